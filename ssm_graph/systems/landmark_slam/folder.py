"""A folder of one's own log: ``landmarks.toml`` and tables of odometry, observations, truth."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
import tomli_w
from numpy.typing import NDArray

from ssm_graph.base.errors import ConfigError
from ssm_graph.base.frozen import Array
from ssm_graph.base.settings import (
    FILE_KEY,
    Key,
    Settings,
    number_key,
    read_settings,
    read_toml,
)
from ssm_graph.base.tables import Table, TableSpec
from ssm_graph.base.units import DEGREE
from ssm_graph.io.tables.append_file import write_through
from ssm_graph.io.tables.files import read_table, write_table
from ssm_graph.systems.landmark_slam.logs import LandmarkLog
from ssm_graph.systems.landmark_slam.problem import (
    UNKNOWN,
    SlamEstimate,
    SlamNoise,
    SlamProblem,
)

TOML_NAME: Final = "landmarks.toml"
FORMAT: Final = 1
_SIGMA: Final[dict[str, Any]] = {"positive": True}
ODOMETRY_KEYS: Final[Mapping[str, Key]] = {
    "file": FILE_KEY,
    "speed_noise_m_per_sqrt_s": Key(high=10.0, hint="0.02 is a wheeled robot", **_SIGMA),
    "side_noise_m_per_sqrt_s": Key(high=10.0, hint="0.01 is a wheeled robot", **_SIGMA),
    "turn_noise_deg_per_sqrt_s": Key(high=90.0, hint="2 is a wheeled robot", **_SIGMA),
}
OBSERVATION_KEYS: Final[Mapping[str, Key]] = {
    "file": FILE_KEY,
    "range_sigma_m": Key(high=1e3, required=False, **_SIGMA),
    "range_sigma_share": Key(high=1.0, required=False, hint="0.05 is 5 % of it", **_SIGMA),
    "bearing_sigma_deg": Key(high=90.0, hint="the unit is degrees", **_SIGMA),
}
TRUTH_KEYS: Final[Mapping[str, Key]] = {"file": FILE_KEY}
TOP_KEYS: Final[Mapping[str, Key]] = {"format": number_key("", FORMAT, FORMAT)}
ODOMETRY: Final = TableSpec(
    ("time_s", "speed_m_per_s", "turn_rate_deg_per_s"), ("side_speed_m_per_s",)
)
OBSERVATIONS: Final = TableSpec(
    ("time_s", "range_m", "bearing_deg"),
    ("landmark",),
    blank=frozenset({"range_m", "bearing_deg"}),
    key=("landmark", "range_m", "bearing_deg"),
)
TRUTH: Final = TableSpec(("time_s", "x_m", "y_m"), ("heading_deg",))
SECTIONS: Final = {"odometry": ODOMETRY_KEYS, "observations": OBSERVATION_KEYS, "truth": TRUTH_KEYS}


def read_landmark_folder(folder: Path) -> LandmarkLog:
    """Return the log of a folder.

    Raises :class:`ConfigError` and :class:`DataError` with file, line and what to try.
    """
    path = folder / TOML_NAME
    try:
        raw = read_toml(path)
    except FileNotFoundError:
        raise ConfigError(f"{folder}: expected a folder with {TOML_NAME}, found none") from None
    top = {key: value for key, value in raw.items() if key not in SECTIONS}
    read_settings("", top, known=TOP_KEYS, file=TOML_NAME)
    read = {
        name: read_settings(name, raw.get(name, {}), known=keys, file=TOML_NAME)
        for name, keys in SECTIONS.items()
        if name in raw or name != "truth"
    }
    odometry = _table(folder, read["odometry"], ODOMETRY)
    seen = _table(folder, read["observations"], OBSERVATIONS)
    truth = _table(folder, read["truth"], TRUTH) if "truth" in read else None
    noise, grows = _noise(read["odometry"], read["observations"])
    side = odometry.columns.get("side_speed_m_per_s", np.zeros(len(odometry)))
    return LandmarkLog(
        odometry.time_s,
        np.column_stack([odometry["speed_m_per_s"], side]),
        odometry["turn_rate_deg_per_s"] * DEGREE,
        seen.time_s,
        np.column_stack([seen["range_m"], seen["bearing_deg"] * DEGREE]),
        _names(seen),
        noise,
        np.zeros(0) if truth is None else truth.time_s,
        np.zeros((0, 3)) if truth is None else _truth(truth),
        range_sigma_grows=grows,
        notes=(*odometry.notes, *seen.notes),
    )


def _table(folder: Path, settings: Settings, spec: TableSpec) -> Table:
    name = settings.text("file")
    return read_table(folder / name, name, spec)


def _names(seen: Table) -> NDArray[np.intp]:
    if "landmark" not in seen:
        return np.full(len(seen), UNKNOWN, dtype=np.intp)
    values = seen["landmark"]
    bad = np.isfinite(values) & ((values < 0) | (values != np.round(values)))
    if bad.any():
        raise seen.cell_fault(
            int(np.argmax(bad)), "landmark", "expected a whole number from 0, or nothing"
        )
    return np.where(np.isfinite(values), values, UNKNOWN).astype(np.intp)


def _truth(table: Table) -> Array:
    heading = table["heading_deg"] * DEGREE if "heading_deg" in table else np.nan
    return np.column_stack([table["x_m"], table["y_m"], heading + np.zeros(len(table))])


def _noise(odometry: Settings, seen: Settings) -> tuple[SlamNoise, bool]:
    grows = "range_sigma_share" in seen
    if grows == ("range_sigma_m" in seen):
        raise seen.fault(
            "range_sigma_m",
            "expected one of range_sigma_m and range_sigma_share, got "
            f"{'both' if grows else 'none'}",
        )
    control = [
        odometry.number("speed_noise_m_per_sqrt_s"),
        odometry.number("side_noise_m_per_sqrt_s"),
        odometry.number("turn_noise_deg_per_sqrt_s") * DEGREE,
    ]
    of_range = seen.number("range_sigma_share" if grows else "range_sigma_m")
    bearing = seen.number("bearing_sigma_deg") * DEGREE
    return SlamNoise(np.array(control), np.array([of_range, bearing])), grows


def write_landmark_folder(folder: Path, log: LandmarkLog) -> None:
    """Write a log as a folder that `read_landmark_folder` reads."""
    folder.mkdir(parents=True, exist_ok=True)
    control, seen = log.noise.control, log.noise.observation
    which = "range_sigma_share" if log.range_sigma_grows else "range_sigma_m"
    sections: dict[str, Any] = {
        "format": FORMAT,
        "odometry": {
            "file": "odometry.csv",
            "speed_noise_m_per_sqrt_s": float(control[0]),
            "side_noise_m_per_sqrt_s": float(control[1]),
            "turn_noise_deg_per_sqrt_s": float(control[2] / DEGREE),
        },
        "observations": {
            "file": "observations.csv",
            which: float(seen[0]),
            "bearing_sigma_deg": float(seen[1] / DEGREE),
        },
    }
    odometry = {
        "time_s": log.odometry_s,
        "speed_m_per_s": log.speed[:, 0],
        "turn_rate_deg_per_s": log.turn_rate / DEGREE,
        "side_speed_m_per_s": log.speed[:, 1],
    }
    write_table(folder / "odometry.csv", odometry)
    named = np.where(log.landmark == UNKNOWN, np.nan, log.landmark)
    observations = {
        "time_s": log.seen_s,
        "range_m": log.seen[:, 0],
        "bearing_deg": log.seen[:, 1] / DEGREE,
    }
    if np.isfinite(named).any():
        observations["landmark"] = named
    write_table(folder / "observations.csv", observations)
    if len(log.truth_s):
        sections["truth"] = {"file": "truth.csv"}
        truth = {"time_s": log.truth_s, "x_m": log.truth[:, 0], "y_m": log.truth[:, 1]}
        if np.isfinite(log.truth[:, 2]).any():
            truth["heading_deg"] = log.truth[:, 2] / DEGREE
        write_table(folder / "truth.csv", truth)
    write_through(folder / TOML_NAME, tomli_w.dumps(sections).encode())


def write_answer(
    folder: Path, problem: SlamProblem, answer: SlamEstimate, summary: Mapping[str, Any]
) -> None:
    """Write path, map, weights and a summary."""
    folder.mkdir(parents=True, exist_ok=True)
    sigma = np.sqrt(np.einsum("kii->ki", answer.pose_cov))
    path = {
        "time_s": problem.time_s,
        "x_m": answer.pose[:, 0],
        "y_m": answer.pose[:, 1],
        "heading_deg": answer.pose[:, 2] / DEGREE,
        "x_sigma_m": sigma[:, 0],
        "y_sigma_m": sigma[:, 1],
        "heading_sigma_deg": sigma[:, 2] / DEGREE,
    }
    write_table(folder / "path.csv", path)
    cov = answer.landmark_cov
    landmarks = {
        "landmark": np.array([float(name) for name in problem.names]),
        "x_m": answer.landmarks[:, 0],
        "y_m": answer.landmarks[:, 1],
        "x_sigma_m": np.sqrt(cov[:, 0, 0]),
        "y_sigma_m": np.sqrt(cov[:, 1, 1]),
        "xy_cov_m2": cov[:, 0, 1],
        "sightings": np.bincount(problem.landmark, minlength=len(cov)).astype(np.float64),
    }
    write_table(folder / "landmarks.csv", landmarks)
    weights = {
        "time_s": problem.time_s[problem.keyframe],
        "landmark": landmarks["landmark"][problem.landmark],
        "range_m": problem.measured[:, 0],
        "bearing_deg": problem.measured[:, 1] / DEGREE,
        "weight": answer.weights,
    }
    write_table(folder / "weights.csv", weights)
    text = json.dumps(summary, indent=2, allow_nan=False) + "\n"
    write_through(folder / "summary.json", text.encode())
