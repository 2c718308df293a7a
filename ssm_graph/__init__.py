"""Factor-graph smoothing of inertial and DVL navigation with a weight for every beam.

::

    import ssm_graph as sg

    mission = sg.read_mission("lake-trial-3")
    estimate = sg.smooth(mission, sg.SmootherConfig(kernel=sg.LogKernel(dof=5)))
    print(estimate.status.name, estimate.reason)
    metrics = sg.evaluate(estimate.trajectory, mission.reference) if mission.reference else None
    sg.write_results("out", estimate, mission=mission, metrics=metrics, settings={})
    sg.save_figure("out/figure.png", estimate, mission.reference)
"""

from factors.similarity import ExpKernel, GaussianKernel, Kernel, LogKernel, SqrtKernel
from ssm_graph.base.errors import (
    ConfigError,
    DataError,
    MissingExtraError,
    SolverError,
    SsmGraphError,
)
from ssm_graph.evaluation import Metrics, evaluate, reference_from_gnss
from ssm_graph.filters.navigation.named import FILTERS, filter_problems
from ssm_graph.io.mission_folder.reader import read_mission, write_mission
from ssm_graph.io.results.tables import read_results, write_results
from ssm_graph.live.estimator import FixedLagSmoother
from ssm_graph.mission.estimate import Estimate, Iteration, Status, Trajectory
from ssm_graph.mission.mission import InitialState, Mission, Reference
from ssm_graph.mission.problem import Problem, ProblemConfig, build_problem
from ssm_graph.mission.start.alignment import Alignment, align
from ssm_graph.report.mission.figure import save_figure
from ssm_graph.smoothers.batch import Similarity, SmootherConfig, SsmSmoother
from ssm_graph.smoothers.beam_faults import FaultSearch
from ssm_graph.smoothers.fixed_lag import FixedLagConfig, solve_fixed_lag
from ssm_graph.smoothers.mission import smooth

__all__ = [
    "FILTERS",
    "Alignment",
    "ConfigError",
    "DataError",
    "Estimate",
    "ExpKernel",
    "FaultSearch",
    "FixedLagConfig",
    "FixedLagSmoother",
    "GaussianKernel",
    "InitialState",
    "Iteration",
    "Kernel",
    "LogKernel",
    "Metrics",
    "MissingExtraError",
    "Mission",
    "Problem",
    "ProblemConfig",
    "Reference",
    "Similarity",
    "SmootherConfig",
    "SolverError",
    "SqrtKernel",
    "SsmGraphError",
    "SsmSmoother",
    "Status",
    "Trajectory",
    "align",
    "build_problem",
    "evaluate",
    "filter_problems",
    "read_mission",
    "read_results",
    "reference_from_gnss",
    "save_figure",
    "smooth",
    "solve_fixed_lag",
    "write_mission",
    "write_results",
]
