"""What the table of faults injects, and what it lets pass."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.faults import report, summary
from benchmarks.faults_case import (
    Case,
    Run,
    Sent,
    Stage,
    difference_of,
    good_from,
    run_case,
    spells,
    undisturbed,
    undisturbed_stream,
)
from benchmarks.faults_data import data_cases
from benchmarks.faults_judge import HEADER, Row, judge
from benchmarks.faults_process import PROCESS_ROWS, RESULTS, Outcome, process_row
from benchmarks.faults_sockets import FAULTS, run_socket_case
from benchmarks.faults_transforms import (
    clock_moved,
    edited,
    frozen,
    late,
    one_more,
    repeated,
    silent,
    spoiled,
    untouched,
)
from ssm_graph.mission.navigation import Health
from ssm_graph.sensors.depth import DepthReading
from ssm_graph.sensors.dvl import Ping
from ssm_graph.sensors.imu import ImuSample
from ssm_graph.sensors.messages import Message

SHORT = Stage(duration_s=5.0, gnss=((0.0, 3.0),))
RNG = np.random.default_rng(0)


def stream() -> list[Sent]:
    """Return ten samples and three depths."""
    samples: list[Message] = [ImuSample(0.1 * k, (0, 0, 0), (0, 0, -9.8)) for k in range(10)]
    depths: list[Message] = [DepthReading(0.3 * k, float(k)) for k in range(3)]
    return [Sent(m.time_s, m) for m in sorted([*samples, *depths], key=lambda m: m.time_s)]


def depths(given: list[Sent]) -> list[DepthReading]:
    """Return the depths of a stream."""
    return [x.message for x in given if isinstance(x.message, DepthReading)]


def a_case() -> Case:
    """Return a case that does nothing."""
    case = data_cases()[0]
    rule = replace(case.rule, told="")
    return replace(case, transform=untouched, rule=rule, stage=SHORT, begin_s=2.0, end_s=3.0)


def test_transforms_do_what_they_say() -> None:
    """Gone, frozen, spoiled, late, repeated and moved messages; the rest is as it was."""
    assert depths(silent(DepthReading, 0.2)(stream(), RNG)) == [DepthReading(0.0, 0.0)]
    assert [d.depth for d in depths(frozen(DepthReading, 0.2)(stream(), RNG))] == [0.0, 1.0, 1.0]
    spoil = edited(DepthReading, spoiled("depth", [math.inf]), 0.0)
    assert [d.depth for d in depths(spoil(stream(), RNG))] == [0.0, math.inf, math.inf]
    delayed = late(DepthReading, 1.0, 0.25)(stream(), RNG)
    assert [x.true_s for x in delayed if isinstance(x.message, DepthReading)] == pytest.approx(
        [0.25, 0.55, 0.85]
    )
    assert len(repeated(1.0, times=3)(stream(), RNG)) == 4 * len(stream())
    moved = clock_moved(30.0, 0.5, DepthReading)(stream(), RNG)
    assert [d.time_s for d in depths(moved)] == pytest.approx([0.0, 0.3, 30.6])
    more = one_more(lambda m: replace(m, time_s=9e9), DepthReading, 0.2)(stream(), RNG)
    assert [d.time_s for d in depths(more)] == pytest.approx([0.0, 0.3, 9e9, 0.6])


def test_there_are_rows_enough_and_no_name_twice() -> None:
    """The parent process finds a row by its name."""
    names = [*(case.name for case in data_cases()), *PROCESS_ROWS]
    assert len(set(names)) == len(names) > 60


def test_an_undisturbed_mission_passes() -> None:
    """Nothing is lost, told or wrong; the same run is the same to the last bit."""
    case = a_case()
    run = run_case(replace(case, rule=replace(case.rule, is_harmless=True)))
    row = judge(case, run)
    assert row.has_passed
    assert len(row.texts) == len(HEADER)
    assert run.n_used == run.n_sent
    assert spells(run.looks)[-1][1] is Health.GOOD
    last, other = run.looks[-1].navigation, undisturbed(SHORT).looks[-1].navigation
    assert last is not None
    assert other is not None
    assert np.max(difference_of(last, other).sigmas) == 0.0


def test_what_is_wrong_fails() -> None:
    """Exceptions, silent losses, events not told, health that stays bad, other answers."""
    good = undisturbed(SHORT)
    moved = [x._replace(health=Health.BAD) for x in good.looks]
    cases: list[tuple[Run, dict[str, object], str]] = [
        (good._replace(failure="a\nValueError: b"), {}, "raised: ValueError: b"),
        (good._replace(n_silent=2), {}, "2 messages lost in silence"),
        (good, {"told": "clock"}, "clock not told"),
        (good, {"worst": Health.BAD}, "never BAD within 10 s"),
        (good._replace(looks=moved), {}, "not good within 10 s"),
        (good._replace(looks=good.looks[:-3]), {"is_harmless": True}, "another answer"),
    ]
    for run, rule, text in cases:
        case = a_case()
        row = judge(replace(case, rule=replace(case.rule, **rule)), run)  # type: ignore[arg-type]
        assert any(fault.startswith(text) for fault in row.faults), text
    assert math.isinf(good_from(moved))


def test_a_wrong_answer_is_good_only_where_it_says_so() -> None:
    """A velocity that is off while the health is GOOD fails; the same while it is BAD does not."""
    looks = [
        x._replace(navigation=replace(x.navigation, velocity_enu=x.navigation.velocity_enu + 1.0))
        for x in undisturbed(SHORT).looks
        if x.navigation is not None
    ]
    case = a_case()
    row = judge(case, undisturbed(SHORT)._replace(looks=looks))
    assert row.faults[0] == "velocity inside in 0 % while GOOD"
    bad = [x._replace(health=Health.BAD) for x in looks]
    faults = judge(case, undisturbed(SHORT)._replace(looks=bad)).faults
    assert faults == ("not good within 10 s",)


def test_folders_are_compared(tmp_path) -> None:  # type: ignore[no-untyped-def]
    """Results to nine digits, logs byte by byte."""
    for name in ("whole", "run"):
        for file in RESULTS:
            (tmp_path / name / file).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / name / file).write_text("a,b\n1.0,nan\n", encoding="utf-8")
    whole, run = (Outcome(tmp_path / name, [], 1.0) for name in ("whole", "run"))
    assert process_row("x", lambda a, b: whole, run, whole, is_lossless=True).has_passed  # noqa: ARG005
    (tmp_path / "run" / RESULTS[0]).write_text("a,b\n1.0000000001,nan\n", encoding="utf-8")
    assert process_row("x", lambda a, b: whole, run, whole, is_lossless=True).has_passed  # noqa: ARG005
    (tmp_path / "run" / RESULTS[2]).write_text("a,b\n1.00,nan\n", encoding="utf-8")
    row = process_row("x", lambda a, b: whole, run, whole, is_lossless=True)  # noqa: ARG005
    assert row.faults == (f"other than uninterrupted: {RESULTS[2]}",)


def test_the_page_counts_what_passed() -> None:
    """A row that failed says why; its page has the command first."""
    good, bad = (Row(("x",) * (len(HEADER) - 1), faults) for faults in ((), ("it hangs",)))
    assert summary([good, bad], [good]).startswith("**Passed: 1 of 2 faults of data, 1 of 1")
    page = report("python benchmarks/faults.py", [good, bad], [good], plain="All is well.")
    assert page.splitlines()[2].strip() == "python benchmarks/faults.py"
    assert "**fail**: it hangs" in page


@pytest.mark.slow
@pytest.mark.parametrize("name", ["garbage on the DVL's socket", "a client that never reads"])
def test_connections_may_fail(name: str) -> None:
    """A runner behind sockets lives through it."""
    assert name in FAULTS
    assert judge(*run_socket_case(name)).has_passed


def test_the_first_row_of_pings() -> None:
    """A stream has what the table says: two pings a second."""
    pings = [x for x in undisturbed_stream(SHORT) if isinstance(x.message, Ping)]
    assert len(pings) == 2 * SHORT.duration_s
