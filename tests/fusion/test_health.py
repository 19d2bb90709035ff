"""Health: nothing is said of a healthy robot, and each fault is named with the right number."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fusion.consistency import interpolate, track_error
from fusion.health import Health
from fusion.localiser import Localiser
from fusion.measurements import Outcome, WheelOdometry
from fusion.params import GRAVITY, FilterParams
from fusion.simulator import (
    CameraParams,
    ImuParams,
    Simulation,
    Trajectory,
    TriadParams,
    WheelParams,
    WrongMarker,
    aggressive,
    figure_eight,
    random_ground,
    simulate,
)
from server.recording import Recording
from server.replay import replay

PARAMS = FilterParams(time_offset_sigma=0.05, tilt_sigma=0.035)


def watch(simulation: Simulation, motion="ground", params=PARAMS) -> Health:
    health = Health(Localiser("robot", params, motion))
    # Ten readings of the wheels come together, with the last of them.
    groups = [simulation.wheels[i : i + 10] for i in range(0, len(simulation.wheels), 10)]
    wheels = tuple(WheelOdometry("robot", float(group[-1, 0]), group) for group in groups)
    replay(
        Recording("robot", simulation.samples, simulation.arrival, simulation.fixes, None, wheels),
        health.localiser,
        None,
        health,
    )
    return health


def drive(seed, duration=90.0, **faults):
    return simulate(random_ground(seed), seed, duration, **faults)


# --- faults that the simulator does not have


def fixes(simulation, change):
    return replace(simulation, fixes=sorted((change(fix) for fix in simulation.fixes), key=lambda fix: fix.arrival))


def poses(fix, change):
    return replace(fix, hypotheses=tuple(change(pose) for pose in fix.hypotheses))


def turned(pose, degrees):
    attitude = Rotation.from_quat(pose.quaternion_wxyz, scalar_first=True) * Rotation.from_rotvec([0, 0, degrees], True)
    return replace(pose, quaternion_wxyz=attitude.as_quat(scalar_first=True))


def samples(simulation, change):
    changed = change(simulation.samples)
    return replace(simulation, samples=changed, arrival=changed[:, 0].copy())


def times(gyro=1.0, accel=1.0):
    return lambda samples: samples * np.repeat([1.0, gyro, accel], [1, 3, 3])


def boastful(seed, duration=90.0, **faults):
    """Fixes that say half their sigmas."""
    return fixes(
        drive(seed, duration, **faults),
        lambda fix: poses(fix, lambda pose: replace(pose, covariance=0.25 * pose.covariance)),
    )


def two_cameras(seed, offset):
    west, east = drive(seed), simulate(random_ground(seed), seed + 1000, 90.0)
    apart = fixes(
        east,
        lambda fix: replace(poses(fix, lambda p: replace(p, position=p.position + [offset, 0.0, 0.0])), source="east"),
    )
    named = [replace(fix, source="west") for fix in west.fixes]
    return replace(west, fixes=sorted(named + apart.fixes, key=lambda fix: fix.arrival))


def resting(seed):
    """It moves for 4 s in 45."""
    return simulate(replace(random_ground(seed), go=4.0, period=45.0), seed, 90.0)


def standing(seed):
    return simulate(Trajectory(np.zeros((3, 1, 3)), np.zeros((3, 1, 3))), seed, 90.0)


def in_milliseconds(simulation, imu=True, fix=True):
    a, b = 1e3 if imu else 1.0, 1e3 if fix else 1.0
    return fixes(
        samples(simulation, lambda samples: samples * [a, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0]),
        lambda fix: replace(fix, t=fix.t * b, arrival=fix.arrival * b),
    )


def marked(seed, degrees=0.0, shift=(0.0, 0.0, 0.0), share=0.25):
    return drive(
        seed, camera=CameraParams(wrong=WrongMarker(turn=np.radians(degrees), shift=shift, share=share, run=7.0))
    )


def wheeled(seed, speed, rate=1.0):
    simulation = drive(seed, wheels=WheelParams())
    return replace(simulation, wheels=simulation.wheels * [1.0, speed, rate])


class Fault(NamedTuple):
    code: str
    simulate: Callable[[int], Simulation]
    figure: str = ""
    low: float = -np.inf
    high: float = np.inf
    motion: str = "ground"
    besides: frozenset[str] = frozenset()


NOISY_GYRO = ImuParams(gyro=TriadParams(noise=4e-3, bias_sigma=0.02, bias_walk=1e-4))
NOISY_ACCEL = ImuParams(accel=TriadParams(noise=6e-2, bias_sigma=0.2, bias_walk=1e-3, vibration=1.0))
WEAK_GYRO = ImuParams(gyro=TriadParams(noise=1e-3, bias_sigma=0.02, limit=2.18))
WRONG_ACCEL = ImuParams(accel=TriadParams(noise=2e-2, bias_sigma=0.2, bias_walk=1e-3, scale_sigma=0.3))
NO_FIX = frozenset({"no_fix"})
GIVEN_UP = NO_FIX | {"resets"}
SWAYING = np.array([[[0.0, 0.0, 0.0]], [[0.0, 0.0, 0.0]], [[1.0, 0.4, 0.0]]])  # it looks now to the left, now right
FAULTS = {
    "stamps late": Fault("stamps", lambda s: drive(s, camera=CameraParams(stamp_error=0.032)), "late_ms", 25, 39),
    "stamps early": Fault("stamps", lambda s: drive(s, camera=CameraParams(stamp_error=-0.05)), "late_ms", -57, -43),
    "tilt to x": Fault("floor_tilt", lambda s: drive(s, tilt=(np.radians(0.9), 0.0)), "x_deg", 0.6, 1.2),
    "tilt to y": Fault("floor_tilt", lambda s: drive(s, tilt=(0.0, -np.radians(1.5))), "y_deg", -1.8, -1.2),
    "gyro noise": Fault("gyro_noise", lambda s: drive(s, imu=NOISY_GYRO), "times", 3.6, 4.4),
    "accel noise": Fault("accel_noise", lambda s: drive(s, imu=NOISY_ACCEL), "times", 2.7, 3.4),
    "position sigma": Fault(
        "fix_position_noise", boastful, "times", 1.4, 2.8, besides=frozenset({"fix_attitude_noise"})
    ),
    "attitude sigma": Fault(
        "fix_attitude_noise", boastful, "times", 1.4, 2.8, besides=frozenset({"fix_position_noise"})
    ),
    "turned": Fault(
        "fixes_turned",
        lambda s: fixes(drive(s), lambda f: poses(f, lambda p: turned(p, 180.0)) if 20.0 < f.t % 40.0 < 28.0 else f),
        "turn_deg",
        175,
        180,
        besides=frozenset({"resets"}),
    ),
    "flipped": Fault("fixes_flipped", lambda s: drive(s, camera=CameraParams(flip=0.2)), "tip_deg", 20, 90),
    "two cameras": Fault("cameras_disagree", lambda s: two_cameras(s, 0.02), "mm", 15, 25),
    "missing": Fault(
        "imu_missing",
        lambda s: samples(drive(s), lambda a: a[np.random.default_rng(s).uniform(size=len(a)) > 0.07]),
        "share",
        0.06,
        0.08,
    ),
    "repeated": Fault(
        "imu_stamps_repeat",
        lambda s: samples(drive(s), lambda a: np.repeat(a, np.where(np.arange(len(a)) % 20, 1, 2), axis=0)),
        "share",
        0.04,
        0.06,
    ),
    "saturated": Fault(
        "gyro_saturates", lambda s: simulate(aggressive(s), s, 90.0, WEAK_GYRO), "limit", 2.17, 2.19, "free", NO_FIX
    ),
    "g": Fault(
        "accel_unit", lambda s: samples(drive(s), times(accel=1.0 / GRAVITY)), "force", 0.9, 1.1, besides=NO_FIX
    ),
    "deg/s": Fault("gyro_unit", lambda s: samples(drive(s), times(gyro=57.3)), "times", 45, 70, besides=NO_FIX),
    "gyro sign": Fault("gyro_sign", lambda s: samples(drive(s), times(gyro=-1.0)), "times", -1.2, -0.8, besides=NO_FIX),
    "mounted on its side": Fault(
        "imu_mounting",
        lambda s: samples(drive(s), lambda a: a[:, [0, 1, 3, 2, 4, 6, 5]] * [1, 1, 1, -1, 1, 1, -1]),
        "angle_deg",
        80,
        100,
        besides=NO_FIX,
    ),
    "late": Fault(
        "fixes_late", lambda s: fixes(drive(s), lambda f: replace(f, arrival=f.arrival + 1.6)), "delay_p95_s", 1.8, 2.0
    ),
    "lost": Fault(
        "fixes_lost", lambda s: fixes(drive(s), lambda f: replace(f, arrival=f.arrival + 1.8)), "lost", 40, 180
    ),
    "gone": Fault(
        "no_fix", lambda s: replace(drive(s), fixes=[f for f in drive(s).fixes if f.t < 78.0]), "age_s", 11.5, 13.0
    ),
    "deg/s, mostly at rest": Fault(
        "gyro_unit", lambda s: samples(resting(s), times(gyro=57.3)), "times", 45, 70, besides=NO_FIX
    ),
    "deg/s, always at rest": Fault(
        "gyro_unit", lambda s: samples(standing(s), times(gyro=57.3)), "times", 45, 70, besides=NO_FIX
    ),
    "gyro sign, mostly at rest": Fault(
        "gyro_sign", lambda s: samples(resting(s), times(gyro=-1.0)), "correlation", -1.0, -0.8, besides=NO_FIX
    ),
    "milliseconds": Fault("imu_stamp_unit", lambda s: in_milliseconds(drive(s)), "step", 4.9, 5.1),
    "milliseconds of the IMU": Fault(
        "imu_stamp_unit", lambda s: in_milliseconds(drive(s), fix=False), "step", 4.9, 5.1
    ),
    "milliseconds of fixes": Fault("fixes_clock", lambda s: in_milliseconds(drive(s), imu=False), "delay_s", 100, 500),
    "two clocks": Fault(
        "fixes_clock",
        lambda s: fixes(drive(s), lambda f: replace(f, t=f.t + 1.7e9, arrival=f.arrival + 1.7e9)),
        "apart_s",
        1.6e9,
        1.8e9,
    ),
    "stamps of another clock": Fault(
        "fixes_clock", lambda s: fixes(drive(s), lambda f: replace(f, t=f.t - 1e4)), "delay_s", 9.9e3, 1.01e4
    ),
    "marker turned": Fault("fixes_turned", lambda s: marked(s, 180.0), "turn_deg", 175, 180),
    "marker turned a little": Fault(
        "marker_turn", lambda s: marked(s, 8.0), "turn_deg", 7.0, 10.5, besides=frozenset({"resets"})
    ),
    "marker displaced": Fault("marker_place", lambda s: marked(s, shift=(0.0, 0.08, 0.0)), "mm", 60, 100),
    "the only marker displaced": Fault(
        "marker_place", lambda s: marked(s, shift=(0.1, 0.0, 0.0), share=1.0), "mm", 35, 110
    ),
    "IMU beside its place": Fault(
        "marker_place",
        lambda s: simulate(aggressive(s), s, 90.0, ImuParams(lever_arm=(0.1, 0.0, 0.0))),
        "mm",
        15,
        110,
        "free",
    ),
    "heading of the only marker": Fault(
        "marker_heading", lambda s: marked(s, -5.0, share=1.0), "off_deg", 4.2, 5.8, "differential"
    ),
    # three of the 5 mm that the finding gives as its own sigma
    "the only marker before the axle": Fault(
        "marker_place", lambda s: marked(s, shift=(0.1, 0.0, 0.0), share=1.0), "mm", 85, 115, "differential"
    ),
    "drives sideways": Fault(
        "wheels_slide",
        lambda s: simulate(replace(random_ground(s), angles=SWAYING), s, 90.0),
        "share",
        0.3,
        1.0,
        "differential",
        frozenset({"marker_heading", "resets", "no_fix"}),
    ),
    "carried about": Fault(
        "motion",
        lambda s: simulate(aggressive(s), s, 90.0),
        "rise_m",
        0.5,
        1.6,
        besides=frozenset({"resets", "no_fix", "fix_attitude_noise", "fix_position_noise"}),
    ),
    "wheels that slip": Fault(
        "wheels_slip",
        lambda s: drive(s, wheels=WheelParams(slip_rate=0.2, slip_time=0.6, slip=0.6)),
        "times",
        3,
        40,
        "differential",
        frozenset({"resets"}),
    ),
    "wheels too small": Fault("wheel_speed", lambda s: wheeled(s, 1.04), "scale", 0.03, 0.05, "differential"),
    "mm/s": Fault("wheel_unit", lambda s: wheeled(s, 1000.0), "times", 900, 1100, "differential", GIVEN_UP),
    "wheels backwards": Fault("wheel_unit", lambda s: wheeled(s, -1.0), "times", -1.1, -0.9, "differential", GIVEN_UP),
    "dead wheels": Fault("wheel_unit", lambda s: wheeled(s, 0.0), "times", -0.1, 0.1, "differential", GIVEN_UP),
    "deg/s of wheels": Fault("wheel_turn_unit", lambda s: wheeled(s, 1.0, 57.3), "times", 50, 64, "differential"),
    "wrong scale": Fault(
        "accel_motion",
        lambda s: drive(s, imu=WRONG_ACCEL),
        "times",
        2.0,
        50.0,
        besides=frozenset({"fix_position_noise"}),
    ),
}
# What cannot be told from every drive: how wrong a scale is is drawn, and here the draw is of a wrong one; and on some
# courses biases take the most of a displacement.
SEEDS = {"wrong scale": (0, 1), "the only marker displaced": (0, 1, 2)}


def check(fault: Fault, seed: int) -> None:
    simulation = fault.simulate(seed)
    health = watch(simulation, fault.motion)
    found = {diagnosis.code: diagnosis for diagnosis in health.diagnoses(90.0)}
    assert fault.code in found
    assert set(found) <= {fault.code} | fault.besides
    value = found[fault.code].evidence[fault.figure]
    assert fault.low <= np.linalg.norm(value) * (1.0 if np.ndim(value) else np.sign(value)) <= fault.high
    for diagnosis in found.values():
        assert len(diagnosis.text) > 10
        assert json.loads(json.dumps(diagnosis.evidence)) == msgspec.json.decode(
            msgspec.json.encode(diagnosis.evidence)
        )


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_is_named_with_its_number(name):
    for seed in SEEDS.get(name, (0, 1)):
        check(FAULTS[name], seed)


def test_a_marker_is_named():
    for simulation, code in (
        (marked(0, 180.0), "fixes_turned"),
        (marked(0, 8.0), "marker_turn"),
        (marked(0, shift=(0.2, 0.0, 0.0)), "marker_place"),
    ):
        (diagnosis,) = [diagnosis for diagnosis in watch(simulation).diagnoses(90.0) if diagnosis.code != "resets"]
        assert diagnosis.code == code
        assert "marker 7" in diagnosis.text
        assert 7 in diagnosis.evidence["markers"]
    assert diagnosis.evidence["mm"] == pytest.approx([200.0, 0.0], abs=40.0)


MISSED = {("stamps late", 21), ("tilt to x", 21)}


@pytest.mark.long
@pytest.mark.parametrize("name", sorted(FAULTS.keys() - SEEDS.keys()))
@pytest.mark.parametrize("seed", range(2, 22))
def test_faults_are_named_on_many_drives(name, seed, request):
    if (name, seed) in MISSED:
        reason = "the noise that the filter has come to believe is 2.7 times what it is: nothing is sure enough to say"
        request.applymarker(pytest.mark.xfail(strict=True, reason=reason))
    check(FAULTS[name], seed)


# --- silence


def healthy(seed: int) -> tuple[Simulation, str]:
    """Drives of all kinds, with cameras from 2 to 30 Hz."""
    camera = CameraParams(rate=(2.0, 5.0, 10.0, 30.0)[seed % 4], two_poses=seed % 8 == 0, flip=0.2 * (seed % 8 == 0))
    if seed % 3 == 2:
        return simulate(aggressive(seed), seed, 70.0, camera=camera), "free"
    course = random_ground(seed) if seed % 3 else figure_eight()
    return simulate(course, seed, 70.0, camera=camera), "ground" if seed % 3 else "differential"


def told(seed):
    simulation, motion = healthy(seed)
    # `replay` asks each 20 s and at the end; whatever was ever said is there.
    return {diagnosis.text for _, _, diagnosis in watch(simulation, motion).said.values()}


def test_nothing_is_said_of_healthy_robots():
    assert set().union(*(told(seed) for seed in range(20))) == set()


@pytest.mark.long
@pytest.mark.parametrize("seed", range(20, 220))
def test_nothing_is_said_of_many_healthy_robots(seed):
    assert told(seed) == set()


@pytest.mark.parametrize(
    "imu",
    [
        ImuParams(rate=25.0),
        ImuParams(rate=1000.0),
        # a datasheet's noise in the digits of a cheap device
        ImuParams(
            gyro=TriadParams(noise=2e-4, bias_sigma=0.02, step=1e-3), accel=TriadParams(noise=5e-3, step=GRAVITY / 2048)
        ),
        # shaken while it moves, quiet when it stands
        ImuParams(accel=TriadParams(noise=2e-2, bias_sigma=0.2, bias_walk=1e-3, vibration=3.0)),
    ],
    ids=["25 Hz", "1 kHz", "digits", "shaken"],
)
def test_nothing_is_said_of_other_imus(imu):
    assert watch(drive(4, imu=imu)).said == {}


def test_fixes_that_are_lost_because_the_imu_is_too_fast():
    """At 8 kHz what is kept of the samples is half a second."""
    simulation = simulate(
        random_ground(0), 0, 8.0, ImuParams(rate=8000.0), CameraParams(delay_least=0.6, delay_most=0.7)
    )
    (diagnosis,) = [diagnosis for diagnosis in watch(simulation).diagnoses(8.0) if diagnosis.code == "fixes_lost"]
    assert "at this rate of the IMU" in diagnosis.text


# --- figures


def test_accuracy_is_that_of_what_was_published():
    """The score of each fix against the causal track at its stamp, by an independent way."""
    simulation = drive(3, 90.0, camera=CameraParams(dropout=0.3))
    localiser = Localiser("robot", FilterParams(time_offset_sigma=0.0))
    health = Health(localiser)
    recording = Recording("robot", simulation.samples, simulation.arrival, simulation.fixes, None)
    track, outcomes, _ = replay(recording, localiser, None, health)
    # With no delay of the IMU, a row of the track is published at its stamp, before any fix of that time arrives.
    t = np.array([fix.t for fix in simulation.fixes])
    published = interpolate(track, t)
    known = np.isfinite(published[:, 1]) & np.isin(t, [o.t for o in outcomes if o.outcome is Outcome.ACCEPTED])
    fixed = np.array([fix.hypotheses[0].position for fix in simulation.fixes])
    distance = np.linalg.norm(published[known, 1:3] - fixed[known, :2], axis=1)
    accuracy = health.figures(90.0)["accuracy"]
    assert accuracy["fixes"] == known.sum() > 100
    assert accuracy["mm_p50"] == pytest.approx(1e3 * np.percentile(distance, 50), rel=1e-6)
    assert accuracy["mm_p95"] == pytest.approx(1e3 * np.percentile(distance, 95), rel=1e-6)
    assert 0.3 < accuracy["deg_p50"] < 1.5
    # Two frames a second, some without a fix: at a fix's instant the one before is 0.5, 1.0, 1.5 s old.
    ages = [bucket["fixes"] for bucket in accuracy["by_fix_age"]]
    assert ages[0] == 0
    assert ages[1] > ages[2] > ages[3]
    assert sum(ages) == accuracy["fixes"]
    assert accuracy["by_fix_age"][1]["mm_p50"] < accuracy["by_fix_age"][2]["mm_p50"]
    # The truth's error and the fix's own add up to it.
    error = track_error(track[simulation.samples[:, 0] > 10.0], simulation.truth)
    assert 1e3 * np.median(error.position) < accuracy["mm_p50"]


def test_accuracy_is_of_the_channel_that_is_published():
    """Poses are asked for ahead of the IMU, as by the service; the score is that of these, not of the filter's own."""
    simulation = drive(3, 60.0, imu=ImuParams(latency=0.02), camera=CameraParams(rate=5.0))
    health = Health(Localiser("robot", FilterParams(time_offset_sigma=0.0)))
    published, waiting, distances = [], list(simulation.fixes), []
    for i in range(0, len(simulation.samples), 4):
        now = simulation.arrival[i + 3 : i + 4]
        if not len(now):
            break
        track = np.empty((4, 8))
        health.localiser.feed_samples(simulation.samples[i : i + 4], track)
        health.judged(health.localiser.judged())
        health.sampled(simulation.samples[i : i + 4], track)
        while waiting and waiting[0].arrival <= now[0]:
            fix = waiting.pop(0)
            if len(published) > 1 and published[0][0] < fix.t:
                at = interpolate(np.array(published), np.array([fix.t]))[0]
                distances.append(np.linalg.norm(at[1:3] - fix.hypotheses[0].position[:2]))
            health.arrived(fix)
            health.judged(health.localiser.feed(fix))
        pose = health.localiser.pose_at(now[0], "smooth")
        if pose is not None:
            health.published(pose)
            published.append([pose.t, *pose.position, *pose.quaternion_wxyz])
    accuracy = health.figures(60.0)["accuracy"]
    assert accuracy["channel"] == "smooth"
    assert accuracy["fixes"] == len(distances) > 250
    assert accuracy["mm_p50"] == pytest.approx(1e3 * np.percentile(distances, 50), rel=1e-6)
    assert accuracy["mm_p95"] == pytest.approx(1e3 * np.percentile(distances, 95), rel=1e-6)
    # Without anyone who listens it is that of the track.
    assert watch(simulation).figures(60.0)["accuracy"]["channel"] == "best"


def test_what_wheels_are_found_to_be():
    """A scale of theirs is drawn for each, of 2 %: that shows in the speed, and more in the turning."""
    right, wrong = (
        watch(drive(2, wheels=WheelParams(scale_sigma=sigma)), "differential").figures(90.0) for sigma in (0.0, 0.02)
    )
    for figures in (right, wrong):
        assert 0.0 < max(figures["wheel_scale_sigma"]) < 0.02
        assert len(figures["wheel_scale"]) == 2
    assert np.abs(right["wheel_scale"]).max() < 0.015
    assert np.abs(wrong["wheel_scale"]).max() > 0.015
    assert watch(drive(2, wheels=WheelParams()), "differential").said == {}


def test_rejects_count_when_the_filter_gives_in():
    """A robot that was carried away was wrong by 2 m; a turned marker does not make its poses wrong."""

    def carried(fix):
        return poses(fix, lambda p: replace(p, position=p.position + [2.0 * (fix.t > 40.0), 0.0, 0.0]))

    health = watch(fixes(drive(5), carried))
    assert health.localiser.counts["reinitialised"] == 1
    assert max(score.distance for scores in health._scores[0] for score in scores) > 1.9
    health = watch(FAULTS["turned"].simulate(5))
    assert health.localiser.counts["rejected"] + health.localiser.counts["inflated"] > 10
    assert health.figures(90.0)["accuracy"]["deg_p95"] < 5.0


def test_figures_before_anything():
    health = Health(Localiser("robot"))
    figures = json.loads(json.dumps(health.figures(0.0)))
    assert figures["nis"]["pose"]["mean"] is None
    assert figures["accuracy"]["mm_p50"] is None
    assert figures["fix_age_s"] is None
    assert health.diagnoses(0.0) == []


def test_counts_and_delays():
    # The third in each ten is held up, and overtaken.
    simulation = fixes(drive(6, 60.0), lambda fix: replace(fix, arrival=fix.arrival + 0.8 * (int(2 * fix.t) % 10 == 3)))
    figures = watch(simulation).figures(60.0)
    assert figures["fixes_reordered"] == pytest.approx(12, abs=1)
    assert figures["fix_delay_ms"]["p50"] == pytest.approx(200.0, abs=40.0)
    assert 400.0 < figures["fix_delay_ms"]["p95"] < 1100.0
    for block in ("pose", "position", "attitude"):
        nis = figures["nis"][block]
        assert nis["low"] < 1.0 < nis["high"]
        assert 0.5 < nis["mean"] < 1.5
        assert nis["fixes"] == 60


def test_a_stream_is_as_good_as_a_recording():
    """Sample by sample, and asked all the time, it says the same."""
    simulation = FAULTS["gyro noise"].simulate(1)
    n = 4000
    health = Health(Localiser("robot", PARAMS))
    waiting = list(simulation.fixes)
    for i in range(0, n, 3):
        while waiting and waiting[0].arrival <= simulation.arrival[i]:
            health.arrived(waiting[0])
            health.judged(health.localiser.feed(waiting.pop(0)))
        part = simulation.samples[i : i + 3]
        track = np.empty((len(part), 8))
        health.localiser.feed_samples(part, track)
        health.judged(health.localiser.judged())
        health.sampled(part, track)
        if i % 300 == 0:
            health.diagnoses(float(part[-1, 0]))
    (since, until, diagnosis) = health.said["gyro_noise", ""]
    assert since < 10.0 < until
    assert diagnosis.evidence["times"] == pytest.approx(4.0, abs=0.4)
    assert list(health.said) == [("gyro_noise", "")]


def test_the_filterpy_engine():
    simulation = drive(7, 20.0)
    health = Health(Localiser("robot", PARAMS, engine="filterpy"))
    replay(
        Recording("robot", simulation.samples, simulation.arrival, simulation.fixes, None),
        health.localiser,
        None,
        health,
    )
    assert health.figures(20.0)["accuracy"]["fixes"] > 30
    assert health.said == {}
