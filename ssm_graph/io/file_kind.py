"""What a file is that no converter reads, by its first bytes, and what to do with it."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from ssm_graph.base.errors import DataError

CSV_ENDINGS: Final = (".csv", ".txt", ".tsv", ".dat")
READ: Final = (
    "a ROS 2 bag (a folder, .mcap or .db3), a ROS 1 .bag, a Blueye X3 log, an ArduPilot log, "
    "Teledyne PD0, PD4, PD5 or PD6, Nortek AD2CP or Nucleus, Water Linked JSON, serial lines or "
    "a table of its reports, NMEA 0183, or tables with  --map"
)
_MCAP: Final = b"\x89MCAP0\r\n"
_REMARKS: Final = 4096
"""Bytes in which remarks before the content end."""
_COMPRESSED: Final = "a compressed file: unpack it first"
_KINDS: Final = (
    (b"#ROSBAG V1", "a ROS 1 bag of version 1: bring it to 2.0 with  rosbag fix"),
    (b"\x28\xb5\x2f\xfd", f"{_COMPRESSED}, with  zstd -d"),
    (b"\x04\x22\x4d\x18", f"{_COMPRESSED}, with  lz4 -d"),
    (b"\x1f\x8b", f"{_COMPRESSED}, with  gunzip"),
    (b"BZh", f"{_COMPRESSED}, with  bunzip2"),
    (b"PK\x03\x04", f"{_COMPRESSED}, with  unzip"),
    (b"\xa3\x95\x80", "an ArduPilot DataFlash log"),
    (b"ULog\x01\x12\x35", "a PX4 ULog: export its tables with  ulog2csv"),
    (b"\x7f\x7f", "like Teledyne PD0, but its first ensemble is damaged"),
    (b"\xb5\x62", "binary of a u-blox receiver: have it write NMEA, or convert it"),
    (b"\xa0\xa2", "binary of a SiRF receiver: have it write NMEA, or convert it"),
    (b"\xd3\x00", "RTCM 3, corrections of a receiver: have it write NMEA beside them"),
    (b"SQLite format 3\0", "an SQLite database: a ROS 2 bag has it under the name .db3"),
    (b"PAR1", "a Parquet table: say what its columns are, with  --map"),
    (b"\x89HDF\r\n", "an HDF5 file: say what its columns are, with  --map"),
    (b"MATLAB", "a MAT file: say what its columns are, with  --map"),
    (b"CDF", "a classic NetCDF file: bring it to NetCDF 4 with  nccopy -k nc4, then  --map"),
    (b"\x89PNG", "an image"),
    (b"\xff\xd8\xff", "an image"),
    (b"%PDF", "a PDF"),
    (b"<?xml", "XML"),
)


def check_is_file(path: Path) -> None:
    """Raise :class:`DataError` for what never ends: pipes, devices, sockets."""
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise DataError(f"{path}: expected a file or a folder, got a pipe or a device")


def is_mcap(path: Path) -> bool:
    """Return whether a file begins as MCAP does."""
    return first_bytes(path).startswith(_MCAP)


def kind_of(path: Path) -> str:
    """Return a sentence that says what a file is, as far as it shows, and what is read."""
    if path.is_dir():
        n_tables = sum(one.suffix.lower() in CSV_ENDINGS for one in path.iterdir())
        if n_tables:
            return (
                f"a folder with {n_tables} table{'s' * (n_tables > 1)}: say what the columns are, "
                "with  --map  "
                f"(ssm-graph template, ssm-graph inspect {path} --draft-map map.toml); else "
                f"expected {READ}"
            )
        return f"a folder without .mcap or .db3 files; expected {READ}"
    head = _after_remarks(path)
    if not head:
        return f"empty, or it cannot be read; expected {READ}"
    for begin, what in _KINDS:
        if head.startswith(begin):
            return f"this is {what}; expected {READ}"
    if path.suffix.lower() in CSV_ENDINGS:
        return (
            "a table or text of unknown columns: say what they are, with  --map  (ssm-graph "
            f"template, ssm-graph inspect {path.name} --draft-map map.toml); else expected {READ}"
        )
    if _is_mavlink(head):
        return f"this is MAVLink without the times of a .tlog; expected {READ}"
    if head.startswith(_MCAP):
        return f"MCAP without messages of ROS 2; expected {READ}"
    return f"of no known kind, it begins with {head[:12]!r}; expected {READ}"


def _after_remarks(path: Path) -> bytes:
    """Return what stands in a file behind the remarks that somebody put before it."""
    try:
        with path.open("rb") as stream:
            head = stream.read(_REMARKS)
    except OSError:
        return b""
    rest = head
    while (
        rest.startswith((b"#", b"\n", b"\r")) and not rest.startswith(b"#ROSBAG") and b"\n" in rest
    ):
        rest = rest.partition(b"\n")[2]
    return rest or head


def _is_mavlink(head: bytes) -> bool:
    """Return whether frames stand alone."""
    return head[:1] in (b"\xfd", b"\xfe")


def first_bytes(path: Path) -> bytes:
    """Return what a file begins with, nothing of one that cannot be read."""
    try:
        with path.open("rb") as stream:
            return stream.read(32)
    except OSError:
        return b""
