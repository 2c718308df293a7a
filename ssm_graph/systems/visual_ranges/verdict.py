"""What a run is worth, in one word and in sentences: scale, anchors, losses, calibration."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ssm_graph.systems.visual_ranges.ranging import AnchorState, RangingResult
from ssm_graph.systems.visual_ranges.result import FrameState, MapSnapshot, VisualResult
from ssm_graph.systems.visual_ranges.start import StartRules, StartState

Array = NDArray[np.float64]

WRONG_CALIBRATION_PX: Final = 1.5
"""Median reprojection error after the adjustment from which the calibration is doubted."""
BENT_PX: Final = 1.0
"""Radial error at the corner of the image that a lens without coefficients should not have."""
LOST_SHARE: Final = 0.2
"""Of the images after the start without a pose: more is told as a fault."""


class Verdict(Enum):
    """The answer's worth."""

    READY = "path, map and anchors are in metres"
    MIRROR = "path and map are in metres; an anchor has other places that fit as well"
    DOUBTFUL = "the map is in metres, but look at the reasons before it is used"
    AMBIGUOUS = "the ranges do not tell the scale yet: path and map are in map units"
    NO_SCALE = "no ranges came, so nothing tells the scale: path and map are in map units"

    @property
    def has_scale(self) -> bool:
        """Whether lengths are metres."""
        return self in (Verdict.READY, Verdict.MIRROR, Verdict.DOUBTFUL)

    @property
    def is_good(self) -> bool:
        """Whether the answer may be used as it is."""
        return self in (Verdict.READY, Verdict.MIRROR)


@dataclass(frozen=True, slots=True)
class Judged:
    """A verdict with its reasons."""

    verdict: Verdict
    reasons: tuple[str, ...]
    advice: str
    """What to do next time, or ""."""


def judged(result: VisualResult) -> Judged:
    """Return what a result is worth."""
    faults = [*_losses(result), *_calibration(result)]
    ranging: RangingResult | None = result.ranging
    if ranging is None or not (len(ranging.weight) or ranging.has_scale):
        return Judged(
            Verdict.NO_SCALE,
            tuple(faults),
            "give ranges to an anchor (--ranges), or scale the map by one known length",
        )
    if not ranging.has_scale:
        reasons = (ranging.state.value, *ranging.reasons, *faults)
        return Judged(Verdict.AMBIGUOUS, reasons, ranging.advice)
    doubtful = [a.name for a in ranging.anchors if a.state is AnchorState.DOUBTFUL]
    if doubtful:
        faults.append(
            f"anchor {', '.join(doubtful)}: most of its last ranges contradict its place: it is "
            "hidden, or was moved"
        )
    if ranging.state is StartState.WITHOUT_RANGES:
        faults += [ranging.state.value, *ranging.reasons]
    if ranging.vehicle is not None and ranging.vehicle.contradiction:
        faults.append(ranging.vehicle.contradiction)
    if ranging.state is StartState.COARSE:
        faults.append(StartRules().coarse(ranging.sigma_log_scale))
    open_ones = [a.name for a in ranging.anchors if a.state is AnchorState.AMBIGUOUS]
    told = []
    if open_ones:
        told.append(f"anchor {', '.join(open_ones)}: other places fit as well, or it is not sharp")
    if faults:
        return Judged(Verdict.DOUBTFUL, (*faults, *told), ranging.advice)
    is_mirror = bool(open_ones) or ranging.state is StartState.MIRROR
    return Judged(
        Verdict.MIRROR if is_mirror else Verdict.READY,
        (*told, *(ranging.reasons if is_mirror else ())),
        ranging.advice if is_mirror else "",
    )


def _losses(result: VisualResult) -> list[str]:
    begun = np.flatnonzero(result.state == FrameState.TRACKED)
    if not len(begun):
        return []
    after = result.state[begun[0] :]
    n_lost = int((after == FrameState.LOST).sum())
    if n_lost <= LOST_SHARE * len(after):
        return []
    return [
        f"{n_lost} of {len(after)} images after the start have no pose "
        f"({100 * n_lost / len(after):.0f} %): too dark, too fast, or nothing to see"
    ]


def _calibration(result: VisualResult) -> list[str]:
    error, pixels = reprojection_errors(result)
    if len(error) < 200:
        return []
    found = []
    middle = float(np.median(np.linalg.norm(error, axis=1)))
    if middle > WRONG_CALIBRATION_PX:
        found.append(
            f"check the calibration: the median reprojection error is {middle:.1f} px (expected "
            f"below {WRONG_CALIBRATION_PX:g})"
        )
    camera = result.camera
    if camera.model == "pinhole":
        out = pixels - [camera.cx, camera.cy]
        radius = np.linalg.norm(out, axis=1)
        corner = float(np.hypot(camera.width, camera.height)) / 2.0
        cube = (radius / corner) ** 3
        radial = np.einsum("ni,ni->n", error, out) / np.maximum(radius, 1.0)
        bent = float(cube @ radial) / max(float(cube @ cube), 1e-9)
        if abs(bent) > BENT_PX:
            found.append(
                f"check the calibration: errors grow outwards to {abs(bent):.1f} px in the corner, "
                "as those of a distorted image without distortion coefficients do"
            )
    return found


def reprojection_errors(result: VisualResult) -> tuple[Array, Array]:
    """Return computed minus seen pixels (n, 2) of all observations in use, and the pixels seen."""
    world: MapSnapshot = result.map
    frame = np.repeat(np.arange(len(world.time_s)), np.diff(world.first_row))
    used = np.flatnonzero((world.point >= 0) & (np.nan_to_num(world.weight) > 0.0))
    place = world.points[world.point[used]]
    x_c = np.einsum("nij,nj->ni", world.R_cw[frame[used]], place) + world.t_cw[frame[used]]
    pixels = world.pixels[used].astype(np.float64)
    error = result.camera.project(x_c) - pixels
    is_good = np.isfinite(error).all(axis=1)
    return error[is_good], pixels[is_good]
