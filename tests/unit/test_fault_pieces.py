"""The search over a long mission in pieces: each fault once, where it is, whatever the seams."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from ssm_graph.base.errors import ConfigError
from ssm_graph.mission.fault import DetectedFault
from ssm_graph.mission.problem import build_problem
from ssm_graph.simulation import DvlSettings, Fault, Grade, with_faults
from ssm_graph.simulation.faults import Sensor
from ssm_graph.smoothers.batch import SmootherConfig, SsmSmoother
from ssm_graph.smoothers.faults.hypotheses import Course, Hypothesis
from ssm_graph.smoothers.faults.judged import Fault as Found
from ssm_graph.smoothers.faults.pieces import Piece, joined_of, parts_of, pieces_of
from ssm_graph.smoothers.faults.search import FaultSearch
from tests.helpers import simulated

PIECE_S = 100.0
DURATION_S = 240.0
"""Pieces from 0, 50, 100 and 150 s on; seams at 75, 125 and 175 s."""


def found_in(*faults: Fault) -> tuple[DetectedFault, ...]:
    """Return what the search finds in pieces of a mission."""
    sim = simulated(
        duration_s=DURATION_S,
        grade=Grade.TACTICAL,
        dvl=DvlSettings(noise=0.005),
        faults=faults,
        seed=5,
    )
    config = SmootherConfig(fault_search=FaultSearch(piece_s=PIECE_S))
    return SsmSmoother(config).solve(build_problem(sim.mission)).faults


@pytest.mark.parametrize(("jump", "seed"), [(0.1, 3), pytest.param(0.2, 5, marks=pytest.mark.slow)])
def test_a_gyro_that_jumped_in_one_piece_counts_to_the_end(jump: float, seed: int) -> None:
    """One that may be chance, and one that is freed: by deg/s, at a quiet speed; sigmas hold."""
    fault = Fault(sensor=Sensor.GYROS, start_s=60.4, size=math.radians(jump), axes=(2,))
    sim = simulated(duration_s=200.0, grade=Grade.TACTICAL, dvl=DvlSettings(noise=0.005), seed=seed)
    broken = with_faults(sim.mission, (fault,), truth=sim.truth_at)
    config = SmootherConfig(fault_search=FaultSearch(piece_s=PIECE_S))
    estimate = SsmSmoother(config).solve(build_problem(broken.mission))
    found = next(one for one in estimate.faults if one.sensor == "gyros")
    assert abs(found.begin_s - fault.start_s) < 12.0
    assert found.end_s == estimate.trajectory.time_s[-1]
    frame, track = sim.mission.frame, estimate.trajectory
    truth = sim.truth_at(track.time_s)
    off = frame.p_n_from_geodetic(track.lat, track.lon, track.height)
    off -= frame.p_n_from_geodetic(truth.lat, truth.lon, truth.height)
    sigma = np.sqrt(np.diagonal(track.position_cov_enu, axis1=1, axis2=2))
    assert np.max(np.abs(off) / sigma) < 4.0


@pytest.mark.parametrize(
    ("begin_s", "end_s"),
    [
        pytest.param(185.0, 215.0, id="in the last piece", marks=pytest.mark.slow),
        pytest.param(105.0, 145.0, id="across a seam"),
        pytest.param(30.0, 220.0, id="longer than a piece", marks=pytest.mark.slow),
    ],
)
def test_a_fault_is_found_once_where_it_is(begin_s: float, end_s: float) -> None:
    """One beam by a constant."""
    (found,) = found_in(Fault((1,), begin_s, end_s, 0.1))
    assert found.sensor == "DVL beam 2"
    assert abs(found.begin_s - begin_s) < 3.0
    assert abs(found.end_s - end_s) < 3.0


def test_nothing_is_found_in_pieces_where_nothing_is() -> None:
    """A seam is no edge."""
    assert not found_in()


def test_pieces_overlap_by_half() -> None:
    """From the begin to the end, the last one no shorter than half."""
    pieces = pieces_of(np.arange(0.0, DURATION_S + 1.0), PIECE_S)
    assert pieces == [
        Piece(0, 100, 0),
        Piece(50, 150, 75),
        Piece(100, 200, 125),
        Piece(150, 241, 175),
    ]
    for longer_s in (PIECE_S, 2.0 * PIECE_S, 1e6):
        assert pieces_of(np.arange(0.0, 101.0), longer_s) == [Piece(0, 101, 0)]


BEAM_2 = Hypothesis("DVL beam 2", "beam", np.eye(4)[:, [1]], np.ones(1), str)
BEAM_3 = Hypothesis("DVL beam 3", "beam", np.eye(4)[:, [2]], np.ones(1), str)
PIECES = pieces_of(np.arange(0.0, 151.0), PIECE_S)


def stretches(*by_piece: list[Found]) -> list[tuple[str, int, int]]:
    """Return sensor, begin and end of what stays of findings in two pieces."""
    found = joined_of(zip(PIECES, by_piece, strict=True))
    return [(one.hypothesis.sensor, one.begin, one.end) for one in found]


def test_edges_are_those_of_the_piece_that_sees_them_best() -> None:
    """That in whose middle they are, the seam being at 75."""
    assert stretches([Found(BEAM_2, 10, 100)], [Found(BEAM_2, 50, 130)]) == [
        ("DVL beam 2", 10, 130)
    ]
    assert stretches([Found(BEAM_2, 60, 92)], [Found(BEAM_2, 58, 90)]) == [("DVL beam 2", 60, 90)]


def test_what_one_piece_alone_finds_counts_in_its_middle() -> None:
    """And to the seam, where it goes on to the end of the piece."""
    assert stretches([Found(BEAM_2, 55, 80)], []) == [("DVL beam 2", 55, 80)]
    assert stretches([Found(BEAM_2, 80, 95)], []) == []
    assert stretches([], [Found(BEAM_2, 55, 70)]) == []
    assert stretches([Found(BEAM_2, 20, 100)], [Found(BEAM_3, 50, 130)]) == [
        ("DVL beam 2", 20, 75),
        ("DVL beam 3", 75, 130),
    ]


def test_rows_are_left_out_across_a_seam_only_where_both_pieces_say_so() -> None:
    """They could say no more later, and the next piece may know better what they are."""
    anything = replace(BEAM_2, course=Course.ANYTHING)
    assert stretches([Found(anything, 20, 100)], [Found(BEAM_2, 50, 130)]) == [
        ("DVL beam 2", 75, 130)
    ]
    assert stretches([Found(anything, 20, 100)], [Found(anything, 50, 130)]) == [
        ("DVL beam 2", 20, 130)
    ]
    assert stretches([Found(anything, 20, 60)], []) == [("DVL beam 2", 20, 60)]


def test_rivals_are_joined_as_their_faults_are() -> None:
    """So that what they cover goes on across the seam."""
    by_piece = (
        [Found(BEAM_2, 10, 100, merit=5.0, rivals=(Found(BEAM_3, 12, 100),))],
        [Found(BEAM_2, 50, 130, rivals=(Found(BEAM_3, 50, 128),))],
    )
    (found,) = joined_of(zip(PIECES, by_piece, strict=True))
    ((begin, end),) = [(one.begin, one.end) for one in found.rivals]
    assert (begin, end) == (12, 128)


def test_a_trend_is_cut_with_the_size_that_it_has_there() -> None:
    """The rate counts from the begin of the stretch on, per 100 s."""
    hypothesis = replace(BEAM_2, course=Course.TREND)
    fault = Found(hypothesis, 10, 130, sizes=np.array([0.1, 0.5]))
    first, second = (parts_of([fault], piece, np.arange(0.0, 151.0))[0] for piece in PIECES)
    assert (first.begin, first.end, second.begin, second.end) == (10, 100, 50, 130)
    assert first.sizes is not None
    assert second.sizes is not None
    np.testing.assert_allclose(first.sizes, [0.1, 0.5])
    np.testing.assert_allclose(second.sizes, [0.3, 0.5])


def test_pieces_hold_some_blocks() -> None:
    """In shorter ones nothing could last."""
    with pytest.raises(ConfigError, match=r"piece_s: expected four blocks of 10\.0 s or more"):
        FaultSearch(piece_s=30.0)
