"""Numbers that no instrument on an underwater vehicle means: beyond them is a code or another unit.

They do not judge an instrument; they are so wide that nothing real leaves them.
"""

from __future__ import annotations

from typing import Final

LARGEST_SPEED: Final = 30.0
"""m/s along a beam"""
DEEPEST_M: Final = 12_000.0
"""Depth, positive down"""
LON_RANGE_DEG: Final = (-180.0, 360.0)
"""Longitudes as people write them: west of Greenwich below zero, or once around to the east"""
HIGHEST_M: Final = 100.0
"""Above the surface: a pressure sensor in air, and tides"""
