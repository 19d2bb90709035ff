"""The guide, with people who do what it says, and with some who do not."""

import cv2
import numpy as np
import pytest

from camera.boards import BoardView, parse_board
from camera.calibration import CalibrationError
from camera.guide import Guide
from fusion.geometry import exp_so3, transform
from tests.camera.board_views import CAMERA, Studio

MIDDLE = np.array([[150.0, 120.0], [490.0, 120.0], [490.0, 360.0], [150.0, 360.0]])


class Person:
    """Holds a board where it is wanted, as well as people can, and still for two pictures."""

    def __init__(self, spec, seed=0):
        self.board = parse_board(spec)
        across, down = self.board.squares
        self._edge = self.board.square * np.array([[0.0, 0, 0], [across, 0, 0], [across, down, 0], [0, down, 0]])
        self._random = np.random.default_rng(seed)

    def hold(self, target_px):
        _, rotation, translation = cv2.solvePnP(
            self._edge, target_px, CAMERA.camera_matrix, CAMERA.distortion, flags=cv2.SOLVEPNP_IPPE
        )
        wobble = exp_so3(np.radians(self._random.normal(0.0, 6.0, 3)))
        return transform(exp_so3(rotation.ravel()) @ wobble, translation.ravel() * self._random.normal(1.0, 0.05))

    def view(self, camera_from_board, sigma_px=0.05):
        points = self.board.corners @ camera_from_board[:3, :3].T + camera_from_board[:3, 3]
        pixels = cv2.projectPoints(points, np.zeros(3), np.zeros(3), CAMERA.camera_matrix, CAMERA.distortion)[0]
        pixels = pixels.reshape(-1, 2) + self._random.normal(0.0, sigma_px, (len(points), 2))
        inside = ((pixels > 2.0) & (pixels < (637.0, 477.0))).all(axis=1)
        if inside.sum() < 8 or (self.board.kind == "chessboard" and not inside.all()):
            return None
        return BoardView("", np.flatnonzero(inside), pixels[inside], 640, 480)


@pytest.mark.parametrize("spec", ["charuco:8x6:30mm", "chessboard:9x6:25mm"])
@pytest.mark.parametrize("seed", [0, 1])
def test_who_does_what_it_says_is_done_soon_and_well(spec, seed):
    person, guide = Person(spec, seed), Guide(parse_board(spec))
    target, texts = MIDDLE, []
    for _ in range(60):
        pose = person.hold(target)
        guide.feed(person.view(pose))
        step = guide.feed(person.view(pose))
        texts.append(step.text)
        if step.target_px is not None:
            target = step.target_px
        if step.done:
            break
    assert guide.done
    assert texts[-1] == "Done"
    assert len(guide.views) < 30
    assert all(criterion.met and criterion.part == 1.0 for criterion in guide.criteria)
    # It has asked for corners and for tilts to several sides; some come by themselves.
    assert any("corner" in text for text in texts)
    assert sum(any(f"{edge} edge away" in text for text in texts) for edge in ("left", "right", "top", "bottom")) >= 3
    found = guide.calibration.intrinsics.camera_matrix
    assert np.abs(found - CAMERA.camera_matrix).max() < 4.0 * np.sqrt(np.diag(guide.calibration.covariance)[:4]).max()


def test_a_tilt_that_is_asked_for_is_the_tilt_that_is_counted():
    """The edge that it names is further away in the view that it then takes."""
    person, guide = Person("charuco:8x6:30mm", 3), Guide(parse_board("charuco:8x6:30mm"))
    target, asked, answers = MIDDLE, "", []
    for _ in range(40):
        pose = person.hold(target)
        guide.feed(person.view(pose))
        step = guide.feed(person.view(pose))
        if step.kept and asked:
            right, bottom = pose[2, 0], pose[2, 1]
            answers.append({"left": right < 0, "right": right > 0, "top": bottom < 0, "bottom": bottom > 0}[asked])
        asked = step.text.split(" edge")[0].split()[-1] if step.text.startswith("Tilt") else ""
        if step.target_px is not None:
            target = step.target_px
    assert len(answers) >= 4
    assert np.mean(answers) > 0.8


def test_a_board_that_is_moved_or_stays_where_it_was_is_not_taken():
    person, guide = Person("charuco:8x6:30mm"), Guide(parse_board("charuco:8x6:30mm"))
    pose = person.hold(MIDDLE)
    first = guide.feed(person.view(pose))
    assert (first.text, first.kept) == ("Hold it still", False)
    assert guide.feed(person.view(pose)).kept
    for _ in range(20):
        assert not guide.feed(person.view(pose)).kept
    # It moves by 6 px from picture to picture.
    for k in range(20):
        shifted = transform(np.eye(3), [0.003 * k, 0.0, 0.0]) @ pose
        assert not guide.feed(person.view(shifted)).kept
    assert len(guide.views) == 1


def test_a_quarter_turn_is_shown_as_one():
    """Where all else is there, views are wanted of the turned board: its top left corner at the picture's right."""
    person, guide = Person("charuco:8x6:30mm"), Guide(parse_board("charuco:8x6:30mm"))
    target = MIDDLE
    for _ in range(60):
        pose = person.hold(target)
        guide.feed(person.view(pose))
        step = guide.feed(person.view(pose))
        if step.text.startswith("Turn the board by a quarter"):
            break
        target = target if step.target_px is None else step.target_px
    left_top, right_top, _, left_bottom = step.target_px
    across, down = right_top - left_top, left_bottom - left_top
    assert abs(across[0]) < 1e-9 < across[1]
    assert down[0] < 0.0
    assert abs(across[1] / down[0]) == pytest.approx(8 / 6)


def test_no_board_and_a_board_that_goes_away():
    person, guide = Person("charuco:8x6:30mm"), Guide(parse_board("charuco:8x6:30mm"))
    assert guide.feed(None).text == "Hold the board into the picture"
    pose = person.hold(MIDDLE)
    for _ in range(3):  # seen in every other picture, it is never known to stand still
        assert not guide.feed(person.view(pose)).kept
        assert not guide.feed(None).kept
    assert guide.views == []


def test_a_board_that_only_faces_the_camera_never_gets_there():
    person, guide = Person("charuco:8x6:30mm"), Guide(parse_board("charuco:8x6:30mm"))
    studio = Studio(person.board)
    for k in range(24):
        pose = studio.held((0.2 + 0.12 * (k % 6), 0.2 + 0.2 * (k // 6)), 0.42)
        guide.feed(person.view(pose))
        guide.feed(person.view(pose))
    assert len(guide.views) >= 20
    assert {c.name for c in guide.criteria if not c.met} >= {"tilt", "focal"}
    step = guide.feed(person.view(pose))
    assert step.text.startswith(("Tilt the board", "Move the board", "Further"))
    # What it draws stays in the picture though nobody knows the focal length.
    assert np.abs(step.outline_px - (320.0, 240.0)).max() < 640.0
    # Once the board is tilted, it is.
    for k in range(16):
        view = person.view(studio.held((0.3 + 0.1 * (k % 4), 0.3 + 0.1 * (k // 4)), 0.42, 30.0, 70.0 * k))
        guide.feed(view)
        guide.feed(view)
    assert "tilt" not in {c.name for c in guide.criteria if not c.met}
    assert "focal" not in {c.name for c in guide.criteria if not c.met}


def test_a_camera_that_changes_its_size_is_refused():
    person, guide = Person("charuco:8x6:30mm"), Guide(parse_board("charuco:8x6:30mm"))
    studio = Studio(person.board)
    views = [person.view(studio.held((0.2 + 0.15 * k, 0.5), 0.42, 20.0)) for k in range(5)]
    for view in views[:4]:
        guide.feed(view)
        assert guide.feed(view).kept
    wide = BoardView("wide", views[4].indices, views[4].corners_px, 1280, 480)
    guide.feed(wide)
    with pytest.raises(CalibrationError, match=r"wide is 1280 x 480 px, .* 640 x 480 px"):
        guide.feed(wide)
