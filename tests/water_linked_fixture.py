"""What a Water Linked DVL sends."""

from __future__ import annotations

import json

import numpy as np

from ssm_graph.base.frozen import Array


def velocity_report(time_s: float, speed: Array) -> str:
    """Return a report of beam speeds (4,), m/s, NaN where a beam has no lock, at a Unix time."""
    beams = [
        {"id": k, "velocity": float(np.nan_to_num(v)), "beam_valid": bool(np.isfinite(v))}
        for k, v in enumerate(speed)
    ]
    kind = {"type": "velocity", "format": "json_v3", "velocity_valid": True}
    return json.dumps({**kind, "transducers": beams, "time_of_validity": round(1e6 * time_s)})
