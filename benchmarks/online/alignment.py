"""What a live estimator's alignment costs its caller: processor time of every push.

``python -m benchmarks.online.alignment --keep`` (about two minutes on one core). A vehicle hovers
at the surface with GNSS and does not know its heading, so that eight are tried: the most work there
is. The alignment is begun with so many seconds of data, and messages go on to come.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from benchmarks.report import Option, Report, table
from ssm_graph.io.mission_folder.vehicle import vehicle_of
from ssm_graph.io.raw_log.rows import messages_of
from ssm_graph.live.estimator import FixedLagSmoother
from ssm_graph.live.estimator.intake import Intake
from ssm_graph.live.estimator.start import MOST_MS, SHARE
from ssm_graph.mission.events import EventLog
from ssm_graph.mission.navigation import Health
from ssm_graph.mission.vehicle import Vehicle
from ssm_graph.sensors.messages import Message
from ssm_graph.simulation import (
    DvlSettings,
    GnssSettings,
    Grade,
    HoverRoute,
    SimulationConfig,
    simulate,
)

CATCHING_UP = "catching up"
LONGEST_S = 120.0
"""So long an alignment is waited for."""


class Load(NamedTuple):
    """What the pushes of one alignment took."""

    data_s: float
    """Length of the data that it was begun with"""
    aligning_s: list[float]
    """Processor time of each push until the start was found"""
    catching_up_s: list[float]
    """And of each from there to the answer"""
    until_s: float = np.nan
    """Time of the data from its begin to the answer, or to where it was given up"""
    outcome: str = "not in time"


def begun_with(messages: Sequence[Message], vehicle: Vehicle) -> FixedLagSmoother:
    """Return an estimator that has received messages and has not tried to align yet."""
    intake = Intake(vehicle, EventLog())
    for message in messages:
        intake.accept(message)
    arrays, meta = FixedLagSmoother(vehicle).checkpoint()
    return FixedLagSmoother.restore(vehicle, None, arrays | intake.buffers.pack(), meta)


def measured(data_s: float) -> Load:
    """Align with so much data, and measure each push."""
    sim = simulate(
        SimulationConfig(
            duration_s=data_s + LONGEST_S,
            imu_rate_hz=100.0,
            grade=Grade.MEMS,
            route=HoverRoute(depth_m=0.3),
            gnss=GnssSettings(),
            dvl=DvlSettings(rate_hz=5.0),
        )
    )
    vehicle = replace(vehicle_of(sim.mission), initial=None)
    messages = list(messages_of(sim.mission))
    n_before = sum(message.time_s <= data_s for message in messages)
    smoother = begun_with(messages[:n_before], vehicle)
    load = Load(data_s, [], [])
    reason = told = smoother.status()[1]
    for message in messages[n_before:]:
        begin = time.process_time()
        smoother.push(message)
        cpu_s = time.process_time() - begin
        (load.catching_up_s if CATCHING_UP in reason else load.aligning_s).append(cpu_s)
        health, reason = smoother.status()
        is_given_up = reason != told and CATCHING_UP not in reason
        if health is not Health.ALIGNING or is_given_up:
            said = reason if health is Health.ALIGNING else "aligned"
            return load._replace(until_s=message.time_s - data_s, outcome=said.partition(":")[0])
    return load


def report(loads: Sequence[Load]) -> list[str]:
    """Return the table."""
    rows = []
    for load in loads:
        aligning, catching_up = 1e3 * np.array(load.aligning_s), 1e3 * np.array(load.catching_up_s)
        of_push = aligning.mean(), np.quantile(aligning, 0.99), aligning.max()
        numbers = [f"{x:.1f}" for x in (load.until_s, aligning.sum() / 1e3, *of_push)]
        last = f"{catching_up.max():.1f}" if len(catching_up) else ""
        rows.append([f"{load.data_s:.0f}", load.outcome, *numbers, last])
    header = ["data, s", "outcome", "after, s", "aligning, s", "a push, ms", "99 %", "largest"]
    return table([*header, "largest, catching up"], rows)


LEGEND = f"""\
A vehicle hovers at the surface, MEMS grade, IMU 100 Hz, DVL 5 Hz, GNSS 1 Hz, no `[initial]`: eight
headings are tried. The alignment begins with the first column's length of data and goes on by
{SHARE:g} ms for every ms of the data that come, counted by the size of its steps; a push ends with
the step that goes beyond, or beyond {MOST_MS:g} ms. *After*: time of the data from the begin to the
answer, or to where the attempt is given up. Processor time of all pushes until then, of one, and of
the largest; those that catch up with what has come meanwhile by themselves.
"""


def main() -> None:
    """Align with each length of data and write the table."""
    page = Report(
        *(__file__, "Processor time of an alignment on the vehicle", __doc__),
        Option("--data", [11.0, 26.0, 60.0, 150.0], "lengths, s"),
    )
    loads = [measured(data_s) for data_s in page.args.data]
    page.write([LEGEND, *report(loads)], part="on_the_vehicle")


if __name__ == "__main__":
    main()
