"""Figures of a visual run: path and anchors, ranges, scale, tracking, an image with its tracks."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.patches import Ellipse
from numpy.typing import NDArray

from ssm_graph.report.style import (
    BOUND,
    DPI,
    ESTIMATE,
    GREY,
    INK,
    NOMINAL,
    OTHER_COLORS,
    OUTLIER,
    REDUCED,
    REFERENCE,
    SMALL,
    dress,
    legend,
    new_figure,
    save,
    thinned,
)
from ssm_graph.systems.visual_ranges.accuracy import Accuracy
from ssm_graph.systems.visual_ranges.outputs import metres
from ssm_graph.systems.visual_ranges.ranging import AnchorState, RangingResult
from ssm_graph.systems.visual_ranges.result import FrameState, VisualResult
from ssm_graph.systems.visual_ranges.sequence import Sequence
from ssm_graph.systems.visual_ranges.verdict import Judged, reprojection_errors

Array = NDArray[np.float64]

ANCHOR_COLORS: Final = ("#009E73", "#CC79A7", "#D55E00", *OTHER_COLORS)
MOST_POINTS: Final = 6000
MOST_LINES: Final = 120
"""Ways of points since the key frame before that are drawn on an image."""


def write_figures(
    folder: Path, sequence: Sequence, result: VisualResult, judged: Judged, errors: Accuracy | None
) -> list[tuple[str, str, str]]:
    """Write the figures of a result; return file name, title and a note of each."""
    made = [
        (
            "path.png",
            "Path, map and anchors",
            "from above and from the side of the first camera: x to its right, z ahead, y down; "
            "ellipses hold 3 sigma",
            _path_figure(sequence, result, judged, errors),
        )
    ]
    ranging: RangingResult | None = result.ranging
    if ranging is not None and np.isfinite(ranging.weight).any():
        note = "computed minus measured; a weight near 0 says that a range was not believed"
        made.append(
            ("ranges.png", "Ranges and their weights", note, _range_figure(sequence, ranging))
        )
    note = "points seen in each image, key frames, loops; scale with 3 sigma where it is known"
    made.append(("run.png", "Tracking and scale over time", note, _run_figure(sequence, result)))
    if len(result.map.time_s):
        note = "key points of a key frame: with a place in the map, doubted, and without"
        made.append(("image.png", "An image and its tracks", note, _image_figure(sequence, result)))
    written = []
    for name, title, text, figure in made:
        save(figure, folder / name, dpi=DPI)
        written.append((name, title, text))
    return written


def _path_figure(
    sequence: Sequence, result: VisualResult, judged: Judged, errors: Accuracy | None
) -> Any:
    figure = new_figure(11.0, 5.6, f"{result.name}: {judged.verdict.name.replace('_', ' ')}")
    unit = "m" if judged.verdict.has_scale else "map units"
    above, side = figure.subplots(1, 2)
    for axes, (i, j), labels in (
        (above, (0, 2), (f"x, to the right ({unit})", f"z, ahead ({unit})")),
        (side, (2, 1), (f"z, ahead ({unit})", f"y, down ({unit})")),
    ):
        _draw_path(axes, sequence, result, errors, i, j)
        axes.set_aspect("equal", adjustable="datalim")
        dress(axes, title="From above" if i == 0 else "From the side", x=labels[0], y=labels[1])
    side.invert_yaxis()
    legend(above, loc="best")
    return figure


def _draw_path(
    axes: Axes, sequence: Sequence, result: VisualResult, errors: Accuracy | None, i: int, j: int
) -> None:
    scale = metres(result)
    world = result.map
    points = world.points[world.points_views >= 3] * scale
    points = points[thinned(len(points), MOST_POINTS)]
    axes.plot(points[:, i], points[:, j], ".", color=BOUND, markersize=1.2, label="points")
    place = result.position * scale
    if sequence.truth is not None and errors is not None:
        back = (errors.metric_to_world or errors.to_world).inverse()
        seen = np.isfinite(place).all(axis=1)
        inside = (sequence.truth.time_s >= result.time_s[seen][0]) & (
            sequence.truth.time_s <= result.time_s[seen][-1]
        )
        true = back.apply(sequence.truth.position_m[inside])
        axes.plot(true[:, i], true[:, j], color=REFERENCE, linewidth=1.6, label="truth")
        if sequence.anchor_truth_m is not None and errors.metric_to_world is not None:
            at = back.apply(sequence.anchor_truth_m)
            axes.plot(at[:, i], at[:, j], "+", color=REFERENCE, markersize=9, label="true anchors")
    axes.plot(place[:, i], place[:, j], color=ESTIMATE, linewidth=1.0, label="camera")
    keys = -np.einsum("kji,kj->ki", world.R_cw, world.t_cw)
    times = np.searchsorted(world.time_s, [loop.time_s for loop in result.loops if loop.is_taken])
    taken = keys[np.minimum(times, len(keys) - 1)] * scale if len(times) else np.zeros((0, 3))
    if len(taken):
        axes.plot(taken[:, i], taken[:, j], "o", mfc="none", color=REDUCED, label="loops taken")
    _draw_anchors(axes, result.ranging, i, j)


def _draw_anchors(axes: Axes, ranging: RangingResult | None, i: int, j: int) -> None:
    if ranging is None or not ranging.has_scale:
        return
    for n, anchor in enumerate(ranging.anchors):
        if not np.isfinite(anchor.place_m).all():
            continue
        colour = ANCHOR_COLORS[n % len(ANCHOR_COLORS)]
        mark = "^" if anchor.state is AnchorState.READY else "v"
        label = f"anchor {anchor.name}, {anchor.state.name.lower()}"
        axes.plot(anchor.place_m[i], anchor.place_m[j], mark, color=colour, label=label)
        part = anchor.covariance[np.ix_([i, j], [i, j])]
        if np.isfinite(part).all():
            size, turn = np.linalg.eigh(part)
            width, height = 6.0 * np.sqrt(np.maximum(size, 0.0))
            angle = float(np.degrees(np.arctan2(turn[1, 0], turn[0, 0])))
            place = (float(anchor.place_m[i]), float(anchor.place_m[j]))
            axes.add_patch(
                Ellipse(place, float(width), float(height), angle=angle, fill=False, color=colour)
            )
        others = anchor.alternatives_m
        axes.plot(others[:, i], others[:, j], "x", color=colour, markersize=5)


def _range_figure(sequence: Sequence, ranging: RangingResult) -> Any:
    ranges = sequence.ranges
    used = np.flatnonzero(np.isfinite(ranging.weight))
    names = [a.name for a in ranging.anchors]
    present = [j for j in range(len(names)) if np.any(ranging.anchor_of[used] == j)][:6]
    figure = new_figure(11.0, 1.6 + 1.7 * len(present), "Ranges: errors and weights")
    rows = figure.subplots(len(present), 2, squeeze=False, width_ratios=(3.0, 1.0))
    begin = float(sequence.time_s[0])
    for (left, right), j in zip(rows, present, strict=True):
        own = used[ranging.anchor_of[used] == j]
        t, e, w = ranges.time_s[own] - begin, ranging.error_m[own], ranging.weight[own]
        marks = left.scatter(t, e, c=w, s=5, cmap="viridis", vmin=0.0, vmax=max(1.0, w.max()))
        sigma = 3.0 * float(np.median(ranges.sigma_m[own]))
        left.axhspan(-sigma, sigma, color=BOUND, alpha=0.35, zorder=0.5, linewidth=0.0)
        share = float(np.mean(w < 0.05))
        title = f"anchor {names[j]}: {len(own)} ranges, {100 * share:.0f} % not believed"
        dress(left, title=title, x="time since the first image (s)", y="error (m)")
        figure.colorbar(marks, ax=left, pad=0.01).ax.tick_params(labelsize=SMALL)
        right.hist(w, bins=np.linspace(0.0, max(1.0, w.max()), 25), color=NOMINAL)
        dress(right, title="weights", x="weight", y="ranges")
    return figure


def _run_figure(sequence: Sequence, result: VisualResult) -> Any:
    ranging: RangingResult | None = result.ranging
    has_scale = ranging is not None and len(ranging.scale_history) > 1
    figure = new_figure(11.0, 6.2 if has_scale else 4.4, "The run")
    n_rows = 2 if has_scale else 1
    grid = figure.subplots(n_rows, 2, squeeze=False, width_ratios=(3.0, 1.0))
    begin = float(sequence.time_s[0])
    axes = grid[0][0]
    t = result.time_s - begin
    axes.plot(t, result.n_tracked, color=ESTIMATE, linewidth=0.9, label="points")
    lost = result.state == FrameState.LOST
    if lost.any():
        axes.plot(t[lost], np.zeros(lost.sum()), "|", color=OUTLIER, label="lost")
    axes.plot(
        result.map.time_s - begin, np.full(len(result.map.time_s), -12.0), "|", color=GREY,
        markersize=4, label="key frames",
    )  # fmt: skip
    taken = [loop.time_s - begin for loop in result.loops if loop.is_taken]
    for n, time in enumerate(taken):
        axes.axvline(time, color=REDUCED, linewidth=1.2, label="loop closed" if n == 0 else None)
    refused = [loop.time_s - begin for loop in result.loops if not loop.is_taken]
    if refused:
        level = np.full(len(refused), 1.05 * max(float(result.n_tracked.max()), 1.0))
        axes.plot(refused, level, "x", color=OUTLIER, markersize=3, label="loop refused")
    axes.set_ylim(top=1.12 * max(float(result.n_tracked.max()), 1.0))
    dress(axes, title="Points seen", x="time since the first image (s)", y="points")
    legend(axes, loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=5, borderaxespad=0.2)
    error, _ = reprojection_errors(result)
    size = np.linalg.norm(error, axis=1) if len(error) else np.zeros(1)
    top = max(float(np.percentile(size, 99)), 0.1)
    grid[0][1].hist(np.minimum(size, top), bins=40, color=NOMINAL)
    title = f"Reprojection, median {np.median(size):.2f} px"
    dress(grid[0][1], title=title, x="error (px)", y="observations")
    if ranging is not None and has_scale:
        _draw_scale(grid[1][0], ranging, begin)
        _draw_states(grid[1][1], ranging)
    return figure


def _draw_scale(axes: Axes, ranging: RangingResult, begin: float) -> None:
    time, scale, sigma = ranging.scale_history.T
    width = 3.0 * scale * sigma
    axes.fill_between(time - begin, scale - width, scale + width, color=BOUND, linewidth=0.0)
    axes.plot(time - begin, scale, color=ESTIMATE, linewidth=1.0)
    dress(axes, title="Scale", x="time since the first image (s)", y="metres a map unit")


def _draw_states(axes: Axes, ranging: RangingResult) -> None:
    if not ranging.anchors:
        axes.set_axis_off()
        return
    for n, anchor in enumerate(ranging.anchors):
        with np.errstate(invalid="ignore"):
            sigma = float(np.sqrt(np.trace(anchor.covariance)))
        height = sigma if np.isfinite(sigma) else 0.0
        axes.bar(n, height, width=0.5, color=ANCHOR_COLORS[n % len(ANCHOR_COLORS)])
    axes.set_xlim(-0.8, max(len(ranging.anchors), 2) - 0.2)
    axes.set_xticks(range(len(ranging.anchors)))
    axes.set_xticklabels([f"{a.name}\n{a.state.name.lower()}" for a in ranging.anchors])
    dress(axes, title="Anchors", y="sigma of the place (m)")


def _image_figure(sequence: Sequence, result: VisualResult) -> Any:
    world = result.map
    counts = [
        int((world.point[a:b] >= 0).sum())
        for a, b in zip(world.first_row[:-1], world.first_row[1:], strict=True)
    ]
    k = int(np.argmax(counts))
    rows = np.arange(world.first_row[k], world.first_row[k + 1])
    image = sequence.images(int(world.image[k]))
    height, width = image.shape
    time_s = float(world.time_s[k] - sequence.time_s[0])
    figure = new_figure(9.0, 9.0 * height / width + 0.6, f"Image at {time_s:.2f} s")
    axes = figure.subplots()
    axes.imshow(image, cmap="gray", vmin=0, vmax=255)
    point, weight = world.point[rows], np.nan_to_num(world.weight[rows], nan=0.0)
    pixels = world.pixels[rows]
    kinds = (
        (point < 0, GREY, "no place yet"),
        ((point >= 0) & (weight < 0.5), OUTLIER, "doubted"),
        ((point >= 0) & (weight >= 0.5), "#56B4E9", "in the map"),
    )
    for mask, colour, label in kinds:
        axes.plot(
            *pixels[mask].T, ".", color=colour, markersize=3.5, label=f"{label}: {mask.sum()}"
        )
    axes.add_collection(
        LineCollection(_flow(result, k, rows), colors=REDUCED, linewidths=0.7, alpha=0.6)
    )
    axes.set_axis_off()
    axes.legend(
        fontsize=SMALL, loc="lower right", facecolor="white", labelcolor=INK, framealpha=0.9
    )
    return figure


def _flow(result: VisualResult, k: int, rows: NDArray[np.int64]) -> list[Array]:
    """Return lines from where points were seen in the key frame before to where they are."""
    world = result.map
    if k == 0:
        return []
    before = np.arange(world.first_row[k - 1], world.first_row[k])
    seen = {int(p): r for p, r in zip(world.point[before], before, strict=True) if p >= 0}
    pairs = [(seen[int(p)], r) for p, r in zip(world.point[rows], rows, strict=True) if p in seen]
    pairs = [pairs[i] for i in thinned(len(pairs), MOST_LINES)]
    return [world.pixels[[a, b]].astype(np.float64) for a, b in pairs]
