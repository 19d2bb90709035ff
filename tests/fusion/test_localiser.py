"""Scenarios: what a robot may expect when things go wrong."""

from __future__ import annotations

import math

import numpy as np
import pytest

from fusion import kernels as k
from fusion import measurements as m
from fusion.geometry import exp_so3, quaternion_from_rotation, wrap
from fusion.localiser import Localiser
from fusion.measurements import ImuBatch, MeasurementError, Mode, Outcome, PoseFix, PoseHypothesis
from fusion.params import FilterParams
from tests.fusion import circle


class Drive:
    """A robot on its circle, a fix each half second, with noise."""

    def __init__(self, localiser, seed=0, rate=100.0):
        self.localiser = localiser
        self.rng = np.random.default_rng(seed)
        self.t = 0.0
        self.step = 1.0 / rate
        self.outcomes = []

    def imu(self, seconds):
        stamps = self.t + np.arange(round(seconds / self.step)) * self.step
        self.t = float(stamps[-1]) + self.step
        self.localiser.feed(circle.batch(stamps, self.rng))

    def on(self, seconds, offset=None, turned=0.0, carried=None):
        """`offset`, `turned`: of the fixes."""
        for _ in range(round(seconds / 0.5)):
            self.imu(0.5)
            self.outcomes += self.localiser.feed(circle.fix(self.t - 0.2, 0.2, self.rng, offset, turned))

    def error(self):
        return float(np.linalg.norm(self.localiser.latest.position - circle.pose(self.localiser.latest.t)[0]))


@pytest.fixture
def drive():
    return Drive(Localiser("rover"))


def test_it_converges(drive):
    drive.on(20.0)
    pose = drive.localiser.latest
    sigma = math.sqrt(np.trace(pose.covariance[:3, :3]))
    assert drive.error() < 3.0 * sigma
    assert sigma < 0.025
    assert pose.mode is Mode.FULL
    assert pose.reset_id == 0
    assert abs(pose.angular_velocity[2] - circle.TURN) < 0.05
    assert abs(np.linalg.norm(pose.velocity) - circle.SPEED) < 0.03
    assert {o.outcome for o in drive.outcomes} == {Outcome.INITIALISED, Outcome.ACCEPTED}


def test_nothing_before_the_first_fix(drive):
    drive.imu(1.0)
    assert not drive.localiser.started
    assert drive.localiser.latest is None
    assert drive.localiser.pose_at(0.5) is None


def test_a_single_outlier_is_refused_and_does_no_harm(drive):
    drive.on(10.0)
    drive.on(0.5, offset=np.array([0.3, 0.0, 0.0]))
    assert drive.outcomes[-1].outcome is Outcome.REJECTED
    assert drive.outcomes[-1].d2 > 22.46
    assert drive.error() < 3.0 * math.sqrt(np.trace(drive.localiser.latest.covariance[:3, :3]))
    drive.on(2.0)
    assert drive.error() < 0.03
    assert drive.localiser.latest.reset_id == 0


def test_a_kidnapped_robot_is_found_again_by_its_third_fix(drive):
    drive.on(10.0)
    away = np.array([2.0, -1.0, 0.0])
    bias = drive.localiser.gyro_bias
    drive.on(1.5, offset=away)
    assert [o.outcome for o in drive.outcomes[-3:]] == [Outcome.REJECTED, Outcome.REJECTED, Outcome.REINITIALISED]
    assert drive.localiser.latest.reset_id == 1
    np.testing.assert_allclose(drive.localiser.gyro_bias, bias, atol=0.005)
    drive.on(5.0, offset=away)
    position = drive.localiser.latest.position - away
    assert np.linalg.norm(position - circle.pose(drive.localiser.latest.t)[0]) < 0.02
    assert drive.localiser.latest.reset_id == 1


def test_a_marker_turned_in_the_map_for_eight_seconds_is_not_believed(drive):
    drive.on(10.0)
    drive.on(8.0, turned=math.pi)
    # its place is, its attitude is not
    assert {o.outcome for o in drive.outcomes[-16:]} == {Outcome.INFLATED}
    assert drive.localiser.latest.reset_id == 0
    assert drive.error() < 0.03


def test_what_stays_turned_is_believed_in_the_end(drive):
    drive.on(10.0)
    drive.on(30.0, turned=math.pi)
    pose = drive.localiser.latest
    assert pose.reset_id >= 1
    assert abs(wrap(pose.yaw - circle.TURN * pose.t - math.pi)) < 0.1
    assert drive.error() < 0.3


def test_a_wrong_first_fix_is_left_at_once():
    drive = Drive(Localiser("rover"))
    drive.on(0.5, offset=np.array([1.0, 1.0, 0.0]), turned=math.pi)
    drive.on(2.0)
    assert drive.localiser.latest.reset_id == 1
    assert drive.error() < 0.05


@pytest.mark.parametrize("i", range(64))
def test_a_bad_start_in_64_directions_is_recovered(i):
    """The first fix is turned by 60 degrees about any axis and off by a metre."""
    golden = math.pi * (3.0 - math.sqrt(5.0))
    z = 1.0 - 2.0 * (i + 0.5) / 64.0
    axis = np.array([math.cos(golden * i) * math.sqrt(1 - z * z), math.sin(golden * i) * math.sqrt(1 - z * z), z])
    drive = Drive(Localiser("rover", motion="free"), seed=i, rate=50.0)
    drive.imu(0.5)
    position, rotation = circle.pose(0.3)
    wrong = PoseHypothesis(
        position + axis, quaternion_from_rotation(exp_so3(axis * math.radians(60)) @ rotation), circle.COVARIANCE
    )
    drive.localiser.feed(PoseFix("rover", 0.3, 0.5, (wrong,)))
    drive.on(8.0)
    assert drive.error() < 0.05


def test_modes_while_the_camera_and_the_imu_go():
    drive = Drive(Localiser("rover", FilterParams(degraded_sigma=0.15, invalid_sigma=0.5)))
    localiser = drive.localiser
    drive.on(10.0)
    assert localiser.latest.mode is Mode.FULL
    modes = []
    for _ in range(60):
        drive.imu(0.5)
        modes.append(localiser.latest.mode)
    order = [Mode.FULL, Mode.COAST, Mode.DEGRADED, Mode.INVALID]
    assert sorted(set(modes), key=order.index) == order
    assert modes == sorted(modes, key=order.index)
    assert localiser.pose_at(drive.t + 0.5).mode is Mode.LOST
    drive.on(1.5)
    assert localiser.latest.mode is Mode.FULL
    localiser.feed(circle.fix(drive.t + 0.4))
    assert localiser.pose_at(drive.t + 0.6).mode is Mode.NO_IMU


def test_uncertainty_grows_while_coasting_and_covers_the_error(drive):
    drive.on(10.0)
    sigmas = []
    for _ in range(10):
        drive.imu(0.5)
        sigmas.append(math.sqrt(np.trace(drive.localiser.latest.covariance[:3, :3])))
    assert sigmas == sorted(sigmas)
    assert drive.error() < 3.0 * sigmas[-1]


def test_the_flip_of_a_flat_marker_is_seen_through(drive):
    drive.on(5.0)
    wrong = 0
    for i in range(40):
        drive.imu(0.5)
        t = drive.t - 0.2
        right = circle.hypothesis(t, drive.rng)
        position, rotation = circle.pose(t)
        tilted = quaternion_from_rotation(rotation @ exp_so3([0.35, 0.0, 0.0]))
        flipped = PoseHypothesis(position, tilted, circle.COVARIANCE)
        hypotheses = (flipped, right) if i % 5 < 2 else (right, flipped)
        for outcome in drive.localiser.feed(PoseFix("rover", t, drive.t, hypotheses)):
            assert outcome.outcome in (Outcome.ACCEPTED, Outcome.INFLATED)
            wrong += outcome.hypothesis != (1 if i % 5 < 2 else 0)
    assert wrong == 0
    assert drive.error() < 0.02


def test_extrapolation_is_smooth_and_short(drive):
    drive.on(10.0)
    now = drive.localiser.latest.t
    a, b = drive.localiser.pose_at(now), drive.localiser.pose_at(now + 0.05)
    assert np.linalg.norm(b.position - a.position) == pytest.approx(0.05 * circle.SPEED, rel=0.1)
    assert b.mode is Mode.FULL
    assert np.trace(b.covariance) > np.trace(a.covariance)


def test_counts_add_up(drive):
    drive.on(5.0)
    drive.on(0.5, offset=np.array([0.3, 0.0, 0.0]))
    counts = drive.localiser.counts
    assert counts["initialised"] + counts["accepted"] + counts["rejected"] == 11
    assert counts["imu_samples"] == 550


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"samples": np.zeros((3, 6))}, r"\(n, 7\)"),
        ({"samples": np.full((2, 7), np.nan)}, "sample 0 is not finite"),
    ],
)
def test_imu_batches_that_cannot_be(change, says):
    with pytest.raises(MeasurementError, match=says):
        ImuBatch(**({"robot": "rover", "arrival": 0.0, "samples": np.zeros((1, 7))} | change))


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (([0, 0], [1, 0, 0, 0], np.eye(6)), "shapes"),
        (([0, 0, math.nan], [1, 0, 0, 0], np.eye(6)), "not finite"),
        (([0, 0, 0], [1, 1, 0, 0], np.eye(6)), "norm 1.41421"),
        (([0, 0, 0], [1, 0, 0, 0], np.zeros((6, 6))), "not positive"),
        (([0, 0, 0], [1, 0, 0, 0], np.ones((6, 6)) - 0.5 * np.eye(6)), "not positive definite"),
    ],
)
def test_poses_that_cannot_be(arguments, says):
    with pytest.raises(MeasurementError, match=says):
        PoseHypothesis(*arguments)


def test_fixes_that_cannot_be():
    with pytest.raises(MeasurementError, match="0 hypotheses"):
        PoseFix("rover", 0.0, 0.0, ())
    with pytest.raises(MeasurementError, match="finite"):
        PoseFix("rover", math.inf, 0.0, (circle.hypothesis(0.0),))


def test_parameters_reach_the_filter():
    strict = Drive(Localiser("rover", FilterParams(gate=1e-6, gate_block=1e-6, gate_inflation=1.0)))
    strict.on(3.0)
    assert strict.outcomes[1].outcome is Outcome.REJECTED


def test_the_smooth_channel_does_not_jump():
    """Between samples it moves as the robot does, within the promised speed; the best one jumps with each fix."""
    worst = {}
    for channel in ("best", "smooth"):
        rng = np.random.default_rng(3)
        localiser = Localiser("rover")
        tracks = []
        for i in range(40):
            stamps = 0.5 * i + np.arange(50) * 0.01
            tracks.append(np.empty((50, 8)))
            localiser.feed_samples(circle.imu(stamps, rng), tracks[-1], channel)
            localiser.feed(circle.fix(stamps[-1] - 0.2, 0.2, rng))
        track = np.concatenate(tracks)[300:]
        true = np.array([circle.pose(t)[0] for t in track[:, 0]])
        worst[channel] = np.linalg.norm(np.diff(track[:, 1:4] - true, axis=0), axis=1).max()
    # 0.3 m/s for 10 ms, and the filter's own error of the speed
    assert worst["smooth"] < 0.003 + 0.1 * 0.01
    assert worst["best"] > 3.0 * worst["smooth"]


def test_the_smooth_channel_steps_when_it_must_and_says_so(drive):
    drive.on(10.0)
    away = np.array([2.0, -1.0, 0.0])
    before = drive.localiser.pose_at(drive.t, "smooth")
    drive.on(1.5, offset=away)
    after = drive.localiser.pose_at(drive.t, "smooth")
    assert after.reset_id == before.reset_id + 1
    np.testing.assert_allclose(after.reset_step[:3], away, atol=0.3)
    np.testing.assert_allclose(after.position, drive.localiser.latest.position, atol=0.05)


def test_the_smooth_channel_is_continuous_where_it_was_published(drive):
    """A pose is asked for 50 ms ahead of the IMU; then a fix comes, which moves the best one."""
    drive.on(3.0)
    worst = {"best": 0.0, "smooth": 0.0}
    for _ in range(20):
        drive.imu(0.3)
        now = drive.t + 0.05
        before = {channel: drive.localiser.pose_at(now, channel) for channel in worst}
        drive.localiser.feed(circle.fix(drive.t - 0.2, 0.25, drive.rng))
        for channel, pose in before.items():
            step = np.linalg.norm(drive.localiser.pose_at(now, channel).position - pose.position)
            worst[channel] = max(worst[channel], step)
    assert worst["smooth"] < 0.001
    assert worst["best"] > 0.005


def test_the_numbers_of_a_pose_stand_where_the_kernels_put_them():
    """Two places say it: numba's cache would not notice if the kernels took it from the other."""
    slices = {
        k.P_POS: m.POSITION, k.P_QUAT: m.QUATERNION, k.P_VEL: m.VELOCITY, k.P_RATE: m.ANGULAR_VELOCITY,
        k.P_COV: m.COVARIANCE, k.P_VCOV: m.VELOCITY_COVARIANCE, k.P_STEP: m.RESET_STEP,
    }  # fmt: skip
    assert list(slices) == [part.start for part in slices.values()]
    assert (k.P_T, k.P_T_ACCEPTED, k.POSE) == (m.INSTANT, m.LAST_FIX, m.POSE_NUMBERS)
