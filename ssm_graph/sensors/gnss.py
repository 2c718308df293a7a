"""GNSS receiver."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from ssm_graph.base.frozen import Array
from ssm_graph.base.settings import FILE_KEY, LEVER_ARM_KEY, optional_key
from ssm_graph.sensors.drift import ARM_SIGMA, Drift, drift_keys, late_keys, share_key
from ssm_graph.sensors.instrument import Calibrated
from ssm_graph.sensors.place import (
    POSITION,
    SIGMA_ENU,
    PositionInstrument,
    PositionLog,
    PositionMessage,
)


@dataclass(frozen=True, slots=True)
class GnssCalibration:
    """What is known of the errors of a GNSS receiver, and what is asked for."""

    time_offset_s: float = 0.0
    """How late its stamps are, s."""
    time_offset_sigma_s: float = 0.0
    """Prior sigma of what is left of that, s; above zero asks for its calibration."""
    lever_arm_sigma: float = 0.0
    """Prior sigma of each component of the lever arm, m; above zero asks for its calibration."""
    drift: Drift = Drift()
    """What fixes are off by slowly, each of east, north and up, m."""
    drift_up_share: float = 1.0
    """Of its sigma, what the component up has; receivers know heights half as well as places."""


@dataclass(frozen=True, slots=True, eq=False)
class GnssLog(PositionLog):
    """Position fixes of a GNSS antenna."""

    calibration: GnssCalibration = GnssCalibration()

    @property
    def valid_s(self) -> Array:
        """(N,) when the antenna was there: stamps less the known offset of the clock, s."""
        return np.asarray(self.time_s - self.calibration.time_offset_s)


@dataclass(frozen=True, slots=True)
class Fix(PositionMessage):
    """One GNSS fix of the antenna; the receiver's time offset is not yet taken off its stamp."""


_KEYS: Final = {
    "file": FILE_KEY,
    "lever_arm_m": LEVER_ARM_KEY,
    "lever_arm_sigma_m": optional_key("calibration.lever_arm_sigma", *ARM_SIGMA),
    **late_keys("calibration"),
    **drift_keys("drift_sigma_m", "calibration.drift", 1000.0, "the unit is metres"),
    "drift_up_share": share_key(
        "calibration.drift_up_share", "drift_sigma_m", "heights that err twice as much make it 2"
    ),
}


GNSS: Final = PositionInstrument(
    "gnss",
    GnssLog,
    _KEYS,
    (*POSITION, SIGMA_ENU),
    Fix,
    "g",
    late="calibration.time_offset_s",
    calibrated={
        "gnss_lever_arm": Calibrated("lever_arm_m", "lever_arm_sigma_m"),
        "gnss_time_offset": Calibrated("time_offset_s", "time_offset_sigma_s"),
    },
)
