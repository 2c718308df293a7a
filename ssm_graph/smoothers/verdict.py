"""Whether a settled answer may be believed, and how noisy beams and inertial data really are.

*Beams.* A beam whose row has the leverage ``h = weight H P H' / sigma^2`` misses the answer by
``sigma^2 (1 - h)`` in the square. The sigma of each beam is the fixed point of the mean square of
``error / sqrt(1 - h)`` up to three times itself, divided by what a Gaussian has there; speeds that
the kernel has rejected do not count. With the right sigma it is consistent. With a wrong one ``h``
is a little wrong as well; :attr:`SmootherConfig.adapt_noise` repeats solution and estimate until
they agree.

*Inertial data.* Their chi-square with the degrees of freedom that the states leave them, see
:func:`ssm_graph.graph.inertial_rows.inertial_fit`.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from factors.similarity import WEIGHT_FLOOR, Kernel
from ssm_graph.base import chi2
from ssm_graph.base.frozen import Array
from ssm_graph.engine.error_state import STATE_DIM
from ssm_graph.engine.extras import Extras
from ssm_graph.engine.marginal_prior import MarginalPrior
from ssm_graph.engine.states import States
from ssm_graph.graph.beam_rows import BeamRows
from ssm_graph.graph.freed import FAULTS
from ssm_graph.graph.inertial_rows import InertialFit
from ssm_graph.graph.linearize import GraphLinearizer, Misfit
from ssm_graph.mission.answer import MISFIT, doubts_of_beams
from ssm_graph.mission.calibration import CURRENTS
from ssm_graph.mission.estimate import OUTLIER_WEIGHT, NoiseFound
from ssm_graph.mission.problem import Beams, Problem

PRIOR_TAIL = 1e-9
"""Probability below which the initial state is contradicted by the data."""


def contradictions(
    linearizer: GraphLinearizer, states: States, beam_rows: BeamRows, weights: Array
) -> list[str]:
    """Compare beams, start, inertial data and calibrations with the answer.

    Returns a sentence for each that disagrees.
    """
    doubts = [
        *doubts_of_beams(linearizer.problem, states.v_n, beam_rows.error, weights),
        _doubt_prior(linearizer.prior, states),
        _doubt_inertial(linearizer.inertial_misfit(states)),
        *_doubt_extras(linearizer.problem.extras, states),
    ]
    return [doubt for doubt in doubts if doubt]


def _doubt_prior(prior: MarginalPrior, states: States) -> str:
    whitened = prior.whitened(states)
    for name, part in (
        ("position or attitude", whitened[:6]),
        ("velocity", whitened[6:9]),
        ("bias", whitened[9:STATE_DIM]),
    ):
        chi_sq = float(part @ part)
        if chi2.sf(chi_sq, len(part)) < PRIOR_TAIL:
            return (
                f"the initial {name} is contradicted by the data (chi-square {chi_sq:.0f} for "
                f"{len(part)} degrees of freedom, largest {np.max(np.abs(part)):.0f} "
                "sigma): check the start, above all its heading, or drop [initial] to align"
            )
    return ""


def _doubt_inertial(misfit: Misfit) -> str:
    mean_sq = misfit.sum_sq / max(misfit.n_rows, 1)
    if mean_sq <= MISFIT:
        return ""
    return (
        f"inertial data miss the answer by {np.sqrt(mean_sq):.1f} of their own sigmas (rms over "
        f"{misfit.n_factors} factors): look at the noise of [imu], its units, axes and time stamps"
    )


def _doubt_extras(extras: Extras, states: States) -> list[str]:
    """Look for what lies further off than its prior can mean: calibrations, then the current."""
    calibrations, currents = [], []
    for block in extras.without({FAULTS}).blocks:
        is_current = block.name in CURRENTS
        walks = states.walks if is_current else states.walks[:1]
        value = extras.value(block.name, walks, states.constants, default=np.zeros(0))
        whitened = np.atleast_2d(value / block.sigma)
        chi_sq = np.sum(whitened**2, axis=-1)
        worst = int(np.argmax(chi_sq))
        if chi2.sf(float(chi_sq[worst]), len(block.sigma)) >= PRIOR_TAIL:
            continue
        if is_current:
            speed = np.linalg.norm(np.atleast_2d(value)[worst])
            currents.append(
                f"a current of {speed:.2f} m/s ({' and '.join(block.labels)}) with a sigma of "
                f"{block.sigma[0]:g} m/s each: state a larger one in [current]; or are pings off "
                "the ground marked as water_track"
            )
        else:
            calibrations.append(
                f"the calibration of {block.name} lies {np.max(np.abs(whitened)):.0f} of its prior "
                "sigmas off: state it nearer, or a larger sigma; or another instrument is wrong"
            )
    return calibrations + currents


FEWEST = 30.0
"""Degrees of freedom below which nothing is said."""
REACH = 3.0
"""Sigmas up to which errors count for the sigma."""
WITHIN_REACH = 0.9733369246625415
"""Mean square of a standard Gaussian within the reach."""
MEDIAN_SQUARE = 0.45493642311957283
"""Of a standard Gaussian."""
LARGEST_LEVERAGE = 0.95
ROUNDS = 50
SIGNIFICANT = 5.0
"""Standard deviations of the estimate by which it must differ from what is stated to be said."""
NOTABLE_BEAM = 1.25
"""And factor: an instrument's sigma is hardly known better."""
NOTABLE_INERTIAL = 2.0
"""And factor of the inertial chi-square; robust weights and wrong beam sigmas make some tens of
per cent."""
ADAPTED = 0.02
"""Adaptation ends when all sigmas agree with the estimate by this share."""
MAX_ADAPTATIONS = 8
BEND = 1e-4
"""Share of ``t`` over which the slope of a weight is taken."""
FEWEST_TO_JUDGE = 100
"""Components below which nothing is said of the efficiency of a kernel."""
LEAST_EFFICIENCY = 0.5
LARGEST_CHANGE = 3.0
"""Factor by which one adaptation changes a sigma at most."""


def beam_noise(
    beams: Beams, *, error: Array, variance: Array, weights: Array
) -> tuple[Array, Array]:
    """Return estimated over stated sigma of each beam, and degrees of freedom, both (B,).

    Parameters
    ----------
    beams : the rows, M of them, with the stated sigmas.
    error : (M,) what the answer misses, m/s.
    variance : (M,) of the answer along the beams, ``H P H'``.
    weights : (M,)
    """
    factor, dof = np.full(beams.n_beams, np.nan), np.zeros(beams.n_beams)
    share = 1.0 - np.clip(weights * variance / beams.sigma**2, 0.0, LARGEST_LEVERAGE)
    square = (error / beams.sigma) ** 2 / share
    for beam in range(beams.n_beams):
        counts = (beams.beam == beam) & (weights >= OUTLIER_WEIGHT)
        dof[beam] = share[counts].sum()
        if dof[beam] >= FEWEST:
            factor[beam] = np.sqrt(_scale_sq(square[counts]))
    return factor, dof


def _scale_sq(square: Array) -> float:
    """Return the variance of a Gaussian from squares, of which some large ones are none of it."""
    scale_sq = float(np.median(square)) / MEDIAN_SQUARE
    for _ in range(ROUNDS):
        last = scale_sq
        inside = square[square <= REACH**2 * scale_sq]
        scale_sq = float(np.mean(inside)) / WITHIN_REACH
        if abs(scale_sq - last) < 1e-6 * last:
            break
    return scale_sq


def efficiency(t: Array, weights: Array, kernel: Kernel, *, dim: int = 1) -> float:
    """Return by how much more measurements say than the sum of their weights makes of them.

    A kernel's answer has the covariance ``A^-1 B A^-1`` with ``A`` the mean slope of the influence
    ``weight error`` and ``B`` its mean square [1]_; the inverse sum of the weights is another one.
    Under normal noise the log kernel knows 0.91 of what its weights claim, under that of a
    Workhorse, Student's with 4.3 degrees of freedom, 1.25. Errors smaller than stated say nothing:
    they are counted as if they were as large.

    Parameters
    ----------
    t : (M,) squared Mahalanobis lengths.
    weights : (M,) those at the floor do not count.
    kernel : that made these of those.
    dim : of the measurements.

    References
    ----------
    .. [1] P. J. Huber, E. M. Ronchetti, "Robust Statistics", 2nd ed., Wiley, 2009, section 6.3.
    """
    t = t[weights > WEIGHT_FLOOR]
    if len(t) * dim < FEWEST_TO_JUDGE:
        return 1.0
    t = t * max(dim / float(np.mean(t)), 1.0)
    w = kernel.weight(t, dim=dim)
    bend = (kernel.weight(t * (1.0 + BEND), dim=dim) - w) / BEND
    slope = float(np.mean(w + 2.0 * bend / dim))
    square = float(np.mean(w**2 * t)) / dim * float(np.mean(w))
    return float(np.clip(slope * abs(slope) / square, LEAST_EFFICIENCY, 1.0 / LEAST_EFFICIENCY))


def noise_found(
    problem: Problem,
    *,
    error: Array,
    variance: Array,
    weights: Array,
    inertial: InertialFit,
    used: Array,
) -> NoiseFound:
    """Return what an answer says of the noise.

    Parameters
    ----------
    problem : with the sigmas that the answer was made with.
    error, variance, weights : as in :func:`beam_noise`.
    inertial : the fit of the inertial data.
    used : (B,) those sigmas over the stated ones.
    """
    factor, dof = beam_noise(problem.beams, error=error, variance=variance, weights=weights)
    return NoiseFound(
        beam_factor=factor * used,
        beam_dof=dof,
        beam_used=used,
        inertial_chi_sq=float(np.sum(inertial.chi_sq)),
        inertial_dof=float(np.sum(inertial.dof)),
    )


def adaptation(found: NoiseFound) -> Array | None:
    """Return by what (B,) to multiply the sigmas that were used, None if they are right."""
    change = np.where(np.isfinite(found.beam_factor), found.beam_factor / found.beam_used, 1.0)
    if np.all(np.abs(np.log(change)) < ADAPTED):
        return None
    return np.clip(change, 1.0 / LARGEST_CHANGE, LARGEST_CHANGE)


def with_sigmas(problem: Problem, change: Array) -> Problem:
    """Return the problem with the sigma of each beam multiplied by ``change`` (B,)."""
    beams = problem.beams
    return replace(problem, beams=replace(beams, sigma=beams.sigma * change[beams.beam]))


def noise_notes(found: NoiseFound) -> tuple[str, ...]:
    """Say where the noise is not as stated, and what sigmas were used instead."""
    notes = (_note_of_beams(found), _note_of_inertial(found))
    return tuple(note for note in notes if note)


def _note_of_beams(found: NoiseFound) -> str:
    if np.any(found.beam_used != 1.0):
        used = ", ".join(f"{factor:.2f}" for factor in found.beam_used)
        beams = f"beams 1 to {len(found.beam_used)}"
        return f"sigmas of {beams} were adapted to their errors: {used} times as stated"
    # The logarithm of a sigma estimated with n degrees of freedom has the deviation 1 / sqrt(2 n).
    off = np.abs(np.log(found.beam_factor))
    is_significant = off * np.sqrt(2.0 * found.beam_dof) > SIGNIFICANT
    notable = np.flatnonzero(is_significant & (off > np.log(NOTABLE_BEAM)))
    if len(notable) == 0:
        return ""
    asked = ", ".join(f"{found.beam_factor[beam]:.2f} of beam {beam + 1}" for beam in notable)
    return (
        f"the errors of the beams are not as stated: they ask for sigmas of {asked} times as much "
        f"({found.beam_dof[notable].min():.0f} degrees of freedom or more); correct the noise of "
        "[dvl], or adapt it"
    )


def _note_of_inertial(found: NoiseFound) -> str:
    chi_sq, dof = found.inertial_chi_sq, found.inertial_dof
    if dof < FEWEST:
        return ""
    ratio = chi_sq / dof
    is_significant = abs(chi_sq - dof) > SIGNIFICANT * np.sqrt(2.0 * dof)
    if not (is_significant and abs(np.log(ratio)) > np.log(NOTABLE_INERTIAL)):
        return ""
    said, wrong = ("more", "small") if ratio > 1.0 else ("less", "large")
    return (
        f"the inertial data err {said} than their noise says (chi-square {chi_sq:.0f} with "
        f"{dof:.0f} degrees of freedom): the densities of [imu] are too {wrong}, by a factor of "
        f"{np.sqrt(max(ratio, 1.0 / ratio)):.1f} or so"
    )
