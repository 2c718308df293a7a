"""Windows of inertial data: silent where they err as stated, said where and by how much if not."""

from __future__ import annotations

import numpy as np
import pytest

from ssm_graph.base.frozen import Array
from ssm_graph.graph.inertial_rows import InertialFit
from ssm_graph.mission.estimate import Status
from ssm_graph.mission.fault import DetectedFault, Treatment
from ssm_graph.mission.problem import build_problem
from ssm_graph.simulation import DvlSettings, Fault, FaultShape, Grade, with_faults
from ssm_graph.simulation.faults import Sensor
from ssm_graph.smoothers.batch import SmootherConfig, SsmSmoother
from ssm_graph.smoothers.faults.search import FaultSearch
from ssm_graph.smoothers.faults.windows import Readings, disagreeing, noisier_than_stated
from tests.helpers import simulated

KEYFRAME_S = np.arange(601.0)
"""Ten minutes."""


def drawn(scale: Array, *, dof: int = 3, seed: int = 0) -> list[DetectedFault]:
    """Return what is said of errors (K - 1,) times as large as stated, of so many freedoms."""
    errors = np.random.default_rng(seed).standard_normal((600, dof)) * scale[:, None]
    share = 0.1
    chi_sq = share * np.sum(errors**2, axis=1)
    return noisier_than_stated(InertialFit(chi_sq, np.full(600, share * dof)), KEYFRAME_S)


def test_noise_as_stated_is_no_fault() -> None:
    """Nor is a third more of it, which vibration makes."""
    for seed in range(20):
        assert not drawn(np.full(600, 1.3), seed=seed)


def test_noise_all_the_time_is_that_of_the_imu() -> None:
    """Said by how much, over all of the mission, and nobody else would explain it."""
    (found,) = drawn(np.full(600, 4.0))
    assert (found.sensor, found.begin_s, found.end_s) == ("IMU", 0.0, 600.0)
    assert found.what.startswith(("errs 3.9", "errs 4.0", "errs 4.1"))
    assert found.is_suspect
    assert not found.rivals


def test_what_is_contradicted_for_a_while_may_be_another() -> None:
    """Two minutes: the windows of them, no others, and whoever they contradict is named too."""
    during = (KEYFRAME_S[:-1] >= 240.0) & (KEYFRAME_S[:-1] < 360.0)
    (found,) = drawn(np.where(during, 5.0, 1.0))
    assert (found.begin_s, found.end_s) == (240.0, 360.0)
    assert found.rivals
    assert found.is_suspect


def test_hardly_any_freedom_says_nothing() -> None:
    """What other sensors leave no freedom cannot err by much."""
    fit = InertialFit(np.full(600, 0.02), np.full(600, 1e-6))
    assert not noisier_than_stated(fit, KEYFRAME_S)


@pytest.mark.parametrize(("factor", "status"), [(1.0, Status.CONVERGED), (10.0, Status.SUSPECT)])
def test_inertial_noise_of_a_mission(factor: float, status: Status) -> None:
    """Ten times the stated one at navigation grade, where all else still fits."""
    sim = simulated(duration_s=400.0, dvl=DvlSettings(noise=0.005), seed=6)
    mission, config = sim.mission, SmootherConfig(fault_search=FaultSearch())
    if factor > 1.0:
        fault = Fault(sensor=Sensor.IMU, shape=FaultShape.NOISE, size=factor)
        mission = with_faults(mission, (fault,), truth=sim.truth_at).mission
    estimate = SsmSmoother(config).solve(build_problem(mission))
    assert estimate.status is status, estimate.reason
    assert any(one.sensor == "IMU" for one in estimate.faults) == (factor > 1.0)
    assert ("IMU" in estimate.reason) == (factor > 1.0)


@pytest.mark.slow
def test_a_loose_answer_is_no_noise() -> None:
    """Metres off without fixes, where rows of other states than the solved ones say anything."""
    sim = simulated(
        duration_s=300.0,
        grade=Grade.MEMS,
        dvl=DvlSettings(noise=0.005),
        gnss=None,
        realistic=True,
        calibrates=True,
        seed=1,
    )
    found = SsmSmoother(SmootherConfig(fault_search=FaultSearch())).solve(
        build_problem(sim.mission)
    )
    of_imu = [one.treatment for one in found.faults if one.sensor == "IMU"]
    assert of_imu == [Treatment.WIDENED]


@pytest.mark.parametrize("n_off", [2, 4])
def test_beams_that_all_disagree_have_the_inertial_data_for_a_rival(n_off: int) -> None:
    """All are compared with them; of some beams alone each is named."""
    rng, time_s = np.random.default_rng(2), np.arange(300.0)
    slow = 2.0 * np.sin(2.0 * np.pi * time_s / 40.0)
    readings = [
        Readings(f"DVL beam {k + 1}", time_s, rng.standard_normal(300) + slow * (k < n_off), 0.04)
        for k in range(4)
    ]
    found = disagreeing(readings, time_s)
    names = ["DVL"] if n_off == 4 else ["DVL beam 1", "DVL beam 2"]
    assert [one.sensor for one in found] == names
    assert ("IMU" in found[0].rivals) == (n_off == 4)
