"""Whole runs over rendered worlds: how far path, scale and anchors are off, and which loops lie."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from ssm_graph.base.errors import ConfigError, nearest_hint
from ssm_graph.study.ledger import Key, Row
from ssm_graph.systems.visual_ranges.accuracy import accuracy, true_places
from ssm_graph.systems.visual_ranges.loop_settings import LoopSettings
from ssm_graph.systems.visual_ranges.ranges import screened_ranges
from ssm_graph.systems.visual_ranges.result import FrameState, VisualResult
from ssm_graph.systems.visual_ranges.sequence import Sequence
from ssm_graph.systems.visual_ranges.settings import VisualSettings
from ssm_graph.systems.visual_ranges.simulate import (
    SMALL_CAMERA,
    ImageFaults,
    RangeFaults,
    Run,
    simulate,
)
from ssm_graph.systems.visual_ranges.system import run
from ssm_graph.systems.visual_ranges.verdict import judged

FIRST_FRESH: Final = 1000
"""Seeds below it are for choosing, from it on for reports."""
SAME_PLACE_M: Final = 1.0
"""Error of the distance between two cameras from which a loop is false; walls repeat by 12.8 m."""


@dataclass(frozen=True, slots=True)
class Case:
    """A kind of run."""

    about: str
    run: Run
    has_ranges: bool = True
    has_loops: bool = True


NLOS: Final = RangeFaults(nlos_share=0.3)
CASES: Final[Mapping[str, Case]] = {
    "room": Case("room, one anchor", Run("room")),
    "room-mono": Case("room, no ranges", Run("room"), has_ranges=False),
    "room-nlos": Case("room, one anchor, 30 % NLOS", Run("room", ranges=NLOS)),
    "room-covered": Case(
        "room, one anchor, the lens covered for 2 s",
        Run("room", images=ImageFaults(covered_s=(30.0, 32.0))),
    ),
    "room-silent": Case(
        "room, one anchor, no ranges for 20 s", Run("room", ranges=RangeFaults(silent_s=(25, 45)))
    ),
    "corridor": Case("corridor, one anchor", Run("corridor", duration_s=63.0)),
    "corridor-mono": Case(
        "corridor, no ranges", Run("corridor", duration_s=63.0), has_ranges=False
    ),
    "corridor-open": Case(
        "corridor, one anchor, loops off", Run("corridor", duration_s=63.0), has_loops=False
    ),
    "corridor-nlos": Case(
        "corridor, three anchors, 30 % NLOS",
        Run("corridor", duration_s=63.0, n_anchors=3, ranges=NLOS),
    ),
}
"""By name; a name that ends in ``-small`` is the same in a quarter of the pixels."""


def case_of(name: str) -> Case:
    """Return a case by its name.

    Raises :class:`ConfigError` for one that is not known.
    """
    bare = name.removesuffix("-small")
    if bare not in CASES:
        raise ConfigError(f"case {name!r}: {nearest_hint(bare, CASES)}")
    found = CASES[bare]
    if name != bare:
        found = replace(found, run=replace(found.run, camera=SMALL_CAMERA))
    return found


def trial(key: Key) -> Row:
    """Do one run; the key is the name of a case, a seed, and how long, s (0: as the case says)."""
    case = case_of(str(key[0]))
    duration_s = float(key[2]) or case.run.duration_s
    sequence = simulate(replace(case.run, seed=int(key[1]), duration_s=duration_s)).sequence
    if not case.has_ranges:
        sequence = replace(sequence, ranges=screened_ranges([], [], []))
    images = [sequence.images(k) for k in range(len(sequence))]  # rendering is not timed
    sequence = replace(sequence, images=lambda k: images[k])
    settings = VisualSettings(loops=LoopSettings(is_on=case.has_loops))
    begin = time.process_time()
    result = run(sequence, settings)
    cpu_s = time.process_time() - begin
    return {**_errors(sequence, result), **_loops(sequence, result), "cpu_s": cpu_s}


def _errors(sequence: Sequence, result: VisualResult) -> dict[str, Any]:
    off, found = accuracy(sequence, result), judged(result)
    tracked = result.state == FrameState.TRACKED
    row: dict[str, Any] = {
        "verdict": found.verdict.name,
        "tracked": float(np.mean(tracked)),
        "n_images": len(result.time_s),
        "metric_m": np.nan,
        "similar_m": np.nan,
        "scale": np.nan,
        "anchor_m": np.nan,
        "started_s": np.nan,
    }
    if off is not None:
        row |= {"metric_m": off.metric_m, "similar_m": off.similar_m, "scale": off.scale_error}
        if np.isfinite(off.anchor_m).any():
            row["anchor_m"] = float(np.nanmax(off.anchor_m))
    if result.ranging is not None:
        row["started_s"] = float(result.ranging.started_s - result.time_s[0])
        row["scale_sigma"] = float(result.ranging.sigma_log_scale)
    return row


def _loops(sequence: Sequence, result: VisualResult) -> dict[str, Any]:
    """Count loops by whether the cameras are in truth as far apart as the loop has them."""
    counts = {"taken_true": 0, "taken_false": 0, "refused_true": 0, "refused_false": 0}
    off = accuracy(sequence, result)
    if sequence.truth is None or off is None:
        return counts
    for loop in result.loops:
        both = true_places(sequence.truth, np.array([loop.time_s, loop.matched_s]))
        claimed_m = off.to_world.scale * loop.apart
        is_true = abs(float(np.linalg.norm(both[1] - both[0])) - claimed_m) < SAME_PLACE_M
        kind = f"{'taken' if loop.is_taken else 'refused'}_{'true' if is_true else 'false'}"
        counts[kind] += 1
    return counts
