"""All compiled code of the filter: one error-state EKF in 3-D, and the timeline that puts late measurements in place.

It is one file because numba's cache does not notice an edited callee in another one.

The model
---------
Nominal state x: attitude q (world_from_body), velocity v and position p (world), gyroscope and accelerometer bias
(body), camera time offset t_d, tilt c of the vertical in the world frame, errors of scale s of wheel odometry. The IMU
is an input. The error is left-invariant, in body axes, 20 numbers:

    R = R̂ Exp(δθ)   v = v̂ + R̂ δv   p = p̂ + R̂ δp   and plain differences for the rest,

for which a pose fix has an H that does not depend on the state (A. Barrau, S. Bonnabel, "The invariant extended
Kalman filter as a stable observer", IEEE TAC 62(4), 2017). A planar robot is the same filter with pseudo-measurements.

The timeline
------------
The state is a function of the *set* of stamped inputs, not of their order of arrival. IMU samples and fixes lie in
rings sorted by stamp; checkpoints of the whole state lie beside them. A late input goes to its place, the newest
checkpoint before it is loaded, and everything after is done again. All that adapts is therefore part of the state.

One flat float64 array, `memory`, holds all of one robot, since each array argument slows the call from Python.
"""

# numba reads these functions: plain loops and scalars are what it compiles best.
# mypy cannot look through its decorator.
from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit, types
from numba.extending import intrinsic
from numba.np.numpy_support import carray

from fusion.measurements import Array
from fusion.params import GRAVITY

# --- One filter: nominal state, then the covariance of its error, row by row -------------------------------------
Q, V, POS, BG, BA, TD, TILT, WHEEL = 0, 4, 7, 10, 13, 16, 17, 19
COV = 21
N = 20
TH, DV, DP, DBG, DBA, DTD, DTILT, DWHEEL = 0, 3, 6, 9, 12, 15, 16, 18
CORRECTED = COV + N * N  # sum of all moves by updates, world axes: position (3), rotation vector (3)
# P lags behind the nominal state by so many seconds, which began at this attitude and velocity; white noise has since
# been added to attitude and velocity along each axis, rad2 and (m/s)2.
LAG = CORRECTED + 6
Q_THEN, V_THEN, ANGLE_VARIANCE, VELOCITY_VARIANCE = LAG + 1, LAG + 5, LAG + 8, LAG + 9
BLOCK = LAG + 10

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
REJECTED_SINCE = AUX + 17  # s: the first reject since the last accepted fix
ACCEL_MEAN = AUX + 18  # running mean of the specific force before the start (3)
ACCEL_COUNT = AUX + 21
NEXT_T = AUX + 22  # s: stamp of the IMU sample that the state is on its way to
NEXT_U = AUX + 23  # its input (6)
BRIDGING = AUX + 29  # 1 while there is no IMU: constant velocity
EXCESS = AUX + 30  # log of how much larger a variance is than its parameter says: accel, gyro, fix position, attitude
SCALE = AUX + 34  # that as a factor, and 1 where it is not significant: of the two densities, of the fix's variances
LAST_INNOVATION = AUX + 38  # the last fix's, each over its expected size (6)
STILL_SINCE = AUX + 44  # s: since when every window has been at rest; inf while one is not
STILL_FIXES = AUX + 45  # fixes taken since then
REST_GYRO, REST_ACCEL = AUX + 46, AUX + 47  # least variance of a window seen so far, both (unit)^2
CONSTRAINT_NIS = AUX + 48  # running mean of the squared innovation of each constraint over its expected one (4)
STILL_MEAN = AUX + 52  # rad/s: mean rate of the last window (3)
STILL_BARRED = AUX + 55  # s: not at rest until then, a fix has said otherwise
MOVING_GYRO, MOVING_ACCEL = AUX + 56, AUX + 57  # mean variance of a window in motion
STILL_SURE = AUX + 58  # 1 where rest and motion differ in that
USUAL_SPEED2 = AUX + 59  # (m/s)^2: mean squared speed along an axis while the robot moves
REJECTED_RUN = AUX + 60  # rejects since the last accepted fix
ADAPTED = AUX + 61  # fixes that the noise has learnt from, of those in quick succession a part
T_ADAPTED = AUX + 62  # s: the last of them
WHEEL_CURSOR = AUX + 63  # number of the next wheel reading to come
T_WHEEL = AUX + 64  # s: stamp of the last one
WHEEL_RATE = AUX + 65  # rad/s: its yaw rate, by its scale
WHEEL_NIS = AUX + 66  # running mean of the squared innovation of speed and of yaw rate over the expected one (2)
SAME_RUN = AUX + 68  # so many IMU samples in a row repeat the one before to the last digit
CHANGE_GYRO, CHANGE_ACCEL = AUX + 69, AUX + 70  # mean squared change from sample to sample
LARGEST_GYRO, LARGEST_ACCEL = AUX + 71, AUX + 72  # magnitude along an axis
SUSPECT = AUX + 73  # 1 where the last sample was held to be lost
BLIND = AUX + 74  # 1 while what the IMU says is not what the robot does
GRID_AT = AUX + 75  # number of the last step of the grid
PLACE = AUX + 76  # m: mean of where fixes have found it (3)
PLACE2 = AUX + 79  # m2: their mean squared distance from that along each axis (3)
PLACE_COUNT = AUX + 82
CLIPPED = AUX + 83  # so often it has repeated the largest of its readings, gyroscope and accelerometer (2)
STILL_FORCE = AUX + 85  # m/s2: mean specific force since it is at rest (3)
SYSTEMATIC = AUX + 88  # covariance of what the last fix taken had wrong in common with all others, world axes (36)
TWINS = AUX + 124  # 1 while the shadow is the other pose of the first fix
LEAD = AUX + 125  # by how much the scores of the fixes since then favour the filter over it
FORCE2 = AUX + 126  # (m/s2)^2: mean square of the specific force,
FORCE_COUNT = AUX + 127  # over so many samples
STATE = AUX + 128

# --- The smooth channel: the pose that robots steer by is the filter's, moved by E; not part of what rewinds --------
E = 0  # world axes: position (3), rotation vector (3)
E_T = 6  # s: the instant of E
E_PUBLISHED = 7  # s: the latest instant that was asked for
E_RESETS = 8  # how often the channel has stepped
E_STEP = 9  # the last step: position (3), rotation vector (3)
E_RESET_ID = 15  # the filter's, as last seen
BEFORE = 16  # what the filter said before an input: T, position (3), quaternion (4), velocity (3), rate (3),
BEFORE_CORRECTED = BEFORE + 14  # and CORRECTED (6)
CHANNEL = BEFORE_CORRECTED + 6

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
    REINIT_ANGLE,
    REINIT_COUNT,
    REINIT_PATIENCE,
    GROUND_VELOCITY_SIGMA,
    GROUND_TILT_SIGMA,
    WHEEL_VELOCITY_SIGMA,
    USUAL_SPEED,
    STILL_SPEED,
    STILL_RATE,
    FIX_CORRELATION,
    ADAPTATION,
    WHEEL_SPEED_SIGMA,
    WHEEL_RATE_SIGMA,
    WHEEL_SCALE_SIGMA,
    MOTION,
) = range(33)
PARAMS = 33
FREE, GROUND, DIFFERENTIAL = 0.0, 1.0, 2.0

# --- A fix: stamp, arrival, number of hypotheses, then per hypothesis position, quaternion, covariance, misfit and
# the part of the covariance that repeats from fix to fix
F_T, F_ARRIVAL, F_COUNT, F_HYPOTHESES = 0, 1, 2, 3
H_POS, H_QUAT, H_COV, H_MISFIT, H_SYSTEMATIC, HYPOTHESIS = 0, 3, 7, 43, 44, 80
F_OUTCOME = F_HYPOTHESES + 2 * HYPOTHESIS
F_D2, F_D2_POSITION, F_D2_ATTITUDE, F_CHOSEN, F_MARGIN = (F_OUTCOME + i for i in range(1, 6))
F_INNOVATION = F_OUTCOME + 6
F_SIGMA = F_OUTCOME + 12
F_REPORTED = F_OUTCOME + 18
FIX = F_OUTCOME + 19
PENDING, INIT, ACCEPTED, INFLATED, REJECTED, REINIT, TOO_LATE, DUPLICATE = range(8)

# --- Counters ----------------------------------------------------------------------------------------------------
# Samples, fixes and checkpoints are numbered from the first ever; number k lies in row k mod capacity of its ring.
IMU_FIRST, IMU_END, FIX_FIRST, FIX_END, CP_FIRST, CP_END = range(6)
HORIZON = 6  # s: newest stamp of any input
IMU_DUPLICATES, IMU_LATE, REWINDS = 7, 8, 9
WHEEL_FIRST, WHEEL_END, WHEEL_DUPLICATES, WHEEL_LATE = 10, 11, 12, 13
AHEAD = 14  # s: the last stamp that was too far ahead to be believed
META = 15

IMU_CAPACITY = 2048  # two seconds at 1 kHz
FIX_CAPACITY = 256  # two seconds of four cameras at 30 Hz
WHEEL_CAPACITY = 256  # two seconds at 100 Hz
CP_CAPACITY = 32
IMU_MASK, FIX_MASK, CP_MASK = IMU_CAPACITY - 1, FIX_CAPACITY - 1, CP_CAPACITY - 1  # all are powers of two
WHEEL_MASK = WHEEL_CAPACITY - 1
IMU_ROW, WHEEL_ROW = 7, 3  # t, gyro, accel; t, forward speed, yaw rate
FAR_AHEAD = 60.0  # s
CP_PER_BUFFER = 20  # a checkpoint each twentieth of the buffer, 100 ms by default: what is written stays in the cache

# --- A pose as it leaves: `fusion.measurements.Pose.numbers` and its bookkeeping ----
P_T, P_POS, P_QUAT, P_T_ACCEPTED, P_VEL, P_RATE, P_COV, P_VCOV = 0, 1, 4, 8, 9, 12, 15, 51
P_STEP = 60  # of the last reset: position (3), rotation vector (3), world
P_RESET_ID, P_T_IMU = 66, 67
POSE = 68

LONGEST_LAG = 0.018  # s: of the covariance behind the state: four samples at 200 Hz
GRID_HZ = 10.0  # pseudo-measurements come on a fixed grid of time, so that late fixes do not move them
SPEED_TIME = 2.0  # s: for so long a robot keeps its speed
LEAST_SPEED = 0.1  # m/s, along an axis: less is not learnt as usual
SMOOTH_TIME = 0.1  # s: E decays with this time constant,
SMOOTH_SPEED, SMOOTH_RATE = 0.3, math.radians(60.0)  # m/s, rad/s: but not faster than this,
SMOOTH_DISTANCE, SMOOTH_ANGLE = 0.25, math.radians(20.0)  # m, rad: and beyond this the channel steps, and says so
SMOOTH_REACH = 0.5  # s: so far ahead of the newest input a published pose is kept from moving
OUTLIER_DISTANCE = 0.15  # m: a fix that is rejected by less tells of noise, not of a mistake
MOST_TAUGHT = 6.0  # d2 / dof - 1 of one fix, at most, that the noise learns from
LEAST_EXCESS, MOST_EXCESS = -1.0, 8.0  # bounds of EXCESS: e^8 is 55 times the sigma
IGNORED_EXCESS = 0.7  # less is chance: matched noise wanders about so far
ADAPTATION_HZ = 2.0  # fixes more often than this share their say in the noise
NOTHING, A_FIX, A_READING = range(3)
BRIDGED, MEASURED = 0.0, 1.0  # numbers, since numba compiles anew for each other constant bool
STILL_WINDOW = 0.25  # s
STILL_AFTER = 0.3  # s: so long after the first window at rest the updates begin
STILL_SPEED_SIGMA = 0.002  # m/s
LEAVE_STILL = 9.35  # chi-square .975 at 3 degrees of freedom: a fix that is further off says that the robot moves
STILL_PUSH = 0.1  # m/s2: less is drift, and what a floor gives under a robot that stands
STILL_PAUSE = 2.0  # s: and for so long it is believed
LEAST_CONSTRAINT = 0.005  # of a constraint's variance is believed where it is kept ever so well
LEAST_FORCE2, MOST_FORCE2 = (0.8 * GRAVITY) ** 2, (1.2 * GRAVITY) ** 2  # no bias is so large
FORCE_SAMPLES = 1000
SLIPS = 9.0  # squared innovation of wheels over the expected one: more is no noise
STUCK_AFTER = 8  # samples that repeat each other to the last digit: nobody measures
SPIKE = 20.0  # times the usual change, and more than these: one sample alone is held to be lost
SPIKE_GYRO, SPIKE_ACCEL = 3.0, 30.0  # rad/s, m/s2
IMPOSSIBLE_GYRO, IMPOSSIBLE_ACCEL = (
    140.0,
    1000.0,
)  # rad/s, m/s2: more than a sensor of 4000 deg/s and 50 g can change by
SATURATED_GYRO, SATURATED_ACCEL = 2.0, 15.0  # rad/s, m/s2: no sensor's range is smaller
CLIPPED_OFTEN = 3  # times the very largest reading twice in a row: that is where it saturates
TIME_OFFSET_WALK = 5e-4  # s/√s: a camera that has connected anew has another
PLACE_TIME = 5.0  # s: for so long a robot keeps to a part of its usual place
PLACE_FIXES = 120  # so many fixes say what that is
LEAST_PLACE = 0.3  # m: and it is no smaller than this
BLIND_TIME = 0.3  # s^0.5: noise of a sensor that is no witness, in its largest reading
CLEAR_LEAD = 12.0  # twice the log of the odds
MOST_BRIDGED = 60.0  # s
COAST_TIME = 1.0  # s: nothing is known any more, and the speed decays with this time constant
UNKNOWN_HEADING = 1.8  # rad: as uncertain as a heading can be, pi/√3
GRAVITY_SIGMA = 0.5  # m/s2: how far the mean specific force before the start may be from gravity, by motion
UNKNOWN_TILT_SIGMA = math.radians(30.0)  # of a flat marker whose two poses are too close to call

# Both are said: what is called would inherit them from what happens to compile it first.
_jit: Any = njit(cache=True, error_model="numpy", nogil=True, fastmath=False, forceinline=False)
# Where most of the time goes: products and sums in one instruction each.
_fused: Any = njit(cache=True, error_model="numpy", nogil=True, fastmath={"contract"}, forceinline=False)
# For what every sample goes through: a call is dear, since each array is seven arguments.
_inline: Any = njit(cache=True, error_model="numpy", nogil=True, fastmath=False, forceinline=True)


_intrinsic: Any = intrinsic


@_intrinsic
def _pointer(_context: Any, _address: Any) -> Any:
    """An address as a pointer to float64."""
    result = types.CPointer(types.float64)

    def code(context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        return builder.inttoptr(arguments[0], context.get_value_type(result))

    return result(types.intp), code


# ------------------------------------------------------------------------------------------------------ rotations


@_jit
def _matrix(q, B):
    """B (3, 3) = rotation of the quaternion q[:4]."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    B[0, 0] = 1.0 - 2.0 * (y * y + z * z)
    B[0, 1] = 2.0 * (x * y - w * z)
    B[0, 2] = 2.0 * (x * z + w * y)
    B[1, 0] = 2.0 * (x * y + w * z)
    B[1, 1] = 1.0 - 2.0 * (x * x + z * z)
    B[1, 2] = 2.0 * (y * z - w * x)
    B[2, 0] = 2.0 * (x * z - w * y)
    B[2, 1] = 2.0 * (y * z + w * x)
    B[2, 2] = 1.0 - 2.0 * (x * x + y * y)


@_jit
def _rotation_vector(q, r, y):
    """y[:3] = Log(q⁻¹ r) of the quaternions q[:4] and r[:4], of length <= pi."""
    a = q[0] * r[1] - q[1] * r[0] - q[2] * r[3] + q[3] * r[2]
    b = q[0] * r[2] + q[1] * r[3] - q[2] * r[0] - q[3] * r[1]
    c = q[0] * r[3] - q[1] * r[2] + q[2] * r[1] - q[3] * r[0]
    d = q[0] * r[0] + q[1] * r[1] + q[2] * r[2] + q[3] * r[3]
    n = math.sqrt(a * a + b * b + c * c)
    sign = -1.0 if d < 0.0 else 1.0
    factor = sign * (2.0 if n < 1e-9 else 2.0 * math.atan2(n, abs(d)) / n)
    y[0], y[1], y[2] = factor * a, factor * b, factor * c


@_jit
def _length(a):
    """Of the vector a[:3]."""
    return math.sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2])


@_jit
def _fill(a, b):
    """a[:] = b, vectors; numba's own assignment costs seconds of compilation for what it says of other shapes."""
    for i in range(a.shape[0]):
        a[i] = b[i]


# ---------------------------------------------------------------------------------------------------------- filter


@_inline
def predict(f, gx, gy, gz, ax, ay, az, dt, gyro_noise, accel_noise):
    """Carry the nominal state of the filter f (BLOCK,) over `dt` s of constant angular rate and specific force, both
    raw. What that does to P waits for `spread`."""
    wx, wy, wz = gx - f[BG], gy - f[BG + 1], gz - f[BG + 2]
    fx, fy, fz = ax - f[BA], ay - f[BA + 1], az - f[BA + 2]
    qw, qx, qy, qz = f[0], f[1], f[2], f[3]
    if f[LAG] == 0.0:
        for i in range(7):
            f[Q_THEN + i] = f[i]  # attitude and velocity
    f[LAG] += dt
    f[ANGLE_VARIANCE] += gyro_noise * gyro_noise * dt
    f[VELOCITY_VARIANCE] += accel_noise * accel_noise * dt
    # quaternion of half the rotation: cos and sin of a quarter of the angle
    quarter2 = dt * dt * (wx * wx + wy * wy + wz * wz) / 16.0
    if quarter2 < 2e-3:
        # to the last digit, and several times faster
        hw = 1.0 - quarter2 / 2.0 * (1.0 - quarter2 / 12.0 * (1.0 - quarter2 / 30.0 * (1.0 - quarter2 / 56.0)))
        h2 = 0.25 * dt * (1.0 - quarter2 / 6.0 * (1.0 - quarter2 / 20.0 * (1.0 - quarter2 / 42.0)))
    else:
        quarter = math.sqrt(quarter2)
        hw, h2 = math.cos(quarter), math.sin(quarter) / quarter * 0.25 * dt
    hx, hy, hz = h2 * wx, h2 * wy, h2 * wz
    # Δv: the specific force of the midpoint, in start axes
    tx, ty, tz = 2.0 * (hy * fz - hz * fy), 2.0 * (hz * fx - hx * fz), 2.0 * (hx * fy - hy * fx)
    d0 = (fx + hw * tx + hy * tz - hz * ty) * dt
    d1 = (fy + hw * ty + hz * tx - hx * tz) * dt
    d2 = (fz + hw * tz + hx * ty - hy * tx) * dt
    # turned by q, and gravity
    tx, ty, tz = 2.0 * (qy * d2 - qz * d1), 2.0 * (qz * d0 - qx * d2), 2.0 * (qx * d1 - qy * d0)
    c0, c1 = f[TILT], f[TILT + 1]
    g = -GRAVITY * dt
    k0 = d0 + qw * tx + qy * tz - qz * ty + g * c0
    k1 = d1 + qw * ty + qz * tx - qx * tz + g * c1
    k2 = d2 + qw * tz + qx * ty - qy * tx + g * math.sqrt(1.0 - c0 * c0 - c1 * c1)
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
    f[0], f[1], f[2], f[3] = nw, nx, ny, nz  # `update` keeps it a unit quaternion


@_fused
def spread(f, measured, gyro_bias_walk, accel_bias_walk):
    """Bring P of the filter f (BLOCK,) up to the nominal state: over `LAG` seconds, several samples at once.

    With Δv, Δp what specific force has added to velocity and position, in the body axes at the *start*, A = R̂ᵀR̂_start
    and C = -g dt R̂_startᵀ∂u/∂c, u = (c, √(1 - c²)) the vertical, the error goes, up to O(dt²),

        δθ' = A (δθ - dt δbg)
        δv' = A (δv - Δv × δθ - dt δba + C δc)
        δp' = A (δp + dt δv - Δp × δθ - dt²/2 δba + dt/2 C δc)

    which is exact for the coupling by attitude, since the start axes do not turn. White noise is isotropic, so that
    A drops out of Q. What is not `measured` by an IMU does not depend on its biases, nor on where gravity seems to be.

    The filter is an array of its own here: with an offset in the index the loops over P are not vectorised.
    """
    dt = f[LAG]
    if dt == 0.0:
        return
    h = 0.5 * dt
    qw, qx, qy, qz = f[Q_THEN], f[Q_THEN + 1], f[Q_THEN + 2], f[Q_THEN + 3]
    r00, r01, r02 = 1.0 - 2.0 * (qy * qy + qz * qz), 2.0 * (qx * qy - qw * qz), 2.0 * (qx * qz + qw * qy)
    r10, r11, r12 = 2.0 * (qx * qy + qw * qz), 1.0 - 2.0 * (qx * qx + qz * qz), 2.0 * (qy * qz - qw * qx)
    r20, r21, r22 = 2.0 * (qx * qz - qw * qy), 2.0 * (qy * qz + qw * qx), 1.0 - 2.0 * (qx * qx + qy * qy)
    c0, c1 = f[TILT], f[TILT + 1]
    c2 = math.sqrt(1.0 - c0 * c0 - c1 * c1)
    g = -GRAVITY * dt
    k0, k1, k2 = f[V] - f[V_THEN] - g * c0, f[V + 1] - f[V_THEN + 1] - g * c1, f[V + 2] - f[V_THEN + 2] - g * c2
    d0, d1, d2 = r00 * k0 + r10 * k1 + r20 * k2, r01 * k0 + r11 * k1 + r21 * k2, r02 * k0 + r12 * k1 + r22 * k2
    t0, t1 = c0 / c2, c1 / c2
    c00, c10, c20 = g * (r00 - t0 * r20), g * (r01 - t0 * r21), g * (r02 - t0 * r22)
    c01, c11, c21 = g * (r10 - t1 * r20), g * (r11 - t1 * r21), g * (r12 - t1 * r22)
    # the turn since then, q_then⁻¹ q
    w, x, y, z = f[0], f[1], f[2], f[3]
    ew, ex = qw * w + qx * x + qy * y + qz * z, qw * x - qx * w - qy * z + qz * y
    ey, ez = qw * y + qx * z - qy * w - qz * x, qw * z - qx * y + qy * x - qz * w
    a00, a10, a20 = 1.0 - 2.0 * (ey * ey + ez * ez), 2.0 * (ex * ey - ew * ez), 2.0 * (ex * ez + ew * ey)
    a01, a11, a21 = 2.0 * (ex * ey + ew * ez), 1.0 - 2.0 * (ex * ex + ez * ez), 2.0 * (ey * ez - ew * ex)
    a02, a12, a22 = 2.0 * (ex * ez - ew * ey), 2.0 * (ey * ez + ew * ex), 1.0 - 2.0 * (ex * ex + ey * ey)
    b = dt
    if measured != MEASURED:
        b = d0 = d1 = d2 = c00 = c10 = c20 = c01 = c11 = c21 = 0.0
    c = COV
    # F P Fᵀ as F (F P)ᵀ: the same loop twice, over columns that lie side by side in memory. The second round is needed
    # for the first nine columns only, since F leaves the rest alone.
    for second in range(2):
        for j in range(9 if second else N):
            t0, t1, t2 = f[c + j], f[c + 20 + j], f[c + 40 + j]
            v0, v1, v2 = f[c + 60 + j], f[c + 80 + j], f[c + 100 + j]
            p0, p1, p2 = f[c + 120 + j], f[c + 140 + j], f[c + 160 + j]
            e0, e1 = f[c + 320 + j], f[c + 340 + j]
            u0 = d2 * t1 - d1 * t2 - b * f[c + 240 + j] + c00 * e0 + c01 * e1
            u1 = d0 * t2 - d2 * t0 - b * f[c + 260 + j] + c10 * e0 + c11 * e1
            u2 = d1 * t0 - d0 * t1 - b * f[c + 280 + j] + c20 * e0 + c21 * e1
            p0 += dt * v0 + h * u0
            p1 += dt * v1 + h * u1
            p2 += dt * v2 + h * u2
            v0 += u0
            v1 += u1
            v2 += u2
            t0 -= b * f[c + 180 + j]
            t1 -= b * f[c + 200 + j]
            t2 -= b * f[c + 220 + j]
            f[c + j] = a00 * t0 + a01 * t1 + a02 * t2
            f[c + 20 + j] = a10 * t0 + a11 * t1 + a12 * t2
            f[c + 40 + j] = a20 * t0 + a21 * t1 + a22 * t2
            f[c + 60 + j] = a00 * v0 + a01 * v1 + a02 * v2
            f[c + 80 + j] = a10 * v0 + a11 * v1 + a12 * v2
            f[c + 100 + j] = a20 * v0 + a21 * v1 + a22 * v2
            f[c + 120 + j] = a00 * p0 + a01 * p1 + a02 * p2
            f[c + 140 + j] = a10 * p0 + a11 * p1 + a12 * p2
            f[c + 160 + j] = a20 * p0 + a21 * p1 + a22 * p2
        if second == 0:
            for i in range(9):
                for j in range(i):
                    swap = f[c + N * i + j]
                    f[c + N * i + j] = f[c + N * j + i]
                    f[c + N * j + i] = swap
                for j in range(9, N):
                    f[c + N * j + i] = f[c + N * i + j]

    for i in range(3):
        f[c + (N + 1) * (TH + i)] += f[ANGLE_VARIANCE]
        f[c + (N + 1) * (DV + i)] += f[VELOCITY_VARIANCE]
        f[c + (N + 1) * (DP + i)] += f[VELOCITY_VARIANCE] * dt * dt / 3.0
        f[c + N * (DV + i) + DP + i] += f[VELOCITY_VARIANCE] * h
        f[c + N * (DP + i) + DV + i] += f[VELOCITY_VARIANCE] * h
        f[c + (N + 1) * (DBG + i)] += gyro_bias_walk * gyro_bias_walk * dt
        f[c + (N + 1) * (DBA + i)] += accel_bias_walk * accel_bias_walk * dt
    f[LAG] = f[ANGLE_VARIANCE] = f[VELOCITY_VARIANCE] = 0.0


@_jit
def _slow(f, dt, noise):
    """What `predict` leaves out where nothing is measured: the speed decays, and what pushes the robot is white.

    The Ornstein-Uhlenbeck process v' = -v/τ + w, w of density `noise`, over dt s, which `predict` has carried at
    constant speed: with e = exp(-dt/τ) speed is left with e v, and position moved by τ(1 - e) v. In one step or many
    it is the same. (D. Gillespie, "Exact numerical simulation of the Ornstein-Uhlenbeck process and its integral",
    Phys. Rev. E 54(2), 1996.)
    """
    e = math.exp(-dt / COAST_TIME)
    gone = COAST_TIME * (1.0 - e)
    for i in range(3):
        f[POS + i] += (gone - dt) * f[V + i]
        f[V + i] *= e
    c = COV
    for _ in range(2):
        # rows, then columns as rows of the transpose
        for i in range(3):
            for j in range(N):
                f[c + N * (DP + i) + j] += (gone - dt) * f[c + N * (DV + i) + j]
                f[c + N * (DV + i) + j] *= e
        for i in range(N):
            for j in range(i):
                swap = f[c + N * i + j]
                f[c + N * i + j] = f[c + N * j + i]
                f[c + N * j + i] = swap
    q = noise * noise
    for i in range(3):
        f[c + (N + 1) * (DV + i)] += 0.5 * q * COAST_TIME * (1.0 - e * e)
        cross = 0.5 * q * gone * gone
        f[c + N * (DV + i) + DP + i] += cross
        f[c + N * (DP + i) + DV + i] += cross
        f[c + (N + 1) * (DP + i)] += q * COAST_TIME**2 * (dt - 2.0 * gone + 0.5 * COAST_TIME * (1.0 - e * e))


@_jit
def update(f, H, y, R):
    """Kalman update of the filter f (BLOCK,) with innovation y (m,), H (m, N), R (m, m). False: S is not positive.

    y and R are used up.

    P - K S Kᵀ with K S Kᵀ = Wᵀ W, W = L⁻¹ H P, S = L Lᵀ: symmetric as it is computed. The state then moves by the
    error dx, and P is expressed in the error about the new state: with R̂⁺ = R̂ Exp(δθ̂), the new error is
    Jr(δθ̂) ε for attitude and Exp(-δθ̂) ε for velocity and position.

    What tells of t_d, a fix, corrects a speed that was wrong at the fixes before as well. It has δp + v δt_d, where the
    second one finds v to be metres per second off: for p = p̂ + R̂ (δp - δv δt_d) its H is exact, and so are both the
    move and the new error. Wheels and constraints tell of a speed that may be new: there it stays p = p̂ + R̂ δp.
    """
    m = y.shape[0]
    c = COV
    W = np.zeros((m, N))
    S, e = R, y
    for a in range(m):
        for k in range(N):
            h = H[a, k]
            if h != 0.0:
                for j in range(N):
                    W[a, j] += h * f[c + N * k + j]
    for a in range(m):
        for b in range(m):
            for k in range(N):
                S[a, b] += W[a, k] * H[b, k]
    for a in range(m):
        for b in range(a):
            for k in range(b):
                S[a, b] -= S[a, k] * S[b, k]
            S[a, b] /= S[b, b]
            S[a, a] -= S[a, b] * S[a, b]
            e[a] -= S[a, b] * e[b]
            for j in range(N):
                W[a, j] -= S[a, b] * W[b, j]
        if not S[a, a] > 0.0:
            return False
        S[a, a] = math.sqrt(S[a, a])
        e[a] /= S[a, a]
        for j in range(N):
            W[a, j] /= S[a, a]
    dx = np.zeros(N)
    for a in range(m):
        # in this order the inner loop is unrolled and the outer vectorised, after one look at whether W overlaps f
        for j in range(N):
            w = W[a, j]
            dx[j] += w * e[a]
            for i in range(N):
                f[c + N * i + j] -= W[a, i] * w

    tells = False
    for a in range(m):
        tells |= H[a, DTD] != 0.0
    if tells:
        for i in range(3):
            dx[DP + i] -= dx[DV + i] * dx[DTD]
    B = np.empty((3, 3))
    _matrix(f, B)
    for i in range(3):
        move = B[i, 0] * dx[DP] + B[i, 1] * dx[DP + 1] + B[i, 2] * dx[DP + 2]
        f[POS + i] += move
        f[CORRECTED + i] += move
        f[CORRECTED + 3 + i] += B[i, 0] * dx[TH] + B[i, 1] * dx[TH + 1] + B[i, 2] * dx[TH + 2]
        f[V + i] += B[i, 0] * dx[DV] + B[i, 1] * dx[DV + 1] + B[i, 2] * dx[DV + 2]
    for i in range(DBG, N):
        f[BG - DBG + i] += dx[i]

    x, y_, z = dx[0], dx[1], dx[2]
    angle2 = x * x + y_ * y_ + z * z
    angle = math.sqrt(angle2)
    if angle < 1e-4:
        sinc, half_cosc, sincc = 1.0 - angle2 / 6.0, 0.5 - angle2 / 24.0, 1.0 / 6.0 - angle2 / 120.0
        w, h = 1.0 - angle2 / 8.0, 0.5 - angle2 / 48.0
    else:
        sinc = math.sin(angle) / angle
        half_cosc = (1.0 - math.cos(angle)) / angle2
        sincc = (1.0 - sinc) / angle2
        w, h = math.cos(0.5 * angle), math.sin(0.5 * angle) / angle
    bx, by, bz = h * x, h * y_, h * z
    qw, qx, qy, qz = f[0], f[1], f[2], f[3]
    nw = qw * w - qx * bx - qy * by - qz * bz
    nx = qw * bx + qx * w + qy * bz - qz * by
    ny = qw * by - qx * bz + qy * w + qz * bx
    nz = qw * bz + qx * by - qy * bx + qz * w
    scale = 1.0 / math.sqrt(nw * nw + nx * nx + ny * ny + nz * nz)
    f[0], f[1], f[2], f[3] = nw * scale, nx * scale, ny * scale, nz * scale

    J = np.empty((2, 3, 3))  # of attitude; of velocity and position
    for i in range(3):
        for j in range(3):
            square = dx[i] * dx[j]  # of [δθ̂]x
            J[0, i, j], J[1, i, j] = sincc * square, half_cosc * square
        J[0, i, i] += 1.0 - sincc * angle2
        J[1, i, i] += 1.0 - half_cosc * angle2
        a, b = (i + 1) % 3, (i + 2) % 3
        J[0, i, a] += half_cosc * dx[b]
        J[0, i, b] -= half_cosc * dx[a]
        J[1, i, a] += sinc * dx[b]
        J[1, i, b] -= sinc * dx[a]
    # J P Jᵀ as J (J P)ᵀ, the second round for the first nine columns only, as in `spread`. There only the mean of P
    # and Pᵀ is kept: without that the rounding of a few minutes grows into a P that is none.
    for second in range(2):
        if tells:
            for i in range(3):
                for j in range(9 if second else N):
                    f[c + N * (DP + i) + j] -= dx[DV + i] * f[c + N * DTD + j] + dx[DTD] * f[c + N * (DV + i) + j]
        for j in range(9 if second else N):
            for block in range(3):
                n = min(block, 1)
                r = c + 3 * N * block + j
                p0, p1, p2 = f[r], f[r + N], f[r + 2 * N]
                for i in range(3):
                    f[r + N * i] = J[n, i, 0] * p0 + J[n, i, 1] * p1 + J[n, i, 2] * p2
        for i in range(9):
            for j in range(i):
                upper, lower = f[c + N * j + i], f[c + N * i + j]
                mean = 0.5 * (upper + lower)
                f[c + N * j + i] = mean if second else lower
                f[c + N * i + j] = mean if second else upper
            for j in range(9, N):
                f[c + N * j + i] = f[c + N * i + j]
    return True


# ---------------------------------------------------------------------------------------------------- measurements


@_jit
def _distance(S, y, d2):
    """Squared Mahalanobis distance of y (3,) or (6,) -> d2[0], of its first three -> d2[1], of the others -> d2[2].

    -> log|S|. It and distances are inf where S is no covariance.
    """
    m = y.shape[0]
    log_det = 0.0
    d2[0] = math.inf
    L = np.empty((m, m))
    e = np.empty(m)
    for first in range(m - 3, -1, -3):
        total = 0.0
        log_det = 0.0
        for i in range(first, m):
            e[i] = y[i]
            for j in range(first, i + 1):
                L[i, j] = S[i, j]
                for k in range(first, j):
                    L[i, j] -= L[i, k] * L[j, k]
                if j < i:
                    L[i, j] /= L[j, j]
                    e[i] -= L[i, j] * e[j]
            if not L[i, i] > 0.0:
                return math.inf
            log_det += math.log(L[i, i])
            L[i, i] = math.sqrt(L[i, i])
            e[i] /= L[i, i]
            total += e[i] * e[i]
            if i == 2:
                d2[1] = total
        d2[2 if first > 0 else 0] = total
    return log_det


@_jit
def _weigh(s, o, prm, fix, H, y, R, S):
    """Choose the fix's hypothesis by the covariance of the filter at s[o:]; fill H, y, R, S and the fix's figures.

    Position then attitude, all in body axes, for a fix z at stamp + t_d:

        y_p = R̂ᵀ(z_p - p̂) = δp + R̂ᵀv̂ δt_d,    y_θ = Log(R̂ᵀ R_z) = δθ + ω δt_d

    R is the fix's covariance turned from world into body axes, and the stamp's jitter along the motion. The score of
    a hypothesis is d² + log|S| + misfit: twice the negative log-likelihood of the pose and of the pixels.
    -> that of the chosen one.
    """
    B = np.empty((3, 3))
    _matrix(s[o:], B)
    motion = np.zeros(6)
    for i in range(3):
        motion[i] = B[0, i] * s[o + V] + B[1, i] * s[o + V + 1] + B[2, i] * s[o + V + 2]
        if s[BRIDGING] == 0.0:
            motion[3 + i] = s[U + i] - s[o + BG + i]
    H[:] = 0.0
    for i in range(3):
        H[i, DP + i] = 1.0
        H[3 + i, TH + i] = 1.0
        H[i, DTD] = motion[i]
        H[3 + i, DTD] = motion[3 + i]
    half = np.empty((6, 6))
    count = int(fix[F_COUNT])
    best, margin, chosen = math.inf, math.inf, 0
    # each hypothesis, then the chosen one once more
    for trial in range(count + 1):
        k = F_HYPOTHESES + (trial if trial < count else chosen) * HYPOTHESIS
        unsure = 0.0
        if trial == count and margin < prm[HYPOTHESIS_MARGIN]:
            unsure = UNKNOWN_TILT_SIGMA * UNKNOWN_TILT_SIGMA
        for i in range(3):
            y[i] = 0.0
            for j in range(3):
                y[i] += B[j, i] * (fix[k + H_POS + j] - s[o + POS + j])
        _rotation_vector(s[o:], fix[k + H_QUAT :], y[3:])
        for i in range(6):
            for j in range(6):
                half[i, j] = 0.0
                for m in range(3):
                    half[i, j] += fix[k + H_COV + 6 * i + 3 * (j // 3) + m] * B[m, j % 3]
        for i in range(6):
            for j in range(6):
                total = motion[i] * motion[j] * prm[STAMP_JITTER] * prm[STAMP_JITTER]
                for m in range(3):
                    total += B[m, i % 3] * half[3 * (i // 3) + m, j]
                if i >= 3 and j >= 3:
                    total += unsure * (B[0, i - 3] * B[0, j - 3] + B[1, i - 3] * B[1, j - 3])
                if (i < 3) == (j < 3):
                    total *= s[SCALE + 2 + i // 3]
                R[i, j] = total
                # H P Hᵀ: row and column i of P are where H has its 1, DTD where it has its motion
                a = o + COV + N * ((DP if i < 3 else TH - 3) + i)
                b = (DP if j < 3 else TH - 3) + j
                d = o + COV + N * DTD
                S[i, j] = total + s[a + b] + motion[i] * s[d + b] + s[a + DTD] * motion[j]
                S[i, j] += motion[i] * s[d + DTD] * motion[j]
        log_det = _distance(S, y, fix[F_D2:])
        score = fix[F_D2] + log_det + fix[k + H_MISFIT]
        if count == 1:
            best = score
            break
        if trial == count:
            continue
        if score < best:
            margin = best - score
            best = score
            chosen = trial
        else:
            margin = score - best
    fix[F_CHOSEN] = chosen
    fix[F_MARGIN] = margin
    for i in range(6):
        fix[F_INNOVATION + i] = y[i]
        fix[F_SIGMA + i] = math.sqrt(S[i, i])
    return best


@_jit
def _start(s, o, prm, fix, k, afresh):
    """Pose and covariance of the filter at s[o:] from the hypothesis at fix[k:]; the rest stays, or starts afresh.

    The fix is of stamp + t_d: beside its own error the attitude is off by δθ = -ω δt_d.
    """
    f = s[o : o + BLOCK]
    c = COV
    if afresh:
        for i in range(BLOCK):
            f[i] = 0.0
        for i in range(3):
            f[c + (N + 1) * (DBG + i)] = prm[GYRO_BIAS_SIGMA] ** 2
            f[c + (N + 1) * (DBA + i)] = prm[ACCEL_BIAS_SIGMA] ** 2
        f[c + (N + 1) * DTD] = prm[TIME_OFFSET_SIGMA] ** 2
        for i in range(2):
            f[c + (N + 1) * (DTILT + i)] = prm[TILT_SIGMA] ** 2
            f[c + (N + 1) * (DWHEEL + i)] = prm[WHEEL_SCALE_SIGMA] ** 2
    for i in range(DBG):
        for j in range(N):
            f[c + N * i + j] = 0.0
            f[c + N * j + i] = 0.0
    for i in range(4):
        f[Q + i] = fix[k + H_QUAT + i]
    B = np.empty((3, 3))
    _matrix(f, B)
    for i in range(3):
        f[POS + i] = fix[k + H_POS + i]
        f[V + i] = 0.0
        f[c + (N + 1) * (DV + i)] = prm[VELOCITY_SIGMA] * prm[VELOCITY_SIGMA]
    # from world into body axes; the fix's halves are (position, attitude), the filter's are (DP, TH)
    for i in range(6):
        for j in range(6):
            total = 0.0
            for m in range(3):
                for n in range(3):
                    total += B[m, i % 3] * fix[k + H_COV + 6 * (3 * (i // 3) + m) + 3 * (j // 3) + n] * B[n, j % 3]
            f[c + N * (DP - 6 * (i // 3) + i % 3) + DP - 6 * (j // 3) + j % 3] = total
    rate = np.zeros(3)
    if s[BRIDGING] == 0.0:
        for i in range(3):
            rate[i] = s[U + i] - f[BG + i]
    for i in range(3):
        for j in range(3):
            f[c + N * i + j] += rate[i] * rate[j] * f[c + (N + 1) * DTD]
        for j in range(DBG, N):
            f[c + N * i + j] = f[c + N * j + i] = -rate[i] * f[c + N * DTD + j]
    most = UNKNOWN_HEADING * UNKNOWN_HEADING
    if max(f[c], f[c + N + 1], f[c + 2 * (N + 1)]) > most:
        # The fix says nothing of the attitude.
        for i in range(3):
            for j in range(N):
                f[c + N * i + j] = 0.0
                f[c + N * j + i] = 0.0
            f[c + (N + 1) * i] = most


@_jit
def _level(s, o, prm):
    """Correct a tilt that is known badly by the mean specific force before the start, in the filter at s[o:].

    It is g R̂ᵀu + b_a, u up: H = [g u_b]x on attitude, 1 on bias, g R̂ᵀ[e_x e_y] on tilt.
    """
    B = np.empty((3, 3))
    _matrix(s[o:], B)
    H, y, R, S = np.zeros((3, N)), np.empty(3), np.zeros((3, 3)), np.zeros((3, 3))
    for i in range(3):
        y[i] = s[ACCEL_MEAN + i] - GRAVITY * B[2, i]
        H[i, DBA + i] = 1.0
        H[i, DTILT] = GRAVITY * B[0, i]
        H[i, DTILT + 1] = GRAVITY * B[1, i]
        R[i, i] = GRAVITY_SIGMA * GRAVITY_SIGMA
        H[i, (i + 1) % 3] = -GRAVITY * B[2, (i + 2) % 3]
        H[i, (i + 2) % 3] = GRAVITY * B[2, (i + 1) % 3]
    for i in range(3):
        for j in range(3):
            S[i, j] = R[i, j]
            for m in range(N):
                for n in range(N):
                    S[i, j] += H[i, m] * s[o + COV + N * m + n] * H[j, n]
    # A fix whose tilt gravity denies is likely wrong: then nothing is to be learnt of the biases from it.
    d2 = np.empty(2)
    _distance(S, y, d2)
    if d2[0] <= prm[GATE_BLOCK]:
        update(s[o : o + BLOCK], H, y, R)


@_jit
def _initialise(s, prm, fix):
    """Start from the first fix. Where it has two poses gravity orders them, and the other starts the shadow filter."""
    count = int(fix[F_COUNT])
    score = np.zeros(2)
    B = np.empty((3, 3))
    for h in range(count):
        k = F_HYPOTHESES + h * HYPOTHESIS
        score[h] = fix[k + H_MISFIT]
        if s[ACCEL_COUNT] > 0.0:
            _matrix(fix[k + H_QUAT :], B)
            for i in range(3):
                score[h] += ((s[ACCEL_MEAN + i] - GRAVITY * B[2, i]) / GRAVITY_SIGMA) ** 2
    for h in range(count):
        # the better one first
        other = count > 1 and (score[1] < score[0]) != (h == 1)
        o = BLOCK * h
        k = F_HYPOTHESES + (HYPOTHESIS if other else 0)
        _start(s, o, prm, fix, k, s[INITIALISED] == 0.0)
        if h == 0:
            _fill(s[SYSTEMATIC : SYSTEMATIC + 36], fix[k + H_SYSTEMATIC :])
        if s[ACCEL_COUNT] > 0.0:
            _level(s, o, prm)
    s[TWINS] = s[SHADOW_COUNT] = count - 1.0
    s[INITIALISED] = 1.0
    s[ACCEPTED_COUNT] = 1.0
    s[T_ACCEPTED] = s[T]


@_jit
def _adapt(s, prm, figures, most):
    """Learn how much larger the noise is than its parameters, from the size and the sequence of innovations.

    An innovation of the expected size has d² = dof. Noise understated in the process leaves innovations that follow
    one another (the filter lags behind), noise understated in the fixes ones that alternate (it follows them too far):
    R. Mehra, "Approaches to adaptive filtering", IEEE TAC 17(5), 1972. By that the blame is laid.
    """
    # The first fixes teach more: a start that believes them too much runs away within seconds.
    # Of a fast camera each teaches less, since its innovations hardly know the process and would let it wander.
    weight = min(max((s[T] - s[T_ADAPTED]) * ADAPTATION_HZ, 0.0), 1.0)
    gain = weight * prm[ADAPTATION] * max(1.0, 20.0 / (s[ADAPTED] + 6.0))
    s[ADAPTED] += weight
    s[T_ADAPTED] = s[T]
    for block in range(2):
        d2, product, length = 0.0, 0.0, 0.0
        for i in range(3 * block, 3 * block + 3):
            e = figures[F_INNOVATION - F_D2 + i] / figures[F_SIGMA - F_D2 + i]
            d2 += e * e
            product += e * s[LAST_INNOVATION + i]
            length += s[LAST_INNOVATION + i] ** 2
            s[LAST_INNOVATION + i] = e
        follows = product / (math.sqrt(d2 * length) + 1.0)
        more = min(d2 / 3.0 - 1.0, most)
        to_process = min(max(0.5 + 1.0 * follows, 0.0), 1.0)
        for k in range(2):
            i = EXCESS + block + 2 * k
            part = to_process if k == 0 else 1.0 - to_process
            s[i] = min(max(s[i] + gain * part * more, LEAST_EXCESS), MOST_EXCESS)
            factor = math.exp(max(s[i] - IGNORED_EXCESS, 0.0))
            s[SCALE + block + 2 * k] = math.sqrt(factor) if k == 0 else factor


@_jit
def _restarted(s, prm, fix, count):
    """The pose has been set anew, by `count` fixes of which this is the last."""
    s[ACCEPTED_COUNT] = count
    s[SHADOW_COUNT] = s[REJECTED_RUN] = 0.0
    s[RESET_ID] += 1.0
    s[T_ACCEPTED] = s[T]
    # It may be the clocks that have jumped.
    for i in range(N):
        s[COV + N * DTD + i] = s[COV + N * i + DTD] = 0.0
    s[COV + (N + 1) * DTD] = prm[TIME_OFFSET_SIGMA] * prm[TIME_OFFSET_SIGMA]
    _fill(s[SYSTEMATIC : SYSTEMATIC + 36], fix[F_HYPOTHESES + int(fix[F_CHOSEN]) * HYPOTHESIS + H_SYSTEMATIC :])
    fix[F_OUTCOME] = REINIT


@_jit
def _judge(s, prm, fix):
    """Believe a fix, or not: update the filter at T, and say in the fix's row what became of it.

    The way back: a rejected fix starts a shadow filter, which runs on the same IMU and takes the rejects that follow.
    When enough in a row agree with it, and its attitude with the gyro's, it takes over. A marker entered wrongly in
    the map gives long runs that agree with each other but not with the gyro; those must last longer than any such run.
    Twice as many in a row that do not even agree with each other, unless they are only turned, and any at all after
    that long without an accepted one, set the filter anew from the last: it is never locked out for good.
    A fix of which only the attitude fails is taken with its position alone, and counts as a reject for the way back.
    """
    H, y, R, S = np.empty((6, N)), np.empty(6), np.empty((6, 6)), np.empty((6, 6))
    shadow = MAIN + SHADOW  # as a variable: for each constant argument numba compiles a function of its own
    if s[TWINS] > 0.0:
        # Which of the first fix's poses was it? Both go on until that is clear, the likelier one as the filter.
        for o in range(MAIN, AUX, BLOCK):
            score = _weigh(s, o, prm, fix, H, y, R, S)
            s[LEAD] += score if o == SHADOW else -score
        if s[LEAD] < 0.0:
            s[LEAD] = -s[LEAD]
            for i in range(BLOCK):
                swap = s[i]
                s[i] = s[SHADOW + i]
                s[SHADOW + i] = swap
        if s[LEAD] > CLEAR_LEAD:
            s[TWINS] = s[SHADOW_COUNT] = 0.0
        else:
            # the one that is the filter now takes the fix below
            _weigh(s, shadow, prm, fix, H, y, R, S)
            if fix[F_D2] <= prm[GATE] * prm[GATE_INFLATION]:
                update(s[SHADOW:AUX], H, y, R)
    shadows = s[SHADOW_COUNT] > 0.0 and s[TWINS] == 0.0
    agrees, partly = False, False
    figures = np.empty(F_REPORTED - F_D2)
    for o in range(MAIN, SHADOW + 1 if shadows else SHADOW, BLOCK):
        _weigh(s, o, prm, fix, H, y, R, S)
        if max(s[COV], s[COV + N + 1], s[COV + 2 * (N + 1)]) > 2.0 * UNKNOWN_HEADING * UNKNOWN_HEADING:
            # After so long without an IMU nothing is left to weigh the fix by.
            _start(s, o, prm, fix, F_HYPOTHESES + int(fix[F_CHOSEN]) * HYPOTHESIS, s[INITIALISED] == 0.0)
            _restarted(s, prm, fix, 1.0)
            return
        blocks = max(fix[F_D2_POSITION], fix[F_D2_ATTITUDE]) / prm[GATE_BLOCK]
        ratio = max(fix[F_D2] / prm[GATE], blocks)
        if o == MAIN:
            if s[STILL_SINCE] < s[T]:
                # A fix at rest repeats the error of the one before: of n fixes, a share of the variance does not
                # average. R such that the variance after n of them is share + (1 - share)/n of one's.
                n, share = s[STILL_FIXES] + 1.0, prm[FIX_CORRELATION]
                s[STILL_FIXES] = n
                if n > 1.0 and share > 0.0:
                    before, after = share + (1.0 - share) / (n - 1.0), share + (1.0 - share) / n
                    more = before * after / (before - after) - 1.0
                    for i in range(6):
                        for j in range(6):
                            S[i, j] += more * R[i, j]
                            R[i, j] += more * R[i, j]
            _fill(figures, fix[F_D2:])
            if fix[F_D2_POSITION] > LEAVE_STILL:
                s[STILL_SINCE] = math.inf
                s[STILL_BARRED] = s[T] + STILL_PAUSE
            fix[F_OUTCOME] = INFLATED if ratio > 1.0 else ACCEPTED
        if ratio > prm[GATE_INFLATION]:
            if o == MAIN and fix[F_D2_POSITION] <= prm[GATE_BLOCK]:
                # A marker that is turned in the map, or seen flipped, is still where it is.
                for i in range(6):
                    for j in range(3, 6):
                        R[i, j] = R[j, i] = 0.0
                for i in range(3, 6):
                    R[i, i] = UNKNOWN_HEADING * UNKNOWN_HEADING
                partly = update(s[:BLOCK], H, y, R)
            continue
        if o == MAIN:
            _adapt(s, prm, figures, MOST_TAUGHT)
        if ratio > 1.0:
            # as if the fix were less certain, until it just passes
            for i in range(6):
                for j in range(6):
                    R[i, j] += (ratio - 1.0) * S[i, j]
        if update(s[o : o + BLOCK], H, y, R):
            if o == MAIN:
                _fill(
                    s[SYSTEMATIC : SYSTEMATIC + 36],
                    fix[F_HYPOTHESES + int(fix[F_CHOSEN]) * HYPOTHESIS + H_SYSTEMATIC :],
                )
                s[REJECTED_RUN] = 0.0
                if s[TWINS] == 0.0:
                    s[SHADOW_COUNT] = 0.0
                s[ACCEPTED_COUNT] += 1.0
                s[T_ACCEPTED] = s[T]
                n = min(s[PLACE_COUNT] + 1.0, PLACE_FIXES)
                s[PLACE_COUNT] = n
                for i in range(3):
                    off = s[POS + i] - s[PLACE + i]
                    s[PLACE + i] += off / n
                    s[PLACE2 + i] += (off * off * (n - 1.0) / n - s[PLACE2 + i]) / n
                return
            agrees = True
    fix[F_OUTCOME] = REJECTED
    if partly:
        fix[F_OUTCOME] = INFLATED
        s[T_ACCEPTED] = s[T]
    _fill(fix[F_D2:F_REPORTED], figures)
    # A reject that is not far off, that agrees with the one before, or is one of many, is no outlier: something is
    # noisier than it says. Unless it is turned, as flips are.
    far = _length(figures[F_INNOVATION - F_D2 :]) > OUTLIER_DISTANCE
    turned = _length(figures[F_INNOVATION - F_D2 + 3 :]) > prm[REINIT_ANGLE]
    s[REJECTED_RUN] += 1.0
    s[TWINS] = 0.0
    if agrees or not (far or turned) or s[REJECTED_RUN] >= prm[REINIT_COUNT]:
        _adapt(s, prm, figures, 0.0 if turned else MOST_TAUGHT)
    if not shadows:
        s[REJECTED_SINCE] = s[T]
    patient = s[T] - s[REJECTED_SINCE] >= prm[REINIT_PATIENCE]
    known = s[ACCEPTED_COUNT] >= 2.0 * prm[REINIT_COUNT]
    if agrees:
        s[SHADOW_COUNT] += 1.0
        # Is the shadow's attitude what the gyro made of the attitude since the last accepted fix?
        turn, covariance = np.empty(3), np.empty((3, 3))
        _rotation_vector(s, s[SHADOW:], turn)
        for i in range(3):
            for j in range(3):
                covariance[i, j] = s[COV + N * i + j] + s[SHADOW + COV + N * i + j]
        angle = _length(turn)
        d2 = np.empty(2)
        _distance(covariance, turn, d2)
        as_gyro = d2[0] <= prm[GATE_BLOCK] or (
            # with noise set too small nothing ever agrees; a map entry is not wrong by a little
            s[SHADOW_COUNT] >= 2.0 * prm[REINIT_COUNT] and angle <= prm[REINIT_ANGLE]
        )
        take = s[SHADOW_COUNT] >= prm[REINIT_COUNT] and (as_gyro or patient or not known)
    else:
        _fill(s[SHADOW:AUX], s)
        # A filter that only its first fixes vouch for has no biases worth keeping.
        _start(s, shadow, prm, fix, F_HYPOTHESES + int(fix[F_CHOSEN]) * HYPOTHESIS, not known)
        s[SHADOW_COUNT] = 1.0
        # Not even with each other do they agree, so many in a row: then any is better than none of them.
        take = patient or (s[REJECTED_RUN] >= 2.0 * prm[REINIT_COUNT] and not (turned and partly))
    if take:
        _fill(s[:SHADOW], s[SHADOW:])
        _restarted(s, prm, fix, s[SHADOW_COUNT])


@_jit
def _watch(s, prm, imu, meta, k):
    """Is the robot at rest? Looks back over the last window of samples, number k the newest."""
    n = 0
    mean, square = np.zeros(6), np.zeros(6)
    t = imu[k & IMU_MASK, 0]
    complete = False
    while k - n >= meta[IMU_FIRST]:
        row = (k - n) & IMU_MASK
        if t - imu[row, 0] > STILL_WINDOW:
            complete = True
            break
        for i in range(6):
            # around the newest, so that no digits are lost to gravity
            d = imu[row, 1 + i] - imu[k & IMU_MASK, 1 + i]
            mean[i] += d
            square[i] += d * d
        n += 1
    still = False
    if complete and n >= 4:
        gyro, accel, rate, pushed = 0.0, 0.0, 0.0, 0.0
        for i in range(3):
            gyro += (square[i] - mean[i] * mean[i] / n) / (n - 1)
            accel += (square[3 + i] - mean[3 + i] * mean[3 + i] / n) / (n - 1)
            r = imu[k & IMU_MASK, 1 + i] + mean[i] / n - s[BG + i]
            rate += r * r
            s[STILL_MEAN + i] = imu[k & IMU_MASK, 1 + i] + mean[i] / n
            force = imu[k & IMU_MASK, 4 + i] + mean[3 + i] / n
            if s[STILL_SINCE] == math.inf:
                s[STILL_FORCE + i] = force
            pushed += (force - s[STILL_FORCE + i]) ** 2
            s[STILL_FORCE + i] += 0.05 * (force - s[STILL_FORCE + i])
        # The quietest window so far is the measure of rest; it is forgotten within minutes.
        s[REST_GYRO] = min(s[REST_GYRO] * 1.001, gyro) if s[REST_GYRO] > 0.0 else gyro
        s[REST_ACCEL] = min(s[REST_ACCEL] * 1.001, accel) if s[REST_ACCEL] > 0.0 else accel
        speed2 = s[V] ** 2 + s[V + 1] ** 2 + s[V + 2] ** 2
        if speed2 > 4.0 * prm[STILL_SPEED] ** 2:
            s[MOVING_GYRO] += 0.02 * (gyro - s[MOVING_GYRO])
            s[MOVING_ACCEL] += 0.02 * (accel - s[MOVING_ACCEL])
            if t - s[T_ACCEPTED] < 1.0:
                s[USUAL_SPEED2] += (speed2 / 3.0 - s[USUAL_SPEED2]) / (60.0 * GRID_HZ)
        # Does motion show in the scatter at all? Not on a smooth floor; then the speed has to say it, more strictly.
        s[STILL_SURE] = 0.0
        if s[MOVING_GYRO] > 30.0 * s[REST_GYRO] or s[MOVING_ACCEL] > 30.0 * s[REST_ACCEL]:
            s[STILL_SURE] = 1.0
        # noise of n samples scatters too: 9 is three times the sigma, and a floor for sensors that round to zero
        quiet = gyro <= 9.0 * s[REST_GYRO] + 1e-6 and accel <= 9.0 * s[REST_ACCEL] + 1e-4
        unsure = 3.0 * math.sqrt(s[COV + (N + 1) * DBG] + s[COV + (N + 1) * (DBG + 1)] + s[COV + (N + 1) * (DBG + 2)])
        sigma2 = s[COV + (N + 1) * DV] + s[COV + (N + 1) * (DV + 1)] + s[COV + (N + 1) * (DV + 2)]
        sigma2 += STILL_SPEED_SIGMA * STILL_SPEED_SIGMA
        still = (
            quiet
            # a smooth departure: zero velocity would make a tilt of it
            and math.sqrt(pushed) < STILL_PUSH + 4.0 * math.sqrt(accel / n)
            and t > s[STILL_BARRED]
            and math.sqrt(rate) < prm[STILL_RATE] + unsure
            and speed2 < prm[STILL_SPEED] ** 2
            and speed2 < (9.0 if s[STILL_SURE] > 0.0 else 2.25) * sigma2
        )
    if not still:
        s[STILL_SINCE] = math.inf
        s[STILL_FIXES] = 0.0
    elif s[STILL_SINCE] == math.inf:
        s[STILL_SINCE] = t


@_jit
def _projected(f, h):
    """h P hᵀ of a row h (N,) of H."""
    total = 0.0
    for i in range(N):
        if h[i] != 0.0:
            for j in range(N):
                total += h[i] * f[COV + N * i + j] * h[j]
    return total


@_jit
def _loosened(s, o, i, variance, least, y, h, learn):
    """The variance of constraint number i, of row h (N,) of H and meant with `variance`, that is violated by y now.

    It is no less than what it has been violated by of late, relative to what it was meant to be, at `least`.
    """
    loose = max(s[CONSTRAINT_NIS + i], least)
    if learn:
        expected = variance * loose + _projected(s[o : o + BLOCK], h)
        s[CONSTRAINT_NIS + i] += 0.05 * (min(y * y / expected, 9.0) * loose - s[CONSTRAINT_NIS + i])
    return max(variance * loose, y * y)


@_jit
def _constrain(s, prm):
    """Pseudo-measurements, ten times a second.

    At rest: no velocity, no rate. On the floor: no vertical speed, upright; on wheels: no sideways speed either. Each
    of these is loosened by how much it has been violated of late. Always: robots do not go faster than they usually
    do, by which a speed that nothing measures any more decays instead of being integrated for ever; nor, when no fix
    comes, do they leave for good the place where they have been.
    """
    B, body = np.empty((3, 3)), np.empty(3)
    still = s[T] - s[T_IMU] <= prm[IMU_GAP] and s[STILL_SINCE] <= s[T] - (
        STILL_AFTER if s[STILL_SURE] > 0.0 else 2.0 * STILL_AFTER
    )
    still_sigma = STILL_SPEED_SIGMA if s[STILL_SURE] > 0.0 else 3.0 * STILL_SPEED_SIGMA
    wheels = prm[MOTION] == DIFFERENTIAL
    for o in range(MAIN, SHADOW + 1 if s[SHADOW_COUNT] > 0.0 else SHADOW, BLOCK):
        m = 0
        learn = o == MAIN and not still
        if prm[TIME_OFFSET_SIGMA] > 0.0:
            s[o + COV + (N + 1) * DTD] += TIME_OFFSET_WALK * TIME_OFFSET_WALK / GRID_HZ
        H, y, variances = np.zeros((12, N)), np.zeros(12), np.empty(12)
        _matrix(s[o:], B)
        # along body axes: v_b = Rᵀv, δv_b = δv + [v_b]x δθ
        for i in range(3):
            body[i] = B[0, i] * s[o + V] + B[1, i] * s[o + V + 1] + B[2, i] * s[o + V + 2]
        for i in range(3):
            sideways = wheels and i == 1 and not still
            # one in each 2 x SPEED_TIME is independent of the one before
            variance = max(s[USUAL_SPEED2], LEAST_SPEED * LEAST_SPEED) * 2.0 * SPEED_TIME * GRID_HZ
            if still:
                variance = still_sigma * still_sigma
            elif not sideways and s[o + COV + (N + 1) * (DV + i)] < 1e-3 * variance:
                # a speed that is known a thousand times better learns nothing from this
                continue
            y[m] = -body[i]
            H[m, DV + i] = 1.0
            H[m, (i + 1) % 3] = -body[(i + 2) % 3]
            H[m, (i + 2) % 3] = body[(i + 1) % 3]
            if sideways:
                variance = _loosened(s, o, i + 2, prm[WHEEL_VELOCITY_SIGMA] ** 2, LEAST_CONSTRAINT, y[m], H[m], learn)
            variances[m] = variance
            m += 1
        if s[T] - s[T_ACCEPTED] > COAST_TIME and s[PLACE_COUNT] > 10.0:
            for i in range(3):
                y[m] = s[PLACE + i] - s[o + POS + i]
                for j in range(3):
                    H[m, DP + j] = B[i, j]
                variances[m] = max(s[PLACE2 + i], LEAST_PLACE * LEAST_PLACE) * 2.0 * PLACE_TIME * GRID_HZ
                m += 1
        if still:
            sigma = 2.0 * prm[GYRO_NOISE] * math.sqrt(GRID_HZ)
            for i in range(3):
                y[m] = s[STILL_MEAN + i] - s[o + BG + i]
                variances[m] = sigma * sigma
                H[m, DBG + i] = 1.0
                m += 1
        if prm[MOTION] != FREE:
            # vertical speed in the world: e_zᵀ(v̂ + R̂ δv)
            y[m] = -s[o + V + 2]
            for i in range(3):
                H[m, DV + i] = B[2, i]
            # up in body axes, u = Rᵀe_z, is (0, 0, 1): δu = [u]x δθ
            y[m + 1], y[m + 2] = -B[2, 0], -B[2, 1]
            H[m + 1, 1], H[m + 1, 2] = -B[2, 2], B[2, 1]
            H[m + 2, 0], H[m + 2, 2] = B[2, 2], -B[2, 0]
            for i in range(3):
                # the tilt is not tightened: who leans, leans always
                sigma, least = prm[GROUND_TILT_SIGMA], 1.0
                if i == 0:
                    sigma, least = prm[GROUND_VELOCITY_SIGMA], LEAST_CONSTRAINT
                variances[m] = _loosened(s, o, i, sigma * sigma, least, y[m], H[m], learn)
                m += 1
        if m > 0:
            R = np.zeros((m, m))
            for i in range(m):
                R[i, i] = variances[i]
            update(s[o : o + BLOCK], H[:m], y[:m], R)


@_jit
def _odometry(s, prm, reading):
    """Take a reading of the wheels at T: forward speed and yaw rate of the body, each with an error of scale.

        y_v = z_v - (1 + s_v) e_xᵀR̂ᵀv̂,    y_ω = z_ω - (1 + s_ω) (ω_z - b_z)

    Wheels slip: a reading whose yaw rate the gyroscope denies by more than three sigma is left out, and a speed that is
    far off is loosened as constraints are, since its witness is weaker. What follows counts for less.
    NaN: the robot does not tell. Without an IMU their yaw rate turns it.
    """
    B = np.empty((3, 3))
    slips = False
    # What wheels get wrong they get wrong for a while: a second of them tells the same at whatever rate.
    share = max(1.0 / (GRID_HZ * max(s[T] - s[T_WHEEL], 1e-3)), 1.0)
    s[T_WHEEL] = s[T]
    s[WHEEL_RATE] = 0.0 if math.isnan(reading[2]) else reading[2] / (1.0 + s[WHEEL + 1])
    for o in range(MAIN, SHADOW + 1 if s[SHADOW_COUNT] > 0.0 else SHADOW, BLOCK):
        _matrix(s[o:], B)
        m = 0
        H, y, variances = np.zeros((2, N)), np.zeros(2), np.empty(2)
        for i in range(2):
            if math.isnan(reading[1 + i]) or (i == 1 and s[BRIDGING] > 0.0):
                continue
            scale = 1.0 + s[o + WHEEL + i]
            if i == 0:
                body = np.zeros(3)
                for j in range(3):
                    body[j] = B[0, j] * s[o + V] + B[1, j] * s[o + V + 1] + B[2, j] * s[o + V + 2]
                value = body[0]
                H[m, DV] = scale
                H[m, TH + 1], H[m, TH + 2] = -scale * body[2], scale * body[1]
            else:
                value = s[U + 2] - s[o + BG + 2]
                H[m, DBG + 2] = -scale
            H[m, DWHEEL + i] = value
            y[m] = reading[1 + i] - scale * value
            variance = prm[WHEEL_SPEED_SIGMA + i] ** 2 * share
            if o == MAIN:
                off = y[m] * y[m] / (variance + _projected(s[:BLOCK], H[m]))
                slips |= i == 1 and off > SLIPS
                s[WHEEL_NIS + i] += 0.05 / share * (min(off, SLIPS) - s[WHEEL_NIS + i])
            if i == 0:
                variance = max(variance, y[m] * y[m] * share)
            variances[m] = variance * max(s[WHEEL_NIS + i], 1.0)
            m += 1
        if m > 0 and not slips:
            R = np.zeros((m, m))
            for i in range(m):
                R[i, i] = variances[i]
            update(s[o : o + BLOCK], H[:m], y[:m], R)


@_inline
def _grid(s, prm):
    """The pseudo-measurements, where T has come to the next step of their grid."""
    step = math.floor(s[T] * GRID_HZ)
    if step != s[GRID_AT]:
        s[GRID_AT] = step
        if s[INITIALISED] > 0.0:
            _constrain(s, prm)


# -------------------------------------------------------------------------------------------------------- timeline


@_inline
def _next_sample(s, prm, imu, k):
    """Set the state on its way to IMU sample number k, as far as that can be believed.

    A pause is bridged, and a sensor that repeats itself to the last digit is one; what is more than the sensor can say,
    and a sample that is far from the one before, alone, are as good as nothing.
    """
    row = k & IMU_MASK
    t = imu[row, 0]
    s[NEXT_T] = t
    # Whether a pause is bridged depends on the stamps of the IMU alone, not on the fixes within it.
    s[BRIDGING] = 1.0 if t - s[T_IMU] > prm[IMU_GAP] else 0.0
    # On the floor what is felt is gravity, on the mean: where it is far from that the scale is wrong.
    scale = 1.0
    if prm[MOTION] != FREE and s[FORCE_COUNT] > 0.0 and not LEAST_FORCE2 < s[FORCE2] < MOST_FORCE2:
        scale = GRAVITY / math.sqrt(max(s[FORCE2], 1e-4 * GRAVITY * GRAVITY))
    gyro, accel, force2, largest_gyro, largest_accel = 0.0, 0.0, 0.0, 0.0, 0.0
    saturated = False
    for i in range(3):
        rate, force = imu[row, 1 + i], scale * imu[row, 4 + i]
        s[NEXT_U + i], s[NEXT_U + 3 + i] = rate, force
        force2 += imu[row, 4 + i] * imu[row, 4 + i]
        faster, harder = rate - s[U + i], force - s[U + 3 + i]
        gyro += faster * faster
        accel += harder * harder
        largest_gyro, largest_accel = max(largest_gyro, abs(rate)), max(largest_accel, abs(force))
        if faster == 0.0 and abs(rate) >= max(s[LARGEST_GYRO], SATURATED_GYRO):
            s[CLIPPED] += 1.0
            saturated |= s[CLIPPED] >= CLIPPED_OFTEN
        if harder == 0.0 and abs(force) >= max(s[LARGEST_ACCEL], SATURATED_ACCEL):
            s[CLIPPED + 1] += 1.0
            saturated |= s[CLIPPED + 1] >= CLIPPED_OFTEN
    if gyro + accel == 0.0:
        s[SAME_RUN] += 1.0
    else:
        s[SAME_RUN] = 0.0
        s[FORCE_COUNT] = min(s[FORCE_COUNT] + 1.0, FORCE_SAMPLES)
        s[FORCE2] += (min(force2, 100.0 * GRAVITY * GRAVITY) - s[FORCE2]) / s[FORCE_COUNT]
    if s[SAME_RUN] >= STUCK_AFTER:
        s[BRIDGING] = 1.0
    spike = gyro > max(SPIKE * SPIKE * s[CHANGE_GYRO], SPIKE_GYRO * SPIKE_GYRO)
    spike |= accel > max(SPIKE * SPIKE * s[CHANGE_ACCEL], SPIKE_ACCEL * SPIKE_ACCEL)
    impossible = gyro > IMPOSSIBLE_GYRO * IMPOSSIBLE_GYRO or accel > IMPOSSIBLE_ACCEL * IMPOSSIBLE_ACCEL
    if impossible or (spike and s[SUSPECT] == 0.0 and s[LARGEST_ACCEL] > 0.0):
        s[SUSPECT] = 1.0
        for i in range(6):
            s[NEXT_U + i] = s[U + i]
    else:
        s[SUSPECT] = 0.0
        if s[LARGEST_ACCEL] > 0.0:
            s[CHANGE_GYRO] += 0.02 * (gyro - s[CHANGE_GYRO])
            s[CHANGE_ACCEL] += 0.02 * (accel - s[CHANGE_ACCEL])
        if largest_gyro > s[LARGEST_GYRO]:
            s[LARGEST_GYRO], s[CLIPPED] = largest_gyro, 0.0
        if largest_accel > s[LARGEST_ACCEL]:
            s[LARGEST_ACCEL], s[CLIPPED + 1] = largest_accel, 0.0
    s[BLIND] = 1.0 if saturated or s[SUSPECT] > 0.0 else 0.0


@_inline
def _settle(s, prm):
    """Bring the covariances up to T by what the IMU has said, for whatever reads or changes them."""
    for o in range(MAIN, SHADOW + 1 if s[SHADOW_COUNT] > 0.0 else SHADOW, BLOCK):
        spread(s[o : o + BLOCK], MEASURED, prm[GYRO_BIAS_WALK], prm[ACCEL_BIAS_WALK])


@_inline
def _run_to(s, prm, fixes, fix_end, wheels, wheel_end, t_end):
    """Carry the state to t_end, on its way to the next sample, or to what is due before. -> what that is."""
    cursor = int(s[FIX_CURSOR])
    t = t_end
    due = NOTHING
    if cursor < fix_end:
        t_fix = fixes[cursor & FIX_MASK, F_T] + s[TD_APPLIED]
        if t_fix <= t_end:
            t, due = t_fix, A_FIX
    wheel = int(s[WHEEL_CURSOR])
    if wheel < wheel_end and wheels[wheel & WHEEL_MASK, 0] <= t:
        t, due = wheels[wheel & WHEEL_MASK, 0], A_READING
    # An offset that has just shrunk can put a fix before the one before it, by its change: it is taken now.
    dt = t - s[T]
    if s[BRIDGING] > 0.0:
        _settle(s, prm)
        # after longer than that nothing is known any less
        dt = min(dt, MOST_BRIDGED)
    if dt > 0.0:
        # the input at t, on the line from the state's to the next sample's; its mean on the way there
        part = 1.0
        if t < s[NEXT_T] and math.isfinite(s[T]):
            part = dt / (s[NEXT_T] - s[T])
        if s[INITIALISED] > 0.0:
            gx = s[U] + 0.5 * part * (s[NEXT_U] - s[U])
            gy = s[U + 1] + 0.5 * part * (s[NEXT_U + 1] - s[U + 1])
            gz = s[U + 2] + 0.5 * part * (s[NEXT_U + 2] - s[U + 2])
            ax = s[U + 3] + 0.5 * part * (s[NEXT_U + 3] - s[U + 3])
            ay = s[U + 4] + 0.5 * part * (s[NEXT_U + 4] - s[U + 4])
            az = s[U + 5] + 0.5 * part * (s[NEXT_U + 5] - s[U + 5])
            rate_noise, force_noise = prm[GYRO_NOISE] * s[SCALE + 1], prm[ACCEL_NOISE] * s[SCALE]
            # An accelerometer that shakes three times as much as its noise says has more of it.
            shaken2 = s[CHANGE_ACCEL] / 6.0 * min(s[NEXT_T] - s[T_IMU], prm[IMU_GAP])
            if shaken2 > 9.0 * prm[ACCEL_NOISE] * prm[ACCEL_NOISE]:
                force_noise = max(force_noise, math.sqrt(shaken2) - 2.0 * prm[ACCEL_NOISE])
            if s[BLIND] > 0.0:
                # anything up to several times what it has ever said
                rate_noise, force_noise = s[LARGEST_GYRO] * BLIND_TIME, s[LARGEST_ACCEL] * BLIND_TIME
            for o in range(MAIN, SHADOW + 1 if s[SHADOW_COUNT] > 0.0 else SHADOW, BLOCK):
                if s[BRIDGING] > 0.0:
                    # Straight on: the input that says so is the bias, and gravity seen from the body.
                    c0, c1 = s[o + TILT], s[o + TILT + 1]
                    c2 = math.sqrt(1.0 - c0 * c0 - c1 * c1)
                    w, x, y, z = s[o], s[o + 1], s[o + 2], s[o + 3]
                    gx, gy, gz = s[o + BG], s[o + BG + 1], s[o + BG + 2]
                    turns = t - s[T_WHEEL] <= prm[IMU_GAP]
                    if turns:
                        gz += s[WHEEL_RATE]
                    ax = (1.0 - 2.0 * (y * y + z * z)) * c0 + 2.0 * ((x * y + w * z) * c1 + (x * z - w * y) * c2)
                    ay = (1.0 - 2.0 * (x * x + z * z)) * c1 + 2.0 * ((x * y - w * z) * c0 + (y * z + w * x) * c2)
                    az = (1.0 - 2.0 * (x * x + y * y)) * c2 + 2.0 * ((x * z + w * y) * c0 + (y * z - w * x) * c1)
                    ax = GRAVITY * ax + s[o + BA]
                    ay = GRAVITY * ay + s[o + BA + 1]
                    az = GRAVITY * az + s[o + BA + 2]
                    rate_noise, force_noise = prm[NO_IMU_RATE_NOISE], 0.0
                    if turns:
                        rate_noise = prm[WHEEL_RATE_SIGMA] / math.sqrt(GRID_HZ)
                predict(s[o : o + BLOCK], gx, gy, gz, ax, ay, az, dt, rate_noise, force_noise)
                if s[BRIDGING] > 0.0:
                    spread(s[o : o + BLOCK], BRIDGED, prm[GYRO_BIAS_WALK], prm[ACCEL_BIAS_WALK])
                    _slow(s[o : o + BLOCK], dt, prm[NO_IMU_ACCEL_NOISE])
        if part == 1.0:
            for i in range(6):
                s[U + i] = s[NEXT_U + i]
        else:
            for i in range(6):
                s[U + i] += part * (s[NEXT_U + i] - s[U + i])
        s[T] = t
    if due != NOTHING or s[LAG] > LONGEST_LAG or math.floor(t * GRID_HZ) != s[GRID_AT]:
        _settle(s, prm)
    return due


@_jit
def _take(s, prm, fixes, wheels, due):
    """The fix or the reading that is due at T."""
    if due == A_READING:
        number = int(s[WHEEL_CURSOR])
        if s[INITIALISED] > 0.0:
            _odometry(s, prm, wheels[number & WHEEL_MASK])
        s[WHEEL_CURSOR] = number + 1
    else:
        number = int(s[FIX_CURSOR])
        fix = fixes[number & FIX_MASK]
        if s[INITIALISED] > 0.0:
            _judge(s, prm, fix)
        else:
            _initialise(s, prm, fix)
            fix[F_OUTCOME] = INIT
        s[TD_APPLIED] = s[TD]
        s[FIX_CURSOR] = number + 1


@_jit
def _copy(a, b):
    """State a to b; a shadow only if there is one."""
    _fill(b[:SHADOW], a)
    if a[SHADOW_COUNT] > 0.0:
        _fill(b[SHADOW:AUX], a[SHADOW:])
    _fill(b[AUX:], a[AUX:])


@_inline
def _keep_checkpoint(s, prm, checkpoints, meta):
    end = int(meta[CP_END])
    if s[T] - checkpoints[(end - 1) & CP_MASK, T] < prm[BUFFER] / CP_PER_BUFFER and end > meta[CP_FIRST]:
        return
    _copy(s, checkpoints[end & CP_MASK])
    meta[CP_END] = end + 1
    if end + 1 - meta[CP_FIRST] > CP_CAPACITY:
        meta[CP_FIRST] += 1.0


@_inline
def _advance(s, prm, imu, fixes, fix_end, wheels, wheel_end, checkpoints, meta, until, live):
    """Bring a state up to the inputs in the rings that are stamped until then, and the live one with checkpoints.

    One that is not live goes on from there: between two samples as ever; beyond the last with its input as long as that
    is fresh, then at constant velocity.
    """
    k = int(s[IMU_CURSOR])
    imu_end = int(meta[IMU_END])
    while True:
        row = k & IMU_MASK
        sample = k < imu_end and (imu[row, 0] <= until or s[T] < until)
        # What is beyond the last sample waits for the IMU, unless that has been silent for too long.
        fresh = s[T_IMU] + prm[IMU_GAP]
        paused = meta[HORIZON] > fresh
        trailing = 0.0
        if sample:
            t = min(imu[row, 0], until)
            _next_sample(s, prm, imu, k)
        elif live and paused:
            t, trailing = math.inf, 1.0
            if s[FIX_CURSOR] < fix_end:
                t = fixes[int(s[FIX_CURSOR]) & FIX_MASK, F_T] + s[TD_APPLIED]
            if s[WHEEL_CURSOR] < wheel_end:
                t = min(t, wheels[int(s[WHEEL_CURSOR]) & WHEEL_MASK, 0])
            if t == math.inf:
                break
            s[NEXT_T] = math.inf
            s[BRIDGING] = 1.0
        elif not live and s[T] < until and s[INITIALISED] + fix_end > 0.0:
            s[BRIDGING] = 1.0 if paused or s[T] >= fresh else 0.0
            t = until if s[BRIDGING] > 0.0 else min(until, fresh)
            s[NEXT_T] = math.inf
            _fill(s[NEXT_U : NEXT_U + 6], s[U:])
        else:
            break
        while True:
            due = _run_to(s, prm, fixes, fix_end, wheels, wheel_end, t)
            if due == NOTHING:
                break
            _take(s, prm, fixes, wheels, due)
            if s[BRIDGING] > 0.0:
                # no sample may come to do it
                _grid(s, prm)
        s[TRAILING] = trailing
        if sample and t == imu[row, 0]:
            if s[INITIALISED] > 0.0:
                if math.floor(t * GRID_HZ) != s[GRID_AT]:
                    _watch(s, prm, imu, meta, k)
            else:
                # mean over the last hundred samples or so
                n = min(s[ACCEL_COUNT] + 1.0, 100.0)
                s[ACCEL_COUNT] = n
                for i in range(3):
                    s[ACCEL_MEAN + i] += (s[NEXT_U + 3 + i] - s[ACCEL_MEAN + i]) / n
            s[T_IMU] = t
            _grid(s, prm)
            k += 1
            s[IMU_CURSOR] = k
        if live:
            _keep_checkpoint(s, prm, checkpoints, meta)


@_inline
def _precedes_sample(s, t, gap):
    """Whether this state is as it would be if a sample stamped t were known to follow."""
    return s[T] < t and (s[TRAILING] == 0.0 or t - s[T_IMU] > gap)


@_jit
def _precedes_fix(s, t, place):
    """Whether this state is as it would be if fix number `place`, stamped t, were known."""
    return s[FIX_CURSOR] <= place and s[T] < t + s[TD_APPLIED]


@_jit
def _rewind(s, prm, checkpoints, meta, t, place):
    """Load the newest checkpoint before something stamped t: fix number `place`, a sample (-1) or a reading of the
    wheels (-2). False: there is none."""
    number = int(meta[CP_END]) - 1
    while number >= meta[CP_FIRST]:
        checkpoint = checkpoints[number & CP_MASK]
        if place >= 0.0:
            precedes = _precedes_fix(checkpoint, t, place)
        else:
            precedes = _precedes_sample(checkpoint, t, prm[IMU_GAP]) if place == -1.0 else checkpoint[T] < t
        if precedes:
            break
        number -= 1
    if number < meta[CP_FIRST] or t < meta[HORIZON] - prm[BUFFER]:
        return False
    _copy(checkpoints[number & CP_MASK], s)
    meta[CP_END] = number + 1
    meta[REWINDS] += 1.0
    return True


@_jit
def _drop_orphans(checkpoints, meta):
    """Drop the checkpoints that would need what has left its ring."""
    while meta[CP_FIRST] < meta[CP_END]:
        oldest = checkpoints[int(meta[CP_FIRST]) & CP_MASK]
        enough = oldest[IMU_CURSOR] >= meta[IMU_FIRST] and oldest[FIX_CURSOR] >= meta[FIX_FIRST]
        if enough and oldest[WHEEL_CURSOR] >= meta[WHEEL_FIRST]:
            break
        meta[CP_FIRST] += 1.0


@_inline
def _plausible(meta, prm, t):
    """Whether a stamp may be true. One of the far future would make everything after it too late; two are a pause."""
    if not t > meta[HORIZON] + FAR_AHEAD or meta[HORIZON] == -math.inf or abs(t - meta[AHEAD]) <= prm[BUFFER]:
        return True
    meta[AHEAD] = t
    return False


@_inline
def _insert_row(s, prm, ring, checkpoints, meta, reading, imu):
    """Put a reading of the IMU, or of the wheels, in its place in the ring, and rewind the state if need be.

    `imu`: whose ring it is. -> how many are kept of it: 1, or 0.
    """
    t = reading[0]
    counters = IMU_FIRST if imu else WHEEL_FIRST
    if not _plausible(meta, prm, t):
        meta[IMU_LATE if imu else WHEEL_LATE] += 1.0
        return 0
    width, mask = ring.shape[1], ring.shape[0] - 1
    first, end = int(meta[counters]), int(meta[counters + 1])
    place = end
    while place > first and ring[(place - 1) & mask, 0] > t:
        place -= 1
    replaces = False
    if place > first and ring[(place - 1) & mask, 0] == t:
        # The same stamp twice: one is kept, and which one must not depend on the order of arrival.
        meta[IMU_DUPLICATES if imu else WHEEL_DUPLICATES] += 1.0
        for i in range(1, width):
            a, b = reading[i], ring[(place - 1) & mask, i]
            if a != b and not (math.isnan(a) and math.isnan(b)):
                replaces = a < b or math.isnan(b)
                break
        if not replaces:
            return 0
    in_order = _precedes_sample(s, t, prm[IMU_GAP]) if imu else s[T] < t
    if (replaces or place < end or not in_order) and not _rewind(s, prm, checkpoints, meta, t, -1.0 if imu else -2.0):
        meta[IMU_LATE if imu else WHEEL_LATE] += 1.0
        return 0
    if replaces:
        place -= 1
    else:
        for k in range(end, place, -1):
            for i in range(width):
                ring[k & mask, i] = ring[(k - 1) & mask, i]
        end += 1
    for i in range(width):
        ring[place & mask, i] = reading[i]
    meta[counters + 1] = end
    meta[HORIZON] = max(meta[HORIZON], t)
    if end - first == mask + 1:
        meta[counters] = first + 1
        _drop_orphans(checkpoints, meta)
    return 1


@_jit
def _insert_fix(s, prm, fixes, checkpoints, meta, fix):
    """Put a fix in its place, by stamp, then by content, and rewind if need be. -> PENDING, TOO_LATE or DUPLICATE."""
    if not _plausible(meta, prm, fix[F_T]):
        return TOO_LATE
    first, end = int(meta[FIX_FIRST]), int(meta[FIX_END])
    place = end
    while place > first:
        before = fixes[(place - 1) & FIX_MASK]
        order = 0
        for i in range(F_OUTCOME):
            if i != F_ARRIVAL and before[i] != fix[i]:
                order = -1 if before[i] < fix[i] else 1
                break
        if order == 0:
            return DUPLICATE
        if order < 0:
            break
        place -= 1
    number = float(place)
    if not _precedes_fix(s, fix[F_T], number) and not _rewind(s, prm, checkpoints, meta, fix[F_T], number):
        return TOO_LATE
    for k in range(end, place, -1):
        _fill(fixes[k & FIX_MASK], fixes[(k - 1) & FIX_MASK])
    _fill(fixes[place & FIX_MASK], fix)
    meta[FIX_END] = end + 1
    meta[HORIZON] = max(meta[HORIZON], fix[F_T])
    if end + 1 - first == FIX_CAPACITY:
        meta[FIX_FIRST] = first + 1
        _drop_orphans(checkpoints, meta)
    return PENDING


@_jit
def _write_pose(s, out):
    """A whole pose, see the P_ constants. Covariances are turned from body into world axes."""
    B = np.empty((3, 3))
    _matrix(s, B)
    out[P_T] = s[T]
    for i in range(3):
        out[P_POS + i] = s[POS + i]
        out[P_VEL + i] = s[V + i]
        out[P_RATE + i] = 0.0 if s[BRIDGING] > 0.0 else s[U + i] - s[BG + i]
    for i in range(4):
        out[P_QUAT + i] = s[Q + i]
    # position, attitude, velocity of the filter's P
    for i in range(9):
        for j in range(9):
            if (i < 6) != (j < 6):
                continue
            a = DV if i >= 6 else (DP if i < 3 else TH)
            b = DV if j >= 6 else (DP if j < 3 else TH)
            total = 0.0
            for m in range(3):
                for n in range(3):
                    total += B[i % 3, m] * s[COV + N * (a + m) + b + n] * B[j % 3, n]
            if i < 6:
                # No number of fixes averages away what all have in common.
                out[P_COV + 6 * i + j] = total + s[SYSTEMATIC + 6 * i + j]
            else:
                out[P_VCOV + 3 * (i - 6) + j - 6] = total
    out[P_T_ACCEPTED] = s[T_ACCEPTED]
    out[P_RESET_ID] = s[RESET_ID]
    out[P_T_IMU] = s[T_IMU]


# -------------------------------------------------------------------------------------------------- smooth channel


@_jit
def _rotate(rotation, q):
    """q[:4] <- Exp(rotation[:3]) q[:4]."""
    x, y, z = rotation[0], rotation[1], rotation[2]
    angle = math.sqrt(x * x + y * y + z * z)
    w, h = math.cos(0.5 * angle), (0.5 if angle < 1e-9 else math.sin(0.5 * angle) / angle)
    x, y, z = h * x, h * y, h * z
    a, b, c, d = q[0], q[1], q[2], q[3]
    q[0] = w * a - x * b - y * c - z * d
    q[1] = w * b + x * a + y * d - z * c
    q[2] = w * c - x * d + y * a + z * b
    q[3] = w * d + x * c - y * b + z * a


@_jit
def _left(e, dt, speed):
    """What is left of half of E, e[:3], after dt s at no more than `speed`, as a factor.

    It shrinks at that speed until the exponential is slower: in one step or in many, the same.
    """
    size = _length(e)
    if dt <= 0.0 or size == 0.0:
        return 1.0
    knee = min(speed * SMOOTH_TIME, size)
    straight = (size - knee) / speed
    if dt <= straight:
        return 1.0 - speed * dt / size
    return knee / size * math.exp((straight - dt) / SMOOTH_TIME)


@_jit
def _move(position, quaternion, ch, dt):
    """Move a pose of the filter by what is left of E after dt s."""
    shift, turn = _left(ch[E:], dt, SMOOTH_SPEED), _left(ch[E + 3 :], dt, SMOOTH_RATE)
    rotation = np.empty(3)
    for i in range(3):
        position[i] += shift * ch[E + i]
        rotation[i] = turn * ch[E + 3 + i]
    _rotate(rotation, quaternion)


@_jit
def _ahead(dt, age, gap):
    """s: for so long at its speed of now does the robot get as far as in dt s, its last IMU sample `age` old."""
    fresh = min(max(gap - age, 0.0), dt)
    return fresh + COAST_TIME * (1.0 - math.exp((fresh - dt) / COAST_TIME))


@_jit
def _absorb(s, prm, ch, plain):
    """Set E such that the smooth pose does not move by what an input has done to the filter's.

    `plain`: by updates alone, in passing, not by a fix or by having done the past again.
    """
    # Where both would have been at the latest instant that is known outside.
    at = s[T] if plain else min(max(ch[E_PUBLISHED], s[T]), s[T] + SMOOTH_REACH)
    if at > ch[E_T]:
        shift = _left(ch[E:], at - ch[E_T], SMOOTH_SPEED)
        rotation = _left(ch[E + 3 :], at - ch[E_T], SMOOTH_RATE)
        for i in range(3):
            ch[E + i] *= shift
            ch[E + 3 + i] *= rotation
        ch[E_T] = at
    if plain:
        # only pseudo-measurements, and the motion itself, which is none of E's business
        for i in range(6):
            ch[E + i] -= s[CORRECTED + i] - ch[BEFORE_CORRECTED + i]
    else:
        old, new = np.empty(4), np.empty(4)
        turn = np.empty(3)
        for i in range(3):
            turn[i] = ch[BEFORE + 11 + i] * (at - ch[BEFORE])
        # Exp(world turn) q = q Exp(body turn): conjugate twice instead of a second function
        for i in range(4):
            old[i] = ch[BEFORE + 4 + i] if i == 0 else -ch[BEFORE + 4 + i]
            new[i] = s[Q + i] if i == 0 else -s[Q + i]
        for i in range(3):
            turn[i] = -turn[i]
        _rotate(turn, old)
        for i in range(3):
            turn[i] = 0.0 if s[BRIDGING] > 0.0 else -(s[U + i] - s[BG + i]) * (at - s[T])
        _rotate(turn, new)
        for i in range(3):
            old[1 + i] = -old[1 + i]
            e = ch[BEFORE + 1 + i] + ch[BEFORE + 8 + i] * _ahead(at - ch[BEFORE], ch[BEFORE] - s[T_IMU], prm[IMU_GAP])
            ch[E + i] += e - s[POS + i] - s[V + i] * _ahead(at - s[T], s[T] - s[T_IMU], prm[IMU_GAP])
        _rotate(ch[E + 3 :], old)
        # Exp(E') = Exp(E) old newᵀ; new stands conjugated already
        w = old[0] * new[0] - old[1] * new[1] - old[2] * new[2] - old[3] * new[3]
        x = old[0] * new[1] + old[1] * new[0] + old[2] * new[3] - old[3] * new[2]
        y = old[0] * new[2] - old[1] * new[3] + old[2] * new[0] + old[3] * new[1]
        z = old[0] * new[3] + old[1] * new[2] - old[2] * new[1] + old[3] * new[0]
        n = math.sqrt(x * x + y * y + z * z)
        factor = (2.0 if n < 1e-9 else 2.0 * math.atan2(n, abs(w)) / n) * (-1.0 if w < 0.0 else 1.0)
        ch[E + 3], ch[E + 4], ch[E + 5] = factor * x, factor * y, factor * z
    far = ch[E] ** 2 + ch[E + 1] ** 2 + ch[E + 2] ** 2 > SMOOTH_DISTANCE * SMOOTH_DISTANCE
    turned = ch[E + 3] ** 2 + ch[E + 4] ** 2 + ch[E + 5] ** 2 > SMOOTH_ANGLE * SMOOTH_ANGLE
    if far or turned or s[RESET_ID] != ch[E_RESET_ID]:
        ch[E_RESETS] += 1.0
        ch[E_RESET_ID] = s[RESET_ID]
        for i in range(6):
            ch[E_STEP + i] = -ch[E + i]
            ch[E + i] = 0.0


# ----------------------------------------------------------------------------------------------- called from Python

FEED_SAMPLES, FEED_FIX, FEED_WHEELS, POSE_AT = range(4)
BEST, SMOOTH = 0, 1


@_jit
def process(memory, task, channel, t, inputs, outputs):
    """The one entry into compiled code: each further one would cost seconds of compilation.

    `channel` of the poses given out: BEST or SMOOTH.
    FEED_SAMPLES: `inputs` (n, 7) are IMU samples; into `outputs` (n, 8), or (0, 8), goes the newest pose after each:
    its instant, which is the sample's stamp unless that came late, position, quaternion wxyz, NaN before the start.
    -> number of samples kept.
    FEED_WHEELS: `inputs` (n, 3) are readings of the wheels: t, forward speed, yaw rate. -> number of those kept.
    FEED_FIX: `inputs` (1, FIX). -> PENDING, TOO_LATE or DUPLICATE; how it was judged stands in its row of the ring.
    POSE_AT: `outputs` (1, POSE) is the pose at `t`, from all inputs so far. -> 0 before the start and the buffer.
    """
    a = META
    b = a + PARAMS
    c = b + STATE
    ch = carray(_pointer(memory + 8 * c), CHANNEL)
    c += CHANNEL
    d = c + IMU_CAPACITY * IMU_ROW
    g = d + FIX_CAPACITY * FIX
    e = g + WHEEL_CAPACITY * WHEEL_ROW
    meta, prm = carray(_pointer(memory), META), carray(_pointer(memory + 8 * a), PARAMS)
    state = carray(_pointer(memory + 8 * b), STATE)
    imu = carray(_pointer(memory + 8 * c), (IMU_CAPACITY, IMU_ROW))
    fixes = carray(_pointer(memory + 8 * d), (FIX_CAPACITY, FIX))
    wheels = carray(_pointer(memory + 8 * g), (WHEEL_CAPACITY, WHEEL_ROW))
    checkpoints = carray(_pointer(memory + 8 * e), (CP_CAPACITY, STATE))

    answer = 0
    s = state
    live = task != POSE_AT
    until = math.inf
    ahead = False
    if not live:
        until = t
        number = int(meta[CP_END]) - 1
        while number >= meta[CP_FIRST] and checkpoints[number & CP_MASK, T] > t:
            number -= 1
        # What is still to come waits for the IMU.
        ahead = t >= state[T]
        if ahead:
            s = state.copy()
        elif number >= meta[CP_FIRST]:
            # The rows of its fixes are written again, with the same figures.
            s = checkpoints[number & CP_MASK].copy()
        else:
            return 0
    for i in range(inputs.shape[0] if live else 1):
        started = state[INITIALISED] > 0.0
        rewinds, cursor = meta[REWINDS], state[FIX_CURSOR]
        if live and started:
            ch[BEFORE] = state[T]
            for j in range(3):
                ch[BEFORE + 1 + j] = state[POS + j]
                ch[BEFORE + 8 + j] = state[V + j]
                ch[BEFORE + 11 + j] = 0.0 if state[BRIDGING] > 0.0 else state[U + j] - state[BG + j]
            for j in range(4):
                ch[BEFORE + 4 + j] = state[Q + j]
            for j in range(6):
                ch[BEFORE_CORRECTED + j] = state[CORRECTED + j]
        if task == FEED_FIX:
            answer = _insert_fix(state, prm, fixes, checkpoints, meta, inputs[i])
        elif live:
            ring = imu if task == FEED_SAMPLES else wheels
            answer += _insert_row(state, prm, ring, checkpoints, meta, inputs[i], task == FEED_SAMPLES)
        fix_end, wheel_end = (0, 0) if ahead else (int(meta[FIX_END]), int(meta[WHEEL_END]))
        _advance(s, prm, imu, fixes, fix_end, wheels, wheel_end, checkpoints, meta, until, live)
        if live and started:
            plain = meta[REWINDS] == rewinds and state[FIX_CURSOR] == cursor
            moved = not plain
            for j in range(6):
                moved |= state[CORRECTED + j] != ch[BEFORE_CORRECTED + j]
            if moved:
                _absorb(state, prm, ch, plain)
        elif live:
            ch[E_T] = state[T]
        if task == FEED_SAMPLES and i < outputs.shape[0]:
            outputs[i, 0] = s[T]
            for j in range(3):
                outputs[i, 1 + j] = s[POS + j] if s[INITIALISED] > 0.0 else math.nan
            for j in range(4):
                outputs[i, 4 + j] = s[Q + j] if s[INITIALISED] > 0.0 else math.nan
            if channel == SMOOTH:
                _move(outputs[i, 1:], outputs[i, 4:], ch, s[T] - ch[E_T])
    if live:
        return answer
    if not s[INITIALISED] > 0.0:
        return 0
    out = outputs[0]
    _settle(s, prm)
    _write_pose(s, out)
    if channel == SMOOTH:
        out[P_RESET_ID] = ch[E_RESETS]
        for i in range(6):
            out[P_STEP + i] = ch[E_STEP + i]
        if t >= state[T]:
            ch[E_PUBLISHED] = max(ch[E_PUBLISHED], t)
            _move(out[P_POS:], out[P_QUAT:], ch, t - ch[E_T])
            # E is known, and not the filter's error: what is left of it adds to the second moment.
            left = np.empty(6)
            for i in range(3):
                left[i] = out[P_POS + i] - s[POS + i]
                left[3 + i] = _left(ch[E + 3 :], t - ch[E_T], SMOOTH_RATE) * ch[E + 3 + i]
            for i in range(6):
                for j in range(6):
                    out[P_COV + 6 * i + j] += left[i] * left[j]
    return 1


_VECTOR, _MATRIX = types.float64[::1], types.float64[:, ::1]


def compile_taking() -> None:
    """Compile what takes fixes and readings of the wheels: half of the work.

    Where these signatures are not those that `process` calls with, that is so much work for nothing, and no more.
    """
    _take.compile((_VECTOR, _VECTOR, _MATRIX, _MATRIX, types.int64))


def compile_moving() -> None:
    """Compile most of the other half: two processes can share the work, since both write to numba's cache."""
    _run_to.compile((_VECTOR, _VECTOR, _MATRIX, types.int64, _MATRIX, types.int64, types.float64))
    _next_sample.compile((_VECTOR, _VECTOR, _MATRIX, types.int64))
    _watch.compile((_VECTOR, _VECTOR, _MATRIX, _VECTOR, types.int64))
    _absorb.compile((_VECTOR, _VECTOR, _VECTOR, types.boolean))
    _insert_fix.compile((_VECTOR, _VECTOR, _MATRIX, _MATRIX, _VECTOR, _VECTOR))
    _write_pose.compile((_VECTOR, _VECTOR))
    _move.compile((_VECTOR, _VECTOR, _VECTOR, types.float64))
    _grid.compile((_VECTOR, _VECTOR))


def views(memory: Array) -> tuple[Array, Array, Array, Array, Array, Array, Array]:
    """Meta, parameters, state, smooth channel, IMU ring, fix ring and checkpoint ring of one robot's memory."""
    wheels = WHEEL_CAPACITY * WHEEL_ROW
    sizes = (META, PARAMS, STATE, CHANNEL, IMU_CAPACITY * IMU_ROW, FIX_CAPACITY * FIX, wheels, CP_CAPACITY * STATE)
    meta, prm, state, channel, imu, fixes, _, checkpoints = np.split(memory, np.cumsum(sizes)[:-1])
    return (
        meta,
        prm,
        state,
        channel,
        imu.reshape(IMU_CAPACITY, IMU_ROW),
        fixes.reshape(FIX_CAPACITY, FIX),
        checkpoints.reshape(CP_CAPACITY, STATE),
    )


def new_memory(parameters: Array) -> Array:
    """The memory of a robot that nothing is known of: empty rings, a blank state, and a checkpoint of it."""
    rings = IMU_CAPACITY * IMU_ROW + FIX_CAPACITY * FIX + WHEEL_CAPACITY * WHEEL_ROW + CP_CAPACITY * STATE
    memory = np.zeros(META + PARAMS + STATE + CHANNEL + rings)
    meta, prm, state, channel, _, _, checkpoints = views(memory)
    prm[:] = parameters
    meta[AHEAD] = meta[HORIZON] = state[T] = state[T_IMU] = state[T_ACCEPTED] = state[T_WHEEL] = -math.inf
    channel[E_PUBLISHED] = -math.inf
    state[STILL_SINCE] = math.inf
    state[STILL_BARRED] = state[T_ADAPTED] = state[GRID_AT] = -math.inf
    state[SCALE : SCALE + 4] = state[CONSTRAINT_NIS : CONSTRAINT_NIS + 4] = 1.0
    state[USUAL_SPEED2] = prm[USUAL_SPEED] ** 2
    checkpoints[0] = state
    meta[CP_END] = 1.0
    return memory
