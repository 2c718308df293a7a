"""Recordings of Nortek's instruments as messages of a mission folder; the beams are kept."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Final

import numpy as np

from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import Array
from ssm_graph.base.progress import told
from ssm_graph.io.nortek.packets import NUCLEUS_FAMILY, Packet, find_packets
from ssm_graph.io.nortek.reports import Report, nucleus_heading, nucleus_imu, report_of
from ssm_graph.io.recording import Recording, whole
from ssm_graph.sensors.compass import HeadingReading
from ssm_graph.sensors.dvl import Ping
from ssm_graph.sensors.imu import FORCE_RANGE, ImuSample
from ssm_graph.sensors.messages import Message

_FEWEST_FITTED: Final = 10
_WORST_FIT: Final = 0.02
"""m/s, of beams by the velocity made of them: a unit whose axes are known fits to millimetres."""
_TURNING: Final = 0.01
"""rad/s rms: slower turns tell no unit."""
_DEGREES: Final = 180.0 / np.pi


def read_nortek(path: Path) -> Recording:
    """Return the pings, headings and inertial samples of a recording.

    A speed is taken to be positive where the instrument moves along the beam.

    Raises :class:`DataError` for a file without sound bottom track in beam coordinates, one of
    several instruments, and a clock that goes back.
    """
    data = whole(path)
    found = find_packets(data)
    reports, notes = _reports(path, found.packets)
    with_speed = sum(bool(np.isfinite(report.speed).any()) for report in reports)
    is_nucleus = any(packet.family == NUCLEUS_FAMILY for packet in found.packets)
    about = (
        f"Nortek {'Nucleus' if is_nucleus else 'AD2CP'}, {len(found.packets)} packets, "
        f"{len(reports)} reports of {len(reports[0].speed)} beams, speeds in "
        f"{100.0 * with_speed / len(reports):.0f} %"
    )
    if found.n_damaged:
        notes.append(f"{found.n_damaged} damaged packets left out")
    notes.append(_mount_note(reports))
    headings = [
        HeadingReading(report.time_s, report.heading)
        for report in reports
        if np.isfinite(report.heading)
    ]
    turned = [row for packet in found.packets if (row := nucleus_heading(packet))]
    headings += [HeadingReading(time_s, float(np.radians(deg))) for time_s, deg in turned]
    samples, said = _samples([row for p in found.packets if (row := nucleus_imu(p))], turned)
    pings = [
        Ping(r.time_s, tuple(r.speed.tolist()), _sigma(r.sigma), is_water=r.is_water)
        for r in reports
    ]
    every: list[Message] = [*pings, *headings, *samples]
    return Recording(about, tuple(sorted(every, key=lambda m: m.time_s)), (*notes, *said))


def _sigma(sigma: Array) -> tuple[float, ...] | None:
    return tuple(sigma.tolist()) if np.isfinite(sigma).any() else None


def _reports(path: Path, packets: tuple[Packet, ...]) -> tuple[list[Report], list[str]]:
    """Return the reports of speeds of one instrument; raise where there are none."""
    reports: list[Report] = []
    refused: Counter[str] = Counter()
    last = {False: -np.inf, True: -np.inf}
    n_repeats = 0
    for packet in told(packets, len(packets)):
        try:
            report = report_of(packet)
        except ValueError as error:
            refused[str(error)] += 1
            continue
        if report is None:
            continue
        if report.time_s < last[report.is_water]:
            raise DataError(
                f"{path}: the clock goes from {last[report.is_water]:.3f} to {report.time_s:.3f} s;"
                " expected increasing times: split the file there"
            )
        n_repeats += report.time_s == last[report.is_water]
        if report.time_s > last[report.is_water]:
            reports.append(report)
        last[report.is_water] = report.time_s
    if not reports:
        kinds = Counter(f"{p.family:02X}/{p.kind:02X}" for p in packets)
        why = "; ".join(f"{n} times {text}" for text, n in refused.items())
        raise DataError(
            f"{path}: {len(packets)} sound packets and no bottom track in beam coordinates"
            f"{f' ({why})' if why else ''}; it has "
            f"{', '.join(f'{n} of kind {kind}' for kind, n in kinds.most_common(5)) or 'none'}; "
            "turn bottom track on, in beam coordinates"
        )
    counts = Counter(len(report.speed) for report in reports)
    if len(counts) > 1:
        raise DataError(
            f"{path}: reports of {' and '.join(map(str, counts))} beams; expected one instrument: "
            "split the file"
        )
    notes = ["times are those of the instrument's clock"]
    if n_repeats:
        notes.append(f"{n_repeats} reports of a time that an earlier one has were left out")
    return reports, notes


def _mount_note(reports: list[Report]) -> str:
    """Return the directions of the beams, by the velocities that the instrument made of them."""
    speed = np.array([r.speed for r in reports if not r.is_water])
    velocity = np.array([r.velocity for r in reports if not r.is_water])
    sign = "speeds are taken to be positive along the beam (else --beams-against)"
    whole = np.isfinite(speed).all(axis=1) & np.isfinite(velocity).all(axis=1) if len(speed) else []
    if np.sum(whole) >= _FEWEST_FITTED:
        found, _, rank, _ = np.linalg.lstsq(velocity[whole], speed[whole])
        off = np.sqrt(np.mean((velocity[whole] @ found - speed[whole]) ** 2))
        if rank == 3 and off < _WORST_FIT:
            units = (found / np.linalg.norm(found, axis=0)).T
            rows = ", ".join("[" + ", ".join(f"{v:.5f}" for v in row) + "]" for row in units)
            return (
                f"by the velocities that the instrument made of its beams, [dvl] has beam_vectors ="
                f" [{rows}] in its own x, y, z; {sign}"
            )
    return (
        "the directions of the beams are not told: [dvl] needs beam_azimuth_deg in the order of "
        f"the beams and beam_janus_deg (25 of a DVL, 20 of a Nucleus); {sign}"
    )


def _samples(
    rows: list[tuple[float, ...]], turned: list[tuple[float, ...]]
) -> tuple[list[ImuSample], list[str]]:
    """Return inertial samples in SI units, by what gravity and the turns of the heading tell."""
    if not rows:
        return [], []
    table = np.array(sorted(rows))
    table = table[np.r_[True, np.diff(table[:, 0]) > 0.0]]
    force = float(np.median(np.linalg.norm(table[:, 4:7], axis=1)))
    low, high = FORCE_RANGE
    unit = 1.0 if low <= force <= high else 9.80665 if low <= force * 9.80665 <= high else 0.0
    rate = _unit_of_rates(table, np.array(sorted(turned)) if turned else np.zeros((0, 2)))
    if not unit or not rate:
        return [], [
            f"{len(table)} inertial samples left out: "
            + (
                f"their median force is {force:.3g}, neither in m/s^2 nor in g"
                if not unit
                else "no turn of the heading tells whether the gyros are in rad/s or deg/s"
            )
        ]
    said = f"inertial samples: gyros in {'rad/s' if rate == 1.0 else 'deg/s'}, by the heading"
    return [
        ImuSample(t, (gx * rate, gy * rate, gz * rate), (ax * unit, ay * unit, az * unit))
        for t, gx, gy, gz, ax, ay, az in table.tolist()
    ], [said]


def _unit_of_rates(table: Array, turned: Array) -> float:
    """Return rad/s of one unit of the gyros; 0 where the heading (M, 2) does not tell."""
    turned = turned[np.unique(turned[:, 0], return_index=True)[1]] if len(turned) else turned
    if len(turned) < _FEWEST_FITTED:
        return 0.0
    heading = np.unwrap(np.radians(turned[:, 1]))
    gained = np.concatenate([[0.0], np.cumsum(table[1:, 3] * np.diff(table[:, 0]))])
    own = np.interp(turned[:, 0], table[:, 0], gained)
    step = np.diff(turned[:, 0])
    true, told = np.diff(heading) / step, np.diff(own) / step
    if np.sqrt(np.mean(true**2)) < _TURNING or not np.any(told):
        return 0.0
    ratio = abs(float(np.sum(told * true) / np.sum(true**2)))
    if 0.5 < ratio < 2.0:
        return 1.0
    return 1.0 / _DEGREES if 0.5 < ratio / _DEGREES < 2.0 else 0.0
