"""Answers at other times and points than the keyframes' and the inertial unit's, as options."""

from __future__ import annotations

import argparse
import csv
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from rich.console import Console

from ssm_graph.base.errors import ConfigError, DataError
from ssm_graph.base.frozen import Array
from ssm_graph.cli.options import number_option
from ssm_graph.io.file_kind import check_is_file

if TYPE_CHECKING:
    from ssm_graph.io.export.track import Track
    from ssm_graph.mission.posterior import Posterior

ABOUT = """\
Answers are at the keyframes and of the inertial unit, unless asked for at the times of a file
(--at), at a rate (--rate), or at a point of the vehicle (--point): an instrument's section of
mission.toml with its lever arm, along the axes of the vehicle, or the name of a [[point]] there,
with its lever arm and mounting. Between keyframes the inertial data of the mission say how the
vehicle moved; sigmas hold there as at keyframes."""


def add_answer_arguments(parser: argparse.ArgumentParser, *, afterwards: bool) -> None:
    """Add where answers are wanted."""
    group = parser.add_argument_group("where answers are wanted", ABOUT)
    group.add_argument(
        "--at",
        type=Path,
        metavar="FILE",
        help="times, one a line, or a CSV with a column time_s or utc; seconds of the mission's "
        "clock, or ISO 8601 such as 2026-05-01T10:00:00.25Z",
    )
    number_option(group, "--rate", "HZ", "answers at an even rate, such as that of the IMU")
    group.add_argument("--point", metavar="NAME", help="where on the vehicle (default: the IMU)")
    group.add_argument(
        "--covariance",
        action="store_true",
        help="every covariance of position, velocity and attitude besides the sigmas (csv, "
        "parquet)",
    )
    group.add_argument(
        "--epoch",
        metavar="UTC",
        help="UTC of time_s = 0, such as 2026-05-01T10:00:00Z, where times are no Unix time",
    )
    if afterwards:
        group.add_argument(
            "--mission",
            type=Path,
            metavar="DIR",
            help="the mission folder, where it is no longer where the result was made of it",
        )


class Asked(NamedTuple):
    """A track as it was asked for, with a word for its file's name and what has to be said."""

    track: Track
    suffix: str
    notes: tuple[str, ...]


def asks(arguments: argparse.Namespace) -> bool:
    """Return whether anything but keyframes and the inertial unit is wanted."""
    wanted = (arguments.at, arguments.rate, arguments.point)
    return any(one is not None for one in wanted) or bool(arguments.covariance)


def check_asked(arguments: argparse.Namespace) -> None:
    """Refuse what no answer can be given for, before the work."""
    from ssm_graph.io.export.track import parse_epoch
    from ssm_graph.io.mission_folder.toml import read_mission_toml
    from ssm_graph.smoothers.between import check_rate

    if arguments.at is not None and arguments.rate is not None:
        raise ConfigError("--at: expected alone, got --rate besides; leave one of them out")
    if arguments.epoch is not None:
        parse_epoch(arguments.epoch)
    if arguments.rate is not None:
        check_rate(arguments.rate)
    if arguments.at is not None:
        read_times(arguments.at, 0.0)
    if arguments.point is not None and arguments.mission is not None:
        read_mission_toml(arguments.mission).point(arguments.point)


def asked_track(arguments: argparse.Namespace, result: Path, errors: Console) -> Asked:
    """Return the track of a result folder that was asked for.

    Raises :class:`ConfigError` for options that contradict each other, a point that the vehicle
    does not have, or inertial data that are not those of the result; :class:`DataError` for times
    that cannot be read or lie outside.
    """
    from ssm_graph.io.export.track import parse_epoch, track_of
    from ssm_graph.io.results.tables import read_results
    from ssm_graph.report.terminal.progress import ProgressDisplay

    check_asked(arguments)
    if not asks(arguments):
        epoch_s = None if arguments.epoch is None else parse_epoch(arguments.epoch)
        return Asked(track_of(read_results(result), epoch_s=epoch_s), "", ())
    from ssm_graph.result import Result

    of = Result(result, mission=arguments.mission, epoch=arguments.epoch)
    time_s, suffix, notes = _times(arguments, of.posterior, of.epoch_s)
    with ProgressDisplay(errors) as show:
        show.stage(f"answers at {len(time_s)} times")
        track = of.track(
            time_s,
            point=arguments.point,
            covariance=arguments.covariance,
            on_progress=show.rows,
        )
    return Asked(track, suffix + (f"-{arguments.point}" if arguments.point else ""), notes)


def _times(
    arguments: argparse.Namespace, posterior: Posterior, epoch_s: float | None
) -> tuple[Array, str, tuple[str, ...]]:
    """Return the times asked for, what files of them are called by, and notes."""
    from ssm_graph.smoothers.between import even_times

    if arguments.rate is not None:
        return even_times(posterior, arguments.rate), f"-{arguments.rate:g}Hz", ()
    if arguments.at is None:
        return posterior.time_s, "", ()
    time_s = read_times(arguments.at, epoch_s)
    begin_s, end_s = posterior.time_s[0], posterior.time_s[-1]
    inside = (time_s >= begin_s) & (time_s <= end_s)
    if not inside.any():
        raise DataError(
            f"{arguments.at}: expected times from {begin_s:.3f} to {end_s:.3f} s, got "
            f"{time_s.min():.13g} to {time_s.max():.13g} s; is it another clock?"
        )
    notes: tuple[str, ...] = ()
    if not inside.all():
        notes = (
            f"{arguments.at}: {int(np.sum(~inside))} of {len(time_s)} times lie outside "
            f"{begin_s:.3f} to {end_s:.3f} s and have no answer",
        )
    return np.unique(np.round(time_s[inside], 6)), f"-{arguments.at.stem}", notes


def read_times(path: Path, epoch_s: float | None) -> Array:
    """Return the times (N,) of a file in its order, s of the mission's clock.

    Parameters
    ----------
    path : one time a line, or a CSV with a header that has ``time_s`` or ``utc``.
    epoch_s : Unix time of ``time_s`` 0, s, which ISO times need.

    Raises :class:`DataError` naming the line.
    """
    from ssm_graph.io.export.track import parse_epoch

    check_is_file(path)
    try:
        rows = list(csv.reader(path.read_text(encoding="utf-8-sig").splitlines()))
    except (OSError, ValueError, csv.Error) as error:
        raise DataError(f"{path}: cannot be read: {error}") from error
    numbered = [(i, row) for i, row in enumerate(rows, 1) if row and not row[0].startswith("#")]
    if not numbered:
        raise DataError(f"{path}: expected a time in each line, found none")
    heads = [cell.strip() for cell in numbered[0][1]]
    column = next((heads.index(name) for name in ("time_s", "utc") if name in heads), None)
    if column is not None:
        numbered = numbered[1:]
    elif len(heads) > 1:
        raise DataError(
            f"{path}:{numbered[0][0]}: expected a column time_s or utc, got {', '.join(heads)}"
        )
    found = np.empty(len(numbered))
    for i, (line, row) in enumerate(numbered):
        where = f"{path}:{line}"
        cell = row[column or 0].strip() if len(row) > (column or 0) else ""
        try:
            found[i] = float(cell)
        except ValueError:
            if epoch_s is None:
                raise DataError(
                    f"{where}: expected seconds, got {cell!r}; for times of UTC say --epoch"
                ) from None
            try:
                found[i] = parse_epoch(cell, where) - epoch_s
            except ConfigError as error:
                raise DataError(str(error)) from None
    if len(found) == 0 or not np.all(np.isfinite(found)):
        raise DataError(f"{path}: expected finite times, one a line or row")
    return found
