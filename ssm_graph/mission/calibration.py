"""What a mission asks to estimate beside the states: its instruments, and the current."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from ssm_graph.engine.extras import Extra, Extras
from ssm_graph.graph.aids import AIDS
from ssm_graph.graph.aids.aid import along_axes, drift_variable
from ssm_graph.graph.aids.depth import DEPTH_OFFSET, depth_variables
from ssm_graph.graph.aids.gnss import GNSS_LEVER_ARM, GNSS_TIME_OFFSET, gnss_variables
from ssm_graph.mission.imu_variables import COLUMNS as IMU_ERRORS
from ssm_graph.mission.imu_variables import imu_extras
from ssm_graph.mission.mission import Mission
from ssm_graph.sensors.current import CurrentModel
from ssm_graph.sensors.depth import DepthCalibration
from ssm_graph.sensors.dvl import DvlMount
from ssm_graph.sensors.gnss import GnssCalibration
from ssm_graph.sensors.imu_calibration import ImuCalibration

CURRENT: Final = "current"
"""East and north at the vehicle."""
CURRENT_UP: Final = "current_up"
CURRENTS: Final = frozenset({CURRENT, CURRENT_UP})
"""Those of the extra variables that tell of the water."""


def has_water_pings(mission: Mission) -> bool:
    """Return whether a ping off the water has a speed."""
    return mission.dvl.hears_water


def current_extras(model: CurrentModel) -> tuple[Extra, ...]:
    """Return the current as walks that keep their variance."""
    parts = (
        (CURRENT, ("current_east_m_per_s", "current_north_m_per_s"), model.sigma),
        (CURRENT_UP, ("current_up_m_per_s",), model.vertical_sigma),
    )
    return tuple(
        Extra.gauss_markov(name, labels, sigma, correlation_s=model.correlation_s)
        for name, labels, sigma in parts
        if sigma > 0.0
    )


def current_note(mission: Mission) -> tuple[str, ...]:
    """Return the note of a current that has to be assumed."""
    if mission.current is not None or not has_water_pings(mission):
        return ()
    model = CurrentModel()
    return (
        "pings off the water, and nothing says what their current is like: taken as "
        f"{model.sigma:g} m/s along east and north, {model.vertical_sigma:g} m/s up (1 sigma), "
        f"correlated over {model.correlation_s / 3600.0:g} h; state it in [current]",
    )


DVL_MOUNTING: Final = "dvl_mounting"
DVL_SCALE: Final = "dvl_scale"
DVL_BEAM_SCALE: Final = "dvl_beam_scale"
DVL_LEVER_ARM: Final = "dvl_lever_arm"
DVL_TIME_OFFSET: Final = "dvl_time_offset"
DVL_DRIFT: Final = "dvl_drift"
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
        *IMU_ERRORS,
    }
)
"""Those of the extra variables that tell of the instruments of every estimator."""


SEEN_BY_READINGS: Final = frozenset({DVL_TIME_OFFSET, DVL_LEVER_ARM})
"""Those that only motion shows, as the IMU reads it about each ping."""


def calibration_extras(
    mount: DvlMount,
    depth: DepthCalibration | None,
    gnss: GnssCalibration | None,
    imu: ImuCalibration,
) -> tuple[Extra, ...]:
    """Return what the sigmas of instruments switch on, drifts too; None for one not there."""
    extras = [
        Extra(
            DVL_SCALE,
            ("dvl_scale_error",),
            np.array([mount.scale_sigma]),
            walk_density=mount.scale_walk_density,
            as_a_turn=1.0,
        ),
        Extra(
            DVL_MOUNTING,
            along_axes("dvl_mounting_{}_deg"),
            np.full(3, mount.misalignment_sigma),
            unit=math.radians(1.0),
            as_a_turn=1.0,
        ),
        Extra(
            DVL_BEAM_SCALE,
            tuple(f"dvl_beam{beam}_scale_error" for beam in range(1, mount.n_beams + 1)),
            np.full(mount.n_beams, mount.beam_scale_sigma),
            as_a_turn=1.0,
        ),
        Extra(
            DVL_LEVER_ARM,
            along_axes("dvl_lever_arm_{}_m"),
            np.full(3, mount.lever_arm_sigma),
            as_a_turn=1e2,
        ),
        Extra(DVL_TIME_OFFSET, ("dvl_time_offset_s",), np.array([mount.time_offset_sigma_s])),
        *drift_variable(
            DVL_DRIFT,
            along_axes("dvl_drift_{}_m_per_s"),
            mount.drift,
            shares=np.array([1.0, 1.0, mount.drift_z_share]),
        ),
    ]
    if depth is not None:
        extras += depth_variables(depth)
    if gnss is not None:
        extras += gnss_variables(gnss)
    extras += imu_extras(imu)
    return tuple(extra for extra in extras if extra.sigma[0] > 0.0)


def extras_of(mission: Mission) -> Extras:
    """Return what a mission asks to calibrate, its further aids as well, and its current."""
    depth, gnss = mission.depth, mission.gnss
    of_instruments = calibration_extras(
        mission.dvl.mount,
        None if depth is None else depth.calibration,
        None if gnss is None else gnss.calibration,
        mission.imu.calibration,
    )
    of_aids = (extra for kind in AIDS for extra in kind.variables(mission.aids))
    of_water = current_extras(mission.current or CurrentModel()) if has_water_pings(mission) else ()
    return Extras((*of_instruments, *of_aids, *of_water))


def needs_motion(extras: Extras) -> bool:
    """Return whether something is to be estimated that only motion shows, as the IMU reads it."""
    return any(name in extras for name in SEEN_BY_READINGS)


def windowed(extras: Extras) -> Extras:
    """Return those that a fixed-lag window estimates, as it carries them: in each state.

    Left out are those that only motion shows: how much of what the IMU reads is motion can only be
    judged over a whole mission.
    """
    return extras.without(SEEN_BY_READINGS).in_the_state()


def taken_as_exact(extras: Extras) -> tuple[str, ...]:
    """Return the note of an estimator that does not calibrate, if it is asked to."""
    asked = [block.name for block in extras.blocks if block.name in CALIBRATIONS]
    if not asked:
        return ()
    return (
        f"mission.toml asks to calibrate {', '.join(asked)}: this estimator takes them as stated, "
        "and its sigmas leave their errors out; ssm-graph smooth calibrates",
    )
