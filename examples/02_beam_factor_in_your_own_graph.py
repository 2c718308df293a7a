"""The one-beam factor in a plain GTSAM graph: four beams fix a velocity, one of them lies.

The factor stands for itself: no mission, no smoother, any graph of poses, velocities and biases.
"""

from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X

from factors.dvl_beam import beam_error, dvl_beam_factor
from factors.similarity import LogKernel
from ssm_graph.simulation import janus_beams

beams_b = janus_beams()  # 30 degrees from the vertical, at 45, 135, 225 and 315 degrees
R_nb = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])  # heading north, level
true_v_n = np.array([0.0, 1.5, 0.0])
measured = beams_b @ (R_nb.T @ true_v_n)
measured[2] += 0.8  # a fish in beam 3
setting: dict[str, Any] = {
    "gyro_b": np.zeros(3),
    "lever_arm_b": np.zeros(3),
    "omega_ie_n": np.zeros(3),
}
sigma, kernel, weights = 0.005, LogKernel(dof=5), np.ones(4)

for _ in range(20):
    graph = gtsam.NonlinearFactorGraph()
    pose = gtsam.Pose3(gtsam.Rot3(R_nb), np.zeros(3))
    graph.addPriorPose3(X(0), pose, gtsam.noiseModel.Isotropic.Sigma(6, 1e-3))
    # What an inertial prediction knows of the velocity: without it nobody can tell who lies.
    graph.addPriorVector(V(0), true_v_n + 0.02, gtsam.noiseModel.Isotropic.Sigma(3, 0.03))
    bias = gtsam.imuBias.ConstantBias()
    graph.addPriorConstantBias(B(0), bias, gtsam.noiseModel.Isotropic.Sigma(6, 1e-3))
    for beam_b, speed, weight in zip(beams_b, measured, weights, strict=True):
        graph.add(
            dvl_beam_factor(
                X(0), V(0), B(0), sigma=sigma, speed=speed, beam_b=beam_b, weight=weight, **setting
            )
        )
    values = gtsam.Values()
    values.insert(X(0), pose)
    values.insert(V(0), true_v_n)
    values.insert(B(0), bias)
    solved = gtsam.GaussNewtonOptimizer(graph, values).optimize()
    v_n = solved.atVector(V(0))
    error = beam_error(R_nb, v_n, np.zeros(3), speed=measured, beam_b=beams_b, **setting)
    weights = kernel.weight((error / sigma) ** 2)

print("velocity east, north, up, m/s:", np.round(v_n, 4))
print("weights of beams 1 to 4:      ", np.round(weights, 4))
assert np.linalg.norm(v_n - true_v_n) < 0.01
assert weights[2] < 0.01 < 0.5 < np.delete(weights, 2).min()
