"""Starts from acoustic fixes, where there is neither GNSS nor an initial state."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ssm_graph.base.errors import ConfigError, DataError
from ssm_graph.evaluation.errors import evaluate
from ssm_graph.io.mission_folder.folder import read_mission, write_mission
from ssm_graph.mission.mission import NO_AIDS, Mission
from ssm_graph.mission.start.alignment import align
from ssm_graph.mission.start.measured import NEAR_S, BodyVelocities, body_velocities, start_fixes
from ssm_graph.sensors.acoustic import UsblLog
from ssm_graph.simulation import GnssSettings, Grade, SimulatedMission
from ssm_graph.smoothers.mission import smooth
from tests.aids_fixture import KNOWN, ranging, usbl
from tests.helpers import simulated


def adrift(rate: float = 0.0, **changes: object) -> SimulatedMission:
    """Return a mission with USBL alone, whose start is not known."""
    config = {"duration_s": 240.0, "grade": Grade.TACTICAL, "aids": usbl(rate, interval_s=4.0)}
    sim = simulated(**(config | changes))
    return replace(sim, mission=replace(sim.mission, initial=None))


def first_wrong(mission: Mission, n_wrong: int) -> Mission:
    """Return the mission with its first fixes 300 m off to the north."""
    log = mission.aids[UsblLog]
    lat = log.lat + np.where(np.arange(len(log.lat)) < n_wrong, 300.0 / 6.4e6, 0.0)
    return replace(mission, aids=mission.aids.having(replace(log, lat=lat)))


def test_the_start_is_within_its_sigmas() -> None:
    """Position, at the time when the fix was valid, and heading, by the fixes and the DVL."""
    sim = adrift()
    alignment = align(sim.mission)
    assert "position from USBL" in alignment.method
    start = alignment.candidates[0]
    log = sim.mission.aids[UsblLog]
    assert start.time_s == log.valid_s[log.valid_s >= sim.mission.imu.start_s][0]
    truth = sim.truth_at(np.array([start.time_s]))
    off_n = sim.mission.frame.p_n_from_geodetic(
        np.array([start.lat]), np.array([start.lon]), np.array([start.height])
    ) - sim.mission.frame.p_n_from_geodetic(truth.lat, truth.lon, truth.height)
    assert np.all(np.abs(off_n[0]) < start.position_sigma_enu)


def test_a_mission_with_usbl_alone_is_smoothed() -> None:
    """As with a start that is known, but for what the fixes leave open."""
    sim = adrift(rate=0.1)
    estimate = smooth(sim.mission)
    assert estimate.status.is_good
    metrics = evaluate(estimate.trajectory, sim.truth_at(estimate.trajectory.time_s))
    assert metrics.rmse_horizontal_m < 2.0


def test_gross_fixes_start_nothing() -> None:
    """The first that most of its neighbours agree with does."""
    mission = adrift().mission
    wrong = first_wrong(mission, 3)
    velocities = body_velocities(mission)
    found, expected = start_fixes(wrong, velocities), start_fixes(mission, velocities)
    np.testing.assert_array_equal(found.time_s, expected.time_s[3:])
    np.testing.assert_array_equal(found.position_n, expected.position_n[3:])


@pytest.mark.parametrize(("far", "is_kept"), [(3.9, True), (4.1, False)])
def test_a_fix_disagrees_beyond_four_sigmas(far: float, is_kept: bool) -> None:
    """Of both fixes together, at rest and without a lever arm; the last one comes after the end."""
    mission = adrift().mission
    log = mission.aids[UsblLog]
    n, sigma = len(log.time_s), 0.5
    place_n = np.zeros((n, 3))
    place_n[0, 0] = far * sigma * np.sqrt(6.0)
    lat, lon, height = mission.frame.geodetic_from_p_n(place_n)
    fixes = replace(
        log,
        delay_s=np.zeros(n),
        lat=lat,
        lon=lon,
        height=height,
        sigma_enu=np.full((n, 3), sigma),
        lever_arm_b=np.zeros(3),
    )
    at_rest = BodyVelocities(log.time_s, place_n * 0.0)
    found = start_fixes(replace(mission, aids=mission.aids.having(fixes)), at_rest)
    np.testing.assert_array_equal(found.time_s, log.time_s[0 if is_kept else 1 : -1])


def test_gnss_goes_first_unless_it_is_late() -> None:
    """Half an hour of a dive is not given away for a better fix at its end."""
    for begin_s, source in ((NEAR_S - 10.0, "GNSS"), (NEAR_S + 10.0, "USBL")):
        mission = adrift(gnss=GnssSettings(windows=((begin_s, 240.0),))).mission
        assert start_fixes(mission, body_velocities(mission)).source == source


def test_without_fixes_the_error_says_what_to_try() -> None:
    """No fixes at all, ranges alone, and fixes of another time."""
    mission = adrift().mission
    with pytest.raises(ConfigError, match=r"expected \[initial\], \[gnss\] or \[usbl\], got none"):
        align(replace(mission, aids=NO_AIDS))
    with pytest.raises(ConfigError, match=r"ranges to beacons alone give none: add \[initial\]"):
        align(adrift(aids=ranging(KNOWN)).mission)
    log = mission.aids[UsblLog]
    late = replace(log, time_s=log.time_s + 1e4)
    with pytest.raises(DataError, match=r"got fixes of USBL 10.*check the clocks"):
        align(replace(mission, aids=mission.aids.having(late)))


def test_usbl_says_where_on_earth(tmp_path: Path) -> None:
    """A folder without [origin], [gnss] and [initial]."""
    mission = adrift().mission
    write_mission(tmp_path, mission)
    path = tmp_path / "mission.toml"
    before, _, after = path.read_text().partition("[origin]\n")
    path.write_text(before + after[after.index("\n[") :])
    log, got = mission.aids[UsblLog], read_mission(tmp_path)
    assert log is not None
    np.testing.assert_allclose([got.frame.lat, got.frame.lon], [log.lat[0], log.lon[0]])
    assert got.frame.height == pytest.approx(log.height[0])
