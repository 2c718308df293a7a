"""What real instruments do beyond bias, walk and white noise; off unless it is asked for.

``SimulationConfig(realistic=True)`` has all of it, in the sizes of the grade; ``instruments`` sets
sizes one by one. What the mission states of its sensors stays as it is.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Final, NamedTuple

import numpy as np

from ssm_graph.base.frozen import Array
from ssm_graph.mission.mission import Mission
from ssm_graph.sensors import imu_calibration
from ssm_graph.simulation import checked
from ssm_graph.simulation.inertial import MICRO_G, PER_HOUR, Grade, ImuErrors
from ssm_graph.simulation.lasting_faults import low_passed
from ssm_graph.simulation.randomness import SlowPart, Streams, regular_gauss_markov, with_slow_part

_G: Final = 9.80665
_PPM: Final = 1e-6
GROUP_DELAY: Final = math.sqrt(2.0) / (2.0 * math.pi)
"""Of a Butterworth filter of two poles far below its end, in the inverse of that."""

FLICKER_S: Final = (1.0, 10.0, 100.0, 1000.0, 10000.0)
"""Correlation times of the Gauss-Markov processes whose sum has a density like ``1 / f``, s."""
_OF_FLOOR: Final = math.sqrt(math.log(10.0) / (2.0 * math.log(2.0)))
"""Sigma of each process over the Allan deviation's floor. A decade apart and of variance ``s^2``,
they add up to the one-sided density ``s^2 / (f ln 10)``; the floor of ``h / f`` is
``sqrt(2 ln 2 h)``."""
_WANDER: Final = (0.01, 5.0)
"""Share by which the frequency of a vibration wanders, and correlation time, s: a thruster under
changing load."""


_FREQUENCIES: Final = checked.Rule(
    lambda hz: all(math.isfinite(f) and f > 0.0 for f in hz), "frequencies above 0 Hz", "try 37 Hz"
)


@dataclass(frozen=True, slots=True)
class InertialErrors(checked.Settings):
    """Of gyros and accelerometers; each sigma is of every number that is drawn, once a mission."""

    gyro_scale: float = checked.not_negative(0.0, hint="write 100 ppm as 1e-4")
    """Sigma of the scale factor of each axis."""
    accel_scale: float = checked.not_negative(0.0, hint="write 100 ppm as 1e-4")
    gyro_misalignment: float = checked.not_negative(0.0, hint="write 0.1 mrad as 1e-4")
    """Sigma of what each axis reads of each other one, rad: six numbers."""
    accel_misalignment: float = checked.not_negative(0.0, hint="write 0.1 mrad as 1e-4")
    g_sensitivity: float = checked.not_negative(0.0, hint="1 deg/h/g is 4.9e-7")
    """Sigma of what each gyro reads of each axis of the specific force, rad/s per m/s^2."""
    gyro_instability: float = checked.not_negative(0.0, hint="1 deg/h is 4.8e-6")
    """Bias instability: the floor of the Allan deviation, rad/s."""
    accel_instability: float = checked.not_negative(0.0, hint="10 ug is 9.8e-5")
    """m/s^2"""
    gyro_vibration: float = checked.not_negative(0.0, hint="try 2e-4 rad/s")
    """Root mean square of each axis at each frequency, rad/s."""
    accel_vibration: float = checked.not_negative(0.0, hint="try 0.02 m/s^2")
    """m/s^2"""
    vibration_hz: tuple[float, ...] = checked.field(_FREQUENCIES, (37.0, 143.0))
    """What is above half the rate of the IMU comes as another frequency."""
    is_averaging: bool = True
    """Whether a sample is the mean of the vibration over its interval, or one of its values."""
    low_pass_hz: float | None = checked.positive(None, hint="leave it out for none")
    """Where the sensor's filter of two poles ends, which makes it late by
    :data:`GROUP_DELAY` over this."""
    late_s: float = checked.not_negative(0.0, hint="try 0.002 s")
    """Samples are stamped later than they are by this much, s, filter not counted."""
    late_tolerance: float = checked.not_negative(0.0, hint="write 5 % as 0.05")
    """Sigma of the very unit's ``late_s`` by that of its data sheet, drawn once a mission."""
    gyro_range: float | None = checked.positive(None, hint="500 deg/s is 8.7")
    """Readings end here, rad/s; None for nowhere."""
    accel_range: float | None = checked.positive(None, hint="4 g is 39")
    """m/s^2"""
    gyro_quantum: float = checked.not_negative(0.0, hint="try 1e-4 rad/s")
    """Step of the readings, rad/s."""
    accel_quantum: float = checked.not_negative(0.0, hint="try 1e-3 m/s^2")
    """m/s^2"""
    carries_rest: bool = True
    """Whether what a step leaves over comes with the next sample, as in counted pulses."""

    @property
    def asked(self) -> imu_calibration.ImuCalibration:
        """What a mission states that asks for the calibration of what is drawn of these sizes."""
        return imu_calibration.ImuCalibration(
            gyro_scale_sigma=self.gyro_scale,
            gyro_misalignment_sigma=self.gyro_misalignment,
            gyro_g_sensitivity_sigma=self.g_sensitivity,
            accel_scale_sigma=self.accel_scale,
            accel_misalignment_sigma=self.accel_misalignment,
            time_offset_s=self.delay_s,
        )

    def drawn_late_s(self, streams: Streams) -> float:
        """Return how late the stamps of a very unit are, s, filter not counted."""
        off = float(streams.of("imu delay").standard_normal())
        return max(self.late_s * (1.0 + self.late_tolerance * off), 0.0)

    @property
    def delay_s(self) -> float:
        """How late readings are by the data sheet, s: latency and group delay of the filter."""
        filtered_s = GROUP_DELAY / self.low_pass_hz if self.low_pass_hz else 0.0
        return self.late_s + filtered_s


_DOF: Final = checked.Rule(
    lambda dof: dof > 2.0 and math.isfinite(dof), "degrees of freedom above 2", "try 4.3"
)


@dataclass(frozen=True, slots=True)
class BeamNoise(checked.Settings):
    """How the noise of beams comes about; but for speed and range its variance is that stated."""

    dof: float | None = checked.field(_DOF, 4.3)
    """Of Student's t, whose tails it has: what the error velocity of a Workhorse shows. None for
    normal noise."""
    slow: SlowPart | None = SlowPart(0.125, 20.0)
    """Each beam's own; None for white noise."""
    correlation: float = checked.fraction(0.1)
    """Of the white part, between any two beams: turbulence and electronics in common."""
    of_speed: float = checked.not_negative(0.002, hint="write 0.2 % as 0.002")
    """Sigma of a part that grows with the speed along the beam: long-term accuracies of data
    sheets are 0.2 to 0.4 % of the speed."""
    of_range: float = checked.not_negative(3e-5, hint="try 3e-5 m/s per m")
    """Sigma of a part that grows with the range, m/s per m, where ranges are known: at 50 m 1.5
    mm/s, by which echoes that spread and weaken widen the spectrum."""

    def draw(
        self, sigma: Array, speed: Array, range_m: Array | None, time_s: Array, streams: Streams
    ) -> Array:
        """Return the noise (N, B), m/s, of beams of a stated sigma (N, 1)."""
        rng, shape = streams.of("beam noise"), speed.shape
        own, common = self._white(rng, shape), self._white(rng, (len(time_s), 1))
        unit = math.sqrt(1.0 - self.correlation) * own + math.sqrt(self.correlation) * common
        unit = with_slow_part(unit, time_s, self.slow, streams.of("slow beam noise"))
        grown = (self.of_speed * speed) ** 2
        if range_m is not None:
            grown = grown + (self.of_range * np.nan_to_num(range_m)) ** 2
        return np.asarray(np.sqrt(sigma**2 + grown) * unit)

    def _white(self, rng: np.random.Generator, shape: tuple[int, ...]) -> Array:
        if self.dof is None:
            return rng.standard_normal(shape)
        return rng.standard_t(self.dof, shape) * math.sqrt(1.0 - 2.0 / self.dof)


@dataclass(frozen=True, slots=True)
class InstrumentErrors:
    """Of all instruments; None for one that is as simple as it says."""

    inertial: InertialErrors | None = None
    beams: BeamNoise | None = BeamNoise()
    depth: SlowPart | None = SlowPart(0.25, 20.0)
    """Swell and drag that the pressure port reads."""
    gnss: SlowPart | None = SlowPart(0.25, 100.0)
    """Multipath and atmosphere."""


def _inertial(sheet: tuple[float, ...], **others: float | bool) -> InertialErrors:
    """Return the errors of a grade in SI units."""
    g_scale, g_angle, a_scale, a_angle, g_sensitivity, g_floor, a_floor = sheet
    return InertialErrors(
        gyro_scale=g_scale * _PPM,
        gyro_misalignment=g_angle * 1e-6,
        accel_scale=a_scale * _PPM,
        accel_misalignment=a_angle * 1e-6,
        g_sensitivity=math.radians(g_sensitivity) * PER_HOUR / _G,
        gyro_instability=math.radians(g_floor) * PER_HOUR,
        accel_instability=a_floor * MICRO_G,
        gyro_vibration=2e-4,
        accel_vibration=0.02,
        late_tolerance=0.05,  # oscillators and drivers of such units keep some per cent
        **others,  # type: ignore[arg-type]
    )


INERTIAL_ERRORS: Final[Mapping[Grade, InertialErrors]] = MappingProxyType(
    {
        # Ring laser and navigation fibre-optic units (GG1320, HG9900 class): pulses are counted.
        Grade.NAVIGATION: _inertial(
            (5.0, 10.0, 100.0, 25.0, 0.001, 0.003, 10.0),
            late_s=0.001,
            gyro_range=math.radians(400.0),
            accel_range=20.0 * _G,
            gyro_quantum=1e-4,
            accel_quantum=1e-3,
        ),
        # Small fibre-optic, ring laser and quartz units (LN-200, HG1700, HG1930 class).
        Grade.TACTICAL: _inertial(
            (150.0, 150.0, 300.0, 150.0, 0.3, 0.3, 20.0),
            late_s=0.002,
            gyro_range=math.radians(500.0),
            accel_range=20.0 * _G,
            gyro_quantum=2e-4,
            accel_quantum=3e-3,
        ),
        # Calibrated MEMS units (ADIS16495, STIM300 class): 16 bits at full range.
        Grade.INDUSTRIAL: _inertial(
            (1000.0, 600.0, 1000.0, 600.0, 5.0, 2.0, 30.0),
            late_s=0.003,
            gyro_range=math.radians(450.0),
            accel_range=8.0 * _G,
            gyro_quantum=1.1e-4,
            accel_quantum=2.5e-3,
            carries_rest=False,
        ),
        # Chips for phones and autopilots (ICM-20948, BMI088 class) once calibrated at rest.
        Grade.MEMS: _inertial(
            (5000.0, 5000.0, 5000.0, 3000.0, 50.0, 10.0, 100.0),
            late_s=0.005,
            low_pass_hz=40.0,
            gyro_range=math.radians(500.0),
            accel_range=4.0 * _G,
            gyro_quantum=2.7e-4,
            accel_quantum=1.2e-3,
            carries_rest=False,
            is_averaging=False,
        ),
    }
)
"""Scale of gyros in ppm, their misalignment in urad, the same of accelerometers, g-sensitivity in
deg/h/g, instability of gyros in deg/h, of accelerometers in ug; all 1 sigma, as sheets have them.
Vibration is that of a small vehicle with thrusters, the unit on dampers."""


class ImuCalibration(NamedTuple):
    """What was drawn: ``gyro = (1 + K) omega + G f``, ``accel = (1 + A) f`` and biases, noise."""

    gyro: Array
    """(3, 3) K, scale errors on its diagonal."""
    accel: Array
    """(3, 3) A."""
    g_sensitivity: Array
    """(3, 3) G, rad/s per m/s^2."""


UNCALIBRATED: Final = ImuCalibration(*np.zeros((3, 3, 3)))
"""Of an IMU without such errors."""


class ReadImu(NamedTuple):
    """What the inertial sensors read, and what is true of them."""

    gyro_b: Array
    """(N, 3) rad/s"""
    accel_b: Array
    """(N, 3) m/s^2"""
    gyro_bias: Array
    """(N, 3) turn-on bias, walk and instability, rad/s."""
    accel_bias: Array
    """(N, 3) the same, m/s^2."""
    calibration: ImuCalibration


def read_imu(
    errors: InertialErrors,
    true: tuple[Array, Array],
    drawn: tuple[ImuErrors, ImuErrors],
    *,
    rate_hz: float,
    streams: Streams,
) -> ReadImu:
    """Return what is read of the true mean rate and specific force (N, 3), body axes.

    ``drawn`` are the biases, walks and white noise of gyros and accelerometers.
    """
    (omega_b, f_b), (gyro, accel) = true, drawn
    rng = streams.of("imu calibration")
    calibration = ImuCalibration(
        _matrix(errors.gyro_scale, errors.gyro_misalignment, rng),
        _matrix(errors.accel_scale, errors.accel_misalignment, rng),
        errors.g_sensitivity * rng.standard_normal((3, 3)),
    )
    floors = errors.gyro_instability, errors.accel_instability
    flicker = [
        _flicker(f, len(f_b), rate_hz, streams.of(f"imu flicker {i}")) for i, f in enumerate(floors)
    ]
    shaken = _vibration(errors, len(f_b), rate_hz, streams.of("imu vibration"))
    omega_b, f_b = (
        omega_b + errors.gyro_vibration * shaken[0],
        f_b + errors.accel_vibration * shaken[1],
    )
    gyro_bias, accel_bias = gyro.bias + flicker[0], accel.bias + flicker[1]
    gyro_b = omega_b + omega_b @ calibration.gyro.T + f_b @ calibration.g_sensitivity.T
    accel_b = f_b + f_b @ calibration.accel.T
    return ReadImu(
        _digitised(
            gyro_b + gyro_bias + gyro.noise, errors, errors.gyro_range, errors.gyro_quantum, rate_hz
        ),
        _digitised(
            accel_b + accel_bias + accel.noise,
            errors,
            errors.accel_range,
            errors.accel_quantum,
            rate_hz,
        ),
        gyro_bias,
        accel_bias,
        calibration,
    )


def _matrix(scale: float, misalignment: float, rng: np.random.Generator) -> Array:
    sigma = np.full((3, 3), misalignment)
    np.fill_diagonal(sigma, scale)
    return np.asarray(sigma * rng.standard_normal((3, 3)))


def _flicker(floor: float, n: int, rate_hz: float, rng: np.random.Generator) -> Array:
    """Return biases (n, 3) whose Allan deviation is flat at ``floor`` from seconds to an hour."""
    total = np.zeros((n, 3))
    for correlation_s in FLICKER_S if floor > 0.0 else ():
        total += regular_gauss_markov(rng.standard_normal((n, 3)), 1.0 / rate_hz, correlation_s)
    return floor * _OF_FLOOR * total


def _vibration(errors: InertialErrors, n: int, rate_hz: float, rng: np.random.Generator) -> Array:
    """Return what a sample has of vibrations of root mean square 1, (2, n, 3): rate and force."""
    total = np.zeros((2, n, 3))
    if not errors.gyro_vibration and not errors.accel_vibration:
        return total
    share, correlation_s = _WANDER
    for frequency_hz in errors.vibration_hz:
        wander = regular_gauss_markov(rng.standard_normal((n, 1)), 1.0 / rate_hz, correlation_s)
        turn = 2.0 * math.pi * frequency_hz / rate_hz * (1.0 + share * wander)
        phase = np.cumsum(turn, axis=0) + rng.uniform(0.0, 2.0 * math.pi, (2, 1, 3))
        if errors.is_averaging:
            total += math.sqrt(2.0) * (np.cos(phase - turn) - np.cos(phase)) / turn
        else:
            total += math.sqrt(2.0) * np.sin(phase)
    return total


def _digitised(
    reading: Array, errors: InertialErrors, limit: float | None, quantum: float, rate_hz: float
) -> Array:
    """Return readings (N, 3) as they leave the sensor: filtered, clipped, in steps."""
    if errors.low_pass_hz is not None:
        reading = low_passed(reading, errors.low_pass_hz, rate_hz)
    if limit is not None:
        reading = np.clip(reading, -limit, limit)
    if not quantum:
        return reading
    if not errors.carries_rest:
        return np.asarray(quantum * np.round(reading / quantum))
    counted = np.round(np.cumsum(reading, axis=0) / quantum)
    return np.asarray(quantum * np.diff(counted, axis=0, prepend=0.0))


def errors_of(grade: Grade) -> InstrumentErrors:
    """Return the errors of all instruments of a vehicle with an IMU of a grade."""
    return InstrumentErrors(INERTIAL_ERRORS[grade])


SIMPLE: Final = InstrumentErrors(None, None, None, None)
"""Bias, walk and white noise, as stated."""


def stating(mission: Mission, errors: InstrumentErrors) -> Mission:
    """Return a mission that states what its instruments err in, as their data sheets would.

    What stays the same of an IMU is to be calibrated, the instability of its biases is its noise;
    slow errors of beams, fixes and depths are drifts.
    """
    imu, dvl, gnss, depth = mission.imu, mission.dvl, mission.gnss, mission.depth
    if errors.inertial:
        floors = errors.inertial.gyro_instability, errors.inertial.accel_instability
        noise = replace(
            imu.noise, gyro_bias_instability=floors[0], accel_bias_instability=floors[1]
        )
        imu = replace(imu, calibration=errors.inertial.asked, noise=noise)
    if errors.beams and errors.beams.slow:
        # Of a velocity along each axis of the instrument from beams that err each for itself.
        mount = dvl.mount
        x_sq, y_sq, z_sq = np.diagonal(np.linalg.inv(mount.beams_d.T @ mount.beams_d)).tolist()
        level = math.sqrt(0.5 * (x_sq + y_sq))
        drift = errors.beams.slow.drift(level * float(np.mean(dvl.sigma)))
        share = math.sqrt(z_sq) / level
        dvl = replace(dvl, mount=replace(mount, drift=drift, drift_z_share=share))
    if gnss and errors.gnss:
        east, north, up = np.sqrt(np.mean(gnss.sigma_enu**2, axis=0)).tolist()
        level = math.hypot(east, north) / math.sqrt(2.0)
        drifts = {"drift": errors.gnss.drift(level), "drift_up_share": up / level}
        gnss = replace(gnss, calibration=replace(gnss.calibration, **drifts))
    if depth and errors.depth:
        known_depth = replace(depth.calibration, drift=errors.depth.drift(depth.sigma))
        depth = replace(depth, calibration=known_depth)
    return replace(mission, imu=imu, dvl=dvl, gnss=gnss, depth=depth)
