"""Cases and methods of the studies, and what the benchmark of speed prints."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import benchmarks.monte_carlo as monte_carlo
from benchmarks.speed import FLOOR, OURS, PLAIN, comparison_lines, lengths_lines, verdict
from benchmarks.speed_tasks import (
    PlainStart,
    Timing,
    time_floor,
    time_ours,
    time_plain,
    write_mission,
)
from benchmarks.study_cases import CASES, DEFAULT_METHODS, case_config, parse_method
from benchmarks.study_runs import Job, beam_truth, do_job
from factors.similarity import ExpKernel, LogKernel, SqrtKernel
from ssm_graph.errors import ConfigError
from ssm_graph.problem.problem import build_problem
from ssm_graph.simulation import Grade, simulate
from ssm_graph.smoothers.batch import Similarity, SsmSmoother


@pytest.mark.parametrize("name", CASES)
def test_case_can_be_made(name: str) -> None:
    """Every case at any length; few_beams is the one that is longer."""
    config = case_config(name, Grade.MEMS, seed=3, duration_s=1200.0)
    assert config.duration_s == (2400.0 if name == "few_beams" else 1200.0)
    assert (config.seed, config.grade) == (3, Grade.MEMS)


def test_faults_hit_neighbours() -> None:
    """Equal offsets of adjacent beams cancel in the array's parity."""
    (fault,) = case_config("fault2x15", Grade.MEMS, seed=3, duration_s=1200.0).faults
    assert fault.beams == (3, 0)
    assert fault.offset_m_per_s == (1.0, 1.0)
    assert (fault.start_s, fault.end_s) == (600.0, 615.0)


def test_few_beams_are_lost_for_minutes() -> None:
    """Three minutes each with three, two and one beam, ten minutes with none."""
    losses = case_config("few_beams", Grade.MEMS, seed=0, duration_s=1200.0).losses
    lengths = {4 - len(loss.beams): loss.end_s - loss.start_s for loss in losses}
    assert lengths == {3: 180.0, 2: 180.0, 1: 180.0, 0: 600.0}


def test_method_names() -> None:
    """A number belongs to the name, so that runs of different numbers never mix."""
    assert parse_method("log").name == "log:5"
    assert parse_method("log:8").kernel == LogKernel(8.0)
    assert parse_method("exp:2.5").kernel == ExpKernel(2.5)
    assert parse_method("log-plain").similarity is Similarity.PLAIN
    assert parse_method("oracle").is_oracle
    assert all(parse_method(name).name.startswith(name) for name in DEFAULT_METHODS)
    assert parse_method("sqrt").kernel == SqrtKernel()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("lag", "did you mean 'log'"),
        ("oracle:3", "did you mean 'oracle'"),
        ("log:x", "expected a number above zero"),
        ("log:-1", "expected a number above zero"),
    ],
)
def test_bad_methods_are_refused(text: str, message: str) -> None:
    """The message says what would do."""
    with pytest.raises(ConfigError, match=message):
        parse_method(text)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--cases", "sparse"], "did you mean 'sparse10'"),
        (["--grades", "NAV"], "--grades: there is no 'NAV'"),
    ],
)
def test_bad_arguments_are_refused(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Before anything is run."""
    assert monte_carlo.main(arguments) == 1
    assert message in capsys.readouterr().err


def test_outliers_are_found_in_the_beam_table() -> None:
    """Rows are matched by time and beam; the oracle sees none of the bad ones."""
    sim = simulate(case_config("sparse10", Grade.NAVIGATION, seed=1, duration_s=20.0))
    estimate = SsmSmoother().solve(build_problem(sim.mission))
    offset, is_outlier = beam_truth(sim, estimate)
    assert is_outlier.sum() == sim.is_outlier.sum() == 2
    np.testing.assert_array_equal(
        np.sort(offset[is_outlier]), np.sort(sim.beam_offset[sim.is_outlier])
    )
    told = SsmSmoother().solve(build_problem(sim.without_outliers()))
    assert not beam_truth(sim, told)[1].any()


def test_job_compares_all_methods() -> None:
    """On the same mission."""
    methods = (parse_method("oracle"), parse_method("log"))
    oracle, log = do_job(Job("sparse10", Grade.NAVIGATION, 1, methods, 20.0))
    assert (oracle.key.method, log.key.method) == ("oracle", "log:5")
    assert oracle.has_result
    assert log.has_result
    assert (oracle.n_large_outliers, log.n_large_outliers) == (0, 2)
    assert log.n_large_rejected == 2
    assert oracle.n_epochs == log.n_epochs == 21


def test_speed_times_all_three(tmp_path: Path) -> None:
    """Each part has a time, and the smoother is left as it was."""
    path = tmp_path / "mission.pickle"
    solve = SsmSmoother.solve
    write_mission(path, minutes=0.1, seed=0)
    ours, plain, floor = time_ours(path), time_plain(path), time_floor(path, 3)
    assert SsmSmoother.solve is solve
    assert ours.n_keyframes == plain.n_keyframes == 7
    assert floor.n_iterations == 3
    settled = time_plain(path, PlainStart.DEAD_RECKONING, 1e-9)
    assert settled.rms_horizontal_m == pytest.approx(plain.rms_horizontal_m, abs=0.01)
    assert all(seconds >= 0.0 for seconds in ours.parts.values())
    assert abs(ours.rms_horizontal_m - plain.rms_horizontal_m) < 0.5
    lines = "\n".join(comparison_lines(0.1, {OURS: ours, FLOOR: floor, PLAIN: plain}))
    assert "eliminate by QR" in lines
    assert "| 0.1 | 7 |" in "\n".join(lengths_lines({0.1: ours}))


def test_verdict_names_both_ratios() -> None:
    """Times of the whole, not of the passes."""
    timings = {
        name: Timing({"a": seconds, "b": seconds})
        for name, seconds in ((OURS, 2.0), (FLOOR, 1.0), (PLAIN, 300.0))
    }
    assert verdict(timings) == "150 times faster than (a); 2.00 times the floor (b)"
