"""Wheel odometry: what it is worth, that its errors are found, and that it does no harm where it is wrong."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fusion.consistency import hold_last, rms, track_error
from fusion.localiser import Localiser
from fusion.measurements import PoseFix, PoseHypothesis, WheelOdometry
from fusion.simulator import Simulation, WheelParams, random_ground, simulate
from tests.data import data
from tests.fusion.simulated import drive

NO_WHEELS = np.empty((0, 3))


def course(seed: int, wheels: WheelParams, factors=(1.0, 1.0), speed: float = 0.7, stops: bool = True) -> Simulation:
    """A minute; `factors`: by which speed and yaw rate are wrong."""
    trajectory = random_ground(seed, speed=speed)
    if not stops:
        trajectory = replace(trajectory, go=1000.0, period=2000.0)
    simulation = simulate(trajectory, seed, 60.0, wheels=wheels)
    return replace(simulation, wheels=simulation.wheels * [1.0, *factors])


@pytest.mark.parametrize("seed", range(3))
def test_errors_of_scale_are_found_with_honest_sigmas_and_the_pose_gains(seed):
    # GIVEN wheels that say 4 % too much of the speed and 3 % too little of the yaw rate
    simulation = course(seed, WheelParams(), (1.04, 0.97))
    # WHEN it drives for a minute with them, and without
    run = drive(simulation, motion="differential")
    without = drive(replace(simulation, wheels=NO_WHEELS), motion="differential")
    # THEN both errors are known to within three of their sigmas, which have become small
    sigma = run.localiser.wheel_scale_sigma
    assert (sigma < 0.006).all()
    assert (np.abs(run.localiser.wheel_scale - [0.04, -0.03]) < 3.0 * sigma).all()
    # measured for seeds 0 to 5: 6.3 to 8.2 mm with them, 10.6 to 13.5 mm without
    assert run.mm(5.0) < 0.8 * without.mm(5.0)


@pytest.mark.parametrize("seed", range(5))
def test_slipping_wheels_do_no_harm(seed):
    # GIVEN a wheel that turns half again too fast for half a second, every three seconds or so, and unequal wheels
    simulation = course(seed, WheelParams(slip_rate=0.3, scale_sigma=0.03))
    # WHEN it drives with them, and without
    run = drive(simulation, motion="differential")
    without = drive(replace(simulation, wheels=NO_WHEELS), motion="differential")
    # THEN it is not worse for them
    assert run.mm(5.0) < 1.03 * without.mm(5.0)
    assert run.localiser.counts["rejected"] == 0


def test_the_camera_gone_for_ten_seconds():
    # GIVEN a robot at about 1 m/s with wheels that are wrong by some percent, which loses the camera after 34 s
    errors = {"wheels": [], "without": []}
    for seed in range(8):
        factors = 1.0 + np.random.default_rng(seed).normal(0.0, 0.03, 2)
        simulation = course(seed, WheelParams(), tuple(factors), speed=1.0, stops=False)
        simulation = replace(simulation, fixes=[fix for fix in simulation.fixes if fix.t < 34.0])
        for name, wheels in (("wheels", simulation.wheels), ("without", NO_WHEELS)):
            # WHEN it drives on by IMU and wheels
            error = drive(replace(simulation, wheels=wheels), motion="differential").error()
            errors[name].append(1e3 * error.position[np.searchsorted(error.t, 44.0)])
    print({name: np.round(np.median(mm), 1) for name, mm in errors.items()})
    # THEN it is still known where it is, to 40 mm (measured: 20)
    assert np.median(errors["wheels"]) < 40.0
    assert np.median(errors["wheels"]) < np.median(errors["without"])


@pytest.mark.parametrize("seed", range(3))
def test_wheels_and_a_camera_are_enough(seed):
    # GIVEN a robot without an IMU
    simulation = course(seed, WheelParams(), (1.04, 1.0))
    simulation = replace(simulation, samples=simulation.samples[:0], arrival=simulation.arrival[:0])
    # WHEN it drives for a minute
    run = drive(simulation, motion="differential")
    # THEN its pose is good, and it says by what it has it
    settled = run.times > 5.0
    assert 1e3 * rms(np.linalg.norm(run.errors[settled, :3], axis=1)) < 25.0
    assert run.localiser.counts["rejected"] == 0
    assert run.localiser.latest.mode == "NO_IMU"
    assert run.localiser.wheel_scale[0] == pytest.approx(0.04, abs=0.015)
    # the yaw rate has no other witness
    assert run.localiser.wheel_scale_sigma[1] == pytest.approx(0.05, rel=0.05)


@pytest.mark.parametrize("motion", ["ground", "differential"])
def test_on_a_real_robot_they_beat_holding_the_last_fix(motion):
    # GIVEN the odometry of a real robot, and fixes twice a second, 100 to 300 ms late, made of its truth
    folder = data("wheeled_odometry")
    t, yaw_rate, speed = np.loadtxt(folder / "odometry.csv", delimiter=",", skiprows=1).T[:3]
    truth = np.loadtxt(folder / "truth.csv", delimiter=",", skiprows=1)
    rng = np.random.default_rng(0)
    covariance = np.diag([0.005**2] * 3 + [0.0175**2] * 3)
    fixes = []
    for row in truth[np.searchsorted(truth[:, 0], np.arange(truth[0, 0] + 0.3, truth[-1, 0], 0.5))]:
        pose = PoseHypothesis(row[1:4] + rng.normal(0.0, 0.005, 3), row[4:] / np.linalg.norm(row[4:]), covariance)
        fixes.append(PoseFix("robot", row[0], row[0] + rng.uniform(0.1, 0.3), (pose,)))
    readings = [WheelOdometry("robot", row[0], row[np.newaxis]) for row in np.column_stack([t, speed, yaw_rate])]
    # WHEN they are replayed
    localiser, track = Localiser("robot", motion=motion), []
    for measurement in sorted([*fixes, *readings], key=lambda measurement: measurement.arrival):
        localiser.feed(measurement)
        pose = localiser.pose_at(measurement.arrival)
        if pose is not None and measurement.arrival < truth[-1, 0]:
            track.append([pose.t, *pose.position, *pose.quaternion_wxyz])
    # THEN the pose is better by far than the last fix
    track = np.array(track)
    held = np.array([(fix.t, *fix.hypotheses[0].position, *fix.hypotheses[0].quaternion_wxyz) for fix in fixes])
    held = hold_last(held, np.array([fix.arrival for fix in fixes]), track[:, 0])
    mm, held_mm = (1e3 * track_error(each, truth).position_rmse for each in (track, held))
    print(f"{motion}: {mm:.1f} mm, holding the last fix {held_mm:.1f} mm, {localiser.counts}")
    assert mm < 0.5 * held_mm
    assert localiser.counts["rejected"] == 0
