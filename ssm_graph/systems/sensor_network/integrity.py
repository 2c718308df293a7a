"""The smoother's answer beside the set: inside, outside, or a proof that a bound is false."""

from __future__ import annotations

import csv
import io
import json
from dataclasses import dataclass, replace
from enum import Enum
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from ssm_graph.base.frozen import Array, ReadOnlyArrays
from ssm_graph.filters.rules.ellipsoids import Mask
from ssm_graph.io.tables.append_file import write_through
from ssm_graph.mission.estimate import Estimate, Trajectory
from ssm_graph.mission.fault import DetectedFault, Treatment
from ssm_graph.mission.mission import InitialState, Mission, Reference
from ssm_graph.sensors.imu import ImuLog
from ssm_graph.systems.sensor_network.witness import (
    LONGEST_GAP_S,
    BoundAlarm,
    Witness,
    WitnessBounds,
    joined,
    witness,
)

PROTECTION_SIGMAS: Final = 5.0
"""Of the smoother, beside which the width of the set is told."""
NOISE_STEPS: Final = 41
"""Headings that are tried for a truth whose gyro noise is not known."""
APART_S: Final = 60.0
"""Alarms of a sensor that are closer than this are one finding."""
RIVALS: Final = {
    "GNSS": ("DVL", "gyros", "start"),
    "compass": ("gyros", "start"),
    "depth": ("DVL", "start"),
    "DVL": ("accelerometers",),
}
"""Whose bound may be the false one instead."""


class Agreement(Enum):
    """What the witness says of an answer; the text is shown to the user."""

    INSIDE = "the answer is inside the set, and no bound was contradicted"
    ALARM = "not all of the stated bounds are true"
    OUTSIDE = "the answer leaves the set, so it is wrong or a stated bound is false"


@dataclass(frozen=True, slots=True, eq=False)
class Integrity(ReadOnlyArrays):
    """An answer beside the set, at the ends of M blocks."""

    witness: Witness
    answer_n: Array
    """(M, 3) m, position of the answer in the mission's frame"""
    excess: Array
    """(M,) of its horizontal place, at most 1 inside the set"""
    is_inside: Mask
    """(M,) of place and height"""
    radius_m: Array
    """(M,) how far the truth can be from the answer, level, if the bounds are true"""
    up_m: Array
    """(M,) the same of the height"""
    sigma_radius_m: Array
    """(M,) `PROTECTION_SIGMAS` of the answer's own, along its worst level direction"""
    ends_s: tuple[float, ...] = ()
    """Where sets ended at gaps of the inertial data; after each a new one began with the answer"""

    @property
    def agreement(self) -> Agreement:
        """What the witness says."""
        if self.witness.alarms:
            return Agreement.ALARM
        return Agreement.INSIDE if self.is_inside.all() else Agreement.OUTSIDE

    @property
    def reason(self) -> str:
        """One sentence, with numbers."""
        w = self.witness
        text = self.agreement.value
        if w.alarms:
            text = f"{text}: {w.alarms[0].sentence}"
            return f"{text} (and {len(w.alarms) - 1} more)" if len(w.alarms) > 1 else text
        if not self.is_inside.all():
            first = float(w.time_s[int(np.argmin(self.is_inside))])
            return f"{text}: from {first:.0f} s, {int((~self.is_inside).sum())} blocks"
        return (
            f"{text}; at the end the truth is within {self.radius_m[-1]:.3g} m of it if the bounds "
            f"are true, {PROTECTION_SIGMAS:g} of its sigmas are {self.sigma_radius_m[-1]:.2g} m"
            f"{self._anew}"
        )

    @property
    def _anew(self) -> str:
        if not self.ends_s:
            return ""
        times = ", ".join(f"{at:.0f}" for at in self.ends_s)
        return (
            f"; inertial data are missing after {times} s, where the set began anew with the "
            "answer, which is trusted there"
        )

    @property
    def faults(self) -> tuple[DetectedFault, ...]:
        """The alarms as findings: by sensor, joined where they are close."""
        found: list[list[BoundAlarm]] = []
        for alarm in sorted(self.witness.alarms, key=lambda a: (a.sensor, a.time_s)):
            last = found[-1][-1] if found else None
            if last and last.sensor == alarm.sensor and alarm.time_s - last.time_s <= APART_S:
                found[-1].append(alarm)
            else:
                found.append([alarm])
        faults = [
            DetectedFault(
                sensor=group[0].sensor,
                what=f"misses the set of what its bounds allow, {group[0].by}",
                begin_s=group[0].time_s,
                end_s=group[-1].time_s,
                chi_sq=float("inf"),
                dof=0,
                treatment=Treatment.SAID,
                rivals=RIVALS[group[0].sensor],
                remedy="one of the stated sigmas is too small, or the sensor was off",
            )
            for group in found
        ]
        return tuple(sorted(faults, key=lambda fault: fault.begin_s))


def check_integrity(
    mission: Mission, estimate: Estimate, bounds: WitnessBounds | None = None
) -> Integrity:
    """Return a smoother's answer beside the set of its mission's bounds, from its own start on.

    Where inertial data are missing for more than `LONGEST_GAP_S`, the set begins anew with the
    answer of then.
    """
    trajectory = estimate.trajectory
    parts = [
        witness(replace(mission, imu=imu), start, bounds)
        for imu, start in _pieces(mission.imu.calibrated, estimate)
    ]
    w = joined(parts)
    p_n = mission.frame.p_n_from_geodetic(trajectory.lat, trajectory.lon, trajectory.height)
    answer = np.column_stack([np.interp(w.time_s, trajectory.time_s, x) for x in p_n.T])
    found = against(w, answer)
    worst = np.sqrt(np.linalg.eigvalsh(trajectory.position_cov_enu[:, :2, :2])[:, -1])
    return Integrity(
        witness=w,
        answer_n=answer,
        excess=found.excess,
        is_inside=found.is_inside,
        radius_m=found.radius_m,
        up_m=found.up_m,
        sigma_radius_m=PROTECTION_SIGMAS * np.interp(w.time_s, trajectory.time_s, worst),
        ends_s=tuple(float(part.time_s[-1]) for part in parts[:-1]),
    )


def _pieces(imu: ImuLog, estimate: Estimate) -> list[tuple[ImuLog, InitialState]]:
    """Return the inertial data between their gaps, with the answer where each piece begins."""
    t, trajectory, start = imu.time_s, estimate.trajectory, estimate.start
    ends = [*(np.flatnonzero(np.diff(t) > LONGEST_GAP_S) + 1), len(t)]
    found: list[tuple[ImuLog, InitialState]] = []
    for first, last in zip([0, *ends], ends, strict=False):
        if t[last - 1] <= start.time_s:
            continue
        log, at = imu, start
        if len(ends) > 1:  # the first sample after a gap is the mean over it, or of nobody knows
            begun = first + 1 if first else 0
            begin_s = float(t[first]) if first else imu.start_s
            rows = {name: getattr(imu, name)[begun:last] for name in ("gyro_b", "accel_b")}
            log = replace(imu, start_s=begin_s, time_s=t[begun:last], **rows)
        if found or (first and t[first] > start.time_s):
            later = np.flatnonzero(
                (trajectory.time_s >= t[first]) & (trajectory.time_s < t[last - 1])
            )
            if len(later) == 0:
                continue
            at = _state_of(trajectory, int(later[0]))
        found.append((log, at))
    return found


def _state_of(trajectory: Trajectory, i: int) -> InitialState:
    """Return an answer as the start of a set, with its sigmas."""
    roll, pitch, heading = (float(angle) for angle in trajectory.roll_pitch_heading[i])
    return InitialState(
        float(trajectory.time_s[i]),
        float(trajectory.lat[i]),
        float(trajectory.lon[i]),
        float(trajectory.height[i]),
        roll,
        pitch,
        heading,
        velocity_enu=trajectory.velocity_enu[i].copy(),
        position_sigma_enu=np.sqrt(np.diag(trajectory.position_cov_enu[i])),
        velocity_sigma_enu=trajectory.velocity_sigma_enu[i].copy(),
        attitude_sigma=trajectory.attitude_sigma[i].copy(),
    )


class Against(NamedTuple):
    """Answers beside the sets of M blocks; see :class:`Integrity`."""

    excess: Array
    is_inside: Mask
    radius_m: Array
    up_m: Array


def against(w: Witness, answer_n: Array) -> Against:
    """Return how answers (M, 3) stand to the sets, m in the mission's frame."""
    center, shape = w.center[:, :2], w.shape[:, :2, :2]
    e, up = answer_n[:, :2] - center, answer_n[:, 2]
    in_ellipse = np.einsum("mi,mi->m", e, np.linalg.solve(shape, e[..., None])[..., 0])
    middle, half = 0.5 * (w.high + w.low)[:, :2], 0.5 * (w.high - w.low)[:, :2]
    in_box = np.max(np.abs(answer_n[:, :2] - middle) / half, axis=1) ** 2
    excess = np.maximum(in_ellipse, in_box)
    by_ellipse = np.linalg.norm(e, axis=1) + np.sqrt(np.linalg.eigvalsh(shape)[:, -1])
    corner = np.maximum(w.high[:, :2] - answer_n[:, :2], answer_n[:, :2] - w.low[:, :2])
    return Against(
        excess,
        (excess <= 1.0) & (up >= w.up_low) & (up <= w.up_high),
        np.minimum(by_ellipse, np.linalg.norm(corner, axis=1)),
        np.maximum(w.up_high - up, up - w.up_low),
    )


def holds_truth(mission: Mission, w: Witness, truth: Reference) -> Mask:
    """Return at which blocks (M,) the set holds the truth, whose rows are at the blocks' ends."""
    p_n = mission.frame.p_n_from_geodetic(truth.lat, truth.lon, truth.height)
    off = -(truth.roll_pitch_heading[:, 2] - w.heading)
    psi = np.remainder(off + np.pi, 2.0 * np.pi) - np.pi
    # The sets are of the heading without the noise of the gyros, which may be anything within it.
    share = np.linspace(-1.0, 1.0, NOISE_STEPS)[:, None]
    drawn = psi + share * w.noise_angle
    place = np.broadcast_to(p_n[:, :2], (*drawn.shape, 2))
    excess = w.sets.excess(np.concatenate([place, drawn[..., None]], axis=-1))
    in_plane = excess.min(axis=0) <= 1.0 + 1e-9
    return np.asarray(in_plane & (p_n[:, 2] >= w.up_low) & (p_n[:, 2] <= w.up_high))


def write_integrity(folder: Path, integrity: Integrity) -> None:
    """Write ``integrity.csv``, a row a block, and ``integrity.json``."""
    folder.mkdir(parents=True, exist_ok=True)
    w, table = integrity.witness, io.StringIO()
    writer = csv.writer(table, lineterminator="\n")
    writer.writerow(
        [
            "time_s",
            "east_half_width_m",
            "north_half_width_m",
            "up_half_width_m",
            "heading_half_width_rad",
            "inside",
            "error_at_most_m",
            "up_error_at_most_m",
            f"sigma{PROTECTION_SIGMAS:g}_m",
        ]
    )
    for i, half in enumerate(w.half_widths):
        numbers = [integrity.radius_m[i], integrity.up_m[i], integrity.sigma_radius_m[i]]
        cells = [f"{w.time_s[i]:.3f}", *(f"{x:.6g}" for x in half)]
        writer.writerow([*cells, int(integrity.is_inside[i]), *(f"{x:.6g}" for x in numbers)])
    write_through(folder / "integrity.csv", table.getvalue().encode())
    said = {
        "agreement": integrity.agreement.name,
        "reason": integrity.reason,
        "alarms": [alarm.sentence for alarm in w.alarms],
        "findings": [fault.sentence for fault in integrity.faults],
        "set_ended_s": list(integrity.ends_s),
        "beam_speeds_used": w.n_beams,
        "beam_speeds_left_out": w.n_left_out,
    }
    write_through(folder / "integrity.json", (json.dumps(said, indent=2) + "\n").encode())
