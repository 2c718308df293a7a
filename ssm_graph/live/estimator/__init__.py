"""The vehicle's own estimator: messages in as they come, the newest state out at once."""

from ssm_graph.live.estimator.separation import IntegrityConfig
from ssm_graph.live.estimator.smoother import ONLINE, FixedLagSmoother

__all__ = ["ONLINE", "FixedLagSmoother", "IntegrityConfig"]
