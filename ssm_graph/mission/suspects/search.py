"""Which hypothesis makes a mission's logs agree, by how much, and how surely.

A family of hypotheses differs by one number. It is scanned, not linearised: turns, waves and an
attitude that is wrong altogether break first order. The loss is minus the logarithm of a Student
likelihood, summed over blocks of residuals that err independently.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from typing import Final

import numpy as np

from ssm_graph.base.frozen import Array
from ssm_graph.mission.mission import Mission
from ssm_graph.mission.suspects.evidence import Part, parts_of
from ssm_graph.mission.suspects.hypothesis import Delay, Hypothesis, with_delays
from ssm_graph.mission.suspects.regression import EXPECTED_LOSS, loss, scale_of
from ssm_graph.mission.suspects.track import Logs

ENOUGH: Final = 25.0
"""Gain in the logarithm of the likelihood that is asked for; 6 sigma are 18."""
SURE: Final = 6.0
"""Sigmas, by the scatter over blocks, that a value has to be off."""
WITHOUT_BEST: Final = 10.0
"""Of the gain, what has to remain without the block that says most."""
HINT: Final = 3.0
"""Gain of a small step from the null that makes a family worth a scan."""
POOR: Final = 1.6
"""Mean loss of a part over the expected one, above which every hypothesis about it is tried,"""
POOR_BLOCK: Final = 4.0
"""and that of its worst block."""
CURVED: Final = 8.0
"""Rise of the loss between neighbours up to which it is a parabola."""
ROUNDS: Final = 9
LEAST_STEP_S: Final = 0.7
"""By less no clock is set: they are set by whole seconds."""
STEP_WIDTH_S: Final = 0.1
FAR_S: Final = 2.0
FAR_SHARE: Final = 0.25
"""Of the loss of what it touches, the gain of a delay beyond :data:`FAR_S`: it spoils all of a
comparison, while whole periods of the waves change little, and by chance to the better."""
STEP_BETTER: Final = 15.0
"""Gain over one constant delay that a clock that was set needs: a second delay and a time."""
JUMP_AS_GOOD: Final = 6.0
"""A step of the position may explain the fixes better by so much."""


@dataclass(frozen=True)
class Family:
    """Hypotheses that differ by one number."""

    name: str
    make: Callable[[Hypothesis, float], Hypothesis]
    near: tuple[float, ...]
    """Values to try where there is a hint, in order,"""
    far: tuple[float, ...]
    """and where the logs agree poorly."""
    least: float
    """How far from the null it has to be to matter."""
    null: float = 0.0
    cared: float = 0.0
    """How far from it a calibration that the mission asks for takes care of."""
    is_discrete: bool = False
    """Whether values between those to try mean nothing."""
    only_poor: bool = False
    """Whether it is only tried where the logs agree poorly."""
    clocks: tuple[str, ...] = ()
    """The delays of the hypothesis that it changes, if it is a clock."""
    part: str = ""
    """The part that says most of it."""


@dataclass(frozen=True, eq=False)
class Found:
    """The best of a family."""

    family: Family
    value: float
    sigma: float
    hypothesis: Hypothesis
    gain: float
    without_best: float
    """The gain less that of the block that gains most"""
    by_part: dict[str, float]
    """Gain of each part"""
    share: float = 1.0
    """The gain, of the loss without it"""
    rivals: tuple[Found, ...] = ()
    """Others that explain the logs as well"""

    @property
    def is_sure(self) -> bool:
        """Whether it is beyond what errors of healthy instruments make."""
        off = abs(self.value - self.family.null)
        enough = self.gain > ENOUGH and self.without_best > WITHOUT_BEST
        if self.is_far and self.share < FAR_SHARE:
            return False
        least = LEAST_STEP_S if self.is_set else self.family.least
        return enough and off > max(least, SURE * self.sigma)

    @property
    def is_far(self) -> bool:
        """Whether it is a clock that is off by seconds all the time."""
        return bool(self.family.clocks) and not self.is_set and abs(self.value) > FAR_S

    @property
    def is_cared_for(self) -> bool:
        """Whether the mission asks for a calibration that finds it."""
        return not self.is_set and abs(self.value - self.family.null) <= self.family.cared

    @property
    def delay(self) -> Delay | None:
        """The delay of its clock, None of what is none."""
        return getattr(self.hypothesis, self.family.clocks[0]) if self.family.clocks else None

    @property
    def is_set(self) -> bool:
        """Whether it is a clock that was set in mid-run."""
        return self.delay is not None and self.delay.before_s != self.delay.after_s


@dataclass(eq=False)
class Evidence:
    """Residuals of all parts, each made once for what it depends on."""

    logs: Logs
    parts: tuple[Part, ...]
    _made: dict[tuple[object, ...], Array] = field(default_factory=dict)

    @classmethod
    def of(cls, mission: Mission) -> Evidence:
        """Return that of a mission."""
        logs = Logs(mission)
        return cls(logs, parts_of(logs))

    def residual(self, part: Part, of: Hypothesis) -> Array:
        """Return the residuals (n,) of a part."""
        key = (part.name, *part.depends_on(of))
        if key not in self._made:
            self._made[key] = part.residual(self.logs, of)
        return self._made[key]

    def losses(self, hypotheses: Sequence[Hypothesis], only: str = "") -> dict[str, Array]:
        """Return the loss (h, g) by hypothesis and block of every part that they differ in.

        All residuals of a part are on one scale, the least that one of the hypotheses needs.
        """
        found: dict[str, Array] = {}
        for part in self.parts:
            differs = len({part.depends_on(of) for of in hypotheses}) > 1
            if not differs or only not in ("", part.name):
                continue
            residuals = [self.residual(part, of) for of in hypotheses]
            scale = min(scale_of(r) for r in residuals)
            n = int(part.group[-1]) + 1
            found[part.name] = np.stack(
                [
                    np.bincount(part.group, loss(r, scale), minlength=n).astype(float)
                    for r in residuals
                ]
            )
        return found

    def total(self, hypotheses: Sequence[Hypothesis], only: str = "") -> Array:
        """Return the loss (h,) of hypotheses over all blocks and parts."""
        losses = self.losses(hypotheses, only).values()
        return np.asarray(sum((x.sum(axis=1) for x in losses), np.zeros(len(hypotheses))))

    def poor(self, of: Hypothesis) -> set[str]:
        """Return the names of the parts that agree poorly."""
        names = set()
        for part in self.parts:
            each = loss(self.residual(part, of), 1.0) / EXPECTED_LOSS
            blocks = np.bincount(part.group, each) / np.bincount(part.group)
            if each.mean() > POOR or blocks.max() > POOR_BLOCK:
                names.add(part.name)
        return names

    def best_of(self, family: Family, base: Hypothesis, poor: set[str]) -> Found | None:
        """Return the best value of a family beside a base; None where nothing hints at it."""
        ends = [family.make(base, family.null), family.make(base, family.far[0])]
        touched = {p.name for p in self.parts if len({p.depends_on(h) for h in ends}) > 1}
        if not touched:
            return None
        first = family.part if family.part in touched else ""
        is_poor = bool(poor & ({first} if first else touched)) or len(touched & poor) > 1
        null = family.null
        if not is_poor:
            if family.is_discrete or family.only_poor:
                return None
            probes = (null, null - family.least, null + family.least)
            at = self.total([family.make(base, v) for v in probes], first)
            if at[0] - at.min() < HINT:
                return None
        values = sorted({null, *family.near, *(family.far if is_poor else ())})
        for only in dict.fromkeys((first, "")):
            values = self._refined(family, base, values, only)
        return self._found(family, base, values)

    def _refined(
        self, family: Family, base: Hypothesis, values: list[float], only: str
    ) -> list[float]:
        """Return values about the least loss so near each other that it is a parabola there."""
        null = family.null
        for _ in range(ROUNDS):
            total = self.total([family.make(base, v) for v in values], only)
            at = int(np.argmin(total))
            around = slice(max(at - 1, 0), at + 2)
            if family.is_discrete or np.ptp(total[around]) < CURVED:
                break
            fine = np.linspace(values[around][0], values[around][-1], 7).tolist()
            values = sorted({null, *fine, values[at]})
        return sorted({null, *values[around]})

    def _found(self, family: Family, base: Hypothesis, values: list[float]) -> Found | None:
        hypotheses = [family.make(base, v) for v in values]
        by_part = self.losses(hypotheses)
        blocks = np.concatenate(list(by_part.values()), axis=1)
        at, null = int(np.argmin(blocks.sum(axis=1))), values.index(family.null)
        if at == null:
            return None
        value, sigma = values[at], 0.0
        if not family.is_discrete and 0 < at < len(values) - 1:
            least, sigma = vertex(np.array(values[at - 1 : at + 2]), blocks[at - 1 : at + 2])
            losses = self.total([family.make(base, v) for v in (value, least)])
            value = least if losses[1] < losses[0] else value
        gains = blocks[null] - blocks[at]
        return Found(
            family,
            value,
            sigma,
            hypothesis=family.make(base, value),
            gain=float(gains.sum()),
            share=float(gains.sum() / blocks[null].sum()),
            without_best=float(gains.sum() - gains.max()),
            by_part={name: float((x[null] - x[at]).sum()) for name, x in by_part.items()},
        )

    def set_clock(self, family: Family, base: Hypothesis, values: Sequence[float]) -> Found | None:
        """Return the best change of a delay at some time beside a base; None without blocks.

        Parameters
        ----------
        family : of the clock.
        base : what is known besides; its own delay of that clock is left out.
        values : delays to try before or after the change, s.
        """
        part = next((p for p in self.parts if p.name == family.part), None)
        if part is None or len(part.begin_s) < 3:
            return None

        def of(delay: Delay) -> Hypothesis:
            return with_delays(base, dict.fromkeys(family.clocks, delay))

        def loss_of(delays: Sequence[Delay]) -> Array:
            return self.total([of(d) for d in delays], family.part)

        tried = list(self._likely_steps(part, of, values))
        best = tried[int(np.argmin(loss_of(tried)))]
        spacing = float(np.median(np.diff(part.begin_s)))
        for reach in (spacing, 0.3 * spacing, 0.1 * spacing):
            shifts = np.linspace(-reach, reach, 9)
            near = [replace(best, switch_s=best.switch_s + s) for s in shifts]
            best = near[int(np.argmin(loss_of(near)))]
            for name in ("before_s", "after_s"):
                width = max(0.06, 0.03 * reach)
                now = getattr(best, name)
                near = [replace(best, **{name: now + s}) for s in np.linspace(-width, width, 7)]
                best = near[int(np.argmin(loss_of(near)))]
        return self._step_found(family, base, of, best)

    def _likely_steps(
        self, part: Part, of: Callable[[Delay], Hypothesis], values: Sequence[float]
    ) -> Iterator[Delay]:
        """Yield steps of a delay worth a look: by the sum of blocks, and where residuals jump."""
        delays = [Delay(v, v) for v in (0.0, *values)]
        losses = self.losses([of(d) for d in delays], part.name)[part.name]
        gains = losses[0] - losses[1:]
        for of_run, is_before in ((np.cumsum(gains, axis=1), True), (_sums_behind(gains), False)):
            for v, block in np.argwhere(of_run >= np.sort(of_run.ravel())[-4]):
                at = min(int(block) + is_before, len(part.begin_s) - 1)
                yield _step(values[int(v)], float(part.begin_s[at]), is_before)
        jumps = np.argsort(losses[0])[-2:]
        for switch, v in product(
            {float(part.begin_s[b]) for b in jumps} - {part.begin_s[0]}, values
        ):
            yield from (_step(v, switch, is_before) for is_before in (True, False))

    def _step_found(
        self, family: Family, base: Hypothesis, of: Callable[[Delay], Hypothesis], best: Delay
    ) -> Found:
        by_part = self.losses([base, of(Delay()), of(best)])
        blocks = np.concatenate(list(by_part.values()), axis=1)
        gains = blocks[1] - blocks[2]
        side = "before_s" if abs(best.before_s) > abs(best.after_s) else "after_s"
        late_s = getattr(best, side)
        around = late_s + np.array([-STEP_WIDTH_S, 0.0, STEP_WIDTH_S])
        bent = self.losses([of(replace(best, **{side: v})) for v in around], family.part)
        return Found(
            family,
            value=best.before_s - best.after_s,
            sigma=vertex(around, bent[family.part])[1],
            hypothesis=of(best),
            gain=float((blocks[0] - blocks[2]).sum()),
            without_best=float(gains.sum() - gains.max()),
            by_part={name: float((x[1] - x[2]).sum()) for name, x in by_part.items()},
        )


def _sums_behind(gains: Array) -> Array:
    """Return the sums (v, g) from each block to the last."""
    return np.asarray(np.cumsum(gains[:, ::-1], axis=1)[:, ::-1])


def _step(late_s: float, switch_s: float, is_before: bool) -> Delay:
    return Delay(late_s, 0.0, switch_s) if is_before else Delay(0.0, late_s, switch_s)


def vertex(values: Array, curve: Array) -> tuple[float, float]:
    """Return where a loss (3, g), summed over blocks, is least, and the sigma of that.

    A parabola through three values; the sigma is the larger of what its curvature says and of the
    scatter of the vertex when one block after the other is left out.
    """
    middle, (low, _, high) = values[1], values - values[1]

    def least(y: Array) -> tuple[Array, Array]:
        down, up = (y[0] - y[1]) / low, (y[2] - y[1]) / high
        bend = (up - down) / (high - low)
        slope = down - bend * low
        flat = np.abs(bend) < 1e-12
        at = np.where(flat, 0.0, -0.5 * slope / np.where(flat, 1.0, bend))
        return middle + np.clip(at, low, high), 2.0 * bend

    total = curve.sum(axis=1)
    at, bend = least(total)
    left_out, _ = least(total[:, None] - curve)
    n = len(left_out)
    scatter = np.sqrt((n - 1) / n * np.sum((left_out - left_out.mean()) ** 2))
    return float(at), max(float(scatter), max(float(bend), 1e-12) ** -0.5)
