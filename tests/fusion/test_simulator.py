"""The simulator against the filter's own mechanics, and each of its imperfections against what it says."""

from __future__ import annotations

import math
from dataclasses import fields

import numpy as np
import pytest
from msgspec.structs import replace
from scipy.spatial.transform import Rotation

from fusion import kernels as k
from fusion.consistency import attitude_angle, nees, rms
from fusion.localiser import Localiser
from fusion.measurements import Array
from fusion.params import GRAVITY
from fusion.simulator import (
    CameraParams,
    ImuParams,
    MarkerParams,
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

PERFECT = ImuParams(gyro=TriadParams(), accel=TriadParams())
TILT = (0.02, -0.01)
COURSES = pytest.mark.parametrize(
    "course", [figure_eight(), random_ground(3), aggressive(3)], ids=["figure_eight", "random_ground", "aggressive"]
)


@COURSES
def test_velocity_acceleration_and_rate_are_the_derivatives(course: Trajectory) -> None:
    # Through rest, ramps and the seam of two rounds of the course. Central differences of 2h = 0.2 ms.
    t, h = np.arange(0.0025, 32.0, 0.0137), 1e-4
    now, before, after = course.at(t), course.at(t - h), course.at(t + h)
    np.testing.assert_allclose((after.position - before.position) / (2 * h), now.velocity, atol=1e-5)
    np.testing.assert_allclose((after.velocity - before.velocity) / (2 * h), now.acceleration, atol=2e-3)
    turned = (before.attitude.inv() * after.attitude).as_rotvec() / (2 * h)
    np.testing.assert_allclose(turned, now.rate, atol=2e-3)


def integrate(simulation: Simulation) -> tuple[float, float]:
    """Errors in m and rad at the end, of the filter's mechanics on the IMU from the true start."""
    state = np.zeros(k.STATE)
    state[k.Q : k.Q + 4] = simulation.truth[0, 4:]
    state[k.POS : k.POS + 3] = simulation.truth[0, 1:4]
    state[k.TILT : k.TILT + 2] = TILT
    samples = simulation.samples
    for u, dt in zip(0.5 * (samples[:-1] + samples[1:]), np.diff(samples[:, 0]), strict=True):
        k.predict(state[: k.BLOCK], *u[1:], dt, 0.0, 0.0)
    last = simulation.truth[-1]
    angle = attitude_angle(state[np.newaxis, k.Q : k.Q + 4], last[np.newaxis, 4:])
    return float(np.linalg.norm(state[k.POS : k.POS + 3] - last[1:4])), float(angle[0])


@COURSES
def test_a_perfect_imu_integrated_by_the_filter_gives_the_truth(course: Trajectory) -> None:
    """Midpoint integration errs with the square of the step: what it tends to must be the truth itself."""
    rates = (200.0, 400.0)
    coarse, fine = (integrate(simulate(course, 0, 4.0, replace(PERFECT, rate=rate), tilt=TILT)) for rate in rates)
    for at_200, at_400, enough in zip(coarse, fine, (4e-3, 1e-4), strict=True):
        assert at_200 < enough
        assert abs(4.0 * at_400 - at_200) < 0.02 * at_200 + 1e-9


def test_ground_courses_stay_upright_look_ahead_and_stop() -> None:
    for course in (figure_eight(), random_ground(1), random_ground(2)):
        motion = course.at(np.arange(0.0, 60.0, 0.01))
        ahead = motion.attitude.apply(motion.velocity, inverse=True)
        assert np.abs(ahead[:, 1:]).max() < 1e-12
        assert np.abs(motion.position[:, 2]).max() == 0.0
        still = (np.linalg.norm(motion.velocity, axis=1) == 0.0) & (np.linalg.norm(motion.rate, axis=1) == 0.0)
        assert 0.19 < still.mean() < 0.21
        assert np.abs(motion.rate).max() < 6.0


def test_at_rest_the_imu_feels_gravity_in_a_tilted_world() -> None:
    simulation = simulate(figure_eight(), 0, 0.0, PERFECT, tilt=TILT)
    world = Rotation.from_quat(simulation.truth[0, 4:], scalar_first=True).apply(simulation.samples[0, 4:])
    np.testing.assert_allclose(world[:2], np.array(TILT) * GRAVITY, atol=1e-12)
    assert np.linalg.norm(world) == pytest.approx(GRAVITY)


def test_the_same_seed_gives_the_same_and_another_does_not() -> None:
    camera = CameraParams(two_poses=True, dropout=0.2, flip=0.2, stamp_jitter=0.01)
    one, same, other = (simulate(aggressive(5), seed, 10.0, camera=camera) for seed in (5, 5, 6))
    for field in fields(Simulation):
        if field.name != "fixes":
            np.testing.assert_array_equal(getattr(one, field.name), getattr(same, field.name))
    assert [(f.t, f.arrival) for f in one.fixes] == [(f.t, f.arrival) for f in same.fixes]
    for a, b in zip(one.fixes, same.fixes, strict=True):
        np.testing.assert_array_equal(a.hypotheses[1].quaternion_wxyz, b.hypotheses[1].quaternion_wxyz)
    assert not np.array_equal(one.samples, other.samples)
    np.testing.assert_array_equal(aggressive(5).waves, aggressive(5).waves)
    assert not np.array_equal(random_ground(5).waves, random_ground(6).waves)


def gyro_error(gyro: TriadParams, seed: int = 0, duration: float = 60.0) -> tuple[Array, Simulation]:
    simulation = simulate(aggressive(1), seed, duration, replace(PERFECT, gyro=gyro))
    truth = aggressive(1).at(simulation.samples[:, 0])
    accel = truth.attitude.apply(truth.acceleration + [0.0, 0.0, GRAVITY], inverse=True)
    np.testing.assert_allclose(simulation.samples[:, 4:], accel, atol=1e-12)  # the other sensor has none of it
    return simulation.samples[:, 1:4] - truth.rate, simulation


def test_white_noise_has_its_density() -> None:
    error, _ = gyro_error(TriadParams(noise=1e-3))
    assert error.std() == pytest.approx(1e-3 * math.sqrt(200.0), rel=0.02)


def test_biases_start_and_walk_as_they_should() -> None:
    triad = TriadParams(bias_sigma=0.5, bias_walk=0.1)
    error, simulation = gyro_error(triad)
    np.testing.assert_allclose(error, simulation.gyro_bias, atol=1e-12)
    biases = np.array([simulate(figure_eight(), seed, 9.0, ImuParams(accel=triad)).accel_bias for seed in range(60)])
    assert biases[:, 0].std() == pytest.approx(0.5, rel=0.2)
    assert (biases[:, -1] - biases[:, 0]).std() == pytest.approx(0.1 * math.sqrt(9.0), rel=0.2)


def test_scale_and_misalignment_are_one_matrix() -> None:
    error, simulation = gyro_error(TriadParams(scale_sigma=0.01, misalignment_sigma=0.02))
    rate = simulation.samples[:, 1:4] - error
    gain, residuals, *_ = np.linalg.lstsq(rate, error)
    assert residuals.max() < 1e-18
    assert 0.0 < rms(np.diag(gain)) < 0.03
    assert 0.005 < rms(gain[~np.eye(3, dtype=bool)]) < 0.06


def test_saturation_and_digits() -> None:
    _, simulation = gyro_error(TriadParams(limit=0.75, step=0.25))
    assert set(np.unique(simulation.samples[:, 1:4])) == {-0.75, -0.5, -0.25, 0.0, 0.25, 0.5, 0.75}


def test_vibration_comes_with_speed_at_its_frequency() -> None:
    error, simulation = gyro_error(TriadParams(vibration=0.3))
    speed = np.linalg.norm(simulation.velocity, axis=1)
    size = np.linalg.norm(error, axis=1)
    assert (size <= 0.3 * speed + 1e-12).all()
    assert rms(size) == pytest.approx(0.3 * rms(speed) / math.sqrt(2.0), rel=0.02)
    spectrum = np.abs(np.fft.rfft(error[:, 0]))
    assert np.fft.rfftfreq(len(error), 1.0 / 200.0)[np.argmax(spectrum)] == pytest.approx(37.0, abs=1.0)


def test_imu_latency() -> None:
    simulation = simulate(figure_eight(), 0, 1.0, ImuParams(latency=0.02))
    np.testing.assert_allclose(simulation.arrival - simulation.samples[:, 0], 0.02)


def fix_errors(simulation: Simulation, course: Trajectory, hypothesis: int = 0, late: float = 0.0) -> Array:
    """(n, 6): position, then rotation in world axes, of the fixes against the truth at their stamps less `late`."""
    truth = course.at(np.array([fix.t for fix in simulation.fixes]) - late)
    poses = [fix.hypotheses[hypothesis] for fix in simulation.fixes]
    attitude = Rotation.from_quat([pose.quaternion_wxyz for pose in poses], scalar_first=True)
    position = np.array([pose.position for pose in poses])
    return np.column_stack([position - truth.position, (attitude * truth.attitude.inv()).as_rotvec()])


def test_fixes_are_as_good_as_they_say_and_as_late() -> None:
    course = aggressive(2)
    simulation = simulate(course, 4, 60.0, camera=CameraParams(rate=20.0))
    errors = fix_errors(simulation, course)
    covariances = np.array([fix.hypotheses[0].covariance for fix in simulation.fixes])
    assert nees(errors, covariances).mean() == pytest.approx(6.0, rel=0.05)
    assert (errors[:, :3].std(), errors[:, 3:].std()) == pytest.approx((0.005, 0.0175), rel=0.05)
    delay = np.array([fix.arrival - fix.t for fix in simulation.fixes])
    assert (delay.min(), delay.mean(), delay.max()) == pytest.approx((0.1, 0.2, 0.3), abs=0.005)
    arrival = [fix.arrival for fix in simulation.fixes]
    stamps = [fix.t for fix in simulation.fixes]
    assert arrival == sorted(arrival)
    assert stamps != sorted(stamps)  # some overtake each other at 20 Hz
    assert len(stamps) == pytest.approx(1200, abs=1)
    assert all(len(fix.hypotheses) == 1 for fix in simulation.fixes)


def test_stamp_error_and_jitter() -> None:
    course = figure_eight()
    noiseless = CameraParams(rate=20.0, position_sigma=1e-9, attitude_sigma=1e-9)
    late = simulate(course, 4, 60.0, camera=replace(noiseless, stamp_error=0.08))
    assert np.abs(fix_errors(late, course, late=0.08)).max() < 1e-7
    plain = simulate(course, 4, 60.0, camera=noiseless)
    jittered = simulate(course, 4, 60.0, camera=replace(noiseless, stamp_jitter=0.01))
    assert [fix.arrival for fix in jittered.fixes] == [fix.arrival for fix in plain.fixes]
    moved = [a.t - b.t for a, b in zip(jittered.fixes, plain.fixes, strict=True)]
    assert np.std(moved) == pytest.approx(0.01, rel=0.1)


def test_dropouts_take_fixes_away_and_leave_the_others() -> None:
    every, some = (
        simulate(figure_eight(), 4, 60.0, camera=CameraParams(rate=20.0, dropout=share)) for share in (0.0, 0.3)
    )
    assert len(some.fixes) == pytest.approx(0.7 * len(every.fixes), rel=0.05)
    assert {fix.t for fix in some.fixes} < {fix.t for fix in every.fixes}


def test_a_flip_is_the_other_pose_of_a_flat_marker() -> None:
    course = aggressive(2)
    camera = CameraParams(rate=20.0, two_poses=True, flip=0.4)
    simulation = simulate(course, 4, 60.0, camera=camera)
    likelier, other = (fix_errors(simulation, course, hypothesis)[:, 3:] for hypothesis in (0, 1))
    right = np.linalg.norm(likelier, axis=1) < np.linalg.norm(other, axis=1)
    assert 0.55 < right.mean() < 0.65
    assert rms(np.where(right[:, np.newaxis], likelier, other)) == pytest.approx(0.0175, rel=0.05)
    for fix in simulation.fixes[:50]:
        first, second = fix.hypotheses
        assert first.misfit < second.misfit
        np.testing.assert_array_equal(first.position, second.position)
        # Both have the same angle to the line of sight, and on weak perspective the same image.
        sight = first.position - np.array(camera.position)
        sight /= np.linalg.norm(sight)
        a, b = (Rotation.from_quat(pose.quaternion_wxyz, scalar_first=True).as_matrix() for pose in (first, second))
        assert sight @ a[:, 2] == pytest.approx(sight @ b[:, 2])
        across = np.eye(3) - np.outer(sight, sight)
        np.testing.assert_allclose(across @ a[:, :2], across @ b[:, :2], atol=1e-12)
    alone = simulate(course, 4, 60.0, camera=replace(camera, two_poses=False))
    np.testing.assert_array_equal(fix_errors(alone, course), fix_errors(simulation, course))


def pixels(position: Array, attitude: Rotation, marker: MarkerParams, camera: tuple[float, float, float]) -> Array:
    """(4, 2): where a camera that looks straight down has the corners of a marker."""
    half = 0.5 * marker.size
    corners = position + attitude.apply([[-half, half, 0], [half, half, 0], [half, -half, 0], [-half, -half, 0]])
    below = camera[2] - corners[:, 2:]
    return marker.focal_px * (corners[:, :2] - camera[:2]) / below


@pytest.mark.parametrize("on_floor", [True, False])
@pytest.mark.parametrize("field", [0.0, 0.6])
def test_errors_from_the_picture_are_as_large_as_their_covariance(on_floor: bool, field: float) -> None:
    """Over 60 runs, since of what is drawn once for each, six or twelve numbers, there are only so many."""
    marker = MarkerParams(on_floor=on_floor, field_sigma_px=field, field_length_px=150.0)
    values = []
    for seed in range(60):
        course = random_ground(seed) if on_floor else aggressive(seed)
        camera = CameraParams(rate=5.0, marker=marker, position=(0.3, -0.2, 4.0))
        simulation = simulate(course, seed, 12.0, camera=camera)
        covariances = np.array([fix.hypotheses[0].covariance for fix in simulation.fixes])
        values.append(nees(fix_errors(simulation, course), covariances).mean())
    assert np.mean(values) == pytest.approx(6.0, rel=0.08 if not on_floor else 0.16)


def test_errors_from_the_picture_are_those_that_the_corners_have() -> None:
    """The fixed pose, projected anew, has its corners where they were seen, but for two of their eight coordinates."""
    course = random_ground(1)
    sigma = 1e-3  # so small that what is not linear does not matter
    for on_floor, spent in ((False, 6), (True, 3)):
        marker = MarkerParams(corner_sigma_px=sigma, on_floor=on_floor, height_sigma=1e-9, tilt_sigma=1e-9)
        camera = CameraParams(rate=20.0, marker=marker)
        simulation = simulate(course, 1, 30.0, camera=camera)
        squares = []
        for fix in simulation.fixes:
            pose, truth = fix.hypotheses[0], course.at([fix.t])
            fixed = Rotation.from_quat(pose.quaternion_wxyz, scalar_first=True)
            off = pixels(pose.position, fixed, marker, camera.position)
            off = off - pixels(truth.position[0], truth.attitude[0], marker, camera.position)
            squares.append(np.sum((off / sigma) ** 2))
        assert np.mean(squares) == pytest.approx(spent, rel=0.08)


def test_an_error_that_depends_on_the_place_repeats_while_the_robot_stands() -> None:
    course = random_ground(2)
    marker = MarkerParams(corner_sigma_px=1e-6, field_sigma_px=0.5, height_sigma=1e-9, tilt_sigma=1e-9)
    simulation = simulate(course, 2, 150.0, camera=CameraParams(rate=10.0, marker=marker))
    t = np.array([fix.t for fix in simulation.fixes])
    errors = fix_errors(simulation, course)[:, [0, 1, 5]]
    stops = [errors[(t % 15.0 > 12.2) & (t // 15.0 == i)] for i in range(10)]
    assert max(np.ptp(stop, axis=0).max() for stop in stops) < 1e-6
    assert np.std([stop[0] for stop in stops], axis=0).min() > 1e-4
    assert np.abs(errors).max() < 0.02


def test_what_is_taken_for_the_height_counts_most_beside_the_camera() -> None:
    course = figure_eight()
    marker = MarkerParams(corner_sigma_px=1e-6, height_sigma=0.01, tilt_sigma=1e-9)
    simulation = simulate(course, 3, 30.0, camera=CameraParams(rate=10.0, marker=marker, position=(0.0, 0.0, 2.5)))
    errors = fix_errors(simulation, course)
    height = -errors[0, 2]  # of the marker above where it is taken to be
    assert 1e-4 < abs(height) < 0.04
    np.testing.assert_allclose(errors[:, 2], -height)
    # By similar triangles. The covariance is the same with the height's sigma.
    x = course.at(np.array([fix.t for fix in simulation.fixes])).position[:, 0]
    np.testing.assert_allclose(errors[:, 0], height * x / 2.5, atol=1e-7)
    sigma = np.sqrt([fix.hypotheses[0].covariance[0, 0] for fix in simulation.fixes])
    np.testing.assert_allclose(sigma, 0.01 * np.abs(x) / 2.5, atol=1e-7)


def test_a_camera_below_the_course_is_refused() -> None:
    camera = CameraParams(marker=MarkerParams(), position=(0.0, 0.0, 0.0))
    with pytest.raises(ValueError, match="rises to the camera at 0 m"):
        simulate(aggressive(1), 1, 10.0, camera=camera)


def test_a_marker_that_is_entered_wrongly_is_wrong_whenever_it_is_in_view() -> None:
    course = random_ground(3)
    wrong = WrongMarker(turn=math.pi, shift=(0.2, -0.1, 0.0), share=0.3, run=8.0)
    camera = CameraParams(rate=10.0)
    simulation = simulate(course, 3, 300.0, camera=replace(camera, wrong=wrong))
    plain = simulate(course, 3, 300.0, camera=camera)
    assert {fix.markers for fix in simulation.fixes} == {(1,), (7,)}
    assert {fix.markers for fix in plain.fixes} == {()}
    this = np.array([fix.markers == (7,) for fix in simulation.fixes])
    assert this.mean() == pytest.approx(0.3, abs=0.03)
    for marked, fix, as_it_is in zip(this, simulation.fixes, plain.fixes, strict=True):
        there, here = fix.hypotheses[0], as_it_is.hypotheses[0]
        a, b = (Rotation.from_quat(pose.quaternion_wxyz, scalar_first=True) for pose in (here, there))
        np.testing.assert_allclose(
            a.inv().apply(there.position - here.position), [0.2, -0.1, 0.0] if marked else 0.0, atol=1e-12
        )
        assert (a.inv() * b).magnitude() == pytest.approx(math.pi if marked else 0.0, abs=1e-6)
    changes = np.flatnonzero(np.diff(this[np.argsort([fix.t for fix in simulation.fixes])]))
    runs = np.diff(changes)[::2] / 10.0
    assert len(runs) >= 9
    assert 7.0 < runs.min() < runs.max() < 9.0
    always = simulate(course, 3, 20.0, camera=replace(camera, wrong=replace(wrong, share=1.0)))
    assert {fix.markers for fix in always.fixes} == {(7,)}


def test_an_imu_beside_the_origin_feels_its_own_acceleration() -> None:
    arm = np.array([0.1, -0.2, 0.05])
    simulation = simulate(aggressive(4), 0, 20.0, replace(PERFECT, lever_arm=tuple(arm)))

    def place(t: Array) -> Array:
        motion = aggressive(4).at(t)
        return motion.position + motion.attitude.apply(arm)

    t, h = simulation.samples[1:, 0], 1e-3
    acceleration = (place(t + h) - 2.0 * place(t) + place(t - h)) / h**2
    force = aggressive(4).at(t).attitude.apply(acceleration + [0.0, 0.0, GRAVITY], inverse=True)
    np.testing.assert_allclose(simulation.samples[1:, 4:], force, atol=1e-2)
    np.testing.assert_array_equal(simulation.samples[:, 1:4], simulate(aggressive(4), 0, 20.0, PERFECT).samples[:, 1:4])


def wheel_errors(wheels: WheelParams, seed: int = 0) -> tuple[Array, Array]:
    """Errors (n, 2) of the left and right wheel's speed, and those speeds."""
    course = random_ground(seed)
    odometry = simulate(course, seed, 120.0, wheels=wheels).wheels
    motion = course.at(odometry[:, 0])
    speed, rate = np.linalg.norm(motion.velocity, axis=1), motion.rate[:, 2]
    read, true = (
        np.column_stack([v - 0.5 * wheels.track * w, v + 0.5 * wheels.track * w])
        for v, w in ((odometry[:, 1], odometry[:, 2]), (speed, rate))
    )
    return read - true, true


def test_wheels() -> None:
    assert simulate(random_ground(0), 0, 5.0).wheels.shape == (0, 3)
    error, true = wheel_errors(WheelParams(noise=0.0))
    assert len(error) == 6000
    np.testing.assert_allclose(error, 0.0, atol=1e-12)
    error, _ = wheel_errors(WheelParams(noise=0.01))
    assert error.std(axis=0) == pytest.approx([0.01, 0.01], rel=0.05)
    scales = []
    for seed in range(40):
        error, true = wheel_errors(WheelParams(noise=0.0, scale_sigma=0.02), seed)
        scale = np.sum(error * true, axis=0) / np.sum(true**2, axis=0)
        np.testing.assert_allclose(error, true * scale, atol=1e-12)
        scales.append(scale)
    assert np.std(scales) == pytest.approx(0.02, rel=0.2)


def test_wheels_that_slip() -> None:
    error, true = wheel_errors(WheelParams(noise=0.0, slip_rate=0.1, slip_time=0.4, slip=0.5))
    slipping = np.abs(error) > 1e-9
    np.testing.assert_allclose(error[slipping], 0.5 * true[slipping])
    assert slipping.any(axis=0).all()
    # 0.1 a second for 0.4 s, of which a fifth falls into stops.
    assert slipping.any(axis=1).mean() == pytest.approx(0.04 * 0.8, abs=0.02)


def test_the_filter_with_matched_noise_is_as_good_as_it_says() -> None:
    """ANEES by its 6 degrees of freedom, just before each fix, over 20 runs of a minute: 0.97 +- 0.04 when written."""
    values = []
    for seed in range(20):
        simulation = simulate(random_ground(seed), seed, 60.0)
        localiser = Localiser("robot", motion="free")
        errors, covariances = [], []
        at = 0
        for fix in simulation.fixes:
            stop = int(np.searchsorted(simulation.arrival, fix.arrival))
            localiser.feed_samples(simulation.samples[at:stop])
            pose = localiser.latest
            if pose is not None:
                truth = simulation.truth[stop - 1]
                assert pose.t == truth[0]
                attitude, true_attitude = Rotation.from_quat([pose.quaternion_wxyz, truth[4:]], scalar_first=True)
                errors.append(np.append(truth[1:4] - pose.position, (true_attitude * attitude.inv()).as_rotvec()))
                covariances.append(pose.covariance)
            localiser.feed(fix)
            at = stop
        values.append(nees(np.array(errors), np.array(covariances)).mean() / 6.0)
    assert 0.9 < np.mean(values) < 1.1
