"""The same model on `filterpy.kalman.ExtendedKalmanFilter`: the engine without a compiler, and the kernels' oracle.

Written from the equations with whole matrices, not from the kernels: where both agree, neither has a slip. The model
and the rules of the timeline are described in `fusion.kernels`; the layouts of fixes and poses are shared with it.
"""

from __future__ import annotations

import bisect
import math
from collections.abc import Sequence
from typing import Any, TypeVar

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter

from fusion import kernels as k
from fusion.geometry import exp_so3, log_so3, quaternion_from_rotation, rotation_from_quaternion, skew
from fusion.measurements import Array
from fusion.params import GRAVITY, Channel, FilterParams, Motion
from fusion.smoothing import Motion as Moving
from fusion.smoothing import Smoother

TH, DV, DP, DBG, DBA, DTILT, DWHEEL = (
    slice(0, 3),
    slice(3, 6),
    slice(6, 9),
    slice(9, 12),
    slice(12, 15),
    slice(16, 18),
    slice(18, 20),
)
DTD = 15
N = 20
T = TypeVar("T")
_I3 = np.eye(3)
_I = np.eye(N)


def _no_innovation(_: Array) -> float:
    return 0.0


def _shallow_copy(original: T) -> T:
    """As `copy.copy`, but faster: there is nothing to an object here but its attributes."""
    other = object.__new__(type(original))
    other.__dict__.update(original.__dict__)
    return other


def _turned(attitude: Array, turn: Array) -> Array:
    """q ⊗ Exp(φ): a quaternion wxyz turned by a rotation vector in its own axes."""
    a, b, c, d = attitude.tolist()
    x, y, z = turn.tolist()
    angle = math.hypot(x, y, z)
    w, share = math.cos(0.5 * angle), math.sin(0.5 * angle) / angle if angle else 0.5
    x, y, z = share * x, share * y, share * z
    return np.array(
        [
            a * w - b * x - c * y - d * z,
            a * x + b * w + c * z - d * y,
            a * y - b * z + c * w + d * x,
            a * z + b * y - c * x + d * w,
        ]
    )


class ErrorStateFilter(ExtendedKalmanFilter):  # type: ignore[misc]
    """One filter: filterpy holds the error (always zero between updates) and P, the nominal state stands beside.

    No array is ever changed in place, so that a shallow copy is a checkpoint. On matrices this small, `dot` takes a
    third of the time of `@`.
    """

    def __init__(self) -> None:
        super().__init__(dim_x=N, dim_z=6)
        self.x = np.zeros(N)
        self.P = np.zeros((N, N))
        self.face(np.array([1.0, 0.0, 0.0, 0.0]))
        self.velocity = np.zeros(3)
        self.position = np.zeros(3)
        self.bias = np.zeros(6)  # of the IMU's sample: gyro, accel
        self.time_offset = 0.0
        self.wheel_scale = np.zeros(2)  # of wheel odometry: errors of forward speed and yaw rate
        self.lean(np.zeros(2))
        self.corrected = np.zeros(6)  # sum of all moves by updates: position, rotation vector, world axes
        # P lags behind the nominal state, by so many s since this rotation and velocity. White noise has since been
        # added to attitude and velocity along each axis, rad2 and (m/s)2.
        self.lag, self.then, self.white = 0.0, (self.rotation, self.velocity), (0.0, 0.0)

    def predict_x(self, u: Any = 0) -> None:
        """The error stays zero; `move` carries the nominal state."""

    def face(self, attitude: Array) -> None:
        """Set the attitude (4,), which poses are published with, and the matrix that all else reckons with."""
        self.attitude = attitude
        self.rotation = rotation_from_quaternion(attitude)

    def lean(self, tilt: Array) -> None:
        """Set the tilt, and with it the vertical in the world frame (3,) and how it goes with the tilt (3, 2)."""
        x, y = tilt.tolist()
        z = math.sqrt(1.0 - x * x - y * y)
        self.tilt = tilt
        self.up = np.array([x, y, z])
        self.up_by_tilt = np.array([[1.0, 0.0], [0.0, 1.0], [-x / z, -y / z]])

    @property
    def gyro_bias(self) -> Array:
        return self.bias[:3]

    def move(self, u: Array, dt: float, gyro_noise: float, accel_noise: float) -> None:
        """Carry the nominal state over `dt` s of constant rate and specific force u (6,), with its bias, measured with
        such densities of noise. What that does to P waits for `spread`."""
        if self.lag == 0.0:
            self.then = self.rotation, self.velocity
        self.lag += dt
        self.white = self.white[0] + gyro_noise**2 * dt, self.white[1] + accel_noise**2 * dt
        du = (u - self.bias) * dt
        added = exp_so3(0.5 * du[:3]).dot(du[3:])  # Δv, in start axes
        velocity = self.velocity
        self.velocity = velocity + self.rotation.dot(added) - GRAVITY * dt * self.up
        self.position = self.position + 0.5 * dt * (velocity + self.velocity)
        self.face(_turned(self.attitude, du[:3]))

    def spread(self, measured: bool, gyro_walk: float, accel_walk: float) -> None:
        """Bring P up to the nominal state, the biases walking with such densities; see `kernels.spread`."""
        dt = self.lag
        if dt == 0.0:
            return
        start, velocity = self.then
        A = self.rotation.T.dot(start)  # end axes from start axes
        added = start.T.dot(self.velocity - velocity + GRAVITY * dt * self.up)  # Δv, in start axes
        F, Q = _I.copy(), np.zeros((N, N))
        F[TH, TH] = F[DV, DV] = F[DP, DP] = A
        if measured:
            F[TH, DBG] = F[DV, DBA] = -dt * A
            F[DV, TH] = A.dot(skew(-added))
            F[DV, DTILT] = -GRAVITY * dt * self.rotation.T.dot(self.up_by_tilt)
        F[DP, TH], F[DP, 9:] = 0.5 * dt * F[DV, TH], 0.5 * dt * F[DV, 9:]  # it goes by the mean of both velocities
        F[DP, DV] = dt * A
        angle, speed = self.white
        Q[TH, TH], Q[DV, DV], Q[DP, DP] = angle * _I3, speed * _I3, dt * dt / 3.0 * speed * _I3
        Q[DV, DP] = Q[DP, DV] = 0.5 * dt * speed * _I3
        Q[DBG, DBG], Q[DBA, DBA] = gyro_walk**2 * dt * _I3, accel_walk**2 * dt * _I3
        self.F, self.Q = F, Q
        self.predict()
        self.lag, self.white = 0.0, (0.0, 0.0)

    def slow(self, dt: float, noise: float) -> None:
        """What `move` leaves out where nothing is measured: the speed decays, and white `noise` pushes the robot."""
        tau = k.COAST_TIME
        e = math.exp(-dt / tau)
        gone = tau * (1.0 - e)
        self.position = self.position + (gone - dt) * self.velocity
        self.velocity = e * self.velocity
        F = _I.copy()
        F[DV, DV], F[DP, DV] = e * _I3, (gone - dt) * _I3
        Q = np.zeros((N, N))
        half = 0.5 * tau * (1.0 - e * e)
        Q[DV, DV] = half * _I3
        Q[DV, DP] = Q[DP, DV] = 0.5 * gone**2 * _I3
        Q[DP, DP] = tau**2 * (dt - 2.0 * gone + half) * _I3
        self.F, self.Q = F, noise**2 * Q
        self.predict()

    def correct(self, H: Array, y: Array, R: Array) -> None:
        """Update with innovation y, then move the nominal state by the error and reset it."""
        self.update(y, lambda _: H, _no_innovation, R=R)
        dx = self.x
        self.x = np.zeros(N)
        tells = float(H[:, DTD].any())  # of the time offset: a fix
        dx[DP] -= tells * dx[DTD] * dx[DV]
        turn = dx[TH]
        turned, faster, moved = self.rotation.dot(dx[:9].reshape(3, 3).T).T  # world axes
        self.corrected = self.corrected + np.concatenate([moved, turned])
        self.velocity = self.velocity + faster
        self.position = self.position + moved
        self.bias = self.bias + dx[9:15]
        self.time_offset += float(dx[DTD])
        self.lean(self.tilt + dx[DTILT])
        self.wheel_scale = self.wheel_scale + dx[DWHEEL]
        # Jr(φ) = I - (1 - cos φ)/φ² [φ]x + (φ - sin φ)/φ³ [φ]x²
        angle, K = math.hypot(*turn.tolist()), skew(turn)
        b, c = (0.5, 1.0 / 6.0)
        if angle > 1e-4:
            b, c = (1.0 - math.cos(angle)) / angle**2, (angle - math.sin(angle)) / angle**3
        J = _I.copy()
        J[TH, TH] = _I3 - b * K + c * K.dot(K)
        J[DV, DV] = J[DP, DP] = exp_so3(turn).T
        J[DP, DV], J[DP, DTD] = -tells * dx[DTD] * J[DP, DP], -tells * J[DP, DP].dot(dx[DV])
        P = J.dot(self.P).dot(J.T)
        self.P = 0.5 * (P + P.T)
        attitude = _turned(self.attitude, turn)
        self.face(attitude / math.sqrt(attitude.dot(attitude)))

    def start(self, hypothesis: Array, velocity_sigma: float, rate: Array) -> None:
        """Pose and its covariance from a fix, at an angular rate (3,); the other states stay."""
        self.face(hypothesis[k.H_QUAT : k.H_QUAT + 4].copy())
        self.position = hypothesis[k.H_POS : k.H_POS + 3].copy()
        self.velocity = np.zeros(3)
        P = self.P.copy()
        P[:9, :] = 0.0
        P[:, :9] = 0.0
        P[DV, DV] = velocity_sigma**2 * _I3
        R = self._in_body(hypothesis)
        P[DP, DP], P[TH, TH] = R[:3, :3], R[3:, 3:]
        P[DP, TH], P[TH, DP] = R[:3, 3:], R[3:, :3]
        # off by -ω δt_d beside the fix's own error
        P[TH, TH] += P[DTD, DTD] * np.outer(rate, rate)
        P[TH, 9:] = -np.outer(rate, P[DTD, 9:])
        P[9:, TH] = P[TH, 9:].T
        if P.diagonal()[TH].max() > k.UNKNOWN_HEADING**2:
            # the fix says nothing of the attitude
            P[TH, :] = P[:, TH] = 0.0
            P[TH, TH] = k.UNKNOWN_HEADING**2 * _I3
        self.P = P

    def reopen(self, i: int, variance: float) -> None:
        """Forget what is known of one of the plain states."""
        P = self.P.copy()
        P[i, :] = P[:, i] = 0.0
        P[i, i] = variance
        self.P = P

    def _in_body(self, hypothesis: Array) -> Array:
        """(6, 6): a fix's covariance in body axes."""
        turn = np.zeros((6, 6))
        turn[:3, :3] = turn[3:, 3:] = self.rotation.T
        R: Array = turn @ hypothesis[k.H_COV : k.H_COV + 36].reshape(6, 6) @ turn.T
        return R

    def fix_model(self, hypothesis: Array, rate: Array, jitter: float) -> tuple[Array, Array, Array]:
        """H, y and R of a pose fix: position then attitude, in body axes."""
        H = np.zeros((6, N))
        H[:3, DP] = _I3
        H[3:, TH] = _I3
        motion = np.concatenate([self.rotation.T @ self.velocity, rate])
        H[:, DTD] = motion
        y = np.concatenate(
            [
                self.rotation.T @ (hypothesis[k.H_POS : k.H_POS + 3] - self.position),
                log_so3(self.rotation.T @ rotation_from_quaternion(hypothesis[k.H_QUAT : k.H_QUAT + 4])),
            ]
        )
        return H, y, self._in_body(hypothesis) + jitter**2 * np.outer(motion, motion)


def _order(reading: tuple[float, ...]) -> list[float]:
    """By what readings are sorted: NaN, which compares with nothing, comes last."""
    return [math.inf if math.isnan(number) else number for number in reading]


def _repeated(now: Sequence[float], last: Sequence[float], peak: float, least: float) -> int:
    """Along how many axes a reading, `peak` at most, is to the last digit what it was, and at least `least`."""
    return 0 if peak < least else sum([a == b and abs(a) >= least for a, b in zip(now, last, strict=True)])


def _d2(S: Array, y: Array) -> float:
    return float(y @ np.linalg.solve(S, y))


class _State:
    """All that rewinds. Copied shallowly, filters included."""

    def __init__(self) -> None:
        self.main = ErrorStateFilter()
        self.shadow: ErrorStateFilter | None = None
        self.shadow_count = 0
        self.twins, self.lead = False, 0.0
        self.rejected_since, self.rejected_run = 0.0, 0
        self.t = self.t_imu = self.t_accepted = -math.inf
        self.u = np.zeros(6)
        self.next_t = math.inf
        self.next_u = np.zeros(6)
        self.bridging = self.trailing = self.initialised = False
        self.imu_cursor = self.fix_cursor = self.wheel_cursor = 0
        self.grid_at = -math.inf
        self.td_applied = 0.0
        self.reset_id = self.accepted_count = 0
        self.accel_mean, self.accel_count = np.zeros(3), 0
        self.excess, self.scale, self.last_innovation = [0.0] * 4, [1.0] * 4, np.zeros(6)
        self.still_since, self.still_barred, self.still_sure, self.still_fixes = math.inf, -math.inf, False, 0
        self.still_mean, self.still_force = np.zeros(3), np.zeros(3)
        self.rest, self.moving = [0.0, 0.0], [0.0, 0.0]  # of gyro and accelerometer
        self.change_gyro = self.change_accel = self.largest_gyro = self.largest_accel = 0.0
        self.clipped_gyro = self.clipped_accel = 0
        self.same_run, self.suspect, self.blind = 0, False, False
        self.constraint_nis, self.usual_speed2 = np.ones(4), 0.0
        self.adapted, self.t_adapted = 0.0, -math.inf
        self.t_wheel, self.wheel_rate, self.wheel_share = -math.inf, 0.0, 1.0
        self.wheel_nis, self.slips = [0.0, 0.0], False  # of speed, of yaw rate
        self.force2, self.force_count = 0.0, 0
        self.systematic = np.zeros(36)
        self.place, self.place2, self.place_count = np.zeros(3), np.zeros(3), 0

    def copy(self) -> _State:
        other = _shallow_copy(self)
        other.main = _shallow_copy(self.main)
        other.shadow = None if self.shadow is None else _shallow_copy(self.shadow)
        return other

    @property
    def filters(self) -> list[ErrorStateFilter]:
        return [self.main] if self.shadow is None else [self.main, self.shadow]


class ReferenceTimeline:
    """Drop-in for `fusion.timeline.Timeline`; how much slower, `benchmarks.fusion` prints."""

    def __init__(self, params: FilterParams, motion: Motion) -> None:
        self._params = params
        self._motion = motion
        self._samples: list[tuple[float, ...]] = []
        self._fixes: list[Array] = []
        self._readings: list[tuple[float, ...]] = []  # of wheels
        self._state = _State()
        self._state.usual_speed2 = params.usual_speed**2
        self._checkpoints = [self._state.copy()]
        self._horizon = self._ahead = -math.inf
        self._figures = dict.fromkeys(("imu_duplicates", "imu_late", "wheel_duplicates", "wheel_late", "rewinds"), 0)
        self._waiting = 0
        self._smoother = Smoother()

    # --- the interface of Timeline

    @property
    def figures(self) -> dict[str, int]:
        """See `Timeline.figures`."""
        return dict(self._figures)

    @property
    def state(self) -> Array:
        """(kernels.STATE,): the live filter in the kernels' layout."""
        s = self._state
        vector = np.zeros(k.STATE)
        vector[k.Q : k.Q + 4] = s.main.attitude
        vector[k.V : k.V + 3] = s.main.velocity
        vector[k.POS : k.POS + 3] = s.main.position
        vector[k.BG : k.BG + 3], vector[k.BA : k.BA + 3] = s.main.bias[:3], s.main.bias[3:]
        vector[k.TD] = s.main.time_offset
        vector[k.TILT : k.TILT + 2], vector[k.WHEEL : k.WHEEL + 2] = s.main.tilt, s.main.wheel_scale
        vector[k.COV : k.COV + N * N] = s.main.P.ravel()
        vector[k.T], vector[k.T_IMU], vector[k.T_ACCEPTED] = s.t, s.t_imu, s.t_accepted
        vector[k.INITIALISED], vector[k.RESET_ID] = s.initialised, s.reset_id
        vector[k.SCALE : k.SCALE + 4] = s.scale
        return vector

    def feed_samples(self, samples: Array, track: Array | None = None, channel: Channel = "best") -> int:
        """See `Timeline.feed_samples`."""
        kept = 0
        for i, sample in enumerate(samples.tolist()):
            before = self._before()
            kept += self._insert("imu", self._samples, tuple(sample))
            self._advance(self._state, math.inf, live=True)
            self._absorb(before)
            self._forget()
            if track is not None:
                state, row = self._state, track[i]
                row[0] = state.t
                if not state.initialised:
                    row[1:] = np.nan
                    continue
                row[1:4], row[4:] = state.main.position, state.main.attitude
                if channel == "smooth":
                    e = self._smoother.offset(state.t)
                    row[1:4] += e[:3]
                    row[4:] = quaternion_from_rotation(exp_so3(e[3:]) @ state.main.rotation)
        return kept

    def feed_wheels(self, samples: Array) -> int:
        """See `Timeline.feed_wheels`."""
        kept = 0
        for reading in samples.tolist():
            before = self._before()
            kept += self._insert("wheel", self._readings, tuple(reading))
            self._advance(self._state, math.inf, live=True)
            self._absorb(before)
            self._forget()
        return kept

    def feed_fix(self, row: Array) -> int:
        """See `Timeline.feed_fix`."""
        if not self._plausible(float(row[k.F_T])):
            return k.TOO_LATE
        key = self._fix_key(row)
        place = bisect.bisect_left(self._fixes, key, key=self._fix_key)
        if place < len(self._fixes) and self._fix_key(self._fixes[place]) == key:
            return k.DUPLICATE
        t = float(row[k.F_T])
        before = self._before()
        if not self._precedes_fix(self._state, t, place) and not self._rewind(
            t, lambda state: self._precedes_fix(state, t, place)
        ):
            return k.TOO_LATE
        self._fixes.insert(place, row.copy())
        self._waiting += 1
        self._horizon = max(self._horizon, t)
        self._advance(self._state, math.inf, live=True)
        self._absorb(before)
        self._forget()
        return k.PENDING

    def judged(self) -> list[Array]:
        """See `Timeline.judged`."""
        rows = []
        for row in self._fixes if self._waiting else []:
            if row[k.F_OUTCOME] != k.PENDING and not row[k.F_REPORTED]:
                row[k.F_REPORTED] = 1.0
                rows.append(row.copy())
        self._waiting -= len(rows)
        return rows

    def _before(self) -> tuple[bool, int, int, Array, Moving]:
        """What must be known of the state before an input, to smooth what it does."""
        s = self._state
        return s.initialised, self._figures["rewinds"], s.fix_cursor, s.main.corrected, self._moving()

    def _moving(self) -> Moving:
        s = self._state
        f = s.main
        fresh_until, u = s.t_imu + self._params.imu_gap, f.bias if s.bridging else s.u
        return Moving(s.t, fresh_until, f.position, f.rotation, f.velocity, u, f.bias, s.reset_id)

    def _absorb(self, before: tuple[bool, int, int, Array, Moving]) -> None:
        started, rewinds, cursor, corrected, moving = before
        now = self._state.main.corrected
        plain = self._figures["rewinds"] == rewinds and self._state.fix_cursor == cursor
        if started and not (plain and now is corrected):
            self._smoother.absorb(moving, self._moving(), now - corrected if plain else None)

    def pose_at(self, t: float, channel: Channel = "best") -> Array | None:
        """See `Timeline.pose_at`."""
        fixes, readings = self._fixes, self._readings
        if t >= self._state.t:
            state = self._state.copy()
            fixes, readings = [], []
        else:
            earlier = [checkpoint for checkpoint in self._checkpoints if checkpoint.t <= t]
            if not earlier:
                return None
            state = earlier[-1].copy()
        self._advance(state, t, live=False)
        if state.imu_cursor < len(self._samples) and t < self._state.t:
            self._head_for(state, self._samples[state.imu_cursor])
            if t > state.t:
                self._run_to(state, t, fixes, readings)
        elif state.initialised or fixes:
            state.next_t, state.next_u = math.inf, state.u
            fresh = state.t_imu + self._params.imu_gap
            # A pause that is known to be one is bridged from its start.
            legs = [(False, min(t, fresh)), (True, t)] if self._horizon <= fresh else [(True, t)]
            for bridging, leg in legs:
                if leg > state.t:
                    state.bridging = bridging
                    self._run_to(state, leg, fixes, readings)
        if not state.initialised:
            return None
        self._settle(state)
        out = self._pose(state)
        if channel == "smooth":
            out[k.P_RESET_ID], out[k.P_STEP : k.P_STEP + 6] = self._smoother.resets, self._smoother.step
            if t >= self._state.t:
                e = self._smoother.publish(t)
                out[k.P_POS : k.P_POS + 3] += e[:3]
                out[k.P_QUAT : k.P_QUAT + 4] = quaternion_from_rotation(exp_so3(e[3:]) @ state.main.rotation)
                out[k.P_COV : k.P_COV + 36] += np.outer(e, e).ravel()
        return out

    # --- the timeline

    @staticmethod
    def _fix_key(row: Array) -> list[float]:
        return [row[k.F_T], *row[k.F_COUNT : k.F_OUTCOME].tolist()]

    def _precedes_fix(self, state: _State, t: float, place: int) -> bool:
        return state.fix_cursor <= place and state.t < t + state.td_applied

    def _precedes_sample(self, state: _State, t: float) -> bool:
        return state.t < t and (not state.trailing or t - state.t_imu > self._params.imu_gap)

    def _rewind(self, t: float, precedes: Any) -> bool:
        if t < self._horizon - self._params.buffer:
            return False
        for i in range(len(self._checkpoints) - 1, -1, -1):
            if precedes(self._checkpoints[i]):
                self._state = self._checkpoints[i].copy()
                del self._checkpoints[i + 1 :]
                self._figures["rewinds"] += 1
                return True
        return False

    def _plausible(self, t: float) -> bool:
        """Whether a stamp may be true: one of the far future is not, two are a pause."""
        near = t <= self._horizon + k.FAR_AHEAD or math.isinf(self._horizon)
        if near or abs(t - self._ahead) <= self._params.buffer:
            return True
        self._ahead = t
        return False

    def _insert(self, kind: str, readings: list[tuple[float, ...]], reading: tuple[float, ...]) -> bool:
        """Put a reading of the IMU ("imu"), or of the wheels ("wheel"), in its place."""
        t = reading[0]
        if not self._plausible(t):
            self._figures[f"{kind}_late"] += 1
            return False
        place = len(readings)
        if place and t <= readings[-1][0]:
            place = bisect.bisect_right(readings, t, key=lambda other: other[0])
        replaces = False
        if place and readings[place - 1][0] == t:
            self._figures[f"{kind}_duplicates"] += 1
            replaces = _order(reading) < _order(readings[place - 1])
            if not replaces:
                return False

        def precedes(state: _State) -> bool:
            return self._precedes_sample(state, t) if kind == "imu" else state.t < t

        in_order = place == len(readings) and not replaces and precedes(self._state)
        if not in_order and not self._rewind(t, precedes):
            self._figures[f"{kind}_late"] += 1
            return False
        readings[place - replaces : place] = [reading]
        self._horizon = max(self._horizon, t)
        return True

    def _forget(self) -> None:
        """Drop what lies too far back for any input to be put before it. Seldom, and then much."""
        if len(self._checkpoints) <= 4 * k.CP_PER_BUFFER:
            return
        oldest = self._horizon - 1.5 * self._params.buffer
        keep = max(0, bisect.bisect_left(self._checkpoints, oldest, key=lambda state: state.t) - 1)
        first = self._checkpoints[keep]
        samples, fixes, readings = first.imu_cursor, first.fix_cursor, first.wheel_cursor
        del self._checkpoints[:keep]
        del self._samples[:samples]
        del self._fixes[:fixes]
        del self._readings[:readings]
        for state in (self._state, *self._checkpoints):
            state.imu_cursor -= samples
            state.fix_cursor -= fixes
            state.wheel_cursor -= readings

    def _head_for(self, state: _State, sample: tuple[float, ...]) -> None:
        """See `kernels._next_sample`."""
        state.next_t, rate, force = sample[0], sample[1:4], sample[4:]
        force2 = math.hypot(*force) ** 2
        if self._motion != "free" and state.force_count and not k.LEAST_FORCE2 < state.force2 < k.MOST_FORCE2:
            scale = GRAVITY / math.sqrt(max(state.force2, 1e-4 * GRAVITY**2))
            force = tuple([scale * f for f in force])
        last = state.u.tolist()
        gyro, accel = math.dist(rate, last[:3]) ** 2, math.dist(force, last[3:]) ** 2
        fastest, hardest = max(map(abs, rate)), max(map(abs, force))
        # of both sensors: so often has a reading that is the largest ever come twice in a row
        turns = _repeated(rate, last[:3], fastest, max(state.largest_gyro, k.SATURATED_GYRO))
        pushes = _repeated(force, last[3:], hardest, max(state.largest_accel, k.SATURATED_ACCEL))
        state.clipped_gyro += turns
        state.clipped_accel += pushes
        saturated = turns > 0 and state.clipped_gyro >= k.CLIPPED_OFTEN
        saturated |= pushes > 0 and state.clipped_accel >= k.CLIPPED_OFTEN
        state.same_run += 1
        if gyro + accel:
            state.same_run = 0
            state.force_count = min(state.force_count + 1, k.FORCE_SAMPLES)
            state.force2 += (min(force2, 100.0 * GRAVITY**2) - state.force2) / state.force_count
        state.bridging = sample[0] - state.t_imu > self._params.imu_gap or state.same_run >= k.STUCK_AFTER
        # what one sample alone may change by, and what none can
        spike = gyro > max(k.SPIKE**2 * state.change_gyro, k.SPIKE_GYRO**2)
        spike |= accel > max(k.SPIKE**2 * state.change_accel, k.SPIKE_ACCEL**2)
        known = state.largest_accel > 0.0
        impossible = gyro > k.IMPOSSIBLE_GYRO**2 or accel > k.IMPOSSIBLE_ACCEL**2
        state.suspect = impossible or (spike and not state.suspect and known)
        if state.suspect:
            state.next_u = state.u
        else:
            state.next_u = np.array(rate + force)
            if known:
                state.change_gyro += 0.02 * (gyro - state.change_gyro)
                state.change_accel += 0.02 * (accel - state.change_accel)
            if fastest > state.largest_gyro:
                state.largest_gyro, state.clipped_gyro = fastest, 0
            if hardest > state.largest_accel:
                state.largest_accel, state.clipped_accel = hardest, 0
        state.blind = saturated or state.suspect

    def _advance(self, state: _State, until: float, live: bool) -> None:
        while True:
            sample = None
            if state.imu_cursor < len(self._samples) and self._samples[state.imu_cursor][0] <= until:
                sample = self._samples[state.imu_cursor]
                self._head_for(state, sample)
                t = sample[0]
            elif live and self._horizon > state.t_imu + self._params.imu_gap:
                waiting = [reading[0] for reading in self._readings[state.wheel_cursor :][:1]]
                waiting += [float(fix[k.F_T]) + state.td_applied for fix in self._fixes[state.fix_cursor :][:1]]
                if not waiting:
                    return
                t = min(waiting)
                state.next_t, state.bridging = math.inf, True
            else:
                return
            self._run_to(state, t, self._fixes, self._readings)
            state.trailing = sample is None
            if sample is not None:
                if not state.initialised:
                    state.accel_count = min(state.accel_count + 1, 100)
                    step = (state.next_u[3:] - state.accel_mean) / state.accel_count
                    state.accel_mean = state.accel_mean + step
                elif math.floor(t * k.GRID_HZ) != state.grid_at:
                    self._watch(state)
                state.t_imu = t
                self._grid(state)
                state.imu_cursor += 1
            if live and state.t - self._checkpoints[-1].t >= self._params.buffer / k.CP_PER_BUFFER:
                self._checkpoints.append(state.copy())

    def _grid(self, state: _State) -> None:
        """The pseudo-measurements, where t has come to the next step of their grid."""
        step = math.floor(state.t * k.GRID_HZ)
        if step != state.grid_at:
            state.grid_at = step
            for f in state.filters if state.initialised else []:
                self._constrain(state, f)

    def _run_to(self, state: _State, t_end: float, fixes: list[Array], readings: list[tuple[float, ...]]) -> None:
        while True:
            t, fix, reading = t_end, None, None
            if state.fix_cursor < len(fixes) and fixes[state.fix_cursor][k.F_T] + state.td_applied <= t_end:
                fix = fixes[state.fix_cursor]
                t = float(fix[k.F_T]) + state.td_applied
            if state.wheel_cursor < len(readings) and readings[state.wheel_cursor][0] <= t:
                reading = readings[state.wheel_cursor]
                t = reading[0]
            dt = t - state.t
            if state.bridging:
                self._settle(state)
                dt = min(dt, k.MOST_BRIDGED)
            if dt > 0.0:
                part = 1.0
                if t < state.next_t and math.isfinite(state.t):
                    part = dt / (state.next_t - state.t)
                ahead = state.next_u if part == 1.0 else state.u + part * (state.next_u - state.u)
                for f in state.filters if state.initialised else []:
                    self._move(state, f, 0.5 * (state.u + ahead), t, dt)
                state.u = ahead
                state.t = t
            due = reading is not None or fix is not None
            if due or state.main.lag > k.LONGEST_LAG or math.floor(t * k.GRID_HZ) != state.grid_at:
                self._settle(state)
            if reading is not None:
                for f in state.filters if state.initialised else []:
                    self._odometry(state, f, reading)
                state.wheel_cursor += 1
            elif fix is not None:
                if state.initialised:
                    self._judge(state, fix)
                else:
                    self._initialise(state, fix)
                    fix[k.F_OUTCOME] = k.INIT
                state.td_applied = state.main.time_offset
                state.fix_cursor += 1
            else:
                return
            if state.bridging:
                self._grid(state)

    def _move(self, state: _State, f: ErrorStateFilter, u: Array, t: float, dt: float) -> None:
        """Carry a filter on to t, by the IMU's u (6,), or by itself while there is none."""
        p = self._params
        if state.bridging:
            # straight on, unless the wheels say how it turns
            turns = t - state.t_wheel <= p.imu_gap
            rate = [0.0, 0.0, state.wheel_rate if turns else 0.0]
            rate_noise = p.wheel_rate_sigma / math.sqrt(k.GRID_HZ) if turns else p.no_imu_rate_noise
            force = GRAVITY * f.rotation.T @ f.up
            f.move(f.bias + np.concatenate([rate, force]), dt, rate_noise, 0.0)
            f.spread(False, p.gyro_bias_walk, p.accel_bias_walk)
            f.slow(dt, p.no_imu_accel_noise)
            return
        shaken = math.sqrt(state.change_accel / 6.0 * min(state.next_t - state.t_imu, p.imu_gap))
        white = (p.gyro_noise * state.scale[1], max(p.accel_noise * state.scale[0], shaken - 2.0 * p.accel_noise))
        if state.blind:
            white = (state.largest_gyro * k.BLIND_TIME, state.largest_accel * k.BLIND_TIME)
        f.move(u, dt, *white)

    def _settle(self, state: _State) -> None:
        """Bring the covariances up to t by what the IMU has said, for whatever reads or changes them."""
        for f in state.filters:
            f.spread(True, self._params.gyro_bias_walk, self._params.accel_bias_walk)

    # --- measurements

    @staticmethod
    def _hypothesis(fix: Array, i: int) -> Array:
        return fix[k.F_HYPOTHESES + i * k.HYPOTHESIS : k.F_HYPOTHESES + (i + 1) * k.HYPOTHESIS]

    def _chosen(self, fix: Array) -> Array:
        return self._hypothesis(fix, int(fix[k.F_CHOSEN]))

    def _initialise(self, state: _State, fix: Array) -> None:
        scores = []
        for i in range(int(fix[k.F_COUNT])):
            pose = self._hypothesis(fix, i)
            up = rotation_from_quaternion(pose[k.H_QUAT : k.H_QUAT + 4])[2]
            denied = (state.accel_mean - GRAVITY * up) / k.GRAVITY_SIGMA if state.accel_count else np.zeros(3)
            scores.append(float(pose[k.H_MISFIT] + denied @ denied))
        order = np.argsort(scores, kind="stable")
        filters = [self._first(state, self._hypothesis(fix, i)) for i in order]
        state.main = filters[0]
        state.systematic = self._hypothesis(fix, order[0])[k.H_SYSTEMATIC :]
        if len(filters) > 1:
            state.shadow, state.shadow_count, state.twins, state.lead = filters[1], 1, True, 0.0
        state.initialised = True
        state.accepted_count = 1
        state.t_accepted = state.t

    def _first(self, state: _State, hypothesis: Array) -> ErrorStateFilter:
        """A filter that starts from a pose, its tilt corrected by gravity."""
        f = ErrorStateFilter()
        f.P = self._prior()
        f.start(hypothesis, self._params.velocity_sigma, self._rate(state, f))
        if state.accel_count:
            force = GRAVITY * f.rotation.T @ f.up
            H = np.zeros((3, N))
            H[:, TH] = skew(force)
            H[:, DBA] = _I3
            H[:, DTILT] = GRAVITY * f.rotation.T[:, :2]
            y, R = state.accel_mean - force, k.GRAVITY_SIGMA**2 * _I3
            if _d2(H @ f.P @ H.T + R, y) <= self._params.gate_block:
                f.correct(H, y, R)
        return f

    def _prior(self) -> Array:
        p = self._params
        sigmas = [0.0] * 9 + [p.gyro_bias_sigma] * 3 + [p.accel_bias_sigma] * 3 + [p.time_offset_sigma]
        return np.diag(np.square([*sigmas, *[p.tilt_sigma] * 2, *[p.wheel_scale_sigma] * 2]))

    def _score(self, state: _State, f: ErrorStateFilter, fix: Array) -> float:
        """Of the hypothesis that fits a filter best, see `kernels._weigh`."""
        rate = self._rate(state, f)
        scores = []
        for i in range(int(fix[k.F_COUNT])):
            H, y, R = f.fix_model(self._hypothesis(fix, i), rate, self._params.stamp_jitter)
            S = H @ f.P @ H.T + self._rescaled(state, R)
            scores.append(_d2(S, y) + np.linalg.slogdet(S)[1] + self._hypothesis(fix, i)[k.H_MISFIT])
        return float(min(scores))

    def _tell_apart(self, state: _State, fix: Array) -> None:
        """Which of the first fix's poses was it? See `kernels._judge`."""
        p, other = self._params, state.shadow
        assert other is not None
        state.lead += self._score(state, other, fix) - self._score(state, state.main, fix)
        if state.lead < 0.0:
            state.lead = -state.lead
            state.main, other = other, state.main
            state.shadow = other
        if state.lead > k.CLEAR_LEAD:
            state.twins, state.shadow, state.shadow_count = False, None, 0
            return
        H, y, R, _ = self._weigh(state, other, fix)
        if fix[k.F_D2] <= p.gate * p.gate_inflation:
            other.correct(H, y, R)

    def _weigh(self, state: _State, f: ErrorStateFilter, fix: Array) -> tuple[Array, Array, Array, Array]:
        """Choose the hypothesis, write the fix's figures. -> H, y, R, S."""
        rate = self._rate(state, f)
        scores, models = [], []
        for i in range(int(fix[k.F_COUNT])):
            H, y, R = f.fix_model(self._hypothesis(fix, i), rate, self._params.stamp_jitter)
            models.append((H, y, R))
            S = H @ f.P @ H.T + self._rescaled(state, R)
            scores.append(_d2(S, y) + np.linalg.slogdet(S)[1] + self._hypothesis(fix, i)[k.H_MISFIT])
        chosen = int(np.argmin(scores))
        margin = abs(scores[0] - scores[1]) if len(scores) == 2 else math.inf
        H, y, R = models[chosen]
        if margin < self._params.hypothesis_margin:
            B = f.rotation
            R[3:, 3:] += k.UNKNOWN_TILT_SIGMA**2 * (np.outer(B[0], B[0]) + np.outer(B[1], B[1]))
        R = self._rescaled(state, R)
        S = H @ f.P @ H.T + R
        fix[k.F_D2] = _d2(S, y)
        fix[k.F_D2_POSITION] = _d2(S[:3, :3], y[:3])
        fix[k.F_D2_ATTITUDE] = _d2(S[3:, 3:], y[3:])
        fix[k.F_CHOSEN] = chosen
        fix[k.F_MARGIN] = margin
        fix[k.F_INNOVATION : k.F_INNOVATION + 6] = y
        fix[k.F_SIGMA : k.F_SIGMA + 6] = np.sqrt(np.diag(S))
        return H, y, R, S

    @staticmethod
    def _rate(state: _State, f: ErrorStateFilter) -> Array:
        return np.zeros(3) if state.bridging else state.u[:3] - f.gyro_bias

    @staticmethod
    def _rescaled(state: _State, R: Array) -> Array:
        R = R.copy()
        R[:3, :3] *= state.scale[2]
        R[3:, 3:] *= state.scale[3]
        return R

    def _adapt(self, state: _State, figures: Array, most: float) -> None:
        """See `kernels._adapt`."""
        e = figures[k.F_INNOVATION - k.F_D2 :][:6] / figures[k.F_SIGMA - k.F_D2 :][:6]
        before, state.last_innovation = state.last_innovation, e
        state.excess, state.scale = list(state.excess), list(state.scale)
        weight = min(max((state.t - state.t_adapted) * k.ADAPTATION_HZ, 0.0), 1.0)
        gain = weight * self._params.adaptation * max(1.0, 20.0 / (state.adapted + 6.0))
        state.adapted += weight
        state.t_adapted = state.t
        for block, half in enumerate((slice(0, 3), slice(3, 6))):
            d2 = float(e[half] @ e[half])
            length = float(before[half] @ before[half])
            follows = float(e[half] @ before[half]) / (math.sqrt(d2 * length) + 1.0)
            more = min(d2 / 3.0 - 1.0, most)
            to_process = min(max(0.5 + follows, 0.0), 1.0)
            for i, part in ((block, to_process), (block + 2, 1.0 - to_process)):
                excess = state.excess[i] + gain * part * more
                state.excess[i] = min(max(excess, k.LEAST_EXCESS), k.MOST_EXCESS)
                factor = math.exp(max(state.excess[i] - k.IGNORED_EXCESS, 0.0))
                state.scale[i] = math.sqrt(factor) if i < 2 else factor

    def _restarted(self, state: _State, fix: Array, count: int) -> None:
        """See `kernels._restarted`."""
        state.shadow, state.shadow_count, state.rejected_run = None, 0, 0
        state.accepted_count = count
        state.reset_id += 1
        state.t_accepted = state.t
        state.main.reopen(DTD, self._params.time_offset_sigma**2)
        state.systematic = self._chosen(fix)[k.H_SYSTEMATIC :]
        fix[k.F_OUTCOME] = k.REINIT

    def _judge(self, state: _State, fix: Array) -> None:
        p = self._params
        if state.twins:
            self._tell_apart(state, fix)
        main, shadow = state.main, None if state.twins else state.shadow
        H, y, R, S = self._weigh(state, main, fix)
        if main.P.diagonal()[TH].max() > 2.0 * k.UNKNOWN_HEADING**2:
            # after so long without an IMU nothing is left to weigh the fix by
            main.start(self._chosen(fix), p.velocity_sigma, self._rate(state, main))
            self._restarted(state, fix, 1)
            return
        ratio = self._gate_ratio(fix)
        figures = fix[k.F_D2 : k.F_REPORTED].copy()
        if state.still_since < state.t:
            state.still_fixes = n = state.still_fixes + 1
            share = p.fix_correlation
            if n > 1 and share > 0.0:
                one, two = share + (1.0 - share) / (n - 1), share + (1.0 - share) / n
                more = one * two / (one - two) - 1.0
                S, R = S + more * R, R + more * R
        if fix[k.F_D2_POSITION] > k.LEAVE_STILL:
            state.still_since, state.still_barred = math.inf, state.t + k.STILL_PAUSE
        if ratio <= p.gate_inflation:
            self._adapt(state, figures, k.MOST_TAUGHT)
            fix[k.F_OUTCOME] = k.ACCEPTED
            if ratio > 1.0:
                fix[k.F_OUTCOME] = k.INFLATED
                R = R + (ratio - 1.0) * S
            main.correct(H, y, R)
            state.rejected_run = 0
            if not state.twins:
                state.shadow, state.shadow_count = None, 0
            state.accepted_count += 1
            state.t_accepted = state.t
            state.systematic = self._chosen(fix)[k.H_SYSTEMATIC :]
            state.place_count = n = min(state.place_count + 1, int(k.PLACE_FIXES))
            off = main.position - state.place
            state.place = state.place + off / n
            state.place2 = state.place2 + (off * off * (n - 1) / n - state.place2) / n
            return
        partly = bool(fix[k.F_D2_POSITION] <= p.gate_block)
        fix[k.F_OUTCOME] = k.REJECTED
        if partly:
            # turned, or flipped, it is still where it is
            fix[k.F_OUTCOME] = k.INFLATED
            alone = k.UNKNOWN_HEADING**2 * np.eye(6)
            alone[:3, :3] = R[:3, :3]
            main.correct(H, y, alone)
            state.t_accepted = state.t
        state.twins = False
        if shadow is None:
            state.rejected_since = state.t
        patient = state.t - state.rejected_since >= p.reinit_patience
        known = state.accepted_count >= 2 * p.reinit_count
        agrees = False
        if shadow is not None:
            H, y, R, S = self._weigh(state, shadow, fix)
            ratio = self._gate_ratio(fix)
            agrees = ratio <= p.gate_inflation
            R = R + max(ratio - 1.0, 0.0) * S
            fix[k.F_D2 : k.F_REPORTED] = figures
        y_main = figures[k.F_INNOVATION - k.F_D2 : k.F_SIGMA - k.F_D2]
        far = float(np.linalg.norm(y_main[:3])) > k.OUTLIER_DISTANCE
        turned = float(np.linalg.norm(y_main[3:])) > p.reinit_angle
        if shadow is not None and agrees:
            shadow.correct(H, y, R)
        state.rejected_run += 1
        if agrees or not (far or turned) or state.rejected_run >= p.reinit_count:
            self._adapt(state, figures, 0.0 if turned else k.MOST_TAUGHT)
        if shadow is not None and agrees:
            state.shadow_count += 1
            take = state.shadow_count >= p.reinit_count and (
                patient or not known or self._attitudes_agree(state, main, shadow)
            )
        else:
            shadow = _shallow_copy(main)
            if not known:
                shadow = ErrorStateFilter()
                shadow.P = self._prior()
            shadow.start(self._chosen(fix), p.velocity_sigma, self._rate(state, shadow))
            state.shadow, state.shadow_count = shadow, 1
            take = patient or (state.rejected_run >= 2 * p.reinit_count and not (turned and partly))
        if take:
            state.main = shadow
            self._restarted(state, fix, state.shadow_count)

    def _gate_ratio(self, fix: Array) -> float:
        p = self._params
        blocks = max(fix[k.F_D2_POSITION], fix[k.F_D2_ATTITUDE]) / p.gate_block
        return float(max(fix[k.F_D2] / p.gate, blocks))

    def _attitudes_agree(self, state: _State, main: ErrorStateFilter, shadow: ErrorStateFilter) -> bool:
        p = self._params
        y = log_so3(main.rotation.T @ shadow.rotation)
        if _d2(main.P[TH, TH] + shadow.P[TH, TH], y) <= p.gate_block:
            return True
        return state.shadow_count >= 2 * p.reinit_count and float(np.linalg.norm(y)) <= p.reinit_angle

    def _watch(self, state: _State) -> None:
        """Is the robot at rest? See `kernels._watch`."""
        p = self._params
        t = state.t
        first = bisect.bisect_left(self._samples, -k.STILL_WINDOW, key=lambda sample: sample[0] - t)
        window = np.array(self._samples[first : state.imu_cursor + 1])[:, 1:]
        n = len(window)
        still = False
        if first > 0 and n >= 4:
            # around the newest, so that a sensor that is stuck scatters by nothing at all
            off = window - window[-1]
            mean = off.sum(axis=0) / n
            off = off - mean
            variances = (np.einsum("ij,ij->j", off, off) / (n - 1)).tolist()
            scatter = [sum(variances[:3]), sum(variances[3:])]
            middle = window[-1] + mean
            state.still_mean, force = middle[:3], middle[3:]
            if math.isinf(state.still_since):
                state.still_force = force
            pushed = math.dist(force, state.still_force)
            state.still_force = state.still_force + 0.05 * (force - state.still_force)
            rate = math.dist(state.still_mean, state.main.gyro_bias)
            state.rest = [min(r * 1.001, s) if r > 0.0 else s for r, s in zip(state.rest, scatter, strict=True)]
            speed2 = float(state.main.velocity.dot(state.main.velocity))
            if speed2 > 4.0 * p.still_speed**2:
                state.moving = [m + 0.02 * (s - m) for m, s in zip(state.moving, scatter, strict=True)]
                if t - state.t_accepted < 1.0:
                    state.usual_speed2 += (speed2 / 3.0 - state.usual_speed2) / (60.0 * k.GRID_HZ)
            state.still_sure = any(m > 30.0 * r for m, r in zip(state.moving, state.rest, strict=True))
            P = state.main.P.diagonal().tolist()
            unsure = 3.0 * math.sqrt(sum(P[DBG]))
            sigma2 = sum(P[DV]) + k.STILL_SPEED_SIGMA**2
            still = (
                scatter[0] <= 9.0 * state.rest[0] + 1e-6
                and scatter[1] <= 9.0 * state.rest[1] + 1e-4
                and pushed < k.STILL_PUSH + 4.0 * math.sqrt(scatter[1] / n)
                and t > state.still_barred
                and rate < p.still_rate + unsure
                and speed2 < p.still_speed**2
                and speed2 < (9.0 if state.still_sure else 2.25) * sigma2
            )
        if not still:
            state.still_since, state.still_fixes = math.inf, 0
        elif math.isinf(state.still_since):
            state.still_since = t

    def _constrain(self, state: _State, f: ErrorStateFilter) -> None:
        """Pseudo-measurements, see `kernels._constrain`: rows of H, innovations and variances."""
        p = self._params
        ground, wheels = self._motion != "free", self._motion == "differential"
        factor = 1.0 if state.still_sure else 3.0
        still = state.t - state.t_imu <= p.imu_gap and state.still_since <= state.t - k.STILL_AFTER * (
            1.0 if state.still_sure else 2.0
        )
        if p.time_offset_sigma > 0.0:
            f.P = f.P + k.TIME_OFFSET_WALK**2 / k.GRID_HZ * np.outer(_I[DTD], _I[DTD])
        # how much looser or tighter each constraint is than it was meant; not tighter for roll and pitch
        loose = [max(n, 1.0 if i in (1, 2) else k.LEAST_CONSTRAINT) for i, n in enumerate(state.constraint_nis)]

        def loosened(sigma: float, i: int, y: float) -> float:
            return max(sigma**2 * loose[i], float(y * y))

        body = f.rotation.T.dot(f.velocity)
        usual = max(state.usual_speed2, k.LEAST_SPEED**2) * 2.0 * k.SPEED_TIME * k.GRID_HZ
        variances = [(factor * k.STILL_SPEED_SIGMA) ** 2 if still else usual] * 3
        if wheels and not still:
            variances[1] = loosened(p.wheel_velocity_sigma, 3, body[1])
        # a speed that is known a thousand times better learns nothing from what is usual
        known = np.diag(f.P)[DV] < 1e-3 * usual
        axes = [i for i in range(3) if still or (wheels and i == 1) or not known[i]]
        H = np.zeros((12, N))
        H[: len(axes), DV], H[: len(axes), TH] = _I3[axes], skew(body)[axes]
        y = (-body[axes]).tolist()
        variances = [variances[i] for i in axes]
        if state.t - state.t_accepted > k.COAST_TIME and state.place_count > 10:
            H[len(y) : len(y) + 3, DP] = f.rotation
            y += (state.place - f.position).tolist()
            variances += (np.maximum(state.place2, k.LEAST_PLACE**2) * 2.0 * k.PLACE_TIME * k.GRID_HZ).tolist()
        if still:
            H[len(y) : len(y) + 3, DBG] = _I3
            y += (state.still_mean - f.gyro_bias).tolist()
            variances += [(2.0 * p.gyro_noise) ** 2 * k.GRID_HZ] * 3
        if ground:
            up = f.rotation.T[:, 2]
            m = len(y)
            H[m, DV] = up
            H[m + 1 : m + 3, TH] = skew(up)[:2]
            y += [-f.velocity[2], -up[0], -up[1]]
            sigmas = (p.ground_velocity_sigma, p.ground_tilt_sigma, p.ground_tilt_sigma)
            variances += [loosened(sigma, i, y[m + i]) for i, sigma in enumerate(sigmas)]
        m = len(y)
        if f is state.main and ground and not still:
            state.constraint_nis = state.constraint_nis.copy()
            meant = [sigma**2 for sigma in (*sigmas, p.wheel_velocity_sigma)]
            for i, row in enumerate([m - 3, m - 2, m - 1, axes.index(1)] if wheels else [m - 3, m - 2, m - 1]):
                expected = meant[i] * loose[i] + H[row] @ f.P @ H[row]
                now = min(y[row] ** 2 / expected, 9.0) * loose[i]
                state.constraint_nis[i] += 0.05 * (now - state.constraint_nis[i])
        if m:
            f.correct(H[:m], np.array(y), np.diag(variances))

    def _odometry(self, state: _State, f: ErrorStateFilter, reading: tuple[float, ...]) -> None:
        """A reading of the wheels, see `kernels._odometry`. The main filter comes first, and does the bookkeeping."""
        p = self._params
        if f is state.main:
            since, state.t_wheel = state.t - state.t_wheel, state.t
            state.wheel_share = max(1.0 / (k.GRID_HZ * max(since, 1e-3)), 1.0)
            state.wheel_rate = 0.0 if math.isnan(reading[2]) else reading[2] / (1.0 + float(f.wheel_scale[1]))
        body = f.rotation.T @ f.velocity
        H = np.zeros((2, N))
        H[0, DV], H[0, TH] = _I3[0], skew(body)[0]
        H[1, DBG] = -_I3[2]
        H *= (1.0 + f.wheel_scale)[:, np.newaxis]
        values = np.array([body[0], state.u[2] - f.gyro_bias[2]])
        H[:, DWHEEL] = np.diag(values)
        y = np.array(reading[1:]) - (1.0 + f.wheel_scale) * values
        rows, variances, nis = [], [], list(state.wheel_nis)
        if f is state.main:
            state.slips = False
        for i, sigma in enumerate((p.wheel_speed_sigma, p.wheel_rate_sigma)):
            if math.isnan(y[i]) or (i == 1 and state.bridging):
                continue
            variance = sigma**2 * state.wheel_share
            if f is state.main:
                off = y[i] ** 2 / (variance + H[i] @ f.P @ H[i])
                state.slips |= bool(i == 1 and off > k.SLIPS)
                nis[i] += 0.05 / state.wheel_share * (min(off, k.SLIPS) - nis[i])
            rows.append(i)
            if i == 0:
                variance = max(variance, float(y[i] ** 2) * state.wheel_share)
            variances.append(variance * max(nis[i], 1.0))
        state.wheel_nis = nis
        if rows and not state.slips:
            f.correct(H[rows], y[rows], np.diag(variances))

    def _pose(self, state: _State) -> Array:
        f = state.main
        out = np.zeros(k.POSE)
        out[k.P_T] = state.t
        out[k.P_POS : k.P_POS + 3] = f.position
        out[k.P_QUAT : k.P_QUAT + 4] = f.attitude
        out[k.P_VEL : k.P_VEL + 3] = f.velocity
        out[k.P_RATE : k.P_RATE + 3] = 0.0 if state.bridging else state.u[:3] - f.gyro_bias
        turn = np.kron(np.eye(2), f.rotation)
        order = np.r_[6:9, 0:3]
        out[k.P_COV : k.P_COV + 36] = (turn @ f.P[np.ix_(order, order)] @ turn.T).ravel() + state.systematic
        out[k.P_VCOV : k.P_VCOV + 9] = (f.rotation @ f.P[DV, DV] @ f.rotation.T).ravel()
        out[k.P_T_ACCEPTED], out[k.P_RESET_ID], out[k.P_T_IMU] = state.t_accepted, state.reset_id, state.t_imu
        return out
