"""Nodes as processes that talk by UDP on this machine, in the place of an acoustic modem."""

from __future__ import annotations

import multiprocessing
import socket
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from queue import Empty
from typing import Any, Final

import numpy as np

from ssm_graph.base.errors import ConfigError, DataError, SsmGraphError
from ssm_graph.base.frozen import Array
from ssm_graph.systems.sensor_network.codes import (
    HEADING_BITS,
    HEADING_STEP,
    MOST_BITS,
    Keystream,
    UniformCode,
)
from ssm_graph.systems.sensor_network.nodes import SetNodes
from ssm_graph.systems.sensor_network.packets import PacketForm, signed, unsigned
from ssm_graph.systems.sensor_network.setting import Setting, Share
from ssm_graph.systems.sensor_network.world import Disturbance, World

HOST: Final = "127.0.0.1"
LEAST_MEMORY: Final = 3
"""Steps that a packet may be late here, where nothing but the machine delays it."""
START_S: Final = 0.2
"""From the last process that is there to the first step."""
PATIENCE_S: Final = 60.0
"""For processes to be there, and beyond a period for their reports."""


@dataclass(frozen=True, slots=True)
class Report:
    """What a node knows at the end of a step."""

    node: int
    """From 1."""
    k: int
    middle: tuple[float, float, float]
    half_widths: tuple[float, float, float]
    holds_truth: bool
    n_heard: int
    """Packets by now,"""
    n_refused: int
    """and those of another key, another length or beyond memory."""
    alarms: tuple[str, ...]
    """Raised by now."""
    n_bytes: int
    """Of a packet."""


@dataclass(frozen=True, slots=True)
class Run:
    """What all processes are told."""

    setting: Setting
    period_s: float
    seed: int
    ports: tuple[int, ...]
    secrets: tuple[bytes | None, ...]
    """By node; all the same unless one has a wrong key."""


def run_processes(
    setting: Setting,
    *,
    period_s: float = 0.2,
    seed: int = 0,
    secrets: tuple[bytes | None, ...] | None = None,
) -> Iterator[Report]:
    """Start a process a node, yield what they report, and end them.

    Nodes share measurements; what is lost is lost by the sender, at the rate of the setting.
    Each watches the same robot, drawn from the seed, in the place of its own sensors.
    """
    if not 0.01 <= period_s <= 60.0:
        raise ConfigError(f"--period: expected 0.01 to 60 s, got {period_s:g}")
    setting = replace(setting, share=Share.MEASUREMENTS)
    context = multiprocessing.get_context("spawn")
    reports = context.Queue()
    # Of the clock time.monotonic, which the machine's processes share; zero until all are there.
    begin_s = context.Value("d", 0.0)
    keys = secrets or (None,) * setting.n_nodes
    run = Run(setting, period_s, seed, _free_ports(setting.n_nodes), keys)
    processes = [
        context.Process(target=_node, args=(run, i, reports, begin_s), daemon=True)
        for i in range(setting.n_nodes)
    ]
    try:
        for process in processes:
            process.start()
        for _ in processes:
            _next(reports, processes, period_s)
        begin_s.value = time.monotonic() + START_S
        for _ in range(setting.n_nodes * setting.n_steps):
            yield _next(reports, processes, period_s)
    finally:
        for process in processes:
            process.join(timeout=1.0)
            if process.is_alive():
                process.terminate()


def _next(reports: Any, processes: list[Any], period_s: float) -> Any:
    """Return what a node says next; what one ended of is raised."""
    for _ in range(int(PATIENCE_S + period_s)):
        try:
            said = reports.get(timeout=1.0)
        except Empty:
            if any(one.exitcode not in (None, 0) for one in processes):
                break
            continue
        if isinstance(said, str):
            raise SsmGraphError(said)
        return said
    dead = [i + 1 for i, one in enumerate(processes) if one.exitcode not in (None, 0)]
    raise SsmGraphError(f"network-run: no report from nodes {dead or 'any'}; try again")


def _free_ports(count: int) -> tuple[int, ...]:
    sockets = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(count)]
    try:
        for one in sockets:
            one.bind((HOST, 0))
        return tuple(one.getsockname()[1] for one in sockets)
    finally:
        for one in sockets:
            one.close()


def packet_form(setting: Setting, secret: bytes | None) -> PacketForm:
    """Return the packets of a setting: two positions, and a heading where there is a compass."""
    heading = (HEADING_BITS,) if setting.compass_bound is not None else ()
    return PacketForm((setting.bits,) * 2 + heading, Keystream(secret) if secret else None)


def packed_values(form: PacketForm, setting: Setting, node: int, k: int, values: Array) -> bytes:
    """Return the packet of a measurement (3,) of a node, from 0, in step k."""
    code = UniformCode(setting.step)
    index = unsigned(code.index(values[:2]), setting.bits)
    if setting.compass_bound is not None:
        heading = int(np.floor(values[2] / HEADING_STEP + 0.5)) % 2**HEADING_BITS
        index = np.append(index, heading)
    return form.packed(node, k, index)


def unpacked_values(form: PacketForm, setting: Setting, packet: bytes) -> tuple[int, int, Array]:
    """Return node, step and values (3,); NaN for what is not in it, residues as they came."""
    node, k, index = form.unpacked(packet)
    if node >= setting.n_nodes:
        raise DataError(f"packet: expected a node of {setting.n_nodes}, got {node + 1}")
    values = np.full(3, np.nan)
    whole = signed(index[:2], setting.bits) if setting.bits == MOST_BITS else index[:2]
    values[:2] = UniformCode(setting.step).value(whole)
    if len(index) > 2:
        values[2] = index[2] * HEADING_STEP
    return node, k, values


def _node(run: Run, i: int, reports: Any, begin_s: Any) -> None:
    """Be node i, from 0, until all steps are done."""
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as own:
            own.bind((HOST, run.ports[i]))
            node = _Node(run, i, own, reports)
            reports.put(None)
            while not begin_s.value:
                time.sleep(0.01)
            node.go(begin_s.value)
    except (SsmGraphError, OSError) as error:
        reports.put(f"node {i + 1}: {error}")


class _Node:
    def __init__(self, run: Run, i: int, own: socket.socket, reports: Any) -> None:
        self._run, self._i, self._socket, self._reports = run, i, own, reports
        setting = run.setting
        self._world = World(setting, Disturbance.UNIFORM, 1, run.seed)
        memory = max(setting.delay[1], LEAST_MEMORY)
        self._sets = SetNodes(
            setting, center=self._world.first[:, i : i + 1], memory=memory, nodes=np.array([i])
        )
        self._form = packet_form(setting, run.secrets[i])
        self._to = [run.ports[a - 1] for a, b in setting.edges if b == i + 1]
        self._rng = np.random.default_rng([run.seed, i, *b"loss"])
        self._n_heard = self._n_refused = 0

    def go(self, begin_s: float) -> None:
        """Step by step, by the clock."""
        run, setting, sets = self._run, self._run.setting, self._sets
        for k in range(1, setting.n_steps + 1):
            begin = begin_s + (k - 1) * run.period_s
            self._listen(until=begin)
            advance, turn = self._world.move(sets.sets.ellipsoid)
            sets.lead_on(advance, turn)
            like = np.broadcast_to(sets.sets.ellipsoid.center, (1, setting.n_nodes, 3))
            mine = self._world.measure(like)[0, self._i]
            packet = packed_values(self._form, setting, self._i, k, mine)
            code = UniformCode(setting.step)
            read = np.append(
                code.value(code.index(mine[:2])),
                HEADING_STEP * np.floor(mine[2] / HEADING_STEP + 0.5),
            )
            self._hear(k, self._i, read)
            for port in self._to:
                if self._rng.random() >= setting.loss:
                    self._socket.sendto(packet, (HOST, port))
            self._listen(until=begin + 0.9 * run.period_s)
            self._report(k)

    def _hear(self, k: int, sender: int, values: Array) -> None:
        table = np.full((1, 1, self._run.setting.n_nodes, 3), np.nan)
        table[0, 0, sender] = values
        self._sets.hear(k, table)

    def _listen(self, *, until: float) -> None:
        while (left := until - time.monotonic()) > 0.0:
            self._socket.settimeout(left)
            try:
                packet, _ = self._socket.recvfrom(2048)
            except TimeoutError:
                return
            try:
                sender, k, values = unpacked_values(self._form, self._run.setting, packet)
            except DataError:
                self._n_refused += 1
                continue
            if k > self._sets.k:  # of a node whose clock is ahead by a little
                self._n_refused += 1
                continue
            self._n_heard += 1
            self._hear(k, sender, values)

    def _report(self, k: int) -> None:
        now = self._sets.sets
        x, y, a = (float(v) for v in now.middle[0, 0])
        b, c, d = (float(v) for v in now.half_widths[0, 0])
        holds = bool(now.excess(self._world.state[:, None])[0, 0] <= 1.0 + 1e-9)
        alarms = tuple(alarm.sentence for alarm in self._sets.alarms)
        self._reports.put(
            Report(
                self._i + 1,
                k,
                (x, y, a),
                (b, c, d),
                holds,
                self._n_heard,
                self._n_refused,
                alarms,
                self._form.n_bytes,
            )
        )
