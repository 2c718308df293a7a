"""Smoothed states that have left the window, as users know them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ssm_graph.base.earth import LocalFrame
from ssm_graph.engine.extras import Extras
from ssm_graph.graph.measurements import aid_table
from ssm_graph.mission.answer import trajectory_at
from ssm_graph.mission.estimate import AidTable, BeamTable, CurrentTrack, Trajectory
from ssm_graph.smoothers.track import Stretch, current_along


class Delayed(NamedTuple):
    """Some successive keyframes: rows for ``trajectory.csv`` and ``beams.csv``."""

    trajectory: Trajectory
    beams: BeamTable
    current: CurrentTrack | None
    """Beside the trajectory; None of a vehicle without one."""
    aids: AidTable | None
    """What became of the aids' measurements; None if there were none."""


def delayed_of(stretch: Stretch, frame: LocalFrame, extras: Extras, *, shift_s: float) -> Delayed:
    """Return a stretch on the vehicle's clock, which is ``shift_s`` behind ours.

    ``extras`` are what each keyframe of it carries beside the error state.
    """
    time_s = stretch.time_s - shift_s
    return Delayed(
        trajectory_at(frame, time_s, stretch.states, stretch.covariance, n_beams=stretch.n_beams),
        BeamTable(
            time_s=np.repeat(time_s, stretch.n_beams.astype(int)),
            beam=(stretch.beam + 1).astype(np.float64),
            innovation=stretch.innovation,
            mahalanobis_sq=stretch.mahalanobis_sq,
            weight=stretch.weight,
        ),
        current_along(extras, stretch._replace(time_s=time_s)),
        aid_table([one._replace(time_s=one.time_s - shift_s) for one in stretch.aids.values()]),
    )
