"""NMEA 0183 out: answers as GGA, VTG and HDT, empty where nobody may steer by them."""

from __future__ import annotations

from typing import Final

import numpy as np

from ssm_graph.io import nmea_sentences as nmea
from ssm_graph.mission.navigation import Health, Navigation

USABLE: Final = frozenset({Health.GOOD, Health.DEGRADED})
"""What may be steered by; with any other health the fields of a sentence are empty."""


def encode_nmea(navigation: Navigation, *, geoid_separation_m: float = 0.0) -> bytes:
    """Return GGA, VTG and HDT, each ended by CR LF."""
    altitude_m = {"geoid_separation_m": geoid_separation_m}
    sentences = encode_gga(navigation, **altitude_m), encode_vtg(navigation), encode_hdt(navigation)
    return "".join(sentences).encode("ascii")


def encode_gga(navigation: Navigation, *, geoid_separation_m: float = 0.0) -> str:
    """Return a GGA, see `nmea_sentences.gga`; UTC is right where the vehicle's clock is Unix time.

    Without a finite time nothing of it is of use.
    """
    place = (navigation.lat, navigation.lon, navigation.height)
    is_usable = _is_usable(navigation, *place, navigation.time_s)
    return nmea.gga(
        navigation.time_s, place if is_usable else None, geoid_separation_m=geoid_separation_m
    )


def encode_vtg(navigation: Navigation) -> str:
    """Return a VTG, see `nmea_sentences.vtg`."""
    east, north = navigation.velocity_enu[:2].tolist()
    return nmea.vtg((east, north) if _is_usable(navigation, east, north) else None)


def encode_hdt(navigation: Navigation) -> str:
    """Return an HDT, see `nmea_sentences.hdt`."""
    heading = float(navigation.roll_pitch_heading[2])
    return nmea.hdt(heading if _is_usable(navigation, heading) else None)


def _is_usable(navigation: Navigation, *values: float) -> bool:
    return navigation.health in USABLE and bool(np.isfinite(values).all())
