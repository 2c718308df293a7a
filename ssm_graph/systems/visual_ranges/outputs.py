"""What ``ssm-graph visual`` writes: trajectories, covariances, map, anchors, ranges, scale."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ssm_graph.io.tables.append_file import write_through
from ssm_graph.systems.visual_ranges.accuracy import Accuracy
from ssm_graph.systems.visual_ranges.map_files import MAP_NAME, save_map
from ssm_graph.systems.visual_ranges.ranging import RangingResult
from ssm_graph.systems.visual_ranges.result import FrameState, VisualResult
from ssm_graph.systems.visual_ranges.sequence import Sequence
from ssm_graph.systems.visual_ranges.verdict import Judged

Array = NDArray[np.float64]

PATH_COLOUR: Final = (213, 94, 0)
"""Red, green, blue of the camera's path among the points of ``map.ply``."""
ANCHOR_COLOUR: Final = (0, 114, 178)


def metres(result: VisualResult) -> float:
    """Return metres a map unit, 1 where the scale is not known."""
    ranging: RangingResult | None = result.ranging
    return ranging.scale if ranging is not None and ranging.has_scale else 1.0


def write_outputs(
    folder: Path,
    sequence: Sequence,
    result: VisualResult,
    judged: Judged,
    errors: Accuracy | None,
    notes: tuple[str, ...] = (),
) -> None:
    """Write all tables of a result; lengths are metres where the scale is known, else map units."""
    folder.mkdir(parents=True, exist_ok=True)
    scale = metres(result)
    unit = "m" if judged.verdict.has_scale else "map units"
    on = np.isfinite(result.t_cw).all(axis=1)
    head = f"# time_s x y z qx qy qz qw  ({unit}; camera to map)"
    write_tum(
        folder / "trajectory.tum", head, result.time_s[on], result.R_cw[on], scale * result.t_cw[on]
    )
    world = result.map
    write_tum(folder / "keyframes.tum", head, world.time_s, world.R_cw, scale * world.t_cw)
    np.savez_compressed(
        folder / "covariance.npz",
        time_s=world.time_s,
        covariance=_metric(world.covariance, scale),
        order=np.array("left perturbation of map to camera: translation xyz, rotation xyz"),
        unit=np.array(unit),
    )
    write_ply(folder / "map.ply", result, scale)
    save_map(folder / MAP_NAME, result)
    ranging: RangingResult | None = result.ranging
    if ranging is not None:
        _write_text(folder / "anchors.csv", _anchor_rows(ranging))
        _write_text(folder / "ranges.csv", _range_rows(sequence, ranging))
        rows = [",".join(f"{x:.9g}" for x in row) for row in ranging.scale_history]
        _write_text(folder / "scale.csv", ["time_s,m_per_map_unit,relative_sigma", *rows])
    summary = summary_of(sequence, result, judged, errors, notes)
    text = json.dumps(summary, indent=2, allow_nan=False)
    _write_text(folder / "result.json", [text])


def write_tum(path: Path, head: str, time_s: Array, R_cw: Array, t_cw: Array) -> None:
    """Write camera poses (N, 3, 3), (N, 3), map to camera, as a TUM file of camera to map."""
    centre = -np.einsum("nji,nj->ni", R_cw, t_cw)
    quaternion = (
        Rotation.from_matrix(np.swapaxes(R_cw, 1, 2)).as_quat() if len(R_cw) else np.zeros((0, 4))
    )
    rows = [
        f"{t:.9f} " + " ".join(f"{x:.9f}" for x in row)
        for t, row in zip(time_s, np.column_stack([centre, quaternion]), strict=True)
    ]
    _write_text(path, [head, *rows])


def write_ply(path: Path, result: VisualResult, scale: float) -> None:
    """Write points (grey, with how many key frames see each), the path, and ready anchors."""
    world = result.map
    kept = world.points_views >= 2
    parts: list[tuple[Array, NDArray[np.int64], tuple[int, int, int] | None, int]]
    parts = [(world.points[kept] * scale, world.points_views[kept], None, 0)]
    grey = world.points_grey[kept]
    place = result.position
    place = place[np.isfinite(place).all(axis=1)] * scale
    parts.append((place, np.zeros(len(place), dtype=np.int64), PATH_COLOUR, 1))
    ranging: RangingResult | None = result.ranging
    if ranging is not None and ranging.has_scale:
        anchors = np.array([a.place_m for a in ranging.anchors]).reshape(-1, 3)
        anchors = anchors[np.isfinite(anchors).all(axis=1)]
        parts.append((anchors, np.zeros(len(anchors), dtype=np.int64), ANCHOR_COLOUR, 2))
    kind = np.dtype(
        [
            *((name, "<f4") for name in "xyz"),
            *((name, "u1") for name in ("red", "green", "blue")),
            ("views", "<i4"),
            ("kind", "u1"),
        ]
    )
    vertices = []
    for places, views, colour, what in parts:
        table = np.zeros(len(places), dtype=kind)
        for i, name in enumerate("xyz"):
            table[name] = places[:, i]
        for i, name in enumerate(("red", "green", "blue")):
            table[name] = grey if colour is None else colour[i]
        table["views"], table["kind"] = views, what
        vertices.append(table)
    table = np.concatenate(vertices)
    names = {"<f4": "float", "|u1": "uchar", "<i4": "int"}
    head = ["ply", "format binary_little_endian 1.0", "comment kind: 0 point, 1 path, 2 anchor"]
    head += [f"element vertex {len(table)}"]
    head += [f"property {names[kind[name].str]} {name}" for name in kind.names or ()]
    write_through(path, ("\n".join([*head, "end_header"]) + "\n").encode() + table.tobytes())


def summary_of(
    sequence: Sequence,
    result: VisualResult,
    judged: Judged,
    errors: Accuracy | None,
    notes: tuple[str, ...],
) -> dict[str, Any]:
    """Return the whole answer in few numbers, for JSON."""
    ranging: RangingResult | None = result.ranging
    place = result.position * metres(result)
    place = place[np.isfinite(place).all(axis=1)]
    length = float(np.linalg.norm(np.diff(place, axis=0), axis=1).sum()) if len(place) else 0.0
    found: dict[str, Any] = {
        "name": result.name,
        "verdict": judged.verdict.name,
        "meaning": judged.verdict.value,
        "reasons": list(judged.reasons),
        "advice": judged.advice,
        "unit": "m" if judged.verdict.has_scale else "map units",
        "n_images": len(result.time_s),
        "n_tracked": int((result.state == FrameState.TRACKED).sum()),
        "n_lost": int((result.state == FrameState.LOST).sum()),
        "n_key_frames": len(result.map.time_s),
        "n_points": int((result.map.points_views >= 2).sum()),
        "path_length": length,
        "loops_taken": sum(loop.is_taken for loop in result.loops),
        "loops_refused": sum(not loop.is_taken for loop in result.loops),
        "events": told_events(result.events),
        "notes": [*sequence.notes, *notes],
    }
    if ranging is not None:
        found["scale"] = {
            "state": ranging.state.name,
            "m_per_map_unit": _plain(ranging.scale),
            "relative_sigma": _plain(ranging.sigma_log_scale),
            "started_s": _plain(ranging.started_s),
            "clock_s": _plain(ranging.clock_s),
            "clock_sigma_s": _plain(ranging.clock_sigma_s),
            "lever_arm_error_m": ranging.lever_error_m.tolist(),
        }
        if ranging.vehicle is not None:
            own = ranging.vehicle
            found["vehicle"] = {
                "down_map_axes": own.down.tolist(),
                "down_sigma_rad": _plain(float(np.sqrt(np.trace(own.down_covariance)))),
                "depth_of_origin_m": _plain(own.depth_m),
                "m_per_map_unit": _plain(own.scale),
                "relative_sigma": _plain(own.sigma_log_scale),
                "range_unit_m": _plain(own.range_unit),
                "range_unit_sigma": _plain(own.range_unit_sigma),
                "contradiction": own.contradiction,
            }
    if errors is not None:
        found["against_truth"] = {
            "n_frames": errors.n_frames,
            "metric_rms_m": _plain(errors.metric_m),
            "scale_aligned_rms_m": _plain(errors.similar_m),
            "scale_error": _plain(errors.scale_error),
            "anchor_error_m": [_plain(x) for x in errors.anchor_m],
        }
    return found


def told_events(events: tuple[str, ...]) -> list[str]:
    """Return events, those that repeat the one before but for time and numbers told once."""
    told: list[str] = []
    kinds: list[str] = []
    counts: list[int] = []
    for event in events:
        kind = re.sub(r"[\d.]+", "", event)
        if kinds and kinds[-1] == kind:
            counts[-1] += 1
            continue
        told.append(event)
        kinds.append(kind)
        counts.append(1)
    return [
        text if n == 1 else f"{text} (and {n - 1} times more)"
        for text, n in zip(told, counts, strict=True)
    ]


def _plain(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _metric(covariance: Array, scale: float) -> Array:
    """Return covariances (K, 6, 6) with translations in metres."""
    factor = np.array([scale] * 3 + [1.0] * 3)
    return np.asarray(covariance * factor[:, None] * factor[None, :])


def _anchor_rows(ranging: RangingResult) -> list[str]:
    rows = [
        "anchor,state,x_m,y_m,z_m,x_sigma_m,y_sigma_m,z_sigma_m,bias_m,bias_sigma_m,n_ranges,"
        "nlos_share,alternatives_m"
    ]
    for a in ranging.anchors:
        with np.errstate(invalid="ignore"):
            sigma = np.sqrt(np.diag(a.covariance))
        numbers = [*a.place_m, *sigma, a.bias_m, a.bias_sigma_m]
        others = "; ".join(" ".join(f"{x:.3f}" for x in place) for place in a.alternatives_m)
        cells = [a.name, a.state.name, *(_cell(x) for x in numbers), str(a.n_ranges)]
        rows.append(",".join([*cells, _cell(a.nlos_share), others]))
    return rows


def _range_rows(sequence: Sequence, ranging: RangingResult) -> list[str]:
    r = sequence.ranges
    rows = ["time_s,anchor,range_m,sigma_m,error_m,t,weight"]
    for i in range(len(r)):
        e, w = ranging.error_m[i], ranging.weight[i]
        name = ranging.anchors[int(ranging.anchor_of[i])].name
        t = (e / r.sigma_m[i]) ** 2
        numbers = (r.range_m[i], r.sigma_m[i], e, t, w)
        rows.append(f"{r.time_s[i]:.9f},{name}," + ",".join(_cell(x) for x in numbers))
    return rows


def _cell(value: float) -> str:
    return f"{value:.6g}" if np.isfinite(value) else ""


def _write_text(path: Path, lines: list[str]) -> None:
    write_through(path, ("\n".join(lines) + "\n").encode())
