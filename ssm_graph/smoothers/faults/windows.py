"""Whether all data fit an answer as well as their noise says, in windows of a mission.

What the search finds is freed before; what is left is noise, or what no hypothesis describes. The
inertial data pay for all of it: whatever bends the answer bends it against them. Of beams and aids
successive residuals tell both apart: noise is new in each, what no hypothesis describes lasts.
Their means and trends tell nothing, for the answer follows these.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import bdtrc

from factors.similarity import WEIGHT_FLOOR, Kernel
from ssm_graph.base import chi2
from ssm_graph.base.frozen import Array
from ssm_graph.engine.states import States
from ssm_graph.graph.aids.depth import DepthMeans
from ssm_graph.graph.inertial_rows import InertialFit
from ssm_graph.graph.linearize import GraphLinearizer
from ssm_graph.mission.fault import DetectedFault, Treatment
from ssm_graph.mission.problem import Beams
from ssm_graph.smoothers.faults.columns import BESIDE_MEDIAN, beside_median
from ssm_graph.smoothers.faults.nuisances import DVL, SLOW_AID, SLOW_AIDS, SLOW_BEAM
from ssm_graph.smoothers.verdict import efficiency

WINDOW_S: Final = 60.0
USUAL: Final = 2.0
"""Chi-square by its degrees of freedom that errors of healthy instruments may come to: vibration
and quantisation make it up to 1.25, of MEMS units up to 1.6, over realistic missions (30 a grade,
seeds 100 to 129)."""
TAIL: Final = 1e-6
"""Probability of a stretch's chi-square where it is as large as is usual, and of a median."""
MOST: Final = 3
"""Stretches that are named."""
OTHERS: Final = "DVL or aids, whose lie the inertial data contradict"
CLIP: Final = 3.0
"""Sigmas that a residual counts for at most: single bad readings are nobody's lasting fault."""
SAFE: Final = 2.0
"""By the variance of what healthy instruments err in slowly."""
DEVIATIONS: Final = 6.0
"""Of the sum of products of successive residuals beyond that, and"""
LEAST: Final = 0.5
"""what their mean has to be beyond it, in the square of a reading's sigma."""
WHITE: Final = ("GNSS", "USBL", "range", "depth")
"""Aids whose errors are new in each reading, but for a part; iron and maps err alike for long."""
CONTRADICTING: Final = "what it is compared with"
GROUP: Final = 100
"""Successive readings whose median tells their noise,"""
FEWEST: Final = 30
"""the fewest that do, and that a stretch has which is said to last,"""
NOTABLE_SQUARE: Final = 2.0
"""and their variance by that stated, from which on they are noisier if that is no chance."""
GROSS_SQ: Final = 25.0
"""Square of the sigmas beyond which readings are gross errors if there are"""
GROSS_MORE: Final = 2.0
"""as many times more of them as noise makes that has the same median."""
SEEN_BY_THREE: Final = 3
"""Beams: any speeds of so many are those of some velocity."""
LEAST_SHARE: Final = 1e-3
"""What a measurement says is never less than this share of its weight: sigmas 30 times as large."""


def noisier_than_stated(fit: InertialFit, keyframe_s: Array) -> list[DetectedFault]:
    """Return the stretches of whole windows in which inertial data err more than they may.

    Over most of a mission that is their noise. For a while it may be anything that they contradict.
    """
    since = keyframe_s[:-1] - keyframe_s[0]
    first = np.flatnonzero(np.diff(np.floor(since / WINDOW_S), prepend=-1.0))
    begin_s = np.append(keyframe_s[first], keyframe_s[-1])
    chi_sq, dof = (np.add.reduceat(x, first) for x in (fit.chi_sq, fit.dof))
    found = []
    for begin, end in _stretches(chi_sq, dof):
        total, expected = float(chi_sq[begin:end].sum()), max(float(dof[begin:end].sum()), 1.0)
        is_noise = 2 * (end - begin) > len(first)
        found.append(
            DetectedFault(
                sensor="IMU",
                what=f"errs {np.sqrt(total / expected):.1f} times as much as its noise says "
                f"(chi-square {total:.0f} with {expected:.0f} degrees of freedom)",
                begin_s=float(begin_s[begin]),
                end_s=float(begin_s[end]),
                chi_sq=total - expected,
                dof=round(expected),
                treatment=Treatment.SAID,
                rivals=() if is_noise else (OTHERS,),
                remedy="look at the densities of [imu], its units, axes and time stamps",
            )
        )
    return sorted(found, key=lambda fault: fault.begin_s)


def _stretches(chi_sq: Array, dof: Array) -> Iterator[tuple[int, int]]:
    """Yield stretches of windows (N,) beyond chance, the least likely first, none twice."""
    n = len(chi_sq)
    begin, end = np.triu_indices(n + 1, 1)
    sums = [np.concatenate([[0.0], np.cumsum(x)]) for x in (chi_sq, dof)]
    total, expected = (x[end] - x[begin] for x in sums)
    # Where other sensors leave no degree of freedom there is nothing to be said.
    likely = chi2.logsf(total / USUAL, np.maximum(expected, 1.0))
    for _ in range(MOST):
        least = int(np.argmin(likely))
        if likely[least] > np.log(TAIL):
            return
        yield int(begin[least]), int(end[least])
        likely = np.where((begin < end[least]) & (end > begin[least]), 0.0, likely)


class Readings(NamedTuple):
    """What an answer leaves of one beam, or of one component of an aid."""

    sensor: str
    time_s: Array
    """(n,)"""
    error: Array
    """(n,) in stated sigmas"""
    slow: float
    """Variance of what healthy ones err in slowly, in that of a reading"""


def readings_of(
    linearizer: GraphLinearizer,
    states: States,
    beam_error: Array,
    weights: Array,
    aid_weights: Array,
) -> Iterator[Readings]:
    """Yield what the states leave of all readings that count.

    ``beam_error`` (M,) is in m/s; the weights are (M,) of beams, and (A,).
    """
    problem, weighted = linearizer.problem, linearizer.weighted
    beams, time_s = problem.beams, problem.keyframe_s
    for beam in range(beams.n_beams):
        own = (beams.beam == beam) & (weights > WEIGHT_FLOOR)
        error = (beam_error / beams.sigma)[own]
        yield Readings(
            f"DVL beam {beam + 1}", time_s[beams.keyframe[own]], error, SLOW_BEAM[0] ** 2
        )
    for aid in weighted.all:
        if aid.name not in WHITE or len(aid) == 0:
            continue
        error = weighted.whitened(aid, states).error
        used = weighted.of(aid, aid_weights) > WEIGHT_FLOOR
        labels, slow = np.array(aid.labels), SLOW_AIDS.get(aid.name, SLOW_AID)[0] ** 2
        if isinstance(aid, DepthMeans):  # the slow part is no less in a mean
            slow *= aid.sigma**2 * float(np.median(aid.root_information)) ** 2
        for axis, of_axis in enumerate(labels.reshape(len(aid), aid.dim).T):
            for label in np.unique(of_axis):
                own = used & (of_axis == label)
                yield Readings(aid.name, time_s[aid.keyframe[own]], error[own, axis], slow)


def disagreeing(readings: Iterable[Readings], keyframe_s: Array) -> list[DetectedFault]:
    """Return the whole windows over which sensors disagree with an answer, time and again.

    Of each sensor one stretch, the surest; where all beams do so, one of the DVL, with the inertial
    data as the rival.
    """
    found: dict[str, DetectedFault] = {}
    names = set()
    for one in readings:
        names.add(one.sensor)
        if len(one.error) <= FEWEST:
            continue
        error, usual = np.clip(one.error, -CLIP, CLIP), SAFE * one.slow
        product = error[1:] * error[:-1] - usual
        begin_s = np.arange(keyframe_s[0], keyframe_s[-1], WINDOW_S)
        window = np.searchsorted(begin_s, one.time_s[1:], side="right") - 1
        total, count = (
            np.bincount(window, x, len(begin_s)) for x in (product, np.ones(len(window)))
        )
        begin, end = np.triu_indices(len(begin_s) + 1, 1)
        sums = [np.concatenate([[0.0], np.cumsum(x)]) for x in (total, count)]
        more, n = (x[end] - x[begin] for x in sums)
        sigmas = more / np.sqrt(np.maximum(n, 1.0)) / (1.0 + usual)
        sigmas[(more < LEAST * n) | (n < FEWEST)] = 0.0
        best = int(np.argmax(sigmas))
        if sigmas[best] <= DEVIATIONS:
            continue
        chi_sq, size = float(sigmas[best]) ** 2, np.sqrt(more[best] / n[best] + usual)
        ends_s = np.append(begin_s, keyframe_s[-1])
        if one.sensor not in found or chi_sq > found[one.sensor].chi_sq:
            found[one.sensor] = DetectedFault(
                sensor=one.sensor,
                what=f"disagrees with the answer by {size:.1f} of its sigmas for long",
                begin_s=float(ends_s[begin[best]]),
                end_s=float(ends_s[end[best]]),
                chi_sq=chi_sq,
                dof=1,
                treatment=Treatment.SAID,
                rivals=(CONTRADICTING,),
                remedy="look at its place, mounting and units, and at those of the others",
            )
    beams = {name for name in names if name.startswith(DVL)}
    if len(beams) > 1 and beams <= found.keys():
        return [_of_all([found.pop(name) for name in sorted(beams)]), *found.values()]
    return list(found.values())


def _of_all(beams: Sequence[DetectedFault]) -> DetectedFault:
    """Return the finding of all beams as one of the DVL, or of what all are compared with."""
    surest = max(beams, key=lambda one: one.chi_sq)
    return replace(
        surest,
        sensor=DVL,
        what=f"{surest.what}, all beams",
        begin_s=min(one.begin_s for one in beams),
        end_s=max(one.end_s for one in beams),
        rivals=("IMU",),
        remedy="look at noise, stamps and filters of [imu], and at mounting and units of [dvl]",
    )


def informative(
    sensor: str,
    t: Array,
    weights: Array,
    time_s: Array,
    kernel: Kernel,
    *,
    dim: int = 1,
    freed: NDArray[np.bool_] | None = None,
    beam: NDArray[np.intp] | None = None,
) -> tuple[Array, list[DetectedFault]]:
    """Return how much each measurement says (M,), by its weight, and who is noisy.

    What a lie leaves says nothing of the noise, and is judged apart: it counts for less, but larger
    sigmas would not mend it. Where the array as a whole is not noisy, one of its beams may be.

    Parameters
    ----------
    sensor : its name.
    t, weights, time_s : (M,) squared Mahalanobis lengths, what the kernel made of these, s.
    kernel : that of the weights.
    dim : of the measurements.
    freed : (M,) those that a lie was taken off; if off all of them, all count alike.
    beam : (M,) from 0, of a sensor that has any.
    """
    freed = np.zeros(len(t), np.bool_) if freed is None else freed & ~freed.all()
    most = np.full(len(t), np.inf)
    for own in (freed, ~freed):
        most[own] = most_by_noise(t[own], weights[own], time_s[own], dim=dim)
    found = [_noisy(sensor, t, np.where(freed, np.inf, most), time_s, dim=dim)]
    for one in () if beam is None or found[0] else np.unique(beam[~freed]).tolist():
        own = (beam == one) & ~freed
        counts = np.where(is_gross(t[own]), WEIGHT_FLOOR, weights[own])
        most[own] = np.minimum(most[own], most_by_noise(t[own], counts, time_s[own]))
        of_beam = np.where(own, most, np.inf)
        found.append(_noisy(f"{sensor} beam {one + 1}", t, of_beam, time_s, dim=dim))
    says = np.minimum(efficiency(t, weights, kernel, dim=dim), most)
    return says, [one for one in found if one is not None]


def noisy_or_compared(noisy: DetectedFault, beams: Beams, time_s: Array) -> DetectedFault:
    """Return the finding of a noisy DVL, or beam, or of what it is compared with, if beams agree.

    What no velocity makes of more than three beams is their noise alone, whatever the vehicle does.
    Only the beams of the finding's stretch are asked, by their times (M,), s.
    """
    own = beams.take((noisy.begin_s <= time_s) & (time_s <= noisy.end_s))
    parity = beside_median(parity_of(own)) / np.sqrt(BESIDE_MEDIAN)
    square = float(np.median(parity**2)) / float(chi2.isf(0.5, 1)) if len(parity) else np.inf
    if len(parity) < FEWEST or square > NOTABLE_SQUARE:
        return noisy
    return replace(
        noisy,
        sensor="IMU",
        what=f"misses beams of the DVL, which agree to {np.sqrt(square):.1f} of their sigmas",
        remedy="look at noise, stamps and filters of [imu]",
    )


def parity_of(beams: Beams) -> Array:
    """Return what no velocity makes of the speeds of whole pings (P, B - 3), in sigmas."""
    count = np.bincount(beams.ping)
    own = (count[beams.ping] == beams.n_beams) & (beams.n_beams > SEEN_BY_THREE)
    shape = -1, beams.n_beams
    if not own.any():
        return np.zeros(0)
    speed, sigma = beams.speed[own].reshape(shape), beams.sigma[own].reshape(shape)
    whitened = beams.beam_b[own].reshape(*shape, 3) / sigma[..., None]
    null = np.linalg.svd(whitened)[0][..., SEEN_BY_THREE:]
    return np.asarray(np.einsum("pbi,pb->pi", null, speed / sigma))


def _noisy(sensor: str, t: Array, most: Array, time_s: Array, *, dim: int) -> DetectedFault | None:
    own = np.isfinite(most)
    if not own.any():
        return None
    factor = float(np.sqrt(np.median(t[own]) / chi2.isf(0.5, dim)))
    return DetectedFault(
        sensor=sensor,
        what=f"errs {factor:.1f} times as much as stated, at random",
        begin_s=float(time_s[own].min()),
        end_s=float(time_s[own].max()),
        chi_sq=float(np.sum(t[own])),
        dof=int(own.sum()) * dim,
        treatment=Treatment.WIDENED,
        remedy="state larger sigmas",
    )


def most_by_noise(t: Array, weights: Array, time_s: Array, *, dim: int = 1) -> Array:
    """Return the share (M,) of its weight that each measurement says at most, for its noise.

    A weight lets go of what sticks out; where most readings do, it leaves them more than the
    inverse of their variance, which medians of successive ones tell. Infinite where they err no
    more than stated, or by a chance of :data:`TAIL`.

    Parameters
    ----------
    t : (M,) squared Mahalanobis lengths.
    weights : (M,) those at the floor do not count.
    time_s : (M,)
    dim : of the measurements.
    """
    counts = np.flatnonzero(weights > WEIGHT_FLOOR)
    most, counts = np.full(len(t), np.inf), counts[np.argsort(time_s[counts], kind="stable")]
    for own in np.array_split(counts, max(len(counts) // GROUP, 1)):
        if len(own) * dim < FEWEST:
            continue
        median = float(np.median(t[own]))
        scale_sq = median / float(chi2.isf(0.5, dim))
        # The median is as large where half of the readings are, each with the same probability.
        chance = bdtrc((len(own) - 1) // 2, len(own), chi2.sf(median, dim))
        if scale_sq > NOTABLE_SQUARE and chance < TAIL:
            most[own] = max(1.0 / (scale_sq * float(np.mean(weights[own]))), LEAST_SHARE)
    return most


def is_gross(t: Array) -> NDArray[np.bool_]:
    """Return which squared lengths (N,) are gross errors: more than noise makes of its median."""
    gross = t > GROSS_SQ
    scale_sq = float(np.median(t)) / float(chi2.isf(0.5, 1))
    by_noise = float(chi2.sf(GROSS_SQ / scale_sq, 1))
    return gross & (np.mean(gross) > GROSS_MORE * by_noise)
