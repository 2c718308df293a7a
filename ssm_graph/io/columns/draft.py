"""A draft of ``map.toml`` for a table of anyone, by the names of its columns and their sizes."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.errors import DataError
from ssm_graph.base.times import GPS_EPOCH_S, UNIX_FROM_S, UNIX_UNTIL_S, WEEK_S, gps_ahead_s
from ssm_graph.io.columns.sources import Source
from ssm_graph.sensors.imu import FASTEST_TURN, FORCE_UNITS

_TIME: Final = re.compile(r"(^|_)(time|timestamp|stamp|t|utc|epoch|datetime|date_time)($|_)")
_DATE: Final = re.compile(r"(^|_)(date|when|day_time)($|_)")
"""Times where the cells are no numbers."""
_SECONDS: Final = re.compile(r"(?:^|.*_)(?:secs?|seconds)")
_NANOSECONDS: Final = re.compile(r"(?:^|.*_)(?:nsecs?|nanosecs?|nanoseconds|ns)")
_WEEK: Final = re.compile(r"(?:^|.*_)(?:week|wn|wno|gps_?week)(?:_?(?:number|no))?")
_OF_WEEK: Final = re.compile(
    r"(?:^|.*_)(?:i?tow|sow|seconds_of_week|time_of_week|gps_?tow|ms)(_.*)?"
)
_AXES: Final = "xyz"
_ANY: Final = r"(?:^|.*_)"
_VECTORS: Final = {
    "gyro": rf"{_ANY}(?:gyro|gyr|gyroscope|g|w|omega|rate|angular_velocity|ang_vel|angvel|angrate)",
    "accel": rf"{_ANY}(?:accel|acc|accelerometer|a|f|force|linear_acceleration|lin_acc)",
    "mag": rf"{_ANY}(?:mag|magnetometer|magnetic|m)",
    "velocity": rf"{_ANY}(?:vel|velocity|v|bt_vel|dvl)",
}
_BEAM: Final = re.compile(
    r"(?:^|.*_)(?:b|v|beam|bm|vel_beam|beam_vel|transducers?|vel)_?(\d)(?:_.*)?"
)
_NO_SPEED: Final = re.compile(
    r"valid|good|credit|status|flag|_id$|rssi|_nsd|corr|(^|_)amp|noise|sigma|fom|dist|range|alt|time"
)
"""Numbers of a beam that are none of its speed."""
_OFF_WATER: Final = re.compile(r"water|(?:^|_)wt(?:_|$)")
_RANGE: Final = re.compile(
    r"(?:^|.*_)(?:r|range|rng|dist|distance|alt|altitude)_?(?:beam_?)?(\d).*"
    r"|(?:^|.*_)(?:b|beam|bm|transducers?)_?(\d)_(?:r|range|rng|dist|distance|alt|altitude)(?:_.*)?"
)
_SCALARS: Final = {
    "depth": r"(^|_)depth($|_)",
    "pressure": r"(^|_)press(ure)?($|_)",
    "lat": r"(^|_)lat(itude)?($|_)",
    "lon": r"(^|_)(lon|lng|longitude)($|_)",
    "height": r"(^|_)(height|altitude|alt|hgt|hmsl|h)($|_)",
    "heading": r"(^|_)(heading|hdg|compass)($|_)",
}
_NAMED_UNITS: Final = (
    (r"deg(?:rees?)?(?:_per_|/|p)?s(?:ec)?$|dps$|°/s", "deg/s"),
    (r"rad(?:ians?)?(?:_per_|/|p)?s(?:ec)?$", "rad/s"),
    (r"m(?:_per_|/|p)?s2$|mps2$|m/s\^2|ms-2$", "m/s^2"),
    (r"mm(?:_per_|/|p)s$", "mm/s"),
    (r"cm(?:_per_|/|p)s$", "cm/s"),
    (r"m(?:_per_|/|p)s$", "m/s"),
    (r"(?:^|_)(m?bar|dbar|h?k?pa|psi)$", "{0}"),
    (r"(?:^|_)(ns|us|ms|s|mm|cm|m|ft|deg|rad|g|mg|ut|nt)$", "{0}"),
    (r"(?:^|_)(?:sec|seconds)$", "s"),
)
_UNITS_AS_PINT: Final = {"pa": "Pa", "hpa": "hPa", "kpa": "kPa", "ut": "uT", "nt": "nT"}
_TIME_UNITS: Final = (("s", 1.0), ("ms", 1e3), ("us", 1e6), ("ns", 1e9))
_FAR: Final = 3.0
"""Times the largest other number."""
_RATES_HZ: Final = (0.05, 5000.0)


_MOST_NAMED: Final = 20
"""Columns that a remark names."""
_SECTIONS: Final = ("imu", "dvl", "depth", "gnss", "heading")


class Guess(NamedTuple):
    """One line of the map, and why."""

    key: str
    columns: tuple[str, ...]
    unit: str
    why: str
    axes: str = ""
    missing: float | None = None
    """A code that stands for no reading."""
    units: tuple[str, ...] = ()
    """Of each column, where they are added up."""
    offset_s: float = 0.0


class Drafted(NamedTuple):
    """A draft, and what a person has to look at."""

    text: str
    found: tuple[str, ...]
    """Sections."""


def draft_map(*sources: Source) -> Drafted:
    """Return a ``map.toml`` for files of columns; of a section, the first file that has it counts.

    Raises :class:`DataError` where readings of a file have no column that is a time.
    """
    found: dict[str, tuple[Source, list[Guess]]] = {}
    for source in sources:
        for name, guesses in guess_sections(source).items():
            found.setdefault(name, (source, guesses))
    if not found:
        for source in sources:
            guess_time(source)  # which says what is missing
    labels = ", ".join(source.label for source in sources)
    lines = [
        f"# Drafted of {labels} by the names of columns and the sizes of their numbers:",
        "# look at every line. ssm-graph template writes a map with all keys explained.",
        "format = 1",
        'vehicle = "vehicle.toml"',
    ]
    for name in _SECTIONS:
        if name in found:
            source, guesses = found[name]
            lines += ["", f"[{name}]", f"file = {_quoted(source.label)}", *_lines(guesses)]
        elif name in ("imu", "dvl"):
            lines += ["", f"# [{name}]: no columns of it here, and a mission needs it"]
        if name == "gnss" and name in found:
            if "height" not in {guess.key for guess in found[name][1]}:
                lines.append("height = { value = 0.0 }                  # no column of it")
            lines.append('sigma = { values = [2.0, 2.0, 4.0], unit = "m" }   # assumed')
    lines += ["", *_left_over(sources, found)]
    return Drafted(
        "\n".join(lines).rstrip() + "\n", tuple(name for name in _SECTIONS if name in found)
    )


def _left_over(
    sources: tuple[Source, ...], found: dict[str, tuple[Source, list[Guess]]]
) -> Iterator[str]:
    """Yield remarks on columns that no section has."""
    for source in sources:
        used = {
            name
            for of, guesses in found.values()
            if of is source
            for guess in guesses
            for name in guess.columns
        }
        left = [name for name in source.columns if name not in used]
        if left:
            more = ", ..." if len(left) > _MOST_NAMED else ""
            yield f"# not drafted, of {source.label}: {', '.join(left[:_MOST_NAMED])}{more}"


def guess_sections(source: Source) -> dict[str, list[Guess]]:
    """Return what a file may hold by section, of each its time first."""
    plain = {_plain(name): name for name in source.columns}
    place = _scalars(source, plain, ("lat", "lon", "height"))
    found = {
        "imu": _imu(source, plain),
        "dvl": _dvl(source, plain),
        "depth": _scalars(source, plain, ("depth",)) or _scalars(source, plain, ("pressure",)),
        "gnss": place if {"lat", "lon"} <= {guess.key for guess in place} else [],
        "heading": _scalars(source, plain, ("heading",)),
    }
    found = {name: guesses for name, guesses in found.items() if guesses}
    time = [guess_time(source)] if found else []
    return {name: [*time, *guesses] for name, guesses in found.items()}


def _lines(guesses: list[Guess]) -> Iterator[str]:
    for guess in guesses:
        names = [_quoted(name) for name in guess.columns]
        which = f"column = {names[0]}" if len(names) == 1 else f"columns = [{', '.join(names)}]"
        unit = f", unit = {_quoted(guess.unit)}" if guess.unit else ""
        if guess.units:
            unit = f", units = [{', '.join(map(_quoted, guess.units))}]"
        if guess.offset_s:
            unit += f", offset_s = {guess.offset_s:.0f}"
        axes = f", axes = {_quoted(guess.axes)}" if guess.axes else ""
        code = "" if guess.missing is None else f", missing = {guess.missing:g}"
        yield f"{guess.key} = {{ {which}{unit}{axes}{code} }}  # {guess.why}"


def _quoted(text: str) -> str:
    escaped = text.replace("\\", "\\\\").replace('"', '\\"')
    return f'"{escaped}"'


def _plain(name: str) -> str:
    """Return a name in small letters with single underscores, ``Gyro X (deg/s)`` to a pattern."""
    spaced = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name)
    return re.sub(r"[\s\[\](){}.:,-]+|/(?=[a-z]{2,})", "_", spaced).strip("_").lower()


def _numbers(source: Source, name: str) -> NDArray[np.float64]:
    try:
        values = source.numbers(name, "draft")
    except DataError:
        return np.zeros(0)
    return values[np.isfinite(values)]


def guess_time(source: Source) -> Guess:
    """Return the column of the times and its unit; raise :class:`DataError` where there is none."""
    plain = {_plain(name): name for name in source.columns}
    added_up = _added_times(source, plain), _of_dates(source, plain), *_of_gps_week(source, plain)
    for added in added_up:
        if added is not None:
            return added
    for short, name in plain.items():
        values = _numbers(source, name)
        if not _TIME.search(short) and not (_DATE.search(short) and not len(values)):
            continue
        if not len(values):
            return Guess("time", (name,), "iso", "dates, UTC where they have no zone")
        named = _named_unit(short)
        if named in dict(_TIME_UNITS):
            return Guess("time", (name,), named, "by its name")
        for unit, size in _TIME_UNITS:
            if UNIX_FROM_S < np.median(values) / size < UNIX_UNTIL_S:
                return Guess("time", (name,), unit, "Unix time by its size")
        step = float(np.median(np.diff(np.unique(values)))) if len(values) > 1 else 1.0
        fits = [u for u, size in _TIME_UNITS if _RATES_HZ[0] <= size / step <= _RATES_HZ[1]]
        unit = "s" if "s" in fits and step < 10.0 else (fits or ["s"])[0]
        return Guess("time", (name,), unit, f"rows are {step:.6g} apart")
    raise DataError(
        f"{source.label}: no column whose name says that it is a time among "
        f"{', '.join(list(source.columns)[:12])}; name it in a map of your own "
        "(ssm-graph template)"
    )


def _added_times(source: Source, plain: dict[str, str]) -> Guess | None:
    """Return seconds and nanoseconds in columns of their own, as ROS has them."""
    whole, parts = (
        [name for short, name in plain.items() if pattern.fullmatch(short)]
        for pattern in (_SECONDS, _NANOSECONDS)
    )
    if len(whole) != 1 or len(parts) != 1:
        return None
    below = _numbers(source, parts[0])
    if not len(below) or below.min() < 0.0 or below.max() >= 1e9:
        return None
    return Guess("time", (whole[0], parts[0]), "", "added up", units=("s", "ns"))


def _of_dates(source: Source, plain: dict[str, str]) -> Guess | None:
    """Return dates and times of the day in columns of their own."""
    texts = [(short, name) for short, name in plain.items() if not len(_numbers(source, name))]
    dates = [name for short, name in texts if _DATE.search(short) and not _TIME.search(short)]
    hours = [name for short, name in texts if _TIME.search(short) and not _DATE.search(short)]
    if len(dates) != 1 or len(hours) != 1:
        return None
    return Guess("time", (dates[0], hours[0]), "", "dates are UTC", units=("iso", "iso"))


def _of_gps_week(source: Source, plain: dict[str, str]) -> Iterator[Guess]:
    """Yield GPS weeks and the time of the week, in seconds or milliseconds, to Unix time."""
    for short, week in plain.items():
        weeks = _numbers(source, week) if _WEEK.fullmatch(short) else np.zeros(0)
        if not len(weeks) or not (weeks % 1.0 == 0.0).all() or np.ptp(weeks) > 1.0:
            continue
        for other, name in plain.items():
            within = _numbers(source, name) if _OF_WEEK.fullmatch(other) else np.zeros(0)
            if name != week and len(within) == len(weeks):
                unit = "ms" if within.max() > WEEK_S else "s"
                begin_s = GPS_EPOCH_S + WEEK_S * float(weeks.max())
                offset_s = GPS_EPOCH_S - float(gps_ahead_s(begin_s))
                why = "of the GPS week, to UTC"
                yield Guess("time", (week, name), "", why, units=("week", unit), offset_s=offset_s)


def _named_unit(short: str) -> str:
    for pattern, unit in _NAMED_UNITS:
        found = re.search(pattern, short)
        if found:
            word = unit.format(*found.groups())
            return _UNITS_AS_PINT.get(word, word)
    return ""


def _triple(plain: dict[str, str], key: str) -> tuple[str, ...]:
    """Return the columns of x, y, z of a vector; () where they are not all there."""
    for middle in ("_?{}(?:_.*)?", r"_?{}"):
        found = []
        for axis in _AXES:
            pattern = re.compile(_VECTORS[key] + middle.format(axis))
            found.append([name for short, name in plain.items() if pattern.fullmatch(short)])
        if all(len(names) == 1 for names in found):
            return tuple(names[0] for names in found)
    by_index = [f"{key}[{i}]" for i in range(3)]
    for stem in plain.values():
        base = stem.removesuffix("[0]")
        if stem.endswith("[0]") and re.fullmatch(_VECTORS[key], _plain(base.split("/")[-1])):
            by_index = [f"{base}[{i}]" for i in range(3)]
            return tuple(by_index) if all(n in plain.values() for n in by_index) else ()
    return ()


def _imu(source: Source, plain: dict[str, str]) -> list[Guess]:
    gyro, accel = (_vector(source, plain, key) for key in ("gyro", "accel"))
    if gyro is not None and accel is not None:
        gyro = gyro._replace(axes=accel.axes)
    return [guess for guess in (gyro, accel) if guess is not None]


def _vector(source: Source, plain: dict[str, str], key: str) -> Guess | None:
    names = _triple(plain, key)
    if not names:
        return None
    short = next(short for short, name in plain.items() if name == names[0])
    named = _named_unit(short)
    columns = [_numbers(source, name) for name in names]
    if len({len(values) for values in columns}) != 1 or not len(columns[0]):
        return None
    values = np.column_stack(columns)
    length = np.linalg.norm(values, axis=1)
    if key == "accel":
        return _accel(names, named, values, float(np.median(length)))
    if key == "gyro":
        top = float(np.percentile(length, 99.0))
        unit = "deg/s" if top > FASTEST_TURN else "rad/s"
        unit = "deg/h" if top > np.degrees(FASTEST_TURN) else unit
        why = f"99 % of the rates are below {top:.3g}"
        if named in ("deg/s", "rad/s"):
            return Guess(key, names, named, "unit by the name; axes as those of accel")
        doubt = "" if top > FASTEST_TURN else ": could be a slow vehicle in deg/s"
        return Guess(key, names, unit, f"{why}{doubt}; axes as those of accel")
    return Guess(key, names, named or "m/s", "unit by the name" if named else "unit assumed")


def _accel(names: tuple[str, ...], named: str, values: NDArray[np.float64], size: float) -> Guess:
    units = {u: g for g, u, _ in FORCE_UNITS} | {"m/s^2": 9.81}
    by_size = next((u for u, g in units.items() if abs(size / g - 1.0) < 0.06), "")
    unit = named or by_size or "m/s^2"
    mean = values.mean(axis=0)
    along = int(np.argmax(np.abs(mean)))
    axes = ("FRD" if mean[along] < 0.0 else "FLU") if along == 2 else ""
    why = f"median length {size:.4g}"
    if named and by_size and named != by_size:
        why += f", which looks like {by_size}"
    why += (
        f"; gravity along {_AXES[along]} with {'minus' if mean[along] < 0 else 'plus'}"
        f"{': is it mounted so? then list the columns as forward, right, down' if not axes else ''}"
    )
    return Guess("accel", names, unit, why, axes)


def _dvl(source: Source, plain: dict[str, str]) -> list[Guess]:
    speeds = {short: name for short, name in plain.items() if not _NO_SPEED.search(short)}
    ground = {short: name for short, name in speeds.items() if not _OFF_WATER.search(short)}
    beams = _numbered(ground, _BEAM) or _numbered(speeds, _BEAM)
    if len(beams) >= 3:
        short = next(short for short, name in plain.items() if name == beams[0])
        named = _named_unit(short)
        values = np.concatenate([_numbers(source, name) for name in beams])
        code = _code(values)
        values = values[values != code] if code is not None else values
        top = float(np.percentile(np.abs(values), 99.0)) if len(values) else 0.0
        unit = named or ("mm/s" if top > 30.0 else "m/s")
        why = f"99 % below {top:.3g}; positive along the beam? else a minus before each name"
        found = [Guess("beam", beams, unit, why, missing=code)]
        ranges = _numbered(plain, _RANGE)
        if len(ranges) == len(beams):
            found.append(
                Guess("range", ranges, _named_unit(_plain(ranges[0])) or "m", "along beams")
            )
        return found
    velocity = _vector(source, plain, "velocity")
    return [] if velocity is None else [velocity]


def _code(values: NDArray[np.float64]) -> float | None:
    """Return the number that lies far beyond all others and comes again and again, or None."""
    if not len(values):
        return None
    extreme = float(values[np.argmax(np.abs(values))])
    others = np.abs(values[values != extreme])
    is_far = len(others) > 0 and abs(extreme) > _FAR * float(np.max(others))
    return extreme if is_far and np.sum(values == extreme) > 1 else None


def _numbered(plain: dict[str, str], pattern: re.Pattern[str]) -> tuple[str, ...]:
    """Return columns whose names differ by a number alone that counts from 0 or 1."""
    alike: dict[tuple[str, str], dict[int, str]] = {}
    for short, name in plain.items():
        found = pattern.fullmatch(short)
        if found:
            digit = found.lastindex or 0
            ends = short[: found.start(digit)], short[found.end(digit) :]
            alike.setdefault(ends, {})[int(found[digit])] = name
    for of in alike.values():
        first = min(of)
        if first < 2 and len(of) > 1 and sorted(of) == list(range(first, first + len(of))):
            return tuple(of[number] for number in sorted(of))
    return ()


def _scalars(source: Source, plain: dict[str, str], keys: tuple[str, ...]) -> list[Guess]:
    found = []
    for key in keys:
        for short, name in plain.items():
            values = _numbers(source, name)
            if re.search(_SCALARS[key], short) and len(np.unique(values)) > 1:
                found.append(_scalar(key, name, _named_unit(short), values))
                break
    return found


def _scalar(key: str, name: str, named: str, values: NDArray[np.float64]) -> Guess:
    top, doubt = float(np.max(np.abs(values))), ""
    if key in ("lat", "lon"):
        unit = named if named in ("deg", "rad") else "1e-7 deg" if top > 1e5 else "deg"
        doubt = ": could be radians" if not named and top <= np.pi else ""
    elif key == "pressure":
        unit = named or ("Pa" if top > 5e4 else "mbar" if top > 500.0 else "bar")
    elif key == "heading":
        unit = named or ("deg" if top > 6.3 else "rad")
    else:
        unit = named or "m"
    return Guess(key, (name,), unit, f"{values.min():.6g} to {values.max():.6g}{doubt}")
