"""Options of ``ssm-graph online``: connections, estimator and rates."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from pathlib import Path
from typing import Final

from factors.kernels import KERNELS
from ssm_graph.base.errors import ConfigError
from ssm_graph.base.frames import BodyAxes
from ssm_graph.live.estimator import ONLINE
from ssm_graph.live.protocols.decoder import Clock
from ssm_graph.live.protocols.json_messages import JsonDecoder
from ssm_graph.live.protocols.nmea import NmeaDecoder, NmeaOptions
from ssm_graph.live.protocols.waterlinked import WaterLinkedDecoder
from ssm_graph.live.run.feed import CountingDecoder, Limits
from ssm_graph.live.sockets.endpoints import OUTPUTS, parse_endpoint
from ssm_graph.live.sockets.outputs import OutputFormat
from ssm_graph.live.sockets.sockets import InputConfig, OutputConfig

DESCRIPTION: Final = """\
Navigate live: messages of the instruments in, position, velocity and attitude with their sigmas
out. Everything that comes is logged before it is used; started again with the same RUN after a
crash or a power cut it goes on where it was. SIGINT or SIGTERM ends it in order.

What VEHICLE gives prior sigmas for, a drift, and the current of its [current] are estimated along:
values with sigmas on the page and in RUN/summary.json.

addresses:
  tcp://HOST:PORT           a server that is called, again and again if need be
  tcp-listen://[HOST]:PORT  a server that others call
  udp://[HOST]:PORT         datagrams; for --publish and --nmea where they go to
What listens, listens to this computer only (127.0.0.1) unless HOST names another interface.

what is understood and written: docs/live-protocols.md; how to run it: docs/online.md
"""
_INPUTS: Final = {
    "dvl": "Water Linked DVL-A50 or A125, JSON over TCP port 16171",
    "gnss": "GNSS receiver, NMEA 0183",
    "depth": "pressure sensor, NMEA 0183",
    "imu": "inertial samples, JSON lines",
    "messages": "any messages, JSON lines",
}


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
    group.add_argument(
        "--clock",
        choices=[clock.name.lower() for clock in Clock],
        default=Clock.INSTRUMENT.name.lower(),
        help="stamp DVL and GNSS by the instrument's own UTC where it agrees with the arrival, or "
        "by the arrival (default: instrument)",
    )
    group.add_argument(
        "--axes",
        choices=[axes.value for axes in BodyAxes],
        default=BodyAxes.FRD.value,
        help="body axes of inertial vectors in JSON (default: FRD)",
    )
    group.add_argument(
        "--surface-height",
        type=float,
        default=0.0,
        metavar="M",
        help="of the water above the ellipsoid, for --depth (default: 0)",
    )
    group.add_argument(
        "--geoid-separation",
        type=float,
        metavar="M",
        help="geoid above ellipsoid: for fixes that leave it out, and for --nmea (default: none)",
    )
    group = parser.add_argument_group("outputs")
    group.add_argument(
        "--publish", action="append", metavar="ADDRESS", help="answers as JSON lines; repeatable"
    )
    group.add_argument(
        "--nmea", action="append", metavar="ADDRESS", help="answers as GGA, VTG, HDT; repeatable"
    )


def add_estimator_options(parser: argparse.ArgumentParser) -> None:
    """Add lag and kernel."""
    parser.add_argument(
        "--lag",
        type=float,
        default=ONLINE.lag_s,
        metavar="SECONDS",
        help=f"states so old are settled (default: {ONLINE.lag_s:g})",
    )
    parser.add_argument(
        "--kernel", choices=KERNELS, default="log", help="as for smooth (default: log)"
    )
    for name in ("dof", "width", "phi"):
        owners = ", ".join(k for k, c in KERNELS.items() if c.parameter == name)
        parser.add_argument(
            f"--{name}", type=float, metavar="NUMBER", help=f"parameter of {owners}, as for smooth"
        )


MAX_RATE: Final = "inertial samples/s of one source, of other kinds a tenth; more are left out"


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
        parser.add_argument(
            f"--{name}",
            type=float,
            default=default,
            metavar=metavar,
            help=f"{meaning} (default: {default:g})",
        )
    parser.add_argument(
        "--duration", type=float, metavar="SECONDS", help="end by itself (default: never)"
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


def _decoder(name: str, arguments: argparse.Namespace) -> Callable[[], CountingDecoder]:
    clock, axes = Clock[arguments.clock.upper()], BodyAxes(arguments.axes)
    if name == "dvl":
        return lambda: WaterLinkedDecoder(clock=clock)
    if name in ("imu", "messages"):
        return lambda: JsonDecoder(axes=axes)
    options = NmeaOptions(
        clock=clock,
        geoid_separation_m=arguments.geoid_separation,
        surface_height_m=arguments.surface_height,
    )
    return lambda: NmeaDecoder(options)
