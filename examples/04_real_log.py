"""A Blueye X3 log: converted, aligned without any heading, smoothed, scored on withheld GNSS.

Set SSM_GRAPH_DATA to the folder with the real logs; without it this example says so and ends.
"""

import os
import sys
from pathlib import Path

import ssm_graph as sg

folder = Path(os.environ.get("SSM_GRAPH_DATA", "../shared/data"))
log = folder / "blueye_x3" / "log_auto_square_2025-05-07_14_55_13.mcap"
if not log.exists():
    print(f"{log} is not there: set SSM_GRAPH_DATA to the folder of real logs")
    sys.exit(0)

mission, withheld = sg.withhold_gnss(sg.convert_blueye(log), 70.0)
estimate = sg.smooth(mission)
metrics = sg.evaluate(estimate.trajectory, sg.reference_from_gnss(withheld, estimate.trajectory))
print(estimate.status.name, estimate.reason)
print(
    f"{metrics.rmse_horizontal_m:.2f} m rms horizontally against {metrics.n_epochs} withheld "
    f"epochs, {metrics.path_length_m:.0f} m travelled"
)
