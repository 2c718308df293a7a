"""What people see: the table, the page, the progress; content and robustness, not pixels."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.figure import Figure
from rich.console import Console, RenderableType

from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import Array
from ssm_graph.base.progress import told
from ssm_graph.evaluation.errors import evaluate
from ssm_graph.mission.estimate import OUTLIER_WEIGHT, BeamTable, Estimate, Iteration, Status
from ssm_graph.report.mission.figure import draw_figure, save_figure
from ssm_graph.report.mission.summary import summary_table
from ssm_graph.report.style import (
    broken_at_gaps,
    save,
    thinned,
    thinned_outliers_first,
    time_axis,
)
from ssm_graph.report.terminal.progress import ProgressDisplay
from tests.estimate_fixture import NOTES, calibrated, make_run, with_current, with_faults

N_PANELS = 14
"""Of a page with a reference, without current and calibration."""
NO_BEAMS = BeamTable(*[np.empty(0)] * 5)


def text_of(renderable: RenderableType, *, color: bool = False) -> str:
    """Return what a terminal of 120 columns shows."""
    console = Console(file=io.StringIO(), width=120, force_terminal=color, no_color=not color)
    console.print(renderable)
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


def row(text: str, heading: str) -> list[str]:
    """Return the words behind ``heading``."""
    (line,) = [line for line in text.splitlines() if line.strip().startswith(heading)]
    return line.split(heading)[1].split()


def shorten(estimate: Estimate, n: int) -> Estimate:
    """Return the first ``n`` keyframes."""
    trajectory = estimate.trajectory
    cut = {name: getattr(trajectory, name)[:n] for name in trajectory.__dataclass_fields__}
    return replace(estimate, trajectory=replace(trajectory, **cut), beams=NO_BEAMS)


def test_a_current_is_told_and_drawn() -> None:
    """Three numbers a row; a panel of its own below the beams, without what is not estimated."""
    estimate, reference = make_run()
    estimate = with_current(estimate)
    text = text_of(summary_table(estimate))
    assert row(text, "mean sigma east, north, up, m/s") == ["0.02", "0.02", "0"]
    assert "Current of the water" not in text_of(summary_table(make_run()[0]))
    figure = draw_figure(estimate, reference)
    (panel,) = [axes for axes in figure.axes if axes.get_title(loc="left").startswith("Current")]
    assert [line.get_label() for line in panel.get_lines()] == ["east", "north"]
    assert len(figure.axes) == N_PANELS + 1


def test_who_was_off_is_told_and_drawn(tmp_path: Path) -> None:
    """A row a sensor, red where the answer may be wrong for it, and a bar from when to when."""
    estimate, reference = make_run()
    estimate = with_faults(estimate)
    text = text_of(summary_table(estimate))
    assert "Sensors that were off" in text
    assert "3.1 m to the east" in text
    assert "or it is DVL, 0.20 m/s to the north" in " ".join(text.split())
    assert "Sensors that were off" not in text_of(summary_table(make_run()[0]))
    figure = draw_figure(estimate, reference)
    (panel,) = [a for a in figure.axes if a.get_title(loc="left").startswith("Sensors that")]
    assert [label.get_text() for label in panel.get_yticklabels()] == ["DVL beam 2", "GNSS"]
    first, second = (container[0] for container in panel.containers)
    assert (first.get_x(), first.get_width()) == pytest.approx((3.0, 2.0))
    assert first.get_facecolor() != second.get_facecolor()
    assert len(figure.axes) == N_PANELS + 1
    save(figure, tmp_path / "figure.png", dpi=40)


def test_a_calibration_is_drawn_in_sigmas_before(tmp_path: Path) -> None:
    """A panel of its own, beside that of a current; each value has a place and the sign it has."""
    estimate, reference = make_run()
    estimate = calibrated(with_current(estimate), gnss_sigma=0.1)
    assert estimate.calibration is not None
    figure = draw_figure(estimate, reference)
    (panel,) = [a for a in figure.axes if a.get_title(loc="left").startswith("Calibration")]
    labels = [label.get_text().split("\n") for label in panel.get_xticklabels()]
    assert [name for name, _ in labels] == [v.label for v in estimate.calibration.values]
    assert labels[0] == ["dvl_scale_error", "-0.02"]
    assert labels[3] == ["dvl_mounting_z_deg", "2"]
    centres = [c.lines[0].get_ydata()[0] for c in panel.containers]  # type: ignore[attr-defined]
    np.testing.assert_allclose(centres[0], -0.02 / 0.03)
    assert len(figure.axes) == N_PANELS + 2
    save(figure, tmp_path / "figure.png", dpi=40)


def test_table_tells_the_run() -> None:
    """Numbers with their units, in the units of the result files."""
    estimate, reference = make_run()
    metrics = evaluate(estimate.trajectory, reference)
    text = text_of(summary_table(estimate, metrics))
    assert row(text, "status")[0] == "CONVERGED"
    assert estimate.reason in text
    assert row(text, "keyframes") == ["300"]
    assert row(text, "beam speeds used") == ["1200"]
    n_outliers = int(np.sum(estimate.beams.weight < 0.05))
    assert row(text, "outliers, weight < 0.05")[0] == str(n_outliers)
    assert sum(int(x.strip(",")) for x in row(text, "outliers of beams 1 to 4")) == n_outliers
    assert row(text, "gyro bias x, y, z, deg/h") == ["0.02063", "-0.04125", "0.06188"]
    assert row(text, "accelerometer bias x, y, z, ug") == ["30.59", "-10.2", "20.39"]
    assert row(text, "horizontal error, rms, m") == [f"{metrics.rmse_horizontal_m:.4g}"]
    assert row(text, "drift, % of path length") == [f"{metrics.drift_percent:.4g}"]
    assert row(text, "NEES of position / 3, expected 1") == [f"{metrics.nees_position:.4g}"]
    assert f"note: {NOTES[0]}" in text


@pytest.mark.parametrize("status", Status)
def test_every_status_has_its_colour(status: Status) -> None:
    """Good is green and nothing else is."""
    estimate, _ = make_run(n=5, status=status)
    text = text_of(summary_table(estimate), color=True)
    assert status.name in text
    assert (f"\x1b[1;32m{status.name}" in text) == status.is_good


def test_table_without_reference_or_content() -> None:
    """No comparison, no beams, no keyframes, markup in a note: still a table."""
    estimate, reference = make_run(n=20)
    assert "Against the reference" not in text_of(summary_table(estimate))
    estimate = replace(shorten(estimate, 0), notes=("[bold]not markup[/]",))
    text = text_of(summary_table(estimate))
    assert "no keyframes" in text
    assert "[bold]not markup[/]" in text
    unknown = replace(reference, velocity_enu=np.full((20, 3), np.nan))
    estimate, _ = make_run(n=20)
    text = text_of(summary_table(estimate, evaluate(estimate.trajectory, unknown)))
    assert row(text, "velocity error, rms, m/s") == ["–"]


def panels(figure: Figure) -> dict[str, list[str]]:
    """Return title or y label of all axes, and the labels of their curves."""
    return {
        axes.get_title(loc="left") or axes.get_ylabel(): [
            str(line.get_label()) for line in axes.get_lines()
        ]
        for axes in figure.axes
    }


def test_page_shows_errors_with_a_reference() -> None:
    """Fourteen panels; every axis says its unit."""
    estimate, reference = make_run(n=100, outlier_share=0.2)
    figure = draw_figure(estimate, reference, title="lawn-mower")
    found = panels(figure)
    assert {"Track", "Position error", "Velocity error", "Heading error", "Beam 4"} <= set(found)
    assert found["Track"] == [
        "reference",
        "estimate",
        "beam weight < 0.05 (60 pings)",
        "start",
        "end",
    ]
    assert len(figure.axes) == N_PANELS
    for axes in figure.axes:
        for label in (axes.get_xlabel(), axes.get_ylabel()):
            assert label == "" or ", " in label


@pytest.mark.parametrize("n_beams", [1, 3, 8])
def test_page_and_table_of_any_number_of_beams(n_beams: int) -> None:
    """A column of panels and a count of outliers for each beam that there is."""
    estimate, reference = make_run(n=100, outlier_share=0.2)
    beam = 1.0 + np.arange(float(len(estimate.beams.beam))) % n_beams
    estimate = replace(estimate, beams=replace(estimate.beams, beam=beam), noise=None)
    found = panels(draw_figure(estimate, reference))
    named = [name for name in found if name.startswith("Beam ")]
    assert named == [f"Beam {i + 1}" for i in range(n_beams)]
    shown = text_of(summary_table(estimate))
    (row,) = (line for line in shown.splitlines() if "outliers of beams" in line)
    assert f"outliers of beams 1 to {n_beams} " in row
    counts = [int(word) for word in row.split(f"1 to {n_beams}")[1].replace(",", " ").split()]
    assert len(counts) == n_beams
    assert sum(counts) == (estimate.beams.weight < OUTLIER_WEIGHT).sum()


def test_page_shows_bounds_without_a_reference() -> None:
    """The same page; a reference of another time is as good as none."""
    estimate, reference = make_run(n=50)
    for other in (None, replace(reference, time_s=reference.time_s + 1e6)):
        found = panels(draw_figure(estimate, other))
        assert {"Position uncertainty", "Velocity uncertainty", "Heading uncertainty"} <= set(found)
        assert "reference" not in found["Track"]


def degenerate(name: str) -> Estimate:
    """Return estimates that nobody wants to see and a figure must survive."""
    estimate, _ = make_run(n=30)
    trajectory, n = estimate.trajectory, 30
    if name == "one keyframe":
        return shorten(estimate, 1)
    if name == "no beams":
        return replace(estimate, beams=NO_BEAMS)
    if name == "no noise":
        beams = replace(estimate.beams, innovation=np.zeros(120), weight=np.ones(120))
        return replace(estimate, beams=beams)
    nan = np.full(n, np.nan)
    lost = replace(
        trajectory,
        lat=nan,
        lon=nan,
        height=nan,
        velocity_enu=np.full((n, 3), np.nan),
        position_cov_enu=np.full((n, 3, 3), np.nan),
        velocity_sigma_enu=np.full((n, 3), np.nan),
        attitude_sigma=np.full((n, 3), np.nan),
    )
    return replace(estimate, trajectory=lost, status=Status.DIVERGED)


@pytest.mark.parametrize("name", ["one keyframe", "no beams", "no noise", "diverged"])
def test_page_survives(tmp_path: Path, name: str) -> None:
    """With and without a reference, and no warning on the way."""
    _, reference = make_run(n=30)
    draw_figure(degenerate(name))
    if name in ("one keyframe", "diverged"):  # to lay it out takes most of a second
        save(draw_figure(degenerate(name), reference), tmp_path / "page.png", dpi=40)
        assert [path.name for path in tmp_path.iterdir()] == ["page.png"]


def test_figure_is_saved_without_side_effects(tmp_path: Path) -> None:
    """A PNG of legible size; no global setting changed; errors name the path."""
    estimate, reference = make_run(n=60)
    before = dict(mpl.rcParams)
    save_figure(tmp_path / "page.png", estimate, reference)
    assert dict(mpl.rcParams) == before
    data = (tmp_path / "page.png").read_bytes()
    assert data.startswith(b"\x89PNG")
    assert int.from_bytes(data[16:20], "big") > 1200
    with pytest.raises(DataError, match=r"none/page\.png: cannot write"):
        save_figure(tmp_path / "none" / "page.png", estimate)
    with pytest.raises(DataError, match=r"page\.xyz: cannot write"):
        save_figure(tmp_path / "page.xyz", estimate)
    with pytest.raises(DataError, match="without keyframes"):
        save_figure(tmp_path / "page.png", shorten(estimate, 0))
    assert [path.name for path in tmp_path.iterdir()] == ["page.png"]


def test_thinning_keeps_ends_and_outliers() -> None:
    """Long series lose points, but neither the ends nor what matters."""
    assert np.array_equal(thinned(7, 10), np.arange(7))
    index = thinned(100_000, 500)
    assert len(index) == 500
    assert (index[0], index[-1]) == (0, 99_999)
    weight = np.ones(50_000)
    outliers = np.arange(17, 50_000, 1000)
    weight[outliers] = 0.01
    index = thinned_outliers_first(weight, 400)
    assert len(index) == 400
    assert np.all(np.diff(index) > 0)
    assert np.isin(outliers, index).all()


def test_lines_break_and_axes_scale() -> None:
    """A hole of the reference is not drawn over; hours are not counted in seconds."""
    time_s: Array = np.r_[np.arange(0.0, 5.0), np.arange(60.0, 65.0)]
    since, values = broken_at_gaps(time_s, np.column_stack([time_s, time_s]))
    assert np.flatnonzero(np.isnan(since)).tolist() == [5]
    assert np.isnan(values[5]).all()
    assert time_axis(np.array([0.0, 600.0])) == (1.0, "time since start, s")
    assert time_axis(np.array([0.0, 3600.0])) == (60.0, "time since start, min")
    assert time_axis(np.array([0.0, 36_000.0])) == (3600.0, "time since start, h")


def run_display(console: Console, count: int) -> str:
    """Return what the display writes during ``count`` iterations."""
    with ProgressDisplay(console) as show:
        show.stage("reading the mission")
        show.stage("smoothing")
        for index in range(1, count + 1):
            show(
                index, 50, Iteration(update_sigmas=10.0 / index, weight_change=0.5, kernel="[log]")
            )
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


def test_progress_in_a_file_is_a_few_plain_lines() -> None:
    """No control characters; first, every tenth and last iteration."""
    text = run_display(Console(file=io.StringIO(), width=40), 23)
    lines = text.splitlines()
    assert lines[:2] == ["reading the mission", "smoothing"]
    assert [line.split()[1] for line in lines[2:]] == ["1", "10", "20", "23"]
    assert lines[2] == "iteration 1 of at most 50: update 10 sigma, weights 0.5, [log]"
    assert text.isprintable() or set(text) - {"\n"} <= {c for c in text if c.isprintable()}


def test_progress_on_a_terminal_leaves_nothing() -> None:
    """A live line that is wiped in the end, also when the work fails."""
    console = Console(
        file=io.StringIO(),
        width=100,
        force_terminal=True,
        force_interactive=True,
        _environ={"TERM": "xterm"},
    )
    text = run_display(console, 3)
    assert "\x1b[" in text
    assert "3 of at most 50: update 3.3 sigma" in text
    assert text.rstrip().endswith("\x1b[2K")


def test_shares_of_long_work_are_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    """In steps of a fifth, and only of what takes long; a second piece counts for itself."""
    now = [0.0]
    monkeypatch.setattr("ssm_graph.report.terminal.progress.time.monotonic", lambda: now[0])
    stream = io.StringIO()
    assert list(told(range(3), 3)) == [0, 1, 2]  # nobody listens
    with ProgressDisplay(Console(file=stream, width=200)) as show:
        show.stage("reading")
        for seconds in (0.01, 0.1):
            for _ in told(["abcd"] * 128, 512, size=len):
                now[0] += seconds
    first, *shares = stream.getvalue().splitlines()
    assert first == "reading"
    assert shares == [f"reading: {share}%" for share in (20, 41, 61, 81)]
