"""What gyros, accelerometers and beams say of velocity and way, block by block, with bounds."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from factors import so3
from ssm_graph.base.errors import ConfigError
from ssm_graph.base.frames import R_lb_from_roll_pitch_heading, roll_pitch_heading_from_R_lb
from ssm_graph.base.frozen import Array, ReadOnlyArrays
from ssm_graph.base.stepwise import Steps, at_once
from ssm_graph.filters.rules.ellipsoids import (
    Ellipsoids,
    around_box,
    cut_by_strip,
    segments,
    sum_shape,
)
from ssm_graph.imu.increments import merge_samples_steps
from ssm_graph.imu.ping_motion import mean_gyro
from ssm_graph.mission.mission import InitialState, Mission
from ssm_graph.systems.sensor_network.block import Block, BlockRow, worst_sigma

if TYPE_CHECKING:
    from ssm_graph.systems.sensor_network.witness import BoundAlarm, WitnessBounds

GAP_S: Final = 0.5
"""Longest interval that is integrated in one step where no ping comes."""
LATEST_END_S: Final = 2.0
"""A block waits no longer for a ping to end at."""
MERGE_HZ: Final = 1e-3
"""Merges all samples of an interval into one."""
_MOST_BLOCKS: Final = 100_000
_FLOOR_M_PER_S: Final = 1e-4


@dataclass(frozen=True, slots=True, eq=False)
class Track(ReadOnlyArrays):
    """M blocks."""

    begin_s: Array
    """(M,)"""
    time_s: Array
    """(M,) their ends"""
    advance: Array
    """(M, 3) m: way of the body's origin in the mission's frame, along the gyros' heading"""
    advance_bound: Array
    """(M, 3) m, of its error but for that of the heading"""
    turn_bound: Array
    """(M,) rad: by how much the error of the heading may change"""
    noise_angle: Array
    """(M,) rad: what the noise of the gyros has made of the heading by now, at most"""
    heading: Array
    """(M,) rad, clockwise from north, at the ends"""
    edge_s: Array
    """(K,) all times that were stepped to"""
    way: Array
    """(K, 3) m since the begin"""
    R_nb: Array
    """(K, 3, 3) of the gyros, levelled"""
    speed_bound: Array
    """(M,) m/s, of the mean velocity over a block"""
    closing: Array
    """(M,) m, largest correction of the way between two pings, by the second of them"""
    tilt_bound: Array
    """(M,) rad, of the levelled attitude during a block"""
    alarms: tuple[BoundAlarm, ...]
    n_beams: int
    n_left_out: int

    def led_to_end(self, i: int, time_s: Array, arm_b: Array) -> tuple[Array, Array, Array]:
        """Return lever arms (n, 3) at times (n,), and the ways from then to the end of block i.

        The ways (n, 3) are in m; the third (n,) bounds their error.
        """
        at = np.minimum(np.searchsorted(self.edge_s, time_s), len(self.edge_s) - 1)
        end = int(np.searchsorted(self.edge_s, self.time_s[i]))
        begin = int(np.searchsorted(self.edge_s, self.begin_s[i]))
        edge_s, way = self.edge_s[begin : end + 1], self.way[begin : end + 1]
        passed = np.column_stack([np.interp(time_s, edge_s, axis) for axis in way.T])
        bound = (self.time_s[i] - time_s) * self.speed_bound[i] + self.closing[i]
        return self.R_nb[at] @ arm_b, way[-1] - passed, bound

    def heading_at(self, time_s: float) -> float:
        """Return the gyros' heading at a time, rad."""
        at = min(int(np.searchsorted(self.edge_s, time_s)), len(self.edge_s) - 1)
        return float(roll_pitch_heading_from_R_lb(self.R_nb[at])[2])


class Edges(NamedTuple):
    """Times to step to."""

    time_s: Array
    """(K,) the first is where the walk stands"""
    is_end: NDArray[np.bool_]
    """(K,) which of them end a block"""


def block_edges(pings_s: Array, begin_s: float, ends_s: Array, last_s: float) -> Edges:
    """Return the edges of blocks that ought to end at some times (M,), from ``begin_s`` on.

    A block ends at a ping where there is one, or the way to the next would be half known.
    """
    ends = np.unique([_next(pings_s, end, last_s) for end in ends_s])
    last = float(ends[-1])
    inside = pings_s[(pings_s > begin_s) & (pings_s <= last)]
    known = np.unique(np.concatenate([[begin_s], inside, ends]))
    parts = np.maximum(np.ceil(np.diff(known) / GAP_S - 1e-6).astype(int), 1)
    fill = [np.linspace(a, b, n + 1) for a, b, n in zip(known, known[1:], parts, strict=False)]
    edge_s = np.unique(np.concatenate([known, *(one[1:-1] for one in fill)]))
    return Edges(edge_s, np.isin(edge_s, ends))


def mission_edges(mission: Mission, begin_s: float, block_s: float) -> Edges:
    """Return the edges of all blocks of a mission from a time on."""
    last = float(mission.imu.time_s[-1])
    pings_s = mission.dvl.of_ground().valid_s
    pings_s = pings_s[pings_s <= last]
    last = min(last, float(pings_s[-1] if len(pings_s) else begin_s) + block_s)
    if (last - begin_s) / block_s > _MOST_BLOCKS:
        raise ConfigError(
            f"block_s: expected at most {_MOST_BLOCKS} blocks in {last - begin_s:.6g} s, got "
            f"blocks of {block_s:g} s; try 10"
        )
    ends = np.arange(begin_s + block_s, last, block_s)
    ends = np.append(ends[:-1], last) if len(ends) else np.array([last])
    return block_edges(pings_s[pings_s > begin_s], begin_s, ends, last)


def _next(pings: Array, end_s: float, last_s: float) -> float:
    at = int(np.searchsorted(pings, end_s - 1e-6))
    near = at < len(pings) and pings[at] - end_s < LATEST_END_S
    return float(pings[at]) if near else min(end_s, last_s)


class VelocityWalk:
    """The walk from edge to edge; see :mod:`.witness` for what is done.

    It takes a mission as a whole, or piece by piece as it comes.
    """

    def __init__(self, mission: Mission, start: InitialState, own: WitnessBounds) -> None:
        self._own, self._frame = own, mission.frame
        self._noise, self._imu = mission.imu.noise, mission.imu.calibration
        self._mount = mission.dvl.mount
        self.begin_s = max(start.time_s, mission.imu.start_s)
        k = own.sigmas
        self._place = self._frame.p_n_from_geodetic(start.lat, start.lon, start.height)
        R_nl = self._frame.R_nl_at(self._place)
        self._g_n = self._frame.g_n_at(self._place)
        self._R = R_nl @ R_lb_from_roll_pitch_heading(start.roll, start.pitch, start.heading)
        self._tilt = k * float(np.max(start.attitude_sigma[:2]))
        self._heading = k * float(start.attitude_sigma[2])
        half = np.maximum(k * start.velocity_sigma_enu, _FLOOR_M_PER_S)
        self._set = around_box(R_nl @ start.velocity_enu, half)
        self._velocity = self._set.center
        self._silent_s, self._is_silent = 0.0, False
        self._coriolis = 2.0 * so3.skew(self._frame.omega_ie_n)
        self._gained, self._pushed, self._open_s = np.zeros(3), 0.0, 0.0

    def follow_steps(self, mission: Mission, edges: Edges) -> Steps[Track]:
        """Return the blocks of a piece of a mission, whose first edge is where the last ended."""
        yield from self._take_steps(mission, edges)
        self._alarms: list[BoundAlarm] = []
        self._n_beams = self._n_left_out = 0
        self._prepare_bounds(self._end_of_block(0))
        R, way, rotations = self._R, [np.zeros(3)], [self._R]
        begun = self._place
        block = Block(self._velocity)
        blocks: list[BlockRow] = []
        for n, dt in enumerate(self._dt):
            gain = R @ self._gains[n]
            R = self._earth[n] @ R @ self._turns[n]
            block.turned += float(np.linalg.norm(self._theta[n]))
            gain = gain + (self._g_n - self._coriolis @ block.velocity) * dt
            way.append(way[-1] + block.step(gain, float(dt)))
            tilt = self._tilt + self._drift(block)
            # A heading that turns away takes the velocity with it.
            swing = self._gyro + self._gyro_share * float(np.linalg.norm(self._theta[n])) / dt
            force = 9.81 * tilt + self._accel + swing * float(np.linalg.norm(block.velocity))
            self._gained, self._open_s = self._gained + gain, self._open_s + float(dt)
            self._pushed += force * float(dt)
            found = self._ping_at(n + 1, R, float(dt), tilt)
            if found is not None:
                way[-1] = way[-1] + block.close(*found, force)
            if self._ends[n + 1]:
                self._lead_on()
                block.leave_open(self._set)
                blocks.append(self._finished(block, float(self._edge_s[n + 1])))
                R = self._levelled(R, block)
                self._place = begun + way[-1]
                self._g_n = self._frame.g_n_at(self._place)
                self._prepare_bounds(self._end_of_block(n + 1))
                block = Block(block.velocity)
            rotations.append(R)
            yield 1.0
        self._R, self._velocity = R, block.velocity
        return self._track(np.array(way), np.array(rotations), blocks)

    follow = at_once(follow_steps)

    def _take_steps(self, mission: Mission, edges: Edges) -> Steps[None]:
        """Merge the inertial data of a piece, and find its pings at its edges."""
        self._edge_s, self._ends = edges
        dvl = mission.dvl.of_ground()
        imu = mission.imu.calibrated
        merged = yield from merge_samples_steps(imu, self._edge_s, rate_hz=MERGE_HZ)
        self._dt = np.diff(self._edge_s)
        theta = merged.gyro_b * merged.dt[:, None]
        self._theta, self._turns = theta, so3.exp(theta)
        self._gains = so3.left_jacobian_times(theta, merged.accel_b * merged.dt[:, None])
        self._earth = so3.exp(-self._frame.omega_ie_n * self._dt[:, None])
        speed, sigma, beams_b = dvl.independent()
        self._speed, self._sigma, self._beams = speed, sigma, beams_b
        ping_s = np.clip(dvl.valid_s, self._edge_s[0], self._edge_s[-1])
        arm = so3.cross(mean_gyro(imu, ping_s), dvl.mount.lever_arm_b[None])
        self._arm_speed = np.einsum("nbi,ni->nb", beams_b, arm)
        at = np.searchsorted(self._edge_s, dvl.valid_s)
        self._ping = {int(a): n for n, a in enumerate(at) if 0 < a < len(self._edge_s)}
        self._null = None
        if dvl.mount.n_beams > 3 and dvl.covariance is None:
            self._null = np.linalg.svd(dvl.mount.beams_b.T)[2][3:]

    def _end_of_block(self, edge: int) -> float:
        """Return how long after the begin the block ends that an edge is the begin of, s."""
        ends = self._edge_s[edge + 1 :][self._ends[edge + 1 :]]
        return float((ends[0] if len(ends) else self._edge_s[-1]) - self.begin_s)

    def _prepare_bounds(self, since_s: float) -> None:
        """Set what bounds the errors up to so long after the begin."""
        k, noise, mount = self._own.of("DVL"), self._noise, self._mount
        k_gyro, k_accel = self._own.of("gyros"), self._own.of("accelerometers")
        root = math.sqrt(since_s)
        self._gyro = k_gyro * (noise.gyro_bias_sigma + noise.gyro_bias_walk * root)
        self._accel = k_accel * (noise.accel_bias_sigma + noise.accel_bias_walk * root)
        more = mount.misalignment_sigma + mount.scale_sigma + mount.beam_scale_sigma
        more += mount.scale_walk_density * root
        wider = self._own.times.get("DVL", 1.0)
        self._share = self._own.speed_share * wider + k * more
        imu = self._imu
        # Scale and axes of the gyros count with every turn, those of accelerometers with gravity.
        self._gyro_share = k_gyro * (imu.gyro_scale_sigma + imu.gyro_misalignment_sigma)
        self._gyro += 9.81 * k_gyro * imu.gyro_g_sensitivity_sigma
        self._accel += 9.81 * k_accel * (imu.accel_scale_sigma + imu.accel_misalignment_sigma)
        self._steady = self._own.velocity_m_per_s * wider + k * mount.drift.sigma
        self._gyro_noise = k_gyro * noise.gyro_density
        self._accel_noise = k_accel * noise.accel_density
        self._late_s = k * mount.time_offset_sigma_s
        self._arm_m = 2.0 * k * mount.lever_arm_sigma

    def _drift(self, block: Block) -> float:
        """Return by how much the attitude of a block may have tilted by now, rad.

        A heading that is off takes what the Earth turns about another axis.
        """
        earth = float(np.linalg.norm(self._frame.omega_ie_n[:2])) * min(self._heading, 2.0)
        steady = (self._gyro + earth) * block.span_s + self._gyro_share * block.turned
        return steady + self._gyro_noise * math.sqrt(block.span_s)

    def _lead_on(self) -> None:
        """Lead the set of velocities on by what the accelerometers have gained since they were."""
        if self._open_s == 0.0:
            return
        half = self._pushed + self._accel_noise * math.sqrt(self._open_s)
        parts = np.concatenate([self._set.shape[None], segments(half * np.eye(3))])
        self._set = Ellipsoids(self._set.center + self._gained, sum_shape(parts))
        self._gained, self._pushed, self._open_s = np.zeros(3), 0.0, 0.0

    def _ping_at(self, edge: int, R: Array, dt: float, tilt: float) -> tuple[Array, Array] | None:
        """Cut the set by a ping's beams; return the velocity (3,) and its covariance (3, 3)."""
        n = self._ping.get(edge)
        if n is not None:
            self._lead_on()
        used = [] if n is None else self._usable(n, R, tilt)
        if n is None or len(used) < 3:
            self._silence(edge, dt)
            return None
        self._silent_s, self._is_silent = 0.0, False
        H = self._beams[n][used] @ R.T
        C = np.linalg.inv(H.T @ (H / np.square(self._sigma[n][used])[:, None]))
        weighted = (self._speed[n] - self._arm_speed[n])[used] / np.square(self._sigma[n][used])
        return np.asarray(C @ (H.T @ weighted)), C

    def _usable(self, n: int, R: Array, tilt: float) -> list[int]:
        """Return the beams of ping n that miss neither each other nor the set; they cut it."""
        read = self._speed[n] - self._arm_speed[n]
        speed = float(np.linalg.norm(self._set.center))
        bound = self._own.of("DVL") * self._sigma[n] + self._steady
        bound = bound + (self._share + tilt) * speed
        rows = self._beams[n] @ R.T
        off = np.abs(read - rows @ self._set.center)
        left = [int(b) for b in np.flatnonzero(np.isfinite(read))]
        if self._null is not None and len(left) == len(read):
            contradicts = np.abs(self._null @ read) > np.abs(self._null) @ bound
            if np.any(contradicts):
                reach = np.array([float(self._set.extent(row)) for row in rows]) + bound
                left.remove(int(np.argmax(off / reach)))
                self._n_left_out += 1
        used = []
        for b in left:
            cut, missed = cut_by_strip(
                self._set, rows[b], read[b] - bound[b], read[b] + bound[b], floor=_FLOOR_M_PER_S
            )
            if bool(missed):
                self._n_left_out += 1
            else:
                self._set = cut
                used.append(b)
        self._n_beams += len(used)
        return used

    def _silence(self, edge: int, dt: float) -> None:
        from ssm_graph.systems.sensor_network.witness import BoundAlarm

        self._silent_s += dt
        heard = self._ping.get(edge)
        if heard is None or self._is_silent or self._silent_s <= self._own.silence_s:
            return
        if np.isfinite(self._speed[heard]).sum() >= 3:
            self._is_silent = True
            by = f"for {self._silent_s:.0f} s its beams miss what inertial data allow"
            self._alarms.append(BoundAlarm(float(self._edge_s[edge]), "DVL", by))

    def _finished(self, block: Block, end_s: float) -> BlockRow:
        """Return way, its bounds, turn, noise of the heading and mean speed's bound of a block."""
        k, T = self._own.of("DVL"), block.span_s
        since = end_s - self.begin_s
        angle = self._gyro_noise * math.sqrt(since)
        tilt = self._tilt + self._drift(block)
        # Levelling by up to twice the tilt turns about the vertical by a product of two tilts.
        turn = self._gyro * T + self._gyro_share * block.turned + tilt**2
        scatter = k * worst_sigma(block.covariance)
        steady = self._steady * T + self._share * block.path + self._arm_m
        steady += self._late_s * block.changed + block.curved + block.bent + scatter + block.unseen
        level = steady + block.path * (0.5 * tilt**2 + angle + turn) + block.climbed * tilt
        up = steady + block.path * tilt
        bound = np.array([level, level, up])
        self._heading += turn
        speed = float(max(level, up) / max(T, 1e-9))
        return BlockRow(block.way, bound, turn, angle, end_s, speed, block.closing, tilt)

    def _levelled(self, R: Array, block: Block) -> Array:
        """Turn the attitude to where the accelerometers' gain is the change of the velocity."""
        drift = self._drift(block)
        self._tilt += drift
        if block.latest is None or block.first is None:
            return R
        T = block.span_s - block.since_first_s - block.open_s
        if 0.5 * self._own.block_s > T:
            return R
        g = float(np.linalg.norm(self._g_n))
        ends = self._own.of("DVL") * (worst_sigma(block.latest) + worst_sigma(block.earliest))
        white = self._accel_noise * math.sqrt(T)
        speeds = float(np.linalg.norm(block.first) + np.linalg.norm(block.last))
        changed = self._share * block.changed + drift * (speeds + block.changed)
        tilt = ((ends + 2.0 * self._steady + changed + white) / T + self._accel) / g
        tilt += drift
        if tilt >= self._tilt:
            return R
        self._tilt = tilt
        rest = (block.gain_to_ping - (block.last - block.first)) / (g * T)
        return np.asarray(so3.exp(np.array([rest[1], -rest[0], 0.0])) @ R)

    def _track(
        self,
        way: Array,
        rotations: Array,
        blocks: list[BlockRow],
    ) -> Track:
        advance, bound, turn, angle, end_s, speed, closing, tilt = (
            np.array(column) for column in zip(*blocks, strict=True)
        )
        at = np.searchsorted(self._edge_s, end_s)
        return Track(
            np.append(self._edge_s[0], end_s[:-1]),
            end_s,
            advance,
            bound,
            turn,
            angle,
            roll_pitch_heading_from_R_lb(rotations[at])[2],
            self._edge_s.copy(),
            way,
            rotations,
            speed,
            closing,
            tilt,
            tuple(self._alarms),
            self._n_beams,
            self._n_left_out,
        )
