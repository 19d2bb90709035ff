import json

import cv2
import numpy as np
import pytest

from camera.capture import read_image
from camera.synthetic import Room
from camera.tracking import SEARCH_EVERY, STILL_AT_ONCE, MarkerTracker, Prediction
from fusion.geometry import rotation_about_z, transform
from tests.camera.scene import INTRINSICS, WORLD_FROM_CAMERA
from tests.camera.test_markers import HARD, errors, frame
from tests.data import data

RATE_HZ = 30.0
ROOM = Room(INTRINSICS, WORLD_FROM_CAMERA, "4X4_50", 3)
# 45 px
SIZE = 0.2175


def drive(k, rate_hz=RATE_HZ):
    """world_from_marker of a marker on a robot that drives a curve at 0.9 m/s and 1 rad/s, in frame k."""
    angle = k / rate_hz
    return transform(rotation_about_z(angle), [0.9 * np.sin(angle), 0.4 - 0.9 * np.cos(angle), 0.1])


def seen(pose, **light):
    return ROOM.render({7: (SIZE, pose, pose)}, **light), ROOM.corners_px(SIZE, pose)


EMPTY = ROOM.render({})


def test_what_moves_is_followed_by_its_own_motion():
    tracker = MarkerTracker("4X4_50", ids=[7])
    for k in range(30):
        image, truth = seen(drive(k))
        (sighting,) = tracker.track(image, k / RATE_HZ, "ceiling")
        assert (sighting.id, sighting.t, sighting.camera) == (7, k / RATE_HZ, "ceiling")
        assert np.abs(sighting.corners_px - truth).max() < 0.25, k


def test_followed_by_predictions_where_its_own_motion_says_nothing():
    random = np.random.default_rng(1)
    tracker = MarkerTracker("4X4_50", ids=[7])
    for k in range(8):
        # 2 frames a second and turns between them: the last place is of no use.
        image, truth = seen(drive(k, 0.7))
        prediction = Prediction(truth + random.normal(0.0, 1.0, (1, 2)), 1.0)
        (sighting,) = tracker.track(image, k / 2.0, predictions={7: prediction})
        assert np.abs(sighting.corners_px - truth).max() < 0.25, k


def test_a_prediction_is_no_measurement():
    tracker = MarkerTracker("4X4_50", ids=[7])
    image, truth = seen(drive(0))
    assert len(tracker.track(image, 0.0)) == 1
    # A robot that has gone, on a floor with texture and in the dark, where its filter still believes it to be
    for k, picture in enumerate((EMPTY, ROOM.render({}, brightness=0.1), np.zeros_like(EMPTY)) * 3):
        assert tracker.track(picture, (k + 1) / RATE_HZ, predictions={7: Prediction(truth, 0.5)}) == []


def test_another_marker_at_its_place_is_not_taken_for_it():
    tracker = MarkerTracker("4X4_50", ids=[7])
    image, truth = seen(drive(0))
    tracker.track(image, 0.0)
    other = ROOM.render({8: (SIZE, drive(0), drive(0))})
    for k in range(12):
        assert tracker.track(other, (k + 1) / RATE_HZ, predictions={7: Prediction(truth, 0.5)}) == []


def test_what_comes_back_is_found_by_the_next_search():
    tracker = MarkerTracker("4X4_50", ids=[7])
    image, _ = seen(drive(0))
    tracker.track(image, 0.0)
    assert [tracker.track(EMPTY, k / RATE_HZ) for k in range(1, 25)] == [[]] * 24
    assert any(tracker.track(image, (25 + k) / RATE_HZ) for k in range(SEARCH_EVERY))


def test_a_slow_camera_searches_every_frame():
    tracker = MarkerTracker("4X4_50", ids=[7])
    image, _ = seen(drive(0))
    for k in range(3):
        assert tracker.track(EMPTY, 0.5 * k) == []
    assert len(tracker.track(image, 2.0)) == 1


def test_of_many_markers_at_rest_each_has_its_turn():
    image, _ = frame(45)
    tracker = MarkerTracker("4X4_50", ids=range(6), still=range(6))
    assert [len(tracker.track(image, k / RATE_HZ)) for k in range(2)] == [6, 6]  # search, and sweep for repeated ones
    seen = [{s.id for s in tracker.track(image, k / RATE_HZ)} for k in range(2, 8)]
    assert [len(ids) for ids in seen] == [STILL_AT_ONCE] * 6
    assert all(sum(id in ids for ids in seen) >= 3 for id in range(6))


def test_photographs_are_followed_where_they_move():
    folder = data("aruco_photos")
    for name, expected in json.loads((folder / "truth.json").read_text()).items():
        if "markers" not in expected:
            continue
        image = read_image(folder / name)
        tracker = MarkerTracker(expected["dictionary"], [int(id) for id in expected["markers"]])
        for k in range(4):
            shift = np.array([5.3, -3.7]) * k
            moved = cv2.warpAffine(image, np.column_stack([np.eye(2), shift]), image.shape[1::-1])
            sightings = tracker.track(moved, k / RATE_HZ)
            assert len(sightings) == len(expected["markers"])
            for sighting in sightings:
                known = slice(2) if str(sighting.id) in expected.get("only_first_two_corners_of", []) else slice(4)
                error = sighting.corners_px - shift - expected["markers"][str(sighting.id)]
                assert np.linalg.norm(error[known], axis=1).max() < 0.5, (name, sighting.id, k)


@pytest.mark.parametrize("case", ["dark", "small", "blurred"])
def test_hard_frames_are_searched_as_by_a_detector_and_then_followed(case):
    image, truth = frame(**HARD[case])
    tracker = MarkerTracker("4X4_50", ids=range(6))
    sides = [float(np.linalg.norm(corners[1] - corners[0])) for corners in truth.values()]
    tracker.sides_px = min(sides), max(sides)
    # Searches, as many as there are ways to look, and then a few frames in which what was found is followed.
    for k in range(8):
        sightings = tracker.track(image, min(0.5 * k, 2.0 + k / RATE_HZ))
    assert [sighting.id for sighting in sightings] == list(range(6))
    over_sigma = errors(sightings, truth) / np.array([sighting.sigma_px for sighting in sightings])[:, None, None]
    assert np.sqrt(np.mean(over_sigma**2)) < 1.5


def test_a_filter_that_is_wrong_does_not_lose_what_is_in_view():
    tracker = MarkerTracker("4X4_50", ids=[7, 8])
    for k in range(1, 20):
        image, truth = seen(drive(k))
        elsewhere = Prediction(truth + 60.0, 0.5)
        sightings = tracker.track(image, k / RATE_HZ, predictions={7: elsewhere} if k > 1 else {})
        assert [sighting.id for sighting in sightings] == [7], k
        assert np.abs(sightings[0].corners_px - truth).max() < 0.25


def test_what_is_predicted_out_of_the_picture_is_not_searched():
    image, truth = seen(drive(0))
    for shift, found in (([-2000.0, 0.0], 0), ([0.0, 1e6], 0), ([20.0, 0.0], 1)):
        tracker = MarkerTracker("4X4_50", ids=[7])
        prediction = {7: Prediction(truth + shift, 2.0)}
        assert tracker.track(EMPTY, 0.0, predictions=prediction) == []
        assert len(tracker.track(image, 1.0, predictions=prediction)) == found


def test_a_hidden_anchor_costs_no_search_and_is_seen_when_it_is_free_again():
    def anchors(*places):
        poses = {id: transform(np.eye(3), [x, 0.2, 0.0]) for id, x in enumerate(places)}
        return ROOM.render({id: (SIZE, pose, pose) for id, pose in poses.items()})

    tracker = MarkerTracker("4X4_50", ids=[0, 1], still=[0, 1])
    both = anchors(-0.3, 0.3)
    for k in range(2):
        assert len(tracker.track(both, k / RATE_HZ)) == 2
    # Somewhere else it is not found, since it is not searched, ...
    moved = anchors(-0.3, 0.8)
    assert [len(tracker.track(moved, k / RATE_HZ)) for k in range(2, 25)] == [1] * 23
    assert any(len(tracker.track(both, (25 + k) / RATE_HZ)) == 2 for k in range(SEARCH_EVERY))
    # ... unless it stays there, ...
    assert len(tracker.track(moved, 10.0)) == 2
    # ... and if no other one is where it was either, the camera has moved, and a search finds them.
    assert len(tracker.track(anchors(-0.6, -0.1), 10.1)) == 2
