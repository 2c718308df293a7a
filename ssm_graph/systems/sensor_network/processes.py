"""Nodes as processes that talk by UDP on this machine, in the place of an acoustic modem."""

from __future__ import annotations

import multiprocessing
import os
import signal
import socket
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection, wait
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
EARLY: Final = 1
"""Steps that a sender may be ahead; its packet waits for the step to begin here."""
START_S: Final = 0.2
"""From the last process that is there to the first step."""
PATIENCE_S: Final = 60.0
"""For processes to be there, and beyond a period for their reports."""
SESSION_BYTES: Final = 16


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
    """and those of another key, another length, no such node, or of a step too early or late."""
    alarms: tuple[str, ...]
    """Raised by now."""
    n_bytes: int
    """Of a packet."""


@dataclass(frozen=True, slots=True)
class Ended:
    """A process that ended before its last step; the others go on, as if its packets were lost."""

    node: int
    """From 1."""
    k: int
    """Its last step that was reported."""
    reason: str


@dataclass(frozen=True, slots=True)
class Run:
    """What all processes are told."""

    setting: Setting
    period_s: float
    seed: int
    ports: tuple[int, ...]
    secrets: tuple[bytes | None, ...]
    """By node; all the same unless one has a wrong key."""
    session: bytes
    """New in every run, so that no packet of an earlier one is authentic in it."""


def run_processes(
    setting: Setting,
    *,
    period_s: float = 0.2,
    seed: int = 0,
    secrets: tuple[bytes | None, ...] | None = None,
) -> Iterator[Report | Ended]:
    """Start a process a node, yield what they report or that one ended, and end them.

    Nodes share measurements; what is lost is lost by the sender, at the rate of the setting.
    Each watches the same robot, drawn from the seed, in the place of its own sensors.
    """
    if not 0.01 <= period_s <= 60.0:
        raise ConfigError(f"--period: expected 0.01 to 60 s, got {period_s:g}")
    if seed < 0:
        raise ConfigError(f"--seed: expected 0 or more, got {seed}")
    setting = replace(setting, share=Share.MEASUREMENTS)
    keys = secrets or (None,) * setting.n_nodes
    for key in keys:
        packet_form(setting, key, b"")  # what is refused is refused before any process is there
    session = os.urandom(SESSION_BYTES)
    run = Run(setting, period_s, seed, _free_ports(setting.n_nodes), keys, session)
    context = multiprocessing.get_context("spawn")
    # Of the clock time.monotonic, which the machine's processes share; zero until all are there.
    begin_s = context.Value("d", 0.0, lock=False)
    processes: list[Any] = []
    pipes: dict[Any, int] = {}
    try:
        for i in range(setting.n_nodes):
            # A pipe each: one that is killed takes no lock with it.
            own, theirs = context.Pipe(duplex=False)
            process = context.Process(
                target=_node, args=(run, i, theirs, begin_s), name=f"node {i + 1}", daemon=True
            )
            process.start()
            theirs.close()
            processes.append(process)
            pipes[own] = i
        waiting = dict(pipes)
        while waiting:
            for pipe, _ in _heard(waiting, period_s):
                waiting.pop(pipe)
        begin_s.value = time.monotonic() + START_S
        yield from _reports(pipes, processes, run)
    finally:
        for process in processes:
            process.join(timeout=1.0)
            if process.is_alive():
                process.terminate()


def _reports(pipes: dict[Any, int], processes: list[Any], run: Run) -> Iterator[Report | Ended]:
    """Yield what nodes report until the last has ended."""
    last = [0] * len(processes)
    while pipes:
        for pipe, report in _heard(pipes, run.period_s):
            if report is not None:
                last[report.node - 1] = report.k
                yield report
                continue
            i = pipes.pop(pipe)
            if last[i] < run.setting.n_steps:
                processes[i].join(timeout=PATIENCE_S)
                code = processes[i].exitcode
                how = f"by signal {-code}" if code and code < 0 else f"with code {code}"
                yield Ended(i + 1, last[i], f"its process ended {how}")


def _heard(pipes: dict[Any, int], period_s: float) -> list[tuple[Any, Report | None]]:
    """Return what has come by which pipe; None where nothing will any more.

    What a node says that it ended of is raised, and so is silence.
    """
    found: list[tuple[Any, Report | None]] = []
    ready: list[Any] = wait(list(pipes), timeout=PATIENCE_S + period_s)
    for pipe in ready:
        try:
            said = pipe.recv()
        except (EOFError, OSError):
            said = None
        if isinstance(said, str):
            raise SsmGraphError(said)
        found.append((pipe, said))
    if not found:
        silent = ", ".join(str(i + 1) for i in sorted(pipes.values()))
        raise SsmGraphError(
            f"network-run: no report from nodes {silent} for {PATIENCE_S + period_s:.0f} s; is "
            "the machine busy? try a longer --period"
        )
    return found


def _free_ports(count: int) -> tuple[int, ...]:
    sockets = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(count)]
    try:
        for one in sockets:
            one.bind((HOST, 0))
        return tuple(one.getsockname()[1] for one in sockets)
    finally:
        for one in sockets:
            one.close()


def packet_form(setting: Setting, secret: bytes | None, session: bytes) -> PacketForm:
    """Return the packets of a setting: two positions, and a heading where there is a compass."""
    heading = (HEADING_BITS,) if setting.compass_bound is not None else ()
    keystream = None if secret is None else Keystream(secret).of_session(session)
    return PacketForm((setting.bits,) * 2 + heading, keystream)


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


def _node(run: Run, i: int, reports: Connection, begin_s: Any) -> None:
    """Be node i, from 0, until all steps are done."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # of a terminal: who started all ends all
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as own:
            own.bind((HOST, run.ports[i]))
            node = _Node(run, i, own, reports)
            reports.send(None)
            while not begin_s.value:
                time.sleep(0.01)
            node.go(begin_s.value)
    except BrokenPipeError:
        return  # nobody listens any more
    except (SsmGraphError, OSError) as error:
        reports.send(f"node {i + 1}: {error}")


class _Node:
    def __init__(self, run: Run, i: int, own: socket.socket, reports: Connection) -> None:
        self._run, self._i, self._socket, self._reports = run, i, own, reports
        setting = run.setting
        self._world = World(setting, Disturbance.UNIFORM, 1, run.seed)
        self._memory = max(setting.delay[1], LEAST_MEMORY)
        center, nodes = self._world.first[:, i : i + 1], np.array([i])
        self._sets = SetNodes(setting, center=center, memory=self._memory, nodes=nodes)
        self._early: dict[tuple[int, int], Array] = {}
        """Values by step and sender."""
        self._form = packet_form(setting, run.secrets[i], run.session)
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
            for (step, sender), values in self._early.items():
                self._hear(step, sender, values)
            self._early.clear()
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
            if not max(self._sets.k - self._memory, 1) <= k <= self._sets.k + EARLY:
                self._n_refused += 1
                continue
            self._n_heard += 1
            if k > self._sets.k:
                self._early[k, sender] = values
            else:
                self._hear(k, sender, values)

    def _report(self, k: int) -> None:
        now = self._sets.sets
        x, y, a = (float(v) for v in now.middle[0, 0])
        b, c, d = (float(v) for v in now.half_widths[0, 0])
        holds = bool(now.excess(self._world.state[:, None])[0, 0] <= 1.0 + 1e-9)
        alarms = tuple(alarm.sentence for alarm in self._sets.alarms)
        self._reports.send(
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
