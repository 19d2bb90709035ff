"""Boards: their names, and where they are found in pictures with a known truth."""

import numpy as np
import pytest

from camera.boards import Board, BoardDetector, BoardError, parse_board, parse_length
from tests.camera.board_views import Studio

CHARUCO = parse_board("charuco:8x6:30mm")
CHESSBOARD = parse_board("chessboard:9x6:25mm")


@pytest.mark.parametrize(
    "text", ["chessboard:9x6:25mm", "charuco:8x6:30mm", "charuco:7x5:24.5mm:18mm:APRILTAG_36H11", "charuco:3x3:1000mm"]
)
def test_a_description_comes_back(text):
    board = parse_board(text)
    assert str(board) == text
    assert parse_board(str(board)) == board


def test_defaults_lengths_and_corners():
    assert Board("charuco", 8, 6, 0.03, 0.021, "5X5_50") == CHARUCO
    assert parse_board("charuco:8x6:3cm:0.021m:dict_5x5_50") == CHARUCO
    assert CHESSBOARD.squares == (10, 7)
    assert CHARUCO.squares == (8, 6)
    np.testing.assert_allclose(
        CHESSBOARD.corners[[0, 1, 9, -1], :2], 0.025 * np.array([[1, 1], [2, 1], [1, 2], [9, 6]])
    )
    np.testing.assert_allclose(CHARUCO.corners, CHARUCO.opencv().getChessboardCorners(), atol=1e-7)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "chessboard:9x6:25mm is one of 9 x 6 inner corners"),
        ("chess:9x6:25mm", "is no board"),
        ("chessboard:9x6", "is no board"),
        ("chessboard:9:25mm", "is no board"),
        ("chessboard:9x6:25", "'25' is no length; 25mm"),
        ("chessboard:9x6:-25mm", "is no length"),
        ("chessboard:9x6:0mm", "is no length"),
        ("chessboard:9x6:nanmm", "is no length"),
        ("chessboard:2x6:25mm", "at least 3 x 3 inner corners"),
        ("chessboard:9x6:25mm:18mm", "is no board"),
        ("charuco:8x2:30mm", "at least 3 x 3 squares"),
        ("charuco:8x6:30mm:30mm", "markers of 30 mm do not fit squares of 30 mm"),
        ("charuco:8x6:30mm:20mm:5X5_51", "did you mean 5X5_50"),
        ("charuco:12x12:30mm", "needs 72 markers, and 5X5_50 has 50"),
        ("charuco:999x999:30mm", "needs 499000 markers"),
    ],
)
def test_a_description_that_cannot_be_used_says_what_can(text, says):
    with pytest.raises(BoardError) as caught:
        parse_board(text)
    assert says in str(caught.value)


def test_lengths_have_units():
    assert [parse_length(text) for text in ("25mm", "2.5cm", "0.025 m", ".025m")] == [0.025] * 4


# Sharp, tilted and unsharp; a chessboard has to be seen whole, and its corners have no markers near them.
HELD = [((0.5, 0.5), 1.7, 0.0, 0.0), ((0.45, 0.55), 1.6, 35.0, 50.0), ((0.55, 0.5), 2.2, 25.0, 170.0)]


@pytest.mark.parametrize(("board", "limit_px"), [(CHARUCO, 0.10), (CHESSBOARD, 0.06)], ids=str)
def test_corners_are_where_they_truly_are(board, limit_px):
    studio = Studio(board)
    errors = []
    for at, distance, tilt, way in HELD:
        pose = studio.held(at, distance * max(board.squares) * board.square, tilt, way)
        view = BoardDetector(board).find(studio.picture(pose), "a")
        assert view is not None
        assert (view.name, view.width_px, view.height_px) == ("a", 640, 480)
        assert len(view.indices) == len(board.corners)
        errors.append(view.corners_px - studio.corners_px(pose)[view.indices])
    errors = np.concatenate(errors)
    assert np.sqrt(np.square(errors).sum(axis=1).mean()) < limit_px
    assert np.abs(errors.mean(axis=0)).max() < 0.03  # half a pixel of offset would be a mistake of convention


def test_half_a_charuco_board_is_a_view_and_half_a_chessboard_none():
    for board, seen in ((CHARUCO, True), (CHESSBOARD, False)):
        studio = Studio(board)
        size = max(board.squares) * board.square
        view = BoardDetector(board).find(studio.picture(studio.held((0.05, 0.5), 1.2 * size)))
        assert (view is not None) == seen
        if view is not None:
            assert 8 <= len(view.indices) < len(board.corners)


def test_a_large_picture_is_searched_small_and_measured_large():
    studio = Studio(CHESSBOARD)
    pose = studio.held((0.5, 0.5), 0.5, 20.0)
    small = studio.picture(pose)
    large = np.kron(small, np.ones((4, 4), np.uint8))
    view = BoardDetector(CHESSBOARD).find(large)
    assert view is not None
    expected = (studio.corners_px(pose) + 0.5) * 4.0 - 0.5
    assert np.abs(view.corners_px - expected).max() < 1.0


@pytest.mark.parametrize(
    ("board", "shown", "says"),
    [
        ("chessboard:8x5:25mm", CHESSBOARD, "it shows 9 x 6 inner corners; is it --board chessboard:9x6:25mm?"),
        ("chessboard:10x7:25mm", CHESSBOARD, "it shows 9 x 6 inner corners"),
        ("charuco:8x6:30mm", CHESSBOARD, "no marker is seen"),
        ("charuco:8x6:30mm:21mm:4X4_50", CHARUCO, "it shows markers of 5X5_250"),
        (
            "charuco:4x4:30mm:21mm:5X5_50",
            CHARUCO,
            "it shows the markers 8, 9, 10, 11, 12, 13 ..., which this board does",
        ),
    ],
)
def test_a_board_that_does_not_match_says_what_is_there(board, shown, says):
    studio = Studio(shown)
    picture = studio.picture(studio.held((0.5, 0.5), 1.7 * max(shown.squares) * shown.square, 10.0))
    detector = BoardDetector(parse_board(board))
    if "the markers 8" not in says:  # a part of it matches by chance
        assert detector.find(picture) is None
    assert says in detector.what_is_there(picture)


def test_empty_pictures():
    black, noise = np.zeros((480, 640), np.uint8), np.random.default_rng(0).integers(0, 255, (480, 640), np.uint8)
    for board in (CHARUCO, CHESSBOARD):
        detector = BoardDetector(board)
        assert detector.find(black) is None
        assert detector.find(noise) is None
        assert detector.what_is_there(black) == "the picture is blank (its grey values scatter by 0.0)"
        assert detector.what_is_there(noise).startswith("no ")


def test_views_of_the_same_place_are_the_same():
    studio = Studio(CHARUCO)
    detector = BoardDetector(CHARUCO)
    first, again, other = (detector.find(studio.picture(studio.held((x, 0.5), 0.4, 10.0))) for x in (0.5, 0.5005, 0.55))
    assert first.same_as(again)
    assert not first.same_as(other)
