"""The raw log: what was acknowledged is on the disk, whatever happens to process and disk."""

from __future__ import annotations

import contextlib
import errno
import math
import multiprocessing
import os
import re
import resource
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ssm_graph.base.errors import ConfigError
from ssm_graph.base.units import DEGREE, exactly_in_unit
from ssm_graph.io.mission_folder.folder import read_mission
from ssm_graph.io.mission_folder.vehicle import vehicle_of
from ssm_graph.io.raw_log import log as raw_log
from ssm_graph.io.raw_log import rows as raw_rows
from ssm_graph.io.raw_log.kinds import row_kinds
from ssm_graph.io.raw_log.log import RawLog, replay
from ssm_graph.io.raw_log.rows import ALWAYS, messages_of
from ssm_graph.io.raw_log.waiting import WAITING
from ssm_graph.sensors.acoustic import AcousticRange
from ssm_graph.sensors.depth import DepthReading
from ssm_graph.sensors.dvl import Ping
from ssm_graph.sensors.gnss import Fix
from ssm_graph.sensors.imu import ImuSample
from ssm_graph.sensors.messages import Message
from ssm_graph.sensors.registry import BY_MESSAGE
from tests.mission_fixture import make_mission
from tests.unit.test_mission_roundtrip import assert_same

FORK = multiprocessing.get_context("fork")
VEHICLE = vehicle_of(make_mission())
TABLES = list(ALWAYS)
NAN = math.nan
FLOATS = st.floats(allow_nan=False)
TRIPLES = st.tuples(FLOATS, FLOATS, FLOATS)
BEAMS = st.tuples(*[st.floats(allow_infinity=False)] * 4)
MESSAGES = st.one_of(
    st.builds(ImuSample, FLOATS, TRIPLES, TRIPLES),
    st.builds(Ping, FLOATS, BEAMS, st.none() | BEAMS, st.booleans()),
    st.builds(DepthReading, FLOATS, FLOATS),
    st.builds(Fix, FLOATS, st.just(0.8), st.just(2.2), FLOATS, TRIPLES),
)


def sample(k: int) -> ImuSample:
    """Return the k-th of many samples, no two alike."""
    return ImuSample(0.01 * k, (k / 7.0, -k / 3.0, 1e-17 * k), (0.1, k / 9.0, -9.8))


def mixed(n: int) -> list[Message]:
    """Return messages of all kinds whose times are all different, in order of time."""
    kinds: list[Callable[[float], Message]] = [
        lambda t: ImuSample(t, (t, 0.1, 1 / 3), (0.0, -0.0, -9.8)),
        lambda t: Ping(t, (t, NAN, 0.1, 1e-300), is_water=t > 5.0),
        lambda t: DepthReading(t, 20.0 + t / 3.0),
        lambda t: Fix(t, 0.8, 2.2, -t, (0.5, 0.5, 1.0)),
    ]
    return [kinds[k % 4 if k % 3 == 0 else 0](0.1 * k) for k in range(n)]


def log_of(folder: Path, messages: Sequence[Message], **limits: int) -> RawLog:
    """Begin a log with messages."""
    log = RawLog(folder, VEHICLE, **limits)
    for message in messages:
        log.append(message)
    return log


def replayed(folder: Path, offsets: dict[str, int] | None = None) -> list[Message]:
    """Return all messages after a checkpoint."""
    return list(replay(folder, VEHICLE, offsets))


def shown(messages: Sequence[Message]) -> list[str]:
    """Return texts that are equal where messages are, NaN and signed zeros included."""
    return [repr(message) for message in messages]


@pytest.fixture(autouse=True, scope="module")
def _without_waiting_for_the_disk() -> Iterator[None]:
    """No test here could see a power failure."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda _: None)
        yield


@pytest.fixture
def failing(monkeypatch: pytest.MonkeyPatch) -> list[int | None]:
    """Let each ``os.write`` follow a plan: None is a success, n writes n bytes, -1 fails."""
    plan: list[int | None] = []
    write = os.write

    def planned(file: int, data: bytes) -> int:
        step = plan.pop(0) if plan else None
        if step == -1:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return write(file, data if step is None else data[:step])

    monkeypatch.setattr(os, "write", planned)
    return plan


def test_a_simulated_mission_comes_back(tmp_path: Path) -> None:
    """By the reader of missions, and by replay; the tables bit for bit."""
    mission = make_mission()
    messages = list(messages_of(mission))
    with log_of(tmp_path, messages) as log:
        assert log.problems() is None
    got = read_mission(tmp_path)
    assert mission.gnss is not None
    assert got.gnss is not None
    dvl = replace(got.dvl, range_m=mission.dvl.range_m)
    assert_same(replace(got, dvl=dvl, reference=mission.reference, notes=()), mission)
    np.testing.assert_array_equal(got.imu.time_s, mission.imu.time_s)
    np.testing.assert_array_equal(got.imu.gyro_b, mission.imu.gyro_b)
    np.testing.assert_array_equal(got.imu.accel_b, mission.imu.accel_b)
    np.testing.assert_array_equal(got.dvl.speed, mission.dvl.speed)
    np.testing.assert_array_equal(got.dvl.sigma, mission.dvl.sigma)
    np.testing.assert_array_equal(got.gnss.height, mission.gnss.height)
    np.testing.assert_allclose(got.gnss.lat, mission.gnss.lat, rtol=0.0, atol=5e-16)
    again = replayed(tmp_path)
    assert [type(m) for m in again] == [type(m) for m in messages]
    not_fixes = [[m for m in some if not isinstance(m, Fix)] for some in (again, messages)]
    assert shown(not_fixes[0]) == shown(not_fixes[1])


@given(MESSAGES)
def test_any_message_becomes_a_row_and_back(message: Message) -> None:
    """Bit for bit, but for degrees and for sigmas that say nothing."""
    kind = row_kinds(VEHICLE)[type(message)]
    got = kind.parse(kind.row(message).rstrip())
    if isinstance(message, Ping) and np.isnan(message.sigma or NAN).all():
        message = replace(message, sigma=None)
    if isinstance(message, Fix):
        assert isinstance(got, Fix)
        assert abs(got.lat - message.lat) + abs(got.lon - message.lon) < 1e-15
        got = replace(got, lat=message.lat, lon=message.lon)
    assert repr(got) == repr(message)


@settings(max_examples=15)
@given(st.lists(MESSAGES, max_size=8), st.integers(0, 8))
def test_any_messages_are_replayed(messages: list[Message], n_before: int) -> None:
    """In the order in which they came, from any checkpoint on, whatever the times say."""
    rows = [row_kinds(VEHICLE)[type(message)].row(message) for message in messages]
    with tempfile.TemporaryDirectory() as name:
        with log_of(Path(name) / "log", messages[:n_before]) as log:
            offsets = log.offsets()
            for message in messages[n_before:]:
                log.append(message)
        for start, want in ((None, rows), (offsets, rows[n_before:])):
            got = replayed(Path(name) / "log", start)
            assert [row_kinds(VEHICLE)[type(message)].row(message) for message in got] == want


@given(st.floats(-math.pi, math.pi))
def test_degrees_come_back_to_a_neighbour_at_worst(angle: float) -> None:
    """And by the formula of NumPy, which the reader uses, as by that of ``math``."""
    back = float(np.radians(exactly_in_unit(angle, DEGREE)))
    assert back == math.radians(exactly_in_unit(angle, DEGREE))
    assert abs(back - angle) <= math.ulp(angle)
    assert exactly_in_unit(back, DEGREE) == pytest.approx(exactly_in_unit(angle, DEGREE), rel=4e-16)
    assert math.radians(exactly_in_unit(back, DEGREE)) == back


def test_numbers_of_other_types_are_written_as_floats(tmp_path: Path) -> None:
    """Decoders may hand over NumPy's numbers and integers."""
    three: Any = (np.float64(0.1), 2, np.float32(0.5))
    with log_of(tmp_path, [ImuSample(np.float64(1.5), three, three)]):
        pass
    assert replayed(tmp_path) == [ImuSample(1.5, (0.1, 2.0, 0.5), (0.1, 2.0, 0.5))]


def test_what_is_not_finite_is_logged_as_it_came(tmp_path: Path) -> None:
    """The log judges nothing; the reader of missions leaves it out."""
    bad: list[Message] = [
        ImuSample(0.5, (NAN, 0.0, 0.0), (0.0, math.inf, 0.0)),
        Ping(0.5, (1.0, math.inf, 1, 1)),
    ]
    with log_of(tmp_path, [*messages_of(make_mission()), *bad]):
        pass
    assert shown(replayed(tmp_path)[-2:])[0] == repr(bad[0])
    notes = read_mission(tmp_path).notes
    assert sum("1 row of impossible numbers" in note for note in notes) == 2


def test_the_log_of_another_version_is_refused(tmp_path: Path) -> None:
    """Rows of other columns would shift; as a mission it can be read still."""
    log_of(tmp_path, list(messages_of(make_mission()))).close()
    path = tmp_path / "dvl.csv"
    lines = path.read_text().splitlines()
    path.write_text("".join(f"{line.rpartition(',')[0]}\n" for line in lines))
    for begin in (RawLog.reopen, replay):
        with pytest.raises(ConfigError, match=r"dvl\.csv: expected the columns .*water_track"):
            begin(tmp_path, VEHICLE)
    assert len(read_mission(tmp_path).dvl.time_s) == len(make_mission().dvl.time_s)


def test_a_folder_with_a_mission_is_refused(tmp_path: Path) -> None:
    """Nothing of it is touched."""
    log_of(tmp_path, mixed(5)).close()
    for path in (tmp_path / "mission.toml", None):
        before = {p.name: p.read_bytes() for p in tmp_path.iterdir()}
        with pytest.raises(ConfigError, match=r"holds a mission already; .* choose another folder"):
            RawLog(tmp_path, VEHICLE)
        assert {p.name: p.read_bytes() for p in tmp_path.iterdir()} == before
        if path is not None:
            path.unlink()


def test_a_start_that_was_cut_short_is_no_mission(tmp_path: Path) -> None:
    """Heads of tables without ``mission.toml`` are begun anew."""
    (tmp_path / "imu.csv").write_text("time_s,gy")
    log_of(tmp_path, mixed(9)).close()
    assert shown(replayed(tmp_path)) == shown(mixed(9))


def test_the_log_of_another_vehicle_is_refused(tmp_path: Path) -> None:
    """By the name of the key; rounding of units is no difference."""
    log_of(tmp_path, mixed(5)).close()
    other = replace(VEHICLE, beam_sigma=0.02)
    for use in (RawLog.reopen, replay):
        with pytest.raises(ConfigError, match=r"mission.toml \[dvl\] beam_noise_m_per_s: the log"):
            use(tmp_path, other)
        with pytest.raises(ConfigError, match=r"mission.toml \[origin\]: the log"):
            use(tmp_path, replace(VEHICLE, frame=None))
        with pytest.raises(ConfigError, match=r"there is none in"):
            use(tmp_path / "none", VEHICLE)
    turned = replace(VEHICLE.mount, R_bd=VEHICLE.mount.R_bd * (1.0 + 1e-16))
    RawLog.reopen(tmp_path, replace(VEHICLE, mount=turned)).close()


def test_replay_and_new_rows_do_not_meet(tmp_path: Path) -> None:
    """A replay that is still under way is not given what is appended meanwhile."""
    messages = mixed(200)
    log_of(tmp_path, messages[:100]).close()
    old = replay(tmp_path, VEHICLE)
    first = [next(old)]
    with RawLog.reopen(tmp_path, VEHICLE) as log:
        for message in messages[100:]:
            log.append(message)
        assert shown(first + list(old)) == shown(messages[:100])
    assert shown(replayed(tmp_path)) == shown(messages)


@pytest.mark.parametrize("table", TABLES)
def test_killed_at_every_byte_of_the_last_rows(
    tmp_path: Path, table: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The torn row goes, one without its letter stays, later ones keep their order."""
    for module in (raw_log, raw_rows):  # it takes longer than all the rest
        monkeypatch.setattr(module, "check_same_vehicle", lambda *_: None)
    messages = mixed(36)
    log = log_of(tmp_path, messages)
    log.close()
    whole = {p.name: p.read_bytes() for p in tmp_path.iterdir()}
    kind = next(type_ for type_, kind in row_kinds(VEHICLE).items() if kind.file == table)
    last = next(k for k in reversed(range(len(messages))) if type(messages[k]) is kind)
    row = whole[table].splitlines(keepends=True)[-1]
    n_letters = len(whole["arrivals"])
    for n_lost in range(len(row) + 1):
        for name, content in whole.items():
            cut = n_lost if name == table else 0
            (tmp_path / name).write_bytes(content[: len(content) - cut])
        (tmp_path / "arrivals").write_bytes(whole["arrivals"][: last + (n_lost == 0)])
        later = [ImuSample(9.0 - k, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)) for k in range(3)]
        with RawLog.reopen(tmp_path, VEHICLE) as again:
            for message in later:
                again.append(message)
        lost = [messages[last]] if n_lost else []
        want = [m for m in messages if m not in lost]
        got = replayed(tmp_path)
        assert shown(got[:last]) == shown(want[:last])
        assert sorted(shown(got[:-3])) == sorted(shown(want))
        assert shown(got[-3:]) == shown(later)
    assert n_letters == len(messages)


@pytest.mark.parametrize("k_logged", [None, 0, 1])
def test_what_waits_to_be_told_its_time_outlives_the_process(
    tmp_path: Path, k_logged: int | None
) -> None:
    """It is replayed last and has a row from then on; in a table already, it counts once."""
    messages = mixed(40)
    log = log_of(tmp_path / "log", messages[:30])
    pings = [Ping(9.0 + k, (0.1, -0.2, 0.3, 0.01 * k)) for k in range(3)]
    ways = [(ping, replace(ping, time_s=ping.time_s + 0.5)) for ping in pings]
    log.hold(ways[:1])
    log.hold(ways)
    logged = [] if k_logged is None else [ways[0][k_logged]]
    for message in logged:  # killed before it was noted that it waits no more
        log.append(message)
    left = [one for one, _ in ways][len(logged) :]
    expected = shown([*messages[:30], *logged, *left])
    for _ in range(2):
        assert shown(replayed(tmp_path / "log")) == expected
    with RawLog.reopen(tmp_path / "log", VEHICLE) as log:
        assert not (tmp_path / "log" / WAITING).exists()
        log.append(messages[30])
    assert shown(replayed(tmp_path / "log")) == [*expected, *shown(messages[30:31])]


@pytest.mark.parametrize("n_torn", [0, 5])
def test_a_mission_has_what_waited_when_its_log_ended(tmp_path: Path, n_torn: int) -> None:
    """Killed and not gone on with: rows without a place count where the log is read, and are told.

    A row that was torn at the end of its table stays what it is.
    """
    messages = list(messages_of(make_mission()))
    pings = [one for one in messages if isinstance(one, Ping)][-3:]
    with log_of(tmp_path, [one for one in messages if one not in pings]) as log:
        log.hold([(one, replace(one, time_s=one.time_s + 0.5)) for one in pings[:2]])
        whole = read_mission(tmp_path)
        log.append(replace(pings[0], time_s=pings[0].time_s + 0.5))
        other = read_mission(tmp_path)
        log.hold([(one,) for one in pings])
    with (tmp_path / "dvl.csv").open("a") as stream:
        stream.write("12345"[:n_torn])
    want_s = make_mission().dvl.time_s
    np.testing.assert_array_equal(whole.dvl.time_s, want_s[:-1])
    assert whole.notes[0].endswith("at their likelier times: 2 of [dvl]")
    np.testing.assert_allclose(other.dvl.time_s[-2:], np.sort([want_s[-3] + 0.5, want_s[-2]]))
    assert other.notes[0].endswith("at their likelier times: 1 of [dvl]")
    got = read_mission(tmp_path)
    np.testing.assert_array_equal(np.setdiff1d(want_s, got.dvl.time_s), [])
    assert any("no end" in note for note in got.notes) == bool(n_torn)
    assert not any("torn line" in note for note in got.notes)


@pytest.mark.parametrize(
    "damage", [b"", b"\0" * 50, b"d1,2", b"d1,2\n|\n", b"|d1.0,x\n", b"\xff\n\n"]
)
def test_damage_to_what_waits_costs_what_is_damaged(tmp_path: Path, damage: bytes) -> None:
    """A power failure took it; the tables are gone on with."""
    messages = mixed(20)
    log_of(tmp_path / "log", messages).close()
    (tmp_path / "log" / WAITING).write_bytes(damage)
    assert shown(replayed(tmp_path / "log")) == shown(messages)
    RawLog.reopen(tmp_path / "log", VEHICLE).close()
    assert shown(replayed(tmp_path / "log")) == shown(messages)


def test_what_waits_on_a_full_disk_is_said(tmp_path: Path) -> None:
    """And forgotten once it can be written again."""
    log = log_of(tmp_path / "log", mixed(5))
    in_the_way = tmp_path / "log" / f"{WAITING}.part"
    in_the_way.mkdir()
    log.hold([(mixed(1)[0],)])
    assert WAITING in (log.problems() or "")
    in_the_way.rmdir()
    log.hold([(mixed(1)[0],)])
    assert log.problems() is None
    log.close()


def test_rows_without_letters_come_last_in_order_of_time(tmp_path: Path) -> None:
    """Each process's own, before those of the next; without any letter as good as can be."""
    messages = mixed(60)
    log_of(tmp_path, messages).close()
    arrivals = (tmp_path / "arrivals").read_bytes()
    (tmp_path / "arrivals").write_bytes(arrivals[:30])
    with RawLog.reopen(tmp_path, VEHICLE) as log:
        log.append(sample(0))
    want = [*messages, sample(0)]
    assert shown(replayed(tmp_path)) == shown(want)
    (tmp_path / "arrivals").unlink()
    again = replayed(tmp_path)
    assert sorted(shown(again)) == sorted(shown(want))
    assert shown(again[:20]) == shown(messages[:20])


def test_a_log_from_before_acoustics_and_headings(tmp_path: Path) -> None:
    """It counts four tables where its processes changed; a row without its letter shifts none."""
    messages = mixed(20)
    log_of(tmp_path, messages[:9]).close()
    arrivals = tmp_path / "arrivals"
    arrivals.write_bytes(arrivals.read_bytes()[:-1])
    with RawLog.reopen(tmp_path, VEHICLE) as log:
        for message in messages[9:]:
            log.append(message)
    text = arrivals.read_bytes()
    sizes = re.search(rb"@(.*?);", text)
    assert sizes is not None
    four = b",".join(sizes[1].split(b",")[:4])
    assert sizes[1] == four + (len(BY_MESSAGE) - 4) * b",0"
    want = shown(replayed(tmp_path))
    arrivals.write_bytes(text.replace(sizes[1], four))
    assert shown(replayed(tmp_path)) == want == shown(messages)


def test_an_instrument_that_the_vehicle_does_not_have_is_logged(tmp_path: Path) -> None:
    """Its table begins with its first message, and its rows come back in order of arrival."""
    late = AcousticRange(2.5, 4.0, 120.0)
    messages = [*mixed(10), late, *mixed(3)]
    log_of(tmp_path, messages[:11]).close()
    assert not (tmp_path / "usbl.csv").exists()
    with RawLog.reopen(tmp_path, VEHICLE) as log:
        for message in messages[11:]:
            log.append(message)
    assert shown(replayed(tmp_path)) == shown(messages)


def test_arrivals_outlive_rows_in_a_power_failure(tmp_path: Path) -> None:
    """Letters without rows do not reach for those of the next process."""
    messages = mixed(60)
    log_of(tmp_path, messages).close()
    imu = (tmp_path / "imu.csv").read_bytes()
    (tmp_path / "imu.csv").write_bytes(imu[: imu.index(b"\n") + 1])
    with RawLog.reopen(tmp_path, VEHICLE) as log:
        for k in range(5):
            log.append(sample(k))
    want = [m for m in messages if not isinstance(m, ImuSample)] + [sample(k) for k in range(5)]
    assert shown(replayed(tmp_path)) == shown(want)


@pytest.mark.parametrize("n_kept", [0, 7])
def test_a_power_failure_that_took_a_head(tmp_path: Path, n_kept: int) -> None:
    """The head is written again."""
    log_of(tmp_path, list(messages_of(make_mission()))).close()
    os.truncate(tmp_path / "depth.csv", n_kept)
    with RawLog.reopen(tmp_path, VEHICLE) as log:
        log.append(DepthReading(30.0, 20.0))
    depth = read_mission(tmp_path).depth
    assert depth is not None
    assert depth.depth.tolist() == [20.0]


def test_a_checkpoint_beyond_the_end_of_the_file(tmp_path: Path) -> None:
    """After a power failure the replay begins at a whole row all the same."""
    log = log_of(tmp_path, [sample(k) for k in range(20)])
    offsets = log.offsets()
    log.close()
    os.truncate(tmp_path / "imu.csv", offsets["imu.csv"] - 100)
    assert replayed(tmp_path, offsets) == []
    with RawLog.reopen(tmp_path, VEHICLE) as again:
        for k in range(20, 40):
            again.append(sample(k))
    got = replayed(tmp_path, offsets)
    assert shown(got) == shown([sample(k) for k in range(40 - len(got), 40)])
    assert len(got) >= 17


def test_a_short_write_leaves_no_torn_row(tmp_path: Path, failing: list[int | None]) -> None:
    """Neither where the rest fails nor where it can be written after all."""
    with log_of(tmp_path, mixed(10)) as log:
        for plan in ([5], [5, -1], [None, -1], [-1]):
            failing += plan
            log.append(sample(0))
            assert (log.problems() is None) == (plan == [5])
            for k in range(3):
                log.append(ImuSample(100.0 * k, (0.0,) * 3, (0.0,) * 3))
            assert log.problems() is None
    assert len(replayed(tmp_path)) == 10 + 4 * 4
    assert b"torn" not in (tmp_path / "imu.csv").read_bytes()


def test_a_row_that_cannot_be_taken_back_is_ended(
    tmp_path: Path, failing: list[int | None], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The next row begins a line of its own; a number cut short is not taken for a whole one."""
    log = log_of(tmp_path, [sample(0)])

    def refuse(*_: object) -> None:
        raise OSError(errno.EIO, "no")

    monkeypatch.setattr(os, "ftruncate", refuse)
    failing += [len(row_kinds(VEHICLE)[ImuSample].row(sample(1))) - 2, -1]
    log.append(sample(1))
    failing += [8, -1]
    log.append(ImuSample(5.0, (0.0,) * 3, (0.0,) * 3))
    log.append(ImuSample(9.0, (0.0,) * 3, (0.0,) * 3))
    log.close()
    assert [m.time_s for m in replayed(tmp_path)] == [0.0, 0.01, 5.0, 9.0]
    assert (tmp_path / "imu.csv").read_text().count("torn") == 2


def test_rows_wait_and_are_lost_when_too_many_do(tmp_path: Path, failing: list[int | None]) -> None:
    """Nothing is raised; the problem says how many; the disk is not asked for every row."""
    log = log_of(tmp_path, [sample(0)], max_waiting=3, retry_every=4)
    failing += [-1] * 50
    for k in range(1, 10):
        log.append(sample(k))
    problem = log.problems()
    assert problem is not None
    assert "wait in memory for the disk: 3 (No space left on device)" in problem
    assert "lost because 3 waited already: 6" in problem
    assert len(failing) == 50 - 3
    log.append(ImuSample(30.0, (0.0,) * 3, (0.0,) * 3))
    assert len(failing) == 50 - 4
    failing.clear()
    assert log.sync()
    assert log.problems() == "raw log: rows lost because 3 waited already: 7"
    assert shown(replayed(tmp_path)) == shown([sample(k) for k in range(4)])


def test_offsets_do_not_count_rows_that_wait(tmp_path: Path, failing: list[int | None]) -> None:
    """A checkpoint of that moment is given them once more."""
    log = log_of(tmp_path, mixed(10))
    failing += [None, -1]
    log.append(sample(1))
    log.append(sample(1))
    offsets = log.offsets()
    assert log.sync()
    assert replayed(tmp_path, offsets) == [sample(1), sample(1)]


def test_a_sync_that_fails_is_a_problem(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Until one succeeds."""
    log = log_of(tmp_path, mixed(10))
    with monkeypatch.context() as patch:

        def fail(_: int) -> None:
            raise OSError(errno.EIO, os.strerror(errno.EIO))

        patch.setattr(os, "fsync", fail)
        assert not log.sync()
        assert "does not confirm" in (log.problems() or "")
    assert log.sync()
    assert log.problems() is None


def test_reopened_on_a_full_disk(tmp_path: Path, failing: list[int | None]) -> None:
    """The estimator starts; what it logs waits, and the order is right in the end."""
    messages = mixed(40)
    log_of(tmp_path, messages[:20]).close()
    failing += [-1] * 3
    log = RawLog.reopen(tmp_path, VEHICLE)
    for message in messages[20:25]:
        log.append(message)
    assert "wait in memory" in (log.problems() or "")
    for message in messages[25:]:
        log.append(message)
    log.close()
    assert log.problems() is None
    assert shown(replayed(tmp_path)) == shown(messages)


def _fill_the_disk(folder: Path, pipe: Connection) -> None:
    """Log beyond a real limit on the size of files, twice, then without limit."""
    log = RawLog(folder, VEHICLE)
    texts: list[str | None] = []
    for limit in (5_000, 40_001, resource.RLIM_INFINITY):
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, resource.RLIM_INFINITY))
        for k in range(len(texts) * 500, (len(texts) + 1) * 500):
            log.append(sample(k))
        texts.append(log.problems())
    log.close()
    pipe.send(texts)


def test_a_disk_that_is_really_full(tmp_path: Path) -> None:
    """The system itself cuts a row in two; nothing is lost, torn or out of order."""
    ours, theirs = FORK.Pipe()
    process = FORK.Process(target=_fill_the_disk, args=(tmp_path / "log", theirs))
    process.start()
    assert ours.poll(20.0)
    first, second, third = ours.recv()
    process.join()
    assert "File too large" in first
    assert "File too large" in second
    assert third is None
    assert replayed(tmp_path / "log") == [sample(k) for k in range(1500)]
    assert b"torn" not in (tmp_path / "log" / "imu.csv").read_bytes()


def _append_for_ever(folder: Path, start: int, pipe: Connection) -> None:
    """Log, and acknowledge each row."""
    log = RawLog(folder, VEHICLE) if start == 0 else RawLog.reopen(folder, VEHICLE)
    for k in range(start, 10**9):
        log.append(sample(k))
        pipe.send_bytes(str(k).encode())


def test_killed_at_any_moment(tmp_path: Path) -> None:
    """Every acknowledged row is there, through three deaths of the process."""
    rng = np.random.default_rng(3)
    acknowledged, start = set(), 0
    for _ in range(3):
        ours, theirs = FORK.Pipe(duplex=False)
        process = FORK.Process(target=_append_for_ever, args=(tmp_path / "log", start, theirs))
        process.start()
        theirs.close()
        acknowledged.add(int(ours.recv_bytes()))
        end = time.monotonic() + 0.03 * rng.random()
        while time.monotonic() < end:
            acknowledged.add(int(ours.recv_bytes()))
        process.kill()
        process.join()
        with contextlib.suppress(EOFError):
            while True:
                acknowledged.add(int(ours.recv_bytes()))
        start = max(acknowledged) + 1000
    got = replayed(tmp_path / "log")
    keys = [round(m.time_s / 0.01) for m in got]
    assert acknowledged <= set(keys)
    assert keys == sorted(keys)
    assert got == [sample(k) for k in keys]
    assert len(keys) <= len(acknowledged) + 3
