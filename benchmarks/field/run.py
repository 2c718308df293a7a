"""Real runs of a Blueye X3 against GNSS that was withheld.

``python -m benchmarks.field.run --keep`` (some twenty minutes on one core; a quick look is ``--runs
square,grid --seeds 1 --methods log``). The logs are looked for in ``$SSM_GRAPH_DATA/blueye_x3``,
else in ``../shared/data/blueye_x3``.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import product

import numpy as np
from matplotlib.figure import Figure

from benchmarks.field.runs import (
    ESTIMATED,
    FILTER,
    IMU_ALONE,
    LOGS,
    MODES,
    RUNS,
    SMOOTHERS,
    SURFACE,
    Case,
    Faults,
    Protocol,
    Score,
    evaluate_case,
    load,
    track_of,
    used_fixes,
)
from benchmarks.report import DOCS, Option, Report, note, rms, table
from ssm_graph.mission.mission import Mission
from ssm_graph.report.style import (
    ESTIMATE,
    INK,
    OUTLIER,
    REFERENCE,
    add_footnote,
    dress,
    new_figure,
    save,
)

TO_BEAT: dict[Protocol, dict[str, tuple[float, ...]]] = {
    Protocol.A: {"square": (1.8, 1.2), "grid": (0.39, 2.0)},
    Protocol.B: {"square": (0.93,), "grid": (0.32,)},
    Protocol.C: {"square": (0.15,), "grid": (0.15,)},
}
"""m: a draft graph tuned on these very runs, and the better of the log author's two filters."""

Scores = dict[Case, Score]
Missions = Mapping[tuple[str, str], Mission]
"""By run and mode of calibration."""


def cases(runs: Sequence[str], methods: Sequence[str], seeds: int) -> Iterator[Case]:
    """Yield every cell: the filter for protocol A alone, one seed for the dive."""
    for run, protocol, method, calibration in product(runs, Protocol, methods, MODES):
        if method == FILTER and (protocol is not Protocol.A or calibration == ESTIMATED):
            continue
        if calibration == IMU_ALONE and method != "log":
            continue
        is_dive = run not in SURFACE
        if is_dive and (method not in (methods[0], FILTER) or calibration == "none"):
            continue  # eight headings are tried there, half a minute each time
        for faults in Faults:
            if is_dive and faults is not Faults.CLEAN and protocol is not Protocol.A:
                continue
            n = 1 if faults is Faults.CLEAN or is_dive else seeds
            yield from (Case(run, protocol, method, calibration, faults, seed) for seed in range(n))


def report(scores: Scores) -> list[str]:
    """Return the tables of all protocols."""
    lines: list[str] = []
    for protocol in Protocol:
        lines += [f"## {protocol.name}: {protocol.value}", ""]
        lines += ["### Clean beams", "", *_clean_table(scores, protocol), ""]
        lines += ["### Faults injected, mean and largest over the seeds", ""]
        lines += [*_fault_table(scores, protocol), ""]
    return lines


def _clean_table(scores: Scores, protocol: Protocol) -> list[str]:
    header = ["run", "method", "calibration", "rms, m", "of the path", "end, m", "of the path"]
    header += ["path, m", "heading sigma, deg", "error / sigma", "verdict"]
    rows = []
    for case, score in scores.items():
        if case.protocol is protocol and case.faults is Faults.CLEAN:
            rows.append([case.run, case.method, case.calibration, *_cells(score)])
    beat = [
        f"{run}: {' and '.join(f'{x:g} m' for x in values)}"
        for run, values in TO_BEAT[protocol].items()
    ]
    return [*table(header, rows), "", f"To beat: {'; '.join(beat)} rms."]


def _cells(score: Score) -> list[str]:
    if not math.isfinite(score.rms_m):
        return ["–", "–", "–", "–", "–", "–", "–", score.status]
    return [
        f"{score.rms_m:.2f}",
        f"{score.percent:.2f} %",
        f"{score.end_m:.2f}",
        f"{100.0 * score.end_m / score.path_m:.2f} %",
        f"{score.path_m:.0f}",
        f"{math.degrees(score.heading_sigma):.1f}",
        f"{score.ratio:.2f}",
        score.status,
    ]


def _fault_table(scores: Scores, protocol: Protocol) -> list[str]:
    header = ["run", "method", "calibration", "clean, m"]
    header += [f"{faults.name.lower()}, m" for faults in Faults if faults is not Faults.CLEAN]
    rows = []
    keys = dict.fromkeys((c.run, c.method, c.calibration) for c in scores if c.protocol is protocol)
    for run, method, calibration in keys:
        cells = [_spread(scores, run, protocol, method, calibration, faults) for faults in Faults]
        rows.append([run, method, calibration, *cells])
    return table(header, rows)


def _spread(
    scores: Scores, run: str, protocol: Protocol, method: str, calibration: str, faults: Faults
) -> str:
    some = [s for c, s in scores.items() if c[:5] == (run, protocol, method, calibration, faults)]
    rms = np.array([score.rms_m for score in some])
    if not np.isfinite(rms).any():
        return "–"
    doubted = [s.status for s in some if s.status != "CONVERGED"]
    verdict = f", {len(doubted)} of {len(some)} not CONVERGED" if doubted else ""
    if len(rms) == 1:
        return f"{rms[0]:.2f}{verdict}"
    return f"{np.nanmean(rms):.2f}, {np.nanmax(rms):.2f}{verdict}"


def calibration_lines(scores: Scores) -> list[str]:
    """Return what the smoother with kernel log found of the instruments, beams clean."""
    rows = []
    for case, score in scores.items():
        found = score.estimate.calibration if score.estimate is not None else None
        if case.method != "log" or case.faults is not Faults.CLEAN or found is None:
            continue
        for v in found.values:
            numbers = [f"{x / v.unit:+.4f}" for x in (v.value, v.sigma, v.prior_sigma)]
            rows.append([case.run, case.protocol.name, v.label, *numbers, v.determined.name])
    header = ["run", "protocol", "what", "found beyond the stated", "sigma", "prior", "determined"]
    return ["## What the calibration found", "", *table(header, rows), ""]


def cuts_lines(missions: Missions, cuts: Sequence[float]) -> list[str]:
    """Return the error of protocol A against when GNSS ends, kernel log, in % of the path."""
    rows = []
    for (run, calibration), mission in missions.items():
        if run not in SURFACE:
            continue
        case = Case(run, Protocol.A, "log", calibration, Faults.CLEAN, 0)
        scores = [evaluate_case(mission, case, until_s) for until_s in cuts]
        percent = np.array([score.percent for score in scores])
        ratio = rms([score.ratio for score in scores])
        rows.append([run, calibration, *(f"{x:.2f}" for x in (*percent, percent.mean(), ratio))])
    header = ["run", "calibration", *(f"{cut:.0f} s" for cut in cuts), "mean", "error / sigma"]
    return ["## When GNSS ends earlier or later: rms in % of the path", "", *table(header, rows)]


def draw(scores: Scores, missions: Missions, runs: Sequence[str]) -> Figure:
    """Return the tracks of the clean runs, kernel log, a row for each run."""
    figure = new_figure(9.6, 3.3 * len(runs), "Blueye X3: smoother-log against GNSS")
    panels = figure.subplots(len(runs), len(Protocol), squeeze=False)
    for (i, run), (j, protocol) in product(enumerate(runs), enumerate(Protocol)):
        axes = panels[i, j]
        score = scores.get(Case(run, protocol, "log", ESTIMATED, Faults.CLEAN, 0))
        if score is None or score.estimate is None:
            axes.set_visible(False)
            continue
        mission = missions[run, ESTIMATED]
        assert mission.gnss is not None
        gnss, used = mission.gnss, used_fixes(mission, protocol)
        fixes = mission.frame.p_n_from_geodetic(gnss.lat, gnss.lon, gnss.height)[:, :2]
        axes.plot(*fixes[~used].T, ".", color=REFERENCE, markersize=2.5, label="GNSS withheld")
        axes.plot(*fixes[used].T, ".", color=OUTLIER, markersize=2.5, label="GNSS used")
        track = track_of(score.estimate, mission)
        axes.plot(*track.T, color=ESTIMATE, linewidth=1.2, label="estimate")
        axes.plot(*track[0], "o", color=INK, markersize=4.5)
        title = f"{run}, {protocol.name}: {score.rms_m:.2f} m rms"
        dress(axes, title=title, x="east, m", y="north, m")
        axes.set_aspect("equal", adjustable="datalim")
    handles = panels[0, 0].get_legend_handles_labels()
    figure.legend(*handles, loc="outside lower right", ncols=3, fontsize=8, frameon=False)
    add_footnote(figure, "The antenna's fixes, 0.35 m behind the body origin that is estimated.")
    return figure


LEGEND = """\
Missions as `ssm-graph convert` makes them: one set of settings for the vehicle, nothing tuned per
log ([where each comes from](../../docs/field.md)). Calibration `estimated`: DVL scale and both
delays about the vehicle's known values, and the DVL's own heading with origin and rate to be
estimated, as the importer asks; `IMU alone`: without that heading; `vehicle`: scale and delays
taken as exact, all three with the slow errors of DVL and GNSS as variables; `none`: the speeds as
read, gyro biases left in with a prior of 0.001 rad/s, all errors as white noise, no DVL heading.
The filter has neither such variables nor that heading. Path: horizontal way from the last fix used
to the last one scored, by positions a second apart. Heading sigma: posterior, when GNSS ends.
Error / sigma: rms of the horizontal error over the rms of its own sigma. The fixes themselves are
good to 0.15 to 0.5 m. Faults are drawn from the seed; bursts begin after GNSS has ended.
"""


CUTS = [45.0, 55.0, 62.0, 70.0, 80.0, 90.0, 100.0, 110.0, 120.0]


def main() -> int:
    """Run all cases; write tables and figure."""
    page = Report(
        *(__file__, "Real runs", __doc__),
        Option("--runs", ",".join(RUNS), "of square, grid, dive"),
        Option("--methods", ",".join((*SMOOTHERS, FILTER)), "see the tables"),
        Option("--seeds", 3, "of the faults, on surface runs"),
        Option("--protocols", [protocol.name for protocol in Protocol], "see the tables"),
        Option("--cuts", CUTS, "other ends of GNSS for protocol A, s: one is one draw of noise"),
    )
    if not LOGS.is_dir():
        note(f"{LOGS}: no real logs; set SSM_GRAPH_DATA to the folder that holds blueye_x3")
        return 1
    args = page.args
    runs, methods = args.runs.split(","), args.methods.split(",")
    missions = {(run, mode): make(load(run)) for run in runs for mode, make in MODES.items()}
    scores: Scores = {}
    wanted = (x for x in cases(runs, methods, args.seeds) if x.protocol.name in args.protocols)
    for case in wanted:
        scores[case] = evaluate_case(missions[case.run, case.calibration], case)
        note(f"{case}: {scores[case].rms_m:.2f} m, {scores[case].status}")
    cuts = cuts_lines(missions, args.cuts)
    page.write([LEGEND, *report(scores), *calibration_lines(scores), *cuts])
    for folder in page.places(DOCS):
        save(draw(scores, missions, runs), folder / "field.png")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
