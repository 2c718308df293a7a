"""Put trajectory, sensors and faults together: a mission as recorded, and the truth behind it."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.frozen import Array, ShortRepr
from ssm_graph.mission.mission import Mission, Reference
from ssm_graph.sensors.depth import DepthLog
from ssm_graph.sensors.dvl import DvlLog
from ssm_graph.sensors.gnss import GnssLog
from ssm_graph.sensors.imu import ImuLog
from ssm_graph.simulation.aids import SimulatedAids, aid_logs, depth_log, gnss_log
from ssm_graph.simulation.beam_faults import (
    Loss,
    Outliers,
    add_faults,
    draw_dropouts,
    draw_outliers,
    lost_beams,
)
from ssm_graph.simulation.config import SimulationConfig
from ssm_graph.simulation.currents import Current
from ssm_graph.simulation.dvl_model import beam_ranges, ping_times, true_beam_speeds
from ssm_graph.simulation.faults import Fault
from ssm_graph.simulation.inertial import START_SIGMAS, averaged_imu, imu_errors, initial_state
from ssm_graph.simulation.instruments import (
    UNCALIBRATED,
    ImuCalibration,
    ReadImu,
    read_imu,
    stating,
)
from ssm_graph.simulation.lasting_faults import BrokenMission, with_faults
from ssm_graph.simulation.randomness import Streams, draw_drift, spawn_streams
from ssm_graph.simulation.trajectory import Trajectory


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class SimulatedMission(ShortRepr):
    """A mission as an estimator may see it, and everything that it may not."""

    config: SimulationConfig
    mission: Mission
    """The recorded run; its reference is the truth at ``config.reference_rate_hz``."""
    is_outlier: NDArray[np.bool_]
    """(N, B) beams that an outlier or fault acts on; False where the beam is missing."""
    beam_offset: Array
    """(N, B) what outliers and faults added to the speeds, m/s."""
    true_speed: Array
    """(N, B) beam speeds over ground without noise, outliers, faults or losses, m/s."""
    water_speed: Array
    """(N, B) the same through the water, m/s."""
    ping_time_s: Array
    """(N,) when the pings really happened, s."""
    gyro_bias: Array
    """(M, 3) true gyro bias of each IMU sample, rad/s."""
    aids: SimulatedAids
    """The further aids, with what is wrong with them"""
    accel_bias: Array
    """(M, 3) true accelerometer bias of each IMU sample, m/s^2."""
    imu_calibration: ImuCalibration
    """Scale factors, misalignments and g-sensitivity that were drawn; zeros without them."""
    current: Current
    intact: Mission
    """The mission without the faults that came when all was read: those of beams are in it."""
    is_bad: Mapping[str, NDArray[np.bool_]]
    """Readings that a fault acts on, by the section of their log, as
    :attr:`BrokenMission.is_bad`; ``dvl`` is ``is_outlier``."""

    @property
    def trajectory(self) -> Trajectory:
        """The closed-form motion."""
        return self.config.trajectory

    def truth_at(self, time_s: ArrayLike) -> Reference:
        """Return the true position, velocity and attitude at any times, s."""
        return self.trajectory.truth(time_s)

    def with_known_current(self) -> Mission:
        """Return the mission of the oracle who is told the current: every ping is off the ground.

        Pings off the water keep their noise.
        """
        dvl = self.mission.dvl
        over_ground = dvl.speed + (self.true_speed - self.water_speed)
        known = dataclasses.replace(
            dvl, speed=np.where(dvl.is_water[:, None], over_ground, dvl.speed), water_track=None
        )
        return dataclasses.replace(self.mission, dvl=known)

    def without_outliers(self) -> Mission:
        """Return the mission of the oracle, who is told what is bad: it is missing.

        Inertial data with a fault are those of ``intact``.
        """
        return BrokenMission(self.mission, self.is_bad).told(self.intact)


def simulate(config: SimulationConfig) -> SimulatedMission:
    """Simulate a mission; the same settings give the same mission, bit by bit."""
    streams = spawn_streams(config.seed)
    n_samples = math.floor(config.duration_s * config.imu_rate_hz + 1e-9)
    end_s = n_samples / config.imu_rate_hz
    imu, read = _imu(config, streams, n_samples)
    ping_s = ping_times(config.dvl, end_s=end_s, rng=streams.ping_time)
    current = Current(config.current, end_s=end_s, rng=streams.current)
    speeds = _true_speeds(config, ping_s, current)
    dvl = _dvl(config, streams, ping_s, speeds)
    depth, gnss = _aids(config, streams, end_s)
    noisy = not config.perfect_sensors
    aids = aid_logs(config.trajectory, config.aids, end_s=end_s, streams=streams, noisy=noisy)
    truth = config.trajectory.truth(_reference_times(config, end_s))
    initial_rng = streams.initial if config.draw_initial_errors else None
    intact = Mission(
        name=config.name,
        frame=LocalFrame(lat=config.lat, lon=config.lon, height=0.0),
        imu=imu,
        dvl=dvl.log,
        depth=depth,
        gnss=gnss,
        aids=aids.logs,
        initial=initial_state(
            truth, config.start_sigmas or START_SIGMAS[config.grade], rng=initial_rng
        ),
        reference=truth,
        current=None if config.current is None else config.current.model,
    )
    if config.calibrates:
        intact = stating(intact, config.errors)
    return SimulatedMission(
        config=config,
        **_broken(config, intact, dvl),
        true_speed=speeds.over_ground,
        water_speed=speeds.through_water,
        ping_time_s=ping_s,
        gyro_bias=read.gyro_bias,
        aids=aids,
        accel_bias=read.accel_bias,
        imu_calibration=read.calibration,
        current=current,
    )


def with_dvl_errors(
    simulated: SimulatedMission,
    *,
    outliers: Outliers | None = None,
    faults: Sequence[Fault] = (),
    losses: Sequence[Loss] = (),
    dropout_rate: float = 0.0,
) -> SimulatedMission:
    """Return the same run with other DVL errors; those that it had are replaced.

    Every source of error has a random stream of its own, so that this is, bit by bit, what
    :func:`simulate` makes of the settings with these errors, at a hundredth of the work: all but
    the DVL log is shared with ``simulated``.
    """
    config = dataclasses.replace(
        simulated.config,
        outliers=outliers or Outliers(),
        faults=tuple(faults),
        losses=tuple(losses),
        dropout_rate=dropout_rate,
    )
    streams = spawn_streams(config.seed)
    speeds = _TrueSpeeds(simulated.true_speed, simulated.water_speed)
    dvl = _dvl(config, streams, simulated.ping_time_s, speeds)
    intact = dataclasses.replace(simulated.intact, dvl=dvl.log)
    return dataclasses.replace(simulated, config=config, **_broken(config, intact, dvl))


def _broken(config: SimulationConfig, intact: Mission, dvl: _Dvl) -> dict[str, Any]:
    """Return the fields of a simulated mission that faults decide."""
    faults = [fault for fault in config.faults if not fault.is_before_noise]
    broken = with_faults(intact, faults, truth=config.trajectory.truth, seed=config.seed)
    mission, offset, is_outlier = broken.mission, dvl.offset, dvl.is_outlier
    if "dvl" in broken.is_bad:
        is_outlier = is_outlier | broken.is_bad["dvl"]
        offset = offset + np.nan_to_num(mission.dvl.speed - intact.dvl.speed)
    return {
        "intact": intact,
        "mission": mission,
        "is_outlier": is_outlier,
        "beam_offset": offset,
        "is_bad": {**broken.is_bad, "dvl": is_outlier},
    }


def _reference_times(config: SimulationConfig, end_s: float) -> Array:
    """Return regular times from 0, and the end itself."""
    count = math.floor(end_s * config.reference_rate_hz + 1e-9)
    time_s = np.arange(count + 1) / config.reference_rate_hz
    return time_s if end_s - time_s[-1] < 1e-9 else np.append(time_s, end_s)


def _imu(config: SimulationConfig, streams: Streams, n_samples: int) -> tuple[ImuLog, ReadImu]:
    """Return the log, and what is true of it."""
    rate_hz, inertial = config.imu_rate_hz, config.errors.inertial
    late_s = inertial.drawn_late_s(streams) if inertial else 0.0
    gyro_b, accel_b = averaged_imu(
        config.trajectory, rate_hz=rate_hz, n_samples=n_samples, late_s=late_s
    )
    if config.perfect_sensors:
        none = np.zeros_like(gyro_b)
        read = ReadImu(gyro_b, accel_b, none, none, UNCALIBRATED)
    else:
        drawn = imu_errors(config.noise, rate_hz=rate_hz, n_samples=n_samples, streams=streams)
        if inertial:
            read = read_imu(inertial, (gyro_b, accel_b), drawn, rate_hz=rate_hz, streams=streams)
        else:
            gyro, accel = drawn
            gyro_b += gyro.bias + gyro.noise
            accel_b += accel.bias + accel.noise
            read = ReadImu(gyro_b, accel_b, gyro.bias, accel.bias, UNCALIBRATED)
    log = ImuLog(
        start_s=0.0,
        noise=config.noise,
        time_s=np.arange(1, n_samples + 1) / rate_hz,
        gyro_b=read.gyro_b,
        accel_b=read.accel_b,
    )
    return log, read


class _TrueSpeeds(NamedTuple):
    """Of the instrument along its beams, both (N, B), m/s."""

    over_ground: Array
    through_water: Array


def _true_speeds(config: SimulationConfig, time_s: Array, current: Current) -> _TrueSpeeds:
    over_ground = true_beam_speeds(config.trajectory, config.dvl, time_s)
    if config.current is None:
        return _TrueSpeeds(over_ground, over_ground)
    return _TrueSpeeds(
        over_ground,
        true_beam_speeds(config.trajectory, config.dvl, time_s, current_enu=current.at(time_s)),
    )


class _Dvl(NamedTuple):
    log: DvlLog
    offset: Array
    is_outlier: NDArray[np.bool_]


def _dvl(config: SimulationConfig, streams: Streams, time_s: Array, speeds: _TrueSpeeds) -> _Dvl:
    """Return the pings as read, and what was done to them."""
    settings, water = config.dvl, config.water_track
    n_beams = settings.mount.n_beams
    lost = lost_beams(time_s, n_beams, config.losses)
    is_water = np.zeros(len(time_s), bool) if water is None else water.pings(lost)
    noise = np.where(is_water, settings.noise if water is None else water.noise, settings.noise)
    named = None if water is None else water.beams
    returns = np.isin(np.arange(n_beams), np.arange(n_beams) if named is None else named)
    missing = draw_dropouts(lost.shape, dropout_rate=config.dropout_rate, rng=streams.dropouts)
    missing |= np.where(is_water[:, None], ~returns, lost)
    speed = np.where(is_water[:, None], speeds.through_water, speeds.over_ground)
    drawn = draw_outliers(config.outliers, time_s, speed, rng=streams.outliers)
    before_noise = [fault for fault in config.faults if fault.is_before_noise]
    offset, is_outlier = add_faults(drawn, before_noise, time_s, speed)
    speed = speed + offset
    ranges = None
    if settings.seabed_depth_m is not None:
        off_ground = beam_ranges(config.trajectory, settings, time_s)
        ranges = np.where(missing | is_water[:, None], np.nan, off_ground)
    if not config.perfect_sensors:
        beams = config.errors.beams
        if beams is None:
            speed = speed + noise[:, None] * streams.beam_noise.standard_normal(speed.shape)
        else:
            speed = speed + beams.draw(noise[:, None], speed, ranges, time_s, streams)
        if settings.drift is not None:
            drift_d = draw_drift(settings.drift, time_s, streams.dvl_drift)
            speed = speed + drift_d @ settings.mount.beams_d.T
    log = DvlLog(
        mount=settings.mount,
        time_s=time_s + settings.late_s,
        speed=np.where(missing, np.nan, speed),
        sigma=np.broadcast_to(noise[:, None], speed.shape),
        range_m=ranges,
        water_track=is_water.astype(float) if is_water.any() else None,
    )
    return _Dvl(log, offset, is_outlier & ~missing)


def _aids(
    config: SimulationConfig, streams: Streams, end_s: float
) -> tuple[DepthLog | None, GnssLog | None]:
    """Return the readings of depth sensor and GNSS receiver, where there are any."""
    rngs = (streams.depth, streams.gnss, streams.gnss_drift)
    of_depth, of_gnss, of_drift = (None,) * 3 if config.perfect_sensors else rngs
    depth, gnss, path, slow = config.depth, config.gnss, config.trajectory, config.errors
    slow_depth = (slow.depth, streams.of("slow depth")) if slow.depth else None
    slow_gnss = (slow.gnss, streams.of("slow gnss")) if slow.gnss else None
    return (
        None
        if depth is None
        else depth_log(path, depth, end_s=end_s, rng=of_depth, slow=slow_depth),
        None
        if gnss is None
        else gnss_log(path, gnss, end_s=end_s, rng=of_gnss, drift_rng=of_drift, slow=slow_gnss),
    )
