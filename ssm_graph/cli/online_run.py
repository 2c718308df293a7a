"""What ``ssm-graph online`` does once its options are read."""

from __future__ import annotations

import argparse
import contextlib
import gc
import math
import signal
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from rich.console import Console

from factors.kernels import KERNELS
from ssm_graph.base.errors import ConfigError, SolverError
from ssm_graph.base.frozen import Array
from ssm_graph.cli.online import INPUTS
from ssm_graph.cli.options import kernel_of
from ssm_graph.cli.terminal import say, signals_to
from ssm_graph.cli.witness import witnessed
from ssm_graph.io.mission_folder.folder import read_mission
from ssm_graph.io.mission_folder.vehicle import read_vehicle, vehicle_of
from ssm_graph.io.raw_log.rows import messages_of
from ssm_graph.live.estimator import ONLINE, FixedLagSmoother, IntegrityConfig
from ssm_graph.live.page.server import LivePage, parse_page_address
from ssm_graph.live.protocols.decoder import Decoder
from ssm_graph.live.protocols.json_messages import JsonDecoder
from ssm_graph.live.protocols.nmea import PRESSURE_SENTENCES, NmeaDecoder, NmeaOptions
from ssm_graph.live.protocols.waterlinked import WaterLinkedDecoder
from ssm_graph.live.run.clock_file import ClockFile
from ssm_graph.live.run.place_file import PlaceFile
from ssm_graph.live.run.replay_source import ReplaySource
from ssm_graph.live.run.run_folder import RunFolder
from ssm_graph.live.run.runner import Connections, Engine, RunEnd, Runner, RunnerConfig, StopReason
from ssm_graph.live.sockets.clocks import boot_s
from ssm_graph.live.sockets.endpoints import OUTPUTS, parse_endpoint
from ssm_graph.live.sockets.feed import Limits
from ssm_graph.live.sockets.outputs import OutputFormat, Publisher
from ssm_graph.live.sockets.sockets import InputConfig, OutputConfig, SocketHub
from ssm_graph.mission.mission import Mission
from ssm_graph.mission.navigation import Health
from ssm_graph.mission.run_status import RunStatus
from ssm_graph.mission.vehicle import Vehicle
from ssm_graph.report.mission.summary import calibration_table
from ssm_graph.report.terminal.status_page import StatusPage
from ssm_graph.smoothers.window import FixedLagConfig


def navigate(arguments: argparse.Namespace, console: Console, errors: Console) -> bool:
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
    kernel = kernel_of(arguments, KERNELS)
    lag = replace(ONLINE, lag_s=arguments.lag, kernel=kernel, similarity=kernel.published_with)
    integrity = integrity_of(arguments)
    _check_sources(arguments, inputs)
    mission = None if arguments.replay is None else read_mission(arguments.replay)
    vehicle = _vehicle(arguments.vehicle, mission)
    with contextlib.ExitStack() as stack:
        show: Callable[[RunStatus], None] = stack.enter_context(StatusPage(errors))
        if arguments.page is not None:
            height_m = arguments.surface_height
            host, port = parse_page_address(arguments.page)
            page = stack.enter_context(LivePage(host, port, surface_height_m=height_m))
            say(errors, f"page: {page.address}")
            show = both(show, page)
        runner = Runner(
            RunFolder(arguments.out, vehicle, _settings(lag, integrity)),
            witnessed(engine_of(vehicle, lag, integrity), arguments, lag.lag_s),
            _connector(stack, arguments.out, inputs, outputs, mission, speed),
            publisher=publisher,
            config=config,
            on_status=show,
        )
        stack.enter_context(signals_to(_stopping(runner.stop)))
        pass_over_imports()
        end = runner.run()
    return _report(end, arguments.out, console)


def both(
    first: Callable[[RunStatus], None], second: Callable[[RunStatus], None]
) -> Callable[[RunStatus], None]:
    """Return what shows a status at two places."""

    def show(status: RunStatus) -> None:
        first(status)
        second(status)

    return show


def pass_over_imports() -> None:
    """Have the garbage collector pass over all that there is: to look through it takes 60 ms."""
    gc.collect()
    gc.freeze()


def engine_of(
    vehicle: Vehicle, config: FixedLagConfig, integrity: IntegrityConfig | None = None
) -> Engine:
    """Return how the vehicle's estimator is made."""

    def restore(arrays: Mapping[str, Array], meta: Mapping[str, Any]) -> FixedLagSmoother:
        return FixedLagSmoother.restore(vehicle, config, arrays, meta, integrity=integrity)

    return Engine(lambda: FixedLagSmoother(vehicle, config, integrity=integrity), restore)


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


def _settings(config: FixedLagConfig, integrity: IntegrityConfig) -> dict[str, Any]:
    usual = IntegrityConfig()
    asked = {k: v for k, v in asdict(integrity).items() if v != getattr(usual, k)}
    return {
        **asked,
        "lag_s": config.lag_s,
        "kernel": str(config.kernel),
        "similarity": config.similarity.name.lower(),
    }


def _connector(
    stack: contextlib.ExitStack,
    folder: Path,
    inputs: list[InputConfig],
    outputs: list[OutputConfig],
    mission: Mission | None,
    speed: float | None,
) -> Callable[[int], Connections]:
    def connect(n_messages: int) -> Connections:
        if mission is None:
            clock, places = ClockFile(folder), PlaceFile(folder)
            hub = stack.enter_context(
                SocketHub(
                    inputs,
                    outputs,
                    set_by_s=clock.set_by_s(time.time(), boot_s()),
                    note_clock=clock.note,
                    known=places.known(),
                    note_places=places.note,
                )
            )
            return Connections(hub, hub)
        hub = stack.enter_context(SocketHub(outputs=outputs))
        source = ReplaySource(
            messages_of(mission),
            speed=speed,
            skip=n_messages,
            name=mission.name,
            end_s=float(mission.imu.time_s[-1]),
            altitude=(mission.dvl.valid_s, mission.dvl.altitude()),
            wait=hub.wait,
        )
        return Connections(source, hub)

    return connect


def _stopping(stop: Callable[[], None]) -> Callable[..., None]:
    """Return what stops at the first signal; a second SIGINT or SIGTERM interrupts at once.

    A terminal that is closed sends SIGHUP more than once, and a service manager after SIGTERM.
    """
    n_asked = 0

    def on_signal(number: int, *_: object) -> None:
        nonlocal n_asked
        if n_asked and number in (signal.SIGINT, signal.SIGTERM):
            raise KeyboardInterrupt
        n_asked += 1
        stop()

    return on_signal


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
    say(console, text)
    if end.found.calibration is not None:
        console.print(calibration_table(end.found.calibration))
    for note in end.notes:
        say(console, f"note: {note}")
    say(console, f"results in {folder}")
    return end.navigation.health is Health.GOOD and end.reason is not StopReason.FAILED


def integrity_of(arguments: argparse.Namespace) -> IntegrityConfig:
    """Return what was asked for."""
    flat, up = (
        math.inf if level is None else level
        for level in (arguments.protection, arguments.protection_up)
    )
    return IntegrityConfig(
        false_alerts_per_h=arguments.false_alerts,
        missed_detection=arguments.missed_detection,
        protection_m=flat,
        protection_up_m=up,
    )


def replay_speed(word: str) -> float | None:
    """Return the speed of a replay, None for as fast as it goes."""
    if word == "full":
        return None
    try:
        speed = float(word)
    except ValueError:
        speed = math.nan
    if not 0.0 < speed < math.inf:
        raise ConfigError(f"--speed: expected a number above 0 or full, got {word!r}")
    return speed


def input_configs(arguments: argparse.Namespace) -> list[InputConfig]:
    """Return the sources that were asked for."""
    rate, usual = arguments.max_rate, Limits()
    limits = Limits(
        messages_per_s=rate,
        burst=max(1, math.ceil(2.0 * rate)) if math.isfinite(rate) else 1,
        bytes_per_s=max(1.0, rate / usual.messages_per_s) * usual.bytes_per_s,
        stall_s=arguments.stall,
    )
    return [
        InputConfig(
            name,
            parse_endpoint(getattr(arguments, name), where=f"--{name}"),
            _decoder(name, arguments),
            limits,
        )
        for name in INPUTS
        if getattr(arguments, name) is not None
    ]


def output_configs(arguments: argparse.Namespace) -> list[OutputConfig]:
    """Return the outputs that were asked for."""
    asked = (
        ("--publish", OutputFormat.JSON, arguments.publish),
        ("--nmea", OutputFormat.NMEA, arguments.nmea),
    )
    return [
        OutputConfig(form, parse_endpoint(text, where=where, allowed=OUTPUTS))
        for where, form, texts in asked
        for text in texts or ()
    ]


def _decoder(name: str, arguments: argparse.Namespace) -> Callable[[], Decoder]:
    clock, axes = arguments.clock, arguments.axes
    if name == "dvl":
        return lambda: WaterLinkedDecoder(clock=clock, heading=arguments.dvl_heading)
    if name in ("imu", "messages"):
        return lambda: JsonDecoder(axes=axes)
    options = NmeaOptions(
        clock=clock,
        geoid_separation_m=arguments.geoid_separation,
        surface_height_m=arguments.surface_height,
        depth_sentences=frozenset(arguments.depth_sentence or PRESSURE_SENTENCES),
    )
    return lambda: NmeaDecoder(options)
