"""Successive keyframes as they were at one moment of their life."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from ssm_graph.base.frozen import Array
from ssm_graph.base.times import Indices
from ssm_graph.engine.states import States
from ssm_graph.graph.aids.aid import Aid
from ssm_graph.graph.measurements import JudgedAid, joined_aids


class Stretch(NamedTuple):
    """Successive keyframes as they were at one moment, with the beams of all of them."""

    time_s: Array
    """(K,) s"""
    states: States
    """(K, ...)"""
    covariance: Array
    """(K, n, n)"""
    n_beams: Array
    """(K,)"""
    beam: Indices
    """(M,) from 0, of each beam speed"""
    innovation: Array
    """(M,) m/s, measured minus predicted before the first update"""
    mahalanobis_sq: Array
    """(M,)"""
    weight: Array
    """(M,)"""
    aids: Mapping[str, JudgedAid]
    """Measurements of aids that have weights, by the aid's name"""


def joined(stretches: Sequence[Stretch]) -> Stretch:
    """Return successive stretches as one."""
    states, aids = ([getattr(one, name) for one in stretches] for name in ("states", "aids"))
    names = dict.fromkeys(name for of_one in aids for name in of_one)
    columns: dict[str, Any] = {
        name: np.concatenate([getattr(one, name) for one in stretches])
        for name in Stretch._fields
        if name not in ("states", "aids")
    }
    return Stretch(
        states=states[0].followed_by(*states[1:]),
        aids={n: joined_aids([of_one[n] for of_one in aids if n in of_one]) for n in names},
        **columns,
    )


def pack_judged(aids: Mapping[str, JudgedAid]) -> Iterator[tuple[str, Array]]:
    """Yield name and array of what became of aids, for checkpoints."""
    for name, judged in aids.items():
        for column, array in judged.aid.pack():
            yield f"aid_{name}_{column}", array
        for column, array in zip(JudgedAid._fields[1:], judged[1:], strict=True):
            yield f"judged_{name}_{column}", array


def unpack_judged(
    arrays: Mapping[str, Array], sensors: Mapping[str, Aid], *, prefix: str
) -> dict[str, JudgedAid]:
    """Return what was packed, of sensors by their names; names of arrays begin with ``prefix``."""
    found = {}
    for name, template in sensors.items():
        if f"{prefix}judged_{name}_weight" in arrays:
            own = {n: arrays[f"{prefix}aid_{name}_{n}"] for n in template.columns()}
            others = (arrays[f"{prefix}judged_{name}_{n}"] for n in JudgedAid._fields[1:])
            found[name] = JudgedAid(template.unpack(own), *others)
    return found
