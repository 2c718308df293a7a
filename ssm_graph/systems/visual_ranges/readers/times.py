"""Units of time found by what the numbers span, and one clock for images and ranges."""

from __future__ import annotations

from typing import Final

import numpy as np

from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import Array

UNITS: Final = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
"""Names of units of time in headers, and each in seconds."""
FRAME_STEPS_S: Final = (2e-3, 10.0)
"""Time between two images of a video that a map can be made of, shortest and longest."""


def image_seconds(values: Array, where: str, unit: str = "") -> tuple[Array, str]:
    """Return times of images (K,) in seconds, and a note where the unit had to be found.

    Raises :class:`DataError` where no unit gives steps within `FRAME_STEPS_S`.
    """
    if len(values) < 2:
        raise DataError(f"{where}: expected at least 2 images, got {len(values)}")
    if unit:
        return values * UNITS[unit], ""
    step = float(np.median(np.diff(values)))
    for name, factor in UNITS.items():
        if FRAME_STEPS_S[0] <= step * factor <= FRAME_STEPS_S[1]:
            note = (
                ""
                if name == "s"
                else f"{where}: times of images taken for {name} ({step:g} a step)"
            )
            return values * factor, note
    raise DataError(
        f"{where}: the times of images step by {step:g}, which is {FRAME_STEPS_S[0]} to "
        f"{FRAME_STEPS_S[1]:g} s in no unit of s, ms, us, ns; are they times?"
    )


def range_seconds(
    values: Array, where: str, image_time_s: Array, unit: str = ""
) -> tuple[Array, str]:
    """Return times of ranges (M,) in seconds, and a note where the unit had to be found.

    The unit is the one in which most ranges lie within the time of the images.

    Raises :class:`DataError` where none does.
    """
    if len(values) == 0:
        return values, ""
    begin, end = float(image_time_s[0]), float(image_time_s[-1])
    factors = {unit: UNITS[unit]} if unit else UNITS
    shares = {
        name: float(np.mean((values * factor >= begin - 1.0) & (values * factor <= end + 1.0)))
        for name, factor in factors.items()
    }
    best = max(shares, key=lambda name: shares[name])
    if shares[best] == 0.0:
        finite = values[np.isfinite(values)]
        low, high = (finite.min(), finite.max()) if len(finite) else (np.nan, np.nan)
        raise DataError(
            f"{where}: the ranges ({low:.10g} to {high:.10g}) and the images ({begin:.10g} to "
            f"{end:.10g} s) share no time; expected one clock for both; shift the ranges, or give "
            "--start-s, the time of the first image"
        )
    note = "" if best == "s" or unit else f"{where}: times of ranges taken for {best}"
    return values * UNITS[best], note


def increasing(time_s: Array, where: str) -> tuple[np.ndarray[tuple[int], np.dtype[np.intp]], str]:
    """Return the order in which times increase strictly, and a note on what it cost.

    Repeated times are left out but for the first; disordered ones are sorted.
    """
    order = np.argsort(time_s, kind="stable")
    kept = order[np.r_[True, np.diff(time_s[order]) > 0.0]]
    parts = []
    late = int(np.sum(np.diff(time_s) < 0.0))
    if late:
        parts.append(f"{late} out of order, sorted")
    if len(kept) < len(order):
        parts.append(f"{len(order) - len(kept)} with the time of another, left out")
    return kept, f"{where}: images {', '.join(parts)}" if parts else ""
