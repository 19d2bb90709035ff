import numpy as np
import pytest

from camera.fix import project, rays
from camera.markers import MarkerSighting
from camera.shake import SIGMA_PRIOR, measure_shake, shaken
from fusion.geometry import exp_so3, log_so3
from tests.camera.scene import INTRINSICS, WORLD_FROM_CAMERA

CORNERS = np.array([[-20.0, -20.0], [20.0, -20.0], [20.0, 20.0], [-20.0, 20.0]])
AT_REST = {
    id: np.array(middle) + CORNERS
    for id, middle in {40: [90.0, 80.0], 41: [550.0, 90.0], 42: [540.0, 400.0], 43: [320.0, 250.0]}.items()
}
SIGMA_PX = 0.1


def sighted(rotation, random=None, ids=(40, 41, 42, 43), sigma_px=SIGMA_PX):
    """The anchors as a camera sees them that is turned by `rotation`, rad, about its own axes."""
    sightings = []
    for id in ids:
        corners = project(rays(AT_REST[id], INTRINSICS) @ exp_so3(rotation), INTRINSICS)[0]
        if random is not None:
            corners = corners + random.normal(0.0, sigma_px, (4, 2))
        sightings.append(MarkerSighting(1.0, "ceiling", id, corners, sigma_px))
    return sightings


@pytest.mark.parametrize("rotation", [[0.002, -0.001, 0.0015], [-0.02, 0.015, 0.03]], ids=["small", "two degrees"])
def test_the_rotation_is_found(rotation):
    found = measure_shake(AT_REST, sighted(rotation), INTRINSICS)
    assert found is not None
    # The prior takes a part of it that is as small as the variance is against the prior's.
    np.testing.assert_allclose(log_so3(found.rotation), rotation, rtol=0.02, atol=1e-6)


@pytest.mark.parametrize("ids", [(40, 41, 42, 43), (43,)], ids=["four anchors", "one"])
def test_covariance_is_the_scatter(ids):
    random, trials, total = np.random.default_rng(1), 300, 0.0
    for _ in range(trials):
        truth = random.normal(0.0, SIGMA_PRIOR, 3)
        found = measure_shake(AT_REST, sighted(truth, random, ids), INTRINSICS)
        error = log_so3(found.rotation @ exp_so3(truth).T)
        total += error @ np.linalg.solve(found.covariance, error)
    # .0005 and .9995 quantiles, normal approximation
    assert abs(total / trials - 3.0) < 3.29 * np.sqrt(6.0 / trials)


def test_one_anchor_that_moved_is_left_out_and_two_against_each_other_say_nothing():
    rotation = [0.003, 0.002, -0.001]
    sightings = sighted(rotation)
    sightings[1] = MarkerSighting(1.0, "ceiling", 41, sightings[1].corners_px + 6.0, SIGMA_PX)
    found = measure_shake(AT_REST, sightings, INTRINSICS)
    np.testing.assert_allclose(log_so3(found.rotation), rotation, rtol=0.02, atol=1e-6)
    assert measure_shake(AT_REST, sightings[:2], INTRINSICS) is None
    assert measure_shake(AT_REST, [], INTRINSICS) is None
    assert measure_shake({}, sightings, INTRINSICS) is None


def test_the_camera_turns_where_it_hangs():
    found = measure_shake(AT_REST, sighted([0.002, 0.0, 0.0]), INTRINSICS)
    pose, covariance = shaken(WORLD_FROM_CAMERA, 1e-6 * np.eye(6), found)
    np.testing.assert_array_equal(pose[:3, 3], WORLD_FROM_CAMERA[:3, 3])
    # What was seen at rest along r is seen along R^T r: both are the same direction in the world.
    r = np.array([0.1, 0.2, 1.0])
    np.testing.assert_allclose(pose[:3, :3] @ found.rotation.T @ r, WORLD_FROM_CAMERA[:3, :3] @ r, atol=1e-12)
    assert np.trace(covariance[3:, 3:]) > 3e-6
