"""What a Doppler velocity log reads: the motion of the instrument itself along its beams."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from ssm_graph.base.earth import R_el_from_lat_lon, geodetic_from_ecef
from ssm_graph.base.frozen import Array
from ssm_graph.sensors.dvl import DvlMount
from ssm_graph.simulation import checked
from ssm_graph.simulation.randomness import DriftSettings
from ssm_graph.simulation.taylor import Series
from ssm_graph.simulation.trajectory import Motion, Trajectory, Vector, stacked

Point = tuple[float, float, float]

_RELATIVE = checked.Rule(lambda x: abs(x) < 1.0, "a relative error below 1", "write 2 % as 0.02")
_VERTICAL = np.array([[0.0, 0.0, 1.0]])


def janus_beams(
    n_beams: int = 4, *, azimuth: Sequence[float] | None = None, janus: float = math.radians(30.0)
) -> Array:
    """Return unit beam directions (B, 3) in instrument axes, x forward mark, y starboard, z down.

    Each beam is the z axis, tilted by ``janus`` towards x and then turned by its azimuth from x
    towards y, rad. Without azimuths the beams are spread evenly, half a step from x on; of five
    one looks straight down, as makers of such instruments have it.
    """
    from scipy.spatial.transform import Rotation

    has_vertical = azimuth is None and n_beams == 5
    n_slanted = n_beams - has_vertical
    even = 2.0 * math.pi * (np.arange(n_slanted) + 0.5) / n_slanted
    turns = even if azimuth is None else np.asarray(azimuth, float)
    angles = np.column_stack([turns, np.full(len(turns), janus)])
    beams_d = np.asarray(Rotation.from_euler("ZY", angles).apply([0.0, 0.0, 1.0]))
    return np.vstack([beams_d, _VERTICAL]) if has_vertical else beams_d


def default_mount(beams_d: Array | None = None) -> DvlMount:
    """Return an instrument 0.5 m ahead of the IMU and 0.3 m below, slightly askew.

    Its beams (B, 3) are a 30-degree Janus array of four unless given; ``numpy.eye(3)`` is an
    instrument that gives a velocity alone.
    """
    from scipy.spatial.transform import Rotation

    askew = Rotation.from_euler("ZYX", np.radians([2.0, -1.0, 0.5]))
    return DvlMount(
        beams_d=janus_beams() if beams_d is None else beams_d,
        R_bd=askew.as_matrix(),
        lever_arm_b=np.array([0.5, 0.0, 0.3]),
    )


@dataclass(frozen=True, slots=True)
class DvlSettings(checked.Settings):
    """The instrument, and in which ways it differs from what is written about it."""

    mount: DvlMount = field(default_factory=default_mount)
    """The geometry as written into the mission; any number of beams in any directions."""
    rate_hz: float = checked.positive(1.0, hint="try 1 Hz")
    """Pings per second."""
    first_s: float | None = None
    """Time of the first ping, s; None for one interval after the start."""
    jitter_s: float = checked.not_negative(0.0, hint="try 0.02 s")
    """Each ping is early or late by up to this much, uniformly; its stamp is true."""
    noise: float = checked.positive(0.005, hint="try 0.005 m/s")
    """Standard deviation of a beam speed, m/s."""
    scale_error: float = checked.field(_RELATIVE, 0.0)
    """Speeds are read ``1 + scale_error`` too large."""
    misalignment: Point = (0.0, 0.0, 0.0)
    """Rotation vector, rad, by which the true mounting differs: ``R_bd_true = R_bd Exp(m)``."""
    late_s: float = 0.0
    """Stamps are later than the pings by this much, s."""
    lever_arm_error_b: Point = checked.point((0.0, 0.0, 0.0))
    """The instrument truly sits this much further on, body axes, m."""
    beam_scale_errors: tuple[float, ...] = ()
    """On top of ``scale_error``, each beam's own; empty for none."""
    scale_drift_per_h: float = 0.0
    """By so much the scale error grows in an hour."""
    drift: DriftSettings | None = None
    """Of the velocity that is read, each component in instrument axes, m/s."""
    seabed_depth_m: float | None = None
    """Depth of a level sea floor; given, ranges are written as well."""

    def __post_init__(self) -> None:
        super(DvlSettings, self).__post_init__()
        checked.require(
            self.jitter_s < 0.5 / self.rate_hz,
            "DvlSettings.jitter_s",
            expected=f"less than half an interval, {0.5 / self.rate_hz} s",
            got=self.jitter_s,
            hint="pings must stay in order",
        )
        checked.require(
            len(self.beam_scale_errors) in (0, self.mount.n_beams),
            "DvlSettings.beam_scale_errors",
            expected=f"none, or one for each of the {self.mount.n_beams} beams",
            got=self.beam_scale_errors,
            hint="write 2 % as 0.02",
        )


def ping_times(settings: DvlSettings, *, end_s: float, rng: np.random.Generator | None) -> Array:
    """Return when the pings happen, s, within ``(0, end_s]``; None draws no jitter."""
    interval = 1.0 / settings.rate_hz
    first = interval if settings.first_s is None else settings.first_s
    count = max(math.floor((end_s - first) * settings.rate_hz + 1e-9) + 1, 0)
    # A quotient, not a multiple of a rounded interval: whole seconds stay whole.
    time_s = first + np.arange(count) / settings.rate_hz
    if rng is not None and settings.jitter_s > 0.0:
        time_s = time_s + rng.uniform(-settings.jitter_s, settings.jitter_s, size=count)
    return np.minimum(time_s[(time_s > 0.0) & (time_s <= end_s + 1e-9)], end_s)


def true_beam_speeds(
    trajectory: Trajectory,
    settings: DvlSettings,
    time_s: Array,
    *,
    current_enu: Array | None = None,
) -> Array:
    """Return how fast the instrument moves along each of its beams (N, B), m/s, over ground.

    The instrument's path over the Earth is differentiated as it is; ``v + omega x l`` is nowhere
    used. With a current (N, 3), m/s along east, north, up, it is the motion through the water.
    """
    motion = trajectory.at(time_s)
    x, y, z = (axis.rate for axis in motion.point_e(_true_lever_arm_b(settings)))
    if current_enu is not None:
        R_el = R_el_from_lat_lon(motion.lat.value, motion.lon.value)
        east, north, up = np.moveaxis(R_el * current_enu[:, None, :], -1, 0)
        x, y, z = (v - c for v, c in zip((x, y, z), (east + north + up).T, strict=True))
    v_e: Vector = (Series([x]), Series([y]), Series([z]))
    v_b = stacked(motion.body_from_earth(v_e))
    read = (1.0 + settings.scale_error + settings.scale_drift_per_h * time_s / 3600.0)[:, None]
    if settings.beam_scale_errors:
        read = read * (1.0 + np.array(settings.beam_scale_errors))
    return np.asarray(v_b @ _true_beams_b(settings).T * read)


def beam_ranges(trajectory: Trajectory, settings: DvlSettings, time_s: Array) -> Array:
    """Return the range (N, B) along each beam to a level sea floor, m; NaN if it never meets it."""
    seabed = math.nan if settings.seabed_depth_m is None else settings.seabed_depth_m
    motion = trajectory.at(time_s)
    _, _, height = geodetic_from_ecef(stacked(motion.point_e(_true_lever_arm_b(settings))))
    down = np.empty((len(time_s), settings.mount.n_beams))
    for beam, direction in enumerate(_true_beams_b(settings)):
        down[:, beam] = _down_part(motion, direction)
    altitude = seabed + height[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = altitude / down
    return np.where((down > 0.0) & (altitude > 0.0), distance, np.nan)


def _true_lever_arm_b(settings: DvlSettings) -> Array:
    return np.asarray(settings.mount.lever_arm_b + np.array(settings.lever_arm_error_b))


def _true_beams_b(settings: DvlSettings) -> Array:
    """Return the beams (B, 3) in body axes as they really point."""
    from scipy.spatial.transform import Rotation

    R_dd = Rotation.from_rotvec(settings.misalignment).as_matrix()
    return np.asarray(settings.mount.beams_d @ (settings.mount.R_bd @ R_dd).T)


def _down_part(motion: Motion, direction_b: Array) -> Array:
    """Return the downward component of a direction fixed to the body."""
    v: Vector = tuple(Series([np.array(c)]) for c in direction_b)  # type: ignore[assignment]
    for turn in reversed(motion.to_body):
        v = turn.forward(v)
    return v[2].value
