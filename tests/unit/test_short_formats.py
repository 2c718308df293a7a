"""PD4, PD5, PD6 by their documented layouts: signs of a vehicle, beams where there are any."""

from __future__ import annotations

import struct
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from ssm_graph.base.errors import DataError
from ssm_graph.io.teledyne.short_formats import is_pd6, is_pd45, read_pd6, read_pd45
from ssm_graph.live.recorded.log import read_recorded
from ssm_graph.sensors.compass import HeadingReading
from ssm_graph.sensors.dvl import Ping


def ensemble(
    second: int, speeds: list[int], *, coordinates: int = 0, is_pd5: bool = False, hour: int = 10
) -> bytes:
    """Return PD4 or PD5 with its checksum."""
    size = 86 if is_pd5 else 45
    body = struct.pack(
        "<BBHB4h4HB", 0x7D, is_pd5, size, coordinates << 6 | 2, *speeds, *[800] * 4, 0
    )
    body += struct.pack("<4hHHB4BHHh", *[0] * 4, 0, 0, 0, hour, 0, second, 50, 0, 1500, 1000)
    if is_pd5:
        body += struct.pack("<BHhhH8i", 35, 100, 0, 0, 9050, *[0] * 8)
    assert len(body) == size
    return body + struct.pack("<H", sum(body) & 0xFFFF)


def _file(folder: Path, data: bytes) -> Path:
    path = folder / "log.bin"
    path.write_bytes(data)
    return path


def test_beams_of_pd4_and_pd5(tmp_path: Path) -> None:
    """Beam coordinates are beams; PD5 has a heading; over midnight the seconds go on."""
    path = _file(tmp_path, b"".join(ensemble(k, [100, -200, 300, -32768]) for k in range(3)))
    assert is_pd45(path.read_bytes())
    found = read_recorded(path)
    assert found is not None
    assert found.about == "Teledyne PD4, 3 ensembles, beam coordinates, bottom track in 100 %"
    ping = found.messages[1]
    assert isinstance(ping, Ping)
    np.testing.assert_array_equal(ping.speed, [0.1, -0.2, 0.3, np.nan])
    assert ping.time_s == 36001.5
    late = [ensemble(59, [1, 2, 3, 4], is_pd5=True, hour=23)]
    late.append(ensemble(1, [1, 2, 3, 4], is_pd5=True, hour=0))
    both = read_pd45(_file(tmp_path, b"".join(late))).messages
    assert both[2].time_s == 86401.5
    heading = both[1]
    assert isinstance(heading, HeadingReading)
    assert np.degrees(heading.heading) == pytest.approx(90.5)


def test_other_coordinates(tmp_path: Path) -> None:
    """Of the instrument: three components; of ship and earth: a refusal; mixed: a refusal."""
    one = [ensemble(k, [1500, -20, 3, 9], coordinates=1) for k in range(2)]
    found = read_pd45(_file(tmp_path, b"".join(one)))
    ping = found.messages[0]
    assert isinstance(ping, Ping)
    np.testing.assert_allclose(ping.speed, [1.5, -0.02, 0.003])
    assert "beam_vectors" in found.notes[1]
    for coordinates, name in ((2, "ship"), (3, "earth")):
        with pytest.raises(DataError, match=f"1 ensembles in {name} coordinates"):
            read_pd45(_file(tmp_path, ensemble(0, [1] * 4, coordinates=coordinates)))
    with pytest.raises(DataError, match="2 different formats or coordinates"):
        read_pd45(_file(tmp_path, one[0] + ensemble(5, [1] * 4)))
    twice = read_pd45(_file(tmp_path, 2 * ensemble(5, [1] * 4)))
    assert len(twice.messages) == 1
    assert any("1 reports of a time that an earlier one has" in note for note in twice.notes)
    with pytest.raises(DataError, match="the clock goes from"):
        read_pd45(_file(tmp_path, ensemble(5, [1] * 4) + ensemble(3, [1] * 4)))


@pytest.mark.parametrize("is_pd5", [False, True])
def test_every_truncation_of_pd4_and_pd5(tmp_path: Path, is_pd5: bool) -> None:
    """Whole ensembles before the cut, or one sentence."""
    parts = [ensemble(k, [100, 200, 300, 400], is_pd5=is_pd5) for k in range(3)]
    data, size = b"".join(parts), len(parts[0])
    for end in range(len(data) + 1):
        path = _file(tmp_path, data[:end])
        if end < size:
            assert not is_pd45(data[:end])
            continue
        pings = [m for m in read_pd45(path).messages if isinstance(m, Ping)]
        assert len(pings) == end // size
    for at in range(len(data)):
        broken = bytearray(data)
        broken[at] ^= 0x11
        found = read_pd45(_file(tmp_path, bytes(broken))).messages
        pings = [m for m in found if isinstance(m, Ping)]
        assert len(pings) == 2


def sentences(second: int, x: int, status: str = "A", heading: str = "90.50") -> bytes:
    """Return one ensemble of PD6."""
    return (
        f":SA,+01.00,-02.00,{heading}\r\n"
        f":TS,26050110{second:02d}0025,35.0,+10.0,0001.0,1500.0,000\r\n"
        f":WI,+00001,+00002,+00003,+00004,A\r\n"
        f":BI,{x:+06d},-00200,+00003,+00004,{status}\r\n"
        f":BS,+00001,+00002,+00003,{status}\r\n"
        ":BD,+0.0,+0.0,+0.0,12.3,0.1\r\n"
    ).encode()


def test_pd6_without_axes_of_the_instrument_is_refused_as_that(tmp_path: Path) -> None:
    """It is PD6 all the same, and the message says what it has instead."""
    data = b"".join(sentences(k, 100).replace(b":BI", b":BE") for k in range(3))
    with pytest.raises(DataError, match=r"no bottom track in axes of the instrument.* 3 BE"):
        read_recorded(_file(tmp_path, data))


def test_velocities_of_pd6(tmp_path: Path) -> None:
    """Instrument axes, mm/s, the vehicle's sign; V is none; a heading of zero is no heading."""
    parts = [sentences(1, 1500), sentences(2, 1400, "V"), sentences(3, 1300, heading="00.00")]
    data = b"noise\r\n".join(parts)
    assert is_pd6(data)
    found = read_recorded(_file(tmp_path, data))
    assert found is not None
    pings = [m for m in found.messages if isinstance(m, Ping)]
    np.testing.assert_allclose(pings[0].speed, [1.5, -0.2, 0.003])
    assert np.isnan(pings[1].speed).all()
    assert pings[0].time_s == datetime(2026, 5, 1, 10, 1, 0, 250000, tzinfo=UTC).timestamp()
    assert sum(isinstance(m, HeadingReading) for m in found.messages) == 2
    with pytest.raises(DataError, match=r"no bottom track .* it has 1 TS"):
        read_pd6(_file(tmp_path, b":TS,26050110000000,35.0\r\n"))
    with pytest.raises(DataError, match="the clock goes from"):
        read_pd6(_file(tmp_path, parts[1] + parts[0]))


def test_every_truncation_of_pd6(tmp_path: Path) -> None:
    """Whole reports, or a sentence; never a number of half a field without its status."""
    data = sentences(1, 1500) + sentences(2, 1400)
    for end in range(len(data)):
        path = _file(tmp_path, data[:end])
        try:
            pings = [m for m in read_pd6(path).messages if isinstance(m, Ping)]
        except DataError:
            assert data[:end].count(b"+00004,A\r\n:BS") == 0
            continue
        assert [round(1e3 * p.speed[0]) for p in pings] in ([1500], [1500, 1400])
