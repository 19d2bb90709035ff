"""Leads a person with a board through a calibration: takes a view whenever the board stands still somewhere new, and
says where to hold it next."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from camera.boards import Board, BoardView
from camera.calibration import (
    CELLS,
    SOLVABLE_VIEWS,
    TILTED_DEG,
    Calibration,
    Criterion,
    Intrinsics,
    calibrate,
    coverage,
    judge,
    place_in_words,
)
from fusion.geometry import exp_so3, transform
from fusion.measurements import Array

# The board stands still where its corners move by less than this part of the picture's diagonal from one frame to the
# next, on average: about a pixel of a small picture, so that what moved within the exposure is less.
_STILL = 0.0015
# It is somewhere new where its middle is this part of the diagonal away from every view's, or its distance is another
# by this part, or it is turned by this much, deg.
_ELSEWHERE, _NEARER, _TURNED_DEG = 0.08, 0.15, 10.0
# Before there is a calibration: focal length as a part of the picture's width, as most cameras have it.
_USUAL_FOCAL = 0.9
# The guess is given up for the views' own focal length once that is known to this part of it: while the board has only
# faced the camera, it can be anything.
_TRUSTED_FOCAL = 0.05
# A tilt that is asked for, deg, and the part of the picture that a target fills.
_TILT_DEG, _FILLED = 32.0, 0.5
_MOVE = "Move the board"
# The edge of the board that is to go away from the camera, and the axis to turn it about for that.
_TILTS = {
    "left": (0.0, 1.0),
    "right": (0.0, -1.0),
    "top": (-1.0, 0.0),
    "bottom": (1.0, 0.0),
}


@dataclass(frozen=True, slots=True)
class Step:
    """What became of one picture, and what to do. `text`: in a few words; `kept`: the view was taken.

    `outline_px`, `target_px`: (4, 2), the board's edge as it is seen and where it is wanted; None for neither.
    """

    text: str
    kept: bool = False
    done: bool = False
    outline_px: Array | None = None
    target_px: Array | None = None


@dataclass(frozen=True, slots=True)
class _Stance:
    """How the board is held: its middle as a part of the picture's diagonal, the logarithm of its distance, its normal
    in the camera's frame."""

    middle: Array
    distance: float
    normal: Array

    def is_new_beside(self, other: _Stance) -> bool:
        turned = math.degrees(math.acos(min(1.0, abs(float(self.normal @ other.normal)))))
        return bool(
            np.linalg.norm(self.middle - other.middle) > _ELSEWHERE
            or abs(self.distance - other.distance) > _NEARER
            or turned > _TURNED_DEG
        )


class Guide:
    """`feed` each picture's view of the board, in order; then `views`, `calibration` (None at first) and `criteria` are
    what has come of it."""

    def __init__(self, board: Board) -> None:
        self.board = board
        self.views: list[BoardView] = []
        self.calibration: Calibration | None = None
        self.criteria: tuple[Criterion, ...] = judge((), None)
        self._stances: list[_Stance] = []
        self._before: BoardView | None = None

    @property
    def done(self) -> bool:
        return all(criterion.met for criterion in self.criteria)

    @property
    def used(self) -> Sequence[BoardView]:
        """The views that count: not those that do not fit to the others."""
        return self.views if self.calibration is None else self.calibration.views

    def feed(self, view: BoardView | None) -> Step:
        """The next picture of the camera. Raises CalibrationError when its size has changed."""
        before, self._before = self._before, view
        if self.done:
            return Step("Done", done=True)
        if view is None:
            return Step("Hold the board into the picture")
        camera = self._camera(view)
        camera_from_board = _pose(self.board, view, camera)
        stance = _stance(self.board, view, camera_from_board, camera)
        outline = _outline(self.board, camera_from_board, camera)
        elsewhere = all(stance.is_new_beside(other) for other in self._stances)
        reaches = ((coverage([view]) > 0) & (coverage(self.used) == 0)).any()
        new = bool(elsewhere or reaches) and not any(map(view.same_as, self.views))
        kept = new and before is not None and _is_still(before, view)
        if kept:
            self._keep(view, stance)
        if self.done:
            return Step("Done", kept, True, outline)
        if new and not kept:
            return Step("Hold it still", outline_px=outline)
        text, target = self._next(view, camera)
        away = np.linalg.norm(outline.mean(axis=0) - target.mean(axis=0))
        if text.startswith(_MOVE) and not kept and away < _ELSEWHERE * math.hypot(view.width_px, view.height_px):
            text = f"Further{text.removeprefix(_MOVE)}, up to the border of the picture"
        return Step(text, kept, False, outline, target)

    def _keep(self, view: BoardView, stance: _Stance) -> None:
        self.views.append(view)
        self._stances.append(stance)
        if len(self.views) >= SOLVABLE_VIEWS:
            self.calibration = calibrate(self.board, self.views)
        self.criteria = judge(self.used, self.calibration)

    def _camera(self, view: BoardView) -> Intrinsics:
        if self.calibration is not None:
            found = self.calibration.intrinsics
            if math.sqrt(self.calibration.covariance[0, 0]) < _TRUSTED_FOCAL * found.camera_matrix[0, 0]:
                return found
        focal = _USUAL_FOCAL * view.width_px
        matrix = [[focal, 0.0, 0.5 * view.width_px], [0.0, focal, 0.5 * view.height_px], [0.0, 0.0, 1.0]]
        return Intrinsics(np.array(matrix), np.zeros(5), view.width_px, view.height_px)

    def _next(self, view: BoardView, camera: Intrinsics) -> tuple[str, Array]:
        """What to do, and where the board is wanted."""
        missing = {criterion.name for criterion in self.criteria if not criterion.met}
        seen = coverage(self.used) > 0
        # Tilting is the harder part: begun in between, so that whole calibrations do not end with it.
        if "tilt" in missing and (len(self.views) % 3 == 2 or not missing & {"corners", "coverage"}):
            edge = self._rarest_tilt()
            axis = np.array([*_TILTS[edge], 0.0])
            R = exp_so3(math.radians(_TILT_DEG) * axis)
            text = f"Tilt the board: its {edge} edge away from the camera, by about 30 degrees"
            return text, _outline(self.board, _centred(self.board, camera, R), camera)
        if "corners" in missing or "coverage" in missing:
            row, column = self._wanted_cell(seen, "corners" in missing)
            return f"{_MOVE} into {place_in_words(row, column)}", self._rectangle(row, column, view)
        if "projection" in missing and self.calibration is not None:
            sigma = self.calibration.projection_sigma_px
            row, column = (int(k) for k in np.unravel_index(int(sigma.argmax()), sigma.shape))
            return f"Once more into {place_in_words(row, column)}, tilted", self._rectangle(row, column, view)
        if "focal" in missing:
            R = exp_so3(math.radians(40.0) * np.array([*_TILTS[self._rarest_tilt()], 0.0]))
            text = "Bring the board nearer, and tilt it more"
            return text, _outline(self.board, _centred(self.board, camera, R), camera)
        if "fit" in missing or "held back" in missing:
            advice = next(c.advice for c in self.criteria if c.name in ("fit", "held back") and not c.met)
            return advice[0].upper() + advice[1:], self._rectangle(CELLS // 2, CELLS // 2, view)
        # A stretched print only shows when the board is not always upright.
        row, column = (int(k) for k in np.unravel_index(int(coverage(self.used).argmin()), (CELLS, CELLS)))
        text = f"Turn the board by a quarter, and hold it to {place_in_words(row, column)}"
        return text, self._rectangle(row, column, view, turned=True)

    def _rarest_tilt(self) -> str:
        """The edge that has been furthest away least often."""
        counts = dict.fromkeys(_TILTS, 0)
        for pose in self.calibration.camera_from_board if self.calibration is not None else ():
            if math.degrees(math.acos(min(1.0, abs(pose[2, 2])))) >= TILTED_DEG[0]:
                # x of the board points to its right edge, y to its bottom; their z says which end is further away.
                right, bottom = pose[2, 0], pose[2, 1]
                if abs(right) > abs(bottom):
                    counts["right" if right > 0.0 else "left"] += 1
                else:
                    counts["bottom" if bottom > 0.0 else "top"] += 1
        return min(counts, key=lambda edge: counts[edge])

    def _wanted_cell(self, seen: NDArray[np.bool_], corners: bool) -> tuple[int, int]:
        if corners:
            last = CELLS - 1
            return next((r, c) for r, c in ((0, 0), (0, last), (last, last), (last, 0)) if not seen[r, c])
        around = cv2.boxFilter(seen.astype(np.float32), -1, (3, 3), borderType=cv2.BORDER_REPLICATE)
        row, column = np.unravel_index(int((around + 10.0 * seen).argmin()), seen.shape)
        return int(row), int(column)

    def _rectangle(self, row: int, column: int, view: BoardView, turned: bool = False) -> Array:
        """The outline of the board held straight or turned by a quarter, near a cell, within the picture. (4, 2) px"""
        size = np.array(self.board.squares, np.float64)
        size = size[::-1] if turned else size
        picture = np.array([view.width_px, view.height_px], np.float64)
        size *= _FILLED * (picture / size).min()
        middle = (np.array([column, row]) + 0.5) / CELLS * picture
        left, top = np.clip(middle - 0.5 * size, 0.0, picture - size)
        right, bottom = left + size[0], top + size[1]
        corners = np.array([[left, top], [right, top], [right, bottom], [left, bottom]])
        return np.roll(corners, -1, axis=0) if turned else corners


def _is_still(before: BoardView, view: BoardView) -> bool:
    common, then, now = np.intersect1d(before.indices, view.indices, return_indices=True)
    if 2 * len(common) < len(view.indices):
        return False
    moved = np.linalg.norm(before.corners_px[then] - view.corners_px[now], axis=1).mean()
    return bool(moved < _STILL * math.hypot(view.width_px, view.height_px))


def _pose(board: Board, view: BoardView, camera: Intrinsics) -> Array:
    """camera_from_board (4, 4)."""
    points = board.corners[view.indices]
    _, rotation, translation = cv2.solvePnP(
        points, view.corners_px, camera.camera_matrix, camera.distortion, flags=cv2.SOLVEPNP_IPPE
    )
    return transform(exp_so3(np.asarray(rotation).ravel()), np.asarray(translation).ravel())


def _stance(board: Board, view: BoardView, camera_from_board: Array, camera: Intrinsics) -> _Stance:
    middle = camera_from_board[:3, :3] @ board.middle + camera_from_board[:3, 3]
    pixel = camera.camera_matrix[:2] @ (middle / middle[2])
    diagonal = math.hypot(view.width_px, view.height_px)
    return _Stance(pixel / diagonal, math.log(max(middle[2], 1e-6)), camera_from_board[:3, 2])


def _outline(board: Board, camera_from_board: Array, camera: Intrinsics) -> Array:
    """(4, 2) px of the board's edge."""
    across, down = board.squares
    corners = board.square * np.array([[0.0, 0.0, 0.0], [across, 0.0, 0.0], [across, down, 0.0], [0.0, down, 0.0]])
    rotation, _ = cv2.Rodrigues(camera_from_board[:3, :3])
    pixels, _ = cv2.projectPoints(
        corners, rotation, camera_from_board[:3, 3].copy(), camera.camera_matrix, camera.distortion
    )
    return np.asarray(pixels, np.float64).reshape(-1, 2)


def _centred(board: Board, camera: Intrinsics, R: Array) -> Array:
    """camera_from_board of a board turned by R in the middle of the picture, filling its part of it."""
    across, down = board.squares
    fx, fy = camera.camera_matrix[0, 0], camera.camera_matrix[1, 1]
    distance = board.square * max(fx * across / camera.width_px, fy * down / camera.height_px) / (_FILLED + 0.1)
    x = (0.5 * camera.width_px - camera.camera_matrix[0, 2]) / fx
    y = (0.5 * camera.height_px - camera.camera_matrix[1, 2]) / fy
    return transform(R, distance * np.array([x, y, 1.0]) - R @ board.middle)
