"""Filters by name: every one runs, takes its parameter, and is nobody else's business."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from functools import cache

import numpy as np
import pytest

from factors.kernels import KERNELS
from ssm_graph.base.errors import ConfigError
from ssm_graph.base.frozen import Array
from ssm_graph.filters.navigation.named import FILTERS, filter_problems
from ssm_graph.mission.estimate import OUTLIER_WEIGHT, Estimate, Status, Trajectory
from ssm_graph.mission.mission import InitialState
from ssm_graph.mission.problem import Problem, build_problem
from ssm_graph.simulation import GnssSettings, OutlierKind, Outliers, SimulatedMission
from tests.helpers import simulated, with_initial

every_filter = pytest.mark.parametrize("name", FILTERS)
BY_PARAMETER = [name for name, choice in FILTERS.items() if choice.default is not None]
LOSES_ITSELF = {"ssmkf-sqrt", "ssmkf-exp"}
"""Those that give an outlier's ping up together with the prediction, and may run away with it."""
WHOLE_PING = {"ekf", "ekf-gate-ping", "rstkf", "ssmkf-log", "ssm-ping-log"} | LOSES_ITSELF
"""Those with one weight for all beams of a ping."""
STEADY = [name for name in FILTERS if name not in LOSES_ITSELF]
N_BEAMS = 4


@cache
def surveys(rate: float) -> tuple[SimulatedMission, ...]:
    """Return two runs of 30 s in waves, with this share of pings with an outlier."""
    outliers = Outliers(OutlierKind.SPARSE, rate=rate) if rate else Outliers()
    return tuple(simulated(seed=seed, outliers=outliers) for seed in (0, 1))


@cache
def problems(rate: float = 0.1) -> tuple[Problem, ...]:
    """Return what is to be estimated of :func:`surveys`."""
    return tuple(build_problem(sim.mission) for sim in surveys(rate))


@cache
def filtered(name: str, rate: float = 0.1, value: float | None = None) -> tuple[Estimate, ...]:
    """Return the estimates of both runs."""
    return tuple(filter_problems(problems(rate), name, value=value))


def highest_weight(name: str) -> float:
    """Return what a beam without any residual or variance would get."""
    if name == "rstkf":
        return (5.0 + N_BEAMS) / 5.0
    if not name.startswith("ssm"):
        return 1.0
    dim = N_BEAMS if name in WHOLE_PING else 1
    return float(KERNELS[name.rpartition("-")[2]].make().weight(0.0, dim=dim))


def apart(found: Sequence[Estimate], expected: Sequence[Estimate]) -> float:
    """Return the largest difference of velocities, sigmas."""
    return max(
        float(np.abs(own.velocity_enu - other.velocity_enu).max() / other.velocity_sigma_enu.max())
        for own, other in zip(
            (estimate.trajectory for estimate in found),
            (estimate.trajectory for estimate in expected),
            strict=True,
        )
    )


@every_filter
def test_every_filter_converges_on_clean_data(name: str) -> None:
    """A finite track within five of its own sigmas from the truth, and weights in their range."""
    for sim, estimate in zip(surveys(0.0), filtered(name, 0.0), strict=True):
        assert estimate.status is Status.CONVERGED, estimate.reason
        track, weight = estimate.trajectory, estimate.beams.weight
        for column in Trajectory.__dataclass_fields__:
            assert np.all(np.isfinite(getattr(track, column))), column
        error = track.velocity_enu - sim.truth_at(track.time_s).velocity_enu
        assert np.abs(error / track.velocity_sigma_enu).max() < 5.0
        assert weight.min() >= 0.0
        assert weight.max() <= highest_weight(name)
        assert np.median(weight) > 0.9
        assert estimate.method == f"filter {name}"


@pytest.mark.parametrize("name", ["ekf", "ekf-gate-beam", "ssm-log"])
def test_a_start_whose_heading_is_wrong_is_no_converged_answer(name: str) -> None:
    """Beams alone tell little of it; fixes that lie aside of the way do, one after the other."""
    sim = simulated(duration_s=60.0, gnss=GnssSettings(windows=((0.0, 60.0),)))
    start = sim.mission.initial
    assert isinstance(start, InitialState)
    off = with_initial(sim.mission, heading=start.heading + np.radians(10.0))
    for mission, status in ((sim.mission, Status.CONVERGED), (off, Status.SUSPECT)):
        (estimate,) = filter_problems([build_problem(mission)], name)
        assert estimate.status is status, estimate.reason
    assert "GNSS measurements" in estimate.reason
    assert "start" in estimate.reason


@pytest.mark.parametrize("name", STEADY)
def test_outliers_are_survived_or_confessed(name: str) -> None:
    """A tenth of the pings with a bad beam: all but the plain filter stay with the truth."""
    for sim, estimate in zip(surveys(0.1), filtered(name), strict=True):
        track = estimate.trajectory
        error = track.velocity_enu - sim.truth_at(track.time_s).velocity_enu
        worst = np.abs(error / track.velocity_sigma_enu).max()
        if name == "ekf":
            assert estimate.status is Status.SUSPECT
            assert worst > 50.0
        else:
            assert estimate.status is Status.CONVERGED, estimate.reason
            assert worst < 5.0


@pytest.mark.parametrize("name", sorted(LOSES_ITSELF))
def test_what_runs_away_is_not_called_good(name: str) -> None:
    """Where the track is not one, the status says so; where it is, it is near the truth."""
    for sim, estimate in zip(surveys(0.1), filtered(name), strict=True):
        track = estimate.trajectory
        error = track.velocity_enu - sim.truth_at(track.time_s).velocity_enu
        is_near = bool(np.all(np.abs(error) < 5.0 * track.velocity_sigma_enu))
        assert estimate.status.is_good == is_near, estimate.reason


@every_filter
def test_beams_of_a_ping_share_their_weight_as_the_name_says(name: str) -> None:
    """One weight for the ping, or the good beams beside a bad one keep theirs."""
    for sim, problem, estimate in zip(surveys(0.1), problems(), filtered(name), strict=True):
        weight = np.full((problem.n_keyframes, 4), np.nan)
        weight[problem.beams.keyframe, problem.beams.beam] = estimate.beams.weight
        bad = np.zeros(weight.shape, bool)
        bad[1:] = sim.is_outlier  # pings at 1 s, 2 s, ...
        struck = weight[bad.any(axis=1)]
        struck = struck[np.isfinite(struck).all(axis=1)]  # a run that is lost has none any more
        assert len(struck) >= 1
        if name in WHOLE_PING:
            np.testing.assert_allclose(np.ptp(struck, axis=1), 0.0, atol=1e-15)
        else:
            assert np.all(struck.max(axis=1) > 0.5)
            assert np.all(weight[bad] < OUTLIER_WEIGHT)


@pytest.mark.parametrize("name", BY_PARAMETER)
def test_parameter_arrives(name: str) -> None:
    """One without tails gives the Kalman filter on clean data; the default does not.

    Degrees of freedom of 1e13 leave 1e-6 of a sigma to rounding of the weights, measured.
    """
    default = FILTERS[name].default
    assert default is not None
    is_gate = name.startswith("ekf-gate")
    is_width = name == "mckf" or name.endswith("-exp")
    large = 1.0 - 1e-15 if is_gate else 1e7 if is_width else 1e13
    kalman = filtered("ekf", 0.0)
    assert apart(filtered(name, 0.0, large), kalman) < 1e-5
    assert apart(filtered(name, 0.0), kalman) > 1e-3
    assert apart(filtered(name, 0.0, default), filtered(name, 0.0)) == 0.0
    assert f"{0.75:g}" in filtered(name, 0.0, 0.75)[0].kernel
    assert f"{default:g}" in filtered(name, 0.0)[0].kernel


@pytest.mark.parametrize(
    ("name", "value"), [("ekf", 1.0), ("rstkf", 5.0), ("ekf-gate-ping", 0.0), ("mckf", 0.0)]
)
def test_a_wrong_parameter_is_refused(name: str, value: float) -> None:
    """Neither ignored nor replaced by the default."""
    with pytest.raises(ConfigError, match="expected"):
        filter_problems(problems(), name, value=value)


def test_each_keyframe_is_announced() -> None:
    """With how many there are."""
    seen: list[tuple[int, int]] = []
    filter_problems(problems(), "ekf", on_keyframe=lambda *at: seen.append(at))
    n = problems()[0].n_keyframes
    assert seen == [(k + 1, n) for k in range(n)]


def columns(estimate: Estimate) -> dict[str, Array]:
    """Return everything that an estimate says of its run."""
    names = Trajectory.__dataclass_fields__
    track = {name: getattr(estimate.trajectory, name) for name in names}
    return track | {name: getattr(estimate.beams, name) for name in ("innovation", "weight")}


def beside_a_lost_run(
    name: str, speed: float, begin_s: int = 10, *, smoothed: bool
) -> tuple[Estimate, Estimate]:
    """Return the good run and that whose beams all read ``speed`` from 10 s on, or from later."""
    good, other = problems()
    beams = other.beams
    damaged = np.where(beams.keyframe >= begin_s, speed, beams.speed)
    lost = dataclasses.replace(other, beams=dataclasses.replace(beams, speed=damaged))
    beside, away = filter_problems([good, lost], name, smoothed=smoothed)
    return beside, away


def assert_same_run(found: Estimate, expected: Estimate, *, atol: float) -> None:
    """Compare all columns, each in parts of its largest number."""
    assert found.status is expected.status
    for key, column in columns(expected).items():
        scale = np.abs(column).max()
        np.testing.assert_allclose(
            columns(found)[key], column, rtol=0.0, atol=atol * scale, err_msg=key
        )


@pytest.mark.parametrize(
    ("name", "speed", "begin_s"),
    [(name, np.nan, 10) for name in STEADY]
    + [(name, 1e200, 10) for name in ("ekf", "ssm-log", "rstkf", "mckf")]
    + [("mckf", 1e7, 28)],
)
def test_a_lost_run_takes_nobody_along(name: str, speed: float, begin_s: int) -> None:
    """One of two runs goes beyond all numbers: the other is as beside a good one.

    To rounding, as NumPy rounds a stack of one otherwise: when the other has settled, one is left.
    The last makes 10,001 passes at each keyframe, and has but three to make them at.
    """
    in_good_company, unharmed = filtered(name)
    beside, away = beside_a_lost_run(name, speed, begin_s, smoothed=False)
    assert away.status in {Status.DIVERGED, Status.SUSPECT}
    assert_same_run(beside, in_good_company, atol=1e-12)
    # What the lost one found before is kept.
    found, expected = away.trajectory, unharmed.trajectory
    kept = slice(0, begin_s)
    np.testing.assert_allclose(found.velocity_enu[kept], expected.velocity_enu[kept], atol=1e-12)
    if np.isnan(speed):  # a robust rule rejects any number, and goes on without the beams
        assert away.status is Status.DIVERGED
        assert "10.0 s" in away.reason
        for column in (found.height, found.velocity_enu, found.velocity_sigma_enu):
            assert np.all(np.isnan(column[10:]))


@pytest.mark.parametrize("name", ["ekf", "ssm-log"])
def test_the_pass_backwards_takes_nobody_along_either(name: str) -> None:
    """As before, and the backward pass goes on beside a run that is not a number any more.

    Solving with predicted covariances makes more of the rounding: 5e-12 was measured.
    """
    expected = filter_problems(problems(), name, smoothed=True)[0]
    beside, away = beside_a_lost_run(name, np.nan, smoothed=True)
    assert away.status is Status.DIVERGED
    assert_same_run(beside, expected, atol=1e-9)
