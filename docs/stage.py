"""What ``mkdocs.yml`` calls before it builds: pages of the whole repository in one place.

Pages link to results, examples and each other by their places in the repository; MkDocs takes one
folder. So what it needs is copied, with those places, to a folder of its own.
"""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
STAGE = ROOT / "out" / "docs"
WANTED = ("*.md", "docs/*.md", "docs/*.svg", "docs/*.png", "benchmarks/results/**/*")
WANTED += ("benchmarks/studies/*.toml", "examples/*.py", "LICENSE", "CITATION.cff")
LINK = re.compile(r"\]\((?!https?:|#|mailto:)([^)#\s]+)(#[^)\s]*)?\)")


def on_config(config: Any) -> Any:
    """Copy, and have MkDocs build from there."""
    shutil.rmtree(STAGE, ignore_errors=True)
    for pattern in WANTED:
        for path in sorted(ROOT.glob(pattern)):
            if path.is_file():
                copy = STAGE / path.relative_to(ROOT)
                copy.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(path, copy)
    config["docs_dir"] = str(STAGE)
    return config


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Show links to code that the site does not have as text."""
    here = (STAGE / page.file.src_uri).parent

    def shown(found: re.Match[str]) -> str:
        target = (here / found[1]).resolve()
        return found[0] if target.is_file() else "]"

    return re.sub(r"\[([^\[\]]*)\]$", r"`\1`", LINK.sub(shown, markdown))
