"""The report of a benchmark: what was run, on which machine, and where the text goes."""

from __future__ import annotations

import os
import platform
import shlex
import sys
from collections.abc import Iterable, Sequence
from importlib.metadata import version
from pathlib import Path

from ssm_graph.study.code import code_version


class Report:
    """One benchmark's page; made before the work, for it holds the load of the machine then."""

    def __init__(self, name: str, title: str, argv: Sequence[str] | None) -> None:
        """Take the name of script and page, the page's title, and what ``main`` was called with."""
        self._name, self._title = name, title
        command = ["python", f"benchmarks/{name}.py", *(sys.argv[1:] if argv is None else argv)]
        self._command = shlex.join(command)
        self._about = f"{machine()}; load average before {os.getloadavg()[0]:.1f}."

    def head(self) -> list[str]:
        """Return title, command and machine as lines."""
        return [f"# {self._title}", "", f"    {self._command}", "", self._about, ""]

    def write(self, text: str, folders: Iterable[Path]) -> None:
        """Print the page, and write it to each of the folders."""
        print(text)
        for folder in folders:
            folder.mkdir(parents=True, exist_ok=True)
            (folder / f"{self._name}.md").write_text(text, encoding="utf-8")


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
