"""A camera's path in map units, ranges to one anchor nobody surveyed: scale, anchor, and doubts.

No image is needed: the ranges work on any path of a monocular system, and say what it lacks.
"""

from __future__ import annotations

import numpy as np

from ssm_graph.systems.visual_ranges.range_terms import FramePoses
from ssm_graph.systems.visual_ranges.ranges import screened_ranges
from ssm_graph.systems.visual_ranges.ranging import Ranging, RangingResult

SCALE, ANCHOR_M, BIAS_M = 2.5, np.array([3.0, -1.5, 4.0]), 0.06
TIME_S = np.arange(0.0, 30.0, 0.1)


def walked(height_m: float) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    """Return a walk (N, 3), m, on a circle of 2 m that goes up and down by ``height_m``."""
    turn = 2.0 * np.pi * TIME_S / 15.0
    return np.stack([2.0 * np.sin(turn), height_m * np.sin(1.7 * turn), 2.0 * np.cos(turn)], 1)


def asked(place_m: np.ndarray[tuple[int, int], np.dtype[np.float64]]) -> RangingResult:
    """Return what ranges along a walk tell, a fifth of them not in line of sight."""
    rng = np.random.default_rng(0)
    n = len(TIME_S)
    range_m = np.linalg.norm(place_m - ANCHOR_M, axis=1) + BIAS_M + rng.normal(0.0, 0.08, n)
    range_m += np.where((TIME_S % 5.0) < 1.0, 0.3 + rng.exponential(0.8, n), 0.0)
    ranges = screened_ranges(TIME_S, ["A"] * n, range_m, np.full(n, 0.08))
    # The camera looks ahead all along; every tenth frame is a key frame. Map units, not metres.
    R_cw, t_cw = np.broadcast_to(np.eye(3), (n, 3, 3)), -place_m / SCALE
    frames = FramePoses(TIME_S, R_cw, t_cw, np.arange(n) // 10)
    ranging = Ranging(ranges, np.zeros(3))
    for told in ranging.update(frames, R_cw[::10], t_cw[::10]):
        print("   ", told)
    return ranging.result()


for name, height_m in (("a circle in a plane", 0.0), ("the same with 0.5 m of heave", 0.5)):
    print(f"{name}:")
    found = asked(walked(height_m))
    if found.has_scale:
        anchor = found.anchors[0]
        print(
            f"    scale {found.scale:.3f} m a map unit ± {100 * found.sigma_log_scale:.1f} % (true "
            f"{SCALE}), anchor {anchor.place_m.round(2)} m (true {ANCHOR_M}), "
            f"{100 * anchor.nlos_share:.0f} % of the ranges not believed"
        )
    else:
        print(f"    {found.state.value}: {'; '.join(found.reasons)}")
        print(f"    {found.advice}")
