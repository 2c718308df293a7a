"""A DVL as a section, a table and a live message: any number of beams, in any directions.

An instrument that gives a velocity alone has three beams, its axes, and may state the covariance of
their speeds in every ping: columns ``cov11_m2_per_s2``, ``cov12_m2_per_s2`` and so on, the upper
triangle, numbered as the beams are. It counts along the principal axes of that covariance, see
:meth:`~ssm_graph.sensors.dvl.DvlLog.independent`; live, by the sigmas of its beams.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np

from ssm_graph.base.errors import DataError
from ssm_graph.base.frames import BodyAxes
from ssm_graph.base.frozen import Array
from ssm_graph.base.settings import (
    FILE_KEY,
    LEVER_ARM_KEY,
    Key,
    Settings,
    build,
    optional_key,
    sigma_key,
    written,
)
from ssm_graph.base.tables import Table
from ssm_graph.base.units import DEGREE, PER_SQRT_H, in_unit
from ssm_graph.sensors import dvl_readings as readings
from ssm_graph.sensors.drift import ARM_SIGMA, drift_keys, late_keys, share_key
from ssm_graph.sensors.dvl import (
    MOST_BEAMS,
    DvlLog,
    DvlMount,
    Ping,
    R_bd_from_rpy,
    beams_from_angles,
    counted_sigma,
    empty_dvl,
    nominal_sigma,
    rpy_from_R_bd,
    sigma_off_water,
)
from ssm_graph.sensors.instrument import (
    SMALLEST_SIGMA,
    Calibrated,
    Column,
    Instrument,
    Lists,
    compounded,
    read_columns,
)
from ssm_graph.sensors.messages import Message

MOST_CORRELATED: Final = 3
"""Beams of an instrument that states the covariance of their speeds: a velocity along its axes."""
_UNIT_TOLERANCE: Final = 1e-3
_FLATTEST_GEOMETRY: Final = 0.01
"""Least singular value of directions that measure every component of a velocity."""
_BEAMS: Final = (1, MOST_BEAMS)
_PERCENT: Final = "1 percent is 0.01"
_START_OF_WALK: Final = (
    "expected with a scale_sigma above 0, the sigma at the start, got none; 0.01 is 1 percent"
)
_SPEED_UNIT: Final = "the unit is m/s, not mm/s"

_SPEED: Final = Column(
    "speed",
    "beam{}_m_per_s",
    limits=(-readings.LARGEST_SPEED, readings.LARGEST_SPEED),
    expected=f"expected m/s, up to {readings.LARGEST_SPEED:g}; {readings.LEAVE_EMPTY}",
    blank=True,
    is_many=True,
    json="beam_m_per_s",
)
_SIGMA: Final = Column(
    "sigma",
    "beam{}_sigma_m_per_s",
    limits=(SMALLEST_SIGMA, 1e3),
    expected="expected a standard deviation above 0, in m/s; leave the cell empty to use "
    "beam_noise_m_per_s",
    told="sigmas {} m/s, expected above zero",
    optional=True,
    is_many=True,
    json="sigma_m_per_s",
)
_RANGE: Final = Column(
    "range_m",
    "range{}_m",
    limits=(0.0, math.inf),
    expected="expected metres, not below 0; leave the cell empty where it is unknown",
    optional=True,
    is_many=True,
    is_live=False,
)
_WATER: Final = Column(
    "water_track",
    "water_track",
    limits=(0.0, 1.0),
    expected="expected 1 for a ping off the water, 0 or nothing for one off the ground",
    optional=True,
    missing=0.0,
    is_flag=True,
    message_field="is_water",
)
_KEYS: Final = {
    "file": FILE_KEY,
    "beam_azimuth_deg": Key(shape=(_BEAMS,), low=-360.0, high=360.0, required=False, unit=DEGREE),
    "beam_janus_deg": sigma_key(
        *("", 45.0, "it is counted from the vertical; the horizontal angle is 90 minus this"),
        required=False,
        unit=DEGREE,
    ),
    "beam_vectors": Key(shape=(_BEAMS, 3), required=False),
    "beam_noise_m_per_s": sigma_key("", 5.0, _SPEED_UNIT),
    "lever_arm_m": replace(LEVER_ARM_KEY, field="mount.lever_arm_b"),
    "mounting_rpy_deg": Key(shape=(3,), low=-360.0, high=360.0, unit=DEGREE),
    "misalignment_sigma_deg": optional_key(
        "mount.misalignment_sigma", 0.0, 45.0, "the unit is degrees", unit=DEGREE
    ),
    "scale_sigma": optional_key("mount.scale_sigma", 0.0, 1.0, _PERCENT),
    **late_keys("mount"),
    "scale_error": optional_key("mount.scale_error", -0.5, 0.5, _PERCENT),
    "scale_walk_per_sqrt_h": optional_key(
        *("mount.scale_walk_density", 0.0, 1.0, "1 percent in an hour is 0.01"),
        unit=PER_SQRT_H,
        beside=("scale_sigma", _START_OF_WALK),
    ),
    "beam_scale_error": optional_key(
        "mount.beam_scale_error", -0.5, 0.5, _PERCENT, shape=(_BEAMS,)
    ),
    "beam_scale_sigma": optional_key("mount.beam_scale_sigma", 0.0, 1.0, _PERCENT),
    "lever_arm_sigma_m": optional_key("mount.lever_arm_sigma", *ARM_SIGMA),
    "water_noise_m_per_s": sigma_key("", 5.0, _SPEED_UNIT, required=False),
    **drift_keys("drift_sigma_m_per_s", "mount.drift", 5.0, _SPEED_UNIT),
    "drift_z_share": share_key(
        "mount.drift_z_share", "drift_sigma_m_per_s", "four beams at 30 degrees make it 0.41"
    ),
}


class _Dvl(Instrument):
    """The way of a DVL: as many columns as it has beams, and sigmas that differ off the water."""

    def bare(self, settings: Settings, lists: Lists) -> DvlLog:  # noqa: ARG002
        beams_d = _beams_d(settings)
        key, n_beams = "beam_scale_error", len(beams_d)
        if key in settings and len(settings.array(key)) != n_beams:
            got = len(settings.array(key))
            raise settings.fault(key, f"expected {n_beams} numbers, one of each beam, got {got}")
        given = {name.removeprefix("mount."): value for name, value in settings.given().items()}
        R_bd = R_bd_from_rpy(np.asarray(settings.si("mounting_rpy_deg")))
        mount = build(DvlMount, {"beams_d": beams_d, "R_bd": R_bd, **given})
        return empty_dvl(mount)

    def columns_of(self, bare: DvlLog) -> tuple[Column, ...]:
        n_beams = bare.mount.n_beams
        many = (_SPEED.sized(n_beams), _SIGMA.sized(n_beams), _RANGE.sized(n_beams))
        pairs = _pairs(n_beams) if n_beams <= MOST_CORRELATED else []
        covariance = (Column("", name, optional=True, is_live=False) for *_, name in pairs)
        return (*many, _WATER, *covariance)

    def check(self, table: Table, bare: DvlLog, axes: BodyAxes) -> list[str]:  # noqa: ARG002
        notes = _geometry_note(bare.mount, table.label)
        speed, *others = self.columns_of(bare)
        flag = table.stack(_WATER.names)[:, 0]
        if len(flag):
            for column in others:
                column.beyond(table)
            _check_flags(table, flag)
            _check_covariance(table, bare)
        return notes + readings.check_speeds(table, speed, flag > 0.0)

    def filled(self, table: Table, bare: DvlLog, settings: Settings, axes: BodyAxes) -> DvlLog:
        rows = read_columns(table, [c for c in self.columns_of(bare) if c.field], axes)
        covariance = _covariance(table, bare)
        if covariance is not None:
            stated = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
            rows["sigma"] = np.where(np.isnan(stated), rows["sigma"], stated)
        water = rows["water_track"]
        has_range = any(name in table.columns for name in _RANGE.sized(bare.mount.n_beams).names)
        log = DvlLog(
            mount=bare.mount,
            time_s=table.time_s,
            speed=rows["speed"],
            sigma=counted_sigma(
                rows["sigma"],
                water > 0.0,
                ground_sigma=settings.number("beam_noise_m_per_s"),
                water_sigma=settings.number("water_noise_m_per_s"),
            ),
            range_m=rows["range_m"] if has_range else None,
            water_track=water if water.any() else None,
            covariance=covariance,
        )
        return self.cleaned(log)

    def cleaned(self, log: DvlLog) -> DvlLog:
        return replace(log, speed=readings.without_false_speeds(log.speed, log.is_water))

    def without_rows(self, log: DvlLog) -> DvlLog:
        return empty_dvl(log.mount)

    def settings_of(self, log: DvlLog) -> dict[str, Any]:
        found = {
            "beam_vectors": log.mount.beams_d.tolist(),
            "beam_noise_m_per_s": nominal_sigma(log),
            "mounting_rpy_deg": _mounting(log.mount),
            **written(log, self.keys),
        }
        if log.is_water.any():
            found["water_noise_m_per_s"] = sigma_off_water(log)
        return found

    def table_of(self, log: DvlLog) -> dict[str, Array]:
        columns = {"time_s": log.time_s, **_SPEED.sized(log.mount.n_beams).written(log.speed)}
        nominal = np.full(log.sigma.shape, nominal_sigma(log))
        if log.is_water.any():
            nominal[log.is_water] = sigma_off_water(log)
        if log.covariance is not None:
            for i, j, name in _pairs(log.mount.n_beams):
                columns[name] = log.covariance[:, i, j]
        elif np.any(log.sigma != nominal):
            columns |= _SIGMA.sized(log.mount.n_beams).written(log.sigma)
        if log.range_m is not None:
            columns |= _RANGE.sized(log.mount.n_beams).written(log.range_m)
        if log.water_track is not None:
            columns |= _WATER.written(log.water_track)
        return columns

    def live_columns(self, bare: DvlLog) -> tuple[Column, ...]:
        return (_SPEED.sized(bare.mount.n_beams), _SIGMA.sized(bare.mount.n_beams), _WATER)

    def numbers(self, message: Message) -> list[float]:
        assert isinstance(message, Ping)
        sigma = message.sigma or (math.nan,) * len(message.speed)
        return [message.time_s, *message.speed, *sigma, float(message.is_water)]

    def message_of(self, numbers: Sequence[float], bare: DvlLog) -> Ping:
        n_beams = bare.mount.n_beams
        speed, sigma = tuple(numbers[1 : 1 + n_beams]), tuple(numbers[1 + n_beams : -1])
        has_sigma = not all(math.isnan(x) for x in sigma)
        return Ping(numbers[0], speed, sigma if has_sigma else None, is_water=numbers[-1] > 0.0)

    def messages_of(self, log: DvlLog) -> Iterator[Message]:
        water = log.is_water.astype(float)
        return super().messages_of(replace(log, water_track=water))

    def problem(self, message: Message, bare: DvlLog) -> str | None:
        assert isinstance(message, Ping)
        if len(message.speed) != bare.mount.n_beams:
            return f"{len(message.speed)} beams, expected the vehicle's {bare.mount.n_beams}"
        if message.sigma is not None and len(message.sigma) != bare.mount.n_beams:
            return f"{len(message.sigma)} sigmas of {bare.mount.n_beams} beams"
        return None

    def sifted(
        self, message: Message, near: Array, bare: DvlLog
    ) -> tuple[Message, tuple[str, str] | None]:
        """Return the ping without beams that no beam can have measured, and why they are left out.

        A copy of a report keeps its speeds, with infinite sigmas: the next copy has to be known.
        """
        assert isinstance(message, Ping)
        n_beams = bare.mount.n_beams
        speed = np.array(message.speed)
        none = (math.nan,) * n_beams
        if np.isnan(speed).all():
            return replace(message, speed=none), None
        if readings.no_lock(speed[None])[0]:
            return replace(message, speed=none), ("no_lock", "0 m/s in all beams: no bottom lock")
        if readings.identical_beams(speed[None])[0]:
            text = f"{readings.COUNTS[n_beams]} beams of {speed[0]:g} m/s each"
            return replace(message, speed=none), ("identical_beams", text)
        same_track = near[near[:, -1] == float(message.is_water), 1 : 1 + n_beams]
        if any(np.array_equal(other, speed, equal_nan=True) for other in same_track):
            text = f"the speeds {message.speed} m/s once more"
            return replace(message, sigma=(math.inf,) * n_beams), ("repeated_speeds", text)
        beyond = np.abs(speed) > readings.LARGEST_SPEED
        if beyond.any():
            kept = tuple(np.where(beyond, math.nan, speed).tolist())
            text = f"beam speeds {message.speed} m/s: a wrong unit?"
            return replace(message, speed=kept), ("implausible", text)
        return message, None


def _turned_further(log: DvlLog, _: float | Array, off: Array) -> Array:
    """Return roll, pitch and yaw of an instrument that is turned about its own axes, radians."""
    from scipy.spatial.transform import Rotation

    return rpy_from_R_bd(log.mount.R_bd @ Rotation.from_rotvec(off).as_matrix())


DVL: Final = _Dvl(
    "dvl",
    DvlLog,
    _KEYS,
    (_SPEED, _SIGMA, _RANGE, _WATER),
    Ping,
    "d",
    late="mount.time_offset_s",
    calibrated={
        "dvl_mounting": Calibrated("mounting_rpy_deg", "misalignment_sigma_deg", _turned_further),
        "dvl_scale": Calibrated("scale_error", "scale_sigma", compounded),
        "dvl_beam_scale": Calibrated("beam_scale_error", "beam_scale_sigma", compounded),
        "dvl_lever_arm": Calibrated("lever_arm_m", "lever_arm_sigma_m"),
        "dvl_time_offset": Calibrated("time_offset_s", "time_offset_sigma_s"),
    },
    is_required=True,
)


def _beams_d(settings: Settings) -> Array:
    """Return the directions (B, 3) that a section states; raise where they measure no velocity."""
    angles = ("beam_azimuth_deg", "beam_janus_deg")
    given = [key for key in angles if key in settings]
    if "beam_vectors" in settings and given:
        raise settings.fault("beam_vectors", f"given together with {given[0]}; keep one of the two")
    if "beam_vectors" not in settings and len(given) < len(angles):
        missing = next(key for key in angles if key not in settings)
        raise settings.fault(
            missing,
            "the key is missing; expected beam_azimuth_deg with beam_janus_deg, or beam_vectors",
        )
    if given:
        key = "beam_azimuth_deg"
        azimuth, janus = settings.si(key), settings.si("beam_janus_deg")
        beams = beams_from_angles(np.asarray(azimuth), float(janus))
    else:
        key = "beam_vectors"
        beams = settings.array(key)
        length = np.linalg.norm(beams, axis=1)
        for row in np.flatnonzero(np.abs(length - 1.0) > _UNIT_TOLERANCE):
            raise settings.fault(
                key, f"expected unit vectors, got length {length[row]:.6g} for beam {row + 1}"
            )
        beams = beams / length[:, None]
    if len(beams) >= 3 and rank_of(beams) < 3:
        raise settings.fault(
            key,
            f"the beams lie in one plane and cannot measure a velocity; expected "
            f"{readings.COUNTS[len(beams)]} different directions around the vertical",
        )
    return beams


def rank_of(beams_d: Array) -> int:
    """Return how many components of a velocity directions (B, 3) measure."""
    sizes = np.linalg.svd(beams_d, compute_uv=False)
    return int(np.sum(sizes > _FLATTEST_GEOMETRY))


def _geometry_note(mount: DvlMount, label: str) -> list[str]:
    if mount.n_beams >= 3:
        return []
    rank = rank_of(mount.beams_d)
    return [
        f"{label}: {readings.COUNTS[mount.n_beams]} beam{'s' * (mount.n_beams > 1)} measure"
        f"{'s' * (mount.n_beams == 1)} {readings.COUNTS[rank]} of three components of the velocity;"
        " the others come from the inertial sensors alone"
    ]


def _mounting(mount: DvlMount) -> list[float]:
    """Return the mounting in degrees; raise where it is no rotation."""
    rpy = rpy_from_R_bd(mount.R_bd)
    if not np.allclose(R_bd_from_rpy(rpy), mount.R_bd, rtol=0.0, atol=1e-9):
        raise DataError(f"DvlMount.R_bd: expected a rotation matrix, got {mount.R_bd.tolist()}")
    return [in_unit(float(angle), DEGREE) for angle in rpy]


def _check_flags(table: Table, flag: Array) -> None:
    """Refuse a flag that is neither yes nor no."""
    bad = np.isfinite(flag) & (flag != 0.0) & (flag != 1.0)
    if bad.any():
        raise table.cell_fault(int(np.argmax(bad)), _WATER.pattern, _WATER.expected)


def _pairs(n_beams: int) -> list[tuple[int, int, str]]:
    """Return the columns of a covariance and their places: the upper triangle."""
    return [
        (i, j, f"cov{i + 1}{j + 1}_m2_per_s2") for i in range(n_beams) for j in range(i, n_beams)
    ]


def _covariance(table: Table, bare: DvlLog) -> Array | None:
    """Return the covariances (N, B, B) that a table states, NaN in pings without; None for none."""
    n_beams = bare.mount.n_beams
    pairs = _pairs(n_beams) if n_beams <= MOST_CORRELATED else []
    if not any(name in table.columns for _, _, name in pairs):
        return None
    found = np.full((len(table.time_s), n_beams, n_beams), np.nan)
    for (i, j, _), cells in zip(pairs, table.stack([name for *_, name in pairs]).T, strict=True):
        found[:, i, j] = found[:, j, i] = cells
    return found


def _check_covariance(table: Table, bare: DvlLog) -> None:
    """Refuse what is no covariance, and sigmas beside it."""
    covariance = _covariance(table, bare)
    if covariance is None:
        return
    sigmas = [name for name in _SIGMA.sized(bare.mount.n_beams).names if name in table.columns]
    if sigmas:
        raise DataError(
            f"{table.label}: columns {sigmas[0]!r} and 'cov11_m2_per_s2' stand together; expected "
            "one of them: the covariance has the sigmas on its diagonal"
        )
    if bare.mount.beam_scale_sigma or bare.mount.beam_scale_error is not None:
        raise DataError(
            f"{table.label}: speeds with a covariance count along its axes, not along beams; "
            "expected no beam_scale_error and no beam_scale_sigma; state scale_error instead"
        )
    whole = np.isfinite(covariance).all(axis=(1, 2))
    least = np.full(len(covariance), np.inf)
    least[whole] = np.linalg.eigvalsh(covariance[whole])[:, 0]
    least = np.minimum(
        least, np.nan_to_num(np.diagonal(covariance, axis1=1, axis2=2), nan=1.0).min(axis=1)
    )
    if (least <= SMALLEST_SIGMA**2).any():
        row = int(np.argmax(least <= SMALLEST_SIGMA**2))
        raise table.fault(
            row,
            "columns 'cov11_m2_per_s2' and so on hold no covariance: expected variances above 0 "
            "and correlations below 1, in m^2/s^2; leave the cells empty where it is unknown",
        )
