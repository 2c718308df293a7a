"""Further aids from a mission to its answer: keyframes, weights, beacons, doubts, and no trace."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest

from factors.kernels import HuberKernel, TruncatedKernel
from factors.similarity import ExpKernel, LogKernel, Similarity
from ssm_graph.base.errors import ConfigError, DataError
from ssm_graph.engine.reweighting import Graduation
from ssm_graph.filters.navigation.named import filter_problems
from ssm_graph.graph.aids.heading import Headings
from ssm_graph.graph.aids.ranges import Ranges
from ssm_graph.graph.aids.standstill import Standstills
from ssm_graph.graph.aids.usbl import UsblFixes
from ssm_graph.graph.beacon_start import BeaconRanges, beacon_start, rival_place
from ssm_graph.graph.first_values import first_values
from ssm_graph.graph.first_weights import settled_weights
from ssm_graph.graph.gtsam_graph import gtsam_graph
from ssm_graph.mission.estimate import Determined, Status
from ssm_graph.mission.mission import Aids
from ssm_graph.mission.problem import build_problem
from ssm_graph.sensors.acoustic import RangeLog, UsblLog
from ssm_graph.sensors.compass import HeadingLog
from ssm_graph.sensors.standstill import Standstill
from ssm_graph.simulation import (
    CALM,
    AidSettings,
    BeaconSettings,
    GrossErrors,
    HoverRoute,
    SimulatedMission,
    TransitRoute,
)
from ssm_graph.smoothers.batch import SmootherConfig, SsmSmoother, warm_start
from ssm_graph.smoothers.beam_faults import FaultSearch
from tests.aids_fixture import UNKNOWN, compass, ranging, usbl, weights_of, with_every_aid
from tests.helpers import simulated

KERNEL = LogKernel()


def test_fixes_and_ranges_have_keyframes_of_when_they_were_valid() -> None:
    """Between the pings; a fix that came late goes back to its time."""
    sim = with_every_aid()
    problem, aids = build_problem(sim.mission), sim.mission.aids
    fixes, ranges = problem.aid(UsblFixes), problem.aid(Ranges)
    assert fixes is not None
    assert ranges is not None
    np.testing.assert_allclose(problem.keyframe_s[fixes.keyframe], aids[UsblLog].valid_s)
    np.testing.assert_allclose(problem.keyframe_s[ranges.keyframe], aids[RangeLog].time_s)
    assert aids[UsblLog].valid_s[0] == pytest.approx(aids[UsblLog].time_s[0] - 1.5)
    numbers = ranges.number[ranges.beacon]
    np.testing.assert_array_equal(numbers, aids[RangeLog].beacon)


def test_what_lies_outside_is_left_out_and_said() -> None:
    """Fixes that were valid before the start."""
    sim = simulated(aids=usbl(delay_s=0.0, interval_s=2.0))
    log = sim.mission.aids[UsblLog]
    late = replace(log, delay_s=np.where(np.arange(len(log.time_s)) < 3, 100.0, 0.0))
    problem = build_problem(replace(sim.mission, aids=Aids(late)))
    fixes = problem.aid(UsblFixes)
    assert fixes is not None
    assert len(fixes) == len(log.time_s) - 3
    assert any("3 USBL fixes outside" in note for note in problem.notes)


def test_an_aid_without_a_measurement_in_the_mission_is_none() -> None:
    """Each kind beside another one, and all of them together."""
    sim = with_every_aid()
    aids = sim.mission.aids
    fixes, ranges, heading = (
        replace(aids[UsblLog], time_s=aids[UsblLog].time_s + 1e3),
        replace(aids[RangeLog], time_s=aids[RangeLog].time_s + 1e3),
        replace(aids[HeadingLog], time_s=aids[HeadingLog].time_s + 1e3),
    )
    still = Standstill(1e3, 2e3)
    late = Aids(fixes, ranges, heading, still)
    for logs in (
        aids.having(still).having(fixes),
        aids.having(still).having(ranges).having(heading),
        late,
    ):
        estimate = SsmSmoother().solve(build_problem(replace(sim.mission, aids=logs)))
        assert estimate.status is Status.CONVERGED
        assert estimate.aids is not None
        assert (set(estimate.aids.aid) == {"depth"}) == (logs is late)


def test_a_keyframe_has_one_heading_led_to_it_by_the_gyros() -> None:
    """At a quarter of a second from its reading, in a turn, and without noise, to 1e-4 rad."""
    sim = simulated(perfect_sensors=True, aids=compass(rate_hz=2.0), route=HoverRoute())
    shifted = sim.mission.aids[HeadingLog]
    shifted = replace(shifted, time_s=shifted.time_s + 0.25)  # its readings are of 0.25 s before
    headings = build_problem(replace(sim.mission, aids=Aids(shifted))).aid(Headings)
    assert headings is not None
    assert len(np.unique(headings.keyframe)) == len(headings.keyframe)
    problem = build_problem(sim.mission)
    led = problem.aid(Headings)
    assert led is not None
    assert len(led.keyframe) >= problem.n_keyframes - 1
    turn = np.arccos(0.5 * (np.trace(headings.R_back, axis1=1, axis2=2) - 1.0))
    assert 1e-4 < np.median(turn) < 0.05


def test_the_vehicle_stands_still_at_every_keyframe_of_a_standstill() -> None:
    """Where two overlap the stricter one counts."""
    sim = simulated()
    stills = (Standstill(3.0, 8.0), Standstill(6.0, 9.5, sigma=0.01))
    problem = build_problem(replace(sim.mission, aids=Aids(*stills)))
    further = problem.aid(Standstills)
    assert further is not None
    time_s = problem.keyframe_s[further.keyframe]
    assert (time_s >= 3.0).all()
    assert (time_s <= 9.5).all()
    np.testing.assert_array_equal(further.sigma, np.where(time_s >= 6.0, 0.01, 0.05))


def test_first_weights_are_those_of_the_posterior() -> None:
    """Of its mean and of its covariance, here in information form; a fix beside two ranges."""
    rng = np.random.default_rng(4)
    root = rng.standard_normal((5, 5))
    predicted, innovation = 2.0 * root @ root.T, np.array([1.0, -0.5, 0.3, 2.0, -6.0])
    measurement = np.array([0, 0, 0, 1, 2])
    weights = settled_weights(innovation, predicted, measurement, KERNEL)
    information = np.diag(weights[measurement])
    covariance = np.linalg.inv(np.linalg.inv(predicted) + information)
    left = innovation - covariance @ information @ innovation
    t = np.bincount(measurement, weights=left**2 + covariance.diagonal())
    np.testing.assert_allclose(weights, KERNEL.weight(t, dim=np.array([3.0, 1.0, 1.0])), atol=0.02)


@pytest.mark.parametrize("dim", [1, 3])
def test_first_weights_begin_at_the_gate(dim: int) -> None:
    """A vague prediction agrees with all that it can mean, and with nothing beyond."""
    predicted, first = 100.0 * np.eye(dim), np.eye(dim)[-1] * np.sqrt(101.0)
    within, beyond = (
        settled_weights(far * first, predicted, np.zeros(dim, np.intp), KERNEL)
        for far in (4.99, 5.01)
    )
    assert within > 0.9
    assert beyond < 0.01


@pytest.mark.parametrize("order", list(itertools.permutations(range(3))))
def test_measurements_of_one_keyframe_judge_each_other(order: tuple[int, ...]) -> None:
    """A gross one that is alone within reach of the prediction loses, whichever comes first."""
    innovation = np.array([0.3, -0.2, 30.0])[list(order)]
    weights = settled_weights(innovation, np.full((3, 3), 1e4), np.arange(3), KERNEL)
    gross = weights[np.argmax(innovation)]
    assert gross < 0.01
    assert np.delete(weights, np.argmax(innovation)).min() > 0.9


@pytest.mark.parametrize("order", [(0, 1, 2, 3), (2, 3, 1, 0)])
@pytest.mark.parametrize("n_gross", [0, 1])
def test_ranges_of_one_keyframe_find_a_start_that_is_off(
    order: tuple[int, ...], n_gross: int
) -> None:
    """By 25 m, as its sigmas say; exact ranges to four beacons around, and one that is an echo."""
    around = [(300.0, 0.0, -50.0), (0.0, 300.0, -50.0), (-300.0, 0.0, -50.0), (0.0, -300.0, -50.0)]
    known = tuple(BeaconSettings(number + 1, enu) for number, enu in enumerate(around))
    sim = simulated(duration_s=10.0, aids=ranging(*known), gnss=None)
    mission, frame = sim.mission, sim.mission.frame
    log, start = mission.aids[RangeLog], mission.initial
    assert start is not None
    at_s, beacons = 5.0, [log.beacons[i] for i in order]
    truth = sim.truth_at(np.array([at_s]))
    place_n = frame.p_n_from_geodetic(truth.lat, truth.lon, truth.height)[0]
    beacon_n = np.array([frame.p_n_from_geodetic(b.lat, b.lon, b.height) for b in beacons])
    distance = np.linalg.norm(beacon_n - place_n, axis=1) + np.array([35.0 * n_gross, 0, 0, 0])
    ranges = RangeLog(
        log.beacons,
        np.full(4, at_s),
        np.array([float(b.number) for b in beacons]),
        distance,
        np.full(4, 0.3),
        np.zeros(3),
    )
    start_n = frame.p_n_from_geodetic(start.lat, start.lon, start.height)
    start_n = start_n + np.array([20.0, -15.0, 0.0])
    lat, lon, height = (float(x) for x in frame.geodetic_from_p_n(start_n))
    sigma_enu = np.array([20.0, 20.0, 1.0])
    off = replace(start, lat=lat, lon=lon, height=height, position_sigma_enu=sigma_enu)
    problem = build_problem(replace(mission, aids=Aids(ranges)), start=off)
    first = first_values(problem, kernel=KERNEL)
    met = problem.aid(Ranges)
    assert met is not None
    (k,) = np.unique(met.keyframe)
    assert np.linalg.norm((first.states.p_n[k] - place_n)[:2]) < 0.5
    weights = first.aid_weights[-4:]
    assert weights[n_gross:].min() > 0.8
    assert np.all(weights[:n_gross] < 0.01)


def circle(n: int = 200) -> np.ndarray:
    """Return a track once around, 60 m wide, at one depth."""
    angle = np.linspace(0.0, 2.0 * np.pi, n)
    return np.stack([30.0 * np.cos(angle), 30.0 * np.sin(angle), np.full(n, 5.0)], axis=1)


def test_a_beacon_is_found_from_ranges_along_a_turning_track() -> None:
    """Thrice its prior sigma off, with every fifth range an echo."""
    rng, track, place = np.random.default_rng(2), circle(), np.array([120.0, -80.0, -12.0])
    ranges = np.linalg.norm(track - place, axis=1) + 0.2 * rng.standard_normal(len(track))
    ranges[::5] += rng.uniform(5.0, 60.0, len(ranges[::5]))
    heard = BeaconRanges(
        "beacon_1", track, ranges, np.full(len(track), 0.2), np.array([60.0, 60.0, 6.0])
    )
    found, weights = beacon_start(heard)
    np.testing.assert_allclose(found[:2], place[:2], atol=2.0)
    assert weights[::5].max() < 0.2
    assert np.median(np.delete(weights, np.s_[::5])) > 0.8
    assert rival_place(heard, found, apart_m=0.0) is None


def test_a_straight_track_leaves_two_places() -> None:
    """Ranges along a line cannot tell one side of it from the other, and this is said."""
    track = np.stack([np.linspace(-100.0, 100.0, 100), *np.zeros((2, 100))], axis=1)
    ranges = np.linalg.norm(track - np.array([10.0, 50.0, 0.0]), axis=1)
    heard = BeaconRanges("beacon_1", track, ranges, np.full(100, 0.3), np.array([60.0, 60.0, 2.0]))
    found, _ = beacon_start(heard)
    rival = rival_place(heard, found, apart_m=5.0)
    assert rival is not None
    np.testing.assert_allclose(np.abs([found[1], rival[1]]), 50.0, atol=3.0)
    assert found[1] * rival[1] < 0.0
    assert rival_place(heard, found, apart_m=200.0) is None


def test_an_answer_with_a_beacon_on_either_side_is_suspect() -> None:
    """After a straight run past it."""
    beacon = BeaconSettings(5, (150.0, 200.0, -45.0), (20.0, -20.0, 1.0), (80.0, 80.0, 3.0))
    sim = simulated(duration_s=200.0, route=TransitRoute(), aids=ranging(beacon, interval_s=2.0))
    estimate = SsmSmoother().solve(build_problem(sim.mission))
    assert estimate.status is Status.SUSPECT
    assert "beacon_5 may as well be" in estimate.reason


def test_the_smoother_starts_an_unknown_beacon_near_its_place() -> None:
    """Within some metres, before the first iteration."""
    sim = simulated(duration_s=300.0, aids=ranging(UNKNOWN, rate=0.1))
    problem = build_problem(sim.mission)
    first = first_values(problem, kernel=KERNEL)
    np.testing.assert_allclose(first.states.constants, -np.array(UNKNOWN.stated_off), atol=8.0)
    gross = sim.aids.gross["ranges"]
    assert first.aid_weights[-len(gross) :][gross].max() < 0.3


def outliers(sim: SimulatedMission, section: str, name: str) -> tuple[Status, np.ndarray]:
    """Return how the smoother ended, and the weights of gross errors and of good readings."""
    estimate = SsmSmoother().solve(build_problem(sim.mission))
    assert estimate.aids is not None
    assert set(estimate.aids.aid) == {"depth", name}
    weight, gross = weights_of(estimate.aids, name), sim.aids.gross[section]
    assert len(weight) == len(gross)
    assert weight[gross].max() < 0.15
    assert np.median(weight[~gross]) > 0.8
    return estimate.status, weight


def test_gross_fixes_and_ranges_lose_their_weight() -> None:
    """One in five, and the good ones keep theirs."""
    for settings, section, name in (
        (usbl(0.2, interval_s=2.0), "usbl", "USBL"),
        (ranging(BeaconSettings(1, (80.0, 90.0, -40.0)), rate=0.2), "ranges", "range"),
    ):
        sim = simulated(duration_s=200.0, aids=settings)
        status, _ = outliers(sim, section, name)
        assert status is Status.CONVERGED


@pytest.mark.parametrize(
    "config",
    [
        SmootherConfig(kernel=ExpKernel()),
        SmootherConfig(kernel=HuberKernel()),
        SmootherConfig(kernel=TruncatedKernel(), graduation=Graduation()),
        SmootherConfig(adapt_noise=True, fault_search=FaultSearch()),
    ],
    ids=lambda config: config.weighting,
)
def test_whatever_weighs_the_beams_the_aids_are_robust(config: SmootherConfig) -> None:
    """Kernels that know but one component leave them to the log kernel; all of them settle."""
    sim = simulated(duration_s=100.0, aids=usbl(0.2, interval_s=2.0))
    estimate = SsmSmoother(config).solve(build_problem(sim.mission))
    assert estimate.status is Status.CONVERGED
    assert estimate.aids is not None
    weight = weights_of(estimate.aids, "USBL")
    assert weight[sim.aids.gross["usbl"]].max() < 0.15
    assert np.isfinite(estimate.cost)


def test_a_disturbed_compass_loses_its_weight() -> None:
    """While it is near iron, and no longer."""
    sim = simulated(duration_s=200.0, aids=compass(rate_hz=1.0, gross=GrossErrors(0.2, (0.3, 1.0))))
    estimate = SsmSmoother().solve(build_problem(sim.mission))
    assert estimate.status is Status.CONVERGED
    table, log = estimate.aids, sim.mission.aids.get(HeadingLog)
    assert table is not None
    assert log is not None
    time_s = table.time_s[np.array(table.aid) == "heading"]
    reading = np.argmin(np.abs(log.time_s - time_s[:, None]), axis=1)
    gross = sim.aids.gross["heading"][reading]
    weight = weights_of(table, "heading")
    assert weight[gross].max() < 0.15
    assert np.median(weight[~gross]) > 0.8


def test_what_a_compass_errs_by_is_found_within_its_sigma() -> None:
    """Offset, iron and rate, the heading known from the start; a label and a colour for each."""
    sim = simulated(duration_s=300.0, aids=compass())
    found = SsmSmoother().solve(build_problem(sim.mission)).calibration
    assert found is not None
    truth = dict(
        zip(
            (
                "heading_offset_deg",
                "heading_one_cycle_sine_deg",
                "heading_one_cycle_cosine_deg",
                "heading_two_cycle_sine_deg",
                "heading_two_cycle_cosine_deg",
                "heading_rate_deg_per_h",
            ),
            sim.aids.heading_errors,
            strict=True,
        )
    )
    values = {value.label: value for value in found.values}
    assert set(values) == set(truth)
    for label, true in truth.items():
        assert abs(values[label].value - true) < 3.0 * values[label].sigma, label
    assert values["heading_one_cycle_cosine_deg"].determined is not Determined.RED


def test_an_aid_that_contradicts_the_answer_is_named() -> None:
    """A datum that is 40 m off, and a compass mounted backwards."""
    sim = simulated(duration_s=120.0, aids=usbl(interval_s=2.0), gnss=None)
    log = sim.mission.aids[UsblLog]
    wrong = replace(log, height=log.height + 200.0)
    estimate = SsmSmoother().solve(build_problem(replace(sim.mission, aids=Aids(wrong))))
    assert estimate.status is Status.SUSPECT
    assert "USBL measurements contradict" in estimate.reason
    assert "datum" in estimate.reason
    sim = simulated(duration_s=60.0, aids=compass())
    heading = sim.mission.aids[HeadingLog]
    backwards = replace(heading, heading=heading.heading + np.pi)
    estimate = SsmSmoother().solve(build_problem(replace(sim.mission, aids=Aids(backwards))))
    assert estimate.status is Status.SUSPECT
    assert "heading" in estimate.reason


def test_without_aids_nothing_changes() -> None:
    """The same mission, whether or not its aids are taken away: bit by bit that without them."""
    plain, aided = simulated(), with_every_aid()
    taken = replace(aided.mission, aids=Aids())
    for log in ("imu", "dvl", "depth"):
        for name in ("time_s", "speed", "gyro_b", "depth"):
            if hasattr(getattr(plain.mission, log), name):
                np.testing.assert_array_equal(
                    getattr(getattr(taken, log), name), getattr(getattr(plain.mission, log), name)
                )
    first, second = (SsmSmoother().solve(build_problem(m)) for m in (plain.mission, taken))
    np.testing.assert_array_equal(first.trajectory.lat, second.trajectory.lat)
    np.testing.assert_array_equal(first.beams.weight, second.beams.weight)
    assert first.aids is not None
    assert set(first.aids.aid) == {"depth"}
    assert first.calibration is None
    assert first.notes == second.notes


def test_every_aid_at_once() -> None:
    """They settle together, and a table tells of each."""
    at_rest = with_every_aid(route=HoverRoute(sway_m=0.0), waves=CALM)
    estimate = SsmSmoother().solve(build_problem(at_rest.mission))
    assert estimate.status is Status.CONVERGED, estimate.reason
    assert estimate.aids is not None
    assert set(estimate.aids.aid) == {
        *("depth", "USBL", "range", "heading", "magnetometer", "standstill")
    }
    assert set(estimate.aids.component) == {
        *("x", "y", "z"),
        "east",
        "north",
        "up",
        "depth",
        "heading",
        "beacon_3",
        "beacon_7",
    }


def test_estimators_without_them_say_so() -> None:
    """Filters; GTSAM's own graph refuses what is unknown of them."""
    problem = build_problem(with_every_aid().mission)
    for estimate in filter_problems([problem], "ekf"):
        (note,) = (note for note in estimate.notes if "left out" in note)
        assert "[usbl], [ranges], [heading], [[standstill]]" in note
    with pytest.raises(ConfigError, match="estimates heading_walk"):
        gtsam_graph(problem, warm_start(problem).states)


def test_at_rest_nothing_drifts() -> None:
    """A silent DVL, on deck: the end is ten times nearer than inertial data alone bring it."""
    sim = simulated(
        duration_s=120.0,
        dropout_rate=1.0,
        depth=None,
        route=HoverRoute(sway_m=0.0, yaw=0.0),
        waves=CALM,
        aids=AidSettings(standstills=(Standstill(0.0, 120.0),)),
    )
    apart = []
    for mission in (sim.mission, replace(sim.mission, aids=Aids())):
        estimate = SsmSmoother().solve(build_problem(mission))
        end = estimate.trajectory
        truth = sim.truth_at(end.time_s[-1:])
        apart.append(float(np.hypot(end.lat[-1] - truth.lat[0], end.lon[-1] - truth.lon[0])))
    assert apart[0] < 0.1 * apart[1]


def test_logs_refuse_what_cannot_be() -> None:
    """Ranges to a beacon that nobody stated, and a standstill that ends before it begins."""
    sim = simulated(aids=ranging(UNKNOWN))
    log = sim.mission.aids[RangeLog]
    with pytest.raises(DataError, match="numbers of the beacons"):
        RangeLog(
            beacons=log.beacons,
            time_s=log.time_s,
            beacon=log.beacon + 1.0,
            range_m=log.range_m,
            sigma=log.sigma,
            lever_arm_b=log.lever_arm_b,
        )
    with pytest.raises(DataError, match="before its end"):
        Standstill(2.0, 1.0)
    with pytest.raises(DataError, match="shape"):
        HeadingLog(sigma=0.1, time_s=np.zeros(3), heading=np.zeros(2))


def test_plain_weights_ignore_the_posterior() -> None:
    """A method that judges by the residual alone judges the aids so as well."""
    problem = build_problem(with_every_aid().mission)
    with_, without = (
        SsmSmoother(SmootherConfig(similarity=similarity)).solve(problem).aids
        for similarity in (Similarity.EXPECTED, Similarity.PLAIN)
    )
    assert with_ is not None
    assert without is not None
    assert without.mahalanobis_sq.mean() < with_.mahalanobis_sq.mean()


@pytest.mark.parametrize(
    ("log", "field", "value"),
    [
        ("usbl", "sigma_enu", 0.0),
        ("usbl", "height", np.nan),
        ("usbl", "delay_s", np.inf),
        ("ranges", "range_m", np.nan),
        ("ranges", "sigma", -1.0),
        ("heading", "heading", np.nan),
        ("heading", "time_s", -1.0),
    ],
)
def test_a_value_that_no_smoother_can_use_is_named(log: str, field: str, value: float) -> None:
    """In missions made in Python, which no reader has checked."""
    mission = with_every_aid(duration_s=10.0).mission
    whole = next(aid for aid in mission.aids if f"[{log}]" == aid.SECTION)
    changed = getattr(whole, field).copy()
    changed.flat[-1] = value
    spoilt = replace(cast(Any, whole), **{field: changed})
    with pytest.raises(DataError, match=f"aids.{log}.{field}"):
        build_problem(replace(mission, aids=mission.aids.having(spoilt)))


def test_a_beacon_known_along_one_axis_alone_is_named() -> None:
    """Its prior would be infinitely strong there."""
    mission = simulated(duration_s=10.0, aids=ranging(UNKNOWN)).mission
    log = mission.aids[RangeLog]
    flat = replace(log.beacons[0], position_sigma_enu=np.array([40.0, 40.0, 0.0]))
    with pytest.raises(DataError, match="number 7, position_sigma_enu"):
        build_problem(replace(mission, aids=Aids(replace(log, beacons=(flat,)))))
