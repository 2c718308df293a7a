"""Figures of a study: those of the patent by its numbers, and what they do not show."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np
from matplotlib.figure import Figure

from ssm_graph.base.frozen import Array
from ssm_graph.report import style
from ssm_graph.report.style import Band, Curve, Panel
from ssm_graph.systems.sensor_network.codes import residue_bits
from ssm_graph.systems.sensor_network.motion import HEADING
from ssm_graph.systems.sensor_network.setting import Setting, Share
from ssm_graph.systems.sensor_network.study import INTERVALS, KEYS, NetworkStudy, table_1
from ssm_graph.systems.sensor_network.world import Disturbance, Trial, run_patent, run_sets

_COMPONENTS: Final = ("π, m", "τ, m", "θ, rad")
_PAIRS: Final = ((0, 1), (2, 3))
_COLORS: Final = ("#0072B2", "#D55E00", "#009E73", "#CC79A7")
_STEPS: Final = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0)


def save_network_figures(folder: Path, study: NetworkStudy) -> list[Path]:
    """Draw and save all figures; ``figure_02.png`` to ``figure_11.png`` are those of the patent."""
    folder.mkdir(parents=True, exist_ok=True)
    setting, seed = study.setting, study.seed
    trial = run_patent(setting, Disturbance.PATENT, seed=seed)
    figures: dict[str, Figure] = {}
    for half, both in enumerate(_PAIRS):
        pair = [i for i in both if i < setting.n_nodes]
        if not pair:
            continue
        for axis in range(3):
            figures[f"figure_{2 + 2 * axis + half:02}"] = _states(trial, axis, pair)
        figures[f"figure_{8 + half:02}"] = _bounds(trial, pair, setting)
        figures[f"figure_{10 + half}"] = _intervals(setting, pair, seed)
    shared = replace(setting, share=Share.MEASUREMENTS)
    sets = run_sets(shared, Disturbance.UNIFORM, seed=seed)
    figures["sets_in_the_plane"] = _plane(sets)
    figures["tubes"] = _tubes(sets)
    figures["error_against_bound"] = _errors(sets)
    figures["bits_and_steps"] = _bits(setting, seed)
    return [style.save(figure, folder / f"{name}.png") for name, figure in figures.items()]


def _drawn(title: str, panels: Sequence[Panel], width: float = 3.6, height: float = 3.0) -> Figure:
    figure = style.new_figure(width * len(panels), height, title)
    axes = figure.subplots(1, len(panels), squeeze=False)[0]
    for one, panel in zip(axes, panels, strict=True):
        style.draw_panel(one, panel)
    return figure


def _line(color: str, label: str, dash: style.Dash = "-") -> dict[str, object]:
    return {"color": color, "label": label, "linestyle": dash, "linewidth": 1.1}


def _states(trial: Trial, axis: int, pair: Sequence[int]) -> Figure:
    k = np.arange(1.0, len(trial.truth) + 1.0)
    curves = [Curve(k, trial.truth[:, 0, axis], _line(style.INK, "state"))]
    curves += [
        Curve(k, trial.center[:, 0, i, axis], _line(_COLORS[i], f"node {i + 1}", dash))
        for i, dash in zip(pair, (style.LONG, style.SHORT), strict=False)
    ]
    panel = Panel(x="step k", y=_COMPONENTS[axis], curves=curves, legend={"loc": "best"})
    names = ", ".join(str(i + 1) for i in pair)
    return _drawn(f"Component {axis + 1} and nodes {names}", [panel], 6.0)


def _bounds(trial: Trial, pair: Sequence[int], setting: Setting) -> Figure:
    k = np.arange(1.0, len(trial.truth) + 1.0)
    # Between two walls nothing is off by more than twice what they allow.
    walls = np.full(len(k), 2.0 * float(np.linalg.norm(setting.saturation)))
    most = 2.0 * max(float(walls[0]), float(trial.root_trace.max()))
    panels = [
        Panel(
            title=f"node {i + 1}",
            x="step k",
            y="error and bound",
            curves=[
                Curve(k, trial.error[:, 0, i], _line(_COLORS[i], "error")),
                Curve(k, trial.root_trace[:, i], _line(style.INK, "root of the trace", "--")),
                Curve(k, walls, _line(style.GREY, "nothing known but walls", style.SHORT)),
            ],
            is_log_y=True,
            y_limits=(0.01, most),  # room for the legend
            legend={"loc": "lower left"},
        )
        for i in pair
    ]
    title = "Error and bound of the patent, and what the walls alone allow"
    return _drawn(title, panels, 7.2 / len(panels))


def _intervals(setting: Setting, pair: Sequence[int], seed: int) -> Figure:
    panels = []
    for key in (1.0, 100.0):
        curves = []
        for d, dash in zip(INTERVALS, ("--", "-"), strict=True):
            one = replace(setting, d=d, key=key)
            error = run_patent(one, Disturbance.PATENT, seed=seed).error[:, 0]
            k = np.arange(1.0, len(error) + 1.0)
            curves += [
                Curve(k, error[:, i], _line(_COLORS[i], f"node {i + 1}, d = {d}", dash))
                for i in pair
            ]
        top = 1.5 * max(float(curve.y.max()) for curve in curves)
        panels.append(
            Panel(
                title=f"key {key:g}",
                x="step k",
                y="length of the error, m and rad",
                y_limits=(0.0, top),  # room for the legend
                curves=curves,
                legend={"loc": "upper left", "ncols": 2},
            )
        )
    return _drawn("Error by the interval d of the quantiser, by key", panels)


def border_of(center: Array, shape: Array, low: Array, high: Array) -> tuple[Array, Array]:
    """Return the border of a set of places, east and north, m.

    The ellipse is cut by the box coordinate by coordinate, which loses nothing of both.
    """
    angle = np.linspace(0.0, 2.0 * math.pi, 120)
    ring = np.stack([np.cos(angle), np.sin(angle)])
    border = center[:2, None] + np.linalg.cholesky(shape[:2, :2]) @ ring
    east, north = np.clip(border, low[:2, None], high[:2, None])
    return east, north


def _plane(trial: Trial) -> Figure:
    east, north = trial.truth[:, 0, 0], trial.truth[:, 0, 1]
    shown = range(0, len(east), 5)
    dots = {"color": style.INK, "linestyle": "", "marker": "o", "markersize": 2.5}
    curves = [curve for k in shown for curve in _borders(trial, k, is_named=k == 0)]
    curves.append(Curve(east, north, _line(style.INK, "robot")))
    curves.append(Curve(east[shown], north[shown], {**dots, "label": "at those steps"}))
    last = shown[-1]
    near = [*_borders(trial, last, is_named=False), Curve(east[[last]], north[[last]], dots)]
    whole = Panel(
        title="every fifth step", x="east, m", y="north, m", curves=curves, legend={"loc": "best"}
    )
    panels = [whole, replace(whole, title=f"step {last + 1} from near", curves=near, legend={})]
    figure = _drawn("Sets in the plane", panels, 4.6, 4.6)
    for axes in figure.axes:
        axes.set_aspect("equal", adjustable="datalim")
    return figure


def _borders(trial: Trial, k: int, *, is_named: bool) -> Iterator[Curve]:
    """Yield the borders of all nodes' sets at a step."""
    for i in range(trial.center.shape[2]):
        middle, half = trial.center[k, 0, i], trial.half_widths[k, 0, i]
        border = border_of(trial.around[k, i], trial.shape[k, i], middle - half, middle + half)
        label = f"node {i + 1}" if is_named and i < len(_COLORS) else ""
        color = _COLORS[i % len(_COLORS)]
        yield Curve(*border, {"color": color, "linewidth": 0.9, "label": label})


def _tubes(trial: Trial) -> Figure:
    k = np.arange(1.0, len(trial.truth) + 1.0)
    panels = []
    for axis in range(3):
        c, h = trial.center[:, 0, 0, axis], trial.half_widths[:, 0, 0, axis]
        is_unknown = axis == HEADING and float(h.max()) >= math.pi
        panels.append(
            Panel(
                title="wider than a turn: not observed" if is_unknown else "",
                x="step k",
                y=_COMPONENTS[axis],
                bands=[Band(k, c - h, c + h, {"color": style.BOUND, "alpha": 0.6, "label": "set"})],
                curves=[Curve(k, trial.truth[:, 0, axis], _line(style.INK, "state"))],
                legend={"loc": "best"},
            )
        )
    return _drawn("What node 1 knows for certain", panels)


def _errors(trial: Trial) -> Figure:
    k = np.arange(1.0, len(trial.truth) + 1.0)
    panels = []
    for axis in range(3):
        error = trial.point[:, 0, 0, axis] - trial.truth[:, 0, axis]
        low = trial.center[:, 0, 0, axis] - trial.half_widths[:, 0, 0, axis]
        high = trial.center[:, 0, 0, axis] + trial.half_widths[:, 0, 0, axis]
        most = np.maximum(high - trial.point[:, 0, 0, axis], trial.point[:, 0, 0, axis] - low)
        curves = [
            Curve(k, np.abs(error), _line(style.ESTIMATE, "error of the point")),
            Curve(k, most, _line(style.INK, "bound", "--")),
        ]
        panels.append(Panel(x="step k", y=_COMPONENTS[axis], curves=curves, legend={"loc": "best"}))
    return _drawn("Error of the point estimate against its bound, node 1", panels)


def _bits(setting: Setting, seed: int) -> Figure:
    steps = np.array(_STEPS)
    half = np.array([_half_width(replace(setting, d=d, key=1.0), seed) for d in _STEPS])
    bits = np.array(
        [
            residue_bits(2.0 * (h + setting.position_bound), d)
            for h, d in zip(half, _STEPS, strict=True)
        ],
        dtype=np.float64,
    )
    found = table_1(setting, seed=seed)
    mean = {d: np.array([np.mean(found[key][d]) for key in KEYS]) for d in INTERVALS}
    marks = {"marker": "o", "markersize": 3.0}
    panels = [
        Panel(
            title=f"bits against half-width, steps of {_STEPS[0]:g} to {_STEPS[-1]:g} m",
            x="half-width of the position, m",
            y="bits of a residue",
            curves=[Curve(half, bits, {**_line(style.ESTIMATE, ""), **marks})],
        ),
        Panel(
            title="half-width against step",
            x="step key · d, m",
            y="half-width of the position, m",
            curves=[Curve(steps, half, {**_line(style.ESTIMATE, ""), **marks})],
            is_log_x=True,
            x_limits=(0.008, 7.0),
        ),
        Panel(
            title="the patent's error against its key",
            x="key",
            y="mean length of the error, m and rad",
            curves=[
                Curve(np.array(KEYS), mean[d], {**_line(color, f"d = {d}"), **marks})
                for d, color in zip(INTERVALS, _COLORS, strict=False)
            ],
            is_log_x=True,
            x_limits=(0.8, 300.0),
            legend={"loc": "upper left"},
        ),
    ]
    return _drawn("What bits, steps and keys cost", panels)


def _half_width(setting: Setting, seed: int) -> float:
    trial = run_sets(replace(setting, share=Share.MEASUREMENTS), Disturbance.UNIFORM, seed=seed)
    half: Array = trial.half_widths[..., :2]
    return float(half.mean())
