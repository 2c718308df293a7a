"""What of OpenCV and numba the system needs, with an error that names the extra."""

from __future__ import annotations

import importlib
import importlib.util
import os
from collections.abc import Callable
from typing import Any, TypeVar

from ssm_graph.base.errors import MissingExtraError

_Function = TypeVar("_Function", bound=Callable[..., Any])


def opencv() -> Any:
    """Return OpenCV's module, or say how to install it."""
    try:
        return importlib.import_module("cv2")
    except ImportError:
        raise MissingExtraError("cv2", extra="visual", purpose="a camera's images") from None


def numba_is_used() -> bool:
    """Return whether kernels are compiled: numba is there, and SSM_GRAPH_NUMBA is not 0."""
    if os.environ.get("SSM_GRAPH_NUMBA", "1") == "0":
        return False
    return importlib.util.find_spec("numba") is not None


def compiled(function: _Function) -> _Function:
    """Return the function compiled by numba, kept on disk, free of the interpreter's lock.

    Without numba it stays as it is; whoever calls it then takes the NumPy form of the same thing.
    """
    if not numba_is_used():
        return function
    numba = importlib.import_module("numba")
    made: _Function = numba.njit(cache=True, nogil=True, fastmath=False)(function)
    return made
