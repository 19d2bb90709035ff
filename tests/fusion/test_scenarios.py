"""GIVEN a robot on its way, WHEN something happens to it, THEN its pose is of use, and soon as good as before.

What the sensors suffer is put into a simulated drive with matched noise; the measure is the causal RMSE, beside that of
the same drive without the mishap, or of holding the last fix. Figures in comments were measured when the test was
written.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from fusion.consistency import rms
from fusion.localiser import Localiser
from fusion.measurements import Array, PoseFix, PoseHypothesis
from fusion.params import Motion
from fusion.simulator import (
    CameraParams,
    MarkerParams,
    Simulation,
    WheelParams,
    WrongMarker,
    aggressive,
    random_ground,
    simulate,
)
from tests.fusion.simulated import drive, held_mm

MOTIONS = pytest.mark.parametrize("motion", ["free", "ground", "differential"])
SETTLED, AT, SECONDS = 12.0, 20.0, 45.0  # s: the mishap comes at AT
SEEDS = (0, 1)


def healthy(motion: Motion, seed: int, seconds: float = SECONDS, **faults: object) -> Simulation:
    course = aggressive(seed) if motion == "free" else random_ground(seed)
    return simulate(course, seed, seconds, **faults)  # type: ignore[arg-type]


def samples(simulation: Simulation, change: Callable[[Array], Array]) -> Simulation:
    """`change` may take some away, by their rows; what arrives when stays."""
    changed = change(simulation.samples.copy())
    if len(changed) == len(simulation.samples):
        return replace(simulation, samples=changed)
    return replace(simulation, samples=changed, arrival=changed[:, 0].copy())


def fixes(simulation: Simulation, change: Callable[[PoseFix], PoseFix | None]) -> Simulation:
    changed = [fix for fix in map(change, simulation.fixes) if fix is not None]
    return replace(simulation, fixes=sorted(changed, key=lambda fix: fix.arrival))


def poses(fix: PoseFix, change: Callable[[PoseHypothesis], PoseHypothesis]) -> PoseFix:
    return replace(fix, hypotheses=tuple(map(change, fix.hypotheses)))


def between(t: float | Array, seconds: float) -> Array:
    return (np.asarray(t) > AT) & (np.asarray(t) < AT + seconds)


# --- What is no mishap at all


@MOTIONS
def test_every_sample_comes_twice(motion):
    simulation = healthy(motion, 0)
    twice = np.repeat(np.arange(len(simulation.samples)), 2)
    doubled = replace(simulation, samples=simulation.samples[twice], arrival=simulation.arrival[twice])
    run = drive(doubled, None, motion)
    np.testing.assert_array_equal(run.track[::2], drive(simulation, None, motion).track)
    assert run.localiser.counts["imu_duplicates"] == len(simulation.samples)


@MOTIONS
def test_every_fix_comes_twice(motion):
    """Late the second time; the poses are the same to the last bit."""
    simulation = healthy(motion, 0)
    again = [replace(fix, arrival=fix.arrival + 0.2) for fix in simulation.fixes]
    both = sorted([*simulation.fixes, *again], key=lambda fix: fix.arrival)
    run = drive(replace(simulation, fixes=both), None, motion)
    np.testing.assert_array_equal(run.track, drive(simulation, None, motion).track)
    assert run.localiser.counts["duplicate"] == len(simulation.fixes)


@MOTIONS
def test_stamps_in_steps_of_20_ms(motion):
    """Four samples in a row have the same stamp: three are dropped. Free 2.1 times the error, ground 1.5 to 2.5."""
    plain, coarse = [], []
    for seed in SEEDS:
        simulation = healthy(motion, seed)
        stamps = simulation.samples.copy()
        stamps[:, 0] = np.floor(50.0 * stamps[:, 0] + 1e-6) / 50.0
        run = drive(replace(simulation, samples=stamps), None, motion)
        assert run.localiser.counts["imu_duplicates"] > 0.7 * len(stamps)
        plain.append(drive(simulation, None, motion).mm(SETTLED))
        coarse.append(run.mm(SETTLED))
    assert rms(np.array(coarse)) < 3.0 * rms(np.array(plain))


@MOTIONS
def test_fixes_held_up_and_then_all_at_once_the_newest_first(motion):
    for seed in SEEDS:
        simulation = healthy(motion, seed, camera=CameraParams(rate=5.0))
        held_up = []
        for i in range(0, len(simulation.fixes), 4):
            group = simulation.fixes[i : i + 4]
            held_up += [replace(fix, arrival=group[-1].arrival) for fix in reversed(group)]
        run = drive(replace(simulation, fixes=held_up), None, motion)
        assert run.localiser.counts["rejected"] == run.localiser.counts["reinitialised"] == 0
        assert run.mm(SETTLED) < 2.0 * drive(simulation, None, motion).mm(SETTLED)


@MOTIONS
def test_a_robot_is_found_while_it_moves(motion):
    for seed in SEEDS:
        simulation = fixes(healthy(motion, seed), lambda fix: fix if fix.t > 4.0 else None)
        assert drive(simulation, None, motion).mm(SETTLED) < 1.1 * drive(healthy(motion, seed), None, motion).mm(
            SETTLED
        )


# --- The robot


@MOTIONS
def test_it_is_carried_away(motion):
    away = np.array([2.0, -1.0, 0.0])
    for seed in SEEDS:
        simulation = healthy(motion, seed)
        carried = fixes(
            simulation, lambda fix: poses(fix, lambda p: replace(p, position=p.position + away * (fix.t > AT)))
        )
        truth = simulation.truth.copy()
        truth[truth[:, 0] > AT, 1:4] += away
        run = drive(replace(carried, truth=truth), None, motion)
        assert run.localiser.latest.reset_id == 1
        assert run.mm(AT + 5.0) < 1.5 * drive(simulation, None, motion).mm(AT + 5.0)


@MOTIONS
def test_a_robot_leaves_the_room_for_a_while_and_comes_back(motion):
    """Neither IMU nor fixes for 15 s; then it is where it would have been."""
    for seed in SEEDS:
        simulation = healthy(motion, seed, 60.0)
        gone = samples(simulation, lambda a: a[~between(a[:, 0], 15.0)])
        gone = fixes(gone, lambda fix: None if between(fix.t, 15.0) else fix)
        run = drive(gone, None, motion)
        assert run.mm(45.0) < 1.5 * drive(simulation, None, motion).mm(45.0)


# --- The camera


@MOTIONS
def test_the_camera_is_lost_for_fifteen_seconds_and_comes_back(motion):
    for seed in SEEDS:
        simulation = healthy(motion, seed, 60.0)
        lost = fixes(simulation, lambda fix: None if between(fix.t, 15.0) else fix)
        run = drive(lost, None, motion)
        assert run.mm(45.0) < 1.5 * drive(simulation, None, motion).mm(45.0)
        assert run.localiser.latest.reset_id == 0


@MOTIONS
def test_without_the_camera_it_is_never_worse_than_holding_the_last_fix(motion):
    for seed in range(4):
        lost = fixes(healthy(motion, seed, 60.0), lambda fix: None if between(fix.t, 15.0) else fix)
        assert drive(lost, None, motion).mm(SETTLED) < held_mm(lost, SETTLED)


@MOTIONS
@pytest.mark.parametrize("degrees", [30.0, 90.0, 180.0])
def test_a_marker_is_entered_turned(motion, degrees):
    """It is in view for nine seconds at a time, and all its fixes agree with each other."""
    for seed in SEEDS:
        camera = CameraParams(wrong=WrongMarker(turn=math.radians(degrees)))
        run = drive(healthy(motion, seed, 75.0, camera=camera), None, motion)
        assert run.localiser.latest.reset_id == 0
        assert run.deg(SETTLED) < 1.5


@MOTIONS
def test_a_marker_is_entered_in_the_wrong_place(motion):
    """By 10 cm: its fixes are that far off, and nothing else is."""
    for seed in SEEDS:
        camera = CameraParams(wrong=WrongMarker(turn=0.0, shift=(0.1, 0.0, 0.0)))
        run = drive(healthy(motion, seed, 75.0, camera=camera), None, motion)
        assert run.mm(SETTLED) < 100.0
        assert run.deg(SETTLED) < 1.5


@MOTIONS
@pytest.mark.parametrize("late", [-0.15, 0.15])
def test_stamps_are_wrong_by_150_ms(motion, late):
    for seed in SEEDS:
        simulation = healthy(motion, seed, 90.0, camera=CameraParams(stamp_error=late))
        run = drive(simulation, None, motion)
        known = fixes(simulation, lambda fix: replace(fix, t=fix.t - late))
        assert run.localiser.time_offset == pytest.approx(-late, abs=0.015)
        assert run.mm(60.0) < 1.5 * drive(known, None, motion).mm(60.0)


@MOTIONS
def test_fixes_whose_errors_repeat_while_it_stands(motion):
    """Of a place in the picture, and on the floor of a marker's height and tilt, which are the same all the time."""
    marker = MarkerParams(field_sigma_px=0.5, on_floor=motion != "free")
    camera = CameraParams(marker=marker, position=(0.0, 0.0, 4.0))
    values = [drive(healthy(motion, seed, camera=camera), None, motion).anees for seed in range(8)]
    assert 0.6 < np.mean(values) < 1.3


# --- The IMU


@MOTIONS
def test_the_imu_pauses_for_three_seconds(motion):
    for seed in SEEDS:
        simulation = healthy(motion, seed)
        run = drive(samples(simulation, lambda a: a[~between(a[:, 0], 3.0)]), None, motion)
        assert run.mm(SETTLED) < 0.6 * held_mm(simulation, SETTLED)
        assert run.mm(AT + 10.0) < 1.2 * drive(simulation, None, motion).mm(AT + 10.0)
        assert run.localiser.latest.reset_id == 0


def frozen(a: Array) -> Array:
    where = between(a[:, 0], 3.0)
    a[where, 1:] = a[np.argmax(where), 1:]
    return a


def zeros(a: Array) -> Array:
    a[between(a[:, 0], 3.0), 1:] = 0.0
    return a


def spikes(a: Array) -> Array:
    rng = np.random.default_rng(0)
    rows = rng.choice(np.flatnonzero(a[:, 0] > SETTLED), 8)
    a[rows, 1:] = rng.uniform(-1.0, 1.0, (8, 6)) * [35.0, 35.0, 35.0, 150.0, 150.0, 150.0]
    return a


def clock_forth(a: Array) -> Array:
    a[a[:, 0] > AT, 0] += 0.5
    return a


def clock_back(a: Array) -> Array:
    a[a[:, 0] > AT, 0] -= 0.5
    return a


NEVER_FOUND = pytest.mark.xfail(strict=True, reason="an offset of 0.5 s is never found: 5 m, 90 m")


@pytest.mark.parametrize(
    "change",
    [
        frozen,
        zeros,
        spikes,
        pytest.param(clock_forth, marks=NEVER_FOUND),
        pytest.param(clock_back, marks=NEVER_FOUND),
    ],
)
def test_an_imu_that_tells_nonsense_for_a_while_is_better_than_none(change):
    for motion in ("free", "ground"):
        for seed in SEEDS:
            simulation = samples(healthy(motion, seed), change)
            run = drive(simulation, None, motion)
            assert run.mm(SETTLED) < held_mm(simulation, SETTLED)


# --- The wheels


def test_wheels_make_it_better_and_carry_it_without_the_camera():
    """Their scale is wrong by a few percent each, which is found."""
    for seed in SEEDS:
        wheels = WheelParams(scale_sigma=0.02)
        with_them, without = (healthy("differential", seed, 60.0, wheels=each) for each in (wheels, None))
        assert drive(with_them, None, "differential").mm(SETTLED) < drive(without, None, "differential").mm(SETTLED)
        lost = fixes(with_them, lambda fix: None if between(fix.t, 15.0) else fix)
        assert drive(lost, None, "differential").error(AT).position.max() < 0.15


@pytest.mark.parametrize(
    "factors",
    [
        pytest.param((-1.0, 1.0), id="backwards"),
        pytest.param((1.0, -1.0), id="turning the other way"),
        pytest.param((1000.0, 1.0), id="mm/s"),
        pytest.param((1.0, 57.3), id="deg/s"),
        pytest.param((0.0, 0.0), id="nothing but zeros"),
    ],
)
def test_wheels_that_are_altogether_wrong_do_no_harm(factors):
    for seed in SEEDS:
        simulation = healthy("differential", seed, wheels=WheelParams())
        wrong = replace(simulation, wheels=simulation.wheels * [1.0, *factors])
        run = drive(wrong, None, "differential")
        assert run.mm(AT) < held_mm(simulation, AT)
        assert run.localiser.latest.reset_id <= 1


def test_wheels_that_slip():
    for seed in range(4):
        wheels = WheelParams(slip_rate=0.2, slip_time=0.6, slip=0.6)
        simulation = healthy("differential", seed, wheels=wheels)
        assert drive(simulation, None, "differential").mm(SETTLED) < 0.5 * held_mm(simulation, SETTLED)


# --- The smooth channel


def camera_lost(motion: Motion) -> Simulation:
    return fixes(healthy(motion, 0), lambda fix: None if between(fix.t, 15.0) else fix)


def imu_pauses(motion: Motion) -> Simulation:
    return samples(healthy(motion, 0), lambda a: a[~between(a[:, 0], 3.0)])


def carried(motion: Motion) -> Simulation:
    return fixes(
        healthy(motion, 0), lambda fix: poses(fix, lambda p: replace(p, position=p.position + 2.0 * (fix.t > AT)))
    )


def marker_displaced(motion: Motion) -> Simulation:
    wrong = WrongMarker(turn=0.0, shift=(0.1, 0.0, 0.0))
    return healthy(motion, 1, camera=CameraParams(wrong=wrong))


@pytest.mark.parametrize("motion", ["free", "ground"])
@pytest.mark.parametrize("mishap", [camera_lost, imu_pauses, carried, marker_displaced])
def test_no_step_that_is_not_told(mishap, motion):
    """Beyond what its own velocity moves it in 5 ms: 0.3 m/s make 1.5 mm, the change of the velocity the rest."""
    simulation = mishap(motion)
    localiser = Localiser("robot", motion=motion)
    waiting = list(simulation.fixes)
    before, steps, told = None, [], 0
    for sample, arrival in zip(simulation.samples, simulation.arrival, strict=True):
        while waiting and waiting[0].arrival <= arrival:
            localiser.feed(waiting.pop(0))
        localiser.feed_samples(sample[np.newaxis])
        pose = localiser.pose_at(sample[0], "smooth")
        if before is not None and pose.t - before.t < 0.02:
            moved = pose.position - before.position - (pose.t - before.t) * 0.5 * (pose.velocity + before.velocity)
            if pose.reset_id == before.reset_id:
                steps.append(np.linalg.norm(moved))
            else:
                told += 1
                assert np.linalg.norm(pose.reset_step) > 0.0
        before = pose
    assert max(steps) < 0.003
    assert len(steps) > 7000
    assert told >= (mishap is carried)


# --- Numbers that cannot be


def one_sample(column: int, value: float) -> Callable[[Simulation], Simulation]:
    def change(a: Array) -> Array:
        a[np.searchsorted(a[:, 0], AT), column] = value
        return a

    return lambda simulation: samples(simulation, change)


def one_fix(**changes: float) -> Callable[[Simulation], Simulation]:
    def change(simulation: Simulation) -> Simulation:
        at = len(simulation.fixes) // 2
        fix = replace(simulation.fixes[at], **changes)
        return replace(simulation, fixes=[*simulation.fixes[:at], fix, *simulation.fixes[at + 1 :]])

    return change


def strayed(metres: float) -> Callable[[Simulation], Simulation]:
    def change(simulation: Simulation) -> Simulation:
        at = len(simulation.fixes) // 2
        fix = poses(simulation.fixes[at], lambda p: replace(p, position=np.full(3, metres)))
        return replace(simulation, fixes=[*simulation.fixes[:at], fix, *simulation.fixes[at + 1 :]])

    return change


NUMBERS = {
    "a fix at 1e9 m": strayed(1e9),
    "a fix at 1e300 m": strayed(1e300),
    "a fix of long ago": one_fix(t=-1e9),
    "a fix of the far future": one_fix(t=1e6),
    "a sample of long ago": one_sample(0, -1e9),
    "a sample of the far future": one_sample(0, 1e6),
    "a rate of 1000 rad/s": one_sample(1, 1e3),
    "a rate of 1e300 rad/s": one_sample(1, 1e300),
    "a force of 1e300 m/s2": one_sample(4, 1e300),
}


@pytest.mark.parametrize("spoil", NUMBERS.values(), ids=NUMBERS.keys())
def test_one_number_that_cannot_be_does_no_harm(spoil):
    simulation = healthy("ground", 1, 40.0)
    run = drive(spoil(simulation))
    assert run.mm(AT + 5.0) < 1.1 * drive(simulation).mm(AT + 5.0)
    assert np.linalg.eigvalsh(run.localiser.latest.covariance)[0] > 0.0


@pytest.mark.parametrize("origin", [1.7e9, -1e6])
def test_any_epoch_of_the_clock(origin):
    """Floats of seconds since 1970 tell 0.2 us apart."""
    simulation = healthy("ground", 1, 30.0)
    truth, moved = simulation.truth.copy(), simulation.samples.copy()
    truth[:, 0] += origin
    moved[:, 0] += origin
    later = fixes(simulation, lambda fix: replace(fix, t=fix.t + origin, arrival=fix.arrival + origin))
    run = drive(replace(later, samples=moved, arrival=moved[:, 0].copy(), truth=truth))
    assert run.mm(origin + SETTLED) == pytest.approx(drive(simulation).mm(SETTLED), rel=0.02)


def test_a_room_far_from_the_origin():
    simulation = healthy("ground", 1, 30.0)
    away = fixes(simulation, lambda fix: poses(fix, lambda p: replace(p, position=p.position + 1e4)))
    run = drive(replace(away, truth=simulation.truth + 1e4 * np.array([0, 1, 1, 1, 0, 0, 0, 0])))
    assert run.mm(SETTLED) == pytest.approx(drive(simulation).mm(SETTLED), rel=0.01)
