"""What is written of a place that was looked for: result.json with its rivals, and a track."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from ssm_graph.base.frozen import Array
from ssm_graph.io.tables.files import write_table

MOST_RIVALS: Final = 20
"""That are written, those with most evidence."""


def write_found(
    folder: Path,
    result: Mapping[str, Any],
    rivals: Sequence[Mapping[str, float]],
    track: str,
    columns: Mapping[str, Array],
) -> None:
    """Write result.json and the table of a track into a folder, which is made where it is missing.

    Parameters
    ----------
    result : what is said of the place.
    rivals : what is said of all places, the best one first.
    track, columns : name of the table and its columns (N,).
    """
    folder.mkdir(parents=True, exist_ok=True)
    told = {**result, "hypotheses": [dict(place) for place in rivals[:MOST_RIVALS]]}
    text = json.dumps(told, indent=2, allow_nan=False)
    (folder / "result.json").write_text(text + "\n", encoding="utf-8")
    write_table(folder / track, dict(columns))


def covariance_columns(cov: Array, names: Sequence[str]) -> dict[str, Array]:
    """Return the upper halves of covariances (N, d, d) as columns, named cov_xy and so on."""
    return {
        f"cov_{a}{b}": cov[:, i, j]
        for i, a in enumerate(names)
        for j, b in enumerate(names)
        if j >= i
    }
