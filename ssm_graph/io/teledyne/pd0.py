"""Bottom track of PD0 recordings as pings with a speed for every beam.

Velocities in beam coordinates are taken as they are; of instrument, ship and earth coordinates the
beams are restored where that is exact: with four beams and an error velocity, and the attitude that
the instrument itself turned by. A ping that was made of three beams cannot be restored.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict
from pathlib import Path
from typing import Final

import numpy as np

from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import Array
from ssm_graph.io.recording import Recording, whole
from ssm_graph.io.teledyne.ensembles import Ensemble, Setup, find_ensembles
from ssm_graph.sensors.compass import HeadingReading
from ssm_graph.sensors.dvl import Ping

_HEADING_MEASURED: Final = 0x10
_N_BEAMS: Final = 4
"""Of bottom track in PD0; an instrument of five has its fifth for profiles alone."""
_AXES: Final = np.array([[0.0, -1.0], [0.0, 1.0], [1.0, 0.0], [-1.0, 0.0]])
"""Forward and right of beams 1 to 4 of a unit that looks down with beam 3 forward."""


def read_pd0(path: Path) -> Recording:
    """Return the pings of a PD0 recording.

    Raises :class:`DataError` for a file without a sound ensemble, without bottom track, of an
    instrument that looks up, or whose beams cannot be restored; and where settings change amid it.
    """
    data = whole(path)
    found = find_ensembles(data)
    if not found.ensembles and found.n_undated:
        raise DataError(
            f"{path}: {found.n_undated} PD0 ensembles, none with a date: the instrument's clock is "
            "not set; set it (command TS)"
        )
    if not found.ensembles:
        raise DataError(
            f"{path}: no sound PD0 ensemble among {len(data)} bytes ({found.n_damaged} damaged); "
            "was it transferred as text?"
        )
    down = [e for e in found.ensembles if not e.setup.is_up]
    setup = _one_setup(path, down)
    with_bottom = [e for e in down if e.bottom is not None]
    if not with_bottom:
        raise DataError(
            f"{path}: {len(down)} ensembles without bottom track: water profiles alone "
            "are no navigation; turn bottom track on (command BP1)"
        )
    pings, n_without, n_repeats = _pings(path, setup, with_bottom)
    known = sum(bool(np.isfinite(ping.speed).any()) for ping in pings)
    about = (
        f"Teledyne PD0, {len(down)} ensembles, {setup.coordinates} coordinates, bottom track in "
        f"{100.0 * known / (len(down) - n_repeats):.0f} %"
    )
    headings = [
        HeadingReading(time_s=e.unix_s, heading=float(np.radians(e.heading_deg)))
        for e in down
        if e.sensors & _HEADING_MEASURED and setup.coordinates == "beam"
    ]
    notes = [_mount_note(setup), "times are those of the instrument's clock, taken for UTC"]
    if len(down) < len(found.ensembles):
        notes.append(f"{len(found.ensembles) - len(down)} ensembles that look up are left out")
    if found.n_undated:
        notes.append(f"{found.n_undated} ensembles whose clock has no date left out")
    if n_repeats:
        notes.append(f"{n_repeats} pings of a time that an earlier one has were left out")
    if found.n_damaged:
        notes.append(f"{found.n_damaged} damaged ensembles left out")
    if n_without:
        notes.append(
            f"{n_without} pings without an error velocity, made of three beams, are left out: "
            "their beams cannot be restored"
        )
    messages = sorted([*pings, *headings], key=lambda message: message.time_s)
    return Recording(about, tuple(messages), tuple(notes))


def _one_setup(path: Path, ensembles: list[Ensemble]) -> Setup:
    """Return the setup of all ensembles; raise :class:`DataError` where it is of no use."""
    if not ensembles:
        raise DataError(f"{path}: the instrument looks up; expected one that sees the bottom")
    (setup, _), *others = Counter(e.setup for e in ensembles).most_common()
    if others:
        raise DataError(
            f"{path}: {1 + len(others)} different settings of the instrument "
            f"({_difference(setup, others[0][0], ensembles)}); expected one: split the file where "
            "they change"
        )
    if setup.beam_angle_deg is None:
        raise DataError(f"{path}: the angle of the beams is not told: it cannot be used")
    if setup.n_beams < _N_BEAMS and setup.coordinates != "beam":
        raise DataError(
            f"{path}: an instrument of {setup.n_beams} beams in {setup.coordinates} coordinates: "
            "its beams cannot be restored; expected beam coordinates (command EX00xxx)"
        )
    return setup


def _difference(usual: Setup, other: Setup, ensembles: list[Ensemble]) -> str:
    """Return what differs between two settings, and from which ensemble on."""
    mine, others = asdict(usual), asdict(other)
    what = ", ".join(
        f"{name.removesuffix('_deg').replace('_', ' ')} {mine[name]} and {others[name]}"
        for name in mine
        if mine[name] != others[name]
    )
    first = next(e.number for e in ensembles if e.setup == other)
    return f"{what}, from ensemble {first} on"


def _pings(path: Path, setup: Setup, ensembles: list[Ensemble]) -> tuple[list[Ping], int, int]:
    """Return a ping of every ensemble with bottom track.

    And how many could not be restored, and how many had the time of the one before.
    """
    restore = _beams_of(setup)
    pings, n_without, n_repeats, last = [], 0, 0, -np.inf
    for e in ensembles:
        assert e.bottom is not None
        if e.unix_s == last:
            n_repeats += 1
            continue
        if e.unix_s < last:
            raise DataError(
                f"{path}: the clock goes from {last:.2f} to {e.unix_s:.2f} s at ensemble "
                f"{e.number}; expected increasing times: split the file there"
            )
        last = e.unix_s
        if setup.coordinates == "beam":
            speed = e.bottom[: setup.n_beams]
        else:
            xyz_error = _in_instrument(setup, e)
            n_without += bool(np.isnan(xyz_error[3]) and np.isfinite(xyz_error[:3]).all())
            speed = restore @ xyz_error
        pings.append(Ping(time_s=e.unix_s, speed=tuple(speed.tolist())))
    return pings, n_without, n_repeats


def _beams_of(setup: Setup) -> Array:
    """Return what makes beam velocities (4,) of x, y, z and error velocity of the instrument."""
    angle = _angle(setup)
    a, b = 1.0 / (2.0 * np.sin(angle)), 1.0 / (4.0 * np.cos(angle))
    c, d = (1.0 if setup.is_convex else -1.0), a / np.sqrt(2.0)
    matrix = [[c * a, -c * a, 0.0, 0.0], [0.0, 0.0, -c * a, c * a], [b, b, b, b], [d, d, -d, -d]]
    return np.linalg.inv(np.array(matrix))


def _in_instrument(setup: Setup, e: Ensemble) -> Array:
    """Return x, y, z and error velocity (4,) in axes of the instrument.

    Ship and earth coordinates are turned back by heading, pitch and roll of the ensemble, for an
    instrument that looks down (of one that looks up the roll would count half a turn more).
    """
    assert e.bottom is not None
    if setup.coordinates == "instrument":
        return e.bottom
    heading = np.radians(e.heading_deg) if setup.coordinates == "earth" else 0.0
    if setup.coordinates == "ship":
        heading = np.radians(setup.heading_alignment_deg)
    has_tilts = setup.uses_tilts or setup.coordinates == "earth"
    roll = np.radians(e.roll_deg) if has_tilts else 0.0
    # The gimbal's pitch to that of the rotation, as the instrument does it.
    tilt = np.arctan(np.tan(np.radians(e.pitch_deg)) * np.cos(np.radians(e.roll_deg)))
    pitch = float(tilt) if has_tilts else 0.0
    sh, ch, sp, cp, sr, cr = (f(x) for x in (heading, pitch, roll) for f in (np.sin, np.cos))
    turn = np.array(
        [
            [ch * cr + sh * sp * sr, sh * cp, ch * sr - sh * sp * cr],
            [-sh * cr + ch * sp * sr, ch * cp, -sh * sr - ch * sp * cr],
            [-cp * sr, sp, cp * cr],
        ]
    )
    return np.concatenate([turn.T @ e.bottom[:3], e.bottom[3:]])


def _mount_note(setup: Setup) -> str:
    """Return the beam directions for ``mission.toml`` of a unit that looks down."""
    if setup.n_beams < _N_BEAMS:
        return (
            f"{setup.n_beams} beams {setup.beam_angle_deg:g} deg from down; their azimuths are not "
            f"told: [dvl] needs beam_azimuth_deg and beam_janus_deg{_alignment(setup)}"
        )
    angle = _angle(setup)
    rows = np.column_stack([np.sin(angle) * _AXES, np.full(4, np.cos(angle))])
    vectors = ", ".join("[" + ", ".join(f"{v:.5f}" for v in row) + "]" for row in rows)
    return (
        f"beams {setup.beam_angle_deg:g} deg from down; with beam 3 forward [dvl] has "
        f"beam_vectors = [{vectors}]; turn them by mounting_rpy_deg where it is mounted otherwise"
        f"{_alignment(setup)}"
    )


def _angle(setup: Setup) -> float:
    """Return the angle of the beams from the axis, rad, where it is told."""
    assert setup.beam_angle_deg is not None
    return float(np.radians(setup.beam_angle_deg))


def _alignment(setup: Setup) -> str:
    yaw = setup.heading_alignment_deg
    return f" (it was told to be turned: mounting_rpy_deg = [0, 0, {yaw:g}])" if yaw else ""
