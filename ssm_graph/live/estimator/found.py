"""What a live estimator knows by now beside the state of the vehicle."""

from __future__ import annotations

from ssm_graph.mission.estimate import Found
from ssm_graph.smoothers.track import calibration_of_last, current_along
from ssm_graph.smoothers.window import Window


def found_by(window: Window, *, begun_s: float) -> Found:
    """Return it as the newest keyframe carries it; ``begun_s`` is when the estimator began."""
    extras, newest = window.sensors.extras, window.newest
    span_s = float(newest.time_s[0]) - begun_s
    return Found(calibration_of_last(extras, newest, span_s=span_s), current_along(extras, newest))
