"""What converters assume of instruments that nothing is said of; a note of the mission says so."""

from __future__ import annotations

from typing import Final

from ssm_graph.sensors.imu import ImuNoise

NOISE: Final = ImuNoise(
    gyro_density=1.2e-4,
    accel_density=1.5e-3,
    gyro_bias_sigma=4.8e-4,
    accel_bias_sigma=0.05,
    gyro_bias_density=2.4e-6,
    accel_bias_density=1.6e-4,
)
"""A consumer MEMS unit: 100 deg/h, 0.4 deg/sqrt(h), 5 mg."""
BEAM_SIGMA: Final = 0.02
"""m/s"""
DEPTH_SIGMA: Final = 0.1
"""m"""
