"""x, y and yaw of bodies that stand level on the floor, from corners whose places on the body are known: compiled.

Least squares by Gauss and Newton on the corner pixels, from where the corners' rays meet the plane at their height. The
lens comes in once, by the rays and by how pixels answer to them there: what is left of a corner's residual after that
is of second order in a fraction of a pixel.
"""

# numba reads these functions: plain loops and scalars are what it compiles best.
# mypy cannot look through its decorator.
from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from fusion.measurements import Array

# What is taken as known is known this well: the height of the body above the floor, m, ...
FLOOR_HEIGHT_SIGMA = 0.005
# ... and its roll and pitch, rad. An uneven floor, a soft tyre, a marker glued on a little askew.
FLOOR_TILT_SIGMA = 0.01

_ROUNDS, _SMALL_GAIN = 20, 1e-6

_jit: Any = njit(cache=True, error_model="numpy", nogil=True)


def solve_planar(
    points_body: Array,
    rays_camera: Array,
    by_ray: Array,
    residual_sigma: Array,
    count: NDArray[np.int_],
    world_from_camera: Array,
    placement: Array,
) -> tuple[Array, Array, Array, Array]:
    """The level poses of m bodies, all corners of one after those of the other.

    `points_body`: (n, 3) corners in their body's frame, m. `rays_camera`: (n, 2) where they are seen, x/z and y/z.
    `by_ray`: (n, 2, 2) px by ray. `residual_sigma`: (n,) of a corner's coordinate, px. `count`: (m,) corners of each.
    `placement`: (6, 6) covariance of `world_from_camera`, position and rotation, world axes.
    -> (m, 3) x, y, yaw, m and rad, (m, 6, 6) covariance and its systematic part, and (m,) misfit, as in
    `fusion.measurements.PoseHypothesis`: NaN for a body that no pose in front of the camera explains.
    """
    m = len(count)
    state, covariance, systematic, misfit = np.zeros((m, 3)), np.zeros((m, 6, 6)), np.zeros((m, 6, 6)), np.zeros(m)
    _solve(
        points_body, rays_camera, by_ray, residual_sigma, count, world_from_camera, placement,
        state, covariance, systematic, misfit,
    )  # fmt: skip
    return state, covariance, systematic, misfit


def warm_up() -> None:
    """Compile, or load from numba's cache, before the first picture needs it."""
    nothing = np.zeros((0, 3)), np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros(0), np.zeros(0, np.int_)
    solve_planar(*nothing, np.eye(4), np.zeros((6, 6)))


@_jit
def _solve(points, rays, by_ray, sigma, count, pose, placement, state, covariance, systematic, misfit):
    J = np.zeros((2, 6))
    normal, gradient = np.zeros((6, 6)), np.zeros(6)
    noise = np.zeros((3, 3))
    last = 0
    for k in range(len(count)):
        first, last = last, last + count[k]
        possible = _start(points, rays, first, last, pose, state[k])
        for _ in range(_ROUNDS):
            if not possible:
                break
            misfit[k] = _normal(points, rays, by_ray, sigma, first, last, pose, state[k], J, normal, gradient)
            possible = math.isfinite(misfit[k]) and _inverse(normal, noise)
            gain = 0.0
            for i in range(3):
                step = 0.0
                for j in range(3):
                    step += noise[i, j] * gradient[_solved(j)]
                state[k, i] += step
                gain += step * gradient[_solved(i)]
            if gain < _SMALL_GAIN:
                break
        if possible:
            corners = last - first
            _covariance(normal, noise, misfit[k], corners, pose, placement, state[k], covariance[k], systematic[k])
        else:
            misfit[k] = math.nan


@_jit
def _solved(i):
    """Which of (x, y, z, rotation about x, y, z) is the i-th of those that are solved for."""
    return 5 if i == 2 else i


@_jit
def _start(points, rays, first, last, pose, state):
    """Each corner's ray cut with the plane at that corner's height, then the rotation and shift of the plane that fit
    best (Umeyama, 1991, without scale, in two dimensions). -> whether all rays meet their plane."""
    n = last - first
    floor = np.zeros((n, 2))
    body_x = body_y = floor_x = floor_y = 0.0
    for i in range(n):
        u, v = rays[first + i, 0], rays[first + i, 1]
        down = pose[2, 0] * u + pose[2, 1] * v + pose[2, 2]
        distance = (points[first + i, 2] - pose[2, 3]) / down if down != 0.0 else -1.0
        if not (math.isfinite(distance) and distance > 0.0):
            return False
        for a in range(2):
            floor[i, a] = pose[a, 3] + distance * (pose[a, 0] * u + pose[a, 1] * v + pose[a, 2])
        body_x += points[first + i, 0] / n
        body_y += points[first + i, 1] / n
        floor_x += floor[i, 0] / n
        floor_y += floor[i, 1] / n
    along = across = 0.0
    for i in range(n):
        ax, ay = points[first + i, 0] - body_x, points[first + i, 1] - body_y
        bx, by = floor[i, 0] - floor_x, floor[i, 1] - floor_y
        along += ax * bx + ay * by
        across += ax * by - ay * bx
    state[2] = math.atan2(across, along)
    c, s = math.cos(state[2]), math.sin(state[2])
    state[0] = floor_x - (c * body_x - s * body_y)
    state[1] = floor_y - (s * body_x + c * body_y)
    return True


@_jit
def _normal(points, rays, by_ray, sigma, first, last, pose, state, J, normal, gradient):
    """The normal matrix (6, 6) and the gradient (6,) of a level pose, of all six unknowns. -> the misfit, NaN where a
    corner is not in front of the camera."""
    normal[:] = 0.0
    gradient[:] = 0.0
    misfit = 0.0
    c, s = math.cos(state[2]), math.sin(state[2])
    for i in range(first, last):
        # The corner from the body's origin, and from the camera, along the world's axes
        lx, ly, lz = c * points[i, 0] - s * points[i, 1], s * points[i, 0] + c * points[i, 1], points[i, 2]
        wx, wy, wz = lx + state[0] - pose[0, 3], ly + state[1] - pose[1, 3], lz - pose[2, 3]
        x = pose[0, 0] * wx + pose[1, 0] * wy + pose[2, 0] * wz
        y = pose[0, 1] * wx + pose[1, 1] * wy + pose[2, 1] * wz
        z = pose[0, 2] * wx + pose[1, 2] * wy + pose[2, 2] * wz
        if z < 1e-3:
            return math.nan
        u, v = x / z, y / z
        for a in range(2):
            p, q = by_ray[i, a, 0] / sigma[i], by_ray[i, a, 1] / sigma[i]
            residual = p * (rays[i, 0] - u) + q * (rays[i, 1] - v)
            # d(x/z, y/z) = (dx - u dz, dy - v dz) / z
            for j in range(3):
                J[a, j] = (p * pose[j, 0] + q * pose[j, 1] - (p * u + q * v) * pose[j, 2]) / z
            # d(p + exp(dtheta) l) / d dtheta = -[l]x, and -j [l]x = l × j
            J[a, 3] = ly * J[a, 2] - lz * J[a, 1]
            J[a, 4] = lz * J[a, 0] - lx * J[a, 2]
            J[a, 5] = lx * J[a, 1] - ly * J[a, 0]
            for j in range(6):
                gradient[j] += J[a, j] * residual
                for l in range(6):
                    normal[j, l] += J[a, j] * J[a, l]
            misfit += residual * residual
    return misfit


@_jit
def _inverse(normal, noise):
    """Of the part of what is solved for, (3, 3), by its adjugate. -> whether there is one."""
    a, b, c = normal[0, 0], normal[0, 1], normal[0, 5]
    d, e, f = normal[1, 1], normal[1, 5], normal[5, 5]
    noise[0, 0], noise[0, 1], noise[0, 2] = d * f - e * e, c * e - b * f, b * e - c * d
    noise[1, 1], noise[1, 2], noise[2, 2] = a * f - c * c, b * c - a * e, a * d - b * b
    determinant = a * noise[0, 0] + b * noise[0, 1] + c * noise[0, 2]
    if not (math.isfinite(determinant) and determinant > 1e-12 * a * d * f):
        return False
    for i in range(3):
        for j in range(i, 3):
            noise[i, j] /= determinant
            noise[j, i] = noise[i, j]
    return True


@_jit
def _covariance(normal, noise, misfit, corners, pose, placement, state, covariance, systematic):
    # What is wrong with the assumptions and with the camera's place is so in each frame: the systematic part.
    # How the solved part answers to a motion of the body that the solve does not know of: dx = response @ motion.
    # Height and tilt are errors of what was assumed ("consider" covariance), a misplaced camera moves all six.
    response, moved = np.zeros((3, 6)), np.zeros((3, 6))
    for i in range(3):
        for j in range(6):
            for l in range(3):
                response[i, j] += noise[i, l] * normal[_solved(l), j]
    assumed = np.zeros((6, 3))
    for l in range(3):
        for i in range(3):
            assumed[_solved(i), l] = response[i, 2 + l]
        assumed[2 + l, l] = -1.0
    for i in range(6):
        for j in range(6):
            for l in range(3):
                variance = FLOOR_HEIGHT_SIGMA**2 if l == 0 else FLOOR_TILT_SIGMA**2
                systematic[i, j] += assumed[i, l] * variance * assumed[j, l]
    # A body moves with the camera as one, (I, -[x]x; 0, I) with x from the camera to the body.
    x, y, z = state[0] - pose[0, 3], state[1] - pose[1, 3], -pose[2, 3]
    for i in range(3):
        a, b, c = response[i, 0], response[i, 1], response[i, 2]
        moved[i, 0], moved[i, 1], moved[i, 2] = a, b, c
        # -a [x]x = x × a
        moved[i, 3] = response[i, 3] + y * c - z * b
        moved[i, 4] = response[i, 4] + z * a - x * c
        moved[i, 5] = response[i, 5] + x * b - y * a
    # 1, or by how much the corners' variance must have been larger to explain a misfit beyond chance: beyond the .999
    # quantile of the chi-square distribution, by Wilson and Hilferty (1931).
    freedom = 2.0 * corners - 3.0
    spread = 2.0 / (9.0 * freedom)
    inflation = max(1.0, misfit / (freedom * (1.0 - spread + 3.0902 * math.sqrt(spread)) ** 3))
    for i in range(3):
        for j in range(3):
            for l in range(6):
                for n in range(6):
                    systematic[_solved(i), _solved(j)] += moved[i, l] * placement[l, n] * moved[j, n]
            covariance[_solved(i), _solved(j)] = noise[i, j] * inflation
    covariance += systematic
