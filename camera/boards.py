"""Calibration boards: what they are called, where their corners are, and how they are found in a picture.

A board is written as on the command line and on the printed sheet:

    chessboard:9x6:25mm                     9 x 6 inner corners, squares of 25 mm
    charuco:8x6:30mm                        8 x 6 squares of 30 mm, markers of 21 mm of 5X5_50 in the white ones
    charuco:8x6:30mm:22mm:4X4_100           with other markers
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from camera.dictionaries import DictionaryError, dictionary_by_name
from camera.images import Image, Pixels, grey
from fusion.measurements import Array

# Side of a ChArUco board's markers over that of its squares: what is left lets the corners of the squares be measured.
MARKER_PART = 0.7
# Not the dictionary of example.toml's robots: a board that lies in view must not be taken for one of them.
BOARD_DICTIONARY = "5X5_50"
DEFAULT_BOARD = "charuco:8x6:30mm"
# Fewest corners of which a view is made: with fewer, its six unknowns eat up what it says about the lens.
MIN_CORNERS = 8
# Chessboards are looked for in a picture of at most so many pixels across; their corners are measured in the full one.
_SEARCH_PX = 1280
# Half of the window in which a corner is measured, as part of the distance to the next corner. With much more the next
# corner comes in where perspective is strong.
_WINDOW = 0.3
# Views are the same where corners moved by less than this part of the picture's diagonal, on average.
_SAME = 0.005
_UNITS = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}


class BoardError(ValueError):
    """A description of a board, or a length, that cannot be used. The text says what would be right."""


@dataclass(frozen=True, slots=True)
class Board:
    """A flat calibration board. `columns`, `rows`: inner corners of a chessboard, squares of a ChArUco board.

    `square`, `marker`: sides in m; `dictionary` as in `camera.markers`. The last two are for ChArUco alone.
    """

    kind: Literal["chessboard", "charuco"]
    columns: int
    rows: int
    square: float
    marker: float = 0.0
    dictionary: str = ""

    @property
    def squares(self) -> tuple[int, int]:
        """Across and down."""
        return (self.columns + 1, self.rows + 1) if self.kind == "chessboard" else (self.columns, self.rows)

    @property
    def corners(self) -> Array:
        """(n, 3) m: the inner corners, row by row from the top left; x to the right, y down, z = 0 into the board."""
        across, down = self.squares
        x, y = np.meshgrid(np.arange(1, across), np.arange(1, down))
        flat = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
        return np.asarray(self.square * flat, np.float64)

    @property
    def middle(self) -> Array:
        """(3,) m."""
        middle: Array = 0.5 * self.square * np.array([*self.squares, 0.0])
        return middle

    def opencv(self) -> cv2.aruco.CharucoBoard:
        """A ChArUco board as OpenCV has it."""
        dictionary = dictionary_by_name(self.dictionary)
        return cv2.aruco.CharucoBoard((self.columns, self.rows), self.square, self.marker, dictionary)

    def __str__(self) -> str:
        text = f"{self.kind}:{self.columns}x{self.rows}:{1e3 * self.square:g}mm"
        if self.kind == "chessboard" or self == parse_board(text):
            return text
        return f"{text}:{1e3 * self.marker:g}mm:{self.dictionary}"


def parse_length(text: str) -> float:
    """`25mm`, `2.5cm` or `0.025m` -> m. Raises BoardError: a bare number could be any of them."""
    match = re.fullmatch(r"(\d+(?:\.\d*)?|\.\d+)\s*(mm|cm|m)", text.strip())
    length = float(match[1]) * _UNITS[match[2]] if match else math.nan
    if not 0.0 < length <= 1000.0:
        raise BoardError(f"{text!r} is no length; 25mm, 2.5cm and 0.025m are")
    # 30 mm, not 0.03 m and the dust of a product in binary
    return round(length, 9)


def parse_board(text: str) -> Board:
    """A board by its description, see the top of this file. Raises BoardError."""
    kind, *parts = text.strip().split(":")
    size = re.fullmatch(r"(\d{1,3})x(\d{1,3})", parts[0]) if parts else None
    charuco = kind == "charuco"
    if size is None or kind not in ("chessboard", "charuco") or not 2 <= len(parts) <= (4 if charuco else 2):
        raise BoardError(
            f"{text!r} is no board; chessboard:9x6:25mm is one of 9 x 6 inner corners, charuco:8x6:30mm one of "
            "8 x 6 squares, each with the side of a square"
        )
    columns, rows, square = int(size[1]), int(size[2]), parse_length(parts[1])
    if not charuco:
        if min(columns, rows) < 3:
            raise BoardError(f"{text!r}: a chessboard needs at least 3 x 3 inner corners")
        return Board("chessboard", columns, rows, square)
    if min(columns, rows) < 3:
        raise BoardError(f"{text!r}: a ChArUco board needs at least 3 x 3 squares")
    marker = parse_length(parts[2]) if len(parts) > 2 else round(MARKER_PART * square, 9)
    if not 0.3 * square <= marker <= 0.95 * square:
        raise BoardError(f"{text!r}: its markers of {1e3 * marker:g} mm do not fit squares of {1e3 * square:g} mm")
    name = (parts[3] if len(parts) > 3 else BOARD_DICTIONARY).upper().removeprefix("DICT_")
    try:
        there = len(dictionary_by_name(name).bytesList)
    except DictionaryError as error:
        raise BoardError(f"{text!r}: {error}") from None
    if columns * rows // 2 > there:
        raise BoardError(f"{text!r} needs {columns * rows // 2} markers, and {name} has {there}")
    return Board("charuco", columns, rows, square, marker, name)


@dataclass(frozen=True, slots=True)
class BoardView:
    """A board in one picture. `indices` (n,): which of `Board.corners` are seen; `corners_px` (n, 2): where."""

    name: str
    indices: NDArray[np.integer]
    corners_px: Array
    width_px: int
    height_px: int

    def same_as(self, other: BoardView) -> bool:
        """Whether the board is where it is in the other view, as nearly as makes no difference: such a view would
        count for nothing new."""
        common, mine, theirs = np.intersect1d(self.indices, other.indices, return_indices=True)
        if 2 * len(common) < max(len(self.indices), len(other.indices)):
            return False
        moved = np.linalg.norm(self.corners_px[mine] - other.corners_px[theirs], axis=1).mean()
        return bool(moved < _SAME * math.hypot(self.width_px, self.height_px))


class BoardDetector:
    """Finds one board. OpenCV's detectors write into themselves: one BoardDetector per thread."""

    def __init__(self, board: Board) -> None:
        self.board = board
        self._charuco = cv2.aruco.CharucoDetector(board.opencv()) if board.kind == "charuco" else None

    def find(self, image: Pixels, name: str = "", thorough: bool = True) -> BoardView | None:
        """The board in a picture, as `grey` takes it; None where it is not, or with less than MIN_CORNERS.

        `thorough`: chessboards are looked for with OpenCV's slow way as well, which finds more of them.
        """
        picture = grey(image)
        found = self._chessboard(picture, thorough) if self._charuco is None else self._squares(picture)
        if found is None or len(found[0]) < MIN_CORNERS or _on_a_line(self.board.corners[found[0]]):
            return None
        return BoardView(name, *found, picture.shape[1], picture.shape[0])

    def what_is_there(self, image: Pixels) -> str:
        """Why `find` has found nothing, as far as the picture tells."""
        picture = grey(image)
        if max(across := cv2.meanStdDev(picture)[1].ravel()) < 4.0:
            return f"the picture is blank (its grey values scatter by {across[0]:.1f})"
        if self._charuco is not None:
            ids = self._charuco.detectBoard(picture)[3]
            there = len(ids) if ids is not None else 0
            if there == 0:
                other = _other_dictionary(picture, self.board.dictionary)
                return f"it shows markers of {other}" if other else "no marker is seen"
            expected = set(range(self.board.columns * self.board.rows // 2))
            strange = sorted(set(np.asarray(ids, np.int32).ravel().tolist()) - expected)
            if strange:
                return f"it shows the markers {_listed(strange)}, which this board does not have"
            return (
                f"{there} of its markers are seen, but not the corners between them: too few neighbours are in "
                "view, or they are placed in another way"
            )
        small, _ = _shrunk(picture)
        found, _, grid = cv2.findChessboardCornersSBWithMeta(small, (3, 3), cv2.CALIB_CB_LARGER)
        size = sorted(grid.shape[:2], reverse=True) if found else [0]
        # 3 x 3 are found in noise as well.
        if size[-1] > 3 and size != sorted((self.board.columns, self.board.rows), reverse=True):
            right = Board("chessboard", size[0], size[1], self.board.square)
            return f"it shows {size[0]} x {size[1]} inner corners; is it --board {right}?"
        return "no chessboard is seen"

    def _chessboard(self, picture: Image, thorough: bool) -> tuple[NDArray[np.integer], Array] | None:
        pattern = (self.board.columns, self.board.rows)
        small, scale = _shrunk(picture)
        flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_FAST_CHECK
        found, corners = cv2.findChessboardCorners(small, pattern, flags=flags)
        if not found and thorough:
            found, corners = cv2.findChessboardCornersSB(small, pattern, flags=cv2.CALIB_CB_NORMALIZE_IMAGE)
        if not found:
            return None
        # Middles of pixels are at whole numbers, and a scaled image's edges, not its middles, coincide.
        start = ((corners.reshape(-1, 2) + 0.5) / scale - 0.5).astype(np.float32)
        grid = start.reshape(self.board.rows, self.board.columns, 2)
        nearest = min(float(np.linalg.norm(np.diff(grid, axis=k), axis=-1).min()) for k in (0, 1))
        half = max(2, round(_WINDOW * nearest))
        refined = cv2.cornerSubPix(
            picture, start, (half, half), (-1, -1), (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 60, 1e-4)
        )
        return np.arange(len(start)), np.asarray(refined, np.float64).reshape(-1, 2)

    def _squares(self, picture: Image) -> tuple[NDArray[np.integer], Array] | None:
        assert self._charuco is not None
        corners, ids, _, _ = self._charuco.detectBoard(picture)
        if ids is None or not len(ids):
            return None
        return np.asarray(ids, np.int32).ravel(), np.asarray(corners, np.float64).reshape(-1, 2)


def _on_a_line(points: Array) -> bool:
    """Corners of a single row or column, which no pose can be had from."""
    return len(set(points[:, 0])) < 2 or len(set(points[:, 1])) < 2


def _shrunk(picture: Image) -> tuple[Image, float]:
    scale = min(1.0, _SEARCH_PX / max(picture.shape))
    if scale == 1.0:
        return picture, 1.0
    return np.asarray(cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8), scale


def _other_dictionary(picture: Image, but: str) -> str:
    """The family that the markers in a picture are of, "" if none is read."""
    for name in ("4X4_250", "5X5_250", "6X6_250", "7X7_250", "APRILTAG_36H11", "ARUCO_ORIGINAL"):
        if name[:3] != but[:3] and cv2.aruco.ArucoDetector(dictionary_by_name(name)).detectMarkers(picture)[0]:
            return name
    return ""


def _listed(ids: list[int]) -> str:
    return ", ".join(map(str, ids[:6])) + (" ..." if len(ids) > 6 else "")
