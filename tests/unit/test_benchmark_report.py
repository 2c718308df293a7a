"""The page of a benchmark: its command and its machine, and where it goes."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.report import Report


def test_a_page_says_what_was_run_and_where(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The command can be pasted into a shell; the text is printed and goes to every folder."""
    page = Report("aids", "Further aids", ["--runs", "3", "--out", "my results"])
    title, _, command, _, about, _ = page.head()
    assert title == "# Further aids"
    assert command == "    python benchmarks/aids.py --runs 3 --out 'my results'"
    assert "cores; ssm-graph" in about
    assert "load average before" in about
    page.write("text", (tmp_path / "a", tmp_path / "b"))
    assert capsys.readouterr().out == "text\n"
    assert [path.read_text() for path in sorted(tmp_path.glob("*/aids.md"))] == ["text", "text"]
