"""Errors that several kinds of instruments have: slow ones, late clocks, lever arms in doubt."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from ssm_graph.base.settings import Key, correlation_key, optional_key, sigma_key


@dataclass(frozen=True, slots=True)
class Drift:
    """Errors that change slowly, as a Gauss-Markov process; none by default.

    An estimator that models it takes the rest of the stated noise as white; one that does not
    counts the stated noise, which has to stand for both.
    """

    sigma: float = 0.0
    """Of each component, SI; above zero makes it a variable of the graph."""
    correlation_s: float = 0.0
    """It forgets within so much, s; above zero where there is a drift."""
    white_share: float = 1.0
    """Of the stated sigmas, what is left as white noise where the drift is modelled, in (0, 1]."""

    @property
    def white(self) -> float:
        """Of the stated sigmas, what an estimator counts that carries the drift, if any."""
        return self.white_share if self.sigma > 0.0 else 1.0


ARM_SIGMA: Final = (0.0, 100.0, "the unit is metres")
"""Limits of the key of a doubted lever arm."""
SECONDS: Final = "the unit is seconds, not milliseconds"


def late_keys(owner: str) -> dict[str, Key]:
    """Return the keys of a clock that is late; ``owner`` has the fields."""
    return {
        "time_offset_s": optional_key(f"{owner}.time_offset_s", -10.0, 10.0, SECONDS),
        "time_offset_sigma_s": optional_key(f"{owner}.time_offset_sigma_s", 0.0, 10.0, SECONDS),
    }


def share_key(owner: str, name: str, hint: str) -> Key:
    """Return the key of what one component has of a drift's sigma, whose key is ``name``."""
    beside = (name, f"expected with a {name} above 0, got none")
    return sigma_key(owner, 10.0, hint, required=False, beside=beside)


def drift_keys(name: str, owner: str, high: float, hint: str) -> dict[str, Key]:
    """Return the keys of a drift; ``name`` is that of its sigma, ``owner`` has its fields."""
    stands_with = (name, f"expected with a {name} above 0, got none")
    needed = "expected with a drift_correlation_s, got none; 20 is a third of a minute"
    needs = ("drift_correlation_s", needed)
    return {
        name: optional_key(f"{owner}.sigma", 0.0, high, hint, beside=needs),
        "drift_correlation_s": correlation_key(f"{owner}.correlation_s", 1e8, stands_with),
        "drift_white_share": sigma_key(
            f"{owner}.white_share", 1.0, "all of the noise is 1", required=False, beside=stands_with
        ),
    }
