"""Every malformed mission of the catalogue is refused with a sentence that helps."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.make_malformed_table import DOC, INTRO, message_of, row_of
from tests.malformed_cases import CASES, Malformed


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.title)
def test_message_says_where_and_what_to_try(case: Malformed, tmp_path: Path) -> None:
    """Error class, place and hint are right, and the page in docs shows this very message."""
    if "Parquet" in case.title:
        pytest.importorskip("pyarrow")
    message = message_of(case, tmp_path)
    assert message.startswith(case.error.__name__)
    for word in case.words:
        assert word in message
    assert "\n" not in message
    assert row_of(case, message) in DOC.read_text(encoding="utf-8"), (
        "run  python -m tests.make_malformed_table"
    )


def test_page_holds_nothing_else() -> None:
    """No row outlives its case."""
    page = DOC.read_text(encoding="utf-8")
    assert page.startswith(INTRO)
    assert page.count("Error: ") == len(CASES)
    assert len(CASES) == len({case.title for case in CASES})
