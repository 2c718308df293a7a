"""Values that no estimator can use are refused, with the name and row of the first one."""

from __future__ import annotations

from operator import attrgetter

import numpy as np

from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import Array


def require_finite(name: str, values: Array) -> None:
    """Raise unless all values are finite, naming the first that is not."""
    _refuse(name, values, ~np.isfinite(values), "a finite number")


def require_positive(name: str, values: Array) -> None:
    """Raise unless all are finite and above zero."""
    _refuse(name, values, ~(np.isfinite(values) & (values > 0.0)), "a finite number above zero")


def require_increasing(name: str, times: Array) -> None:
    """Raise unless times increase strictly."""
    require_finite(name, times)
    wrong = np.zeros(len(times), bool)
    wrong[1:] = ~(np.diff(times) > 0.0)
    _refuse(name, times, wrong, "times that increase strictly")


def require_fields(
    name: str, value: object, *, increasing: str = "", finite: str = "", positive: str = ""
) -> None:
    """Raise for the first field of a value that is not as it has to be; dotted ones lie within."""
    checks = ((require_increasing, increasing), (require_positive, positive))
    for check, fields in (*checks, (require_finite, finite)):
        for field in fields.split():
            check(f"{name}.{field}", np.atleast_1d(attrgetter(field)(value)))


def _refuse(
    name: str, values: Array, wrong: np.ndarray[tuple[int, ...], np.dtype[np.bool_]], expected: str
) -> None:
    places = np.argwhere(wrong)
    if len(places) == 0:
        return
    at = tuple(int(i) for i in places[0])
    raise DataError(
        f"{name}, row {at[0]}: expected {expected}, got {values[at]:g} ({len(places)} such "
        "values); check where the mission was made"
    )
