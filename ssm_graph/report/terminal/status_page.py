"""What a person on watch sees of a live run: a page on a terminal, a plain line elsewhere."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from types import TracebackType
from typing import Final, Self

import numpy as np
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from ssm_graph.mission.estimate import Found
from ssm_graph.mission.navigation import Event, Health, Navigation, Severity
from ssm_graph.report.mission.summary import DETERMINED_STYLE

PLAIN_EVERY_S: Final = 10.0
HEALTH_STYLE: Final = {
    Health.GOOD: "bold green",
    Health.DEGRADED: "bold yellow",
    Health.BAD: "bold white on red",
    Health.ALIGNING: "bold cyan",
}
SEVERITY_STYLE: Final = {
    Severity.INFO: "dim",
    Severity.WARNING: "yellow",
    Severity.ERROR: "bold red",
}
BAR: Final = "▁▂▃▄▅▆▇█"
N_EVENTS: Final = 5
_NONE: Final = "–"
_FIRST_UNIX_S: Final = 1e9
"""Later times are Unix time, shown as time of day."""


@dataclass(frozen=True, slots=True)
class SourceRow:
    """One source, or one output."""

    name: str
    address: str
    state: str
    rate_hz: float = math.nan
    """Messages passed on; NaN where it is not known."""
    n_messages: int = 0
    n_refused: int = 0
    """Damaged, not understood, or too many."""
    n_reconnects: int = 0
    age_s: float = math.inf
    """Since the last message."""


@dataclass(frozen=True, slots=True)
class StatusView:
    """Everything on the page."""

    vehicle: str
    folder: str
    elapsed_s: float
    n_messages: int
    navigation: Navigation | None
    reason: str
    latency_s: tuple[float, float, float] | None = None
    """Median, 99th percentile and largest, from arrival to answer."""
    sources: tuple[SourceRow, ...] = ()
    outputs: tuple[SourceRow, ...] = ()
    events: tuple[Event, ...] = ()
    """Newest last."""
    log_problem: str | None = None
    checkpoint_age_s: float = math.inf
    found: Found = Found()
    """What is known beside the state of the vehicle."""
    note: str = ""


class StatusPage:
    """Shows one view after the other.

    ::

        with StatusPage(Console(stderr=True)) as show:
            show(view)
    """

    def __init__(self, console: Console, *, steady_s: Callable[[], float] = time.monotonic) -> None:
        self._console, self._steady_s = console, steady_s
        self._printed_s = -math.inf
        self._is_live = console.is_terminal and not console.is_dumb_terminal
        self._live = Live(console=console, auto_refresh=False, transient=False)

    def __enter__(self) -> Self:
        if self._is_live:
            self._live.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if self._is_live:
            self._live.stop()

    def __call__(self, view: StatusView) -> None:
        """Show how it goes now; without a terminal one line every ten seconds."""
        if self._is_live:
            self._live.update(render(view), refresh=True)
        elif self._steady_s() - self._printed_s >= PLAIN_EVERY_S:
            self._printed_s = self._steady_s()
            self._console.print(plain_line(view), markup=False, highlight=False, soft_wrap=True)


def render(view: StatusView) -> RenderableType:
    """Return the page."""
    parts: list[RenderableType] = [_headline(view)]
    if view.navigation is not None:
        parts.append(_state(view.navigation))
        parts.append(_beams(view.navigation))
    parts += [*_found(view.found), _latency(view), _links(view)]
    parts += [_event(event) for event in view.events[-N_EVENTS:]]
    parts.append(_disk(view))
    title = f"{view.vehicle}   {_clock(view.elapsed_s)}   {view.n_messages} messages"
    return Panel(Group(*parts), title=Text(title), title_align="left")


def plain_line(view: StatusView) -> str:
    """Return the most important in one line."""
    words = [_clock(view.elapsed_s), _health(view).name]
    navigation = view.navigation
    if navigation is None:
        words.append(view.reason)
    else:
        words += [
            f"lat {math.degrees(navigation.lat):.7f} lon {math.degrees(navigation.lon):.7f} deg",
            f"height {navigation.height:.2f} m",
            f"sigma {_horizontal(navigation):.2f} m",
            f"heading {_heading(navigation):.1f} deg",
            "bottom lock" if navigation.bottom_lock else "no bottom lock",
        ]
        if navigation.health is not Health.GOOD:
            words.append(navigation.reason)
    words += [f"{source.name} {source.state} {source.rate_hz:.0f}/s" for source in view.sources]
    if view.log_problem:
        words.append(view.log_problem)
    return "; ".join([*words, view.note] if view.note else words)


def weight_bar(weight: float) -> str:
    """Return a weight of 0 to 1 as a bar one character wide; a beam that is missing as a dot."""
    if not math.isfinite(weight):
        return "·"
    return BAR[max(0, min(len(BAR) - 1, math.floor(weight * len(BAR))))]


def _health(view: StatusView) -> Health:
    return Health.ALIGNING if view.navigation is None else view.navigation.health


def _headline(view: StatusView) -> Text:
    health = _health(view)
    text = Text.assemble((f" {health.name} ", HEALTH_STYLE[health]), " ", view.reason)
    if view.navigation is not None:
        text.append(f"   confidence {view.navigation.confidence:.2f}", "dim")
    if view.note:
        text.append(f"   {view.note}", "bold")
    return text


def _state(navigation: Navigation) -> Table:
    """Return position, velocity and attitude, each with its sigma; three columns of 24."""
    table = Table.grid(padding=(0, 2))
    for _ in range(3):
        table.add_column(no_wrap=True)
    east, north, up = navigation.position_sigma_enu
    table.add_row(
        f"lat {math.degrees(navigation.lat):.7f}° ±{north:.2f} m",
        f"lon {math.degrees(navigation.lon):.7f}° ±{east:.2f} m",
        f"height {navigation.height:.2f} ±{up:.2f} m",
    )
    velocity = zip(
        ("east", "north", "up"),
        navigation.velocity_enu,
        navigation.velocity_sigma_enu,
        strict=True,
    )
    table.add_row(*(f"{n} {v:+.3f} ±{s:.3f} m/s" for n, v, s in velocity))
    angles = np.degrees(navigation.roll_pitch_heading)
    angles[2] = _heading(navigation)
    attitude = zip(
        ("roll", "pitch", "heading"), angles, np.degrees(navigation.attitude_sigma), strict=True
    )
    table.add_row(*(f"{n} {a:.2f} ±{s:.2g}°" for n, a, s in attitude))
    return table


def _beams(navigation: Navigation) -> Text:
    text = Text("beams")
    for number, weight in enumerate(navigation.beam_weights.tolist()):
        style = "green" if weight > 0.5 else "yellow" if weight > 0.05 else "red"
        shown = f"{weight:.2f}" if math.isfinite(weight) else _NONE
        text.append(f"  {number + 1}").append(weight_bar(weight), style).append(f" {shown}")
    lock = ("bottom lock", "green") if navigation.bottom_lock else ("no bottom lock", "yellow")
    since = f"last aid {_ago(navigation.since_aid_s)}"
    return text.append("  ").append(*lock).append(f"  {since}")


def _found(found: Found) -> Iterator[Text]:
    """Yield what was found of the current and of the instruments, each with its sigma."""
    if found.current is not None:
        velocity, sigma = found.current.velocity_enu[-1], found.current.sigma_enu[-1]
        parts = zip(("east", "north", "up"), velocity, sigma, strict=True)
        yield Text("  ".join(["current", *(f"{n} {v:+.2f} ±{s:.2f}" for n, v, s in parts), "m/s"]))
    if found.calibration is not None:
        text = Text("off what is stated")
        for value in found.calibration.values:
            shown = f"{value.value / value.unit:+.3g} ±{value.sigma / value.unit:.2g}"
            text.append(f"  {value.label} ").append(shown, DETERMINED_STYLE[value.determined])
        yield text


def _latency(view: StatusView) -> Text:
    if view.latency_s is None:
        return Text("latency  nothing has come yet", "dim")
    median, p99, largest = (1e3 * value for value in view.latency_s)
    return Text(f"latency  median {median:.1f} ms, 99 % {p99:.1f} ms, max {largest:.1f} ms")


def _links(view: StatusView) -> Table:
    table = Table(box=None, padding=(0, 1, 0, 0), pad_edge=False, header_style="dim")
    for name, width in (("source", 8), ("state", 11)):
        table.add_column(name, no_wrap=True, min_width=width)
    for name, width in (("per s", 6), ("messages", 8), ("refused", 7), ("again", 5), ("last", 6)):
        table.add_column(name, justify="right", no_wrap=True, min_width=width)
    table.add_column("address", no_wrap=True, overflow="ellipsis")
    for row in view.sources:
        rate = f"{row.rate_hz:.1f}" if math.isfinite(row.rate_hz) else _NONE
        _add_link(table, row, rate, f"{row.n_reconnects}", _age(row.age_s))
    for row in view.outputs:
        _add_link(table, row, "", "", "")
    return table


def _add_link(table: Table, row: SourceRow, rate: str, again: str, last: str) -> None:
    refused = Text(f"{row.n_refused}", "yellow" if row.n_refused else "")
    texts = [Text(row.name), Text(row.state)]
    table.add_row(*texts, rate, f"{row.n_messages}", refused, again, last, Text(row.address))


def _event(event: Event) -> Text:
    when = f"{event.time_s:.1f} s"
    if event.time_s > _FIRST_UNIX_S:
        when = time.strftime("%H:%M:%S", time.gmtime(event.time_s))
    style = SEVERITY_STYLE[event.severity]
    return Text(f"{when}  {event.text}", style, no_wrap=True, overflow="ellipsis")


def _disk(view: StatusView) -> Text:
    text = Text(f"{view.folder}   ", "dim")
    if view.log_problem:
        return text.append(view.log_problem, "bold red")
    return text.append(f"log as it comes; checkpoint {_ago(view.checkpoint_age_s)}")


def _horizontal(navigation: Navigation) -> float:
    return float(np.hypot(*navigation.position_sigma_enu[:2]))


def _heading(navigation: Navigation) -> float:
    return math.degrees(float(navigation.roll_pitch_heading[2])) % 360.0


def _clock(seconds: float) -> str:
    minutes, rest = divmod(int(seconds), 60)
    return f"{minutes // 60}:{minutes % 60:02d}:{rest:02d}"


def _age(seconds: float) -> str:
    if not math.isfinite(seconds):
        return "never"
    return f"{seconds:.1f} s" if seconds < 100.0 else f"{seconds / 60.0:.0f} min"


def _ago(seconds: float) -> str:
    return f"{_age(seconds)} ago" if math.isfinite(seconds) else "not yet"
