"""Instruments, first state and place on Earth as the sections of ``mission.toml`` state them."""

from __future__ import annotations

import numpy as np

from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.frames import to_frd, wrap_to_pi
from ssm_graph.base.frozen import Array
from ssm_graph.io.mission_folder.toml import MissionToml
from ssm_graph.io.mission_folder.units import R_bd_from_rpy, beams_from_angles, to_si
from ssm_graph.io.tables.settings import Settings
from ssm_graph.io.tables.table import POSITION
from ssm_graph.mission.mission import InitialState
from ssm_graph.sensors.current import CurrentModel
from ssm_graph.sensors.depth import DepthCalibration
from ssm_graph.sensors.drift import Drift
from ssm_graph.sensors.dvl import DvlMount
from ssm_graph.sensors.gnss import GnssCalibration
from ssm_graph.sensors.imu import ImuNoise

_UNIT_TOLERANCE = 1e-3
_FLATTEST_GEOMETRY = 0.01


def imu_noise(settings: Settings) -> ImuNoise:
    """Return the noise of the inertial sensors of section ``[imu]``."""
    return ImuNoise(
        gyro_density=_si(settings, "gyro_random_walk_deg_per_sqrt_h"),
        accel_density=_si(settings, "accel_random_walk_ug_per_sqrt_hz"),
        gyro_bias_sigma=_si(settings, "gyro_bias_deg_per_h"),
        accel_bias_sigma=_si(settings, "accel_bias_ug"),
        gyro_bias_density=_si(settings, "gyro_bias_walk_deg_per_h_per_sqrt_h"),
        accel_bias_density=_si(settings, "accel_bias_walk_ug_per_sqrt_h"),
    )


def dvl_mount(toml: MissionToml) -> DvlMount:
    """Return the geometry of section ``[dvl]``; raise where the beams lie in one plane."""
    settings = toml["dvl"]
    if settings.number("scale_walk_per_sqrt_h") > 0.0 and settings.number("scale_sigma") == 0.0:
        raise settings.fault(
            "scale_walk_per_sqrt_h",
            "expected with a scale_sigma above 0, the sigma at the start, got none; "
            "0.01 is 1 percent",
        )
    return DvlMount(
        beams_d=_beams(settings),
        R_bd=R_bd_from_rpy(np.radians(settings.array("mounting_rpy_deg"))),
        lever_arm_b=lever_arm_b(toml, "dvl"),
        misalignment_sigma=_si(settings, "misalignment_sigma_deg"),
        scale_sigma=settings.number("scale_sigma"),
        time_offset_s=settings.number("time_offset_s"),
        time_offset_sigma_s=settings.number("time_offset_sigma_s"),
        scale_error=settings.number("scale_error"),
        scale_walk_density=_si(settings, "scale_walk_per_sqrt_h"),
        beam_scale_error=(
            settings.array("beam_scale_error") if "beam_scale_error" in settings else None
        ),
        beam_scale_sigma=settings.number("beam_scale_sigma"),
        lever_arm_sigma=settings.number("lever_arm_sigma_m"),
        drift=_drift(settings, "drift_sigma_m_per_s"),
    )


def current_model(settings: Settings) -> CurrentModel:
    """Return what section ``[current]`` says of the water; what it does not say is the default."""
    default = CurrentModel()
    return CurrentModel(
        sigma=settings.number("sigma_m_per_s") or default.sigma,
        correlation_s=settings.number("correlation_s") or default.correlation_s,
        vertical_sigma=(
            settings.number("vertical_sigma_m_per_s")
            if "vertical_sigma_m_per_s" in settings
            else default.vertical_sigma
        ),
    )


def depth_calibration(toml: MissionToml) -> DepthCalibration:
    """Return what section ``[depth]`` says of its errors; nothing without the section."""
    if "depth" not in toml:
        return DepthCalibration()
    settings = toml["depth"]
    return DepthCalibration(settings.number("offset_m"), settings.number("offset_sigma_m"))


def gnss_calibration(toml: MissionToml) -> GnssCalibration:
    """Return what section ``[gnss]`` says of its errors; nothing without the section."""
    if "gnss" not in toml:
        return GnssCalibration()
    settings = toml["gnss"]
    return GnssCalibration(
        time_offset_s=settings.number("time_offset_s"),
        time_offset_sigma_s=settings.number("time_offset_sigma_s"),
        lever_arm_sigma=settings.number("lever_arm_sigma_m"),
        drift=_drift(settings, "drift_sigma_m"),
    )


def lever_arm_b(toml: MissionToml, section: str) -> Array:
    """Return a section's lever arm (3,) in forward-right-down; zero without the section."""
    if section not in toml:
        return np.zeros(3)
    return to_frd(toml[section].array("lever_arm_m"), toml.body)


def stated_frame(toml: MissionToml, section: str) -> LocalFrame | None:
    """Return the frame at the place that ``[origin]`` or ``[initial]`` states."""
    if section not in toml:
        return None
    return frame_at(*(toml[section].number(key) for key in POSITION))


def frame_at(lat_deg: float, lon_deg: float, height_m: float) -> LocalFrame:
    """Return the navigation frame at a place in the units of the file."""
    return LocalFrame(float(np.radians(lat_deg)), float(radians_wrapped(lon_deg)), height_m)


def initial_state(settings: Settings) -> InitialState:
    """Return the state of section ``[initial]``."""
    return InitialState(
        time_s=settings.number("time_s"),
        lat=_si(settings, "lat_deg"),
        lon=float(radians_wrapped(settings.number("lon_deg"))),
        height=settings.number("height_m"),
        roll=_si(settings, "roll_deg"),
        pitch=_si(settings, "pitch_deg"),
        heading=_si(settings, "heading_deg"),
        velocity_enu=settings.array("vel_enu_m_per_s"),
        position_sigma_enu=settings.array("position_sigma_m"),
        velocity_sigma_enu=settings.array("velocity_sigma_m_per_s"),
        attitude_sigma=np.radians(settings.array("attitude_sigma_deg")),
    )


def radians_wrapped(lon_deg: Array | float) -> Array:
    """Return a longitude in [-pi, pi], unchanged in all its digits where it lies there already."""
    lon = np.radians(lon_deg)
    return np.asarray(np.where(np.abs(lon) > np.pi, wrap_to_pi(lon), lon))


def _drift(settings: Settings, sigma_key: str) -> Drift:
    """Return the drift of a section; raise where one of its keys stands without the other."""
    sigma, correlation_s = settings.number(sigma_key), settings.number("drift_correlation_s")
    if sigma > 0.0 and correlation_s == 0.0:
        raise settings.fault(
            sigma_key, "expected with a drift_correlation_s, got none; 20 is a third of a minute"
        )
    for key in ("drift_correlation_s", "drift_white_share"):
        if key in settings and sigma == 0.0:
            raise settings.fault(key, f"expected with a {sigma_key} above 0, got none")
    share = settings.number("drift_white_share") if "drift_white_share" in settings else 1.0
    return Drift(sigma, correlation_s, share)


def _beams(settings: Settings) -> Array:
    if "beam_vectors" not in settings:
        azimuth = np.radians(settings.array("beam_azimuth_deg"))
        beams = beams_from_angles(azimuth, float(np.radians(settings.number("beam_janus_deg"))))
    else:
        beams = settings.array("beam_vectors")
        length = np.linalg.norm(beams, axis=1)
        for row in np.flatnonzero(np.abs(length - 1.0) > _UNIT_TOLERANCE):
            raise settings.fault(
                "beam_vectors",
                f"expected unit vectors, got length {length[row]:.6g} for beam {row + 1}",
            )
        beams = beams / length[:, None]
    if np.linalg.svd(beams, compute_uv=False)[-1] < _FLATTEST_GEOMETRY:
        key = "beam_vectors" if "beam_vectors" in settings else "beam_azimuth_deg"
        raise settings.fault(
            key,
            "the beams lie in one plane and cannot measure a velocity; expected four different "
            "directions around the vertical",
        )
    return beams


def _si(settings: Settings, key: str) -> float:
    return to_si(key, settings.number(key))
