"""Further aids as factors of GTSAM's, each measurement one factor with its weight.

Position fixes and standstills are GTSAM's own; ranges and headings are factors in Python.
"""

from __future__ import annotations

from collections.abc import Iterator

import gtsam
import numpy as np
from gtsam.symbol_shorthand import V, X

from factors.beacon_range import beacon_range_factor
from factors.compass_heading import heading_factor
from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.errors import ConfigError
from ssm_graph.base.frozen import Array
from ssm_graph.engine.states import States
from ssm_graph.graph.aids.gnss import Fixes
from ssm_graph.graph.aids.heading import Headings
from ssm_graph.graph.aids.ranges import Ranges
from ssm_graph.graph.aids.standstill import Standstills
from ssm_graph.mission.problem import Problem


def aid_graph(
    problem: Problem, states: States, weights: Array | None = None
) -> gtsam.NonlinearFactorGraph:
    """Return the further aids of a problem that estimates nothing of theirs.

    Parameters
    ----------
    problem : with any of them, or none.
    states : of all keyframes; they say where north is for the compass.
    weights : (M,) of the measurements: USBL, ranges, headings, standstills; all one when left out.
    """
    kinds = problem.aids
    sizes = [len(aid) for aid in kinds]
    weights = np.ones(sum(sizes)) if weights is None else weights
    graph = gtsam.NonlinearFactorGraph()
    for aid, size, end in zip(kinds, sizes, np.cumsum(sizes).tolist(), strict=True):
        own = weights[end - size : end]
        match aid:
            case Fixes():
                factors = _fixes(aid, own)
            case Ranges():
                factors = _ranges(aid, own)
            case Headings():
                factors = _headings(aid, own, states, problem.frame)
            case Standstills():
                factors = _standstills(aid, own)
            case _:
                raise ConfigError(
                    f"GTSAM's graph: expected aids it has factors for, got {aid.name}"
                )
        for factor in factors:
            graph.add(factor)
    return graph


def _fixes(fixes: Fixes, weights: Array) -> Iterator[gtsam.NonlinearFactor]:
    for i, k in enumerate(fixes.keyframe.tolist()):
        noise = gtsam.noiseModel.Gaussian.Covariance(fixes.covariance_n[i] / weights[i])
        yield gtsam.GPSFactorArm(X(k), fixes.position_n[i], fixes.lever_arm_b, noise)


def _ranges(ranges: Ranges, weights: Array) -> Iterator[gtsam.NonlinearFactor]:
    for i, k in enumerate(ranges.keyframe.tolist()):
        yield beacon_range_factor(
            X(k),
            sigma=float(ranges.sigma[i]),
            weight=float(weights[i]),
            range_m=float(ranges.range_m[i]),
            lever_arm_b=ranges.lever_arm_b,
            beacon_n=ranges.beacon_n[ranges.beacon[i]],
        )


def _headings(
    headings: Headings, weights: Array, states: States, frame: LocalFrame
) -> Iterator[gtsam.NonlinearFactor]:
    R_nl = frame.R_nl_at(states.p_n[headings.keyframe])
    for i, k in enumerate(headings.keyframe.tolist()):
        yield heading_factor(
            X(k),
            sigma=headings.sigma,
            weight=float(weights[i]),
            heading=float(headings.heading[i]),
            east_n=R_nl[i, :, 0],
            north_n=R_nl[i, :, 1],
            R_back=headings.R_back[i],
        )


def _standstills(standstills: Standstills, weights: Array) -> Iterator[gtsam.NonlinearFactor]:
    for k, sigma in zip(
        standstills.keyframe.tolist(), standstills.sigma / np.sqrt(weights), strict=True
    ):
        noise = gtsam.noiseModel.Isotropic.Sigma(3, float(sigma))
        yield gtsam.PriorFactorVector(V(k), np.zeros(3), noise)
