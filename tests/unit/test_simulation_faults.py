"""Outliers, programmed faults and losses have the shape and the rate asked for."""

from __future__ import annotations

import math

import numpy as np
import pytest

from ssm_graph.base.errors import ConfigError
from ssm_graph.simulation import (
    CALM,
    DvlSettings,
    Fault,
    FaultShape,
    Loss,
    OutlierKind,
    Outliers,
    SimulationConfig,
    default_mount,
    janus_beams,
    simulate,
)
from ssm_graph.simulation.beam_faults import (
    BeamFaults,
    add_faults,
    draw_dropouts,
    draw_outliers,
    lost_beams,
)

N = 4000
TIMES = np.arange(1.0, N + 1.0)
SPEED = np.random.default_rng(0).normal(size=(N, 4))
KINDS = [kind for kind in OutlierKind if kind is not OutlierKind.NONE]


def draw(kind: OutlierKind, *, rate: float = 0.1, beam: int | None = None) -> BeamFaults:
    """Return outliers of one kind at the default size."""
    rng = np.random.default_rng(7)
    return draw_outliers(Outliers(kind, rate, beam=beam), TIMES, SPEED, rng=rng)


def runs(mask: np.ndarray) -> np.ndarray:
    """Return the lengths of the runs of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(int), [0]])))
    return np.asarray(edges[1::2] - edges[::2])


@pytest.mark.parametrize("rate", [0.0, 0.02, 0.1, 0.5, 1.0])
@pytest.mark.parametrize("kind", KINDS)
def test_rate_is_the_fraction_of_pings(kind: OutlierKind, rate: float) -> None:
    """Exact for kinds that strike single pings, to a ping or so per event for the others."""
    touched = draw(kind, rate=rate).is_outlier.any(axis=1).sum()
    slack = 0 if kind in {OutlierKind.SPARSE, OutlierKind.ONE_BEAM, OutlierKind.TWO_BEAMS} else 30
    assert abs(touched - rate * N) <= slack


@pytest.mark.parametrize("kind", KINDS)
def test_offsets_are_where_the_mask_is(kind: OutlierKind) -> None:
    """Nothing is touched that the mask does not show."""
    faults = draw(kind)
    assert not faults.offset[~faults.is_outlier].any()
    beams_per_ping = faults.is_outlier.sum(axis=1)
    assert beams_per_ping.max() == (2 if kind is OutlierKind.TWO_BEAMS else 1)


@pytest.mark.parametrize(
    "kind", [OutlierKind.SPARSE, OutlierKind.BURST, OutlierKind.ONE_BEAM, OutlierKind.TWO_BEAMS]
)
def test_sizes_and_signs(kind: OutlierKind) -> None:
    """Absolute offsets lie between 0.5 and 3 m/s, both signs occur."""
    faults = draw(kind, rate=0.3)
    offset = faults.offset[faults.is_outlier]
    assert 0.5 <= np.abs(offset).min() < 1.0
    assert 2.5 < np.abs(offset).max() <= 3.0
    assert 0.3 < (offset > 0.0).mean() < 0.7


def test_sparse_outliers_choose_beams_evenly() -> None:
    """Every beam takes its share of the sparse ones, one beam takes all of ONE_BEAM."""
    share = draw(OutlierKind.SPARSE, rate=0.5).is_outlier.mean(axis=0)
    np.testing.assert_allclose(share, 0.125, atol=0.03)
    assert np.count_nonzero(draw(OutlierKind.ONE_BEAM).is_outlier.any(axis=0)) == 1


def test_two_beams_err_independently() -> None:
    """Two different beams with offsets of their own."""
    faults = draw(OutlierKind.TWO_BEAMS, rate=0.5)
    pairs = faults.offset[faults.is_outlier].reshape(-1, 2)
    correlation = np.mean(pairs[:, 0] * pairs[:, 1]) / np.mean(pairs**2)
    assert abs(correlation) < 0.1


@pytest.mark.parametrize("kind", [OutlierKind.BURST, OutlierKind.BLOCKED])
def test_bursts_last_five_to_twenty_seconds(kind: OutlierKind) -> None:
    """One beam at a time, constant offset; neighbours may touch."""
    faults = draw(kind, beam=2)
    assert not np.delete(faults.is_outlier, 2, axis=1).any()
    lengths = runs(faults.is_outlier[:, 2])
    assert np.median(lengths) == pytest.approx(12.5, abs=4.0)
    assert (lengths <= 45).all()


def test_a_blocked_beam_reads_zero() -> None:
    """What is added takes the whole speed away."""
    faults = draw(OutlierKind.BLOCKED)
    np.testing.assert_array_equal((SPEED + faults.offset)[faults.is_outlier], 0.0)


def test_silt_rises_slowly_and_stays() -> None:
    """Never a step up; the end value is 0.15 to 0.3 m/s and holds."""
    faults = draw(OutlierKind.SILT, rate=0.1, beam=0)
    offset = np.abs(faults.offset[:, 0])
    assert np.diff(offset).max() <= 0.3 / 60.0 + 1e-12
    assert 0.15 < offset.max() <= 0.3
    assert (offset[1:] == offset[:-1])[offset[1:] > 0.0].mean() > 0.2


def test_programmed_faults_do_exactly_what_they_say() -> None:
    """One beam for 40 s, two beams with offsets of their own; the end is not included."""
    faults = (
        Fault(beams=(0,), start_s=100.0, end_s=140.0, offset_m_per_s=1.0),
        Fault(beams=(1, 3), start_s=200.0, end_s=215.0, offset_m_per_s=(0.5, -0.7)),
        Fault(beams=(1, 2), start_s=300.0, end_s=315.0, offset_m_per_s=0.4),
    )
    done = add_faults(draw(OutlierKind.NONE), faults, TIMES, SPEED)
    assert done.is_outlier.sum(axis=0).tolist() == [40, 30, 15, 15]
    np.testing.assert_array_equal(done.offset[99:139, 0], 1.0)
    np.testing.assert_array_equal(done.offset[205], [0.0, 0.5, 0.0, -0.7])
    np.testing.assert_array_equal(done.offset[305], [0.0, 0.4, 0.4, 0.0])


def test_slow_faults_begin_at_nothing() -> None:
    """A drift comes to its offset evenly, a covered beam loses its share, a stuck one stays."""
    faults = (
        Fault((0,), 100.0, 200.0, 0.5, shape=FaultShape.DRIFT),
        Fault((1,), 100.0, 200.0, shape=FaultShape.COVERED, share=0.4),
        Fault((2, 3), 100.0, 200.0, shape=FaultShape.STUCK),
    )
    done = add_faults(draw(OutlierKind.NONE), faults, TIMES, SPEED)
    assert done.is_outlier.sum(axis=0).tolist() == [100] * 4
    np.testing.assert_allclose(done.offset[99:199, 0], 0.005 * np.arange(100.0))
    np.testing.assert_allclose(done.offset[149, 1], -0.2 * SPEED[149, 1])
    stuck = (SPEED + done.offset)[99:199, 2:]
    np.testing.assert_allclose(stuck, np.broadcast_to(SPEED[99, 2:], stuck.shape))
    assert not done.offset[199:].any()


def test_losses_and_dropouts() -> None:
    """One, two and three beams left, then none; dropouts at their rate elsewhere."""
    losses = (
        Loss(0.0, 60.0, beams=(0,)),
        Loss(60.0, 120.0, beams=(0, 1)),
        Loss(120.0, 180.0, beams=(0, 1, 3)),
        Loss(180.0, 780.0),
    )
    rng = np.random.default_rng(1)
    lost = lost_beams(TIMES, 4, losses)
    left = 4 - lost.sum(axis=1)
    assert [int(left[k]) for k in (30, 90, 150, 500, 2000)] == [3, 2, 1, 0, 4]
    assert (left == 0).sum() == 600
    missing = draw_dropouts(lost.shape, dropout_rate=0.05, rng=rng)
    assert missing.mean() == pytest.approx(0.05, abs=0.01)


def test_impossible_faults_are_refused() -> None:
    """Beams count from 0, rates are fractions, windows run forwards."""
    with pytest.raises(ConfigError, match=r"Outliers\.rate: .*10 % as 0\.1"):
        Outliers(OutlierKind.SPARSE, rate=10.0)
    with pytest.raises(ConfigError, match=r"Outliers\.size"):
        Outliers(OutlierKind.SPARSE, size=(3.0, 0.5))
    with pytest.raises(ConfigError, match=r"Outliers\.beam"):
        SimulationConfig(outliers=Outliers(OutlierKind.BURST, beam=4))
    with pytest.raises(ConfigError, match=r"Fault\.beams: .* counted from 0"):
        SimulationConfig(faults=(Fault(beams=(4,), start_s=0.0, end_s=1.0, offset_m_per_s=1.0),))
    with pytest.raises(ConfigError, match=r"Loss\.beams: .* out of 0\.\.2"):
        SimulationConfig(dvl=velocity_dvl(), losses=(Loss(0.0, 1.0, beams=(3,)),))
    with pytest.raises(ConfigError, match=r"Loss\.beams: .* got \(8,\)"):
        Loss(0.0, 1.0, beams=(8,))
    with pytest.raises(ConfigError, match=r"Fault\.offset_m_per_s: expected 1 or 2 offsets"):
        Fault(beams=(0, 1), start_s=0.0, end_s=1.0, offset_m_per_s=(1.0, 2.0, 3.0))
    with pytest.raises(ConfigError, match=r"Fault\.offset_m_per_s: expected none with STUCK"):
        Fault((0,), 0.0, 1.0, 1.0, shape=FaultShape.STUCK)
    with pytest.raises(ConfigError, match=r"Fault\.share: .*30 % as 0\.3"):
        Fault((0,), 0.0, 1.0, shape=FaultShape.COVERED, share=30.0)
    with pytest.raises(ConfigError, match="Loss: expected start_s < end_s"):
        Loss(10.0, 10.0)
    with pytest.raises(ConfigError, match="Fault: expected"):
        Fault(beams=(0,), start_s=math.nan, end_s=1.0, offset_m_per_s=1.0)


def velocity_dvl() -> DvlSettings:
    """Return an instrument that gives a velocity alone."""
    return DvlSettings(mount=default_mount(np.eye(3)))


@pytest.mark.parametrize("n_beams", [1, 2, 3, 5, 8])
@pytest.mark.parametrize("kind", list(OutlierKind))
def test_faults_of_any_number_of_beams(n_beams: int, kind: OutlierKind) -> None:
    """Outliers, faults, dropouts and losses reach every beam that there is, and no other."""
    config = SimulationConfig(
        duration_s=600.0,
        imu_rate_hz=10.0,
        waves=CALM,
        dvl=DvlSettings(mount=default_mount(janus_beams(n_beams)), seabed_depth_m=60.0),
        outliers=Outliers(kind, 0.4, beam=n_beams - 1),
        faults=(Fault((n_beams - 1,), 500.0, 510.0, 2.0),),
        losses=(Loss(520.0, 540.0), Loss(550.0, 560.0, beams=(n_beams - 1,))),
        dropout_rate=0.05,
        perfect_sensors=True,
    )
    run = simulate(config)
    speed = run.mission.dvl.speed
    assert speed.shape == run.is_outlier.shape == (600, n_beams)
    assert run.mission.dvl.range_m is not None
    ping_s = run.ping_time_s
    assert np.isnan(speed[(ping_s >= 520.0) & (ping_s < 540.0)]).all()
    last = speed[(ping_s >= 550.0) & (ping_s < 560.0)]
    assert np.isnan(last[:, -1]).all()
    assert n_beams == 1 or np.isfinite(last[:, 0]).mean() > 0.5
    good = ~run.is_outlier & np.isfinite(speed)
    np.testing.assert_allclose(speed[good], run.true_speed[good], atol=1e-12)
    assert run.is_outlier[:, -1].sum() > (10 if kind is OutlierKind.NONE else 60) * 0.5


def test_an_instrument_that_gives_a_velocity() -> None:
    """Three beams along its axes read the velocity of the instrument, in its own axes."""
    run = simulate(SimulationConfig(duration_s=60.0, dvl=velocity_dvl(), perfect_sensors=True))
    mount = run.mission.dvl.mount
    over_ground = simulate(SimulationConfig(duration_s=60.0, perfect_sensors=True)).mission.dvl
    v_d = np.linalg.lstsq(over_ground.mount.beams_d, over_ground.speed.T, rcond=None)[0].T
    np.testing.assert_allclose(run.mission.dvl.speed, v_d, atol=1e-9)
    np.testing.assert_array_equal(mount.beams_d, np.eye(3))
