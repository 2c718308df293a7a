"""What can be said of the lane, when, and why."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np

from ssm_graph.base.frozen import Array
from ssm_graph.filters.rules.hypotheses import Hypothesis
from ssm_graph.systems.road_map.hypotheses import apart, is_same_lane


class Verdict(Enum):
    """What can be said of the lane; the text is shown to the user."""

    CONVERGED = "the lane is known, and the place along it"
    UNRESOLVED_ALONG = "the lane is known, the place along it is not: the road looks alike there"
    AMBIGUOUS = "more than one lane explains what was seen"
    FAILED = "no lane explains what was seen"

    @property
    def has_lane(self) -> bool:
        """Whether the lane is known."""
        return self in (Verdict.CONVERGED, Verdict.UNRESOLVED_ALONG)


@dataclass(frozen=True, slots=True, kw_only=True)
class VerdictSettings:
    """When the lane is held to be known."""

    least_driven_m: float = 12.0
    window_m: float = 45.0
    """Of the stretch that is laid on the map to find rivals."""
    again_after_m: float = 5.0
    """Between two looks at the rivals while the lane is not known ..."""
    watch_m: float = 80.0
    """... and once it is."""
    misfit: float = 3.0
    """Loss of log evidence per curve beyond which nothing explains what was seen."""
    along_sigma_m: float = 4.0
    """More is not resolved along the road."""
    refined_pictures: int = 40


def reason_of(
    verdict: Verdict,
    hypotheses: Sequence[Hypothesis],
    most_misfit: float,
    pose: Array,
    sigmas: tuple[float, float, float],
) -> str:
    """Return why a verdict is what it is, with the strongest rival."""
    if not hypotheses:
        return "no curve was seen in the last stretch, so nothing tells one lane from another"
    best = hypotheses[0]
    if verdict is Verdict.FAILED:
        return (
            f"the best place explains the curves with a loss of {best.misfit:.1f} each, expected "
            f"below {most_misfit:.1f}: another place, an old map, curves in other axes, or a yaw "
            "rate of the other sign"
        )
    rival = next((h for h in hypotheses if not is_same_lane(h, pose)), None)
    told = ""
    if rival is not None:
        across, along, turn = apart(pose, np.array(rival.pose))
        told = (
            f"; rival {across:+.1f} m across, {along:+.1f} m along, turned {np.degrees(turn):+.0f} "
            f"deg, with {100.0 * rival.share:.1f} % of the evidence"
        )
    if verdict is Verdict.UNRESOLVED_ALONG:
        return f"sigma along the road {sigmas[1]:.1f} m, across {sigmas[0]:.2f} m{told}"
    if verdict is Verdict.AMBIGUOUS:
        return f"the best place has {100.0 * best.share:.0f} % of the evidence{told}"
    return f"sigma across {sigmas[0]:.3f} m, along {sigmas[1]:.2f} m{told}"
