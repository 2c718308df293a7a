"""Where each instrument was heard, remembered from process to process of a run.

``places.json`` has, for each kind of message, the places that kept others out, the first that was
heard first. A process that follows knows them: a stranger that happens to speak first does not take
the place of an instrument.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Final

from ssm_graph.base.settings import parse_json
from ssm_graph.live.sockets.places import Known
from ssm_graph.sensors.registry import BY_MESSAGE

PLACES_NAME: Final = "places.json"
_BY_NAME: Final = {one.__name__: one for one in BY_MESSAGE}
_LARGEST: Final = 1 << 20
"""Bytes; what is larger was written by somebody else."""


class PlaceFile:
    """The file of one run. Raises nothing: without it whoever speaks first counts."""

    def __init__(self, folder: Path) -> None:
        self._path = folder / PLACES_NAME

    def known(self) -> list[Known]:
        """Return the places; none where the file is not there, or damaged."""
        try:
            with self._path.open("rb") as stream:
                found = parse_json(stream.read(_LARGEST))
        except (OSError, ValueError):
            return []
        rows = found if isinstance(found, list) else []
        return [
            Known(_BY_NAME[row[0]], row[1], row[2])
            for row in rows
            if isinstance(row, list) and len(row) == 3 and all(isinstance(x, str) for x in row)
            if row[0] in _BY_NAME
        ]

    def note(self, known: Iterable[Known]) -> str | None:
        """Write them in place of those of before; return why it could not be."""
        rows = [[one.kind.__name__, one.name, one.host] for one in known]
        part = self._path.with_name(f"{PLACES_NAME}.part")
        try:  # after a power failure whoever speaks first counts: no sync
            part.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
            part.replace(self._path)
        except OSError as error:
            return f"{PLACES_NAME} cannot be written: {error.strerror or error}"
        return None
