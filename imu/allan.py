"""Allan deviation of an IMU at rest, and the noise that it shows.

Of a rate whose noise is white of density N (u/sqrt(Hz)), whose bias flickers by B (u) and walks by K (u/s/sqrt(Hz)),
and whose digits are Q (u s), the Allan variance over τ seconds is

    σ²(τ) = N²/τ + 2 ln2/π B² + K² τ/3 + 3 Q²/τ²

IEEE Std 952-1997, annex C. The only importer of allantools, which computes the overlapping estimate.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import allantools
import numpy as np
from scipy.optimize import nnls

from fusion.measurements import Array
from imu.calibration import CalibrationError, check_gravity, longest_rest

# Sensors: name, columns of readings, unit.
SENSORS = (("gyro", slice(1, 4), "rad/s"), ("accel", slice(4, 7), "m/s2"))
# s: the shortest rest of which there is anything to say.
SHORTEST = 10.0
# The longest τ, as a share of the rest: beyond it are too few intervals to average.
LONGEST_SHARE = 0.1
# A part of the variance is believed where it is this many times its standard error.
BELIEVED = 3.0


class Noise(NamedTuple):
    """One axis: `tau` (m,) s, `deviation` (m,) u, and what was found in them; nan where it does not show.

    `density` u/sqrt(Hz), `flicker` u, `walk` u/s/sqrt(Hz).
    """

    tau: Array
    deviation: Array
    density: float
    flicker: float
    walk: float


class Allan(NamedTuple):
    """Of the longest rest in a file: `start` and `seconds` of it, `rate_hz`, and three axes of each sensor."""

    start: float
    seconds: float
    rate_hz: float
    gyro: list[Noise]
    accel: list[Noise]


def analyse(readings: Array) -> Allan:
    """Readings (n, 7) as in `imu.calibration`. Raises CalibrationError where they hold no rest that is long enough."""
    part = readings[longest_rest(readings)]
    seconds = float(part[-1, 0] - part[0, 0]) if len(part) else 0.0
    if seconds < SHORTEST:
        raise CalibrationError(
            f"the longest rest lasts {seconds:.0f} s: {SHORTEST:.0f} s are needed for the noise and hours for the bias "
            "walk; let the device lie where nothing shakes it"
        )
    check_gravity(float(np.linalg.norm(part[:, 4:].mean(axis=0))))
    # By number, not by stamp: what is missing now and then shifts little, and what is put in between would be no noise.
    rate = (len(part) - 1) / seconds
    gyro, accel = ([_axis(values, rate) for values in part[:, columns].T] for _, columns, _ in SENSORS)
    return Allan(float(part[0, 0] - readings[0, 0]), seconds, rate, gyro, accel)


def _axis(values: Array, rate: float) -> Noise:
    tau, deviation, _, _ = allantools.oadev(values - values.mean(), rate=rate, data_type="freq", taus="octave")
    kept = (tau <= LONGEST_SHARE * len(values) / rate) & (deviation > 0.0)
    tau, deviation = tau[kept], deviation[kept]
    if len(tau) < 4:
        return Noise(tau, deviation, math.nan, math.nan, math.nan)
    # The relative error of a variance from n/m intervals, by which its equation is weighed.
    sigma = deviation**2 * np.sqrt(2.0 * tau * rate / len(values))
    parts = np.column_stack([1.0 / tau, np.full_like(tau, 2.0 * math.log(2.0) / math.pi), tau / 3.0, 3.0 / tau**2])
    weighed = parts / sigma[:, np.newaxis]
    squares, _ = nnls(weighed, deviation**2 / sigma)
    error = np.sqrt(np.diag(np.linalg.pinv(weighed.T @ weighed)))
    n2, b2, k2 = np.where(squares > BELIEVED * error, squares, np.nan)[:3].tolist()
    return Noise(tau, deviation, math.sqrt(n2), math.sqrt(b2), math.sqrt(k2))


def fitted(noise: Noise, tau: Array) -> Array:
    """The deviation that density, flicker and walk alone make at tau (m,), u."""
    n, b, k = np.nan_to_num([noise.density, noise.flicker, noise.walk]).tolist()
    deviation: Array = np.sqrt(n**2 / tau + 2.0 * math.log(2.0) / math.pi * b**2 + k**2 * tau / 3.0)
    return deviation
