"""The page's charts, as data and layout of plotly.js: what is drawn, with its units."""

from __future__ import annotations

import base64
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import Any, Final

import numpy as np

from ssm_graph.base.frozen import Array
from ssm_graph.base.progress import told
from ssm_graph.base.runs import runs_of
from ssm_graph.mission.estimate import OUTLIER_WEIGHT
from ssm_graph.report.page.content import Content
from ssm_graph.report.style import (
    EAST_NORTH_UP,
    ESTIMATE,
    GREY,
    INK,
    OUTLIER,
    broken_at_gaps,
    thinned,
    thinned_outliers_first,
    thinned_to_extremes,
)

BEAM_COLORS: Final = (*EAST_NORTH_UP, "#CC79A7", "#56B4E9", "#E69F00", "#999933", "#332288")
SUSPECT: Final = "#D55E00"
MOST_ELLIPSES: Final = 60
"""Of uncertainty on the track; more hide it."""
MOST_IN_SVG: Final = 1000
"""Markers of a beam that are drawn without WebGL, which is slow where it is not of a card."""
MOST_LAGS: Final = 20
FEW_DECADES: Final = 4
"""Up to so many an axis has room for ticks at 2 and 5 as well."""
BAND: Final = "rgba(0, 114, 178, 0.16)"


@dataclass(frozen=True, slots=True)
class Chart:
    """One chart of the page."""

    name: str
    """Short, of letters: its place in the page."""
    title: str
    note: str
    """What to see in it, one or two sentences."""
    traces: Sequence[Mapping[str, Any]]
    layout: Mapping[str, Any]
    is_time: bool = True
    """Whether its x axis is time, and goes with the others'."""
    height: int = 300
    """Pixels of the page."""


def packed(values: Array) -> dict[str, str]:
    """Return numbers as plotly.js reads them fastest: single precision, base 64."""
    data = base64.b64encode(np.ascontiguousarray(values, "<f4").tobytes())
    return {"dtype": "f4", "bdata": data.decode("ascii")}


def line(x: Array, y: Array, name: str, color: str, **further: Any) -> dict[str, Any]:
    """Return a line, broken at gaps and thinned to what a screen can show, spikes left in."""
    x, y = broken_at_gaps(x, y)
    kept = thinned_to_extremes(y)
    style = {
        "color": color,
        "width": further.pop("width", 1.6),
        "dash": further.pop("dash", "solid"),
    }
    # Not by WebGL: where a machine has none but in software, that takes longer than all else.
    trace = {"type": "scatter", "mode": "lines", "name": name}
    return {**trace, "x": packed(x[kept]), "y": packed(y[kept]), "line": style, **further}


def band(x: Array, low: Array, high: Array, name: str, color: str = BAND) -> list[dict[str, Any]]:
    """Return what lies between two curves, as an area without outline."""
    kept = thinned(len(x), 1500)
    outline = np.r_[x[kept], x[kept][::-1]], np.r_[low[kept], high[kept][::-1]]
    area = {"type": "scatter", "mode": "lines", "name": name, "fill": "toself", "fillcolor": color}
    return [
        {
            **area,
            "x": packed(outline[0]),
            "y": packed(outline[1]),
            "line": {"width": 0},
            "hoverinfo": "skip",
        }
    ]


def axes(x: str, y: str, **further: Any) -> dict[str, Any]:
    """Return a layout with titles of both axes, units among them."""
    layout: dict[str, Any] = {"xaxis": {"title": {"text": x}}, "yaxis": {"title": {"text": y}}}
    for key, value in further.items():
        layout[key] = {**layout.get(key, {}), **value} if isinstance(value, dict) else value
    return layout


MINUTES: Final = "minutes since start"


def charts_of(content: Content) -> list[Chart]:
    """Return all charts for which the result has data; axes of time show all of it at first."""
    parts = (_track, _series, _beams, _aids, _whiteness)
    charts = [chart for part in told(parts, len(parts)) for chart in part(content)]
    whole = {"range": [0.0, float(content.since_min[-1])]}
    return [
        replace(chart, layout={**chart.layout, "xaxis": {**chart.layout["xaxis"], **whole}})
        if chart.is_time
        else chart
        for chart in charts
    ]


def _track(content: Content) -> list[Chart]:
    """Return the map: local metres, equal scales, ellipses of three sigma."""
    enu, rows = content.local_enu, content.trajectory
    kept = thinned(len(enu))
    hover = [
        f"{_clock(content, t)}<br>height {h:.2f} m<br>sigma of an axis {s:.2f} m"
        for t, h, s in zip(
            rows["time_s"][kept].tolist(),
            rows["height_m"][kept].tolist(),
            content.horizontal_sigma_m[kept].tolist(),
            strict=True,
        )
    ]
    traces = [
        _ellipses(content, enu),
        {
            **line(enu[kept, 0], enu[kept, 1], "track", ESTIMATE, width=2),
            "text": hover,
            "hovertemplate": "east %{x:.2f} m, north %{y:.2f} m<br>%{text}<extra></extra>",
        },
    ]
    # Gaps in place are none of the track's: it is drawn as it is.
    traces[1] |= {"x": packed(enu[kept, 0]), "y": packed(enu[kept, 1])}
    for number, (begin, end) in enumerate(runs_of(content.is_suspect)):
        part = enu[begin:end]
        doubtful = line(part[:, 0], part[:, 1], "suspect", SUSPECT, width=4)
        doubtful |= {"x": packed(part[:, 0]), "y": packed(part[:, 1]), "showlegend": number == 0}
        traces.append(doubtful)
    for name, row, symbol in (("start", 0, "circle"), ("end", -1, "square")):
        marker = {"size": 11, "symbol": symbol, "color": INK}
        point = {"x": [float(enu[row, 0])], "y": [float(enu[row, 1])], "marker": marker}
        traces.append({"type": "scatter", "mode": "markers", "name": name, **point})
    layout = axes(
        "east of the start, m",
        "north of the start, m",
        yaxis={"scaleanchor": "x", "scaleratio": 1},
    )
    note = "Ellipses are three sigma. Where the answer is suspect the track is thick and vermilion."
    return [Chart("track", "Track", note, traces, layout, is_time=False, height=520)]


def _clock(content: Content, time_s: float) -> str:
    """Return a time for people: minutes since start, and UTC where it is known."""
    text = f"{(time_s - content.begin_s) / 60.0:.2f} min"
    if content.epoch_s is None:
        return text
    when = datetime.fromtimestamp(time_s + content.epoch_s, UTC)
    return f"{text}, {when.strftime('%H:%M:%S')} UTC"


def _ellipses(content: Content, enu: Array) -> dict[str, Any]:
    rows = thinned(len(enu), MOST_ELLIPSES)
    angle = np.linspace(0.0, 2.0 * np.pi, 25)
    sigma = np.column_stack([content.trajectory[f"sigma_{n}_m"][rows] for n in ("east", "north")])
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    rings = enu[rows, None, :2] + 3.0 * sigma[:, None, :] * circle
    broken = np.concatenate([rings, np.full((len(rows), 1, 2), np.nan)], axis=1).reshape(-1, 2)
    return {
        "type": "scatter",
        "mode": "lines",
        "name": "3 sigma",
        "x": packed(broken[:, 0]),
        "y": packed(broken[:, 1]),
        "line": {"width": 0.8, "color": "#9DB7CC"},
        "hoverinfo": "skip",
    }


def _series(content: Content) -> Iterator[Chart]:
    rows, t = content.trajectory, content.since_min
    up, sigma_up = rows["height_m"], rows["sigma_up_m"]
    traces = [
        *band(t, up - 3 * sigma_up, up + 3 * sigma_up, "3 sigma"),
        line(t, up, "height", ESTIMATE),
    ]
    yield Chart("height", "Height above the ellipsoid", "", traces, axes(MINUTES, "height, m"))
    if content.altitude is not None and np.isfinite(content.altitude[1]).any():
        time_s, altitude = content.altitude
        traces = [line(content.minutes(time_s), altitude, "altitude", ESTIMATE)]
        layout = axes(MINUTES, "altitude, m", yaxis={"rangemode": "tozero"})
        note = "Of the DVL, by the ranges of its beams; where it breaks no beam met the bottom."
        yield Chart("altitude", "Altitude over the bottom", note, traces, layout)
    traces = [
        line(t, 3.0 * rows[f"sigma_{name}_m"], f"3 sigma {name}", color)
        for name, color in zip(("east", "north", "up"), EAST_NORTH_UP, strict=True)
    ]
    note = "How well the position is known: three sigma by axis."
    if content.protection:
        of = content.protection
        level = np.where(np.isfinite(of["protection_m"]), of["protection_m"], np.nan)
        style = {"width": 2, "dash": "dash"}
        then = content.minutes(of["time_s"])
        traces.append(line(then, level, "protection level", INK, **style))
        note += " The protection level bounds the horizontal error even if one sensor lies."
    layout = axes(MINUTES, "3 sigma, m", yaxis=_scale(traces))
    yield Chart("sigma", "Uncertainty of position", note, traces, layout)
    yield from _errors(content)
    east, north = rows["vel_east_m_per_s"], rows["vel_north_m_per_s"]
    traces = [
        line(t, np.hypot(east, north), "over ground", ESTIMATE),
        line(t, rows["vel_up_m_per_s"], "upwards", EAST_NORTH_UP[2]),
    ]
    yield Chart("speed", "Speed", "", traces, axes(MINUTES, "speed, m/s"))
    traces = [
        line(t, rows["roll_deg"], "roll", EAST_NORTH_UP[0]),
        line(t, rows["pitch_deg"], "pitch", EAST_NORTH_UP[1]),
    ]
    yield Chart("attitude", "Roll and pitch", "", traces, axes(MINUTES, "angle, degrees"))
    heading = _unbroken(t, rows["heading_deg"])
    traces = [line(*heading, "heading", EAST_NORTH_UP[0])]
    layout = axes(MINUTES, "heading, degrees", yaxis={"tickvals": [0, 90, 180, 270, 360]})
    yield Chart("heading", "Heading", "", traces, layout)
    traces = [
        line(t, 3.0 * rows[f"sigma_{name}_deg"], f"3 sigma {name}", color)
        for name, color in zip(("roll", "pitch", "heading"), EAST_NORTH_UP, strict=True)
    ]
    layout = axes(MINUTES, "3 sigma, degrees", yaxis=_scale(traces))
    yield Chart("attitude-sigma", "Uncertainty of attitude", "", traces, layout)


def _errors(content: Content) -> Iterator[Chart]:
    """Return errors by axis against the reference, inside three of their sigmas or not."""
    of = content.errors
    if of is None or not np.isfinite(of.position_enu).any():
        return
    t, traces = content.minutes(of.time_s), []
    sigma = 3.0 * np.hypot(of.position_sigma_enu, of.reference_sigma_enu)
    for i, (name, color) in enumerate(zip(("east", "north", "up"), EAST_NORTH_UP, strict=True)):
        if not np.isfinite(of.position_enu[:, i]).any():
            continue  # the reference says nothing of it
        bound = {"width": 0.8, "dash": "dot", "legendgroup": name, "hoverinfo": "skip"}
        traces.append(line(t, of.position_enu[:, i], name, color, legendgroup=name))
        for sign in (1.0, -1.0):
            traces.append(line(t, sign * sigma[:, i], "", color, showlegend=False, **bound))
    note = "Estimate minus reference; dotted are three sigma of both. Click a name to hide it."
    layout = axes(MINUTES, "error, m")
    yield Chart("errors", "Errors against the reference", note, traces, layout)


def _scale(traces: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return an axis for sigmas: of decades where they differ by more than two."""
    low, high = _reach(traces)
    if high <= 100.0 * low:
        return {"rangemode": "tozero"}
    ends = math.floor(math.log10(low)), math.ceil(math.log10(high))
    steps = (1.0, 2.0, 5.0) if ends[1] - ends[0] <= FEW_DECADES else (1.0,)
    decades = range(ends[0] - 1, ends[1] + 2)
    ticks = [step * 10.0**decade for decade in decades for step in steps]
    return {"type": "log", "tickvals": ticks, "ticktext": [f"{tick:g}" for tick in ticks]}


def _unbroken(t: Array, heading_deg: Array) -> tuple[Array, Array]:
    """Return a heading with NaN where it passes north, so that no line runs across."""
    at = np.flatnonzero(np.abs(np.diff(heading_deg)) > 180.0) + 1
    return np.insert(t, at, t[at]), np.insert(heading_deg, at, np.nan)


def _reach(traces: Sequence[Mapping[str, Any]]) -> tuple[float, float]:
    """Return the smallest and the largest of all values above zero; ones if there is none."""
    values = [np.frombuffer(base64.b64decode(tr["y"]["bdata"]), "<f4") for tr in traces]
    known = np.concatenate(values)
    known = known[np.isfinite(known) & (known > 0.0)]
    return (float(known.min()), float(known.max())) if len(known) else (1.0, 1.0)


def _beams(content: Content) -> Iterator[Chart]:
    rows = content.beams
    if len(rows["time_s"]) == 0:
        return
    t, weight, number = content.minutes(rows["time_s"]), rows["weight"], rows["beam"].astype(int)
    innovation = rows["innovation_m_per_s"]
    of_weight, of_innovation = [], []
    for beam in np.unique(number):
        mine = np.flatnonzero(number == beam)
        kept = mine[thinned_outliers_first(weight[mine], 4000)]
        is_out = weight[kept] < OUTLIER_WEIGHT
        for some, symbol, size in ((kept[~is_out], "circle", 4), (kept[is_out], "x", 7)):
            look = {"color": BEAM_COLORS[(beam - 1) % len(BEAM_COLORS)], "size": size}
            common = {
                "type": "scattergl" if len(kept) > MOST_IN_SVG else "scatter",
                "mode": "markers",
                "name": f"beam {beam}",
                "legendgroup": f"beam {beam}",
                "showlegend": symbol == "circle",
                "marker": {**look, "symbol": symbol},
                "x": packed(t[some]),
            }
            of_weight.append({**common, "y": packed(weight[some])})
            of_innovation.append({**common, "y": packed(1e3 * innovation[some])})
    note = "1 is the weight of a measurement that is as noisy as stated; a cross is left out."
    top = 1.05 * float(np.max(weight, initial=1.0))
    layout = axes(MINUTES, "weight", yaxis={"range": [-0.06, top]})
    yield Chart("weights", "Weights of the DVL's beams", note, of_weight, layout)
    note = "Measured minus what the answer expects. Crosses may be far outside: zoom out."
    limit = 1e3 * 8.0 * float(np.median(np.abs(innovation))) or 1.0
    layout = axes(MINUTES, "innovation, mm/s", yaxis={"range": [-limit, limit]})
    yield Chart("innovations", "Innovations of the DVL's beams", note, of_innovation, layout)


def _aids(content: Content) -> Iterator[Chart]:
    rows = content.aids
    if not rows:
        return
    names = np.array(rows["aid"])
    for aid in dict.fromkeys(rows["aid"]):
        mine = np.flatnonzero(names == aid)
        traces = []
        components = np.array(rows["component"])[mine]
        for i, component in enumerate(dict.fromkeys(components.tolist())):
            of = mine[components == component]
            of = of[thinned_outliers_first(rows["weight"][of], 4000)]
            color = BEAM_COLORS[i % len(BEAM_COLORS)]
            is_out = rows["weight"][of] < OUTLIER_WEIGHT
            look = {
                "size": np.where(is_out, 8, 5).tolist(),
                "symbol": np.where(is_out, "x", "circle").tolist(),
                "color": np.where(is_out, OUTLIER, color).tolist(),
            }
            x, y = content.minutes(rows["time_s"][of]), rows["innovation"][of]
            common = {"type": "scatter", "mode": "markers", "name": component, "marker": look}
            traces.append({**common, "x": packed(x), "y": packed(y)})
        unit = rows["unit"][int(mine[0])]
        note = "Measured minus what the answer expects; a cross has a weight below 0.05."
        title = f"Innovations of {aid}"
        name = "aid" + "".join(filter(str.isalnum, aid))
        yield Chart(name, title, note, traces, axes(MINUTES, f"innovation, {unit}"))


def _whiteness(content: Content) -> Iterator[Chart]:
    """Return autocorrelations of each beam's normalised innovations."""
    rows = content.beams
    traces, longest = [], 0
    for beam in np.unique(rows["beam"]).astype(int):
        mine = (rows["beam"] == beam) & (rows["weight"] >= OUTLIER_WEIGHT)
        values = np.sign(rows["innovation_m_per_s"][mine]) * np.sqrt(rows["mahalanobis_sq"][mine])
        if len(values) <= 5 * MOST_LAGS:
            continue
        longest = max(longest, len(values))
        color = BEAM_COLORS[(beam - 1) % len(BEAM_COLORS)]
        lags = np.arange(1, MOST_LAGS + 1)
        trace = line(lags.astype(float), autocorrelation(values), f"beam {beam}", color)
        traces.append({**trace, "mode": "lines+markers"})
    if not traces:
        return
    bound = 1.96 / np.sqrt(longest)
    ends = np.array([1.0, float(MOST_LAGS)])
    for sign in (1.0, -1.0):
        limit = line(ends, np.full(2, sign * bound), "95 % of white noise", GREY, dash="dash")
        traces.append({**limit, "showlegend": sign > 0, "hoverinfo": "skip"})
    note = (
        "White innovations stay between the dashed lines, 19 of 20 times. What lies above for many "
        "lags is an error that lasts: of mounting, scale, clock, or noise that is not white."
    )
    layout = axes("lag, pings", "autocorrelation", yaxis={"range": [-0.5, 1.0]})
    yield Chart("whiteness", "Whiteness", note, traces, layout, is_time=False)


def autocorrelation(values: Array) -> Array:
    """Return the autocorrelation of a series, its mean taken off, at lags 1 to `MOST_LAGS`."""
    centred = values - values.mean()
    power = float(centred @ centred) or 1.0
    lags = range(1, MOST_LAGS + 1)
    return np.array([float(centred[lag:] @ centred[:-lag]) / power for lag in lags])
