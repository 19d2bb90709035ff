import time

import cv2
import numpy as np
import pytest

from camera.calibration import Intrinsics
from camera.edges import refine_corners
from camera.markers import MarkerDetector
from camera.synthetic import Room
from fusion.geometry import exp_so3, rotation_about_z, transform
from tests.camera.scene import INTRINSICS, WORLD_FROM_CAMERA


@pytest.fixture(scope="module")
def room():
    return Room(INTRINSICS, WORLD_FROM_CAMERA, "4X4_50", seed=1)


def at(x, y, yaw, height=0.1):
    return transform(rotation_about_z(yaw), [x, y, height])


def test_the_same_seed_gives_the_same_frames():
    pose = at(0.2, 0.1, 0.3)
    frames = [Room(INTRINSICS, WORLD_FROM_CAMERA, "4X4_50", seed).render({3: (0.2, pose, pose)}) for seed in (1, 1, 2)]
    assert frames[0].shape == (480, 640)
    assert frames[0].dtype == np.uint8
    np.testing.assert_array_equal(frames[0], frames[1])
    assert (frames[0] != frames[2]).mean() > 0.5


def test_edges_are_where_projection_says(room):
    pose = at(0.3, -0.2, 0.5) @ transform(exp_so3([0.2, -0.1, 0.0]), [0.0, 0.0, 0.0])
    image = room.render({3: (0.3, pose, pose)}, noise=0.0, blur_px=0.0)
    corners, _, _ = refine_corners(image, room.corners_px(0.3, pose)[None], 6)
    np.testing.assert_allclose(corners[0], room.corners_px(0.3, pose), atol=0.15)
    soft = room.render({3: (0.3, pose, pose)}, noise=0.0)
    corners, _, _ = refine_corners(soft, room.corners_px(0.3, pose)[None], 6)
    np.testing.assert_allclose(corners[0], room.corners_px(0.3, pose), atol=0.06)


def test_motion_blurs_along_the_path_around_its_middle(room):
    start, end = at(0.10, 0.0, 0.0), at(0.14, 0.0, 0.0)
    sharp = room.render({5: (0.3, at(0.12, 0.0, 0.0), at(0.12, 0.0, 0.0))}, noise=0.0).astype(float)
    blurred = room.render({5: (0.3, start, end)}, noise=0.0).astype(float)
    # Blur does not move the centre of gravity.
    x = np.arange(640)
    empty = room.render({}, noise=0.0).astype(float)
    centres = [((frame - empty) * x).sum() / (frame - empty).sum() for frame in (sharp, blurred)]
    assert centres[0] == pytest.approx(centres[1], abs=0.3)
    middle = room.corners_px(0.3, at(0.12, 0.0, 0.0))
    found = MarkerDetector("4X4_50").search(blurred.astype(np.uint8))
    np.testing.assert_allclose(found[0].corners_px, middle, atol=0.6)
    assert found[0].sigma_px > 0.1


def test_markers_out_of_the_picture_are_left_out(room):
    empty = room.render({}, noise=0.0)
    beside, behind = at(9.0, 0.0, 0.0), at(0.0, 0.0, 0.0, height=5.0)
    image = room.render({1: (0.2, beside, beside), 2: (0.2, behind, behind)}, noise=0.0)
    np.testing.assert_array_equal(image, empty)
    half = at(1.45, 0.1, 0.0)
    assert (room.render({1: (0.2, half, half)}, noise=0.0) != empty).any()


def test_anchors_that_lie_still_are_drawn_again_when_they_change(room):
    here, there = at(-0.4, 0.1, 0.0, 0.0), at(0.4, 0.1, 0.0, 0.0)
    first = room.render({40: (0.2, here, here)}, noise=0.0)
    again = room.render({40: (0.2, here, here)}, noise=0.0)
    moved = room.render({40: (0.2, there, there)}, noise=0.0)
    np.testing.assert_array_equal(first, again)
    assert (first != moved).sum() > 1000


def test_light_and_noise_are_as_asked(room):
    full, dim = (room.render({}, noise=0.0, brightness=b).mean() for b in (1.0, 0.3))
    assert dim == pytest.approx(0.3 * full, rel=0.03)
    difference = room.render({}, noise=4.0).astype(float) - room.render({}, noise=0.0)
    assert difference.std() == pytest.approx(4.0, rel=0.1)
    assert abs(difference.mean()) < 0.2


def test_rendering_needs_an_image_size():
    unknown = Intrinsics(INTRINSICS.camera_matrix, INTRINSICS.distortion)
    with pytest.raises(ValueError, match="width_px"):
        Room(unknown, WORLD_FROM_CAMERA, "4X4_50")


@pytest.mark.long
def test_a_frame_is_rendered_in_time(room):
    cv2.setNumThreads(1)
    matrix = np.array([[900.0, 0.0, 543.5], [0.0, 900.0, 543.5], [0.0, 0.0, 1.0]])
    big = Room(Intrinsics(matrix, INTRINSICS.distortion, 1088, 1088), WORLD_FROM_CAMERA, "4X4_50")
    markers = {40 + k: (0.15, at(k - 1.5, 1.0, 0.0, 0.0), at(k - 1.5, 1.0, 0.0, 0.0)) for k in range(4)}
    markers |= {k: (0.1, at(k - 1.0, 0.0, 0.0), at(k - 0.995, 0.0, 0.01)) for k in range(3)}
    big.render(markers)
    begin = time.process_time()
    for _ in range(20):
        big.render(markers)
    assert (time.process_time() - begin) / 20 < 0.05
