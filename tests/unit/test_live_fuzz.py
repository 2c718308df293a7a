"""Damaged traffic, a little of it; and that what is looked for is seen."""

from __future__ import annotations

import math
import random
from typing import cast

import pytest

from ssm_graph.live.protocols.decoder import Decoder
from ssm_graph.sensors.depth import DepthReading
from ssm_graph.sensors.messages import Message
from tests.damaged_traffic import Target, damaged, json_traffic, run, targets


@pytest.mark.parametrize("k", range(len(targets())))
def test_damaged_traffic_does_no_harm(k: int) -> None:
    """The same bytes every time; `benchmarks/results/fuzz.md` has ten million."""
    others = targets()
    run(others[k], others, 50_000, random.Random(7))
    assert others[k].failures == []
    assert others[k].messages > 20


def test_traffic_is_sound_before_it_is_damaged() -> None:
    """Each decoder takes all of its own traffic without a refusal but of fixes that are none."""
    rng = random.Random(0)
    for target in targets():
        for k in range(50):
            target.feed(target.traffic(rng, 1.7e9 + k), 1.7e9 + k)
        refused = target.decoder.take_refusals()
        assert all("fix" in text for text in refused if "more were" not in text)
        assert target.messages >= 25


def test_damage_is_that_of_the_seed() -> None:
    """And it is damage."""
    data = b"".join(json_traffic(random.Random(k), 1.0) for k in range(20))
    found = [damaged(data, random.Random(seed)) for seed in (1, 1, 2)]
    assert found[0] == found[1] != found[2] != data


class _Broken:
    """A decoder that does all that is forbidden."""

    n_held = 10**6

    def feed(self, data: bytes, *, arrival_s: float) -> list[Message]:
        if b"x" in data:
            raise KeyError("x")
        return [DepthReading(arrival_s, math.inf)]

    def take_refusals(self) -> list[str]:
        return ["\x1b"] * 100


def test_failures_are_seen() -> None:
    """Raising, holding, numbers that are not finite, refusals too many or not printable."""
    target = Target("broken", cast(Decoder, _Broken()), json_traffic)
    target.feed(b"x", 0.0)
    target.feed(b"y", 0.0)
    target.take()
    text = " ".join(target.failures)
    for word in ("KeyError", "holds 1000000", "depth of", "kept 100", "refusal"):
        assert word in text
