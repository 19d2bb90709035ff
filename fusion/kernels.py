"""All compiled code of the filter: one error-state EKF in 3-D, and the timeline that puts late measurements in place.

It is one file because numba's cache does not notice an edited callee in another one.

The model
---------
Nominal state x: attitude q (world_from_body), velocity v and position p (world), gyroscope and accelerometer bias
(body), camera time offset t_d, tilt c of the vertical in the world frame. The IMU is an input. The error is
left-invariant, in body axes, 18 numbers:

    R = R̂ Exp(δθ)   v = v̂ + R̂ δv   p = p̂ + R̂ δp   and plain differences for the rest,

for which a pose fix has an H that does not depend on the state (A. Barrau, S. Bonnabel, "The invariant extended
Kalman filter as a stable observer", IEEE TAC 62(4), 2017). A planar robot is the same filter with pseudo-measurements.

The timeline
------------
The state is a function of the *set* of stamped inputs, not of their order of arrival. IMU samples and fixes lie in
rings sorted by stamp; checkpoints of the whole state lie beside them. A late input goes to its place, the newest
checkpoint before it is loaded, and everything after is done again. All that adapts is therefore part of the state.

One flat float64 array, `memory`, holds all of one robot, since each array argument costs about 0.1 us of dispatch.
"""

# numba reads these functions: plain loops and scalars are what it compiles best.
# mypy cannot look through its decorator.
from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from fusion.measurements import Array

GRAVITY = 9.80665

# --- One filter: nominal state, then the covariance of its error, row by row -------------------------------------
Q, V, POS, BG, BA, TD, TILT = 0, 4, 7, 10, 13, 16, 17
COV = 20
N = 18
TH, DV, DP, DBG, DBA, DTD, DTILT = 0, 3, 6, 9, 12, 15, 16
BLOCK = COV + N * N

# --- The whole state of a robot: the filter, a second one that grows from rejected fixes, and bookkeeping ---------
MAIN, SHADOW, AUX = 0, BLOCK, 2 * BLOCK
T = AUX  # s: the instant of the state
T_IMU = AUX + 1  # s: stamp of the last IMU sample in it
U = AUX + 2  # the input at T: gyro, accel (6)
IMU_CURSOR = AUX + 8  # number of the next IMU sample to come
FIX_CURSOR = AUX + 9  # number of the next fix to come
TD_APPLIED = AUX + 10  # s: the time offset as the last fix left it
INITIALISED = AUX + 11
RESET_ID = AUX + 12
T_ACCEPTED = AUX + 13  # s: capture time of the last accepted fix
ACCEPTED_COUNT = AUX + 14  # fixes accepted since the last (re)start
TRAILING = AUX + 15  # 1 when T is a fix beyond the last IMU sample
SHADOW_COUNT = AUX + 16  # fixes that the shadow agrees with; 0: there is none
SHADOW_SINCE = AUX + 17  # s: the first of them
ACCEL_MEAN = AUX + 18  # running mean of the specific force before the start (3)
ACCEL_COUNT = AUX + 21
STATE = AUX + 22

# --- Parameters, as numbers --------------------------------------------------------------------------------------
(
    GYRO_NOISE,
    ACCEL_NOISE,
    GYRO_BIAS_WALK,
    ACCEL_BIAS_WALK,
    GYRO_BIAS_SIGMA,
    ACCEL_BIAS_SIGMA,
    VELOCITY_SIGMA,
    TIME_OFFSET_SIGMA,
    TILT_SIGMA,
    STAMP_JITTER,
    GATE,
    GATE_BLOCK,
    GATE_INFLATION,
    HYPOTHESIS_MARGIN,
    BUFFER,
    IMU_GAP,
    NO_IMU_ACCEL_NOISE,
    NO_IMU_RATE_NOISE,
    REINIT_GATE,
    REINIT_COUNT,
    REINIT_PATIENCE,
    GROUND_VELOCITY_SIGMA,
    GROUND_TILT_SIGMA,
    WHEEL_VELOCITY_SIGMA,
    MOTION,
) = range(25)
PARAMS = 25
FREE, GROUND, DIFFERENTIAL = 0.0, 1.0, 2.0

# --- A fix: stamp, arrival, number of hypotheses, then per hypothesis position, quaternion, covariance, misfit -----
F_T, F_ARRIVAL, F_COUNT, F_HYPOTHESES = 0, 1, 2, 3
H_POS, H_QUAT, H_COV, H_MISFIT, HYPOTHESIS = 0, 3, 7, 43, 44
F_OUTCOME = F_HYPOTHESES + 2 * HYPOTHESIS
F_D2, F_D2_POSITION, F_D2_ATTITUDE, F_CHOSEN, F_MARGIN = (F_OUTCOME + i for i in range(1, 6))
F_INNOVATION = F_OUTCOME + 6
F_SIGMA = F_OUTCOME + 12
F_REPORTED = F_OUTCOME + 18
FIX = F_OUTCOME + 19
PENDING, INIT, ACCEPTED, INFLATED, REJECTED, REINIT, TOO_LATE, DUPLICATE = range(8)

# --- Counters ----------------------------------------------------------------------------------------------------
# Samples, fixes and checkpoints are numbered from the first ever; number k lies in row k % capacity of its ring.
IMU_FIRST, IMU_END, FIX_FIRST, FIX_END, CP_FIRST, CP_END = range(6)
HORIZON = 6  # s: newest stamp of any input
IMU_DUPLICATES, IMU_LATE, REWINDS = 7, 8, 9
META = 10

IMU_CAPACITY = 4096  # two seconds at 2 kHz
FIX_CAPACITY = 256  # two seconds of four cameras at 30 Hz
CP_CAPACITY = 64
CP_PER_BUFFER = 50  # a checkpoint each fiftieth of the buffer: 40 ms by default
MEMORY = META + PARAMS + STATE + IMU_CAPACITY * 7 + FIX_CAPACITY * FIX + CP_CAPACITY * STATE

# --- A pose as it leaves: t, position, quaternion, velocity, rate, covariance, velocity covariance, bookkeeping ----
P_T, P_POS, P_QUAT, P_VEL, P_RATE, P_COV, P_VCOV = 0, 1, 4, 8, 11, 14, 50
P_T_ACCEPTED, P_RESET_ID, P_T_IMU = 59, 60, 61
POSE = 62

GRID_HZ = 10.0  # pseudo-measurements come on a fixed grid of time, so that late fixes do not move them
GRAVITY_SIGMA = 0.5  # m/s2: how far the mean specific force before the start may be from gravity, by motion
UNKNOWN_TILT_SIGMA = math.radians(30.0)  # of a flat marker whose two poses are too close to call

_jit: Any = njit(cache=True, error_model="numpy", nogil=True)


# ------------------------------------------------------------------------------------------------------ rotations


@_jit
def _quaternion_to_matrix(x, R):
    w, a, b, c = x[0], x[1], x[2], x[3]
    R[0, 0] = 1.0 - 2.0 * (b * b + c * c)
    R[0, 1] = 2.0 * (a * b - w * c)
    R[0, 2] = 2.0 * (a * c + w * b)
    R[1, 0] = 2.0 * (a * b + w * c)
    R[1, 1] = 1.0 - 2.0 * (a * a + c * c)
    R[1, 2] = 2.0 * (b * c - w * a)
    R[2, 0] = 2.0 * (a * c - w * b)
    R[2, 1] = 2.0 * (b * c + w * a)
    R[2, 2] = 1.0 - 2.0 * (a * a + b * b)


@_jit
def _rotation_vector(q, r, y, o):
    """y[o:o+3] = Log(q^-1 r): the rotation vector from q to r, of length <= pi."""
    w = q[0] * r[0] + q[1] * r[1] + q[2] * r[2] + q[3] * r[3]
    a = q[0] * r[1] - q[1] * r[0] - q[2] * r[3] + q[3] * r[2]
    b = q[0] * r[2] + q[1] * r[3] - q[2] * r[0] - q[3] * r[1]
    c = q[0] * r[3] - q[1] * r[2] + q[2] * r[1] - q[3] * r[0]
    if w < 0.0:
        w, a, b, c = -w, -a, -b, -c
    n = math.sqrt(a * a + b * b + c * c)
    factor = 2.0 / w if n < 1e-9 else 2.0 * math.atan2(n, w) / n
    y[o] = factor * a
    y[o + 1] = factor * b
    y[o + 2] = factor * c


# ---------------------------------------------------------------------------------------------------------- filter


@_jit
def predict(f, gx, gy, gz, ax, ay, az, dt, gyro_noise, accel_noise, gyro_bias_walk, accel_bias_walk):
    """Carry filter block `f` over `dt` s of constant angular rate and specific force (raw, the biases are taken off).

    With Δv, Δp the increments of velocity and position by specific force in the body axes at the *start*, A = Exp(-ω dt)
    and C = -g dt R̂ᵀ[e_x e_y], the error goes, up to O(dt²),

        δθ' = A (δθ - dt δbg)
        δv' = A (δv - Δv × δθ - dt δba + C δc)
        δp' = A (δp + dt δv - Δp × δθ - dt²/2 δba + dt/2 C δc)

    which is exact for the coupling by attitude, since the start axes do not turn. White noise is isotropic, so that
    A drops out of Q.
    """
    wx, wy, wz = gx - f[BG], gy - f[BG + 1], gz - f[BG + 2]
    fx, fy, fz = ax - f[BA], ay - f[BA + 1], az - f[BA + 2]
    qw, qx, qy, qz = f[0], f[1], f[2], f[3]
    # quaternion of half the rotation: cos and sin of a quarter of the angle
    h = 0.5 * dt
    quarter = 0.5 * h * math.sqrt(wx * wx + wy * wy + wz * wz)
    if quarter < 1e-4:
        hw, s = 1.0 - 0.5 * quarter * quarter, 0.5 * h * (1.0 - quarter * quarter / 6.0)
    else:
        hw, s = math.cos(quarter), math.sin(quarter) / quarter * 0.5 * h
    hx, hy, hz = s * wx, s * wy, s * wz
    # Δv: the specific force of the midpoint, in start axes
    tx, ty, tz = 2.0 * (hy * fz - hz * fy), 2.0 * (hz * fx - hx * fz), 2.0 * (hx * fy - hy * fx)
    d0 = (fx + hw * tx + hy * tz - hz * ty) * dt
    d1 = (fy + hw * ty + hz * tx - hx * tz) * dt
    d2 = (fz + hw * tz + hx * ty - hy * tx) * dt

    r00, r01, r02 = 1.0 - 2.0 * (qy * qy + qz * qz), 2.0 * (qx * qy - qw * qz), 2.0 * (qx * qz + qw * qy)
    r10, r11, r12 = 2.0 * (qx * qy + qw * qz), 1.0 - 2.0 * (qx * qx + qz * qz), 2.0 * (qy * qz - qw * qx)
    r20, r21, r22 = 2.0 * (qx * qz - qw * qy), 2.0 * (qy * qz + qw * qx), 1.0 - 2.0 * (qx * qx + qy * qy)
    c0, c1 = f[TILT], f[TILT + 1]
    g = -GRAVITY * dt
    k0 = r00 * d0 + r01 * d1 + r02 * d2 + g * c0
    k1 = r10 * d0 + r11 * d1 + r12 * d2 + g * c1
    k2 = r20 * d0 + r21 * d1 + r22 * d2 + g * math.sqrt(1.0 - c0 * c0 - c1 * c1)
    f[POS] += (f[V] + 0.5 * k0) * dt
    f[POS + 1] += (f[V + 1] + 0.5 * k1) * dt
    f[POS + 2] += (f[V + 2] + 0.5 * k2) * dt
    f[V] += k0
    f[V + 1] += k1
    f[V + 2] += k2

    ew, ex, ey, ez = hw * hw - hx * hx - hy * hy - hz * hz, 2.0 * hw * hx, 2.0 * hw * hy, 2.0 * hw * hz
    nw = qw * ew - qx * ex - qy * ey - qz * ez
    nx = qw * ex + qx * ew + qy * ez - qz * ey
    ny = qw * ey - qx * ez + qy * ew + qz * ex
    nz = qw * ez + qx * ey - qy * ex + qz * ew
    scale = 1.0 / math.sqrt(nw * nw + nx * nx + ny * ny + nz * nz)
    f[0], f[1], f[2], f[3] = nw * scale, nx * scale, ny * scale, nz * scale

    a00, a10, a20 = 1.0 - 2.0 * (ey * ey + ez * ez), 2.0 * (ex * ey - ew * ez), 2.0 * (ex * ez + ew * ey)
    a01, a11, a21 = 2.0 * (ex * ey + ew * ez), 1.0 - 2.0 * (ex * ex + ez * ez), 2.0 * (ey * ez - ew * ex)
    a02, a12, a22 = 2.0 * (ex * ez - ew * ey), 2.0 * (ey * ez + ew * ex), 1.0 - 2.0 * (ex * ex + ey * ey)
    c00, c01, c10, c11, c20, c21 = g * r00, g * r10, g * r01, g * r11, g * r02, g * r12
    P = f[COV:]
    # F P Fᵀ as F (F P)ᵀ: the same loop twice, over columns that lie side by side in memory. The second round is needed
    # for the first nine columns only, since F leaves the rest alone.
    for second in range(2):
        for j in range(N - 9 * second):
            t0, t1, t2 = P[j], P[18 + j], P[36 + j]
            v0, v1, v2 = P[54 + j], P[72 + j], P[90 + j]
            p0, p1, p2 = P[108 + j], P[126 + j], P[144 + j]
            e0, e1 = P[288 + j], P[306 + j]
            u0 = d2 * t1 - d1 * t2 - dt * P[216 + j] + c00 * e0 + c01 * e1
            u1 = d0 * t2 - d2 * t0 - dt * P[234 + j] + c10 * e0 + c11 * e1
            u2 = d1 * t0 - d0 * t1 - dt * P[252 + j] + c20 * e0 + c21 * e1
            p0 += dt * v0 + h * u0
            p1 += dt * v1 + h * u1
            p2 += dt * v2 + h * u2
            v0 += u0
            v1 += u1
            v2 += u2
            t0 -= dt * P[162 + j]
            t1 -= dt * P[180 + j]
            t2 -= dt * P[198 + j]
            P[j] = a00 * t0 + a01 * t1 + a02 * t2
            P[18 + j] = a10 * t0 + a11 * t1 + a12 * t2
            P[36 + j] = a20 * t0 + a21 * t1 + a22 * t2
            P[54 + j] = a00 * v0 + a01 * v1 + a02 * v2
            P[72 + j] = a10 * v0 + a11 * v1 + a12 * v2
            P[90 + j] = a20 * v0 + a21 * v1 + a22 * v2
            P[108 + j] = a00 * p0 + a01 * p1 + a02 * p2
            P[126 + j] = a10 * p0 + a11 * p1 + a12 * p2
            P[144 + j] = a20 * p0 + a21 * p1 + a22 * p2
        if second == 0:
            for i in range(9):
                for j in range(i):
                    swap = P[18 * i + j]
                    P[18 * i + j] = P[18 * j + i]
                    P[18 * j + i] = swap
                for j in range(9, N):
                    P[18 * j + i] = P[18 * i + j]

    angle_noise = gyro_noise * gyro_noise * dt
    velocity_noise = accel_noise * accel_noise * dt
    for i in range(3):
        P[19 * (TH + i)] += angle_noise
        P[19 * (DV + i)] += velocity_noise
        P[19 * (DP + i)] += velocity_noise * dt * dt / 3.0
        P[18 * (DV + i) + DP + i] += velocity_noise * h
        P[18 * (DP + i) + DV + i] += velocity_noise * h
        P[19 * (DBG + i)] += gyro_bias_walk * gyro_bias_walk * dt
        P[19 * (DBA + i)] += accel_bias_walk * accel_bias_walk * dt


@_jit
def _turn_rows_and_columns(P, M, r):
    """P <- J P Jᵀ where J is the identity but for the 3 x 3 block M at r."""
    for j in range(N):
        a, b, c = P[r, j], P[r + 1, j], P[r + 2, j]
        for i in range(3):
            P[r + i, j] = M[i, 0] * a + M[i, 1] * b + M[i, 2] * c
    for j in range(N):
        a, b, c = P[j, r], P[j, r + 1], P[j, r + 2]
        for i in range(3):
            P[j, r + i] = M[i, 0] * a + M[i, 1] * b + M[i, 2] * c


@_jit
def retract(f, dx):
    """Move filter block `f` by the error `dx` (18,) and express P in the error about the new state.

    With R̂⁺ = R̂ Exp(δθ̂): the new error is Jr(δθ̂) ε for attitude and Exp(-δθ̂) ε for velocity and position.
    """
    q = f[Q : Q + 4]
    R = np.empty((3, 3))
    _quaternion_to_matrix(q, R)
    for i in range(3):
        f[V + i] += R[i, 0] * dx[DV] + R[i, 1] * dx[DV + 1] + R[i, 2] * dx[DV + 2]
        f[POS + i] += R[i, 0] * dx[DP] + R[i, 1] * dx[DP + 1] + R[i, 2] * dx[DP + 2]
        f[BG + i] += dx[DBG + i]
        f[BA + i] += dx[DBA + i]
    f[TD] += dx[DTD]
    f[TILT] += dx[DTILT]
    f[TILT + 1] += dx[DTILT + 1]

    x, y, z = dx[0], dx[1], dx[2]
    angle2 = x * x + y * y + z * z
    angle = math.sqrt(angle2)
    if angle < 1e-4:
        sinc, half_cosc, sincc = 1.0 - angle2 / 6.0, 0.5 - angle2 / 24.0, 1.0 / 6.0 - angle2 / 120.0
    else:
        sinc = math.sin(angle) / angle
        half_cosc = (1.0 - math.cos(angle)) / angle2
        sincc = (1.0 - sinc) / angle2
    w, s = math.cos(0.5 * angle), (0.5 if angle < 1e-6 else math.sin(0.5 * angle) / angle)
    bx, by, bz = s * x, s * y, s * z
    qw, qx, qy, qz = q[0], q[1], q[2], q[3]
    nw = qw * w - qx * bx - qy * by - qz * bz
    nx = qw * bx + qx * w + qy * bz - qz * by
    ny = qw * by - qx * bz + qy * w + qz * bx
    nz = qw * bz + qx * by - qy * bx + qz * w
    scale = 1.0 / math.sqrt(nw * nw + nx * nx + ny * ny + nz * nz)
    q[0], q[1], q[2], q[3] = nw * scale, nx * scale, ny * scale, nz * scale

    K = np.zeros((3, 3))
    K[0, 1], K[0, 2], K[1, 2] = -z, y, -x
    K[1, 0], K[2, 0], K[2, 1] = z, -y, x
    turn, jacobian = np.eye(3), np.eye(3)
    for i in range(3):
        for j in range(3):
            K2 = K[i, 0] * K[0, j] + K[i, 1] * K[1, j] + K[i, 2] * K[2, j]
            turn[i, j] += half_cosc * K2 - sinc * K[i, j]  # Exp(-δθ̂)
            jacobian[i, j] += sincc * K2 - half_cosc * K[i, j]  # Jr(δθ̂)
    P = f[COV:].reshape((N, N))
    _turn_rows_and_columns(P, jacobian, TH)
    _turn_rows_and_columns(P, turn, DV)
    _turn_rows_and_columns(P, turn, DP)
    # Without this the rounding of a few minutes grows into a P that is none.
    for i in range(N):
        for j in range(i):
            mean = 0.5 * (P[i, j] + P[j, i])
            P[i, j] = mean
            P[j, i] = mean


@_jit
def _cholesky(S, m):
    """Lower triangle of S becomes L with L Lᵀ = S. False where S is not positive definite."""
    for i in range(m):
        for j in range(i + 1):
            s = S[i, j]
            for k in range(j):
                s -= S[i, k] * S[j, k]
            if i == j:
                if not s > 0.0:
                    return False
                S[i, i] = math.sqrt(s)
            else:
                S[i, j] = s / S[j, j]
    return True


@_jit
def update(f, H, y, R):
    """Kalman update of filter block `f` with innovation y (m,), H (m, 18), R (m, m). False: S was not positive.

    P - K S Kᵀ with K S Kᵀ = Wᵀ W, W = L⁻¹ H P, S = L Lᵀ: symmetric as it is computed.
    """
    m = y.shape[0]
    P = f[COV:].reshape((N, N))
    W = np.zeros((m, N))
    for a in range(m):
        for k in range(N):
            h = H[a, k]
            if h != 0.0:
                for j in range(N):
                    W[a, j] += h * P[k, j]
    S = R.copy()
    for a in range(m):
        for b in range(m):
            for k in range(N):
                S[a, b] += W[a, k] * H[b, k]
    if not _cholesky(S, m):
        return False
    e = y.copy()
    for a in range(m):
        for b in range(a):
            e[a] -= S[a, b] * e[b]
            for j in range(N):
                W[a, j] -= S[a, b] * W[b, j]
        e[a] /= S[a, a]
        for j in range(N):
            W[a, j] /= S[a, a]
    dx = np.zeros(N)
    for a in range(m):
        for i in range(N):
            dx[i] += W[a, i] * e[a]
            for j in range(N):
                P[i, j] -= W[a, i] * W[a, j]
    retract(f, dx)
    return True


# ---------------------------------------------------------------------------------------------------- measurements


@_jit
def _fix_model(f, rate, hypothesis, jitter, H, y, R):
    """Innovation, H and R of a pose fix, position then attitude, all in body axes.

        y_p = R̂ᵀ(z_p - p̂) = δp + R̂ᵀv δt_d,    y_θ = Log(R̂ᵀ R_z) = δθ + ω δt_d

    R is the fix's covariance turned from world into body axes, and the stamp's jitter along the motion.
    """
    B = np.empty((3, 3))
    _quaternion_to_matrix(f, B)
    motion = np.empty(6)
    for i in range(3):
        y[i] = 0.0
        motion[i] = 0.0
        for k in range(3):
            y[i] += B[k, i] * (hypothesis[H_POS + k] - f[POS + k])
            motion[i] += B[k, i] * f[V + k]
        motion[3 + i] = rate[i] - f[BG + i]
    _rotation_vector(f, hypothesis[H_QUAT : H_QUAT + 4], y, 3)
    H[:] = 0.0
    for i in range(3):
        H[i, DP + i] = 1.0
        H[3 + i, TH + i] = 1.0
        H[i, DTD] = motion[i]
        H[3 + i, DTD] = motion[3 + i]
    half = np.empty((3, 3))
    for a in range(0, 6, 3):
        for b in range(0, 6, 3):
            for i in range(3):
                for j in range(3):
                    half[i, j] = 0.0
                    for k in range(3):
                        half[i, j] += B[k, i] * hypothesis[H_COV + 6 * (a + k) + b + j]
            for i in range(3):
                for j in range(3):
                    s = 0.0
                    for k in range(3):
                        s += half[i, k] * B[k, j]
                    R[a + i, b + j] = s + motion[a + i] * jitter * jitter * motion[b + j]


@_jit
def _innovation_covariance(f, H, R):
    """S = H P Hᵀ + R for the sparse H of a fix."""
    P = f[COV:]
    m = H.shape[0]
    S = R.copy()
    for a in range(m):
        for b in range(m):
            for i in range(N):
                if H[a, i] != 0.0:
                    for j in range(N):
                        if H[b, j] != 0.0:
                            S[a, b] += H[a, i] * P[N * i + j] * H[b, j]
    return S


@_jit
def _distance(S, y, first, m):
    """Squared Mahalanobis distance of y[first:first+m], and log|S| of that block; d2 is inf where S is no covariance."""
    L = S[first : first + m, first : first + m].copy()
    if not _cholesky(L, m):
        return math.inf, 0.0
    d2, log_det = 0.0, 0.0
    e = np.empty(m)
    for a in range(m):
        e[a] = y[first + a]
        for b in range(a):
            e[a] -= L[a, b] * e[b]
        e[a] /= L[a, a]
        d2 += e[a] * e[a]
        log_det += 2.0 * math.log(L[a, a])
    return d2, log_det


@_jit
def _forget_tilt(f, R):
    """Add to R, body axes, the variance of a tilt about world x and y that nothing is known of."""
    B = np.empty((3, 3))
    _quaternion_to_matrix(f, B)
    variance = UNKNOWN_TILT_SIGMA * UNKNOWN_TILT_SIGMA
    for i in range(3):
        for j in range(3):
            R[3 + i, 3 + j] += variance * (B[0, i] * B[0, j] + B[1, i] * B[1, j])


@_jit
def _weigh(f, rate, prm, fix, H, y, R):
    """Choose the fix's hypothesis by the filter's own covariance; fill H, y, R and the fix's figures. -> S

    The score is d² + log|S| + misfit: twice the negative log-likelihood of the pose and of the pixels.
    """
    best = math.inf
    margin = math.inf
    chosen = 0
    for k in range(int(fix[F_COUNT])):
        hypothesis = fix[F_HYPOTHESES + k * HYPOTHESIS : F_HYPOTHESES + (k + 1) * HYPOTHESIS]
        _fix_model(f, rate, hypothesis, prm[STAMP_JITTER], H, y, R)
        d2, log_det = _distance(_innovation_covariance(f, H, R), y, 0, 6)
        score = d2 + log_det + hypothesis[H_MISFIT]
        if score < best:
            margin = best - score
            best = score
            chosen = k
        else:
            margin = score - best
    hypothesis = fix[F_HYPOTHESES + chosen * HYPOTHESIS : F_HYPOTHESES + (chosen + 1) * HYPOTHESIS]
    _fix_model(f, rate, hypothesis, prm[STAMP_JITTER], H, y, R)
    if margin < prm[HYPOTHESIS_MARGIN]:
        _forget_tilt(f, R)
    S = _innovation_covariance(f, H, R)
    fix[F_D2] = _distance(S, y, 0, 6)[0]
    fix[F_D2_POSITION] = _distance(S, y, 0, 3)[0]
    fix[F_D2_ATTITUDE] = _distance(S, y, 3, 3)[0]
    fix[F_CHOSEN] = chosen
    fix[F_MARGIN] = margin
    for i in range(6):
        fix[F_INNOVATION + i] = y[i]
        fix[F_SIGMA + i] = math.sqrt(S[i, i])
    return S


@_jit
def _start(f, prm, hypothesis):
    """Set pose and covariance of filter block `f` from a fix; biases, time offset and tilt stay, and P of them."""
    P = f[COV:].reshape((N, N))
    for i in range(DBG):
        for j in range(N):
            P[i, j] = 0.0
            P[j, i] = 0.0
    for i in range(4):
        f[Q + i] = hypothesis[H_QUAT + i]
    B = np.empty((3, 3))
    _quaternion_to_matrix(f, B)
    for i in range(3):
        f[POS + i] = hypothesis[H_POS + i]
        P[DV + i, DV + i] = prm[VELOCITY_SIGMA] * prm[VELOCITY_SIGMA]
    # the fix's covariance, from world into body axes; its halves are (position, attitude), the filter's (DP, TH)
    for a in range(2):
        for b in range(2):
            for i in range(3):
                for j in range(3):
                    s = 0.0
                    for k in range(3):
                        for m in range(3):
                            s += B[k, i] * hypothesis[H_COV + 6 * (3 * a + k) + 3 * b + m] * B[m, j]
                    P[DP - 6 * a + i, DP - 6 * b + j] = s


@_jit
def _initialise(state, prm, fix):
    """Start from the first fix; gravity then corrects a tilt that a flat marker knows badly."""
    f = state[MAIN : MAIN + BLOCK]
    f[:] = 0.0
    hypothesis = fix[F_HYPOTHESES : F_HYPOTHESES + HYPOTHESIS].copy()
    if fix[F_COUNT] > 1.0 and (
        fix[F_HYPOTHESES + HYPOTHESIS + H_MISFIT] - hypothesis[H_MISFIT] < prm[HYPOTHESIS_MARGIN]
    ):
        for i in range(3, 5):
            hypothesis[H_COV + 7 * i] += UNKNOWN_TILT_SIGMA * UNKNOWN_TILT_SIGMA
    _start(f, prm, hypothesis)
    for i in range(3):
        f[COV + 19 * (DBG + i)] = prm[GYRO_BIAS_SIGMA] ** 2
        f[COV + 19 * (DBA + i)] = prm[ACCEL_BIAS_SIGMA] ** 2
    f[COV + 19 * DTD] = prm[TIME_OFFSET_SIGMA] ** 2
    f[COV + 19 * DTILT] = prm[TILT_SIGMA] ** 2
    f[COV + 19 * (DTILT + 1)] = prm[TILT_SIGMA] ** 2
    if state[ACCEL_COUNT] > 0.0:
        # mean specific force = R̂ᵀ g u + b_a, u up: H = [s]x on attitude, 1 on bias, g R̂ᵀ[e_x e_y] on tilt
        B = np.empty((3, 3))
        _quaternion_to_matrix(f, B)
        H = np.zeros((3, N))
        y = np.empty(3)
        s = GRAVITY * B[2]
        for i in range(3):
            y[i] = state[ACCEL_MEAN + i] - s[i]
            H[i, DBA + i] = 1.0
            H[i, DTILT] = GRAVITY * B[0, i]
            H[i, DTILT + 1] = GRAVITY * B[1, i]
        H[0, 1], H[0, 2], H[1, 2] = -s[2], s[1], -s[0]
        H[1, 0], H[2, 0], H[2, 1] = s[2], -s[1], s[0]
        update(f, H, y, np.eye(3) * (GRAVITY_SIGMA * GRAVITY_SIGMA))
    state[INITIALISED] = 1.0
    state[SHADOW_COUNT] = 0.0
    state[ACCEPTED_COUNT] = 1.0


@_jit
def _gate_ratio(prm, fix):
    """How far beyond the nearest of the three gates the fix lies: <= 1 is inside all."""
    return max(
        fix[F_D2] / prm[GATE],
        max(fix[F_D2_POSITION] / prm[GATE_BLOCK], fix[F_D2_ATTITUDE] / prm[GATE_BLOCK]),
    )


@_jit
def _attitudes_agree(state, prm):
    """Whether the shadow's attitude is what the gyro made of the attitude since the last accepted fix."""
    y = np.empty(3)
    _rotation_vector(state[MAIN : MAIN + 4], state[SHADOW : SHADOW + 4], y, 0)
    S = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            S[i, j] = state[MAIN + COV + N * i + j] + state[SHADOW + COV + N * i + j]
    return _distance(S, y, 0, 3)[0] <= prm[GATE_BLOCK]


@_jit
def _judge(state, prm, fix):
    """Believe a fix, or not: update the filter at T, and say in the fix's row what became of it.

    The way back: a rejected fix starts a shadow filter, which runs on the same IMU and takes the rejects that follow.
    When enough in a row agree with it, and its attitude with the gyro's, it takes over. A marker entered wrongly in
    the map gives long runs that agree with each other but not with the gyro; those must last longer than any such run.
    """
    H, y, R = np.empty((6, N)), np.empty(6), np.empty((6, 6))
    rate = state[U : U + 3]
    main = state[MAIN : MAIN + BLOCK]
    S = _weigh(main, rate, prm, fix, H, y, R)
    ratio = _gate_ratio(prm, fix)
    if ratio <= prm[GATE_INFLATION]:
        fix[F_OUTCOME] = ACCEPTED
        if ratio > 1.0:
            fix[F_OUTCOME] = INFLATED
            R += (ratio - 1.0) * S
        if update(main, H, y, R):
            state[SHADOW_COUNT] = 0.0
            state[ACCEPTED_COUNT] += 1.0
            state[T_ACCEPTED] = state[T]
            return
    fix[F_OUTCOME] = REJECTED
    shadow = state[SHADOW : SHADOW + BLOCK]
    if state[SHADOW_COUNT] > 0.0:
        figures = fix[F_D2:F_REPORTED].copy()
        _weigh(shadow, rate, prm, fix, H, y, R)
        agrees = fix[F_D2] <= prm[REINIT_GATE] and update(shadow, H, y, R)
        fix[F_D2:F_REPORTED] = figures
        if agrees:
            state[SHADOW_COUNT] += 1.0
            if state[SHADOW_COUNT] >= prm[REINIT_COUNT] and (
                state[ACCEPTED_COUNT] < prm[REINIT_COUNT]
                or state[T] - state[SHADOW_SINCE] >= prm[REINIT_PATIENCE]
                or _attitudes_agree(state, prm)
            ):
                main[:] = shadow
                state[SHADOW_COUNT] = 0.0
                state[ACCEPTED_COUNT] = prm[REINIT_COUNT]
                state[RESET_ID] += 1.0
                state[T_ACCEPTED] = state[T]
                fix[F_OUTCOME] = REINIT
            return
    hypothesis = fix[F_HYPOTHESES + int(fix[F_CHOSEN]) * HYPOTHESIS :][:HYPOTHESIS]
    shadow[:] = main
    # The robot still moves as it did, seen from itself: turn the velocity with the body.
    before, after = np.empty((3, 3)), np.empty((3, 3))
    _quaternion_to_matrix(main, before)
    _start(shadow, prm, hypothesis)
    _quaternion_to_matrix(shadow, after)
    for i in range(3):
        shadow[V + i] = 0.0
        for k in range(3):
            body = before[0, k] * main[V] + before[1, k] * main[V + 1] + before[2, k] * main[V + 2]
            shadow[V + i] += after[i, k] * body
    state[SHADOW_COUNT] = 1.0
    state[SHADOW_SINCE] = state[T]


@_jit
def _constrain(f, prm):
    """Pseudo-measurements of a robot on the floor: no vertical speed, upright; on wheels: no sideways speed either."""
    wheels = prm[MOTION] == DIFFERENTIAL
    m = 4 if wheels else 3
    H, y, R = np.zeros((m, N)), np.zeros(m), np.zeros((m, m))
    B = np.empty((3, 3))
    _quaternion_to_matrix(f, B)
    # vertical speed in the world: e_zᵀ(v̂ + R̂ δv)
    y[0] = -f[V + 2]
    R[0, 0] = prm[GROUND_VELOCITY_SIGMA] ** 2
    for i in range(3):
        H[0, DV + i] = B[2, i]
    # up in body axes, u = Rᵀe_z, is (0, 0, 1): δu = [u]x δθ
    y[1], y[2] = -B[2, 0], -B[2, 1]
    H[1, 1], H[1, 2] = -B[2, 2], B[2, 1]
    H[2, 0], H[2, 2] = B[2, 2], -B[2, 0]
    R[1, 1] = R[2, 2] = prm[GROUND_TILT_SIGMA] ** 2
    if wheels:
        # speed along body y: δv_b = δv + [v_b]x δθ
        b = np.empty(3)
        for i in range(3):
            b[i] = B[0, i] * f[V] + B[1, i] * f[V + 1] + B[2, i] * f[V + 2]
        y[3] = -b[1]
        H[3, DV + 1] = 1.0
        H[3, 0], H[3, 2] = b[2], -b[0]
        R[3, 3] = prm[WHEEL_VELOCITY_SIGMA] ** 2
    update(f, H, y, R)


# -------------------------------------------------------------------------------------------------------- timeline


@_jit
def _views(memory):
    """Meta, parameters, state, IMU ring, fix ring, checkpoint ring of one robot."""
    a = META
    b = a + PARAMS
    c = b + STATE
    d = c + IMU_CAPACITY * 7
    e = d + FIX_CAPACITY * FIX
    return (
        memory[:a],
        memory[a:b],
        memory[b:c],
        memory[c:d].reshape((IMU_CAPACITY, 7)),
        memory[d:e].reshape((FIX_CAPACITY, FIX)),
        memory[e:].reshape((CP_CAPACITY, STATE)),
    )


@_jit
def clear(memory):
    """Empty rings, a state that knows nothing, and a checkpoint of it. The parameters stay."""
    meta, _, state, _, _, checkpoints = _views(memory)
    meta[:] = 0.0
    meta[HORIZON] = -math.inf
    state[:] = 0.0
    state[T] = -math.inf
    state[T_IMU] = -math.inf
    state[T_ACCEPTED] = -math.inf
    checkpoints[0] = state
    meta[CP_END] = 1.0


@_jit
def _carry_block(f, prm, gx, gy, gz, ax, ay, az, dt, bridging):
    if not bridging:
        predict(
            f, gx, gy, gz, ax, ay, az, dt,
            prm[GYRO_NOISE], prm[ACCEL_NOISE], prm[GYRO_BIAS_WALK], prm[ACCEL_BIAS_WALK],
        )  # fmt: skip
        return
    # No IMU: straight on at constant velocity. The input that says so is the bias, and gravity seen from the body.
    up = np.empty(3)
    c0, c1 = f[TILT], f[TILT + 1]
    c2 = math.sqrt(1.0 - c0 * c0 - c1 * c1)
    B = np.empty((3, 3))
    _quaternion_to_matrix(f, B)
    for i in range(3):
        up[i] = GRAVITY * (B[0, i] * c0 + B[1, i] * c1 + B[2, i] * c2)
    predict(
        f, f[BG], f[BG + 1], f[BG + 2], f[BA] + up[0], f[BA + 1] + up[1], f[BA + 2] + up[2], dt,
        prm[NO_IMU_RATE_NOISE], prm[NO_IMU_ACCEL_NOISE], prm[GYRO_BIAS_WALK], prm[ACCEL_BIAS_WALK],
    )  # fmt: skip


@_jit
def _carry(state, prm, t, u, bridging):
    """Carry the state to instant t, where the input is u (6,): trapezoidal between the inputs at both ends."""
    dt = t - state[T]
    if state[INITIALISED] > 0.0 and dt > 0.0:
        gx, gy, gz = 0.5 * (state[U] + u[0]), 0.5 * (state[U + 1] + u[1]), 0.5 * (state[U + 2] + u[2])
        ax, ay, az = 0.5 * (state[U + 3] + u[3]), 0.5 * (state[U + 4] + u[4]), 0.5 * (state[U + 5] + u[5])
        _carry_block(state[MAIN : MAIN + BLOCK], prm, gx, gy, gz, ax, ay, az, dt, bridging)
        if state[SHADOW_COUNT] > 0.0:
            _carry_block(state[SHADOW : SHADOW + BLOCK], prm, gx, gy, gz, ax, ay, az, dt, bridging)
    if dt > 0.0:
        state[T] = t
    state[U : U + 6] = u


@_jit
def _interpolated(state, t, u, t_next, u_next):
    """u (6,) = the input at t, between that of the state and that of the next sample."""
    span = t_next - state[T]
    if not (span > 0.0 and math.isfinite(span)):
        u[:] = u_next
        return
    s = (t - state[T]) / span
    for i in range(6):
        u[i] = state[U + i] + s * (u_next[i] - state[U + i])


@_jit
def _take_fixes(state, prm, fixes, meta, t_next, u_next, bridging):
    """All fixes due up to t_next, each at its own instant."""
    cursor = int(state[FIX_CURSOR])
    end = int(meta[FIX_END])
    if cursor >= end:
        return
    u = np.empty(6)
    while cursor < end:
        fix = fixes[cursor % FIX_CAPACITY]
        t = fix[F_T] + state[TD_APPLIED]
        if t > t_next:
            break
        # An offset that has just shrunk can put a fix before the one before it, by its change: it is taken now.
        if t > state[T]:
            if bridging:
                u[:] = u_next
            else:
                _interpolated(state, t, u, t_next, u_next)
            _carry(state, prm, t, u, bridging)
        if state[INITIALISED] > 0.0:
            _judge(state, prm, fix)
        else:
            _initialise(state, prm, fix)
            state[T_ACCEPTED] = t
            fix[F_OUTCOME] = INIT
        state[TD_APPLIED] = state[MAIN + TD]
        cursor += 1
        state[FIX_CURSOR] = cursor


@_jit
def _take_sample(state, prm, fixes, meta, sample):
    """The fixes due before an IMU sample, then the sample."""
    t = sample[0]
    u = sample[1:]
    # Whether a pause is bridged depends on the stamps of the IMU alone, not on the fixes within it.
    bridging = t - state[T_IMU] > prm[IMU_GAP]
    _take_fixes(state, prm, fixes, meta, t, u, bridging)
    before = state[T_IMU]
    _carry(state, prm, t, u, bridging)
    state[T_IMU] = t
    state[TRAILING] = 0.0
    if state[INITIALISED] > 0.0:
        if prm[MOTION] != FREE and math.floor(t * GRID_HZ) != math.floor(before * GRID_HZ):
            _constrain(state[MAIN : MAIN + BLOCK], prm)
            if state[SHADOW_COUNT] > 0.0:
                _constrain(state[SHADOW : SHADOW + BLOCK], prm)
    else:
        # mean over the last half second or so
        n = min(state[ACCEL_COUNT] + 1.0, 100.0)
        state[ACCEL_COUNT] = n
        for i in range(3):
            state[ACCEL_MEAN + i] += (u[3 + i] - state[ACCEL_MEAN + i]) / n


@_jit
def _keep_checkpoint(state, prm, checkpoints, meta):
    end = int(meta[CP_END])
    if end > meta[CP_FIRST]:
        since = state[T] - checkpoints[(end - 1) % CP_CAPACITY, T]
        if since < prm[BUFFER] / CP_PER_BUFFER:
            return
    checkpoints[end % CP_CAPACITY] = state
    meta[CP_END] = end + 1
    if end + 1 - meta[CP_FIRST] > CP_CAPACITY:
        meta[CP_FIRST] += 1.0


@_jit
def _advance(state, prm, imu, fixes, checkpoints, meta):
    """Bring the state up to all inputs in the rings."""
    k = int(state[IMU_CURSOR])
    end = int(meta[IMU_END])
    while k < end:
        _take_sample(state, prm, fixes, meta, imu[k % IMU_CAPACITY])
        k += 1
        state[IMU_CURSOR] = k
        _keep_checkpoint(state, prm, checkpoints, meta)
    # Fixes beyond the last sample wait for the IMU, unless it has been silent for too long.
    if state[FIX_CURSOR] < meta[FIX_END] and meta[HORIZON] > state[T_IMU] + prm[IMU_GAP]:
        u = state[U : U + 6].copy()
        while state[FIX_CURSOR] < meta[FIX_END]:
            t = fixes[int(state[FIX_CURSOR]) % FIX_CAPACITY, F_T] + state[TD_APPLIED]
            state[TRAILING] = 1.0
            _take_fixes(state, prm, fixes, meta, t, u, True)
            _keep_checkpoint(state, prm, checkpoints, meta)


@_jit
def _load(state, checkpoints, meta, number):
    if number + 1 < meta[CP_END] or state[T] != checkpoints[number % CP_CAPACITY, T]:
        meta[REWINDS] += 1.0
    state[:] = checkpoints[number % CP_CAPACITY]
    meta[CP_END] = number + 1


@_jit
def _drop_oldest_checkpoints(checkpoints, meta):
    """Those that would need a sample or a fix that has left its ring."""
    while meta[CP_FIRST] < meta[CP_END]:
        oldest = checkpoints[int(meta[CP_FIRST]) % CP_CAPACITY]
        if oldest[IMU_CURSOR] >= meta[IMU_FIRST] and oldest[FIX_CURSOR] >= meta[FIX_FIRST]:
            break
        meta[CP_FIRST] += 1.0


@_jit
def _before_sample(state, t, gap):
    """Whether this state is as it would be if a sample stamped t were known to follow."""
    return state[T] < t and (state[TRAILING] == 0.0 or t - state[T_IMU] > gap)


@_jit
def _insert_sample(state, prm, imu, checkpoints, meta, sample):
    """Put a sample in its place in the ring, and rewind the state if it is not at the end. False: dropped."""
    t = sample[0]
    first, end = int(meta[IMU_FIRST]), int(meta[IMU_END])
    in_order = end == first or t > imu[(end - 1) % IMU_CAPACITY, 0]
    place = end
    replaces = False
    if not in_order:
        while place > first and imu[(place - 1) % IMU_CAPACITY, 0] > t:
            place -= 1
        if place > first and imu[(place - 1) % IMU_CAPACITY, 0] == t:
            # The same stamp twice: one is kept, and which one must not depend on the order of arrival.
            present = imu[(place - 1) % IMU_CAPACITY]
            for i in range(1, 7):
                if sample[i] != present[i]:
                    replaces = sample[i] < present[i]
                    break
            meta[IMU_DUPLICATES] += 1.0
            if not replaces:
                return False
    if not (in_order and _before_sample(state, t, prm[IMU_GAP])):
        number = int(meta[CP_END]) - 1
        while number >= meta[CP_FIRST] and not _before_sample(checkpoints[number % CP_CAPACITY], t, prm[IMU_GAP]):
            number -= 1
        if number < meta[CP_FIRST] or t < meta[HORIZON] - prm[BUFFER]:
            meta[IMU_LATE] += 1.0
            return False
        _load(state, checkpoints, meta, number)
    if replaces:
        imu[(place - 1) % IMU_CAPACITY] = sample
        return True
    for k in range(end, place, -1):
        imu[k % IMU_CAPACITY] = imu[(k - 1) % IMU_CAPACITY]
    imu[place % IMU_CAPACITY] = sample
    meta[IMU_END] = end + 1
    if t > meta[HORIZON]:
        meta[HORIZON] = t
    if end + 1 - first >= IMU_CAPACITY:
        meta[IMU_FIRST] = first + 1
        _drop_oldest_checkpoints(checkpoints, meta)
    return True


@_jit
def _compare_fixes(a, b):
    """-1, 0, 1: by stamp, then by content; the arrival does not count."""
    for i in range(F_OUTCOME):
        if i != F_ARRIVAL and a[i] != b[i]:
            return -1 if a[i] < b[i] else 1
    return 0


@_jit
def _write_pose(state, out):
    """A whole pose, see the P_ constants. Covariances are turned from body into world axes."""
    f = state[MAIN : MAIN + BLOCK]
    B = np.empty((3, 3))
    _quaternion_to_matrix(f, B)
    out[P_T] = state[T]
    out[P_POS : P_POS + 3] = f[POS : POS + 3]
    out[P_QUAT : P_QUAT + 4] = f[Q : Q + 4]
    out[P_VEL : P_VEL + 3] = f[V : V + 3]
    for i in range(3):
        out[P_RATE + i] = state[U + i] - f[BG + i]
    P = f[COV:].reshape((N, N))
    for a in range(3):
        row = DP if a == 0 else (TH if a == 1 else DV)
        for b in range(3):
            column = DP if b == 0 else (TH if b == 1 else DV)
            if (a == 2) != (b == 2):
                continue
            turned = np.ascontiguousarray(B) @ np.ascontiguousarray(P[row : row + 3, column : column + 3]) @ B.T
            for i in range(3):
                for j in range(3):
                    if a == 2:
                        out[P_VCOV + 3 * i + j] = turned[i, j]
                    else:
                        out[P_COV + 6 * (3 * a + i) + 3 * b + j] = turned[i, j]
    out[P_T_ACCEPTED] = state[T_ACCEPTED]
    out[P_RESET_ID] = state[RESET_ID]
    out[P_T_IMU] = state[T_IMU]


# ----------------------------------------------------------------------------------------------- called from Python


@_jit
def feed_sample(memory, t, gx, gy, gz, ax, ay, az):
    """One IMU sample. False: a duplicate, or older than the buffer."""
    meta, prm, state, imu, fixes, checkpoints = _views(memory)
    sample = np.array((t, gx, gy, gz, ax, ay, az))
    kept = _insert_sample(state, prm, imu, checkpoints, meta, sample)
    _advance(state, prm, imu, fixes, checkpoints, meta)
    return kept


@_jit
def feed_samples(memory, samples, track):
    """IMU samples (n, 7). Into `track` (n, 8), or (0, 8), goes the pose after each: t, position, quaternion wxyz;
    NaN before the start. -> number kept."""
    meta, prm, state, imu, fixes, checkpoints = _views(memory)
    kept = 0
    for i in range(samples.shape[0]):
        if _insert_sample(state, prm, imu, checkpoints, meta, samples[i]):
            kept += 1
        _advance(state, prm, imu, fixes, checkpoints, meta)
        if track.shape[0] > 0:
            track[i, 0] = samples[i, 0]
            if state[INITIALISED] > 0.0:
                track[i, 1:4] = state[POS : POS + 3]
                track[i, 4:8] = state[Q : Q + 4]
            else:
                track[i, 1:8] = math.nan
    return kept


@_jit
def feed_fix(memory, fix):
    """One fix, a row (FIX,). -> PENDING, TOO_LATE or DUPLICATE; how it was judged stands in its row of the ring."""
    meta, prm, state, imu, fixes, checkpoints = _views(memory)
    first, end = int(meta[FIX_FIRST]), int(meta[FIX_END])
    place = end
    while place > first:
        order = _compare_fixes(fixes[(place - 1) % FIX_CAPACITY], fix)
        if order == 0:
            return DUPLICATE
        if order < 0:
            break
        place -= 1
    t = fix[F_T]
    # In place already when all before it is taken, and nothing after.
    if not (state[FIX_CURSOR] <= place and state[T] < t + state[TD_APPLIED]):
        number = int(meta[CP_END]) - 1
        while number >= meta[CP_FIRST]:
            checkpoint = checkpoints[number % CP_CAPACITY]
            if checkpoint[FIX_CURSOR] <= place and checkpoint[T] < t + checkpoint[TD_APPLIED]:
                break
            number -= 1
        if number < meta[CP_FIRST] or t < meta[HORIZON] - prm[BUFFER]:
            return TOO_LATE
        _load(state, checkpoints, meta, number)
    for k in range(end, place, -1):
        fixes[k % FIX_CAPACITY] = fixes[(k - 1) % FIX_CAPACITY]
    fixes[place % FIX_CAPACITY] = fix
    meta[FIX_END] = end + 1
    if t > meta[HORIZON]:
        meta[HORIZON] = t
    if end + 1 - first >= FIX_CAPACITY:
        meta[FIX_FIRST] = first + 1
        _drop_oldest_checkpoints(checkpoints, meta)
    _advance(state, prm, imu, fixes, checkpoints, meta)
    return PENDING


@_jit
def pose_at(memory, t, out):
    """The pose at instant t, from all inputs so far. False: before the start, or before the buffer."""
    meta, prm, state, imu, fixes, checkpoints = _views(memory)
    past = t < state[T]
    work = state.copy()
    if past:
        number = int(meta[CP_END]) - 1
        while number >= meta[CP_FIRST] and checkpoints[number % CP_CAPACITY, T] > t:
            number -= 1
        if number < meta[CP_FIRST]:
            return False
        work[:] = checkpoints[number % CP_CAPACITY]
        # The rows of the fixes would be written again, with the same figures: replaying changes nothing.
        k = int(work[IMU_CURSOR])
        while k < meta[IMU_END] and imu[k % IMU_CAPACITY, 0] <= t:
            _take_sample(work, prm, fixes, meta, imu[k % IMU_CAPACITY])
            k += 1
            work[IMU_CURSOR] = k
        u = np.empty(6)
        if k < meta[IMU_END]:
            sample = imu[k % IMU_CAPACITY]
            bridging = sample[0] - work[T_IMU] > prm[IMU_GAP]
            _interpolated(work, t, u, sample[0], sample[1:])
        else:
            bridging = True
            u[:] = work[U : U + 6]
        _take_fixes(work, prm, fixes, meta, t, u, bridging)
        if work[T] < t:
            _carry(work, prm, t, u, bridging)
    elif work[INITIALISED] > 0.0 and t > work[T]:
        # Straight on with the last input as long as it is fresh, then at constant velocity.
        u = work[U : U + 6].copy()
        fresh = min(t, work[T_IMU] + prm[IMU_GAP])
        if fresh > work[T]:
            _carry(work, prm, fresh, u, False)
        if t > work[T]:
            for i in range(3):
                work[U + i] = work[BG + i]
            u[:] = work[U : U + 6]
            _carry(work, prm, t, u, True)
    if not work[INITIALISED] > 0.0:
        return False
    _write_pose(work, out)
    return True


def views(memory: Array) -> tuple[Array, Array, Array, Array, Array, Array]:
    """Meta, parameters, state, IMU ring, fix ring and checkpoint ring of one robot's memory, as views."""
    answer: tuple[Array, Array, Array, Array, Array, Array] = _views(memory)
    return answer
