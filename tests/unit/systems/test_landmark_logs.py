"""Folders of landmarks, association, the two commands."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ssm_graph.base.errors import ConfigError, DataError
from ssm_graph.base.frozen import Array
from ssm_graph.cli.main import main
from ssm_graph.systems.landmark_slam.association import (
    Association,
    AssociationSettings,
    associate,
    association_errors,
)
from ssm_graph.systems.landmark_slam.folder import read_landmark_folder, write_landmark_folder
from ssm_graph.systems.landmark_slam.logs import (
    LONGEST_STEP_S,
    LandmarkLog,
    aligned,
    problem_of_log,
)
from ssm_graph.systems.landmark_slam.problem import UNKNOWN, SlamNoise
from ssm_graph.systems.landmark_slam.recorded import (
    VICTORIA_GRAPH,
    read_graph,
    read_victoria_park,
)

DATA = Path(os.environ.get("SSM_GRAPH_DATA", "/nowhere")) / "systems"
PLACES = np.array([[3.0, 2.0], [-2.0, 4.0], [1.0, 6.0], [5.0, 5.0], [-1.0, -1.5]])


def log_of(seed: int = 0) -> LandmarkLog:
    """Return a drive of 60 s in circles among five landmarks, all seen twice a second."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, 60.0, 0.1)
    turn = np.full(len(t), 0.2)
    heading = 0.2 * t
    truth = np.column_stack([2.5 * np.sin(heading), 2.5 * (1.0 - np.cos(heading)), heading])
    seen_s, seen, names = [], [], []
    for at in range(5, len(t), 5):
        d = PLACES - truth[at, :2]
        z = np.column_stack([np.hypot(*d.T), np.arctan2(d[:, 1], d[:, 0]) - heading[at]])
        z += np.array([0.05, 0.01]) * rng.standard_normal(z.shape)
        z[:, 1] = (z[:, 1] + np.pi) % (2.0 * np.pi) - np.pi
        seen.append(z)
        seen_s += [t[at]] * len(d)
        names += list(range(10, 15))
    speed = np.column_stack([np.full(len(t), 0.5), np.zeros(len(t))])
    speed[:, 0] += 0.02 * rng.standard_normal(len(t))
    noise = SlamNoise(np.array([0.02, 0.01, 0.02]), np.array([0.05, 0.01]))
    return LandmarkLog(
        t,
        speed,
        turn + 0.02 * rng.standard_normal(len(t)),
        np.array(seen_s),
        np.concatenate(seen),
        np.array(names),
        noise,
        t,
        truth,
    )


def test_a_folder_comes_back_as_it_was(tmp_path: Path) -> None:
    """Every number of a log, to rounding of degrees."""
    log = log_of()
    write_landmark_folder(tmp_path, log)
    back = read_landmark_folder(tmp_path)
    for name in ("odometry_s", "speed", "turn_rate", "seen", "landmark", "truth"):
        assert getattr(back, name) == pytest.approx(getattr(log, name), abs=1e-12), name
    assert back.noise.observation == pytest.approx(log.noise.observation)


def test_the_command_solves_a_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Tables, summary and figure; a truth is compared with."""
    write_landmark_folder(tmp_path / "log", log_of())
    assert main(["slam", str(tmp_path / "log"), "--out", str(tmp_path / "out")]) == 0
    summary = json.loads((tmp_path / "out/summary.json").read_text())
    assert summary["status"] == "CONVERGED"
    assert summary["score"]["position_m"] < 0.05
    rows = np.loadtxt(tmp_path / "out/landmarks.csv", delimiter=",", skiprows=1)
    first = problem_of_log(log_of()).start
    assert first[2] == pytest.approx(0.1)  # the first keyframe is where something was seen
    assert rows[:, 1:3] == pytest.approx(PLACES, abs=0.1)
    assert (tmp_path / "out/figure.png").stat().st_size > 10_000
    assert "position rms" in capsys.readouterr().out


def test_a_truth_without_headings(tmp_path: Path) -> None:
    """GPS: the aligned error counts, and nothing is said of headings."""
    log = log_of()
    truth = log.truth.copy()
    truth[:, 2] = np.nan
    write_landmark_folder(tmp_path / "log", replace(log, truth=truth))
    assert main(["slam", str(tmp_path / "log"), "--out", str(tmp_path / "out")]) == 0
    score = json.loads((tmp_path / "out/summary.json").read_text())["score"]
    assert score["heading_deg"] is None
    assert score["aligned_m"] < 0.05


@pytest.mark.skipif(not DATA.is_dir(), reason="SSM_GRAPH_DATA has no systems")
def test_victoria_park_has_times() -> None:
    """The graph's way is that of the raw log: its turns come out at the times found by the way."""
    log = read_victoria_park(DATA / "victoria_park")
    assert len(log.odometry_s) == 61_945
    graph, _ = read_graph(DATA / "victoria_park" / VICTORIA_GRAPH)
    problem = problem_of_log(log)
    seen = np.unique(graph.keyframe)
    assert len(np.unique(problem.keyframe)) == pytest.approx(len(seen), abs=5)
    assert np.diff(problem.time_s).max() <= LONGEST_STEP_S + 1e-9
    theirs = np.append(0.0, np.cumsum(graph.control[:, 2]))[seen[[0, -1]]]
    assert problem.control[:, 2].sum() == pytest.approx(theirs[1] - theirs[0], abs=0.01)


@pytest.mark.parametrize("kind", [Association.NEAREST, Association.JOINT])
def test_landmarks_without_names_are_found(kind: Association) -> None:
    """Each once, after three sightings, without an error."""
    log = log_of()
    problem = problem_of_log(replace(log, landmark=np.full(len(log.landmark), UNKNOWN)))
    found = associate(problem, log.noise, AssociationSettings(kind))
    errors = association_errors(found.landmark, log.landmark)
    assert len(found.problem.names) == len(PLACES)
    assert errors.n_wrong == 0
    assert errors.n_split == 0
    assert errors.n_left_out < 0.05 * errors.n


def change(log: LandmarkLog, name: str, row: int, value: float, column: int = 0) -> LandmarkLog:
    """Return a log with one number changed."""
    values: Array = getattr(log, name).copy()
    values[(row, column) if values.ndim == 2 else row] = value
    given: dict[str, Any] = {name: values}
    return replace(log, **given)


@pytest.mark.parametrize(
    ("name", "row", "value", "column", "said"),
    [
        ("seen", 3, 45.0, 1, "row 4: expected a bearing in radians, got 45; is it in degrees"),
        ("seen", 2, -1.0, 0, "row 3: expected a range above 0 m"),
        ("odometry_s", 5, 0.1, 0, "time goes from 0.400 to 0.100 s in row 6"),
        ("landmark", 1, 10, 0, "landmark 10 is there twice at 0.500 s"),
        ("odometry_s", 5, np.nan, 0, "expected finite times, got NaN in row 6"),
    ],
)
def test_bad_logs_are_refused(name: str, row: int, value: float, column: int, said: str) -> None:
    """With the place and what to try."""
    with pytest.raises(DataError, match=said):
        change(log_of(), name, row, value, column)


def test_bad_settings_are_refused(tmp_path: Path) -> None:
    """Unknown keys, negative sigmas, both kinds of range sigma."""
    write_landmark_folder(tmp_path, log_of())
    path = tmp_path / "landmarks.toml"
    good = path.read_text()
    for old, new, said in (
        (
            "range_sigma_m = 0.05",
            "range_sigma_m = -0.05",
            r"range_sigma_m: expected a number above",
        ),
        ("range_sigma_m = 0.05", "range_sigm_m = 0.05", "did you mean 'range_sigma_m'"),
        ("range_sigma_m = 0.05", "range_sigma_m = 0.05\nrange_sigma_share = 0.1", "got both"),
        ("range_sigma_m = 0.05\n", "", "got none"),
    ):
        assert old in good
        path.write_text(good.replace(old, new))
        with pytest.raises(ConfigError, match=said):
            read_landmark_folder(tmp_path)


def test_alignment_undoes_a_turn() -> None:
    """Rotation and shift of a path."""
    rng = np.random.default_rng(0)
    path = rng.normal(size=(30, 2))
    c, s = np.cos(0.7), np.sin(0.7)
    R = np.array([[c, -s], [s, c]])
    rotation, shift = aligned(path, path @ R.T + np.array([1.0, 2.0]))
    assert rotation == pytest.approx(R)
    assert shift == pytest.approx([1.0, 2.0])


def test_the_study_goes_on_where_it_was(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A small study: page and figures; the second time nothing is done anew."""
    words = ["slam-study", "--out", str(tmp_path), "--runs", "2", "--steps", "40", "--jobs", "1"]
    words += ["--methods", "ekf,ukf,naukf", "--cases", "stated,G1"]
    assert main(words) == 0
    text = capsys.readouterr().out
    assert "The paper says" in text
    assert text.count("| naukf |") == 2
    names = sorted(path.name for path in (tmp_path / "figures").glob("*.png"))
    assert names[0] == "figure-02-ekf.png"
    assert "figure-07-G1-landmarks.png" in names
    before = (tmp_path / "trials.jsonl").read_bytes()
    assert main([*words, "--no-figures"]) == 0
    assert (tmp_path / "trials.jsonl").read_bytes() == before
    assert before.count(b"\n") == 7  # settings and six batches


def test_a_graph_with_shared_keys(tmp_path: Path) -> None:
    """Poses and landmarks are numbered together in GTSAM's text."""
    path = tmp_path / "graph.txt"
    odometry = "0.0001 0 0 4e-06 0 4e-06"
    path.write_text(
        f"ODOMETRY 0 1 1.0 0.0 0.1 {odometry}\nLANDMARK 1 2 3.0 4.0 0.4 0 0.4\n"
        f"ODOMETRY 1 3 1.0 0.0 0.1 {odometry}\n"
    )
    problem, noise = read_graph(path)
    assert len(problem.time_s) == 3
    assert problem.measured[0] == pytest.approx([5.0, np.arctan2(4.0, 3.0)])
    assert noise.control == pytest.approx([0.01, 0.002, 0.002])
    path.write_text(f"ODOMETRY 0 1 1 0 0 {odometry}\nODOMETRY 7 8 1 0 0 {odometry}\n")
    with pytest.raises(DataError, match=":2: expected odometry from the last pose"):
        read_graph(path)


@pytest.mark.skipif(not (DATA / "mrclam").is_dir(), reason="no MRCLAM data in SSM_GRAPH_DATA")
@pytest.mark.slow
def test_mrclam(tmp_path: Path) -> None:
    """A robot of the set that settings were chosen on."""
    folder = DATA / "mrclam/MRCLAM_Dataset7"
    assert main(["slam", str(folder), "--robot", "5", "--out", str(tmp_path)]) == 0
    score = json.loads((tmp_path / "summary.json").read_text())["score"]
    assert score["aligned_m"] < 0.13
    assert score["position_m"] < 0.2
