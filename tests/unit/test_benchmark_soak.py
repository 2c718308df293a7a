"""What the soak breaks, measures, prints and draws."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.online_stream import HEALTHS
from benchmarks.soak import by_health, goals, report, shares_inside, soaked_once
from benchmarks.soak_figure import draw, hourly
from benchmarks.soak_stream import (
    CASES,
    STUCK_BEAM,
    Soaked,
    broken_mission,
    longest_run,
    more_untold,
    soak,
)
from ssm_graph.mission.navigation import Health
from ssm_graph.report.style import save
from ssm_graph.simulation import Grade

GOOD, DEGRADED = HEALTHS.index(Health.GOOD), HEALTHS.index(Health.DEGRADED)


def made_up() -> Soaked:
    """Return two hours: off by ten sigmas in one axis for 20 s of good and 40 s of degraded."""
    time_s = np.arange(0.0, 7200.0, 1.0)
    error, sigma = np.zeros((len(time_s), 9)), np.ones((len(time_s), 9))
    error[100:120, 4] = error[200:240, 4] = 10.0
    health = np.full(len(time_s), GOOD)
    health[200:260] = DEGRADED
    latency_s = 1e-3 * (1.0 + np.arange(7200.0) % 7.0)
    rss_s = time_s[::60]
    events, refused = {"doubt": 2}, {"imu clock": 1}
    return Soaked(
        "made up", time_s, error, sigma, health, latency_s, events, refused, rss_s, 5.0 + rss_s, 1.0
    )


def test_missions_are_broken_as_asked() -> None:
    """Losses, a stuck beam, gaps and no depth are where they should be."""
    mission, truth = broken_mission(
        CASES["all of these"], duration_s=2500.0, seed=0, dvl_hz=1.0, grade=Grade.NAVIGATION
    )
    time_s, speed = mission.dvl.time_s, mission.dvl.speed
    lost = (time_s >= 1800.0) & (time_s < 2400.0)
    assert np.isnan(speed[lost]).all()
    assert np.isfinite(speed[~lost]).all()
    stuck = speed[(time_s >= 600.0) & (time_s < 1500.0), STUCK_BEAM]
    assert np.ptp(stuck) == 0.0
    gaps = np.diff(mission.imu.time_s)
    np.testing.assert_allclose(gaps[gaps > 0.015], 1.01, atol=1e-6)
    assert np.sum(gaps > 0.015) == 4
    assert mission.depth is None
    assert truth(np.array([1.0])).velocity_enu.shape == (1, 3)


def test_a_short_soak_is_good() -> None:
    """Half a minute without trouble: good but for the start, errors within their sigmas."""
    run = soak("depth", hours=0.01, seed=0, dvl_hz=1.0, grade="NAVIGATION", says=False)
    assert run.time_s[-1] == pytest.approx(36.0, abs=0.6)
    assert run.is_good.mean() > 0.9
    assert shares_inside(run).min() > 0.9
    assert run.error.shape == run.sigma.shape == (len(run.time_s), 9)


def test_report_tells_good_from_bad(tmp_path: Path) -> None:
    """Only what is outside while the health is good counts against it."""
    run = made_up()
    np.testing.assert_allclose(shares_inside(run)[4], 1.0 - 20.0 / 7140.0)
    cells = goals(run)
    assert cells[1] == "99.72 % (velocity N)"
    assert cells[3:5] == ["20 s at 0.03 h", "20 s"]
    assert cells[5:] == ["+3600.00", "**no**"]
    assert [row[1] for row in by_health(run)] == ["good", "degraded"]
    text = "\n".join(report([run]))
    assert "doubt 2" in text
    assert hourly(run)[1] == pytest.approx([4.0, 7.0, 7.0])
    assert save(draw([run], "title"), tmp_path / "soak.png").stat().st_size > 10_000


def test_longest_run_and_untold_events() -> None:
    """A stretch that lasts to the end counts; an event may stand for several."""
    assert longest_run(np.array([1, 0, 0, 1, 1, 1], dtype=bool), 0.5) == (1.5, 3)
    assert longest_run(np.zeros(3, dtype=bool), 0.5) == (0.0, 0)
    assert more_untold("no beam (and 12 more since)") == 12
    assert more_untold("no beam") == 0


def test_a_finished_case_is_kept(tmp_path: Path) -> None:
    """A second run of the same code with the same settings reads what the first one found."""
    settings = {"hours": 0.01, "seed": 3, "dvl_hz": 1.0, "grade": "NAVIGATION", "says": False}
    first = soaked_once(tmp_path, "depth", **settings)
    (file,) = tmp_path.iterdir()
    again = soaked_once(tmp_path, "depth", **settings)
    assert again.wall_s == first.wall_s
    assert (again.name, again.events, again.refused) == (first.name, first.events, first.refused)
    np.testing.assert_array_equal(again.error, first.error)
    assert goals(again) == goals(first)
    other = soaked_once(tmp_path, "depth", **settings | {"seed": 4})
    assert other.wall_s != first.wall_s
    assert len(list(tmp_path.iterdir())) == 2
    assert file.exists()
