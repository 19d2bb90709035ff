"""Every number of the filter that a configuration can set: unit, meaning, default, source. SI units and radians.

Densities are of continuous white noise: the variance of an integral over `dt` seconds is `density**2 * dt`.
"""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import Meta, Struct

Motion = Literal["free", "ground", "differential"]
Engine = Literal["numba", "filterpy"]
Channel = Literal["best", "smooth"]

Positive = Annotated[float, Meta(gt=0.0)]
NotNegative = Annotated[float, Meta(ge=0.0)]

# Standard gravity, m/s2 (CGPM 1901). Its local variation, 0.3 %, is absorbed by the accelerometer bias.
GRAVITY = 9.80665


class FilterParams(Struct, frozen=True, forbid_unknown_fields=True):
    """Noise, priors and gates of one robot's filter.

    The noise defaults are those of a consumer MEMS IMU mounted on a robot that shakes it: about ten times a
    datasheet. The gates are quantiles of the chi-square distribution.
    """

    gyro_noise: Positive = 1e-3
    """rad/s/sqrt(Hz): white noise of the angular rate."""
    accel_noise: Positive = 2e-2
    """m/s2/sqrt(Hz): white noise of the specific force."""
    gyro_bias_walk: NotNegative = 1e-4
    """rad/s2/sqrt(Hz): random walk of the gyroscope bias."""
    accel_bias_walk: NotNegative = 1e-3
    """m/s3/sqrt(Hz): random walk of the accelerometer bias."""

    gyro_bias_sigma: NotNegative = 0.02
    """rad/s: prior of the gyroscope bias at the first fix."""
    accel_bias_sigma: NotNegative = 0.2
    """m/s2: prior of the accelerometer bias at the first fix."""
    velocity_sigma: Positive = 2.0
    """m/s: prior of the velocity at the first fix. Wide, since a robot may be found at full speed, and with
    the second fix the prior matters no more."""
    time_offset_sigma: NotNegative = 0.05
    """s: prior of the camera's time offset, to be added to a fix's stamp; 0 holds it at 0."""
    tilt_sigma: NotNegative = 0.035
    """rad: prior of the angle between the world's z axis and the vertical, about x and y; 0 holds it at 0."""

    stamp_jitter: NotNegative = 0.0
    """s: random error of a fix's stamp, which adds (velocity * jitter)^2 to its covariance."""
    fix_position_sigma: Positive = 0.005
    """m: error of a fix that brings no covariance of its own, each axis."""
    fix_attitude_sigma: Positive = 0.0175
    """rad: the same of its rotation, about each axis."""

    gate: Positive = 22.46
    """chi-square .999 at 6 degrees of freedom: a fix whose d2 is below is accepted as it is."""
    gate_block: Positive = 16.27
    """chi-square .999 at 3 degrees of freedom: the same for position and for attitude alone."""
    gate_inflation: Annotated[float, Meta(ge=1.0)] = 3.0
    """up to this multiple of a gate a fix is accepted with its covariance inflated until it fits, beyond rejected."""
    hypothesis_margin: NotNegative = 4.0
    """score by which one pose of a flat marker must beat the other to be believed with its tilt."""

    reinit_count: Annotated[int, Meta(ge=2)] = 3
    """that many rejects in a row that agree with each other through the IMU set the pose anew, if their attitude also
    agrees with the gyro since the last accepted fix."""
    reinit_angle: Positive = 0.35
    """rad: twice as many do if it disagrees by less than this: then the noise is set too small, not the map wrong."""
    reinit_patience: Positive = 15.0
    """s: after that long they do even if it does not. Longer than a wrong map entry is in view (8-10 s measured)."""

    ground_velocity_sigma: Positive = 0.03
    """m/s: vertical speed of a robot on the floor, ten times a second."""
    ground_tilt_sigma: Positive = 0.4
    """rad: its roll and pitch, likewise. Wide, since it is the same error each time: with 0.05 a device that is held
    askew is forced upright (handheld_mocap replayed as "ground": 1.07 deg RMSE, 0.30 deg with this)."""
    wheel_velocity_sigma: Positive = 0.03
    """m/s: sideways speed of a robot on wheels, ten times a second."""
    wheel_speed_sigma: Positive = 0.03
    """m/s: forward speed by wheel odometry, as if it came ten times a second."""
    wheel_rate_sigma: Positive = 0.05
    """rad/s: its yaw rate, likewise."""
    wheel_scale_sigma: NotNegative = 0.05
    """prior of the error of scale of each, as a share; 0 holds it at 0."""
    usual_speed: Positive = 0.7
    """m/s: root mean square of the speed along an axis while the robot moves, before it is learnt. A speed that nothing
    measures any more decays by it."""
    still_speed: NotNegative = 0.1
    """m/s: largest estimated speed of a robot at rest; 0 switches the updates at rest off."""
    still_rate: NotNegative = 0.02
    """rad/s: largest mean rate of a robot at rest, beyond what its gyroscope bias may be."""
    fix_correlation: Annotated[float, Meta(ge=0.0, lt=1.0)] = 0.1
    """share of a fix's variance that repeats from fix to fix while the robot stands."""
    adaptation: NotNegative = 0.15
    """how fast the noise follows the innovations, per fix; 0 holds it."""
    no_imu_accel_noise: Positive = 1.0
    """m/s2/sqrt(Hz): how a robot without IMU data may change its velocity."""
    no_imu_rate_noise: Positive = 0.5
    """rad/s/sqrt(Hz): how it may turn."""

    buffer: Positive = 2.0
    """s: how late a measurement may come and still be put in its place."""
    imu_gap: Positive = 0.2
    """s: a longer pause of the IMU is bridged with constant velocity."""
    coast_after: Positive = 1.5
    """s without an accepted fix: mode COAST."""
    degraded_sigma: Positive = 0.05
    """m: largest position sigma up to which a coasting pose is still good to steer by."""
    invalid_sigma: Positive = 0.30
    """m: largest position sigma up to which it is good for anything."""
