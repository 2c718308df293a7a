"""A benchmark's command line and page: what was run, on which machine, and where it goes."""

from __future__ import annotations

import argparse
import os
import platform
import shlex
import sys
from collections.abc import Iterable, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ssm_graph.base.code_version import code_version
from ssm_graph.evaluation.statistics import Interval, mean_with_interval, paired_ratio

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results"
DOCS = ROOT / "docs"


class Option(NamedTuple):
    """One option of a command line."""

    flag: str
    """``--name``, or ``name`` for an argument that has to be given"""
    default: Any
    """Its type is the option's; False or a list means a switch or several values, a type itself an
    option without a default"""
    text: str
    choices: Iterable[str] | None = None

    def add_to(self, parser: argparse.ArgumentParser) -> None:
        """Make the parser know it."""
        default = self.default
        more: dict[str, Any] = {} if self.choices is None else {"choices": [*self.choices]}
        if default is False:
            parser.add_argument(self.flag, action="store_true", help=self.text)
        elif isinstance(default, type):
            parser.add_argument(self.flag, type=default, help=self.text, **more)
        else:
            several = isinstance(default, list)
            kind, nargs = (type(default[0]), "*") if several else (type(default), None)
            settings = {"type": kind, "nargs": nargs, "default": default, **more}
            parser.add_argument(self.flag, help=self.text, **settings)


class Report:
    """A benchmark's command line and page; made before the work, for it holds the load then."""

    def __init__(self, file: str, title: str, about: str | None, *options: Option) -> None:
        """Read the command line of a module, of which ``__file__`` and ``__doc__`` are given.

        The page has the name of the module, or of the folder of a ``run.py``; all have ``--out``
        and ``--keep``.
        """
        path = Path(file).resolve().relative_to(ROOT).with_suffix("")
        module = ".".join(path.parts)
        self._title, self._name = title, path.parent.name if path.name == "run" else path.name
        parser = argparse.ArgumentParser(
            prog=f"python -m {module}",
            description=(about or "").partition("\n")[0],
            formatter_class=argparse.ArgumentDefaultsHelpFormatter,
        )
        for option in options:
            option.add_to(parser)
        Option("--out", Path("out") / self._name, "folder of the page").add_to(parser)
        Option("--keep", False, "write to benchmarks/results, figures to docs, too").add_to(parser)
        self.args = parser.parse_args()
        self._command = shlex.join(["python", "-m", module, *sys.argv[1:]])
        self._load = os.getloadavg()[0]

    def places(self, kept: Path = RESULTS) -> list[Path]:
        """Return the folders to write to: that of ``--out``, and with ``--keep`` another."""
        folders = [self.args.out, kept] if self.args.keep else [self.args.out]
        for folder in folders:
            folder.mkdir(parents=True, exist_ok=True)
        return folders

    def write(self, lines: Iterable[str], *, part: str = "", of: str = "") -> None:
        """Print the page and write it; one of several is named by its part, and says of what."""
        before, self._load = self._load, os.getloadavg()[0]
        about = f"{machine()}; load average before {before:.1f}, after {self._load:.1f}."
        title = f"{self._title}: {of}" if of else self._title
        text = "\n".join([f"# {title}", "", f"    {self._command}", "", about, "", *lines])
        text = text.rstrip() + "\n"
        print(text)
        for folder in self.places():
            name = f"{self._name}_{part}.md" if part else f"{self._name}.md"
            (folder / name).write_text(text, encoding="utf-8")


def machine() -> str:
    """Return processor, cores and versions."""
    model = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        names = [x for x in cpuinfo.read_text(encoding="utf-8").splitlines() if "model name" in x]
        model = names[0].partition(":")[2].strip() if names else model
    return (
        f"{model}, {os.cpu_count()} cores; ssm-graph {code_version()}, gtsam {version('gtsam')}, "
        f"numpy {version('numpy')}, Python {platform.python_version()}"
    )


def note(text: str) -> None:
    """Say on the way what is done."""
    print(text, file=sys.stderr, flush=True)


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Return the lines of a Markdown table."""
    return [f"| {' | '.join(cells)} |" for cells in (header, ["---"] * len(header), *rows)]


def interval_text(interval: Interval, digits: str = ".3g") -> str:
    """Return a value with its interval."""
    value, low, high = (f"{x:{digits}}" for x in (interval.value, interval.low, interval.high))
    return f"{value} ({low} to {high})"


def mean_text(samples: ArrayLike, digits: str = ".3g") -> str:
    """Return a mean with its 95 % interval (Student's t); a dash for nothing but NaN."""
    if np.isnan(samples).all():
        return "–"
    return interval_text(mean_with_interval(samples), digits)


def spread_text(samples: ArrayLike) -> str:
    """Return a mean ± half of its 95 % interval (Student's t); a dash for none."""
    n = np.size(samples)
    if n == 0:
        return "–"
    mean = mean_with_interval(samples)
    return f"{mean.value:.3g} ± {mean.half_width:.2g}" if n > 1 else f"{mean.value:.3g}"


def ratio_text(ours: ArrayLike, other: ArrayLike) -> str:
    """Return the ratio of means over the same missions, with its 95 % bootstrap interval."""
    return interval_text(paired_ratio(ours, other, np.random.default_rng(0)), ".3f")


def number_text(x: float) -> str:
    """Return three digits, all before the point of thousands, or a dash."""
    if not np.isfinite(x):
        return "–"
    return f"{x:.0f}" if 999.5 <= abs(x) < 1e6 else f"{x:.3g}"


def rms(errors: ArrayLike) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(np.square(errors))))
