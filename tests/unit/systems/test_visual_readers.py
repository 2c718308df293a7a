"""Recordings of a camera and ranges: every layout, every unit, and what is said of bad input."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ssm_graph.base.errors import ConfigError, DataError
from ssm_graph.systems.visual_ranges.camera import Camera
from ssm_graph.systems.visual_ranges.ranges import screened_ranges
from ssm_graph.systems.visual_ranges.readers.calibration import read_camera
from ssm_graph.systems.visual_ranges.readers.images import depth_bits, to_grey
from ssm_graph.systems.visual_ranges.readers.options import ReadOptions
from ssm_graph.systems.visual_ranges.readers.own_folder import read_own_folder, write_own_folder
from ssm_graph.systems.visual_ranges.readers.range_text import read_ranges
from ssm_graph.systems.visual_ranges.readers.source import read_sequence, reader_of
from ssm_graph.systems.visual_ranges.readers.starloc import read_starloc
from ssm_graph.systems.visual_ranges.readers.times import image_seconds
from ssm_graph.systems.visual_ranges.sequence import PathTruth, Sequence

cv2 = pytest.importorskip("cv2")
DATA = Path(os.environ.get("SSM_GRAPH_DATA", "../shared/data")) / "systems"
CAMERA = Camera(96, 72, 80.0, 81.0, 47.5, 35.5, "radtan", (-0.1, 0.02, 0.001, -0.002))
TIMES = np.linspace(3.0, 3.55, 12)


def data(name: str) -> Path:
    """Return a folder of the real data, or skip."""
    path = DATA / name
    if not path.exists():
        pytest.skip(f"{path}: no real data there; set SSM_GRAPH_DATA")
    return path


def picture(index: int) -> NDArray[np.uint8]:
    """Return an image that is like no other."""
    rng = np.random.default_rng(index)
    return rng.integers(40, 200, (CAMERA.height, CAMERA.width), dtype=np.uint8)


def recording(n_ranges: int = 6) -> Sequence:
    """Return a recording of 12 images and some ranges to two anchors."""
    at = TIMES[0] + 0.04 * np.arange(n_ranges)
    names = ["A" if k % 2 == 0 else "B7" for k in range(n_ranges)]
    ranges = screened_ranges(at, names, 2.0 + 0.25 * np.arange(n_ranges), np.full(n_ranges, 0.08))
    turn = Rotation.from_rotvec(np.outer(TIMES - 3.0, [0.1, 0.2, 0.3])).as_quat()
    truth = PathTruth(TIMES, np.outer(TIMES, [1.0, 0.5, -0.25]), turn)
    anchors = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
    return Sequence("made", CAMERA, TIMES, picture, ranges, (0.1, -0.2, 0.05), truth, anchors, ())


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a folder of one's own recording."""
    assert len(list(write_own_folder(tmp_path, recording()))) == len(TIMES)
    return tmp_path


def test_a_folder_comes_back_as_it_was_written(folder: Path) -> None:
    """Camera, times, images, ranges, lever arm, truth: all of it."""
    found, made = read_sequence(folder), recording()
    assert found.camera == made.camera
    assert found.lever_arm_m == made.lever_arm_m
    assert found.truth is not None
    assert made.truth is not None
    np.testing.assert_allclose(found.time_s, made.time_s, atol=1e-9)
    np.testing.assert_array_equal(found.images(5), picture(5))
    np.testing.assert_allclose(found.ranges.range_m, made.ranges.range_m, atol=1e-6)
    assert found.ranges.names == made.ranges.names
    np.testing.assert_allclose(found.truth.position_m, made.truth.position_m, atol=1e-9)
    assert found.anchor_truth_m is not None
    assert made.anchor_truth_m is not None
    np.testing.assert_allclose(found.anchor_truth_m, made.anchor_truth_m)


def test_some_images_of_it(folder: Path) -> None:
    """The first ones left out, and so many."""
    found = read_own_folder(folder, ReadOptions(first=3, count=4))
    np.testing.assert_allclose(found.time_s, TIMES[3:7])
    np.testing.assert_array_equal(found.images(0), picture(3))
    with pytest.raises(DataError, match=r"--first 11: expected at least 2 images"):
        read_own_folder(folder, ReadOptions(first=11))


def test_defects_of_images_are_told(folder: Path) -> None:
    """Cut off, of another size, black, frozen: each is counted and none stops the run."""
    images = folder / "images"
    (images / "000002.png").write_bytes((images / "000002.png").read_bytes()[:60])
    cv2.imwrite(str(images / "000004.png"), np.zeros((10, 20), dtype=np.uint8))
    cv2.imwrite(str(images / "000006.png"), np.zeros((72, 96), dtype=np.uint8))
    cv2.imwrite(str(images / "000008.png"), picture(7))
    found = read_sequence(folder)
    shown = [found.images(k) for k in range(len(found))]
    assert not shown[2].any()
    assert not shown[4].any()
    assert found.images(2).shape == (72, 96)  # a second look counts nothing twice
    told = "\n".join(found.images.defects())  # type: ignore[attr-defined]
    assert "1 could not be decoded: 000002.png" in told
    assert "1 had another size (20 x 10): 000004.png" in told
    assert "1 are black: 000006.png" in told
    assert "1 repeat the one before (frozen camera?): 000008.png" in told


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda t: t.replace("width = 96", "width = 192"), "images are 96 x 72 pixels, the calib"),
        (lambda t: t.replace("fx = 80.0", "fx = 8000.0"), "focal lengths 8000, 81 cannot be"),
        (lambda t: t.replace("fx =", "fxx ="), "unknown key; did you mean 'fx'"),
        (lambda t: t.replace('"radtan"', '"radial"'), "expected a distortion model of"),
        (lambda t: t.replace('"times.csv"', '"none.csv"'), "none.csv: cannot be read"),
        (lambda t: t.replace("-0.1,", "-0.1, 1, 1, 1, 1, 1,"), "8 numbers|at most 8"),
    ],
)
def test_a_bad_folder_is_told_by_its_key(
    folder: Path, change: Callable[[str], str], told: str
) -> None:
    """Message with file, key, what was expected, what came."""
    path = folder / "visual.toml"
    text = path.read_text()
    assert change(text) != text
    path.write_text(change(text))
    with pytest.raises((ConfigError, DataError), match=told):
        read_sequence(folder)


def test_ranges_in_every_unit(tmp_path: Path) -> None:
    """Nanoseconds, millimetres, names with units, no header, spaces or commas: one answer."""
    rows = [(3.0, "7", 2.5), (3.1, "9", 4.0), (3.2, "7", 2.75)]
    texts = {
        "ns.csv": "#timestamp [ns], anchor, range [m], std [m]\n"
        + "".join(f"{int(t * 1e9)},{a},{r},0.05\n" for t, a, r in rows),
        "mm.csv": "time_s;to_id;range_mm;sigma_m\n"
        + "".join(f"{t};{a};{r * 1000};0.05\n" for t, a, r in rows),
        "plain.txt": "".join(f"{t} {a} {r} 0.05\n" for t, a, r in rows),
        "ms.txt": "# time anchor range std\n"
        + "".join(f"{t * 1e3} {a}.0 {r} 0.05\n" for t, a, r in rows),
    }
    for name, text in texts.items():
        (tmp_path / name).write_text(text)
        found = read_ranges(tmp_path / name, TIMES)
        assert found.names == ("7", "9"), name
        np.testing.assert_allclose(found.time_s, [3.0, 3.1, 3.2], err_msg=name)
        np.testing.assert_allclose(found.range_m, [2.5, 4.0, 2.75], err_msg=name)
        np.testing.assert_allclose(found.sigma_m, 0.05, err_msg=name)
    assert "taken for ms" in read_ranges(tmp_path / "ms.txt", TIMES).notes[0]


def test_bad_ranges_are_counted_with_their_line(tmp_path: Path) -> None:
    """NaN, zero, too long, torn: dropped, and told where."""
    path = tmp_path / "uwb.csv"
    path.write_text(
        "time_s,anchor,range_m\n3.0,A,2\n3.1,A,nan\n3.2,A,0\n3.3,A,-4\n3.35,A\n3.4,A,9999\n3.45,A,3\n"
    )
    found = read_ranges(path, TIMES)
    assert found.range_m.tolist() == [2.0, 3.0]
    told = "\n".join(found.notes)
    assert "1 lines that are no ranges, left out (first: line 6)" in told
    assert "1 readings without a range, dropped (first: line 3)" in told
    assert "2 ranges at or below zero, dropped (first: line 4)" in told
    assert "1 ranges beyond 500 m, dropped (first: line 7)" in told


def test_ranges_that_cannot_be(tmp_path: Path) -> None:
    """Another clock, another unit, no table at all: refused, with what to try."""
    path = tmp_path / "uwb.csv"
    path.write_text("time_s,anchor,range_m\n900.0,A,2\n901.0,A,2.1\n")
    with pytest.raises(DataError, match=r"share no time.*--start-s"):
        read_ranges(path, TIMES)
    path.write_text("time_s,anchor,range\n3.0,A,2100\n3.1,A,2200\n")
    with pytest.raises(DataError, match=r"are they millimetres.*--range-unit mm"):
        read_ranges(path, TIMES)
    assert read_ranges(path, TIMES, unit="mm").range_m.tolist() == [2.1, 2.2]
    path.write_text("time_s,who,what\n3.0,A,2100\n")
    with pytest.raises(DataError, match="expected columns for time, anchor and range, got"):
        read_ranges(path, TIMES)
    path.write_text("")
    with pytest.raises(DataError, match="found none"):
        read_ranges(path, TIMES)


def test_calibrations_as_people_have_them(tmp_path: Path) -> None:
    """EuRoC, Kalibr, ORB-SLAM, ROS, KITTI, plain numbers: one camera."""
    k, d = [80.0, 81.0, 47.5, 35.5], [-0.1, 0.02, 0.001, -0.002]
    numbers = ", ".join(map(str, d))
    texts = {
        "sensor.yaml": f"%YAML:1.0\nresolution: [96, 72]\nintrinsics: {k} #fu\n"
        f"distortion_model: radial-tangential\ndistortion_coefficients: [{numbers}]\n",
        "chain.yaml": f"cam0:\n  camera_model: pinhole\n  intrinsics: {k}\n"
        f"  distortion_model: radtan\n  distortion_coeffs: [{numbers}]\n  resolution: [96, 72]\n",
        "orb.yaml": '%YAML:1.0\nCamera.type: "PinHole"\n'
        + "".join(f"Camera.{n}: {x}\n" for n, x in zip(("fx", "fy", "cx", "cy"), k, strict=True))
        + "".join(f"Camera.{n}: {x}\n" for n, x in zip(("k1", "k2", "p1", "p2"), d, strict=True)),
        "info.yaml": "image_width: 96\nimage_height: 72\ncamera_matrix:\n  rows: 3\n  cols: 3\n"
        f"  data: [{k[0]}, 0, {k[2]},\n    0, {k[1]}, {k[3]}, 0, 0, 1]\n"
        f"distortion_model: plumb_bob\ndistortion_coefficients:\n  data: [{numbers}, 0]\n",
        "plain.txt": " ".join(map(str, [*k, *d])),
    }
    for name, text in texts.items():
        (tmp_path / name).write_text(text)
        assert read_camera(tmp_path / name, (96, 72)) == CAMERA, name
    (tmp_path / "calib.txt").write_text("P0: 80 0 47.5 0 0 81 35.5 0 0 0 1 0\nP1: 1 2\n")
    plain = Camera(96, 72, 80.0, 81.0, 47.5, 35.5)
    assert read_camera(tmp_path / "calib.txt", (96, 72)) == plain
    (tmp_path / "no.yaml").write_text("a: 3\n")
    with pytest.raises(DataError, match="expected a calibration of EuRoC or Kalibr"):
        read_camera(tmp_path / "no.yaml", (96, 72))


def test_fisheye_of_orb_slam(tmp_path: Path) -> None:
    """KannalaBrandt8 is the equidistant model."""
    path = tmp_path / "tum_vi.yaml"
    path.write_text(
        'Camera.type: "KannalaBrandt8"\nCamera.fx: 190.9\nCamera.fy: 190.9\nCamera.cx: 254.9\n'
        "Camera.cy: 256.9\nCamera.k1: 0.0034\nCamera.k2: 0.0007\nCamera.k3: -0.002\n"
        "Camera.k4: 0.0002\nCamera.width: 512\nCamera.height: 512\n"
    )
    camera = read_camera(path)
    assert camera.model == "equidistant"
    assert camera.distortion == (0.0034, 0.0007, -0.002, 0.0002)


def test_pixels_of_every_kind() -> None:
    """12 bits in 16, colour, Bayer: grey of 8 bits."""
    grey = picture(0)
    deep = grey.astype(np.uint16) << 4
    assert depth_bits(deep) == 12
    np.testing.assert_array_equal(to_grey(deep, bits=12), grey)
    np.testing.assert_array_equal(to_grey(np.stack([grey] * 3, axis=2)), grey)
    np.testing.assert_array_equal(to_grey(np.full((8, 8), 90, np.uint8), bayer="rggb"), 90)
    with pytest.raises(DataError, match="8 or 16 bits, got float32"):
        to_grey(grey.astype(np.float32))


def test_a_video_with_a_table_of_ranges(tmp_path: Path) -> None:
    """Frames in order and back again, times by the rate, ranges from the table beside it."""
    path = tmp_path / "run.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 20.0, (96, 72))
    for k in range(10):
        writer.write(np.full((72, 96, 3), 10 * k + 20, dtype=np.uint8))
    writer.release()
    (tmp_path / "run.txt").write_text("80 81 47.5 35.5")
    (tmp_path / "run.csv").write_text("time,anchor,range\n5.1,A,2.0\n5.2,A,2.1\n")
    found = read_sequence(path, ReadOptions(start_s=5.0))
    np.testing.assert_allclose(found.time_s, 5.0 + np.arange(10) / 20.0)
    for k in (0, 7, 3):
        assert abs(float(found.images(k).mean()) - (10 * k + 20)) < 4.0
    assert len(found.ranges) == 2


def test_tum_and_a_folder_of_images(tmp_path: Path) -> None:
    """rgb.txt with its truth; names that are nanoseconds; disorder is put right and told."""
    (tmp_path / "rgb").mkdir()
    for k in range(4):
        cv2.imwrite(str(tmp_path / "rgb" / f"{k}.png"), picture(k))
    order = (0, 2, 1, 3)
    lines = [f"{3.0 + 0.1 * k:.2f} rgb/{k}.png" for k in order]
    (tmp_path / "rgb.txt").write_text("# timestamp filename\n" + "\n".join(lines) + "\n")
    (tmp_path / "groundtruth.txt").write_text("3.0 1 2 3 0 0 0 1\n3.3 2 2 3 0 0 0 1\n")
    (tmp_path / "calib.txt").write_text("80 81 47.5 35.5")
    found = read_sequence(tmp_path)
    np.testing.assert_array_equal(found.images(1), picture(1))
    assert any("1 out of order, sorted" in note for note in found.notes)
    assert found.truth is not None
    plain = tmp_path / "plain"
    plain.mkdir()
    for k in range(3):
        cv2.imwrite(str(plain / f"{1403715273262142976 + 50_000_000 * k}.png"), picture(k))
    with pytest.raises(DataError, match=r"no calibration file; give one with --camera"):
        read_sequence(plain)
    found = read_sequence(plain, ReadOptions(camera=tmp_path / "calib.txt"))
    np.testing.assert_allclose(np.diff(found.time_s), 0.05, atol=1e-6)


def test_times_that_are_none() -> None:
    """A step that no unit makes a video's."""
    assert image_seconds(np.linspace(0.0, 132.0, 5), "x")[1].startswith(
        "x: times of images taken for ms"
    )
    with pytest.raises(DataError, match="are they times"):
        image_seconds(np.linspace(0.0, 2e13, 5), "x")


def test_what_is_no_recording(tmp_path: Path) -> None:
    """Said with all that would be one."""
    with pytest.raises(DataError, match="no such file or folder"):
        read_sequence(tmp_path / "nothing")
    with pytest.raises(DataError, match=r"expected visual.toml, mav0"):
        read_sequence(tmp_path)


def test_real_euroc() -> None:
    """The ASL layout of the first frames of V1_01."""
    found = read_sequence(data("euroc_v1_01"))
    assert reader_of(data("euroc_v1_01"))[0] == "EuRoC"
    assert found.camera.model == "radtan"
    assert found.images(3).shape == (480, 752)
    np.testing.assert_allclose(np.diff(found.time_s), 0.05, atol=1e-3)


def test_real_kitti_and_kitchen() -> None:
    """Images, calibration and truth of both; the kitchen's focal length is the colour camera's."""
    kitti, kitchen = read_sequence(data("kitti07")), read_sequence(data("kitchen"))
    assert (len(kitti), len(kitchen)) == (160, 1000)
    assert kitti.camera.fx == pytest.approx(707.0912)
    assert kitchen.camera.fx == 525.0
    assert kitti.truth is not None
    assert kitchen.truth is not None
    assert kitti.images(7).shape == (370, 1226)


def test_real_starloc() -> None:
    """Ranges and tag pixels fit the truth: radios are 9 cm short, pixels 10 off, as published."""
    run = read_starloc(data("starloc") / "loop-2d_s5")
    turn = Rotation.from_quat(run.truth.quaternion)
    antenna = run.truth.position_m + turn.apply(run.lever_arm_m)
    at = np.column_stack([np.interp(run.ranges.time_s, run.truth.time_s, x) for x in antenna.T])
    line = np.linalg.norm(at - run.anchor_truth_m[run.ranges.anchor], axis=1)
    assert np.median(run.ranges.range_m - line) == pytest.approx(-0.097, abs=0.01)
    row = np.abs(run.truth.time_s[None] - run.sightings.time_s[:, None]).argmin(axis=1)
    places = np.array([run.tag_truth_m[int(tag)] for tag in run.sightings.tag])
    seen = run.camera.project(turn[row].inv().apply(places - run.truth.position_m[row]))
    assert np.nanmedian(np.linalg.norm(seen - run.sightings.left, axis=1)) < 15.0
