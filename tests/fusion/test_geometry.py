from __future__ import annotations

import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from fusion.geometry import (
    exp_so3,
    inverse,
    log_so3,
    quaternion_from_rotation,
    rotation_about_z,
    rotation_from_quaternion,
    rotation_vectors,
    skew,
    transform,
    transform_points,
    wrap,
    yaw_of,
)

vectors = arrays(np.float64, 3, elements=st.floats(-3.0, 3.0))
angles = st.floats(-50.0, 50.0)


@given(vectors)
def test_exp_is_a_rotation(v):
    R = exp_so3(v)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert math.isclose(np.linalg.det(R), 1.0, abs_tol=1e-12)


@given(vectors, vectors)
def test_rotations_between_quaternions_are_the_logs_between_rotations(a, b):
    quaternions = [np.array([quaternion_from_rotation(exp_so3(v))]) for v in (a, b)]
    (between,) = rotation_vectors(*quaternions)
    assert np.linalg.norm(between) <= math.pi + 1e-9
    np.testing.assert_allclose(exp_so3(between), exp_so3(a).T @ exp_so3(b), atol=1e-9)


@given(vectors)
def test_log_inverts_exp_up_to_whole_turns(v):
    np.testing.assert_allclose(exp_so3(log_so3(exp_so3(v))), exp_so3(v), atol=1e-12)
    if np.linalg.norm(v) < 3.1:
        np.testing.assert_allclose(log_so3(exp_so3(v)), v, atol=1e-9)


@given(vectors, st.floats(1e-12, 1e-3))
def test_small_angles_lose_no_digits(v, scale):
    np.testing.assert_allclose(log_so3(exp_so3(v * scale)), v * scale, rtol=1e-9, atol=1e-18)


@given(st.integers(0, 2), st.floats(-1e-9, 1e-9))
def test_log_near_half_a_turn(axis, short):
    v = np.zeros(3)
    v[axis] = math.pi + short
    assert math.isclose(np.linalg.norm(log_so3(exp_so3(v))), math.pi, abs_tol=1e-8)


@given(vectors)
def test_quaternion_round_trip(v):
    R = exp_so3(v)
    q = quaternion_from_rotation(R)
    assert q[0] >= 0.0
    np.testing.assert_allclose(rotation_from_quaternion(q), R, atol=1e-12)
    np.testing.assert_allclose(rotation_from_quaternion(-q), R, atol=1e-12)


@given(vectors, vectors, vectors)
def test_neighbouring_frames_cancel(a, b, p):
    world_from_camera = transform(exp_so3(a), b)
    camera_from_marker = transform(exp_so3(b), p)
    world_from_marker = world_from_camera @ camera_from_marker
    np.testing.assert_allclose(inverse(world_from_camera) @ world_from_marker, camera_from_marker, atol=1e-12)
    np.testing.assert_allclose(
        transform_points(world_from_marker, [p])[0],
        transform_points(world_from_camera, transform_points(camera_from_marker, [p]))[0],
        atol=1e-12,
    )


@given(vectors, vectors)
def test_skew_is_the_cross_product(a, b):
    np.testing.assert_allclose(skew(a) @ b, np.cross(a, b), atol=1e-12)


@given(angles)
def test_wrap_and_yaw(angle):
    assert -math.pi <= wrap(angle) < math.pi
    assert math.isclose(math.cos(wrap(angle)), math.cos(angle), abs_tol=1e-9)
    assert math.isclose(abs(wrap(yaw_of(rotation_about_z(angle)) - angle)) % (2 * math.pi), 0.0, abs_tol=1e-9)
