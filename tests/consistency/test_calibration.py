"""Calibrations over several runs: errors as large as their sigmas say, the track as if told."""

from __future__ import annotations

import numpy as np
import pytest

from factors.similarity import LogKernel
from tests.calibration_runs import LABELS, Run, transit, turns
from tests.helpers import assert_consistent

RUNS = 8


@pytest.mark.slow
def test_what_is_wrong_is_found() -> None:
    """Turns and GNSS at the surface: nearly all within 3 sigma, all eight together consistent."""
    runs: list[Run] = [turns(seed, LogKernel(), 0.1, duration_s=240.0) for seed in range(RUNS)]
    assert all(run.status == "CONVERGED" for run in runs)
    error = np.array([run.error for run in runs])
    assert np.mean(np.abs(error) < 3.0) > 0.97
    assert_consistent(np.array([run.nees for run in runs]), dof=len(LABELS))
    assert np.mean([run.rms_m for run in runs]) < 1.2 * np.mean([run.rms_known_m for run in runs])


@pytest.mark.slow
@pytest.mark.parametrize("with_gnss", [True, False], ids=["GNSS", "no GNSS"])
def test_a_straight_run_leaves_open_what_it_does_not_show(with_gnss: bool) -> None:
    """Only with GNSS the scale; never clock and lever arm; and nothing beyond 3 sigma."""
    runs = [transit(seed, with_gnss=with_gnss) for seed in range(3)]
    ratio = dict(zip(LABELS, np.mean([run.ratio for run in runs], axis=0), strict=True))
    assert (ratio["dvl_scale_error"] < 0.3) == with_gnss
    for label in ("dvl_lever_arm_x_m", "dvl_lever_arm_z_m", "dvl_time_offset_s"):
        assert ratio[label] > 0.8
    assert np.abs([run.error for run in runs]).max() < 3.0
