"""Whole runs: how far path, scale and anchors are off, and which loops lie.

Over rendered worlds, and over real images with ranges that are simulated along their true path.
"""

from __future__ import annotations

import os
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.errors import ConfigError, nearest_hint
from ssm_graph.study.ledger import Key, Row
from ssm_graph.systems.visual_ranges.accuracy import accuracy, true_places
from ssm_graph.systems.visual_ranges.loop_settings import LoopSettings
from ssm_graph.systems.visual_ranges.ranges import screened_ranges
from ssm_graph.systems.visual_ranges.readers.source import read_sequence
from ssm_graph.systems.visual_ranges.readers.starloc import read_starloc
from ssm_graph.systems.visual_ranges.result import FrameState, VisualResult
from ssm_graph.systems.visual_ranges.sequence import ImageOf, Sequence
from ssm_graph.systems.visual_ranges.settings import VisualSettings
from ssm_graph.systems.visual_ranges.similarity3 import umeyama
from ssm_graph.systems.visual_ranges.simulate import (
    SMALL_CAMERA,
    ImageFaults,
    Run,
    Simulated,
    simulate,
    under_water,
)
from ssm_graph.systems.visual_ranges.simulated_ranges import RangeFaults, with_simulated_ranges
from ssm_graph.systems.visual_ranges.system import run
from ssm_graph.systems.visual_ranges.tag_start import tag_path
from ssm_graph.systems.visual_ranges.verdict import judged

FIRST_FRESH: Final = 1000
"""Seeds below it are for choosing, from it on for reports."""
SMALL_CORNERS: Final = 350
"""Corners followed in a quarter of the pixels."""
SAME_PLACE_M: Final = 1.0
"""Error of the distance between two cameras from which a loop is false; walls repeat by 12.8 m."""
LAST_S: Final = 10.0
"""At the end of a run, in which the camera has to be back after what went wrong."""
FAR_TOO_LONG_M: Final = 0.5
"""Excess of a range out of sight that has to end without weight."""
NO_WEIGHT: Final = 0.1
"""Below it a range has none that matters."""


@dataclass(frozen=True, slots=True)
class Case:
    """A kind of run."""

    about: str
    run: Run
    has_ranges: bool = True
    has_loops: bool = True
    is_threaded: bool = False
    """Mapping beside tracking, as a user on the way would have it."""
    is_kept: bool = True
    """Whether all images are rendered before the run: they are not timed, but in memory."""


@dataclass(frozen=True, slots=True)
class Recorded:
    """Real images with simulated ranges, anchors placed by the seed."""

    about: str
    folder: str
    """Below ``systems`` of the folder that ``SSM_GRAPH_DATA`` names."""
    n_anchors: int
    """0: no ranges"""
    away_m: tuple[float, float]
    """Least and largest distance of an anchor from the middle of the path, level."""
    height_m: tuple[float, float]
    """The same upwards; cameras are level at first, so up is -y."""
    lever_sigma_m: float = 0.0
    """Of the place, beside the camera, that the truth is of and ranges are simulated from."""


NLOS: Final = RangeFaults(nlos_share=0.3)
HALF: Final = RangeFaults(nlos_share=0.5)
_KITCHEN: Final = ("kitchen", (1.5, 3.0), (0.5, 1.5))
_KITTI: Final = ("kitti07", (30.0, 60.0), (4.0, 8.0))
_ANCHORS: Final = ("no ranges", "one anchor", "", "three anchors")
_RECORDED: Final[Mapping[str, Recorded]] = {
    f"{name}-{n}" if n else f"{name}-mono": Recorded(
        f"{words}, {_ANCHORS[n]}", place[0], n, *place[1:]
    )
    for name, words, place in (
        ("kitchen", "7-Scenes kitchen", _KITCHEN),
        ("kitti", "KITTI 07", _KITTI),
    )
    for n in (0, 1, 3)
}
RECORDED: Final[Mapping[str, Recorded]] = {
    **_RECORDED,
    **{
        f"{name}-arm": replace(
            _RECORDED[name],
            about=f"{_RECORDED[name].about}, lever arm to be found",
            lever_sigma_m=sigma,
        )
        for name, sigma in (("kitchen-1", 0.05), ("kitchen-3", 0.05), ("kitti-1", 0.5))
    },
}
"""By name; with ``-arm`` what the truth is a path of, from which ranges are simulated, is not taken
for the camera: it may be elsewhere on the car, or on the sensor in the hand."""
TAGS: Final[Mapping[str, str]] = {
    f"tags-{name}": name for name in ("loop-2d_s5", "loop-3d_s5", "loop-2d-fast_s1")
}
"""Runs of STAR-loc, by tags and ranges alone; the radios of the last are not calibrated."""
CASES: Final[Mapping[str, Case]] = {
    "room": Case("room, one anchor", Run("room")),
    "room-mono": Case("room, no ranges", Run("room"), has_ranges=False),
    "room-nlos": Case("room, one anchor, 30 % NLOS", Run("room", ranges=NLOS)),
    "room-half": Case("room, one anchor, 50 % NLOS", Run("room", ranges=HALF)),
    "room-threads": Case(
        "room, one anchor, mapping beside tracking", Run("room"), is_threaded=True
    ),
    "room-long": Case(
        "room, one anchor, 2000 images", Run("room", duration_s=99.95), is_kept=False
    ),
    "room-covered": Case(
        "room, one anchor, the lens covered for 2 s",
        Run("room", images=ImageFaults(covered_s=(30.0, 32.0))),
    ),
    "room-silent": Case(
        "room, one anchor, no ranges for 20 s", Run("room", ranges=RangeFaults(silent_s=(25, 45)))
    ),
    "room-carried": Case(
        "room, one anchor, carried elsewhere under a covered lens for 12 s",
        Run("room", images=ImageFaults(covered_s=(30.0, 42.0))),
    ),
    "room-dropped": Case(
        "room, one anchor, 30 % of the images dropped",
        Run("room", images=ImageFaults(dropped_share=0.3)),
    ),
    "room-clock": Case(
        "room, one anchor, ranges stamped 50 ms late", Run("room", ranges=RangeFaults(clock_s=0.05))
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
    "bottom": Case("under water, depth and dead reckoning", under_water(0)),
    "bottom-bare": Case("under water, ranges alone", under_water(0, vehicle=None)),
    "bottom-silent": Case(
        "under water, depth and dead reckoning, no ranges", under_water(0), has_ranges=False
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
    name, seed, duration_s = str(key[0]), int(key[1]), float(key[2])
    if name in TAGS:
        return tag_trial(name)
    simulated = None
    if name in RECORDED:
        case = Case("", Run())
        sequence = recorded(RECORDED[name], seed, duration_s)
        images = [sequence.images(k) for k in range(len(sequence))]
        sequence = replace(sequence, images=images.__getitem__)
    else:
        case = case_of(name)
        asked = replace(case.run, seed=seed, duration_s=duration_s or case.run.duration_s)
        simulated = simulate(asked)
        sequence = simulated.sequence
        if case.is_kept:
            sequence = replace(sequence, images=_rendered_before(asked, sequence))
        if not case.has_ranges:
            sequence = replace(sequence, ranges=screened_ranges([], [], []))
    settings = VisualSettings(
        n_corners=SMALL_CORNERS if name.endswith("-small") else VisualSettings().n_corners,
        loops=LoopSettings(is_on=case.has_loops),
        is_deterministic=not case.is_threaded,
    )
    begin, wall = time.process_time(), time.perf_counter()
    result = run(sequence, settings)
    row = {"cpu_s": time.process_time() - begin, "wall_s": time.perf_counter() - wall}
    tracking = result.timing_s.get("tracking", np.zeros(1))
    row |= {
        "rate_hz": len(sequence) / row["wall_s"],
        "tracking_p99_s": float(np.percentile(tracking, 99)),
        "peak_mib": _peak_mib(),
        **_errors(sequence, result),
        **_loops(sequence, result),
    }
    return row if simulated is None else row | _weights(simulated, result)


def tag_trial(name: str) -> Row:
    """Return the errors of a run of STAR-loc from the centres of tags and ranges alone.

    Seconds and images are those in which a tag is seen; no seed plays a part.
    """
    recorded_run = read_starloc(data_folder() / "starloc" / TAGS[name])
    begin, wall = time.process_time(), time.perf_counter()
    found = tag_path(recorded_run.sightings, recorded_run.ranges, recorded_run.lever_arm_m)
    spent = {"cpu_s": time.process_time() - begin, "wall_s": time.perf_counter() - wall}
    image_s = np.unique(recorded_run.sightings.time_s)
    true = true_places(recorded_run.truth, image_s)
    kept = np.isfinite(true).all(axis=1)
    place = found.place[np.searchsorted(found.time_s, image_s[kept])]
    metric = umeyama(place, true[kept], with_scale=False)
    similar = umeyama(place, true[kept], with_scale=True)
    anchor_m = np.nan
    if len(found.anchors):
        away = metric.apply(found.anchors) - recorded_run.anchor_truth_m
        anchor_m = float(np.nanmax(np.linalg.norm(away, axis=1)))
    return {
        "verdict": found.state.name, "tracked": 1.0, "tracked_last": 1.0,
        "n_key_frames": len(found.time_s), "n_images": len(image_s),
        "metric_m": root_mean_square(metric.apply(place) - true[kept]),
        "similar_m": root_mean_square(similar.apply(place) - true[kept]),
        "scale": 1.0 / similar.scale - 1.0, "scale_sigma": found.sigma_log_scale,
        "anchor_m": anchor_m, "started_s": np.nan, "clock_s": found.clock_s,
        "rate_hz": len(image_s) / spent["wall_s"], "peak_mib": _peak_mib(), **spent,
        **dict.fromkeys(("taken_true", "taken_false", "refused_true", "refused_false"), 0),
    }  # fmt: skip


def root_mean_square(error: NDArray[np.float64]) -> float:
    """Return the rms length of errors (N, 3)."""
    return float(np.sqrt(np.mean(np.sum(error**2, axis=1))))


def _rendered_before(asked: Run, sequence: Sequence) -> ImageOf:
    """Return a simulated run's images, each rendered already; what is wrong with them is not."""
    faults = asked.images
    plain = replace(faults, covered_s=(0.0, 0.0), dropped_share=0.0)
    bare = replace(
        asked, n_anchors=0, ranges=RangeFaults(), images=plain, vehicle=None, range_scale_share=0.0
    )
    made = _rendered(bare)

    def image(index: int) -> NDArray[np.uint8]:
        time_s = float(sequence.time_s[index])
        if faults.covered_s[0] <= time_s < faults.covered_s[1]:
            return sequence.images(index)
        return np.asarray(made[round(time_s * asked.rate_hz)])

    return image


@lru_cache(maxsize=1)
def _rendered(asked: Run) -> NDArray[np.uint8]:
    """Return all images (N, H, W) of a run; runs of one path that follow each other share them."""
    sequence = simulate(asked).sequence
    return np.stack([sequence.images(k) for k in range(len(sequence))])


def _peak_mib() -> float:
    """Return the most memory that this process has had, MiB; NaN where the system does not say."""
    status = Path("/proc/self/status")
    if not status.exists():
        return float("nan")
    lines = [x for x in status.read_text(encoding="utf-8").splitlines() if x.startswith("VmHWM")]
    return float(lines[0].split()[1]) / 1024.0 if lines else float("nan")


def data_folder() -> Path:
    """Return the folder of the systems' data, from ``SSM_GRAPH_DATA``."""
    return Path(os.environ.get("SSM_GRAPH_DATA", "../shared/data")) / "systems"


def recorded(case: Recorded, seed: int, duration_s: float = 0.0) -> Sequence:
    """Return a recording with ranges to anchors that a seed places; 0 s: all of it."""
    sequence = read_sequence(data_folder() / case.folder)
    assert sequence.truth is not None
    rng, path = np.random.default_rng((seed, 14)), sequence.truth.position_m
    turn = rng.uniform(0.0, 2.0 * np.pi, case.n_anchors)
    away, up = rng.uniform(*case.away_m, turn.shape), rng.uniform(*case.height_m, turn.shape)
    middle = 0.5 * (path.min(axis=0) + path.max(axis=0))
    anchors = middle + np.stack([away * np.cos(turn), -up, away * np.sin(turn)], axis=1)
    sequence = with_simulated_ranges(sequence, anchors, seed)
    sequence = replace(sequence, lever_arm_sigma_m=case.lever_sigma_m)
    if not duration_s:
        return sequence
    kept = sequence.time_s < sequence.time_s[0] + duration_s
    return replace(sequence, time_s=sequence.time_s[kept])


def _errors(sequence: Sequence, result: VisualResult) -> dict[str, Any]:
    off, found = accuracy(sequence, result), judged(result)
    tracked = result.state == FrameState.TRACKED
    row: dict[str, Any] = {
        "verdict": found.verdict.name,
        "tracked": float(np.mean(tracked)),
        "tracked_last": float(np.mean(tracked[result.time_s > result.time_s[-1] - LAST_S])),
        "n_key_frames": len(result.map.time_s),
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
        row["clock_s"] = float(result.ranging.clock_s)
    return row


def _weights(simulated: Simulated, result: VisualResult) -> dict[str, Any]:
    """Return how many ranges that are far too long end without weight, and the others' mean."""
    sequence, row = simulated.sequence, {"nlos_dropped": np.nan, "clear_weight": np.nan}
    truth, anchors, ranges = sequence.truth, sequence.anchor_truth_m, sequence.ranges
    if result.ranging is None or not len(result.ranging.weight) or truth is None:
        return row
    assert anchors is not None
    place = true_places(truth, ranges.time_s + result.ranging.clock_s)
    away = np.linalg.norm(place - anchors[ranges.anchor], axis=1)
    excess = ranges.range_m - away - simulated.bias_m
    known = np.isfinite(result.ranging.weight)
    long = known & simulated.is_nlos & (excess > FAR_TOO_LONG_M)
    clear = known & ~simulated.is_nlos
    if long.any():
        row["nlos_dropped"] = float(np.mean(result.ranging.weight[long] < NO_WEIGHT))
    if clear.any():
        row["clear_weight"] = float(np.mean(result.ranging.weight[clear]))
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
