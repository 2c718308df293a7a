"""``ssm-graph visual``: verdicts, files, exit codes, what it says of input that cannot be used."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ssm_graph.cli.main import main
from ssm_graph.cli.visual import lines
from ssm_graph.systems.visual_ranges.accuracy import accuracy
from ssm_graph.systems.visual_ranges.camera import Camera
from ssm_graph.systems.visual_ranges.figures import write_figures
from ssm_graph.systems.visual_ranges.outputs import told_events, write_outputs
from ssm_graph.systems.visual_ranges.page import write_page
from ssm_graph.systems.visual_ranges.path_file import PathAsItComes
from ssm_graph.systems.visual_ranges.ranges import screened_ranges
from ssm_graph.systems.visual_ranges.ranging import Anchor, AnchorState, RangingResult
from ssm_graph.systems.visual_ranges.ranging_result import VehicleResult
from ssm_graph.systems.visual_ranges.recording import write_recording
from ssm_graph.systems.visual_ranges.result import FrameNow, FrameState, MapSnapshot, VisualResult
from ssm_graph.systems.visual_ranges.sequence import PathTruth, Sequence
from ssm_graph.systems.visual_ranges.similarity3 import Sim3
from ssm_graph.systems.visual_ranges.start import StartState
from ssm_graph.systems.visual_ranges.verdict import Verdict, judged

pytest.importorskip("cv2")
CAMERA = Camera(320, 240, 230.0, 230.0, 159.5, 119.5)
N, SCALE, ANCHOR = 30, 2.5, np.array([1.0, -0.5, 4.0])
TIMES = np.linspace(0.0, 2.9, N)
WORLD = Sim3(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), np.array([5.0, 6.0, 1.0]))
"""Metres of the map to the world of the truth."""


def made(*, blur_px: float = 0.0, bent: float = 0.0) -> tuple[Sequence, VisualResult]:
    """Return a recording and an answer without error, but for those asked for, in pixels."""
    rng = np.random.default_rng(3)
    centre = np.stack([0.4 * np.sin(TIMES), 0.1 * np.cos(2 * TIMES), 0.2 * TIMES], 1)
    points = rng.uniform([-1.5, -1, 2], [1.5, 1, 5], (300, 3))
    pixels, which, first = [], [], [0]
    keys = np.arange(0, N, 5)
    for k in keys:
        seen = CAMERA.project(points - centre[k])
        inside = np.flatnonzero(CAMERA.contains(seen))
        out = seen[inside] - [CAMERA.cx, CAMERA.cy]
        radius = np.linalg.norm(out, axis=1, keepdims=True)
        seen = seen[inside] + bent * (radius / 200.0) ** 3 * out / radius
        pixels.append(seen + rng.normal(0.0, 0.05 + blur_px, seen.shape))
        which.append(inside)
        first.append(first[-1] + len(inside))
    point = np.concatenate(which)
    eye = np.broadcast_to(np.eye(3), (N, 3, 3))
    world = MapSnapshot(
        image=keys, time_s=TIMES[keys], R_cw=eye[keys].copy(), t_cw=-centre[keys],
        covariance=np.tile(1e-6 * np.eye(6), (len(keys), 1, 1)), points=points,
        points_views=np.bincount(point, minlength=300),
        points_grey=np.full(300, 99, np.uint8), points_descriptor=np.zeros((300, 32), np.uint8),
        first_row=np.array(first), pixels=np.concatenate(pixels).astype(np.float32),
        octave=np.zeros(len(point), np.int64), descriptor=np.zeros((len(point), 32), np.uint8),
        point=point, weight=np.ones(len(point)),
    )  # fmt: skip
    path = WORLD.apply(SCALE * centre)
    ranges = screened_ranges(TIMES, ["A"] * N, np.linalg.norm(SCALE * centre - ANCHOR, axis=1))
    sequence = Sequence(
        "made", CAMERA, TIMES, lambda k: np.full((240, 320), 90 + k, np.uint8), ranges,
        truth=PathTruth(TIMES, path, np.tile([0.0, 0, 0, 1], (N, 1))),
        anchor_truth_m=WORLD.apply(ANCHOR[None] + [0.3, 0.0, 0.0]), notes=("a note",),
    )  # fmt: skip
    result = VisualResult(
        name="made", camera=CAMERA, time_s=TIMES,
        state=np.full(N, FrameState.TRACKED, dtype=np.int64), R_cw=eye.copy(), t_cw=-centre,
        key_frame=np.arange(N) // 5, n_tracked=np.full(N, 200), map=world,
        ranging=ranging(AnchorState.READY, StartState.READY), events=("0.10 s: map started",),
        timing_s={"frame": np.full(N, 0.01)},
    )  # fmt: skip
    return sequence, result


def ranging(anchor: AnchorState, state: StartState) -> RangingResult:
    """Return scale and an anchor in a state."""
    has_scale = state.has_scale
    mirror = ANCHOR[None] * [1, -1, 1] if anchor is AnchorState.AMBIGUOUS else np.zeros((0, 3))
    place = ANCHOR.copy() if has_scale else np.full(3, np.nan)
    one = Anchor("A", anchor, place, 0.01 * np.eye(3), 0.05, 0.02, mirror, N, 0.1)
    return RangingResult(
        state, SCALE if has_scale else float("nan"), 0.004, 0.0, 0.01, (one,), np.full(N, 0.01),
        np.ones(N), np.zeros(N, dtype=np.int64), np.array([[0.5, 2.4, 0.01], [2.0, 2.5, 0.004]]),
        ("scale known to 9.1 %",), "move up by 0.5 m", 0.5,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("anchor", "state", "verdict", "is_good"),
    [
        (AnchorState.READY, StartState.READY, Verdict.READY, True),
        (AnchorState.AMBIGUOUS, StartState.MIRROR, Verdict.MIRROR, True),
        (AnchorState.DOUBTFUL, StartState.READY, Verdict.DOUBTFUL, False),
        (AnchorState.READY, StartState.COARSE, Verdict.DOUBTFUL, False),
        (AnchorState.UNKNOWN, StartState.AMBIGUOUS, Verdict.AMBIGUOUS, False),
        (AnchorState.UNKNOWN, StartState.REFUSED, Verdict.AMBIGUOUS, False),
    ],
)
def test_verdicts_of_scale_and_anchors(
    anchor: AnchorState, state: StartState, verdict: Verdict, is_good: bool
) -> None:
    """Each state of the ranges has its verdict; advice goes with those that lack something."""
    _, result = made()
    found = judged(replace(result, ranging=ranging(anchor, state)))
    assert (found.verdict, found.verdict.is_good) == (verdict, is_good)
    assert bool(found.advice) == (verdict is not Verdict.READY)
    assert judged(replace(result, ranging=None)).verdict is Verdict.NO_SCALE


def test_doubts_of_calibration_and_losses() -> None:
    """Errors of pixels, errors that grow outwards, images without a pose: each told."""
    found = judged(made(blur_px=2.0)[1])
    assert found.verdict is Verdict.DOUBTFUL
    assert "median reprojection error is" in found.reasons[0]
    assert "errors grow outwards to 2.9 px" in judged(made(bent=3.0)[1]).reasons[0]
    _, result = made()
    lost = result.state.copy()
    lost[10:25] = FrameState.LOST
    assert "15 of 30 images after the start" in judged(replace(result, state=lost)).reasons[0]


def test_files_of_an_answer(tmp_path: Path) -> None:
    """Everything in metres, errors against the truth."""
    sequence, result = made()
    found, off = judged(result), accuracy(sequence, result)
    assert off is not None
    assert off.metric_m == pytest.approx(0.0, abs=1e-9)
    assert off.scale_error == pytest.approx(0.0, abs=1e-9)
    assert off.anchor_m[0] == pytest.approx(0.3)
    write_outputs(tmp_path, sequence, result, found, off, ("images: 1 are black: 7",))
    rows = np.loadtxt(tmp_path / "trajectory.tum")
    np.testing.assert_allclose(rows[:, 1:4], SCALE * result.position, atol=1e-8)
    np.testing.assert_allclose(rows[:, 4:], np.tile([0, 0, 0, 1.0], (N, 1)), atol=1e-9)
    with np.load(tmp_path / "covariance.npz") as archive:
        sigma = np.sqrt(np.diagonal(archive["covariance"][0]))
    np.testing.assert_allclose(sigma, [2.5e-3] * 3 + [1e-3] * 3)
    ply = (tmp_path / "map.ply").read_bytes()
    head, _, body = ply.partition(b"end_header\n")
    n = int(head.split(b"element vertex ")[1].split()[0])
    assert n == int((result.map.points_views >= 2).sum()) + N + 1
    assert len(body) == 20 * n
    anchor = (tmp_path / "anchors.csv").read_text().splitlines()[1].split(",")
    assert anchor[:5] == ["A", "READY", "1", "-0.5", "4"]
    summary = json.loads((tmp_path / "result.json").read_text())
    assert summary["verdict"] == "READY"
    assert summary["notes"] == ["a note", "images: 1 are black: 7"]
    assert summary["against_truth"]["anchor_error_m"] == [pytest.approx(0.3)]


def test_a_recording_for_rerun(tmp_path: Path) -> None:
    """What the viewer is given: every pose, the key frames' images, anchors, ranges, events."""
    reader = pytest.importorskip("rerun.chunk").RrdReader
    sequence, result = made()
    assert result.ranging is not None
    (one,) = result.ranging.anchors
    ranging = replace(result.ranging, anchors=(replace(one, name="A/1 from 3.0 s"),))
    write_recording(tmp_path / "recording.rrd", sequence, replace(result, ranging=ranging))
    chunks: dict[str, int] = {}
    for chunk in reader(tmp_path / "recording.rrd").stream().to_chunks():
        name = str(chunk.entity_path)
        chunks[name] = chunks.get(name, 0) + chunk.num_rows
    assert chunks["/map/camera"] == N + 1
    assert chunks["/map/camera/image"] == len(result.map.image)
    anchor = r"A\/1\ from\ 3.0\ s"  # one name, not a path
    assert chunks[f"/ranges/weight/{anchor}"] == N
    assert {"/map/points", "/map/path", f"/map/anchors/{anchor}", "/events"} <= set(chunks)


def test_an_answer_by_the_vehicle_alone(tmp_path: Path) -> None:
    """Without any range: metres, READY, and the vertical in the files."""
    sequence, result = made()
    none, own = np.zeros(0), result.ranging
    told = VehicleResult(
        np.array([0.0, 0.8, 0.6]), 1e-6 * np.eye(2), 3.0, SCALE, 0.004, np.nan, np.nan, ""
    )
    own = replace(
        own, anchors=(), error_m=none, weight=none, anchor_of=np.zeros(0, np.intp), vehicle=told
    )
    result = replace(result, ranging=own)
    sequence = replace(sequence, ranges=screened_ranges([], [], []), anchor_truth_m=None)
    found, off = judged(result), accuracy(sequence, result)
    assert found.verdict is Verdict.READY
    assert off is not None
    assert off.metric_m < 1e-6
    write_outputs(tmp_path, sequence, result, found, off, ())
    figures = write_figures(tmp_path, sequence, result, found, off)
    write_page(tmp_path / "report.html", sequence, result, found, off, figures, ())
    assert "There were no anchors." in (tmp_path / "report.html").read_text()
    answer = json.loads((tmp_path / "result.json").read_text())
    assert answer["vehicle"]["down_map_axes"] == [0.0, 0.8, 0.6]
    assert answer["vehicle"]["range_unit_m"] is None
    assert any("down is 0.000, 0.800, 0.600" in line for line in lines(result, found, off))
    doubted = replace(own, vehicle=replace(told, contradiction="the DVL against anchor A"))
    found = judged(replace(result, ranging=doubted))
    assert (found.verdict, found.reasons) == (Verdict.DOUBTFUL, ("the DVL against anchor A",))
    own = replace(own, state=StartState.WITHOUT_RANGES, reasons=("residuals of A",))
    found = judged(replace(result, ranging=own))
    assert found.verdict is Verdict.DOUBTFUL
    assert found.reasons == (StartState.WITHOUT_RANGES.value, "residuals of A")


def test_the_path_is_in_its_file_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A run that is killed leaves what it had; a full disc ends the file, not the run."""
    turn = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    with PathAsItComes(tmp_path / "new") as path:
        path.append(FrameNow(1.5, turn, np.array([1.0, 2.0, 3.0]), float("nan")))
        row = np.loadtxt(path.path, delimiter=",", skiprows=1)  # while it is open
        np.testing.assert_allclose(row[:4], [1.5, 2.0, -1.0, -3.0], atol=1e-8)
        np.testing.assert_allclose(np.abs(row[4:8]), np.array([0, 0, 1, 1]) / np.sqrt(2), atol=1e-8)
        assert np.isnan(row[8])

        def full(*_: object) -> int:
            raise OSError(28, "No space left on device")

        monkeypatch.setattr("os.write", full)
        for _ in range(2):
            path.append(FrameNow(1.6, turn, np.zeros(3), 2.0))
        assert path.failure == "No space left on device"
        monkeypatch.undo()
    assert len(path.path.read_text().splitlines()) == 2


def test_events_that_repeat_are_told_once() -> None:
    """Numbers and times apart."""
    events = ("0.1 s: no start: 3 and 5", "0.2 s: no start: 4 and 4", "0.3 s: started")
    assert told_events(events) == ["0.1 s: no start: 3 and 5 (and 1 times more)", "0.3 s: started"]


def test_input_that_cannot_be_used(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Exit codes 2 and 3, the message dry, nothing written."""
    out = str(tmp_path / "out")
    assert main(["visual", str(tmp_path / "none"), "--out", out]) == 3
    assert "there is no such file or folder" in capsys.readouterr().err
    assert main(["visual-simulate", "kitchen", "--out", out]) == 2
    assert "world 'kitchen': known are: bottom, corridor, room" in capsys.readouterr().err
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "visual.toml").write_text("format = 1\n[camera]\n[images]\n")
    assert main(["visual", str(tmp_path / "run"), "--out", out]) == 2
    assert "visual.toml [images] folder: expected a folder of images" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_recording_without_texture(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """No map can be started: exit code 5, and what the camera has to do."""
    import cv2

    (tmp_path / "run").mkdir()
    for k in range(5):
        grey = np.full((96, 128), 100, np.uint8)
        cv2.imwrite(str(tmp_path / "run" / f"{k}.png"), grey)
    (tmp_path / "calib.txt").write_text("100 100 63.5 47.5")
    words = ["visual", str(tmp_path / "run"), "--camera", str(tmp_path / "calib.txt")]
    assert main([*words, "--rate-hz", "10", "--out", str(tmp_path / "out")]) == 5
    told = capsys.readouterr().err
    assert "no map could be started" in told
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_simulated_and_found(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A room rendered, written, read and solved: metres to 2 % and to 3 cm, by the commands."""
    run, out = str(tmp_path / "run"), str(tmp_path / "out")
    simulated = ["visual-simulate", "room", "--small", "--seed", "2", "--anchors", "3"]
    fewer = ["--duration-s", "14", "--rate-hz", "8"]
    assert main([*simulated, *fewer, "--out", run]) == 0
    assert main(["visual", run, "--corners", "250", "--no-loops", "--out", out]) == 0
    assert "against the truth" in capsys.readouterr().out
    off = json.loads((tmp_path / "out" / "result.json").read_text())["against_truth"]
    assert off["metric_rms_m"] < 0.03
    assert abs(off["scale_error"]) < 0.02
    rows = np.loadtxt(tmp_path / "out" / "as_it_came.csv", delimiter=",", skiprows=1)
    final = np.loadtxt(tmp_path / "out" / "trajectory.tum")
    assert len(rows) > 0.8 * len(final)
    at = np.searchsorted(final[:, 0], rows[-1, 0] - 1e-6)
    assert np.linalg.norm(rows[-1, 8] * rows[-1, 1:4] - final[at, 1:4]) < 0.1
    page = (tmp_path / "out" / "report.html").read_text()
    assert page.count("data:image/png;base64") == 4
    assert "in metres" in page
