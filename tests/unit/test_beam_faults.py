"""The search for stretches in which one beam is off: found, not invented, not put on another."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from ssm_graph.base.errors import ConfigError
from ssm_graph.base.frozen import Array
from ssm_graph.engine.beam_evidence import Evidence
from ssm_graph.graph.first_values import first_values
from ssm_graph.graph.linearize import GraphLinearizer
from ssm_graph.mission.estimate import OUTLIER_WEIGHT, Estimate, Status
from ssm_graph.mission.mission import NO_AIDS
from ssm_graph.mission.problem import build_problem
from ssm_graph.sensors.dvl import DvlLog
from ssm_graph.simulation import (
    AidSettings,
    CompassSettings,
    Fault,
    FaultShape,
    Grade,
    HoverRoute,
    Loss,
    OutlierKind,
    Outliers,
    SimulatedMission,
    UsblSettings,
)
from ssm_graph.smoothers import beam_faults
from ssm_graph.smoothers.batch import SmootherConfig, SsmSmoother
from ssm_graph.smoothers.beam_faults import (
    KERNEL,
    FaultSearch,
    FaultWatch,
    calibration_columns,
    stretch_chi_sq,
    who_is_off,
    without_shared,
)
from tests.aids_fixture import with_every_aid
from tests.helpers import simulated, with_initial

SEARCH = SmootherConfig(fault_search=FaultSearch())


def smoothed(sim: SimulatedMission, config: SmootherConfig = SEARCH) -> Estimate:
    """Return the estimate of a simulated mission."""
    return SsmSmoother(config).solve(build_problem(sim.mission))


def test_a_bias_of_three_sigmas_is_found_in_time_and_beam() -> None:
    """Two minutes with a minute of 15 mm/s: to the block; the log kernel keeps most of it."""
    fault = Fault((2,), 40.0, 100.0, 0.015)
    sim = simulated(duration_s=140.0, faults=(fault,))
    estimate = smoothed(sim)
    assert estimate.status is Status.CONVERGED, estimate.reason
    is_off = estimate.beams.weight < 1e-7
    assert set(estimate.beams.beam[is_off]) == {3.0}
    time_s = estimate.beams.time_s[is_off]
    assert 40.0 <= time_s.min() <= 50.0
    assert 89.0 <= time_s.max() < 110.0
    (note,) = (note for note in estimate.notes if "left out" in note)
    assert note.startswith("beam 3 is off from ")
    assert "by +0.01" in note
    alone = smoothed(sim, SmootherConfig()).beams.weight[sim.is_outlier.ravel()]
    assert alone.mean() > 0.5


def test_the_search_goes_with_calibration() -> None:
    """Extra variables are held at their estimates while stretches are judged."""
    sim = simulated(duration_s=140.0, faults=(Fault((2,), 40.0, 100.0, 0.03),))
    dvl = sim.mission.dvl
    asking = replace(dvl, mount=replace(dvl.mount, scale_sigma=0.02))
    estimate = SsmSmoother(SEARCH).solve(build_problem(replace(sim.mission, dvl=asking)))
    assert estimate.calibration
    (note,) = (note for note in estimate.notes if "left out" in note)
    assert note.startswith("beam 3 is off from ")


def test_the_search_goes_by_further_aids() -> None:
    """Three beams have no parity, and a poor IMU that starts at any velocity believes them all."""
    aids = AidSettings(
        usbl=UsblSettings(interval_s=2.0, sigma_horizontal=0.3, sigma_vertical=0.3),
        compass=CompassSettings(sigma=math.radians(0.3)),
    )
    sim = simulated(
        duration_s=200.0,
        route=HoverRoute(),
        grade=Grade.MEMS,
        losses=(Loss(0.0, 200.0, (0,)),),
        faults=(Fault((2,), 0.0, 200.0, 0.02),),
        aids=aids,
        seed=1,
    )
    start = with_initial(sim.mission, velocity_sigma_enu=np.full(3, 1.0))
    unaided = smoothed(replace(sim, mission=replace(start, aids=NO_AIDS)))
    assert not any("left out" in note for note in unaided.notes)
    (note,) = (n for n in smoothed(replace(sim, mission=start)).notes if "left out" in n)
    assert note.startswith("beam 3 is off from 1.0 s to 200.0 s, by +0.0")


def test_errors_of_aids_are_carried_along() -> None:
    """Those of a compass and the place of a beacon too, and nothing is found."""
    sim = with_every_aid(duration_s=60.0)
    assert not any("left out" in note for note in smoothed(sim).notes)


@pytest.mark.parametrize(
    "outliers",
    [Outliers(), Outliers(OutlierKind.SPARSE, 0.1), Outliers(OutlierKind.ONE_BEAM, 0.5)],
    ids=lambda outliers: outliers.kind.name,
)
def test_nothing_is_found_where_nothing_lasts(outliers: Outliers) -> None:
    """Clean data and single bad pings: the estimate is that of the kernel alone, to the bit."""
    sim = simulated(duration_s=120.0, grade=Grade.TACTICAL, outliers=outliers)
    found, alone = smoothed(sim), smoothed(sim, SmootherConfig())
    np.testing.assert_array_equal(found.trajectory.velocity_enu, alone.trajectory.velocity_enu)
    np.testing.assert_array_equal(found.beams.weight, alone.beams.weight)
    assert found.notes == alone.notes


def test_a_wrong_scale_is_no_fault_of_a_beam() -> None:
    """Four per cent of 2 m/s in all beams at once, with a start that is known well."""
    sim = simulated(duration_s=120.0)
    dvl = replace(sim.mission.dvl, speed=1.04 * sim.mission.dvl.speed)
    assert isinstance(dvl, DvlLog)
    estimate = SsmSmoother(SEARCH).solve(build_problem(replace(sim.mission, dvl=dvl)))
    assert not any("left out" in note for note in estimate.notes)


def test_calibration_columns_are_the_change_of_the_speeds() -> None:
    """Against the linearised beams: scale as the speed itself, angles as a turn of the body."""
    problem = build_problem(simulated(perfect_sensors=True, duration_s=20.0).mission)
    states = first_values(problem, kernel=KERNEL).states
    columns = calibration_columns(problem, states)
    rows = GraphLinearizer(problem).beam_rows(states)
    lever = np.cross(problem.beams.gyro_b, problem.beams.lever_arm_b)
    along_lever = np.einsum("mi,mi->m", problem.beams.beam_b, lever)
    np.testing.assert_allclose(columns[:, 0], problem.beams.speed - along_lever, atol=1e-2)
    # A turn of the mounting moves the beams as the opposite turn of the body moves the velocity.
    np.testing.assert_allclose(columns[:, 1:], -rows.jacobian[:, :3], atol=1e-2)


def evidence_of(columns: Array, noise: Array) -> Evidence:
    """Return evidence of columns that no trajectory explains any of."""
    return Evidence(columns.T @ noise, columns.T @ columns)


def test_chi_square_of_every_stretch() -> None:
    """Against sums over the blocks of a stretch."""
    rng = np.random.default_rng(2)
    judged = evidence_of(rng.normal(size=(60, 20)), rng.normal(size=60))
    table = stretch_chi_sq(judged, 1, 5)
    for begin in range(6):
        for end in range(6):
            blocks = 4 * np.arange(begin, end) + 1
            information = judged.information[np.ix_(blocks, blocks)].sum()
            expected = judged.score[blocks].sum() ** 2 / information if begin < end else 0.0
            assert table[begin, end] == pytest.approx(expected)


def test_shared_columns_are_eliminated_with_their_prior() -> None:
    """As if they were noise of unit variance along the column."""
    rng = np.random.default_rng(3)
    own, shared, missed = rng.normal(size=(30, 8)), rng.normal(size=(30, 2)), rng.normal(size=30)
    left = without_shared(evidence_of(np.hstack([own, shared]), missed), 2)
    whitener = np.linalg.inv(np.eye(30) + shared @ shared.T)
    np.testing.assert_allclose(left.information, own.T @ whitener @ own)
    np.testing.assert_allclose(left.score, own.T @ whitener @ missed)


def test_who_is_off() -> None:
    """The one beam that explains best; of several, one that is blamed nearby; else nobody."""
    nobody = np.zeros((3, 4), dtype=bool)
    nearby = nobody.copy()
    nearby[0, 2] = True
    plain, unclear = np.array([80.0, 10.0, 60.0, 0.0]), np.array([80.0, 10.0, 75.0, 0.0])
    assert who_is_off(plain, nobody, margin=12.0) == 0
    assert who_is_off(unclear, nobody, margin=12.0) is None
    assert who_is_off(unclear, nearby, margin=12.0) == 2
    assert who_is_off(plain, nearby, margin=12.0) == 0


@pytest.mark.parametrize("n_blocks", [1, 7, 8, 9, 12, 13, 40])
def test_pieces_cover_a_mission_once(n_blocks: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Their middles follow each other; a piece is no longer than asked for."""
    monkeypatch.setattr(beam_faults, "PIECE_BLOCKS", 8)
    pieces = beam_faults.pieces_of(n_blocks)
    counted = [block for _, middle in pieces for block in range(n_blocks)[middle]]
    assert counted == list(range(n_blocks))
    assert all(piece.stop - piece.start <= 8 for piece, _ in pieces)
    assert all(piece.start <= middle.start < middle.stop <= piece.stop for piece, middle in pieces)


def test_pieces_find_what_the_whole_finds(monkeypatch: pytest.MonkeyPatch) -> None:
    """A fault across the border of two pieces."""
    sim = simulated(duration_s=200.0, faults=(Fault((0,), 60.0, 130.0, 0.02),))
    whole = smoothed(sim).beams.weight < 1e-7
    monkeypatch.setattr(beam_faults, "PIECE_BLOCKS", 14)
    pieces = smoothed(sim).beams.weight < 1e-7
    assert np.mean(whole == pieces) > 0.98


def test_findings_stop_changing(monkeypatch: pytest.MonkeyPatch) -> None:
    """A search that cannot decide ends: later findings only add."""
    problem = build_problem(simulated().mission)
    watch = FaultWatch(problem, FaultSearch())
    rows = GraphLinearizer(problem).beam_rows(first_values(problem, kernel=KERNEL).states)
    n_rows = len(problem.beams.speed)
    answers = iter([(0, 5), (5, 9), (0, 5), (5, 9), (0, 9)])

    def undecided(*_: object) -> beam_faults.Found:
        begin, end = next(answers)
        return beam_faults.Found((np.arange(n_rows) >= begin) & (np.arange(n_rows) < end), ())

    monkeypatch.setattr(beam_faults, "find_beam_faults", undecided)
    states = first_values(problem, kernel=KERNEL).states
    assert not watch.look(states, rows, update_sigmas=3.0, is_settled=False)
    assert watch.look(states, rows, update_sigmas=0.5, is_settled=False)
    assert not watch.look(states, rows, update_sigmas=0.5, is_settled=False)
    looks = [watch.look(states, rows, update_sigmas=0.0, is_settled=True) for _ in range(3)]
    assert looks == [True, True, False]
    assert np.count_nonzero(watch.leave_out(np.ones(n_rows)) < 1.0) == 9


def test_settings_are_checked() -> None:
    """Nothing below zero."""
    with pytest.raises(ConfigError, match="block_s: expected a number above zero"):
        FaultSearch(block_s=0.0)


@pytest.mark.slow
@pytest.mark.parametrize("grade", [Grade.NAVIGATION, Grade.TACTICAL])
@pytest.mark.parametrize(
    "fault",
    [
        Fault((1,), 200.0, 240.0, 0.15),
        Fault((1,), 100.0, 400.0, 0.05, shape=FaultShape.DRIFT),
        Fault((1,), 100.0, 600.0, shape=FaultShape.COVERED, share=0.3),
    ],
    ids=lambda fault: fault.shape.name,
)
def test_slow_faults_are_left_out(fault: Fault, grade: Grade) -> None:
    """Most of the beam while it is off by more than three sigmas, and hardly anything else.

    A stuck beam errs to both sides as the vehicle rolls: ping by ping, the kernel's business.
    """
    sim = simulated(duration_s=600.0, grade=grade, faults=(fault,), seed=11)
    estimate = smoothed(sim)
    assert estimate.status is Status.CONVERGED, estimate.reason
    is_off = (estimate.beams.weight < OUTLIER_WEIGHT).reshape(-1, 4)
    assert is_off[np.abs(sim.beam_offset) > 0.015].mean() > 0.95
    assert is_off[~sim.is_outlier].mean() < 0.01
