"""What pages have in common: one file of HTML with its style, title, links and footer."""

from __future__ import annotations

import html
from collections.abc import Iterable
from importlib.resources import files

_FRAME = """\
<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>
{css}</style>
</head>
<body>
<main>
<h1>{title}</h1>
{head}
<nav>{links}</nav>
{body}
<footer>{footer}</footer>
</main>
{scripts}</body>
</html>
"""


def frame(
    title: str,
    *,
    head: str,
    links: Iterable[tuple[str, str]],
    body: str,
    footer: str,
    css: str = "",
    scripts: str = "",
) -> str:
    """Return a page.

    Parameters
    ----------
    title, footer : texts.
    head, body : HTML above and below the links.
    links : name of a place in the page, and what is shown of it.
    css, scripts : more of these than every page has.
    """
    own = (files("ssm_graph.report.page") / "page.css").read_text(encoding="utf-8")
    return _FRAME.format(
        title=html.escape(title),
        css=own + css,
        head=head,
        links=" ".join(f'<a href="#{name}">{html.escape(shown)}</a>' for name, shown in links),
        body=body,
        footer=html.escape(footer),
        scripts=scripts,
    )


def numbered(parts: Iterable[tuple[str, str]]) -> str:
    """Return parts (title, HTML) below headings that links ``part0``, ``part1`` ... lead to."""
    return "\n".join(
        f'<h2 id="part{number}">{html.escape(title)}</h2>\n{text}'
        for number, (title, text) in enumerate(parts)
    )
