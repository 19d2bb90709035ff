"""What an IMU reads -> what a perfect one at the body's origin would.

Readings (n, 7) are those of an `ImuBatch`: t in s, angular rate in rad/s, specific force in m/s2, but along the axes of
the IMU and with its errors. `ImuCalibration` says what is known of them, `BodyReadings` takes them out;
`imu.calibration` finds them.
"""

from __future__ import annotations

import json
import math
from typing import Annotated

import numpy as np
from msgspec import Meta, Struct

from fusion.geometry import rotation_about_z, skew
from fusion.measurements import Array

Metres = Annotated[float, Meta(ge=-10.0, le=10.0)]
Degrees = Annotated[float, Meta(ge=-360.0, le=360.0)]
Rate = Annotated[float, Meta(ge=-1.0, le=1.0)]
Force = Annotated[float, Meta(ge=-5.0, le=5.0)]
Gain = Annotated[float, Meta(ge=-2.0, le=2.0)]
Row = tuple[Gain, Gain, Gain]

# s: over a longer pause the angular rate says nothing of the angular acceleration; and no device samples faster than
# the shortest, so that stamps which are closer are not as the samples were.
LONGEST_STEP = 0.1
SHORTEST_STEP = 5e-4


class ImuCalibration(Struct, frozen=True, forbid_unknown_fields=True):
    """How an IMU is mounted, and its errors; by default it is perfect, at the body's origin, along its axes."""

    position_m: tuple[Metres, Metres, Metres] = (0.0, 0.0, 0.0)
    """Of the IMU, from the body's origin: forward, left, up."""
    rotation_deg: tuple[Degrees, Degrees, Degrees] = (0.0, 0.0, 0.0)
    """Roll, pitch, yaw: body_from_imu = Rz(yaw) Ry(pitch) Rx(roll)."""
    gyro_bias: tuple[Rate, Rate, Rate] = (0.0, 0.0, 0.0)
    """rad/s, along the IMU's axes: what it reads at rest."""
    accel_bias: tuple[Force, Force, Force] = (0.0, 0.0, 0.0)
    """m/s2, along the IMU's axes."""
    accel_matrix: tuple[Row, Row, Row] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    """Rows. Scale and misalignment: true specific force = accel_matrix (reading - accel_bias)."""


def given(calibration: ImuCalibration) -> dict[str, tuple[float, ...] | tuple[Row, ...]]:
    """The keys that are not as by default."""
    perfect = ImuCalibration()
    values = {name: getattr(calibration, name) for name in ImuCalibration.__struct_fields__}
    return {name: value for name, value in values.items() if value != getattr(perfect, name)}


def toml_lines(calibration: ImuCalibration) -> list[str]:
    """The keys that are not as by default, as lines of TOML."""
    return [f"{name} = {json.dumps(value)}" for name, value in given(calibration).items()]


def rotation_from_deg(rotation_deg: tuple[float, float, float]) -> Array:
    """Roll, pitch, yaw in degrees -> body_from_imu (3, 3)."""
    roll, pitch, yaw = map(math.radians, rotation_deg)
    cr, sr, cp, sp = math.cos(roll), math.sin(roll), math.cos(pitch), math.sin(pitch)
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, cr, -sr], [0.0, sr, cr]])
    about_y = np.array([[cp, 0.0, sp], [0.0, 1.0, 0.0], [-sp, 0.0, cp]])
    rotation: Array = rotation_about_z(yaw) @ about_y @ about_x
    return rotation


def deg_from_rotation(body_from_imu: Array) -> tuple[float, float, float]:
    """The inverse of `rotation_from_deg`; where pitch is +-90 deg and only yaw -+ roll is known, roll is 0."""
    R = body_from_imu
    pitch = math.atan2(-R[2, 0], math.hypot(R[2, 1], R[2, 2]))
    if math.hypot(R[2, 1], R[2, 2]) < 1e-9:
        roll, yaw = 0.0, math.atan2(-R[0, 1], R[1, 1])
    else:
        roll, yaw = math.atan2(R[2, 1], R[2, 2]), math.atan2(R[1, 0], R[0, 0])
    return math.degrees(roll), math.degrees(pitch), math.degrees(yaw)


class BodyReadings:
    """Takes the calibration's errors out of readings, and brings them to the body's origin and axes.

    With lever arm l, the specific force at the origin is f - α × l - ω × (ω × l). α is the difference of two rates over
    their distance. It is noisy, but its integral is not: in the velocity it leaves no more than the noise of one rate
    times l, and nothing that grows. (The other way, to let the filter carry the IMU's place and to move its poses,
    needs no α; but then it is the IMU that must never slide sideways, which off the axle it does: in
    `benchmarks.imu lever-arms` that is worse than to say nothing of the lever arm.)

    One sample's answer depends on the samples before it, not on how they are cut into batches.
    """

    def __init__(self, calibration: ImuCalibration) -> None:
        rotation = rotation_from_deg(calibration.rotation_deg)
        # (sensor, body axis, IMU axis), and (sensor, IMU axis)
        self._to_body = np.stack([rotation, rotation @ np.array(calibration.accel_matrix)])
        self._bias = np.array([calibration.gyro_bias, calibration.accel_bias])
        self._lever = np.array(calibration.position_m)
        self._off_origin = bool(self._lever.any())
        self._as_it_is = not given(calibration)
        # t, angular rate of the last sample, and the step to it
        self._last = np.full(4, np.nan)
        self._step = 0.0

    def __call__(self, readings: Array) -> Array:
        """(n, 7) -> (n, 7): stamps as they are, the rest in body axes and at the body's origin."""
        if self._as_it_is or not len(readings):
            return readings
        out = np.empty_like(readings)
        out[:, 0] = readings[:, 0]
        true = readings[:, 1:].reshape(-1, 2, 3) - self._bias
        out[:, 1:] = _product(self._to_body, true).reshape(-1, 6)
        if self._off_origin:
            self._to_origin(out)
        return out

    def _to_origin(self, out: Array) -> None:
        before = np.vstack([self._last, out[:-1, :4]])
        change = out[:, :4] - before
        step = change[:, 0]
        # The longer of two steps: a stamp that jitters must not make a blow of its sample's noise.
        longer = np.fmax(np.fmax(step, np.append(self._step, step[:-1])), SHORTEST_STEP)
        known = (step > 0.0) & (step < LONGEST_STEP)
        alpha = np.where(known[:, np.newaxis], change[:, 1:] / longer[:, np.newaxis], 0.0)
        self._last, self._step = out[-1, :4].copy(), float(step[-1])
        w, l = out[:, 1:4], self._lever
        along = w[:, :1] * l[0] + w[:, 1:2] * l[1] + w[:, 2:] * l[2]
        square = w[:, :1] * w[:, :1] + w[:, 1:2] * w[:, 1:2] + w[:, 2:] * w[:, 2:]
        # α × l = -[l]x α, and ω × (ω × l) = ω (ω · l) - l (ω · ω)
        out[:, 4:] -= _product(-skew(l), alpha) + w * along - l * square


def _product(A: Array, v: Array) -> Array:
    """Matrices (..., i, j) times vectors (n, ..., j), in sums: a matrix product's last bit depends on n."""
    product: Array = A[..., 0] * v[..., :1] + A[..., 1] * v[..., 1:2] + A[..., 2] * v[..., 2:]
    return product
