"""One door to all recordings: which layout a path has is told by what is in it."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from ssm_graph.base.errors import ConfigError, DataError
from ssm_graph.systems.visual_ranges.readers import layouts
from ssm_graph.systems.visual_ranges.readers.images import ENDINGS, VIDEO_ENDINGS
from ssm_graph.systems.visual_ranges.readers.options import ReadOptions
from ssm_graph.systems.visual_ranges.readers.own_folder import TOML_NAME, read_own_folder
from ssm_graph.systems.visual_ranges.sequence import Sequence

DEFAULTS: Final = ReadOptions()


def read_sequence(path: Path, options: ReadOptions = DEFAULTS) -> Sequence:
    """Return the recording at a path: a folder of images in a known layout, a video, or a bag.

    Raises :class:`DataError` and :class:`ConfigError` with file, line and what to try, and
    :class:`MissingExtraError` where a package is missing.
    """
    return reader_of(path)[1](path, options)


def reader_of(path: Path) -> tuple[str, layouts.Reader]:
    """Return the name of a recording's layout and what reads it."""
    if not path.exists():
        raise DataError(f"{path}: there is no such file or folder")
    if path.is_file():
        if path.suffix.lower() in VIDEO_ENDINGS:
            return "video", layouts.read_video
        if path.suffix in (".bag", ".mcap", ".db3"):
            return "ROS bag", _bag()
        if path.name == TOML_NAME:
            return "own folder", lambda p, o: read_own_folder(p.parent, o)
        raise DataError(
            f"{path}: expected a folder, a video ({', '.join(VIDEO_ENDINGS)}) or a ROS bag"
        )
    marks: list[tuple[str, str, layouts.Reader]] = [
        (TOML_NAME, "own folder", read_own_folder),
        ("mav0", "EuRoC", layouts.read_euroc),
        ("cam0/data.csv", "EuRoC", layouts.read_euroc),
        ("rgb.txt", "TUM RGB-D", layouts.read_tum),
        ("times.txt", "KITTI", layouts.read_kitti),
    ]
    for mark, kind, read in marks:
        if (path / mark).exists() and (kind != "KITTI" or any(path.glob("image_?"))):
            return kind, read
    if (path / "metadata.yaml").is_file() or any(path.glob("*.mcap")) or any(path.glob("*.db3")):
        return "ROS bag", _bag()
    if any(path.glob("frame-*.color.*")):
        return "7-Scenes", layouts.read_scenes
    if (path / "apriltag.csv").is_file() and (path / "uwb.csv").is_file():
        raise ConfigError(
            f"{path}: a run of STAR-loc has tags instead of images; its door is "
            "readers.starloc.read_starloc, see docs/visual-ranges.md"
        )
    if (path / "images").is_dir() or any(p.suffix.lower() in ENDINGS for p in path.iterdir()):
        return "folder of images", layouts.read_image_folder
    raise DataError(
        f"{path}: expected {TOML_NAME}, mav0 (EuRoC), rgb.txt (TUM), times.txt with image_0 "
        "(KITTI), a ROS bag, a video, or images; found none of them"
    )


def _bag() -> layouts.Reader:
    from ssm_graph.systems.visual_ranges.readers.bag import read_bag

    return read_bag
