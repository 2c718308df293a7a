"""Ranges against a map: Jacobians of the factor and of the aid, at the grid's own slope."""

from __future__ import annotations

import gtsam
import numpy as np
from gtsam.symbol_shorthand import X

from factors.terrain_range import beam_ends, terrain_range_factor
from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.frozen import Array
from ssm_graph.engine.extras import Extras
from ssm_graph.graph.aids.aid import Keyframes, RowStates
from ssm_graph.graph.aids.terrain import TerrainRanges, above_seabed
from ssm_graph.mission.mission import Aids
from ssm_graph.sensors.seabed import MapErrors, SeabedGrid, TerrainLog
from tests.helpers import rotation

FRAME = LocalFrame(0.8, 0.2, 0.0)
R_NB, P_N = rotation([0.3, -0.2, 0.8]), np.array([13.0, -21.0, -30.0])
BEAMS_B = np.array([[0.5, 0.0, 0.8], [-0.3, 0.4, 0.8], [0.1, -0.5, 0.8]])
STEP = 2e-4
"""Heights above the ellipsoid are differences of Earth radii, to 1e-9 m: smaller steps drown."""
BEAMS_B /= np.linalg.norm(BEAMS_B, axis=1)[:, None]


def hills() -> SeabedGrid:
    """Return a seabed with waves of 60 m and 90 m."""
    side = np.arange(-150.0, 151.0, 5.0)
    x, y = np.meshgrid(side, side)
    height = -80.0 + 6.0 * np.sin(x / 10.0) + 5.0 * np.cos(y / 15.0)
    return SeabedGrid("hills", FRAME, -150.0, -150.0, 5.0, height)


def test_factor_on_a_pose() -> None:
    """Against numeric derivatives of the factor itself, on a seabed of four cells' cubic."""
    grid = hills()

    def seabed(point_n: Array) -> tuple[float, Array]:
        above, grows, _ = above_seabed(grid, point_n)
        return float(above), grows

    factor = terrain_range_factor(
        X(0), sigma=0.5, end_b=np.array([20.0, 5.0, 45.0]), seabed=seabed, weight=0.25
    )
    values = gtsam.Values()
    values.insert(X(0), gtsam.Pose3(gtsam.Rot3(R_NB), P_N))
    jacobian, _ = factor.linearize(values).jacobian()
    pose = values.atPose3(X(0))
    columns = []
    for step in STEP * np.eye(6):
        errors = []
        for sign in (1.0, -1.0):
            moved = gtsam.Values()
            moved.insert(X(0), pose.retract(sign * step))
            errors.append(factor.unwhitenedError(moved)[0])
        columns.append((errors[0] - errors[1]) / (2.0 * STEP))
    # sigma / sqrt(weight) is 1 m
    np.testing.assert_allclose(jacobian[0], columns, atol=2e-5)
    assert np.abs(columns).min() > 1e-3


def test_rows_of_the_aid() -> None:
    """State, bias, and what is common and different under the beams, by central differences."""
    grid = hills()
    log = TerrainLog(
        grid=grid,
        errors=MapErrors(),
        time_s=np.array([1.0, 2.0]),
        range_m=np.array([[55.0, 60.0, np.nan], [52.0, 58.0, 61.0]]),
        beams_b=BEAMS_B,
        lever_arm_b=np.array([0.4, -0.1, 0.3]),
        way_m=np.array([1.5, 1.5]),
    )
    aids = Aids(log)
    aid = TerrainRanges.of(aids, Keyframes(FRAME, None, np.array([1.0, 2.0])))  # type: ignore[arg-type]
    assert aid is not None
    assert aid.keyframe.tolist() == [0, 0, 1, 1, 1]
    extras = Extras(TerrainRanges.variables(aids))
    assert extras.n_walks == 4

    def at(d: Array) -> RowStates:
        R = np.broadcast_to(R_NB @ rotation(d[:3]), (5, 3, 3))
        p = np.broadcast_to(P_N + R_NB @ d[3:6], (5, 3))
        walks = np.broadcast_to(np.array([0.3, -0.2, 0.1, 0.4]) + d[15:], (5, 4))
        return RowStates(R, p, np.zeros((5, 3)), np.zeros((5, 6)), walks, np.zeros(0), extras, p)

    found = aid.measured(at(np.zeros(19)))
    steps = STEP * np.eye(19)
    numeric = [
        (aid.measured(at(d)).error - aid.measured(at(-d)).error) / (2.0 * STEP) for d in steps
    ]
    np.testing.assert_allclose(found.jacobian, np.stack(numeric, axis=-1), atol=2e-5)
    # The end of the second beam of the second ping, above the map there, less what the map is off.
    end_n = beam_ends(R_NB, P_N, end_b=log.lever_arm_b + 58.0 * BEAMS_B[1])
    assert above_seabed(grid, end_n)[0] != found.error[3, 0]
    apart = found.jacobian[:, 0, 17:]
    np.testing.assert_allclose(apart[2] + apart[3] + apart[4], 0.0, atol=1e-12)


def test_off_the_map_says_nothing() -> None:
    """Neither an error nor a direction."""
    log = TerrainLog(
        grid=hills(),
        errors=MapErrors(),
        time_s=np.array([1.0, 2.0]),
        range_m=np.full((2, 3), 55.0),
        beams_b=BEAMS_B,
        lever_arm_b=np.zeros(3),
        way_m=np.array([1.5, 1.5]),
    )
    aids = Aids(log)
    aid = TerrainRanges.of(aids, Keyframes(FRAME, None, np.array([1.0, 2.0])))  # type: ignore[arg-type]
    assert aid is not None
    extras = Extras(TerrainRanges.variables(aids))
    far = np.array([900.0, 0.0, -30.0])
    state = RowStates(
        R_NB, far, np.zeros(3), np.zeros(6), np.zeros(4), np.zeros(0), extras, np.zeros(3)
    )
    found = aid.measured(state)
    assert not found.error.any()
    assert not found.jacobian.any()
