"""Docstrings of this house as the site's reader of docstrings expects them.

Here a parameter's line says what it is, ``name : what it is``, and its type stands in the
signature; numpydoc has the type there and the words below. Roles of Sphinx become code.
"""

from __future__ import annotations

import re
from typing import Any

import griffe

ROLE = re.compile(r":(?:class|func|meth|data|mod|attr):`~?([^`]+)`")
SECTION = re.compile(r"(?<=Parameters\n----------\n)(.*?)(?=\n\n\w[\w ]*\n---|\Z)", re.S)
LINE = re.compile(r"^(\w[\w, *]*?) : (.*)$", re.M)


class HouseDocstrings(griffe.Extension):
    """Rewrites every docstring before it is parsed."""

    def on_instance(self, *, obj: Any, **_: Any) -> None:
        """Rewrite one."""
        if obj.docstring is None:
            return
        text = ROLE.sub(r"``\1``", obj.docstring.value)
        obj.docstring.value = SECTION.sub(lambda found: LINE.sub(r"\1\n    \2", found[1]), text)
