"""Which aids a problem has."""

from __future__ import annotations

from ssm_graph.graph.aids.acoustic import RangeAid, UsblAid
from ssm_graph.graph.aids.depth_and_gnss import DepthAid, GnssAid
from ssm_graph.graph.aids.motion import HeadingAid, StandstillAid
from ssm_graph.graph.aids.rows import Aid
from ssm_graph.graph.aids.weighted import WeightedAid, WeightedAids
from ssm_graph.mission.problem import Problem


def full_aids(problem: Problem) -> list[Aid]:
    """Return the aids that count in full."""
    aids: list[Aid] = []
    if problem.depths is not None:
        aids.append(DepthAid(problem, problem.depths))
    if problem.fixes is not None:
        aids.append(GnssAid(problem, problem.fixes))
    return aids


def weighted_aids(problem: Problem) -> WeightedAids:
    """Return the aids whose measurements are weighted."""
    further, extras = problem.further, problem.extras
    aids: list[WeightedAid] = []
    if further.usbl is not None:
        aids.append(UsblAid(further.usbl, extras))
    if further.ranges is not None:
        aids.append(RangeAid(further.ranges, extras))
    if further.headings is not None:
        aids.append(HeadingAid(further.headings, extras, problem.frame))
    if further.standstills is not None:
        aids.append(StandstillAid(further.standstills, extras))
    return WeightedAids(aids)
