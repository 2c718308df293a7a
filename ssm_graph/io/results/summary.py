"""The content of ``summary.json``: how an estimate came about and how good it is."""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Mapping, Sequence
from enum import Enum
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Final, Protocol

import numpy as np

from ssm_graph.base.errors import DataError
from ssm_graph.base.settings import written
from ssm_graph.io.mission_folder.toml import (
    INITIAL_KEYS,
    TABLES,
    TOML_NAME,
    read_mission_toml,
)
from ssm_graph.mission.estimate import (
    OUTLIER_WEIGHT,
    AidTable,
    Calibration,
    CurrentTrack,
    Estimate,
    Trajectory,
    path_length_m,
)
from ssm_graph.mission.fault import DetectedFault
from ssm_graph.mission.mission import Mission

PACKAGES: Final = ("ssm_graph", "gtsam", "numpy", "scipy")
"""Names in the summary; distributions have hyphens."""


class MetricsLike(Protocol):
    """What a summary needs of `ssm_graph.evaluation.Metrics`."""

    def summary_fields(self) -> dict[str, Any]: ...  # noqa: D102


def build_summary(
    estimate: Estimate,
    *,
    mission: Mission,
    metrics: MetricsLike | None,
    settings: Mapping[str, Any],
) -> dict[str, Any]:
    """Return the summary of an estimate, ready for strict JSON: what is not finite is None.

    With a reference, ``path_length_m`` is the part that was compared, on which ``drift_percent``
    rests; ``total_path_length_m`` is always that of the whole trajectory.
    """
    trajectory, beams = estimate.trajectory, estimate.beams
    total_path = path_length_m(trajectory)
    summary = {
        "mission": mission.name,
        "method": estimate.method,
        "kernel": estimate.kernel,
        "status": estimate.status.name,
        "status_text": estimate.status.value,
        "is_good": estimate.status.is_good,
        "reason": estimate.reason,
        "iterations": estimate.n_iterations,
        "wall_seconds": estimate.wall_s,
        "n_keyframes": len(trajectory.time_s),
        "n_beams": len(beams.time_s),
        "n_outliers": int(np.sum(beams.weight < OUTLIER_WEIGHT)),
        "outlier_weight": OUTLIER_WEIGHT,
        "duration_s": float(np.ptp(trajectory.time_s)) if len(trajectory.time_s) else 0.0,
        "path_length_m": total_path,
        "total_path_length_m": total_path,
        "final": _final(trajectory),
        "start": {
            **written(estimate.start, INITIAL_KEYS),
            "heading_deg": np.rad2deg(estimate.start.heading) % 360.0,
            "origin": _start_origin(mission),
        },
        **({} if mission.local is None else {"local_start": mission.local.sentence}),
        "calibration": calibration_fields(estimate.calibration),
        "noise": _noise(estimate),
        **({"aids": _aids(estimate.aids)} if estimate.aids is not None else {}),
        "current": current_fields(estimate.current),
        "faults": [fault_fields(fault) for fault in estimate.faults],
        **(metrics.summary_fields() if metrics is not None else {}),
        "settings": settings,
        "history": [
            {name: getattr(step, name) for name in ("update_sigmas", "weight_change", "kernel")}
            for step in estimate.iterations
        ],
        "notes": estimate.notes,
        "mission_notes": mission.notes,
        "versions": versions(),
    }
    return {key: as_json(value) for key, value in summary.items()}


def _start_origin(mission: Mission) -> str:
    """Return where a start is from, in a word."""
    if mission.initial is not None:
        return "mission"
    return "alignment" if mission.local is None else "local"


def input_fields(folder: Path) -> dict[str, Any]:
    """Return where a mission is, and the SHA-256 of every file that ``mission.toml`` names."""
    toml = read_mission_toml(folder)
    names = [toml[one.section].text("file") for one in TABLES if one.section in toml]
    files = [TOML_NAME, *(name for name in dict.fromkeys(names) if (folder / name).is_file())]
    return {"folder": str(folder.resolve()), "sha256": {n: sha256(folder / n) for n in files}}


def sha256(path: Path) -> str:
    """Return the SHA-256 of a file, in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def versions() -> dict[str, str | None]:
    """Return the versions of everything that makes the numbers; None for what is not installed."""
    found: dict[str, str | None] = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = version(name.replace("_", "-"))
        except PackageNotFoundError:
            found[name] = None
    return found


def as_json(value: Any) -> Any:
    """Return ``value`` made of strict JSON's types; infinite and NaN become None."""
    if isinstance(value, Mapping):
        return {str(key): as_json(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return as_json(value.tolist())
    if isinstance(value, Enum):
        return value.name
    if isinstance(value, bool | int | str) or value is None:
        return value
    if isinstance(value, float):
        return value if np.isfinite(value) else None
    if isinstance(value, Sequence | set | frozenset):
        return [as_json(item) for item in value]
    return str(value)


def calibration_fields(calibration: Calibration | None) -> dict[str, Any]:
    """Return what was found of the instruments, by label, in the label's unit."""
    if calibration is None:
        return {}
    return {
        value.label: {
            "value": value.value / value.unit,
            "sigma": value.sigma / value.unit,
            "prior_sigma": value.prior_sigma / value.unit,
            "determined": value.determined.name.lower(),
        }
        for value in calibration.values
    }


def fault_fields(fault: DetectedFault) -> dict[str, Any]:
    """Return which sensor was off, when, how, and what became of it."""
    return {
        "sensor": fault.sensor,
        "what": fault.what,
        "begin_s": fault.begin_s,
        "end_s": fault.end_s,
        "chi_square": fault.chi_sq,
        "degrees_of_freedom": fault.dof,
        "treatment": fault.treatment.name.lower(),
        "rivals": fault.rivals,
        "cost_m": fault.cost_m,
        "remedy": fault.remedy,
        "is_suspect": fault.is_suspect,
    }


def _aids(aids: AidTable) -> dict[str, Any]:
    """Return how many measurements each further aid had, and how many had hardly any weight."""
    return {
        name: {"n_measurements": count, "n_outliers": outliers}
        for name, (count, outliers) in aids.counts().items()
    }


def _noise(estimate: Estimate) -> dict[str, Any]:
    """Return the noise found, by beam, over the stated one; of the inertial data the test."""
    noise = estimate.noise
    if noise is None:
        return {}
    return {
        "beam_sigma_estimated_over_stated": noise.beam_factor,
        "beam_sigma_used_over_stated": noise.beam_used,
        "beam_degrees_of_freedom": noise.beam_dof,
        "inertial_chi_square": noise.inertial_chi_sq,
        "inertial_degrees_of_freedom": noise.inertial_dof,
    }


def current_fields(current: CurrentTrack | None) -> dict[str, Any]:
    """Return what was found of the current: means, the largest, and how well it is known."""
    if current is None:
        return {}
    return {
        "mean_enu_m_per_s": current.velocity_enu.mean(axis=0),
        "largest_m_per_s": np.linalg.norm(current.velocity_enu[:, :2], axis=1).max(),
        "mean_sigma_enu_m_per_s": current.sigma_enu.mean(axis=0),
        "final_enu_m_per_s": current.velocity_enu[-1],
        "final_sigma_enu_m_per_s": current.sigma_enu[-1],
    }


def _final(trajectory: Trajectory) -> dict[str, Any]:
    """Return the last keyframe's uncertainty and its place."""
    if len(trajectory.time_s) == 0:
        return {}
    variance = np.maximum(np.diagonal(trajectory.position_cov_enu[-1]), 0.0)
    return {
        "time_s": trajectory.time_s[-1],
        "lat_deg": np.rad2deg(trajectory.lat[-1]),
        "lon_deg": np.rad2deg(trajectory.lon[-1]),
        "height_m": trajectory.height[-1],
        "position_sigma_m": np.sqrt(variance),
        "velocity_sigma_m_per_s": trajectory.velocity_sigma_enu[-1],
        "attitude_sigma_deg": np.rad2deg(trajectory.attitude_sigma[-1]),
    }


_KINDS: Final[Mapping[str, type]] = {
    **dict.fromkeys(("final", "start", "calibration", "noise", "aids", "current"), dict),
    **dict.fromkeys(("inside_3_sigma", "settings", "versions", "inputs"), dict),
    **dict.fromkeys(("faults", "history", "notes", "mission_notes"), list),
    **dict.fromkeys(("duration_s", "total_path_length_m", "rmse_horizontal_m"), float),
    **dict.fromkeys(("n_beams", "n_outliers"), int),
}
"""Of what a summary says, where it says it."""
_CALLED: Final = {dict: "an object", list: "a list", float: "a number", int: "a whole number"}


def check_summary(summary: Mapping[str, Any], path: Path) -> None:
    """Raise :class:`DataError` where a summary that was read says something of another kind."""
    for name, kind in _KINDS.items():
        value = summary.get(name)
        is_whole = kind is float and isinstance(value, int)
        if value is not None and not isinstance(value, kind) and not is_whole:
            raise DataError(
                f"{path}: key {name!r}: expected {_CALLED[kind]}, got {str(value)[:40]!r}; was it "
                "edited?"
            )
