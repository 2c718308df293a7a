"""Which code made a number."""

from __future__ import annotations

import hashlib
from functools import cache
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Final

_LEFT_OUT: Final = ("report", "cli")
"""Parts of the package that no number of a study depends on."""


@cache
def code_version() -> str:
    """Return the package version with a digest of all that a study's numbers depend on.

    The version alone does not do: between releases the source changes. The versions of GTSAM,
    NumPy and SciPy are part of the digest.
    """
    package = Path(__file__).parents[1]
    spec = find_spec("factors")
    assert spec is not None
    assert spec.origin is not None
    sources = {p.relative_to(package).as_posix(): p for p in package.rglob("*.py")}
    digest = hashlib.sha256()
    for name in sorted(name for name in sources if name.split("/")[0] not in _LEFT_OUT):
        digest.update(f"ssm_graph/{name}\0".encode() + sources[name].read_bytes())
    for path in sorted(Path(spec.origin).parent.glob("*.py")):
        digest.update(f"factors/{path.name}\0".encode() + path.read_bytes())
    for name in ("gtsam", "numpy", "scipy"):
        digest.update(f"{name} {version(name)}\0".encode())
    return f"{version('ssm-graph')}+{digest.hexdigest()[:10]}"
