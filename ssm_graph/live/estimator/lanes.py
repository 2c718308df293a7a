"""Cheap filters beside the window, each of which leaves one sensor out for a while.

A lane begins with what all sensors say and goes on without one of them for 10, 60 or 240 s; two of
each length take turns. What it says then owes nothing to what that sensor did since: a sensor that
lies for long, or whose readings all lie alike, parts the lanes from the answer. That is solution
separation. One more lane leaves nothing out and is the measure of the others: all have one model,
that of the window with a share of the noise that lasts, and then the covariance of a separation is
the difference of their covariances.

Inertial data cannot be left out, for all else hangs on them. Their lanes forget the bias of the
gyros where they begin, for 60 or 240 s: a bias that has jumped since is found anew from what the
other sensors say of turns and accelerations, and parts them from the measure, which knows it from
before.

All lanes are linear about the answer of the window, whose rows and weights they use, and are
carried as deviations from it in arrays: a keyframe costs as much as a few small products.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.frozen import Array
from ssm_graph.engine.error_state import GYRO_BIAS
from ssm_graph.engine.states import States
from ssm_graph.graph.aids.depth import DEPTH_DRIFT, DepthMeans
from ssm_graph.graph.aids.gnss import GNSS_DRIFT, Fixes
from ssm_graph.graph.aids.heading import Headings
from ssm_graph.graph.aids.magnetometer import MagneticFields
from ssm_graph.graph.aids.ranges import Ranges
from ssm_graph.graph.aids.usbl import UsblFixes
from ssm_graph.live.estimator.jumps import JUMP, Jumps
from ssm_graph.mission.calibration import DVL_DRIFT
from ssm_graph.sensors.dvl import MOST_BEAMS
from ssm_graph.smoothers.keyframe import Keyframe, Sensors
from ssm_graph.smoothers.window import BEAMS, Window
from ssm_graph.smoothers.window_aids import SensorRows

LENGTHS_S: Final = (10.0, 60.0, 240.0)
"""So long a lane leaves its sensor out; two of each, half of it apart."""
INERTIAL_S: Final = LENGTHS_S[1:]
"""And those that forget the bias of the gyros: 10 s of other sensors say little of one."""
DVL, DEPTH = "DVL", "depth"
INERTIAL: Final = "the inertial data"
ACOUSTICS: Final = "acoustic fixes"
COMPASS: Final = "compass"
SUSPECT_OF: Final = {
    BEAMS: DVL,
    Fixes.name: Fixes.name,
    UsblFixes.name: ACOUSTICS,
    Ranges.name: ACOUSTICS,
    DepthMeans.name: DEPTH,
    Headings.name: COMPASS,
    MagneticFields.name: COMPASS,
}
"""What is left out together, by the name of the sensor's rows; others are never left out."""
FIXES: Final = (Fixes.name, ACOUSTICS)
"""Those that tell where the vehicle is."""
LASTING: Final = {DVL: 0.125, Fixes.name: 0.02}
"""Share of a sensor's variance that may last, by suspect: it is a state of every lane, unless the
vehicle states a drift, which is a state of the window then. That of a DVL is what bottom tracks
show (`simulation.instruments.BeamNoise`)."""
LASTING_OF_OTHERS: Final = 0.25
LASTING_S: Final = 20.0
"""Correlation time of what lasts."""
DRIFTS: Final = {BEAMS: DVL_DRIFT, Fixes.name: GNSS_DRIFT, DepthMeans.name: DEPTH_DRIFT}
"""What a stated drift is called, by the name of the sensor's rows."""
MISFIT_S: Final = 10.0
"""A misfit is forgotten within so much."""
BEGUN_ANEW: Final = 1e4
"""Misfit of a measure that was just begun anew: it fits whatever it was begun with, which may be
what lies, and so refutes no lane until this is forgotten, about a minute."""
LEAST_WEIGHT: Final = 1e-9
"""What the window refuses must not pull at lanes either: a row a thousand sigmas off, of a weight
of 1e-3, would do so by thirty of them at every ping."""
MEMORY_S: Final = 10.0
"""Time constant of the low-passed innovation ratios."""
DOUBT_FACTOR: Final = 2.0
"""What the window says is doubted by so much where lanes begin with it: it knows nothing of noise
that lasts."""
MEASURE: Final = 0
"""The lane that leaves nothing out."""


class Lanes(NamedTuple):
    """L lanes at a keyframe, n components of state, of S suspects.

    The state is that of the window's keyframes, then what lasts of each component that is measured,
    in sigmas of its noise.
    """

    deviation: Array
    """(L, n) from the newest state of the window, where nothing lasts"""
    covariance: Array
    """(L, n, n)"""
    begun_s: Array
    """(L,) s; infinite for a lane that is not used"""
    n_out: Array
    """(L,) rows left out since"""
    n_fixes: Array
    """(L,) rows of fixes that counted since"""
    evidence: Array
    """(L,) by how much more than noise the measure's chi-square has grown since than the lane's"""
    misfit: Array
    """(L,) by how much more than noise its own chi-square has grown lately"""
    is_nested: Array
    """(L,) 1 where the lane and the measure have the same past, else 0"""
    last_s: Array
    """(S,) when each suspect was last heard, s"""
    ratio: Array
    """(S, 8) low-passed innovations in their sigmas, NaN where there are none"""
    doubted_s: Array
    """(S,) when the answer was last begun anew because each suspect contradicted it, s"""
    jumps: Jumps
    """Those of the gyros' bias that may have been"""

    def pack(self) -> Iterator[tuple[str, Array]]:
        """Yield name and array of everything."""
        yield from zip(self._fields[:-1], self[:-1], strict=True)
        yield from self.jumps.pack()

    @classmethod
    def unpack(cls, arrays: Mapping[str, Array]) -> Lanes:
        """Return the lanes that were packed."""
        own: dict[str, Any] = {name: arrays[name] for name in cls._fields[:-1]}
        return cls(**own, jumps=Jumps.unpack(arrays))

    def with_copy(self, into: int, of: int) -> Lanes:
        """Return the lanes with one of them as another one is."""
        changed: dict[str, Any] = {}
        for name in _BY_LANE:
            column = getattr(self, name).copy()
            column[into] = column[of]
            changed[name] = column
        return self._replace(**changed)


_BY_LANE: Final = Lanes._fields[: Lanes._fields.index("last_s")]


class LaneBank:
    """Which lanes a vehicle has, and how they go on from keyframe to keyframe."""

    def __init__(self, sensors: Sensors) -> None:
        named = [BEAMS, *sensors.aids]
        heard = dict.fromkeys(s for n, s in SUSPECT_OF.items() if n in named)
        self.suspects = (*heard, INERTIAL)
        """What is left out, each in its turn"""
        lengths = [np.repeat(INERTIAL_S if s == INERTIAL else LENGTHS_S, 2) for s in self.suspects]
        ends = np.cumsum([len(each) + 1 for each in lengths])
        self.suspect = np.concatenate(
            [[-1], *(np.full(len(each) + 1, s) for s, each in enumerate(lengths))]
        )
        """(L,) which of them each lane leaves out, -1 for none"""
        self.length_s = np.concatenate([[np.inf], *(np.append(each, np.inf) for each in lengths)])
        """(L,) how long; infinite for the measure, and for a lane that is held"""
        self._stagger_s = np.concatenate(
            [[0.0], *(np.append(each * np.resize([0.0, 0.5], len(each)), 0.0) for each in lengths)]
        )
        self._first, self.held = np.append(1, ends[:-1] + 1), ends
        """(S,) the first lane of each suspect, and that which is led on once it contradicts"""
        self._forgets = self.suspect == self.suspects.index(INERTIAL)
        self._is_fix = np.array([*(name in FIXES for name in self.suspects), False])
        """(S + 1,) the last for rows that are never left out"""
        dims = {BEAMS: sensors.beams.n_beams, **{k: aid.dim for k, aid in sensors.aids.items()}}
        self._lasting: dict[str, slice] = {}
        shares, end = [], sensors.state_dim
        for name, suspect in SUSPECT_OF.items():
            if name in dims and DRIFTS.get(name, "") not in sensors.extras:
                self._lasting[name] = slice(end, end + dims[name])
                end += dims[name]
                shares += [LASTING.get(suspect, LASTING_OF_OTHERS)] * dims[name]
        self.undrifting = {SUSPECT_OF[name] for name in self._lasting if name in DRIFTS}
        """Suspects whose errors would last if the vehicle stated a drift"""
        self._share = np.array(shares)
        """Variance of what lasts, in that of the noise"""
        self._n = sensors.state_dim

    def lanes_of(self, suspect: int) -> range:
        """Return the lanes that leave a suspect out, that which is held last."""
        return range(int(self._first[suspect]), int(self.held[suspect]) + 1)

    def begin(self, window: Window, led_on: Sequence[int] = ()) -> Lanes:
        """Return the lanes that begin with the newest state of a window.

        ``led_on`` are suspects that are known to contradict.
        """
        L, S = len(self.suspect), len(self.suspects)
        time_s = window.keyframes[-1].time_s
        covariance = self._beside(window.newest_covariance * DOUBT_FACTOR**2)
        begun_s = time_s - self._stagger_s
        begun_s[self.held] = np.inf
        begun_s[self.held[list(led_on)]] = time_s
        lanes = Lanes(
            np.zeros((L, len(covariance))),
            np.tile(covariance, (L, 1, 1)),
            begun_s,
            np.zeros(L),
            np.zeros(L),
            np.zeros(L),
            np.zeros(L),
            np.ones(L),
            np.full(S, -np.inf),
            np.full((S, MOST_BEAMS), np.nan),
            np.full(S, -np.inf),
            Jumps.none(len(covariance)).with_next(time_s),
        )
        return self._begun(lanes, np.ones(L, dtype=np.bool_), begun_s)

    def led_on(self, lanes: Lanes, last: States, keyframe: Keyframe, window: Window) -> Lanes:
        """Return the lanes at the next keyframe, with which the window is settled.

        ``last`` (1, ...) is the state of the window before it.
        """
        lanes = self._predicted(lanes, last, keyframe, window)
        measured = list(window.newest_rows())
        if measured:
            lanes = self._updated(lanes, measured, keyframe.time_s)
        return self._begun_anew(lanes, keyframe.time_s)

    def after_doubt(
        self,
        lanes: Lanes,
        last: States,
        keyframe: Keyframe,
        window: Window,
        doubted: Sequence[str],
    ) -> Lanes:
        """Return the lanes at a keyframe where a window was begun anew.

        ``doubted`` are the suspects that contradicted the answer, or may have bent it. Lanes
        without these, or that of them which is led on, know what was before and stay; the others
        begin with what the window says now, as the measure does.
        """
        lanes = self._predicted(lanes, last, keyframe, window)
        own = [s for s, name in enumerate(self.suspects) if name in doubted]
        is_led_on = np.isfinite(lanes.begun_s[self.held])
        stays = np.isin(self.suspect, [s for s in own if not is_led_on[s]])
        stays[self.held] = True
        deviation, covariance = lanes.deviation.copy(), lanes.covariance.copy()
        deviation[MEASURE] = 0.0
        covariance[MEASURE] = self._beside(window.newest_covariance)
        doubted_s = lanes.doubted_s.copy()
        doubted_s[own] = keyframe.time_s
        lanes = lanes._replace(
            deviation=deviation,
            covariance=covariance,
            is_nested=np.zeros(len(deviation)),
            doubted_s=doubted_s,
            jumps=Jumps.none(len(covariance[MEASURE])).with_next(keyframe.time_s),
        )
        lanes = self._begun(lanes, ~stays, keyframe.time_s - self._stagger_s)
        misfit = lanes.misfit.copy()
        misfit[MEASURE] = BEGUN_ANEW
        return self._begun_anew(lanes._replace(misfit=misfit), keyframe.time_s)

    def _beside(self, covariance: Array) -> Array:
        """Return a covariance (n, n) with that of what lasts beside it."""
        n, whole = len(covariance), np.diag(np.append(np.zeros(len(covariance)), self._share))
        whole[:n, :n] = covariance
        return whole

    def _predicted(self, lanes: Lanes, last: States, keyframe: Keyframe, window: Window) -> Lanes:
        assert keyframe.inertial is not None
        interval, now = keyframe.inertial, window.newest_states
        ahead = window.ahead or window.inertial.predict(interval, last)
        covariance, span_s = ahead.covariance(lanes.covariance), float(interval.span_s[0])
        n, kept = self._n, np.exp(-span_s / LASTING_S)
        covariance[:, n:] *= kept
        covariance[:, :, n:] *= kept
        own = n + np.arange(len(self._share))
        covariance[:, own, own] += self._share * (1.0 - kept**2)
        # From the prediction to where the window is now.
        off = now.navigation.deviation_of(ahead.states.navigation)[0]
        off = np.append(off, ahead.states.walks[0] - now.walks[0])
        moved = off + ahead.deviation(lanes.deviation[:, :n])
        deviation = np.concatenate([moved, lanes.deviation[:, n:] * kept], axis=1)
        by_jump = lanes.jumps.moved
        by_jump = np.concatenate([ahead.deviation(by_jump[:, :n]), by_jump[:, n:] * kept], axis=1)
        return lanes._replace(
            deviation=deviation,
            covariance=covariance,
            misfit=lanes.misfit * np.exp(-span_s / MISFIT_S),
            jumps=lanes.jumps._replace(moved=by_jump).with_next(keyframe.time_s),
        )

    def _updated(self, lanes: Lanes, measured: Sequence[SensorRows], time_s: float) -> Lanes:
        suspect = [self._number(rows.sensor) for rows in measured]
        counts = [len(rows.error) for rows in measured]
        of_row = np.repeat(suspect, counts)
        H, share = self._rows(measured)
        weight = np.concatenate([rows.weight for rows in measured])
        noise = (1.0 - share) / np.clip(weight, LEAST_WEIGHT, 1.0)
        innovation = -np.concatenate([rows.error for rows in measured]) - lanes.deviation @ H.T
        lanes = self._with_ratios(lanes, measured, suspect, innovation[MEASURE], H, time_s)
        counts_in = (of_row != self.suspect[:, None]) | (of_row < 0)
        H_all, H = H, H * counts_in[..., None]
        innovation = innovation * counts_in
        P = lanes.covariance
        PHt = P @ H.mT
        S = H @ PHt
        rows = np.arange(len(of_row))
        S[:, rows, rows] += noise
        solved = np.linalg.solve(S, np.concatenate([PHt.mT, innovation[..., None]], axis=2))
        deviation = lanes.deviation + (PHt @ solved[..., -1:])[..., 0]
        P = P - PHt @ solved[..., :-1]
        surplus = np.sum(innovation * solved[..., -1] - counts_in, axis=1)
        is_fix = self._is_fix[of_row]
        of_measure = np.linalg.inv(S[MEASURE]), solved[MEASURE, :, -1], solved[MEASURE, :, :-1].T
        return lanes._replace(
            deviation=deviation,
            covariance=0.5 * (P + P.mT),
            n_out=lanes.n_out + np.sum(~counts_in, axis=1),
            n_fixes=lanes.n_fixes + np.sum(counts_in & is_fix, axis=1),
            evidence=lanes.evidence + surplus[MEASURE] - surplus,
            misfit=np.maximum(lanes.misfit + surplus, 0.0),
            jumps=lanes.jumps.updated(H_all, *of_measure),
        )

    def _number(self, sensor: str) -> int:
        name = SUSPECT_OF.get(sensor)
        return -1 if name is None else self.suspects.index(name)

    def _rows(self, measured: Sequence[SensorRows]) -> tuple[Array, Array]:
        """Return Jacobians (m, n) with those of what lasts, and the share (m,) that may."""
        blocks, shares = [], []
        for rows in measured:
            H, share = np.zeros((len(rows.error), self._n + len(self._share))), 0.0
            H[:, : self._n] = rows.jacobian
            if rows.sensor in self._lasting:
                begin = self._lasting[rows.sensor].start
                H[np.arange(len(H)), begin + rows.component] = 1.0
                share = float(self._share[begin - self._n])
            blocks.append(H)
            shares.append(np.full(len(H), share))
        return np.concatenate(blocks), np.concatenate(shares)

    def _with_ratios(
        self,
        lanes: Lanes,
        measured: Sequence[SensorRows],
        suspect: Sequence[int],
        innovation: Array,
        jacobian: Array,
        time_s: float,
    ) -> Lanes:
        """Return the lanes with what is remembered of each sensor; ``innovation`` (m,)."""
        last_s, ratio, begin = lanes.last_s.copy(), lanes.ratio.copy(), 0
        spread = np.sum((jacobian @ lanes.covariance[MEASURE]) * jacobian, axis=1)
        sigmas = np.sqrt(1.0 + spread)
        for rows, s in zip(measured, suspect, strict=True):
            end = begin + len(rows.error)
            own, sigma, at, begin = innovation[begin:end], sigmas[begin:end], rows.component, end
            if s < 0:
                continue
            before = ratio[s, at]
            before[np.isnan(before)] = 0.0
            share = -np.expm1(-min(time_s - float(last_s[s]), MEMORY_S) / MEMORY_S)
            ratio[s, at] = before + share * (own / sigma - before)
            last_s[s] = time_s
        return lanes._replace(last_s=last_s, ratio=ratio)

    def let_go(self, lanes: Lanes, suspect: int, others: Sequence[int], time_s: float) -> Lanes:
        """Return the lanes without that which was led on for a suspect.

        All lanes of ``others``, which had followed what it did, begin anew.
        """
        which = np.isin(self.suspect, others)
        lanes = self._begun(lanes, which, time_s - self._stagger_s)
        begun_s = lanes.begun_s.copy()
        begun_s[self.held[[suspect, *others]]] = np.inf
        return lanes._replace(begun_s=begun_s)

    def _begun_anew(self, lanes: Lanes, time_s: float) -> Lanes:
        """Return the lanes with those begun anew whose time is over."""
        is_over = time_s - lanes.begun_s > self.length_s
        return self._begun(lanes, is_over, time_s) if is_over.any() else lanes

    def _begun(self, lanes: Lanes, which: NDArray[np.bool_], begun_s: Array | float) -> Lanes:
        """Return the lanes with some (L,) begun with what the measure says."""
        deviation, covariance = lanes.deviation.copy(), lanes.covariance.copy()
        deviation[which], covariance[which] = deviation[MEASURE], covariance[MEASURE]
        forget, own = np.flatnonzero(which & self._forgets), np.arange(*GYRO_BIAS.indices(self._n))
        covariance[np.ix_(forget, own, own)] += JUMP**2 * np.eye(len(own))
        counts: dict[str, Any] = {
            name: np.where(which, 0.0, getattr(lanes, name)) for name in _COUNTS
        }
        counts["n_out"][forget] = 1.0
        return lanes._replace(
            deviation=deviation,
            covariance=covariance,
            begun_s=np.where(which, begun_s, lanes.begun_s),
            is_nested=np.where(which, 1.0, lanes.is_nested),
            **counts,
        )


_COUNTS: Final = ("n_out", "n_fixes", "evidence", "misfit")
