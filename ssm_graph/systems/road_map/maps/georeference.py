"""Where the plane of an OpenDRIVE file lies on Earth: its ``geoReference`` and ``offset``."""

from __future__ import annotations

import math
import re
from typing import Final
from xml.etree import ElementTree

from ssm_graph.base.projection import TransverseMercator

_ELLIPSOIDS: Final = frozenset({"WGS84", "GRS80"})
"""Alike within a tenth of a millimetre."""
_UTM_CODE: Final = re.compile(r"(?:EPSG:|\+init=epsg:)(326|327|258)(\d\d)", re.IGNORECASE)
_READ: Final = (
    "read are +proj=utm, +proj=tmerc in metres on WGS 84 or GRS 80, and EPSG:326zz, 327zz, 258zz"
)


def plane_of(root: ElementTree.Element) -> tuple[TransverseMercator | None, tuple[str, ...]]:
    """Return the plane of a file from its header, and notes where it says one that is not read.

    Heights (``+geoidgrids``, ``+vunits``) are left out. The header's ``offset`` is what the file's
    coordinates lack of those of the projection.
    """
    told = root.find("header/geoReference")
    text = "" if told is None or told.text is None else told.text.strip()
    if not text:
        return None, ()
    try:
        x0, y0 = _offset(root)
        return _mercator(text, x0, y0), ()
    except ValueError as error:
        return None, (f"geoReference {text!r}: {error}; positions in degrees cannot be placed",)


def _offset(root: ElementTree.Element) -> tuple[float, float]:
    found = root.find("header/offset")
    if found is None:
        return 0.0, 0.0
    if float(found.get("hdg", "0")) != 0.0:
        raise ValueError("an offset that turns (hdg) is not read")
    return float(found.get("x", "0")), float(found.get("y", "0"))


def _mercator(text: str, x: float, y: float) -> TransverseMercator:
    """Return the projection that a text names, less an offset, m; ValueError names what is not."""
    code = _UTM_CODE.fullmatch(text.split()[0])
    if code is not None:
        return _utm(int(code[2]), x, y, is_south=code[1] == "327")
    said: dict[str, str] = dict(re.findall(r"\+(\w+)(?:=(\S+))?", text))
    kind = said.get("proj", "")
    if kind not in {"utm", "tmerc"}:
        raise ValueError(f"a projection {kind!r}; {_READ}")
    earth = {said[key] for key in ("datum", "ellps") if key in said}
    if not earth or not earth <= _ELLIPSOIDS:
        raise ValueError(f"an Earth of {', '.join(sorted(earth)) or 'no name'}; {_READ}")
    if said.get("units", "m") != "m" or float(said.get("to_meter", "1") or 0) != 1.0:
        raise ValueError(f"units other than metres; {_READ}")
    if any(float(v) != 0.0 for v in said.get("towgs84", "0").split(",")):
        raise ValueError(f"a shift to WGS 84; {_READ}")
    if kind == "utm":
        return _utm(int(said.get("zone", "0")), x, y, is_south="south" in said)
    lat, lon, east, north = (float(said.get(k, "0")) for k in ("lat_0", "lon_0", "x_0", "y_0"))
    scale = float(said.get("k_0", said.get("k", "1")))
    return TransverseMercator(math.radians(lat), math.radians(lon), scale, east - x, north - y)


def _utm(zone: int, x: float, y: float, *, is_south: bool) -> TransverseMercator:
    if not 1 <= zone <= 60:
        raise ValueError(f"a UTM zone of {zone}, expected 1 to 60")
    middle, north = math.radians(6.0 * zone - 183.0), 10e6 if is_south else 0.0
    return TransverseMercator(0.0, middle, 0.9996, 500e3 - x, north - y)
