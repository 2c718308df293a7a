"""Defaults that options of commands and settings of estimators share.

They stand apart from the settings, so that ``--help`` says them without loading an estimator.
"""

from __future__ import annotations

from typing import Final

MERGE_RATE_HZ: Final = 20.0
"""Raw inertial samples are merged to this rate."""
KEYFRAME_INTERVAL_S: Final = 1.0
"""Longest time between keyframes while DVL and GNSS are silent, s."""
MAX_ITERATIONS: Final = 100
"""Passes of the similarity loop at most; sound missions take 5 to 15."""
LAG_S: Final = 30.0
"""Keyframes older than this leave a fixed lag's window, s."""
FILTER: Final = "ssm-log"
"""Method of ``ssm-graph filter``."""
FALSE_ALERTS_PER_H: Final = 1e-3
"""Sensors that are as stated are called contradicting so often."""
MISSED_DETECTION: Final = 1e-3
"""Probability that an unseen fault moves the answer out of its protection level."""
MESSAGES_PER_S: Final = 2000.0
"""Inertial samples of one source, of every other kind a tenth."""
STALL_S: Final = 10.0
"""Time without a sound message after which a connection is given up, s."""
SEABED_DIVE_S: Final = 600.0
"""Length of a simulated dive over a seabed, s."""
SEABED_RELIEF_M: Final = 6.0
"""Standard deviation of a simulated seabed's heights, m."""
