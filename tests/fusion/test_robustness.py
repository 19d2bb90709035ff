"""When the settings, the sensors or the fixes are not what the filter was told: it stays of use.

The measure is the causal position RMSE, often against that of holding the last fix. Figures in comments were measured
when the test was written.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fusion.consistency import nees, rms
from fusion.measurements import Array, Outcome, PoseFix, PoseHypothesis
from fusion.params import GRAVITY, FilterParams, Motion
from fusion.simulator import (
    CameraParams,
    ImuParams,
    Simulation,
    Trajectory,
    TriadParams,
    aggressive,
    random_ground,
    simulate,
)
from fusion.tuning import scale_fix_noise
from tests.fusion.simulated import Drive, drive, held_mm

SETTLED = 15.0  # s
GYRO, ACCEL, FIX = (0.05, 1.0, 30.0), (0.05, 1.0, 30.0), (0.1, 1.0, 10.0)
CORNERS = list(itertools.product(GYRO[::2], ACCEL[::2], FIX[::2]))


def course(motion: Motion, seed: int) -> Trajectory:
    return aggressive(seed) if motion == "free" else random_ground(seed)


def judged(mm: list[float]) -> float:
    """One figure for several drives."""
    return rms(np.array(mm))


def each_pose(simulation: Simulation, change: Callable[[PoseHypothesis], PoseHypothesis]) -> Simulation:
    fixes = [replace(fix, hypotheses=tuple(map(change, fix.hypotheses))) for fix in simulation.fixes]
    return replace(simulation, fixes=fixes)


# --- Noise settings


def share_of_held(
    simulation: Simulation, motion: Motion, gyro: float, accel: float, fix: float, **more: float
) -> float:
    """RMSE once settled, over that of holding the last fix, with the sigmas that the filter is told multiplied."""
    default = FilterParams()
    params = FilterParams(gyro_noise=gyro * default.gyro_noise, accel_noise=accel * default.accel_noise)
    told = replace(simulation, fixes=scale_fix_noise(simulation.fixes, fix))
    return drive(told, params, motion).mm(SETTLED) / held_mm(simulation, SETTLED)


@pytest.fixture(scope="module")
def ground_drive() -> Simulation:
    return simulate(random_ground(0), 0, 45.0)


@pytest.mark.parametrize(("gyro", "accel", "fix"), CORNERS)
def test_wrong_noise_settings_do_not_lock_it_out(ground_drive, gyro, accel, fix):
    # worst: 0.29, IMU noise told 20 times too small and fix noise 10 times too large
    assert share_of_held(ground_drive, "ground", gyro, accel, fix) < 0.5


@pytest.mark.long
@pytest.mark.parametrize("motion", ["free", "ground", "differential"])
def test_wrong_noise_settings_on_many_drives(motion, capsys):
    shares = {}
    for seed in range(6):
        simulation = simulate(course(motion, seed), seed, 45.0)
        for setting in itertools.product(GYRO, ACCEL, FIX):
            shares[seed, *setting] = share_of_held(simulation, motion, *setting)
    worse = {key: round(share, 2) for key, share in shares.items() if share >= 1.0}
    with capsys.disabled():
        print(f"\n{motion}: RMSE over that of holding the last fix, median {np.median(list(shares.values())):.2f},")
        print(f"  not below 1 in {len(worse)} of {len(shares)} (seed, gyro, accel, fix): {worse}")
    # Not met everywhere: free 2 of 162 (worst 3.64), both with all noise told 10 to 20 times too small.
    assert len(worse) <= (2 if motion == "free" else 0)
    assert max(shares.values()) < 4.0


def test_departure_is_noticed_although_the_gyro_noise_is_overstated():
    """The robot leaves straight on at 15 s: what pushes it is felt before the gyroscope says anything."""
    simulation = simulate(random_ground(1), 1, 20.0)
    outcomes = drive(simulation, FilterParams(gyro_noise=0.03)).outcomes
    assert Outcome.REJECTED not in {outcome.outcome for outcome in outcomes}


# --- Fixes


def test_flips_do_no_harm_when_both_poses_are_given():
    # 0.4 of the fixes; ground 1.01, whether the first one is among them or not
    plain, flipped = (
        judged([drive(simulate(random_ground(s), s, 45.0, camera=camera)).mm(10.0) for s in range(6)])
        for camera in (CameraParams(two_poses=True), CameraParams(two_poses=True, flip=0.4))
    )
    assert flipped < 1.1 * plain


def test_a_flipped_first_fix_is_seen_by_gravity():
    """The less likely pose has 13 more in misfit, and is upright; the other leans by 57 degrees."""
    simulation = simulate(random_ground(3), 3, 60.0, camera=CameraParams(two_poses=True, flip=0.4))
    assert drive(simulation).mm() < held_mm(simulation)


def test_of_two_first_poses_the_one_that_takes_over_is_as_if_it_had_been_alone():
    """Before the first fix there is no IMU to tell them apart, and the wrong one has less misfit."""
    simulation = simulate(aggressive(1), 1, 3.0, camera=CameraParams(two_poses=True))
    first, second = sorted(simulation.fixes, key=lambda fix: fix.t)[:2]
    between = (simulation.samples[:, 0] > first.t) & (simulation.samples[:, 0] < second.t + 0.01)
    simulation = replace(simulation, samples=simulation.samples[between], arrival=simulation.arrival[between])
    right, wrong = first.hypotheses
    right = replace(right, misfit=wrong.misfit + 1.0)
    # neither learns from what the other one had wrong
    params = FilterParams(adaptation=0.0, still_speed=0.0)
    alone, taken_over = (
        drive(replace(simulation, fixes=[replace(first, hypotheses=poses), second]), params, "free").localiser.latest
        for poses in ((right,), (wrong, right))
    )
    assert alone is not None
    assert taken_over is not None
    np.testing.assert_allclose(taken_over.position, alone.position, atol=1e-4)
    np.testing.assert_allclose(taken_over.covariance, alone.covariance, rtol=0.01, atol=1e-8)


@pytest.mark.parametrize("late", [-0.05, 0.05])
def test_the_start_knows_what_an_unknown_offset_of_the_stamps_does_to_it(late):
    """Found at 1.6 m/s and 1 rad/s, with stamps that are wrong by one sigma; nothing else is."""
    t = np.arange(0.0, 4.0, 0.005)
    zero = np.zeros_like(t)
    shaken = 1e-3 * np.random.default_rng(1).standard_normal((len(t), 6))  # no sensor repeats itself
    samples = np.column_stack([t, shaken + [0.0, 0.0, 1.0, 0.0, 0.0, GRAVITY]])
    truth = np.column_stack([t, 1.6 * t, zero, zero, np.cos(0.5 * t), zero, zero, np.sin(0.5 * t)])
    covariance = np.diag([0.005**2] * 3 + [0.0175**2] * 3)
    fixes = [
        PoseFix("robot", row[0] + late, row[0] + 0.2, (PoseHypothesis(row[1:4], row[4:], covariance),))
        for row in truth[100::100]
    ]
    still = np.zeros((len(t), 3))
    run = drive(Simulation(samples, t, fixes, truth, still, still, still, np.empty((0, 3))), None, "free")
    assert len(run.errors) == 6
    assert nees(run.errors, run.covariances).max() < 6.0


@pytest.mark.parametrize("motion", ["free", "ground"])
def test_stamps_that_are_late_by_60_ms_cost_nothing_in_the_end(motion):
    late, known, offsets = [], [], []
    for seed in range(3):
        simulation = simulate(course(motion, seed), seed, 90.0, camera=CameraParams(stamp_error=0.06))
        run = drive(simulation, None, motion)
        late.append(run.mm(60.0))
        offsets.append(run.localiser.time_offset)
        right = replace(simulation, fixes=[replace(fix, t=fix.t - 0.06) for fix in simulation.fixes])
        known.append(drive(right, FilterParams(time_offset_sigma=0.0), motion).mm(60.0))
    assert judged(late) < 1.1 * judged(known)
    np.testing.assert_allclose(offsets, -0.06, atol=0.006)


@pytest.mark.parametrize("motion", ["free", "ground"])
def test_a_floor_tilted_by_a_degree_is_no_surprise(motion):
    level, tilted = (
        np.mean([drive(simulate(course(motion, s), s, 45.0, tilt=tilt), None, motion).anees for s in range(6)])
        for tilt in ((0.0, 0.0), (math.radians(1.0), 0.0))
    )
    assert 0.7 < tilted < 1.1
    assert tilted == pytest.approx(level, rel=0.05)


HEAVY: dict[str, Callable[[np.random.Generator], Array]] = {
    "student": lambda rng: 0.01 * rng.standard_t(2, 3),
    "near": lambda rng: (rng.uniform() < 0.15) * 0.05 * rng.standard_normal(3),
    "far": lambda rng: (rng.uniform() < 0.15) * 0.5 * rng.standard_normal(3),
}


@pytest.mark.parametrize("motion", ["free", "ground"])
@pytest.mark.parametrize(("tails", "times"), [("student", 4.5), ("near", 3.5), ("far", 1.6)])
def test_fixes_with_heavy_tails(motion, tails, times):
    """Added: Student's t with 2 degrees of freedom and 10 mm; in 15 % of the fixes 50 mm; in 15 % of them 0.5 m."""
    plain, heavy = [], []
    for seed in range(2):
        simulation = simulate(course(motion, seed), seed, 45.0, camera=CameraParams(rate=5.0))
        rng = np.random.default_rng(seed)
        off = each_pose(simulation, lambda pose, rng=rng: replace(pose, position=pose.position + HEAVY[tails](rng)))
        plain.append(drive(simulation, None, motion).mm(5.0))
        heavy.append(drive(off, None, motion).mm(5.0))
        assert heavy[-1] < 0.35 * held_mm(off, 5.0)
    assert judged(heavy) < times * judged(plain)


def position_and_yaw(pose: PoseHypothesis) -> PoseHypothesis:
    """Upright, and it says that it does not know."""
    yaw = Rotation.from_quat(pose.quaternion_wxyz, scalar_first=True).as_euler("ZYX")[0]
    covariance = pose.covariance.copy()
    covariance[3, 3] = covariance[4, 4] = 100.0
    return PoseHypothesis(pose.position, Rotation.from_euler("Z", yaw).as_quat(scalar_first=True), covariance)


def position_only(pose: PoseHypothesis) -> PoseHypothesis:
    covariance = pose.covariance.copy()
    covariance[3:, 3:] = 100.0 * np.eye(3)
    return PoseHypothesis(pose.position, np.array([1.0, 0.0, 0.0, 0.0]), covariance)


def believed(run: Drive) -> int:
    """One in a thousand is beyond the gate by chance, and taken with less weight."""
    return run.localiser.counts["accepted"] + run.localiser.counts["inflated"]


def some(
    simulation: Simulation, change: Callable[[PoseHypothesis], PoseHypothesis], first: int, end: int
) -> Simulation:
    changed = each_pose(simulation, change).fixes[first:end]
    return replace(simulation, fixes=[*simulation.fixes[:first], *changed, *simulation.fixes[end:]])


@pytest.mark.parametrize("motion", ["ground", "differential"])
def test_fixes_of_position_and_yaw_alone(motion):
    for seed in range(3):
        simulation = simulate(random_ground(seed), seed, 45.0)
        run = drive(each_pose(simulation, position_and_yaw), None, motion)
        assert believed(run) == len(simulation.fixes) - 1
        assert run.mm(SETTLED) < 1.2 * drive(simulation, None, motion).mm(SETTLED)
        assert run.deg(SETTLED) < 1.2


@pytest.mark.parametrize("motion", ["free", "ground", "differential"])
def test_fixes_of_position_alone_after_a_start_with_attitude(motion):
    for seed in range(3):
        simulation = simulate(course(motion, seed), seed, 45.0)
        run = drive(some(simulation, position_only, 5, 999), None, motion)
        assert believed(run) == len(simulation.fixes) - 1
        assert run.mm(SETTLED) < 1.5 * drive(simulation, None, motion).mm(SETTLED)
        assert run.deg(SETTLED) < 3.5


def test_fixes_of_position_alone_from_the_start():
    """On the floor the motion tells the heading."""
    for seed in range(5):
        simulation = simulate(random_ground(seed), seed, 60.0)
        run = drive(each_pose(simulation, position_only))
        assert believed(run) == len(simulation.fixes) - 1
        assert run.mm(SETTLED) < 30.0
        assert run.deg(40.0) < 3.5


def test_the_first_fix_knows_only_its_position_while_the_robot_moves():
    # seed 2 does not recover: 130 mm after 40 s
    for seed in (0, 1, 3, 4):
        simulation = simulate(random_ground(seed), seed, 60.0)
        moving = replace(simulation, fixes=[fix for fix in simulation.fixes if fix.t > 3.0])
        run = drive(some(moving, position_only, 0, 1))
        assert run.mm(40.0) < 1.2 * drive(moving).mm(40.0)
        assert run.deg(40.0) < 1.0


# --- IMU


def scaled(simulation: Simulation, axes: list[int], scale: float) -> Simulation:
    samples = simulation.samples.copy()
    samples[:, axes] *= scale
    return replace(simulation, samples=samples)


@pytest.mark.parametrize(
    ("motion", "axes", "scale"),
    [
        ("ground", [4], 1.5),
        ("ground", [4, 5], 1.5),
        ("ground", [4, 5, 6], 1.2),
        ("differential", [4], 1.5),
        ("differential", [4, 5, 6], 1.2),
    ],
)
def test_a_bad_accelerometer_is_better_than_none(motion, axes, scale):
    """Of 25 Hz; forward, level or all axes. On wheels with both level axes it is not, by 3 %: 55.6 mm against 53.9."""
    with_it, without, held = [], [], []
    for seed in range(6):
        simulation = scaled(simulate(random_ground(seed), seed, 60.0, ImuParams(rate=25.0)), axes, scale)
        with_it.append(drive(simulation, None, motion).mm(SETTLED))
        without.append(drive(simulation, FilterParams(accel_noise=1.0), motion).mm(SETTLED))
        held.append(held_mm(simulation, SETTLED))
    assert judged(with_it) < judged(without)
    assert judged(with_it) < 0.4 * judged(held)


def test_an_accelerometer_wrong_by_half_on_all_axes_is_better_than_holding_the_last_fix():
    """But not than none, yet: at 25 Hz 103 to 140 mm against 77 to 116 mm with accel_noise=1.0."""
    for seed in range(3):
        simulation = scaled(simulate(random_ground(seed), seed, 60.0, ImuParams(rate=25.0)), [4, 5, 6], 1.5)
        assert drive(simulation).mm(SETTLED) < 0.6 * held_mm(simulation, SETTLED)


@pytest.mark.parametrize(("motion", "within"), [("free", 2.0), ("ground", 0.4), ("differential", 0.4)])
def test_a_pause_of_the_imu_of_a_second(motion, within):
    """It comes while the robot moves; `within` m at worst, and all is well again after."""
    for seed in range(3):
        simulation = simulate(course(motion, seed), seed, 45.0)
        there = ~((simulation.samples[:, 0] > 20.0) & (simulation.samples[:, 0] < 21.0))
        paused = replace(simulation, samples=simulation.samples[there], arrival=simulation.arrival[there])
        run, plain = drive(paused, None, motion), drive(simulation, None, motion)
        assert run.error(SETTLED).position.max() < within
        assert run.localiser.latest.reset_id == 0
        assert run.mm(30.0) < 1.1 * plain.mm(30.0)


def weak_gyro(seed: int) -> Simulation:
    """It tells 1.3 rad/s at most, of up to 2.5."""
    gyro = TriadParams(noise=1e-3, bias_sigma=0.02, bias_walk=1e-4, limit=1.3)
    return simulate(random_ground(seed), seed, 60.0, ImuParams(gyro=gyro))


@pytest.mark.parametrize("motion", ["ground", "differential"])
def test_a_gyro_that_saturates_now_and_then(motion):
    """In 5 % of the samples."""
    for seed in (4, 5):
        simulation = weak_gyro(seed)
        run = drive(simulation, None, motion)
        assert run.mm(SETTLED) < 0.1 * held_mm(simulation, SETTLED)
        assert run.deg(SETTLED) < 2.5


def test_a_gyro_that_saturates_often():
    """In 11 % of the samples."""
    simulation = weak_gyro(2)
    assert drive(simulation).mm(SETTLED) < held_mm(simulation, SETTLED)
