"""What was found to be off, as constants of the graph with columns on the rows of its sensor."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.frozen import Array
from ssm_graph.graph.freed import Freed, OfArray
from ssm_graph.mission.problem import Problem
from ssm_graph.smoothers.faults.columns import (
    BEAM,
    BOTTOM,
    IMU,
    MOUNTING,
    SCALE,
    TREND_S,
    Channels,
)
from ssm_graph.smoothers.faults.hypotheses import Course
from ssm_graph.smoothers.faults.judged import Fault
from ssm_graph.smoothers.faults.search import with_rivals
from ssm_graph.smoothers.faults.unstated import WIDER, Unstated


def freed_of(
    found: Sequence[Fault], channels: Channels, problem: Problem, unstated: Unstated | None
) -> Freed:
    """Return the constants of all that was found, and of what the inertial data err in besides."""
    faults = [one for one in with_rivals(found) if one.n_constants]
    beams, time_s = problem.beams, problem.keyframe_s
    on_beams = {name: channels.beams[:, channels.of(name).columns] for name in (BEAM, BOTTOM, IMU)}
    keyframes = np.arange(len(channels.between))
    sigmas = [np.resize(one.hypothesis.sigma, one.n_constants) for one in faults]
    between = [columns_of(faults, {IMU: channels.between}, keyframes, time_s)]
    n_more = 0
    if unstated is not None:
        n_more = len(unstated.errors_sigma)
        sigmas.append(WIDER * unstated.errors_sigma)
        between.append(unstated.errors_columns)
    return Freed(
        sigma=np.concatenate([np.zeros(0), *sigmas]),
        beams=_behind(columns_of(faults, on_beams, beams.keyframe, time_s), n_more),
        between=np.concatenate(between, axis=-1),
        aids={
            name: _behind(columns_of(faults, on_aid, channels.aid_keyframe[name], time_s), n_more)
            for name, on_aid in channels.of_aids()
            if any(one.hypothesis.channel in on_aid for one in faults)
        },
        array=tuple(_of_array(faults, beams.keyframe)),
    )


def _behind(columns: Array, n_more: int) -> Array:
    """Return columns (N, ..., F) with as many more behind them that do nothing."""
    return np.concatenate([columns, np.zeros((*columns.shape[:-1], n_more))], axis=-1)


def inside_of(keyframe: NDArray[np.intp], fault: Fault) -> NDArray[np.bool_]:
    """Return which keyframes (N,) are inside the stretch of a fault."""
    return (keyframe >= fault.begin) & (keyframe < fault.end)


def columns_of(
    faults: Sequence[Fault],
    of_channels: Mapping[str, Array],
    keyframe: NDArray[np.intp],
    keyframe_s: Array,
) -> Array:
    """Return the columns (N, ..., F) of faults on rows at keyframes (N,).

    ``of_channels`` are those (N, ..., c) of the channels that act on these rows.
    """
    rows = next(iter(of_channels.values())).shape[:-1]
    parts = [np.zeros((*rows, 0))]
    for fault in faults:
        hypothesis = fault.hypothesis
        if hypothesis.channel in of_channels:
            columns = of_channels[hypothesis.channel] @ hypothesis.combined
            parts.append(_over(columns, keyframe, fault, keyframe_s))
        else:
            parts.append(np.zeros((*rows, fault.n_constants)))
    return np.concatenate(parts, axis=-1)


def _over(columns: Array, keyframe: NDArray[np.intp], fault: Fault, keyframe_s: Array) -> Array:
    """Return columns (N, ..., d) of rows at keyframes (N,) over the stretch of a fault."""
    inside = inside_of(keyframe, fault).reshape(-1, *[1] * (columns.ndim - 1))
    constant = columns * inside
    if not fault.hypothesis.has_rate:
        return np.asarray(constant)
    since = (keyframe_s[keyframe] - keyframe_s[fault.begin]) / TREND_S
    rate = constant * since.reshape(inside.shape)
    if fault.hypothesis.course is Course.RAMP:
        return np.asarray(rate)
    return np.concatenate([constant, rate], axis=-1)


def _of_array(faults: Sequence[Fault], keyframe: NDArray[np.intp]) -> Iterator[OfArray]:
    """Yield what holds the beams at keyframes (M,) otherwise than stated."""
    end = 0
    for fault in faults:
        combined, end = fault.hypothesis.combined, end + fault.n_constants
        columns = slice(end - fault.n_constants, end)
        if fault.hypothesis.channel == SCALE:
            yield OfArray(inside_of(keyframe, fault), columns, np.pad(combined, ((0, 3), (0, 0))))
        elif fault.hypothesis.channel == MOUNTING:
            yield OfArray(inside_of(keyframe, fault), columns, np.pad(combined, ((1, 0), (0, 0))))
