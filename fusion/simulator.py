"""A robot that never was: its true motion, and what its IMU and a ceiling camera make of it.

The same seed gives the same simulation to the last bit, and each imperfection draws its own random numbers: to switch
one on or off changes nothing else. Frames, units and axes are those of `fusion.measurements`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple

import numpy as np
from msgspec import Meta, Struct
from numpy.random import Generator, default_rng
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from fusion.measurements import Array, PoseFix, PoseHypothesis
from fusion.params import GRAVITY, NotNegative, Positive

Probability = Annotated[float, Meta(ge=0.0, le=1.0)]


class TriadParams(Struct, frozen=True, forbid_unknown_fields=True):
    """A gyroscope or accelerometer, perfect by default. u is its unit: rad/s or m/s2.

    A sigma is that of each axis, drawn once for each simulation. Densities are of continuous white noise.
    """

    noise: NotNegative = 0.0
    """u/sqrt(Hz)."""
    bias_sigma: NotNegative = 0.0
    """u: of the bias at the start."""
    bias_walk: NotNegative = 0.0
    """u/s/sqrt(Hz): random walk of the bias."""
    scale_sigma: NotNegative = 0.0
    """of the scale error; 0.01 is 1 %."""
    misalignment_sigma: NotNegative = 0.0
    """rad: by which each axis leans towards each other one."""
    vibration: NotNegative = 0.0
    """u: amplitude of the shaking at a speed of 1 m/s, to which it is proportional."""
    limit: Positive = math.inf
    """u: where it saturates."""
    step: NotNegative = 0.0
    """u: of the digits; 0: as fine as floats."""


class ImuParams(Struct, frozen=True, forbid_unknown_fields=True):
    """An IMU, by default with the noise and the biases that the filter expects by default."""

    rate: Positive = 200.0
    """Hz."""
    latency: NotNegative = 0.0
    """s: from a sample's stamp to its arrival."""
    vibration_frequency: Positive = 37.0
    """Hz: of the shaking."""
    gyro: TriadParams = TriadParams(noise=1e-3, bias_sigma=0.02, bias_walk=1e-4)
    accel: TriadParams = TriadParams(noise=2e-2, bias_sigma=0.2, bias_walk=1e-3)


class CameraParams(Struct, frozen=True, forbid_unknown_fields=True):
    """A camera that sees a flat marker on the robot, and gives fixes. Jitter, dropouts and flips are off.

    The fixes' covariance says what `position_sigma` and `attitude_sigma` do, and nothing of the other errors.
    """

    rate: Positive = 2.0
    """Hz."""
    position: tuple[float, float, float] = (0.0, 0.0, 2.5)
    """m, world: on which it depends how the marker flips."""
    position_sigma: Positive = 0.005
    """m, each axis."""
    attitude_sigma: Positive = 0.0175
    """rad, about each axis."""
    delay_least: NotNegative = 0.1
    """s: least time from capture to arrival."""
    delay_most: NotNegative = 0.3
    """s: most; uniform between."""
    stamp_jitter: NotNegative = 0.0
    """s: random error of the stamps."""
    stamp_error: float = 0.0
    """s: by which all stamps are late."""
    dropout: Probability = 0.0
    """Share of the frames without a fix."""
    two_poses: bool = False
    """Whether a fix brings both poses that a flat marker has, or only the likelier one."""
    flip: Probability = 0.0
    """Share of the fixes whose likelier pose is the wrong one."""
    misfit_margin: Positive = 4.0
    """Mean of what the less likely pose has more in misfit (exponential)."""


class TrueMotion(NamedTuple):
    """Position (n, 3) m, velocity and acceleration, world; attitude (n), world_from_body; rate (n, 3) rad/s, body."""

    position: Array
    velocity: Array
    acceleration: Array
    attitude: Any
    rate: Array


@dataclass(frozen=True)
class Trajectory:
    """A smooth course, with stops.

    Position is a sum of sines of the course's own time s: `waves` (3, k, 3) holds for x, y and z the amplitude in m,
    frequency in rad/s and phase in rad of each. `angles` (3, k, 3), rad, does the same for roll, pitch and yaw (about
    x, y, z; yaw turns first); None: the robot is upright and looks along its course. s runs with t for `go` s, with
    ramps of `ramp` s at either end, then stands still for the rest of `period`, and so on; t = 0 is a start from rest.
    """

    waves: Array
    angles: Array | None = None
    go: float = 12.0
    period: float = 15.0
    ramp: float = 1.0

    def at(self, t: ArrayLike) -> TrueMotion:
        """The motion at the instants t (n,), in closed form."""
        s, rate, change = self._course_time(np.asarray(t, dtype=np.float64))
        position, slope, bend = _sines(self.waves, s)
        if self.angles is None:
            dx, dy = slope[:, 0], slope[:, 1]
            upright = np.zeros_like(s)
            angles = np.column_stack([upright, upright, np.arctan2(dy, dx)])
            turning = np.column_stack([upright, upright, (dx * bend[:, 1] - dy * bend[:, 0]) / (dx**2 + dy**2)])
        else:
            angles, turning, _ = _sines(self.angles, s)
        (roll, pitch, _), (droll, dpitch, dyaw) = angles.T, (turning * rate).T
        return TrueMotion(
            position,
            slope * rate,
            bend * rate**2 + slope * change,
            Rotation.from_euler("ZYX", angles[:, ::-1]),
            np.column_stack(
                [
                    droll - dyaw * np.sin(pitch),
                    dpitch * np.cos(roll) + dyaw * np.cos(pitch) * np.sin(roll),
                    dyaw * np.cos(pitch) * np.cos(roll) - dpitch * np.sin(roll),
                ]
            ),
        )

    def _course_time(self, t: Array) -> tuple[Array, Array, Array]:
        """s (n,), and its first and second derivative by t (n, 1)."""
        rounds = np.floor(t / self.period)
        into = t - rounds * self.period
        s, rate, change = rounds * (self.go - self.ramp), np.zeros_like(t), np.zeros_like(t)
        for sign, start in ((1.0, 0.0), (-1.0, self.go - self.ramp)):
            # x²(3 - 2x) from 0 to 1 as x does: the speed of s. Its integral goes on as x - 1/2 beyond 1.
            x = np.clip((into - start) / self.ramp, 0.0, 1.0)
            s += sign * (self.ramp * (x**3 - 0.5 * x**4) + np.maximum(into - start - self.ramp, 0.0))
            rate += sign * x**2 * (3.0 - 2.0 * x)
            change += sign * 6.0 * x * (1.0 - x) / self.ramp
        return s, rate[:, np.newaxis], change[:, np.newaxis]


def _sines(waves: Array, s: Array) -> tuple[Array, Array, Array]:
    """The three sums of sines at s (n,), and their first and second derivative by s: (n, 3) each."""
    amplitude, frequency, phase = np.moveaxis(waves, 2, 0)
    angle = frequency * s[:, np.newaxis, np.newaxis] + phase
    sine, cosine = amplitude * np.sin(angle), amplitude * np.cos(angle)
    return sine.sum(axis=2), (frequency * cosine).sum(axis=2), -(frequency**2 * sine).sum(axis=2)


def figure_eight(half_length: float = 1.8, speed: float = 1.2) -> Trajectory:
    """An eight on the floor, `half_length` m to either side, at about `speed` m/s where it crosses itself."""
    w = speed / (math.sqrt(2.0) * half_length)
    return Trajectory(np.array([[[half_length, w, 0.0]], [[0.5 * half_length, 2.0 * w, 0.0]], [[0.0, 0.0, 0.0]]]))


def random_ground(seed: int, radius: float = 1.2, speed: float = 0.7) -> Trajectory:
    """Round and round on the floor, but never twice the same way; mean `radius` m, mean `speed` m/s."""
    rng = default_rng(seed)
    w = speed / radius
    frequency = w * rng.uniform(1.5, 5.0, size=5) * rng.choice([-1.0, 1.0], size=5)
    # The side ways share 0.6 of the main one's speed, so that the robot never stops and turns on the spot.
    amplitude = speed * 0.6 * rng.dirichlet(np.ones(5)) / np.abs(frequency)
    amplitude, frequency = np.append(radius, amplitude), np.append(w * rng.choice([-1.0, 1.0]), frequency)
    phase = rng.uniform(-np.pi, np.pi, size=6)
    x = np.column_stack([amplitude, frequency, phase + 0.5 * np.pi])
    y = np.column_stack([amplitude, frequency, phase])
    return Trajectory(np.stack([x, y, np.zeros((6, 3))]))


def aggressive(seed: int) -> Trajectory:
    """By hand or in flight: about 1.6 m/s, 4 m/s2 and 1.8 rad/s on the mean, leaning by up to 60 degrees."""
    rng = default_rng(seed)

    def waves(reach: tuple[float, float, float], least: float, most: float) -> Array:
        amplitude = np.array(reach)[:, np.newaxis] * rng.dirichlet(np.full(4, 3.0), size=3)
        return np.stack([amplitude, rng.uniform(least, most, (3, 4)), rng.uniform(-np.pi, np.pi, (3, 4))], axis=2)

    return Trajectory(waves((1.5, 1.5, 0.8), 0.5, 3.0), waves((1.0, 1.0, 2.5), 0.5, 3.0), go=25.0, period=30.0)


@dataclass(frozen=True)
class Simulation:
    """What happened and what was measured, over n IMU instants.

    `samples` (n, 7) as in `ImuBatch`; `arrival` (n,) s; `fixes` in order of arrival; `truth` (n, 8): t, position,
    quaternion wxyz; `velocity` (n, 3) m/s, world; `gyro_bias`, `accel_bias` (n, 3) rad/s and m/s2, body.
    """

    samples: Array
    arrival: Array
    fixes: list[PoseFix]
    truth: Array
    velocity: Array
    gyro_bias: Array
    accel_bias: Array


def simulate(
    trajectory: Trajectory,
    seed: int,
    duration: float = 120.0,
    imu: ImuParams | None = None,
    camera: CameraParams | None = None,
    tilt: tuple[float, float] = (0.0, 0.0),
    robot: str = "robot",
) -> Simulation:
    """Drive a course for `duration` s from t = 0.

    `tilt`: x and y (sines, so nearly rad) of the unit vector upwards in a world frame whose floor is not level.
    """
    imu, camera = imu or ImuParams(), camera or CameraParams()
    imu_rng, camera_rng = default_rng(seed).spawn(2)
    t = np.arange(round(duration * imu.rate) + 1) / imu.rate
    motion = trajectory.at(t)
    up = np.array([*tilt, math.sqrt(1.0 - tilt[0] ** 2 - tilt[1] ** 2)])
    force = motion.attitude.apply(motion.acceleration + GRAVITY * up, inverse=True)
    shaking = np.linalg.norm(motion.velocity, axis=1) * np.sin(2.0 * np.pi * imu.vibration_frequency * t)
    gyro, gyro_bias = _sense(imu.gyro, imu_rng, 1.0 / imu.rate, motion.rate, shaking)
    accel, accel_bias = _sense(imu.accel, imu_rng, 1.0 / imu.rate, force, shaking)
    return Simulation(
        np.column_stack([t, gyro, accel]),
        t + imu.latency,
        _fixes(camera_rng, robot, trajectory, duration, camera),
        np.column_stack([t, motion.position, motion.attitude.as_quat(scalar_first=True)]),
        motion.velocity,
        gyro_bias,
        accel_bias,
    )


def _sense(sensor: TriadParams, rng: Generator, dt: float, truth: Array, shaking: Array) -> tuple[Array, Array]:
    """What a sensor makes of `truth` (n, 3) and `shaking` (n,) in a direction of its own, and its bias (n, 3)."""
    gain = rng.standard_normal((3, 3)) * np.where(np.eye(3), sensor.scale_sigma, sensor.misalignment_sigma)
    direction = rng.standard_normal(3)
    direction *= sensor.vibration / np.linalg.norm(direction)
    start, steps, noise = rng.standard_normal(3), rng.standard_normal(truth.shape), rng.standard_normal(truth.shape)
    bias = sensor.bias_sigma * start + sensor.bias_walk * math.sqrt(dt) * steps.cumsum(axis=0)
    read = (truth + np.outer(shaking, direction)) @ (np.eye(3) + gain).T + bias + sensor.noise / math.sqrt(dt) * noise
    read = np.clip(read, -sensor.limit, sensor.limit)
    return np.round(read / sensor.step) * sensor.step if sensor.step else read, bias


def _fixes(rng: Generator, robot: str, trajectory: Trajectory, duration: float, camera: CameraParams) -> list[PoseFix]:
    t = np.arange(rng.uniform() / camera.rate, duration, 1.0 / camera.rate)
    n = len(t)
    motion = trajectory.at(t)
    position = motion.position + camera.position_sigma * rng.standard_normal((n, 3))
    attitude = motion.attitude * Rotation.from_rotvec(camera.attitude_sigma * rng.standard_normal((n, 3)))
    # A flat marker seen along d, a unit vector, looks nearly the same when its normal is mirrored at d: to mirror the
    # world at the plane across d, and the marker at its own plane, leaves its image as it is but for the perspective.
    sight = position - np.array(camera.position)
    sight /= np.linalg.norm(sight, axis=1, keepdims=True)
    mirror = np.eye(3) - 2.0 * sight[:, :, np.newaxis] * sight[:, np.newaxis, :]
    mirrored = Rotation.from_matrix(mirror @ attitude.as_matrix() @ np.diag([1.0, 1.0, -1.0]))
    quaternions = np.stack([attitude.as_quat(scalar_first=True), mirrored.as_quat(scalar_first=True)], axis=1)
    arrival = t + rng.uniform(camera.delay_least, camera.delay_most, n)
    stamp = t + camera.stamp_error + camera.stamp_jitter * rng.standard_normal(n)
    seen = rng.uniform(size=n) >= camera.dropout
    flipped = (rng.uniform(size=n) < camera.flip).astype(int)
    # Of eight coordinates of corners, six are spent on the pose.
    misfit = rng.chisquare(2.0, n)
    misfit = np.column_stack([misfit, misfit + rng.exponential(camera.misfit_margin, n)])
    covariance = np.diag([camera.position_sigma**2] * 3 + [camera.attitude_sigma**2] * 3)
    fixes = []
    for i in np.argsort(arrival, kind="stable"):
        if not seen[i]:
            continue
        poses = [
            PoseHypothesis(position[i], quaternions[i, order ^ flipped[i]], covariance, misfit[i, order])
            for order in range(2 if camera.two_poses else 1)
        ]
        fixes.append(PoseFix(robot, float(stamp[i]), float(arrival[i]), tuple(poses), "simulated"))
    return fixes
