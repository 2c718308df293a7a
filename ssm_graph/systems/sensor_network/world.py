"""A robot, disturbances within their bounds, and nodes that watch it: trials of a network."""

from __future__ import annotations

import time
from collections import defaultdict
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import Array, ReadOnlyArrays
from ssm_graph.filters.rules.ellipsoids import Ellipsoids, Mask
from ssm_graph.filters.rules.set_membership import Sets
from ssm_graph.systems.sensor_network.codes import HEADING_STEP, Indices, UniformCode
from ssm_graph.systems.sensor_network.motion import planar_step
from ssm_graph.systems.sensor_network.nodes import Alarm, SetNodes
from ssm_graph.systems.sensor_network.patent import PatentNodes, PatentSettings
from ssm_graph.systems.sensor_network.point import PointNodes
from ssm_graph.systems.sensor_network.setting import Setting, Share

Rng = np.random.Generator


class Disturbance(Enum):
    """How the noise uses its bounds."""

    PATENT = "the patent's sinusoids, scaled to the bounds"
    UNIFORM = "uniform in the box"
    CORNER = "random corners of the box"
    ADVERSARY = "the corner that takes the truth furthest out of the first node's set"
    SEARCH = "random corners; the half of the runs that came furthest out is led on twice"


@dataclass(frozen=True, slots=True, eq=False)
class Trial(ReadOnlyArrays):
    """What came of K steps of R runs with N nodes."""

    truth: Array
    """(K, R, 3)"""
    center: Array
    """(K, R, N, 3) of the sets; of the patent its estimate."""
    half_widths: Array
    """(K, R, N, 3) of the smallest box around each set."""
    excess: Array
    """(K, R, N) of the truth, at most 1 inside the set."""
    log_volume: Array
    """(K, R, N)"""
    shape: Array
    """(K, N, 3, 3) of the ellipsoids of the first run,"""
    around: Array
    """(K, N, 3) and their own centres."""
    point: Array
    """(K, R, N, 3) the estimate: of a Kalman filter beside the set, moved into it."""
    ekf: Array
    """(K, R, N, 3) the same filter by itself."""
    alarms: tuple[Alarm, ...]
    n_bits: int
    """Of one component in a packet."""
    n_ambiguous: int
    cpu_s: float

    @property
    def error(self) -> Array:
        """(K, R, N) length of the error of the centre, m and rad mixed as in the patent."""
        return np.asarray(np.linalg.norm(self.center - self.truth[:, :, None], axis=-1))

    @property
    def root_trace(self) -> Array:
        """(K, N) of the shape of the first run."""
        return np.asarray(np.sqrt(np.einsum("...ii->...", self.shape)))


def noise_at(
    kind: Disturbance, k: int, bound: Array, shape: tuple[int, ...], rng: Rng, towards: Array
) -> Array:
    """Return noise (..., m) within a bound (m,): of the motion, or of positions (m = 2).

    ``towards`` (..., m) is where the adversary wants it to point.
    """
    if kind is Disturbance.UNIFORM:
        return np.asarray(bound * rng.uniform(-1.0, 1.0, shape))
    if kind in (Disturbance.CORNER, Disturbance.SEARCH):
        return np.asarray(bound * rng.choice([-1.0, 1.0], shape))
    if kind is Disturbance.ADVERSARY:
        free = np.where(towards == 0.0, rng.choice([-1.0, 1.0], shape), np.sign(towards))
        return np.asarray(bound * free)
    waves = {
        3: np.array([np.sin(0.1 * k), np.cos(0.3 * k), np.cos(0.2 * k)]),
        2: np.array([np.sin(0.1 * k), np.sin(0.1 * k)]),
        1: np.array([np.sin(0.1 * k)]),
    }
    return np.asarray(np.broadcast_to(bound * waves[len(bound)], shape))


class World:
    """The robot and what its nodes measure, run by run."""

    def __init__(self, setting: Setting, kind: Disturbance, runs: int, seed: int) -> None:
        """Draw where the robots start: inside E(0, P_0) about the nodes' common start."""
        self.setting, self.kind, self.runs = setting, kind, runs
        self.rng = np.random.default_rng([seed, *setting.name.encode(), *kind.name.encode()])
        P_0 = setting.initial_variance * np.eye(3)
        start = Ellipsoids(np.zeros((runs, 3)), np.broadcast_to(P_0, (runs, 3, 3)).copy())
        self.state = start.sampled(self.rng, 1)[0] * 0.5
        # Each node begins somewhere of its own, from where the truth is within E(center, P_0).
        around = Ellipsoids(
            np.zeros((runs, setting.n_nodes, 3)), 0.25 * P_0 * np.ones((1, 1, 1, 1))
        )
        self.first = 0.999 * around.sampled(self.rng, 1)[0]
        excess = Ellipsoids(self.first, np.broadcast_to(P_0, (*self.first.shape, 3)).copy())
        if not excess.contains(self.state[:, None]).all():
            raise DataError(
                "initial state: expected inside E(center, P_0) of every node; it is not"
            )
        self.k = 0

    def move(self, out_of: Ellipsoids) -> tuple[Array, Array]:
        """Lead the robots on and return advance (R, 1, 2) and turn (R, 1)."""
        setting, k = self.setting, self.k
        advance = np.broadcast_to(np.array([setting.speed_m, 0.0]), (self.runs, 1, 2))
        turn = np.full((self.runs, 1), setting.turn(k))
        there = planar_step(self.state, advance[:, 0], turn[:, 0])
        first = out_of[:, 0]
        towards = np.linalg.solve(first.shape, (self.state - first.center)[..., None])[..., 0]
        w = noise_at(self.kind, k, np.asarray(setting.motion_bound), there.shape, self.rng, towards)
        levels = np.asarray(setting.saturation)
        self.state = np.clip(there + w, -levels, levels)
        self.k += 1
        return advance, turn

    def measure(self, predicted: Array) -> Array:
        """Return what every node measures (R, N, 3) of sets with centres (R, N, 3) by now."""
        setting, shape = self.setting, predicted.shape
        away = predicted - self.state[:, None]
        bound = np.full(2, setting.position_bound * setting.true_scale)
        v = noise_at(self.kind, self.k, bound, (*shape[:2], 2), self.rng, away[..., :2])
        values = np.full(shape, np.nan)
        values[..., :2] = self.state[:, None, :2] + v
        if setting.compass_bound is not None:
            one = np.array([setting.compass_bound])
            u = noise_at(self.kind, self.k, one, (*shape[:2], 1), self.rng, away[..., 2:])
            values[..., 2] = self.state[:, None, 2] + u[..., 0]
        return values

    def go_on_with(self, runs: Indices) -> None:
        """Lead some of the runs on, in the places of all."""
        self.state = self.state[runs]

    def arrivals(self) -> tuple[Mask, Indices]:
        """Return which packets come, by receiver and sender (R, N, N), and after how many steps."""
        setting = self.setting
        shape = (self.runs, setting.n_nodes, setting.n_nodes)
        comes = (setting.hears() > 0.0) & (self.rng.random(shape) >= setting.loss)
        late = self.rng.integers(setting.delay[0], setting.delay[1] + 1, shape)
        return comes, late


def run_sets(
    setting: Setting, kind: Disturbance, *, runs: int = 1, seed: int = 0, keep: int | None = None
) -> Trial:
    """Run the recommended recursion; ``keep`` steps are kept of every array, None for all."""
    world = World(setting, kind, runs, seed)
    nodes = SetNodes(setting, center=world.first, memory=setting.delay[1])
    points = PointNodes(setting, center=world.first, is_corner=kind is not Disturbance.UNIFORM)
    code, rows = UniformCode(setting.step), _Rows(keep)
    due: dict[int, list[tuple[int, Array, Mask]]] = defaultdict(list)
    due_sets: dict[int, list[tuple[int, Sets, Mask]]] = defaultdict(list)
    me = np.eye(setting.n_nodes, dtype=bool)
    cpu = 0.0
    for k in range(1, setting.n_steps + 1):
        out_of = nodes.sets.ellipsoid
        advance, turn = world.move(out_of)
        begin = time.process_time()
        nodes.lead_on(advance, turn)
        cpu += time.process_time() - begin
        values = world.measure(nodes.sets.ellipsoid.center)
        values[..., :2] = code.value(code.index(values[..., :2]))
        values[..., 2] = HEADING_STEP * np.floor(values[..., 2] / HEADING_STEP + 0.5)
        comes, late = world.arrivals()
        begin = time.process_time()
        by_receiver = np.broadcast_to(values[:, None], (*comes.shape, 3))
        now = me | (comes & (late == 0) & (setting.share is Share.MEASUREMENTS))
        if setting.share is Share.MEASUREMENTS:
            for delay in range(1, setting.delay[1] + 1):
                due[k + delay].append((k, by_receiver, comes & (late == delay)))
        for step, one, mask in due.pop(k, []):
            nodes.hear(step, np.where(mask[..., None], one, np.nan))
        nodes.hear(k, np.where(now[..., None], by_receiver, np.nan))
        if setting.share is Share.ELLIPSOIDS:
            _exchange(nodes, k, comes, late, due_sets)
        nodes.sets.half_widths  # noqa: B018  (what was heard is used when it is asked for)
        cpu += time.process_time() - begin
        points.step(advance, turn, np.where(now[..., None], by_receiver, np.nan))
        rows.add(world.state, nodes, points)
        if kind is Disturbance.SEARCH:
            best = furthest(nodes.sets.ellipsoid, world.state)
            world.go_on_with(best)
            nodes.go_on_with(best)
            points.go_on_with(best)
            for waiting in due.values():
                waiting[:] = [(step, one[best], mask[best]) for step, one, mask in waiting]
            for late_sets in due_sets.values():
                late_sets[:] = [(step, one[best], mask[best]) for step, one, mask in late_sets]
    return rows.trial(nodes, setting, cpu)


def furthest(sets: Ellipsoids, state: Array) -> Indices:
    """Return which runs (R,) a search goes on with, from sets (R, N) and the truth (R, 3)."""
    far = sets.excess(state[:, None]).max(axis=1)
    kept = np.argsort(-far, kind="stable")[: (len(far) + 1) // 2]
    return np.asarray(np.concatenate([kept, kept])[: len(far)], dtype=np.int64)


def _exchange(
    nodes: SetNodes,
    k: int,
    comes: Mask,
    late: Indices,
    due: dict[int, list[tuple[int, Sets, Mask]]],
) -> None:
    for delay in range(nodes.setting.delay[1] + 1):
        due[k + delay].append((k, nodes.sets, comes & (late == delay)))
    for step, sent, mask in due.pop(k, []):
        nodes.hear_sets(step, sent, mask)


class _Rows:
    """Arrays of a trial as they grow."""

    def __init__(self, keep: int | None) -> None:
        self._keep = keep
        self._rows: dict[str, list[Array]] = defaultdict(list)

    def add(self, state: Array, nodes: SetNodes, points: PointNodes) -> None:
        sets = nodes.sets
        found = {
            "truth": state,
            "center": sets.middle,
            "half_widths": sets.half_widths,
            "excess": sets.excess(state[:, None]),
            "log_volume": sets.ellipsoid.log_volume,
            "shape": sets.ellipsoid.shape[0],
            "around": sets.ellipsoid.center[0],
            "point": sets.nearest(points.center),
            "ekf": points.center,
        }
        for name, value in found.items():
            self._rows[name].append(value.copy())

    def trial(self, nodes: SetNodes, setting: Setting, cpu_s: float) -> Trial:
        last = slice(None) if self._keep is None else slice(-self._keep, None)
        arrays = {name: np.array(rows[last]) for name, rows in self._rows.items()}
        return Trial(
            **arrays,
            alarms=nodes.alarms,
            n_bits=setting.bits,
            n_ambiguous=nodes.n_ambiguous,
            cpu_s=cpu_s,
        )


def run_patent(
    setting: Setting,
    kind: Disturbance,
    *,
    runs: int = 1,
    seed: int = 0,
    settings: PatentSettings | None = None,
) -> Trial:
    """Run the patent's recursion on the very robots, starts and noise of :func:`run_sets`.

    The adversary, who looks at sets, looks at the patent's.
    """
    setting = replace(setting, share=Share.NONE, loss=0.0, delay=(0, 0))
    world = World(setting, kind, runs, seed)
    nodes = PatentNodes(setting, center=world.first, settings=settings)
    code = UniformCode(setting.step)
    rows: dict[str, list[Array]] = defaultdict(list)
    cpu = 0.0
    for _ in range(setting.n_steps):
        advance, turn = world.move(Ellipsoids(nodes.center.copy(), nodes.bound.copy()))
        begin = time.process_time()
        nodes.lead_on(advance, turn)
        cpu += time.process_time() - begin
        values = world.measure(nodes.center)[..., :2]
        world.arrivals()  # the same draws as with sharing, so that the noise is the same
        begin = time.process_time()
        nodes.hear(code.value(code.index(values)))
        cpu += time.process_time() - begin
        now, state = Ellipsoids(nodes.center.copy(), nodes.bound.copy()), world.state
        if kind is Disturbance.SEARCH:
            best = furthest(now, state)
            world.go_on_with(best)
            nodes.go_on_with(best)
        found = {
            "truth": state,
            "center": now.center,
            "half_widths": now.half_widths,
            "excess": now.excess(state[:, None]),
            "log_volume": now.log_volume,
            "shape": now.shape[0],
            "around": now.center[0],
            "point": now.center,
            "ekf": now.center,
        }
        for name, value in found.items():
            rows[name].append(value.copy())
    arrays = {name: np.array(values) for name, values in rows.items()}
    return Trial(**arrays, alarms=(), n_bits=setting.bits, n_ambiguous=0, cpu_s=cpu)
