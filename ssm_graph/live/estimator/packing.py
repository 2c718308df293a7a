"""The live estimator's step as plain arrays and plain numbers, and back."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from factors.inertial import Intervals
from ssm_graph.base.frozen import Array
from ssm_graph.engine.states import States
from ssm_graph.live.estimator.course import Step
from ssm_graph.live.estimator.recovery import Reserve
from ssm_graph.live.estimator.watch import Contradicted, Watch
from ssm_graph.smoothers.keyframe import Sensors
from ssm_graph.smoothers.track import Stretch, pack_judged, unpack_judged
from ssm_graph.smoothers.window import FixedLagConfig, Window


def pack_step(step: Step) -> tuple[dict[str, Array], dict[str, Any]]:
    """Return arrays of the window and of what left it, and the plain numbers of the watch."""
    arrays = {f"window_{name}": array for name, array in step.window.pack().items()}
    if step.left is not None:
        states = {f"states_{k}": v for k, v in step.left.states._asdict().items()}
        others = {k: v for k, v in step.left._asdict().items() if k not in ("states", "aids")}
        aids = dict(pack_judged(step.left.aids))
        arrays |= {f"left_{name}": array for name, array in {**states, **others, **aids}.items()}
    arrays |= {f"reserve_{name}": array for name, array in step.reserve.pack()}
    return arrays, {name: _plain(value) for name, value in step.watch._asdict().items()}


def unpack_step(
    arrays: Mapping[str, Array],
    watch: Mapping[str, Any],
    sensors: Sensors,
    config: FixedLagConfig,
    inertial: Callable[[float, float], Intervals],
) -> tuple[Window, Watch, Stretch | None, Reserve]:
    """Return the step that was packed; ``inertial`` is that of the keyframes' maker."""
    window = Window.unpack(part_of(arrays, "window_"), sensors, config, inertial)
    reserve = Reserve.unpack(part_of(arrays, "reserve_"))
    return window, _watch(watch), _left(part_of(arrays, "left_"), sensors), reserve


def part_of(arrays: Mapping[str, Array], prefix: str) -> dict[str, Array]:
    """Return the arrays whose names begin with a prefix, by the rest of the name."""
    return {k.removeprefix(prefix): v for k, v in arrays.items() if k.startswith(prefix)}


def _watch(plain: Mapping[str, Any]) -> Watch:
    numbers: dict[str, Any] = {
        name: float(value) if isinstance(value, str) and name != "trouble" else value
        for name, value in plain.items()
    }
    numbers["beam_weights"] = tuple(float(weight) for weight in plain["beam_weights"])
    numbers["moved"] = tuple(plain["moved"])
    if plain["contradicted"] is not None:
        since_s, text, reckoned_n, sigma = plain["contradicted"]
        numbers["contradicted"] = Contradicted(since_s, text, tuple(reckoned_n), sigma)
    return Watch(**numbers)


def _left(arrays: Mapping[str, Array], sensors: Sensors) -> Stretch | None:
    """Return what had left the window with the step."""
    if "time_s" not in arrays:
        return None
    states = States(*(arrays[f"states_{name}"] for name in States._fields))
    aids = unpack_judged(arrays, sensors.aids, prefix="")
    others: dict[str, Any] = {n: arrays[n] for n in Stretch._fields if n not in ("states", "aids")}
    others["beam"] = others["beam"].astype(np.intp)
    return Stretch(states=states, aids=aids, **others)


def _plain(value: Any) -> Any:
    """Return a number that JSON can hold: infinite ones and NaN as text."""
    if isinstance(value, tuple):
        return [_plain(v) for v in value]
    return str(value) if isinstance(value, float) and not np.isfinite(value) else value
