"""Trials of starts: a simulated walk or a known shape, a drifting path, ranges of all kinds.

A trial is the start alone, on true places with a drift, without images: hundreds are done in
minutes.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from scipy.spatial.transform import Rotation

from factors.so3 import exp
from ssm_graph.base.frozen import Array
from ssm_graph.study.ledger import Key
from ssm_graph.systems.visual_ranges.range_terms import FramePoses, Places, hang, places_of
from ssm_graph.systems.visual_ranges.readers.starloc import StarLocRun
from ssm_graph.systems.visual_ranges.simulate import (
    Run,
    corridor_path,
    room_path,
    simulate,
)
from ssm_graph.systems.visual_ranges.simulated_ranges import RangeFaults
from ssm_graph.systems.visual_ranges.start import Start, find_start

UNIT_M: Final = 2.5
"""Metres a map unit in all trials."""
N_PLACES: Final = 200
SHAPE_S: Final = 20.0
SHAPE_SIGMA_M: Final = 0.08
SHAPES: Final = (
    "standing still",
    "turning only",
    "line",
    "line through the anchor",
    "plane curve",
    "circle",
    "circle about the anchor's axis",
    "sphere",
    "helix",
    "plane curve with 0.1 m heave",
    "circle with 0.3 m heave",
)
"""The motions of the table of observability."""
NEVER_READY: Final = frozenset((*SHAPES[:4], *SHAPES[5:7]))


def walk_trial(key: Key) -> dict[str, Any]:
    """Return how a start on a simulated walk went.

    ``key`` is (world, seconds, anchors, NLOS share, drift as a share of the way, seed).
    """
    world, duration, n_anchors, share, drift, seed = key
    run = Run(
        str(world),
        int(seed),
        duration_s=float(duration),
        n_anchors=int(n_anchors),
        ranges=RangeFaults(nlos_share=float(share), occlusion=False),
    )
    simulated = simulate(run)
    ranges, anchors = simulated.sequence.ranges, simulated.sequence.anchor_truth_m
    assert anchors is not None
    path = room_path(run.seed) if run.world == "room" else corridor_path(run.seed)
    camera = path.place(ranges.time_s) + _drift(path.place(ranges.time_s), float(drift), run.seed)
    none = np.zeros_like(camera)
    places = Places(
        camera / UNIT_M,
        np.gradient(camera, ranges.time_s, axis=0) / UNIT_M,
        none,
        none,
        ranges.anchor,
        ranges.range_m,
        ranges.sigma_m,
        ranges.time_s,
    )
    turned = float(np.ptp(path.heading(ranges.time_s)[:, 0]))
    return scored(find_start(places, ranges.names, turned_rad=turned), UNIT_M, anchors)


def shape_trial(key: Key) -> dict[str, Any]:
    """Return how a start on a known shape went; ``key`` is (shape, drift, seed)."""
    name, drift, seed = str(key[0]), float(key[1]), int(key[2])
    rng = np.random.default_rng((seed, SHAPES.index(name), 12))
    time = np.linspace(0.0, SHAPE_S, N_PLACES)
    place, anchor = shape_path(name, time)
    turn = exp(rng.normal(size=3))
    place, anchor = place @ turn.T, turn @ anchor
    noise = SHAPE_SIGMA_M * rng.standard_normal(N_PLACES)
    measured = np.linalg.norm(place - anchor, axis=1) + 0.05 + noise
    camera = place + _drift(place, drift, seed) + 0.002 * rng.normal(size=place.shape)
    none = np.zeros_like(camera)
    places = Places(
        camera / UNIT_M,
        np.gradient(camera, time, axis=0) / UNIT_M,
        none,
        none,
        np.zeros(N_PLACES, dtype=np.intp),
        measured,
        np.full(N_PLACES, SHAPE_SIGMA_M),
        time,
    )
    turned = 1.0 if name == "turning only" else 0.0
    return scored(find_start(places, ("A0",), turned_rad=turned), UNIT_M, anchor[None])


def shape_path(name: str, time_s: Array) -> tuple[Array, Array]:
    """Return places (N, 3) of a shape about the origin, of 3 m extent, and an anchor (3,), m."""
    share = time_s / time_s[-1]
    round_, zero = 2.0 * np.pi * share, np.zeros_like(share)
    anchor = np.array([2.5, 1.0, 1.5])
    circle = np.stack([1.5 * np.cos(round_), 1.5 * np.sin(round_), zero], axis=1)
    curve = np.stack([1.5 * np.sin(round_), 1.2 * np.sin(2.0 * round_), zero], axis=1)
    up = np.array([0.0, 0.0, 1.0])
    if name in ("standing still", "turning only"):
        return np.zeros((len(share), 3)), anchor
    if name == "line":
        return np.outer(3.0 * (share - 0.5), [1.0, 0.0, 0.0]), anchor
    if name == "line through the anchor":
        return np.outer(3.0 * (share - 0.5), anchor / np.linalg.norm(anchor)), anchor
    if name == "circle":
        return circle, anchor
    if name == "circle about the anchor's axis":
        return circle, 2.0 * up
    if name == "sphere":
        east, north = 2.2 * round_, 0.9 * np.sin(round_)
        flat = np.cos(north)
        ball = np.stack([flat * np.cos(east), flat * np.sin(east), np.sin(north)], axis=1)
        return 1.5 * ball, anchor
    if name == "helix":
        two = 2.0 * round_
        return np.stack([1.5 * np.cos(two), 1.5 * np.sin(two), 1.5 * (share - 0.5)], 1), anchor
    if name == "plane curve with 0.1 m heave":
        return curve + np.outer(0.1 * np.sin(5.0 * round_), up), anchor
    if name == "circle with 0.3 m heave":
        return circle + np.outer(0.3 * np.sin(3.0 * round_), up), anchor
    return curve, anchor


def _drift(place: Array, share: float, seed: int) -> Array:
    """Return a random walk (N, 3) whose end has a standard deviation of a share of the way, m."""
    rng = np.random.default_rng((seed, 13))
    step = np.linalg.norm(np.diff(place, axis=0, prepend=place[:1]), axis=1)
    way = max(float(step.sum()), 1e-12)
    walk = np.cumsum(rng.normal(size=place.shape) * np.sqrt(step / way)[:, None], axis=0)
    return np.asarray(share * way * walk)


def scored(start: Start, unit_m: float, anchors: Array) -> dict[str, Any]:
    """Return a row: state, errors, and errors in sigmas."""
    row: dict[str, Any] = {
        "state": start.state.name,
        "motion": "" if start.shape is None else start.shape.motion.name,
        "gap": float(start.gap),
        "reasons": " | ".join(start.reasons),
        "n_alternatives": len(start.alternatives),
    }
    found = start.solution
    if found is None:
        return row
    away = np.linalg.norm(found.anchors - anchors, axis=1)
    row["scale_percent"] = 100.0 * (found.scale / unit_m - 1.0)
    row["sigma_percent"] = 100.0 * found.sigma_log_scale
    row["anchor_m"] = [float(x) for x in away]
    row["anchor_sigma_m"] = [
        float(np.sqrt(np.trace(found.anchor_covariance(j)))) for j in range(len(anchors))
    ]
    row["anchor_ready"] = [bool(x) for x in start.anchor_ready]
    both = (found, *start.alternatives)
    row["truth_listed"] = bool(
        any(
            abs(np.log(one.scale / unit_m)) < max(3.0 * one.sigma_log_scale, 0.02)
            and float(np.linalg.norm(one.anchors[0] - anchors[0]))
            < max(3.0 * float(np.sqrt(np.trace(one.anchor_covariance(0)))), 0.2)
            for one in both
        )
    )
    return row


def starloc_trial(run: StarLocRun, names: tuple[str, ...]) -> dict[str, Any]:
    """Return how a start on the true path of a real run, in map units, went with some anchors."""
    truth, ranges = run.truth, run.ranges
    kept = np.flatnonzero(np.isin(ranges.anchor, [ranges.names.index(name) for name in names]))
    order = [ranges.names.index(name) for name in names]
    R_cw = np.swapaxes(Rotation.from_quat(truth.quaternion).as_matrix(), 1, 2)
    t_cw = -np.einsum("nij,nj->ni", R_cw, truth.position_m / UNIT_M)
    frames = FramePoses(truth.time_s, R_cw, t_cw, np.arange(len(R_cw)))
    terms = hang(ranges.rows(kept), frames, R_cw, t_cw, lever_arm_m=run.lever_arm_m)
    places = places_of(terms, R_cw, t_cw, ranges.time_s[kept])
    column = np.full(ranges.n_anchors, -1, dtype=np.intp)
    column[order] = np.arange(len(order))
    places = places._replace(anchor=column[places.anchor])
    start = find_start(places, names, turned_rad=1.0)
    return scored(start, UNIT_M, run.anchor_truth_m[order])
