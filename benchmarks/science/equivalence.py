"""Is the smoother's single step the filter? ``python -m benchmarks.science.equivalence --keep``.

Ten missions with outliers, dropouts, a bottom loss and a GNSS start, three grades in turn, each
estimated by the graph in single steps and by the filter in gains and covariances, which linearises
anew at each pass as the graph does or, as ``ssm-log``, once; and, with measurements linearised
once, by the graph and by the geodetic filter. Differences are the largest over all keyframes and
components, in posterior sigmas. A quick look is ``--missions 2 --duration 40``.
"""

from __future__ import annotations

from benchmarks.report import Option, Report, table
from factors.similarity import Similarity
from ssm_graph import build_problem
from ssm_graph.engine.error_state import Linearised
from ssm_graph.filters.geodetic.mechanisation import Feedback
from tests.single_step import against_filter, against_geodetic, missions

ALL = 10
"""Missions of the whole page."""
FILTER = ["seed", "grade", "similarity", "state, posterior sigmas", "covariance, of √(P_ii P_jj)"]
FILTER += ["weights", "keyframes with other iteration counts"]
FILTER += ["state of the filter linearised once, posterior sigmas"]
GEODETIC = {
    "linearised once, complete feedback": (Linearised.ONCE, Feedback.COMPLETE),
    "linearised once, the paper's feedback": (Linearised.ONCE, Feedback.PAPER),
    "Gauss-Newton, complete feedback": (Linearised.EACH_PASS, Feedback.COMPLETE),
}


def lines_of(count: int, duration_s: float) -> list[str]:
    """Return both comparisons."""
    by_filter, by_geodetic = [], []
    for seed, sim in enumerate(missions(count, duration_s)):
        problem, labels = build_problem(sim.mission), [str(seed), sim.config.grade.name.lower()]
        for similarity in Similarity:
            *off, n_other, once = against_filter(problem, similarity)
            cells = [f"{x:.1e}" for x in off]
            by_filter.append(
                [*labels, similarity.name.lower(), *cells, str(n_other), f"{once:.3f}"]
            )
        apart = [against_geodetic(problem, sim, *pair) for pair in GEODETIC.values()]
        by_geodetic.append([*labels, *(f"{v:.3f} / {p:.3f}" for v, p in apart)])
    return [
        f"{count} missions of {duration_s:g} s, 10 % of the pings with an outlier, 5 % of the "
        "beams missing, 30 s without bottom lock, GNSS for the first 30 s; kernel log(dof=5).",
        *([f"A part of the page: {ALL} missions are the whole."] if count < ALL else []),
        "",
        "## Single step of the graph against the filter in NumPy",
        "",
        *table(FILTER, by_filter),
        "",
        "## Single step of the graph against the geodetic filter",
        "",
        "Largest difference over the mission: velocity / horizontal position, posterior sigmas.",
        "",
        *table(("seed", "grade", *GEODETIC), by_geodetic),
    ]


def main() -> None:
    """Write both comparisons."""
    report = Report(
        *(__file__, "Single-step equivalence", __doc__),
        Option("--missions", ALL, "three grades in turn"),
        Option("--duration", 1200.0, "of a mission, s"),
    )
    report.write(lines_of(report.args.missions, report.args.duration))


if __name__ == "__main__":
    main()
