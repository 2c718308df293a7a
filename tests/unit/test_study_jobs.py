"""Jobs: which are needed, what one does, and that it does not matter where and when."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from ssm_graph.base.errors import SolverError
from ssm_graph.mission.estimate import Estimate, Status
from ssm_graph.mission.mission import Mission
from ssm_graph.mission.problem import Problem, build_problem
from ssm_graph.sensors.dvl import DvlLog
from ssm_graph.simulation import (
    Fault,
    Grade,
    Loss,
    OutlierKind,
    Outliers,
    Sensor,
    SimulatedMission,
    scenario_config,
    simulate,
    with_dvl_errors,
)
from ssm_graph.smoothers.batch import SsmSmoother
from ssm_graph.study.cells import StudyFault
from ssm_graph.study.jobs import Job, do_job
from ssm_graph.study.methods import FAMILIES, Family
from ssm_graph.study.processes import best_job, merged
from ssm_graph.study.runner import missing_jobs, wanted_keys
from ssm_graph.study.scoring import COLUMNS, beam_truth
from ssm_graph.study.trials import (
    CACHE,
    CACHE_LIMIT_S,
    MAX_BLOCK,
    MissionCache,
    block_size,
    simulated_trials,
)
from tests.study_fixture import DURATION_S, SPARSE, tiny_study, untimed


def a_job(*methods: str, seeds: tuple[int, ...] = (1,)) -> Job:
    """Return a job on the sparse outliers."""
    return Job("tiny", SPARSE, Grade.NAVIGATION, seeds, methods)


ERRORS: dict[str, Any] = {
    "outliers": Outliers(OutlierKind.BURST, 0.3),
    "faults": (Fault((1, 2), 5.0, 9.0, (1.0, 0.4)),),
    "losses": (Loss(10.0, 13.0),),
    "dropout_rate": 0.2,
}


@pytest.mark.parametrize("scenario", ["survey", "demo"])
@pytest.mark.parametrize("kind", OutlierKind)
def test_dvl_errors_afterwards_are_the_same(scenario: str, kind: OutlierKind) -> None:
    """Bit by bit what the simulation with these settings from the begin gives."""
    errors = ERRORS | {"outliers": Outliers(kind, 0.3)}
    config = scenario_config(scenario, seed=4, duration_s=20.0, **errors)
    expected = simulate(config)
    other = simulate(scenario_config(scenario, seed=4, duration_s=20.0))
    found = with_dvl_errors(other, **errors)
    assert str(found.config) == str(config)
    for name in ("is_outlier", "beam_offset", "true_speed", "ping_time_s"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
    assert_same_dvl(found.mission.dvl, expected.mission.dvl)
    for log in ("imu", "depth", "initial", "gnss", "reference"):
        assert getattr(found.mission, log) is getattr(other.mission, log)


def assert_same_dvl(found: DvlLog, expected: DvlLog) -> None:
    """Check every array of two logs for equal bits."""
    for name in ("time_s", "speed", "sigma", "range_m"):
        one, two = getattr(found, name), getattr(expected, name)
        assert (one is None) == (two is None)
        if one is not None:
            np.testing.assert_array_equal(one, two)


def test_cached_trials_are_those_built_alone() -> None:
    """Only the DVL differs from cell to cell; the problem is that of the whole mission."""
    cache = MissionCache()
    (clean,) = simulated_trials(
        replace(SPARSE, outliers=Outliers()), Grade.NAVIGATION, [3], cache=cache
    )
    (trial,) = simulated_trials(SPARSE, Grade.NAVIGATION, [3], cache=cache)
    assert len(cache) == 1
    assert trial.problem.chain is clean.problem.chain is trial.oracle_problem.chain
    expected = build_problem(trial.mission).beams
    for name in ("keyframe", "beam", "speed", "sigma", "gyro_b", "beam_b"):
        np.testing.assert_array_equal(getattr(trial.problem.beams, name), getattr(expected, name))
    assert trial.is_outlier is not None
    assert len(trial.oracle_problem.beams.speed) == len(expected.speed) - trial.is_outlier.sum()
    assert trial.duration_s == pytest.approx(DURATION_S)


def test_trials_with_a_bad_sensor_have_problems_of_their_own() -> None:
    """The fixes at fault are those of the problem; the oracle is told and does without them."""
    fault = StudyFault((), 5.0, 4.0, sensor=Sensor.GNSS, size=(30.0, 0.0, 0.0))
    windows = ((0.0, 1e4),)
    cells = (
        replace(SPARSE, gnss_windows_s=windows),
        replace(SPARSE, gnss_windows_s=windows, faults=(fault,)),
    )
    cache = MissionCache()
    clean, bad = (
        simulated_trials(cell, Grade.NAVIGATION, [3], cache=cache)[0].problem for cell in cells
    )
    (trial,) = simulated_trials(cells[1], Grade.NAVIGATION, [3], cache=cache)
    assert len(cache) == 1
    told = trial.oracle_problem.fixes
    assert clean.fixes is not None
    assert bad.fixes is not None
    assert told is not None
    off = np.abs(bad.fixes.position_n - clean.fixes.position_n).max(axis=1)
    assert (off > 29.0).sum() == 4
    assert len(told.position_n) == len(clean.fixes.position_n) - 4


def test_cache_is_bounded() -> None:
    """The mission used longest ago goes; one that is longer than all comes all the same."""
    cache = MissionCache(limit_s=100.0)
    for key in "abac":
        cache.get(key, key.lower, length_s=40.0)
    assert len(cache) == 2
    assert cache.get("a", lambda: "new", length_s=40.0) == "a"
    assert cache.get("b", lambda: "new", length_s=40.0) == "new"
    assert cache.get("long", lambda: "long", length_s=1000.0) == "long"
    assert len(cache) == 1


def test_blocks_fit_into_the_cache() -> None:
    """However long the missions are."""
    assert block_size(1.0) == MAX_BLOCK
    assert block_size(2400.0) * 2400.0 <= CACHE_LIMIT_S
    assert block_size(1e6) == 1


def test_order_and_company_do_not_matter() -> None:
    """Alone, after others on the same cached mission, or as part of a larger job: same bits."""
    alone = do_job(a_job("smoother-log"))
    do_job(replace(a_job("smoother-gaussian"), source=replace(SPARSE, outliers=Outliers())))
    larger = do_job(a_job("oracle", "smoother-gaussian", "smoother-log", seeds=(0, 1)))
    CACHE._kept.clear()
    again = do_job(a_job("smoother-log"))
    (key,) = alone.rows
    assert untimed(alone.rows[key]) == untimed(larger.rows[key]) == untimed(again.rows[key])
    np.testing.assert_array_equal(alone.series["smoother-log"][0], larger.series["smoother-log"][1])


@pytest.mark.parametrize("method", ["ekf", "ekf-gate-beam", "ssm-log", "rstkf"])
def test_company_in_a_batch_does_not_matter(method: str) -> None:
    """A resumed study may need only one of many seeds."""
    many = do_job(a_job(method, seeds=(0, 1, 2, 3, 4)))
    alone = do_job(a_job(method, seeds=(3,)))
    ((key, row),) = alone.rows.items()
    assert untimed(row) == untimed(many.rows[key])


def test_rows_tell_errors_and_weights() -> None:
    """The oracle sees none of the bad beams, the smoother rejects them."""
    result = do_job(a_job("oracle", "smoother-log"))
    oracle, log = result.rows.values()
    assert tuple(sorted(oracle)) == tuple(sorted(COLUMNS))
    assert (oracle["method"], log["method"]) == ("oracle", "smoother-log")
    assert (oracle["n_outliers"], log["n_outliers"]) == (0, 2)
    assert log["outliers_rejected"] == 1.0
    assert oracle["n_epochs"] == log["n_epochs"] == 20
    assert (log["status"], log["failed"], log["error"]) == ("CONVERGED", 0, "")
    assert log["path_length_m"] == pytest.approx(1.5 * DURATION_S, rel=0.05)
    samples = result.series["smoother-log"]
    assert samples.shape == (1, 3, 3)
    assert samples[0, -1, 0] == log["end_error_m"]
    assert samples[0, -1, 2] == log["nees_position_final"]


def test_outliers_are_found_in_the_beam_table() -> None:
    """Rows are matched by time and beam."""
    sim = simulate(scenario_config("survey", seed=1, duration_s=20.0, outliers=SPARSE.outliers))
    estimate = SsmSmoother().solve(build_problem(sim.mission))
    offset, is_outlier = beam_truth(sim, estimate)
    assert is_outlier.sum() == sim.is_outlier.sum() == 2
    np.testing.assert_array_equal(
        np.sort(offset[is_outlier]), np.sort(sim.beam_offset[sim.is_outlier])
    )


def test_failure_is_a_row(monkeypatch: pytest.MonkeyPatch) -> None:
    """One method that breaks neither ends the job nor disappears."""

    def make(_: float | None) -> Any:
        def solve(_: Any, __: Any) -> Any:
            raise SolverError("no finite solution")

        return solve

    monkeypatch.setitem(FAMILIES, "broken", Family("never works", make))
    broken, log = do_job(a_job("broken", "smoother-log")).rows.values()
    assert (broken["status"], broken["failed"]) == ("FAILED", 1)
    assert broken["error"] == "no finite solution"
    assert broken["horizontal_rms_m"] != broken["horizontal_rms_m"]
    assert log["failed"] == 0


@pytest.mark.parametrize("status", [Status.DIVERGED, Status.CONVERGED])
def test_estimate_without_numbers_is_a_failure(
    status: Status, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever its status says."""
    solve = SsmSmoother.solve

    def lost(self: SsmSmoother, problem: Problem, **how: Any) -> Estimate:
        estimate = solve(self, problem, **how)
        nowhere = np.full_like(estimate.trajectory.lat, np.nan)
        return replace(
            estimate, status=status, trajectory=replace(estimate.trajectory, lat=nowhere)
        )

    monkeypatch.setattr(SsmSmoother, "solve", lost)
    (row,) = do_job(a_job("oracle")).rows.values()
    assert (row["status"], row["failed"]) == (status.name, 1)
    assert np.isnan(float(row["horizontal_rms_m"]))


def test_mission_that_cannot_be_made_fails_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """All of its methods say why."""

    def never(*_: Any, **__: Any) -> tuple[SimulatedMission, Mission]:
        raise MemoryError("full")

    monkeypatch.setattr("ssm_graph.study.trials.with_dvl_errors", never)
    rows = do_job(a_job("oracle", "smoother-log", seeds=(0, 1))).rows.values()
    assert [row["error"] for row in rows] == ["MemoryError: full"] * 4


def test_every_run_is_in_one_job() -> None:
    """Whatever methods and seeds a job takes; what is done is left out."""
    study = tiny_study(
        grades=["navigation", "mems"],
        methods=[
            {"names": ["oracle", "smoother-log", "smoother-sqrt"], "seeds": 12},
            {"names": ["smoother-gaussian"], "seeds": 3},
        ],
    )
    wanted = wanted_keys(study)
    jobs = missing_jobs(study, set())
    keys = [key for job in jobs for key in job.run_keys()]
    assert len(keys) == len(wanted) == 2 * 2 * (3 * 12 + 3)
    assert set(keys) == set(wanted)
    done = set(wanted[::3])
    left = [key for job in missing_jobs(study, done) for key in job.run_keys()]
    assert len(left) == len(set(left))
    assert set(left) == set(wanted) - done
    assert missing_jobs(study, set(wanted)) == []


def test_cells_of_the_same_seeds_follow_each_other() -> None:
    """So that a process simulates them once."""
    groups = [{"names": ["oracle"], "seeds": 25}]
    jobs = missing_jobs(tiny_study(methods=groups), set())
    assert [(job.source.case, job.seeds[0], len(job.seeds)) for job in jobs] == [
        ("clean", 0, 20),
        ("sparse10", 0, 20),
        ("clean", 20, 5),
        ("sparse10", 20, 5),
    ]


def test_batched_methods_get_many_seeds() -> None:
    """One job each here; on a cluster one for all of the same missions."""
    groups = [
        {"names": ["ekf", "ssm-log"], "seeds": 40},
        {"names": ["oracle", "smoother-log"], "seeds": 11},
    ]
    jobs = missing_jobs(tiny_study(methods=groups, cases=[{"kinds": ["none"]}]), set())
    assert [(job.methods, len(job.seeds)) for job in jobs] == [
        (("ekf",), 40),
        (("ssm-log",), 40),
        (("oracle", "smoother-log"), 10),
        (("oracle", "smoother-log"), 1),
    ]
    together = merged(jobs)
    assert [(job.methods, len(job.seeds)) for job in together[:2]] == [
        (("ekf", "ssm-log"), 40),
        (("oracle", "smoother-log"), 10),
    ]
    assert sum(job.n_runs for job in together) == sum(job.n_runs for job in jobs)


def test_a_process_keeps_to_its_missions() -> None:
    """First those it knows, then those nobody knows, then it helps."""
    jobs = [a_job("oracle", seeds=seeds) for seeds in ((0, 1), (2, 3), (4, 5))]
    mine, others = set(jobs[2].missions), [set(jobs[0].missions)]
    assert best_job(jobs, mine, others) == 2
    assert best_job(jobs[:2], mine, others) == 1
    assert best_job(jobs[:1], mine, others) == 0
    assert best_job(jobs, set(), []) == 0


def test_jobs_are_halved_down_to_one_run() -> None:
    """By seeds first, then by methods."""
    parts = [a_job("a", "b", seeds=(0, 1, 2))]
    for _ in range(4):
        parts = [half for part in parts for half in part.halves()]
    assert all(part.n_runs == 1 for part in parts)
    assert {(part.seeds[0], part.methods[0]) for part in parts} == {
        (seed, method) for seed in range(3) for method in "ab"
    }
    assert len(parts) == 6
