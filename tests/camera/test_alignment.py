import cv2
import numpy as np
import pytest

from camera.alignment import Alignment
from camera.dictionaries import dictionary_by_name
from camera.synthetic import Room
from fusion.geometry import rotation_about_z, transform
from tests.camera.scene import INTRINSICS, WORLD_FROM_CAMERA

DICTIONARY = dictionary_by_name("4X4_50")
ALIGNMENTS = {
    id: Alignment(np.pad(cv2.aruco.generateImageMarker(DICTIONARY, id, 6) / 255.0, 2, constant_values=1.0))
    for id in (3, 4)
}
ROOM = Room(INTRINSICS, WORLD_FROM_CAMERA, "4X4_50", 2)


def marker(side_px, moved_px=0.0, **light):
    """A picture of marker 3, moved during its exposure, and its corners in the middle of that."""
    size = side_px * 2.9 / 600.0
    start = transform(rotation_about_z(0.7), [0.2, 0.1, 0.1])
    end = transform(np.eye(3), [0.8 * moved_px * 2.9 / 600.0, 0.6 * moved_px * 2.9 / 600.0, 0.0]) @ start
    truth = 0.5 * (ROOM.corners_px(size, start) + ROOM.corners_px(size, end))
    return ROOM.render({3: (size, start, end)}, **light), truth


def displaced(corners, shift_px, turn):
    middle = corners.mean(axis=0)
    return (corners - middle) @ rotation_about_z(turn)[:2, :2] + middle + shift_px


@pytest.mark.parametrize(
    ("case", "limit_px"),
    [
        ({"side_px": 45}, 0.15),
        ({"side_px": 30, "moved_px": 8.0}, 0.3),
        ({"side_px": 45, "moved_px": 12.0}, 0.6),
        ({"side_px": 45, "blur_px": 3.5}, 0.3),
        ({"side_px": 45, "brightness": 0.12, "noise": 3.0}, 0.3),
    ],
    ids=["sharp", "moved by 8 px", "moved by 12 px", "defocus", "dark"],
)
def test_a_marker_is_found_to_a_part_of_a_pixel_and_its_sigma_says_so(case, limit_px):
    image, truth = marker(**case)
    corners, sigma_px, score = ALIGNMENTS[3].fit(image, displaced(truth, [2.0, -1.5], 0.03))
    error = np.sqrt(np.mean(np.square(corners - truth)))
    assert error < limit_px
    assert error < 2.0 * sigma_px
    assert score > 0.9


@pytest.mark.parametrize("moved_px", [0.0, 12.0])
def test_what_is_not_there_does_not_fit(moved_px):
    image, truth = marker(45, moved_px)
    assert ALIGNMENTS[4].fit(image, truth)[2] < 0.85
    assert ALIGNMENTS[3].fit(ROOM.render({}), truth)[2] < 0.6
    corners, _, score = ALIGNMENTS[3].fit(np.zeros_like(image), truth)
    assert score == 0.0
    assert np.isfinite(corners).all()
