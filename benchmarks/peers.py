"""What one would otherwise take for the task of `benchmarks.fusion`: each does it as well as the library lets it.

All are told the true noise, `PARAMS`. Libraries are imported where they are used, as most are not the project's.
"""

from __future__ import annotations

import bisect
import math
from datetime import datetime, timedelta
from typing import Any, NamedTuple, Protocol

import msgspec
import numpy as np

from benchmarks.replay import without_imu
from fusion.consistency import hold_last, interpolate
from fusion.geometry import quaternion_from_rotation, rotation_from_quaternion, skew, yaw_of
from fusion.measurements import Array, PoseFix
from fusion.params import GRAVITY, FilterParams
from fusion.simulator import ImuParams, Simulation, TriadParams
from server.recording import Recording

# A good MEMS IMU, as its datasheet has it; mounted on a robot it is several times noisier, which hits all alike.
TRUE = FilterParams(gyro_noise=2e-4, accel_noise=2e-3, gyro_bias_walk=1e-5, accel_bias_walk=1e-4)
IMU = ImuParams(
    gyro=TriadParams(TRUE.gyro_noise, TRUE.gyro_bias_sigma, TRUE.gyro_bias_walk),
    accel=TriadParams(TRUE.accel_noise, TRUE.accel_bias_sigma, TRUE.accel_bias_walk),
)
# Only what all have: no search for errors of clock, floor and noise, none of which the simulation has, nor for rest.
PARAMS = msgspec.structs.replace(
    TRUE, time_offset_sigma=0.0, tilt_sigma=0.0, still_speed=0.0, fix_correlation=0.0, adaptation=0.0
)


class Estimator(Protocol):
    """Takes measurements in order of arrival."""

    def imu(self, samples: Array, track: Array) -> None:
        """Samples (n, 7) as in `ImuBatch`; writes the pose after each to `track` (n, 8), but for its first column."""

    def fix(self, fix: PoseFix) -> None:
        """A fix that has just arrived."""


def row_of(fix: PoseFix) -> Array:
    """(8,): a fix as a row of a track."""
    return np.array([fix.t, *fix.hypotheses[0].position, *fix.hypotheses[0].quaternion_wxyz])


def input_at(samples: Array, t: float) -> Array:
    """(7,): the IMU's sample at t, interpolated."""
    i = min(max(int(np.searchsorted(samples[:, 0], t)), 1), len(samples) - 1)
    a, b = samples[i - 1], samples[i]
    row: Array = a + (t - a[0]) / (b[0] - a[0]) * (b - a)
    return row


# ---------------------------------------------------------------------------------- one textbook filter, two libraries

_I3, _I15 = np.eye(3), np.eye(15)
DP, DV, TH, DBG, DBA = (slice(i, i + 3) for i in range(0, 15, 3))


def exp(v: Array) -> Array:
    """(3, 3) of a rotation vector, in scalars, which is four times as fast as with vectors."""
    x, y, z = v.tolist()
    angle = math.sqrt(x * x + y * y + z * z)
    a, b = (math.sin(angle) / angle, (1.0 - math.cos(angle)) / angle**2) if angle > 1e-9 else (1.0, 0.5)
    return np.array(
        [
            [1.0 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y],
            [b * x * y + a * z, 1.0 - b * (x * x + z * z), b * y * z - a * x],
            [b * x * z - a * y, b * y * z + a * x, 1.0 - b * (x * x + y * y)],
        ]
    )


def rotation_vector(R: Array) -> Array:
    """(3,) of a small rotation."""
    w, *v = quaternion_from_rotation(R)
    rotation: Array = 2.0 / w * np.array(v)
    return rotation


class State(NamedTuple):
    """At one instant; `belief` holds the error's covariance, as its library keeps it. No array is changed in place."""

    t: float
    u: Array
    p: Array
    v: Array
    R: Array
    bg: Array
    ba: Array
    belief: Any


class TextbookFilter:
    """Error-state EKF with fifteen states: J. Solà, "Quaternion kinematics for the error-state Kalman filter" (2017),
    chapters 5 and 6, error of the attitude in body axes. A late fix is applied to the state stored before it, moved to
    its very instant, and the samples since are done again. The library does the covariance.
    """

    def __init__(self, _: Simulation) -> None:
        self.states: list[State] = []
        noise = [0.0, PARAMS.accel_noise, PARAMS.gyro_noise, PARAMS.gyro_bias_walk, PARAMS.accel_bias_walk]
        self.Q_per_second = np.diag(np.repeat(np.square(noise), 3))

    def start(self, t: float, P: Array) -> Any:
        raise NotImplementedError

    def predict(self, belief: Any, t: float, F: Array, Q: Array) -> Any:
        raise NotImplementedError

    def update(self, belief: Any, t: float, H: Array, y: Array, R: Array) -> tuple[Array, Any]:
        raise NotImplementedError

    def imu(self, samples: Array, track: Array) -> None:
        for i in range(len(samples)):
            if self.states:
                state = self.move(self.states[-1], float(samples[i, 0]), samples[i, 1:])
                self.states.append(state)
                track[i, 1:4], track[i, 4:] = state.p, quaternion_from_rotation(state.R)

    def move(self, s: State, t: float, u: Array) -> State:
        dt = t - s.t
        mean = 0.5 * (s.u + u)
        R = s.R @ exp((mean[:3] - s.bg) * dt)
        force = mean[3:] - s.ba
        kick = 0.5 * dt * (s.R + R) @ force
        kick[2] -= GRAVITY * dt
        F = _I15.copy()
        F[DP, DV] = dt * _I3
        F[DV, TH] = s.R @ skew(-dt * force)
        F[DV, DBA] = -dt * s.R
        F[TH, TH] = R.T @ s.R
        F[TH, DBG] = -dt * _I3
        belief = self.predict(s.belief, t, F, dt * self.Q_per_second)
        return State(t, u, s.p + (s.v + 0.5 * kick) * dt, s.v + kick, R, s.bg, s.ba, belief)

    def fix(self, fix: PoseFix) -> None:
        seen = fix.hypotheses[0]
        R_fix = rotation_from_quaternion(seen.quaternion_wxyz)
        noise = seen.covariance.copy()
        noise[3:, 3:] = R_fix.T @ noise[3:, 3:] @ R_fix
        if not self.states:
            P = np.diag(
                np.repeat(
                    np.square([0.0, PARAMS.velocity_sigma, 0.0, PARAMS.gyro_bias_sigma, PARAMS.accel_bias_sigma]), 3
                )
            )
            P[DP, DP], P[TH, TH] = noise[:3, :3], noise[3:, 3:]
            at_rest, zero = np.array([0.0, 0.0, 0.0, 0.0, 0.0, GRAVITY]), np.zeros(3)
            belief = self.start(fix.t, P)
            self.states = [State(fix.t, at_rest, seen.position, zero, R_fix, zero, zero, belief)]
            return
        after = bisect.bisect_right(self.states, fix.t, key=lambda state: state.t)
        again = self.states[after:]
        del self.states[after:], self.states[: max(after - 200, 0)]
        before = self.states[-1]
        share = (fix.t - before.t) / (again[0].t - before.t)
        s = self.move(before, fix.t, before.u + share * (again[0].u - before.u))
        H = np.zeros((6, 15))
        H[:3, DP] = H[3:, TH] = _I3
        y = np.concatenate([seen.position - s.p, rotation_vector(s.R.T @ R_fix)])
        dx, belief = self.update(s.belief, s.t, H, y, noise)
        R = rotation_from_quaternion(quaternion_from_rotation(s.R @ exp(dx[TH])))
        s = State(s.t, s.u, s.p + dx[DP], s.v + dx[DV], R, s.bg + dx[DBG], s.ba + dx[DBA], belief)
        self.states.append(s)
        for old in again:
            s = self.move(s, old.t, old.u)
            self.states.append(s)


def filterpy(simulation: Simulation) -> Estimator:
    from filterpy.kalman import ExtendedKalmanFilter

    ekf = ExtendedKalmanFilter(dim_x=15, dim_z=6)
    ekf.x = np.zeros(15)

    class Filter(TextbookFilter):
        def start(self, t: float, P: Array) -> Any:
            return P

        def predict(self, belief: Any, t: float, F: Array, Q: Array) -> Any:
            ekf.P, ekf.F, ekf.Q = belief, F, Q
            ekf.predict()
            return ekf.P

        def update(self, belief: Any, t: float, H: Array, y: Array, R: Array) -> tuple[Array, Any]:
            ekf.P = belief
            ekf.update(y, lambda _: H, lambda _: np.zeros(6), R)
            dx, ekf.x = ekf.x, np.zeros(15)
            return dx, ekf.P

    return Filter(simulation)


def stone_soup(simulation: Simulation) -> Estimator:
    from stonesoup.models.measurement.linear import LinearGaussian
    from stonesoup.models.transition.linear import LinearGaussianTransitionModel
    from stonesoup.predictor.kalman import KalmanPredictor
    from stonesoup.types.detection import Detection
    from stonesoup.types.hypothesis import SingleHypothesis
    from stonesoup.types.state import GaussianState
    from stonesoup.updater.kalman import KalmanUpdater

    class ErrorModel(LinearGaussianTransitionModel):  # type: ignore[misc]
        F, Q = _I15, _I15
        ndim_state = 15

        def matrix(self, **_: Any) -> Array:
            return self.F

        def covar(self, **_: Any) -> Array:
            return self.Q

    model = ErrorModel()
    predictor, updater = KalmanPredictor(model), KalmanUpdater()
    zero = np.zeros((15, 1))
    seen = [*range(*DP.indices(15)), *range(*TH.indices(15))]

    def stamp(t: float) -> datetime:
        return datetime(2000, 1, 1) + timedelta(seconds=t)

    class Filter(TextbookFilter):
        def start(self, t: float, P: Array) -> Any:
            return GaussianState(zero, P, timestamp=stamp(t))

        def predict(self, belief: Any, t: float, F: Array, Q: Array) -> Any:
            model.F, model.Q = F, Q
            return predictor.predict(belief, timestamp=stamp(t))

        def update(self, belief: Any, t: float, H: Array, y: Array, R: Array) -> tuple[Array, Any]:
            detection = Detection(
                y[:, np.newaxis], timestamp=stamp(t), measurement_model=LinearGaussian(15, seen, noise_covar=R)
            )
            posterior = updater.update(SingleHypothesis(belief, detection))
            dx = np.asarray(posterior.state_vector, dtype=np.float64).ravel()
            return dx, GaussianState(zero, np.asarray(posterior.covar), timestamp=stamp(t))

    return Filter(simulation)


# ---------------------------------------------------------------------------------------------------------- gtsam


class Gtsam:
    """Nodes and factors that the two rows of gtsam share. Node k has pose, velocity and bias."""

    def __init__(self) -> None:
        import gtsam

        self.g = gtsam
        self.imu_params = gtsam.PreintegrationCombinedParams.MakeSharedU(GRAVITY)
        self.imu_params.setGyroscopeCovariance(PARAMS.gyro_noise**2 * _I3)
        self.imu_params.setAccelerometerCovariance(PARAMS.accel_noise**2 * _I3)
        self.imu_params.setBiasOmegaCovariance(PARAMS.gyro_bias_walk**2 * _I3)
        self.imu_params.setBiasAccCovariance(PARAMS.accel_bias_walk**2 * _I3)
        self.imu_params.setIntegrationCovariance(1e-12 * _I3)
        self.no_bias = gtsam.imuBias.ConstantBias()

    def keys(self, k: int) -> tuple[int, int, int]:
        return self.g.symbol("x", k), self.g.symbol("v", k), self.g.symbol("b", k)

    def pose(self, row: Array) -> Any:
        return self.g.Pose3(self.g.Rot3.Quaternion(*row[4:]), row[1:4])

    def prior(self, k: int) -> Any:
        sigmas = self.g.noiseModel.Diagonal.Sigmas
        graph = self.g.NonlinearFactorGraph()
        _, v, b = self.keys(k)
        graph.add(self.g.PriorFactorVector(v, np.zeros(3), sigmas(np.full(3, PARAMS.velocity_sigma))))
        bias = np.repeat([PARAMS.accel_bias_sigma, PARAMS.gyro_bias_sigma], 3)
        graph.add(self.g.PriorFactorConstantBias(b, self.no_bias, sigmas(bias)))
        return graph

    def seen(self, k: int, fix: PoseFix) -> Any:
        sigmas = np.sqrt(np.diag(fix.hypotheses[0].covariance))[[3, 4, 5, 0, 1, 2]]  # alike in all directions
        return self.g.PriorFactorPose3(
            self.keys(k)[0], self.pose(row_of(fix)), self.g.noiseModel.Diagonal.Sigmas(sigmas)
        )

    def preintegrate(self, inputs: Array, bias: Any) -> Any:
        """Over rows (n, 7) of t and u, each step with the mean of its ends."""
        pim = self.g.PreintegratedCombinedMeasurements(self.imu_params, bias)
        means, steps = 0.5 * (inputs[1:, 1:] + inputs[:-1, 1:]), np.diff(inputs[:, 0])
        for mean, dt in zip(means, steps.tolist(), strict=True):
            pim.integrateMeasurement(mean[3:], mean[:3], dt)
        return pim


class FixedLag:
    """gtsam's incremental fixed-lag smoother, a node for each fix; from the newest on, the pose is predicted."""

    def __init__(self, _: Simulation) -> None:
        self.base = Gtsam()
        g = self.base.g
        isam = g.ISAM2Params()
        isam.setRelinearizeThreshold(0.01)
        isam.relinearizeSkip = 1
        self.smoother = g.IncrementalFixedLagSmoother(3.0, isam)
        self.count = 0
        self.samples = np.zeros((0, 7))
        self.here = self.last = np.zeros(7)  # the input at the newest node, and the newest of all
        self.pending: list[Array] = []

    def imu(self, samples: Array, track: Array) -> None:
        for i in range(len(samples)):
            row = samples[i]
            self.pending.append(row)
            if self.count:
                mean = 0.5 * (self.last + row)
                self.pim.integrateMeasurement(mean[4:], mean[1:4], row[0] - self.last[0])
                self.last = row
                pose = self.pim.predict(self.node, self.bias).pose()
                q = pose.rotation().toQuaternion()
                track[i, 1:4], track[i, 4:] = pose.translation(), (q.w(), q.x(), q.y(), q.z())

    def fix(self, fix: PoseFix) -> None:
        base, k = self.base, self.count
        self.samples = np.vstack([self.samples[-400:], *self.pending])
        self.pending = []
        here = input_at(self.samples, fix.t)
        x, v, b = base.keys(k)
        values = base.g.Values()
        if k == 0:
            graph = base.prior(0)
            self.node, self.bias = base.g.NavState(base.pose(row_of(fix)), np.zeros(3)), base.no_bias
        else:
            graph = base.g.NonlinearFactorGraph()
            start, end = np.searchsorted(self.samples[:, 0], [self.here[0], fix.t], side="right")
            pim = base.preintegrate(np.vstack([self.here, self.samples[start:end], here]), self.bias)
            graph.add(base.g.CombinedImuFactor(*base.keys(k - 1)[:2], x, v, base.keys(k - 1)[2], b, pim))
            self.node = pim.predict(self.node, self.bias)
        graph.add(base.seen(k, fix))
        values.insert(x, self.node.pose())
        values.insert(v, self.node.velocity())
        values.insert(b, self.bias)
        self.smoother.update(graph, values, dict.fromkeys((x, v, b), fix.t))
        pose, velocity = self.smoother.calculateEstimatePose3(x), self.smoother.calculateEstimateVector(v)
        self.node, self.bias = base.g.NavState(pose, velocity), self.smoother.calculateEstimateConstantBias(b)
        late = self.samples[np.searchsorted(self.samples[:, 0], fix.t, side="right") :]
        self.pim = base.preintegrate(np.vstack([here, late]), self.bias)
        self.here, self.last, self.count = here, self.samples[-1], k + 1


def gtsam_batch(simulation: Simulation) -> Array:
    """(n, 8): Levenberg-Marquardt over the whole recording, knowing the future; a node at each tenth sample and fix."""
    base = Gtsam()
    fixes = {fix.t: fix for fix in simulation.fixes}
    first, last = min(fixes), max(fixes)
    every = simulation.samples[::10, 0]
    times = np.union1d(every[(every > first) & (every < last)], list(fixes))
    guess = interpolate(np.array([row_of(fixes[t]) for t in sorted(fixes)]), times, longest_gap=math.inf)
    nodes = np.array([input_at(simulation.samples, t) for t in times])
    inputs = np.vstack([nodes, simulation.samples])
    inputs = inputs[np.unique(inputs[:, 0], return_index=True)[1]]
    ends = np.searchsorted(inputs[:, 0], times)
    graph, values = base.prior(0), base.g.Values()
    for k, t in enumerate(times.tolist()):
        x, v, b = base.keys(k)
        values.insert(x, base.pose(guess[k]))
        values.insert(v, np.zeros(3))
        values.insert(b, base.no_bias)
        if t in fixes:
            graph.add(base.seen(k, fixes[t]))
        if k:
            pim = base.preintegrate(inputs[ends[k - 1] : ends[k] + 1], base.no_bias)
            graph.add(base.g.CombinedImuFactor(*base.keys(k - 1)[:2], x, v, base.keys(k - 1)[2], b, pim))
    best = base.g.LevenbergMarquardtOptimizer(graph, values).optimize()
    track = np.empty((len(times), 8))
    for k, t in enumerate(times.tolist()):
        pose = best.atPose3(base.keys(k)[0])
        q = pose.rotation().toQuaternion()
        track[k] = (t, *pose.translation(), q.w(), q.x(), q.y(), q.z())
    return track


# --------------------------------------------------------------------------------------------------------- WPILib

WHEEL_SCALE, WHEEL_NOISE = 0.01, 0.02  # sigma of the wheels' scale error; of their speed's noise at each sample, m/s


class Wpilib:
    """WPILib's pose estimator: planar, odometry corrected with a constant gain.

    It wants wheels. Without, their speed is the forward accelerometer's, integrated and held to the way between fixes
    by a small observer of the bias. It knows no gyroscope bias, and is given the one at the start, as if calibrated at
    rest. The gain depends on `ratio` alone, sigma of the fixes over that of the odometry, of position and of heading:
    the best on other seeds of the same course.
    """

    def __init__(self, simulation: Simulation, wheels: bool, ratio: tuple[float, float]) -> None:
        from wpimath.estimator import DifferentialDrivePoseEstimator
        from wpimath.geometry import Pose2d, Rotation2d
        from wpimath.kinematics import DifferentialDriveKinematics

        self.Pose, self.Rotation = Pose2d, Rotation2d
        drive, (xy, heading) = DifferentialDriveKinematics(0.2), ratio
        self.estimator = DifferentialDrivePoseEstimator(
            drive, Rotation2d(0), 0.0, 0.0, Pose2d(), (1.0, 1.0, 1.0), (xy, xy, heading)
        )
        self.wheels: list[float] = []
        if wheels:
            rng = np.random.default_rng(simulation.samples[0, 1:].view(np.uint64))  # another for each seed
            speed = np.linalg.norm(simulation.velocity, axis=1) * (1.0 + WHEEL_SCALE * rng.standard_normal())
            self.wheels = (speed + WHEEL_NOISE * rng.standard_normal(len(speed))).tolist()
        self.bias = float(simulation.gyro_bias[0, 2])
        self.started = False
        self.n, self.t, self.rate, self.angle, self.way = -1, 0.0, 0.0, 0.0, 0.0
        self.speed = self.raw_way = 0.0  # the accelerometer's
        self.raw: list[tuple[float, float]] = []  # t, raw_way
        self.lacks, self.slope, self.lacks_at = 0.0, 0.0, math.nan  # what its speed lacks, m/s, at an instant; m/s2
        self.last: tuple[float, float, Array] | None = None  # t, raw way and place of the last fix

    def imu(self, samples: Array, track: Array) -> None:
        for i, (t, _, _, rate, force, _, _) in enumerate(samples.tolist()):
            dt, self.t = t - self.t, t
            self.angle += (0.5 * (rate + self.rate) - self.bias) * dt
            self.rate = rate
            if self.wheels:
                self.n += 1
                self.way += self.wheels[self.n] * dt
            else:
                self.speed += force * dt
                self.raw_way += self.speed * dt
                self.raw.append((t, self.raw_way))
                if not math.isnan(self.lacks_at):
                    self.way += max(self.speed + self.lacks + self.slope * (t - self.lacks_at), 0.0) * dt
            pose = self.estimator.updateWithTime(t, self.Rotation(self.angle), self.way, self.way)
            half = 0.5 * pose.rotation().radians()
            track[i, 1:] = (pose.X(), pose.Y(), 0.0, math.cos(half), 0.0, 0.0, math.sin(half))

    def fix(self, fix: PoseFix) -> None:
        x, y, _ = fix.hypotheses[0].position.tolist()
        heading = yaw_of(rotation_from_quaternion(fix.hypotheses[0].quaternion_wxyz))
        if self.started:
            self.estimator.addVisionMeasurement(self.Pose(x, y, self.Rotation(heading)), fix.t)
        else:
            self.estimator.resetPose(self.Pose(x, y, self.Rotation(heading)))
            self.started = True
        if self.wheels:
            return
        del self.raw[:-400]
        i = bisect.bisect(self.raw, (fix.t, 0.0))
        (before, way), (after, further) = self.raw[i - 1], self.raw[i]
        place, raw_way = np.array([x, y]), way + (fix.t - before) / (after - before) * (further - way)
        if self.last is not None:
            t, way, was = self.last
            dt, middle = fix.t - t, 0.5 * (fix.t + t)
            lacks = (float(np.linalg.norm(place - was)) - (raw_way - way)) / dt
            if not math.isnan(self.lacks_at):
                expected = self.lacks + self.slope * (middle - self.lacks_at)
                self.slope += 0.1 * (lacks - expected) / dt
                lacks = 0.5 * (expected + lacks)
            self.lacks, self.lacks_at = lacks, middle
        self.last = fix.t, raw_way, place


# ---------------------------------------------------------------------------------------------------- without an IMU


def constant_velocity(s: Simulation) -> Array:
    """(n, 8): position and attitude with constant speed and rate, noise as is best for these recordings."""
    return without_imu(Recording("", s.samples, s.arrival, s.fixes, s.truth), 2.0, 4.0)


def holding(s: Simulation) -> Array:
    """(n, 8): the newest fix."""
    rows, arrival = np.array([row_of(fix) for fix in s.fixes]), np.array([fix.arrival for fix in s.fixes])
    return hold_last(rows, arrival, s.samples[:, 0])
