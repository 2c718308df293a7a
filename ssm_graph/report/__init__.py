"""Tables and figures: the only place that draws."""

from ssm_graph.report.mission.figure import save_figure
from ssm_graph.report.mission.summary import summary_table
from ssm_graph.report.terminal.progress import ProgressDisplay

__all__ = ["ProgressDisplay", "save_figure", "summary_table"]
