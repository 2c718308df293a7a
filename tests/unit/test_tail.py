"""From the newest keyframe to the last inertial sample: gaps, and asking that changes nothing."""

from __future__ import annotations

import numpy as np
import pytest

from ssm_graph.base.frozen import Array
from ssm_graph.engine.states import States
from ssm_graph.graph.inertial_rows import InertialRows
from ssm_graph.imu.preintegration import GAP_ACCEL, GAP_GYRO_RATE, GRAVITY
from ssm_graph.live.estimator import FixedLagSmoother
from ssm_graph.live.estimator.start import sensors_of_vehicle
from ssm_graph.live.estimator.tail import LONGEST_S, Tail
from ssm_graph.sensors.imu import ImuSample
from ssm_graph.smoothers.keyframe import Keyframe
from tests.online_fixture import SHORT, messages, run, stream

PERIOD_S = 0.02
TILT = 1e-4
"""rad^2, variance of the attitude at the keyframe"""


def a_tail() -> Tail:
    """Return one that begins at 0 s, at rest and level, forward-right-down to East-North-up."""
    _, vehicle = stream()
    assert vehicle.initial is not None
    frame = stream()[0].mission.frame
    sensors = sensors_of_vehicle(vehicle, frame)
    n = sensors.state_dim
    R_nb = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    walks = np.zeros((1, n - 15))
    states = States(R_nb[None], np.zeros((1, 3)), np.zeros((1, 3)), np.zeros((1, 6)), walks)
    keyframe = Keyframe(0.0, sensors.beams)
    return Tail(
        keyframe,
        states,
        TILT * np.eye(n),
        noise=vehicle.imu_noise,
        frame=frame,
        inertial=InertialRows(frame, sensors.extras),
    )


def samples(*spans: tuple[float, float], yaw_rate: float = 0.0) -> Array:
    """Return samples (N, 7) at rest within spans of time, s, each turning at its own rate, rad/s.

    The k-th span turns at ``k + 1`` times ``yaw_rate``.
    """
    rows = []
    for k, (begin_s, end_s) in enumerate(spans):
        for time_s in np.arange(begin_s + PERIOD_S, end_s + 0.5 * PERIOD_S, PERIOD_S):
            rows.append([time_s, 0.0, 0.0, (k + 1) * yaw_rate, 0.0, 0.0, -GRAVITY])
    return np.array(rows)


def after(rows: Array, *, asked: bool = False) -> tuple[States, Array]:
    """Return states and covariance after some samples, asked for at each of them or at the end."""
    tail = a_tail()
    for row in rows:
        tail.add(row[None])
        if asked:
            tail.newest()
    assert tail.end_s == rows[-1, 0]
    newest = tail.newest()
    assert newest.time_s == rows[-1, 0]
    return newest.states, newest.covariance


def test_asking_changes_nothing() -> None:
    """Whether somebody asked in between: the same answer to the last bit, also after a gap."""
    rows = samples((0.0, 0.2), (0.55, 0.9))
    (once, covariance), (often, other) = after(rows), after(rows, asked=True)
    np.testing.assert_array_equal(covariance, other)
    for a, b in zip(once, often, strict=True):
        np.testing.assert_array_equal(a, b)


def test_asking_a_live_estimator_changes_nothing() -> None:
    """A third of a second is lost between keyframes, and the display asks at every message."""
    lost = [m for m in messages() if isinstance(m, ImuSample) and 11.05 < m.time_s < 11.4]
    given = [m for m in messages() if m.time_s < 11.48 and m not in lost]
    _, vehicle = stream()
    expected, _, _ = run(given, vehicle)
    smoother = FixedLagSmoother(vehicle, SHORT)
    for message in given:
        smoother.push(message)
        newest = smoother.newest()
    assert newest is not None
    np.testing.assert_array_equal(newest.position_sigma_enu, expected.position_sigma_enu)
    np.testing.assert_array_equal(newest.attitude_sigma, expected.attitude_sigma)


@pytest.mark.parametrize(
    "spans", [[(0.0, 0.2), (0.55, 0.9)], [(0.0, 0.2), (0.55, 0.7), (0.85, 0.9)]]
)
def test_a_gap_is_uncertain_by_what_may_have_happened_in_it(
    spans: list[tuple[float, float]],
) -> None:
    """By its own length, the longest one's, in attitude and velocity; a missing sample is none."""
    gap_s = 0.35 + PERIOD_S
    covariance, whole = after(samples(*spans))[1], after(samples((0.0, 0.9)))[1]
    more = np.diagonal(covariance - whole)
    np.testing.assert_allclose(more[:3], (GAP_GYRO_RATE * gap_s) ** 2, rtol=0.02)
    force = np.hypot(GAP_ACCEL, 0.5 * GRAVITY * GAP_GYRO_RATE * gap_s) * gap_s
    tilted = (GRAVITY * 0.9 * GAP_GYRO_RATE * gap_s) ** 2
    np.testing.assert_allclose(more[6:8], force**2 + tilted, rtol=0.02)


def test_a_short_step_is_no_gap() -> None:
    """Samples that are a little apart are as good as those of a slower instrument."""
    apart_s = LONGEST_S - 2.0 * PERIOD_S
    slow = after(samples((0.0, 0.2), (0.2 + apart_s, 0.9)))[1]
    fast = after(samples((0.0, 0.9)))[1]
    np.testing.assert_allclose(np.diagonal(slow), np.diagonal(fast), rtol=1e-3)


def test_a_gap_is_bridged_by_the_mean_of_both_sides() -> None:
    """A turn that doubled its rate somewhere in a gap: half of the gap each."""
    rate, first, last = 0.2, (0.0, 0.2), (0.58, 0.9)
    R_nb = after(samples(first, last, yaw_rate=rate))[0].R_nb[0]
    turned = np.arctan2(R_nb[0, 0], R_nb[1, 0])
    gap_s = last[0] + PERIOD_S - first[1]
    expected = rate * 0.2 + 1.5 * rate * gap_s + 2.0 * rate * (0.9 - last[0] - PERIOD_S)
    assert turned == pytest.approx(expected, abs=2e-4)
