"""The vocabulary: what sensors say, what the filter answers.

Every `t` is float seconds on one clock (live: the host's monotonic clock), **when the event happened**:
mid-exposure for a frame, the sampling instant for an IMU. `arrival` is when it reached the service.
Frames: `world` (x east on the floor plan, y north, z up), `body` (x forward, y left, z up). SI units, radians.

A 6 x 6 pose covariance is ordered (x, y, z, rotation about x, y, z); both blocks are along the fixed *world*
axes, which is also the order and meaning of ROS's PoseWithCovariance.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import IntEnum, StrEnum
from typing import Self

import msgspec
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Six printed digits make a variance of nearly nothing negative by so much of what it is made of.
_AS_PRINTED = np.ones((6, 6)) + 1e-5 * np.eye(6)


class MeasurementError(ValueError):
    """A measurement that cannot be one: a wrong shape, NaN, a covariance that is none. The text says which."""


@dataclass(frozen=True, slots=True)
class ImuBatch:
    """Consecutive IMU readings of one robot.

    `samples`: (n, 7) float64: stamp in s, angular rate in rad/s, specific force in m/s2 (+9.81 on z at rest), in
    body axes; stamps need not be sorted.
    Raises MeasurementError on a wrong shape or a number that is not finite.
    """

    robot: str
    arrival: float
    samples: Array

    def __post_init__(self) -> None:
        samples = np.ascontiguousarray(self.samples, dtype=np.float64)
        if samples.ndim != 2 or samples.shape[1] != 7:
            raise MeasurementError(f"IMU samples of shape {samples.shape}: (n, 7) is needed, t gx gy gz ax ay az")
        # A sum of squares that is finite has finite parts, and is quicker to find.
        if not math.isfinite(np.vdot(samples, samples)) and not np.isfinite(samples).all():
            row = int(np.flatnonzero(~np.isfinite(samples).all(axis=1))[0])
            raise MeasurementError(f"IMU sample {row} is not finite: {samples[row].tolist()}")
        object.__setattr__(self, "samples", samples)


@dataclass(frozen=True, slots=True)
class WheelOdometry:
    """Consecutive readings of one robot's wheel odometry.

    `samples`: (n, 3) float64: stamp in s, forward speed of the body's origin in m/s, yaw rate in rad/s (to the left);
    NaN for one of the two that the robot does not tell; stamps need not be sorted.
    Raises MeasurementError on a wrong shape, a number that is infinite, or a reading without a stamp or any content.
    """

    robot: str
    arrival: float
    samples: Array

    def __post_init__(self) -> None:
        samples = np.ascontiguousarray(self.samples, dtype=np.float64)
        if samples.ndim != 2 or samples.shape[1] != 3:
            raise MeasurementError(f"wheel odometry of shape {samples.shape}: (n, 3) is needed, t speed yaw_rate")
        wrong = np.isinf(samples).any(axis=1) | np.isnan(samples[:, 0]) | np.isnan(samples[:, 1:]).all(axis=1)
        if wrong.any():
            row = int(np.flatnonzero(wrong)[0])
            raise MeasurementError(f"wheel odometry, reading {row} is not finite: {samples[row].tolist()}")
        object.__setattr__(self, "samples", samples)


@dataclass(frozen=True, slots=True)
class PoseHypothesis:
    """One pose that explains what a camera saw.

    `position`: (3,) m, world. `quaternion_wxyz`: (4,) unit, world_from_body. `covariance`: (6, 6), see the module.
    `misfit`: squared reprojection error over its variance (dimensionless), by which two hypotheses are compared.
    `systematic`: (6, 6) the part of `covariance` that repeats from fix to fix, of how the marker is mounted and where
    the camera hangs; it does not average out, and stays in the covariance of the poses.
    A fix that knows no tilt says so with a large variance about x and y; one that knows no attitude, about all three.
    Raises MeasurementError for a shape, a NaN, a quaternion or a covariance that cannot be.
    """

    position: Array
    quaternion_wxyz: Array
    covariance: Array
    misfit: float = 0.0
    systematic: Array = field(default_factory=lambda: np.zeros((6, 6)))

    def __post_init__(self) -> None:
        position = np.asarray(self.position, dtype=np.float64)
        quaternion = np.asarray(self.quaternion_wxyz, dtype=np.float64)
        covariance = np.asarray(self.covariance, dtype=np.float64)
        systematic = np.asarray(self.systematic, dtype=np.float64)
        shapes = position.shape, quaternion.shape, covariance.shape, systematic.shape
        if shapes != ((3,), (4,), (6, 6), (6, 6)):
            raise MeasurementError(f"pose of shapes {shapes}: (3,), (4,), (6, 6), (6, 6) are needed")
        if not all(np.isfinite(numbers).all() for numbers in (position, quaternion, covariance, systematic)):
            raise MeasurementError("pose with a number that is not finite")
        norm = float(np.linalg.norm(quaternion))
        # 1e-3: six printed decimals keep it, a quaternion in the wrong units or order of magnitude does not.
        if abs(norm - 1.0) > 1e-3:
            raise MeasurementError(f"quaternion of norm {norm:.6g}: 1 is needed (order w, x, y, z)")
        if not (np.diag(covariance) > 0.0).all():
            raise MeasurementError("covariance with a variance that is not positive")
        try:
            np.linalg.cholesky(covariance * _AS_PRINTED)
        except np.linalg.LinAlgError:
            raise MeasurementError("covariance that none can be: it is not positive definite") from None
        object.__setattr__(self, "position", position)
        object.__setattr__(self, "quaternion_wxyz", quaternion / norm)
        object.__setattr__(self, "covariance", 0.5 * (covariance + covariance.T))
        object.__setattr__(self, "systematic", 0.5 * (systematic + systematic.T))


@dataclass(frozen=True, slots=True)
class PoseFix:
    """An absolute pose of one robot from one frame: one hypothesis, or two (a flat marker has two poses).

    The likelier hypothesis comes first. `source` names the camera, `markers` (their ids) what it saw of the robot,
    where that is known.
    """

    robot: str
    t: float
    arrival: float
    hypotheses: tuple[PoseHypothesis, ...]
    source: str = ""
    markers: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        if len(self.hypotheses) not in (1, 2):
            raise MeasurementError(f"a fix with {len(self.hypotheses)} hypotheses: 1 or 2 are possible")
        if not (math.isfinite(self.t) and math.isfinite(self.arrival)):
            raise MeasurementError(f"fix stamped {self.t}, arrived {self.arrival}: both must be finite")


class Mode(StrEnum):
    """What a pose rests on.

    INIT no fix yet; FULL IMU and recent fixes; COAST no fix for a while, IMU alone; DEGRADED, INVALID the same with
    an uncertainty beyond use for steering, for anything; NO_IMU fixes alone; LOST neither.
    """

    INIT = "INIT"
    FULL = "FULL"
    COAST = "COAST"
    DEGRADED = "DEGRADED"
    INVALID = "INVALID"
    NO_IMU = "NO_IMU"
    LOST = "LOST"


def heading(quaternion_wxyz: Sequence[float]) -> float:
    """Of body x in the floor plane, rad, anticlockwise from world x, in (-pi, pi]."""
    w, x, y, z = quaternion_wxyz
    return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


# Where the parts of a pose stand in its `numbers`, as the kernels lay them out. The first, up to the instant of the
# last fix in it, are what is kept of those that were published.
INSTANT, LAST_FIX = 0, 8
POSITION, QUATERNION, VELOCITY, ANGULAR_VELOCITY = slice(1, 4), slice(4, 8), slice(9, 12), slice(12, 15)
COVARIANCE, VELOCITY_COVARIANCE, RESET_STEP = slice(15, 51), slice(51, 60), slice(60, 66)
POSE_NUMBERS = 68


class Pose(msgspec.Struct, frozen=True, eq=False):  # Made several times as fast as a frozen dataclass.
    """An estimate for the instant `t`.

    `position`, `velocity`: (3,) m and m/s, world. `quaternion_wxyz`: (4,), world_from_body.
    `angular_velocity`: (3,) rad/s, body. `covariance`: (6, 6), see the module. `velocity_covariance`: (3, 3), world.
    `reset_id` rises by one whenever the pose was set anew instead of corrected.
    `fix_age`: s from the last accepted fix's capture to `t`; inf before the first.
    `reset_step`: (6,) by how much the smooth channel stepped at its last reset, m and rad, world axes.
    `numbers`: (POSE_NUMBERS,) one row, as the filter gives it: taken apart only when something of it is asked for.
    """

    robot: str
    t: float
    numbers: Array
    mode: Mode
    reset_id: int
    fix_age: float

    @classmethod
    def of(
        cls,
        robot: str,
        t: float,
        position: Array,
        quaternion_wxyz: Array,
        velocity: Array,
        angular_velocity: Array,
        covariance: Array,
        velocity_covariance: Array,
        mode: Mode,
        reset_id: int,
        fix_age: float,
    ) -> Self:
        """A pose that does not come from a filter."""
        numbers = np.zeros(POSE_NUMBERS)
        numbers[INSTANT], numbers[LAST_FIX] = t, t - fix_age
        numbers[POSITION], numbers[QUATERNION] = position, quaternion_wxyz
        numbers[VELOCITY], numbers[ANGULAR_VELOCITY] = velocity, angular_velocity
        numbers[COVARIANCE], numbers[VELOCITY_COVARIANCE] = covariance.ravel(), velocity_covariance.ravel()
        return cls(robot, t, numbers, mode, reset_id, fix_age)

    @property
    def position(self) -> Array:
        return self.numbers[POSITION]

    @property
    def quaternion_wxyz(self) -> Array:
        return self.numbers[QUATERNION]

    @property
    def velocity(self) -> Array:
        return self.numbers[VELOCITY]

    @property
    def angular_velocity(self) -> Array:
        return self.numbers[ANGULAR_VELOCITY]

    @property
    def covariance(self) -> Array:
        return self.numbers[COVARIANCE].reshape(6, 6)

    @property
    def velocity_covariance(self) -> Array:
        return self.numbers[VELOCITY_COVARIANCE].reshape(3, 3)

    @property
    def reset_step(self) -> Array:
        return self.numbers[RESET_STEP]

    @property
    def yaw(self) -> float:
        """Heading of body x in the floor plane, rad, anticlockwise from world x, in (-pi, pi]."""
        return heading(self.quaternion_wxyz.tolist())


class Outcome(IntEnum):
    """What became of a fix.

    INITIALISED it started the filter; ACCEPTED; INFLATED accepted with less weight; REJECTED too far from the
    prediction; REINITIALISED it agreed with the rejects before it, and the pose was set anew; PENDING it is stamped
    later than the IMU data so far and waits for them; TOO_LATE older than the buffer; DUPLICATE the same again.
    """

    PENDING = 0
    INITIALISED = 1
    ACCEPTED = 2
    INFLATED = 3
    REJECTED = 4
    REINITIALISED = 5
    TOO_LATE = 6
    DUPLICATE = 7


class FixOutcome(msgspec.Struct, frozen=True, eq=False):
    """How a fix was judged.

    `d2`: squared Mahalanobis distance of the innovation (6 dof), `d2_position` and `d2_attitude` of its halves (3).
    `innovation`: (6,) position then rotation, body axes, m and rad; `innovation_sigma`: (6,) its expected size.
    `hypothesis`: index of the pose used; `margin`: by how much it beat the other (inf for one alone).
    """

    robot: str
    t: float
    arrival: float
    outcome: Outcome
    d2: float = math.nan
    d2_position: float = math.nan
    d2_attitude: float = math.nan
    innovation: Array = msgspec.field(default_factory=lambda: np.full(6, np.nan))
    innovation_sigma: Array = msgspec.field(default_factory=lambda: np.full(6, np.nan))
    hypothesis: int = 0
    margin: float = math.inf
    source: str = ""

    @property
    def delay(self) -> float:
        """Seconds from capture to arrival."""
        return self.arrival - self.t
