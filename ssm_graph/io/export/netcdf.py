"""NetCDF (classic) by the CF conventions 1.11: one trajectory, for xarray, MATLAB and archives."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import numpy as np

from ssm_graph.base.frozen import Array
from ssm_graph.io.export.track import Track

FILL: Final = 9.969209968386869e36
"""NetCDF's own value for what is missing."""
_ENU: Final = ("eastward", "northward", "upward")


def write_netcdf(track: Track, path: Path) -> None:
    """Write coordinates, velocities, attitude and their sigmas along one trajectory."""
    from scipy.io import netcdf_file

    seconds = track.unix_s
    with netcdf_file(str(path), "w", version=2) as file:
        attributes = {
            "Conventions": "CF-1.11",
            "featureType": "trajectory",
            "title": track.name,
            "comment": track.about,
            "source": "inertial and DVL navigation, ssm-graph",
            "institution": "not stated",
            "references": "not stated",
            "history": f"{datetime.now(UTC).strftime('%Y-%m-%dT%H:%M:%SZ')} ssm-graph export",
        }
        for key, value in attributes.items():
            setattr(file, key, value.encode())
        name = track.name.encode() or b"mission"
        file.createDimension("time", len(seconds))
        file.createDimension("name_length", len(name))
        identity = file.createVariable("trajectory", "c", ("name_length",))
        identity[:] = np.frombuffer(name, "S1")
        identity.cf_role, identity.long_name = b"trajectory_id", b"name of the mission"
        system = file.createVariable("crs", "i", ())
        for key, number in (
            ("semi_major_axis", 6378137.0),
            ("inverse_flattening", 298.257223563),
            ("longitude_of_prime_meridian", 0.0),
        ):
            setattr(system, key, number)
        system.grid_mapping_name = b"latitude_longitude"
        system.reference_ellipsoid_name = system.horizontal_datum_name = b"WGS 84"
        system.prime_meridian_name = b"Greenwich"
        for args in _variables(track, seconds):
            _put(file, *args)


def _variables(track: Track, seconds: Array) -> list[tuple[str, Array, dict[str, str]]]:
    """Return name, values and attributes of every variable along the track."""
    angles = np.degrees(track.roll_pitch_heading)
    sigmas = np.degrees(track.attitude_sigma)
    rows: list[tuple[str, Array, dict[str, str]]] = [
        ("time", seconds, {**_is("time", "seconds since 1970-01-01T00:00:00Z"), **_TIME}),
        ("lat", np.degrees(track.lat), {**_is("latitude", "degrees_north"), "axis": "Y"}),
        ("lon", np.degrees(track.lon), {**_is("longitude", "degrees_east"), "axis": "X"}),
        ("height", track.height, {**_is("height_above_reference_ellipsoid", "m"), **_UP}),
    ]
    for i, along in enumerate(_ENU):
        about = {"long_name": f"{along} velocity of the vehicle over ground", "units": "m s-1"}
        sigma = {"long_name": f"standard error of the {along} velocity", "units": "m s-1"}
        name = f"{along}_velocity"
        rows.append(
            (name, track.velocity_enu[:, i], {**about, "ancillary_variables": f"{name}_se"})
        )
        rows.append((f"{name}_se", track.velocity_sigma_enu[:, i], sigma))
        where = {"long_name": f"standard error of the position, {along}", "units": "m"}
        rows.append((f"{along}_position_se", track.position_sigma_enu[:, i], where))
    for i, (name, standard) in enumerate(
        (
            ("roll", "platform_roll_starboard_down"),
            ("pitch", "platform_pitch_fore_up"),
            ("heading", "platform_orientation"),
        )
    ):
        about = {**_is(standard, "degree"), "ancillary_variables": f"{name}_se"}
        rows.append((name, angles[:, i], about))
        error = {"standard_name": f"{standard} standard_error", "units": "degree"}
        rows.append((f"{name}_se", sigmas[:, i], error))
    return rows


_TIME: Final = {"calendar": "standard", "axis": "T", "units_metadata": "leap_seconds: none"}
_UP: Final = {"positive": "up", "axis": "Z"}
_COORDINATES: Final = ("time", "lat", "lon", "height")


def _is(standard_name: str, units: str) -> dict[str, str]:
    return {"standard_name": standard_name, "long_name": standard_name, "units": units}


def _put(file: Any, name: str, values: Array, attributes: dict[str, str]) -> None:
    variable = file.createVariable(name, "d", ("time",))
    if name not in _COORDINATES:
        variable._FillValue = np.float64(FILL)
        attributes = {**attributes, "coordinates": "time lat lon height", "grid_mapping": "crs"}
    variable[:] = np.where(np.isfinite(values), values, FILL)
    for key, text in attributes.items():
        setattr(variable, key, text.encode())
