"""The page about a result: whole without a network, sound in a browser, true to the tables."""

from __future__ import annotations

import base64
import json
import re
import subprocess
from collections.abc import Mapping
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ssm_graph.evaluation.errors import ErrorSeries
from ssm_graph.report.page.charts import MOST_LAGS, autocorrelation, charts_of, line
from ssm_graph.report.page.content import Content
from ssm_graph.report.page.words import sections, verdict

pytest.importorskip("plotly", reason="extra 'report' is not installed")
from ssm_graph.report.page.page import page_of, write_page
from tests.browser import BROWSER, Browser

N = 600


def content(**changes: Any) -> Content:
    """Return a result of ten minutes with a doubtful stretch and a beam that was left out."""
    k = np.arange(N, dtype=float)
    rng = np.random.default_rng(3)
    rows: dict[str, Any] = {
        "time_s": 1000.0 + k,
        "lat_deg": 60.0 + 1e-5 * k,
        "lon_deg": 7.0 + 1e-5 * np.sin(k / 50.0),
        "height_m": -10.0 + np.sin(k / 30.0),
        "suspect": ((k >= 100) & (k < 160)).astype(float),
    }
    for name in ("east", "north", "up"):
        rows[f"sigma_{name}_m"] = 0.2 + 0.001 * k
        rows[f"vel_{name}_m_per_s"] = np.full(N, 0.4)
    rows |= {f"sigma_{name}_deg": np.full(N, 0.1) for name in ("roll", "pitch", "heading")}
    rows |= {"roll_deg": k % 5, "pitch_deg": k % 3, "heading_deg": (3.0 * k) % 360.0}
    beam = np.tile([1.0, 2.0, 3.0, 4.0], N)
    weight = np.where((beam == 2) & (np.repeat(k, 4) >= 300) & (np.repeat(k, 4) < 340), 0.01, 1.0)
    beams = {
        "time_s": np.repeat(rows["time_s"], 4),
        "beam": beam,
        "innovation_m_per_s": 0.004 * rng.normal(size=4 * N),
        "mahalanobis_sq": rng.chisquare(1, size=4 * N),
        "weight": weight,
    }
    fault = {"sensor": "GNSS", "what": "3.1 m to the east", "begin_s": 1100.0, "end_s": 1159.0}
    fault |= {"treatment": "said", "rivals": ["DVL </script><b>"], "cost_m": 2.0, "remedy": ""}
    summary: dict[str, Any] = {"mission": "lake <3>", "status": "SUSPECT", "method": "smoother"}
    summary |= {"kernel": "log(dof=5)", "reason": "GNSS, 100-160 s", "duration_s": 599.0}
    summary |= {"n_beams": 4 * N, "n_outliers": 40, "faults": [{**fault, "is_suspect": True}]}
    summary |= {"versions": {"gtsam": "4.3.0"}, "settings": {"tolerance": None}}
    of = {"trajectory": rows, "beams": beams, "summary": summary, "aids": {}}
    return Content(**{**of, "epoch_s": None, **changes})


class Parts(HTMLParser):
    """Collects what a page refers to and the text of its scripts."""

    def __init__(self) -> None:
        super().__init__()
        self.references: list[str] = []
        self.scripts: list[str] = []
        self._inside = False

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:  # noqa: D102
        self.references += [value or "" for name, value in attrs if name in ("src", "href")]
        self._inside = tag == "script"
        if self._inside:
            self.scripts.append("")

    def handle_data(self, data: str) -> None:  # noqa: D102
        if self._inside:
            self.scripts[-1] += data


def parts_of(page: str) -> Parts:
    """Return the parts of a page."""
    parser = Parts()
    parser.feed(page)
    return parser


def values(trace: Mapping[str, Any], axis: str) -> np.ndarray[Any, Any]:
    """Return a trace's numbers as the browser reads them."""
    return np.frombuffer(base64.b64decode(trace[axis]["bdata"]), trace[axis]["dtype"])


def test_the_page_holds_all_that_it_shows() -> None:
    """No reference leads out of it; words of the mission end no script and make no tag."""
    page = page_of(content(), footer="made by a test")
    parts = parts_of(page)
    assert all(reference.startswith("#") for reference in parts.references)
    assert len(parts.scripts) == 3
    charts = json.loads(parts.scripts[0])
    assert list(charts)[:3] == ["track", "height", "sigma"]
    assert "lake &lt;3&gt;: navigation report" in page
    assert "<b>" not in page.partition('<script id="charts"')[0]
    assert set(re.findall(r'href="#([\w-]+)"', page)) <= set(re.findall(r'id="([\w-]+)"', page))


def test_the_verdict_comes_first_and_in_words() -> None:
    """Status, sign, meaning and reason; the numbers are those of the tables."""
    text = verdict(content())
    assert text.index("SUSPECT") < text.index("Look first") < text.index("GNSS, 100-160 s")
    assert "40 of 2400 (1.7 %)" in text
    assert f"{1.96 * np.hypot(0.799, 0.799):.2f} m" in text
    told = dict(sections(content()))
    assert "1.7 to 2.6" in told["Sensors that were off"]
    assert "<td>5 to 6</td><td>40 of 240</td><td>2</td>" in told["Beams"]
    assert "Data quality" not in told
    rows = [("IMU", "60", "100", "0.10", "1", "3.0", "9.8 m/s²; 1 gap from 1060.0 s on")]
    quality = dict(sections(content(data=rows)))["Data quality"]
    assert "<td>3.0</td></tr>" in quality
    assert "<li>IMU: 9.8 m/s²; 1 gap from 1060.0 s (1.0 min) on</li>" in quality
    survey = told["Position uncertainty for surveys"]
    # 1 m over 1.96 and the root of 2 is a sigma of 0.3608 m, which 161 of 600 rows stay below.
    assert "<td>Exclusive</td><td>1</td><td>26.8</td>" in survey
    assert "<td>0.0 to 10.0</td></tr><tr><td>Special" in survey  # its height never meets it


def test_charts_show_the_tables() -> None:
    """Curves are the columns, in minutes since the first row, and break where north is passed."""
    rows, of = content().trajectory, np.arange(3.0 * N).reshape(N, 3)
    no_height = of * [1.0, 1.0, np.nan]
    errors = ErrorSeries(rows["time_s"], no_height, of, of, of, of, of, of, of[:, 0])
    further: dict[str, Any] = {"altitude": (rows["time_s"][5:], of[5:, 0]), "errors": errors}
    charts = {chart.name: chart for chart in charts_of(content(**further))}
    np.testing.assert_allclose(values(charts["altitude"].traces[0], "y"), of[5:, 0])
    north, above, below = charts["errors"].traces[3:]  # the reference has no heights
    np.testing.assert_allclose(values(north, "y"), of[:, 1])
    np.testing.assert_allclose(values(above, "y"), 3.0 * np.sqrt(2.0) * of[:, 1], rtol=1e-6)
    np.testing.assert_array_equal(values(below, "y"), -values(above, "y"))
    crosses = [t for t in charts["weights"].traces if t["marker"]["symbol"] == "x"]
    assert [len(values(trace, "x")) for trace in crosses] == [0, 40, 0, 0]
    height = charts["height"].traces[-1]
    np.testing.assert_allclose(values(height, "x"), np.arange(N) / 60.0, rtol=1e-6)
    np.testing.assert_allclose(values(height, "y"), content().trajectory["height_m"], rtol=1e-6)
    heading = values(charts["heading"].traces[0], "y")
    assert np.isnan(heading).sum() == 4
    assert [trace["name"] for trace in charts["track"].traces].count("suspect") == 1
    for chart in charts.values():
        json.dumps([chart.traces, chart.layout], allow_nan=False)
        assert chart.layout["yaxis"]["title"]["text"]
        assert not chart.is_time or chart.layout["xaxis"]["range"] == [0.0, 599.0 / 60.0]


def test_autocorrelation_is_what_it_says() -> None:
    """Of a sine it is a cosine; of a constant nothing."""
    t = np.arange(5000.0)
    found = autocorrelation(np.sin(0.3 * t))
    np.testing.assert_allclose(found, np.cos(0.3 * np.arange(1, MOST_LAGS + 1)), atol=0.01)
    assert not autocorrelation(np.full(50, 3.0)).any()


def test_a_long_mission_keeps_its_spikes() -> None:
    """Of four hours at 1 Hz the one bad row is drawn, and the gaps."""
    k = np.arange(14400.0)
    values_of = np.where(k == 7777.0, 5.0, np.sin(k / 500.0))
    drawn = line(np.where(k > 9000.0, k + 60.0, k), values_of, "", "black")
    y = values(drawn, "y")
    assert len(y) <= 5003
    assert np.nanmax(y) == 5.0
    assert np.isnan(y).sum() == 1
    assert values(drawn, "x")[[0, -1]].tolist() == [0.0, 14459.0]


PROBE = """
<script>
window.addEventListener("load", async () => {
  const told = [];
  window.addEventListener("error", (event) => told.push(event.message));
  for (const name of Object.keys(charts)) await draw(name);
  await Plotly.relayout("height", { "xaxis.range[0]": 2, "xaxis.range[1]": 3 });
  await new Promise((done) => setTimeout(done, 300));
  const range = document.getElementById("speed").layout.xaxis.range;
  Plotly.Fx.hover("height", [{ curveNumber: 1, pointNumber: 150 }]);
  const hover = document.querySelectorAll("#height .hoverlayer .hovertext").length;
  const wide = document.documentElement.scrollWidth - window.innerWidth;
  const width = () => document.querySelector("#speed .main-svg").clientWidth;
  const before = width();
  window.dispatchEvent(new Event("beforeprint"));
  const paper = width();
  window.dispatchEvent(new Event("afterprint"));
  await new Promise((done) => setTimeout(done, 300));
  const restored = width() === before;
  const drawings = document.querySelectorAll(".chart .main-svg").length > 8;
  const seen = { range, hover, wide, drawings, paper, restored, errors: told };
  document.body.setAttribute("data-probe", JSON.stringify(seen));
});
</script></body>"""


@pytest.mark.slow
@pytest.mark.skipif(BROWSER is None, reason="no chromium or chrome on this machine")
@pytest.mark.parametrize("width", [1200, 390])
def test_a_browser_draws_zooms_and_hovers(tmp_path: Path, width: int) -> None:
    """No error, linked axes, a label under the pointer, paper, and nothing wider than a phone."""
    path = tmp_path / "report.html"
    write_page(content(), path, footer="made by a test")
    path.write_text(path.read_text(encoding="utf-8").replace("</body>", PROBE), encoding="utf-8")
    assert BROWSER is not None
    options = ["--headless", "--no-sandbox", "--disable-gpu", f"--window-size={width},900"]
    options += ["--virtual-time-budget=20000", "--enable-logging=stderr", "--dump-dom"]
    done = subprocess.run(
        [BROWSER, *options, path.as_uri()], capture_output=True, text=True, timeout=120, check=True
    )
    found = re.search(r'data-probe="([^"]*)"', done.stdout)
    assert found, done.stderr[-2000:]
    seen = json.loads(found[1].replace("&quot;", '"'))
    assert seen.pop("wide") <= 0
    assert seen.pop("paper") == 690  # between the margins of A4, 703 pixels, and of letter
    drawn = {"range": [2, 3], "hover": 1, "drawings": True, "restored": True}
    assert seen == {**drawn, "errors": []}
    assert not [text for text in done.stderr.splitlines() if "CONSOLE" in text and "rror" in text]


@pytest.mark.slow
@pytest.mark.skipif(BROWSER is None, reason="no chromium or chrome on this machine")
def test_four_hours_open_in_three_seconds(tmp_path: Path) -> None:
    """Of processor time of the page, until the first charts stand."""
    long = content()
    repeated = {name: np.tile(column, 24) for name, column in long.trajectory.items()}
    beams = {name: np.tile(column, 24) for name, column in long.beams.items()}
    repeated["time_s"] = np.arange(24.0 * N)
    beams["time_s"] = np.repeat(repeated["time_s"], 4)
    path = tmp_path / "report.html"
    write_page(content(trajectory=repeated, beams=beams), path, footer="made by a test")
    with Browser(tmp_path / "profile") as browser:
        browser.measure()
        browser.open(path.as_uri())
        browser.wait_for("document.querySelectorAll('#height .main-svg').length > 0")
        assert browser.busy_s() < 3.0
        assert browser.errors == []
