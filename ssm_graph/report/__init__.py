"""Tables and figures: the only place that draws."""

from ssm_graph.report.figure import save_figure
from ssm_graph.report.progress import ProgressDisplay
from ssm_graph.report.summary import summary_table

__all__ = ["ProgressDisplay", "save_figure", "summary_table"]
