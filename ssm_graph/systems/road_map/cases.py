"""Methods and cases of a study of drives over maps, by name."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

METHODS: Final = ("annealed", "patent", "patent-min-max", "patent-sum")
CASES: Final[Mapping[str, str]] = {
    "plain": "200 m at 8 m/s, the map is true",
    "damaged": "5 % of the boundaries missing in the map, 2 % shifted by 0.5 m",
    "traffic": "30 % of the pictures occluded beyond 8 to 20 m, 3 % of the curves false",
    "motorway": "400 m at 25 m/s",
    "short": "80 m at 8 m/s, for maps of one junction",
    "left-hand": "as plain, the map seen in a mirror",
    "no course": "as plain, by a receiver that gives no course",
}
