"""The kernels by themselves: Jacobians against central differences, and what an update must leave true."""

from __future__ import annotations

import numpy as np
import pytest

from fusion import kernels as k
from fusion.geometry import exp_so3, log_so3, quaternion_from_rotation, rotation_from_quaternion
from fusion.params import GRAVITY, FilterParams
from fusion.timeline import parameter_vector

INPUT = np.array([0.7, -0.4, 1.1, 0.8, -1.2, 9.4])


def some_state(rng):
    s = np.zeros(k.STATE)
    s[k.Q : k.Q + 4] = quaternion_from_rotation(exp_so3(rng.normal(0.0, 0.8, 3)))
    s[k.V : k.V + 3] = rng.normal(0.0, 1.0, 3)
    s[k.POS : k.POS + 3] = rng.normal(0.0, 2.0, 3)
    s[k.BG : k.BG + 3] = rng.normal(0.0, 0.02, 3)
    s[k.BA : k.BA + 3] = rng.normal(0.0, 0.2, 3)
    s[k.TD] = 0.01
    s[k.TILT : k.TILT + 2] = rng.normal(0.0, 0.02, 2)
    s[k.WHEEL : k.WHEEL + 2] = [0.03, -0.05]
    s[k.SCALE : k.SCALE + 4] = s[k.CONSTRAINT_NIS : k.CONSTRAINT_NIS + 4] = 1.0
    return s


def some_covariance(rng):
    A = rng.normal(0.0, 0.1, (k.N, k.N))
    return A @ A.T + 1e-4 * np.eye(k.N)


def moved(s, dx, fix=False):
    """The state whose error from s is dx, from the definition of the error; that by a fix counts δv δt_d in."""
    out = s.copy()
    R = rotation_from_quaternion(s[k.Q : k.Q + 4])
    out[k.Q : k.Q + 4] = quaternion_from_rotation(R @ exp_so3(dx[k.TH : k.TH + 3]))
    out[k.V : k.V + 3] += R @ dx[k.DV : k.DV + 3]
    out[k.POS : k.POS + 3] += R @ (dx[k.DP : k.DP + 3] - fix * dx[k.DV : k.DV + 3] * dx[k.DTD])
    out[k.BG : k.COV] += dx[k.DBG :]
    return out


def error(s, other, fix=False):
    """The error (N,) that leads from s to other."""
    R = rotation_from_quaternion(s[k.Q : k.Q + 4])
    faster = R.T @ (other[k.V : k.V + 3] - s[k.V : k.V + 3])
    return np.concatenate(
        [
            log_so3(R.T @ rotation_from_quaternion(other[k.Q : k.Q + 4])),
            faster,
            R.T @ (other[k.POS : k.POS + 3] - s[k.POS : k.POS + 3]) + fix * faster * (other[k.TD] - s[k.TD]),
            other[k.BG : k.COV] - s[k.BG : k.COV],
        ]
    )


def predict(s, dt, noise=(0.0, 0.0, 0.0, 0.0)):
    out = s.copy()
    k.predict(out[: k.BLOCK], *INPUT, dt, *noise[:2])
    k.spread(out[: k.BLOCK], k.MEASURED, *noise[2:])
    return out


def transition_by_differences(s, dt, h=1e-5):
    F = np.empty((k.N, k.N))
    for i in range(k.N):
        dx = np.zeros(k.N)
        dx[i] = h
        F[:, i] = error(predict(moved(s, -dx), dt), predict(moved(s, dx), dt)) / (2.0 * h)
    return F


def transition_of_the_kernel(s, dt):
    """F from P: with Q = 0, P = e eᵀ becomes (F e)(F e)ᵀ, and P = (e + f)(e + f)ᵀ gives the signs."""
    F = np.empty((k.N, k.N))
    probe = s.copy()
    probe[k.COV : k.COV + k.N * k.N] = np.eye(k.N).ravel()
    FFt = predict(probe, dt)[k.COV : k.COV + k.N * k.N].reshape(k.N, k.N)
    for i in range(k.N):
        probe[k.COV : k.COV + k.N * k.N] = np.outer(np.eye(k.N)[i], np.eye(k.N)[i]).ravel()
        P = predict(probe, dt)[k.COV : k.COV + k.N * k.N].reshape(k.N, k.N)
        # the column's own entry is positive: F is near the identity
        F[:, i] = P[:, i] / np.sqrt(P[i, i])
    np.testing.assert_allclose(F @ F.T, FFt, atol=1e-12)
    return F


def test_transition_equals_central_differences_to_second_order():
    s = some_state(np.random.default_rng(1))
    remainders = [
        np.abs(transition_of_the_kernel(s, dt) - transition_by_differences(s, dt)).max() for dt in (0.02, 0.01, 0.005)
    ]
    # O(dt²): a halved step quarters what is left out; and that is small where the filter works
    assert remainders[0] / remainders[1] == pytest.approx(4.0, rel=0.1)
    assert remainders[1] / remainders[2] == pytest.approx(4.0, rel=0.1)
    assert remainders[2] < 2e-4


def test_process_noise_is_that_of_integrated_white_noise():
    s = some_state(np.random.default_rng(2))
    gyro, accel, gyro_walk, accel_walk = 1e-2, 3e-2, 1e-3, 4e-3
    dt, n = 0.001, 1000
    for _ in range(n):
        s = predict(s, dt, (gyro, accel, gyro_walk, accel_walk))
    P = s[k.COV : k.COV + k.N * k.N].reshape(k.N, k.N)
    # after one second: attitude σ²T + walk² T³/3; position σ²T³/3 and more by attitude
    np.testing.assert_allclose(np.diag(P)[:3], gyro**2 + gyro_walk**2 / 3.0, rtol=2e-2)
    np.testing.assert_allclose(np.diag(P)[k.DBG : k.DBG + 3], gyro_walk**2, rtol=1e-9)
    np.testing.assert_allclose(np.diag(P)[k.DBA : k.DBA + 3], accel_walk**2, rtol=1e-9)
    assert np.trace(P[k.DP : k.DP + 3, k.DP : k.DP + 3]) > accel**2  # 3 axes × 1/3


def test_the_covariance_of_several_samples_at_once_is_that_of_each_to_second_order():
    """As far as the whole step turns: half a step, a quarter of what is left out."""
    rng = np.random.default_rng(4)
    s = some_state(rng)
    s[k.COV : k.COV + k.N * k.N] = some_covariance(rng).ravel()
    inputs = INPUT * rng.uniform(0.5, 1.5, (4, 6))
    left_out = []
    for dt in (0.005, 0.0025):
        each, once = s.copy(), s.copy()
        for u in inputs:
            for out in (each, once):
                k.predict(out[: k.BLOCK], *u, dt, 1e-2, 3e-2)
            k.spread(each[: k.BLOCK], k.MEASURED, 1e-3, 4e-3)
        k.spread(once[: k.BLOCK], k.MEASURED, 1e-3, 4e-3)
        np.testing.assert_array_equal(once[: k.COV], each[: k.COV])
        assert once[k.LAG] == once[k.ANGLE_VARIANCE] == once[k.VELOCITY_VARIANCE] == 0.0
        P, Q = (state[k.COV : k.COV + k.N * k.N] for state in (once, each))
        left_out.append(np.abs(P - Q).max() / np.abs(Q).max())
    assert left_out[0] / left_out[1] == pytest.approx(4.0, rel=0.2)
    assert left_out[0] < 2e-3


def fix_model(s, z):
    """H, y of a fix through the kernel that weighs it."""
    row = np.zeros(k.FIX)
    row[k.F_COUNT] = 1.0
    row[k.F_HYPOTHESES : k.F_HYPOTHESES + 7] = z
    row[k.F_HYPOTHESES + k.H_COV : k.F_HYPOTHESES + k.H_COV + 36] = np.eye(6).ravel()
    H, y, R, S = np.zeros((6, k.N)), np.zeros(6), np.zeros((6, 6)), np.zeros((6, 6))
    k._weigh(s, 0, parameter_vector(FilterParams(), "free"), row, H, y, R, S)
    P = s[k.COV : k.COV + k.N * k.N].reshape(k.N, k.N)
    np.testing.assert_allclose(S, H @ P @ H.T + R, rtol=1e-12, atol=1e-12)
    return H, y


def test_fix_jacobian_equals_central_differences():
    rng = np.random.default_rng(3)
    s = some_state(rng)
    s[k.U : k.U + 6] = INPUT
    s[k.COV : k.COV + k.N * k.N] = some_covariance(rng).ravel()
    z = np.concatenate([s[k.POS : k.POS + 3], s[k.Q : k.Q + 4]])  # the innovation is zero here
    H, y = fix_model(s, z)
    np.testing.assert_allclose(y, 0.0, atol=1e-12)
    h = 1e-6
    for i in range(k.DTD):
        dx = np.zeros(k.N)
        dx[i] = h
        # y = z - h(x), so that H is minus its slope
        slope = (fix_model(moved(s, dx), z)[1] - fix_model(moved(s, -dx), z)[1]) / (2.0 * h)
        np.testing.assert_allclose(H[:, i], -slope, atol=1e-7)
    # the time offset acts through the motion: where the body is h later
    later, sooner = s.copy(), s.copy()
    R = rotation_from_quaternion(s[k.Q : k.Q + 4])
    rate = INPUT[:3] - s[k.BG : k.BG + 3]
    for state, dt in ((later, h), (sooner, -h)):
        state[k.POS : k.POS + 3] += s[k.V : k.V + 3] * dt
        state[k.Q : k.Q + 4] = quaternion_from_rotation(R @ exp_so3(rate * dt))
    slope = (fix_model(later, z)[1] - fix_model(sooner, z)[1]) / (2.0 * h)
    np.testing.assert_allclose(H[:, k.DTD], -slope, atol=1e-7)


@pytest.mark.parametrize("still", [False, True])
@pytest.mark.parametrize("motion", ["free", "ground", "differential"])
def test_constraint_jacobian_equals_central_differences(motion, still):
    """All constraints at once, against an update with what differences make of their definition."""
    rng = np.random.default_rng(4)
    s = some_state(rng)
    s[k.V : k.V + 3] *= 0.01
    prm = parameter_vector(FilterParams(), motion)
    s[k.USUAL_SPEED2] = 0.5
    s[k.STILL_SINCE] = s[k.T] - 10.0 if still else np.inf
    s[k.STILL_SURE] = 1.0
    s[k.STILL_MEAN : k.STILL_MEAN + 3] = [0.01, 0.02, -0.03]

    def prediction(state):
        R = rotation_from_quaternion(state[k.Q : k.Q + 4])
        values = list(R.T @ state[k.V : k.V + 3])
        if still:
            values += list(state[k.BG : k.BG + 3])
        if motion != "free":
            values += [state[k.V + 2], *R.T[:2, 2]]
        return np.array(values)

    h = 1e-6
    m = len(prediction(s))
    H = np.empty((m, k.N))
    for i in range(k.N):
        dx = np.zeros(k.N)
        dx[i] = h
        H[:, i] = (prediction(moved(s, dx)) - prediction(moved(s, -dx))) / (2.0 * h)
    y = -prediction(s)
    variances = [k.STILL_SPEED_SIGMA**2 if still else 0.5 * 2.0 * k.SPEED_TIME * k.GRID_HZ] * 3
    if motion == "differential" and not still:
        variances[1] = max(prm[k.WHEEL_VELOCITY_SIGMA] ** 2, y[1] ** 2)
    if still:
        y[3:6] += s[k.STILL_MEAN : k.STILL_MEAN + 3]
        variances += [(2.0 * prm[k.GYRO_NOISE]) ** 2 * k.GRID_HZ] * 3
    if motion != "free":
        sigmas = [prm[k.GROUND_VELOCITY_SIGMA], *[prm[k.GROUND_TILT_SIGMA]] * 2]
        variances += [max(sigma**2, value**2) for sigma, value in zip(sigmas, y[-3:], strict=True)]
    P = some_covariance(rng)
    s[k.COV : k.COV + k.N * k.N] = P.ravel()
    P[k.DTD, k.DTD] += k.TIME_OFFSET_WALK**2 / k.GRID_HZ
    S = H @ P @ H.T + np.diag(variances)
    expected = moved(s, P @ H.T @ np.linalg.solve(S, y))
    k._constrain(s, prm)
    np.testing.assert_allclose(s[: k.COV], expected[: k.COV], atol=1e-8)


@pytest.mark.parametrize("bridging", [False, True])
@pytest.mark.parametrize("told", [(True, True), (True, False), (False, True)])
def test_odometry_jacobian_equals_central_differences(told, bridging):
    """Speed and yaw rate, against an update with what differences make of their definition."""
    rng = np.random.default_rng(7)
    s = some_state(rng)
    s[k.U : k.U + 6] = INPUT
    s[k.T], s[k.T_WHEEL], s[k.BRIDGING] = 3.0, 2.98, bridging
    prm = parameter_vector(FilterParams(), "free")

    def prediction(state):
        R = rotation_from_quaternion(state[k.Q : k.Q + 4])
        scale = 1.0 + state[k.WHEEL : k.WHEEL + 2]
        return scale * [(R.T @ state[k.V : k.V + 3])[0], INPUT[2] - state[k.BG + 2]]

    h = 1e-6
    H = np.empty((2, k.N))
    for i in range(k.N):
        dx = np.zeros(k.N)
        dx[i] = h
        H[:, i] = (prediction(moved(s, dx)) - prediction(moved(s, -dx))) / (2.0 * h)
    y = np.array([0.02, -0.03])
    reading = np.array([3.0, *np.where(told, prediction(s) + y, np.nan)])
    # 50 a second tell no more than ten
    variances = 5.0 * np.square([prm[k.WHEEL_SPEED_SIGMA], prm[k.WHEEL_RATE_SIGMA]])
    rows = [i for i in range(2) if told[i] and not (i == 1 and bridging)]
    P = some_covariance(rng)
    s[k.COV : k.COV + k.N * k.N] = P.ravel()
    H, y = H[rows], y[rows]
    S = H @ P @ H.T + np.diag(variances[rows])
    expected = moved(s, P @ H.T @ np.linalg.solve(S, y))
    k._odometry(s, prm, reading)
    np.testing.assert_allclose(s[: k.COV], expected[: k.COV], atol=1e-8)
    assert s[k.T_WHEEL] == 3.0
    assert s[k.WHEEL_RATE] == pytest.approx(reading[2] / 0.95 if told[1] else 0.0)


def test_wheels_that_slip_are_not_believed():
    """By the yaw rate, which the gyroscope knows better; a speed that is off alone counts for less."""
    s = some_state(np.random.default_rng(8))
    s[k.U : k.U + 6] = INPUT
    s[k.COV : k.COV + k.N * k.N] = (1e-4 * np.eye(k.N)).ravel()
    speed = (rotation_from_quaternion(s[k.Q : k.Q + 4]).T @ s[k.V : k.V + 3])[0]
    reading = np.array([0.1, 1.03 * speed, 0.95 * (INPUT[2] - s[k.BG + 2])])
    for off, believed in (([0.0, 0.0, 0.05], True), ([0.0, 0.3, 0.3], False), ([0.0, 0.3, 0.0], True)):
        s[k.T] += 0.1
        before = s.copy()
        k._odometry(s, parameter_vector(FilterParams(), "free"), reading + off)
        assert np.array_equal(s[: k.COV], before[: k.COV]) != believed


def test_a_reading_that_is_far_off_is_loosened_until_it_is_one_sigma():
    s = some_state(np.random.default_rng(8))
    s[k.T], s[k.T_WHEEL] = 3.0, 2.9
    s[k.COV : k.COV + k.N * k.N] = (1e-4 * np.eye(k.N)).ravel()
    speed = (rotation_from_quaternion(s[k.Q : k.Q + 4]).T @ s[k.V : k.V + 3])[0]
    before = s.copy()
    k._odometry(s, parameter_vector(FilterParams(), "free"), np.array([3.0, 1.03 * speed + 5.0, np.nan]))
    gained = np.linalg.norm(s[k.V : k.V + 3] - before[k.V : k.V + 3])
    assert gained == pytest.approx(5.0 * 1.03 * 1e-4 / 25.0, rel=1e-3)


def slowed(s, dt, noise, steps=1):
    """Bridged as the timeline does it: straight on, then what has been left out."""
    out = s.copy()
    for _ in range(steps):
        R = rotation_from_quaternion(out[k.Q : k.Q + 4])
        up = np.array([*out[k.TILT : k.TILT + 2], np.sqrt(1.0 - np.sum(out[k.TILT : k.TILT + 2] ** 2))])
        gyro, accel = out[k.BG : k.BG + 3], out[k.BA : k.BA + 3] + GRAVITY * R.T @ up
        k.predict(out[: k.BLOCK], *gyro, *accel, dt / steps, 0.0, 0.0)
        k.spread(out[: k.BLOCK], k.BRIDGED, 0.0, 0.0)
        k._slow(out[: k.BLOCK], dt / steps, noise)
    return out


def test_a_speed_decays_the_same_in_one_step_or_many():
    s = some_state(np.random.default_rng(9))
    s[k.COV : k.COV + k.N * k.N] = some_covariance(np.random.default_rng(10)).ravel()
    once, often = slowed(s, 1.7, 0.8), slowed(s, 1.7, 0.8, 500)
    np.testing.assert_allclose(once[: k.COV], often[: k.COV], atol=1e-10)
    P, Q = (state[k.COV : k.COV + k.N * k.N] for state in (once, often))
    np.testing.assert_allclose(P, Q, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(once[k.V : k.V + 3], s[k.V : k.V + 3] * np.exp(-1.7 / k.COAST_TIME), rtol=1e-12)


def test_a_bridged_speed_scatters_as_the_process_simulated_step_by_step():
    """v' = -v/τ + w by brute force, 20 000 robots in steps of 1 ms."""
    noise, dt, steps = 0.8, 0.001, 1500
    rng = np.random.default_rng(11)
    position, velocity = np.zeros(20_000), np.full(20_000, 0.9)
    for _ in range(steps):
        position += 0.5 * dt * velocity
        velocity += -velocity / k.COAST_TIME * dt + rng.normal(0.0, noise * np.sqrt(dt), len(velocity))
        position += 0.5 * dt * velocity
    s = np.zeros(k.STATE)
    s[k.Q], s[k.V] = 1.0, 0.9
    s = slowed(s, steps * dt, noise)
    P = s[k.COV : k.COV + k.N * k.N].reshape(k.N, k.N)
    simulated = np.cov(velocity, position)
    # a variance of 20 000 is known to 1 % (1 sigma)
    np.testing.assert_allclose(P[np.ix_([k.DV, k.DP], [k.DV, k.DP])], simulated, rtol=0.04)
    assert s[k.POS] == pytest.approx(position.mean(), abs=0.02)
    assert s[k.V] == pytest.approx(velocity.mean(), abs=0.02)


@pytest.mark.parametrize("fix", [False, True])
def test_update_is_the_textbook_one_and_keeps_a_covariance(fix):
    rng = np.random.default_rng(5)
    s = some_state(rng)
    P = some_covariance(rng)
    s[k.COV : k.COV + k.N * k.N] = P.ravel()
    H, y = rng.normal(0.0, 1.0, (4, k.N)), rng.normal(0.0, 0.05, 4)
    H[:, k.DTD] *= fix
    R = np.diag([0.1, 0.2, 0.3, 0.4])
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
    dx = K @ y
    before = s.copy()
    assert k.update(s[: k.BLOCK], H, y, R)
    np.testing.assert_allclose(error(before, s, fix), dx, atol=1e-12)
    # the error about the new state, by differences of its definition
    J = np.empty((k.N, k.N))
    h = 1e-6
    for i in range(k.N):
        e = np.zeros(k.N)
        e[i] = h
        J[:, i] = (error(s, moved(before, dx + e, fix)) - error(s, moved(before, dx - e, fix))) / (2.0 * h)
    after = s[k.COV : k.COV + k.N * k.N].reshape(k.N, k.N)
    np.testing.assert_allclose(after, J @ (P - K @ H @ P) @ J.T, atol=1e-8)
    np.testing.assert_array_equal(after, after.T)
    assert np.linalg.eigvalsh(after)[0] > 0.0


def test_update_refuses_what_is_no_covariance():
    s = some_state(np.random.default_rng(6))
    before = s.copy()
    assert not k.update(s[: k.BLOCK], np.eye(6, k.N), np.ones(6), -np.eye(6))
    np.testing.assert_array_equal(s, before)
