"""What the benchmarks of real runs and of alignment withhold, spoil, print and draw."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks import alignment
from benchmarks.field import cases, draw, report
from benchmarks.field_runs import (
    FILTER,
    MODES,
    Case,
    Faults,
    Protocol,
    evaluate_case,
    used_fixes,
    with_faults,
)
from ssm_graph.io.blueye.vehicle import GYRO_BIAS
from ssm_graph.mission.mission import Mission
from ssm_graph.report.style import save
from ssm_graph.simulation import GnssSettings, Grade, scenario_config, simulate


@pytest.fixture(scope="module")
def mission() -> Mission:
    """Return two minutes with GNSS throughout, nothing known of the start."""
    config = scenario_config(
        "survey", duration_s=120.0, grade=Grade.TACTICAL, gnss=GnssSettings(windows=((0.0, 200.0),))
    )
    return replace(simulate(config).mission, initial=None)


def test_protocols_withhold_what_they_say(mission: Mission) -> None:
    """A until 70 s or the dive, B begin and end, C nothing."""
    assert mission.gnss is not None
    elapsed = mission.gnss.time_s - mission.imu.start_s
    assert elapsed[used_fixes(mission, Protocol.A)].max() == pytest.approx(70.0)
    between = elapsed[~used_fixes(mission, Protocol.B)]
    assert (between.min(), between.max()) == pytest.approx((30.0, 100.0))
    assert used_fixes(mission, Protocol.C).all()
    gone = (elapsed > 40.0) & (elapsed < 60.0)
    times = np.where(gone, mission.gnss.time_s + 100.0, mission.gnss.time_s)
    dived = replace(mission, gnss=replace(mission.gnss, time_s=np.sort(times)))
    assert dived.gnss is not None
    kept = (dived.gnss.time_s - mission.imu.start_s)[used_fixes(dived, Protocol.A)]
    assert kept.max() == pytest.approx(40.0)


def test_faults_are_drawn_from_the_seed(mission: Mission) -> None:
    """One beam of a tenth of the pings, or one beam for ten seconds after GNSS has ended."""
    assert with_faults(mission, Faults.CLEAN, 0).dvl.speed == pytest.approx(mission.dvl.speed)
    for faults in (Faults.SPARSE, Faults.BURST):
        off = with_faults(mission, faults, 1).dvl.speed - mission.dvl.speed
        again = with_faults(mission, faults, 1).dvl.speed - mission.dvl.speed
        np.testing.assert_array_equal(off, again)
        assert np.any(off != with_faults(mission, faults, 2).dvl.speed - mission.dvl.speed)
        assert np.max(np.sum(off != 0.0, axis=1)) == 1
        size = np.abs(off[off != 0.0])
        assert 0.49 < size.min() <= size.max() < 3.01
    hit = mission.dvl.time_s[(off != 0.0).any(axis=1)]
    assert 8.0 < hit[-1] - hit[0] < 10.0
    assert hit[0] > 70.0


def test_modes_differ_in_what_is_known(mission: Mission) -> None:
    """Nobody estimates in ``vehicle``; ``none`` gives the gyro biases back."""
    mount = replace(mission.dvl.mount, scale_error=0.05, scale_sigma=0.01)
    known = replace(mission, dvl=replace(mission.dvl, mount=mount))
    assert MODES["vehicle"](known).dvl.mount.scale_sigma == 0.0
    assert MODES["vehicle"](known).dvl.mount.scale_error == 0.05
    assert MODES["none"](known).dvl.mount.scale_error == 0.0
    back = MODES["none"](known).imu.gyro_b - known.imu.gyro_b
    np.testing.assert_allclose(back, np.tile(GYRO_BIAS, (len(back), 1)))
    assert MODES["estimated"](known) is known


def test_scores_tables_and_tracks(mission: Mission, tmp_path: Path) -> None:
    """A clean run of good sensors ends within a metre, and every table has its cells."""
    case = Case("square", Protocol.A, "log", "estimated", Faults.CLEAN, 0)
    score = evaluate_case(mission, case)
    assert score.status == "CONVERGED"
    assert 0.0 < score.rms_m < 1.0
    assert 60.0 < score.path_m < 90.0
    assert 0.0 < math.degrees(score.heading_sigma) < 2.0
    missions = {("square", mode): mission for mode in MODES}
    lines = report({case: score})
    assert any(
        line.startswith(f"| square | log | estimated | {score.rms_m:.2f} |") for line in lines
    )
    figure = draw({case: score}, missions, ["square"])
    assert save(figure, tmp_path / "field.png").stat().st_size > 10_000


def test_cases_name_each_cell_once() -> None:
    """The filter is there for protocol A alone, and estimates nothing."""
    every = list(cases(["square", "dive"], ["log", FILTER], 2))
    assert len(set(every)) == len(every)
    filtered = [case for case in every if case.method == FILTER]
    assert {case.protocol for case in filtered} == {Protocol.A}
    assert "estimated" not in {case.calibration for case in filtered}


def test_a_minute_finds_the_heading_or_says_that_it_does_not() -> None:
    """Industrial grade on a straight course is sure; the table counts what was said."""
    row = alignment.run("industrial", "straight", 0)
    assert abs(row.error) < 3.0 * row.sigma < math.radians(3.0)
    assert not row.is_said
    wrong = row._replace(seed=1, error=1.0, sigma=0.1)
    said = row._replace(seed=2, is_said=True)
    lines = alignment.report([row, wrong, said])
    assert lines[-1].startswith("| industrial | straight | 3 | 67 % |")
    assert "| 33 % | 1 | 3 CONVERGED |" in lines[-1]
    assert alignment.doubtful([row, said]) == ["None outside 3 sigma."]
    assert "| industrial | straight | 1 |" in alignment.doubtful([wrong])[-1]
