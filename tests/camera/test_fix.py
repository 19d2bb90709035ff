import numpy as np
import pytest

from camera import fix, planar
from camera.fix import Body, MarkerMount, MarkerPose, View, marker_corners, marker_poses, predict, project, rays, solve
from camera.markers import MarkerSighting
from fusion.geometry import exp_so3, quaternion_from_rotation, rotation_about_z, transform, transform_points
from fusion.measurements import Mode, Pose
from tests.camera.scene import INTRINSICS, WORLD_FROM_CAMERA, moved, nees, pose_error, sight

SIGMA_PX = 0.1
ONE = [MarkerMount(7, 0.10, transform(rotation_about_z(0.4), [0.03, -0.02, 0.12]))]
TWO = [
    MarkerMount(7, 0.10, transform(rotation_about_z(0.4), [0.13, -0.02, 0.12])),
    MarkerMount(8, 0.08, transform(rotation_about_z(2.0), [-0.10, 0.00, 0.15])),
]
TRIALS = 200
# .0005 and .9995 quantiles of chi-square at 6 * TRIALS = 1200 degrees of freedom (normal approximation), per trial
LOWEST, HIGHEST = 6.0 - 3.29 * np.sqrt(12.0 / TRIALS), 6.0 + 3.29 * np.sqrt(12.0 / TRIALS)


def on_the_floor(random):
    """A robot anywhere in view, on a floor that is as uneven as the planar solve supposes."""
    tilt = random.normal(0.0, planar.FLOOR_TILT_SIGMA, 2)
    return transform(
        rotation_about_z(random.uniform(-np.pi, np.pi)) @ exp_so3([*tilt, 0.0]),
        [random.uniform(-0.9, 0.9), random.uniform(-0.7, 0.7), random.normal(0.0, planar.FLOOR_HEIGHT_SIGMA)],
    )


def test_the_models_derivative_is_that_of_differences():
    random = np.random.default_rng(1)
    truth = on_the_floor(random)
    view = View.of(list(zip(TWO, sight(TWO, truth, random, SIGMA_PX), strict=True)), WORLD_FROM_CAMERA, INTRINSICS)
    _, jacobian = view.residuals(truth)
    for k in range(6):
        step = np.zeros(6)
        step[k] = 1e-6
        ahead, behind = view.residuals(moved(truth, step))[0], view.residuals(moved(truth, -step))[0]
        # A residual is seen minus expected, the Jacobian that of the expected.
        np.testing.assert_allclose(jacobian[:, k], -(ahead - behind) / 2e-6, rtol=1e-5, atol=1e-3)


def test_rays_undo_projection():
    points = np.random.default_rng(2).uniform([-1.0, -0.7, 2.0], [1.0, 0.7, 4.0], (50, 3))
    pixels, _ = project(points, INTRINSICS)
    np.testing.assert_allclose(rays(pixels, INTRINSICS) * points[:, 2:], points, atol=1e-5)


@pytest.mark.parametrize("mounts", [ONE, TWO], ids=["one marker", "two markers"])
@pytest.mark.parametrize("placed", [False, True], ids=["camera known", "camera uncertain"])
def test_planar_covariance_is_the_scatter(mounts, placed):
    random = np.random.default_rng(3)
    placement = np.diag([2e-3, 2e-3, 3e-3, 1e-3, 1e-3, 5e-4]) ** 2 if placed else None
    total = 0.0
    for _ in range(TRIALS):
        truth = on_the_floor(random)
        believed = WORLD_FROM_CAMERA
        if placement is not None:
            believed = moved(believed, random.multivariate_normal(np.zeros(6), placement))
        sightings = sight(mounts, truth, random, SIGMA_PX)
        (found,) = solve(
            [Body("rover", mounts, planar=True)],
            sightings,
            INTRINSICS,
            believed,
            arrival=1.1,
            placement_covariance=placement,
        )
        (pose,) = found.hypotheses
        total += nees(truth, pose.position, pose.quaternion_wxyz, pose.covariance)
    assert LOWEST < total / TRIALS < HIGHEST


def test_six_dof_covariance_is_the_scatter():
    random = np.random.default_rng(4)
    total = 0.0
    for _ in range(TRIALS):
        truth = on_the_floor(random) @ transform(exp_so3(random.normal(0.0, 0.2, 3)), [0.0, 0.0, 0.5])
        sightings = sight(TWO, truth, random, SIGMA_PX)
        (found,) = solve([Body("rover", TWO, planar=False)], sightings, INTRINSICS, WORLD_FROM_CAMERA, arrival=1.1)
        pose = found.hypotheses[0]
        total += nees(truth, pose.position, pose.quaternion_wxyz, pose.covariance)
    assert LOWEST < total / TRIALS < HIGHEST


def test_planar_is_far_better_determined_than_six_unknowns():
    random = np.random.default_rng(5)
    planar, six = [], []
    for _ in range(50):
        truth = transform(rotation_about_z(random.uniform(-3, 3)), [random.uniform(-0.8, 0.8), 0.3, 0.0])
        sightings = sight(ONE, truth, random, SIGMA_PX)
        for errors, level in ((planar, True), (six, False)):
            (found,) = solve([Body("r", ONE, planar=level)], sightings, INTRINSICS, WORLD_FROM_CAMERA, arrival=1.1)
            errors.append(found.hypotheses[0].position[:2] - truth[:2, 3])
    assert np.std(planar) < 0.2 * np.std(six)
    assert np.std(planar) < 4e-4


def test_a_fix_without_noise_is_exact_and_carries_its_origin():
    truth = transform(rotation_about_z(2.5), [0.4, -0.3, 0.0])
    random = np.random.default_rng(6)
    for mounts in (ONE, TWO):
        sightings = [
            MarkerSighting(s.t, s.camera, s.id, s.corners_px, SIGMA_PX) for s in sight(mounts, truth, random, 0.0)
        ]
        (found,) = solve([Body("rover", mounts, planar=True)], sightings, INTRINSICS, WORLD_FROM_CAMERA, arrival=1.25)
        assert (found.robot, found.t, found.arrival, found.source) == ("rover", 1.0, 1.25, "ceiling")
        assert found.markers == tuple(mount.id for mount in mounts)
        np.testing.assert_allclose(found.hypotheses[0].position, truth[:3, 3], atol=1e-6)
        assert found.hypotheses[0].misfit < 1e-3


def test_a_flat_marker_seen_from_above_has_two_poses_one_of_them_true():
    random = np.random.default_rng(7)
    second_was_true = 0
    for _ in range(60):
        truth = transform(exp_so3([np.pi, 0.0, 0.0]) @ exp_so3(random.normal(0.0, 0.15, 3)), [0.1, 0.05, 3.0])
        corners = project(transform_points(truth, marker_corners(0.1)), INTRINSICS)[0]
        poses = marker_poses(corners + random.normal(0.0, 0.1, (4, 2)), 0.1, INTRINSICS, 0.1)
        assert len(poses) == 2
        assert poses[0].misfit <= poses[1].misfit
        errors = [_turned_by(pose, truth) for pose in poses]
        second_was_true += errors[1] < errors[0]
        assert min(errors) < 0.35
    # Both must be handed on: the reprojection error alone is wrong often.
    assert 5 < second_was_true < 30


def _turned_by(pose: MarkerPose, truth: np.ndarray) -> float:
    return float(np.linalg.norm(pose_error(truth, pose.camera_from_marker[:3, 3], pose.camera_from_marker[:3, :3])[3:]))


def test_what_cannot_be_is_no_fix():
    truth = transform(rotation_about_z(0.2), [0.4, -0.3, 0.0])
    random = np.random.default_rng(8)
    sightings = sight(ONE, truth, random, SIGMA_PX)
    body, other = Body("r", ONE, planar=True), Body("s", [MarkerMount(9, 0.1, np.eye(4))], planar=True)
    assert solve([body], [], INTRINSICS, WORLD_FROM_CAMERA, arrival=1.1) == []
    assert solve([other], sightings, INTRINSICS, WORLD_FROM_CAMERA, arrival=1.1) == []
    # A camera that looks up sees no floor.
    assert solve([body], sightings, INTRINSICS, transform(np.eye(3), [0.0, 0.0, 3.0]), arrival=1.1) == []
    assert marker_poses(np.zeros((4, 2)), 0.1, INTRINSICS, 0.1) == ()


def test_corners_that_contradict_the_model_widen_the_covariance():
    truth = transform(rotation_about_z(0.2), [0.4, -0.3, 0.0])
    sightings = sight(TWO, truth, np.random.default_rng(9), SIGMA_PX)
    wrong = MarkerSighting(1.0, "ceiling", 8, sightings[1].corners_px + 20.0, SIGMA_PX)
    good, bad = (
        solve([Body("r", TWO, planar=True)], seen, INTRINSICS, WORLD_FROM_CAMERA, arrival=1.1)[0].hypotheses[0]
        for seen in (sightings, [sightings[0], wrong])
    )
    assert bad.misfit > 100.0 * good.misfit
    # Of yaw, which height and tilt of the floor hardly touch
    assert bad.covariance[5, 5] > 100.0 * good.covariance[5, 5]


def test_chi_square_limit_is_the_quantile():
    # scipy.stats.chi2.ppf(0.999, k)
    for k, exact in ((2, 13.8155), (5, 20.5150), (13, 34.5282), (29, 58.3012)):
        assert fix.chi_square_limit(k) == pytest.approx(exact, rel=0.03)


def test_a_camera_believed_elsewhere_moves_the_fix_with_it():
    truth = transform(rotation_about_z(0.7), [0.5, 0.2, 0.0])
    sightings = [
        MarkerSighting(s.t, s.camera, s.id, s.corners_px, SIGMA_PX)
        for s in sight(ONE, truth, np.random.default_rng(10), 0.0)
    ]
    believed = transform(np.eye(3), [0.003, 0.0, 0.0]) @ WORLD_FROM_CAMERA
    found = solve([Body("r", ONE, planar=True)], sightings, INTRINSICS, believed, arrival=1.1)[0].hypotheses[0]
    np.testing.assert_allclose(found.position, truth[:3, 3] + [0.003, 0.0, 0.0], atol=1e-5)


def known_at(world_from_body, covariance=None, velocity=(0.0, 0.0, 0.0)):
    return Pose.of(
        "rover", 1.0, world_from_body[:3, 3], quaternion_from_rotation(world_from_body[:3, :3]), np.array(velocity),
        np.array([0.0, 0.0, 0.5]), np.diag([1e-4] * 3 + [1e-4] * 3) if covariance is None else covariance,
        np.eye(3), Mode.FULL, 0, 0.0,
    )  # fmt: skip


def test_markers_are_predicted_where_they_are_seen_as_far_as_the_pose_is_known():
    random, body = np.random.default_rng(11), Body("rover", TWO, planar=True)
    truth = on_the_floor(random)
    seen = {s.id: s.corners_px for s in sight(TWO, truth, random, 0.0)}
    predicted = predict([body], {"rover": known_at(truth)}, INTRINSICS, WORLD_FROM_CAMERA)
    assert predicted.keys() == seen.keys()
    for id, prediction in predicted.items():
        np.testing.assert_allclose(prediction.corners_px, seen[id], atol=1e-6)
    off = []
    for _ in range(200):
        shift = random.normal(0.0, 0.01, 6)
        off += [
            (s.corners_px - predicted[s.id].corners_px) / predicted[s.id].sigma_px
            for s in sight(TWO, moved(truth, shift), random, 0.0)
        ]
    # A bound that is not far away
    assert 0.4 < np.sqrt(np.mean(np.square(off))) < 1.0


def test_a_rolling_shutter_sees_what_moves_where_it_is_in_that_row():
    body, truth, velocity = Body("rover", ONE, planar=True), transform(np.eye(3), [0.3, 0.2, 0.0]), [1.0, -0.5, 0.0]
    line_time = 40e-6
    (prediction,) = predict(
        [body], {"rover": known_at(truth, velocity=velocity)}, INTRINSICS, WORLD_FROM_CAMERA, line_time
    ).values()
    later = line_time * prediction.corners_px[:, 1].mean()
    there = transform(rotation_about_z(0.5 * later), truth[:3, 3] + later * np.array(velocity))
    (seen,) = sight(ONE, there, np.random.default_rng(0), 0.0)
    np.testing.assert_allclose(prediction.corners_px, seen.corners_px, atol=0.02)


def test_what_cannot_be_seen_is_predicted_out_of_the_picture_and_what_is_lost_not_at_all():
    truth = transform(np.eye(3), [0.3, 0.2, 0.0])
    below = [MarkerMount(7, 0.1, transform(exp_so3([np.pi, 0.0, 0.0]), [0.0, 0.0, -0.1]))]
    for mounts, pose in ((below, truth), (ONE, transform(np.eye(3), [0.0, 0.0, 9.0]))):
        (prediction,) = predict(
            [Body("rover", mounts, planar=True)], {"rover": known_at(pose)}, INTRINSICS, WORLD_FROM_CAMERA
        ).values()
        assert prediction.corners_px.max() < -1e5
    for covariance in (np.diag([4.0, 1e-4, 1e-4, 1e-4, 1e-4, 1e-4]), np.full((6, 6), np.inf)):
        poses = {"rover": known_at(truth, covariance)}
        assert predict([Body("rover", ONE, planar=True)], poses, INTRINSICS, WORLD_FROM_CAMERA) == {}
    assert predict([Body("cart", ONE, planar=True)], {"rover": known_at(truth)}, INTRINSICS, WORLD_FROM_CAMERA) == {}
