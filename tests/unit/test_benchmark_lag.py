"""What the benchmark of the lag measures, prints and draws."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from benchmarks.lag import (
    BATCH,
    DELAYED,
    FILTER,
    GRADES,
    NEWEST,
    Row,
    Rows,
    draw,
    findings,
    grade_lines,
    run_mission,
)
from ssm_graph.report.style import save


def made_up(lags: tuple[str, ...]) -> Rows:
    """Return three missions whose delayed error halves and whose newest error rises at each lag."""
    rows = Rows()
    for seed in (2, 0, 1):
        for grade in GRADES:
            for k, name in enumerate((FILTER, *lags, BATCH)):
                for track, x in ((DELAYED, 0.5**k), (NEWEST, 1.0 + k)):
                    if (name, track) != (BATCH, NEWEST):
                        x += 1e-3 * seed
                        row = Row(grade, seed, name, track, x, x, x, 2e-5, 3e-6, 1.0, "CONVERGED")
                        rows.append(row)
    return rows


def test_a_mission_has_all_its_rows() -> None:
    """Lag zero knows each state but once; a lag as long as the mission is the batch."""
    rows = Rows(run_mission("TACTICAL", 3, 8.0, ("0", "8")))
    assert len(rows) == 3 + 2 * 2
    zero = [rows.of("TACTICAL", "0", track, "velocity") for track in (DELAYED, NEWEST)]
    np.testing.assert_array_equal(zero[0], zero[1])
    (whole,) = (row for row in rows if (row.estimator, row.track) == ("8", DELAYED))
    (batch,) = (row for row in rows if row.estimator == BATCH)
    assert batch.sigmas_from_batch == batch.weight_from_batch == 0.0
    assert whole.sigmas_from_batch < 1e-2
    assert whole.velocity == pytest.approx(batch.velocity, rel=1e-3)
    assert all(0.0 < row.velocity < 100.0 and math.isfinite(row.heading) for row in rows)


def test_report_names_the_steps_that_rise(tmp_path: Path) -> None:
    """The delayed error falls at every step, the newest rises at each beyond chance."""
    lags = ("0", "1", "10")
    rows = made_up(lags)
    lines = findings(rows, lags, 10.0)
    (falling,) = (x for x in lines if x.startswith("| NAVIGATION | delayed | velocity"))
    (rising,) = (x for x in lines if x.startswith("| TACTICAL | newest | heading"))
    assert falling.endswith("| none | none |")
    assert rising.endswith("| 0 to 1 s, 1 to 10 s | 0 to 1 s, 1 to 10 s |")
    assert "position, velocity and attitude within 2.0e-05 of its posterior sigmas," in lines
    assert "weights within 3.0e-06." in lines
    assert not any("posterior sigmas" in x for x in findings(rows, lags, 11.0))
    cells = grade_lines(rows, "TACTICAL", (FILTER, *lags, BATCH))[-2]
    assert cells.startswith("| batch | 0.0635 ± ")
    assert "–" in cells
    assert save(draw(rows, lags, "title"), tmp_path / "lag.png").stat().st_size > 10_000
