"""Comparison of trajectories with references, and honest statistics over many runs."""

from ssm_graph.evaluation.comparison import (
    FILTER_ORACLE,
    METRICS,
    ORACLE,
    Cell,
    Comparison,
    Measure,
    MethodResult,
    compare_methods,
)
from ssm_graph.evaluation.errors import ErrorSeries, error_series, gap_limit_s, interpolate_within
from ssm_graph.evaluation.metrics import Metrics, evaluate
from ssm_graph.evaluation.statistics import (
    Interval,
    Paired,
    SignedRank,
    chi2_interval,
    holm,
    mean_with_interval,
    paired_difference,
    paired_ratio,
    signed_rank,
)
from ssm_graph.evaluation.withheld import reference_from_gnss, withhold_gnss

__all__ = [
    "FILTER_ORACLE",
    "METRICS",
    "ORACLE",
    "Cell",
    "Comparison",
    "ErrorSeries",
    "Interval",
    "Measure",
    "MethodResult",
    "Metrics",
    "Paired",
    "SignedRank",
    "chi2_interval",
    "compare_methods",
    "error_series",
    "evaluate",
    "gap_limit_s",
    "holm",
    "interpolate_within",
    "mean_with_interval",
    "paired_difference",
    "paired_ratio",
    "reference_from_gnss",
    "signed_rank",
    "withhold_gnss",
]
