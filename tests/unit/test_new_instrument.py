"""An instrument is a file and a line of the registry; nothing else has to hear of it."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

from ssm_graph.sensors.registry import BY_MESSAGE, INSTRUMENTS

ROOT = Path(__file__).parents[2]


def test_an_instrument_is_one_file_and_one_line(tmp_path: Path) -> None:
    """It is read, written, converted, decoded, logged, replayed and kept, checked everywhere."""
    code = tmp_path / "code"
    # With what is compiled: to do that again takes longer than all else.
    half_written = shutil.ignore_patterns("*.pyc.*", "*.nb?", "*.nb?.*")
    for part in ("ssm_graph", "factors", "tests"):
        shutil.copytree(ROOT / part, code / part, ignore=half_written)
    sensors = code / "ssm_graph" / "sensors"
    shutil.copy(ROOT / "tests" / "fluxgate_fixture.py", sensors / "fluxgate.py")
    registry = sensors / "registry.py"
    text = registry.read_text()
    imported = "from ssm_graph.sensors.fluxgate import FLUXGATE\nfrom ssm_graph.sensors.mess"
    text = text.replace("from ssm_graph.sensors.mess", imported)
    assert "    COMPASS,\n" in text
    registry.write_text(text.replace("    COMPASS,\n", "    COMPASS,\n    FLUXGATE,\n"))
    ran = subprocess.run(
        [sys.executable, "-m", "tests.new_instrument_script", str(tmp_path)],
        cwd=code,
        env={**os.environ, "PYTHONPATH": str(code)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert ran.stdout == "all ways\n", ran.stderr


def test_names_and_letters_tell_instruments_apart() -> None:
    """A log counts arrivals by letters, and a folder has one table of each section."""
    letters = [one.letter for one in BY_MESSAGE.values()]
    assert all(len(letter) == 1 and letter.isascii() and letter.isalpha() for letter in letters)
    assert len(set(letters)) == len(letters)
    assert len({one.section for one in INSTRUMENTS}) == len(INSTRUMENTS)
    assert len({one.log for one in INSTRUMENTS}) == len(INSTRUMENTS)
    # As logs count them that are there already: what is new comes behind.
    assert "".join(letters).startswith("idzgurhmsp")
