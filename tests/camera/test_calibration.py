import datetime
import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from camera.boards import BoardDetector, BoardView, parse_board
from camera.calibration import (
    CELLS,
    CalibrationError,
    Intrinsics,
    calibrate,
    coverage,
    judge,
    load_intrinsics,
    place_in_words,
    projection_sigma_px,
    save_intrinsics,
)
from camera.capture import read_image
from fusion.geometry import exp_so3, transform
from tests.camera.board_views import CAMERA, Studio, good_poses
from tests.data import data

GOOD = """
width_px = 640
height_px = 480
camera_matrix = [[600.0, 0.0, 319.5], [0.0, 601.0, 239.5], [0.0, 0.0, 1.0]]
distortion = [0.1, -0.2, 0.0, 0.0, 0.01]
"""


def test_a_file_comes_back_exactly_as_it_was_written(tmp_path):
    matrix = np.array([[1006.126, 0.0, 655.864], [0.0, 1004.015, 490.614], [0.0, 0.0, 1.0]])
    for written in (
        Intrinsics(matrix, np.array([0.1 + 0.2, -1e-17, 0.0, 3.0, 5e20]), 1280, 960, 0.21),
        Intrinsics(matrix, np.array([])),
    ):
        save_intrinsics(tmp_path / "camera.toml", written)
        read = load_intrinsics(tmp_path / "camera.toml")
        np.testing.assert_array_equal(read.camera_matrix, written.camera_matrix)
        np.testing.assert_array_equal(read.distortion, written.distortion)
        assert (read.width_px, read.height_px, read.rms_px) == (written.width_px, written.height_px, written.rms_px)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (("camera_matrix", "cameramatrix"), "cameramatrix"),
        (("distortion =", "# distortion ="), "distortion"),
        (("[0.0, 601.0, 239.5], ", ""), "camera_matrix"),
        (("601.0", "-601.0"), "camera_matrix"),
        (("[0.0, 0.0, 1.0]", "[0.0, 0.0, 2.0]"), "camera_matrix"),
        (("0.1, -0.2", "0.1"), None),
        (("0.1, -0.2, 0.0, 0.0, 0.01", "0.1, -0.2, 0.3"), "distortion"),
        (("0.1, -0.2", "nan, -0.2"), "distortion"),
        (("width_px = 640", "width_px = -640"), "width_px"),
        (("height_px = 480", ""), "height_px"),
        (("640", "'wide'"), "width_px"),
        (("[0.1", "[[0.1"), ""),
    ],
)
def test_a_wrong_file_is_refused_by_file_and_key(tmp_path, change, says):
    path = tmp_path / "camera.toml"
    path.write_text(GOOD.replace(*change))
    if says is None:
        assert len(load_intrinsics(path).distortion) == 4
        return
    with pytest.raises(CalibrationError) as caught:
        load_intrinsics(path)
    assert str(path) in str(caught.value)
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


def test_another_image_size_is_refused_naming_both(tmp_path):
    path = tmp_path / "camera.toml"
    path.write_text(GOOD)
    intrinsics = load_intrinsics(path)
    intrinsics.check_size(640, 480)
    with pytest.raises(CalibrationError, match=r"1280 x 960.*640 x 480"):
        intrinsics.check_size(1280, 960)
    path.write_text(GOOD.replace("width_px = 640", "").replace("height_px = 480", ""))
    load_intrinsics(path).check_size(1280, 960)


CHARUCO = parse_board("charuco:8x6:30mm")


@pytest.fixture(scope="module")
def studio():
    return Studio(CHARUCO)


@pytest.fixture(scope="module")
def good_views(studio):
    """24 rendered views over the whole picture, and four that reach its corners."""
    detector = BoardDetector(CHARUCO)
    poses = good_poses(studio)
    poses += [studio.held((x, y), 0.33) for x in (0.1, 0.9) for y in (0.1, 0.9)]
    return [detector.find(studio.picture(pose), f"view {k}") for k, pose in enumerate(poses)]


@pytest.fixture(scope="module")
def good(good_views):
    return calibrate(CHARUCO, good_views)


def projected(studio, poses, random, sigma_px):
    """Views without pictures: corners where they truly are, with noise."""
    views = []
    for k, pose in enumerate(poses):
        pixels = studio.corners_px(pose) + random.normal(0.0, sigma_px, (len(studio.board.corners), 2))
        inside = ((pixels > 0.0) & (pixels < (639.0, 479.0))).all(axis=1)
        views.append(BoardView(f"view {k}", np.flatnonzero(inside), pixels[inside], 640, 480))
    return views


def parameters(intrinsics):
    matrix = intrinsics.camera_matrix
    return np.concatenate([[matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]], intrinsics.distortion])


def unmet(views, calibration):
    return {criterion.name for criterion in judge(views, calibration) if not criterion.met}


def test_a_lens_with_distortion_is_found_from_pictures_and_accepted(good_views, good):
    assert good.views == tuple(good_views)
    assert good.left_out == ()
    assert unmet(good.views, good) == set()
    assert good.rms_px < 0.1
    assert 1.0 <= good.held_back_rms_px / good.rms_px < 1.1
    # What is left of a picture's error is not white: a little more than the covariance says.
    error = (parameters(good.intrinsics) - parameters(CAMERA)) / np.sqrt(np.diag(good.covariance))
    assert np.abs(error).max() < 6.0
    np.testing.assert_allclose(good.intrinsics.camera_matrix, CAMERA.camera_matrix, atol=1.5)
    # The distortion as a whole: where a ray is seen, once the camera has been turned to fit.
    seen, truth = (pixels_of_rays(intrinsics) for intrinsics in (good.intrinsics, CAMERA))
    assert turned_to_fit(seen, truth).max() < 0.5


def pixels_of_rays(intrinsics):
    """(64, 2) px where rays are seen that lie evenly over the true camera's picture."""
    u, v = np.meshgrid(np.linspace(0.0, 639.0, 8), np.linspace(0.0, 479.0, 8))
    pixels = np.stack([u, v], axis=-1).reshape(-1, 1, 2)
    rays = cv2.undistortPoints(pixels, CAMERA.camera_matrix, CAMERA.distortion).reshape(-1, 2)
    points = np.hstack([rays, np.ones((64, 1))])
    zero = np.zeros(3)
    return cv2.projectPoints(points, zero, zero, intrinsics.camera_matrix, intrinsics.distortion)[0].reshape(-1, 2)


def turned_to_fit(seen, truth):
    """(64,) px between two such lists, less what a turn of the camera explains."""
    u, v = np.meshgrid(np.linspace(0.0, 639.0, 8), np.linspace(0.0, 479.0, 8))
    pixels = np.stack([u, v], axis=-1).reshape(-1, 1, 2)
    rays = cv2.undistortPoints(pixels, CAMERA.camera_matrix, CAMERA.distortion).reshape(-1, 2)
    points = np.hstack([rays, np.ones((64, 1))])
    by_turn = cv2.projectPoints(points, np.zeros(3), np.zeros(3), CAMERA.camera_matrix, CAMERA.distortion)[1][:, :3]
    off = (seen - truth).ravel()
    return np.linalg.norm((off - by_turn @ np.linalg.lstsq(by_turn, off, rcond=None)[0]).reshape(-1, 2), axis=1)


def test_covariance_and_projection_error_are_what_repetition_shows(studio):
    """Thirty calibrations from the same places, with white noise: NEES, and errors over the whole picture."""
    random = np.random.default_rng(1)
    poses = good_poses(studio)
    truth = pixels_of_rays(CAMERA)
    distances, errors, claimed = [], [], []
    for _ in range(30):
        found = calibrate(CHARUCO, projected(studio, poses, random, 0.1))
        off = parameters(found.intrinsics) - parameters(CAMERA)
        distances.append(off @ np.linalg.solve(found.covariance, off))
        errors.append(turned_to_fit(pixels_of_rays(found.intrinsics), truth))
        claimed.append(found.projection_sigma_px.ravel())
    # The mean of 30 values of chi-square at 9 degrees of freedom: 9 +- 3 sigma of 0.77.
    assert 6.7 < np.mean(distances) < 11.3
    # The claim is the worst direction's standard deviation: what is seen lies between it and sqrt(2) times it.
    ratio = np.sqrt(np.mean(np.square(errors), axis=0)) / np.mean(claimed, axis=0)
    assert ratio.min() > 0.75
    assert ratio.max() < 1.6


def test_eight_frontal_views_are_refused_though_they_fit():
    studio = Studio(CHARUCO, seed=4)
    poses = [studio.held((x, y), 0.45) for x in (0.3, 0.43, 0.57, 0.7) for y in (0.4, 0.6)]
    detector = BoardDetector(CHARUCO)
    found = calibrate(CHARUCO, [detector.find(studio.picture(pose), "") for pose in poses])
    assert found.rms_px < 0.07
    assert abs(found.intrinsics.camera_matrix[0, 0] / CAMERA.camera_matrix[0, 0] - 1.0) > 0.08
    missing = unmet(found.views, found)
    assert missing >= {"views", "corners", "tilt", "focal", "projection"}
    # The numbers are as bad as it says.
    assert np.abs(found.tilts_deg).max() < 5.0
    assert found.projection_sigma_px.max() > 10.0


def test_twenty_frontal_views_are_refused_as_well(studio):
    poses = [studio.held((0.15 + 0.175 * k, 0.15 + 0.23 * j), 0.35) for k in range(5) for j in range(4)]
    found = calibrate(CHARUCO, projected(studio, poses, np.random.default_rng(2), 0.05))
    missing = unmet(found.views, found)
    assert missing >= {"tilt", "focal"}
    assert "views" not in missing


def test_every_refusal_says_what_to_do(good):
    for views, calibration in (((), None), (good.views[:5], None), (good.views, good)):
        for criterion in judge(views, calibration):
            assert criterion.text
            assert criterion.met == (criterion.part == 1.0)
            if criterion.met:
                assert criterion.advice == ""
            elif calibration is not None or criterion.text != "not solved yet":
                assert criterion.advice
    first = {criterion.name: criterion for criterion in judge((), None)}
    assert first["views"].advice == "take 20 more, each with the board elsewhere"
    assert first["corners"].advice.count("corner") == 4


def test_a_wrong_view_is_left_out_by_name(good_views):
    wrong = replace(good_views[7], corners_px=good_views[7].corners_px[::-1].copy(), name="upside down")
    blurred = replace(
        good_views[3],
        corners_px=good_views[3].corners_px + np.random.default_rng(3).normal(0.0, 2.0, good_views[3].corners_px.shape),
        name="shaken",
    )
    views = [*good_views[:3], blurred, *good_views[4:7], wrong, *good_views[8:]]
    found = calibrate(CHARUCO, views)
    assert {view.name for view in found.left_out} >= {"shaken"}
    assert found.rms_px < 0.1
    assert len(found.views) + len(found.left_out) == len(views)
    np.testing.assert_allclose(found.intrinsics.camera_matrix, CAMERA.camera_matrix, atol=2.0)


@pytest.mark.parametrize("turned", [False, True])
def test_a_board_that_the_printer_stretched_is_refused(studio, turned):
    """By 4 % along one side. Held upright in all views, it looks like a camera whose pixels are not square."""
    points = CHARUCO.corners * (0.96, 1.0, 1.0)
    quarter = transform(exp_so3([0.0, 0.0, np.pi / 2.0]), np.zeros(3))
    views = []
    for k, pose in enumerate(good_poses(studio)):
        held = pose if not turned or k % 2 else pose @ around(CHARUCO.middle, quarter)
        at = points @ held[:3, :3].T + held[:3, 3]
        pixels = cv2.projectPoints(at, np.zeros(3), np.zeros(3), CAMERA.camera_matrix, CAMERA.distortion)[0]
        views.append(BoardView(f"{k}", np.arange(len(points)), pixels.reshape(-1, 2), 640, 480))
    found = calibrate(CHARUCO, views)
    fit = next(criterion for criterion in judge(found.views, found) if criterion.name == "fit")
    assert not fit.met
    assert "measure its squares across and down" in fit.advice
    assert turned == (found.rms_px > 0.5)


def around(point, a_from_b):
    """The same motion about a point."""
    return transform(np.eye(3), point) @ a_from_b @ transform(np.eye(3), -point)


def test_too_few_views_and_two_cameras_are_refused_by_name(good_views):
    with pytest.raises(CalibrationError, match="too few views of the board: 3, and at least 4"):
        calibrate(CHARUCO, good_views[:3])
    other = replace(good_views[4], name="phone.jpg", width_px=4000, height_px=3000)
    with pytest.raises(CalibrationError, match=r"phone\.jpg is 4000 x 3000 px, view 0 640 x 480 px: .* one camera"):
        calibrate(CHARUCO, [*good_views[:4], other])


def test_the_same_view_again_and_again_has_no_good_answer(good_views):
    try:
        found = calibrate(CHARUCO, [good_views[0]] * 25)
    except CalibrationError as error:
        assert "other places" in str(error)  # noqa: PT017 - either is right
        return
    assert unmet(found.views, found) >= {"coverage", "corners"}


def test_cells_and_their_names(good_views):
    cells = coverage(good_views)
    assert cells.shape == (CELLS, CELLS)
    assert cells.max() <= len(good_views)
    one = replace(good_views[0], corners_px=np.array([[-0.5, -0.5], [639.4, -0.4], [320.0, 479.49]]))
    assert list(zip(*np.nonzero(coverage([one])), strict=True)) == [(0, 0), (0, CELLS - 1), (CELLS - 1, 4)]
    assert place_in_words(0, 0) == "the top left corner"
    assert place_in_words(CELLS - 1, 4) == "the bottom edge"
    assert place_in_words(4, CELLS - 1) == "the right edge"
    assert place_in_words(3, 4) == "the middle"


def test_projection_sigma_does_not_count_a_turn_of_the_camera():
    """A centre that is unknown along the picture is a turn of the camera, but for what the distortion makes of it."""
    plain = replace(CAMERA, distortion=np.zeros(5))
    covariance = np.zeros((9, 9))
    covariance[2, 2] = 1.0
    assert projection_sigma_px(plain, covariance).max() < 0.3
    covariance = np.zeros((9, 9))
    covariance[0, 0] = 1.0
    assert projection_sigma_px(plain, covariance)[0, 0] == pytest.approx(327.3 / 612.0, rel=0.3)


def test_quality_is_written_with_the_calibration(tmp_path, good):
    quality = good.quality(True, datetime.date(2026, 11, 22))
    save_intrinsics(tmp_path / "camera.toml", good.intrinsics, quality)
    read = load_intrinsics(tmp_path / "camera.toml")
    assert read.sigma_px == good.projection_sigma_px.max()
    text = (tmp_path / "camera.toml").read_text()
    assert "date = 2026-11-22\n" in text
    assert 'board = "charuco:8x6:30mm"\n' in text
    assert "accepted = true\n" in text
    (tmp_path / "camera.toml").write_text(text.replace("projection_sigma_px = ", "projection_sigma_px = -"))
    with pytest.raises(CalibrationError, match="projection_sigma_px = -"):
        load_intrinsics(tmp_path / "camera.toml")


def test_photographs_agree_with_the_reference_and_lack_corners():
    folder = data("chessboard_photos")
    truth = json.loads((folder / "truth.json").read_text())
    columns, rows = truth["board"]
    board = parse_board(f"chessboard:{columns}x{rows}:{1000 * truth['square_m']:g}mm")
    detector = BoardDetector(board)
    views = [detector.find(read_image(path), path.name) for path in sorted(folder.glob("*.jpg"))]
    found = calibrate(board, views)
    assert len(found.views) == 13
    assert found.rms_px <= 0.20
    reference = truth["all_free_measured"]
    matrix = found.intrinsics.camera_matrix
    assert matrix[0, 0] == pytest.approx(reference["fx"], rel=3e-3)
    assert matrix[1, 1] == pytest.approx(reference["fy"], rel=3e-3)
    assert found.held_back_rms_px < 1.3 * found.rms_px
    # Thirteen views that never come near a corner of the picture: nobody knows what the lens does there.
    assert unmet(found.views, found) == {"views", "coverage", "corners", "projection"}
