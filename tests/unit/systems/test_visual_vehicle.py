"""Depth and dead reckoning in the map: residuals, scale without ranges, sound speed, files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest

from factors.metric_step import metric_step_factor
from factors.so3 import exp
from ssm_graph.base.errors import ConfigError, DataError
from ssm_graph.base.frozen import Array
from ssm_graph.systems.visual_ranges.bundle import Effort, Problem, adjust, sorted_views
from ssm_graph.systems.visual_ranges.bundle_metric import BundleMetric
from ssm_graph.systems.visual_ranges.metric import Metric
from ssm_graph.systems.visual_ranges.range_terms import FramePoses
from ssm_graph.systems.visual_ranges.ranges import at_the_anchor, screened_ranges
from ssm_graph.systems.visual_ranges.readers.options import ReadOptions
from ssm_graph.systems.visual_ranges.readers.own_folder import read_own_folder, write_own_folder
from ssm_graph.systems.visual_ranges.simulate import (
    SMALL_CAMERA,
    axes,
    bottom_path,
    simulate,
    under_water,
)
from ssm_graph.systems.visual_ranges.simulated_ranges import RangeFaults, simulated_ranges
from ssm_graph.systems.visual_ranges.simulated_vehicle import VehicleFaults, simulated_vehicle
from ssm_graph.systems.visual_ranges.start import StartState
from ssm_graph.systems.visual_ranges.vehicle import Vehicle
from ssm_graph.systems.visual_ranges.vehicle_terms import (
    MetricState,
    VehicleTerms,
    hung,
    metric_state,
)

UNIT_M = 1.7


def path_of(seed: int, n: int = 80, step_s: float = 0.5) -> tuple[Array, Array, Array, Array]:
    """Return times, true poses (R_wc, p_w), and the map's places in units of 1.7 m."""
    path, time = bottom_path(seed), (np.arange(n) * step_s).astype(np.float64)
    R_wc, p_w = axes(path, time), path.place(time)
    return time, R_wc, p_w, (p_w - p_w[0]) @ R_wc[0] / UNIT_M


def map_of(seed: int, n: int = 80) -> tuple[Array, Array, Array, Vehicle]:
    """Return times, world to camera poses of a perfect map, and what the vehicle measures."""
    time, R_wc, _p_w, centre = path_of(seed, n)
    R_cw = np.swapaxes(R_wc, 1, 2) @ R_wc[0]
    t_cw = -np.einsum("kij,kj->ki", R_cw, centre)
    faults = VehicleFaults(scale_share=1e-9)
    when = np.arange(int(time[-1] * 10) + 2) / 10.0
    path = bottom_path(seed)
    own = simulated_vehicle(faults, when, axes(path, when), path.place(when), seed, 0.0)
    return time, R_cw, t_cw, own


def moved(R: Array, t: Array, xi: Array) -> tuple[Array, Array]:
    """Return a pose perturbed from the left."""
    turn = exp(xi[3:])
    return turn @ R, turn @ t + xi[:3]


def test_rows_have_the_jacobians_of_their_differences() -> None:
    """By both poses, scale, vertical and depth of the origin."""
    time, R, t, own = map_of(2, 6)
    terms = hung(own, time)
    assert (len(terms.depth_of), len(terms.vertical_of), len(terms.step_of)) == (6, 6, 5)
    rng = np.random.default_rng(0)
    terms = replace(terms, depth_lever=np.array([0.2, -0.1, 0.4]))
    t = t + 0.1 * rng.standard_normal(t.shape)
    R = exp(0.05 * rng.standard_normal(t.shape)) @ R
    down = np.array([0.1, 0.9, 0.3])
    state = MetricState(0.4, down / np.linalg.norm(down), 1.0, np.eye(4))
    rows, h = terms.rows(R, t, state), 1e-6

    def error(k: int, xi: Array, extra: Array) -> Array:
        R_k, t_k = R.copy(), t.copy()
        R_k[k], t_k[k] = moved(R[k], t[k], xi)
        return terms.rows(R_k, t_k, state.moved(extra)).error

    for k in range(len(time)):
        for axis in np.eye(6):
            slope = (error(k, h * axis, np.zeros(4)) - error(k, -h * axis, np.zeros(4))) / (2 * h)
            wanted = np.where(rows.first == k, rows.by_first @ axis, 0.0)
            wanted += np.where(rows.second == k, rows.by_second @ axis, 0.0)
            np.testing.assert_allclose(slope, wanted, rtol=1e-7, atol=2e-5)
    for axis in np.eye(4):
        none = np.zeros(6)
        slope = (error(0, none, h * axis) - error(0, none, -h * axis)) / (2 * h)
        np.testing.assert_allclose(slope, rows.by_extra @ axis, rtol=1e-7, atol=2e-5)


def test_a_step_of_a_graph_of_similarities_has_the_jacobian_of_its_difference() -> None:
    """By turn, step and scale of both nodes."""
    rng, h = np.random.default_rng(3), 1e-6
    turn, shift = exp(rng.standard_normal((2, 3))), rng.standard_normal((2, 3))
    nodes = [gtsam.Similarity3(gtsam.Rot3(turn[i]), shift[i], 0.8 + 0.5 * i) for i in (0, 1)]
    factor = metric_step_factor((0, 1), sigma=1.0, step=np.array([0.3, -0.2, 1.0]))
    values = gtsam.Values()
    for key, node in enumerate(nodes):
        values.insert(key, node)
    J = factor.linearize(values).jacobian()[0]
    for key in (0, 1):
        for column, axis in enumerate(np.eye(7)):
            ends = []
            for sign in (1.0, -1.0):
                other = gtsam.Values(values)
                other.update(key, nodes[key] * gtsam.Similarity3.Expmap(sign * h * axis))
                ends.append(factor.unwhitenedError(other))
            slope = (ends[0] - ends[1]) / (2 * h)
            np.testing.assert_allclose(slope, J[:, 7 * key + column], atol=1e-7)
    with pytest.raises(ValueError, match="sigma"):
        metric_step_factor((0, 1), sigma=0.0, step=np.zeros(3))


@pytest.mark.parametrize("which", ["both", "depth", "dead reckoning"])
def test_the_vehicle_tells_scale_and_vertical_without_any_range(which: str) -> None:
    """Within 4 sigma, and sharp: by steps to half a per cent, by depth to two."""
    for seed in (1, 2, 3):
        time, R, t, own = map_of(seed, 120)
        kept = replace(
            own,
            depths=own.depths if which != "dead reckoning" else None,
            dead_reckoning=own.dead_reckoning if which != "depth" else None,
        )
        found = metric_state(hung(kept, time), R, t)
        assert found is not None
        sigma = float(np.sqrt(found.covariance[0, 0]))
        assert abs(found.log_scale - np.log(UNIT_M)) < 4.0 * sigma
        assert sigma < (0.02 if which == "depth" else 0.005)
        true_down = -path_of(seed)[1][0][2]  # world's third axis is up
        assert np.degrees(np.arccos(min(found.down @ true_down, 1.0))) < 1.0


def test_depths_along_a_level_path_tell_nothing() -> None:
    """And the sigma says so."""
    time, R, t, own = map_of(1, 60)
    assert own.depths is not None
    centre = -np.einsum("kji,kj->ki", R, t)
    up = path_of(1)[1][0][2]
    flat = centre - np.outer(centre @ up, up)
    level = replace(
        own,
        dead_reckoning=None,
        depths=replace(
            own.depths,
            depth_m=0 * own.depths.time_s
            + 3.0
            + 0.03 * np.random.default_rng(1).standard_normal(len(own.depths.time_s)),
        ),
    )
    found = metric_state(hung(level, time), R, -np.einsum("kij,kj->ki", R, flat))
    assert found is None or np.sqrt(found.covariance[0, 0]) > 0.04


def test_gross_steps_lose_their_weight_and_do_not_bend_the_scale() -> None:
    """Ten steps without bottom lock, twice too long."""
    time, R, t, own = map_of(4, 120)
    terms = hung(own, time)
    step = terms.step_m.copy()
    step[10:20] *= 2.0  # no bottom lock
    bad = replace(terms, step_m=step)
    found = metric_state(bad, R, t)
    assert found is not None
    assert abs(np.exp(found.log_scale) / UNIT_M - 1.0) < 0.01
    weight = bad.weights(bad.rows(R, t, found).error, np.zeros(len(bad)))
    first = len(bad) - 6 * len(step)
    own_weight = weight[first : first + 3 * len(step) : 3]
    assert own_weight[10:20].max() < 0.1 < 0.5 < np.median(np.delete(own_weight, np.s_[10:20]))


def test_dead_reckoning_holds_the_scale_of_an_adjustment() -> None:
    """A map that shrinks along the way is put right; the posterior of steps is in their weights."""
    time, R, t, own = map_of(5, 12)
    rng = np.random.default_rng(5)
    centre = -np.einsum("kji,kj->ki", R, t)
    points = centre[rng.integers(12, size=150)] + 2.5 * R[0][2] + rng.standard_normal((150, 3))
    pose, point, xy = [], [], []
    for k in range(12):
        x_c = points @ R[k].T + t[k]
        seen = np.flatnonzero((x_c[:, 2] > 0.5) & (np.abs(x_c[:, :2]) < x_c[:, 2:]).all(axis=1))
        pose += [k] * len(seen)
        point += seen.tolist()
        xy += (x_c[seen, :2] / x_c[seen, 2:]).tolist()
    used, point_at = np.unique(point, return_inverse=True)
    scale = np.full((len(xy), 2), 500.0)
    views = sorted_views(np.array(pose), point_at, np.array(xy), scale, len(used))
    shrunk = 1.0 - 0.02 * np.arange(12)
    bent = centre[0] + np.cumsum(np.diff(centre, axis=0, prepend=centre[:1]) * shrunk[:, None], 0)
    state = MetricState(
        float(np.log(UNIT_M)),
        -path_of(5)[1][0][2],
        float(own.depths.depth_m[0]) if own.depths else 0.0,
        np.eye(4),
    )
    terms = BundleMetric(None, hung(own, time), state, 1e-3)
    start = -np.einsum("kij,kj->ki", R, bent)
    free = np.arange(12) > 0
    problem = Problem(R, start, free, points[used], views, terms)
    found = adjust(problem, Effort(steps=15, posterior_from=8))
    ends = -np.einsum("kji,kj->ki", found.R_cw, found.t_cw)
    way, wanted = np.linalg.norm(ends[-1] - ends[0]), np.linalg.norm(centre[-1] - centre[0])
    assert abs(way / wanted - 1.0) < 0.01
    before = np.linalg.norm(bent[-1] - bent[0])
    assert abs(before / wanted - 1.0) > 0.05
    assert len(found.further_weight) == len(terms.terms)


def frames_of(time: Array, R: Array, t: Array) -> FramePoses:
    """Return all frames as key frames."""
    return FramePoses(time, R, t, np.arange(len(time)))


def test_sound_speed_is_told_apart_from_the_scale_by_dead_reckoning_alone() -> None:
    """Ranges 2 % too long: without the vehicle it is in the scale, with it in the sound speed."""
    time, R, t, own = map_of(6, 160)
    path = bottom_path(6)
    faults = RangeFaults(rate_hz=2.0, sigma_m=0.05, bias_m=0.0, sound_speed_m_per_s=1500.0 / 1.02)
    anchors = np.array([[9.0, -7.0, 0.6]])
    raw, _, _ = simulated_ranges(faults, path.place, anchors, (0.0, float(time[-1])), 6)
    ranges, _ = at_the_anchor(raw, 1500.0)
    alone = Metric(ranges, np.zeros(3), Vehicle(range_scale_share=0.02))
    alone.update(frames_of(time, R, t), R, t, time)
    result = alone.result()
    assert result.has_scale
    assert abs(result.scale / UNIT_M - 1.02) < 0.01
    assert result.sigma_log_scale > 0.019
    assert any("sound speed" in reason for reason in result.reasons)
    both = Metric(ranges, np.zeros(3), replace(own, range_scale_share=0.02))
    both.update(frames_of(time, R, t), R, t, time)
    result = both.result()
    assert abs(result.scale / UNIT_M - 1.0) < 0.005
    assert result.vehicle is not None
    assert abs(result.vehicle.range_unit - 1.02) < 3.0 * result.vehicle.range_unit_sigma < 0.03
    assert result.state in (StartState.READY, StartState.MIRROR)
    true = (anchors[0] - path_of(6)[2][0]) @ path_of(6)[1][0]
    assert np.linalg.norm(result.anchors[0].place_m - true) < 0.4


@pytest.mark.parametrize(("factor", "told"), [(1.0, ""), (1.1, "above"), (0.9, "below")])
def test_a_dvl_that_the_only_anchor_contradicts_is_told(factor: float, told: str) -> None:
    """The anchor's place could take the wrong scale up: the ranges alone speak against it."""
    time, R, t, own = map_of(21, 120)
    path, reckoning = bottom_path(21), own.dead_reckoning
    assert reckoning is not None
    wrong = replace(reckoning, position_m=factor * reckoning.position_m)
    faults = RangeFaults(rate_hz=1.0, sigma_m=0.1, sound_speed_m_per_s=1485.0)
    anchors = np.array([[9.0, -7.0, 1.8]])
    raw, _, _ = simulated_ranges(faults, path.place, anchors, (0.0, float(time[-1])), 21)
    vehicle = Vehicle(dead_reckoning=wrong, range_scale_share=0.01)
    metric = Metric(at_the_anchor(raw, 1500.0)[0], np.zeros(3), vehicle)
    metric.update(frames_of(time, R, t), R, t, time)
    result = metric.result()
    assert result.has_scale
    assert result.vehicle is not None
    said = result.vehicle.contradiction
    assert bool(said) == bool(told)
    if told:
        assert f"% {told} that of the ranges to anchor A0 alone" in said
        assert "dead reckoning (DVL)" in said


def test_ranges_that_contradict_themselves_are_left_out_and_told() -> None:
    """The vehicle's scale is right without them, and yet the answer is not called sound."""
    time, R, t, own = map_of(6, 160)
    path, made = bottom_path(6), []
    faults = RangeFaults(rate_hz=4.0, sigma_m=0.05, bias_m=0.0, sound_speed_m_per_s=1500.0)
    for anchor in ([9.0, -7.0, 0.6], [-9.0, 17.0, 0.6]):
        raw, _, _ = simulated_ranges(
            faults, path.place, np.array([anchor]), (0.0, float(time[-1])), 6
        )
        made.append(at_the_anchor(raw, 1500.0)[0])
    half = np.searchsorted(made[0].time_s, time[-1] / 2.0)
    both = [made[0].range_m[:half], made[1].range_m[half : len(made[0])]]
    metric = Metric(replace(made[0], range_m=np.concatenate(both)), np.zeros(3), own)
    metric.update(frames_of(time, R, t), R, t, time)
    result = metric.result()
    assert result.state is StartState.WITHOUT_RANGES
    assert abs(result.scale / UNIT_M - 1.0) < 0.005


def test_a_depth_is_known_no_better_than_the_density_of_water() -> None:
    """Fresh water read as sea water: the scale by depth alone is 2.5 % off, within its sigma."""
    time, R, t, own = map_of(1, 120)
    assert own.depths is not None
    salty = replace(own.depths, depth_m=own.depths.depth_m / 1.025, scale_share=0.03)
    metric = Metric(screened_ranges([], [], []), np.zeros(3), Vehicle(salty))
    metric.update(frames_of(time, R, t), R, t, time)
    result = metric.result()
    assert result.state is StartState.COARSE
    assert 0.01 < 1.0 - result.scale / UNIT_M < 1.5 * result.sigma_log_scale


def test_two_way_ranges_are_those_of_the_middle_of_both_legs() -> None:
    """The vehicle moves between ping and reply; half of both legs is the range in between."""
    faults = RangeFaults(
        rate_hz=2.0, sigma_m=1e-9, bias_m=0.0, sound_speed_m_per_s=1500.0, occlusion=False
    )
    anchors = np.array([[400.0, 100.0, -30.0]])

    def antenna(time: Array) -> Array:
        return np.stack([2.0 * time, 3.0 * np.ones_like(time), -time], axis=1)

    raw, _, _ = simulated_ranges(faults, antenna, anchors, (0.0, 20.0), 0)
    ranges, order = at_the_anchor(raw, 1500.0)
    true = np.linalg.norm(antenna(ranges.time_s) - anchors[0], axis=1)
    assert np.abs(ranges.range_m - true).max() < 1e-3
    stamped = np.linalg.norm(antenna(raw.time_s[order]) - anchors[0], axis=1)
    assert np.abs(ranges.range_m - stamped).max() > 0.3
    with pytest.raises(DataError, match="sound speed"):
        at_the_anchor(raw, 0.0)


def test_a_run_under_water_is_written_and_read_as_it_is(tmp_path: Path) -> None:
    """Depth, dead reckoning and how well the sound speed is known; two-way ranges are moved."""
    asked = replace(under_water(3, 1.0), camera=SMALL_CAMERA, texel_m=0.1, n_anchors=2)
    sequence = simulate(asked).sequence
    sequence = replace(sequence, time_s=sequence.time_s[:3])
    assert len([*write_own_folder(tmp_path, sequence)]) == 3
    back = read_own_folder(tmp_path, ReadOptions())
    one, two = sequence.vehicle, back.vehicle
    assert one.depths is not None
    assert two.depths is not None
    assert one.dead_reckoning is not None
    assert two.dead_reckoning is not None
    np.testing.assert_allclose(two.depths.depth_m, one.depths.depth_m, atol=1e-8)
    for name in ("position_m", "step_m", "turn_rad", "tilt_rad", "scale_share"):
        wanted = getattr(one.dead_reckoning, name)
        np.testing.assert_allclose(getattr(two.dead_reckoning, name), wanted, atol=1e-8)
    same = np.abs(np.sum(two.dead_reckoning.quaternion * one.dead_reckoning.quaternion, axis=1))
    np.testing.assert_allclose(same, 1.0, atol=1e-8)
    assert two.range_scale_share == pytest.approx(0.01)
    first = back.images(0)
    assert (first != back.images(2)).mean() > 0.3  # it moves, and snow is elsewhere
    toml = tmp_path / "visual.toml"
    text = toml.read_text()
    toml.write_text(text.replace("[ranges]\n", '[ranges]\ntravel = "two-way"\n'))
    shifted = read_own_folder(tmp_path, ReadOptions()).ranges
    early = back.ranges.time_s - back.ranges.range_m / 1500.0
    np.testing.assert_allclose(shifted.time_s, np.sort(early), atol=1e-9)
    toml.write_text(text.replace("[ranges]\n", '[ranges]\ntravel = "both"\n'))
    with pytest.raises(ConfigError, match="two-way"):
        read_own_folder(tmp_path, ReadOptions())


def test_nothing_measured_gives_no_terms() -> None:
    """A camera in the hand."""
    terms = hung(Vehicle(), np.arange(5.0))
    assert isinstance(terms, VehicleTerms)
    assert len(terms) == 0
    assert metric_state(terms, np.tile(np.eye(3), (5, 1, 1)), np.zeros((5, 3))) is None
    none = Metric(screened_ranges([], [], []), np.zeros(3))
    assert not none.has_scale
