"""Comparison of trajectories with references, and honest statistics over many runs."""

from ssm_graph.evaluation.alignment import gap_limit_s, interpolate_within
from ssm_graph.evaluation.errors import ErrorSeries, error_series
from ssm_graph.evaluation.metrics import Metrics, evaluate
from ssm_graph.evaluation.statistics import (
    Interval,
    chi2_interval,
    mean_with_interval,
    paired_ratio,
)
from ssm_graph.evaluation.withheld import reference_from_gnss

__all__ = [
    "ErrorSeries",
    "Interval",
    "Metrics",
    "chi2_interval",
    "error_series",
    "evaluate",
    "gap_limit_s",
    "interpolate_within",
    "mean_with_interval",
    "paired_ratio",
    "reference_from_gnss",
]
