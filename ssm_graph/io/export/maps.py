"""What maps draw: GeoJSON, GPX, and KML with its zipped form KMZ."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final
from xml.etree.ElementTree import Element, SubElement, indent, tostring

import numpy as np

from ssm_graph.base.frozen import Array
from ssm_graph.base.progress import told
from ssm_graph.base.runs import runs_of
from ssm_graph.io.export.track import Track

KML: Final = "http://www.opengis.net/kml/2.2"
GX: Final = "http://www.google.com/kml/ext/2.2"
GPX: Final = "http://www.topografix.com/GPX/1/1"
MOST_ELLIPSES: Final = 200
"""In a KML file; more cover each other."""
_CORNERS: Final = 24
_TRACK_COLOR: Final = "ffd18b00"
_SUSPECT_COLOR: Final = "ff2b52e8"
"""aabbggrr, as KML has it: the blue and the vermilion of the figures."""


def degrees(track: Track) -> Array:
    """Return longitude, latitude (degrees) and height (m) of every row, (N, 3)."""
    lon = (np.degrees(track.lon) + 180.0) % 360.0 - 180.0
    return np.column_stack([lon.round(9), np.degrees(track.lat).round(9), track.height.round(3)])


def lines(points: Array) -> list[Array]:
    """Return the track cut where it crosses the antimeridian, as RFC 7946 asks for.

    Either part ends on the meridian itself.
    """
    cut = np.flatnonzero(np.abs(np.diff(points[:, 0])) > 180.0) + 1
    parts = np.split(points, cut)
    for before, (i, index) in zip(parts[:-1], enumerate(cut), strict=True):
        a, b = before[-1], points[index]
        side = np.sign(a[0]) * 180.0
        share = (side - a[0]) / (b[0] + 2.0 * side - a[0])
        meridian = a + share * (b - a)
        meridian[0] = side
        parts[i] = np.vstack([before, meridian])
        meridian = meridian * [-1.0, 1.0, 1.0]
        parts[i + 1] = np.vstack([meridian, parts[i + 1]])
    return parts


def suspect_stretches(track: Track) -> Iterator[slice]:
    """Yield where the answer is doubtful, stretch by stretch of two rows at least."""
    yield from (slice(begin, end) for begin, end in runs_of(track.is_suspect) if end - begin > 1)


def _line_geometry(points: Array) -> dict[str, Any]:
    parts = [part.tolist() for part in lines(points)]
    if len(points) == 1:
        return {"type": "Point", "coordinates": points[0].tolist()}
    if len(parts) == 1:
        return {"type": "LineString", "coordinates": parts[0]}
    return {"type": "MultiLineString", "coordinates": parts}


def write_geojson(track: Track, path: Path) -> None:
    """Write the track as a line, and each doubtful stretch as another; RFC 7946.

    Times (UTC where known, else seconds) stand beside the line's points as ``coordTimes``.
    """
    points = degrees(track)
    worst = float(np.nanmax(np.linalg.norm(track.position_sigma_enu[:, :2], axis=1)))
    about: dict[str, Any] = {
        "name": track.name,
        "about": track.about,
        "begin_s": float(track.time_s[0]),
        "end_s": float(track.time_s[-1]),
        "largest_horizontal_sigma_m": worst if np.isfinite(worst) else None,
    }
    if track.epoch_s is not None:
        utc = track.utc()
        about |= {"begin_utc": utc[0], "end_utc": utc[-1]}
    if len(lines(points)) == 1:
        about["coordTimes"] = track.utc() if track.epoch_s is not None else track.time_s.tolist()
    features = [{"type": "Feature", "properties": about, "geometry": _line_geometry(points)}]
    for rows in suspect_stretches(track):
        span = {"begin_s": float(track.time_s[rows][0]), "end_s": float(track.time_s[rows][-1])}
        properties = {"name": f"{track.name}: suspect", **span}
        geometry = _line_geometry(points[rows])
        features.append({"type": "Feature", "properties": properties, "geometry": geometry})
    collection = {"type": "FeatureCollection", "features": features}
    path.write_text(json.dumps(collection, allow_nan=False) + "\n", encoding="utf-8")


def write_gpx(track: Track, path: Path) -> None:
    """Write a GPX 1.1 track with heights, and UTC where it is known."""
    root = Element("gpx", {"version": "1.1", "creator": "ssm-graph", "xmlns": GPX})
    of_track = SubElement(root, "trk")
    _say(of_track, "name", track.name)
    _say(of_track, "desc", track.about)
    segment = SubElement(of_track, "trkseg")
    times = track.utc() if track.epoch_s is not None else None
    for i, (lon, lat, height) in told(enumerate(degrees(track).tolist()), len(track.lat)):
        point = SubElement(segment, "trkpt", {"lat": f"{lat:.9f}", "lon": f"{lon:.9f}"})
        _say(point, "ele", f"{height:.3f}")
        if times is not None:
            _say(point, "time", times[i])
    path.write_bytes(_xml(root))


def write_kml(track: Track, path: Path) -> None:
    """Write a line, a track with times where UTC is known, and ellipses of 3 sigma."""
    path.write_bytes(_kml(track))


def write_kmz(track: Track, path: Path) -> None:
    """Write the same, zipped."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("doc.kml", _kml(track))


def _kml(track: Track) -> bytes:
    root = Element("kml", {"xmlns": KML, "xmlns:gx": GX})
    document = SubElement(root, "Document")
    _say(document, "name", track.name)
    _say(document, "description", track.about)
    for name, color, width in (("track", _TRACK_COLOR, "3"), ("suspect", _SUSPECT_COLOR, "4")):
        line = SubElement(SubElement(document, "Style", {"id": name}), "LineStyle")
        _say(line, "color", color)
        _say(line, "width", width)
    filled = SubElement(document, "Style", {"id": "uncertainty"})
    _say(SubElement(filled, "LineStyle"), "width", "1")
    _say(SubElement(filled, "PolyStyle"), "color", "40d18b00")
    points = degrees(track)
    for part in lines(points):
        _kml_line(document, track.name, "track", part)
    if track.epoch_s is not None:
        _kml_times(document, track, points)
    for rows in suspect_stretches(track):
        begin, end = track.time_s[rows][[0, -1]]
        for part in lines(points[rows]):
            _kml_line(document, f"suspect from {begin:.1f} to {end:.1f} s", "suspect", part)
    _kml_ellipses(document, track)
    return _xml(root)


def _kml_line(document: Element, name: str, style: str, points: Array) -> None:
    placemark = SubElement(document, "Placemark")
    _say(placemark, "name", name)
    _say(placemark, "styleUrl", f"#{style}")
    line = SubElement(placemark, "LineString")
    _say(line, "altitudeMode", "clampToGround")
    _say(line, "coordinates", _coordinates(points))


def _kml_times(document: Element, track: Track, points: Array) -> None:
    placemark = SubElement(document, "Placemark")
    _say(placemark, "name", f"{track.name}, with times")
    times = SubElement(placemark, "gx:Track")
    _say(times, "altitudeMode", "clampToGround")
    for when in track.utc():
        _say(times, "when", when)
    for lon, lat, height in told(points.tolist(), len(points)):
        _say(times, "gx:coord", f"{lon:.9f} {lat:.9f} {height:.3f}")


def _kml_ellipses(document: Element, track: Track) -> None:
    folder = SubElement(document, "Folder")
    _say(folder, "name", "3 sigma east and north")
    n_rows = len(track.time_s)
    frame, local, angle = track.frame, track.local_enu, np.linspace(0.0, 2.0 * np.pi, _CORNERS + 1)
    ring = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(len(angle))])
    for row in np.unique(np.linspace(0, n_rows - 1, min(n_rows, MOST_ELLIPSES)).astype(int)):
        sigma = track.position_sigma_enu[row]
        if not np.isfinite(sigma[:2]).all():
            continue
        lat, lon, _ = frame.geodetic_from_p_n(local[row] + 3.0 * ring * [sigma[0], sigma[1], 0.0])
        placemark = SubElement(folder, "Placemark")
        _say(placemark, "name", f"{track.time_s[row]:.1f} s")
        _say(
            placemark,
            "description",
            (
                f"sigma east {sigma[0]:.2f} m, north {sigma[1]:.2f} m, up {sigma[2]:.2f} m; height "
                f"{track.height[row]:.2f} m"
            ),
        )
        _say(placemark, "styleUrl", "#uncertainty")
        boundary = SubElement(SubElement(placemark, "Polygon"), "outerBoundaryIs")
        of_ring = SubElement(boundary, "LinearRing")
        corners = np.column_stack([np.degrees(lon), np.degrees(lat), np.zeros(len(lat))])
        _say(of_ring, "coordinates", _coordinates(corners))


def _coordinates(points: Array) -> str:
    return " ".join(f"{lon:.9f},{lat:.9f},{height:.3f}" for lon, lat, height in points.tolist())


def _say(parent: Element, tag: str, text: str) -> None:
    element = SubElement(parent, tag)
    element.text = text


def _xml(root: Element) -> bytes:
    indent(root)
    return bytes(tostring(root, encoding="utf-8", xml_declaration=True))
