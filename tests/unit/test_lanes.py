"""Lanes that leave a sensor out: their statistic, what they find, what is remembered, how far."""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Iterator
from functools import cache
from typing import Any

import numpy as np
import pytest

from ssm_graph.base.errors import ConfigError
from ssm_graph.base.frozen import Array
from ssm_graph.engine.error_state import POSITION
from ssm_graph.io.mission_folder.vehicle import vehicle_of
from ssm_graph.live.estimator import ONLINE, FixedLagSmoother, IntegrityConfig
from ssm_graph.live.estimator.guard import Guardian
from ssm_graph.live.estimator.lanes import INERTIAL, MEASURE, Lanes
from ssm_graph.live.estimator.separation import AGREED_S, COVERED_S, UNASKED, Contradiction
from ssm_graph.mission.mission import Mission
from ssm_graph.mission.navigation import Health
from ssm_graph.simulation import Grade, SimulatedMission
from ssm_graph.smoothers.window_aids import SensorRows
from tests.lanes_fixture import LIES, Look, longest_good_lie, looks, survey

BEGIN_S, END_S, LENGTH_S = 20.0, 28.0, 40.0


@cache
def calm() -> SimulatedMission:
    """Return a short survey at navigation grade."""
    return survey(Grade.NAVIGATION, 0, duration_s=LENGTH_S)


@cache
def lied() -> Mission:
    """Return the same while the bottom drifts for ten seconds."""
    lie, _, _ = LIES["bottom drifts 5 cm/s"]
    return lie(calm(), BEGIN_S, END_S)


@cache
def after(name: str) -> tuple[list[Look], FixedLagSmoother]:
    """Return what the estimator said of the calm or the lied mission."""
    return looks(calm().mission if name == "calm" else lied(), calm())


def guardian_of(smoother: FixedLagSmoother) -> tuple[Guardian, Lanes]:
    """Return what guards an estimator, and its lanes now."""
    course = smoother._course
    assert course is not None
    return course.guardian, course.newest.guard.lanes


def drawn_rows(rng: np.random.Generator) -> Iterator[SensorRows]:
    """Yield what DVL and GNSS measure at the truth, but for what lasts: that is in the lanes."""
    for name, share, first, scale in (("DVL", 0.125, 6, 200.0), ("GNSS", 0.02, 3, 2.0)):
        H = np.zeros((3, 15))
        H[np.arange(3), first + np.arange(3)] = scale
        white = math.sqrt(1.0 - share) * rng.standard_normal(3)
        yield SensorRows(name, -white, H, np.ones(3), np.arange(3))


@pytest.mark.slow
def test_separations_are_what_their_covariance_says() -> None:
    """Chi-square of three degrees of freedom: of velocity without DVL, of position without GNSS."""
    guardian, lanes = guardian_of(after("calm")[1])
    bank, rng, n_runs = guardian.bank, np.random.default_rng(7), 400
    n, n_lanes = 15, len(lanes.deviation)
    P = np.zeros_like(lanes.covariance[MEASURE])
    P[:n, :n] = lanes.covariance[MEASURE, :n, :n]
    P[3:6, 3:6] += np.eye(3)
    P[6:9, 6:9] += 1e-3 * np.eye(3)
    P[n:, n:] = np.diag(bank._share)
    root, found = np.linalg.cholesky(P), []
    for _ in range(n_runs):
        begun = lanes._replace(
            deviation=np.tile(root @ rng.standard_normal(len(P)), (n_lanes, 1)),
            covariance=np.tile(P, (n_lanes, 1, 1)),
            begun_s=np.zeros(n_lanes),
        )
        now = bank._updated(begun, list(drawn_rows(rng)), 1.0)
        found.append(guardian.judge.separations(now).test)
    mean, spread = np.mean(found, axis=0), math.sqrt(6.0 / n_runs)
    for name, part in (("DVL", 0), ("GNSS", 1)):
        lane = bank.lanes_of(bank.suspects.index(name))[0]
        assert 3.0 * (1.0 - UNASKED) - 4.0 * spread < mean[lane, part] < 3.0 + 4.0 * spread, name


def test_nothing_contradicts_while_all_is_as_stated() -> None:
    """GOOD from begin to end, within the protection level, and no lasting innovations."""
    found, smoother = after("calm")
    assert all(look.is_good for look in found)
    for look in found:
        assert look.off_m < look.navigation.protection_m
        assert look.off_up_m < look.navigation.protection_up_m
    assert "contradicted_DVL" not in {event.kind for event in smoother.take_events()}
    ratios = found[-1].navigation.innovation_ratios
    assert set(ratios) == {"DVL", "GNSS", "depth"}
    assert max(ratios.values()) < 0.5


def test_a_drifting_bottom_is_found_named_and_remembered() -> None:
    """Within five seconds, and still when it has long come to rest."""
    found, _ = after("lied")
    before = [look for look in found if look.navigation.time_s < BEGIN_S - 1.0]
    seen = [look for look in found if look.navigation.time_s > BEGIN_S + 5.0]
    assert all(look.is_good for look in before)
    assert {look.navigation.health for look in seen} == {Health.DEGRADED}
    for look in seen:
        assert look.navigation.reason.startswith("DVL"), look.navigation.reason
        assert "GNSS" not in look.navigation.reason
    assert longest_good_lie(found) <= 3
    assert all(look.off_m < look.navigation.protection_m for look in found)


def test_a_restart_does_not_forget() -> None:
    """From a checkpoint amid the lie, as plain values: the same health, reason and levels."""
    _, before = looks(lied(), calm(), end_s=24.0)
    arrays, meta = before.checkpoint()
    restored = FixedLagSmoother.restore(
        vehicle_of(lied()), ONLINE, arrays, json.loads(json.dumps(meta))
    )
    mine, _ = looks(lied(), calm(), smoother=restored, begin_s=24.0, end_s=32.0)
    theirs = [look for look in after("lied")[0] if 24.5 < look.navigation.time_s <= 32.0]
    mine = [look for look in mine if look.navigation.time_s > 24.5]
    assert len(mine) == len(theirs) > 5
    for a, b in zip(mine, theirs, strict=True):
        assert a.navigation.reason == b.navigation.reason
        assert a.navigation.protection_m == pytest.approx(b.navigation.protection_m, rel=1e-4)


def test_an_earlier_version_left_no_lanes() -> None:
    """Its checkpoint is gone on with; the lanes begin anew."""
    _, before = looks(calm().mission, calm(), end_s=12.0)
    arrays, meta = before.checkpoint()
    old = {name: array for name, array in arrays.items() if not name.startswith("guard_")}
    del meta["contradictions"]
    restored = FixedLagSmoother.restore(vehicle_of(calm().mission), ONLINE, old, meta)
    navigation, expected = restored.newest(), before.newest()
    assert navigation is not None
    assert expected is not None
    assert navigation.health is Health.GOOD
    assert navigation.lat == pytest.approx(expected.lat, abs=1e-12)
    assert math.isfinite(navigation.protection_m)


def test_good_asks_for_the_protection_level_that_the_user_asks_for() -> None:
    """A level below what there is makes every answer DEGRADED, and the reason says so."""
    asked = IntegrityConfig(protection_m=1e-3)
    found, _ = looks(calm().mission, calm(), integrity=asked, end_s=6.0)
    assert found
    for look in found:
        assert look.navigation.health is Health.DEGRADED
        assert "horizontal protection level is" in look.navigation.reason
        assert "below 0.001 m" in look.navigation.reason


@pytest.mark.slow
def test_settled_states_have_the_levels_of_their_time() -> None:
    """One for every keyframe, finite, also of those that left the window long ago."""
    found, smoother = looks(calm().mission, calm())
    delayed = smoother.finish()
    for piece in delayed:
        np.testing.assert_array_equal(piece.protection.time_s, piece.trajectory.time_s)
        assert np.isfinite(piece.protection.horizontal).all()
        assert np.isfinite(piece.protection.up).all()
    last = delayed[-1].protection.horizontal[-1]
    assert last == pytest.approx(found[-1].navigation.protection_m)


def held_off(lanes: Lanes, guardian: Guardian, off_m: float, sigma: float) -> Lanes:
    """Return lanes of which that without GNSS is ``off_m`` east of all others, with a sigma."""
    bank = guardian.bank
    suspect = bank.suspects.index("GNSS")
    deviation, covariance = np.zeros_like(lanes.deviation), lanes.covariance.copy()
    own = [*bank.lanes_of(suspect)]
    deviation[own, 3] = off_m
    covariance[:] = lanes.covariance[MEASURE]
    covariance[np.ix_(own, range(3, 6), range(3, 6))] += sigma**2 * np.eye(3)
    n_out = np.zeros(len(deviation))
    n_out[own] = 1.0
    ones = np.ones(len(deviation))
    return lanes._replace(deviation=deviation, covariance=covariance, n_out=n_out, is_nested=ones)


def test_only_a_lane_that_could_tell_ends_a_contradiction() -> None:
    """One that has become uncertain agrees with everything, and does not count; 8 s do."""
    guardian, lanes = guardian_of(after("calm")[1])

    def judged(
        off_m: float, sigma: float, known: tuple[Contradiction, ...], time_s: float
    ) -> tuple[Lanes, tuple[Contradiction, ...]]:
        now = held_off(lanes, guardian, off_m, sigma)
        return guardian.judge.judged(now, guardian.judge.separations(now), known, time_s)

    lanes, known = judged(3.0, 0.1, (), 100.0)
    (one,) = known
    assert guardian.bank.suspects[one.suspect] == "GNSS"
    assert one.size == pytest.approx(3.0)
    for k in range(100):
        _, known = judged(0.0, 10.0, known, 101.0 + k)
    assert len(known) == 1
    for k in range(int(AGREED_S)):
        _, known = judged(0.0, 0.1, known, 201.0 + k)
    assert len(known) == 1
    agreed, known = judged(0.0, 0.1, known, 212.5)
    assert known == ()
    assert np.isinf(agreed.begun_s[guardian.bank.held]).all()


def test_a_suspicion_ends_with_any_lane_that_agrees() -> None:
    """It is said, becomes a contradiction where there is more, and is not remembered otherwise."""
    guardian, lanes = guardian_of(after("calm")[1])

    def judged(
        off_m: float, sigma: float, known: tuple[Contradiction, ...], time_s: float
    ) -> tuple[Contradiction, ...]:
        now = held_off(lanes, guardian, off_m, sigma)
        return guardian.judge.judged(now, guardian.judge.separations(now), known, time_s)[1]

    (one,) = suspected = judged(0.55, 0.1, (), 100.0)
    assert not one.is_certain
    said = guardian.judge.sentence(lanes, suspected, 100.0)
    assert "noise alone would hardly" in said
    assert said.endswith("mission.toml say so: [gnss] drift_sigma_m")
    (more,) = judged(3.0, 0.1, suspected, 103.0)
    assert more.is_certain
    assert more.since_s == pytest.approx(103.0)
    for k in range(int(AGREED_S) + 2):
        suspected = judged(0.0, 10.0, suspected, 104.0 + k)
    assert suspected == ()


def test_a_suspicion_that_stays_one_is_covered_by_sigmas() -> None:
    """After a minute it is said no more; until it ends the sigmas hold what it would mean."""
    smoother = after("calm")[1]
    guardian, lanes = guardian_of(smoother)
    course = smoother._course
    assert course is not None
    off_m, bank = 0.45, guardian.bank
    now = held_off(lanes, guardian, off_m, 0.1)
    guard, covariance = course.newest.guard, course.newest.window.newest_covariance
    assert guardian.covering(guard, covariance)[3, 3] < covariance[3, 3] + 0.1 * off_m**2
    for age_s, is_certain, is_covered in (
        (COVERED_S - 1.0, False, False),
        (COVERED_S + 1.0, False, True),
        (COVERED_S + 1.0, True, False),
    ):
        since_s, suspect = guard.time_s - age_s, bank.suspects.index("GNSS")
        one = Contradiction(suspect, since_s, since_s, 1, 0.55, 30.0, np.inf, is_certain)
        judged = guard._replace(lanes=now, contradictions=(one,))
        assert (guardian.told(judged).contradiction == "") == is_covered
        grown = guardian.covering(judged, covariance) - guardian.covering(guard, covariance)
        covered = off_m**2 * is_covered * np.array([2.0, 1.0, 1.0])
        np.testing.assert_allclose(np.diag(grown)[POSITION], covered, atol=1e-12)


def test_a_jump_of_the_gyros_bias_is_found_by_lanes_that_forgot_it() -> None:
    """Theirs are the only ones that are compared in it; the inertial data are named."""
    guardian, lanes = guardian_of(after("calm")[1])
    bank, judge = guardian.bank, guardian.judge
    forgets = bank.suspect == bank.suspects.index(INERTIAL)
    bias = lanes.covariance[:, 14, 14]
    assert bias[forgets].max() > 3.0 * bias[~forgets].max()
    deviation = lanes.deviation.copy()
    deviation[1:, 14] = lanes.deviation[MEASURE, 14] + 8.0 * np.sqrt(bias[1:])
    now = lanes._replace(deviation=deviation, n_out=np.ones(len(bias)))
    _, known = judge.judged(now, judge.separations(now), (), 100.0)
    assert [bank.suspects[one.suspect] for one in known] == [INERTIAL]
    assert judge.sentence(now, known, 100.0).startswith("the inertial data: without the gyro bias")
    unfixed = now._replace(n_fixes=np.zeros(len(bias)))
    said = judge.sentence(unfixed, known, 100.0)
    assert said.startswith("the inertial data or DVL: without the gyro bias")


def test_what_the_window_refuses_pulls_at_no_lane() -> None:
    """A row of no weight, a million sigmas off, moves nothing by a thousandth of a sigma."""
    guardian, lanes = guardian_of(after("calm")[1])
    H = np.zeros((1, 15))
    H[0, 8] = 200.0
    refused = SensorRows("DVL", np.array([1e6]), H, np.zeros(1), np.zeros(1, dtype=np.intp))
    moved = guardian.bank._updated(lanes, [refused], 100.0).deviation - lanes.deviation
    sigma = np.sqrt(np.diagonal(lanes.covariance, axis1=1, axis2=2))
    assert np.abs(moved / sigma)[:, :15].max() < 1e-3


def test_what_only_followed_ends_with_what_it_followed() -> None:
    """The inertial data named after a DVL that is shown to be right; not those named before it."""
    guardian, lanes = guardian_of(after("calm")[1])
    names = guardian.bank.suspects
    for inertial_s, is_left in ((101.0, False), (99.0, True)):
        known = (
            Contradiction(names.index("DVL"), 100.0, 101.0, 0, 5.0, 100.0, 110.0),
            Contradiction(names.index(INERTIAL), inertial_s, 110.0, 2, 0.01, 90.0, np.inf),
        )
        begun_s = lanes.begun_s.copy()
        begun_s[guardian.bank.held[[one.suspect for one in known]]] = 90.0
        quiet = lanes._replace(begun_s=begun_s, deviation=np.zeros_like(lanes.deviation))
        found = guardian.judge.separations(quiet)
        found.sigma[:, 2] = 1.0
        _, left = guardian.judge.judged(quiet, found, known, 110.0 + AGREED_S + 1.0)
        assert [names[one.suspect] for one in left] == [INERTIAL] * is_left


def test_a_blame_that_is_refuted_clears_nobody() -> None:
    """Inertial data were blamed first, then their lane misses its own sensors: the DVL stays."""
    guardian, lanes = guardian_of(after("calm")[1])
    bank, names = guardian.bank, guardian.bank.suspects
    dvl, inertial = names.index("DVL"), names.index(INERTIAL)
    known = (
        Contradiction(dvl, 101.0, 109.0, 0, 0.05, 30.0, np.inf),
        Contradiction(inertial, 99.0, 109.0, 2, 1e-4, 90.0, np.inf),
    )
    held = bank.held[[dvl, inertial]]
    begun_s, misfit = lanes.begun_s.copy(), np.zeros_like(lanes.misfit)
    begun_s[held], misfit[held[1]] = 90.0, 2.0 * guardian.judge.threshold
    deviation = np.zeros_like(lanes.deviation)
    deviation[held[0], 6] = 5.0
    n_out = np.ones(len(begun_s))
    now = lanes._replace(begun_s=begun_s, misfit=misfit, deviation=deviation, n_out=n_out)
    left_on, left = guardian.judge.judged(now, guardian.judge.separations(now), known, 110.0)
    assert [names[one.suspect] for one in left] == ["DVL"]
    assert left_on.begun_s[held[0]] == pytest.approx(90.0)
    assert np.isinf(left_on.begun_s[held[1]])


def test_the_threshold_keeps_the_rate_that_was_asked_for() -> None:
    """Fewer false alerts are bought with larger separations; numbers that mean nothing refused."""
    guardian, _ = guardian_of(after("calm")[1])
    sensors = after("calm")[1]._course.newest.window.sensors  # type: ignore[union-attr]
    rarer = Guardian(sensors, IntegrityConfig(false_alerts_per_h=1e-6))
    assert rarer.judge.threshold > guardian.judge.threshold > 35.0
    for wrong in ({"false_alerts_per_h": 0.0}, {"missed_detection": 0.7}, {"protection_m": -1.0}):
        with pytest.raises(ConfigError, match=next(iter(wrong))):
            IntegrityConfig(**wrong)


LIE_S = 180.0


@cache
def until_the_lie(
    grade: Grade,
) -> tuple[SimulatedMission, list[Look], tuple[dict[str, Array], dict[str, Any]]]:
    """Return five minutes, what is said of the three before the lie, and the checkpoint then."""
    sim = survey(grade, 100, duration_s=300.0)
    found, smoother = looks(sim.mission, sim, end_s=LIE_S)
    smoother.take_delayed()
    return sim, found, smoother.checkpoint()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "grade"), list(zip(LIES, itertools.cycle([Grade.NAVIGATION, Grade.TACTICAL])))
)
def test_no_lie_stays_good_for_long(name: str, grade: Grade) -> None:
    """Never GOOD and beyond five sigmas for more than ten seconds."""
    lie, lasts_s, _ = LIES[name]
    sim, calm_looks, checkpoint = until_the_lie(grade)
    mission = lie(sim, LIE_S, LIE_S + lasts_s)
    smoother = FixedLagSmoother.restore(vehicle_of(mission), ONLINE, *checkpoint)
    since, _ = looks(mission, sim, smoother=smoother, begin_s=LIE_S)
    found = [*calm_looks, *since]
    assert longest_good_lie(found) <= 10
    good = [look.navigation for look in found if look.is_good]
    off_m = [look.off_m for look in found if look.is_good]
    assert np.mean(np.array(off_m) < [answer.protection_m for answer in good]) > 0.99
