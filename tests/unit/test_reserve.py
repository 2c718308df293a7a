"""Answers in reserve: led on by the inertial data, bounded, renewed, stored."""

from __future__ import annotations

import numpy as np

from ssm_graph.engine.error_state import POSITION, ROTATION, VELOCITY
from ssm_graph.live.estimator import FixedLagSmoother
from ssm_graph.live.estimator.recovery import (
    RENEW_S,
    SPEED_SIGMA,
    Doubt,
    Doubted,
    Kept,
    Reserve,
    doubt_of,
    is_astray,
    watch_after,
)
from ssm_graph.live.estimator.watch import Contradicted, Watch
from ssm_graph.smoothers.keyframe import Keyframe
from tests.online_fixture import SHORT, messages, stream


def after(duration_s: float) -> FixedLagSmoother:
    """Return the estimator after a while of the mission."""
    smoother = FixedLagSmoother(stream(40.0)[1], SHORT)
    for message in messages(40.0):
        if message.time_s > duration_s:
            break
        smoother.push(message)
    return smoother


def reserve_of(smoother: FixedLagSmoother) -> Reserve:
    """Return the reserve of the newest step."""
    assert smoother._course is not None
    return smoother._course.newest.reserve


def test_the_older_answer_is_old_enough_to_be_sound() -> None:
    """Two renewals after the start; both stay near the answer, the older one less surely."""
    smoother = after(40.0)
    older, younger = reserve_of(smoother)
    assert younger.since_s - older.since_s >= RENEW_S
    assert smoother._course is not None
    newest = smoother._course.newest.window.newest
    assert newest.time_s[-1] - older.since_s >= RENEW_S
    off = newest.states.navigation.deviation_of(older.states.navigation)[0]
    sigma = np.sqrt(np.diag(older.covariance))
    assert np.all(np.abs(off[:9]) < 5.0 * sigma[:9])
    assert np.all(sigma[VELOCITY] > np.sqrt(np.diag(newest.covariance[-1]))[VELOCITY])


def test_an_answer_of_long_ago_stays_a_possible_one() -> None:
    """Velocity and place are bounded, attitude is what the gyros say."""
    kept = reserve_of(after(20.0)).older
    wild = kept._replace(v_n=np.array([[100.0, 0.0, 0.0]]), p_n=np.full((1, 3), 1e6))
    tame = wild.without_velocity(float(kept.since_s) + 100.0)
    np.testing.assert_allclose(tame.v_n, [[SPEED_SIGMA, 0.0, 0.0]])
    np.testing.assert_array_equal(tame.p_n[0], kept.place_n)
    P = tame.covariance
    np.testing.assert_allclose(np.diag(P)[VELOCITY], SPEED_SIGMA**2)
    assert np.all(np.sqrt(np.diag(P)[POSITION]) >= 100.0 * SPEED_SIGMA)
    np.testing.assert_array_equal(P[ROTATION, ROTATION], wild.covariance[ROTATION, ROTATION])
    assert not P[VELOCITY, ROTATION].any()


def test_a_reserve_is_stored_as_it_is() -> None:
    """Packed and unpacked, every number of it."""
    reserve = reserve_of(after(20.0))
    again = Reserve.unpack(dict(reserve.pack()))
    for kept, other in zip(reserve, again, strict=True):
        for name in Kept._fields:
            np.testing.assert_array_equal(getattr(kept, name), getattr(other, name))


def with_beams(time_s: float) -> Keyframe:
    """Return a keyframe with four beams."""
    smoother = after(10.0)
    assert smoother._course is not None
    keyframes = smoother._course.newest.window.keyframes
    full = next(k for k in keyframes if len(k.beams.speed) == 4)
    return Keyframe(time_s, full.beams)


def test_what_is_doubted_follows_from_what_was_refused() -> None:
    """Once in a row of refusals the answer, after half a minute the inertial data as well."""
    sigma, keyframe = np.full(15, 1e-3), with_beams(100.0)
    sound = Watch(last_beam_s=99.0)
    assert doubt_of(sound, sigma, keyframe) is None
    out = sound._replace(pings_refused=3, pings_out=3, out_since_s=98.0)
    assert doubted(doubt_of(out, sigma, keyframe)) is Doubted.ANSWER
    assert doubt_of(out._replace(begun_anew_s=99.0), sigma, keyframe) is None
    long = out._replace(out_since_s=60.0, begun_anew_s=62.0)
    assert doubted(doubt_of(long, sigma, keyframe)) is Doubted.VELOCITY
    torn = sound._replace(pings_torn=3, torn_since_s=98.0)
    assert doubted(doubt_of(torn, sigma, keyframe)) is Doubted.ANSWER
    assert doubted(doubt_of(sound._replace(fixes_refused=5), sigma, keyframe)) is Doubted.POSITION
    assert doubted(doubt_of(sound._replace(depths_refused=25), sigma, keyframe)) is Doubted.HEIGHT
    followed = sound._replace(depths_refused=26, depths_followed=True)
    assert doubt_of(followed, sigma, keyframe) is None


def test_a_height_is_doubted_where_nothing_else_agrees_with_it() -> None:
    """A fix that agrees speaks against depths that do not, and a depth against fixes."""
    sigma, keyframe = np.full(15, 1e-3), with_beams(100.0)
    low = Watch(last_beam_s=99.0, depths_refused=40)
    assert doubted(doubt_of(low._replace(last_height_s=84.0), sigma, keyframe)) is Doubted.HEIGHT
    assert doubt_of(low._replace(last_height_s=86.0), sigma, keyframe) is None
    high = Watch(last_beam_s=99.0, heights_refused=5)
    by_fixes = doubt_of(high._replace(last_depth_s=84.0), sigma, keyframe)
    assert doubted(by_fixes) is Doubted.HEIGHT_OF_FIXES
    assert doubt_of(high._replace(last_depth_s=86.0), sigma, keyframe) is None


def doubted(doubt: Doubt | None) -> Doubted:
    """Return what is doubted."""
    assert doubt is not None
    assert doubt.reason
    return doubt.what


def test_positions_that_are_contradicted_again_and_again_mean_a_wrong_heading() -> None:
    """Three within two minutes; and each leaves a contradiction that only time or return ends."""
    smoother = after(10.0)
    assert smoother._course is not None
    window = smoother._course.newest.window
    doubt = Doubt(Doubted.POSITION, "5 fixes")
    watch = Watch()
    for _ in range(3):
        assert not is_astray(watch)
        watch = watch_after(watch, window, window.newest, doubt)
    assert is_astray(watch)
    assert isinstance(watch.contradicted, Contradicted)
    assert "5 fixes" in watch.contradicted.text
    apart = watch_after(watch._replace(moved=(-500.0, -400.0)), window, window.newest, doubt)
    assert not is_astray(apart)
