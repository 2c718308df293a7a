"""Runs like those of Bailey's simulator: a map, a path through way points, noise of many kinds.

The path is steered by the truth, so that all runs of a map share it, with what is in view: a batch
of them goes through a filter as one.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from factors.bearing_range import half_turn, range_bearing
from ssm_graph.base.errors import ConfigError
from ssm_graph.base.frozen import Array
from ssm_graph.base.units import DEGREE
from ssm_graph.systems.landmark_slam.models import Bicycle

START: Final = (0.005, 0.005, 0.001)
"""m, m, rad: first pose of the paper."""


@dataclass(frozen=True, slots=True)
class World:
    """What the paper's table 1 said; its numbers are lost.

    Stated in its text are size, steps, time, landmarks and sigmas; speed, wheel base, range and the
    steering limits of Bailey do not fit 40 m, so these are assumed.
    """

    size_m: float = 40.0
    n_landmarks: int = 40
    n_steps: int = 2000
    step_s: float = 0.25
    speed_m_per_s: float = 1.0
    wheel_base_m: float = 1.0
    most_range_m: float = 10.0
    """Seen is what is nearer and ahead of the vehicle: the half plane of positive x."""
    most_steering_rad: float = 30.0 * DEGREE
    most_steering_rate_rad_per_s: float = 20.0 * DEGREE
    reached_m: float = 1.0
    """Nearer than this a way point is reached."""
    map_seed: int = 1

    def __post_init__(self) -> None:
        for name, low in (("n_landmarks", 1), ("n_steps", 2)):
            if getattr(self, name) < low:
                raise ConfigError(
                    f"{name}: expected {low} or more, got {getattr(self, name)}; "
                    f"try {World.__dataclass_fields__[name].default}"
                )


@dataclass(frozen=True, slots=True)
class Sigmas:
    """Standard deviations of controls and observations; the defaults are the paper's."""

    distance_m: float = 0.02
    """Of the distance of a step."""
    steering_rad: float = 0.5 * DEGREE
    range_m: float = 0.1
    bearing_rad: float = 1.0 * DEGREE

    @property
    def control(self) -> Array:
        """(2,) of distance and steering."""
        return np.array([self.distance_m, self.steering_rad])

    @property
    def observation(self) -> Array:
        """(2,) of range and bearing."""
        return np.array([self.range_m, self.bearing_rad])


@dataclass(frozen=True, slots=True)
class NoiseCase:
    """What comes to the stated noise; "every noise" are distance, steering, range and bearing."""

    about: str
    normal_sigmas: float = 0.0
    """N(0, 1) times so many stated sigmas on every noise."""
    uniform_sigmas: float = 0.0
    """U(0, 1) times so many stated sigmas on every noise: half of it is a bias."""
    exponential: float = 0.0
    """Mean of an exponential variable on every noise, in m and rad: all of it is a bias."""
    normal_range_m: float = 0.0
    """Sigma of what comes to the ranges alone."""
    control_factor: float = 1.0
    """True sigma of the controls in stated ones."""
    observation_factor: float = 1.0
    gross_share: float = 0.0
    """Of observations that are anywhere within the range in view."""


CASES: Final[Mapping[str, NoiseCase]] = {
    "stated": NoiseCase("noise as stated"),
    "G1": NoiseCase("N(0, 1) stated sigma on every noise", normal_sigmas=1.0),
    "U1": NoiseCase("U(0, 1) stated sigma on every noise", uniform_sigmas=1.0),
    "E1": NoiseCase("exponential of mean 0.01 m and rad on every noise", exponential=0.01),
    "A1": NoiseCase("N(0, 1) m on every range", normal_range_m=1.0),
    "R3": NoiseCase("true observation sigma 3 times that stated", observation_factor=3.0),
    "Q3": NoiseCase("true control sigma 3 times that stated", control_factor=3.0),
    "gross10": NoiseCase("10 % of the observations are anywhere", gross_share=0.1),
    "gross30": NoiseCase("30 % of the observations are anywhere", gross_share=0.3),
}
"""The first seven are the study of the paper, in every reading of its lost units."""


class Path(NamedTuple):
    """What all runs of a map share."""

    pose: Array
    """(K + 1, 3) true"""
    control: Array
    """(K, 2) true distance [m] and steering [rad]"""
    landmarks: Array
    """(L, 2) m"""
    in_view: tuple[NDArray[np.intp], ...]
    """(K,) the landmarks in view after each step, ascending."""
    way_points: Array
    """(W, 2) m"""


class Runs(NamedTuple):
    """What the vehicles of B runs were told."""

    control: Array
    """(K, B, 2) distance [m] and steering [rad]"""
    observed: tuple[Array, ...]
    """(K,) of (B, m, 2) range [m] and bearing [rad] of the landmarks in view."""
    is_gross: tuple[NDArray[np.bool_], ...]
    """(K,) of (B, m)"""


def make_path(world: World) -> Path:
    """Return a random map of Bailey's kind, and a path around it and through it."""
    rng = np.random.default_rng([world.map_seed, 40])
    half = 0.5 * world.size_m
    landmarks = _apart(rng, world.n_landmarks, half, apart_m=0.06 * world.size_m)
    # Around in alternating reach, as Bailey's web: corners outside, the middle of sides inside.
    angles = np.linspace(0.0, 2.0 * np.pi, 13)[:-1] - 0.5 * np.pi
    reach = half * np.where(np.arange(12) % 2 == 0, 0.75, 0.45) * rng.uniform(0.9, 1.1, 12)
    way_points = np.stack([reach * np.cos(angles), reach * np.sin(angles)], axis=-1)
    pose, control = _steered(world, way_points)
    views = []
    for after in pose[1:]:
        z = range_bearing(after, landmarks)
        ahead = np.abs(z[:, 1]) < 0.5 * np.pi
        views.append(np.flatnonzero(ahead & (z[:, 0] < world.most_range_m)))
    return Path(pose, control, landmarks, tuple(views), way_points)


def _apart(rng: np.random.Generator, count: int, half: float, *, apart_m: float) -> Array:
    """Return random places within a square, as far apart as there is room for."""
    found: list[Array] = []
    while len(found) < count:
        place = rng.uniform(-half, half, 2)
        if all(math.dist(place, other) > apart_m for other in found):
            found.append(place)
        else:
            apart_m *= 0.999
    return np.array(found)


def _steered(world: World, way_points: Array) -> tuple[Array, Array]:
    """Steer from way point to way point, round and round, as Bailey's `compute_steering.m`."""
    motion = Bicycle(world.wheel_base_m)
    pose = np.empty((world.n_steps + 1, 3))
    control = np.empty((world.n_steps, 2))
    pose[0], steering, at = START, 0.0, 0
    most_change = world.most_steering_rate_rad_per_s * world.step_s
    for k in range(world.n_steps):
        if math.dist(pose[k, :2], way_points[at]) < world.reached_m:
            at = (at + 1) % len(way_points)
        wanted = range_bearing(pose[k], way_points[at])[1] - steering
        change = float(np.clip(half_turn(wanted), -most_change, most_change))
        steering = float(
            np.clip(steering + change, -world.most_steering_rad, world.most_steering_rad)
        )
        control[k] = world.speed_m_per_s * world.step_s, steering
        pose[k + 1] = motion.move(pose[k], control[k], np.zeros(2))
    return pose, control


def simulate(path: Path, sigmas: Sigmas, case: NoiseCase, seeds: range, *, reach_m: float) -> Runs:
    """Return what runs of these seeds were told; the stated part of the noise is the seed's alone.

    ``reach_m`` is how far gross observations may lie.
    """
    n_steps, n_landmarks = len(path.control), len(path.landmarks)
    control = np.empty((n_steps, len(seeds), 2))
    noise = np.empty((len(seeds), n_steps, n_landmarks, 2))
    gross = np.zeros((len(seeds), n_steps, n_landmarks), dtype=bool)
    anywhere = np.zeros((len(seeds), n_steps, n_landmarks, 2))
    for b, seed in enumerate(seeds):
        base, more = (np.random.default_rng([seed, stream]) for stream in (0, 1))
        control[:, b] = path.control + _noise(
            base, more, (n_steps, 2), sigmas.control, case, case.control_factor
        )
        noise[b] = _noise(
            base, more, noise[b].shape, sigmas.observation, case, case.observation_factor
        )
        if case.normal_range_m:
            noise[b, ..., 0] += case.normal_range_m * more.standard_normal(noise[b, ..., 0].shape)
        if case.gross_share:
            gross[b] = more.random(gross[b].shape) < case.gross_share
            ends = np.array([[0.1, reach_m], [-0.5 * np.pi, 0.5 * np.pi]])
            anywhere[b] = more.uniform(ends[:, 0], ends[:, 1], noise[b].shape)
    observed, marks = [], []
    for k, view in enumerate(path.in_view):
        z = range_bearing(path.pose[k + 1], path.landmarks[view]) + noise[:, k, view]
        z[..., 0] = np.abs(z[..., 0])
        mark = gross[:, k, view]
        z = np.where(mark[..., None], anywhere[:, k, view], z)
        z[..., 1] = half_turn(z[..., 1])
        observed.append(z)
        marks.append(mark)
    return Runs(control, tuple(observed), tuple(marks))


def _noise(
    base: np.random.Generator,
    more: np.random.Generator,
    shape: tuple[int, ...],
    sigma: Array,
    case: NoiseCase,
    factor: float,
) -> Array:
    noise: Array = factor * sigma * base.standard_normal(shape)
    if case.normal_sigmas:
        noise += case.normal_sigmas * sigma * more.standard_normal(shape)
    if case.uniform_sigmas:
        noise += case.uniform_sigmas * sigma * more.random(shape)
    if case.exponential:
        noise += more.exponential(case.exponential, shape)
    return noise


def true_sigmas(sigmas: Sigmas, case: NoiseCase) -> Sigmas:
    """Return what a filter would be told that knows the noise, biases counted as noise."""
    more = (case.normal_sigmas**2 + case.uniform_sigmas**2 / 3.0, 2.0 * case.exponential**2)

    def total(sigma: float, factor: float, extra: float = 0.0) -> float:
        return math.sqrt((factor * sigma) ** 2 + more[0] * sigma**2 + more[1] + extra)

    return Sigmas(
        total(sigmas.distance_m, case.control_factor),
        total(sigmas.steering_rad, case.control_factor),
        total(sigmas.range_m, case.observation_factor, case.normal_range_m**2),
        total(sigmas.bearing_rad, case.observation_factor),
    )
