"""What makes a map metric: ranges to anchors, and what the vehicle measures itself.

Ranges have a unit of their own, that of the sound speed, and dead reckoning that of its DVL. Each
gives a scale; the better known is the map's, and the ratio of both tells the sound speed.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.frozen import Array
from ssm_graph.systems.visual_ranges.bundle import FurtherTerms
from ssm_graph.systems.visual_ranges.bundle_metric import BundleMetric
from ssm_graph.systems.visual_ranges.bundle_ranges import BundleRanges
from ssm_graph.systems.visual_ranges.loop_closing import Step
from ssm_graph.systems.visual_ranges.range_rows import known_spacing, of_anchors
from ssm_graph.systems.visual_ranges.range_terms import FramePoses
from ssm_graph.systems.visual_ranges.ranges import Ranges
from ssm_graph.systems.visual_ranges.ranging import Ranging, RangingResult
from ssm_graph.systems.visual_ranges.ranging_result import VehicleResult
from ssm_graph.systems.visual_ranges.start import StartRules, StartState
from ssm_graph.systems.visual_ranges.two_scales import OwnScale, contradiction
from ssm_graph.systems.visual_ranges.vehicle import Vehicle
from ssm_graph.systems.visual_ranges.vehicle_terms import (
    MetricState,
    VehicleTerms,
    hung,
    metric_state,
)

Indices = NDArray[np.intp]

LEAST_LINK: Final = 1e-4
"""Two scales are never held nearer to each other than this: it is what the bundle can resolve."""


class Metric:
    """Scale, anchors and vertical of a run."""

    def __init__(
        self,
        ranges: Ranges,
        lever_arm_m: Array,
        vehicle: Vehicle = Vehicle(),  # noqa: B008
        rules: StartRules | None = None,
        lever_sigma_m: float = 0.0,
    ) -> None:
        """Take all that was measured; only what is before the newest frame is used.

        Parameters
        ----------
        lever_arm_m : (3,) camera to the ranges' antenna, camera axes.
        lever_sigma_m : standard deviation of each of its numbers; above 0 it is found as well.
        """
        self.vehicle = vehicle
        self.rules = StartRules() if rules is None else rules
        self.ranging = Ranging(ranges, lever_arm_m, self.rules, lever_sigma_m)
        self.terms: VehicleTerms | None = None
        self.state: MetricState | None = None
        self.started_s = float("nan")
        self._history: list[tuple[float, float, float]] = []
        self._poses: tuple[Array, Array] | None = None
        self._own_share = vehicle.scale_share
        self.link = max(float(np.hypot(self._own_share, vehicle.range_scale_share)), LEAST_LINK)

    @property
    def is_aided(self) -> bool:
        """Whether the vehicle gives a scale that may be used."""
        return self.state is not None and self._own_sigma < self.rules.scale_sigma

    @property
    def _own_sigma(self) -> float:
        assert self.state is not None
        return float(np.hypot(np.sqrt(self.state.covariance[0, 0]), self._own_share))

    @property
    def _range_sigma(self) -> float:
        """Of the scale as ranges have it, their unit included; infinite without."""
        found = self.ranging.found
        if found is None or self.ranging.is_refused:
            return np.inf
        return float(np.hypot(found.sigma_log_scale, self.vehicle.range_scale_share))

    @property
    def has_scale(self) -> bool:
        """Whether map units can be turned into metres."""
        return self.is_aided or self.ranging.has_scale

    @property
    def scale(self) -> float:
        """Metres a map unit; NaN without."""
        if self.is_aided and self._own_sigma < self._range_sigma:
            assert self.state is not None
            return float(np.exp(self.state.log_scale))
        return self.ranging.scale

    def update(self, frames: FramePoses, R_cw: Array, t_cw: Array, time_s: Array) -> list[str]:
        """Take the poses as they stand, start or go on, and return what happened, in words.

        Parameters
        ----------
        frames : all frames so far.
        R_cw, t_cw, time_s : (K, 3, 3), (K, 3) and (K,) of the key frames.
        """
        told, prior = [], None
        self._poses = (R_cw, t_cw)
        if self.vehicle.has_aids:
            self.terms, was_aided = hung(self.vehicle, time_s), self.is_aided
            self.state = metric_state(self.terms, R_cw, t_cw)
            if self.is_aided:
                assert self.state is not None
                prior = (self.state.log_scale, self._prior_sigma())
                if not np.isfinite(self.started_s):
                    self.started_s = float(time_s[-1])
            if self.is_aided and not was_aided:
                told.append(
                    f"scale {self.scale:.4g} m a map unit by the vehicle's own sensors, known to "
                    f"{100.0 * self._own_sigma:.1f} %"
                )
        told += self.ranging.update(frames, R_cw, t_cw, prior)
        if self.has_scale:
            sigma = min(self._own_sigma if self.is_aided else np.inf, self._range_sigma)
            self._history.append((float(time_s[-1]), self.scale, sigma))
        return told

    def _prior_sigma(self) -> float:
        assert self.state is not None
        return float(np.hypot(np.sqrt(self.state.covariance[0, 0]), self.link))

    def restart(self) -> None:
        """Forget scale and anchors: the map's scale has changed. The next update starts anew."""
        self.state = None
        self.ranging.restart()

    def further(self, pose_of: Indices, *, is_free: bool = False) -> FurtherTerms | None:
        """Return what bears on some key frames as terms of their adjustment; None without scale.

        Parameters
        ----------
        pose_of : (K,) index of each key frame among the problem's poses, -1 for the others.
        is_free : whether scale, clock, anchors, biases and vertical are adjusted with them.
        """
        ranges = self.ranging.further(pose_of, is_free=is_free)
        if not self.is_aided or self.terms is None or self.state is None:
            return ranges
        terms = self.terms.on(np.asarray(pose_of, dtype=np.int64))
        return BundleMetric(ranges, terms, self.state, self.link, is_free) if len(terms) else ranges

    def adopt(self, extra: Array, covariance: Array, further: FurtherTerms | None) -> None:
        """Take over what an adjustment with all free found, (E,) and (E, E)."""
        ranges = further
        if isinstance(further, BundleMetric):
            assert self.state is not None
            own, ranges = further.n_ranges, further.ranges
            found = covariance[own:, own:]
            # As for ranges: no sharper than the path allowed before.
            wider = max(1.0, float(self.state.covariance[0, 0] / found[0, 0]))
            self.state = replace(further.state.moved(extra[own:]), covariance=wider * found)
            extra, covariance = extra[:own], covariance[:own, :own]
        if isinstance(ranges, BundleRanges):
            self.ranging.adopt(extra, covariance, ranges)

    def steps(self, R_cw: Array, t_cw: Array) -> list[Step]:
        """Return dead reckoning between key frames for a loop's graph, in map units."""
        if not self.is_aided or self.terms is None or self.state is None:
            return []
        terms, scale = self.terms, float(np.exp(self.state.log_scale))
        rows = terms.rows(R_cw, t_cw, self.state)
        weight = terms.weights(rows.error, np.zeros(len(terms)))
        n = len(terms.step_of)
        first = len(terms) - 6 * n
        own = weight[first : first + 3 * n : 3]
        return [
            Step(int(i), int(j), step / scale, float(sigma) / scale, float(w))
            for (i, j), step, sigma, w in zip(
                terms.step_of, terms.step_m, terms.step_sigma_m, own, strict=True
            )
        ]

    def result(self) -> RangingResult:
        """Return all as it stands, in metres by the better known scale."""
        told, share = self.ranging.result(), self.vehicle.range_scale_share
        reasons = told.reasons
        if share and not self.is_aided and told.has_scale:
            reasons += (
                f"the sound speed is known to {100.0 * share:g} %, and its error is one of the "
                "scale: nothing else here is in metres",
            )
        sigma = min(self._own_sigma if self.is_aided else np.inf, self._range_sigma)
        is_known = self.has_scale
        factor = self.scale / told.scale if is_known and told.has_scale else 1.0
        state = told.state
        if self.is_aided and not told.has_scale:
            if state is StartState.REFUSED:
                state = StartState.WITHOUT_RANGES
            else:
                state = StartState.MIRROR if len(self.ranging.ranges) else StartState.READY
        is_judged = state.has_scale and state is not StartState.WITHOUT_RANGES
        if is_known and is_judged and sigma > self.rules.ready_sigma:
            state = StartState.COARSE
        elif self.is_aided and state is StartState.COARSE:
            sharp = all(not len(a.alternatives_m) for a in told.anchors)
            state = StartState.READY if sharp else StartState.MIRROR
        history = np.array(self._history).reshape(-1, 3) if self._history else told.scale_history
        return replace(
            told,
            state=state,
            scale=self.scale,
            sigma_log_scale=sigma if is_known else told.sigma_log_scale,
            anchors=tuple(
                replace(
                    one,
                    place_m=factor * one.place_m,
                    covariance=factor**2 * one.covariance,
                    alternatives_m=factor * one.alternatives_m,
                )
                for one in told.anchors
            ),
            scale_history=history,
            reasons=reasons,
            started_s=float(np.fmin(self.started_s, told.started_s)),
            vehicle=self._vehicle(told),
        )

    def _vehicle(self, told: RangingResult) -> VehicleResult | None:
        if self.state is None or not self.is_aided:
            return None
        has_both, log_scale = self.ranging.has_scale, self.state.log_scale
        return VehicleResult(
            self.state.down,
            self.state.covariance[1:3, 1:3],
            self.state.depth_m,
            float(np.exp(log_scale)),
            self._own_sigma,
            float(self.ranging.scale / np.exp(log_scale)) if has_both else float("nan"),
            float(np.hypot(told.sigma_log_scale, self._own_sigma)) if has_both else float("nan"),
            self._contradiction() if has_both else "",
        )

    def _contradiction(self) -> str:
        """Return what speaks against both scales being one, asked of the ranges alone."""
        assert self.state is not None
        ranging = self.ranging
        if ranging.terms is None or self._poses is None:
            return ""
        places = ranging.places(*self._poses)
        used = np.array(ranging.used)
        own, _ = of_anchors(places, used)
        lost_s = np.array([ranging.anchors[j].lost_s for j in ranging.used])
        own = own.rows(np.flatnonzero(own.time_s < lost_s[own.anchor]))
        return contradiction(
            own,
            tuple(ranging.anchors[j].name for j in ranging.used),
            OwnScale(
                "depth sensor" if self.vehicle.dead_reckoning is None else "dead reckoning (DVL)",
                self.state.log_scale,
                float(np.hypot(self._own_sigma, self.vehicle.range_scale_share)),
            ),
            self.rules,
            spacing=known_spacing(ranging.ranges.known_position, used),
        )
