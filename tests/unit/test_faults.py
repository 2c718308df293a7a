"""The search for what was off, and when: named, in time, freed; and nothing where nothing is."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ssm_graph.base.errors import ConfigError
from ssm_graph.base.frozen import Array
from ssm_graph.engine.evidence import Evidence
from ssm_graph.engine.extras import Extras
from ssm_graph.graph.beam_rows import BeamRows
from ssm_graph.graph.first_values import first_values
from ssm_graph.graph.freed import FAULTS, Freed, OfArray, array_columns
from ssm_graph.graph.linearize import GraphLinearizer
from ssm_graph.mission.estimate import Estimate, Status
from ssm_graph.mission.fault import DetectedFault, Treatment
from ssm_graph.mission.mission import NO_AIDS, Mission
from ssm_graph.mission.problem import build_problem
from ssm_graph.sensors.dvl import DvlLog
from ssm_graph.simulation import (
    AidSettings,
    CompassSettings,
    DvlSettings,
    Fault,
    FaultShape,
    GnssSettings,
    Grade,
    HoverRoute,
    Loss,
    OutlierKind,
    Outliers,
    SimulatedMission,
    UsblSettings,
    with_faults,
)
from ssm_graph.simulation.faults import Sensor
from ssm_graph.simulation.randomness import gauss_markov
from ssm_graph.smoothers.batch import SmootherConfig, SsmSmoother
from ssm_graph.smoothers.faults.columns import (
    KERNEL,
    beside_median,
    noisier_than_others,
    spike_weights,
)
from ssm_graph.smoothers.faults.grid import Grid
from ssm_graph.smoothers.faults.hypotheses import Course, Hypothesis
from ssm_graph.smoothers.faults.judged import Judged
from ssm_graph.smoothers.faults.search import FaultSearch
from ssm_graph.smoothers.faults.windows import Readings, disagreeing
from ssm_graph.smoothers.mission import smooth
from tests.aids_fixture import with_every_aid
from tests.helpers import simulated, with_initial

SEARCH = SmootherConfig(fault_search=FaultSearch())
QUIET = DvlSettings(noise=0.005)
FIXES = GnssSettings(windows=((0.0, 1e9),))


def smoothed(sim: SimulatedMission, config: SmootherConfig = SEARCH) -> Estimate:
    """Return the estimate of a simulated mission."""
    return SsmSmoother(config).solve(build_problem(sim.mission))


def errors(estimate: Estimate, sim: SimulatedMission) -> tuple[float, float]:
    """Return the horizontal rms, m, and the largest error of position in its sigmas."""
    track, frame = estimate.trajectory, sim.mission.frame
    truth = sim.truth_at(track.time_s)
    off = frame.p_n_from_geodetic(track.lat, track.lon, track.height)
    off -= frame.p_n_from_geodetic(truth.lat, truth.lon, truth.height)
    sigma = np.sqrt(np.diagonal(track.position_cov_enu, axis1=1, axis2=2))
    level = float(np.sqrt(np.mean(off[:, 0] ** 2 + off[:, 1] ** 2)))
    return level, float(np.max(np.abs(off) / sigma))


LIES = {
    "one beam at two sigmas": (Fault((1,), 0.0, math.inf, 0.01), "DVL beam 2"),
    "two beams that agree": (
        Fault((0, 2), 70.0, 150.0, (0.05, -0.05)),
        "DVL beams 1 and 3",
    ),
    "a false bottom": (
        Fault(start_s=60.0, end_s=110.0, shape=FaultShape.MOVING_BOTTOM, size=(0.2, 0.0, 0.0)),
        "DVL",
    ),
    "a scale that jumps": (
        Fault((), 90.0, shape=FaultShape.SCALE, size=1.03),
        "DVL",
    ),
    "a mounting that slips": (
        Fault((), 90.0, shape=FaultShape.SLIP, size=(0.0, 0.0, 0.05)),
        "DVL",
    ),
    "fixes off": (
        Fault(sensor=Sensor.GNSS, start_s=60.0, end_s=140.0, size=(3.0, 0.0, 0.0)),
        "GNSS",
    ),
    "fixes that are pulled": (
        Fault(
            sensor=Sensor.GNSS,
            start_s=60.0,
            end_s=160.0,
            size=(0.0, 0.1, 0.0),
            shape=FaultShape.RAMP,
        ),
        "GNSS",
    ),
    "late fixes": (
        Fault(sensor=Sensor.GNSS, shape=FaultShape.LATE, size=1.0),
        "GNSS",
    ),
    "a depth that is off": (
        Fault(sensor=Sensor.DEPTH, start_s=70.0, end_s=150.0, size=0.5),
        "depth",
    ),
}


QUICK = ("a false bottom", "fixes off", "a depth that is off")  # one of each sensor


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=() if n in QUICK else pytest.mark.slow) for n in LIES]
)
def test_lies_that_last_are_named_and_cost_little(name: str) -> None:
    """Each is the first of all findings, in time to seconds, and is taken off; sigmas hold."""
    fault, sensor = LIES[name]
    gnss = FIXES if fault.sensor is Sensor.GNSS else None
    sim = simulated(duration_s=200.0, dvl=QUIET, gnss=gnss, seed=3)
    broken = with_faults(sim.mission, (fault,), truth=sim.truth_at)
    lying = replace(sim, mission=broken.mission)
    estimate = smoothed(lying)
    assert estimate.status is Status.CONVERGED, estimate.reason
    found = max(estimate.faults, key=lambda one: one.chi_sq)
    assert found.sensor == sensor
    assert found.treatment in {Treatment.FREED, Treatment.COVERED}
    assert found.is_decided  # on a straight way a turned array is one with an offset
    assert abs(found.begin_s - fault.start_s) < 12.0
    assert abs(found.end_s - min(fault.end_s, 200.0)) < 12.0
    assert found.sentence in estimate.notes
    level, sigmas = errors(estimate, sim)
    told = smoothed(replace(sim, mission=broken.told(sim.mission)), SmootherConfig())
    assert level < 1.3 * errors(told, sim)[0]
    assert sigmas < 5.0


@pytest.mark.parametrize("grade", [Grade.NAVIGATION, Grade.TACTICAL])
def test_what_cannot_be_decided_is_covered_and_said(grade: Grade) -> None:
    """A bottom that drifts from half time on, or one that drifted until then."""
    sim = simulated(duration_s=200.0, dvl=QUIET, grade=grade, seed=4)
    fault = Fault(start_s=100.0, shape=FaultShape.MOVING_BOTTOM, size=(0.1, 0.0, 0.0))
    broken = with_faults(sim.mission, (fault,), truth=sim.truth_at)
    estimate = smoothed(replace(sim, mission=broken.mission))
    assert errors(estimate, sim)[1] < 5.0
    assert any(found.sensor == "DVL" for found in estimate.faults)
    assert (estimate.status is Status.SUSPECT) == any(one.is_suspect for one in estimate.faults)


@pytest.mark.parametrize(
    ("rate", "treatment"), [(0.004, Treatment.FREED), (0.0018, Treatment.ALLOWED)]
)
def test_a_slow_drift_of_depth_is_covered_whenever_it_began(
    rate: float, treatment: Treatment
) -> None:
    """Rates in m/s, one to be told, one too small for that: right answers, and not suspect."""
    sim = simulated(duration_s=200.0, dvl=QUIET, seed=3)
    fault = Fault(sensor=Sensor.DEPTH, shape=FaultShape.RAMP, start_s=40.0, size=rate)
    broken = with_faults(sim.mission, (fault,), truth=sim.truth_at)
    estimate = smoothed(replace(sim, mission=broken.mission))
    (found,) = estimate.faults
    assert (found.sensor, found.treatment) == ("depth", treatment)
    assert estimate.status is Status.CONVERGED
    assert errors(estimate, sim)[1] < 4.0


@pytest.mark.parametrize(("grade", "jump"), [(Grade.NAVIGATION, 0.6), (Grade.TACTICAL, 0.1)])
def test_a_gyro_that_jumps_is_named(grade: Grade, jump: float) -> None:
    """Between keyframes, by deg/s: one that no pass follows, one like a push aside; sigmas hold."""
    fault = Fault(sensor=Sensor.GYROS, start_s=80.4, size=math.radians(jump), axes=(2,))
    sim = simulated(duration_s=200.0, dvl=QUIET, grade=grade, seed=3)
    broken = with_faults(sim.mission, (fault,), truth=sim.truth_at)
    estimate = smoothed(replace(sim, mission=broken.mission))
    found = max(estimate.faults, key=lambda one: one.treatment.is_blame)
    assert found.sensor == "gyros"
    assert abs(found.begin_s - fault.start_s) < 12.0
    assert (estimate.status is Status.SUSPECT) == bool(found.rivals)
    assert errors(estimate, sim)[1] < 5.0


@pytest.mark.slow
def test_nothing_is_found_with_realistic_instruments() -> None:
    """Slow noise, heavy tails, scale factors and misalignments are nobody's fault once stated."""
    for seed in (1, 2):
        sim = simulated(
            duration_s=200.0,
            imu_rate_hz=50.0,
            gnss=FIXES,
            realistic=True,
            calibrates=True,
            seed=seed,
        )
        assert not smoothed(sim).faults


def test_what_instruments_do_not_state_is_named_and_allowed_for() -> None:
    """Realistic ones that state white noise alone: what to write is right to a factor of two."""
    sim = simulated(
        duration_s=200.0, imu_rate_hz=50.0, dvl=QUIET, gnss=FIXES, realistic=True, seed=1
    )
    estimate = smoothed(sim)
    assert not any(one.treatment.is_harmless and one.treatment.is_blame for one in estimate.faults)
    widened = (one for one in estimate.faults if one.treatment is Treatment.WIDENED)
    (imu,) = (one for one in widened if one.sensor == "IMU")
    stated = float(imu.remedy.split("accel_bias_instability_ug = ")[1].split(",")[0])
    assert 5.0 <= stated <= 20.0  # 10 is true
    assert estimate.status is Status.CONVERGED or imu.remedy in estimate.reason
    assert errors(estimate, sim)[1] < 5.0


def test_a_beam_noisier_than_the_others_is_named() -> None:
    """Three in ten of its pings two to five sigmas high, which each by itself may be."""
    sim = simulated(duration_s=200.0, dvl=QUIET, seed=3)
    fault = Fault((2,), shape=FaultShape.SPIKES, share=0.3, size=(2.0, 5.0))
    broken = with_faults(sim.mission, (fault,), truth=sim.truth_at)
    estimate = smoothed(replace(sim, mission=broken.mission))
    (found,) = estimate.faults
    assert found.sensor == "DVL beam 3"
    assert "times as much as the others" in found.what
    assert errors(estimate, sim)[1] < 5.0


@pytest.mark.slow
@pytest.mark.parametrize("sensor", [Sensor.DVL, Sensor.GNSS, Sensor.DEPTH])
def test_noise_that_rises_for_a_while_is_no_row_of_faults(sensor: Sensor) -> None:
    """Five times as stated for two minutes: nothing is taken off, and nothing lost."""
    sim = simulated(duration_s=300.0, dvl=QUIET, gnss=FIXES, seed=5)
    beams = (1,) if sensor is Sensor.DVL else ()
    fault = Fault(beams, 80.0, 200.0, shape=FaultShape.NOISE, sensor=sensor, size=5.0)
    broken = with_faults(sim.mission, (fault,), truth=sim.truth_at, seed=1)
    estimate = smoothed(replace(sim, mission=broken.mission))
    taken_off = {Treatment.FREED, Treatment.LEFT_OUT, Treatment.COVERED}
    assert not [found for found in estimate.faults if found.treatment in taken_off]
    assert errors(estimate, sim)[1] < 5.0


def test_the_search_goes_with_calibration() -> None:
    """Extra variables take part with their priors while stretches are judged."""
    sim = simulated(duration_s=140.0, faults=(Fault((2,), 40.0, 100.0, 0.03),))
    dvl = sim.mission.dvl
    asking = replace(dvl, mount=replace(dvl.mount, scale_sigma=0.02))
    estimate = SsmSmoother(SEARCH).solve(build_problem(replace(sim.mission, dvl=asking)))
    assert estimate.calibration
    assert [value.variable for value in estimate.calibration.values] == ["dvl_scale"]
    (found,) = estimate.faults
    assert found.sensor == "DVL beam 3"


@pytest.mark.slow
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
        faults=(Fault((2,), 0.0, 200.0, 0.03),),
        aids=aids,
        seed=1,
    )
    start = with_initial(sim.mission, velocity_sigma_enu=np.full(3, 1.0))
    (found,) = smoothed(replace(sim, mission=start)).faults
    assert found.sensor == "DVL beam 3"
    (alone,) = smoothed(replace(sim, mission=replace(start, aids=NO_AIDS))).faults
    assert found.chi_sq > 1.2 * alone.chi_sq


def test_errors_of_aids_are_carried_along() -> None:
    """Those of a compass and the place of a beacon too; but it moves where it is said to rest."""
    (found,) = smoothed(with_every_aid(duration_s=60.0)).faults
    assert found.sensor == "standstill"


@pytest.mark.parametrize(
    "outliers",
    [Outliers(), Outliers(OutlierKind.SPARSE, 0.1), Outliers(OutlierKind.ONE_BEAM, 0.3)],
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
    assert {found.sensor for found in estimate.faults} <= {"DVL"}


def test_columns_of_the_array_are_the_change_of_the_speeds() -> None:
    """Against the linearised beams: scale as the speed itself, angles as a turn of the body."""
    problem = build_problem(simulated(perfect_sensors=True, duration_s=20.0).mission)
    states = first_values(problem, kernel=KERNEL).states
    columns = array_columns(problem, states, problem.beams.beam_b)
    rows = GraphLinearizer(problem).beam_rows(states)
    speed = problem.beams.speed + rows.error
    np.testing.assert_allclose(columns[:, 0], speed, atol=1e-3)
    # With the body, or in it: the beams turn; what the lever arm adds turns with the body alone.
    lever_b = np.cross(problem.beams.gyro_b, problem.beams.lever_arm_b)
    of_body = rows.jacobian[:, :3] + np.cross(problem.beams.beam_b, lever_b)
    np.testing.assert_allclose(columns[:, 1:], of_body, atol=1e-3)


@pytest.mark.parametrize("scale", [0.04, -1.0])
def test_a_turn_and_a_scale_of_the_array_are_taken_off_whole(scale: float) -> None:
    """The beams of a turned instrument, 7 deg and 4 %, or zeros; derivatives by differences."""
    problem = build_problem(simulated(perfect_sensors=True, duration_s=20.0).mission)
    beams = problem.beams
    inside = beams.keyframe >= 8
    array = (
        OfArray(inside, slice(0, 3), np.eye(4)[:, 1:]),
        OfArray(inside, slice(3, 4), np.eye(4)[:, :1]),
    )
    none = Freed.nothing(problem).with_between(
        np.ones(4), np.zeros((problem.n_keyframes - 1, 15, 4))
    )
    freed = replace(none, array=array)
    problem = replace(problem, extras=Extras((*problem.extras.blocks, freed.variable)))
    states = first_values(problem, kernel=KERNEL).states
    off_by = np.array([0.05, -0.02, 0.12, scale])

    def rows_at(off_by: Array) -> BeamRows:
        return GraphLinearizer(problem, freed).beam_rows(states._replace(constants=off_by))

    turned_b = (1.0 + scale) * beams.beam_b @ Rotation.from_rotvec(off_by[:3]).as_matrix().T
    moved = replace(problem, beams=replace(beams, beam_b=turned_b))
    as_held = GraphLinearizer(moved, none).beam_rows(states._replace(constants=np.zeros(4)))
    as_stated = rows_at(np.zeros(4))
    expected = np.where(inside, as_held.error, as_stated.error)
    np.testing.assert_allclose(rows_at(off_by).error, expected, rtol=0.0, atol=1e-12)
    columns = rows_at(off_by).jacobian[:, problem.extras.columns(FAULTS)]
    for i, step in enumerate(1e-6 * np.eye(4)):
        difference = (rows_at(off_by + step).error - rows_at(off_by - step).error) / 2e-6
        np.testing.assert_allclose(columns[:, i], difference, atol=1e-3)


def test_readings_weigh_less_while_they_scatter_more() -> None:
    """Five times the noise for 150 of 600 readings, with spikes and an offset that stays."""
    rng = np.random.default_rng(3)
    whitened = rng.normal(size=(600, 2))
    whitened[200:350] *= 5.0
    whitened[::37] += 20.0
    whitened[400:] += 3.0
    weights = spike_weights(whitened)
    sound = np.arange(600) % 37 != 0
    inside = sound & (np.arange(600) >= 215) & (np.arange(600) < 335)
    outside = sound & ((np.arange(600) < 170) | (np.arange(600) >= 380))
    assert 0.5 / 25.0 < np.median(weights[inside]) < 2.0 / 25.0
    assert np.median(weights[outside]) > 0.6
    assert weights[~sound].max() < 0.1


class OneChannel:
    """Three columns of one sensor, as the search asks for them."""

    width = 3
    columns = slice(0, 3)
    rates = None

    def of(self, name: str) -> OneChannel:
        """Return the only one."""
        assert name == "any"
        return self


@pytest.mark.parametrize("course", Course)
def test_chi_square_of_every_stretch(course: Course) -> None:
    """Against least squares of its columns, stretch by stretch."""
    rng = np.random.default_rng(2)
    columns, noise = rng.normal(size=(90, 15)), rng.normal(size=90)
    evidence = Evidence(columns.T @ noise, columns.T @ columns)
    grid = Grid.of(np.arange(50.0), [10.0, 20.0, 30.0, 40.0])
    combined = rng.normal(size=(3, 2))
    sigma = np.array([3.0, 5.0])
    hypothesis = Hypothesis("any", "any", combined, sigma, str, course)
    judged = Judged(evidence, grid, OneChannel())  # type: ignore[arg-type]
    table, _ = judged.table(hypothesis)
    middle = np.array([0.05, 0.15, 0.25, 0.35, 0.445])
    by_block = columns.reshape(90, 5, 3) @ combined
    for begin in range(5):
        for end in range(begin + 1, 6):
            own = by_block[:, begin:end]
            since = np.arange(begin, end) / 10.0
            own = {
                Course.CONSTANT: own.sum(axis=1),
                Course.TREND: np.hstack([own.sum(axis=1), np.einsum("rbd,b->rd", own, since)]),
                Course.RAMP: np.einsum("rbd,b->rd", own, middle[begin:end] - since[0]),
                Course.ANYTHING: own.reshape(90, -1),
            }[course]
            prior = np.diag(np.tile(sigma**-2.0, own.shape[1] // 2))
            fitted = np.linalg.solve(own.T @ own + prior, own.T @ noise)
            assert table[begin, end] == pytest.approx(noise @ own @ fitted, rel=2e-2)


def test_what_the_last_look_changes_is_said() -> None:
    """One look that finds something has not settled."""
    sim, mission = _depth_off()
    estimate = smoothed(
        replace(sim, mission=mission), SmootherConfig(fault_search=FaultSearch(most_looks=1))
    )
    assert estimate.status is Status.SUSPECT
    assert [one.treatment for one in estimate.faults] == [Treatment.CHANGING]
    assert estimate.reason.startswith("depth, ")


def test_a_unit_that_is_wrong_leaves_few_looks(monkeypatch: pytest.MonkeyPatch) -> None:
    """No stretch explains it; a clock is taken off like others."""
    unit = DetectedFault("gyros", "reads 0.60 of the turn", 0.0, 120.0, 99.0, 1, Treatment.SAID)
    monkeypatch.setattr("ssm_graph.smoothers.mission.MOST_LOOKS", 1)
    ended = {}
    for suspect in (unit, replace(unit, what="late", late_s=0.1)):
        monkeypatch.setattr("ssm_graph.smoothers.mission.find_suspects", lambda _, s=suspect: (s,))
        estimate = smooth(_depth_off()[1])
        ended[suspect.what] = [one.treatment for one in estimate.faults if one.sensor == "depth"]
    assert ended[unit.what] == [Treatment.CHANGING]
    assert ended["late"] == [Treatment.FREED]


def _depth_off() -> tuple[SimulatedMission, Mission]:
    sim = simulated(duration_s=120.0, dvl=QUIET, seed=3)
    fault = Fault(sensor=Sensor.DEPTH, start_s=40.0, end_s=90.0, size=0.5)
    return sim, with_faults(sim.mission, (fault,), truth=sim.truth_at).mission


def test_beams_without_a_speed_are_compared_with_none() -> None:
    """Of two that have some none is the noisy one; of none at all none either."""
    rng = np.random.default_rng(0)
    beam = np.repeat([0, 2], 500)
    whitened = np.where(beam == 2, 5.0, 1.0) * rng.standard_normal(1000)
    for n in (0, 1000):
        factor = noisier_than_others(whitened[:n], beam[:n], n_beams=4)
        np.testing.assert_array_equal(factor, 1.0)


def test_residuals_that_last_are_said() -> None:
    """A slow half of the noise and wild readings are nobody's; a wave of two sigmas is."""
    rng, time_s = np.random.default_rng(0), np.arange(400.0)
    white = rng.standard_normal((2, 400))
    slow = gauss_markov(rng.standard_normal((400, 1)), time_s, 20.0)[:, 0]
    wild = white[0] + 50.0 * (rng.random(400) < 0.1)
    sound = [
        Readings("DVL beam 1", time_s, np.sqrt(0.5) * white[0] + np.sqrt(0.49) * slow, 0.49),
        Readings("GNSS", time_s, wild, 0.25),
        Readings("USBL", time_s[:20], 5.0 + white[0, :20], 0.25),
    ]
    seldom_s = np.arange(0.0, 3600.0, 30.0)
    pair = white[0, : len(seldom_s)] + 20.0 * np.isin(np.arange(len(seldom_s)), (40, 41, 42))
    sound.append(Readings("USBL", seldom_s, pair, 0.25))
    assert disagreeing(sound, np.arange(3600.0)) == []
    sound.pop()
    wave = 2.0 * np.sin(time_s / 30.0) * (time_s >= 120.0)
    (found,) = disagreeing([*sound, Readings("range", time_s, white[1] + wave, 0.25)], time_s)
    assert (found.sensor, found.treatment) == ("range", Treatment.SAID)
    assert found.begin_s == pytest.approx(120.0, abs=60.0)
    assert found.end_s == pytest.approx(399.0, abs=60.0)
    assert found.rivals


def test_what_stands_out_is_apart_from_what_lasts() -> None:
    """A step stays, but for nothing beside the median; a spike does not."""
    values: Array = np.where(np.arange(40) < 20, 0.0, 1.0)[:, None]
    values[7] = 30.0
    off = beside_median(values)
    assert off[7, 0] == pytest.approx(30.0)
    assert np.count_nonzero(off) == 1


@pytest.mark.parametrize("name", ["block_s", "significance", "margin"])
def test_settings_are_checked(name: str) -> None:
    """Nothing below zero."""
    given: dict[str, Any] = {name: 0.0}
    with pytest.raises(ConfigError, match=f"{name}: expected a number above zero"):
        FaultSearch(**given)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fault", "grade"),
    [
        (Fault((1,), 200.0, 240.0, 0.15), Grade.TACTICAL),
        (Fault((1,), 100.0, 400.0, 0.05, shape=FaultShape.DRIFT), Grade.NAVIGATION),
        (Fault((1,), 100.0, 600.0, shape=FaultShape.COVERED, share=0.3), Grade.TACTICAL),
    ],
    ids=["offset", "drift", "covered"],
)
def test_slow_faults_of_one_beam_cost_little(fault: Fault, grade: Grade) -> None:
    """As the oracle does, and no other beam is named."""
    sim = simulated(duration_s=600.0, grade=grade, faults=(fault,), seed=11)
    estimate = smoothed(sim)
    assert estimate.status is Status.CONVERGED, estimate.reason
    assert {found.sensor for found in estimate.faults} == {"DVL beam 2"}
    told = smoothed(replace(sim, mission=sim.without_outliers()), SmootherConfig())
    level, sigmas = errors(estimate, sim)
    assert level < 1.2 * errors(told, sim)[0]
    assert sigmas < 5.0
