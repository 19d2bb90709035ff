"""A robot on a circle: the one motion whose IMU and pose can be written down without a simulator.

Speed v and turning rate w are constant, so that gyro = (0, 0, w) and specific force = (0, v w, g) in body axes.
"""

from __future__ import annotations

import numpy as np

from fusion.geometry import quaternion_from_rotation, rotation_about_z
from fusion.measurements import Array, ImuBatch, PoseFix, PoseHypothesis
from fusion.params import GRAVITY

SPEED, TURN = 0.5, 0.4
SIGMA_POSITION, SIGMA_ATTITUDE = 0.005, 0.0175
COVARIANCE = np.diag([SIGMA_POSITION**2] * 3 + [SIGMA_ATTITUDE**2] * 3)


def pose(t: float) -> tuple[Array, Array]:
    """Position (3,) and rotation (3, 3) at t."""
    radius, yaw = SPEED / TURN, TURN * t
    return np.array([radius * np.sin(yaw), radius * (1.0 - np.cos(yaw)), 0.0]), rotation_about_z(yaw)


def imu(t: Array, rng: np.random.Generator | None = None) -> Array:
    """Samples (n, 7) at the evenly spaced instants t, with the noise densities of FilterParams if there is an rng."""
    samples = np.tile([0.0, 0.0, 0.0, TURN, 0.0, SPEED * TURN, GRAVITY], (len(t), 1))
    samples[:, 0] = t
    if rng is not None:
        root = np.sqrt((len(t) - 1) / (t[-1] - t[0]))
        samples[:, 1:4] += rng.normal(0.0, 1e-3 * root, (len(t), 3))
        samples[:, 4:7] += rng.normal(0.0, 2e-2 * root, (len(t), 3))
    return samples


def batch(t: Array, rng: np.random.Generator | None = None) -> ImuBatch:
    samples = imu(t, rng)
    return ImuBatch("rover", float(t[-1]), samples)


def hypothesis(
    t: float, rng: np.random.Generator | None = None, offset: Array | None = None, turned: float = 0.0
) -> PoseHypothesis:
    position, rotation = pose(t)
    quaternion = quaternion_from_rotation(rotation @ rotation_about_z(turned))
    noise = np.zeros(3) if rng is None else rng.normal(0.0, SIGMA_POSITION, 3)
    return PoseHypothesis(position + noise + (0.0 if offset is None else offset), quaternion, COVARIANCE)


def fix(
    t: float,
    delay: float = 0.15,
    rng: np.random.Generator | None = None,
    offset: Array | None = None,
    turned: float = 0.0,
) -> PoseFix:
    return PoseFix("rover", t, t + delay, (hypothesis(t, rng, offset, turned),), "ceiling")
