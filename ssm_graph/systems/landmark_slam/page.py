"""The study in words and tables: intervals, paired tests, and what of the paper reproduces."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np

from ssm_graph.base.code_version import code_version
from ssm_graph.base.frozen import Array
from ssm_graph.evaluation.statistics import (
    SIGNIFICANT_P,
    Interval,
    holm,
    mean_with_interval,
    paired_difference,
    paired_ratio,
)
from ssm_graph.systems.landmark_slam.methods import FILTERS, SMOOTHERS
from ssm_graph.systems.landmark_slam.simulator import CASES
from ssm_graph.systems.landmark_slam.study import NEES_BAND, Cell, StudyPlan

Cells = Mapping[tuple[str, str], Cell]
BASE: Final = "ukf"
"""Others are divided by it."""
CONSISTENT: Final = (0.8, 1.25)
"""Mean NEES / 3 that is taken for consistent."""
OUT_LIMIT: Final = 0.05
"""Share of steps outside the band of NEES above which a run is warned of."""
HEADER: Final = (
    "| method | position rms, m | over ukf | p Holm | heading rms, deg | landmarks at the end, m | "
    "NEES/3 | runs warned | NIS a row | sigmas found, in true ones | CPU s a run |"
)


def study_page(plan: StudyPlan, cells: Cells, *, command: str) -> str:
    """Return the study as Markdown."""
    lines = ["# Landmark SLAM: the study of noise-adaptive filters", "", f"    {command}", ""]
    lines += [
        f"{plan.n_runs} runs of {plan.n_steps} steps a case, seeds {plan.first_seed} to "
        f"{plan.first_seed + plan.n_runs - 1}, one map; ssm-graph {code_version()}.",
        "",
        "Means over runs with 95 % intervals (Student's t). Over ukf: ratio of mean position rms "
        "on the same runs, bootstrap interval; p of Wilcoxon's signed-rank test of the same pairs, "
        "corrected for the methods of the case. NEES/3 of the pose, mean over steps: 1 expected. "
        f"Warned: runs with more than 5 % of the steps outside {NEES_BAND[0]:.2f} to "
        f"{NEES_BAND[1]:.2f}. Sigmas found: at the end, of distance, steering, range, bearing; "
        "biases count as noise in the true ones.",
        "",
    ]
    lines += ["## In words", "", *_words(plan, cells), ""]
    for case in plan.cases:
        lines += [f"## {case}: {CASES[case].about}", "", HEADER, "|" + " --- |" * 11]
        lines += [*_rows(plan, cells, case), ""]
    lines += ["Methods: " + "; ".join(_about(m) for m in plan.methods) + "."]
    repaired = sum(cell.n_repaired for cell in cells.values())
    lines += ["", f"Covariances that had to be repaired for a Cholesky root, all runs: {repaired}."]
    return "\n".join(lines) + "\n"


def _about(method: str) -> str:
    return f"{method}, {FILTERS[method].about if method in FILTERS else SMOOTHERS[method]}"


def _text(interval: Interval, digits: str = ".3g") -> str:
    value, low, high = (f"{x:{digits}}" for x in (interval.value, interval.low, interval.high))
    return f"{value} ({low} to {high})"


def _p_values(plan: StudyPlan, cells: Cells, case: str) -> dict[str, float]:
    """Return the corrected p of each method against `BASE`; NaN where there is no pair."""
    others = [m for m in plan.methods if (case, m) in cells]
    p = np.full(len(others), np.nan)
    for i, method in enumerate(others):
        if method != BASE and (case, BASE) in cells:
            ours, base = (cells[case, m].scores["position_m"] for m in (method, BASE))
            p[i] = paired_difference(ours, base, other=BASE).p
    return dict(zip(others, holm(p).tolist(), strict=True))


def ratio_to_base(cells: Cells, case: str, method: str) -> Interval:
    """Return the ratio of mean position rms with its bootstrap interval."""
    ours, base = (cells[case, m].scores["position_m"] for m in (method, BASE))
    return paired_ratio(ours, base, np.random.default_rng(0))


def _rows(plan: StudyPlan, cells: Cells, case: str) -> list[str]:
    p, lines = _p_values(plan, cells, case), []
    for method in plan.methods:
        cell = cells.get((case, method))
        if cell is None:
            lines.append(f"| {method} | no result |" + " |" * 9)
            continue
        s, is_base = cell.scores, method == BASE or (case, BASE) not in cells
        found = np.median(s["noise"], axis=0)
        warned = int(np.sum(s["nees_out"] > OUT_LIMIT))
        texts = [
            method,
            _text(mean_with_interval(s["position_m"])),
            "1" if is_base else _text(ratio_to_base(cells, case, method)),
            "–" if is_base else f"{p[method]:.2g}",
            _text(mean_with_interval(s["heading_deg"])),
            _text(mean_with_interval(s["landmark_m"])),
            _text(mean_with_interval(s["nees"])),
            f"{warned} of {len(s['nees'])}",
            _nis(s["nis"]),
            ", ".join(f"{x:.2f}" for x in found),
            f"{cell.cpu_s / len(s['nees']):.2f}",
        ]
        lines.append(f"| {' | '.join(texts)} |")
    return lines


def _nis(values: Array) -> str:
    return "–" if not np.any(values) else f"{np.mean(values):.2f}"


def _words(plan: StudyPlan, cells: Cells) -> list[str]:
    lines = []
    for case in plan.cases:
        if (case, BASE) not in cells:
            continue
        said = []
        p = _p_values(plan, cells, case)
        for method in ("naukf", "ekf"):
            if (case, method) in cells and not np.isnan(p[method]):
                said.append(_compared(method, ratio_to_base(cells, case, method), p[method]))
        nees = {
            m: float(np.mean(cells[case, m].scores["nees"]))
            for m in ("ukf", "naukf", "guarded")
            if (case, m) in cells
        }
        told = ", ".join(
            f"{m} {x:.2f}{'' if CONSISTENT[0] <= x <= CONSISTENT[1] else ' (not consistent)'}"
            for m, x in nees.items()
        )
        lines.append(f"- **{case}** ({CASES[case].about}): {'; '.join(said)}. NEES/3: {told}.")
    naukf = [case for case in plan.cases if {(case, "naukf"), (case, BASE)} <= set(cells)]
    if naukf:
        lines = [_claim(plan, cells, naukf), "", *lines]
    return lines


def _compared(method: str, ratio: Interval, p: float) -> str:
    if p > SIGNIFICANT_P:
        return f"{method} and {BASE} cannot be told apart (ratio {_text(ratio)}, p {p:.2g})"
    word = "worse" if ratio.value > 1.0 else "better"
    return f"{method} is {word} than {BASE} (ratio {_text(ratio)}, p {p:.2g})"


def _claim(plan: StudyPlan, cells: Cells, cases: list[str]) -> str:
    better: list[str] = []
    worse: list[str] = []
    for case in cases:
        p = _p_values(plan, cells, case)["naukf"]
        if p <= SIGNIFICANT_P:
            (better if ratio_to_base(cells, case, "naukf").value < 1.0 else worse).append(case)
    same = [c for c in cases if c not in better and c not in worse]
    holds = len(better) == len(cases)
    return (
        "The paper says that its noise-adaptive filter beats UKF and EKF under every noise. "
        f"{'That reproduces' if holds else 'That does not reproduce'} with its window of 30 steps: "
        f"better in {', '.join(better) or 'no case'}; worse in {', '.join(worse) or 'none'}; no "
        f"difference in {', '.join(same) or 'none'}."
    )
