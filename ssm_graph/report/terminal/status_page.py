"""What a person on watch sees of a live run: a page on a terminal, a plain line elsewhere."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from typing import Final, Self

import numpy as np
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from ssm_graph.base.times import UNIX_FROM_S, UNIX_UNTIL_S
from ssm_graph.mission.estimate import Found
from ssm_graph.mission.navigation import Event, Health, Navigation, Severity
from ssm_graph.mission.run_status import Latency, RunStatus
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
LASTING: Final = (0.5, 1.0)
"""Low-passed innovations, in sigmas, from which on they are shown in yellow and in red."""
_NONE: Final = "–"


class StatusPage:
    """Shows one view after the other.

    ::

        with StatusPage(Console(stderr=True)) as show:
            show(status)
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

    def __exit__(self, *_: object) -> None:
        if self._is_live:
            self._live.stop()

    def __call__(self, status: RunStatus) -> None:
        """Show how it goes now; without a terminal one line every ten seconds."""
        if self._is_live:
            self._live.update(render(status), refresh=True)
        elif self._steady_s() - self._printed_s >= PLAIN_EVERY_S:
            self._printed_s = self._steady_s()
            self._console.print(plain_line(status), markup=False, highlight=False, soft_wrap=True)


def render(status: RunStatus) -> RenderableType:
    """Return the page."""
    parts: list[RenderableType] = [_headline(status)]
    if status.navigation is not None:
        parts.append(_state(status.navigation))
        parts.append(_beams(status.navigation))
        parts.append(_integrity(status.navigation))
    parts += [*_found(status.found), _latency(status.latency), _links(status)]
    parts += [_event(event) for event in status.events[-N_EVENTS:]]
    parts.append(_disk(status))
    title = f"{status.vehicle}   {_clock(status.elapsed_s)}   {status.n_messages} messages"
    return Panel(Group(*parts), title=Text(title), title_align="left")


def plain_line(status: RunStatus) -> str:
    """Return the most important in one line."""
    words = [_clock(status.elapsed_s), _health(status).name]
    navigation = status.navigation
    if navigation is None:
        words.append(status.reason)
    else:
        words += [
            f"lat {math.degrees(navigation.lat):.7f} lon {math.degrees(navigation.lon):.7f} deg",
            f"height {navigation.height:.2f} m",
            f"sigma {_horizontal(navigation):.2f} m",
            f"protected within {navigation.protection_m:.3g} m",
            f"heading {_heading(navigation):.1f} deg",
            "bottom lock" if navigation.bottom_lock else "no bottom lock",
        ]
        if navigation.health is not Health.GOOD:
            words.append(navigation.reason)
    words += [
        f"{source.name} {source.state.value} {source.rate_hz:.0f}/s" for source in status.sources
    ]
    if status.log_problem:
        words.append(status.log_problem)
    return "; ".join([*words, status.note] if status.note else words)


def weight_bar(weight: float) -> str:
    """Return a weight of 0 to 1 as a bar one character wide; a beam that is missing as a dot."""
    if not math.isfinite(weight):
        return "·"
    return BAR[max(0, min(len(BAR) - 1, math.floor(weight * len(BAR))))]


def _health(status: RunStatus) -> Health:
    return Health.ALIGNING if status.navigation is None else status.navigation.health


def _headline(status: RunStatus) -> Text:
    health = _health(status)
    text = Text.assemble((f" {health.name} ", HEALTH_STYLE[health]), " ", status.reason)
    if status.navigation is not None:
        text.append(f"   confidence {status.navigation.confidence:.2f}", "dim")
    if status.note:
        text.append(f"   {status.note}", "bold")
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
        ("east", "north", "up"), navigation.velocity_enu, navigation.velocity_sigma_enu, strict=True
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


def _integrity(navigation: Navigation) -> Text:
    """Return the protection levels, and the low-passed innovation of each sensor in its sigmas."""
    text = Text("protected")
    for name, level in (("within", navigation.protection_m), ("up", navigation.protection_up_m)):
        shown = f"{level:.3g} m" if math.isfinite(level) else _NONE
        text.append(f" {name} {shown}")
    for name, ratio in navigation.innovation_ratios.items():
        style = "green" if ratio < LASTING[0] else "yellow" if ratio < LASTING[1] else "red"
        text.append(f"  {name} ").append(f"{ratio:.2f}", style)
    return text.append("  (lasting innovations, sigmas)", "dim")


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


def _latency(latency: Latency | None) -> Text:
    if latency is None:
        return Text("latency  nothing has come yet", "dim")
    median, p99, largest = (1e3 * t for t in (latency.median_s, latency.p99_s, latency.max_s))
    return Text(f"latency  median {median:.1f} ms, 99 % {p99:.1f} ms, max {largest:.1f} ms")


def _links(status: RunStatus) -> Table:
    table = Table(box=None, padding=(0, 1, 0, 0), pad_edge=False, header_style="dim")
    for name, width in (("source", 8), ("state", 11)):
        table.add_column(name, no_wrap=True, min_width=width)
    for name, width in (("per s", 6), ("messages", 8), ("refused", 7), ("again", 5), ("last", 6)):
        table.add_column(name, justify="right", no_wrap=True, min_width=width)
    table.add_column("address", no_wrap=True, overflow="ellipsis")
    for row in status.sources:
        names = (Text(row.name), Text(row.state.value))
        came = (f"{row.rate_hz:.1f}", f"{row.n_messages}", _refused(row.n_refused + row.n_limited))
        last = (f"{row.n_reconnects}", _age(row.age_s), Text(row.address))
        table.add_row(*names, *came, *last)
    for out in status.outputs:
        names = (Text(f"→ {out.name}"), Text(f"{out.n_clients} listening"))
        sent = ("", f"{out.n_sent}", _refused(out.n_dropped))
        table.add_row(*names, *sent, "", "", Text(out.address))
    return table


def _refused(n: int) -> Text:
    return Text(f"{n}", "yellow" if n else "")


def _event(event: Event) -> Text:
    when = f"{event.time_s:.1f} s"
    if UNIX_FROM_S <= event.time_s <= UNIX_UNTIL_S:
        when = time.strftime("%H:%M:%S", time.gmtime(event.time_s))
    style = SEVERITY_STYLE[event.severity]
    return Text(f"{when}  {event.text}", style, no_wrap=True, overflow="ellipsis")


def _disk(status: RunStatus) -> Text:
    text = Text(f"{status.folder}   ", "dim")
    if status.log_problem:
        return text.append(status.log_problem, "bold red")
    return text.append(f"log as it comes; checkpoint {_ago(status.checkpoint_age_s)}")


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
