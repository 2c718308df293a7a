"""Write ``docs/malformed-input.md``: ``python -m tests.make_malformed_table`` from the root."""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from ssm_graph.base.errors import SsmGraphError
from ssm_graph.io.mission_folder.folder import read_mission
from tests.malformed_cases import AID_CASES, PHYSICS_CASES, TABLE_CASES, TOML_CASES, Malformed
from tests.mission_fixture import write_example

DOC = Path(__file__).parents[1] / "docs" / "malformed-input.md"
INTRO = """\
# What the reader says about malformed input

A mission that cannot be right is refused with one sentence: where, what was expected, what came,
what to try. `imu.csv:17` is line 17 of the file as an editor counts; Parquet tables have rows,
counted from 1. What is odd and may yet be right becomes a note of the mission instead.

This page is made by `python -m tests.make_malformed_table` from the cases of
`tests/malformed_cases.py`, each of which is also a test.
"""
HEAD = "| what was wrong | message |\n|---|---|\n"


def message_of(case: Malformed, folder: Path) -> str:
    """Damage a fresh mission in ``folder`` and return what the reader says about it."""
    write_example(folder)
    case.damage(folder)
    try:
        read_mission(folder)
    except SsmGraphError as error:
        return f"{type(error).__name__}: {error}".replace(str(folder), "lake-trial-3")
    raise AssertionError(f"{case.title}: the mission was read without an error")


def row_of(case: Malformed, message: str) -> str:
    """Return one row of the page."""
    text = message.replace("|", "\\|").replace("`", "'")
    return f"| {case.title} | `{text}` |\n"


def make_page() -> str:
    """Return the whole page."""
    page = INTRO
    for heading, cases in (
        ("The file mission.toml", TOML_CASES),
        ("Damaged tables", TABLE_CASES),
        ("Wrong units, signs and clocks", PHYSICS_CASES),
        ("Acoustics, compass and times at rest", AID_CASES),
    ):
        page += f"\n## {heading}\n\n{HEAD}"
        for case in cases:
            with tempfile.TemporaryDirectory() as folder:
                page += row_of(case, message_of(case, Path(folder)))
    return page


if __name__ == "__main__":
    DOC.parent.mkdir(exist_ok=True)
    DOC.write_text(make_page(), encoding="utf-8")
    sys.stdout.write(f"wrote {DOC}\n")
