"""Factor-graph smoothing of inertial and DVL navigation with a weight for every beam.

::

    import ssm_graph as sg

    mission = sg.read_mission("lake-trial-3")
    estimate = sg.smooth(mission, sg.SmootherConfig(kernel=sg.LogKernel(dof=5)))
    print(estimate.status.name, estimate.reason)
    metrics = sg.evaluate(estimate.trajectory, mission.reference) if mission.reference else None
    sg.write_results("out", estimate, mission=mission, metrics=metrics, settings={})
    sg.save_figure("out/figure.png", estimate, mission.reference)

The public names stand in ``__init__.pyi``; each is loaded when it is first asked for, so that to
import this package costs nothing.
"""

from __future__ import annotations

import ast
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import Any

_STUB = ast.parse(Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8"))
_HOMES = {
    alias.asname: (node.module, alias.name)
    for node in _STUB.body
    if isinstance(node, ast.ImportFrom)
    for alias in node.names
}
"""Module and name there of every public name."""

__all__ = sorted(_HOMES)  # type: ignore[arg-type]


def __getattr__(name: str) -> Any:
    """Load a public name."""
    if name == "__version__":
        value = version("ssm-graph")
    elif name in _HOMES:
        module, there = _HOMES[name]
        value = getattr(import_module(str(module)), there)
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return [*globals(), *__all__, "__version__"]
