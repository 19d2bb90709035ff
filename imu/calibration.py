"""An IMU's errors and its mounting, found at rest and in six positions; `imu.mounting` takes them out.

Readings (n, 7): t in s, angular rate in rad/s, specific force in m/s2, along the IMU's own axes.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from fusion.measurements import Array
from fusion.params import GRAVITY
from imu.health import UNITS

# Rest is judged over windows of WINDOW s by the scatter of the means over BLOCK s, in which noise and the shaking of a
# fan are small, but not a hand's tremor (4 to 10 Hz).
BLOCK = 0.1
WINDOW = 1.0
# rad/s and m/s2: largest scatter of a window at rest (white noise of 2.5e-3 rad/s/sqrt(Hz), 0.05 m/s2/sqrt(Hz)); where
# the quietest window is quieter, a window at rest is within CALMER times that.
SCATTER = (0.008, 0.15)
CALMER = 4.0
# rad/s and m/s2: by how much the mean of a window may differ from that of the RECENT ones before it. From all of them
# it may by more: within hours a bias drifts with the temperature.
CHANGE = (0.005, 0.15)
RECENT = 10
# rad/s: a larger mean rate is no gyroscope's bias.
LARGEST_BIAS = 0.3
# Gravity is read within this share by an accelerometer that needs no repair.
GRAVITY_SHARE = 0.1

# Six positions: s of rest in each; cosine of the angle within which an axis counts as upright; rad by which a device is
# askew that was put on its side by hand.
POSITION_REST = 2.0
UPRIGHT = math.cos(math.radians(20.0))
PLACEMENT = math.radians(1.0)
SIDES = ("+x", "-x", "+y", "-y", "+z", "-z")


class CalibrationError(ValueError):
    """Readings from which nothing can be calibrated. The text says what is wrong with them and what would be right."""


class Rest(NamedTuple):
    """What readings at rest say.

    `start`, `seconds`: when, and how long; `rate_hz`. `gyro_bias` (3,) rad/s; `gyro_scatter`, `accel_scatter` (3,)
    standard deviations of single readings, rad/s and m/s2; `force` (3,) mean specific force, m/s2. `rotation_deg`: roll
    and pitch that put gravity upright, with a yaw of 0, which gravity does not show.
    """

    start: float
    seconds: float
    rate_hz: float
    gyro_bias: Array
    gyro_scatter: Array
    force: Array
    accel_scatter: Array
    rotation_deg: tuple[float, float, float]


def rate_of(readings: Array) -> float:
    """Samples a second, by the usual step. Raises CalibrationError for readings whose stamps do not rise."""
    step = float(np.median(np.diff(readings[:, 0]))) if len(readings) > 1 else math.nan
    if not step > 0.0:
        raise CalibrationError(f"{len(readings)} samples without rising stamps: at least some seconds are needed")
    return 1.0 / step


def rests(readings: Array) -> list[slice]:
    """The stretches at rest, of whole windows, in order. Raises CalibrationError where the stamps do not rise."""
    block = max(1, round(BLOCK * rate_of(readings)))
    size = block * round(WINDOW / BLOCK)
    n = len(readings) // size
    if n == 0:
        return []
    means = readings[: n * size, 1:].reshape(n, size // block, block, 6).mean(axis=2)
    window = means.mean(axis=1)
    scatter = means.std(axis=1)
    quiet = np.linalg.norm(window[:, :3], axis=1) < LARGEST_BIAS
    for columns, most, digits in ((slice(0, 3), SCATTER[0], 5e-4), (slice(3, 6), SCATTER[1], 5e-3)):
        largest = scatter[:, columns].max(axis=1)
        quiet &= largest <= min(most, max(CALMER * largest.min(), digits))
    # A window that a pause of the device lies in, or that is stamped backwards, is no window.
    span = readings[size - 1 : n * size : size, 0] - readings[0 : n * size : size, 0]
    quiet &= (span > 0.5 * WINDOW) & (span < 2.0 * WINDOW)
    stretches: list[slice] = []
    first = 0
    for i in range(n + 1):
        moved = i == n or not quiet[i]
        if not moved and i > first:
            change = np.abs(window[i] - window[max(first, i - RECENT) : i].mean(axis=0))
            moved = bool(change[:3].max() > CHANGE[0] or change[3:].max() > CHANGE[1])
        if moved:
            if i > first:
                stretches.append(slice(first * size, i * size))
            first = i if i < n and quiet[i] else i + 1
    return stretches


def longest_rest(readings: Array) -> slice:
    """Of `rests`; empty where there is none."""
    return max(rests(readings), key=lambda stretch: stretch.stop - stretch.start, default=slice(0, 0))


def _duration(readings: Array, stretch: slice) -> float:
    return float((stretch.stop - stretch.start) / rate_of(readings))


def at_rest(readings: Array, seconds: float = 10.0) -> Rest:
    """The longest rest in readings (n, 7). Raises CalibrationError if it is under `seconds`, or its gravity is none."""
    longest = longest_rest(readings)
    duration = _duration(readings, longest)
    # Windows are whole ones: up to one is lost at the end.
    if duration < max(seconds - 1.1 * WINDOW, 0.5 * WINDOW):
        span = len(readings) / rate_of(readings)
        if span < seconds:
            raise CalibrationError(f"{span:.1f} s of readings; {seconds:g} s at rest are needed")
        # In a wrong unit rest looks like motion.
        check_gravity(float(np.median(np.linalg.norm(readings[:, 4:], axis=1))))
        best = (
            f"it was still for {duration:.0f} s at most"
            if duration
            else "it was never still, or its rates are not rad/s"
        )
        raise CalibrationError(f"the IMU moved: {best}; {seconds:g} s are needed, on something firm")
    part = readings[longest]
    mean, scatter = part[:, 1:].mean(axis=0), part[:, 1:].std(axis=0)
    check_gravity(float(np.linalg.norm(mean[3:])))
    fx, fy, fz = mean[3:]
    rotation = (math.degrees(math.atan2(fy, fz)), math.degrees(math.atan2(-fx, math.hypot(fy, fz))), 0.0)
    start = float(part[0, 0] - readings[0, 0])
    return Rest(start, duration, rate_of(part), mean[:3], scatter[:3], mean[3:], scatter[3:], rotation)


def check_gravity(norm: float) -> None:
    """Raises CalibrationError for a specific force at rest of `norm` m/s2 that cannot be gravity."""
    if abs(norm - GRAVITY) < GRAVITY_SHARE * GRAVITY:
        return
    named = (text for reads, text in UNITS if abs(norm - reads) < GRAVITY_SHARE * reads)
    what = next(named, "the unit or the scale is wrong, or it was in free fall")
    raise CalibrationError(f"gravity reads {norm:.4g} instead of {GRAVITY:.2f} m/s2: {what}")


class Positions(NamedTuple):
    """An accelerometer's calibration from positions at rest.

    `matrix` (3, 3) and `bias` (3,) as in `ImuCalibration`. `matrix_sigma` (3, 3), `bias_sigma` (3,). `error` (n,): by
    how much gravity misreads in each position with them, `error_before` without, m/s2. `sides`: how many positions on
    each of SIDES.
    """

    matrix: Array
    bias: Array
    matrix_sigma: Array
    bias_sigma: Array
    error: Array
    error_before: Array
    sides: dict[str, int]


def positions_seen(readings: Array) -> Array:
    """(m, 3): mean specific force of each position in which it rested long enough, those alike as one."""
    groups: list[list[Array]] = []
    for stretch in rests(readings):
        if _duration(readings, stretch) < POSITION_REST - 0.5 * WINDOW:
            continue
        force = readings[stretch, 4:].mean(axis=0)
        for group in groups:
            if np.dot(force, group[0]) > math.cos(math.radians(3.0)) * np.linalg.norm(force) * np.linalg.norm(group[0]):
                group.append(force)
                break
        else:
            groups.append([force])
    return np.array([np.mean(group, axis=0) for group in groups]).reshape(-1, 3)


def side_of(force: Array) -> str:
    """Which axis is up, one of SIDES; "" where it is none within 20 degrees."""
    axis = int(np.argmax(np.abs(force)))
    if abs(force[axis]) < UPRIGHT * np.linalg.norm(force):
        return ""
    return ("+" if force[axis] > 0.0 else "-") + "xyz"[axis]


def solve_positions(forces: Array) -> Positions:
    """Specific force at rest (m, 3), in m/s2, on all six sides and in any other positions -> the calibration.

    Least squares of |M (f - b)| = g, which holds however the device lies, together with the direction of gravity on its
    six sides, which is only as good as it was placed: that decides the misalignment, which six lengths cannot.
    Raises CalibrationError if a side is missing or gravity is none.
    """
    for norm in np.linalg.norm(forces, axis=1):
        check_gravity(float(norm))
    sides = [side_of(force) for force in forces]
    if missing := [side for side in SIDES if side not in sides]:
        raise CalibrationError(
            f"{len(forces)} positions at rest, none with {' '.join(missing)} up: "
            f"lay the device on each of its six sides, {POSITION_REST:g} s still on each"
        )
    upright = np.array([i for i, side in enumerate(sides) if side])
    axes = np.array(["xyz".index(sides[i][1]) for i in upright])
    sideways = np.array([[j for j in range(3) if j != axis] for axis in axes])
    # m/s2: nonlinearity and noise of a mean; and gravity along an axis that is askew
    length_sigma, side_sigma = 0.01, GRAVITY * PLACEMENT

    def residuals(x: Array) -> Array:
        true = (forces - x[9:]) @ x[:9].reshape(3, 3).T
        lengths = (np.linalg.norm(true, axis=1) - GRAVITY) / length_sigma
        return np.concatenate([lengths, np.take_along_axis(true[upright], sideways, axis=1).ravel() / side_sigma])

    solved = least_squares(residuals, np.concatenate([np.eye(3).ravel(), np.zeros(3)]))
    sigma = np.sqrt(np.diag(np.linalg.inv(solved.jac.T @ solved.jac)))
    matrix, bias = solved.x[:9].reshape(3, 3), solved.x[9:]
    return Positions(
        matrix,
        bias,
        sigma[:9].reshape(3, 3),
        sigma[9:],
        np.linalg.norm((forces - bias) @ matrix.T, axis=1) - GRAVITY,
        np.linalg.norm(forces, axis=1) - GRAVITY,
        {side: sides.count(side) for side in SIDES},
    )
