"""The paper's figures 2 to 13, with what it left out: intervals over runs, NEES, and the map."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path as FilePath
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Ellipse

from ssm_graph.base.frozen import Array
from ssm_graph.report.style import (
    ESTIMATE,
    INK,
    OUTLIER,
    REFERENCE,
    Curve,
    Panel,
    add_legend,
    draw_panel,
    line,
    looks_of,
    new_figure,
    save,
)
from ssm_graph.systems.landmark_slam.filters import MapFilter
from ssm_graph.systems.landmark_slam.methods import FILTERS, PAPER
from ssm_graph.systems.landmark_slam.models import Bicycle
from ssm_graph.systems.landmark_slam.simulator import CASES, Sigmas, World, simulate
from ssm_graph.systems.landmark_slam.study import Cell, StudyPlan, curve_steps, path_of

MAP_FIGURES: Final = {2: "ekf", 3: "ukf", 4: "naukf"}
"""Figure of the paper: method, noise as stated."""
CURVE_FIGURES: Final = {5: "G1", 8: "U1", 11: "E1"}
"""First of three figures of the paper (position, heading, landmarks): case."""
QUANTITIES: Final = (
    ("position", "mean position error, m"),
    ("heading", "mean heading error, deg"),
    ("landmarks", "mean landmark error, m"),
)
SIGMAS: Final = 3.0
"""Of the ellipses."""


def save_study_figures(
    folder: FilePath, plan: StudyPlan, cells: Mapping[tuple[str, str], Cell]
) -> list[FilePath]:
    """Write the figures that the study has runs for, and return their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = [
        save_map(folder / f"figure-{number:02d}-{method}.png", method, plan, number)
        for number, method in MAP_FIGURES.items()
        if method in plan.methods
    ]
    shown: list[str] = [m for m in (*PAPER, "guarded", "ukf-told") if m in plan.methods]
    for first, case in CURVE_FIGURES.items():
        own = [m for m in shown if (case, m) in cells]
        for i, (name, label) in enumerate(QUANTITIES):
            if own:
                path = folder / f"figure-{first + i:02d}-{case}-{name}.png"
                title = f"Figure {first + i}: {CASES[case].about}"
                curves = {m: cells[case, m].curves[i] for m in own}
                paths.append(_save_curves(path, title, label, curves, plan))
    return paths


def _save_curves(
    path: FilePath, title: str, label: str, curves: Mapping[str, Array], plan: StudyPlan
) -> FilePath:
    figure = new_figure(6.4, 3.2, title)
    looks = looks_of(curves)
    time_s = np.asarray((curve_steps(plan.n_steps) + 1) * World().step_s, dtype=np.float64)
    panel = Panel(
        x="time, s",
        y=f"{label} ({plan.n_runs} runs)",
        curves=[Curve(time_s, y, line(looks[m])) for m, y in curves.items()],
        y_limits=(0.0, None),
    )
    draw_panel(figure.subplots(), panel)
    add_legend(figure, list(curves), looks)
    return save(figure, path)


def save_map(path: FilePath, method: str, plan: StudyPlan, number: int) -> FilePath:
    """Draw one run of a filter: true and estimated path, landmarks with ellipses."""
    world = path_of(plan.n_steps)
    seeds = range(plan.first_seed, plan.first_seed + 1)
    runs = simulate(world, Sigmas(), CASES["stated"], seeds, reach_m=World().most_range_m)
    slam = FILTERS[method].begin(
        Bicycle(World().wheel_base_m),
        Sigmas().control,
        Sigmas().observation,
        world.pose[:1],
        capacity=len(world.landmarks),
        start_cov=1e-12 * np.eye(3),
    )
    assert isinstance(slam, MapFilter)
    poses = [world.pose[0]]
    for k, view in enumerate(world.in_view):
        slam.predict(runs.control[k])
        if len(view):
            slam.update(view.tolist(), runs.observed[k])
        poses.append(slam.pose[0].copy())
    covs = np.stack([slam.landmark(i)[1][0] for i in slam.ids])
    figure = new_figure(6.4, 5.2, f"Figure {number}: {method}, noise as stated, one run")
    draw_map(
        figure.subplots(),
        path=np.array(poses),
        landmarks=slam.landmarks()[0],
        landmark_cov=covs,
        true_path=world.pose,
        true_landmarks=world.landmarks,
    )
    return save(figure, path)


def draw_map(
    axes: Axes,
    *,
    path: Array,
    landmarks: Array,
    landmark_cov: Array,
    true_path: Array | None = None,
    true_landmarks: Array | None = None,
    labels: Sequence[str] = (),
) -> None:
    """Draw a path (K, 3) and landmarks (L, 2) with their ellipses, the truth where it is known."""
    curves = []
    options: dict[str, Any] = {"linestyle": "", "markerfacecolor": "none", "markersize": 5.0}
    if true_path is not None:
        look = {"color": REFERENCE, "linewidth": 1.0, "label": "true path"}
        curves.append(Curve(true_path[:, 0], true_path[:, 1], look))
    if true_landmarks is not None:
        look = {**options, "marker": "D", "color": REFERENCE, "label": "true landmarks"}
        curves.append(Curve(true_landmarks[:, 0], true_landmarks[:, 1], look))
    look = {"color": ESTIMATE, "linestyle": "--", "linewidth": 0.9, "label": "estimated path"}
    curves.append(Curve(path[:, 0], path[:, 1], look))
    look = {**options, "marker": "+", "color": OUTLIER, "label": "estimated landmarks, 3 sigma"}
    curves.append(Curve(landmarks[:, 0], landmarks[:, 1], look))
    for place, cov in zip(landmarks, landmark_cov, strict=True):
        if np.all(np.isfinite(cov)):
            axes.add_patch(ellipse(place, cov))
    where = {"loc": "upper left", "bbox_to_anchor": (1.0, 1.0)}
    draw_panel(axes, Panel(x="x, m", y="y, m", curves=curves, legend=where))
    axes.set_aspect("equal", adjustable="datalim")
    for label, place in zip(labels, landmarks, strict=False):
        axes.annotate(
            label, (float(place[0]), float(place[1])), xytext=(4.0, 3.0),
            textcoords="offset points", fontsize=5.0, color=INK,
        )  # fmt: skip


def ellipse(place: Array, cov: Array) -> Ellipse:
    """Return the ellipse of `SIGMAS` of a place (2,) with a covariance (2, 2)."""
    values, vectors = np.linalg.eigh(cov)
    width, height = 2.0 * SIGMAS * np.sqrt(np.maximum(values, 0.0))
    angle = float(np.degrees(np.arctan2(vectors[1, 0], vectors[0, 0])))
    x, y = float(place[0]), float(place[1])
    return Ellipse((x, y), width, height, angle=angle, fill=False, color=OUTLIER, linewidth=0.7)
