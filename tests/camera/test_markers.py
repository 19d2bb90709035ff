import json

import cv2
import numpy as np
import pytest

from camera.capture import read_image
from camera.dictionaries import DICTIONARIES, DictionaryError, dictionary_by_name
from camera.edges import refine_corners
from camera.images import grey
from camera.markers import MarkerDetector
from camera.synthetic import Room
from fusion.geometry import exp_so3, rotation_about_z, transform
from tests.camera.scene import INTRINSICS, WORLD_FROM_CAMERA
from tests.data import data


def frame(side_px, seed=0, dictionary="4X4_50", moved_px=0.0, **light):
    """A rendered frame with six markers of about `side_px`, turned at random, and where their corners are."""
    random = np.random.default_rng(seed)
    room = Room(INTRINSICS, WORLD_FROM_CAMERA, dictionary, seed)
    size = side_px * 2.9 / 600.0
    markers = {}
    for id in range(6):
        x, y = (id % 3 - 1) * 0.8 + random.uniform(-0.1, 0.1), (id // 3 - 0.1) * 1.0 + random.uniform(-0.1, 0.1)
        start = transform(rotation_about_z(random.uniform(-3, 3)) @ exp_so3(random.normal(0, 0.05, 3)), [x, y, 0.1])
        end = transform(np.eye(3), [moved_px * 2.9 / 600.0, 0.0, 0.0]) @ start
        markers[id] = (size, start, end)
    truth = {
        id: 0.5 * (room.corners_px(size, start) + room.corners_px(size, end)) for id, (_, start, end) in markers.items()
    }
    return room.render(markers, **light), truth


def errors(sightings, truth):
    return np.array([sighting.corners_px - truth[sighting.id] for sighting in sightings])


@pytest.mark.parametrize(
    ("side_px", "limit"), [(15, 0.06), (20, 0.04), (30, 0.04), (45, 0.04), (60, 0.04)], ids=lambda v: str(v)
)
def test_corners_on_clean_frames(side_px, limit):
    image, truth = frame(side_px)
    found = MarkerDetector("4X4_50").search(image)
    assert [sighting.id for sighting in found] == list(range(6))
    assert np.sqrt(np.mean(errors(found, truth) ** 2)) < limit
    assert all(0.1 <= sighting.sigma_px < 0.35 for sighting in found)


HARD = {
    "small": {"side_px": 13},
    "small AprilTags": {"side_px": 17, "dictionary": "APRILTAG_36H11"},
    "small and blurred": {"side_px": 20, "blur_px": 1.5},
    "blurred": {"side_px": 45, "blur_px": 3.5},
    "moving": {"side_px": 45, "moved_px": 8.0},
    "dark": {"side_px": 45, "brightness": 0.12},
    "all but black": {"side_px": 45, "brightness": 0.06},
    "noisy": {"side_px": 30, "noise": 12.0},
}


@pytest.mark.parametrize("case", HARD)
def test_hard_frames_lose_no_marker_and_claim_no_accuracy_they_lack(case):
    image, truth = frame(**HARD[case])
    found = MarkerDetector(HARD[case].get("dictionary", "4X4_50")).search(image)
    assert [sighting.id for sighting in found] == list(range(6))
    over_sigma = errors(found, truth) / np.array([sighting.sigma_px for sighting in found])[:, None, None]
    assert np.sqrt(np.mean(over_sigma**2)) < 1.5


def test_motion_and_blur_show_in_sigma():
    sharp, blurred = (MarkerDetector("4X4_50").search(frame(30, blur_px=blur)[0]) for blur in (0.6, 2.5))
    assert blurred[0].sigma_px > 2.0 * sharp[0].sigma_px


def test_refinement_that_goes_astray_keeps_what_it_was_given():
    image, truth = frame(45)
    off = truth[0] + 12.0
    flat = np.full((480, 640), 128, np.uint8)
    for picture, start in ((image, off), (flat, truth[0])):
        corners, sigma, _ = refine_corners(picture, start[None], 6)
        np.testing.assert_array_equal(corners[0], start)
        assert sigma[0] >= 0.8


def test_an_unwanted_marker_is_not_taken_for_a_wanted_one():
    image, _ = frame(30)
    assert [s.id for s in MarkerDetector("4X4_50", ids=[2, 40]).search(image)] == [2]
    assert MarkerDetector("4X4_50", ids=range(20, 50)).search(image) == []
    assert MarkerDetector("5X5_100").search(image) == []


def test_the_same_marker_twice_is_two_sightings():
    image, _ = frame(45)
    half = image[:, :320]
    found = MarkerDetector("4X4_50").search(np.hstack([half, half]))
    ids = [sighting.id for sighting in found]
    assert ids
    assert all(ids.count(id) == 2 for id in ids)


def test_nothing_is_found_on_an_empty_floor_or_in_noise():
    detector = MarkerDetector("4X4_50")
    random = np.random.default_rng(1)
    for image in (
        Room(INTRINSICS, WORLD_FROM_CAMERA, "4X4_50", 5).render({}),
        random.integers(0, 256, (240, 320)).astype(np.uint8),
        np.zeros((64, 64), np.uint8),
        np.full((3, 5), 255, np.uint8),
        np.full((1, 1), 255, np.uint8),
    ):
        assert detector.search(image) == []


def test_every_kind_of_image_gives_the_same():
    image, truth = frame(45)
    detector = MarkerDetector("4X4_50")
    colour = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
    kinds = {
        "grey with a channel": image[..., None],
        "colour": colour,
        "with alpha": cv2.cvtColor(image, cv2.COLOR_GRAY2BGRA),
        "16 bits": image.astype(np.uint16) * 257,
        "12 bits in 16, colour": colour.astype(np.uint16) * 16,
        "not contiguous": np.asfortranarray(image),
    }
    for kind, picture in kinds.items():
        found = detector.search(picture)
        assert [sighting.id for sighting in found] == list(range(6)), kind
        assert np.abs(errors(found, truth)).max() < 0.25, kind
    for wrong in (image.astype(np.float32), image[..., None].repeat(2, axis=2), np.zeros((0, 4), np.uint8)):
        with pytest.raises(ValueError, match="needed"):
            grey(wrong)


def test_dictionaries_by_name():
    assert {"4X4_50", "5X5_1000", "APRILTAG_36H11", "ARUCO_MIP_36H12", "ARUCO_ORIGINAL"} <= set(DICTIONARIES)
    for name in ("4X4_50", "4x4_50", "DICT_4X4_50", " dict_4x4_50 "):
        assert dictionary_by_name(name).markerSize == 4
    for name in DICTIONARIES:
        assert len(dictionary_by_name(name).bytesList)
    with pytest.raises(DictionaryError, match=r"'APRILTAG_36H1'; did you mean APRILTAG_36H1[01].* 4X4_50,"):
        MarkerDetector("APRILTAG_36H1")
    with pytest.raises(ValueError, match=r"ids 0 to 49, not \[50\]"):
        MarkerDetector("4X4_50", ids=[3, 50])


def test_photographs_every_id_within_half_a_pixel_and_none_besides():
    folder = data("aruco_photos")
    truth = json.loads((folder / "truth.json").read_text())
    for name, expected in truth.items():
        found = MarkerDetector(expected["dictionary"]).search(read_image(folder / name))
        ids = expected.get("ids") or [int(id) for id in expected["markers"]]
        assert [sighting.id for sighting in found] == sorted(ids), name
        for sighting in found if "markers" in expected else []:
            known = slice(2) if str(sighting.id) in expected.get("only_first_two_corners_of", []) else slice(4)
            error = sighting.corners_px - expected["markers"][str(sighting.id)]
            assert np.linalg.norm(error[known], axis=1).max() < 0.5, (name, sighting.id)


def test_photographs_of_other_markers_and_of_a_chessboard_show_none():
    photographs = [
        data("aruco_photos") / "singlemarkersoriginal.jpg",
        data("chessboard_photos") / "left07.jpg",
        data("chessboard_photos") / "left11.jpg",
    ]
    for dictionary in ("4X4_50", "5X5_50", "APRILTAG_36H11"):
        detector = MarkerDetector(dictionary)
        for path in photographs:
            assert detector.search(read_image(path)) == [], (dictionary, path.name)
