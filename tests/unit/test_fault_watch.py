"""How the search for what was off goes along with the passes of a smoother."""

from __future__ import annotations

import numpy as np
import pytest

from ssm_graph.base.stepwise import Steps, finished
from ssm_graph.engine.error_state import ACCEL_BIAS, GYRO_BIAS
from ssm_graph.engine.states import States
from ssm_graph.graph.linearize import GraphLinearizer
from ssm_graph.mission.estimate import Status
from ssm_graph.mission.problem import Problem, build_problem
from ssm_graph.simulation import DvlSettings
from ssm_graph.smoothers.batch import SmootherConfig, SsmSmoother
from ssm_graph.smoothers.faults.columns import BEAM, IMU
from ssm_graph.smoothers.faults.hypotheses import Course, Hypothesis
from ssm_graph.smoothers.faults.judged import Candidate, Fault
from ssm_graph.smoothers.faults.nuisances import ACCELEROMETERS, Slow
from ssm_graph.smoothers.faults.pieces import PieceSearch
from ssm_graph.smoothers.faults.search import Beside, FaultSearch, chosen_of
from ssm_graph.smoothers.faults.unstated import Unstated
from ssm_graph.smoothers.faults.watch import SLOW_PASSES, FaultWatch
from tests.helpers import simulated, true_states

FAR, NEAR = 50.0, 0.1
"""Updates, sigmas."""


def sound() -> tuple[Problem, GraphLinearizer, States]:
    """Return half a minute in which nothing is off, at the truth."""
    sim = simulated(duration_s=30.0, dvl=DvlSettings(noise=0.005), seed=3)
    problem = build_problem(sim.mission)
    linearizer, states = GraphLinearizer(problem), true_states(problem, sim)
    linearizer.follow(states)
    return problem, linearizer, states


class Scripted:
    """A search that finds nothing, and beside that what it was told."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, told: Beside) -> None:
        self.found_at: list[str] = []
        """Where it was asked"""
        self._told = told
        monkeypatch.setattr(PieceSearch, "find_steps", self._find_steps)
        monkeypatch.setattr(PieceSearch, "beside", self._beside)

    def _find_steps(self, *_: object) -> Steps[list[Fault]]:
        self.found_at.append("search")
        yield 0.0
        return []

    def _beside(self, *_: object) -> Beside:
        self.found_at.append("beside")
        return self._told


def test_what_finds_nothing_far_from_an_answer_looks_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Passes that come no nearer are no end of the search, nor is a statement judged there."""
    problem, linearizer, states = sound()
    search, watch = Scripted(monkeypatch, Beside(None, [], [])), FaultWatch(problem, FaultSearch())
    weights = np.ones(len(problem.beams.speed)), np.ones(len(linearizer.weighted))

    def look(update_sigmas: float) -> None:
        looks = watch.look_steps(linearizer, states, *weights, update_sigmas=update_sigmas)
        assert finished(looks) is None

    for _ in range(SLOW_PASSES + 1):
        look(FAR)
    assert search.found_at == ["search"]
    look(NEAR)
    assert search.found_at == ["search", "search", "beside"]
    look(NEAR)
    assert len(search.found_at) == 3


def test_what_may_be_chance_acts_on_the_rows_in_force(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where biases wander more than stated, too: the column of a jump is that of a gyro's bias."""
    problem, linearizer, states = sound()
    n = problem.n_keyframes
    axis = np.eye(6)[:, [5]]
    jump = Fault(
        Hypothesis("gyros", IMU, axis, np.full(1, 0.1), str), 10, n, 20.0, sizes=np.full(1, 1e-4)
    )
    slow = Slow(ACCELEROMETERS, sigma=1e-3, correlation_s=10.0)
    unstated = Unstated((slow,), np.zeros(0), np.zeros((n - 1, 15, 0)), {})
    Scripted(monkeypatch, Beside(unstated, [], [jump]))
    watch = FaultWatch(problem, FaultSearch())
    weights = np.ones(len(problem.beams.speed)), np.ones(len(linearizer.weighted))
    changed = finished(watch.look_steps(linearizer, states, *weights, update_sigmas=NEAR))
    assert changed is not None
    wide, at = finished(watch.allowing_steps(changed.linearizer, changed.states))
    assert wide.freed is not None
    rows, size = wide.inertial_rows(at), problem.extras.state_dim
    begin, end = (rows[:, :15, part + GYRO_BIAS.stop - 1] for part in (0, size))
    own = np.where(np.arange(n - 1)[:, None] >= 10, begin + end, 0.0)
    np.testing.assert_allclose(wide.freed.between[..., -1], own, rtol=1e-9, atol=1e-9)
    before = linearizer.inertial_rows(states)
    assert np.abs(rows[:, :15, ACCEL_BIAS]).max() < 0.9 * np.abs(before[:, :15, ACCEL_BIAS]).max()


@pytest.mark.parametrize(
    ("first", "second", "merit", "chosen"),
    [
        ((BEAM, Course.ANYTHING), (BEAM, Course.CONSTANT), 890.0, 0),
        ((IMU, Course.CONSTANT), (BEAM, Course.CONSTANT), 600.0, 1),
        ((IMU, Course.CONSTANT), (BEAM, Course.ANYTHING), 600.0, 0),
        (("GNSS", Course.ANYTHING), (BEAM, Course.CONSTANT), 890.0, 1),
        (("GNSS", Course.ANYTHING), (BEAM, Course.CONSTANT), 800.0, 0),
        (("GNSS", Course.ANYTHING), (IMU, Course.CONSTANT), 890.0, 0),
    ],
)
def test_inertial_data_are_chosen_last(
    first: tuple[str, Course], second: tuple[str, Course], merit: float, chosen: int
) -> None:
    """But before readings that would have to be anything; what explains most is chosen else.

    A few numbers of another sensor that explain nearly as much come before such readings.
    """
    ranked = [
        Candidate(
            Hypothesis("any", channel, np.eye(1), np.ones(1), str, course), 0, 1, 1e3, own, 0.0
        )
        for (channel, course), own in zip((first, second), (900.0, merit), strict=True)
    ]
    assert chosen_of(ranked) is ranked[chosen]


@pytest.mark.parametrize("duration_s", [1.0, 9.0])
def test_a_mission_of_one_block_is_searched(duration_s: float) -> None:
    """There is no edge inside it at which a gyro could have jumped."""
    problem = build_problem(simulated(duration_s=duration_s).mission)
    estimate = SsmSmoother(SmootherConfig(fault_search=FaultSearch())).solve(problem)
    assert estimate.status is Status.CONVERGED
    assert not estimate.faults
