"""Lies that last, on the vehicle: never GOOD for long while the answer is beyond its sigmas.

``python -m benchmarks.trust.live --keep`` (hours; a quick look is ``--seeds 2 --grades tactical``).
DVL 5 mm/s; what lies, when and by how much is drawn for every seed. What was run
before, by the same code, is taken from ``--out``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from benchmarks.online.stream import run_stream
from benchmarks.processes import all_done, tell
from benchmarks.report import Option, Report, number_text, table
from benchmarks.soak.stream import GOOD, errors_of, longest_run
from benchmarks.trust.lies import LIVE
from benchmarks.trust.run import BEYOND, DURATION_S, mission_of
from ssm_graph.base.code_version import code_version
from ssm_graph.io.mission_folder.vehicle import vehicle_of
from ssm_graph.io.raw_log.rows import messages_of
from ssm_graph.live.estimator import FixedLagSmoother, IntegrityConfig
from ssm_graph.simulation import AidSettings, CompassSettings, with_faults
from ssm_graph.study.ledger import Key, Ledger, Row, run_trials

CLEAN, REALISTIC = "no fault", "no fault, realistic instruments, as stated by their preset"
LOOK_S = 1.0
MOST_S = 10.0
"""So long an answer may be GOOD and beyond 5 sigma."""


class Run(NamedTuple):
    """What came of one mission; answers are looked at once a second."""

    deceived_s: float
    """Longest unbroken time of GOOD beyond 5 sigma, s"""
    z: float
    """Largest error of position or velocity, in its own sigma, while GOOD"""
    alert_s: float
    """From the begin of the lie until the first answer that is not GOOD, s; NaN without one"""
    needed_s: float
    """From the begin until the answer is first beyond 5 sigma, whatever its health; NaN if never"""
    is_named: bool
    """Whether the sensor that lies is named from its begin on"""
    good_before: float
    """Share of GOOD before the lie; NaN where it is there from the begin"""
    good: float
    """Share of GOOD of all"""
    looks: tuple[int, int]
    """While GOOD, and while not"""
    outside: tuple[int, int]
    """Of these, beyond the horizontal or the vertical protection level"""
    protection_m: float
    """Median of the horizontal level while GOOD"""

    @property
    def is_honest(self) -> bool:
        """Whether it was never GOOD beyond 5 sigma for long."""
        return self.deceived_s <= MOST_S


def run(key: Key) -> Row:
    """Stream one mission of a label, grade, seed, kind of instruments and length, s."""
    label, grade, seed, realistic, duration_s = _settings(key)
    rng = np.random.default_rng([seed, *label.encode()])
    lie = LIVE.get(label)
    with_gnss = seed % 2 == 0 if lie is None or lie.with_gnss is None else lie.with_gnss
    aids = AidSettings(compass=CompassSettings()) if lie and lie.with_compass else None
    sim = mission_of(
        *(grade, seed), with_gnss=with_gnss, realistic=realistic, aids=aids, duration_s=duration_s
    )
    mission, begin_s = sim.mission, np.inf
    words: tuple[str, ...] = ()
    if lie is not None:
        drawn, words = lie.draw(rng, duration_s), lie.named
        faults = drawn if isinstance(drawn, tuple) else (drawn,)
        mission = with_faults(mission, faults, truth=sim.truth_at, seed=seed).mission
        begin_s = min(fault.start_s for fault in faults)
    smoother = FixedLagSmoother(vehicle_of(mission))
    stream = run_stream(
        *(smoother, messages_of(mission)),
        every_s=LOOK_S,
        duration_s=duration_s,
        keeps_delayed=False,
    )
    time_s, error, sigma = errors_of(stream.answers, sim.truth_at)
    z = np.abs(error / sigma)[:, :6].max(axis=1)
    is_good = stream.answers.column("health") == GOOD
    off = np.column_stack([np.hypot(error[:, 0], error[:, 1]), np.abs(error[:, 2])])
    level = stream.answers.column("protection")
    is_outside = (off > level).any(axis=1)
    said = " ".join(event.text for event in stream.events if event.time_s >= begin_s)
    made = Run(
        deceived_s=longest_run(is_good & (z > BEYOND), LOOK_S)[0],
        z=float(z[is_good].max(initial=0.0)),
        alert_s=_first(time_s[~is_good], begin_s),
        needed_s=_first(time_s[z > BEYOND], begin_s),
        is_named=any(word in said for word in words),
        good_before=_share(is_good[time_s < begin_s]),
        good=_share(is_good),
        looks=(int(is_good.sum()), int((~is_good).sum())),
        outside=(int((is_outside & is_good).sum()), int((is_outside & ~is_good).sum())),
        protection_m=float(np.median(level[is_good, 0])) if is_good.any() else np.nan,
    )
    return made._asdict()


def _settings(key: Key) -> tuple[str, str, int, bool, float]:
    label, grade, seed, realistic, duration_s = key
    return str(label), str(grade), int(seed), bool(realistic), float(duration_s)


def _first(time_s: np.ndarray[Any, np.dtype[np.float64]], begin_s: float) -> float:
    """Return how long after a time the first of others is, NaN if none."""
    later = time_s[time_s >= begin_s]
    return float(later[0] - begin_s) if len(later) else np.nan


def _share(is_true: np.ndarray[Any, np.dtype[np.bool_]]) -> float:
    return float(is_true.mean()) if len(is_true) else np.nan


HEADER: tuple[str, ...] = ("what lies", "grade", f"GOOD beyond 5 sigma > {MOST_S:g} s")
HEADER += ("longest, s", "largest z while GOOD", "not GOOD after, s: median, largest")
HEADER += ("beyond 5 sigma after, s: median", "named", "GOOD before, %")
HEADER += ("inside level while GOOD, %: all, worst run", "while not GOOD, %", "level, m")
CLEAN_HEADER: tuple[str, ...] = ("mission", "grade", *HEADER[2:5], "GOOD, %: all, worst run")
CLEAN_HEADER += HEADER[-3:]
LEGEND = f"""\
Answers are looked at every {LOOK_S:g} s. z: largest error of position or velocity along an axis,
in its own sigma. Level: the protection level, horizontal and vertical; an answer is inside it if
both errors are. One of {1 / IntegrityConfig().missed_detection:.0f} may be outside under a fault
that was not found.
"""


def line(label: str, grade: str, runs: Sequence[Run]) -> list[str]:
    """Return one row of the table of lies."""
    alerts = [run.alert_s for run in runs]
    heard = [alert for alert in alerts if np.isfinite(alert)]
    never = f", never in {len(runs) - len(heard)}" if len(heard) < len(runs) else ""
    told = f"{np.median(heard):.0f}, {max(heard):.0f}" if heard else "–"
    needed = [run.needed_s for run in runs if np.isfinite(run.needed_s)]
    return [
        *(label, grade, *_deceived(runs), told + never),
        number_text(float(np.median(needed)) if needed else np.nan),
        f"{sum(run.is_named for run in runs)} of {len(runs)}",
        f"{100 * np.nanmean([run.good_before for run in runs]):.1f}",
        *_levels(runs),
    ]


def clean_line(label: str, grade: str, runs: Sequence[Run]) -> list[str]:
    """Return one row of the table of missions without a lie."""
    good = [run.good for run in runs]
    shares = f"{100 * np.mean(good):.2f}, {100 * min(good):.2f}"
    return [label, grade, *_deceived(runs), shares, *_levels(runs)]


def _deceived(runs: Sequence[Run]) -> list[str]:
    return [
        f"{sum(not run.is_honest for run in runs)} of {len(runs)}",
        f"{max(run.deceived_s for run in runs):.0f}",
        f"{max(run.z for run in runs):.1f}",
    ]


def _levels(runs: Sequence[Run]) -> list[str]:
    """Return shares inside the protection levels, while GOOD and while not, and the level."""
    looks, outside = np.array([run.looks for run in runs]), np.array([run.outside for run in runs])
    inside = 100.0 * (1.0 - outside / np.maximum(looks, 1))
    good, other = 100.0 * (1.0 - outside.sum(axis=0) / np.maximum(looks.sum(axis=0), 1))
    level = np.nanmedian([run.protection_m for run in runs])
    return [f"{good:.2f}, {inside[:, 0].min():.2f}", f"{other:.2f}", number_text(float(level))]


def main() -> None:
    """Run all missions and write the tables."""
    report = Report(
        *(__file__, "Lies that last, on the vehicle", __doc__),
        Option("--seeds", 20, "missions of each kind"),
        Option("--first-seed", 40_000, "where they begin"),
        Option("--grades", "navigation,tactical", "names with commas between them"),
        Option("--only", "", "lies, or missions without, whose names have this in them"),
        Option("--realistic", False, "lies on realistic instruments, as stated by their preset"),
        Option("--lie-s", DURATION_S, "length of missions with a lie, s"),
        Option("--clean-s", 1200.0, "length of missions without a lie, s; 0 for none"),
        Option("--jobs", 1, "missions at a time"),
    )
    args = report.args
    seeds = range(args.first_seed, args.first_seed + args.seeds)
    clean = (CLEAN, REALISTIC) if args.clean_s > 0.0 else ()
    labels = [label for label in (*LIVE, *clean) if args.only in label]
    cells = [(label, grade) for label in labels for grade in args.grades.split(",")]
    kinds = dict.fromkeys(LIVE, (args.realistic, args.lie_s))
    kinds |= {CLEAN: (False, args.clean_s), REALISTIC: (True, args.clean_s)}
    keys: list[Key] = [(*cell, seed, *kinds[cell[0]]) for cell in cells for seed in seeds]
    ledger = Ledger(args.out / f"{code_version()}.jsonl", {"benchmark": "trust.live"})
    made = all_done(run_trials(run, keys, ledger, n_jobs=args.jobs, on_progress=tell))
    runs = [Run(**made[key]) for key in keys]
    rows: dict[bool, list[list[str]]] = {True: [], False: []}
    for i, (label, grade) in enumerate(cells):
        own = runs[i * len(seeds) : (i + 1) * len(seeds)]
        rows[label in LIVE].append((line if label in LIVE else clean_line)(label, grade, own))
    kind = "realistic" if args.realistic else "simple"
    about = f"Seeds {seeds.start} to {seeds[-1]}; lies on {kind} instruments, {args.lie_s:g} s."
    lies = table(HEADER, rows[True]) if rows[True] else []
    fair = table(CLEAN_HEADER, rows[False]) if rows[False] else []
    if fair:
        about += f" Without a lie {args.clean_s:g} s."
    report.write([about, "", LEGEND, *lies, "", *fair])


if __name__ == "__main__":
    main()
