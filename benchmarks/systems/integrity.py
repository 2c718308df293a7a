"""Integrity of one vehicle: the set of its stated bounds beside the smoother, when something lies.

``python -m benchmarks.systems.integrity --keep`` (a quarter of an hour). Missions, lies and times
are those of ``benchmarks.trust``, on seeds of their own.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from benchmarks.report import Option, Report, note, table
from benchmarks.trust.lies import LIES
from benchmarks.trust.run import DURATION_S, mission_of
from factors import so3
from ssm_graph import Mission, smooth
from ssm_graph.base.errors import SsmGraphError
from ssm_graph.base.frames import R_lb_from_roll_pitch_heading
from ssm_graph.base.frozen import Array
from ssm_graph.evaluation.consistency import rate_with_interval
from ssm_graph.imu.ping_motion import mean_gyro
from ssm_graph.mission.mission import Reference
from ssm_graph.simulation import SimulatedMission, with_faults
from ssm_graph.study.ledger import ERROR, Key, Ledger, Row, run_trials
from ssm_graph.systems.sensor_network.integrity import check_integrity, holds_truth
from ssm_graph.systems.sensor_network.witness import WitnessBounds, witness

CLEAN = "no fault"
FIRST_SEED = 100
"""Bounds and rules were chosen on seeds 0 to 2."""
WIDER = (5.0, 10.0, 20.0, 40.0, 80.0)
"""Sigmas that are tried as bounds where the lie is to be within them."""


@dataclass(frozen=True)
class Outcome:
    """What came of one mission."""

    bounds_hold: bool
    holds_truth: bool
    n_alarms: int
    agreement: str
    smoother: str
    half_width_m: float
    """At the end, the larger of east and north"""
    radius_m: float
    """Guaranteed for the answer at the end"""
    sigma_radius_m: float
    """Five sigma of the smoother at the end"""
    error_m: float
    """Of the smoother, level, largest at the ends of blocks"""


def bounds_hold(sim: SimulatedMission, mission: Mission, own: WitnessBounds) -> bool:
    """Return whether every reading errs within the bounds that the witness takes.

    Of inertial data any difference from the intact ones counts as false.
    """
    k = own.sigmas
    intact = sim.mission
    if not np.array_equal(mission.imu.time_s, intact.imu.time_s):
        return False
    if not np.array_equal(mission.imu.gyro_b, intact.imu.gyro_b):
        return False
    if not np.array_equal(mission.imu.accel_b, intact.imu.accel_b):
        return False
    return (
        _beams_hold(sim, mission, own)
        and _fixes_hold(sim, mission, k)
        and _depths_hold(sim, mission, k)
    )


def _beams_hold(sim: SimulatedMission, mission: Mission, own: WitnessBounds) -> bool:
    dvl, k = mission.dvl, own.sigmas
    now = sim.truth_at(dvl.valid_s)
    R_nb, v_n = _attitude(now)
    omega = mean_gyro(sim.mission.imu, dvl.valid_s)
    v_b = np.einsum("nji,nj->ni", R_nb, v_n) + so3.cross(omega, dvl.mount.lever_arm_b[None])
    off = dvl.speed - v_b @ dvl.mount.beams_b.T
    speed = np.linalg.norm(v_b, axis=1)
    more = own.velocity_m_per_s + own.speed_share * speed
    if np.nanmax(np.abs(off) - k * dvl.sigma - more[:, None]) > 0.0:
        return False
    # Noise has to average out over each block, too.
    block = np.floor(dvl.valid_s / own.block_s).astype(int)
    for one in np.unique(block):
        rows = block == one
        mean = np.abs(np.nanmean(off[rows], axis=0))
        n = np.isfinite(off[rows]).sum(axis=0)
        most = k * dvl.sigma[rows].mean(axis=0) / np.sqrt(np.maximum(n, 1))
        if np.any(mean[n > 0] > (most + more[rows].mean())[n > 0]):
            return False
    return True


def _attitude(now: Reference) -> tuple[Array, Array]:
    roll, pitch, heading = now.roll_pitch_heading.T
    return R_lb_from_roll_pitch_heading(roll, pitch, heading), now.velocity_enu


def _fixes_hold(sim: SimulatedMission, mission: Mission, k: float) -> bool:
    gnss = mission.gnss
    if gnss is None:
        return True
    now = sim.truth_at(gnss.valid_s)
    R_lb, _ = _attitude(now)
    p = mission.frame.p_n_from_geodetic(now.lat, now.lon, now.height)
    fix = mission.frame.p_n_from_geodetic(gnss.lat, gnss.lon, gnss.height)
    off = np.abs(fix - p - R_lb @ gnss.lever_arm_b)[:, :2]
    return bool(np.all(off <= k * gnss.sigma_enu[:, :2]))


def _depths_hold(sim: SimulatedMission, mission: Mission, k: float) -> bool:
    log = mission.depth
    if log is None:
        return True
    now = sim.truth_at(log.time_s)
    R_lb, _ = _attitude(now)
    off = np.abs(-log.true_depth - now.height - (R_lb @ log.lever_arm_b)[:, 2])
    return bool(np.all(off <= k * log.sigma))


def _mission(
    label: str, grade: str, seed: int, *, with_gnss: bool
) -> tuple[SimulatedMission, Mission]:
    sim = mission_of(grade, seed, with_gnss=with_gnss, realistic=False)
    if label == CLEAN:
        return sim, sim.mission
    drawn = LIES[label].draw(np.random.default_rng([seed, *label.encode()]), DURATION_S)
    faults = drawn if isinstance(drawn, tuple) else (drawn,)
    return sim, with_faults(sim.mission, faults, truth=sim.truth_at, seed=seed).mission


def run(key: Key) -> Row:
    """Smooth one mission with its lie, and lead the set on beside it."""
    label, grade, seed, with_gnss = str(key[0]), str(key[1]), int(key[2]), bool(key[3])
    smoothed = bool(key[4])
    sim, mission = _mission(label, grade, seed, with_gnss=with_gnss)
    own = WitnessBounds()
    assert mission.initial is not None
    w = witness(mission, mission.initial, own)
    truth = sim.truth_at(w.time_s)
    holds = bool(holds_truth(mission, w, truth).all())
    agreement, status, radius, sigma, error = "not smoothed", "", np.nan, np.nan, np.nan
    try:
        estimate = smooth(mission) if smoothed else None
    except SsmGraphError:
        estimate, agreement, status = None, "no answer", "REFUSED"
    if smoothed and estimate is not None:
        found = check_integrity(mission, estimate, own)
        p_n = mission.frame.p_n_from_geodetic(truth.lat, truth.lon, truth.height)
        agreement, status = found.agreement.name, estimate.status.name
        radius, sigma = float(found.radius_m[-1]), float(found.sigma_radius_m[-1])
        error = float(np.max(np.linalg.norm((found.answer_n - p_n)[:, :2], axis=1)))
    return asdict(
        Outcome(
            bounds_hold(sim, mission, own),
            holds,
            len(w.alarms),
            agreement,
            status,
            float(np.max(w.half_widths[-1, :2])),
            radius,
            sigma,
            error,
        )
    )


def run_wider(key: Key) -> Row:
    """Lead the set on with the least bounds of `WIDER` that hold, lies and all."""
    label, grade, seed, with_gnss = str(key[0]), str(key[1]), int(key[2]), bool(key[3])
    sim, mission = _mission(label, grade, seed, with_gnss=with_gnss)
    for sigmas in WIDER:
        own = WitnessBounds(sigmas=sigmas)
        if bounds_hold(sim, mission, own):
            assert mission.initial is not None
            w = witness(mission, mission.initial, own)
            holds = bool(holds_truth(mission, w, sim.truth_at(w.time_s)).all())
            half = float(np.max(w.half_widths[-1, :2]))
            return {"sigmas": sigmas, "holds": holds, "alarms": len(w.alarms), "half_m": half}
    return {"sigmas": np.inf, "holds": False, "alarms": 0, "half_m": np.nan}


def _wider_page(rows: dict[Key, Row]) -> list[str]:
    held = {key: row for key, row in rows.items() if np.isfinite(row["sigmas"])}
    sound = [bool(row["holds"]) for row in held.values()]
    rate = rate_with_interval(sound)
    lines = [
        "The same lies where who states the bounds knows of them: the least of "
        f"{', '.join(f'{k:g}' for k in WIDER)} stated sigmas within which every reading errs. "
        f"There is one for {len(held)} of {len(rows)} missions (none for inertial data that lie).",
        "",
        f"Truth inside throughout in {sum(sound)} of {len(held)} (a rate of {rate.low:.3f} or "
        f"more, 97.5 %), false alarms in {sum(row['alarms'] > 0 for row in held.values())}.",
        "",
    ]
    cells = [
        [str(key[0]), f"{row['sigmas']:g}", "yes" if row["holds"] else "no", f"{row['half_m']:.1f}"]
        for key, row in held.items()
    ]
    return [*lines, *table(["lie", "sigmas", "inside", "half-width, m"], cells)]


def main() -> None:
    """Run what is missing and write the page."""
    report = Report(
        __file__,
        "Integrity: the set of the stated bounds, when something lies",
        __doc__,
        Option("--seeds", 4, "missions of each lie"),
        Option("--clean", 8, "missions without a lie"),
        Option("--smoothed", 1, "missions of each lie that are smoothed, too"),
        Option("--grade", "tactical", "of the inertial sensors"),
        Option("--jobs", 1, "processes"),
        Option("--wider", False, "with bounds that hold in spite of the lie; a page of its own"),
    )
    a = report.args
    keys: list[Key] = []
    for label in [CLEAN, *LIES]:
        for i in range(a.clean if label == CLEAN else a.seeds):
            asked = None if label == CLEAN else LIES[label].with_gnss
            with_gnss = i % 2 == 0 if asked is None else asked
            smoothed = int(i < a.smoothed)
            keys.append((label, a.grade, FIRST_SEED + i, int(with_gnss), smoothed))
    name, do = ("wider", run_wider) if a.wider else ("runs", run)
    ledger = Ledger(Path(a.out) / f"{name}.jsonl", {"study": "integrity"})
    rows = run_trials(
        do, keys, ledger, n_jobs=a.jobs, on_progress=lambda n, of, key: note(f"{n}/{of} {key}")
    )
    if a.wider:
        report.write(_wider_page(rows), part="wider", of="bounds that hold in spite of the lie")
    else:
        report.write(_page(rows))


def _page(rows: dict[Key, Row]) -> list[str]:
    by_label: dict[str, list[Row]] = defaultdict(list)
    refused = [key for key, row in rows.items() if ERROR in row]
    for key, row in rows.items():
        if ERROR not in row:
            by_label[str(key[0])].append(row)
    good = [row for row in rows.values() if ERROR not in row]
    true = [row for row in good if row["bounds_hold"]]
    false = [row for row in good if not row["bounds_hold"]]
    sound = [bool(row["holds_truth"]) or row["n_alarms"] > 0 for row in true]
    told = [bool(row["holds_truth"]) or row["n_alarms"] > 0 for row in false]
    rate = rate_with_interval(sound)
    lines = [
        f"{len(rows)} missions of {DURATION_S:.0f} s, {len(refused)} refused by the witness. "
        "Bounds are five stated sigmas. A mission's bounds hold if every beam speed, fix and depth "
        "errs within them, and beams on average over blocks of 10 s.",
        "",
        f"Where all bounds hold ({len(true)}): truth inside the set, or alarm, in {sum(sound)} "
        f"(a rate of {rate.low:.3f} or more, 97.5 %), false alarms in "
        f"{sum(row['n_alarms'] > 0 for row in true)}.",
        "",
        f"Where one is false ({len(false)}), nothing is promised: truth inside all the same or "
        f"alarm in {sum(told)}; outside without a word in {len(false) - sum(told)}.",
        "",
    ]
    header = ["lie", "bounds hold", "inside", "alarm", "neither", "agreement with the smoother"]
    header += ["half-width, m", "error at most, m", "5 sigma, m", "largest error, m"]
    cells = []
    for label, group in by_label.items():
        inside = [bool(row["holds_truth"]) for row in group]
        alarm = [row["n_alarms"] > 0 for row in group]
        neither = sum(not i and not b for i, b in zip(inside, alarm, strict=True))
        words: dict[str, int] = defaultdict(int)
        for row in group:
            if row["agreement"] != "not smoothed":
                words[row["agreement"].lower()] += 1
        medians = [
            f"{np.nanmedian([row[name] for row in group]):.2f}"
            if np.isfinite([row[name] for row in group]).any()
            else "–"
            for name in ("half_width_m", "radius_m", "sigma_radius_m", "error_m")
        ]
        cells.append(
            [
                label,
                f"{sum(row['bounds_hold'] for row in group)} of {len(group)}",
                str(sum(inside)),
                str(sum(alarm)),
                str(neither),
                ", ".join(f"{n} {word}" for word, n in words.items()),
                *medians,
            ]
        )
    lines += table(header, cells)
    lines += [
        "",
        "Widths are medians at the end, of missions with fixes and without: without fixes, five "
        "sigma of the stated heading of the start make nearly all of the width. Agreement, error "
        "at most and 5 sigma are of the missions that were smoothed.",
    ]
    return lines


if __name__ == "__main__":
    main()
