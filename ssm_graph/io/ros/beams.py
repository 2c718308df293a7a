"""Which way the beams of a recorded DVL look, and which sign their speeds have.

The velocity that an instrument makes of its own beams proves both: ``beams_d @ velocity_d`` has to
be the beam speeds.  That is worth a look, for drivers err: several publish vectors for the Water
Linked A50 with its 22.5 degrees counted from the horizontal, and others leave them zero.
"""

from __future__ import annotations

from itertools import combinations
from typing import Final, NamedTuple

import numpy as np

from ssm_graph.base.errors import DataError
from ssm_graph.base.frames import rotation_zyx
from ssm_graph.base.frozen import Array
from ssm_graph.sensors.dvl import beams_from_angles

WATER_LINKED_BEAMS: Final = beams_from_angles(
    np.radians([135.0, -135.0, -45.0, 45.0]), float(np.radians(22.5))
)
"""Transducers 0 to 3 of A50 and A125; x forward, y starboard, z down. Against 269 reports of a real
A50 they leave 1.6 mm/s rms; a Blueye X3 has its A50 mounted backwards, and the turn is found."""

_LARGEST_MISFIT: Final = 0.2
"""Of the typical beam speed; the wrong sign gives 2, swapped angles 0.7 and more."""
_FEWEST_PINGS: Final = 10
_FEWEST_BEAMS: Final = 3
_SLOWEST: Final = 0.02
"""m/s of typical beam speed that shows directions."""
_UNIT_TOLERANCE: Final = 1e-3
_FLATTEST: Final = 0.05


class Beams(NamedTuple):
    """The outcome: directions, sign to apply to the speeds, and what a user should know."""

    beams_d: Array
    """(B, 3)"""
    sign: float
    notes: tuple[str, ...]


def stated_beams(beams_d: Array | None) -> Array | None:
    """Return directions (B, 3) as a message states them, None where they cannot be any."""
    if beams_d is None or not np.isfinite(beams_d).all():
        return None
    length = np.linalg.norm(beams_d, axis=1)
    if np.any(np.abs(length - 1.0) > _UNIT_TOLERANCE):
        return None
    beams_d = beams_d / length[:, None]
    return beams_d if np.linalg.svd(beams_d, compute_uv=False)[-1] > _FLATTEST else None


def known_beams(beams_d: Array, *, speed: Array, velocity_d: Array) -> Beams:
    """Return directions that the user gave, and the sign that the data show.

    ``speed`` is (N, B), ``velocity_d`` (N, 3), both NaN where unknown.  Directions that do not fit
    are kept and noted, for the instrument may give its velocity in other axes.

    Raises :class:`DataError`: the speeds are packed to the front, or have no sign.
    """
    choices = [Beams(beams_d, 1.0, ()), Beams(beams_d, -1.0, (_AGAINST,))]
    found = _best(choices, speed, velocity_d)
    if found is None:
        return Beams(beams_d, 1.0, (_UNCHECKED,))
    best, misfit = found
    _refuse_slips(best, speed, velocity_d)
    if misfit <= _LARGEST_MISFIT:
        return best
    text = (
        "The beam directions of the vehicle file do not reproduce the velocity that the DVL "
        f"published (misfit {100.0 * misfit:.0f} %): are they right, or is that velocity in "
        "other axes than the instrument's?"
    )
    return Beams(beams_d, 1.0, (text,))


def proven_beams(
    stated: Array | None, *, water_linked: bool, may_turn: bool, speed: Array, velocity_d: Array
) -> Beams:
    """Return directions and sign from the messages alone.

    Raises :class:`DataError`: there are no directions, or they contradict the velocity, or the
    speeds are packed to the front, or have no sign.

    Parameters
    ----------
    stated : (B, 3) directions of the messages, or None.
    water_linked : the messages are ``dvl_msgs``: the maker's geometry and sign are taken, turned
        by quarters where the velocity shows a mounting rotation.
    may_turn : whether the data may turn the sign of the speeds.
    speed, velocity_d : (N, B) and (N, 3), m/s, NaN where unknown.
    """
    if water_linked:
        choices = _quarter_turns(WATER_LINKED_BEAMS)
        stated = WATER_LINKED_BEAMS
    elif stated is None:
        raise DataError(
            "the DVL's messages state no beam directions (beam_unit_vec is not four unit vectors); "
            f"{_GIVE_VEHICLE}"
        )
    else:
        swapped = _swapped(stated)
        choices = [Beams(stated, 1.0, ()), Beams(swapped, 1.0, (_SWAPPED,))]
        if may_turn:
            both = f"{_SWAPPED} {_AGAINST}"
            choices += [Beams(stated, -1.0, (_AGAINST,)), Beams(swapped, -1.0, (both,))]
    found = _best(choices, speed, velocity_d)
    if found is None:
        return Beams(stated, 1.0, (_UNCHECKED,))
    best, misfit = found
    _refuse_slips(best, speed, velocity_d)
    if misfit > _LARGEST_MISFIT:
        raise DataError(
            "the beam directions do not reproduce the velocity that the DVL published: expected a "
            f"misfit below {100.0 * _LARGEST_MISFIT:.0f} %, got {100.0 * misfit:.0f} %; "
            f"{_GIVE_VEHICLE}"
        )
    return best


_UNCHECKED: Final = (
    "The DVL's messages hold no velocity, or too little motion, to prove directions and sign of "
    "the beams by; they are taken as stated."
)
_SWAPPED: Final = (
    "The messages' beam_unit_vec count the tilt of the beams from the horizontal, a known slip of "
    "drivers: the published velocity fits when it is counted from the vertical, as done here."
)
_GIVE_VEHICLE: Final = (
    "give the directions with  --vehicle FILE  ([dvl] beam_azimuth_deg and beam_janus_deg, or "
    "beam_vectors)"
)
_AGAINST: Final = (
    "The published velocity shows that the driver's beam speeds are positive against the motion "
    "along the beam; their sign is turned."
)
_TURNED: Final = (
    "The DVL's velocity is turned by {:.0f} degrees against its transducers "
    "(mounting_rotation_offset); the beam directions are turned along."
)


def _quarter_turns(beams_d: Array) -> list[Beams]:
    turns = [rotation_zyx(np.radians(angle), 0.0, 0.0) for angle in (0.0, 90.0, 180.0, 270.0)]
    notes = [(), *((_TURNED.format(angle),) for angle in (90.0, 180.0, 270.0))]
    return [Beams(beams_d @ R.T, 1.0, note) for R, note in zip(turns, notes, strict=True)]


def _swapped(beams_d: Array) -> Array:
    """Return directions with the angles from the vertical and the horizontal exchanged.

    A vertical beam, as that of an altimeter, has no azimuth and stays.
    """
    level = np.linalg.norm(beams_d[:, :2], axis=1, keepdims=True)
    is_tilted = level > _UNIT_TOLERANCE
    down = beams_d[:, 2:]
    ahead = beams_d[:, :2] / np.where(is_tilted, level, 1.0)
    swapped = np.hstack([ahead * np.abs(down), np.copysign(level, down)])
    return np.where(is_tilted, swapped, beams_d)


def _best(choices: list[Beams], speed: Array, velocity_d: Array) -> tuple[Beams, float] | None:
    """Return the choice that fits best, or the first, and its misfit; None if none can be judged.

    Half of the pings are used, the faster ones; the typical residual is set against the typical
    speed, so that outliers do not count.
    """
    used = np.isfinite(speed).sum(axis=1) >= _FEWEST_BEAMS
    used &= np.isfinite(velocity_d).all(axis=1) & np.any(velocity_d != 0.0, axis=1)
    if used.sum() < _FEWEST_PINGS:
        return None
    size = _rms(speed[used])
    fast = size >= np.median(size)
    speed, velocity_d = speed[used][fast], velocity_d[used][fast]
    typical = float(np.median(size[fast]))
    if typical < _SLOWEST:
        return None
    misfits = [
        float(np.median(_rms(choice.sign * speed - velocity_d @ choice.beams_d.T))) / typical
        for choice in choices
    ]
    best = int(np.argmin(misfits))
    if misfits[best] > 0.5 * misfits[0]:  # as good as: what is stated needs no change
        best = 0
    return choices[best], misfits[best]


def _refuse_slips(beams: Beams, speed: Array, velocity_d: Array) -> None:
    """Raise :class:`DataError` for two slips of drivers that the velocity shows.

    Speeds without a sign: none is below zero, and they are the sizes of what the velocity says.
    Beams packed to the front: with beams missing, those that are left stand first.
    """
    predicted = velocity_d @ beams.beams_d.T
    known = np.isfinite(velocity_d).all(axis=1) & np.any(velocity_d != 0.0, axis=1)
    signed = beams.sign * speed
    is_unsigned = not np.any(speed < 0.0) and _is_off(signed, predicted, known)
    if is_unsigned and not _is_off(np.abs(speed), np.abs(predicted), known):
        raise DataError(
            "the beam speeds have no sign: not one is below 0, and they are the sizes of what the "
            "published velocity says; expected positive along the beam and negative against it: "
            "mend the driver"
        )
    heard = np.isfinite(speed)
    count = heard.sum(axis=1)
    is_packed = ~np.any(~heard[:, :-1] & heard[:, 1:], axis=1)
    at_front = known & is_packed & (count >= _FEWEST_BEAMS) & (count < speed.shape[1])
    if not _is_off(signed, predicted, at_front):
        return
    spread = np.array([_spread(*row) for row in zip(signed, predicted, count, strict=True)])
    if not _is_off(spread, predicted, at_front):
        raise DataError(
            f"in {int(at_front.sum())} pings with missing beams the speeds are packed to the "
            "front: the published velocity shows that they belong to other beams; expected each "
            "speed in the place of its beam: mend the driver"
        )


def _is_off(speed: Array, predicted: Array, used: Array) -> bool:
    """Return whether speeds (N, B) of enough of the pings used (N,) do not fit the velocity."""
    used = used & (np.isfinite(speed).sum(axis=1) > 0)
    if used.sum() < _FEWEST_PINGS:
        return False
    size = float(np.median(_rms(np.where(np.isnan(speed), np.nan, predicted)[used])))
    misfit = float(np.median(_rms((speed - predicted)[used])))
    return size >= _SLOWEST and misfit > _LARGEST_MISFIT * size


def _spread(speed: Array, predicted: Array, count: int) -> Array:
    """Return speeds that stand first, put in the places, in order, where they fit best."""
    best, least = speed, np.inf
    for places in combinations(range(len(speed)), int(count)):
        placed = np.full(len(speed), np.nan)
        placed[list(places)] = speed[:count]
        misfit = float(np.nansum((placed - predicted) ** 2))
        if misfit < least:
            best, least = placed, misfit
    return best


def _rms(values: Array) -> Array:
    """Return the root mean square (N,) of the beams (N, B) that are not NaN."""
    return np.asarray(np.sqrt(np.nanmean(values**2, axis=1)))
