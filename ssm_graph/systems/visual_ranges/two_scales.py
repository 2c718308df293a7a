"""Whether a vehicle's own scale and that of its ranges are one: asked of the ranges alone.

Together they are no witness of each other: the place of a single anchor takes up a scale that is
wrong, and the residuals stay small. So the start is searched again without the vehicle.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from ssm_graph.systems.visual_ranges.range_terms import Places
from ssm_graph.systems.visual_ranges.start import Start, StartRules, find_start

SIGMAS: Final = 3.0
"""From which two scales contradict each other."""


class OwnScale(NamedTuple):
    """What something other than ranges knows of the scale."""

    name: str
    log_scale: float
    sigma: float
    """Of the logarithm, the ranges' own unit (sound speed) included."""


def contradiction(
    places: Places,
    names: tuple[str, ...],
    own: OwnScale,
    rules: StartRules,
    *,
    spacing: tuple[tuple[int, int, float], ...] = (),
) -> str:
    """Return what speaks against the two scales being one; "" where nothing does.

    All solutions count that the ranges leave open: a scale that is like one of them is not
    contradicted.

    Parameters
    ----------
    places : of the ranges, in order of time, as vision has them.
    names : (J,) of their anchors.
    spacing : pairs of anchors and their distances, m, where known.
    """
    start: Start = find_start(places, names, rules, turned_rad=np.inf, spacing=spacing)
    if start.solution is None:
        return ""
    told: list[tuple[float, float]] = []
    for one in (start.solution, *start.alternatives):
        apart = own.log_scale - float(np.log(one.scale))
        told.append((abs(apart) / float(np.hypot(own.sigma, one.sigma_log_scale)), apart))
    sigmas, apart = min(told)
    if sigmas < SIGMAS:
        return ""
    percent: float = 100.0 * float(np.expm1(apart))
    several = "s" if len(names) > 1 else ""
    return (
        f"the scale of the {own.name} is {abs(percent):.1f} % {'above' if percent > 0 else 'below'}"
        f" that of the ranges to anchor{several} {', '.join(names)} alone, {sigmas:.1f} sigma: one "
        "of them is wrong; compare both with a known length"
    )
