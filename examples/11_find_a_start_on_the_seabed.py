"""A dive finds where it began on a map of the seabed, and smooths on from there.

Run it as ``python examples/11_find_a_start_on_the_seabed.py``.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ssm_graph.evaluation.errors import evaluate
from ssm_graph.simulation import Grade
from ssm_graph.systems.seabed.dive import smooth_dive
from ssm_graph.systems.seabed.simulate import (
    DIVE,
    DiveSettings,
    mission_with_map,
    simulate_dive,
)

# Two minutes over rough ground with MEMS; the stated start is off by up to 150 m.
dive = simulate_dive(
    DiveSettings(
        mission=replace(DIVE, duration_s=120.0, grade=Grade.MEMS, imu_rate_hz=20.0, seed=2),
        start_m=150.0,
    )
)
mission = mission_with_map(dive)

done = smooth_dive(mission)
found, estimate = done.located, done.estimate
assert found is not None
assert estimate is not None
print(f"{found.verdict.name}: {found.reason}")
print(f"began {found.start[0]:+.1f} m east and {found.start[1]:+.1f} m north of the map's origin")
print(f"sigma {np.sqrt(np.diag(found.cov)[:2]).round(1)} m; truth: within 2 m of the origin")
if mission.reference is not None:
    errors = evaluate(estimate.trajectory, mission.reference)
    print(f"smoothed on the map: {errors.rmse_horizontal_m:.2f} m rms, {estimate.status.name}")
