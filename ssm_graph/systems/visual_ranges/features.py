"""Corners on a grid, their descriptors, and optical flow from image to image.

References
----------
.. [1] J. Shi, C. Tomasi, "Good Features to Track", CVPR 1994.
.. [2] J.-Y. Bouguet, "Pyramidal Implementation of the Lucas Kanade Feature Tracker", 2000.
.. [3] E. Rublee, V. Rabaud, K. Konolige, G. Bradski, "ORB: an Efficient Alternative to SIFT or
   SURF", ICCV 2011.
"""

from __future__ import annotations

from functools import cache
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ssm_graph.systems.visual_ranges.extras import opencv

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
Mask = NDArray[np.bool_]

OCTAVE_FACTOR: Final = 1.2
"""Scale from one octave to the next [3]_."""
N_OCTAVES: Final = 8
_BORDER: Final = 32
_BLOCK: Final = 5
_FLOW_WINDOW: Final = (15, 15)
_FLOW_LEVELS: Final = 3
_BACK_LEVELS: Final = 1
_BACK_PIXELS: Final = 0.7
_LEAST_EIGENVALUE: Final = 1e-4
EDGE_PIXELS: Final = 8.0
"""A corner nearer to the image's edge is dropped."""


def corners(image: Image, wanted: int, occupied: Array, *, quality: float = 0.003) -> Array:
    """Return corners (n, 2), the strongest of each free cell of a grid of ``wanted`` cells [1]_.

    Cells that hold one of the pixels ``occupied`` (m, 2) stay as they are. A corner's smaller
    eigenvalue is at least ``quality`` of the 95th percentile of all cells' best.
    """
    cv2 = opencv()
    height, width = image.shape
    cell = max(int(np.sqrt(height * width / wanted)), 8)
    strength = cv2.cornerMinEigenVal(image, _BLOCK, ksize=3)
    edge = int(EDGE_PIXELS) + 2
    rows, columns = (height - 2 * edge) // cell, (width - 2 * edge) // cell
    inside = strength[edge : edge + rows * cell, edge : edge + columns * cell]
    cells = inside.reshape(rows, cell, columns, cell).transpose(0, 2, 1, 3)
    cells = cells.reshape(rows * columns, cell * cell)
    best = cells.argmax(axis=1)
    found = np.take_along_axis(cells, best[:, None], axis=1)[:, 0]
    top = np.partition(found, int(0.95 * found.size))[int(0.95 * found.size)]
    free = found > max(quality * float(top), 1e-6)
    if len(occupied):
        at = ((occupied - edge) / cell).astype(np.int64)
        at = at[((at >= 0) & (at < [columns, rows])).all(axis=1)]
        free[at[:, 1] * columns + at[:, 0]] = False
    which = np.flatnonzero(free)
    x = edge + (which % columns) * cell + best[which] % cell
    y = edge + (which // columns) * cell + best[which] // cell
    found_px = np.stack([x, y], axis=1).astype(np.float64)
    return found_px[_apart(found_px, found[which], occupied, 0.5 * cell)]


def _apart(pixels: Array, strength: Array, occupied: Array, distance: float) -> Mask:
    """Return which corners have no stronger one, and none of ``occupied``, within a distance."""
    kept = np.ones(len(pixels), dtype=bool)
    if len(pixels) == 0:
        return kept
    if len(occupied):
        away, _ = cKDTree(occupied).query(pixels, distance_upper_bound=distance)
        kept &= ~np.isfinite(away)
    pairs = cKDTree(pixels).query_pairs(distance, output_type="ndarray")
    rank = np.empty(len(pixels), dtype=np.int64)
    rank[np.argsort(-strength, kind="stable")] = np.arange(len(pixels))
    weaker = np.where(rank[pairs[:, 0]] < rank[pairs[:, 1]], pairs[:, 1], pairs[:, 0])
    kept[weaker] = False
    return kept


@cache
def _orb() -> Any:
    return opencv().ORB_create(nlevels=N_OCTAVES, scaleFactor=OCTAVE_FACTOR, edgeThreshold=_BORDER)


def descriptors(image: Image, pixels: Array, octave: NDArray[np.int64]) -> NDArray[np.uint8]:
    """Return upright ORB descriptors (n, 32) of pixels (n, 2), each in its octave [3]_."""
    cv2 = opencv()
    if len(pixels) == 0:
        return np.zeros((0, 32), dtype=np.uint8)
    margin = int(_BORDER * OCTAVE_FACTOR**N_OCTAVES) + 2
    padded = cv2.copyMakeBorder(image, margin, margin, margin, margin, cv2.BORDER_REFLECT_101)
    order = np.argsort(octave, kind="stable")
    points = [
        cv2.KeyPoint(float(x) + margin, float(y) + margin, 31.0, 0.0, 0.0, int(o), i)
        for i, (x, y), o in zip(order.tolist(), pixels[order], octave[order], strict=True)
    ]
    kept, found = _orb().compute(padded, points)
    out = np.zeros((len(pixels), 32), dtype=np.uint8)
    out[[point.class_id for point in kept]] = found
    return out


def flow(previous: Image, image: Image, pixels: Array, guess: Array) -> tuple[Array, Mask]:
    """Return where pixels (n, 2) of one image are in the next, and which came back [2]_.

    ``guess`` (n, 2) is where they are looked for first.
    """
    cv2 = opencv()
    if len(pixels) == 0:
        return np.zeros((0, 2)), np.zeros(0, dtype=bool)
    start = pixels.astype(np.float32)
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 20, 0.01)
    options = {
        "winSize": _FLOW_WINDOW,
        "flags": cv2.OPTFLOW_USE_INITIAL_FLOW,
        "criteria": criteria,
        "minEigThreshold": _LEAST_EIGENVALUE,
    }
    there, found, _ = cv2.calcOpticalFlowPyrLK(
        previous, image, start, guess.astype(np.float32), maxLevel=_FLOW_LEVELS, **options
    )
    back, returned, _ = cv2.calcOpticalFlowPyrLK(
        image, previous, there, start.copy(), maxLevel=_BACK_LEVELS, **options
    )
    height, width = image.shape
    ok = (found[:, 0] == 1) & (returned[:, 0] == 1)
    ok &= ((back - start) ** 2).sum(axis=1) < _BACK_PIXELS**2
    low, high = EDGE_PIXELS, np.array([width, height]) - 1.0 - EDGE_PIXELS
    ok &= ((there >= low) & (there <= high)).all(axis=1)
    return there.astype(np.float64), ok
