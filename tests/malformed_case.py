"""What a case of the catalogue of malformed missions is."""

from __future__ import annotations

from dataclasses import dataclass

from ssm_graph.base.errors import SsmGraphError
from tests.mission_damage import Damage


@dataclass(frozen=True, slots=True)
class Malformed:
    """One way in which a mission folder can be wrong."""

    title: str
    """What is wrong with it, for people."""
    damage: Damage
    """Turn a valid folder into a wrong one."""
    error: type[SsmGraphError]
    words: tuple[str, ...]
    """What the message must contain: where, and the point of the hint."""
