"""``ssm-graph online``: instruments in, navigation out, on the vehicle."""

from __future__ import annotations

import argparse
import contextlib
import gc
import signal
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from rich.console import Console

from factors.kernels import KERNELS
from ssm_graph.base.errors import ConfigError, SolverError
from ssm_graph.base.frozen import Array
from ssm_graph.cli.online_arguments import (
    DESCRIPTION,
    add_connections,
    add_estimator_options,
    add_rates,
    input_configs,
    output_configs,
    replay_speed,
)
from ssm_graph.cli.options import add_command, kernel_from
from ssm_graph.io.mission_folder.reader import read_mission
from ssm_graph.io.mission_folder.vehicle import read_vehicle, vehicle_of
from ssm_graph.io.raw_log.rows import messages_of
from ssm_graph.live.estimator import ONLINE, FixedLagSmoother
from ssm_graph.live.run.interfaces import Connections, Engine
from ssm_graph.live.run.replay_source import ReplaySource
from ssm_graph.live.run.run_folder import RunFolder
from ssm_graph.live.run.run_summary import RunEnd, StopReason
from ssm_graph.live.run.runner import Runner, RunnerConfig
from ssm_graph.live.run.status import RunStatus
from ssm_graph.live.sockets.publisher import Publisher
from ssm_graph.live.sockets.sockets import InputConfig, OutputConfig, SocketHub
from ssm_graph.mission.mission import Mission
from ssm_graph.mission.navigation import Health
from ssm_graph.mission.vehicle import Vehicle
from ssm_graph.report.mission.summary import calibration_table
from ssm_graph.report.terminal.status_page import SourceRow, StatusPage, StatusView
from ssm_graph.smoothers.fixed_lag_config import FixedLagConfig


def add_parser(commands: Any, *, epilog: str) -> None:
    """Declare the command and its options."""
    parser = add_command(
        commands,
        "online",
        summary="navigate live from instruments on sockets, or replay a mission as if live",
        description=DESCRIPTION,
        epilog=epilog,
    )
    parser.add_argument(
        "vehicle",
        type=Path,
        nargs="?",
        metavar="VEHICLE",
        help="TOML file of the vehicle, or a mission folder of it; with --replay that mission's",
    )
    parser.add_argument("--out", type=Path, required=True, metavar="RUN", help="run folder")
    add_estimator_options(parser)
    add_connections(parser)
    add_rates(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace, console: Console, errors: Console) -> bool:
    """Navigate until asked to stop; return whether the last answer was good."""
    inputs, outputs = input_configs(arguments), output_configs(arguments)
    speed = replay_speed(arguments.speed)
    publisher = Publisher(
        rate_hz=arguments.output_rate,
        nmea_rate_hz=arguments.nmea_rate,
        geoid_separation_m=arguments.geoid_separation or 0.0,
    )
    config = RunnerConfig(
        checkpoint_every_s=arguments.checkpoint_every, duration_s=arguments.duration
    )
    lag = _lag_config(arguments)
    _check_sources(arguments, inputs)
    mission = None if arguments.replay is None else read_mission(arguments.replay)
    vehicle = _vehicle(arguments.vehicle, mission)
    with contextlib.ExitStack() as stack:
        show = stack.enter_context(StatusPage(errors))
        runner = Runner(
            RunFolder(arguments.out, vehicle, _settings(lag)),
            engine_of(vehicle, lag),
            _connector(stack, inputs, outputs, mission, speed),
            publisher=publisher,
            config=config,
            on_status=lambda status: show(view_of(status)),
        )
        stack.enter_context(_stopped_by_signals(runner.stop))
        pass_over_imports()
        end = runner.run()
    return _report(end, arguments.out, console)


def pass_over_imports() -> None:
    """Have the garbage collector pass over all that there is: to look through it takes 60 ms."""
    gc.collect()
    gc.freeze()


def engine_of(vehicle: Vehicle, config: FixedLagConfig) -> Engine:
    """Return how the vehicle's estimator is made."""

    def restore(arrays: Mapping[str, Array], meta: Mapping[str, Any]) -> FixedLagSmoother:
        return FixedLagSmoother.restore(vehicle, config, arrays, meta)

    return Engine(lambda: FixedLagSmoother(vehicle, config), restore)


def view_of(status: RunStatus) -> StatusView:
    """Return what a status looks like on the page."""
    latency = status.latency
    return StatusView(
        vehicle=status.vehicle,
        folder=status.folder,
        elapsed_s=status.elapsed_s,
        n_messages=status.n_messages,
        navigation=status.navigation,
        reason=status.reason,
        latency_s=None if latency is None else (latency.median_s, latency.p99_s, latency.max_s),
        sources=tuple(
            SourceRow(
                s.name,
                s.address,
                s.state.value,
                s.rate_hz,
                s.n_messages,
                s.n_refused + s.n_limited,
                s.n_reconnects,
                s.age_s,
            )
            for s in status.sources
        ),
        outputs=tuple(
            SourceRow(
                f"→ {o.name}",
                o.address,
                f"{o.n_clients} listening",
                n_messages=o.n_sent,
                n_refused=o.n_dropped,
            )
            for o in status.outputs
        ),
        events=status.events,
        log_problem=status.log_problem,
        checkpoint_age_s=status.checkpoint_age_s,
        found=status.found,
        note=status.note,
    )


def _check_sources(arguments: argparse.Namespace, inputs: list[InputConfig]) -> None:
    if arguments.replay is not None and inputs:
        raise ConfigError(
            f"--replay: expected alone, got --{inputs[0].name} too; a mission is all there is"
        )
    if arguments.replay is None and not inputs:
        raise ConfigError(
            "expected --imu or --messages with what else there is, or --replay MISSION; got no "
            "source"
        )
    if arguments.replay is None and not {"imu", "messages"} & {i.name for i in inputs}:
        raise ConfigError("expected inertial data: --imu or --messages; got neither")


def _vehicle(path: Path | None, mission: Mission | None) -> Vehicle:
    if path is not None:
        return read_vehicle(path)
    if mission is None:
        raise ConfigError("VEHICLE: expected its TOML file; it is left out with --replay only")
    return vehicle_of(mission)


def _lag_config(arguments: argparse.Namespace) -> FixedLagConfig:
    given = {name: getattr(arguments, name) for name in ("dof", "width", "phi")}
    kernel = kernel_from(KERNELS, arguments.kernel, **given)
    return replace(ONLINE, lag_s=arguments.lag, kernel=kernel, similarity=kernel.published_with)


def _settings(config: FixedLagConfig) -> dict[str, Any]:
    return {
        "lag_s": config.lag_s,
        "kernel": str(config.kernel),
        "similarity": config.similarity.name.lower(),
    }


def _connector(
    stack: contextlib.ExitStack,
    inputs: list[InputConfig],
    outputs: list[OutputConfig],
    mission: Mission | None,
    speed: float | None,
) -> Callable[[int], Connections]:
    def connect(n_messages: int) -> Connections:
        hub = stack.enter_context(SocketHub(inputs, outputs))
        if mission is None:
            return Connections(hub, hub)
        source = ReplaySource(
            messages_of(mission),
            speed=speed,
            skip=n_messages,
            name=mission.name,
            end_s=float(mission.imu.time_s[-1]),
            wait=hub.wait,
        )
        return Connections(source, hub)

    return connect


@contextlib.contextmanager
def _stopped_by_signals(stop: Callable[[], None]) -> Iterator[None]:
    """Stop at the first SIGINT or SIGTERM; the second one interrupts at once."""
    asked = False

    def on_signal(*_: object) -> None:
        nonlocal asked
        if asked:
            raise KeyboardInterrupt
        asked = True
        stop()

    before = {number: signal.signal(number, on_signal) for number in _SIGNALS}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


_SIGNALS = (signal.SIGINT, signal.SIGTERM)


def _report(end: RunEnd, folder: Path, console: Console) -> bool:
    """Say how it ended; return whether the last answer was good."""
    if end.navigation is None:
        raise SolverError(
            f"no answer from {end.n_messages} messages ({end.reason.value}): alignment needs "
            f"inertial data, a DVL or fixes, and a position; all that came is in {folder / 'log'}"
        )
    text = f"{end.navigation.health.name}: {end.navigation.reason}; {end.reason.value}"
    if end.n_errors:
        text += f"; {end.n_errors} errors survived, see {folder / 'events.jsonl'}"
    console.print(text, markup=False, highlight=False, soft_wrap=True)
    if end.found.calibration is not None:
        console.print(calibration_table(end.found.calibration))
    console.print(f"results in {folder}", markup=False, highlight=False, soft_wrap=True)
    return end.navigation.health is Health.GOOD and end.reason is not StopReason.FAILED
