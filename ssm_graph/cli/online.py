"""``ssm-graph online``: instruments in, navigation out, on the vehicle."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Final

from rich.console import Console

from factors.kernels import KERNELS
from ssm_graph.base.frames import BodyAxes
from ssm_graph.base.usual import (
    FALSE_ALERTS_PER_H,
    LAG_S,
    MESSAGES_PER_S,
    MISSED_DETECTION,
    STALL_S,
)
from ssm_graph.cli.options import add_kernel_options, choice_option, number_option
from ssm_graph.cli.witness import add_witness
from ssm_graph.live.protocols.decoder import Clock
from ssm_graph.live.protocols.nmea_fields import DepthSentence

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
INPUTS: Final = {
    "dvl": "Water Linked DVL-A50 or A125: JSON (TCP port 16171) or its serial protocol",
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
    number_option(parser, "--lag", "SECONDS", "states so old are settled", LAG_S)
    add_kernel_options(parser, KERNELS)
    add_integrity(parser)
    add_connections(parser)
    add_rates(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace, console: Console, errors: Console) -> bool:
    """Navigate; what it takes is loaded now."""
    from ssm_graph.cli.online_run import navigate

    return navigate(arguments, console, errors)


def add_connections(parser: argparse.ArgumentParser) -> None:
    """Add where messages come from and answers go to."""
    group = parser.add_argument_group("sources")
    for name, meaning in INPUTS.items():
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
    group = parser.add_argument_group("integrity")
    number_option(group, "--protection", "M", "GOOD asks for a horizontal protection level below")
    number_option(group, "--protection-up", "M", "and for a vertical one below")
    number_option(
        group,
        "--false-alerts",
        "PER_HOUR",
        "sensors that are as stated are called contradicting so often",
        FALSE_ALERTS_PER_H,
    )
    number_option(
        group,
        "--missed-detection",
        "P",
        "probability that an unseen fault moves the answer out of its protection level",
        MISSED_DETECTION,
    )
    add_witness(group)


def add_rates(parser: argparse.ArgumentParser) -> None:
    """Add how often what is done, and what one source may send."""
    for name, default, metavar, meaning in (
        ("output-rate", 50.0, "HZ", "JSON answers at most so often"),
        ("nmea-rate", 1.0, "HZ", "NMEA answers at most so often"),
        ("checkpoint-every", 10.0, "SECONDS", "of data, from one checkpoint to the next"),
        ("max-rate", MESSAGES_PER_S, "N", MAX_RATE),
        ("stall", STALL_S, "SECONDS", "a connection silent for so long is given up"),
    ):
        number_option(parser, f"--{name}", metavar, meaning, default)
    number_option(parser, "--duration", "SECONDS", "end by itself (default: never)")


def _depth_sentence(word: str) -> DepthSentence:
    try:
        return DepthSentence[word.upper()]
    except KeyError:
        names = ", ".join(one.name for one in DepthSentence)
        raise argparse.ArgumentTypeError(f"expected one of {names}, got {word!r}") from None
