"""The current of the water as extra variables of a problem whose DVL tracks the water at times."""

from __future__ import annotations

from typing import Final

from ssm_graph.engine.extras import Extra
from ssm_graph.mission.mission import Mission
from ssm_graph.sensors.current import CurrentModel

CURRENT: Final = "current"
"""East and north at the vehicle."""
CURRENT_UP: Final = "current_up"
CURRENTS: Final = frozenset({CURRENT, CURRENT_UP})
"""Those of the extra variables that tell of the water."""


def has_water_pings(mission: Mission) -> bool:
    """Return whether a ping off the water has a speed."""
    return mission.dvl.hears_water


def current_extras(model: CurrentModel) -> tuple[Extra, ...]:
    """Return the current as walks that keep their variance."""
    parts = (
        (CURRENT, ("current_east_m_per_s", "current_north_m_per_s"), model.sigma),
        (CURRENT_UP, ("current_up_m_per_s",), model.vertical_sigma),
    )
    return tuple(
        Extra.gauss_markov(name, labels, sigma, correlation_s=model.correlation_s)
        for name, labels, sigma in parts
        if sigma > 0.0
    )


def current_note(mission: Mission) -> tuple[str, ...]:
    """Return the note of a current that has to be assumed."""
    if mission.current is not None or not has_water_pings(mission):
        return ()
    model = CurrentModel()
    return (
        "pings off the water, and nothing says what their current is like: taken as "
        f"{model.sigma:g} m/s along east and north, {model.vertical_sigma:g} m/s up (1 sigma), "
        f"correlated over {model.correlation_s / 3600.0:g} h; state it in [current]",
    )
