"""Reports of a Water Linked DVL that were written as a table: one a row, one column a number.

The columns are the keys of a report, those of its transducers as ``transducers_0_velocity``, and
``timestamp``, Unix seconds, when it came.
"""

from __future__ import annotations

import csv
import json
import math
import re
from collections.abc import Iterator
from typing import Any, Final, NamedTuple

SIGN: Final = b"transducers_0_velocity"
"""The header of such a table has it."""
_TRANSDUCER: Final = re.compile(r"transducers_(\d)_(\w{1,40})")
_WORDS: Final = {"true": True, "false": False}


class Row(NamedTuple):
    """One report as the instrument sent it, and when it came, s; NaN where that is not known."""

    report: bytes
    arrival_s: float


def rows_of(data: bytes) -> Iterator[Row]:
    """Yield the rows of a table as JSON; cells that are neither number nor truth value are texts.

    Raises :class:`csv.Error` for what is no table.
    """
    lines = data.decode("utf-8", errors="replace").splitlines()
    for cells in csv.DictReader(lines, restkey="more", restval=""):
        report: dict[str, Any] = {}
        beams: dict[str, dict[str, Any]] = {}
        for name, cell in cells.items():
            value = _value(cell)
            found = _TRANSDUCER.fullmatch(name)
            if value == "":
                continue
            if found:
                beams.setdefault(found[1], {})[found[2]] = value
            else:
                report[name] = value
        stamp = report.pop("timestamp", math.nan)
        arrival_s = float(stamp) if type(stamp) in (int, float) else math.nan
        if beams:
            report["transducers"] = [*beams.values()]
        yield Row(json.dumps(report).encode() + b"\n", arrival_s)


def _value(cell: Any) -> Any:
    """Return a cell as JSON would have it."""
    text = str(cell).strip()
    if text.lower() in _WORDS:
        return _WORDS[text.lower()]
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text
