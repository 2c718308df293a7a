"""An NMEA 0183 log: GGA, VTG and HDT of every row, as a receiver would have sent them."""

from __future__ import annotations

from pathlib import Path

from ssm_graph.base.progress import told
from ssm_graph.io.export.track import Track
from ssm_graph.io.nmea_sentences import gga, hdt, vtg


def write_nmea(track: Track, path: Path) -> None:
    """Write three sentences a row; altitudes are heights above the ellipsoid."""
    columns = (track.unix_s, track.lat, track.lon, track.height, track.velocity_enu)
    rows = zip(
        *(column.tolist() for column in columns),
        track.roll_pitch_heading[:, 2].tolist(),
        strict=True,
    )
    with path.open("w", encoding="ascii", newline="") as file:
        file.writelines(
            gga(time_s, (lat, lon, height)) + vtg((velocity[0], velocity[1])) + hdt(heading)
            for time_s, lat, lon, height, velocity, heading in told(rows, len(track.time_s))
        )
