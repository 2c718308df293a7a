"""Tables of a comparison: units, marks, and LaTeX that can be typeset."""

from __future__ import annotations

import math
import re
from typing import Any

import numpy as np
import pytest

from ssm_graph.evaluation.comparison import Comparison, compare_methods
from ssm_graph.report.comparison.tables import (
    LEGEND,
    digits,
    interval,
    latex,
    markdown,
    probability,
)

METHODS = ("oracle", "ekf-oracle", "ssm-log", "t_robust", "bad")


def a_comparison(*, n_rates: int = 3, kinds: tuple[str, ...] = ("one_beam",)) -> Comparison:
    """Return two grades and every kind at every rate; ``bad`` is bad and fails on seed 0."""
    rows: list[dict[str, Any]] = []
    for grade in ("TACTICAL", "MEMS"):
        for kind in kinds:
            for i in range(n_rates):
                rng = np.random.default_rng(i)
                for seed in range(12):
                    base = 0.2 + 0.1 * float(rng.random())
                    for method in METHODS:
                        rows.append(
                            {
                                "case": f"{kind}{i}",
                                "grade": grade,
                                "kind": kind,
                                "rate": 0.05 * (i + 1),
                                "duration_s": 600.0,
                                "seed": seed,
                                "method": method,
                                "status": "CONVERGED",
                                "failed": 0,
                                "horizontal_rms_m": base * (2.0 if method == "bad" else 1.0),
                                "velocity_rms_m_per_s": 0.01 * base,
                                "end_error_m": base,
                                "nees_position_final": 3.0 if method == "bad" else 1.0,
                                "inside_3sigma_east": 0.99,
                            }
                        )
                        if method == "bad" and seed == 0:
                            rows[-1].update(failed=1, status="FAILED", error="singular | matrix")
    return compare_methods(rows)


def report(comparison: Comparison) -> str:
    """Return the Markdown of a comparison."""
    return markdown(
        comparison, title="A study", command="python -m study", code="0.1.0", notes=["Mind this."]
    )


def table_blocks(text: str) -> list[list[list[str]]]:
    """Return the tables of a Markdown text as lists of lists of cells."""
    blocks: list[list[list[str]]] = []
    inside = False
    for line in text.splitlines():
        if line.startswith("| "):
            if not inside:
                blocks.append([])
            blocks[-1].append(re.split(r"(?<!\\)\|", line)[1:-1])
        inside = line.startswith("| ")
    return blocks


def test_markdown_is_headed_by_how_it_was_made() -> None:
    """Command and version come first, notes next."""
    text = report(a_comparison())
    lines = [line for line in text.splitlines() if line]
    assert lines[:2] == ["# A study", "    python -m study"]
    assert "0.1.0" in lines[2]
    assert "`ssm-log`" in lines[2]
    assert lines[3] == "Mind this."
    assert "## Legend" in text


def test_every_heading_has_its_unit() -> None:
    """All columns but names and counts say what they are in, and no table is ragged."""
    blocks = table_blocks(report(a_comparison()))
    assert len(blocks) == 2 * 2 + 2 + 6
    for block in blocks:
        assert {len(line) for line in block} == {len(block[0])}
        for heading in block[0]:
            name = heading.strip()
            assert name in {"method", "runs", "failed"} or re.search(
                r", (1|m|mm/s|deg|s|%|% of path|runs)$", name
            )
        assert len(set(block[0])) == len(block[0])


def test_headline_shows_best_and_missing() -> None:
    """Bold without oracles and significantly worse ones; what failed is marked."""
    blocks = table_blocks(report(a_comparison()))
    assert [cell.strip() for cell in blocks[0][0]] == [
        "method",
        "runs",
        "5 %, m",
        "10 %, m",
        "15 %, m",
    ]
    assert blocks[1][0][2].strip() == "5 %, mm/s"
    lines = {line[0].strip(): line[2].strip() for line in blocks[0][2:]}
    assert re.fullmatch(r"\*\*0\.\d{3} ± 0\.\d{3}\*\*", lines["ssm-log"])
    assert lines["t_robust"] == lines["ssm-log"] == f"**{lines['oracle']}**"
    assert re.fullmatch(r"0\.\d{3} ± 0\.\d{3} †1", lines["bad"])


def test_cells_together_are_means_of_ratios() -> None:
    """By hand: geometric mean and highest of three cells, one of them without pairs."""
    rows = [
        {
            "case": f"{rate:g}",
            "grade": "MEMS",
            "kind": "one_beam",
            "rate": rate,
            "seed": seed,
            "method": method,
            "failed": int(method == "bad" and rate == 0.4),
            "horizontal_rms_m": factor if method == "bad" else 1.0,
            "velocity_rms_m_per_s": 0.1,
        }
        for rate, factor in ((0.1, 2.0), (0.2, 8.0), (0.4, 99.0))
        for seed in range(3)
        for method in ("ssm-log", "bad", "oracle")
    ]
    text = report(compare_methods(rows))
    block = table_blocks(text[text.index("## Cells together") :])[0]
    lines = [[cell.strip() for cell in line] for line in block]
    assert "### mems, outliers, 3 cells" in text
    assert lines[0] == [
        "method",
        "horizontal to ssm-log, 1",
        "horizontal to oracle, 1",
        "velocity to ssm-log, 1",
        "velocity to oracle, 1",
    ]
    assert lines[3] == ["bad", *2 * ["4.00 (≤ 8.00) †1"], *2 * ["1.00 (≤ 1.00) †1"]]
    assert lines[2] == ["ssm-log", "–", "1.00 (≤ 1.00)", "–", "1.00 (≤ 1.00)"]
    assert (
        "Cells together"
        not in report(compare_methods([r for r in rows if r["rate"] == 0.1]))[: -len(LEGEND)]
    )


def test_failures_and_inconsistency_are_said() -> None:
    """Count and message of failed runs; `!` where the NEES is out of bounds."""
    text = report(a_comparison(n_rates=1))
    assert "- bad: 1 of 12 runs failed: singular \\| matrix" in text
    detail = next(block for block in table_blocks(text) if len(block[0]) > 10)
    names = [cell.strip() for cell in detail[0]]
    cells = {line[0].strip(): [cell.strip() for cell in line] for line in detail[2:]}
    nees = names.index("NEES/3 final, 1")
    assert cells["bad"][nees].startswith("3.00 [")
    assert cells["bad"][nees].endswith(" !")
    assert "!" not in cells["ssm-log"][nees]
    assert cells["bad"][names.index("failed")] == "1 †"
    assert cells["bad"][names.index("horizontal rms, m")].endswith("] †1")
    assert cells["bad"][names.index("pairs, 1")] == "11"
    assert cells["bad"][names.index("ratio to oracle, 1")] == "2.00 [2.00, 2.00]"
    assert cells["ssm-log"][names.index("inside 3σ E/N/U, %")] == "99.0/–/–"


@pytest.mark.parametrize(("n_rates", "is_folded"), [(3, False), (4, True)])
def test_many_cells_are_folded(n_rates: int, is_folded: bool) -> None:
    """Six cells are open, eight are not; what opens closes."""
    text = report(a_comparison(n_rates=n_rates))
    assert text.count("<details>") == text.count("</details>") == 2 * n_rates * is_folded


@pytest.mark.parametrize(
    ("n_rates", "kinds", "n_floats"),
    [(3, ("one_beam",), 2), (4, ("one_beam", "burst"), 4), (8, ("one_beam",), 4)],
)
def test_latex_is_balanced(n_rates: int, kinds: tuple[str, ...], n_floats: int) -> None:
    """A table for each grade, or kind, of at most seven columns, all rows as long as its head."""
    text = latex(a_comparison(n_rates=n_rates, kinds=kinds), caption="50 % & a_b", label="tab:x")
    opened: list[str] = []
    for what, name in re.findall(r"\\(begin|end)\{(\w+)\}", text):
        if what == "begin":
            opened.append(name)
        else:
            assert opened.pop() == name
    assert not opened
    assert text.count(r"\begin{table}") == n_floats
    assert text.count("{") == text.count("}")
    assert text.count("$") % 2 == 0
    for columns, body in re.findall(
        r"\\begin\{tabular\}\{l(r+)\}(.*?)\\end\{tabular\}", text, re.S
    ):
        assert len(columns) <= 7
        rows = [line for line in body.splitlines() if line.endswith(r"\\")]
        assert len(rows) == 1 + len(METHODS)
        assert {len(re.findall(r"(?<!\\)&", row)) for row in rows} == {len(columns)}
        assert all(re.search(r"\[(m|mm/s)\]$", c.strip(" \\")) for c in rows[0].split("&")[1:])
    labels = re.findall(r"\\label\{(.*?)\}", text)
    assert len(set(labels)) == n_floats


def test_latex_is_plain_and_escaped() -> None:
    """No Unicode, no bare special characters, only commands of LaTeX and booktabs."""
    text = latex(a_comparison(), caption="50 % & a_b", label="tab")
    assert text.isascii()
    assert r"\caption{50 \% \& a\_b." in text
    assert r"t\_robust & " in text
    assert not re.search(r"(?<!\\)[%_#~]", text)
    assert r"$^{\dagger 1}$" in text
    assert "{\\boldmath$0." in text
    known = "begin end centering footnotesize setlength tabcolsep caption label pm dagger toprule "
    known += "midrule bottomrule par medskip boldmath"
    assert set(re.findall(r"\\([a-z]+)", text)) <= set(known.split())


def test_sparse_tables_are_written() -> None:
    """Unknown rates and durations, a single run, and methods that are not in every cell."""
    first = {"case": "sea", "grade": "", "seed": 0, "failed": 0, "method": "a_1"}
    rows = [
        first | {"horizontal_rms_m": 1.0},
        first | {"case": "lake", "method": "b", "failed": 1, "horizontal_rms_m": math.nan},
    ]
    comparison = compare_methods(rows)
    text = report(comparison)
    assert "sea, m | lake, m" in text
    assert "| a_1 | 1 | **1.00** |  |" in text
    assert "| b | 1 |  | – †1 |" in text
    assert "nan" not in text.replace("significan", "")
    typeset = latex(comparison, caption="Trials", label="tab")
    assert r"a\_1 & {\boldmath$1.00$} &  \\" in typeset
    assert r"b &  & --$^{\dagger 1}$ \\" in typeset


@pytest.mark.parametrize(
    ("value", "shown"),
    [
        (0.0, "0"),
        (0.12345, "0.123"),
        (9.999, "10.0"),
        (123.4, "123"),
        (1234.5, "1230"),
        (-0.00123, "-0.00123"),
        (1.2345e-6, "1.23e-06"),
        (2.5e7, "2.50e+07"),
        (math.nan, "–"),
        (math.inf, "inf"),
    ],
)
def test_three_digits(value: float, shown: str) -> None:
    """Whatever the size of a number."""
    assert digits(value) == shown


def test_intervals_and_probabilities() -> None:
    """An interval that is unknown is left out, a small p value becomes a bound."""
    comparison = a_comparison(n_rates=1)
    mean = comparison.cells[0]["oracle"].measures["velocity_rms_m_per_s"].mean
    assert re.fullmatch(r"2\.\d\d \[2\.\d\d, 2\.\d\d\]", interval(mean, 1000.0))
    assert [probability(p) for p in (0.00001, 0.0123, 1.0, math.nan)] == [
        "< 0.001",
        "0.012",
        "1",
        "–",
    ]
