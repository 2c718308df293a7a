"""A problem as a graph of GTSAM's own, for its optimisers and for factors that a user adds.

Inertial factors, GNSS and depth are GTSAM's; every beam is a factor of its own, in Python. What
solves missions here takes the same residuals in bulk, see :mod:`ssm_graph.graph.linearize`.
"""

from __future__ import annotations

from collections.abc import Iterator

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X

from factors.beacon_range import beacon_range_factor
from factors.compass_heading import heading_factor
from factors.dvl_beam import dvl_beam_factor
from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.errors import ConfigError
from ssm_graph.base.frozen import Array
from ssm_graph.engine.error_state import POSITION, ROTATION, VELOCITY
from ssm_graph.engine.states import States
from ssm_graph.graph.aids.depth import DepthMeans
from ssm_graph.graph.aids.gnss import Fixes
from ssm_graph.graph.aids.heading import Headings
from ssm_graph.graph.aids.ranges import Ranges
from ssm_graph.graph.aids.standstill import Standstills
from ssm_graph.graph.measurements import Measurements
from ssm_graph.imu.preintegration import gravity_between
from ssm_graph.mission.problem import Problem, start_of


def gtsam_graph(
    problem: Problem,
    states: States,
    weights: Array | None = None,
    aid_weights: Array | None = None,
) -> gtsam.NonlinearFactorGraph:
    """Return the whole graph with the keys ``x``, ``v`` and ``b`` of every keyframe.

    Gravity of the inertial factors, the targets of depth and the north of compasses are those of
    ``states``, near the answer, and stay.

    Parameters
    ----------
    problem : the mission, with no calibration asked for.
    states : of all keyframes, for example those of :func:`warm_start`.
    weights : (M,) of the beams; all one when left out.
    aid_weights : of the aids' measurements, as :func:`aid_graph` takes them.

    Raises
    ------
    ConfigError
        If the problem has variables beside those of the keyframes.
    """
    if problem.extras:
        names = ", ".join(block.name for block in problem.extras.blocks)
        raise ConfigError(
            f"gtsam_graph: expected a problem of keyframes alone, got one that estimates {names}: "
            "take their prior sigmas, or the pings off the water, out of the mission"
        )
    graph = graph_without_beams(problem, states, aid_weights)
    beams = problem.beams
    weights = np.ones(len(beams.speed)) if weights is None else weights
    for row, k in enumerate(beams.keyframe.tolist()):
        graph.add(
            dvl_beam_factor(
                X(k),
                V(k),
                B(k),
                sigma=float(beams.sigma[row]),
                weight=float(weights[row]),
                speed=float(beams.speed[row]),
                gyro_b=beams.gyro_b[row],
                beam_b=beams.beam_b[row],
                lever_arm_b=beams.lever_arm_b,
                omega_ie_n=problem.frame.omega_ie_n,
            )
        )
    return graph


def graph_without_beams(
    problem: Problem, states: States, aid_weights: Array | None = None
) -> gtsam.NonlinearFactorGraph:
    """Return the inertial factors, the initial state and the aids, led after ``states``."""
    graph = inertial_graph(problem, states)
    for part in (prior_graph(problem), aid_graph(problem, states, aid_weights)):
        graph.push_back(part)
    return graph


def inertial_graph(problem: Problem, states: States) -> gtsam.NonlinearFactorGraph:
    """Return the inertial factors between successive keyframes, with gravity of ``states``."""
    graph = gtsam.NonlinearFactorGraph()
    gravity = gravity_between(problem.frame, states.p_n)
    for k, measured in enumerate(problem.chain.measured(gravity)):
        graph.add(
            gtsam.GalileanCombinedImuFactor(
                X(k), V(k), X(k + 1), V(k + 1), B(k), B(k + 1), measured
            )
        )
    return graph


def gtsam_values(states: States) -> gtsam.Values:
    """Return the states as GTSAM's values, with the keys of :func:`gtsam_graph`."""
    values = gtsam.Values()
    poses = np.tile(np.eye(4), (len(states.p_n), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = states.R_nb, states.p_n
    # Keywords spare GTSAM the search through 46 overloads: 12 instead of 28 us for a bias.
    columns = zip(poses, states.v_n, states.bias[:, :3], states.bias[:, 3:], strict=True)
    for k, (pose, velocity, accel, gyro) in enumerate(columns):
        values.insert(X(k), pose3=gtsam.Pose3(pose))
        values.insert(V(k), velocity)
        values.insert(B(k), constant_bias=gtsam.imuBias.ConstantBias(accel, gyro))
    return values


def chain_ordering(n_keyframes: int) -> gtsam.Ordering:
    """Return the order to eliminate in: keyframe by keyframe in time, pose, velocity, bias."""
    ordering = gtsam.Ordering()
    for k in range(n_keyframes):
        for key in (X(k), V(k), B(k)):
            ordering.push_back(key)
    return ordering


def prior_graph(problem: Problem) -> gtsam.NonlinearFactorGraph:
    """Return the initial state."""
    start = start_of(problem)
    cov, R_nb = start.covariance, start.R_nb
    gaussian = gtsam.noiseModel.Gaussian.Covariance
    position_cov_n = R_nb @ cov[POSITION, POSITION] @ R_nb.T
    graph = gtsam.NonlinearFactorGraph()
    graph.add(gtsam.PoseRotationPrior3D(X(0), gtsam.Rot3(R_nb), gaussian(cov[ROTATION, ROTATION])))
    graph.add(gtsam.PoseTranslationPrior3D(X(0), start.p_n, gaussian(position_cov_n)))
    graph.addPriorVector(V(0), start.v_n, gaussian(cov[VELOCITY, VELOCITY]))
    graph.addPriorConstantBias(B(0), gtsam.imuBias.ConstantBias(), gaussian(cov[9:, 9:]))
    return graph


def aid_graph(
    problem: Problem, states: States, weights: Array | None = None
) -> gtsam.NonlinearFactorGraph:
    """Return the aids of a problem that estimates nothing of theirs.

    Parameters
    ----------
    problem : with any of them, or none.
    states : of all keyframes; they say where north is for the compass, and lead the depth.
    weights : (M,) of the measurements, as :attr:`FirstValues.aid_weights` has them: depth, GNSS,
        USBL, ranges, headings, standstills; all one when left out.
    """
    aids = Measurements.of_problem(problem)
    aids.follow(states)
    weights = np.ones(len(aids)) if weights is None else weights
    graph = gtsam.NonlinearFactorGraph()
    for aid in aids.all:
        own = aids.of(aid, weights)
        match aid:
            case DepthMeans():
                factors = _depths(aid, own)
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


def _depths(means: DepthMeans, weights: Array) -> Iterator[gtsam.NonlinearFactor]:
    """Yield GTSAM's position factors that count along the local vertical only."""
    root_information = np.zeros((len(means), 3, 3))
    root_information[:, 0] = means.up_n * (means.root_information[:, 0] * np.sqrt(weights)[:, None])
    for k, place_n, root in zip(
        means.keyframe.tolist(), means.target_n, root_information, strict=True
    ):
        noise = gtsam.noiseModel.Gaussian.SqrtInformation(root, False)
        yield gtsam.GPSFactorArm(X(k), place_n, means.lever_arm_b, noise)


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
