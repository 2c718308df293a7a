"""``ssm-graph online``: instruments in, navigation out, on the vehicle."""

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
from typing import Any, Final

from rich.console import Console

from factors.kernels import KERNELS
from ssm_graph.base.errors import ConfigError, SolverError
from ssm_graph.base.frames import BodyAxes
from ssm_graph.base.frozen import Array
from ssm_graph.cli.options import (
    add_kernel_options,
    choice_option,
    kernel_of,
    number_option,
)
from ssm_graph.cli.terminal import say, signals_to
from ssm_graph.cli.witness import add_witness, witnessed
from ssm_graph.io.mission_folder.folder import read_mission
from ssm_graph.io.mission_folder.vehicle import read_vehicle, vehicle_of
from ssm_graph.io.raw_log.rows import messages_of
from ssm_graph.live.estimator import ONLINE, FixedLagSmoother, IntegrityConfig
from ssm_graph.live.page.server import LivePage, parse_page_address
from ssm_graph.live.protocols.decoder import Clock, Decoder
from ssm_graph.live.protocols.json_messages import JsonDecoder
from ssm_graph.live.protocols.nmea import PRESSURE_SENTENCES, NmeaDecoder, NmeaOptions
from ssm_graph.live.protocols.nmea_fields import DepthSentence
from ssm_graph.live.protocols.waterlinked import WaterLinkedDecoder
from ssm_graph.live.run.clock_file import ClockFile
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

DESCRIPTION: Final = """\
Navigate live: messages of the instruments in, position, velocity and attitude with their sigmas
out. Everything that comes is logged before it is used; started again with the same RUN after a
crash or a power cut it goes on where it was. SIGINT, SIGTERM or SIGHUP ends it in order.

What VEHICLE gives prior sigmas for, a drift, and the current of its [current] are estimated along:
values with sigmas on the page and in RUN/summary.json.

addresses:
  tcp://HOST:PORT           a server that is called, again and again if need be
  tcp-listen://[HOST]:PORT  a server that others call
  udp://[HOST]:PORT         datagrams; for --publish and --nmea where they go to
  serial:///dev/PORT?baud=BAUD  a serial port, 8 data bits, no parity; opened again if need be
What listens, listens to this computer only (127.0.0.1) unless HOST names another interface.

examples:
  ssm-graph online VEHICLE.toml --out RUN --dvl tcp://192.168.194.95:16171 --imu udp://:9001 \\
            --gnss udp://:10110 --publish udp://127.0.0.1:9100 --page 127.0.0.1:8080
  ssm-graph online --replay MISSION --speed 10 --page 127.0.0.1:8080 --out RUN

what is understood and written: docs/live-protocols.md; how to run it: docs/online.md
"""
_INPUTS: Final = {
    "dvl": "Water Linked DVL-A50 or A125, JSON over TCP port 16171",
    "gnss": "GNSS receiver, NMEA 0183",
    "depth": "pressure sensor, NMEA 0183",
    "heading": "compass or gyrocompass, NMEA 0183 (HDT, THS, PASHR, HDG)",
    "imu": "inertial samples, JSON lines",
    "messages": "any messages, JSON lines",
}
MAX_RATE: Final = "inertial samples/s of one source, of other kinds a tenth; more are left out"


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    parser.add_argument(
        "vehicle",
        type=Path,
        nargs="?",
        metavar="VEHICLE",
        help="TOML file of the vehicle, or a mission folder of it; with --replay that mission's",
    )
    parser.add_argument("--out", type=Path, required=True, metavar="RUN", help="run folder")
    number_option(parser, "--lag", "SECONDS", "states so old are settled", ONLINE.lag_s)
    add_kernel_options(parser, KERNELS)
    add_integrity(parser)
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
            clock = ClockFile(folder)
            ahead_s = clock.set_by_s(time.time(), boot_s())
            live = SocketHub(inputs, outputs, set_by_s=ahead_s, note_clock=clock.note)
            hub = stack.enter_context(live)
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


def add_connections(parser: argparse.ArgumentParser) -> None:
    """Add where messages come from and answers go to."""
    group = parser.add_argument_group("sources")
    for name, meaning in _INPUTS.items():
        group.add_argument(f"--{name}", metavar="ADDRESS", help=meaning)
    group.add_argument(
        "--replay", type=Path, metavar="MISSION", help="a recorded mission in place of instruments"
    )
    group.add_argument(
        "--speed",
        default="1",
        metavar="1|N|full",
        help="of --replay: as recorded, N times as fast, or as fast as it goes (default: 1)",
    )
    meaning = "stamp DVL and GNSS by the instrument's own UTC where it agrees with the arrival, or "
    meaning += "by the arrival (default: instrument)"
    choice_option(group, "--clock", Clock, meaning, Clock.INSTRUMENT)
    meaning = "body axes of inertial vectors in JSON (default: FRD)"
    choice_option(group, "--axes", BodyAxes, meaning, BodyAxes.FRD)
    meaning = "of the water above the ellipsoid, for --depth"
    number_option(group, "--surface-height", "M", meaning, 0.0)
    meaning = "geoid above ellipsoid: for fixes that leave it out, and for --nmea (default: none)"
    number_option(group, "--geoid-separation", "M", meaning)
    group.add_argument(
        "--depth-sentence",
        type=_depth_sentence,
        action="append",
        metavar="{" + ",".join(one.name for one in DepthSentence) + "}",
        help="what is read as the vehicle's depth; repeatable (default: the pressures, PRVAT, PIPS "
        "and PVIPS2; DPT and DBT are mostly the water below)",
    )
    group.add_argument(
        "--dvl-heading",
        action="store_true",
        help="read the yaw of the DVL's dead reckoning, as the [heading] of a directional gyro",
    )
    group = parser.add_argument_group("outputs")
    group.add_argument(
        "--publish", action="append", metavar="ADDRESS", help="answers as JSON lines; repeatable"
    )
    group.add_argument(
        "--nmea", action="append", metavar="ADDRESS", help="answers as GGA, VTG, HDT; repeatable"
    )
    group.add_argument(
        "--page",
        metavar="HOST:PORT",
        help="a page for browsers on this computer, such as 127.0.0.1:8080; another host lets "
        "others look on",
    )


def add_integrity(parser: argparse.ArgumentParser) -> None:
    """Add what the answer has to be protected within, and how often lanes may be wrong."""
    group, usual = parser.add_argument_group("integrity"), IntegrityConfig()
    number_option(group, "--protection", "M", "GOOD asks for a horizontal protection level below")
    number_option(group, "--protection-up", "M", "and for a vertical one below")
    number_option(
        group,
        "--false-alerts",
        "PER_HOUR",
        "sensors that are as stated are called contradicting so often",
        usual.false_alerts_per_h,
    )
    number_option(
        group,
        "--missed-detection",
        "P",
        "probability that an unseen fault moves the answer out of its protection level",
        usual.missed_detection,
    )
    add_witness(group)


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


def add_rates(parser: argparse.ArgumentParser) -> None:
    """Add how often what is done, and what one source may send."""
    limits = Limits()
    for name, default, metavar, meaning in (
        ("output-rate", 50.0, "HZ", "JSON answers at most so often"),
        ("nmea-rate", 1.0, "HZ", "NMEA answers at most so often"),
        ("checkpoint-every", 10.0, "SECONDS", "of data, from one checkpoint to the next"),
        ("max-rate", limits.messages_per_s, "N", MAX_RATE),
        ("stall", limits.stall_s, "SECONDS", "a connection silent for so long is given up"),
    ):
        number_option(parser, f"--{name}", metavar, meaning, default)
    number_option(parser, "--duration", "SECONDS", "end by itself (default: never)")


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
        for name in _INPUTS
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


def _depth_sentence(word: str) -> DepthSentence:
    try:
        return DepthSentence[word.upper()]
    except KeyError:
        names = ", ".join(one.name for one in DepthSentence)
        raise argparse.ArgumentTypeError(f"expected one of {names}, got {word!r}") from None


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
