"""A rendered walk becomes a map on disk; cameras are then found in it, one image at a time."""

from __future__ import annotations

import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from ssm_graph.base.errors import MissingExtraError
from ssm_graph.systems.visual_ranges.map_files import MapLocator, load_map, save_map
from ssm_graph.systems.visual_ranges.simulate import SMALL_CAMERA, ImageFaults, Run, simulate
from ssm_graph.systems.visual_ranges.system import run

WALK = Run("room", seed=2, duration_s=5.0, camera=SMALL_CAMERA)

try:
    sequence = simulate(WALK).sequence
    result = run(sequence)
except MissingExtraError as error:
    print(f"left out: {error}")
    sys.exit()

n_poses = int(np.isfinite(result.t_cw).all(axis=1).sum())
print(f"{n_poses} of {len(sequence)} images have a pose, {len(result.map.time_s)} are key frames")
with tempfile.TemporaryDirectory() as folder:
    path = Path(folder) / "map.npz"
    save_map(path, result)
    locator = MapLocator(load_map(path))

# The same walk on another day: more noise, another exposure.
worse = ImageFaults(noise=6.0, gain_drift=0.15)
again = simulate(replace(WALK, images=worse)).sequence
for index in range(len(sequence) - 30, len(sequence), 10):
    found = locator.locate(again.images(index))
    if found is None:
        print(f"image {index}: not recognised")
        continue
    off = np.linalg.norm(found.pose.centre - result.position[index])
    print(f"image {index}: {len(found.points)} points, {off:.4f} map units from where it was")
