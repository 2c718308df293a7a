"""A result folder as one object: read, redrawn, rescored, and asked for answers anywhere."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from ssm_graph.base.errors import ConfigError, DataError, MissingExtraError
from ssm_graph.base.frames import rotation_zyx
from ssm_graph.base.frozen import Array
from ssm_graph.base.times import nearest
from ssm_graph.base.units import DEG_PER_H, DEGREE, MICRO_G
from ssm_graph.evaluation.errors import Metrics, evaluate, reference_from_gnss, withhold_gnss
from ssm_graph.io.export.columns import wide_columns
from ssm_graph.io.export.track import Track, epoch_of, parse_epoch, track_of
from ssm_graph.io.mission_folder.folder import read_log, read_mission
from ssm_graph.io.mission_folder.toml import REFERENCE, read_mission_toml, table_path
from ssm_graph.io.results.states import STATES_NAME, read_states
from ssm_graph.io.results.summary import sha256
from ssm_graph.io.results.tables import read_aids, read_results, trajectory_columns
from ssm_graph.mission.estimate import (
    AidTable,
    BeamTable,
    CalibratedValue,
    Calibration,
    CurrentTrack,
    Estimate,
    Iteration,
    Status,
    Trajectory,
)
from ssm_graph.mission.fault import DetectedFault, Treatment
from ssm_graph.mission.mission import InitialState, Mission, Reference
from ssm_graph.mission.point import Point
from ssm_graph.mission.posterior import Posterior
from ssm_graph.sensors.dvl import DvlLog
from ssm_graph.sensors.dvl_instrument import DVL
from ssm_graph.sensors.imu import IMU, ImuLog
from ssm_graph.smoothers.between import Answers, answers_at, even_times

_ENU: Final = ("east", "north", "up")
_RPH: Final = ("roll", "pitch", "heading")
_XYZ: Final = ("x", "y", "z")
_UNITS: Final = {"_m_per_s": "m s-1", "_m": "m", "_deg": "degree", "_s": "s"}


class Result:
    """What ``smooth`` or ``filter`` left in a folder.

    ::

        result = sg.Result("RESULT")
        frame = result.to_dataframe(rate_hz=100.0, point="camera")
        data = result.to_xarray()
        print(result.rescore(reference).rmse_horizontal_m)

    Everything is read when it is first asked for.
    """

    def __init__(
        self, folder: Path | str, *, mission: Path | str | None = None, epoch: str | None = None
    ) -> None:
        """Open a folder.

        Parameters
        ----------
        folder : of ``ssm-graph smooth`` or ``filter``.
        mission : the mission folder that it was made of, where that has moved.
        epoch : UTC of ``time_s`` 0 in ISO 8601, where times are no Unix time.

        Raises :class:`DataError`: it is no result folder, or a file is damaged.
        """
        self.tables = read_results(Path(folder))
        """Its tables as they stand on disk, in the units of their columns."""
        self.summary = self.tables.summary
        """The content of ``summary.json``"""
        stated_s = None if epoch is None else parse_epoch(epoch)
        self.epoch_s = epoch_of(self.tables, stated_s)
        """Unix time of ``time_s`` 0, s; None where nobody knows."""
        self._stated_s = stated_s
        self._mission = None if mission is None else Path(mission)

    def __repr__(self) -> str:
        begin, end = self.tables.trajectory["time_s"][[0, -1]]
        return (
            f"Result({str(self.tables.folder)!r}: {self.summary.get('mission')}, "
            f"{self.summary.get('method')}, {self.status.name}, "
            f"{len(self.tables.trajectory['time_s'])} keyframes, {begin:.1f} to {end:.1f} s)"
        )

    @property
    def status(self) -> Status:
        """Why the estimator stopped, and whether to believe it."""
        return Status[str(self.summary.get("status"))]

    @property
    def mission_folder(self) -> Path:
        """The folder that it was made of.

        Raises :class:`ConfigError` where that is gone, or has other inertial data by their SHA-256.
        """
        inputs = self.summary.get("inputs") or {}
        folder = self._mission or Path(inputs.get("folder") or "")
        if folder == Path() or not folder.is_dir():
            raise ConfigError(
                f"--mission: expected the mission folder of this result, got {str(folder)!r}, "
                "which is none; say where it is"
            )
        toml = read_mission_toml(folder)
        path = table_path(toml, "imu")
        stated = (inputs.get("sha256") or {}).get(toml["imu"].text("file"))
        if path is not None and stated is not None and sha256(path) != stated:
            raise ConfigError(
                f"--mission: {path} is not the file that this result was made of (its "
                "SHA-256 differs); give the mission as it was, or smooth it again"
            )
        return folder

    @cached_property
    def mission(self) -> Mission:
        """The mission that it was made of."""
        return read_mission(self.mission_folder)

    @cached_property
    def _imu(self) -> ImuLog:
        log: ImuLog = read_log(read_mission_toml(self.mission_folder), IMU)
        return log

    @cached_property
    def posterior(self) -> Posterior:
        """States and covariances of all keyframes; raises :class:`DataError` without them."""
        return read_states(self.tables.folder)

    @cached_property
    def reference(self) -> Reference | None:
        """The reference of the mission, or the fixes that were withheld; None without either."""
        until_s = (self.summary.get("settings") or {}).get("gnss_until_s")
        if until_s is None:
            found: Reference | None = read_log(read_mission_toml(self.mission_folder), REFERENCE)
            return found
        _, withheld = withhold_gnss(self.mission, float(until_s))
        return reference_from_gnss(withheld, self.estimate.trajectory)

    @cached_property
    def altitude(self) -> tuple[Array, Array]:
        """Times (N,), s, and the DVL's heights over the bottom (N,), m; NaN where no beam says."""
        log: DvlLog | None = read_log(read_mission_toml(self.mission_folder), DVL)
        if log is None or log.range_m is None:
            return np.zeros(0), np.zeros(0)
        rows = self.tables.trajectory
        at = nearest(rows["time_s"], log.valid_s)
        roll, pitch, heading = (np.radians(rows[f"{name}_deg"][at]) for name in _RPH)
        return log.valid_s, log.altitude(rotation_zyx(heading, pitch, roll))

    @property
    def points(self) -> dict[str, Point]:
        """Points of the vehicle by name: ``[[point]]`` of ``mission.toml``, and instruments."""
        return read_mission_toml(self.mission_folder).points()

    def answers(
        self,
        time_s: ArrayLike | None = None,
        *,
        rate_hz: float | None = None,
        point: str | Point | None = None,
        covariance: bool = False,
        on_progress: Callable[[int, int, int], None] | None = None,
    ) -> Answers:
        """Return states where and when they are wanted, SI units and radians.

        Parameters
        ----------
        time_s : (N,) increasing times of the mission's clock, s; the keyframes when left out,
        rate_hz : or an even rate,
        point : of the vehicle, by name or as a value; the inertial unit when left out.
        covariance : whether the whole covariance is returned, too.
        on_progress : called with how many are done, were done before, and how many there are.
        """
        if time_s is not None and rate_hz is not None:
            raise ConfigError(
                "answers: expected time_s or rate_hz, got both; leave one of them out"
            )
        if rate_hz is not None:
            times = even_times(self.posterior, rate_hz)
        else:
            times = self.posterior.time_s if time_s is None else np.asarray(time_s, np.float64)
        return answers_at(
            self.posterior,
            self._imu,
            times,
            point=read_mission_toml(self.mission_folder).point(point)
            if isinstance(point, str)
            else point,
            wants_covariance=covariance,
            on_progress=on_progress,
        )

    def track(self, time_s: ArrayLike | None = None, **asked: Any) -> Track:
        """Return a track for :func:`ssm_graph.export_track`; parameters as of :meth:`answers`."""
        own = track_of(self.tables, epoch_s=self._stated_s)
        if time_s is None and not any(value for value in asked.values()):
            return own
        answers = self.answers(time_s, **asked)
        columns = {n: values for n, (values, _) in trajectory_columns(answers.trajectory).items()}
        at_keyframe = nearest(self.tables.trajectory["time_s"], columns["time_s"])
        if "suspect" in self.tables.trajectory:
            columns["suspect"] = self.tables.trajectory["suspect"][at_keyframe]
        return track_of(
            replace(self.tables, trajectory=columns),
            epoch_s=self._stated_s,
            covariance=answers.covariance,
            origin=own.frame,
        )

    def to_dataframe(self, time_s: ArrayLike | None = None, **asked: Any) -> Any:
        """Return a pandas ``DataFrame``: a row a time, every column with its unit in its name.

        Parameters as of :meth:`answers`. The index is UTC where that is known, else ``time_s``.
        """
        pandas = _optional("pandas")
        frame = pandas.DataFrame(wide_columns(self.track(time_s, **asked)))
        if "utc" not in frame:
            return frame.set_index("time_s")
        frame["utc"] = pandas.to_datetime(frame["utc"])
        return frame.set_index("utc")

    def to_xarray(self, time_s: ArrayLike | None = None, **asked: Any) -> Any:
        """Return an ``xarray.Dataset`` along ``time_s``, units as attributes, beams by ping.

        Parameters as of :meth:`answers`. ``beam_weight``, ``beam_innovation`` and
        ``beam_mahalanobis_sq`` are along ``ping_s`` and ``beam``, NaN where a beam was missing.
        """
        xarray = _optional("xarray")
        columns = wide_columns(self.track(time_s, **asked))
        time = columns.pop("time_s")
        utc = columns.pop("utc", None)
        found = {name: ("time_s", values, _attributes(name)) for name, values in columns.items()}
        data = xarray.Dataset(found, coords={"time_s": ("time_s", time, {"units": "s"})})
        if utc is not None:
            stamps = np.array([text[:-1] for text in utc], "datetime64[ns]")
            data = data.assign_coords(utc=("time_s", stamps))
        wanted = ("mission", "method", "kernel", "status", "reason")
        data.attrs = {name: str(self.summary.get(name)) for name in wanted}
        return data.assign(self._beam_variables()).assign_coords(self._beam_coordinates())

    def _beam_places(self) -> tuple[Array, Any, int]:
        """Return ping times, the ping of each row, and how many beams there are."""
        ping_s, ping = np.unique(self.tables.beams["time_s"], return_inverse=True)
        return ping_s, ping, int(np.max(self.tables.beams["beam"], initial=1.0))

    def _beam_coordinates(self) -> dict[str, Any]:
        ping_s, _, n_beams = self._beam_places()
        return {"ping_s": ("ping_s", ping_s, {"units": "s"}), "beam": np.arange(1, n_beams + 1)}

    def _beam_variables(self) -> dict[str, Any]:
        rows = self.tables.beams
        ping_s, ping, n_beams = self._beam_places()
        found = {}
        for name, unit in (("innovation_m_per_s", "m s-1"), ("mahalanobis_sq", ""), ("weight", "")):
            values = np.full((len(ping_s), n_beams), np.nan)
            values[ping, rows["beam"].astype(int) - 1] = rows[name]
            short = f"beam_{name.removesuffix('_m_per_s')}"
            found[short] = (("ping_s", "beam"), values, {"units": unit or "1"})
        return found

    @cached_property
    def estimate(self) -> Estimate:
        """The estimate, of what the folder holds of it: what was not finite is NaN."""
        of, summary = self.tables, self.summary
        iterations = tuple(
            Iteration(*(step[name] for name in ("update_sigmas", "weight_change", "kernel")))
            for step in summary.get("history") or ()
        )
        return Estimate(
            method=str(summary.get("method")),
            kernel=str(summary.get("kernel")),
            status=self.status,
            reason=str(summary.get("reason")),
            trajectory=self._trajectory(),
            beams=BeamTable(*(of.beams[name] for name in of.beams)),
            iterations=iterations,
            wall_s=float(summary.get("wall_seconds") or np.nan),
            cost=np.nan,
            start=_start(summary["start"]),
            notes=tuple(summary.get("notes") or ()),
            keyframe_iterations=float(summary.get("iterations") or np.nan),
            calibration=_calibration(summary.get("calibration") or {}),
            aids=_aids(read_aids(of.folder)),
            current=self._current(),
            faults=tuple(_fault(fault) for fault in summary.get("faults") or ()),
            posterior=self.posterior if (of.folder / STATES_NAME).is_file() else None,
        )

    def _trajectory(self) -> Trajectory:
        rows = self.tables.trajectory
        sigma = _columns(rows, "sigma_{}_m", _ENU)
        covariance = sigma[:, :, None] * np.eye(3) * sigma[:, None, :]
        if (self.tables.folder / STATES_NAME).is_file():
            posterior = self.posterior
            R_lb = np.swapaxes(posterior.frame.R_nl_at(posterior.p_n), 1, 2) @ posterior.R_nb
            covariance = R_lb @ posterior.covariance[:, 3:6, 3:6] @ R_lb.mT
        return Trajectory(
            time_s=rows["time_s"],
            lat=np.radians(rows["lat_deg"]),
            lon=np.radians(rows["lon_deg"]),
            height=rows["height_m"],
            velocity_enu=_columns(rows, "vel_{}_m_per_s", _ENU),
            roll_pitch_heading=np.radians(_columns(rows, "{}_deg", _RPH)),
            gyro_bias=_columns(rows, "gyro_bias_{}_deg_per_h", _XYZ) * DEG_PER_H,
            accel_bias=_columns(rows, "accel_bias_{}_ug", _XYZ) * MICRO_G,
            position_cov_enu=covariance,
            velocity_sigma_enu=_columns(rows, "sigma_vel_{}_m_per_s", _ENU),
            attitude_sigma=np.radians(_columns(rows, "sigma_{}_deg", _RPH)),
            n_beams=rows["n_beams"],
        )

    def _current(self) -> CurrentTrack | None:
        rows = self.tables.trajectory
        if "current_east_m_per_s" not in rows:
            return None
        sigma = _columns(rows, "sigma_current_{}_m_per_s", _ENU)
        covariance = sigma[:, :, None] * np.eye(3) * sigma[:, None, :]
        velocity = _columns(rows, "current_{}_m_per_s", _ENU)
        return CurrentTrack(rows["time_s"], velocity, covariance)

    def rescore(self, reference: Reference | None = None) -> Metrics:
        """Compare with a reference anew; that of the mission when left out.

        Raises :class:`DataError` where there is none.
        """
        reference = reference or self.reference
        if reference is None:
            raise DataError(
                f"{self.tables.folder}: the mission has no reference; hand one over, "
                "rescore(reference)"
            )
        return evaluate(self.estimate.trajectory, reference)

    def redraw(self, path: Path | str, reference: Reference | None = None) -> None:
        """Draw the figure anew; the ending of ``path`` decides the format: .png, .pdf, .svg."""
        from ssm_graph.report.mission.figure import save_figure

        save_figure(path, self.estimate, reference, title=str(self.summary.get("mission")))


def _optional(name: str) -> Any:
    try:
        return import_module(name)
    except ImportError as error:
        raise MissingExtraError(name, extra="xarray", purpose=f"a result in {name}") from error


def _attributes(name: str) -> dict[str, str]:
    """Return the unit of a column by its name."""
    unit = next((u for end, u in _UNITS.items() if name.endswith(end)), "1")
    return {"units": "" if name.startswith("cov_") else unit}


def _columns(rows: Any, pattern: str, names: tuple[str, ...]) -> Array:
    return np.column_stack([rows[pattern.format(name)] for name in names])


def _start(fields: Any) -> InitialState:
    lat, lon, roll, pitch, heading = (
        float(np.radians(fields[f"{name}_deg"])) for name in ("lat", "lon", *_RPH)
    )
    return InitialState(
        time_s=float(fields["time_s"]),
        lat=lat,
        lon=lon,
        height=float(fields["height_m"]),
        roll=roll,
        pitch=pitch,
        heading=heading,
        velocity_enu=fields["vel_enu_m_per_s"],
        position_sigma_enu=fields["position_sigma_m"],
        velocity_sigma_enu=fields["velocity_sigma_m_per_s"],
        attitude_sigma=np.radians(fields["attitude_sigma_deg"]),
    )


def _calibration(found: Any) -> Calibration | None:
    """Return what was found of the instruments, in the units of the labels."""
    values = tuple(
        CalibratedValue(label, label, 1.0, of["value"], of["sigma"], of["prior_sigma"])
        for label, of in found.items()
    )
    if not values:
        return None
    return Calibration(values, np.diag([v.sigma**2 for v in values]), np.zeros((0, 0)))


def _aids(columns: dict[str, Any]) -> AidTable | None:
    if not columns:
        return None
    unit = np.array([DEGREE if unit == "deg" else 1.0 for unit in columns["unit"]])
    return AidTable(
        aid=tuple(columns["aid"]),
        component=tuple(columns["component"]),
        unit=tuple("rad" if u == "deg" else u for u in columns["unit"]),
        time_s=columns["time_s"],
        innovation=columns["innovation"] * unit,
        mahalanobis_sq=columns["mahalanobis_sq"],
        weight=columns["weight"],
    )


def _fault(fields: Any) -> DetectedFault:
    return DetectedFault(
        sensor=fields["sensor"],
        what=fields["what"],
        begin_s=fields["begin_s"],
        end_s=fields["end_s"],
        chi_sq=np.inf if fields["chi_square"] is None else fields["chi_square"],
        dof=fields["degrees_of_freedom"],
        treatment=Treatment[fields["treatment"].upper()],
        rivals=tuple(fields["rivals"]),
        cost_m=np.nan if fields["cost_m"] is None else fields["cost_m"],
        remedy=fields["remedy"],
    )
