"""One JSON object of finite numbers a line; NaN is written as null."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any

from ssm_graph.base.settings import shown


def line_of(values: Mapping[str, Any]) -> str:
    """Return the line of an object, with its line break; no number of it may be infinite or NaN."""
    return json.dumps(values, allow_nan=False) + "\n"


def object_of(line: bytes) -> dict[str, Any]:
    """Return a JSON object of finite numbers; raise :class:`ValueError` for all that is none."""
    try:
        values = json.loads(line.decode(), parse_constant=_no_constant)
    except ValueError as error:
        raise ValueError(f"expected a JSON object, got {shown(line)}") from error
    if not isinstance(values, dict):
        raise ValueError(f"expected a JSON object, got {shown(line)}")
    return values


def _no_constant(text: str) -> float:
    raise ValueError(text)


def differing(expected: Mapping[str, Any], found: Mapping[str, Any]) -> str:
    """Return in which settings two studies differ, empty if in none."""
    return "; ".join(
        f"{name}: expected {expected.get(name)!r}, got {found.get(name)!r}"
        for name in sorted(found.keys() | expected.keys())
        if expected.get(name) != found.get(name)
    )


def without_nan(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return values for JSON, None instead of a number that is not finite."""
    return {
        name: None if isinstance(value, float) and not math.isfinite(value) else value
        for name, value in values.items()
    }


def with_nan(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return values of JSON, NaN instead of None."""
    return {name: math.nan if value is None else value for name, value in values.items()}
