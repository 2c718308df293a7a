"""The real logs of a Blueye X3, each read once by all tests of a process."""

from __future__ import annotations

import os
from functools import cache
from pathlib import Path

import pytest

from ssm_graph.io.blueye.convert import convert_blueye
from ssm_graph.io.blueye.log import BlueyeTables, read_blueye_tables
from ssm_graph.mission.mission import Mission

DATA = Path(os.environ.get("SSM_GRAPH_DATA", Path(__file__).parents[1].parent / "shared" / "data"))
LOGS = DATA / "blueye_x3"
SQUARE = "log_auto_square_2025-05-07_14_55_13"
DIVE = "log_dive_2min_2025-05-07_15_06_13"
GRID = "log_grid_01_05_scaled"
needs_logs = pytest.mark.skipif(not LOGS.is_dir(), reason=f"no Blueye logs in {LOGS}")


@cache
def tables(name: str) -> BlueyeTables:
    """Return the messages of a run as they were logged."""
    return read_blueye_tables(LOGS / f"{name}.mcap")


@cache
def converted(name: str) -> Mission:
    """Return a run as a mission."""
    pytest.importorskip("mcap_protobuf", reason="needs the extra 'blueye'")
    return convert_blueye(LOGS / f"{name}.mcap")
