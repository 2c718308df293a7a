"""The page of attacks has every one that is made, and no other."""

from __future__ import annotations

from tests.make_attacks_table import DOC, INTRO, rows


def test_the_page_has_every_attack() -> None:
    """Run  python -m tests.make_attacks_table  where it does not."""
    page = DOC.read_text(encoding="utf-8")
    attacks = [(heading, title) for heading, title, _ in rows()]
    assert page.startswith(INTRO)
    for heading, title in attacks:
        section = page.partition(f"## {heading}\n")[2].partition("\n## ")[0]
        assert f"| {title} | `" in section
    assert page.count("\n| ") == len(attacks) + len({heading for heading, _ in attacks})
    assert "**changed**" not in page
    assert len(attacks) >= 60
