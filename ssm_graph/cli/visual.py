"""``ssm-graph visual``: metric path, map and anchors from a camera and ranges."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Final

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from ssm_graph.base.errors import SolverError
from ssm_graph.cli.options import number_option
from ssm_graph.cli.terminal import say
from ssm_graph.io.results.place import check_is_free

if TYPE_CHECKING:
    from ssm_graph.systems.visual_ranges.accuracy import Accuracy
    from ssm_graph.systems.visual_ranges.readers.options import ReadOptions
    from ssm_graph.systems.visual_ranges.result import VisualResult
    from ssm_graph.systems.visual_ranges.sequence import Sequence
    from ssm_graph.systems.visual_ranges.verdict import Judged

DESCRIPTION: Final = """\
Find the path of one camera, a map of what it saw and the places of radio or acoustic anchors that
nobody surveyed, in metres, from images and ranges.

RUN is a folder with visual.toml (docs/visual-ranges.md), a recording of EuRoC, TUM RGB-D, KITTI or
7-Scenes, a folder of images, a video, or a ROS bag. Ranges come with it or from --ranges, a table
of time, anchor and range. ssm-graph visual-simulate writes one to try.

The answer is one of
  READY      path, map and anchors in metres (exit code 0)
  MIRROR     in metres; an anchor has other places that fit as well, both are listed (0)
  DOUBTFUL   in metres, but the reasons have to be looked at (4)
  AMBIGUOUS  the ranges do not tell the scale yet; what motion is missing is said (4)
  NO_SCALE   there were no ranges: path and map in map units (4)

files in DIR:
  trajectory.tum   camera to map of all images, keyframes.tum of the key frames: evo reads them
  as_it_came.csv   the pose of each image as first given out, written at once: there when killed
  covariance.npz   6 x 6 of each key frame
  map.ply          points, path, anchors
  anchors.csv      places, sigmas, biases, states, other places that fit
  ranges.csv       every range with its error and weight; scale.csv over time
  map.npz          the map, for --in-map
  result.json      verdict, reasons, notes, errors where there is a truth
  report.html      all of it in words, tables and figures
  recording.rrd    with --recording: map, path, images and ranges for the viewer of rerun

With --in-map, only trajectory.tum: where in an earlier map each image was taken. The exit code is
0 where the map is in metres and more than half of the images were found, 4 else.
"""


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    parser.add_argument("source", type=Path, metavar="RUN", help="folder, video or bag")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="result folder")
    parser.add_argument("--overwrite", action="store_true", help="write over earlier results")
    parser.add_argument("--ranges", type=Path, metavar="FILE", help="time, anchor, range (, sigma)")
    parser.add_argument(
        "--no-ranges", action="store_true", help="use none: path and map in map units"
    )
    parser.add_argument(
        "--camera",
        type=Path,
        metavar="FILE",
        help="calibration: EuRoC, Kalibr, ORB-SLAM, ROS, KITTI",
    )
    number_option(parser, "--sigma-m", "M", "of ranges whose row does not say")
    parser.add_argument(
        "--range-unit", choices=("m", "cm", "mm", "ft"), default="", help="of the ranges"
    )
    parser.add_argument(
        "--time-unit", choices=("s", "ms", "us", "ns"), default="", help="of the ranges' times"
    )
    parser.add_argument(
        "--lever-arm-m", nargs=3, type=float, metavar=("X", "Y", "Z"), help="camera to antenna"
    )
    number_option(
        parser, "--lever-arm-sigma-m", "M", "of each of its numbers: above 0 it is found as well"
    )
    number_option(parser, "--rate-hz", "HZ", "of images that carry no times")
    number_option(parser, "--start-s", "S", "time of the first image on the clock of the ranges")
    number_option(parser, "--first", "N", "first image that is used", 0, kind=int)
    number_option(parser, "--count", "N", "images that are used, all without it", kind=int)
    parser.add_argument(
        "--in-map", type=Path, metavar="FILE", help="find each image in a map.npz, make no new map"
    )
    number_option(parser, "--corners", "N", "followed at a time", 700, kind=int)
    parser.add_argument("--no-loops", action="store_true", help="do not close loops")
    parser.add_argument(
        "--threads", action="store_true", help="map beside tracking: faster, not bit for bit"
    )
    parser.add_argument(
        "--recording", action="store_true", help="write recording.rrd, for the viewer of rerun, too"
    )
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace, console: Console, errors: Console) -> bool:
    """Read, run, write, and say what came out."""
    from ssm_graph.systems.visual_ranges.accuracy import accuracy
    from ssm_graph.systems.visual_ranges.figures import write_figures
    from ssm_graph.systems.visual_ranges.outputs import write_outputs
    from ssm_graph.systems.visual_ranges.page import write_page
    from ssm_graph.systems.visual_ranges.readers.images import WatchedImages
    from ssm_graph.systems.visual_ranges.readers.source import read_sequence
    from ssm_graph.systems.visual_ranges.recording import RECORDING_NAME, rerun, write_recording
    from ssm_graph.systems.visual_ranges.verdict import judged

    if arguments.recording:
        rerun()  # said before the work, not after it
    check_is_free(arguments.out, may_overwrite=arguments.overwrite)
    sequence = read_sequence(arguments.source, _options(arguments))
    if arguments.no_ranges:
        sequence = _without_ranges(sequence)
    if arguments.lever_arm_sigma_m is not None:
        sequence = replace(sequence, lever_arm_sigma_m=arguments.lever_arm_sigma_m)
    for note in sequence.notes:
        say(errors, f"note: {note}")
    if arguments.in_map is not None:
        return _found_in_map(sequence, arguments, console, errors)
    result = _followed(sequence, arguments, errors)
    watched = sequence.images
    defects = watched.defects() if isinstance(watched, WatchedImages) else ()
    for note in defects:
        say(errors, f"note: {note}")
    found, off = judged(result), accuracy(sequence, result)
    write_outputs(arguments.out, sequence, result, found, off, defects)
    figures = write_figures(arguments.out, sequence, result, found, off)
    page = arguments.out / "report.html"
    write_page(page, sequence, result, found, off, figures, defects)
    if arguments.recording:
        write_recording(arguments.out / RECORDING_NAME, sequence, result)
    for line in lines(result, found, off):
        say(console, line)
    say(console, f"results in {arguments.out}, report in {page}")
    return found.verdict.is_good


def _options(arguments: argparse.Namespace) -> ReadOptions:
    from ssm_graph.systems.visual_ranges.readers.options import ReadOptions

    return ReadOptions(
        camera=arguments.camera,
        ranges=arguments.ranges,
        rate_hz=arguments.rate_hz,
        start_s=arguments.start_s,
        sigma_m=arguments.sigma_m,
        lever_arm_m=tuple(arguments.lever_arm_m) if arguments.lever_arm_m else None,
        range_unit=arguments.range_unit,
        time_unit=arguments.time_unit,
        first=arguments.first,
        count=arguments.count,
    )


def _without_ranges(sequence: Sequence) -> Sequence:
    from ssm_graph.systems.visual_ranges.ranges import screened_ranges

    return replace(sequence, ranges=screened_ranges([], [], []))


def _followed(sequence: Sequence, arguments: argparse.Namespace, errors: Console) -> VisualResult:
    from ssm_graph.systems.visual_ranges.loop_settings import LoopSettings
    from ssm_graph.systems.visual_ranges.path_file import PathAsItComes
    from ssm_graph.systems.visual_ranges.settings import VisualSettings
    from ssm_graph.systems.visual_ranges.system import run as run_visual

    settings = VisualSettings(
        n_corners=arguments.corners,
        is_deterministic=not arguments.threads,
        loops=LoopSettings(is_on=not arguments.no_loops),
    )
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("image {task.completed} of {task.total}"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=errors, transient=True) as progress:
        task = progress.add_task("tracking and mapping", total=len(sequence))

        def show(done: int, total: int) -> None:
            progress.update(task, completed=done)
            if done == total:
                progress.update(task, description="adjusting everything")

        with PathAsItComes(arguments.out) as path:
            result = run_visual(sequence, settings, progress=show, on_frame=path.append)
    if path.failure:
        say(errors, f"note: {path.path}: {path.failure}; what came later is not in it")
    if not len(result.map.time_s):
        told = "; ".join(result.events[-3:]) or "no image had corners enough"
        raise SolverError(
            f"{sequence.name}: no map could be started: {told}; the camera has to move sideways "
            "before it turns, and see texture"
        )
    return result


def _found_in_map(
    sequence: Sequence, arguments: argparse.Namespace, console: Console, errors: Console
) -> bool:
    """Look for every image in a map of an earlier run, and write where it was taken."""
    import numpy as np

    from ssm_graph.systems.visual_ranges.map_files import MapLocator, load_map
    from ssm_graph.systems.visual_ranges.outputs import write_tum

    saved = load_map(arguments.in_map)
    locator, found = MapLocator(saved, sequence.camera), []
    columns = (TextColumn("image {task.completed} of {task.total}"), BarColumn())
    with Progress(*columns, console=errors, transient=True) as progress:
        task = progress.add_task("", total=len(sequence))
        for index in range(len(sequence)):
            one = locator.locate(sequence.images(index))
            if one is not None:
                found.append((sequence.time_s[index], one.pose))
            progress.advance(task)
    if not found:
        raise SolverError(
            f"{sequence.name}: none of {len(sequence)} images shows a place of {arguments.in_map}; "
            "is it that of another place, or is the light another?"
        )
    has_scale = bool(np.isfinite(saved.scale))
    scale, unit = (saved.scale, "m") if has_scale else (1.0, "map units")
    path = arguments.out / "trajectory.tum"
    arguments.out.mkdir(parents=True, exist_ok=True)
    write_tum(
        path,
        f"# time_s x y z qx qy qz qw  ({unit}; camera to map of {arguments.in_map.name})",
        np.array([time for time, _ in found]),
        np.stack([pose.R_cw for _, pose in found]),
        scale * np.stack([pose.t_cw for _, pose in found]),
    )
    share = len(found) / len(sequence)
    say(console, f"{len(found)} of {len(sequence)} images found in {arguments.in_map} ({unit})")
    say(console, f"results in {path}")
    return has_scale and share > 0.5


def lines(result: VisualResult, found: Judged, off: Accuracy | None) -> list[str]:
    """Return the verdict and what it rests on, one line each."""
    import numpy as np

    from ssm_graph.systems.visual_ranges.result import FrameState

    told = [f"{found.verdict.name}: {found.verdict.value}"]
    told += [f"  {reason}" for reason in found.reasons]
    if found.advice:
        told.append(f"  what helps: {found.advice}")
    n_tracked = int((result.state == FrameState.TRACKED).sum())
    told.append(
        f"  {n_tracked} of {len(result.time_s)} images have a pose; {len(result.map.time_s)} key "
        f"frames, {(result.map.points_views >= 2).sum()} points; "
        f"{sum(loop.is_taken for loop in result.loops)} loops closed"
    )
    if found.verdict.has_scale:
        ranging = result.ranging
        told.append(
            f"  scale {ranging.scale:.5g} m a map unit ± {100 * ranging.sigma_log_scale:.2f} %, "
            f"known after {ranging.started_s - result.time_s[0]:.1f} s"
        )
        for anchor in ranging.anchors:
            if not np.isfinite(anchor.place_m).all():
                told.append(f"  anchor {anchor.name}: not placed")
                continue
            place = ", ".join(f"{x:.2f}" for x in anchor.place_m)
            told.append(
                f"  anchor {anchor.name} ({anchor.state.name.lower()}) at {place} m; bias "
                f"{anchor.bias_m:+.2f} m; {100 * anchor.nlos_share:.0f} % of {anchor.n_ranges} "
                "ranges not believed"
            )
        if ranging.lever_error_m.any():
            change = ", ".join(f"{x:+.3f}" for x in ranging.lever_error_m)
            told.append(f"  the lever arm is off by {change} m, camera axes")
        own = ranging.vehicle
        if own is not None:
            down = ", ".join(f"{x:.3f}" for x in own.down)
            told.append(f"  down is {down} in the map, by the vehicle's own sensors")
            if np.isfinite(own.range_unit):
                told.append(
                    f"  ranges are {own.range_unit:.4f} ± {own.range_unit_sigma:.4f} times what "
                    "these sensors say: the sound speed's share"
                )
    if off is not None and found.verdict.has_scale:
        anchors = ", ".join(f"{x:.3f}" for x in off.anchor_m)
        told.append(
            f"  against the truth: {off.metric_m:.4f} m rms metric ({off.similar_m:.4f} m scale-"
            f"aligned), scale {100 * off.scale_error:+.2f} %, anchors {anchors} m off"
        )
    elif off is not None:
        told.append(f"  against the truth: {off.similar_m:.4f} m rms, scale-aligned")
    return told
