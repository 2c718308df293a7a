"""The nonlinear factors of a mission and their linearisation, beams in bulk."""

from __future__ import annotations

from typing import NamedTuple

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X
from numpy.typing import NDArray

from factors.dvl_beam import BeamResidual, beam_residual
from ssm_graph.data import Array
from ssm_graph.graph.depth import depth_graph
from ssm_graph.graph.interfaces import BeamRows, Misfit
from ssm_graph.graph.keys import chain_ordering
from ssm_graph.graph.marginal_prior import prior_at_start
from ssm_graph.graph.solve import LinearSolution, marginal_covariances, solve_linear
from ssm_graph.graph.states import States, retract
from ssm_graph.problem.error_state import (
    GYRO_BIAS,
    POSITION,
    ROTATION,
    STATE_DIM,
    VELOCITY,
)
from ssm_graph.problem.problem import Beams, Fixes, Problem, start_of


def linearize_beams(
    beams: Beams, *, rows: slice, R_nb: Array, v_n: Array, bias: Array, omega_ie_n: Array
) -> BeamRows:
    """Linearise the beams of ``rows`` at states given for each row, or one for all."""
    residual = beam_residual(
        R_nb,
        v_n,
        bias[..., 3:],
        speed=beams.speed[rows],
        gyro_b=beams.gyro_b[rows],
        beam_b=beams.beam_b[rows],
        lever_arm_b=beams.lever_arm_b,
        omega_ie_n=omega_ie_n,
    )
    return rows_of_beams(residual)


def rows_of_beams(residual: BeamResidual) -> BeamRows:
    """Return the residuals of M beams with Jacobians of the whole error state."""
    jacobian = np.zeros((len(residual.error), STATE_DIM))
    jacobian[:, ROTATION] = residual.error_D_rotation
    jacobian[:, VELOCITY] = residual.error_D_velocity_n
    jacobian[:, GYRO_BIAS] = residual.error_D_gyro_bias
    return BeamRows(residual.error, jacobian)


def carried_covariance(A_i: Array, A_j: Array, covariance: Array) -> Array:
    """Return the covariance (15, 15) at the end of an inertial factor from that at its begin.

    Whitened, ``A_i d_i + A_j d_j`` is noise of unit variance, both (15, 15). Extra variables
    behind the error state make it larger; they are carried as they are.
    """
    solved = np.linalg.solve(A_j, np.hstack([-A_i, np.eye(STATE_DIM)]))
    F, root_Q = solved[:, :STATE_DIM], solved[:, STATE_DIM:]
    if len(covariance) == STATE_DIM:
        return np.asarray(F @ covariance @ F.T + root_Q @ root_Q.T)
    carried = covariance.copy()
    carried[:STATE_DIM] = F @ covariance[:STATE_DIM]
    carried[:, :STATE_DIM] = carried[:, :STATE_DIM] @ F.T
    carried[:STATE_DIM, :STATE_DIM] += root_Q @ root_Q.T
    return carried


class ChainStep(NamedTuple):
    """A step of the keyframes alone."""

    solution: LinearSolution
    covariance: Array

    @property
    def delta(self) -> gtsam.VectorValues:
        """Steps of the keyframes."""
        return self.solution.delta

    @property
    def neighbour_covariance(self) -> Array:
        """Between every keyframe and the next, (K - 1, 15, 15)."""
        gain = np.linalg.solve(self.solution.R[:-1], self.solution.S[:-1])
        return np.asarray(-gain @ self.covariance[1:])

    @property
    def sigma(self) -> Array:
        """Of the error state of every keyframe, (K, 15)."""
        return np.asarray(np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2)))

    @property
    def extras_covariance(self) -> Array:
        """Of no variable beside the keyframes, (0, 0)."""
        return np.zeros((0, 0))

    def variance(self, keyframe: NDArray[np.intp], rows: Array) -> Array:
        """Return ``H P H'`` (M,) of rows (M, 15)."""
        P = self.covariance[keyframe]
        return np.asarray(np.einsum("mi,mij,mj->m", rows, P, rows, optimize=True))


class GraphLinearizer:
    """Linearises the whole graph of a problem at any states and beam weights.

    Inertial factors and GNSS are GTSAM's own and stay; gravity and depth targets follow the
    states; beams become one Jacobian factor a keyframe.
    """

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        self.ordering = chain_ordering(problem.n_keyframes)
        self.inertial = inertial_graph(problem)
        self.prior = prior_at_start(start_of(problem))
        self.gnss = gnss_graph(problem.fixes)
        self.depth = gtsam.NonlinearFactorGraph()
        k = problem.beams.keyframe
        self._first_beam = np.flatnonzero(np.diff(k, prepend=-1))
        self._n_rows = np.diff(np.append(self._first_beam, len(k)))
        largest = int(self._n_rows.max(initial=1))
        self._unit = [gtsam.noiseModel.Unit.Create(m + 1) for m in range(largest)]

    def follow(self, states: States) -> bool:
        """Let gravity and the depth targets follow the states; to be called before the others.

        Returns False: beams stay as they are linearised.
        """
        self.problem.chain.set_gravity(states.p_n)
        self.follow_depth(states)
        return False

    def follow_depth(self, states: States) -> None:
        """Let the depth targets follow the states."""
        problem = self.problem
        if problem.depths is not None:
            self.depth = depth_graph(problem.depths, states, problem.frame, problem.keyframe_s)

    def beam_rows(self, states: States) -> BeamRows:
        """Linearise all beams at ``states``."""
        k = self.problem.beams.keyframe
        return linearize_beams(
            self.problem.beams,
            rows=slice(None),
            R_nb=states.R_nb[k],
            v_n=states.v_n[k],
            bias=states.bias[k],
            omega_ie_n=self.problem.frame.omega_ie_n,
        )

    def linearize(
        self, states: States, beam_rows: BeamRows, weights: Array
    ) -> gtsam.GaussianFactorGraph:
        """Return the linear graph at ``states``, with their beam rows and weights (M,)."""
        linear = self.inertial.linearize(states.values)
        for graph in (self.gnss, self.depth):
            linear.push_back(graph.linearize(states.values))
        linear.push_back(self.prior.linear_factor(states))
        self._push_beams(linear, beam_rows, weights)
        return linear

    def solve(self, states: States, beam_rows: BeamRows, weights: Array) -> ChainStep:
        """Return the step at ``states``, with their beam rows and weights (M,)."""
        linear = self.linearize(states, beam_rows, weights)
        solution = solve_linear(linear, self.ordering, n_keyframes=self.problem.n_keyframes)
        return ChainStep(solution, marginal_covariances(solution))

    def retract(
        self, states: States, delta: gtsam.VectorValues, *, scale: float = 1.0
    ) -> tuple[States, Array]:
        """Return the states moved by ``scale * delta``, and that step as (K, 15)."""
        return retract(states, delta, scale=scale)

    def misfits(self, states: States) -> dict[str, Misfit]:
        """Return the misfit of GNSS, depth and inertial data, by name, where there are any."""
        graphs = {"GNSS": self.gnss, "depth": self.depth, "inertial": self.inertial}
        return {
            name: misfit_of(graph, states, rows_per_factor=1 if name == "depth" else None)
            for name, graph in graphs.items()
            if graph.size()
        }

    def cost(self, states: States, beam_rows: BeamRows, weights: Array) -> float:
        """Return half the weighted sum of squares that :meth:`linearize` makes linear."""
        graphs = (self.inertial, self.gnss, self.depth)
        squares = np.sum(weights * (beam_rows.error / self.problem.beams.sigma) ** 2)
        squares += np.sum(self.prior.whitened(states) ** 2)
        return float(sum(graph.error(states.values) for graph in graphs) + 0.5 * squares)

    def _push_beams(
        self, linear: gtsam.GaussianFactorGraph, beam_rows: BeamRows, weights: Array
    ) -> None:
        scale = np.sqrt(weights) / self.problem.beams.sigma
        rows = beam_rows.jacobian * scale[:, None]
        b = -beam_rows.error * scale
        pose, velocity, bias = (np.ascontiguousarray(rows[:, s]) for s in _BLOCKS)
        keyframes = self.problem.beams.keyframe[self._first_beam].tolist()
        firsts, sizes = self._first_beam.tolist(), self._n_rows.tolist()
        for k, first, size in zip(keyframes, firsts, sizes, strict=True):
            end = first + size
            linear.push_back(
                gtsam.JacobianFactor(
                    X(k),
                    pose[first:end],
                    V(k),
                    velocity[first:end],
                    B(k),
                    bias[first:end],
                    b[first:end],
                    self._unit[size - 1],
                )
            )


_BLOCKS = (slice(0, 6), slice(6, 9), slice(9, 15))


def misfit_of(
    graph: gtsam.NonlinearFactorGraph, states: States, *, rows_per_factor: int | None = None
) -> Misfit:
    """Return the misfit of GTSAM's factors of one kind."""
    n_factors = graph.size()
    n_rows = n_factors * (rows_per_factor or graph.at(0).dim())
    return Misfit(2.0 * graph.error(states.values), n_rows, n_factors)


def inertial_graph(problem: Problem) -> gtsam.NonlinearFactorGraph:
    """Return the inertial factors between successive keyframes."""
    graph = gtsam.NonlinearFactorGraph()
    for k, measured in enumerate(problem.chain.measurements):
        graph.add(
            gtsam.GalileanCombinedImuFactor(
                X(k), V(k), X(k + 1), V(k + 1), B(k), B(k + 1), measured
            )
        )
    return graph


def prior_graph(problem: Problem) -> gtsam.NonlinearFactorGraph:
    """Return the initial state as GTSAM's factors, for a graph that GTSAM is to optimise."""
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


def gnss_graph(fixes: Fixes | None) -> gtsam.NonlinearFactorGraph:
    """Return GNSS position factors with lever arm."""
    graph = gtsam.NonlinearFactorGraph()
    if fixes is None:
        return graph
    for k, position_n, covariance_n in zip(
        fixes.keyframe.tolist(), fixes.position_n, fixes.covariance_n, strict=True
    ):
        noise = gtsam.noiseModel.Gaussian.Covariance(covariance_n)
        graph.add(gtsam.GPSFactorArm(X(k), position_n, fixes.lever_arm_b, noise))
    return graph
