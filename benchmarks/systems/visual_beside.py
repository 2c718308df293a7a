"""The visual part beside ORB-SLAM3 and COLMAP, on the same images, without ranges.

``pip install pyorbslam3 pycolmap`` brings both; neither is a dependency. ORB-SLAM3 wants a
vocabulary: one is grown from the recording's own images, which can only help it. Its mapping runs
beside its tracking, so images are handed over no faster than ``--pace`` says, on a busy machine
slower. Every run has a process of its own and is kept in the folder of ``--out``.
"""

from __future__ import annotations

import importlib
import multiprocessing
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from benchmarks.report import Option, Report, note, number_text, table
from ssm_graph.base.errors import SsmGraphError
from ssm_graph.study.ledger import ERROR, Key, Ledger, Row, run_trials
from ssm_graph.systems.visual_ranges.accuracy import true_places
from ssm_graph.systems.visual_ranges.binary_words import BRANCHES, WordTree
from ssm_graph.systems.visual_ranges.extras import opencv
from ssm_graph.systems.visual_ranges.ranges import screened_ranges
from ssm_graph.systems.visual_ranges.readers.source import read_sequence
from ssm_graph.systems.visual_ranges.sequence import Sequence
from ssm_graph.systems.visual_ranges.settings import VisualSettings
from ssm_graph.systems.visual_ranges.similarity3 import umeyama
from ssm_graph.systems.visual_ranges.simulate import Run, simulate
from ssm_graph.systems.visual_ranges.study import FIRST_FRESH, data_folder
from ssm_graph.systems.visual_ranges.system import run

Array = NDArray[np.float64]

RECORDINGS: Final = {"kitti": "kitti07", "kitchen": "kitchen"}
WORLDS: Final = ("room", "corridor")
SYSTEMS: Final = ("ssm-graph", "orb-slam3", "colmap")
FEATURES: Final = {"kitti": 2000}
"""Of ORB-SLAM3 in an image: its own settings for KITTI; 1000 elsewhere."""
TRAINED_FROM: Final = 40
"""Images of which the vocabulary is grown."""
OVERLAP: Final = 10
"""Images before and after with which COLMAP matches each."""
SETTINGS: Final = """%YAML:1.0
File.version: "1.0"
Camera.type: "PinHole"
Camera1.fx: {fx}
Camera1.fy: {fy}
Camera1.cx: {cx}
Camera1.cy: {cy}
Camera1.k1: 0.0
Camera1.k2: 0.0
Camera1.p1: 0.0
Camera1.p2: 0.0
Camera.width: {width}
Camera.height: {height}
Camera.newWidth: {width}
Camera.newHeight: {height}
Camera.fps: {fps}
Camera.RGB: 1
ORBextractor.nFeatures: {features}
ORBextractor.scaleFactor: 1.2
ORBextractor.nLevels: 8
ORBextractor.iniThFAST: 20
ORBextractor.minThFAST: 7
Viewer.KeyFrameSize: 0.05
Viewer.KeyFrameLineWidth: 1.0
Viewer.GraphLineWidth: 0.9
Viewer.PointSize: 2.0
Viewer.CameraSize: 0.08
Viewer.CameraLineWidth: 3.0
Viewer.ViewpointX: 0.0
Viewer.ViewpointY: -0.7
Viewer.ViewpointZ: -1.8
Viewer.ViewpointF: 500.0
"""


def sequence_of(name: str, seed: int, most: int) -> Sequence:
    """Return the first images of a recording, or of a rendered world, without ranges."""
    if name in RECORDINGS:
        sequence = read_sequence(data_folder() / RECORDINGS[name])
    else:
        sequence = simulate(Run(name, seed, 63.0 if name == "corridor" else 60.0)).sequence
    kept = sequence.time_s[: most or None]
    return replace(sequence, time_s=kept, ranges=screened_ranges([], [], []))


def trial(key: Key) -> Row:
    """Do one run; the key is system, sequence, seed, most images (0: all) and seconds an image."""
    system, name, seed, most, pace_s = key
    sequence = sequence_of(str(name), int(seed), int(most))
    images = [sequence.images(k) for k in range(len(sequence))]
    sequence = replace(sequence, images=images.__getitem__)
    begin, wall = time.process_time(), time.perf_counter()
    if system == "ssm-graph":
        row = _ours(sequence)
    elif system == "orb-slam3":
        row = _orb_slam3(sequence, FEATURES.get(str(name), 1000), float(pace_s))
    else:
        row = _colmap(sequence)
    spent = {"cpu_s": time.process_time() - begin, "wall_s": time.perf_counter() - wall}
    return spent | row | {"n_images": len(sequence)}


def scored(sequence: Sequence, time_s: Array, place: Array, *, part: str = "") -> dict[str, Any]:
    """Return how many poses there are, and their rms error aligned with scale, m."""
    assert sequence.truth is not None
    true = true_places(sequence.truth, time_s)
    kept = np.isfinite(true).all(axis=1) & np.isfinite(place).all(axis=1)
    row: dict[str, Any] = {f"{part}poses": int(kept.sum()), f"{part}rms_m": np.nan}
    if kept.sum() >= 10:
        error = umeyama(place[kept], true[kept], with_scale=True).apply(place[kept]) - true[kept]
        row[f"{part}rms_m"] = float(np.sqrt(np.mean(np.sum(error**2, axis=1))))
    return row


def _ours(sequence: Sequence) -> dict[str, Any]:
    result = run(sequence, VisualSettings())
    world = result.map
    centre = -np.einsum("kji,kj->ki", world.R_cw, world.t_cw)
    return {
        **scored(sequence, result.time_s, result.position),
        **scored(sequence, world.time_s, centre, part="key_"),
    }


def _orb_slam3(sequence: Sequence, features: int, pace_s: float) -> dict[str, Any]:
    orb = importlib.import_module("pyorbslam3")
    camera = sequence.camera
    begin, place = time.process_time(), np.full((len(sequence), 3), np.nan)
    with TemporaryDirectory() as folder:
        words, settings = Path(folder) / "words.txt", Path(folder) / "settings.yaml"
        write_vocabulary(words, sequence, features)
        fps = round(1.0 / float(np.median(np.diff(sequence.time_s))))
        settings.write_text(
            SETTINGS.format(
                fx=float(camera.fx), fy=float(camera.fy), cx=float(camera.cx), cy=float(camera.cy),
                width=camera.width, height=camera.height, fps=fps, features=features,
            ),
            encoding="utf-8",
        )  # fmt: skip
        trained_s = time.process_time() - begin
        slam = orb.Slam(words, settings, orb.Sensor.MONOCULAR)
        for k, time_s in enumerate(sequence.time_s.tolist()):
            start = time.perf_counter()
            found = slam.track_monocular(sequence.images(k), time_s)
            if found.pose_valid:
                place[k] = np.asarray(found.pose_wc)[:3, 3]
            time.sleep(max(pace_s - (time.perf_counter() - start), 0.0))
        keys = Path(folder) / "keys.tum"
        slam.shutdown()
        slam.save_keyframe_trajectory_tum(str(keys))
        rows = np.loadtxt(keys, ndmin=2) if keys.stat().st_size else np.zeros((0, 8))
    return {
        **scored(sequence, sequence.time_s, place),
        **scored(sequence, rows[:, 0], rows[:, 1:4], part="key_"),
        "trained_s": trained_s,
    }


def write_vocabulary(path: Path, sequence: Sequence, features: int) -> None:
    """Write a tree of ORB words in the text form of DBoW2, grown from a recording's own images.

    Its head claims six levels, so that words are grouped at the second, where ORB-SLAM3 matches.
    """
    detector = opencv().ORB_create(nfeatures=features)
    every = max(len(sequence) // TRAINED_FROM, 1)
    found = [detector.detectAndCompute(sequence.images(k), None)[1]
             for k in range(0, len(sequence), every)]  # fmt: skip
    own = [one for one in found if one is not None]
    tree = WordTree(np.concatenate(own))
    seen = np.zeros(tree.n_words)
    for one in own:
        seen[np.unique(tree.words(one))] += 1
    weight = np.log(len(own) / np.maximum(seen, 0.5))
    lines, parents = [f"{BRANCHES} 6 0 0"], [0]
    number = 0
    for level, centres in enumerate(tree.centres):
        is_leaf, children = level == len(tree.centres) - 1, []
        for parent, own_centres in zip(parents, centres, strict=True):
            for centre in own_centres:
                number += 1
                children.append(number)
                bits = " ".join(map(str, centre.tolist()))
                idf = max(float(weight[len(children) - 1]), 1e-3) if is_leaf else 0.0
                lines.append(f"{parent} {int(is_leaf)} {bits} {idf:.6g}")
        parents = children
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _colmap(sequence: Sequence) -> dict[str, Any]:
    colmap, camera = importlib.import_module("pycolmap"), sequence.camera
    with TemporaryDirectory() as folder:
        images, base = Path(folder) / "images", Path(folder) / "base.db"
        images.mkdir()
        for k in range(len(sequence)):
            opencv().imwrite(str(images / f"{k:06d}.png"), sequence.images(k))
        reader = colmap.ImageReaderOptions()
        reader.camera_model = "PINHOLE"
        reader.camera_params = f"{camera.fx},{camera.fy},{camera.cx},{camera.cy}"
        colmap.extract_features(
            base, images, camera_mode=colmap.CameraMode.SINGLE, reader_options=reader
        )
        pairs = colmap.SequentialPairingOptions()
        pairs.overlap = OVERLAP
        colmap.match_sequential(base, pairing_options=pairs)
        options = colmap.IncrementalPipelineOptions()
        options.ba_refine_focal_length = options.ba_refine_extra_params = False
        options.ba_refine_principal_point = False
        made = colmap.incremental_mapping(base, images, Path(folder), options)
        place = np.full((len(sequence), 3), np.nan)
        best = max(made.values(), key=lambda one: one.num_reg_images(), default=None)
        for image in best.images.values() if best is not None else ():
            if image.has_pose:
                place[int(Path(image.name).stem)] = image.projection_center()
    return scored(sequence, sequence.time_s, place)


def in_own_process(key: Key) -> Row:
    """Do a run in a process of its own: what crashes takes nothing with it."""
    try:
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
            return pool.submit(trial, key).result()
    except BrokenProcessPool as error:
        raise SsmGraphError(f"{key[0]} ended without an answer") from error


def main() -> None:
    """Do what is missing and write the page."""
    report = Report(
        __file__,
        "Camera without ranges, beside others",
        __doc__,
        Option("--sequences", [*RECORDINGS, *WORLDS], "whose images"),
        Option("--systems", [*SYSTEMS], "which"),
        Option("--images", 0, "at most, from the first on; 0: all"),
        Option("--pace", 0.1, "least seconds an image, for ORB-SLAM3"),
        Option("--seed", FIRST_FRESH, "of rendered worlds"),
    )
    asked = report.args
    ledger = Ledger(asked.out / "runs.jsonl", {"benchmark": "visual_beside"})
    keys: list[Key] = [
        (system, name, asked.seed, asked.images, asked.pace if system == "orb-slam3" else 0.0)
        for name in asked.sequences
        for system in asked.systems
    ]
    rows = run_trials(
        in_own_process, keys, ledger, on_progress=lambda n, of, key: note(f"{n} of {of}: {key}")
    )
    report.write(page(rows))


def page(rows: dict[Key, Row]) -> Iterator[str]:
    """Yield the table."""
    yield (
        "Rms errors after an alignment with scale, m. All poses: those of the last map for ours "
        "and COLMAP, those given out at once for ORB-SLAM3. Processor seconds are of all threads, "
        "without reading images."
    )
    yield ""
    cells = [
        (
            str(key[1]),
            str(key[0]),
            row[ERROR] if ERROR in row else f"{row['poses']} of {row['n_images']}",
            number_text(row.get("rms_m", np.nan)),
            str(row.get("key_poses", "–")),
            number_text(row.get("key_rms_m", np.nan)),
            number_text(row.get("cpu_s", np.nan) - row.get("trained_s", 0.0)),
            number_text(row.get("wall_s", np.nan)),
        )
        for key, row in rows.items()
    ]
    header = ("images", "system", "poses", "rms, m", "key frames", "rms, m", "CPU s", "wall s")
    yield from table(header, cells)


if __name__ == "__main__":
    main()
