"""Examples are documentation that must stay true."""

from __future__ import annotations

import os
import runpy
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
LONG = ("04", "06", "10")
"""Numbers of those that take seconds"""
EXAMPLES = [
    pytest.param(path, id=path.stem, marks=[pytest.mark.slow] * (path.stem[:2] in LONG))
    for path in sorted((ROOT / "examples").glob("*.py"))
]


@pytest.mark.parametrize("script", EXAMPLES)
def test_example_runs(
    script: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Every script of the folder ends without an error and says something."""
    data = os.environ.get("SSM_GRAPH_DATA", str(ROOT.parent / "shared" / "data"))
    monkeypatch.setenv("SSM_GRAPH_DATA", data)
    monkeypatch.chdir(tmp_path)
    try:
        runpy.run_path(str(script), run_name="__main__")
    except SystemExit as ended:
        if ended.code:
            raise
    assert capsys.readouterr().out.strip()
