"""Which instruments a mission asks to calibrate, as extra variables of the problem."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from ssm_graph.engine.extras import Extra, Extras
from ssm_graph.mission.aid_errors import aid_extras, is_constant_of_aid
from ssm_graph.mission.current import CURRENTS, current_extras, has_water_pings
from ssm_graph.mission.mission import Mission
from ssm_graph.sensors.current import CurrentModel
from ssm_graph.sensors.depth import DepthCalibration
from ssm_graph.sensors.drift import Drift
from ssm_graph.sensors.dvl import DvlMount
from ssm_graph.sensors.gnss import GnssCalibration

DVL_MOUNTING: Final = "dvl_mounting"
DVL_SCALE: Final = "dvl_scale"
DVL_BEAM_SCALE: Final = "dvl_beam_scale"
DVL_LEVER_ARM: Final = "dvl_lever_arm"
DVL_TIME_OFFSET: Final = "dvl_time_offset"
DEPTH_OFFSET: Final = "depth_offset"
GNSS_LEVER_ARM: Final = "gnss_lever_arm"
GNSS_TIME_OFFSET: Final = "gnss_time_offset"
DVL_DRIFT: Final = "dvl_drift"
GNSS_DRIFT: Final = "gnss_drift"
CALIBRATIONS: Final = frozenset(
    {
        DVL_MOUNTING,
        DVL_SCALE,
        DVL_BEAM_SCALE,
        DVL_LEVER_ARM,
        DVL_TIME_OFFSET,
        DEPTH_OFFSET,
        GNSS_LEVER_ARM,
        GNSS_TIME_OFFSET,
    }
)
"""Those of the extra variables that tell of the instruments of every estimator."""
DRIFTS: Final = frozenset({DVL_DRIFT, GNSS_DRIFT})
"""Those that tell of slow errors."""

SEEN_BY_READINGS: Final = frozenset({DVL_TIME_OFFSET, DVL_LEVER_ARM})
"""Those that only motion shows, as the IMU reads it about each ping."""


def calibration_extras(
    mount: DvlMount, depth: DepthCalibration | None, gnss: GnssCalibration | None
) -> tuple[Extra, ...]:
    """Return what the sigmas of instruments switch on, drifts too; None for one not there."""
    extras = [
        Extra(
            DVL_SCALE,
            ("dvl_scale_error",),
            np.array([mount.scale_sigma]),
            walk_density=mount.scale_walk_density,
        ),
        Extra(
            DVL_MOUNTING,
            _axes("dvl_mounting_{}_deg"),
            np.full(3, mount.misalignment_sigma),
            unit=math.radians(1.0),
        ),
        Extra(
            DVL_BEAM_SCALE,
            tuple(f"dvl_beam{beam}_scale_error" for beam in range(1, mount.n_beams + 1)),
            np.full(mount.n_beams, mount.beam_scale_sigma),
        ),
        Extra(DVL_LEVER_ARM, _axes("dvl_lever_arm_{}_m"), np.full(3, mount.lever_arm_sigma)),
        Extra(DVL_TIME_OFFSET, ("dvl_time_offset_s",), np.array([mount.time_offset_sigma_s])),
        *_drift(DVL_DRIFT, "dvl_drift_{}_m_per_s", mount.drift),
    ]
    if depth is not None:
        sigma = np.array([depth.offset_sigma])
        extras.append(Extra(DEPTH_OFFSET, ("depth_offset_m",), sigma))
    if gnss is not None:
        arm_sigma = np.full(3, gnss.lever_arm_sigma)
        late_sigma = np.array([gnss.time_offset_sigma_s])
        extras.append(Extra(GNSS_LEVER_ARM, _axes("gnss_lever_arm_{}_m"), arm_sigma))
        extras.append(Extra(GNSS_TIME_OFFSET, ("gnss_time_offset_s",), late_sigma))
        extras += _drift(GNSS_DRIFT, "gnss_drift_{}_m", gnss.drift)
    return tuple(extra for extra in extras if extra.sigma[0] > 0.0)


def extras_of(mission: Mission) -> Extras:
    """Return what a mission asks to calibrate, its further aids as well, and its current."""
    depth, gnss = mission.depth, mission.gnss
    of_instruments = calibration_extras(
        mission.dvl.mount,
        None if depth is None else depth.calibration,
        None if gnss is None else gnss.calibration,
    )
    of_water = current_extras(mission.current or CurrentModel()) if has_water_pings(mission) else ()
    return Extras((*of_instruments, *aid_extras(mission.aids), *of_water))


def needs_motion(extras: Extras) -> bool:
    """Return whether something is to be estimated that only motion shows, as the IMU reads it."""
    return any(name in extras for name in SEEN_BY_READINGS)


def windowed(extras: Extras) -> Extras:
    """Return those that a fixed-lag window estimates, as it carries them: in each state.

    Left out are those of the further aids, which it is not aided by, and those that only motion
    shows: how much of what the IMU reads is motion can only be judged over a whole mission.
    """
    kept = (CALIBRATIONS | DRIFTS | CURRENTS) - SEEN_BY_READINGS
    return extras.only(kept).in_the_state()


def is_calibration(name: str) -> bool:
    """Return whether an extra variable tells what lasts of an instrument or a beacon."""
    return name in CALIBRATIONS or is_constant_of_aid(name)


def taken_as_exact(extras: Extras) -> tuple[str, ...]:
    """Return the note of an estimator that does not calibrate, if it is asked to."""
    asked = [block.name for block in extras.blocks if block.name in CALIBRATIONS]
    if not asked:
        return ()
    return (
        f"mission.toml asks to calibrate {', '.join(asked)}: this estimator takes them as stated, "
        "and its sigmas leave their errors out; ssm-graph smooth calibrates",
    )


def _drift(name: str, pattern: str, drift: Drift) -> tuple[Extra, ...]:
    """Return a drift of three components, or nothing."""
    if drift.sigma == 0.0:
        return ()
    return (
        Extra.gauss_markov(name, _axes(pattern), drift.sigma, correlation_s=drift.correlation_s),
    )


def _axes(pattern: str) -> tuple[str, ...]:
    return tuple(pattern.format(axis) for axis in "xyz")
