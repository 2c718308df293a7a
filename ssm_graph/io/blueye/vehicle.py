"""What is known of a Blueye X3 with a Water Linked A50, one set for all its logs.

Every value says where it comes from: the makers' drawings and data sheets, the scatter of a sensor
by itself, or three logs of 2025, two of which have GNSS throughout. Nothing depends on the log.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from ssm_graph.sensors.compass import HeadingErrors
from ssm_graph.sensors.drift import Drift
from ssm_graph.sensors.dvl import DvlMount, beams_from_angles
from ssm_graph.sensors.gnss import GnssCalibration
from ssm_graph.sensors.imu import ImuNoise

DVL_LEVER_ARM: Final = (-0.17, 0.0, 0.26)
"""m, forward-right-down from the IMU, as is the antenna's: positions on the vehicle."""
GNSS_LEVER_ARM: Final = (-0.35, 0.0, -0.05)

GYRO_BIAS: Final = (1.3e-3, 1.0e-3, 1.0e-3)
"""rad/s, about x, y, z of Imu2Tel, taken off. x and y are what the gyros turn more than the vehicle
tilts, 0.8e-3 to 1.8e-3 in three logs; z is what the smoother finds with GNSS throughout, 0.95e-3
and 1.18e-3, each known to some 0.2e-3."""
NOISE: Final = ImuNoise(
    # Twice the scatter of the biases above from log to log, 2.5e-4 rad/s.
    gyro_bias_sigma=5e-4,
    # Two IMUs on one vehicle part by 0.3 to 0.6 deg rms within four minutes, and readings of 25 to
    # 37 Hz stamped at arrival miss part of every turn.
    gyro_density=2e-3,
    # With 0.05 the inertial data err three to five times less than that on two logs; with 0.02 both
    # agree about DVL scale and delays, beside them.
    accel_density=0.02,
    # 0.5 % of gravity; a log in m/s^2 is 1 % low.
    accel_bias_sigma=0.05,
)

BEAM_SIGMA: Final = 0.06
"""m/s, what a report counts as where its slow errors are not modelled. At 5 reports a second this
leaves 9 mm/s after half a minute, 1.5 % of the speed under way."""
DVL_DRIFT: Final = Drift(sigma=0.006, correlation_s=20.0, white_share=1.0 / 3.0)
"""m/s. The maker states 1 % for the standard edition, 6 mm/s under way; with GNSS throughout, means
over 2 s miss by 5 mm/s that stay alike for 10 to 20 s. It is common to the beams: what they have
not in common, their parity, is white, 5 mm/s a report. That leaves 0.02 m/s of white noise, four
times as much, for waves within a report."""
DVL_SCALE_ERROR: Final = 0.046
"""Speeds are so much too high: 0.047 and 0.046 against GNSS on two days. The standard edition
counts on 1500 m/s of sound, and brackish water of 6 degrees has 1435 m/s."""
DVL_SCALE_SIGMA: Final = 0.01
"""What salt and temperature change from day to day."""
DVL_DELAY_S: Final = 0.155
"""0.151 s and 0.160 s against the gyros' turns."""
DVL_DELAY_SIGMA_S: Final = 0.02
GNSS_DELAY_S: Final = 0.37
"""0.33 s and 0.40 s against the DVL's track."""
GNSS_DELAY_SIGMA_S: Final = 0.05
DEPTH_SIGMA: Final = 0.03
"""m; the sensor resolves 1 mm, waves at the surface do not"""
DEPTH_DRIFT: Final = Drift(sigma=0.03, correlation_s=2.0, white_share=1.0 / 3.0)
"""m. In waves of 2.8 s the DVL sees a heave of 17 mm rms, of which the port, that is moved with the
water, reads a fifth (log_grid): an error of 17 mm that is alike for half a second and the other way
round after 1.4 s; 5 mm in a calm (log_auto_square). Taken for white at ten readings a second it
held against the DVL, which moves up and down by 45 mm/s there."""
GNSS_SIGMA_LIMIT: Final = 1.0
"""m; fixes that report more are taken while the antenna surfaces or sinks."""
GNSS_DRIFT: Final = Drift(sigma=0.5, correlation_s=120.0, white_share=0.2)
"""m. Nearly all of the 0.5 m that the receiver reports: successive fixes differ by centimetres.
Beside the DVL and the gyros, two logs with GNSS throughout are likeliest with 0.3 to 0.5 m that
stay alike for 120 to 300 s, and 0.01 m of white noise; 0.1 m is left for waves."""
DVL_HEADING_SCALE: Final = 0.989
"""The DVL's own gyro turns so much of what Imu2Tel turns, 0.989 in two logs; both with GNSS
throughout are likelier with the scale of Imu2Tel, by a ratio of 20 together."""
DVL_HEADING_DELAY_S: Final = 0.25
"""0.25 s against the gyros in two logs."""
DVL_HEADING_SIGMA: Final = math.radians(0.5)
"""Stamped at arrival: 0.1 to 0.2 degrees on straight legs, 0.7 in turns."""
DVL_HEADING_ERRORS: Final = HeadingErrors(
    offset_sigma=math.pi,
    # 12, 72 and 0 deg/h against the smoother with GNSS throughout, or the gyros under water.
    rate_sigma=math.radians(50.0) / 3600.0,
    # What is left over 10 s once offset and rate are taken off: 0.2 to 0.3 degrees.
    walk_sigma=math.radians(0.5),
    correlation_s=60.0,
)
GNSS_UP_SIGMA: Final = 50.0
"""m; their height is made from depth, so it must not count as a measurement."""

JANUS_ANGLE: Final = np.deg2rad(22.5)
BEAM_AZIMUTH: Final = np.deg2rad([-45.0, 45.0, 135.0, -135.0])
"""rad, from instrument x (forward) towards y (starboard), transducers 0 to 3."""


def dvl_mount() -> DvlMount:
    """Return the A50 on the vehicle, its scale and delay to be estimated about what is known."""
    return DvlMount(
        beams_d=beams_from_angles(BEAM_AZIMUTH, JANUS_ANGLE),
        R_bd=np.eye(3),
        lever_arm_b=np.array(DVL_LEVER_ARM),
        scale_error=DVL_SCALE_ERROR,
        scale_sigma=DVL_SCALE_SIGMA,
        time_offset_s=DVL_DELAY_S,
        time_offset_sigma_s=DVL_DELAY_SIGMA_S,
        drift=DVL_DRIFT,
    )


def gnss_calibration() -> GnssCalibration:
    """Return the receiver's delay, to be estimated about what is known."""
    return GnssCalibration(
        time_offset_s=GNSS_DELAY_S, time_offset_sigma_s=GNSS_DELAY_SIGMA_S, drift=GNSS_DRIFT
    )
