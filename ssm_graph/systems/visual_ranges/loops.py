"""Places seen before: found by words, checked by geometry, judged by ranges and by the path.

Repeated texture makes false loops look true, with any number of inliers. Two judges do not look at
the image: the ranges of the last seconds, whose path the loop would carry along as one piece, and
the drift that the loop claims, which is small beside the path that was walked between.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ssm_graph.systems.visual_ranges.binary_words import PlaceIndex
from ssm_graph.systems.visual_ranges.camera import Camera
from ssm_graph.systems.visual_ranges.extras import opencv
from ssm_graph.systems.visual_ranges.geometry import Pose, in_camera, refine_pose
from ssm_graph.systems.visual_ranges.loop_settings import LoopSettings
from ssm_graph.systems.visual_ranges.ranging import AnchorState, Ranging
from ssm_graph.systems.visual_ranges.similarity3 import Sim3
from ssm_graph.systems.visual_ranges.visual_map import VisualMap

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

OCTAVE: Final = 1.2
"""Each octave of key points is coarser by it."""
GUIDED_PX: Final = 8.0
"""From where a point should be, within which its key point is looked for ..."""
GUIDED_BITS: Final = 60
"""... that differs by fewer bits."""
NEIGHBOURS: Final = 6
JUDGED_S: Final = 5.0
"""Of the path before a loop, whose ranges judge it."""
LEAST_JUDGES: Final = 10
"""Ranges."""
INLIER_SQUARE: Final = 9.21
"""Squared sigmas in two dimensions, 99 %."""


class RangeJudgement(NamedTuple):
    """What the ranges of the last seconds say to a loop."""

    before_m: float
    """Median of the sizes of their errors as things stand."""
    after_m: float
    """The same with the path carried along by the loop."""
    sigma_m: float
    """Their median standard deviation."""
    n_ranges: int


Judge = Callable[[Sim3, int], RangeJudgement | None]
"""Of the correction (drifted map to old map) and the key frame; None where no anchor is placed."""


@dataclass(frozen=True, slots=True)
class Loop:
    """One loop that was thought of: taken or refused, and why."""

    time_s: float
    key_frame: int
    matched: int
    """Key frame of the same place."""
    matched_s: float
    """Its time."""
    n_matches: int
    n_inliers: int
    scale: float
    """By which the new part of the map has to grow."""
    shift: float
    """How far the key frame moves, map units."""
    apart: float
    """Between the two cameras, as the loop has it, map units."""
    path: float
    """Walked between the two, map units."""
    judgement: RangeJudgement | None
    is_taken: bool
    why: str


@dataclass(frozen=True, slots=True, eq=False)
class Match:
    """Two key frames of one place, by geometry."""

    key_frame: int
    matched: int
    n_matches: int
    correction: Sim3
    """Drifted map to old map."""
    scale_sigma: float
    """Of the logarithm of its scale."""
    rows: Indices
    """(n,) key points of the key frame ..."""
    points: Indices
    """(n,) ... and the old points they show."""


@dataclass(slots=True, eq=False)
class LoopFinder:
    """Finds loops as key frames come."""

    camera: Camera
    settings: LoopSettings = field(default_factory=LoopSettings)
    records: list[Loop] = field(default_factory=list)
    """All that were thought of."""
    _index: PlaceIndex = field(default_factory=PlaceIndex)
    _agreed: list[tuple[set[int], int]] = field(default_factory=list)
    _last_taken: int = -(10**9)

    def look(self, world: VisualMap, k: int, judge: Judge | None = None) -> Match | None:
        """Add key frame ``k`` and return the loop to be closed with it, if there is one."""
        self.add(world, k)
        if not self.settings.is_on or k - self._last_taken < self.settings.rest:
            return None
        candidates = self._candidates(world, k)
        groups = [(c, self.group_of(world, c)) for c in candidates]
        agreed = []
        for candidate, group in groups:
            before = [count for other, count in self._agreed if other & group]
            agreed.append((candidate, group, 1 + max(before, default=0)))
        self._agreed = [(group, count) for _, group, count in agreed]
        for candidate, group, count in agreed:
            if count < self.settings.agree_with_ranges:
                continue
            match = match_place(world, k, candidate, sorted(group), self.camera, self.settings)
            if match is None:
                continue
            loop = self._judged(world, match, count, judge)
            self.records.append(loop)
            if loop.is_taken:
                self._last_taken = k
                self._agreed = []
                return match
        return None

    def add(self, world: VisualMap, k: int) -> None:
        """Add a key frame's descriptors; key frames come in the order of their indices."""
        while len(self._index) <= k:
            self._index.add(world.rows["descriptor"][world.rows_of(len(self._index))])

    def alike(self, descriptors: NDArray[np.uint8], n: int) -> list[int]:
        """Return the ``n`` key frames most alike to descriptors (m, 32), best first."""
        scores = self._index.scores(descriptors)
        return [int(k) for k in np.argsort(-scores, kind="stable")[:n] if scores[k] > 0.0]

    def _candidates(self, world: VisualMap, k: int) -> list[int]:
        s = self.settings
        if not self._index.is_ready or k < s.least_gap:
            return []
        scores = self._index.scores(world.rows["descriptor"][world.rows_of(k)])
        shared = world.shared(k)[: len(scores)]
        near = np.flatnonzero((shared >= 30) & (np.arange(len(shared)) != k))
        near = near[near >= k - s.least_gap]
        reference = scores[near].max(initial=0.0)
        is_open = np.arange(len(scores)) <= k - s.least_gap
        is_open &= (shared < 15) & (scores > s.score_share * reference)
        found: list[int] = []
        for c in np.flatnonzero(is_open)[np.argsort(-scores[is_open], kind="stable")]:
            if all(abs(int(c) - other) > 3 for other in found):
                found.append(int(c))
        return found[: s.n_candidates]

    @staticmethod
    def group_of(world: VisualMap, k: int) -> set[int]:
        """Return a key frame and the few that share most points with it."""
        shared = world.shared(k)
        best = np.argsort(-shared, kind="stable")[:6]
        return {k, *(int(other) for other in best if shared[other] >= 30)}

    def _judged(self, world: VisualMap, match: Match, count: int, judge: Judge | None) -> Loop:
        s, k = self.settings, match.key_frame
        centres = -np.einsum("nji,nj->ni", world.frames["R_cw"], world.frames["t_cw"])
        way = np.linalg.norm(np.diff(centres[match.matched : k + 1], axis=0), axis=1)
        path = float(way.sum())
        shift = float(np.linalg.norm(match.correction.apply(centres[k]) - centres[k]))
        found = None if judge is None else judge(match.correction, k)
        limit = s.drift_alone if found is None else s.drift_with_ranges
        why = ""
        if not 1.0 / s.scale_limit < match.correction.scale < s.scale_limit:
            why = f"its scale would be {match.correction.scale:.2f}"
        elif found is not None:
            most = max(s.range_limit_m, s.range_limit_sigmas * found.sigma_m)
            if found.after_m >= most:
                why = f"the ranges contradict it by {found.after_m:.2f} m (limit {most:.2f} m)"
        elif count < s.agree_alone:
            why = f"{count} key frames in a row find it, {s.agree_alone} are wanted without ranges"
        if not why and shift > limit * path:
            why = f"it would move the camera by {100.0 * shift / path:.0f} % of the path between"
        told = f"{len(match.rows)} inliers of {match.n_matches} matches"
        if not why and found is not None:
            told += f", ranges agree to {found.after_m:.2f} m ({found.before_m:.2f} m before)"
        time_s = float(world.frames["time_s"][k])
        return Loop(
            time_s,
            k,
            match.matched,
            float(world.frames["time_s"][match.matched]),
            match.n_matches,
            len(match.rows),
            match.correction.scale,
            shift,
            float(np.linalg.norm(match.correction.apply(centres[k]) - centres[match.matched])),
            path,
            found,
            not why,
            why or told,
        )


def bit_distances(a: NDArray[np.uint8], b: NDArray[np.uint8]) -> NDArray[np.int32]:
    """Return how many bits differ (n, m) between descriptors (n, 32) and (m, 32)."""
    signs_a, signs_b = (2.0 * np.unpackbits(x, axis=1).astype(np.float32) - 1.0 for x in (a, b))
    return np.asarray((signs_a.shape[1] - signs_a @ signs_b.T) / 2.0).astype(np.int32)


def mutual(distance: NDArray[np.int32], most: int, ratio: float = 1.0) -> tuple[Indices, Indices]:
    """Return the pairs (row, column) that are each other's best, clearly so, and below ``most``."""
    if min(distance.shape) < 2:
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    rows = np.arange(len(distance))
    best, back = distance.argmin(axis=1), distance.argmin(axis=0)
    least = distance[rows, best]
    others = distance.copy()
    others[rows, best] = np.iinfo(others.dtype).max
    is_good = (back[best] == rows) & (least < most) & (least <= ratio * others.min(axis=1))
    return rows[is_good], best[is_good].astype(np.int64)


def points_of(world: VisualMap, frames: list[int]) -> Indices:
    """Return the points that these key frames see."""
    rows = world.observations(np.array(frames, dtype=np.int64))
    points = np.unique(world.rows["point"][rows])
    return np.asarray(points[world.points["valid"][points]])


class Placed(NamedTuple):
    """A camera among old points."""

    pose: Pose
    n_matches: int
    """By descriptors alone, before geometry."""
    seen: Indices
    """(n,) which of its key points ..."""
    points: Indices
    """(n,) ... show which of the points; inliers all"""


def place_camera(
    xy: Array,
    octave: Indices,
    descriptors: NDArray[np.uint8],
    places: Array,
    known: NDArray[np.uint8],
    camera: Camera,
    s: LoopSettings,
) -> Placed | None:
    """Return the pose of a camera that sees some of the points, None where there are too few.

    Parameters
    ----------
    xy : (n, 2) normalised key points; octave : (n,); descriptors : (n, 32).
    places : (m, 3) points, map units; known : (m, 32) their descriptors.
    """
    if min(len(xy), len(places)) < s.least_matches:
        return None
    distance = bit_distances(descriptors, known)
    left, right = mutual(distance, s.most_bits, s.ratio)
    if len(left) < s.least_matches:
        return None
    focal = np.array([camera.fx, camera.fy])
    scale = focal / (OCTAVE ** octave.astype(np.float64))[:, None]
    pose = pose_of_points(places[right], xy[left], 3.0 / camera.fx)
    if pose is None:
        return None
    refined = refine_pose(pose, places[right], xy[left], scale[left])
    n_matches, n_in = len(left), int((refined.square < INLIER_SQUARE).sum())
    if n_in < max(s.least_share * n_matches, s.least_matches // 2):
        return None
    left, right = _guided(refined.pose, places, xy, focal, distance)
    if len(left) < s.least_inliers:
        return None
    refined = refine_pose(refined.pose, places[right], xy[left], scale[left])
    is_in = refined.square < INLIER_SQUARE
    if is_in.sum() < s.least_inliers:
        return None
    return Placed(refined.pose, n_matches, left[is_in], right[is_in])


def match_place(
    world: VisualMap, k: int, candidate: int, group: list[int], camera: Camera, s: LoopSettings
) -> Match | None:
    """Return how key frame ``k`` stands among the points of a group of old key frames."""
    rows = np.arange(*world.rows_of(k).indices(world.rows.size))
    points = points_of(world, group)
    found = place_camera(
        world.rows["xy"][rows],
        world.rows["octave"][rows],
        world.rows["descriptor"][rows],
        world.points["place"][points],
        world.rows["descriptor"][world.points["row"][points]],
        camera,
        s,
    )
    if found is None:
        return None
    return _with_scale(
        world, k, candidate, found.n_matches, found.pose, rows[found.seen], points[found.points]
    )


def _guided(
    pose: Pose, places: Array, xy: Array, focal: Array, distance: NDArray[np.int32]
) -> tuple[Indices, Indices]:
    """Return pairs (row, point) near to each other in the image that look alike."""
    x_c = in_camera(pose, places)
    ahead = x_c[:, 2] > 1e-6
    seen = x_c[:, :2] / np.where(ahead, x_c[:, 2], 1.0)[:, None]
    seen[~ahead] = 1e6
    tree = cKDTree(xy * focal)
    _, near = tree.query(seen * focal, k=NEIGHBOURS, distance_upper_bound=GUIDED_PX)
    column = np.arange(len(places))
    cost = np.where(
        near < len(xy), distance[np.minimum(near, len(xy) - 1), column[:, None]], GUIDED_BITS
    )
    which = cost.argmin(axis=1)
    row, cost = near[column, which], cost[column, which]
    kept = np.flatnonzero(cost < GUIDED_BITS)
    kept = kept[np.argsort(cost[kept], kind="stable")]
    _, first = np.unique(row[kept], return_index=True)  # of several points, the most alike
    kept = kept[first]
    return row[kept], kept


def pose_of_points(places: Array, xy: Array, most: float, n_rounds: int = 300) -> Pose | None:
    """Return the camera's pose among points (n, 3) seen at normalised ``xy`` (n, 2), by P3P-RANSAC.

    ``most`` is the error of an inlier, in normalised units. None where none is found.
    """
    cv2 = opencv()
    if len(places) < 6:
        return None
    is_found, turn, t, inliers = cv2.solvePnPRansac(
        np.ascontiguousarray(places),
        np.ascontiguousarray(xy),
        np.eye(3),
        None,
        iterationsCount=n_rounds,
        reprojectionError=float(most),
        confidence=0.999,
        flags=cv2.SOLVEPNP_P3P,
    )
    if not is_found or inliers is None or len(inliers) < 6:
        return None
    return Pose(np.asarray(cv2.Rodrigues(turn)[0]), np.asarray(t).ravel())


def _with_scale(
    world: VisualMap, k: int, candidate: int, n_matches: int, pose: Pose, rows: Indices,
    points: Indices,
) -> Match | None:  # fmt: skip
    own = world.rows["point"][rows]
    has_own = own >= 0
    if has_own.sum() < 10:
        return None
    now = world.pose(k)
    new_depth = in_camera(pose, world.points["place"][points[has_own]])[:, 2]
    old_depth = in_camera(now, world.points["place"][own[has_own]])[:, 2]
    is_good = (new_depth > 0.0) & (old_depth > 0.0)
    if is_good.sum() < 10:
        return None
    ratio = np.log(new_depth[is_good] / old_depth[is_good])
    middle = float(np.median(ratio))
    spread = 1.4826 * float(np.median(np.abs(ratio - middle)))
    scale = float(np.exp(middle))
    R = pose.R_cw.T @ now.R_cw
    correction = Sim3(R, pose.R_cw.T @ (scale * now.t_cw - pose.t_cw), scale)
    sigma = 1.2533 * spread / np.sqrt(is_good.sum())  # of a median
    return Match(k, candidate, n_matches, correction, float(sigma), rows, points)


def judge_of(ranging: Ranging | None, world: VisualMap) -> Judge | None:
    """Return the judge that the ranges of the last seconds make; None where no anchor is placed.

    Of an anchor with several places that one judges which speaks best for the loop; an anchor that
    is not sharp, or doubtful, does not judge.
    """
    if ranging is None or not ranging.has_scale or ranging.terms is None:
        return None
    assert ranging.found is not None
    found, terms = ranging.found, ranging.terms.with_lever(ranging.lever_error_m)
    recent = ranging.ranges.time_s[terms.row]
    recent = recent > recent[-1] - JUDGED_S
    rows, places = [], []
    for i, j in enumerate(ranging.used):
        own = ranging.anchors[j]
        is_open = own.state is AnchorState.AMBIGUOUS and len(own.alternatives) > 0
        if own.state is AnchorState.READY or is_open:
            rows.append(terms.rows(recent & (terms.anchor == j)))
            places.append([(found.anchors[i], float(found.biases[i])), *own.alternatives])
    n_ranges = sum(len(each) for each in rows)
    if n_ranges < LEAST_JUDGES:
        return None

    def median(correction: Sim3) -> float:
        """Return the median size of the errors with the path carried along."""
        sizes = []
        for own, options in zip(rows, places, strict=True):
            R, t = world.frames["R_cw"][own.key_frame], world.frames["t_cw"][own.key_frame]
            place = np.einsum("mji,mj->mi", R, own.motion + found.clock_s * own.velocity - t)
            arm = np.einsum("mji,mj->mi", R, own.lever) @ correction.R.T
            antenna = found.scale * correction.apply(place) + arm
            errors = [
                np.abs(np.linalg.norm(antenna - anchor, axis=1) + bias - own.range_m)
                for anchor, bias in options
            ]
            sizes.append(min(errors, key=lambda one: float(np.median(one)) if len(one) else 0.0))
        return float(np.median(np.concatenate(sizes)))

    sigma = float(np.median(np.concatenate([own.sigma_m for own in rows])))
    before = median(Sim3(np.eye(3), np.zeros(3), 1.0))

    def judge(correction: Sim3, _: int) -> RangeJudgement:
        return RangeJudgement(before, median(correction), sigma, n_ranges)

    return judge
