"""Closed-form routes: where the vehicle means to be, waves left out.

A route gives metres east and north of the start and the height above the ellipsoid as Taylor
series of time; the sea surface is at height 0. Every route is analytic in time, so that all its
derivatives are continuous.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import final

import numpy as np

from ssm_graph.simulation import checked
from ssm_graph.simulation.taylor import Series, antiderivative, constant, log, sin_cos, sqrt, tanh

Position = tuple[Series, Series, Series]

_PERIODS = checked.Rule(
    lambda periods: all(map(checked.POSITIVE.holds, periods)),
    checked.POSITIVE.expected,
    "try (47, 61, 83)",
)


class Route(checked.Settings, ABC):
    """Where the vehicle means to be, and where it looks."""

    @abstractmethod
    def east_north_height(self, t: Series) -> Position:
        """Return metres east and north of the start, and metres above the ellipsoid."""

    def heading(self, t: Series) -> Series | None:  # noqa: ARG002
        """Return the heading from north, rad; None follows the course made good."""
        return None


@dataclass(frozen=True, slots=True)
class DepthProfile(checked.Settings):
    """Smooth change from one depth to another: a hyperbolic tangent in time."""

    start_m: float = 30.0
    """Depth long before the change, m."""
    end_m: float = 30.0
    """Depth long after it, m."""
    mid_s: float = 0.0
    """Time of the fastest change, s."""
    tau_s: float = checked.positive(25.0, hint="try 25")
    """Time constant; the fastest vertical speed is ``(end_m - start_m) / (2 tau_s)``."""

    def height(self, t: Series) -> Series:
        """Return the height above the ellipsoid, m."""
        if self.start_m == self.end_m:
            return constant(-self.start_m, t)
        half = 0.5 * (self.end_m - self.start_m)
        return tanh((t - self.mid_s) / self.tau_s) * -half - (self.start_m + half)


def _rotated(along: Series, across: Series, course: float) -> tuple[Series, Series]:
    """Return east and north of a track: ``along`` the course, ``across`` to its right."""
    east = along * math.sin(course) + across * math.cos(course)
    north = along * math.cos(course) - across * math.sin(course)
    return east, north


@final
@dataclass(frozen=True, slots=True)
class SurveyRoute(Route):
    """Lawn-mower lines with smooth turns, at exactly constant horizontal speed.

    The course relative to the lines is ``atan2(e, cos w t)``, which flips from nearly 0 to nearly
    pi once per line. Its integral is closed: ``asin`` along the lines and the elliptic integral of
    the first kind across them.
    """

    speed: float = checked.positive(1.5, hint="try 1.5 m/s")
    """m/s"""
    line_m: float = checked.positive(300.0, hint="try 300 m")
    """Distance sailed per line and turn, m."""
    sharpness: float = checked.positive(0.1, hint="try 0.1")
    """The ``e`` above: slope of the lines and inverse sharpness of the turns, of radius
    ``e * line_m / pi``."""
    course: float = math.radians(30.0)
    """Direction of the first line from north, rad."""
    depth: DepthProfile = DepthProfile()

    def east_north_height(self, t: Series) -> Position:
        """Return metres east and north of the start, and metres above the ellipsoid."""
        from scipy.special import ellipkinc

        rate = math.pi * self.speed / self.line_m
        theta = t * rate
        # One order less: `antiderivative` gains it back.
        sine, cosine = (series.cut(t.order - 1) for series in sin_cos(theta))
        inverse = self.speed / sqrt(cosine * cosine + self.sharpness**2)
        modulus = 1.0 / math.sqrt(1.0 + self.sharpness**2)
        scale = self.speed / rate
        along = antiderivative(scale * np.arcsin(modulus * sine.value), cosine * inverse)
        across = antiderivative(
            scale * self.sharpness * modulus * ellipkinc(theta.value, modulus**2),
            inverse * self.sharpness,
        )
        return *_rotated(along, across, self.course), self.depth.height(t)


@final
@dataclass(frozen=True, slots=True)
class SpiralRoute(Route):
    """Flat logarithmic spiral outwards at constant speed."""

    speed: float = checked.positive(1.2, hint="leave the default")
    """Speed around the centre, m/s."""
    radius_m: float = checked.positive(15.0, hint="leave the default")
    """Radius at the start, m."""
    growth: float = checked.positive(0.05, hint="leave the default")
    """Speed away from the centre, m/s."""
    depth: DepthProfile = DepthProfile(20.0, 20.0)

    def east_north_height(self, t: Series) -> Position:
        """Return metres east and north of the start, and metres above the ellipsoid."""
        radius = t * self.growth + self.radius_m
        angle = log(radius / self.radius_m) * (self.speed / self.growth)
        sine, cosine = sin_cos(angle)
        return radius * sine, radius * cosine - self.radius_m, self.depth.height(t)


@final
@dataclass(frozen=True, slots=True)
class DiveRoute(Route):
    """Helix from the surface down and up again, over and over, with a slow drift of its centre."""

    speed: float = checked.positive(1.2, hint="leave the default")
    """Speed around the centre, m/s."""
    radius_m: float = checked.positive(25.0, hint="leave the default")
    """m"""
    surface_m: float = 0.3
    """Least depth, m."""
    depth_m: float = 60.0
    """Greatest depth, m."""
    period_s: float = checked.positive(1200.0, hint="leave the default")
    """Time from surface to surface, s."""
    drift: float = 0.05
    """Northward speed of the centre, m/s."""

    def __post_init__(self) -> None:
        super(DiveRoute, self).__post_init__()
        checked.require(
            abs(self.drift) < self.speed,
            "DiveRoute.drift",
            expected="less than the speed, so that the course stays defined",
            got=self.drift,
            hint="try 0.05 m/s",
        )

    def east_north_height(self, t: Series) -> Position:
        """Return metres east and north of the start, and metres above the ellipsoid."""
        sine, cosine = sin_cos(t * (self.speed / self.radius_m))
        _, profile = sin_cos(t * (2.0 * math.pi / self.period_s))
        half = 0.5 * (self.depth_m - self.surface_m)
        height = profile * half - (self.surface_m + half)
        north = (cosine - 1.0) * -self.radius_m + t * self.drift
        return sine * self.radius_m, north, height


@final
@dataclass(frozen=True, slots=True)
class HoverRoute(Route):
    """Station keeping: slow sway of position and heading about a point; at rest with both zero."""

    sway_m: float = checked.not_negative(0.8, hint="0 is at rest")
    """Amplitude of each sinusoid east and north, m."""
    yaw: float = math.radians(15.0)
    """Amplitude of the heading, rad."""
    mean_heading: float = math.radians(60.0)
    """rad"""
    depth_m: float = 15.0
    """m"""
    periods_s: tuple[float, float, float] = checked.field(_PERIODS, (47.0, 61.0, 83.0))
    """Periods of the sway east, north, and of the heading, s."""

    def east_north_height(self, t: Series) -> Position:
        """Return metres east and north of the start, and metres above the ellipsoid."""
        east, _ = sin_cos(t * (2.0 * math.pi / self.periods_s[0]))
        north, _ = sin_cos(t * (2.0 * math.pi / self.periods_s[1]))
        return east * self.sway_m, north * self.sway_m, constant(-self.depth_m, t)

    def heading(self, t: Series) -> Series:
        """Return the heading from north, rad."""
        sine, _ = sin_cos(t * (2.0 * math.pi / self.periods_s[2]))
        return sine * self.yaw + self.mean_heading


@final
@dataclass(frozen=True, slots=True)
class TransitRoute(Route):
    """Straight run: latitude and longitude linear in time; fit for many hours."""

    speed: float = checked.positive(2.0, hint="try 2 m/s")
    """m/s at the start."""
    course: float = math.radians(50.0)
    """rad from north at the start."""
    depth: DepthProfile = DepthProfile(40.0, 40.0)

    def east_north_height(self, t: Series) -> Position:
        """Return metres east and north of the start, and metres above the ellipsoid."""
        east = t * (self.speed * math.sin(self.course))
        north = t * (self.speed * math.cos(self.course))
        return east, north, self.depth.height(t)
