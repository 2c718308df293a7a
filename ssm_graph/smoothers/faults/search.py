"""The search for what was off, and when.

All hypotheses compete over all stretches of whole blocks. The best one that exceeds its charge has
its edges refined, competes again, is freed, which shows what the others look like without it, and so
on, as in a step-wise regression. What was found before competes anew at every look, for the first
solution may be far off.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from ssm_graph.base.errors import ConfigError
from ssm_graph.base.frozen import Array
from ssm_graph.base.stepwise import Steps
from ssm_graph.smoothers.faults.columns import Channels
from ssm_graph.smoothers.faults.hypotheses import Hypothesis, hypotheses_of
from ssm_graph.smoothers.faults.judged import Candidate, Fault, Grid, Judge, Judged

FINE_S = 1.0
"""s, to which edges are refined."""
NEW_PER_LOOK = 3
"""Faults that one look adds: each bends the solution that the others are judged at."""
MEDIAN_SQUARE = 0.4549364
"""Of a standard Gaussian."""
WITHIN_MARGIN = 12.0


@dataclass(frozen=True, slots=True)
class FaultSearch:
    """Settings of the search."""

    block_s: float = 10.0
    """Stretches are looked for in blocks of this."""
    significance: float = 4.9
    """Sigmas by which one number must differ from zero: 1e-6; more numbers have to be as unlikely,
    and each further one has to earn its keep besides."""
    margin: float = 12.0
    """A rival whose chi-square is less by no more than this explains the data as well."""

    def __post_init__(self) -> None:
        for name in ("block_s", "significance", "margin"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0.0):
                raise ConfigError(f"{name}: expected a number above zero, got {value}")


class Look:
    """One look at a linearised mission, with what was found by those before."""

    def __init__(self, judge: Judge, channels: Channels, settings: FaultSearch) -> None:
        self._judge, self._settings = judge, settings
        self._keyframe_s = judge.linear.problem.keyframe_s
        self.hypotheses = hypotheses_of(channels)

    def find_steps(self, known: Sequence[Fault]) -> Steps[list[Fault]]:
        """Return what is off, from what was thought to be before."""
        found = yield from self._again_steps(known)
        for _ in range(NEW_PER_LOOK):
            coarse = self._judged(found)
            yield 0.1 * len(self._keyframe_s)
            best = best_of(coarse.with_freed(found), self.hypotheses)
            yield 0.1 * len(self._keyframe_s)
            if best.merit <= 0.0:
                break
            rough = self._fault(best, coarse)
            fine = self._judged([*found, rough], refined=[rough])
            yield 0.2 * len(self._keyframe_s)
            left = fine.with_freed(found)
            refined = best_of(left, self.hypotheses)
            found.append(self._fault(refined, left))
            yield 0.2 * len(self._keyframe_s)
        return self._beyond_what_remains(found)

    def _again_steps(self, known: Sequence[Fault]) -> Steps[list[Fault]]:
        """Let each compete anew where it is, the others being freed."""
        found = list(known)
        if not found:
            return found
        fine = self._judged(found, refined=found)
        yield 0.2 * len(self._keyframe_s)
        for fault in sorted(known, key=lambda fault: fault.merit):
            found.remove(fault)
            left = fine.with_freed(found)
            best = best_of(left, self.hypotheses, near=fault)
            yield 0.2 * len(self._keyframe_s)
            if best.merit > 0.0:
                found.append(self._fault(best, left))
        return found

    def _beyond_what_remains(self, found: list[Fault]) -> list[Fault]:
        """Keep what stands out of the excess that is left when all that was found is freed."""
        if not found:
            return found
        judged = self._judged(found)
        excess = excess_of(judged.with_freed(found))
        if excess <= 1.0:
            return found
        return [f for f in found if f.chi_sq / excess > f.chi_sq - f.merit]

    def _judged(self, faults: Iterable[Fault], refined: Iterable[Fault] = ()) -> Judged:
        """Return the evidence on blocks that begin and end where the faults do."""
        last_s = self._keyframe_s[-1]
        edges_s = [np.arange(self._keyframe_s[0], last_s, self._settings.block_s)]
        time_s = np.append(self._keyframe_s, last_s + 1.0)
        for fault in faults:
            edges_s.append(time_s[[fault.begin, fault.end]])
        around = np.arange(-self._settings.block_s, self._settings.block_s + FINE_S, FINE_S)
        for fault in refined:
            for edge_s in time_s[[fault.begin, fault.end]]:
                edges_s.append(edge_s + around)
        return self._judge.on(Grid.of(self._keyframe_s, np.concatenate(edges_s)))

    def _fault(self, candidate: Candidate, judged: Judged) -> Fault:
        edges = judged.grid.edges
        return Fault(
            candidate.hypothesis,
            int(edges[candidate.begin]),
            int(edges[candidate.end]),
            candidate.chi_sq,
            candidate.merit,
        )


def best_of(
    judged: Judged, hypotheses: Sequence[Hypothesis], *, near: Fault | None = None
) -> Candidate:
    """Return the best hypothesis with its stretch; ``near`` a fault, one that has to overlap it."""
    return judged.best_of(hypotheses, near=near)[0]


def excess_of(judged: Judged) -> float:
    """Return by how much the chi-squares of single blocks exceed those of noise as stated.

    Of the channels' medians the largest counts.
    """
    n, width = judged.grid.n_blocks, judged.channels.width
    information = np.diagonal(judged.evidence.information).reshape(n, width)
    square = judged.evidence.score.reshape(n, width) ** 2
    chi_sq: Array = np.divide(square, information, out=np.zeros_like(square), where=information > 0)
    medians = [np.median(chi_sq[:, channel.columns]) for channel in judged.channels.all]
    return float(np.max(medians)) / MEDIAN_SQUARE
