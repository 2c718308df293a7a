"""From a drive and a map to a lane, or to a word why not."""

from __future__ import annotations

import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from ssm_graph.base.errors import DataError, SolverError
from ssm_graph.base.frozen import Array, FrozenArrays, shaped
from ssm_graph.base.units import DEGREE, wrapped
from ssm_graph.filters.rules.hypotheses import CARRIED, Hypothesis
from ssm_graph.filters.rules.particles import moments, normalised
from ssm_graph.systems.road_map.drive import Drive, curve_groups, dead_reckoned
from ssm_graph.systems.road_map.hypotheses import (
    ALONG_M,
    ALONG_STEP_M,
    LATERAL_M,
    TURN,
    along_lane,
    course_trials,
    evidence_of,
    is_same_lane,
    known_along,
    lane_share,
    search,
    slide,
)
from ssm_graph.systems.road_map.locator import (
    BIAS,
    SCALE,
    YAW,
    Locator,
    LocatorSettings,
    first_particles,
    spread_over,
)
from ssm_graph.systems.road_map.maps.index import LineIndex
from ssm_graph.systems.road_map.maps.road_map import LineKind, RoadMap
from ssm_graph.systems.road_map.motion import first_course
from ssm_graph.systems.road_map.plausible import require_plausible
from ssm_graph.systems.road_map.prior import ALONG_INFLATION, prior_of
from ssm_graph.systems.road_map.refinement import Refined, RefinementSettings, refine, sigmas_of
from ssm_graph.systems.road_map.simulate import indices_of
from ssm_graph.systems.road_map.verdict import (
    Verdict,
    VerdictSettings,
    reason_of,
)
from ssm_graph.systems.road_map.window import Window, window_of

SENSOR_REACH_M: Final = 60.0
"""Beyond the square of the fix, what the camera can see."""
LOST: Final = 4.0
"""Log evidence by which another place must be better for the particles to be put there."""
MOST_PICTURES: Final = 60
"""Of a stretch, where the vehicle is slow."""
SLIDE_EVERY_M: Final = 15.0
"""From one look along the lane to the next."""
AGAIN_PICTURES: Final = 5
"""So many pictures at least from one look to the next: at 25 m/s a few metres are one picture."""


@dataclass(frozen=True, slots=True, eq=False)
class Track(FrozenArrays):
    """The filter's answer at every picture."""

    time_s: Array = shaped("N")
    pose: Array = shaped("N", 3)
    """x, y [m], yaw [rad], means of all particles."""
    cov: Array = shaped("N", 3, 3)
    driven_m: Array = shaped("N")
    n_particles: Array = shaped("N")


@dataclass(frozen=True, slots=True, eq=False)
class Located:
    """What came of a drive."""

    verdict: Verdict
    reason: str
    """In words, with numbers."""
    pose: Array
    """(3,) at the last picture: x, y [m], yaw [rad]."""
    sigmas: tuple[float, float, float]
    """Across and along [m], yaw [rad]."""
    hypotheses: tuple[Hypothesis, ...]
    """Places that the last stretch allows, the one with most evidence first."""
    first_fix_s: float
    """When the lane was first known, s from the start; NaN for never."""
    first_fix_m: float
    first_fix: Array
    """(3,) the pose then; NaN for none."""
    track: Track
    refined: Refined | None
    window: Window | None
    snapshots: tuple[tuple[float, Array], ...]
    """Times with particles (n, 3), for figures."""
    cpu_ms: float
    """Processor time of one update, its share of the search among it."""


class Localiser:
    """Follows one drive over one map; see `locate`."""

    def __init__(
        self,
        drive: Drive,
        road_map: RoadMap,
        *,
        settings: LocatorSettings | None = None,
        verdict: VerdictSettings | None = None,
        refinement: RefinementSettings | None = None,
        seed: int = 0,
        indices: Mapping[LineKind, LineIndex] | None = None,
    ) -> None:
        self.drive = drive
        self.settings = settings or LocatorSettings()
        self.when = verdict or VerdictSettings()
        self.verdict, self.hypotheses = Verdict.AMBIGUOUS, list[Hypothesis]()
        self.next_m = self.next_slide_m = 0.0
        self.next_row = self.put_row = 0
        self.before_m = 0.0
        self.first: tuple[float, float, Array] | None = None
        self.refinement = refinement or RefinementSettings()
        self.half_m = square_of(drive)
        fixes, fixes_s = drive.gnss.x_y, drive.gnss.time_s
        if indices is None:
            indices = indices_of(road_map.within(fixes, self.half_m + SENSOR_REACH_M))
        self.indices = indices
        require_plausible(drive)
        begin = first_course(drive)
        self.course, self.begin_s = begin.yaw, float(fixes_s[begin.fix]) if begin.fix else -np.inf
        if begin.yaw is not None:
            spread = max(self.settings.yaw_sigma, begin.sigma)
            self.settings = replace(self.settings, yaw_sigma=spread)
        rng = np.random.default_rng([seed, 2])
        particles = first_particles(
            fixes[begin.fix], self.half_m, self.course, self.indices, self.settings, rng
        )
        self.locator = Locator(self.indices, particles, rng, self.settings)
        t = drive.chassis.time_s
        self.reckoned = dead_reckoned(np.zeros(3), t, drive.chassis)
        self.groups = [g for g in curve_groups(drive.curves) if g[0] >= self.begin_s]
        self.snapshots: list[tuple[float, Array]] = []
        self.rows: list[tuple[float, Array, Array, float, int]] = []
        self.extras: list[tuple[Array, Array]] = []

    def run(self) -> Located:
        """Follow the drive to its end."""
        began = time.process_time()
        t, n_done = self.drive.chassis.time_s, 0
        way = np.hypot(*np.diff(self.reckoned[:, :2], axis=0).T)
        way *= np.sign(0.5 * (self.drive.chassis.speed[1:] + self.drive.chassis.speed[:-1]))
        turn = np.diff(self.reckoned[:, 2])
        begin = int(np.searchsorted(t, self.begin_s))
        self.before_m = float(np.abs(way[:begin]).sum())
        self._keep(float(t[begin]))
        for k in range(begin + 1, len(t)):
            while n_done < len(self.groups) and self.groups[n_done][0] < t[k]:
                self._picture(n_done)
                n_done += 1
            self.locator.predict(float(way[k - 1]), float(turn[k - 1]), float(t[k] - t[k - 1]))
        while n_done < len(self.groups) and self.groups[n_done][0] <= t[-1] + 1e-6:
            self._picture(n_done)
            n_done += 1
        if not self.rows:
            raise DataError(
                f"{self.drive.name} curves: none from {self.begin_s:.3f} s on, when the fixes tell "
                "the course; give a heading in [gnss], or a longer drive"
            )
        self._judge(len(self.rows) - 1)
        return self._answer(began)

    def _picture(self, number: int) -> None:
        when, group = self.groups[number]
        locator = self.locator
        locator.update(self.drive.curves, group)
        p = locator.particles
        weight = p.weight
        mean, cov = moments(p.states, weight, YAW)
        self.rows.append((when, mean[:3], cov[:3, :3], locator.driven_m, len(weight)))
        self.extras.append((mean, cov))
        if len(self.rows) in (3, 10, 25) or len(self.rows) % 60 == 0:
            self._keep(when)
        if len(self.rows) < self.next_row:
            return
        if locator.driven_m >= max(self.next_m, self.when.least_driven_m):
            self._judge(number)
        elif self.verdict is Verdict.CONVERGED and locator.driven_m >= self.next_slide_m:
            self._slide(number)

    def _slide(self, number: int) -> None:
        """Look along the lane: the particles may have lost the right place in it."""
        self.next_slide_m = self.locator.driven_m + SLIDE_EVERY_M
        self.next_row = len(self.rows) + AGAIN_PICTURES
        window = self._stretch(number)
        if window is not None:
            mean = self.rows[-1][1]
            found, own = slide(window, mean, self.indices, self.settings)
            self._put(found, own)

    def _put(self, found: list[Hypothesis], own: Hypothesis) -> None:
        """Put particles where the evidence is, if there is next to none where they are.

        Where the stretch says as much for their place as for another one, what they know from
        before decides.
        """
        if own.log_evidence < found[0].log_evidence - LOST:
            self._spread(found)

    def _spread(self, found: list[Hypothesis]) -> None:
        """Put particles about all places that the stretch allows."""
        locator = self.locator
        self.put_row = len(self.rows)
        likely = [h for h in found if h.share > 1e-3]
        share = np.array([h.share for h in likely])
        at = np.array([h.pose for h in likely])
        locator.put(spread_over(at, share, ALONG_M, locator.particles, self.settings, locator.rng))

    def _lay_along(self, window: Window, fix: Array) -> None:
        """Lay particles anew along the lane, by the evidence of all that was seen.

        Few of the first particles were in the right lane: what they say of the place along it is
        how they happened to lie.
        """
        best = np.array(self.hypotheses[0].pose)
        at, value = along_lane(window, best, fix, self.half_m, self.indices, self.settings)
        if self.course is not None:
            began, now = self._reckoned_at(self.begin_s), self._reckoned_at(self.rows[-1][0])
            since = began[2] - now[2]
            off = wrapped(at[:, 2] + since - self.course) / self.settings.yaw_sigma
            value = value - 0.5 * off**2
        locator = self.locator
        locator.put(
            spread_over(
                at, normalised(value), ALONG_STEP_M, locator.particles, self.settings, locator.rng
            )
        )

    def _keep(self, when: float) -> None:
        self.snapshots.append((when, self.locator.particles.states[:, :3].copy()))

    def _stretch(self, number: int) -> Window | None:
        driven_m = self.locator.driven_m
        row = len(self.rows) - 1
        first = row
        while first > 0 and self.rows[first - 1][3] >= driven_m - self.when.window_m:
            first -= 1
        n = min(row - first + 1, MOST_PICTURES)
        groups = self.groups[number - n + 1 : number + 1]
        mean = self.extras[-1][0]
        return self._window(groups, float(mean[SCALE]), float(mean[BIAS]))

    def _window(
        self, groups: list[tuple[float, slice]], scale: float = 0.0, bias: float = 0.0
    ) -> Window | None:
        times = np.array([g[0] for g in groups])
        t0 = max(float(self.drive.chassis.time_s[0]), float(times[0]))
        times = np.maximum(times, t0)
        motion = dead_reckoned(np.zeros(3), times, self.drive.chassis, scale=1.0 + scale, bias=bias)
        return window_of(self.drive.curves, groups, motion, self.settings.n_points)

    def _judge(self, number: int) -> None:
        """Look for rivals, judge, and put particles where the evidence is."""
        v = self.when
        number = min(number, len(self.groups) - 1)
        window = self._stretch(number)
        when, mean, cov, driven_m, _ = self.rows[-1]
        self.next_m = driven_m + v.again_after_m
        self.next_row = len(self.rows) + AGAIN_PICTURES
        if window is None:
            self.verdict = Verdict.FAILED if self.first is None else self.verdict
            return
        fix = self._fix_at(when, float(mean[2]))
        spread = max(float(np.sqrt(cov[2, 2])), self.settings.yaw_sigma / 2.0)
        yaws = course_trials(float(mean[2]), min(spread, 10.0 * DEGREE))
        found, own = search(window, fix, self.half_m, yaws, self.indices, self.settings, mean)
        self.hypotheses = found
        if found[0].misfit > v.misfit:
            self.verdict = Verdict.FAILED
            return
        best = np.array(found[0].pose)
        is_known = lane_share(found, best) > 1.0 - CARRIED
        if is_known and self._in_lane(best) < 1.0 - CARRIED:
            self._spread(found)  # the stretch as a whole knows the lane before the particles do
        else:
            self._put(found, own)
        p = self.locator.particles
        self.extras[-1] = moments(p.states, p.weight, YAW)
        mean, cov = self.extras[-1][0][:3], self.extras[-1][1][:3, :3]
        self.rows[-1] = (when, mean, cov, driven_m, len(p.states))
        self.verdict = Verdict.AMBIGUOUS
        if min(self._in_lane(mean), lane_share(found, mean)) > 1.0 - CARRIED:
            self.verdict = Verdict.CONVERGED
            self.next_m = driven_m + v.watch_m
            if self.first is None and driven_m >= v.least_driven_m:
                lane = [np.array(h.pose) for h in found if is_same_lane(h, mean)]
                # The mean of particles along a bend is beside it.
                on_it = min(lane, key=lambda pose: float(np.hypot(*(pose - mean)[:2])))
                self.first = (when, driven_m, on_it)
                self._lay_along(window, fix)

    def _in_lane(self, pose: Array) -> float:
        """Return which share of the particles is in the lane of a pose (3,)."""
        p = self.locator.particles
        off, turn = p.states[:, :2] - pose[:2], wrapped(p.states[:, YAW] - pose[2])
        c, s = np.cos(pose[2]), np.sin(pose[2])
        across = off @ [-s, c] - off @ [c, s] * np.tan(0.5 * turn)
        return float(p.weight[(np.abs(across) < LATERAL_M) & (np.abs(turn) < TURN)].sum())

    def _fix_at(self, when: float, yaw: float) -> Array:
        """Return the last fix before a time, carried on by dead reckoning to a course, (2,) m."""
        k = max(0, int(np.searchsorted(self.drive.gnss.time_s, when, side="right")) - 1)
        now = self._reckoned_at(when)
        c, s = np.cos(yaw - now[2]), np.sin(yaw - now[2])
        gone = (now - self._reckoned_at(float(self.drive.gnss.time_s[k])))[:2]
        return np.asarray(self.drive.gnss.x_y[k] + np.array([[c, -s], [s, c]]) @ gone)

    def _reckoned_at(self, when: float) -> Array:
        """Return the dead-reckoned pose (3,) of the chassis row at a time or after it."""
        row = int(np.searchsorted(self.drive.chassis.time_s, when - 1e-6))
        return np.asarray(self.reckoned[min(row, len(self.reckoned) - 1)])

    def _answer(self, began: float) -> Located:
        v = self.when
        _, mean, cov, _, _ = self.rows[-1]
        across, along = sigmas_of(mean, cov)
        along *= ALONG_INFLATION
        pose, sigmas = mean, (across, along, float(np.sqrt(cov[2, 2])))
        refined, window, verdict = None, None, self.verdict
        reason = ""
        if verdict is Verdict.CONVERGED:
            try:
                refined, window = self._refined()
            except SolverError as error:
                reason = str(error)
        if refined is not None:
            pose, sigmas, refined = self._joined(refined, mean, along)
        hypotheses = known_along(self.hypotheses, pose, sigmas[1]) if self.hypotheses else []
        if verdict is Verdict.CONVERGED:
            if lane_share(hypotheses, pose) < 1.0 - CARRIED:
                verdict = Verdict.AMBIGUOUS
            elif sigmas[1] > v.along_sigma_m or sum(h.share > CARRIED for h in hypotheses) > 1:
                verdict = Verdict.UNRESOLVED_ALONG
        first = self.first or (np.nan, np.nan, np.full(3, np.nan))
        return Located(
            verdict,
            reason_of(verdict, hypotheses, v.misfit, pose, sigmas)
            + (f"; {reason}" if reason else ""),
            np.array(pose),
            sigmas,
            tuple(hypotheses),
            first[0] - float(self.drive.chassis.time_s[0]),
            self.before_m + first[1],
            first[2],
            _track(self.rows),
            refined,
            window,
            tuple(self.snapshots),
            1e3 * (time.process_time() - began) / len(self.rows),
        )

    def _joined(
        self, refined: Refined, mean: Array, along: float
    ) -> tuple[Array, tuple[float, float, float], Refined]:
        """Return the refined pose (3,) and sigmas, or along the road what the particles know.

        That counts where they know more; the window is then laid on the map there, whose lines lie
        otherwise. Where both cannot be right the stretch decides.
        """
        pose, sigmas, moved = refined.poses[-1], refined.sigmas, refined.beside(mean)
        shift = float(np.hypot(*(moved - pose)[:2]))
        is_moved = sigmas[1] > along
        if shift > 3.0 * np.hypot(along, sigmas[1]):
            window = self._stretch(len(self.rows) - 1)
            assert window is not None
            found = evidence_of(window, np.stack([pose, moved]), self.indices, self.settings)
            better = float(found[0] - found[1])
            is_moved = better < LOST
            along = along if abs(better) > LOST else float(np.hypot(along, 0.5 * shift))
        if not is_moved:
            return pose, sigmas, refined
        with suppress(SolverError):
            refined = self._refine(mean)[0] or refined
        return refined.beside(mean), refined.with_along(along), refined

    def _refined(self) -> tuple[Refined | None, Window | None]:
        """Lay the window on the map from the particles.

        Where that ends at a place that the last stretch does not allow, from the one that it does.
        """
        refined, window = self._refine()
        stretch = self._stretch(len(self.rows) - 1)
        if refined is None or stretch is None or not self.hypotheses:
            return refined, window
        best = np.array(self.hypotheses[0].pose)
        both = np.stack([refined.poses[-1], best])
        found = evidence_of(stretch, both, self.indices, self.settings)
        return self._refine(best) if found[1] > found[0] + LOST else (refined, window)

    def _refine(self, last: Array | None = None) -> tuple[Refined | None, Window | None]:
        """Lay the last pictures on the map as a graph, begun by the particles before them.

        ``last`` (3,), where given, is where they are held to be in place of what came before.
        """
        n = min(self.when.refined_pictures, len(self.rows))
        groups = self.groups[len(self.rows) - n : len(self.rows)]
        window = self._window(groups)
        if window is None:
            return None, None
        first = len(self.rows) - n
        mean, cov = self.extras[first]
        if first < self.put_row:  # the particles were elsewhere then
            cov = 4.0 * self.extras[-1][1]
            mean = np.concatenate([window.poses_from(self.rows[-1][1])[0], mean[3:]])
        if last is not None:
            mean = np.concatenate([window.poses_from(last)[0], mean[3:]])
        spread_m = self.half_m / np.sqrt(3.0) if n == len(self.rows) else 0.0
        prior = prior_of(mean, cov, self.settings, spread_m)
        start = window.poses_from(self.rows[-1][1] if last is None else last)
        return refine(window, start, prior, self.indices, self.refinement), window


def locate(drive: Drive, road_map: RoadMap, **options: object) -> Located:
    """Return in which lane a drive ends, with a verdict; options are those of `Localiser`."""
    return Localiser(drive, road_map, **options).run()  # type: ignore[arg-type]


def square_of(drive: Drive) -> float:
    """Return half the side of the square about a fix in which the vehicle is, m."""
    noise = 3.0 * float(drive.gnss.sigma_m[0]) if drive.gnss_bias_m == 0.0 else 2.0
    return drive.gnss_bias_m + noise


def _track(rows: list[tuple[float, Array, Array, float, int]]) -> Track:
    return Track(
        np.array([row[0] for row in rows]),
        np.array([row[1] for row in rows]),
        np.array([row[2] for row in rows]),
        np.array([row[3] for row in rows]),
        np.array([float(row[4]) for row in rows]),
    )
