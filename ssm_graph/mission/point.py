"""A point of the vehicle where an answer is wanted: a camera, an antenna, a sonar head."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from ssm_graph.base.frozen import Array, FrozenArrays, shaped
from ssm_graph.base.settings import Key, Settings
from ssm_graph.base.units import DEGREE


def _still() -> Array:
    return np.zeros(3)


@dataclass(frozen=True, slots=True, eq=False)
class Point(FrozenArrays):
    """Where something is mounted, relative to the inertial unit, body axes forward-right-down."""

    name: str
    lever_arm_b: Array = shaped(3)
    """(3,) m, from the inertial unit to the point"""
    mounting: Array = field(default_factory=_still, metadata={"shape": (3,)})
    """(3,) rad, roll, pitch, yaw of its own axes forward, right, down against those of the body"""
    lever_arm_sigma: float = 0.0
    """m, of each component"""
    mounting_sigma: float = 0.0
    """rad, about each axis"""


POINT_KEYS: Final = {
    "name": Key(shape=None),
    "lever_arm_m": Key(
        "lever_arm_b",
        shape=(3,),
        low=-1000.0,
        high=1000.0,
        hint="lever arms are in metres",
        is_body=True,
    ),
    "mounting_roll_pitch_yaw_deg": Key(
        "mounting", shape=(3,), low=-360.0, high=360.0, required=False, unit=DEGREE
    ),
    "lever_arm_sigma_m": Key("lever_arm_sigma", positive=True, high=100.0, required=False),
    "mounting_sigma_deg": Key(
        "mounting_sigma", positive=True, high=180.0, required=False, unit=DEGREE
    ),
}
"""Of a section ``[[point]]``."""


def point(settings: Settings) -> Point:
    """Return the point that a section states."""
    given: dict[str, Any] = settings.given()
    return Point(name=settings.text("name"), **given)
