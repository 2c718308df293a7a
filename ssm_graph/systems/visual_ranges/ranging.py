"""Scale and anchors while a run goes on: started, kept up from all ranges, doubted, found moved.

The map stays in its own units; the scale is a variable. It and the anchors come from all ranges so
far at their present places, never from those of a window alone, with which an anchor runs away.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Final, NamedTuple

import numpy as np

from ssm_graph.base.frozen import Array
from ssm_graph.systems.visual_ranges.bundle_ranges import BundleRanges
from ssm_graph.systems.visual_ranges.range_fit import (
    Problem,
    Solution,
    polished,
    problem_of,
    search,
    solution,
    unknowns_of,
)
from ssm_graph.systems.visual_ranges.range_rows import (
    against_rivals,
    is_sharp,
    known_spacing,
    largest_turn,
    lost_since,
    of_anchors,
    placed_later,
    plain_errors,
)
from ssm_graph.systems.visual_ranges.range_terms import (
    FramePoses,
    Places,
    RangeTerms,
    hang,
    places_of,
)
from ssm_graph.systems.visual_ranges.ranges import Indices, Ranges
from ssm_graph.systems.visual_ranges.ranging_result import Anchor, AnchorState, RangingResult
from ssm_graph.systems.visual_ranges.start import (
    Start,
    StartRules,
    StartState,
    find_start,
    moved,
)
from ssm_graph.systems.visual_ranges.weights import NLOS_WEIGHT, POLISH
from ssm_graph.systems.visual_ranges.widening import opened, widened, with_open

__all__ = ["Anchor", "AnchorState", "Ranging", "RangingResult"]

ScalePrior = tuple[float, float] | None
TRY_AGAIN: Final = 1.15
"""A start is tried again when so many times the ranges are there."""
RECENT_S: Final = 5.0
CHECK_AGAIN: Final = 1.5
"""And all is searched again when so many times the ranges are there."""
LEAST_RECENT: Final = 20
DOUBTFUL_SHARE: Final = 0.6
"""Of the last 5 s of an anchor's ranges, with next to no weight."""


class _Own(NamedTuple):
    """What is kept of an anchor."""

    name: str
    state: AnchorState = AnchorState.UNKNOWN
    alternatives: tuple[tuple[Array, float], ...] = ()
    """Places (3,) m, and biases."""
    lost_s: float = np.inf
    """From then on its ranges fit no more, and are left out."""
    times_open: float = 1.0
    """How many times its sigma its place is open, see :func:`.widening.opened`."""


class Ranging:
    """The ranges of a run."""

    def __init__(
        self,
        ranges: Ranges,
        lever_arm_m: Array,
        rules: StartRules | None = None,
        lever_sigma_m: float = 0.0,
    ) -> None:
        """Take all ranges of the run; only those before the newest frame are used.

        Parameters
        ----------
        lever_arm_m : (3,) camera to antenna, camera axes.
        lever_sigma_m : standard deviation of each of its numbers; above 0 it is found as well.
        """
        self.ranges, self.lever_arm_m = ranges, np.asarray(lever_arm_m, dtype=np.float64)
        self.lever_sigma_m = lever_sigma_m
        self.rules = StartRules() if rules is None else rules
        self.anchor: Indices = ranges.anchor.copy()
        self.anchors = [_Own(name) for name in ranges.names]
        self.start: Start | None = None
        self.found: Solution | None = None
        self.used: list[int] = []
        self.terms: RangeTerms | None = None
        self.history: list[tuple[float, float, float]] = []
        self.started_s = float("nan")
        self.error, self.weight = np.full((2, len(ranges)), np.nan)
        self._scale_prior: ScalePrior = None
        self._tried = self._checked = 0

    @property
    def is_refused(self) -> bool:
        """Whether the ranges contradict themselves."""
        return self.start is not None and self.start.state is StartState.REFUSED

    @property
    def has_scale(self) -> bool:
        """Whether map units can be turned into metres."""
        return self.found is not None and not self.is_refused

    @property
    def scale(self) -> float:
        """Metres a map unit; NaN without."""
        return self.found.scale if self.found is not None else float("nan")

    def update(
        self, frames: FramePoses, R_cw: Array, t_cw: Array, scale_prior: ScalePrior = None
    ) -> list[str]:
        """Take the poses as they stand, start or go on, and return what happened, in words.

        Parameters
        ----------
        frames : all frames so far.
        R_cw, t_cw : (K, 3, 3) and (K, 3) of the key frames.
        scale_prior : mean and standard deviation of log s, where something else knows it.
        """
        self._scale_prior = scale_prior
        self.terms = hang(self.ranges, frames, R_cw, t_cw, lever_arm_m=self.lever_arm_m)
        self.terms = replace(self.terms, anchor=self.anchor[self.terms.row])
        if not len(self.terms):
            return []
        places = self.places(R_cw, t_cw)
        now = float(places.time_s[-1])
        if self.found is None:
            if len(places.time_s) < TRY_AGAIN * self._tried:
                return []
            self._tried = len(places.time_s)
            told = self._start(places, largest_turn(R_cw))
        else:
            told = [*self._go_on(places, now), *self._later(places)]
        if self.found is not None:
            self.history.append((now, self.found.scale, self.found.sigma_log_scale))
        return told

    def places(self, R_cw: Array, t_cw: Array) -> Places:
        """Return where the antenna was at each range, by the key frames' poses."""
        assert self.terms is not None
        return places_of(self.terms, R_cw, t_cw, self.ranges.time_s, self.lever_sigma_m)

    @property
    def lever_error_m(self) -> Array:
        """(3,) what the lever arm is off by, camera axes, as far as ranges tell."""
        arm = None if self.found is None else self.found.arm
        return np.zeros(3) if arm is None else self.lever_sigma_m * arm

    def check_again(self) -> None:
        """Have the next update search everywhere, however few ranges have come since it did.

        It refuses nothing: halves that were asked once more refused 1 of 12 sound walks of a room.
        """
        self._tried = self._checked = 0

    def restart(self) -> None:
        """Forget scale and anchors: the map's scale has changed. The next update starts anew.

        When they were known first is kept.
        """
        self.found, self._tried, self._checked = None, 0, 0
        self.anchors = [_Own(own.name) for own in self.anchors]

    def further(self, pose_of: Indices, *, is_free: bool = False) -> BundleRanges | None:
        """Return the ranges of some key frames as terms of their adjustment; None without scale.

        Parameters
        ----------
        pose_of : (K,) index of each key frame among the problem's poses, -1 for the others.
        is_free : whether scale, clock, anchors and biases are adjusted with them.
        """
        if self.found is None or self.terms is None or self.is_refused:
            return None
        column = np.full(len(self.anchors), -1, dtype=np.intp)
        column[self.used] = np.arange(len(self.used))
        column[[own.state is AnchorState.DOUBTFUL for own in self.anchors]] = -1
        known = pose_of[np.minimum(self.terms.key_frame, len(pose_of) - 1)]
        known = np.where(self.terms.key_frame < len(pose_of), known, -1)
        kept = (known >= 0) & (column[self.terms.anchor] >= 0)
        if not kept.any():
            return None
        own = self.terms.rows(kept).with_lever(self.lever_error_m)
        return BundleRanges(
            replace(own, anchor=column[own.anchor]), known[kept],
            self.found.scale, self.found.clock_s, self.found.anchors, self.found.biases,
            POLISH,  # what is far too long would bend biases and anchors otherwise
            is_free,
        )  # fmt: skip

    def adopt(self, extra: Array, covariance: Array, further: BundleRanges) -> None:
        """Take over what an adjustment with free scale and anchors found, (E,) and (E, E).

        It trusts pixels; what a path may drift by is in the covariance from before alone.
        """
        assert self.found is not None
        own = extra[2:].reshape(-1, 4)
        wider = max(1.0, float(self.found.covariance[0, 0] / covariance[0, 0]))
        self.found = replace(
            self.found,
            scale=further.scale * float(np.exp(extra[0])),
            clock_s=further.clock_s + float(extra[1]),
            anchors=further.anchors + own[:, :3],
            biases=further.biases + own[:, 3],
            covariance=wider * covariance,
        )
        self.found = self._as_open(self.found)

    def _as_open(self, found: Solution) -> Solution:
        """Return a solution whose anchors are as open as they were found to be."""
        return with_open(found, np.array([self.anchors[j].times_open for j in self.used]))

    def result(self) -> RangingResult:
        """Return all as it stands."""
        found = self.found
        state = StartState.WAITING if self.start is None else self.start.state
        if found is not None and not self.is_refused:
            is_open = any(own.state is AnchorState.AMBIGUOUS for own in self.anchors)
            state = StartState.MIRROR if is_open else StartState.READY
            if found.sigma_log_scale > self.rules.ready_sigma:
                state = StartState.COARSE
        return RangingResult(
            state, self.scale, found.sigma_log_scale if found is not None else float("nan"),
            found.clock_s if found is not None else 0.0,
            float(np.sqrt(found.covariance[1, 1])) if found is not None else float("nan"),
            tuple(self._shown(j) for j in range(len(self.anchors))),
            self.error.copy(), self.weight.copy(), self.anchor.copy(),
            np.array(self.history).reshape(-1, 3),
            () if self.start is None else self.start.reasons,
            "" if self.start is None else self.start.advice,
            self.started_s, lever_error_m=self.lever_error_m,
        )  # fmt: skip

    def _shown(self, j: int) -> Anchor:
        own, found = self.anchors[j], self.found
        weight = self.weight[(self.anchor == j) & np.isfinite(self.weight)]
        place, covariance, bias, sigma = np.full(3, np.nan), np.full((3, 3), np.nan), 0.0, np.nan
        if found is not None and j in self.used:
            i = self.used.index(j)
            place, covariance = found.anchors[i].copy(), found.anchor_covariance(i).copy()
            square = found.covariance[5 + 4 * i, 5 + 4 * i]
            bias, sigma = float(found.biases[i]), float(np.sqrt(square))
        return Anchor(
            own.name, own.state, place, covariance, bias, float(sigma),
            np.array([where for where, _ in own.alternatives]).reshape(-1, 3),
            int((self.anchor == j).sum()),
            float(np.mean(weight < NLOS_WEIGHT)) if len(weight) else float("nan"),
        )  # fmt: skip

    def _start(self, places: Places, turned_rad: float) -> list[str]:
        """Try to find scale and the anchors that have ranges enough."""
        counts = np.bincount(places.anchor, minlength=len(self.anchors))
        eligible = np.flatnonzero(counts >= self.rules.least_ranges)
        if not len(eligible):
            eligible = np.array([int(np.argmax(counts))])
        own, _ = of_anchors(places, eligible)
        names = tuple(self.anchors[j].name for j in eligible)
        self.start = find_start(
            own,
            names,
            self.rules,
            turned_rad=turned_rad,
            spacing=known_spacing(self.ranges.known_position, eligible),
            scale_prior=self._scale_prior,
        )
        if not self.start.has_scale or self.start.solution is None:
            return []
        self._checked = len(places.time_s)
        self.found, self.used = self.start.solution, [int(j) for j in eligible]
        now = float(places.time_s[-1])
        self.started_s = float(np.fmin(self.started_s, now))
        for i, j in enumerate(self.used):
            is_ready = self.start.anchor_ready[i]
            self._set(
                j,
                state=AnchorState.READY if is_ready else AnchorState.AMBIGUOUS,
                alternatives=tuple(
                    (one.anchors[i].copy(), float(one.biases[i])) for one in self.start.alternatives
                ),
            )
        self._go_on(places, now)
        found = self.found
        return [
            f"scale {found.scale:.4g} m a map unit, known to {100 * found.sigma_log_scale:.1f} % "
            f"({self.start.state.name.lower()}); "
            + ", ".join(f"anchor {self.anchors[j].name} {self.anchors[j].state.name.lower()}"
                        for j in self.used)
        ]  # fmt: skip

    def _set(self, j: int, **changed: Any) -> None:
        self.anchors[j] = self.anchors[j]._replace(**changed)

    def _go_on(self, places: Places, now: float) -> list[str]:
        """Take up all ranges of the anchors in use."""
        assert self.found is not None
        everything, kept = of_anchors(places, np.array(self.used))
        lost_s = np.array([self.anchors[j].lost_s for j in self.used])
        fits = np.flatnonzero(everything.time_s < lost_s[everything.anchor])
        own = everything.rows(fits)
        problem = problem_of(
            own,
            len(self.used),
            self.rules.kernel,
            drift=self.rules.ledger_drift,
            bias_walk_m=self.rules.bias_walk_m,
            spacing=known_spacing(self.ranges.known_position, np.array(self.used)),
            scale_prior=self._scale_prior,
        )
        before = self.found
        start = unknowns_of(problem, before.scale, before.anchors, before.biases, before.clock_s)
        problem = widened(problem, solution(problem, start, rounds=3))
        self.found = polished(problem, solution(problem, start, rounds=3))
        told: list[str] = []
        if len(places.time_s) > CHECK_AGAIN * self._checked:
            may_refuse, self._checked = self._checked > 0, len(places.time_s)
            told = self._check(own, problem, may_refuse=may_refuse)
            self._rivals(problem)
        if self._checked == len(places.time_s):
            for j, times in zip(self.used, opened(problem, self.found), strict=True):
                self._set(j, times_open=float(times))
        self.found = self._as_open(self.found)
        assert self.terms is not None
        row = self.terms.row[kept]
        self.error[row], self.weight[row] = plain_errors(everything, self.found)
        self.error[row[fits]], self.weight[row[fits]] = self.found.error, self.found.weight
        return [*told, *self._sharpened(everything, self.weight[row], now)]

    def _check(self, own: Places, problem: Problem, *, may_refuse: bool) -> list[str]:
        """Search everywhere again, with all ranges of the anchors in use; take what is better."""
        assert self.found is not None
        names = tuple(self.anchors[j].name for j in self.used)
        again = find_start(
            own, names, self.rules, turned_rad=np.inf, spacing=problem.spacing,
            scale_prior=self._scale_prior,
        )  # fmt: skip
        was_refused = self.is_refused
        if may_refuse or was_refused or again.state is not StartState.REFUSED:
            self.start = again
        told, best = [], again.solution
        if self.is_refused != was_refused:
            what = "; ".join(again.reasons) if self.is_refused else "no contradiction any more"
            told = [f"scale {'doubted' if self.is_refused else 'believed again'}: {what}"]
        if best is None:
            return told
        # A place that is as good by now was not there, or was left, when there were fewer ranges.
        for i, j in enumerate(self.used):
            known, others = self.anchors[j].alternatives, (best, *again.alternatives)
            fresh = [one for one in others if moved(self.found, one, i)]
            found = [(one.anchors[i].copy(), float(one.biases[i])) for one in fresh]
            self._set(j, alternatives=(*known, *found))
        other = unknowns_of(problem, best.scale, best.anchors, best.biases, best.clock_s)
        fit = search(problem, np.array([self.found.unknowns, other]))
        if fit.cost[1] < fit.cost[0] - self.rules.gap:
            old = self.found.scale
            self.found = solution(problem, fit.unknowns[1], is_near=True)
            told.append(f"a better solution: {self.found.scale / old:.3f} times the scale before")
        return told

    def _rivals(self, problem: Problem) -> None:
        """Try the other places of anchors that have some; keep what is best, and as good."""
        assert self.found is not None
        for i, j in enumerate(self.used):
            known = self.anchors[j].alternatives
            if known:
                self.found, kept = against_rivals(problem, self.found, i, known, self.rules.gap)
                self._set(j, alternatives=kept)

    def _sharpened(self, at: Places, weight: Array, now: float) -> list[str]:
        """Judge the anchors anew: sharpness, and whether the last ranges fit."""
        assert self.found is not None
        told = []
        for i, j in enumerate(self.used):
            own = self.anchors[j]
            recent = (at.anchor == i) & (at.time_s > now - RECENT_S)
            sharp = not own.alternatives and is_sharp(self.found, self.rules, at, i)
            state = AnchorState.READY if sharp else AnchorState.AMBIGUOUS
            lost_s = np.inf
            marked = weight[recent] < NLOS_WEIGHT
            if recent.sum() >= LEAST_RECENT and float(np.mean(marked)) > DOUBTFUL_SHARE:
                since = lost_since(self.ranges.time_s, self.anchor == j, self.weight)
                state, lost_s = AnchorState.DOUBTFUL, min(own.lost_s, since)
            if own.state is not state:
                told.append(f"anchor {own.name}: {state.value}")
            self._set(j, state=state, lost_s=lost_s)
        return told

    def _later(self, places: Places) -> list[str]:
        """Place anchors that have ranges enough by now, and anew those that seem to have moved."""
        assert self.found is not None
        told = []
        for j in range(len(self.anchors)):
            own, unused = self.anchors[j], j not in self.used
            is_lost = own.state is AnchorState.DOUBTFUL
            mine = places.anchor == j
            since = own.lost_s if is_lost else -np.inf
            mine = mine & (places.time_s >= since)
            rows = np.flatnonzero(mine)
            if not (unused or is_lost) or len(rows) < self.rules.least_ranges:
                continue
            if float(np.ptp(places.time_s[rows])) < self.rules.least_s:
                continue
            placed = placed_later(places.rows(rows), self.found, self.rules)
            if placed is None:
                continue
            told.append(self._take(j, *placed, since))
        return told

    def _take(self, j: int, place: Array, bias: float, covariance: Array, since: float) -> str:
        """Take an anchor into use; one that moved becomes another from some time on."""
        assert self.found is not None
        name = self.anchors[j].name
        has_moved = bool(np.isfinite(since))
        if has_moved:
            recent = (self.anchor == j) & (self.ranges.time_s >= since)
            self.anchors.append(_Own(f"{name} from {since:.1f} s"))
            self.anchor[recent] = len(self.anchors) - 1
            self._set(j, state=AnchorState.READY, lost_s=np.inf)
            j = len(self.anchors) - 1
        self._set(j, state=AnchorState.READY)
        self.used.append(j)
        found = self.found
        n = len(found.covariance)
        wider = np.zeros((n + 4, n + 4))
        wider[:n, :n], wider[n:, n:] = found.covariance, covariance
        self.found = replace(
            found,
            anchors=np.vstack([found.anchors, place]),
            biases=np.append(found.biases, bias),
            covariance=wider,
        )
        return f"anchor {name} " + ("has moved: placed anew" if has_moved else "placed")
