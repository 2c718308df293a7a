"""What every estimator returns: a trajectory with covariances, beam weights, and why it stopped."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from enum import Enum
from typing import Any

import numpy as np

from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.frozen import Array, FrozenArrays, ShortRepr, shaped
from ssm_graph.mission.fault import DetectedFault
from ssm_graph.mission.mission import InitialState
from ssm_graph.mission.posterior import Posterior

OUTLIER_WEIGHT = 0.05
"""Beams that end below this weight are called outliers."""


OnKeyframe = Callable[[int, int], None]
"""Called by what goes keyframe by keyframe: how many are done, and how many there are."""


class Status(Enum):
    """Why an estimator stopped; the text is shown to the user."""

    CONVERGED = "updates and weights settled"
    MAX_ITERATIONS = "iteration limit reached before updates and weights settled"
    INTERRUPTED = "interrupted before updates and weights settled"
    SUSPECT = "the data contradict the answer or leave it ambiguous"
    DIVERGED = "the solution became non-finite or ran away"

    @property
    def is_good(self) -> bool:
        """True only for a result that may be used without a second look."""
        return self is Status.CONVERGED


@dataclass(frozen=True, slots=True)
class Iteration:
    """One pass of the similarity loop."""

    update_sigmas: float
    """Largest update of any state component, in its own posterior sigmas."""
    weight_change: float
    """Largest change of any beam weight."""
    kernel: str
    """The kernel in force, as text."""


@dataclass(frozen=True, slots=True, eq=False)
class BeamTable(FrozenArrays):
    """One row for every beam speed that was used."""

    time_s: Array = shaped("N")
    """(N,) s, when the ping was taken (time offset applied)."""
    beam: Array = shaped("N")
    """(N,) beam number, 1 to 4."""
    innovation: Array = shaped("N")
    """(N,) measured minus predicted, m/s: before the update in filters, with the final states in
    smoothers."""
    mahalanobis_sq: Array = shaped("N")
    """(N,) the t of the similarity measure, posterior variance included."""
    weight: Array = shaped("N")
    """(N,) similarity weight, 1 = nominal."""


@dataclass(frozen=True, slots=True, eq=False)
class AidTable(FrozenArrays):
    """One row for every component of a measurement beside the beams.

    Of depth that is the mean of a keyframe's readings, of which there are fewer than beam speeds.
    """

    aid: tuple[str, ...]
    """(N,) depth, GNSS, USBL, range, heading, magnetometer, standstill or seabed"""
    component: tuple[str, ...]
    """(N,) depth, east, north, up, heading, x, y, z, the beacon of a range, or a beam"""
    unit: tuple[str, ...]
    """(N,) of the innovation: m, rad or m/s"""
    time_s: Array = shaped("N")
    """(N,) s, when it was valid, or of the keyframe that it was led to."""
    innovation: Array = shaped("N")
    """(N,) measured minus predicted, heights upwards: before the update in filters, with the final
    states in smoothers."""
    mahalanobis_sq: Array = shaped("N")
    """(N,) the t of the whole measurement, posterior variance included."""
    weight: Array = shaped("N")
    """(N,) of the whole measurement, 1 = nominal."""

    @classmethod
    def joined(cls, parts: Sequence[AidTable]) -> AidTable | None:
        """Return the rows of several tables, one after the other; None if there are none."""
        columns: dict[str, Any] = {
            spec.name: [value for part in parts for value in getattr(part, spec.name)]
            for spec in fields(cls)
        }
        if not columns["aid"]:
            return None
        for name, values in columns.items():
            is_text = name in ("aid", "component", "unit")
            columns[name] = tuple(values) if is_text else np.array(values)
        return cls(**columns)

    def counts(self) -> dict[str, tuple[int, int]]:
        """Return how many measurements each aid had, and how many ended as outliers."""
        names = np.array(self.aid)
        # The first component stands for the measurement: east, or x, of what is a vector.
        is_first = ~np.isin(self.component, ("north", "up", "y", "z"))
        found = {}
        for name in dict.fromkeys(self.aid):
            weights = self.weight[is_first & (names == name)]
            found[name] = (len(weights), int(np.sum(weights < OUTLIER_WEIGHT)))
        return found


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory(FrozenArrays):
    """States at the keyframes with their posterior uncertainty."""

    time_s: Array = shaped("N")
    lat: Array = shaped("N")
    """(N,) rad"""
    lon: Array = shaped("N")
    """(N,) rad"""
    height: Array = shaped("N")
    """(N,) m above the ellipsoid"""
    velocity_enu: Array = shaped("N", 3)
    """(N, 3) m/s"""
    roll_pitch_heading: Array = shaped("N", 3)
    """(N, 3) rad"""
    gyro_bias: Array = shaped("N", 3)
    """(N, 3) rad/s, body axes"""
    accel_bias: Array = shaped("N", 3)
    """(N, 3) m/s^2, body axes"""
    position_cov_enu: Array = shaped("N", 3, 3)
    """(N, 3, 3) m^2"""
    velocity_sigma_enu: Array = shaped("N", 3)
    """(N, 3) m/s"""
    attitude_sigma: Array = shaped("N", 3)
    """(N, 3) rad, of roll, pitch and heading"""
    n_beams: Array = shaped("N")
    """(N,) beam speeds used at the keyframe"""


@dataclass(frozen=True, slots=True, eq=False)
class ProtectionTrack(FrozenArrays):
    """What bounded the errors of live answers at the keyframes, as it was known there and then."""

    time_s: Array = shaped("N")
    horizontal: Array = shaped("N")
    """(N,) m, radius; infinite where nothing was known"""
    up: Array = shaped("N")
    """(N,) m"""


@dataclass(frozen=True, slots=True, eq=False)
class CurrentTrack(FrozenArrays):
    """The current of the water along the vehicle's way, at the keyframes."""

    time_s: Array = shaped("N")
    velocity_enu: Array = shaped("N", 3)
    """(N, 3) of the water over ground along east, north, up, m/s; up is zero where it is not
    estimated."""
    covariance_enu: Array = shaped("N", 3, 3)
    """(N, 3, 3) (m/s)^2"""

    @property
    def sigma_enu(self) -> Array:
        """(N, 3) m/s."""
        return np.sqrt(np.diagonal(self.covariance_enu, axis1=1, axis2=2))


class Determined(Enum):
    """How well the data determined a calibration; the text says what that means."""

    GREEN = "by the data"
    AMBER = "in part"
    RED = "not by this mission: it stays at its prior"


GREEN_RATIO = 0.3
"""Posterior sigma over prior sigma below which the data hold nine tenths of what is known."""
AMBER_RATIO = 0.8
"""Above it, hardly more is known than before."""


@dataclass(frozen=True, slots=True)
class CalibratedValue:
    """One number of a calibration: how far an instrument is off what the mission states."""

    variable: str
    """For example ``dvl_mounting``."""
    label: str
    """For people and files, with the unit: ``dvl_mounting_x_deg``."""
    unit: float
    """SI units in one of the label's."""
    value: float
    """SI; of what walks along the mission, at its end."""
    sigma: float
    """SI, posterior."""
    prior_sigma: float
    """SI; of what walks, at the end of the mission if nothing had been measured."""

    @property
    def determined(self) -> Determined:
        """How well the data determined it."""
        ratio = self.sigma / self.prior_sigma
        if ratio < GREEN_RATIO:
            return Determined.GREEN
        return Determined.AMBER if ratio < AMBER_RATIO else Determined.RED


@dataclass(frozen=True, slots=True, eq=False)
class Calibration(ShortRepr):
    """What was found of the instruments."""

    values: tuple[CalibratedValue, ...]
    covariance: Array
    """(E, E) of the values, SI."""
    walks: Array
    """(K, s) at every keyframe, SI: those of the values that walk, which come first; in a window
    each of them does."""

    def of(self, variable: str) -> Array:
        """Return the components of a variable, SI; empty where it was not asked for."""
        return np.array([v.value for v in self.values if v.variable == variable])


@dataclass(frozen=True, slots=True, eq=False)
class Found(ShortRepr):
    """What a live estimator knows by now, beside the state of the vehicle."""

    calibration: Calibration | None = None
    """None where nothing is asked for."""
    current: CurrentTrack | None = None
    """One row, the newest; None without pings off the water."""


@dataclass(frozen=True, slots=True, eq=False)
class NoiseFound(ShortRepr):
    """How noisy the data are by what the answer misses of them."""

    beam_factor: Array
    """(4,) estimated over stated sigma of each beam; NaN with too few speeds."""
    beam_dof: Array
    """(4,) degrees of freedom behind it."""
    beam_used: Array
    """(4,) sigma that the answer was made with over the stated one: 1 unless adapted."""
    inertial_chi_sq: float
    """Sum of the squared whitened errors of the inertial data,"""
    inertial_dof: float
    """and what it is expected to be."""


@dataclass(frozen=True, slots=True, eq=False)
class Estimate(ShortRepr):
    """The answer of one estimator on one mission."""

    method: str
    """For example ``smoother``."""
    kernel: str
    """Kernel with its parameter, for example ``log(dof=5)``."""
    status: Status
    reason: str
    """One sentence: why it stopped, with numbers."""
    trajectory: Trajectory
    beams: BeamTable
    iterations: tuple[Iteration, ...]
    """Passes over all keyframes; empty where each keyframe has its own."""
    wall_s: float
    cost: float
    """Half the sum of squares of all factors, a beam's replaced by its robust loss ``-f(t)``."""
    start: InitialState
    """The initial state that was used, from the mission or from alignment."""
    notes: tuple[str, ...] = ()
    """What a user should know about the run, one sentence each."""
    keyframe_iterations: float = np.nan
    """Mean passes over a keyframe of what goes keyframe by keyframe."""
    calibration: Calibration | None = None
    """What was found of the instruments, if that was asked for."""
    aids: AidTable | None = None
    """What became of the further aids; None where there are none."""
    noise: NoiseFound | None = None
    """What was found of their noise; None of what goes keyframe by keyframe."""
    current: CurrentTrack | None = None
    """What was found of the water's current; None without pings off the water."""
    faults: tuple[DetectedFault, ...] = ()
    """Sensors that were off for long, in the order of their begins."""
    posterior: Posterior | None = None
    """For answers between keyframes; of smoothers of the whole mission."""

    @property
    def n_iterations(self) -> float:
        """How often the data were gone through: in all, or on average over the keyframes."""
        return len(self.iterations) if self.iterations else self.keyframe_iterations

    @property
    def n_beams(self) -> int:
        """How many beams the instrument has, as far as is told."""
        told = 0 if self.noise is None else len(self.noise.beam_factor)
        return max(told, int(np.max(self.beams.beam, initial=1.0)))


def since_first_ping(trajectory: Trajectory) -> Trajectory:
    """Return the keyframes from the first beam speed on.

    Before it there is but the initial state, which a filter is given and a smoother improves:
    0.1 m/s at one of a thousand keyframes is a third of a good filter's velocity rms.
    """
    first = int(np.argmax(trajectory.n_beams > 0))
    return Trajectory(*(getattr(trajectory, f.name)[first:] for f in fields(trajectory)))


def path_length_m(
    trajectory: Trajectory, *, first_s: float = -np.inf, last_s: float = np.inf
) -> float:
    """Return the horizontal length of a trajectory from keyframe to keyframe, m.

    Only keyframes from ``first_s`` to ``last_s`` count; up and down do not. Every step is taken
    along the local level at its own begin.
    """
    kept = (trajectory.time_s >= first_s) & (trajectory.time_s <= last_s)
    lat, lon, height = (x[kept] for x in (trajectory.lat, trajectory.lon, trajectory.height))
    if len(lat) < 2:
        return 0.0
    frame = LocalFrame(float(lat[0]), float(lon[0]), float(height[0]))
    p_n = frame.p_n_from_geodetic(lat, lon, height)
    step_l = np.einsum("nij,ni->nj", frame.R_nl_at(p_n[:-1]), np.diff(p_n, axis=0))
    return float(np.hypot(step_l[:, 0], step_l[:, 1]).sum())
