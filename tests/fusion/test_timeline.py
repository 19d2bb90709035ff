"""The state is a function of the set of inputs: order of arrival, batches and repetitions do not matter."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest

from fusion import kernels as k
from fusion.localiser import Localiser
from fusion.measurements import ImuBatch, Outcome, WheelOdometry
from fusion.params import FilterParams
from fusion.simulator import CameraParams, ImuParams, WheelParams, random_ground, simulate
from tests.fusion import circle

PARAMS = FilterParams(time_offset_sigma=0.05, tilt_sigma=0.03)
AUX = [i for i in range(k.AUX, k.STATE) if not k.NEXT_T <= i <= k.BRIDGING]


def final_state(measurements, motion="ground"):
    localiser = Localiser("rover", PARAMS, motion)
    for measurement in measurements:
        localiser.feed(measurement)
    state = localiser._timeline.state
    end = k.AUX if state[k.SHADOW_COUNT] else k.SHADOW
    return np.concatenate([state[:end], state[AUX]]), localiser


def second(seed, offset_from=99):
    """Inputs of 1.5 s: single IMU samples and fixes, one of them an outlier."""
    rng = np.random.default_rng(seed)
    samples = circle.imu(np.arange(0.0, 1.5, 0.02), rng)
    batches = [ImuBatch("rover", 0.0, row[np.newaxis]) for row in samples]
    fixes = [
        circle.fix(at, rng=rng, offset=np.array([0.5, 0.0, 0.0]) if i in (3, offset_from) else None)
        for i, at in enumerate(np.arange(0.05, 1.45, 0.1))
    ]
    return [*batches, *fixes], rng


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("motion", ["free", "ground", "differential"])
def test_any_order_of_arrival_gives_the_same_bits(seed, motion):
    measurements, rng = second(seed)
    expected, localiser = final_state(measurements, motion)
    assert localiser.counts["rejected"] == 1
    for _ in range(5):
        order = rng.permutation(len(measurements))
        state, _ = final_state([measurements[i] for i in order], motion)
        np.testing.assert_array_equal(state, expected)


def troubled(seed):
    """Inputs of 1.9 s one by one: an IMU that is stuck, has a spike, a pause and ends early; wheels all the while."""
    rng = np.random.default_rng(seed)
    samples = circle.imu(np.arange(0.0, 1.5, 0.02), rng)
    samples[15:28, 1:] = samples[15, 1:]
    samples[35, 4:] += 80.0
    samples = samples[(samples[:, 0] < 0.9) | (samples[:, 0] > 1.2)]
    readings = np.column_stack([np.arange(0.01, 1.9, 0.05), *rng.normal([[0.5], [0.4]], 0.01, (2, 38))])
    readings[7, 1], readings[11, 2] = np.nan, np.nan
    batches = [ImuBatch("rover", 0.0, row[np.newaxis]) for row in samples]
    wheels = [WheelOdometry("rover", 0.0, row[np.newaxis]) for row in readings]
    fixes = [circle.fix(at, rng=rng, turned=0.8 * (i == 9)) for i, at in enumerate(np.arange(0.055, 1.85, 0.12))]
    return [*batches, *wheels, *fixes], rng


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("motion", ["free", "ground", "differential"])
def test_any_order_gives_the_same_bits_when_the_imu_fails_and_wheels_go_on(seed, motion):
    measurements, rng = troubled(seed)
    expected, localiser = final_state(measurements, motion)
    assert localiser.counts["inflated"] >= 1
    assert localiser._timeline.state[k.T] > localiser._timeline.state[k.T_IMU] + 0.3
    for _ in range(5):
        order = rng.permutation(len(measurements))
        state, shuffled = final_state([measurements[i] for i in order], motion)
        np.testing.assert_array_equal(state, expected)
        assert shuffled.counts["imu_late"] == shuffled.counts["wheel_late"] == shuffled.counts["too_late"] == 0


@pytest.mark.parametrize("first", [[1.0, 0.5, np.nan], [1.0, np.nan, 0.4], [1.0, 0.6, 0.4], [1.0, np.nan, 0.3]])
@pytest.mark.parametrize("second", [[1.0, 0.5, 0.4], [1.0, 0.5, 0.3]])
def test_wheels_that_tell_two_things_of_one_instant_are_heard_once(first, second):
    states = []
    for readings in ([first, second], [second, first]):
        wheels = [WheelOdometry("rover", 0.0, np.array([reading])) for reading in readings]
        state, localiser = final_state([circle.batch(np.arange(0.0, 1.5, 0.02)), circle.fix(0.5), *wheels])
        assert localiser.counts["wheel_duplicates"] == 1
        states.append(state)
    np.testing.assert_array_equal(states[0], states[1])


def test_a_replay_gives_the_poses_of_the_live_run_to_the_last_bit():
    """Live: one by one, and poses asked for all the time. Replayed: in batches as long as nothing else comes."""
    course = replace(random_ground(5), go=4.0, period=6.0)
    wheels = WheelParams(rate=20.0, scale_sigma=0.05, slip_rate=0.5)
    drive = simulate(course, 5, 20.0, ImuParams(rate=100.0), CameraParams(rate=3.0), wheels=wheels)
    samples = drive.samples.copy()
    samples[600:640, 1:] = samples[600, 1:]  # stuck
    samples[800, 4:] += 80.0  # a spike
    samples = np.delete(samples, slice(1000, 1250), axis=0)
    arrivals = sorted(
        [(row[0] + 0.002, ImuBatch("rover", 0.0, row[np.newaxis])) for row in samples]
        + [(row[0] + 0.03, WheelOdometry("rover", 0.0, row[np.newaxis])) for row in drive.wheels]
        + [(fix.arrival, fix) for fix in drive.fixes],
        key=lambda pair: pair[0],
    )
    live, replayed = Localiser("rover", PARAMS, "differential"), Localiser("rover", PARAMS, "differential")
    lived, rows = [], []
    for arrival, measurement in arrivals:
        row = np.empty((1, 8))
        live.feed(measurement, row if isinstance(measurement, ImuBatch) else None)
        live.pose_at(arrival + 0.05, "smooth")
        live.pose_at(arrival - 0.4)
        lived += [row] if isinstance(measurement, ImuBatch) else []
    for kind, group in itertools.groupby((m for _, m in arrivals), type):
        measurements = list(group)
        if kind is ImuBatch:
            chunk = np.concatenate([measurement.samples for measurement in measurements])
            rows.append(np.empty((len(chunk), 8)))
            replayed.feed(ImuBatch("rover", 0.0, chunk), rows[-1])
        else:
            for measurement in measurements:
                replayed.feed(measurement)
    np.testing.assert_array_equal(np.concatenate(lived), np.concatenate(rows))
    assert live.counts == replayed.counts
    assert live.counts["rejected"] + live.counts["inflated"] < live.counts["accepted"]


def test_every_order_of_a_handful():
    """All 720 orders of three fixes and three batches, with a fix before all IMU data and one after them."""
    t = np.arange(0.1, 0.7, 0.02)
    batches = [circle.batch(part) for part in np.split(t, 3)]
    measurements = [*batches, circle.fix(0.05), circle.fix(0.31), circle.fix(0.683)]
    states = [final_state(order)[0] for order in itertools.permutations(measurements)]
    for state in states[1:]:
        np.testing.assert_array_equal(state, states[0])


def test_batches_are_only_packaging():
    rng = np.random.default_rng(7)
    samples = circle.imu(np.arange(0.0, 3.0, 0.005), rng)
    fixes = [circle.fix(at, rng=rng) for at in (0.1, 0.6, 1.1, 1.6, 2.1, 2.6)]
    states = []
    for size in (1, 7, 600):
        localiser = Localiser("rover", PARAMS)
        waiting = list(fixes)
        for i in range(0, len(samples), size):
            chunk = samples[i : i + size]
            localiser.feed(ImuBatch("rover", 0.0, chunk))
        for fix in waiting:
            localiser.feed(fix)
        states.append(localiser._timeline.state[: k.SHADOW].copy())
        assert (
            localiser.counts["accepted"] + localiser.counts["too_late"] == len(fixes) - localiser.counts["initialised"]
        )
    np.testing.assert_array_equal(states[0], states[1])
    np.testing.assert_array_equal(states[0], states[2])


def test_a_stamp_seen_twice_counts_once_whichever_comes_first():
    samples = circle.imu(np.arange(0.0, 1.0, 0.02), np.random.default_rng(8))
    other = samples[20].copy()
    other[1:] += 0.3
    first = [ImuBatch("rover", 0.0, samples), ImuBatch("rover", 0.0, other[np.newaxis]), circle.fix(0.2)]
    late = np.vstack([samples[:20], other, samples[21:]])
    second = [circle.fix(0.2), ImuBatch("rover", 0.0, late), ImuBatch("rover", 0.0, samples)]
    a, localiser = final_state(first)
    b, _ = final_state(second)
    np.testing.assert_array_equal(a, b)
    assert localiser.counts["imu_duplicates"] == 1
    assert localiser.counts["imu_samples"] == 51


def test_too_late_is_counted_and_said_and_changes_nothing():
    measurements = [circle.batch(np.arange(0.0, 5.0, 0.01)), circle.fix(4.0)]
    expected, localiser = final_state(measurements)
    outcome = localiser.feed(circle.fix(2.9))
    assert [o.outcome for o in outcome] == [Outcome.TOO_LATE]
    localiser.feed(circle.batch(np.array([2.905])))
    assert localiser.counts["too_late"] == 1
    assert localiser.counts["imu_late"] == 1
    np.testing.assert_array_equal(localiser._timeline.state[: k.SHADOW], expected[: k.SHADOW])


def test_a_first_fix_of_long_ago_is_too_late():
    """As of frames that have waited for the compiler."""
    localiser = Localiser("rover", PARAMS)
    old = replace(circle.fix(0.0), arrival=PARAMS.buffer + 0.1)
    assert [o.outcome for o in localiser.feed(old)] == [Outcome.TOO_LATE]
    assert not localiser.started
    localiser.feed(replace(circle.fix(0.2), arrival=PARAMS.buffer + 0.1))
    assert localiser.started


def test_the_same_fix_twice():
    _, localiser = final_state([circle.batch(np.arange(0.0, 1.0, 0.01)), circle.fix(0.5)])
    assert [o.outcome for o in localiser.feed(circle.fix(0.5, delay=0.3))] == [Outcome.DUPLICATE]


def test_a_fix_ahead_of_the_imu_waits_for_it():
    localiser = Localiser("rover", PARAMS)
    localiser.feed(circle.batch(np.arange(0.0, 1.0, 0.01)))
    localiser.feed(circle.fix(0.5))
    assert localiser.feed(circle.fix(1.05)) == []
    outcomes = localiser.feed(circle.batch(np.arange(1.0, 1.2, 0.01)))
    assert [(o.t, o.outcome, o.source) for o in outcomes] == [(1.05, Outcome.ACCEPTED, "ceiling")]


def test_without_imu_fixes_alone_still_make_a_pose():
    localiser = Localiser("rover", PARAMS)
    for at in np.arange(0.0, 8.0, 0.25):
        outcomes = localiser.feed(circle.fix(at))
        assert [o.outcome for o in outcomes if o.outcome is Outcome.REJECTED] == []
    pose = localiser.pose_at(7.8)
    assert pose.mode == "NO_IMU"
    assert np.linalg.norm(pose.position - circle.pose(7.8)[0]) < 0.1


def test_the_past_within_a_pause_is_bridged_from_its_start():
    """As the filter has come through it itself, once a fix beyond the pause has shown that it is one."""
    rng = np.random.default_rng(7)
    localiser = Localiser("rover", FilterParams(), "free")
    localiser.feed(circle.fix(0.005, rng=rng))
    localiser.feed(ImuBatch("rover", 0.0, circle.imu(np.arange(0.0, 1.001, 0.01), rng)))
    localiser.feed(circle.fix(1.6, rng=rng))
    at_pause, within = localiser.pose_at(1.0), localiser.pose_at(1.3)
    way = k.COAST_TIME * (1.0 - np.exp(-0.3 / k.COAST_TIME)) * at_pause.velocity
    np.testing.assert_allclose(within.position - at_pause.position, way, atol=1e-9)


@pytest.mark.parametrize("capacity", ["IMU_CAPACITY", "FIX_CAPACITY"])
def test_full_rings_forget_the_oldest_and_go_on(capacity):
    localiser = Localiser("rover", FilterParams(), "ground")
    step = {"IMU_CAPACITY": 1e-4, "FIX_CAPACITY": 0.01}[capacity]
    t = np.arange(0.0, 3.0 * getattr(k, capacity) * step, step)
    for part in np.array_split(t, 60):
        localiser.feed(circle.batch(part))
        for at in part[:: 1 if capacity == "FIX_CAPACITY" else len(part)]:
            localiser.feed(circle.fix(at))
    assert localiser.counts["rejected"] == 0
    assert localiser.counts["too_late"] == 0
    assert np.linalg.norm(localiser.latest.position - circle.pose(t[-1])[0]) < 0.01


def test_pose_at_agrees_with_the_track_and_leaves_no_trace():
    rng = np.random.default_rng(9)
    samples = circle.imu(np.arange(0.0, 3.0, 0.005), rng)
    localiser = Localiser("rover", PARAMS)
    track = np.empty((len(samples), 8))
    for i, at in zip(range(0, 600, 100), (0.1, 0.6, 1.1, 1.6, 2.1, None), strict=True):
        localiser.feed(ImuBatch("rover", 0.0, samples[i : i + 100]), track[i : i + 100])
        if at is not None:
            localiser.feed(circle.fix(at, rng=rng))
    before = localiser._timeline._memory.copy()
    for i in (500, 533, 599):  # on samples, after the last fix that had arrived before them, of 2.1 s
        pose = localiser.pose_at(samples[i, 0])
        np.testing.assert_array_equal(pose.position, track[i, 1:4])
        np.testing.assert_array_equal(pose.quaternion_wxyz, track[i, 4:])
    between = localiser.pose_at(1.6525)
    assert np.linalg.norm(between.position - circle.pose(1.6525)[0]) < 0.03
    np.testing.assert_array_equal(localiser._timeline._memory, before)
    assert localiser.pose_at(0.05) is None
