"""One file of HTML that holds everything it shows; it opens without a network, and prints."""

from __future__ import annotations

import html
import json
import os
from importlib.resources import files
from pathlib import Path

from ssm_graph.base.errors import DataError, MissingExtraError
from ssm_graph.report.page.charts import charts_of
from ssm_graph.report.page.content import Content
from ssm_graph.report.page.frame import frame, numbered
from ssm_graph.report.page.words import sections, verdict

_SCRIPTS = """\
<script id="charts" type="application/json">{data}</script>
<script>{library}</script>
<script>
{script}</script>
"""


def page_of(content: Content, *, footer: str) -> str:
    """Return the page of a result.

    Parameters
    ----------
    content : what it is about.
    footer : who made it and from what, one line.

    Raises :class:`MissingExtraError` without plotly, whose script is put into the page.
    """
    try:
        from plotly.offline import get_plotlyjs
    except ImportError as error:
        raise MissingExtraError("plotly", extra="report", purpose="a report page") from error
    charts = charts_of(content)
    told = sections(content)
    places = "\n".join(
        f'<h2 id="{chart.name}-title">{html.escape(chart.title)}</h2>'
        f'<p class="note">{html.escape(chart.note)}</p>'
        f'<div class="chart" id="{chart.name}" style="height: {chart.height}px"></div>'
        for chart in charts
    )
    links = [(f"{chart.name}-title", chart.title) for chart in charts]
    links += [(f"part{number}", title) for number, (title, _) in enumerate(told)]
    data = {
        chart.name: {
            "traces": chart.traces,
            "layout": chart.layout,
            "is_time": chart.is_time,
            "height": chart.height,
        }
        for chart in charts
    }
    scripts = _SCRIPTS.format(
        # A text of the mission must not end the script that it stands in.
        data=json.dumps(data, allow_nan=False).replace("</", "<\\/"),
        library=get_plotlyjs(),
        script=(files("ssm_graph.report.page") / "page.js").read_text(encoding="utf-8"),
    )
    return frame(
        f"{content.summary.get('mission')}: navigation report",
        head=verdict(content),
        links=links,
        body=f"{places}\n{numbered(told)}",
        footer=footer,
        scripts=scripts,
    )


def write_page(content: Content, path: Path, *, footer: str) -> None:
    """Write the page, whole or not at all; see `page_of`.

    Raises :class:`DataError`: the file cannot be written.
    """
    text = page_of(content, footer=footer)
    part = path.with_name(f".{path.stem}.part-{os.getpid()}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        part.write_text(text, encoding="utf-8")
        part.replace(path)
    except OSError as error:
        part.unlink(missing_ok=True)
        raise DataError(f"{path}: cannot be written: {error.strerror or error}") from error
