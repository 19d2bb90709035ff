"""Rotations and rigid transforms.

A rotation is a (3, 3) array, a rigid transform a (4, 4) array that is named `a_from_b` and satisfies
`p_a = a_from_b @ p_b` on homogeneous points, so that neighbours cancel: `world_from_camera @ camera_from_body`.
Quaternions are (4,), Hamilton, in the order w, x, y, z; `q` and `-q` are the same rotation.

Equations: J. Sola, J. Deray, D. Atchuthan, "A micro Lie theory for state estimation in robotics" (2018), numbers in
brackets.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from fusion.measurements import Array

# Below this angle sin(a)/a and its like are replaced by their series: the next term is under 1e-17.
_SMALL = 1e-4


def skew(v: ArrayLike) -> Array:
    """(3, 3) with `skew(a) @ b == cross(a, b)`."""
    x, y, z = np.asarray(v, dtype=np.float64).tolist()
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def exp_so3(rotation_vector: ArrayLike) -> Array:
    """Rotation vector (3,), rad -> rotation (3, 3). Rodrigues' formula [132]: I + a [v]x + b [v]x²."""
    x, y, z = np.asarray(rotation_vector, dtype=np.float64).tolist()
    angle = math.sqrt(x * x + y * y + z * z)
    if angle < _SMALL:
        a, b = 1.0 - angle * angle / 6.0, 0.5 - angle * angle / 24.0
    else:
        a, b = math.sin(angle) / angle, (1.0 - math.cos(angle)) / (angle * angle)
    # in scalars, which is several times as fast
    return np.array(
        [
            [1.0 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y],
            [b * x * y + a * z, 1.0 - b * (x * x + z * z), b * y * z - a * x],
            [b * x * z - a * y, b * y * z + a * x, 1.0 - b * (x * x + y * y)],
        ]
    )


def log_so3(R: ArrayLike) -> Array:
    """Rotation (3, 3) -> rotation vector (3,), rad, of length <= pi. Inverse of `exp_so3` [133]."""
    w, x, y, z = quaternion_from_rotation(R)
    v = np.array([x, y, z])
    n = float(np.linalg.norm(v))
    # 2 atan2(|v|, w) / |v|; w >= 0, so the angle is at most pi and well-conditioned there, unlike acos of the trace.
    factor = 2.0 / w * (1.0 - (n / w) ** 2 / 3.0) if n < _SMALL else 2.0 * math.atan2(n, w) / n
    scaled: Array = factor * v
    return scaled


def rotation_from_quaternion(quaternion_wxyz: ArrayLike) -> Array:
    """Unit quaternion (4,) -> rotation (3, 3)."""
    w, x, y, z = np.asarray(quaternion_wxyz, dtype=np.float64).tolist()
    return np.array(
        [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
            [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
            [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
        ]
    )


def rotation_vectors(a_wxyz: Array, b_wxyz: Array) -> Array:
    """(n, 3) rad, of length <= pi: the rotations conj(a) b between quaternions, (n, 4) each."""
    a, b = a_wxyz, b_wxyz
    w = np.sum(a * b, axis=1)
    v = a[:, :1] * b[:, 1:] - b[:, :1] * a[:, 1:] - np.cross(a[:, 1:], b[:, 1:])
    v = np.where(w[:, np.newaxis] < 0.0, -v, v)
    n = np.linalg.norm(v, axis=1)
    vectors: Array = v * np.where(n > 1e-9, 2.0 * np.arctan2(n, np.abs(w)) / np.maximum(n, 1e-12), 2.0)[:, np.newaxis]
    return vectors


def quaternion_from_rotation(rotation: ArrayLike) -> Array:
    """Rotation (3, 3) -> unit quaternion (4,), w, x, y, z with w >= 0.

    The largest of the four is computed first, so that no small number is divided by (Shepperd's method, 1978).
    """
    # In scalars, since arrays of four take several times as long.
    (a, b, c), (d, e, f), (g, h, i) = np.asarray(rotation, dtype=np.float64).tolist()
    # 4 w², 4 x², 4 y², 4 z² from the diagonal
    w2, x2, y2, z2 = 1.0 + a + e + i, 1.0 + a - e - i, 1.0 - a + e - i, 1.0 - a - e + i
    largest = max(w2, x2, y2, z2)
    if w2 == largest:
        w, x, y, z = w2, h - f, c - g, d - b
    elif x2 == largest:
        w, x, y, z = h - f, x2, d + b, c + g
    elif y2 == largest:
        w, x, y, z = c - g, d + b, y2, h + f
    else:
        w, x, y, z = d - b, c + g, h + f, z2
    scale = math.copysign(1.0 / math.sqrt(w * w + x * x + y * y + z * z), w)
    return np.array([scale * w, scale * x, scale * y, scale * z])


def yaw_of(R: ArrayLike) -> float:
    """Heading of the rotated x axis in the xy plane, rad, in (-pi, pi]."""
    R = np.asarray(R, dtype=np.float64)
    return math.atan2(R[1, 0], R[0, 0])


def rotation_about_z(yaw: float) -> Array:
    """(3, 3), anticlockwise by `yaw` rad."""
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def wrap(angle: float) -> float:
    """The same angle in [-pi, pi), rad."""
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


def transform(rotation: ArrayLike, translation: ArrayLike) -> Array:
    """(4, 4) from a rotation (3, 3) and a translation (3,)."""
    T = np.eye(4)
    T[:3, :3] = rotation
    T[:3, 3] = translation
    return T


def inverse(a_from_b: ArrayLike) -> Array:
    """`b_from_a`: (R^T, -R^T p)."""
    T = np.asarray(a_from_b, dtype=np.float64)
    R_transposed = T[:3, :3].T
    return transform(R_transposed, -R_transposed @ T[:3, 3])


def transform_points(a_from_b: ArrayLike, points_b: ArrayLike) -> Array:
    """(n, 3) points in b -> (n, 3) points in a."""
    T = np.asarray(a_from_b, dtype=np.float64)
    points: Array = np.asarray(points_b, dtype=np.float64) @ T[:3, :3].T + T[:3, 3]
    return points
