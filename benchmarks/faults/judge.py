"""From a run with a fault to a row of the table, and whether it passes."""

from __future__ import annotations

import math
from collections import Counter
from typing import Final, NamedTuple

import numpy as np

from benchmarks.faults.case import (
    GROUPS,
    INSIDE,
    WORSE,
    Case,
    Run,
    difference_of,
    good_from,
    shares_inside,
    spells,
    undisturbed,
)
from ssm_graph.mission.navigation import Health

LEAST_SHARE: Final = 0.95
SAME: Final = 1e-6
"""Sigmas."""
HEADER: Final = (
    *("fault", "injected", "events told", "health from, s", "good again after, s", "lost"),
    *("off undisturbed at the end", "truth inside 3 σ while GOOD", "verdict"),
)
_PERCENT: Final = f"{100.0 * LEAST_SHARE:.0f} %"
RULES: Final = f"""\
A row passes if (1) nothing raised; (2) while the health is GOOD the truth is inside three sigmas in
at least {_PERCENT} of all components of position, of velocity and of attitude; (3) no message is
lost in silence: each is used or counted as refused; (4) where the fault can be seen, the health is
as bad as it has to be in time, and the event that names it is told; (5) where the fault ends, or
can be lived with, the health is GOOD in time and stays so; (6) where it is GOOD at the end, the
answer is within three of its sigmas of that of the undisturbed mission in every component, and
where the fault takes nothing away it is the same answer to {SAME:g} sigmas.

An absolute sensor that goes off for good, depth or GNSS, is followed in the end, for nothing else
sees what it measures. The answer is BAD before, `recovered` is told, and it is not GOOD for ten
minutes; the runs here end before, and after that it would be GOOD at the wrong place.
"""


class Row(NamedTuple):
    """A row of the table."""

    cells: tuple[str, ...]
    faults: tuple[str, ...]
    """What is wrong with it."""

    @property
    def has_passed(self) -> bool:
        """Whether nothing is."""
        return not self.faults

    @property
    def texts(self) -> list[str]:
        """The cells and the verdict."""
        return [*self.cells, "pass" if self.has_passed else f"**fail**: {'; '.join(self.faults)}"]


def judge(case: Case, run: Run) -> Row:
    """Return the row of a case."""
    faults = [] if run.failure is None else [f"raised: {run.failure.splitlines()[-1]}"]
    shares = shares_inside(run.looks, case, Health.GOOD)
    for name, share in zip(GROUPS, shares, strict=True):
        if share < LEAST_SHARE:
            faults.append(f"{name} inside in {100 * share:.0f} % while GOOD")
    if run.n_silent:
        faults.append(f"{run.n_silent} messages lost in silence")
    faults += _told(case, run)
    after_s = good_from(run.looks) - (case.end_s if case.end_s < math.inf else case.begin_s)
    wanted_s = case.rule.good_after_s
    if wanted_s is not None and after_s > wanted_s:
        faults.append(f"not good within {wanted_s:g} s")
    off, problem = _off(case, run)
    faults += [problem] if problem else []
    told = Counter(event.kind for event in run.events if event.kind not in ("aligning", "aligned"))
    cells = (
        case.name,
        case.injected,
        ", ".join(f"{kind} {n}" for kind, n in told.items()) or "none",
        health_text(run),
        "–" if math.isinf(after_s) else f"{max(after_s, 0.0):.1f}",
        ", ".join(f"{name}: {n}" for name, n in run.counts.items()) or "none",
        off,
        share_text(shares),
    )
    return Row(cells, tuple(faults))


def _told(case: Case, run: Run) -> list[str]:
    rule, faults = case.rule, []
    span = [x for x in run.looks if case.begin_s <= x.true_s <= case.begin_s + rule.within_s]
    if max((WORSE[x.health] for x in span), default=0) < WORSE[rule.worst]:
        faults.append(f"never {rule.worst.name} within {rule.within_s:g} s")
    if rule.told and not any(event.kind.startswith(rule.told) for event in run.events):
        faults.append(f"{rule.told} not told")
    return faults


def _off(case: Case, run: Run) -> tuple[str, str]:
    """Return how far the last answer is off the undisturbed one, and what is wrong with that."""
    last, other = run.looks[-1], undisturbed(case.stage).looks[-1].navigation
    assert other is not None
    if last.navigation is None:
        return "no answer", ""
    difference = difference_of(last.navigation, other)
    sigmas = float(np.max(difference.sigmas))
    text = f"{np.linalg.norm(difference.error[0, :3]):.2f} m, {sigmas:.2g} σ"
    if case.rule.is_harmless and not sigmas < SAME:
        return text, f"another answer, by {sigmas:.1g} sigmas"
    if last.health is Health.GOOD and not sigmas < INSIDE:
        return text, f"GOOD at {sigmas:.1f} sigmas"
    return text, ""


def health_text(run: Run) -> str:
    """Return the health in time, without the first alignment."""
    found = spells(run.looks)
    first = int(len(found) > 1 and found[0][1] is Health.ALIGNING)
    parts = [f"{begin_s:.1f} {health.name}" for begin_s, health in found[first:]]
    if len(parts) > 8:
        parts = [*parts[:4], f"… {len(parts) - 7} more …", *parts[-3:]]
    return "; ".join(parts)


def share_text(shares: tuple[float, ...]) -> str:
    """Return three shares in percent."""
    return " / ".join("–" if math.isnan(share) else f"{100 * share:.0f}" for share in shares) + " %"
