"""Recordings of real instruments are read to the last sound report, as the page says."""

from __future__ import annotations

import pytest

from tests.make_instruments_table import DATA, DOC, FOLDERS, INTRO, line_of, recordings


@pytest.mark.parametrize("folder", FOLDERS)
def test_the_page_is_that_of_today(folder: str) -> None:
    """Run  python -m tests.make_instruments_table  where it is not."""
    if not (DATA / folder).is_dir():
        pytest.skip(f"no logs in {DATA / folder}")
    page = DOC.read_text(encoding="utf-8")
    assert page.startswith(INTRO)
    found = list(recordings(folder))
    assert [one.name for one in found if not one.is_whole] == []
    section = page.partition(f"## {FOLDERS[folder]}\n")[2].partition("\n## ")[0]
    rows = [line for line in section.splitlines() if line.startswith("| ")][1:]
    assert rows == [line_of(one) for one in found]
