"""A clock that is set on a machine that lags: answers that are good are within their sigmas."""

from __future__ import annotations

import numpy as np
import pytest

from ssm_graph.simulation import DvlSettings, GnssSettings, Grade, SurveyRoute
from tests.helpers import simulated
from tests.lagging_fixture import Lag, sail

HEAVY = Lag(every=8.0, stall_s=0.8, longest_s=3.0, link_s=0.05, jitter_s=0.8)


@pytest.mark.slow
@pytest.mark.parametrize(("by_s", "follows"), [(0.5, True), (-0.5, False)])
def test_answers_stay_honest_where_the_clock_is_set(by_s: float, *, follows: bool) -> None:
    """Arrivals are drawn, no clock is looked at; links delay by more than the clock was set by."""
    end_s = 60.0
    sim = simulated(
        duration_s=end_s,
        imu_rate_hz=50.0,
        grade=Grade.TACTICAL,
        dvl=DvlSettings(rate_hz=2.0),
        gnss=GnssSettings(windows=((0.0, end_s),)),
        route=SurveyRoute(line_m=60.0),
        seed=7,
    )
    sailed = sail(sim, [(35.0, by_s)], HEAVY, seed=7, gnss_follows=follows)
    good = [answer.sigmas for answer in sailed.answers if answer.is_good]
    assert len(good) > 200
    assert np.mean(np.less_equal(good, 3.0)) > 0.95
    assert sailed.worst < 5.0
    assert sailed.n_passed + sailed.n_refused == sailed.n_sent
