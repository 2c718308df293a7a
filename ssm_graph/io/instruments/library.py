"""Instruments by name: what their makers publish, as keys of ``mission.toml``.

The tables have the units of data sheets; here they become those of the mission folder. What a sheet
does not say is not made up: the key is asked for.
"""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Collection, Mapping, Set
from dataclasses import dataclass
from difflib import get_close_matches
from functools import cache
from importlib.resources import files
from typing import Any, Final

from ssm_graph.base.earth import EARTH_RATE
from ssm_graph.base.errors import ConfigError
from ssm_graph.base.settings import shown
from ssm_graph.base.units import STANDARD_GRAVITY, in_unit

KEY: Final = "instrument"
"""Of the sections ``[imu]`` and ``[dvl]``."""
TABLES: Final[Mapping[str, str]] = {"imu": "imus.toml", "dvl": "dvls.toml"}
_TEXTS: Final = ("maker", "sheet", "basis")
_UG_OF_WALK: Final = 1e6 / (60.0 * STANDARD_GRAVITY)
"""ug/sqrt(Hz) of one m/s/sqrt(h)."""

_BIAS_OF_HEADING: Final = round(3600.0 * EARTH_RATE, 4)
"""deg/h: a gyro that is off by ``b`` to the east turns a heading found by gyrocompassing by
``b / (Omega cos(latitude))``, so that a sheet's degree times the secant of latitude is this."""
_UG_OF_TILT: Final = round(1e6 * math.radians(1.0))
"""ug of a degree: an accelerometer that is off by ``b`` tilts the level by ``b / g``."""

_IMU_KEYS: Final[Mapping[str, tuple[str, float]]] = {
    "gyro_random_walk_deg_per_sqrt_h": ("gyro_random_walk_deg_per_sqrt_h", 1.0),
    "gyro_noise_deg_per_s_per_sqrt_hz": ("gyro_random_walk_deg_per_sqrt_h", 60.0),
    "gyro_noise_deg_per_h_per_sqrt_hz": ("gyro_random_walk_deg_per_sqrt_h", 1.0 / 60.0),
    "gyro_in_run_deg_per_h": ("gyro_bias_instability_deg_per_h", 1.0),
    "gyro_bias_deg_per_h": ("gyro_bias_deg_per_h", 1.0),
    "gyro_bias_deg_per_s": ("gyro_bias_deg_per_h", 3600.0),
    "heading_deg_sec_latitude": ("gyro_bias_deg_per_h", _BIAS_OF_HEADING),
    "gyro_scale_ppm": ("gyro_scale_sigma_ppm", 1.0),
    "gyro_g_sensitivity_deg_per_s_per_g": ("gyro_g_sensitivity_sigma_deg_per_h_per_g", 3600.0),
    "accel_noise_ug_per_sqrt_hz": ("accel_random_walk_ug_per_sqrt_hz", 1.0),
    "accel_random_walk_m_per_s_per_sqrt_h": ("accel_random_walk_ug_per_sqrt_hz", _UG_OF_WALK),
    "accel_in_run_ug": ("accel_bias_instability_ug", 1.0),
    "accel_bias_mg": ("accel_bias_ug", 1000.0),
    "roll_pitch_deg": ("accel_bias_ug", _UG_OF_TILT),
    "accel_scale_ppm": ("accel_scale_sigma_ppm", 1.0),
}
"""By figure of a sheet, the key of ``[imu]`` and what the figure is multiplied by."""
_DVL_FIGURES: Final = (
    "beam_azimuth_deg",
    "beam_janus_deg",
    "velocity_std_cm_per_s",
    "long_term_accuracy_percent",
)


@dataclass(frozen=True, slots=True)
class Preset:
    """One instrument of the library."""

    name: str
    section: str
    """imu or dvl."""
    maker: str
    sheet: str
    """What the figures are of, mostly a data sheet, and where it was read or is quoted."""
    basis: str
    """read, quoted or published; see the head of the table."""
    published: tuple[str, ...]
    """Figures that are only generally published though the basis is better."""
    aliases: tuple[str, ...]
    figures: Mapping[str, Any]
    """In the units of the sheet."""

    @property
    def keys(self) -> dict[str, Any]:
        """The keys of its section of ``mission.toml`` that the figures make."""
        if self.section == "dvl":
            return _dvl_keys(self.figures)
        return {
            key: in_unit(figure * factor, 1.0)
            for name, figure in self.figures.items()
            for key, factor in (_IMU_KEYS[name],)
        }

    @property
    def source(self) -> str:
        """One sentence for people: how good the figures are."""
        how = {
            "read": "read",
            "quoted": "as quoted elsewhere",
            "published": "published figures, not read from a sheet here",
        }[self.basis]
        if not self.figures:
            return f"no figures: {self.sheet}"
        less = f"; {', '.join(self.published)}: published, not read here" if self.published else ""
        return f"{self.sheet} ({how}{less})"


def _dvl_keys(figures: Mapping[str, Any]) -> dict[str, Any]:
    """Return keys of a DVL of four beams.

    One horizontal component is ``(b1 - b2) / (2 sin J)`` of opposite beams, so that its sigma is
    ``sigma_beam / (sqrt(2) sin J)``.
    """
    keys = {name: figures[name] for name in _DVL_FIGURES[:2] if name in figures}
    if "velocity_std_cm_per_s" in figures:
        slant = math.sin(math.radians(figures["beam_janus_deg"]))
        sigma = 0.01 * figures["velocity_std_cm_per_s"] * math.sqrt(2.0) * slant
        keys["beam_noise_m_per_s"] = float(f"{sigma:.3g}")
    if "long_term_accuracy_percent" in figures:
        keys["scale_sigma"] = in_unit(figures["long_term_accuracy_percent"], 100.0)
    return keys


@cache
def presets() -> tuple[Preset, ...]:
    """Return all instruments, those of a section in the order of its table."""
    found = []
    for section, table in TABLES.items():
        text = (files("ssm_graph.io.instruments") / table).read_text("utf-8")
        for name, raw in tomllib.loads(text).items():
            known = {key: raw.pop(key) for key in _TEXTS}
            known |= {key: tuple(raw.pop(key, ())) for key in ("published", "aliases")}
            found.append(Preset(name=name, section=section, figures=raw, **known))
    return tuple(found)


def preset(section: str | None, name: str, *, place: str) -> Preset:
    """Return an instrument by its name or an alias, whatever the case, blanks and dashes.

    ``section`` is imu or dvl; None looks among all.

    Raises :class:`ConfigError` with the nearest names for one that is not there; ``place`` is where
    it was asked for.
    """
    known = {
        _plain(word): one
        for one in presets()
        if section in (None, one.section)
        for word in (one.name, *one.aliases)
    }
    if _plain(name) in known:
        return known[_plain(name)]
    close = get_close_matches(_plain(name), known, n=3, cutoff=0.5)
    names = list(dict.fromkeys(known[word].name for word in close))
    hint = f"did you mean {' or '.join(map(repr, names))}?" if names else "none is like it;"
    raise ConfigError(
        f"{place}: there is no {section or 'instrument'} {shown(name)} in the library; {hint} "
        "ssm-graph instruments  lists them"
    )


def _plain(name: str) -> str:
    return re.sub(r"[\s_-]+", "", name).casefold()


def with_preset(
    section: str, raw: Mapping[str, Any], *, file: str, required: Set[str]
) -> tuple[dict[str, Any], Preset | None]:
    """Return a section with the figures of the instrument that it names; its own keys win.

    Raises :class:`ConfigError` for an unknown instrument, and for a key that its sheet does not
    give and the section has to: ``required`` are those.
    """
    own = dict(raw)
    name = own.pop(KEY, None)
    if name is None:
        return own, None
    place = f"{file} [{section}] {KEY}"
    if not isinstance(name, str):
        raise ConfigError(f"{place}: expected a text in quotes, got {shown(name)}")
    found = preset(section, name, place=place)
    keys = found.keys
    if "beam_vectors" in own:  # say the same otherwise
        keys = {key: value for key, value in keys.items() if key not in _DVL_FIGURES[:2]}
    merged = {**keys, **own}
    missing = asked_for(section, merged, required)
    if missing:
        raise ConfigError(
            f"{file} [{section}] {missing[0]}: expected beside {KEY} = {found.name!r}, of which no "
            f"source gives {', '.join(missing)}; state it (a data sheet, or an Allan deviation at "
            "rest)"
        )
    return merged, found


def asked_for(section: str, known: Collection[str], required: Set[str]) -> list[str]:
    """Return what a section needs of an instrument's keys beside those that are ``known``."""
    asked = (key for key, _ in _IMU_KEYS.values()) if section == "imu" else _ASKED_OF_DVL
    missing = [key for key in dict.fromkeys(asked) if key in required and key not in known]
    if section == "dvl" and "beam_vectors" not in known:
        missing = [*[key for key in _DVL_FIGURES[:2] if key not in known], *missing]
    return missing


_ASKED_OF_DVL: Final = ("beam_noise_m_per_s",)
