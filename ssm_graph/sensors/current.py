"""What is known beforehand of the current that a vehicle swims in."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from ssm_graph.base.settings import optional_key, sigma_key


@dataclass(frozen=True, slots=True)
class CurrentModel:
    """A current that changes slowly along the vehicle's way: Gauss-Markov in each component.

    The defaults cover tidal streams: within 20 minutes half a metre per second changes by 0.17 m/s
    (1 sigma), about twice of what a tide does, for the place changes as well.
    """

    sigma: float = 0.5
    """Of east and of north, m/s, above zero."""
    correlation_s: float = 21600.0
    """The current of so long before is forgotten to 37 percent, s."""
    vertical_sigma: float = 0.02
    """Of the vertical component, m/s; zero for a current that is level."""


CURRENT_KEYS: Final = {
    "sigma_m_per_s": sigma_key("sigma", 20.0, "the unit is m/s", required=False),
    "correlation_s": sigma_key("correlation_s", 1e8, "the unit is seconds", required=False),
    "vertical_sigma_m_per_s": optional_key("vertical_sigma", 0.0, 20.0, "the unit is m/s"),
}
"""Of the section ``[current]``."""
