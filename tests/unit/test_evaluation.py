"""Errors, metrics and statistics against closed forms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import Array
from ssm_graph.evaluation.errors import (
    error_series,
    evaluate,
    gap_limit_s,
    interpolate_within,
    reference_from_gnss,
)
from ssm_graph.evaluation.statistics import chi2_interval, mean_with_interval, paired_ratio
from ssm_graph.mission.estimate import Trajectory, path_length_m
from ssm_graph.mission.mission import Reference
from ssm_graph.sensors.gnss import GnssLog

FRAME = LocalFrame(lat=1.107, lon=0.182, height=-20.0)
EPOCH = 1.7466e9


def make_trajectory(time_s: Array, p_n: Array, *, heading: Array | None = None) -> Trajectory:
    """Return a level trajectory through positions (N, 3) near `FRAME`, sigma 2, 1 and 0.5 m."""
    n = len(time_s)
    lat, lon, height = FRAME.geodetic_from_p_n(p_n)
    angles = np.zeros((n, 3))
    angles[:, 2] = 0.0 if heading is None else heading
    return Trajectory(
        time_s=time_s,
        lat=lat,
        lon=lon,
        height=height,
        velocity_enu=np.zeros((n, 3)),
        roll_pitch_heading=angles,
        gyro_bias=np.zeros((n, 3)),
        accel_bias=np.zeros((n, 3)),
        position_cov_enu=np.tile(np.diag([4.0, 1.0, 0.25]), (n, 1, 1)),
        velocity_sigma_enu=np.full((n, 3), 0.1),
        attitude_sigma=np.full((n, 3), 0.01),
        n_beams=np.full(n, 4.0),
    )


def make_reference(time_s: Array, p_n: Array) -> Reference:
    """Return positions only."""
    lat, lon, height = FRAME.geodetic_from_p_n(p_n)
    unknown = np.full((len(time_s), 3), np.nan)
    return Reference(
        time_s=time_s,
        lat=lat,
        lon=lon,
        height=height,
        velocity_enu=unknown,
        roll_pitch_heading=unknown,
    )


def straight(time_s: Array, *, speed: float = 2.0) -> Array:
    """Return positions (N, 3) of a run to the east at ``speed``, m."""
    return np.column_stack([speed * time_s, np.zeros_like(time_s), np.zeros_like(time_s)])


def test_constant_offset_gives_its_own_size() -> None:
    """Two metres north and one down: every number has a closed form."""
    time_s = np.linspace(0.0, 100.0, 401)
    p_n = straight(time_s)
    metrics = evaluate(
        make_trajectory(time_s, p_n + np.array([0.0, 2.0, -1.0])),
        make_reference(time_s[::4], p_n[::4]),
    )
    assert metrics.n_epochs == 401
    assert (metrics.first_s, metrics.last_s) == (0.0, 100.0)
    assert metrics.rmse_horizontal_m == pytest.approx(2.0, abs=1e-6)
    assert metrics.max_horizontal_m == pytest.approx(2.0, abs=1e-4)
    assert metrics.rmse_vertical_m == pytest.approx(1.0, abs=1e-6)
    assert metrics.end_error_m == pytest.approx(2.0, abs=1e-4)
    assert metrics.path_length_m == pytest.approx(200.0, abs=1e-3)
    assert metrics.drift_percent == pytest.approx(1.0, abs=1e-4)
    assert metrics.nees_position == pytest.approx((4.0 / 1.0 + 1.0 / 0.25) / 3.0, rel=1e-4)
    assert metrics.inside_3_sigma == (1.0, 1.0, 1.0)
    assert np.isnan(metrics.rmse_velocity_m_per_s)
    assert np.isnan(metrics.rmse_attitude).all()


def test_errors_are_along_the_local_axes() -> None:
    """200 km from the frame's origin, east and up are those of the place, not of the frame."""
    time_s = np.arange(5.0)
    far = FRAME.geodetic_from_p_n(np.array([[2e5, 1e5, 0.0]]))
    place = LocalFrame(*(float(x[0]) for x in far))
    lat, lon, height = place.geodetic_from_p_n(np.array([[1.0, 2.0, 3.0]]))
    n = np.ones(5)
    trajectory = replace(
        make_trajectory(time_s, np.zeros((5, 3))), lat=lat * n, lon=lon * n, height=height * n
    )
    reference = replace(
        make_reference(time_s, np.zeros((5, 3))),
        lat=place.lat * n,
        lon=place.lon * n,
        height=place.height * n,
    )
    errors = error_series(trajectory, reference)
    np.testing.assert_allclose(errors.position_enu, [[1.0, 2.0, 3.0]] * 5, atol=1e-5)


def test_nees_uses_the_full_covariance() -> None:
    """A correlated covariance, against the written-out quadratic form."""
    time_s = np.arange(3.0)
    cov = np.array([[2.0, 0.9, 0.1], [0.9, 1.0, -0.2], [0.1, -0.2, 0.5]])
    trajectory = make_trajectory(time_s, np.tile([1.0, -1.0, 0.5], (3, 1)))
    broken = np.array([cov, -cov, np.full((3, 3), np.nan)])
    errors = error_series(
        replace(trajectory, position_cov_enu=broken), make_reference(time_s, np.zeros((3, 3)))
    )
    error = np.array([1.0, -1.0, 0.5])
    expected = [error @ np.linalg.inv(cov) @ error, np.nan, np.nan]
    np.testing.assert_allclose(errors.nees_position, expected, rtol=1e-5)


def test_what_a_reference_errs_by_counts_beside_the_estimate() -> None:
    """Off by 5 sigmas of the estimate alone, by one of both; on the way between fixes too."""
    time_s = np.arange(5.0)
    trajectory = make_trajectory(time_s, np.tile([0.0, 0.0, 2.5], (5, 1)))
    exact = make_reference(time_s[::2], np.zeros((3, 3)))
    doubted = replace(exact, position_sigma_enu=np.tile([0.0, 0.0, np.sqrt(6.0)], (3, 1)))
    alone, both = (evaluate(trajectory, reference) for reference in (exact, doubted))
    assert (alone.inside_3_sigma[2], both.inside_3_sigma[2]) == (0.0, 1.0)
    assert alone.nees_position == pytest.approx(25.0 / 3.0, rel=1e-6)
    assert both.nees_position == pytest.approx(1.0 / 3.0, rel=1e-6)
    blind = replace(exact, position_sigma_enu=np.tile([0.5, 0.5, 50.0], (3, 1)))
    level = evaluate(trajectory, blind)
    assert np.isnan(level.rmse_vertical_m)
    assert np.isnan(level.inside_3_sigma[2])
    assert level.inside_3_sigma[0] == 1.0
    assert level.rmse_horizontal_m == pytest.approx(0.0, abs=1e-6)


def test_angles_cross_north() -> None:
    """Interpolated between 359 and 1 degrees the reference points north, not south."""
    known_s = np.arange(0.0, 10.0)
    heading = np.deg2rad(np.where(known_s % 2 == 0, 359.0, 1.0))
    reference = replace(
        make_reference(known_s, np.zeros((10, 3))),
        roll_pitch_heading=np.column_stack([np.full(10, np.nan), np.zeros(10), heading]),
        velocity_enu=np.full((10, 3), 0.1),
    )
    time_s = known_s[:-1] + 0.5
    metrics = evaluate(
        make_trajectory(time_s, np.zeros((9, 3)), heading=np.full(9, np.deg2rad(359.5))), reference
    )
    roll, pitch, heading_rms = metrics.rmse_attitude
    assert np.isnan(roll)
    assert pitch == 0.0
    assert np.rad2deg(heading_rms) == pytest.approx(0.5, abs=0.1)
    assert metrics.rmse_velocity_m_per_s == pytest.approx(0.1 * np.sqrt(3.0))
    assert np.isnan(metrics.drift_percent)


def test_reference_is_not_extended_nor_bridged() -> None:
    """Keyframes outside of the reference and in its hole do not count."""
    known_s = EPOCH + np.r_[np.arange(0.0, 20.1, 0.5), np.arange(60.0, 80.1, 0.5)]
    time_s = EPOCH + np.arange(-10.0, 100.0, 0.25)
    errors = error_series(
        make_trajectory(time_s, straight(time_s - EPOCH)),
        make_reference(known_s, straight(known_s - EPOCH)),
    )
    since = errors.time_s - EPOCH
    assert len(since) == 2 * 81
    assert np.all((since <= 20.0) | (since >= 60.0))
    np.testing.assert_allclose(errors.position_enu[:, :2], 0.0, atol=1e-5)


def test_no_overlap_names_both_spans() -> None:
    """Two clocks: the message shows them."""
    time_s = np.arange(10.0)
    p_n = np.zeros((10, 3))
    with pytest.raises(DataError, match=r"trajectory 0\.000 to 9\.000 s .*reference 1746600000"):
        evaluate(make_trajectory(time_s, p_n), make_reference(EPOCH + time_s, p_n))
    with pytest.raises(DataError, match="no position at all"):
        evaluate(make_trajectory(time_s, p_n), make_reference(time_s, p_n * np.nan))
    with pytest.raises(DataError, match="increase strictly"):
        evaluate(make_trajectory(time_s, p_n), make_reference(time_s[::-1], p_n))


def test_interpolation_follows_a_curve() -> None:
    """A circle sampled at 2 Hz: better than the chord; missing samples stay missing."""
    known_s = np.arange(0.0, 60.0, 0.5)
    values = np.column_stack([np.sin(0.3 * known_s), np.cos(0.3 * known_s)])
    values[10:40, 1] = np.nan
    time_s = np.arange(0.0, 59.5, 0.1)
    got = interpolate_within(time_s, known_s=known_s, values=values)
    np.testing.assert_allclose(got[:, 0], np.sin(0.3 * time_s), atol=3e-3)
    assert np.isnan(got[:, 1]).sum() == np.sum((time_s > 4.5 + 1e-6) & (time_s < 20.0 - 1e-6))
    alone = interpolate_within(time_s, known_s=known_s[:1], values=values[:1])
    assert np.isfinite(alone[:, 0]).sum() == 1
    assert gap_limit_s(known_s) == 2.5
    assert gap_limit_s(np.arange(0.0, 9.0, 0.01)) == 2.0


def test_path_is_horizontal_and_local() -> None:
    """Up and down add nothing; bounds cut."""
    time_s = np.arange(0.0, 101.0)
    p_n = straight(time_s) + np.column_stack([0 * time_s, 0 * time_s, np.sin(time_s)])
    trajectory = make_trajectory(time_s, p_n)
    assert path_length_m(trajectory) == pytest.approx(200.0, rel=2e-5)
    assert path_length_m(trajectory, first_s=50.0) == pytest.approx(100.0, rel=2e-5)
    assert path_length_m(trajectory, first_s=100.0) == 0.0


def test_consistent_errors_have_a_nees_of_one() -> None:
    """Errors drawn from the covariance: NEES in its interval, shares near 99.7 %."""
    rng = np.random.default_rng(0)
    time_s = np.arange(0.0, 4000.0)
    error = rng.normal(size=(4000, 3)) * [2.0, 1.0, 0.5]
    metrics = evaluate(make_trajectory(time_s, error), make_reference(time_s, 0.0 * error))
    assert metrics.nees_position in chi2_interval(3, 4000, 0.999)
    np.testing.assert_allclose(metrics.inside_3_sigma, 0.9973, atol=4e-3)


def test_withheld_fixes_become_the_body_origin() -> None:
    """The antenna is 2 m behind and 1 m above the origin of a vehicle that heads east."""
    time_s = np.arange(0.0, 30.0, 0.2)
    trajectory = make_trajectory(time_s, straight(time_s), heading=np.full(150, 0.5 * np.pi))
    fix_s = np.arange(-5.0, 20.0, 0.5)
    lat, lon, height = FRAME.geodetic_from_p_n(straight(fix_s) + np.array([-2.0, 0.0, 1.0]))
    gnss = GnssLog(
        time_s=fix_s,
        lat=lat,
        lon=lon,
        height=height,
        sigma_enu=np.ones((50, 3)),
        lever_arm_b=np.array([-2.0, 0.0, -1.0]),
    )
    reference = reference_from_gnss(gnss, trajectory)
    assert reference.time_s[0] == 0.0
    metrics = evaluate(trajectory, reference)
    assert metrics.rmse_horizontal_m < 1e-4
    assert metrics.rmse_vertical_m < 1e-4


def test_chi2_interval_is_that_of_the_tables() -> None:
    """50 runs of dimension 3, 95 %: chi-square with 150 degrees of freedom."""
    interval = chi2_interval(3, 50, 0.95)
    assert interval.low == pytest.approx(117.985 / 150.0, abs=1e-5)
    assert interval.high == pytest.approx(185.800 / 150.0, abs=1e-5)
    with pytest.raises(DataError, match="confidence"):
        chi2_interval(3, 50, 95.0)
    with pytest.raises(DataError, match="1 or more"):
        chi2_interval(3, 0)


def test_mean_with_interval_is_students() -> None:
    """Five samples: t of 2.776 with four degrees of freedom."""
    interval = mean_with_interval([1.0, 2.0, 3.0, 4.0, 5.0])
    half = 2.776445 * np.sqrt(2.5 / 5.0)
    assert interval.value == 3.0
    assert interval.high - 3.0 == pytest.approx(half, rel=1e-6)
    assert 3.0 - interval.low == pytest.approx(half, rel=1e-6)
    assert mean_with_interval([1.0]).high == np.inf
    with pytest.raises(DataError, match="finite"):
        mean_with_interval([1.0, np.nan])


def test_pairs_cancel_what_they_share() -> None:
    """Where b varies tenfold and a is 0.8 b throughout, the ratio is known almost exactly."""
    rng = np.random.default_rng(1)
    b = rng.uniform(1.0, 10.0, 40)
    a = 0.8 * b * rng.normal(1.0, 0.01, 40)
    ratio = paired_ratio(a, b, np.random.default_rng(2))
    assert 0.8 in ratio
    assert ratio.high - ratio.low < 0.01
    assert ratio == paired_ratio(a, b, np.random.default_rng(2))
    with pytest.raises(DataError, match="as many a as b"):
        paired_ratio(a[:3], b, rng)
    with pytest.raises(DataError, match="above zero"):
        paired_ratio(a, 0.0 * b, rng)
