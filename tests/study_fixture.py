"""A tiny study that several tests share."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from ssm_graph.simulation import OutlierKind, Outliers
from ssm_graph.study.cells import Cell
from ssm_graph.study.scenario import Study, study_from
from ssm_graph.study.scoring import COLUMNS, TIMING_COLUMNS, Row

DURATION_S = 20.0
SPARSE = Cell("sparse10", "survey", DURATION_S, Outliers(OutlierKind.SPARSE, 0.1))
TINY: dict[str, Any] = {
    "name": "tiny",
    "duration_s": DURATION_S,
    "methods": [
        {"names": ["oracle", "smoother-log"], "seeds": 2},
        {"names": ["smoother-gaussian"], "seeds": 1},
    ],
    "cases": [{"kinds": ["none"]}, {"kinds": ["sparse"], "rates": [0.1]}],
}
"""As read from a file: two cases, one grade, ten runs."""


def tiny_study(**changes: Any) -> Study:
    """Return the study with some keys changed."""
    return study_from(TINY | changes, where="tiny.toml")


def untimed(row: Mapping[str, Any] | Row) -> tuple[object, ...]:
    """Return all of a row but its times, in a form that compares NaN as equal."""
    values = (row[name] for name in COLUMNS if name not in TIMING_COLUMNS)
    return tuple(None if isinstance(v, float) and math.isnan(v) else v for v in values)
