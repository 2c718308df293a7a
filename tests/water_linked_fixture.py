"""What a Water Linked DVL sends."""

from __future__ import annotations

import json

import numpy as np

from ssm_graph.base.frozen import Array
from ssm_graph.live.protocols.waterlinked_serial import crc8


def velocity_report(time_s: float, speed: Array) -> str:
    """Return a report of beam speeds (4,), m/s, NaN where a beam has no lock, at a Unix time."""
    beams = [
        {"id": k, "velocity": float(np.nan_to_num(v)), "beam_valid": bool(np.isfinite(v))}
        for k, v in enumerate(speed)
    ]
    kind = {"type": "velocity", "format": "json_v3", "velocity_valid": True}
    return json.dumps({**kind, "transducers": beams, "time_of_validity": round(1e6 * time_s)})


def serial_line(body: str) -> bytes:
    """Return a line of the serial protocol with its checksum."""
    return f"{body}*{crc8(body.encode()):02x}\r\n".encode()


def serial_ping(time_s: float, speed: Array, velocity: Array, *, altitude_m: float = 4.0) -> bytes:
    """Return the lines of a ping: velocity (3,) and beam speeds (4,), m/s, NaN without lock."""
    micro_s = round(1e6 * time_s)
    vx, vy, vz = velocity
    head = f"wrz,{vx:.3f},{vy:.3f},{vz:.3f},y,{altitude_m:.2f},0.002,1e-07;0;0;0;1e-07;0;0;0;1e-08"
    lines = [serial_line(f"{head},{micro_s},{micro_s + 150_000},100.00,0")]
    for k, v in enumerate(speed):
        beam = f"{v:.3f},4.50" if np.isfinite(v) else "0.000,-1.00"
        lines.append(serial_line(f"wru,{k},{beam},-40,-95"))
    return b"".join(lines)
