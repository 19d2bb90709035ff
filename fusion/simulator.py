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
    lever_arm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """m, body: where on the robot it sits, while it is thought to sit at the body's origin."""
    gyro: TriadParams = TriadParams(noise=1e-3, bias_sigma=0.02, bias_walk=1e-4)
    accel: TriadParams = TriadParams(noise=2e-2, bias_sigma=0.2, bias_walk=1e-3)


class MarkerParams(Struct, frozen=True, forbid_unknown_fields=True):
    """A flat marker on the body's origin, across its z axis, in the picture of a camera that looks straight down.

    The fixes' errors are those of its four corners in the picture, through least squares, linearised about the true
    pose; their covariance is exact.
    """

    size: Positive = 0.15
    """m: its side."""
    focal_px: Positive = 1000.0
    """of the camera."""
    corner_sigma_px: Positive = 0.3
    """white noise of each coordinate of a corner."""
    field_sigma_px: NotNegative = 0.0
    """of an error of each coordinate that depends on the corner's place in the picture alone, as that of a lens
    calibration does: while the robot stands it is the same each time."""
    field_length_px: Positive = 400.0
    """wavelength of that error over the picture."""
    on_floor: bool = True
    """Whether height, roll and pitch are taken as known, as of a robot on a floor, and not from the corners."""
    height_sigma: Positive = 0.005
    """m: how well the height is known then. The error is drawn once for each simulation."""
    tilt_sigma: Positive = 0.01
    """rad: the same of roll and pitch, about the body's axes."""


class WrongMarker(Struct, frozen=True, forbid_unknown_fields=True):
    """One of the robot's two markers is entered wrongly; now this one is in view, now the other."""

    id: int = 7
    """of this one; the other is 1."""
    turn: float = math.pi
    """rad: by which the fixes of this marker are turned about the body's z axis."""
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """m, body: by which they are displaced."""
    share: Annotated[float, Meta(gt=0.0, le=1.0)] = 0.25
    """of the time that this one is in view; 1: always, there is no other."""
    run: Positive = 9.0
    """s: for how long it is in view at a time, give or take a tenth."""


class WheelParams(Struct, frozen=True, forbid_unknown_fields=True):
    """Odometry of two driven wheels: the speed of each from its encoder, without slip and scale errors by default."""

    rate: Positive = 50.0
    """Hz."""
    track: Positive = 0.3
    """m: from wheel to wheel."""
    noise: NotNegative = 0.005
    """m/s: white, of each wheel's speed."""
    scale_sigma: NotNegative = 0.0
    """of each wheel's scale error, a wrong radius, drawn once for each simulation; 0.01 is 1 %."""
    slip_rate: NotNegative = 0.0
    """1/s: how often one of the wheels, either, slips."""
    slip_time: Positive = 0.5
    """s: for how long."""
    slip: float = 0.5
    """share of its speed by which a slipping wheel turns too fast."""


class CameraParams(Struct, frozen=True, forbid_unknown_fields=True):
    """A camera that sees a flat marker on the robot, and gives fixes. Jitter, dropouts and flips are off.

    The fixes' covariance says what `position_sigma` and `attitude_sigma` do, or what `marker` does in their place, and
    nothing of the other errors.
    """

    rate: Positive = 2.0
    """Hz."""
    position: tuple[float, float, float] = (0.0, 0.0, 2.5)
    """m, world: on which it depends how the marker flips."""
    position_sigma: Positive = 0.005
    """m, each axis."""
    attitude_sigma: Positive = 0.0175
    """rad, about each axis."""
    marker: MarkerParams | None = None
    """Where the errors are to come from the picture, instead of these two sigmas."""
    wrong: WrongMarker | None = None
    """With it, fixes name their marker."""
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
    quaternion wxyz; `velocity` (n, 3) m/s, world; `gyro_bias`, `accel_bias` (n, 3) rad/s and m/s2, body; `wheels`
    (m, 3): stamp, forward speed in m/s, yaw rate in rad/s, as the wheels have it.
    """

    samples: Array
    arrival: Array
    fixes: list[PoseFix]
    truth: Array
    velocity: Array
    gyro_bias: Array
    accel_bias: Array
    wheels: Array


def simulate(
    trajectory: Trajectory,
    seed: int,
    duration: float = 120.0,
    imu: ImuParams | None = None,
    camera: CameraParams | None = None,
    tilt: tuple[float, float] = (0.0, 0.0),
    robot: str = "robot",
    wheels: WheelParams | None = None,
) -> Simulation:
    """Drive a course for `duration` s from t = 0.

    `tilt`: x and y (sines, so nearly rad) of the unit vector upwards in a world frame whose floor is not level.
    Without `wheels` there is no odometry.
    """
    imu, camera = imu or ImuParams(), camera or CameraParams()
    imu_rng, camera_rng, wheel_rng = default_rng(seed).spawn(3)
    t = np.arange(round(duration * imu.rate) + 1) / imu.rate
    motion = trajectory.at(t)
    up = np.array([*tilt, math.sqrt(1.0 - tilt[0] ** 2 - tilt[1] ** 2)])
    force = motion.attitude.apply(motion.acceleration + GRAVITY * up, inverse=True) + _at_lever_arm(trajectory, t, imu)
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
        _odometry(wheel_rng, trajectory, duration, wheels) if wheels else np.empty((0, 3)),
    )


def _at_lever_arm(trajectory: Trajectory, t: Array, imu: ImuParams) -> Array:
    """(n, 3) m/s2, body: by what a place off the origin is accelerated more than that, α × l + ω × (ω × l)."""
    if not any(imu.lever_arm):
        return np.zeros((len(t), 3))
    h = 1e-4
    alpha = (trajectory.at(t + h).rate - trajectory.at(t - h).rate) / (2.0 * h)
    omega = trajectory.at(t).rate
    moved: Array = np.cross(alpha, imu.lever_arm) + np.cross(omega, np.cross(omega, imu.lever_arm))
    return moved


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
    marker_rng, wrong_rng = rng.spawn(2)
    t = np.arange(rng.uniform() / camera.rate, duration, 1.0 / camera.rate)
    n = len(t)
    motion = trajectory.at(t)
    position = motion.position + camera.position_sigma * rng.standard_normal((n, 3))
    attitude = motion.attitude * Rotation.from_rotvec(camera.attitude_sigma * rng.standard_normal((n, 3)))
    covariance = np.tile(np.diag([camera.position_sigma**2] * 3 + [camera.attitude_sigma**2] * 3), (n, 1, 1))
    systematic = np.zeros((n, 6, 6))
    if camera.marker is not None:
        error, covariance, systematic = _through_the_picture(marker_rng, motion, camera.position, camera.marker)
        position = motion.position + error[:, :3]
        attitude = Rotation.from_rotvec(error[:, 3:]) * motion.attitude
    # A flat marker seen along d, a unit vector, looks nearly the same when its normal is mirrored at d: to mirror the
    # world at the plane across d, and the marker at its own plane, leaves its image as it is but for the perspective.
    sight = position - np.array(camera.position)
    sight /= np.linalg.norm(sight, axis=1, keepdims=True)
    mirror = np.eye(3) - 2.0 * sight[:, :, np.newaxis] * sight[:, np.newaxis, :]
    mirrored = Rotation.from_matrix(mirror @ attitude.as_matrix() @ np.diag([1.0, 1.0, -1.0]))
    wrong = np.zeros(n, dtype=bool) if camera.wrong is None else _in_view(wrong_rng, t, camera.wrong)
    placed = [_placed(position, pose, wrong, camera.wrong) for pose in (attitude, mirrored)]
    arrival = t + rng.uniform(camera.delay_least, camera.delay_most, n)
    stamp = t + camera.stamp_error + camera.stamp_jitter * rng.standard_normal(n)
    seen = rng.uniform(size=n) >= camera.dropout
    flipped = (rng.uniform(size=n) < camera.flip).astype(int)
    # Of eight coordinates of corners, six are spent on the pose.
    misfit = rng.chisquare(2.0, n)
    misfit = np.column_stack([misfit, misfit + rng.exponential(camera.misfit_margin, n)])
    fixes = []
    for i in np.argsort(arrival, kind="stable"):
        if not seen[i]:
            continue
        poses = []
        for order in range(2 if camera.two_poses else 1):
            positions, quaternions = placed[order ^ flipped[i]]
            pose = PoseHypothesis(positions[i], quaternions[i], covariance[i], misfit[i, order], systematic[i])
            poses.append(pose)
        markers = () if camera.wrong is None else (camera.wrong.id if wrong[i] else 1,)
        fixes.append(PoseFix(robot, float(stamp[i]), float(arrival[i]), tuple(poses), "simulated", markers))
    return fixes


_SOLVED, _ASSUMED = [0, 1, 5], [2, 3, 4]  # of a pose on the floor: x, y, yaw; height, roll, pitch


def _through_the_picture(
    rng: Generator, motion: TrueMotion, camera: tuple[float, float, float], marker: MarkerParams
) -> tuple[Array, Array, Array]:
    """Errors (n, 6) of fixes, their covariances (n, 6, 6), and of these the part that is the same for the whole drive;
    position and rotation in world axes.

    The camera's axes are the world's: a place (x, y) m beside the camera and d below it is seen at (x, y) f / d.
    """
    n = len(motion.position)
    corners = 0.5 * marker.size * np.array([[-1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [-1.0, -1.0, 0.0]])
    lever = np.stack([motion.attitude.apply(corner) for corner in corners], axis=1)
    place = motion.position[:, np.newaxis] + lever - np.array(camera)
    depth = -place[:, :, 2, np.newaxis]
    if depth.min() <= 0.0:
        raise ValueError(f"the course rises to the camera at {camera[2]:g} m: put it higher")
    seen = marker.focal_px * place[:, :, :2] / depth
    by_position = np.zeros((n, 4, 2, 3))
    by_position[..., 0, 0] = by_position[..., 1, 1] = marker.focal_px / depth[..., 0]
    by_position[..., 2] = seen / depth
    # d(R m) = dθ × R m
    by_rotation = np.stack(
        [np.cross(axis, lever)[:, :, np.newaxis] @ by_position.swapaxes(2, 3) for axis in np.eye(3)], axis=-1
    )
    J = np.concatenate([by_position, by_rotation[:, :, 0]], axis=3).reshape(n, 8, 6)

    # The field: plane waves over the picture, whose phases are drawn, so that its mean square is the same everywhere.
    angle, phase = rng.uniform(-math.pi, math.pi, (2, 6))
    push = math.pi / 6.0 * np.arange(6.0)
    waves = 2.0 * math.pi / marker.field_length_px * np.column_stack([np.cos(angle), np.sin(angle)])
    size = marker.field_sigma_px * math.sqrt(4.0 / 6.0) * np.column_stack([np.cos(push), np.sin(push)])
    field = np.sin(seen @ waves.T + phase) @ size
    apart = (seen[:, :, np.newaxis] - seen[:, np.newaxis]) @ waves.T
    of_field = np.einsum("nabw,wi,wj->naibj", 0.5 * np.cos(apart), size, size).reshape(n, 8, 8)
    off = (field + marker.corner_sigma_px * rng.standard_normal((n, 4, 2))).reshape(n, 8, 1)
    of_corners = of_field + marker.corner_sigma_px**2 * np.eye(8)
    assumed = rng.standard_normal(3) * [marker.height_sigma, marker.tilt_sigma, marker.tilt_sigma]

    gain = np.zeros((n, 6, 8))
    columns = _SOLVED if marker.on_floor else list(range(6))
    gain[:, columns] = np.linalg.pinv(J[:, :, columns])
    error, covariance = gain @ off, gain @ of_corners @ gain.swapaxes(1, 2)
    systematic = np.zeros_like(covariance)
    if marker.on_floor:
        # What is taken as known is wrong, by roll and pitch about the body's axes, and what is solved answers to that.
        by_assumed = gain @ J[:, :, _ASSUMED]
        by_assumed[:, _ASSUMED] = -np.eye(3)
        heading = motion.attitude.as_matrix()[:, :2, :2]
        by_assumed[:, :, 1:] = by_assumed[:, :, 1:] @ heading
        sigma = np.diag([marker.height_sigma, marker.tilt_sigma, marker.tilt_sigma])
        error += (by_assumed @ assumed)[..., np.newaxis]
        systematic = by_assumed @ sigma**2 @ by_assumed.swapaxes(1, 2)
    return error[..., 0], covariance + systematic, systematic


def _in_view(rng: Generator, t: Array, wrong: WrongMarker) -> Array:
    """(n,): whether the wrong marker is in view at t (n,)."""
    runs = int(1.2 * t[-1] / wrong.run) + 1 if len(t) else 0
    this = wrong.run * rng.uniform(0.9, 1.1, runs)
    other = wrong.run * (1.0 / wrong.share - 1.0) * rng.uniform(0.9, 1.1, runs)
    changes = np.cumsum(np.column_stack([other, this]).ravel())
    return np.searchsorted(changes, t, side="right") % 2 == 1 if wrong.share < 1.0 else np.ones(len(t), dtype=bool)


def _placed(position: Array, attitude: Any, there: Array, wrong: WrongMarker | None) -> tuple[Array, Array]:
    """Positions (n, 3) and quaternions wxyz (n, 4) of fixes, as the map has it where the wrong marker is in view."""
    if wrong is None:
        return position, attitude.as_quat(scalar_first=True)
    shift = np.where(there[:, np.newaxis], wrong.shift, 0.0)
    turn = Rotation.from_rotvec(np.outer(there * wrong.turn, [0.0, 0.0, 1.0]))
    return position + attitude.apply(shift), (attitude * turn).as_quat(scalar_first=True)


def _odometry(rng: Generator, trajectory: Trajectory, duration: float, wheels: WheelParams) -> Array:
    """(m, 3): stamp, forward speed, yaw rate."""
    t = np.arange(0.0, duration, 1.0 / wheels.rate)
    motion = trajectory.at(t)
    forward = motion.attitude.apply(motion.velocity, inverse=True)[:, 0]
    # speed of the left and of the right wheel: v -+ ω b/2
    speed = forward[:, np.newaxis] + 0.5 * wheels.track * motion.rate[:, 2:] * [-1.0, 1.0]
    noise, scale = rng.standard_normal(speed.shape), 1.0 + wheels.scale_sigma * rng.standard_normal(2)
    slip_rng = rng.spawn(1)[0]
    starts = slip_rng.uniform(0.0, duration, slip_rng.poisson(wheels.slip_rate * duration))
    slipping = np.zeros(speed.shape, dtype=bool)
    for start, wheel in zip(starts, slip_rng.integers(0, 2, len(starts)), strict=True):
        slipping[(t >= start) & (t < start + wheels.slip_time), wheel] = True
    left, right = (speed * scale * np.where(slipping, 1.0 + wheels.slip, 1.0) + wheels.noise * noise).T
    return np.column_stack([t, 0.5 * (left + right), (right - left) / wheels.track])
