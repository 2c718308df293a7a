"""The search over a long mission in pieces that overlap by half.

The evidence of all stretches grows with the square of their number, so it is made of one piece at
a time; the trajectory is that of the whole mission, but nuisances are each piece's own. What is
found counts in the middle of its piece, where both of its edges are seen best; what two pieces
find of the same is joined.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ssm_graph.base.frozen import Array
from ssm_graph.base.stepwise import Steps
from ssm_graph.engine.error_state import POSITION
from ssm_graph.smoothers.faults.columns import TREND_S, Channels
from ssm_graph.smoothers.faults.hypotheses import Course
from ssm_graph.smoothers.faults.judged import Fault, Judge
from ssm_graph.smoothers.faults.search import SAME_ANSWER_SIGMAS, Beside, FaultSearch, Look


class Piece(NamedTuple):
    """Keyframes that are searched together."""

    begin: int
    end: int
    """The first one after it"""
    from_seam: int
    """Where its middle begins; that of the piece before ends there"""


def pieces_of(keyframe_s: Array, piece_s: float) -> list[Piece]:
    """Return pieces of ``piece_s`` that overlap by half; their middles are all of the mission."""
    half_s, first_s = 0.5 * piece_s, float(keyframe_s[0])
    n_more = int(np.ceil(max(float(keyframe_s[-1]) - first_s - piece_s, 0.0) / half_s))
    begins_s = first_s + half_s * np.arange(n_more + 1)
    begin = np.searchsorted(keyframe_s, begins_s).tolist()
    end = np.searchsorted(keyframe_s, begins_s + piece_s)
    seam = np.searchsorted(keyframe_s, begins_s[1:] + 0.5 * half_s).tolist()
    n = len(keyframe_s)
    ends = [*end[:-1].tolist(), n]
    return [Piece(*one) for one in zip(begin, ends, [0, *seam], strict=True)]


class PieceSearch:
    """The search over all pieces, look after look."""

    def __init__(self, settings: FaultSearch) -> None:
        self._settings = settings
        self._p_n: dict[Piece, Array] = {}
        """(k, 3) where the vehicle was when a piece had nothing, m"""

    def find_steps(
        self, judge: Judge, channels: Channels, known: Sequence[Fault]
    ) -> Steps[list[Fault]]:
        """Return what is off anywhere in a mission: what was before, and what is new.

        A piece that had nothing, and whose answer is still the same, is not searched again.
        """
        keyframe_s, p_n = judge.linear.problem.keyframe_s, judge.linear.states.p_n
        variance = np.trace(judge.linear.solution.covariance_of(POSITION), axis1=1, axis2=2) / 3.0
        found: list[tuple[Piece, list[Fault]]] = []
        for piece in pieces_of(keyframe_s, self._settings.piece_s):
            own, here = parts_of(known, piece, keyframe_s), slice(piece.begin, piece.end)
            last = self._p_n.pop(piece, None)
            if own or last is None or _has_moved(p_n[here] - last, variance[here]):
                look = Look(judge, channels, self._settings, (piece.begin, piece.end))
                own = yield from look.find_steps(own)
                last = p_n[here]
            if not own:
                self._p_n[piece] = last
            found.append((piece, own))
        return joined_of(found)

    def beside(self, judge: Judge, channels: Channels, known: Sequence[Fault]) -> Beside:
        """Return what there may be beside; what instruments do not state is so in all pieces.

        The first one says that. Of jumps that may be chance the likeliest of all pieces counts.
        What goes on to the end of its piece does so to that of the mission.
        """
        keyframe_s = judge.linear.problem.keyframe_s
        first, *later = (
            (piece, Look(judge, channels, self._settings, (piece.begin, piece.end)))
            for piece in pieces_of(keyframe_s, self._settings.piece_s)
        )
        piece, look = first
        found = look.beside(parts_of(known, piece, keyframe_s))
        n = len(keyframe_s)
        instead = [_lasting(one, piece, n) for one in found.instead]
        possible = [replace(one, end=n) for one in found.possible]
        for piece, look in later if not instead else []:
            others = look.possible(parts_of(known, piece, keyframe_s))
            possible += [replace(one, end=n) for one in others]
        likeliest = sorted(possible, key=lambda one: -one.chi_sq)[:1]
        return found._replace(instead=instead, possible=likeliest)


def _lasting(one: Fault, piece: Piece, n: int) -> Fault:
    """Return a fault that goes on to the last of ``n`` keyframes if it does to its piece's end."""
    if one.end < piece.end:
        return one
    rivals = tuple(_lasting(rival, piece, n) for rival in one.rivals)
    return replace(one, end=n, rivals=rivals)


def _has_moved(by_n: Array, variance: Array) -> bool:
    """Return whether positions have changed (k, 3), m, by more than what explains nothing else."""
    return bool(np.any(np.sum(by_n**2, axis=1) > SAME_ANSWER_SIGMAS**2 * variance))


def parts_of(faults: Iterable[Fault], piece: Piece, keyframe_s: Array) -> list[Fault]:
    """Return what of faults is within a piece, and so of their rivals."""
    found = []
    for fault in faults:
        begin, end = max(fault.begin, piece.begin), min(fault.end, piece.end)
        if begin >= end:
            continue
        hypothesis, sizes = fault.hypothesis, fault.sizes
        if begin > fault.begin and hypothesis.course is Course.RAMP:
            hypothesis = replace(hypothesis, course=Course.TREND)
        if sizes is not None and hypothesis.course is Course.TREND:
            # The rate counts from the begin of the stretch on.
            rate = sizes[-hypothesis.combined.shape[1] :]
            constant = sizes[: -len(rate)] if len(sizes) > len(rate) else np.zeros_like(rate)
            since = (keyframe_s[begin] - keyframe_s[fault.begin]) / TREND_S
            sizes = np.concatenate([constant + since * rate, rate])
        rivals, onsets = (
            tuple(parts_of(of, piece, keyframe_s)) for of in (fault.rivals, fault.onsets)
        )
        found.append(
            replace(
                fault,
                hypothesis=hypothesis,
                begin=begin,
                end=end,
                sizes=sizes,
                rivals=rivals,
                onsets=onsets,
            )
        )
    return found


def joined_of(found: Iterable[tuple[Piece, Iterable[Fault]]]) -> list[Fault]:
    """Return what was found in successive pieces, what two of them share being joined.

    Of what one alone has, it stays where most of it is in that one's middle, and to the seam where
    it goes on to the end of the piece.
    """
    done: list[Fault] = []
    last: list[Fault] = []
    last_end = 0
    for piece, own in found:
        now = []
        for fault in own:
            before = _same_of(last, fault)
            if before is not None:
                last.remove(before)
                now.append(joined(before, fault, piece.from_seam))
            elif fault.begin + fault.end > 2 * piece.from_seam:
                is_cut = 0 < piece.begin == fault.begin
                now.extend(_cut(fault, piece.from_seam, fault.end) if is_cut else [fault])
        done.extend(_until(last, piece.from_seam, last_end))
        last, last_end = now, piece.end
    return [*done, *last]


def joined(one: Fault, later: Fault, seam: int) -> Fault:
    """Return what two pieces found of the same: each edge as the piece says that sees it best.

    Rivals are those of the stronger of both, joined with the same ones of the other.
    """
    begin = one.begin if one.begin < seam else later.begin
    end = later.end if later.end > seam else one.end
    stronger, other = (one, later) if one.merit > later.merit else (later, one)
    rivals = []
    for rival in stronger.rivals:
        same = _same_of(other.rivals, rival)
        if same is not None:
            first, second = (rival, same) if stronger is one else (same, rival)
            rival = joined(first, second, seam)
        rivals.append(rival)
    onsets = tuple(
        replace(other, end=end)
        for other in stronger.onsets
        if other.begin < end and other.end == stronger.end
    )
    return replace(stronger, begin=begin, end=end, rivals=tuple(rivals), onsets=onsets)


def _until(faults: Iterable[Fault], seam: int, piece_end: int) -> Iterator[Fault]:
    """Yield faults that the piece after theirs does not have."""
    for fault in faults:
        if fault.begin + fault.end <= 2 * seam:
            yield from _cut(fault, fault.begin, seam) if fault.end == piece_end else [fault]


def _cut(fault: Fault, begin: int, end: int) -> list[Fault]:
    """Return a fault on one side of a seam, none of rows that would count for nothing.

    Those can say no more in later looks, in which the piece beyond may have taken over its name.
    """
    return (
        [] if fault.hypothesis.course is Course.ANYTHING else [replace(fault, begin=begin, end=end)]
    )


def _same_of(faults: Iterable[Fault], other: Fault) -> Fault | None:
    """Return the one with the same numbers of a sensor, over a stretch that overlaps."""
    return next((one for one in faults if _is_same(one, other)), None)


def _is_same(one: Fault, other: Fault) -> bool:
    a, b = one.hypothesis, other.hypothesis
    # Of a ramp that began in the piece before there is a trend here.
    is_like = a.channel == b.channel and (a.course is b.course or (a.has_rate and b.has_rate))
    is_over_same = max(one.begin, other.begin) < min(one.end, other.end)
    return is_over_same and is_like and np.array_equal(a.combined, b.combined)
