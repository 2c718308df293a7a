"""Units of anyone's columns, by pint: ``deg/s``, ``mm/s``, ``bar``, ``1e-7 deg``, ``0.25 mg``."""

from __future__ import annotations

import math
import re
from functools import cache
from importlib import import_module
from typing import Any, Final

from ssm_graph.base.errors import ConfigError, MissingExtraError
from ssm_graph.base.settings import shown

ISO: Final = "iso"
"""The unit of times that are written as dates."""
_OF_GRAVITY: Final = re.compile(r"(?<![A-Za-z_])(m|u|µ|μ)?(g|G|gee)(?![A-Za-z_0-9])")
"""An acceleration in g; pint would take it for grams."""
_OF_FIELD: Final = re.compile(r"(?<![A-Za-z_])(m|u|n|µ|μ)?(gauss|Gauss|Gs|G)(?![A-Za-z_0-9])")
_PREFIXES: Final = {None: "", "m": "1e-3 *", "u": "1e-6 *", "µ": "1e-6 *", "μ": "1e-6 *"}
_PREFIXES_OF_FIELD: Final = {**_PREFIXES, "n": "1e-9 *"}
_LONGEST: Final = 200
_POWER: Final = re.compile(r"\s*(?:\*\*|\^)\s*")
_MOST_POWERS: Final = 4
_POWERS: Final = re.compile(r"\^[^\s*/^)]*?(\d\d|\^|\()")
"""Powers of powers or of more than one digit, which take for ever to reckon."""


def factor_to(unit: str, wanted: str, *, place: str) -> float:
    """Return what a number in ``unit`` is multiplied by to be one in ``wanted``.

    Raises :class:`ConfigError` for a unit that is none or measures something else;
    :class:`MissingExtraError` where pint is not installed. ``unit`` may have a number before it.

    >>> factor_to("0.5 mm/s", "m/s", place="map.toml")
    0.0005
    """
    words = unit.strip().replace("°", "deg")
    if words == wanted:
        return 1.0
    if wanted == "m/s^2":
        words = _OF_GRAVITY.sub(lambda m: f"({_PREFIXES[m[1]]} standard_gravity)", words)
    if wanted == "uT":
        words = _OF_FIELD.sub(lambda m: f"({_PREFIXES_OF_FIELD[m[1]]} 1e-4 * tesla)", words)
    registry, pint = _registry()
    try:
        powers = _POWER.sub("^", words)
        is_high = _POWERS.search(powers) or powers.count("^") > _MOST_POWERS
        if len(words) > _LONGEST or is_high:
            raise ValueError("too long, or too high a power")
        quantity = registry.Quantity(1.0, "") * registry.parse_expression(words)
        factor = float(quantity.to(wanted.replace("^", "**")).magnitude)
        if not (math.isfinite(factor) and factor != 0.0):
            raise ValueError(f"it is {factor:g} {wanted}")
        return factor
    except pint.DimensionalityError:
        raise ConfigError(f"{place}: expected a unit like {wanted}, got {unit!r}") from None
    except Exception as error:  # pint's parser raises what Python's does
        text = " ".join(str(error).split())[:100] or type(error).__name__
        raise ConfigError(
            f"{place}: {shown(unit)} is no unit ({text}); expected one like {wanted}"
        ) from None


@cache
def _registry() -> tuple[Any, Any]:
    try:
        pint = import_module("pint")
    except ImportError as error:
        raise MissingExtraError("pint", extra="columns", purpose="units of columns") from error
    registry = pint.UnitRegistry()
    registry.define("dps = degree / second")
    registry.define("dph = degree / hour")
    return registry, pint
