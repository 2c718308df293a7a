"""Every kind of aid beside beams, depth and GNSS: the one place that names them all."""

from __future__ import annotations

from typing import Final

from ssm_graph.graph.aids.aid import Aid
from ssm_graph.graph.aids.features import FeatureSightings
from ssm_graph.graph.aids.heading import Headings
from ssm_graph.graph.aids.magnetometer import MagneticFields
from ssm_graph.graph.aids.ranges import Ranges
from ssm_graph.graph.aids.standstill import Standstills
from ssm_graph.graph.aids.terrain import TerrainRanges
from ssm_graph.graph.aids.usbl import UsblFixes

AIDS: Final[tuple[type[Aid], ...]] = (
    UsblFixes,
    Ranges,
    Headings,
    Standstills,
    MagneticFields,
    TerrainRanges,
    FeatureSightings,
)
