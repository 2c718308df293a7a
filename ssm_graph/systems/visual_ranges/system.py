"""The run: images in order through start, tracking, mapping, and the last adjustment."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from ssm_graph.systems.visual_ranges.bundle import Effort, adjust
from ssm_graph.systems.visual_ranges.features import Image, corners, flow
from ssm_graph.systems.visual_ranges.geometry import Pose, refine_pose
from ssm_graph.systems.visual_ranges.loop_closing import close_loop
from ssm_graph.systems.visual_ranges.loops import LoopFinder, judge_of
from ssm_graph.systems.visual_ranges.mapping import Mapper
from ssm_graph.systems.visual_ranges.metric import Metric
from ssm_graph.systems.visual_ranges.range_terms import FramePoses
from ssm_graph.systems.visual_ranges.relocalise import relocalise
from ssm_graph.systems.visual_ranges.result import FrameNow, FrameState, VisualResult
from ssm_graph.systems.visual_ranges.settings import VisualSettings
from ssm_graph.systems.visual_ranges.tracking import Followed, Tracker, Tracks
from ssm_graph.systems.visual_ranges.two_view import NoStart, two_view
from ssm_graph.systems.visual_ranges.visual_map import VisualMap

if TYPE_CHECKING:
    from ssm_graph.systems.visual_ranges.sequence import Sequence

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]

_LEAST_CORNERS: Final = 100
_NEW_SCALE: Final = 0.02
"""Change of scale by a loop from which scale and anchors are found anew."""
_HISTORY: Final = 60
"""Frames before the start whose poses are found afterwards."""


def run(
    sequence: Sequence,
    settings: VisualSettings = VisualSettings(),  # noqa: B008
    *,
    progress: Callable[[int, int], None] = lambda done, total: None,  # noqa: ARG005
    on_frame: Callable[[FrameNow], None] | None = None,
) -> VisualResult:
    """Return the path and the map of a sequence.

    ``on_frame`` is called with every image that has a pose, as it is known then.
    """
    return _Run(sequence, settings).finish(progress, on_frame)


class _Run:
    """One sequence from its first image to its last."""

    def __init__(self, sequence: Sequence, settings: VisualSettings) -> None:
        self.sequence, self.settings = sequence, settings
        self.camera = sequence.camera
        self.world = VisualMap()
        self.mapper = Mapper(self.camera, self.world, settings)
        self.tracker = Tracker(self.camera, self.world, settings)
        n = len(sequence.time_s)
        self.state = np.full(n, FrameState.WAITING, dtype=np.int64)
        self.reference = np.full(n, -1, dtype=np.int64)
        self.relative_R, self.relative_t = np.full((n, 3, 3), np.nan), np.full((n, 3), np.nan)
        self.unit = np.ones(n)
        self.n_tracked = np.zeros(n, dtype=np.int64)
        self.events: list[str] = []
        self.timing: dict[str, list[float]] = defaultdict(list)
        self.waiting: list[tuple[int, Array, Indices]] = []
        self.first: tuple[int, Image, Array] | None = None
        self.seen: dict[int, Tracks] = {}
        self.metric = None
        if len(sequence.ranges) or sequence.vehicle.has_aids:
            lever = np.array(sequence.lever_arm_m)
            self.metric = Metric(
                sequence.ranges, lever, sequence.vehicle, lever_sigma_m=sequence.lever_arm_sigma_m
            )
        self.loops = LoopFinder(self.camera, settings.loops)
        self.pool = None if settings.is_deterministic else ThreadPoolExecutor(1)
        self.job: tuple[Image, Tracks, Future[Tracks]] | None = None

    def finish(
        self,
        progress: Callable[[int, int], None],
        on_frame: Callable[[FrameNow], None] | None = None,
    ) -> VisualResult:
        """Go through all images and return the answer."""
        n = len(self.sequence.time_s)
        for i in range(n):
            image = self.sequence.images(i)
            with self.timed("frame"):
                if self.world.n_frames == 0:
                    self.try_start(i, image)
                else:
                    self.follow(i, image)
            if on_frame is not None and self.state[i] == FrameState.TRACKED:
                on_frame(self.now(i))
            progress(i + 1, n)
        self.take_mapped(wait=True)
        if self.pool is not None:
            self.pool.shutdown()
        if self.settings.has_final_adjustment and self.world.n_frames > 2:
            with self.timed("last adjustment"):
                if self.metric is not None:
                    self.metric.ranging.check_again()
                self.adjust_all()
                self.follow_back()
                self.refine_frames()
        return self.answer()

    def now(self, i: int) -> FrameNow:
        """Return the pose of the newest image as it is known now."""
        k = int(self.reference[i])
        with self.world.lock:
            base, grown = self.world.pose(k), float(self.world.frames["grown"][k])
        pose = Pose(self.relative_R[i], grown / self.unit[i] * self.relative_t[i]).after(base)
        scale = self.metric.scale if self.metric is not None else float("nan")
        return FrameNow(float(self.sequence.time_s[i]), pose.R_cw, pose.t_cw, scale)

    @contextmanager
    def timed(self, part: str) -> Iterator[None]:
        """Note how long a part takes."""
        begin = time.perf_counter()
        yield
        self.timing[part].append(time.perf_counter() - begin)

    def try_start(self, i: int, image: Image) -> None:
        """Follow the corners of a reference image until two views make a map."""
        if self.first is None:
            self.set_first(i, image)
            return
        reference, first_image, start = self.first
        index, pixel, which = self.waiting[-1]
        before = self.sequence.images(index) if index != reference else first_image
        pixel, found = flow(before, image, pixel, pixel)
        pixel, which = pixel[found], which[found]
        if len(pixel) < _LEAST_CORNERS:
            self.set_first(i, image)
            return
        self.waiting.append((i, pixel, which))
        median = float(np.median(np.linalg.norm(pixel - start[which], axis=1)))
        share = median / self.camera.width
        if share < self.settings.start_flow_share:
            if len(self.waiting) > _HISTORY:
                del self.waiting[1]
            return
        xy1, xy2 = self.camera.normalise(start[which]), self.camera.normalise(pixel)
        found_start = two_view(xy1, xy2, float(np.sqrt(self.camera.fx * self.camera.fy)))
        if isinstance(found_start, NoStart):
            self.note(i, f"no start yet: {found_start.reason}")
            if share > self.settings.restart_flow_share:
                self.set_first(i, image)
            return
        self.begin_map(i, image, found_start.pose, found_start.points, found_start.good, which)

    def set_first(self, i: int, image: Image) -> None:
        """Take an image as the reference of the start."""
        found = corners(image, self.settings.n_corners, np.zeros((0, 2)))
        self.first = (i, image, found) if len(found) >= _LEAST_CORNERS else None
        self.waiting = [(i, found, np.arange(len(found)))]

    def begin_map(
        self, i: int, image: Image, pose: Pose, points: Array, good: Mask, which: Indices
    ) -> None:
        """Make the first two key frames, and the poses of the frames before and between."""
        assert self.first is not None
        world, mapper, times = self.world, self.mapper, self.sequence.time_s
        reference, first_image, start = self.first
        _, pixel, _ = self.waiting[-1]
        origin = Pose(np.eye(3), np.zeros(3))
        track = world.new_tracks(len(start))
        k = world.add_frame(reference, float(times[reference]), origin, first_image)
        mapper.add_rows(k, first_image, origin, Tracks(track, start))
        on = np.flatnonzero(good)
        k = world.add_frame(i, float(times[i]), pose, image)
        mapper.add_rows(k, image, pose, Tracks(track[which], pixel))
        world.add_points(track[which[on]], points[on])
        mapper.adjust_local(k)
        mapper.set_depth(k)
        fresh = mapper.fill(k, image, Tracks(track[which], pixel))
        self.tracker.start(image, fresh, world.pose(k), k)
        for index, seen, tracks in self.waiting:
            self.pose_before(index, seen, track[tracks])
        self.note(i, f"map started with {len(on)} points")

    def pose_before(self, index: int, pixel: Array, track: Indices) -> None:
        """Find the pose of a frame from before the start, from the points it saw."""
        point = self.world.tracks["point"][track]
        on = point >= 0
        if on.sum() < self.settings.least_inliers:
            return
        xy = self.camera.normalise(pixel[on])
        places = self.world.points["place"][point[on]]
        refined = refine_pose(self.world.pose(0), places, xy, self.tracker.whitening(len(xy)))
        self.record(index, refined.pose, 0, int(on.sum()), Tracks(track, pixel))

    def follow(self, i: int, image: Image) -> None:
        """Track one image, and make it a key frame if it is time."""
        self.take_mapped(wait=False)
        with self.timed("tracking"):
            found = self.tracker.follow(image)
        if found.pose is None:
            self.take_mapped(wait=True)
            if self.find_again(i, image):
                return
            self.state[i] = FrameState.LOST
            if self.state[i - 1] == FrameState.TRACKED:
                self.note(i, f"lost: {found.n_points} points left")
            return
        # From its key frame as it was tracked: the mapping beside may have moved the map since.
        relative, unit = self.tracker.relative, self.tracker.unit
        self.keep(i, relative, unit, self.tracker.reference)
        self.n_tracked[i], self.seen[i] = found.n_points, found.tracks
        if self.is_key_frame(i, found):
            if self.job is not None:
                # Without it the map would thin out wherever images come faster than it is made.
                self.take_mapped(wait=True)
                found.pose, found.tracks = self.tracker.pose(), self.tracker.tracks
            self.make_key_frame(i, image, found)

    def find_again(self, i: int, image: Image) -> bool:
        """Look for a lost camera in the map; return whether it was found."""
        with self.timed("relocalisation"):
            found = relocalise(self.world, self.loops, self.camera, image, self.settings.n_corners)
        if found is None:
            return False
        with self.world.lock:
            tracks = Tracks(self.world.new_tracks(len(found.points), found.points), found.pixel)
        self.tracker.start(image, tracks, found.pose, found.key_frame)
        self.record(i, found.pose, found.key_frame, len(found.points), tracks)
        self.note(i, f"found again by {len(found.points)} points of key frame {found.key_frame}")
        return True

    def is_key_frame(self, i: int, found: Followed) -> bool:
        """Return whether a tracked frame adds enough to the last key frame."""
        s = self.settings
        rotation = float(
            np.arccos(np.clip((np.trace(self.tracker.relative.R_cw) - 1.0) / 2.0, -1.0, 1.0))
        )
        translation = float(np.linalg.norm(self.tracker.relative.centre)) / self.tracker.depth
        if translation < s.key_least_translation and rotation < s.key_least_rotation_rad:
            return False
        since = float(self.sequence.time_s[i] - self.world.frames["time_s"][self.tracker.reference])
        few = found.n_points < max(
            s.key_share * self.n_tracked[self.world.frames["image"][self.tracker.reference]],
            s.key_least_points,
        )
        return (
            translation > s.key_translation
            or rotation > s.key_rotation_rad
            or few
            or since > s.key_interval_s
        )

    def make_key_frame(self, i: int, image: Image, found: Followed) -> None:
        """Hand a key frame to the mapping, which runs beside or at once."""
        assert found.pose is not None
        with self.world.lock:
            k = self.world.add_frame(i, float(self.sequence.time_s[i]), found.pose, image)
        self.tracker.set_pose(found.pose, k)
        self.record(i, found.pose, k, found.n_points, found.tracks)
        given = found.tracks
        if self.pool is None:
            self.tracker.renew(image, given, self.map_key_frame(k, i, given))
        else:
            self.job = (image, given, self.pool.submit(self.map_key_frame, k, i, given))

    def take_mapped(self, *, wait: bool) -> None:
        """Take over what the mapping beside has made, if it is done or is to be waited for."""
        if self.job is not None and (wait or self.job[2].done()):
            image, given, future = self.job
            self.job = None
            self.tracker.renew(image, given, future.result())

    def map_key_frame(self, k: int, i: int, given: Tracks) -> Tracks:
        """Fill key frame ``k`` of image ``i``, ask the ranges, adjust around it, look for loops."""
        with self.timed("mapping"):
            with self.timed("insertion"):
                made = self.mapper.insert(k, given)
            self.n_tracked[i] = int((self.world.tracks["point"][made.track] >= 0).sum())
            if self.metric is not None:
                with self.timed("ranges"):
                    self.ask_ranges(i)
            with self.timed("local adjustment"):
                self.mapper.adjust_local(k, self.metric)
            if self.settings.loops.is_on:
                with self.timed("loops"):
                    self.close_loop(k, i)
        self.seen[i] = made
        return made

    def close_loop(self, k: int, i: int) -> None:
        """Look for a place seen before, and correct map, path and scale by it."""
        judge = None if self.metric is None else judge_of(self.metric.ranging, self.world)
        match = self.loops.look(self.world, k, judge)
        if match is None:
            return
        with self.world.lock:
            keys = self.world.frames
            steps = [] if self.metric is None else self.metric.steps(keys["R_cw"], keys["t_cw"])
            closed = close_loop(self.world, match, self.camera, steps)
        self.note(
            i,
            f"loop closed with {self.world.frames['time_s'][match.matched]:.1f} s: "
            f"{self.loops.records[-1].why}; {closed.n_fused} points joined",
        )
        if self.metric is not None and abs(np.log(match.correction.scale)) > _NEW_SCALE:
            self.metric.restart()
        self.adjust_all(i)

    def ask_ranges(self, i: int) -> None:
        """Hang the ranges up to image ``i`` on the key frames, and see what they tell."""
        assert self.metric is not None
        R, t = self.poses()
        frames = FramePoses(
            self.sequence.time_s[: i + 1], R[: i + 1], t[: i + 1], self.reference[: i + 1]
        )
        keys = self.world.frames
        told = self.metric.update(frames, keys["R_cw"], keys["t_cw"], keys["time_s"])
        for text in told:
            self.note(i, text)

    def record(self, i: int, pose: Pose, reference: int, n_points: int, tracks: Tracks) -> None:
        """Keep a frame's pose relative to its key frame."""
        relative = pose.after(self.world.pose(reference).inverse())
        self.keep(i, relative, float(self.world.frames["grown"][reference]), reference)
        self.n_tracked[i], self.seen[i] = n_points, tracks

    def keep(self, i: int, relative: Pose, unit: float, reference: int) -> None:
        """Keep a pose from that of a key frame around which the map had grown by ``unit``."""
        self.state[i], self.reference[i], self.unit[i] = FrameState.TRACKED, reference, unit
        self.relative_R[i], self.relative_t[i] = relative

    def note(self, i: int, text: str) -> None:
        """Keep what happened."""
        self.events.append(f"{self.sequence.time_s[i] - self.sequence.time_s[0]:.2f} s: {text}")

    def adjust_all(self, last: int | None = None) -> None:
        """Adjust everything together, ranges up to image ``last`` with all they depend on."""
        steps = self.settings.global_steps
        effort = Effort(steps=steps, posterior_from=steps - 3, hold_scale=True)
        if self.metric is not None:
            self.ask_ranges(int(np.flatnonzero(self.reference >= 0)[-1]) if last is None else last)
        window = self.mapper.whole()
        problem = self.mapper.problem(window, self.metric, is_free=True)
        found = adjust(problem, effort)
        self.mapper.take(window, found)
        if self.metric is not None and problem.further is not None:
            self.metric.adopt(found.extra, found.extra_covariance, problem.further)

    def follow_back(self) -> None:
        """Track what lies before the start, or before the camera was found again, backwards.

        No key frames are made on this way: it ends where the next one would be.
        """
        R, t = self.poses()
        is_open = self.state != FrameState.TRACKED
        for j in (np.flatnonzero(is_open[:-1] & ~is_open[1:]) + 1).tolist():
            k = int(self.reference[j])
            self.tracker.start(self.sequence.images(j), self.seen[j], Pose(R[j], t[j]), k)
            few = self.settings.key_share * self.n_tracked[j]
            for i in range(j - 1, -1, -1):
                if not is_open[i]:
                    break
                found = self.tracker.follow(self.sequence.images(i))
                if found.pose is None or found.n_points < few:
                    break
                self.record(i, found.pose, k, found.n_points, found.tracks)

    def refine_frames(self) -> None:
        """Find the pose of every frame anew from the final places of the points it saw."""
        R, t = self.poses()
        keys = set(self.world.frames["image"].tolist())
        for i, tracks in self.seen.items():
            point = self.world.tracks["point"][tracks.track]
            on = point >= 0
            if i in keys or on.sum() < self.settings.least_inliers:
                continue
            places, xy = (
                self.world.points["place"][point[on]],
                self.camera.normalise(tracks.pixel[on]),
            )
            refined = refine_pose(Pose(R[i], t[i]), places, xy, self.tracker.whitening(len(xy)))
            self.record(i, refined.pose, int(self.reference[i]), int(self.n_tracked[i]), tracks)

    def poses(self) -> tuple[Array, Array]:
        """Return the poses of all frames (N, 3, 3), (N, 3) as the map stands; NaN without one."""
        world = self.world
        on = self.reference >= 0
        R, t = np.full_like(self.relative_R, np.nan), np.full_like(self.relative_t, np.nan)
        base_R = world.frames["R_cw"][self.reference[on]]
        base_t = world.frames["t_cw"][self.reference[on]]
        R[on] = self.relative_R[on] @ base_R
        grown = world.frames["grown"][self.reference[on]] / self.unit[on]
        t[on] = np.einsum("nij,nj->ni", self.relative_R[on], base_t)
        t[on] += grown[:, None] * self.relative_t[on]
        return R, t

    def answer(self) -> VisualResult:
        """Return the result as it stands."""
        R, t = self.poses()
        return VisualResult(
            name=self.sequence.name, camera=self.camera, time_s=self.sequence.time_s,
            state=self.state, R_cw=R, t_cw=t, key_frame=self.reference, n_tracked=self.n_tracked,
            map=self.world.snapshot(),
            ranging=None if self.metric is None else self.metric.result(),
            loops=tuple(self.loops.records), events=tuple(self.events),
            timing_s={part: np.array(values) for part, values in self.timing.items()},
        )  # fmt: skip
