"""Keyframe times: pings, fixes, silence, spans."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ssm_graph.base.errors import DataError
from ssm_graph.base.times import MIN_SPACING_S, nearest
from ssm_graph.mission.mission import Mission
from ssm_graph.mission.timeline import Timeline, build_timeline
from ssm_graph.sensors.dvl import DvlLog
from ssm_graph.sensors.gnss import GnssLog
from ssm_graph.simulation import default_mount
from tests.helpers import STEADY, simulated

MISSION = simulated(duration_s=20.0).mission


def mission_with(
    ping_s: Sequence[float], fix_s: Sequence[float] = (), *, late_s: float = 0.0
) -> Mission:
    """Return 20 s of inertial data with pings and fixes at these times."""
    n = len(ping_s)
    mount = dataclasses.replace(default_mount(), time_offset_s=late_s)
    dvl = DvlLog(
        mount=mount,
        time_s=np.array(ping_s, float),
        speed=np.zeros((n, 4)),
        sigma=np.full((n, 4), 0.005),
    )
    place = MISSION.frame
    n_fixes = len(fix_s)
    gnss = GnssLog(
        time_s=np.array(fix_s, float),
        lat=np.full(n_fixes, place.lat),
        lon=np.full(n_fixes, place.lon),
        height=np.zeros(n_fixes),
        sigma_enu=np.ones((n_fixes, 3)),
        lever_arm_b=np.zeros(3),
    )
    return dataclasses.replace(MISSION, dvl=dvl, gnss=gnss if n_fixes else None)


def timeline_of(
    mission: Mission, *, start_s: float = 0.0, interval_s: float = math.inf
) -> Timeline:
    """Return the timeline, by default without filling."""
    return build_timeline(mission, start_s=start_s, interval_s=interval_s)


def test_keyframes_lie_at_pings_and_fixes_and_both_ends() -> None:
    """In time order; what was measured knows its keyframe."""
    timeline = timeline_of(mission_with([1.5, 7.25, 12.0], [3.0, 7.25, 19.0]))
    np.testing.assert_array_equal(timeline.keyframe_s, [0.0, 1.5, 3.0, 7.25, 12.0, 19.0, 20.0])
    np.testing.assert_array_equal(timeline.ping, [0, 1, 2])
    np.testing.assert_array_equal(timeline.ping_keyframe, [1, 3, 4])
    np.testing.assert_array_equal(timeline.fix_keyframe, [2, 3, 5])
    assert timeline.notes == ()


def test_equal_times_share_a_keyframe() -> None:
    """Closer than a millisecond is the same; the earlier time stays."""
    timeline = timeline_of(mission_with([5.0, 5.0004, 5.002], [4.9996, 20.0]))
    np.testing.assert_array_equal(timeline.keyframe_s, [0.0, 4.9996, 5.002, 20.0])
    np.testing.assert_array_equal(timeline.ping_keyframe, [1, 1, 2])
    np.testing.assert_array_equal(timeline.fix_keyframe, [1, 3])


def test_silence_is_filled_evenly() -> None:
    """No interval is longer than asked for, and filled ones are equal within each silence."""
    timeline = timeline_of(mission_with([2.0, 5.5]), interval_s=1.0)
    np.testing.assert_allclose(timeline.keyframe_s[:3], [0.0, 1.0, 2.0])
    np.testing.assert_allclose(np.diff(timeline.keyframe_s[2:7]), 0.875)
    np.testing.assert_allclose(np.diff(timeline.keyframe_s[6:]), 14.5 / 15.0)
    np.testing.assert_allclose(timeline.keyframe_s[timeline.ping_keyframe], [2.0, 5.5])
    regular = timeline_of(mission_with(list(range(1, 21))), interval_s=1.0)
    np.testing.assert_array_equal(regular.keyframe_s, np.arange(21.0))


def test_no_pings_at_all_leave_the_filled_ends() -> None:
    """Pure inertial navigation is a mission as well."""
    timeline = timeline_of(mission_with([]), interval_s=5.0)
    np.testing.assert_allclose(timeline.keyframe_s, [0.0, 5.0, 10.0, 15.0, 20.0])
    assert len(timeline.ping) == len(timeline.ping_keyframe) == 0


@pytest.mark.parametrize("ping_s", [0.0, 4.0, 20.0])
def test_one_ping(ping_s: float) -> None:
    """At the start, within and at the very end."""
    timeline = timeline_of(mission_with([ping_s]))
    np.testing.assert_array_equal(timeline.keyframe_s, np.unique([0.0, ping_s, 20.0]))
    assert timeline.keyframe_s[timeline.ping_keyframe[0]] == ping_s


def test_pings_without_any_beam_make_no_keyframe() -> None:
    """A ping that lost all beams says nothing; it is not left out, it is not there."""
    mission = mission_with([3.0, 4.0, 5.0])
    speed = mission.dvl.speed.copy()
    speed[1] = np.nan
    speed[2, :3] = np.nan
    mission = dataclasses.replace(mission, dvl=dataclasses.replace(mission.dvl, speed=speed))
    timeline = timeline_of(mission)
    np.testing.assert_array_equal(timeline.keyframe_s, [0.0, 3.0, 5.0, 20.0])
    np.testing.assert_array_equal(timeline.ping, [0, 2])
    assert timeline.notes == ()


def test_what_lies_outside_is_left_out_and_counted() -> None:
    """A start in the middle; each kind gets its sentence, in the right number."""
    timeline = timeline_of(
        mission_with([1.0, 2.0, 9.0, 21.0], [3.0, 12.0]), start_s=5.0, interval_s=math.inf
    )
    np.testing.assert_array_equal(timeline.keyframe_s, [5.0, 9.0, 12.0, 20.0])
    np.testing.assert_array_equal(timeline.ping, [2])
    np.testing.assert_array_equal(timeline.fix, [1])
    assert timeline.notes == (
        "3 pings outside the smoothed span 5.000..20.000 s left out",
        "1 GNSS fix outside the smoothed span 5.000..20.000 s left out",
    )
    several = timeline_of(mission_with([1.0], [2.0, 3.0]), start_s=5.0)
    assert [note.split(" outside")[0] for note in several.notes] == ["1 ping", "2 GNSS fixes"]


def test_time_offset_of_the_dvl_is_taken_off() -> None:
    """Stamps late by 0.1 s: keyframes are where the pings were, pings before the start go."""
    timeline = timeline_of(mission_with([0.05, 1.1, 2.1, 20.05], late_s=0.1))
    np.testing.assert_allclose(timeline.keyframe_s, [0.0, 1.0, 2.0, 19.95, 20.0])
    np.testing.assert_array_equal(timeline.ping, [1, 2, 3])


@pytest.mark.parametrize(
    ("start_s", "message"),
    [
        (20.0, r"start at 20\.000 s leaves no inertial data, which end at 20\.000 s"),
        (25.0, r"leaves no inertial data"),
        (-1.0, r"start at -1\.000 s lies before the inertial data, which begin at 0\.000 s"),
    ],
)
def test_starts_outside_the_inertial_data_are_refused(start_s: float, message: str) -> None:
    """The message gives both times."""
    with pytest.raises(DataError, match=message):
        timeline_of(mission_with([1.0]), start_s=start_s)


def test_a_start_at_the_first_sample_may_be_off_by_rounding() -> None:
    """Less than a millisecond early starts with the data."""
    timeline = timeline_of(mission_with([1.0]), start_s=-5e-4)
    assert timeline.keyframe_s[0] == 0.0


@STEADY
@given(
    st.lists(st.floats(0.0, 20.0), max_size=30, unique=True),
    st.lists(st.floats(0.0, 20.0), max_size=10, unique=True),
    st.floats(0.3, 30.0),
)
def test_laws_of_any_timeline(ping_s: list[float], fix_s: list[float], interval_s: float) -> None:
    """Strictly increasing, spaced between the limits, and everything at its own time."""
    mission = mission_with(sorted(ping_s), sorted(fix_s))
    timeline = timeline_of(mission, interval_s=interval_s)
    keyframe_s = timeline.keyframe_s
    spacing = np.diff(keyframe_s)
    assert np.all(spacing >= MIN_SPACING_S - 1e-12)
    # A last time within a millisecond of another is dropped.
    assert np.all(spacing <= interval_s * (1.0 + 1e-6) + 1e-9)
    assert keyframe_s[0] == 0.0
    assert 20.0 - MIN_SPACING_S < keyframe_s[-1] <= 20.0
    assert len(timeline.ping) == len(ping_s)
    off = keyframe_s[timeline.ping_keyframe] - np.sort(ping_s)
    assert np.all(np.abs(off) < MIN_SPACING_S)
    assert np.all(np.diff(timeline.ping_keyframe) >= 0)


@STEADY
@given(st.lists(st.floats(-5.0, 25.0), min_size=1, max_size=20))
def test_nearest_is_nearest(times: list[float]) -> None:
    """No other keyframe is closer, also beyond the ends."""
    keyframe_s = np.array([0.0, 1.0, 4.0, 4.5, 20.0])
    chosen = np.abs(keyframe_s[nearest(keyframe_s, np.array(times))] - times)
    np.testing.assert_allclose(chosen, np.abs(keyframe_s[:, None] - times).min(axis=0))
