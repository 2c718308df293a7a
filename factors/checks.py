"""What a factor is made of, checked before GTSAM sees it: a wrong shape would crash the process."""

from __future__ import annotations

import numpy as np

from factors.so3 import Array


def checked_array(factor: str, name: str, value: Array, shape: tuple[int, ...]) -> Array:
    """Return a copy of an array of a shape, or raise :class:`ValueError`."""
    found = np.array(value, dtype=float)
    if found.shape != shape or not np.all(np.isfinite(found)):
        expected = " x ".join(map(str, shape))
        raise ValueError(f"{factor}: {name}: expected {expected} finite numbers, got {value}")
    return found


def check_numbers(factor: str, *, sigma: float, weight: float, **measured: float) -> None:
    """Refuse measurements that are not finite, and sigmas and weights that are not above zero."""
    for name, number in measured.items():
        if not np.isfinite(number):
            raise ValueError(f"{factor}: {name}: expected a finite number, got {number}")
    if not (0.0 < sigma < np.inf and 0.0 < weight < np.inf):
        raise ValueError(
            f"{factor}: expected sigma and weight above zero, got sigma {sigma}, weight {weight}"
        )
