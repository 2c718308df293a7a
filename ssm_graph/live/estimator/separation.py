"""What the lanes say of the answer: which sensors contradict it, and how far it may be off.

A lane contradicts where its velocity or its position (that which forgot the bias of the gyros: or
that) parts from that of the lane with all sensors by more than noise would at the stated rate of
false alerts. A step shows only while a lane is there that began before it; so a contradiction is
remembered, and the lane that found it first is led on without its sensor, until that lane, by what
is independent of the sensor, can say that the answer is right. What parts by less is a suspicion:
it lasts until that lane agrees, whatever it can tell. One that has not become certain within a
minute is said no more: until it ends the sigmas cover what it would mean.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from ssm_graph.base import chi2
from ssm_graph.base.errors import ConfigError
from ssm_graph.base.frozen import Array
from ssm_graph.base.usual import FALSE_ALERTS_PER_H, MISSED_DETECTION
from ssm_graph.engine.error_state import GYRO_BIAS, POSITION, VELOCITY
from ssm_graph.graph.aids.gnss import Fixes
from ssm_graph.live.estimator.lanes import (
    DEPTH,
    DVL,
    FIXES,
    INERTIAL,
    LENGTHS_S,
    MEASURE,
    LaneBank,
    Lanes,
)

PARTS: Final = (VELOCITY, POSITION, GYRO_BIAS)
OF_ALL: Final = 2
"""Parts in which every lane is compared; the others are for those that forget the gyros' bias."""
SAID: Final = (
    ("velocity", "m/s", 1.0),
    ("position", "m", 1.0),
    ("gyro bias", "deg/s", 180.0 / np.pi),
)
"""Name, unit and factor to it"""
STATED: Final = {
    DVL: "[dvl] drift_sigma_m_per_s",
    Fixes.name: "[gnss] drift_sigma_m",
    DEPTH: "[depth] drift_sigma_m",
}
"""What says that the errors of a suspect last, as those of a depth in waves do."""
TEST_S: Final = 10.0
"""What lanes say changes so slowly, and those of one sensor say so much the same, that of the tests
of each lane one in so long counts as another one. Of noise as stated, 4 h at navigation and at
tactical grade, tests went above a level 3000 to 9000 times as often in an hour as one test would;
this counts 10000."""
BIAS_TEST_S: Final = 40.0
"""The same for a bias of the gyros, which other sensors tell so much more slowly: in 22 minutes
without a fault at both grades the tests of four lanes went as high as those of 120 do."""
UNASKED: Final = 0.01
"""Share of the measure's covariance added to that of a separation: what moves the answer by less
than a tenth of its own sigma is not asked for."""
AGREED_S: Final = 8.0
"""A contradiction or suspicion ends once the lane that is led on has agreed for so long."""
COVERED_S: Final = LENGTHS_S[1]
"""A suspicion so old is covered by sigmas: what goes on has parted lanes for certain by then, and
no lane begun since tells one that noise has made from one that stays small. The bias of a gyro
falsely suspected at tactical grade takes a lane minutes to find again."""
AT_EASE: Final = 0.05
"""It agrees where noise alone would part it by more in so many cases."""
DOUBTED_S: Final = 30.0
"""So long after an answer was begun anew a lane from before contradicts at `DOUBTFUL`."""
DOUBTFUL: Final = 1e-3
"""Probability of a false alert of such a lane: something is wrong for certain."""
CONFIRMED: Final = 1.0 / 3.0
"""Share of its way at a false velocity by which the measure, held by fixes, parts from a lane."""
CONFIRMED_S: Final = 40.0
"""So long a lane without fixes has to go to confirm the DVL."""
FITS: Final = 0.75
"""Misfit of the measure, in thresholds, below which it fits all that is measured."""
WEIGHED_S: Final = 5.0
"""Evidence and size are taken while a contradiction is so young."""
TOGETHER_S: Final = 10.0
"""Contradictions that begin within so much compete for the blame."""
RIVAL: Final = 0.5
"""A sensor that explains so much of what the likeliest one explains is named beside it."""
NEAR: Final = 25.0
"""And so is one whose chi-square is within so much."""
HORIZONTAL: Final = np.array([1.0, 0.0])
VERTICAL: Final = np.array([0.0, 1.0])
"""Of the two protection levels"""


@dataclass(frozen=True, slots=True)
class IntegrityConfig:
    """How often lanes may be wrong, and what the user asks for."""

    false_alerts_per_h: float = FALSE_ALERTS_PER_H
    """Of all lanes together, while every sensor is as it is stated."""
    suspicions_per_h: float = 0.5
    """False ones, of all lanes together: each costs GOOD for a minute or so; none is remembered."""
    missed_detection: float = MISSED_DETECTION
    """Probability that a fault moves the answer out of its protection level unseen."""
    protection_m: float = np.inf
    """A health of GOOD asks for a horizontal protection level below this, m."""
    protection_up_m: float = np.inf
    """And for a vertical one below this, m."""

    def __post_init__(self) -> None:
        for name, high in (
            ("false_alerts_per_h", np.inf),
            ("suspicions_per_h", np.inf),
            ("missed_detection", 0.5),
        ):
            value = getattr(self, name)
            if not 0.0 < value < high:
                raise ConfigError(f"{name}: expected a number in (0, {high}), got {value}")
        for name in ("protection_m", "protection_up_m"):
            if not getattr(self, name) > 0.0:
                raise ConfigError(f"{name}: expected metres above 0, got {getattr(self, name)}")


class Contradiction(NamedTuple):
    """A sensor without which a lane says something else than the answer."""

    suspect: int
    since_s: float
    last_s: float
    """When a lane last said so, s"""
    part: int
    """0 in velocity, 1 in position, 2 in the gyros' bias"""
    size: float
    """Largest while it began: later the answer is bent by what it followed; m/s, m or rad/s"""
    evidence: float
    """By how much less of chi-square was left without it while it began"""
    agreed_s: float
    """Since when the lane that is led on agrees, s; infinite where it does not"""
    is_certain: bool = True
    """Whether it is more than a suspicion"""


class Protection(NamedTuple):
    """Bounds of the position's error under every fault that is not excluded."""

    horizontal: float
    """m, radius"""
    up: float
    """m"""


class Separations(NamedTuple):
    """Of L lanes from the measure, in velocity, position and bias of the gyros."""

    test: Array
    """(L, 3) chi-square of 3 degrees of freedom; zero where a lane has left nothing out"""
    size: Array
    """(L, 3) m/s, m, rad/s"""
    sigma: Array
    """(L, 3) in the most uncertain direction"""


class Judge:
    """Thresholds of a bank of lanes, and what is made of them."""

    def __init__(self, bank: LaneBank, config: IntegrityConfig) -> None:
        self._bank, self.config = bank, config
        self._is_inertial = bank.suspect == bank.suspects.index(INERTIAL)
        n_tests = np.array(
            [
                *[3600.0 / TEST_S * OF_ALL * (len(bank.suspect) - 1)] * OF_ALL,
                3600.0 / BIAS_TEST_S * (self._is_inertial.sum() - 1),
            ]
        )
        self.thresholds, self.suspicions = (
            np.array([chi2.isf(min(0.5 * rate / n, AT_EASE), 3) for n in n_tests])
            for rate in (config.false_alerts_per_h, config.suspicions_per_h)
        )
        """(3,) of the chi-square of a separation, by part; half the rate is for the gyros' bias"""
        self.threshold = float(self.thresholds[0])
        self._at_ease, self._doubtful = (float(chi2.isf(p, 3)) for p in (AT_EASE, DOUBTFUL))
        self._radius = float(np.sqrt(chi2.isf(config.missed_detection, 2)))
        self._side = float(-ndtri(0.5 * config.missed_detection))

    @property
    def detectable(self) -> float:
        """Sigmas of a separation by which a fault has to move it to be seen for certain."""
        return float(np.sqrt(self.threshold)) + self._side

    def separations(self, lanes: Lanes) -> Separations:
        """Return how far lanes are from the measure."""
        L = len(lanes.deviation)
        test, size, sigma = (np.zeros((L, len(PARTS))) for _ in range(3))
        sign = np.where(lanes.is_nested > 0.0, -1.0, 1.0)[:, None, None]
        for k, part in enumerate(PARTS):
            of_measure = lanes.covariance[MEASURE, part, part]
            D = lanes.covariance[:, part, part] + (sign + UNASKED) * of_measure
            D[MEASURE] = of_measure
            off = lanes.deviation[:, part] - lanes.deviation[MEASURE, part]
            test[:, k] = np.sum(off * np.linalg.solve(D, off[..., None])[..., 0], axis=1)
            size[:, k] = np.sqrt(np.sum(off * off, axis=1))
            sigma[:, k] = np.sqrt(np.linalg.eigvalsh(D)[:, -1])
        test[(lanes.n_out == 0.0) | ~np.isfinite(lanes.begun_s) | self.is_refuted(lanes)] = 0.0
        test[~self._is_inertial, OF_ALL:] = 0.0
        return Separations(test, size, sigma)

    def is_refuted(self, lanes: Lanes) -> NDArray[np.bool_]:
        """Return (L,) whether a lane is contradicted by its own sensors, which the measure fits.

        Such a lane accuses nobody: what is wrong is in what it began with, or in the inertial data.
        """
        fits = lanes.misfit[MEASURE] < FITS * self.threshold
        return np.asarray(fits & (lanes.misfit > self.threshold))

    def judged(
        self,
        lanes: Lanes,
        found: Separations,
        known: tuple[Contradiction, ...],
        time_s: float,
    ) -> tuple[Lanes, tuple[Contradiction, ...]]:
        """Return the contradictions after one more keyframe, and the lanes with those led on."""
        kept, over = {one.suspect: one for one in known}, set[int]()
        for suspect in range(len(self._bank.suspects)):
            if suspect in over:
                continue
            own = self._bank.lanes_of(suspect)
            test = found.test[own.start : own.stop]
            highest = np.argmax(test / self.thresholds)
            row, part = (int(i) for i in np.unravel_index(highest, test.shape))
            lane, held, was = own.start + row, int(self._bank.held[suspect]), kept.get(suspect)
            limit = self._limit(lanes, suspect, lane, time_s)
            is_certain = bool(test[row, part] > min(limit, self.thresholds[part]))
            if is_certain or test[row, part] > self.suspicions[part]:
                if was is None:
                    lanes = lanes.with_copy(held, lane)
                if was is None or (is_certain and not was.is_certain):
                    was = Contradiction(suspect, time_s, time_s, part, 0.0, -np.inf, np.inf, False)
                largest = max(was.size, float(found.size[lane, was.part]))
                kept[suspect] = was._replace(
                    last_s=time_s,
                    size=largest if time_s - was.since_s <= WEIGHED_S else was.size,
                    agreed_s=np.inf,
                    is_certain=was.is_certain or is_certain,
                )
            elif was is not None:
                still = self._still(was, lanes, found, time_s)
                if still is None:
                    others = self._consequences(was, lanes, known)
                    over |= {suspect, *others}
                    kept = {s: one for s, one in kept.items() if s not in over}
                    lanes = self._bank.let_go(lanes, suspect, others, time_s)
                else:
                    kept[suspect] = still
        return lanes, tuple(self._weighed(one, lanes, time_s) for one in kept.values())

    def _consequences(
        self, was: Contradiction, lanes: Lanes, known: tuple[Contradiction, ...]
    ) -> list[int]:
        """Return the suspects whose contradiction ends with that of another one.

        They began after it and were not blamed. The lanes of the inertial data had followed the
        DVL, and that a lane without DVL agrees speaks for these data as well. One whose lane is
        refuted was blamed by mistake: that ends no other.
        """
        names, blamed = self._bank.suspects, {one.suspect for one in self.blamed(known)}
        if was.suspect not in blamed or self.is_refuted(lanes)[self._bank.held[was.suspect]]:
            return []
        spared = {names.index(INERTIAL)} if names[was.suspect] == DVL else set()
        later = [one.suspect for one in known if one.since_s > was.since_s]
        return [suspect for suspect in later if suspect not in blamed - spared]

    def _limit(self, lanes: Lanes, suspect: int, lane: int, time_s: float) -> float:
        """Return above which chi-square a lane contradicts an answer that was begun anew."""
        doubted_s = float(lanes.doubted_s[suspect])
        is_doubted = time_s - doubted_s < DOUBTED_S and lanes.begun_s[lane] < doubted_s
        return self._doubtful if is_doubted else np.inf

    def _weighed(self, one: Contradiction, lanes: Lanes, time_s: float) -> Contradiction:
        """Return a contradiction with the evidence of its first seconds."""
        if time_s - one.since_s > WEIGHED_S:
            return one
        return one._replace(evidence=max(one.evidence, self._evidence(lanes, one.suspect)))

    def _still(
        self, was: Contradiction, lanes: Lanes, found: Separations, time_s: float
    ) -> Contradiction | None:
        """Return a contradiction while nothing can rule it out; None once something has."""
        own = int(self._bank.held[was.suspect]), was.part
        if self.is_refuted(lanes)[own[0]]:
            return None
        is_out = bool(found.test[own[0]].max() < self._at_ease)
        if was.is_certain:
            is_out &= bool(found.size[own] + self._side * found.sigma[own] <= was.size)
            if self._bank.suspects[was.suspect] == DVL and was.part == 0:
                is_out |= self._is_confirmed(was, lanes, found, time_s)
        agreed_s = min(was.agreed_s, time_s) if is_out else np.inf
        return None if time_s - agreed_s > AGREED_S else was._replace(agreed_s=agreed_s)

    def _is_confirmed(
        self, was: Contradiction, lanes: Lanes, found: Separations, time_s: float
    ) -> bool:
        """Return whether fixes have shown since that the DVL leads to where the vehicle is.

        A lane without fixes, begun since, would be off by the velocity that was found times its
        age, and what has all sensors by a good part of that.
        """
        for suspect, name in enumerate(self._bank.suspects):
            if name not in FIXES:
                continue
            own = self._bank.lanes_of(suspect)
            if found.test[own.start : own.stop].max() > self.threshold:
                return False
            for lane in own[:-1]:
                age_s = time_s - lanes.begun_s[lane]
                is_since = lanes.begun_s[lane] > was.last_s and lanes.n_out[lane] > 0.0
                seen = self.detectable * found.sigma[lane, 1] <= CONFIRMED * was.size * age_s
                if is_since and age_s > CONFIRMED_S and seen:
                    return True
        return False

    def _evidence(self, lanes: Lanes, suspect: int) -> float:
        """Return what speaks for a suspect, by its oldest lane: those of all began together."""
        own = self._bank.lanes_of(suspect)[:-1]
        return float(lanes.evidence[own[int(np.argmin(lanes.begun_s[own.start : own.stop]))]])

    def blamed(self, known: tuple[Contradiction, ...]) -> list[Contradiction]:
        """Return those without which what the others say fits, the clearest first.

        What contradicts long after the first one does so since the answer has followed that; what
        is certain counts before what is suspected.
        """
        known = tuple(one for one in known if one.is_certain) or known
        first_s = min((one.since_s for one in known), default=0.0)
        rest = [one for one in known if one.since_s - first_s < TOGETHER_S]
        order = sorted(rest, key=lambda one: -one.evidence)
        best = order[0].evidence if order else 0.0
        least = min(RIVAL * best, best - NEAR)
        return [one for one in order if one.evidence >= least]

    def undecided(self, known: tuple[Contradiction, ...], time_s: float) -> list[Contradiction]:
        """Return the suspicions that are covered by sigmas."""
        return [one for one in known if not one.is_certain and time_s - one.since_s > COVERED_S]

    def sentence(self, lanes: Lanes, known: tuple[Contradiction, ...], time_s: float) -> str:
        """Say which sensors contradict the answer; an empty text where none does."""
        covered = self.undecided(known, time_s)
        blamed = self.blamed(tuple(one for one in known if one not in covered))
        if not blamed:
            return ""
        names, first = self._bank.suspects, blamed[0]
        said = [names[one.suspect] for one in blamed]
        has_fixes = lanes.n_fixes[self._bank.held[blamed[0].suspect]] > 0.0
        if DVL in said and INERTIAL not in said and not (has_fixes and len(known) == 1):
            said.append(INERTIAL)
        elif INERTIAL in said and DVL not in said and DVL in names and not has_fixes:
            said.append(DVL)  # without fixes it is all that biases of gyros are told by
        name, unit, factor = SAID[first.part]
        is_inertial = names[first.suspect] == INERTIAL
        without = "the gyro bias of before" if is_inertial else names[first.suspect]
        text = (
            f"{' or '.join(said)}: without {without} the {name} has been another by "
            f"{factor * first.size:.2g} {unit} since {first.since_s:.0f} s, "
        )
        if not first.is_certain:
            drift = STATED.get(without) if without in self._bank.undrifting else None
            hint = f"; if its errors last, have mission.toml say so: {drift}" if drift else ""
            return f"{text}which noise alone would hardly do{hint}"
        return text + "and nothing independent has shown since that the answer is right"

    def protection(
        self, lanes: Lanes, found: Separations, R_up: Array, *, time_s: float, fixed_s: float
    ) -> Protection:
        """Return the protection level of the window's answer.

        ``found`` are the separations of those that are not led on; ``R_up`` (3, 3) turns position
        in body axes to east, north, up; ``fixed_s`` is when the position was last known by itself,
        s: by a fix, or where all began. A lane that is led on began with what its sensor may have
        done until then without being seen.
        """
        off = np.abs(lanes.deviation[:, POSITION] @ R_up.T)
        P = R_up @ lanes.covariance[:, POSITION, POSITION] @ R_up.T
        east, north = P[:, 0, 0], P[:, 1, 1]
        level = np.sqrt(0.5 * (east + north) + np.hypot(0.5 * (east - north), P[:, 0, 1]))
        bound = np.empty((len(off), 2))
        bound[:, 0] = np.hypot(off[:, 0], off[:, 1]) + self._radius * level
        bound[:, 1] = off[:, 2] + self._side * np.sqrt(P[:, 2, 2])
        worst = bound[MEASURE].copy()
        for suspect, name in enumerate(self._bank.suspects):
            own, held = self._bank.lanes_of(suspect), int(self._bank.held[suspect])
            is_led_on = bool(np.isfinite(lanes.begun_s[held]))
            lane = own.start + np.flatnonzero(lanes.n_out[own.start : held] > 0.0)
            if len(lane) == 0:
                worst = np.maximum(worst, bound[held]) if is_led_on else worst
                continue
            age_s, since_s = time_s - lanes.begun_s[lane], time_s - fixed_s
            sigmas = self.detectable * found.sigma[lane, 0 if name == DVL else 1]
            step = float(sigmas.min())
            if name == DVL:
                begun_s = float(lanes.begun_s[held]) if is_led_on else fixed_s
                unseen = step * max(begun_s - fixed_s, 0.0) * HORIZONTAL
                grown = bound[MEASURE] + step * age_s[:, None]
                older = bound[MEASURE] + step * since_s * HORIZONTAL * (since_s > LENGTHS_S[-1])
            else:
                axis = VERTICAL if name == DEPTH else np.ones(2)
                # A slow pull shows to the longest lane last.
                unseen, older = float(sigmas.max()) * axis, bound[MEASURE] + step * axis
                grown = older
            if is_led_on:
                worst = np.maximum(worst, bound[held] + unseen)
            worst = np.maximum(worst, older)
            worst = np.maximum(worst, np.minimum(bound[lane], grown).max(axis=0))
        return Protection(*worst.tolist())


def pack_contradictions(known: tuple[Contradiction, ...], names: tuple[str, ...]) -> list[Any]:
    """Return contradictions as plain values, with the names of the sensors."""
    return [
        {**one._asdict(), "suspect": names[one.suspect], "agreed_s": str(one.agreed_s)}
        for one in known
    ]


def unpack_contradictions(
    packed: Sequence[Mapping[str, Any]], names: tuple[str, ...]
) -> tuple[Contradiction, ...]:
    """Return the contradictions that were packed."""
    return tuple(
        Contradiction(
            **{**one, "suspect": names.index(one["suspect"]), "agreed_s": float(one["agreed_s"])}
        )
        for one in packed
    )
