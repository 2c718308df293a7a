"""Sightings of points by a sonar or a camera; the place of each is a constant of the problem."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

from factors.feature_sighting import direction_axes, place_of_sighting, sight_residual
from ssm_graph.base.frozen import Array
from ssm_graph.base.times import Indices, is_inside, nearest
from ssm_graph.base.usable import require_fields
from ssm_graph.engine.error_state import POSITION, ROTATION
from ssm_graph.engine.extras import Extra
from ssm_graph.graph.aids.aid import Aid, Keyframes, Linearised, RowStates
from ssm_graph.mission.mission import Aids
from ssm_graph.sensors.dvl import R_bd_from_rpy
from ssm_graph.sensors.features import FeatureLog

_FEATURE: Final = "feature_"
"""Followed by the feature's number."""
ANYWHERE_M: Final = 1e5
"""Prior sigma of a place from the mission's origin: farther than a mission goes."""
AS_A_TURN_M: Final = 10.0
"""Metres across that turn the sight by some 1 rad: features are seen from tens of metres."""


def feature_name(number: int) -> str:
    """Return what the place of a feature is called, as an extra variable."""
    return f"{_FEATURE}{number}"


@dataclass(frozen=True, slots=True, eq=False)
class FeatureSightings(Aid):
    """Range and direction of features at their keyframes.

    A place that has no value yet is taken to be where the sighting puts it: seen from where nothing
    is known of it, a direction says nothing linear.
    """

    SHARED = frozenset({"lever_arm_b", "root"})
    name = "feature"
    unit = "sigma"
    hint = "look at the numbers of the features, and at mounting and clock of the sonar"
    section = FeatureLog.SECTION
    asks_for_keyframes = True
    is_live = False  # which features there are shows in the log alone, and variables begin with it

    feature: Indices
    """(M,) its number"""
    range_m: Array
    """(M,) m"""
    axes_b: Array
    """(M, 3, 3) of the measured direction, body axes, one a row"""
    lever_arm_b: Array
    """(3,) m"""
    root: Array
    """(3,) 1/m and 1/rad of range and angles"""

    @classmethod
    def of(cls, aids: Aids, keyframes: Keyframes) -> Self | None:
        """Return the sightings within the keyframes."""
        log = aids.get(FeatureLog)
        if log is None:
            return None
        time_s = keyframes.time_s
        used = is_inside(log.time_s, time_s[0], time_s[-1])
        axes = direction_axes(log.bearing[used], log.elevation[used])
        return cls(
            keyframe=nearest(time_s, log.time_s[used]),
            feature=log.feature[used].astype(np.intp),
            range_m=log.range_m[used],
            axes_b=axes @ R_bd_from_rpy(log.mounting_rpy).T,
            lever_arm_b=log.lever_arm_b,
            root=1.0 / np.array([log.range_sigma, log.angle_sigma, log.angle_sigma]),
        )

    @classmethod
    def variables(cls, aids: Aids) -> tuple[Extra, ...]:
        """Return the places of the features that were seen, from the mission's origin."""
        log = aids.get(FeatureLog)
        numbers = () if log is None else np.unique(log.feature).astype(int).tolist()
        return tuple(
            Extra(
                feature_name(number),
                tuple(f"{feature_name(number)}_{axis}_m" for axis in ("east", "north", "up")),
                np.full(3, ANYWHERE_M),
                as_a_turn=AS_A_TURN_M,
            )
            for number in numbers
        )

    @classmethod
    def require_usable(cls, aids: Aids) -> None:
        """Refuse numbers that are not finite, and ranges and sigmas that are not above zero."""
        log = aids.get(FeatureLog)
        if log is not None:
            finite = "time_s bearing elevation lever_arm_b mounting_rpy feature"
            positive = "range_sigma angle_sigma range_m"
            require_fields("aids.features", log, positive=positive, finite=finite)

    @classmethod
    def times(cls, aids: Aids) -> tuple[str, Array]:
        """Return when something was seen, s."""
        log = aids.get(FeatureLog)
        return "feature sighting", np.zeros(0) if log is None else np.unique(log.time_s)

    @property
    def root_information(self) -> Array:
        """(M, 3, 3) of errors in sigmas."""
        return np.broadcast_to(np.eye(3), (len(self), 3, 3))

    @property
    def labels(self) -> list[str]:
        """(3 M,) feature and component."""
        parts = ("range", "starboard", "up")
        return [f"{feature_name(n)} {part}" for n in self.feature.tolist() for part in parts]

    @property
    def waits(self) -> NDArray[np.bool_]:
        """(M,) all: one wrong sighting would put its feature where no right one finds it."""
        return np.ones(len(self), bool)

    def places_n(self, at: RowStates) -> Array:
        """Return where each sighting (M, 3) puts its feature, m."""
        return place_of_sighting(
            at.R_nb,
            at.p_n,
            lever_arm_b=self.lever_arm_b,
            axes_b=self.axes_b,
            range_m=self.range_m,
        )

    def measured(self, at: RowStates) -> Linearised:
        """Linearise sightings: three components each; those of no variable say nothing."""
        seen_n = self.places_n(at)
        stated = np.zeros_like(seen_n)
        known = np.zeros(seen_n.shape[:-1], bool)
        for number in np.unique(self.feature).tolist():
            if feature_name(number) in at.extras:
                is_its = self.feature == number
                known |= is_its
                value = at.value(feature_name(number), 3)
                stated = np.where(is_its[..., None], value, stated)
        has_place = np.any(stated != 0.0, axis=-1)
        place_n = np.where(has_place[..., None], stated, seen_n)
        found = sight_residual(
            at.R_nb,
            at.p_n,
            lever_arm_b=self.lever_arm_b,
            axes_b=self.axes_b,
            range_m=self.range_m,
            place_n=place_n,
        )
        by_place = found.error_D_place_n
        error = found.error + (by_place @ (stated - place_n)[..., None])[..., 0]
        jacobian = np.zeros((*error.shape, at.extras.width))
        jacobian[..., ROTATION] = found.error_D_rotation
        jacobian[..., POSITION] = found.error_D_position
        for number in np.unique(self.feature).tolist():
            name = feature_name(number)
            if name in at.extras:
                is_its = (self.feature == number)[..., None, None]
                jacobian[..., at.extras.columns(name)] = np.where(is_its, by_place, 0.0)
        counts = np.where(known, 1.0, 0.0)[..., None] * self.root
        return Linearised(counts * error, counts[..., None] * jacobian)
