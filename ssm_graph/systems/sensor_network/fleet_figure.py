"""The figure of a fleet: where its vehicles can be, by themselves and by ranges."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np

from ssm_graph.base.frozen import Array
from ssm_graph.report import style
from ssm_graph.report.style import Curve, Panel
from ssm_graph.systems.sensor_network.figures import border_of
from ssm_graph.systems.sensor_network.fleet import FleetTrial
from ssm_graph.systems.sensor_network.fleet_study import FleetResult

_COLORS: Final = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")


def save_fleet_figure(folder: Path, result: FleetResult) -> Path:
    """Draw tracks with the sets at the end, and half-widths over time; return the file."""
    folder.mkdir(parents=True, exist_ok=True)
    study = result.study
    figure = style.new_figure(9.0, 4.2, f"{study.name}: where its vehicles can be")
    axes = figure.subplots(1, 2)
    style.draw_panel(axes[0], _map(result))
    axes[0].set_aspect("equal", adjustable="datalim")
    style.draw_panel(axes[1], _widths(result))
    return style.save(figure, folder / "fleet.png")


def _line(color: str, label: str, dash: style.Dash) -> dict[str, object]:
    return {"color": color, "label": label, "linestyle": dash, "linewidth": 1.1}


def _edge(trial: FleetTrial, vehicle: int) -> tuple[Array, Array]:
    """Return the border of a vehicle's set of places at the end, east and north, m."""
    sets = (trial.center, trial.shape, trial.low, trial.high)
    return border_of(*(one[-1, vehicle] for one in sets))


def _map(result: FleetResult) -> Panel:
    curves = []
    for i in range(result.study.setting.n_vehicles):
        color, first = _COLORS[i % len(_COLORS)], i == 0
        track = result.together.truth[:, i]
        curves.append(
            Curve(track[:, 0], track[:, 1], _line(color, "true way" if first else "", "-"))
        )
        for trial, label, dash in (
            (result.alone, "set at the end, by itself", style.SHORT),
            (result.together, "set at the end, by ranges", "-"),
        ):
            options = {**_line(color, label if first else "", dash), "linewidth": 1.6}
            curves.append(Curve(*_edge(trial, i), options))
        dot = {"color": style.INK, "linestyle": "", "marker": "o", "markersize": 3.0}
        curves.append(
            Curve(track[-1:, 0], track[-1:, 1], {**dot, "label": "true end" if first else ""})
        )
    return Panel(
        title="ways and sets", x="east, m", y="north, m", curves=curves, legend={"loc": "best"}
    )


def _widths(result: FleetResult) -> Panel:
    curves, setting = [], result.study.setting
    k = np.arange(1.0, setting.n_steps + 1.0)
    for i in range(setting.n_vehicles):
        color = _COLORS[i % len(_COLORS)]
        who = f"vehicle {i + 1}" + (", fixes" if i < setting.n_surfaced else "")
        for trial, label, dash in (
            (result.together, who, "-"),
            (result.alone, "", style.SHORT),
        ):
            half = trial.half_widths[:, i, :2].mean(axis=1)
            curves.append(Curve(k, half, _line(color, label, dash)))
    return Panel(
        title="half-widths; dashed by itself",
        x="time, s",
        y="mean of east and north, m",
        curves=curves,
        legend={"loc": "upper left"},
    )
