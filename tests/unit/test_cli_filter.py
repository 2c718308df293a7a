"""The filter command: every method, the same result folder, refusals."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from ssm_graph.base.errors import ConfigError
from ssm_graph.cli.filter import method_from
from ssm_graph.cli.main import ExitCode, main
from ssm_graph.io.results.tables import read_results
from ssm_graph.study.methods import RECURSIVE as METHODS


@pytest.fixture(scope="module")
def mission(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Simulate a minute, GNSS at its begin."""
    folder = tmp_path_factory.mktemp("filter") / "mission"
    words = ["simulate", "demo", "--duration", "60", "--seed", "3", "--out", str(folder)]
    assert main(words) == ExitCode.GOOD
    return folder


def without_initial(mission: Path, folder: Path) -> Path:
    """Copy the mission, but for its initial state."""
    folder.mkdir()
    for path in mission.iterdir():
        (folder / path.name).write_bytes(path.read_bytes())
    text = (folder / "mission.toml").read_text()
    begin, end = text.index("[initial]"), text.index("[reference]")
    (folder / "mission.toml").write_text(text[:begin] + text[end:])
    return folder


def summary_of(folder: Path) -> dict[str, object]:
    """Return the summary, read as strict JSON."""

    def refuse(word: str) -> None:
        raise AssertionError(f"{word} in summary.json")

    summary: dict[str, object] = json.loads(
        (folder / "summary.json").read_text(), parse_constant=refuse
    )
    return summary


@pytest.mark.parametrize(
    "method", ["ssm-log", "ssm-log+rts", "single-step", "fixed-lag-delayed:2", "geodetic-log:7"]
)
def test_the_result_folder_is_that_of_smooth(
    mission: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], method: str
) -> None:
    """Table, four files, exit code 0, and a position that the reference confirms."""
    words = ["filter", str(mission), "--method", method, "--out", str(tmp_path)]
    is_drawn = method == "ssm-log"
    assert main(words if is_drawn else [*words, "--no-figure"]) == ExitCode.GOOD
    shown = capsys.readouterr()
    assert "a keyframe" in shown.out
    assert re.search(r"keyframe (\d+) of \1, 100 %\n", shown.err)
    summary = summary_of(tmp_path)
    assert summary["status"] == "CONVERGED"
    assert summary["settings"]["method"] == method  # type: ignore[index]
    assert isinstance(summary["iterations"], float)
    assert summary["iterations"] >= 1.0
    assert summary["rmse_horizontal_m"] < 0.5  # type: ignore[operator]
    results = read_results(tmp_path)
    assert np.isfinite(results.trajectory["lat_deg"]).all()
    assert set(np.unique(results.beams["beam"])) == {1.0, 2.0, 3.0, 4.0}
    figure = tmp_path / "figure.png"
    assert figure.exists() == is_drawn
    assert not is_drawn or figure.stat().st_size > 10_000


def test_a_filter_without_defence_says_what_it_missed(mission: Path, tmp_path: Path) -> None:
    """Outliers in full weight: written all the same, marked, exit code 4."""
    words = ["filter", str(mission), "--method", "ekf", "--out", str(tmp_path), "--no-figure"]
    assert main(words) == ExitCode.NOT_GOOD
    summary = summary_of(tmp_path)
    assert summary["status"] == "SUSPECT"
    assert "miss the answer" in str(summary["reason"])


def test_a_filter_that_runs_away_says_when(mission: Path, tmp_path: Path) -> None:
    """What it found before is kept; the rest is empty, in the tables as in the summary."""
    words = ["filter", str(mission), "--method", "ssmkf-exp", "--out", str(tmp_path)]
    assert main(words) == ExitCode.NOT_GOOD
    summary = summary_of(tmp_path)
    assert summary["status"] == "DIVERGED"
    assert "ran away at" in str(summary["reason"])
    lat = read_results(tmp_path).trajectory["lat_deg"]
    assert np.isfinite(lat[0])
    assert np.isnan(lat[-1])


def test_the_start_is_found_where_it_is_missing(mission: Path, tmp_path: Path) -> None:
    """As for smooth, and said."""
    folder = without_initial(mission, tmp_path / "m")
    words = ["filter", str(folder), "--out", str(tmp_path / "out"), "--no-figure"]
    assert main(words) == ExitCode.GOOD
    summary = summary_of(tmp_path / "out")
    assert any(note.startswith("aligned: ") for note in summary["notes"])  # type: ignore[attr-defined]
    assert summary["rmse_horizontal_m"] < 1.5  # type: ignore[operator]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("ssm-lgo", "did you mean 'ssm-log'"),
        ("smoother-log", "is no filter"),
        ("oracle", "is no filter"),
        ("fixed-lag:-1", "--method.*zero or more seconds"),
        ("fixed-lag:x", "--method.*expected a number"),
        ("single-step:3", "--method.*expected no parameter"),
    ],
)
def test_what_is_no_filter_is_refused(text: str, message: str) -> None:
    """Before any work, with what would do."""
    with pytest.raises(ConfigError, match=message):
        method_from(text)


def test_methods_need_no_truth_and_go_forward() -> None:
    """Neither oracles nor smoothers of all keyframes at once are offered."""
    assert "ekf-oracle" not in METHODS
    assert not any(name.startswith("smoother") for name in METHODS)
    assert {"ekf", "ssm-log", "single-step", "fixed-lag", "geodetic-log"} <= set(METHODS)
