"""The intrinsics of a camera: solved from pictures of a board, judged, and their file.

The file is TOML:

    width_px = 1280                 # the image size that the calibration was made at; leave both out if unknown
    height_px = 960
    camera_matrix = [[1006.1, 0.0, 655.9], [0.0, 1004.0, 490.6], [0.0, 0.0, 1.0]]
    distortion = [0.135, -0.234, 0.0007, 0.0049, 0.0]      # OpenCV's order: k1 k2 p1 p2 k3 ...; [] for none
    rms_px = 0.21                   # reprojection error of the calibration, optional
    [quality]                       # how it was made and how well it is known, see `Quality`; optional
"""

from __future__ import annotations

import datetime
import hashlib
import json
import math
import os
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from camera.boards import Board, BoardView
from fusion.geometry import exp_so3, transform
from fusion.measurements import Array

# The lengths that OpenCV's distortion model is defined for; [] is written for a lens without any.
_DISTORTION_LENGTHS = (0, 4, 5, 8, 12, 14)


class CalibrationError(ValueError):
    """A calibration that cannot be used. The text names the file, the key, what was found and what would be right."""


@dataclass(frozen=True, slots=True)
class Intrinsics:
    """A camera in OpenCV's model: pinhole with radial and tangential distortion.

    `camera_matrix`: (3, 3), px; pixel (0, 0) is the middle of the first pixel. `distortion`: (k,) in OpenCV's order.
    `width_px`, `height_px`: the image size it holds for, 0 if unknown. `rms_px`: reprojection error, None if unknown.
    `sigma_px`: standard deviation of where it says that a ray is seen, at the worst place of the image; 0 if unknown.
    It is for placing the camera and for the error on the floor (`camera.floor`). Robots' fixes do without: the
    placement, found with the same calibration, takes up most of the error between the anchors.
    """

    camera_matrix: Array
    distortion: Array
    width_px: int = 0
    height_px: int = 0
    rms_px: float | None = None
    sigma_px: float = 0.0

    @property
    def fingerprint(self) -> str:
        """Of what a pose depends on: the same for the same calibration, another for any other."""
        numbers = [*self.camera_matrix.ravel().tolist(), *self.distortion.ravel().tolist()]
        return hashlib.sha256(repr((numbers, self.width_px, self.height_px)).encode()).hexdigest()[:16]

    def check_size(self, width_px: int, height_px: int) -> None:
        """Raises CalibrationError if an image of this size is not what was calibrated."""
        if self.width_px and (width_px, height_px) != (self.width_px, self.height_px):
            raise CalibrationError(
                f"the image is {width_px} x {height_px} px, "
                f"the calibration is for {self.width_px} x {self.height_px} px"
            )


class Quality(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How a calibration was made. Standard deviations are of one calibration like it, px for focal length and centre.

    `projection_sigma_px`: of where a ray is seen, at the worst place of the image. `held_back_rms_px`: reprojection
    error in views that the solve did not know. `accepted`: false where it was written with `--force`.
    """

    date: datetime.date
    board: str
    views: int
    accepted: bool
    focal_sigma_px: tuple[float, float]
    centre_sigma_px: tuple[float, float]
    distortion_sigma: tuple[float, ...]
    projection_sigma_px: float
    held_back_rms_px: float


class _File(msgspec.Struct, forbid_unknown_fields=True, omit_defaults=True):
    camera_matrix: list[list[float]]
    distortion: list[float]
    width_px: int = 0
    height_px: int = 0
    rms_px: float | None = None
    quality: Quality | None = None


def load_intrinsics(path: str | os.PathLike[str]) -> Intrinsics:
    """Reads a calibration file. Raises CalibrationError naming file and key, OSError if it cannot be read."""
    try:
        text = Path(path).read_text(encoding="utf-8")
        content = msgspec.toml.decode(text, type=_File)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise CalibrationError(f"{path}: {error}") from None
    matrix = np.array(content.camera_matrix) if [len(row) for row in content.camera_matrix] == [3, 3, 3] else None
    if (
        matrix is None
        or not np.isfinite(matrix).all()
        or matrix[0, 0] <= 0.0
        or matrix[1, 1] <= 0.0
        or matrix[2].tolist() != [0.0, 0.0, 1.0]
    ):
        raise CalibrationError(
            f"{path}: camera_matrix = {content.camera_matrix}: "
            "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in px with fx, fy > 0 is needed"
        )
    distortion = np.array(content.distortion, dtype=np.float64)
    if len(distortion) not in _DISTORTION_LENGTHS or not np.isfinite(distortion).all():
        raise CalibrationError(
            f"{path}: distortion = {content.distortion}: {', '.join(map(str, _DISTORTION_LENGTHS))} finite numbers "
            "are possible, in OpenCV's order"
        )
    if min(content.width_px, content.height_px) < 0 or (content.width_px == 0) != (content.height_px == 0):
        raise CalibrationError(
            f"{path}: width_px = {content.width_px}, height_px = {content.height_px}: "
            "give both, above zero, or leave both out"
        )
    sigma = content.quality.projection_sigma_px if content.quality is not None else 0.0
    if not 0.0 <= sigma < math.inf:
        raise CalibrationError(f"{path}: quality, projection_sigma_px = {sigma}: px, 0 or more, are needed")
    return Intrinsics(matrix, distortion, content.width_px, content.height_px, content.rms_px, sigma)


def save_intrinsics(path: str | os.PathLike[str], intrinsics: Intrinsics, quality: Quality | None = None) -> None:
    """Writes a calibration file that `load_intrinsics` reads back exactly. Raises OSError if it cannot be written."""
    rows = ",\n".join(f"    {row}" for row in intrinsics.camera_matrix.tolist())
    lines = [
        f"width_px = {intrinsics.width_px}",
        f"height_px = {intrinsics.height_px}",
        f"camera_matrix = [\n{rows},\n]",
        f"distortion = {intrinsics.distortion.ravel().tolist()}",
    ]
    if intrinsics.rms_px is not None:
        lines.append(f"rms_px = {intrinsics.rms_px!r}")
    if quality is not None:
        lines += ["", "[quality]"]
        lines += [f"{key} = {_toml(value)}" for key, value in msgspec.structs.asdict(quality).items()]
    Path(path).write_text("\n".join(lines) + "\n", encoding="utf-8")


def _toml(value: object) -> str:
    match value:
        case bool():
            return str(value).lower()
        case str():
            return json.dumps(value)
        case datetime.date():
            return value.isoformat()
        case tuple():
            return repr(list(value))
    return repr(value)


# What a calibration is accepted on. RMS alone is a bad judge: a few frontal views fit perfectly and say nothing.
LEAST_VIEWS = 20
# The image is divided into so many cells each way; this part of them, and its four corners, must have been seen.
CELLS, LEAST_COVERAGE = 8, 0.8
# Views with the board tilted by so much, deg, against the image. Without them focal length and distance cannot be told
# apart; with more, corners become unsharp.
LEAST_TILTED, TILTED_DEG = 8, (20.0, 45.0)
# Standard deviation of the focal length over itself
LARGEST_FOCAL_SIGMA = 0.002
# Standard deviation of where a ray is seen, anywhere in the image, px
LARGEST_PROJECTION_SIGMA_PX = 0.5
# Error in views that the solve did not know, over the error in those that it knew
LARGEST_HELD_BACK = 1.3
# Above this the board is not what it is said to be, or not flat, px
LARGEST_RMS_PX = 1.0
# By how much the focal lengths across and down may differ: pixels are square, but printers stretch.
LARGEST_STRETCH = 0.01

# Fewer views than this are not solved: the lens has 9 unknowns, and each view has 6 of its own.
SOLVABLE_VIEWS = 4
# Each view is held back once, in so many groups.
_FOLDS = 5
# A view whose corners fit so much worse than the others', and than this in px, is left out: a wrong or blurred board.
_OUTLIER, _OUTLIER_PX = 3.0, 0.3
# fx, fy, cx, cy, k1, k2, p1, p2, k3 among the columns of OpenCV's Jacobian, after rotation and translation
_LENS = slice(6, 15)


@dataclass(frozen=True, slots=True)
class Calibration:
    """What pictures of a board say about a camera.

    `views` that were used, with `camera_from_board` (n, 4, 4) and `view_rms_px` (n,) for each; `left_out`: those that
    did not fit to the others. `covariance` (9, 9): fx, fy, cx, cy in px, k1, k2, p1, p2, k3.
    `projection_sigma_px` (CELLS, CELLS): standard deviation of where a ray is seen, in the worst direction, by cells of
    the image. `held_back_rms_px`: reprojection error in views that were held back from the solve; inf where too few are
    left without them.
    """

    intrinsics: Intrinsics
    board: Board
    views: tuple[BoardView, ...]
    camera_from_board: Array
    view_rms_px: Array
    left_out: tuple[BoardView, ...]
    covariance: Array
    projection_sigma_px: Array
    held_back_rms_px: float

    @property
    def rms_px(self) -> float:
        """Over all corners of the views used."""
        return self.intrinsics.rms_px or 0.0

    @property
    def tilts_deg(self) -> Array:
        """(n,): angle of each view's board against the image plane."""
        tilts: Array = np.degrees(np.arccos(np.clip(np.abs(self.camera_from_board[:, 2, 2]), 0.0, 1.0)))
        return tilts

    def quality(self, accepted: bool, today: datetime.date) -> Quality:
        """For the file."""
        sigma = np.sqrt(np.diag(self.covariance)).tolist()
        return Quality(
            date=today,
            board=str(self.board),
            views=len(self.views),
            accepted=accepted,
            focal_sigma_px=(sigma[0], sigma[1]),
            centre_sigma_px=(sigma[2], sigma[3]),
            distortion_sigma=tuple(sigma[4:]),
            projection_sigma_px=float(self.projection_sigma_px.max()),
            held_back_rms_px=self.held_back_rms_px,
        )


@dataclass(frozen=True, slots=True)
class Criterion:
    """One condition of acceptance: how far it is, what that means, and what to do about it.

    `part`: of the way there, 0 to 1. `text`: the state in words; `advice`: "" once it is `met`.
    """

    name: str
    met: bool
    part: float
    text: str
    advice: str


def calibrate(board: Board, views: Sequence[BoardView]) -> Calibration:
    """Solves for the camera from views of a board: pinhole with k1, k2, p1, p2, k3, nothing held fixed.

    Raises CalibrationError, which names the view, if they are of several image sizes, too few or without a solution.
    """
    if len(views) < SOLVABLE_VIEWS:
        raise CalibrationError(
            f"too few views of the board: {len(views)}, and at least {SOLVABLE_VIEWS} are needed to solve at all"
        )
    width, height = views[0].width_px, views[0].height_px
    for view in views:
        if (view.width_px, view.height_px) != (width, height):
            raise CalibrationError(
                f"{view.name} is {view.width_px} x {view.height_px} px, {views[0].name} {width} x {height} px: "
                "all pictures must come from one camera at one size"
            )
    used, left_out = list(views), []
    while True:
        solved = _solve(board, used)
        rms = np.array([math.sqrt(float(np.mean(np.square(r).sum(axis=1)))) for r in solved.residuals])
        good = rms <= max(_OUTLIER * float(np.median(rms)), _OUTLIER_PX)
        # Never the larger part: then it is the rest that cannot be believed.
        if good.all() or good.sum() < max(SOLVABLE_VIEWS, 0.7 * len(views)):
            break
        left_out += [view for view, fits in zip(used, good, strict=True) if not fits]
        used = [view for view, fits in zip(used, good, strict=True) if fits]
    covariance = _covariance(board, used, solved)
    total = math.sqrt(float(np.mean(np.square(np.vstack(solved.residuals)).sum(axis=1))))
    intrinsics = Intrinsics(solved.camera_matrix, solved.distortion, width, height, total)
    return Calibration(
        intrinsics=intrinsics,
        board=board,
        views=tuple(used),
        camera_from_board=np.array([transform(exp_so3(r), t) for r, t in solved.poses]),
        view_rms_px=rms,
        left_out=tuple(left_out),
        covariance=covariance,
        projection_sigma_px=projection_sigma_px(intrinsics, covariance),
        held_back_rms_px=_held_back_rms_px(board, used, solved),
    )


@dataclass(frozen=True, slots=True)
class _Solved:
    camera_matrix: Array
    distortion: Array
    # Rotation vector and translation of each view, and seen minus expected (n, 2) of its corners
    poses: list[tuple[Array, Array]]
    residuals: list[Array]


def _solve(board: Board, views: Sequence[BoardView], start: _Solved | None = None) -> _Solved:
    corners = board.corners.astype(np.float32)
    points = [np.ascontiguousarray(corners[view.indices]) for view in views]
    seen = [view.corners_px.astype(np.float32).reshape(-1, 1, 2) for view in views]
    size = (views[0].width_px, views[0].height_px)
    try:
        _, found_matrix, found_distortion, rotations, translations = cv2.calibrateCamera(
            points,
            seen,
            size,
            np.eye(3) if start is None else start.camera_matrix.copy(),
            np.zeros(5) if start is None else start.distortion.copy(),
            flags=0 if start is None else cv2.CALIB_USE_INTRINSIC_GUESS,
            criteria=(cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 30 if start is None else 10, 1e-12),
        )
    except cv2.error as error:
        raise CalibrationError(
            f"the {len(views)} views have no solution ({error.err}): hold the board in other places and tilt it"
        ) from None
    matrix, distortion = np.asarray(found_matrix, np.float64), np.asarray(found_distortion, np.float64).ravel()
    if not (np.isfinite(matrix).all() and np.isfinite(distortion).all() and min(matrix[0, 0], matrix[1, 1]) > 0.0):
        raise CalibrationError(f"the {len(views)} views have no solution: hold the board in other places and tilt it")
    poses = [
        (np.asarray(r, np.float64).ravel(), np.asarray(t, np.float64).ravel())
        for r, t in zip(rotations, translations, strict=True)
    ]
    residuals = [
        view.corners_px - _project(board, view, pose, matrix, distortion)[0]
        for view, pose in zip(views, poses, strict=True)
    ]
    return _Solved(matrix, distortion, poses, residuals)


def _project(
    board: Board, view: BoardView, pose: Sequence[cv2.typing.MatLike], camera_matrix: Array, distortion: Array
) -> tuple[Array, Array]:
    """(n, 2) px of a view's corners, and OpenCV's (2n, 15) Jacobian."""
    rotation, translation = pose
    pixels, jacobian = cv2.projectPoints(board.corners[view.indices], rotation, translation, camera_matrix, distortion)
    return np.asarray(pixels, np.float64).reshape(-1, 2), np.asarray(jacobian, np.float64)


def _covariance(board: Board, views: Sequence[BoardView], solved: _Solved) -> Array:
    """(9, 9) of the lens, the poses of the views marginalised: the inverse of the sum of Schur complements, by the
    variance of the residuals."""
    information = np.zeros((9, 9))
    for view, pose in zip(views, solved.poses, strict=True):
        _, jacobian = _project(board, view, pose, solved.camera_matrix, solved.distortion)
        lens, body = jacobian[:, _LENS], jacobian[:, :6]
        cross = body.T @ lens
        information += lens.T @ lens - cross.T @ np.linalg.lstsq(body.T @ body, cross, rcond=None)[0]
    residuals = np.vstack(solved.residuals).ravel()
    variance = float(residuals @ residuals) / max(len(residuals) - 6 * len(views) - 9, 1)
    # Units differ by orders of magnitude: to ones on the diagonal first.
    scale = 1.0 / np.sqrt(np.maximum(np.diag(information), 1e-12))
    covariance: Array = variance * scale[:, None] * np.linalg.pinv(information * np.outer(scale, scale)) * scale
    return covariance


def projection_sigma_px(intrinsics: Intrinsics, covariance: Array) -> Array:
    """(CELLS, CELLS) px: how well it is known where a ray is seen, from the `covariance` (9, 9) of the lens.

    The standard deviation in the worst direction, in the middles of cells, the outermost at the border. A turn of the
    whole camera does not count: it is found again when the camera is placed.
    """
    u, v = (np.linspace(0.0, n - 1.0, CELLS) for n in (intrinsics.width_px, intrinsics.height_px))
    pixels = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 1, 2)
    rays = cv2.undistortPoints(pixels, intrinsics.camera_matrix, intrinsics.distortion).reshape(-1, 2)
    points = np.hstack([rays, np.ones((len(rays), 1))])
    _, jacobian = cv2.projectPoints(points, np.zeros(3), np.zeros(3), intrinsics.camera_matrix, intrinsics.distortion)
    turn, lens = np.asarray(jacobian[:, :3], np.float64), np.asarray(jacobian[:, _LENS], np.float64)
    lens = lens - turn @ np.linalg.lstsq(turn, lens, rcond=None)[0]
    by_pixel = lens.reshape(-1, 2, 9)
    variances = np.linalg.eigvalsh(by_pixel @ covariance @ by_pixel.transpose(0, 2, 1))[:, -1]
    sigma: Array = np.sqrt(np.maximum(variances, 0.0)).reshape(CELLS, CELLS)
    return sigma


def _held_back_rms_px(board: Board, views: Sequence[BoardView], solved: _Solved) -> float:
    """Each view is held back once: solved without it, then its pose alone is fitted."""
    if len(views) < SOLVABLE_VIEWS + 2:
        return math.inf
    squares = []
    for fold in range(min(_FOLDS, len(views))):
        held = range(fold, len(views), _FOLDS)
        try:
            others = _solve(board, [view for k, view in enumerate(views) if k not in held], solved)
        except CalibrationError:
            return math.inf
        for k in held:
            points = board.corners[views[k].indices]
            rotation, translation = (value.reshape(3, 1).copy() for value in solved.poses[k])
            pose = cv2.solvePnPRefineLM(
                points, views[k].corners_px, others.camera_matrix, others.distortion, rotation, translation
            )
            expected, _ = _project(board, views[k], pose, others.camera_matrix, others.distortion)
            squares.append(np.square(views[k].corners_px - expected).sum(axis=1))
    return math.sqrt(float(np.mean(np.concatenate(squares))))


def coverage(views: Collection[BoardView]) -> NDArray[np.int_]:
    """(CELLS, CELLS) number of views with a corner in that cell of the image; row 0 at the top."""
    counts = np.zeros((CELLS, CELLS), int)
    for view in views:
        cells = np.clip((view.corners_px + 0.5) / (view.width_px, view.height_px) * CELLS, 0, CELLS - 1).astype(int)
        counts[tuple(np.unique(cells, axis=0)[:, ::-1].T)] += 1
    return counts


def place_in_words(row: int, column: int) -> str:
    """Of a cell, by ninths of the picture: "the top left corner", "the left edge", "the middle"."""
    third = CELLS / 3.0
    down = ("top", "", "bottom")[int((row + 0.5) // third)]
    across = ("left", "", "right")[int((column + 0.5) // third)]
    if down and across:
        return f"the {down} {across} corner"
    return f"the {down or across} edge" if down or across else "the middle"


def judge(views: Sequence[BoardView], calibration: Calibration | None) -> tuple[Criterion, ...]:
    """Whether a calibration is good enough, condition by condition. `views` and `calibration` as far as there are any;
    with a calibration, `views` are those that it used."""
    seen = coverage(views) > 0
    cells, needed = int(seen.sum()), math.ceil(LEAST_COVERAGE * CELLS * CELLS)
    corners = [(row, column) for row in (0, -1) for column in (0, -1)]
    unseen = [place_in_words(r % CELLS, c % CELLS) for r, c in corners if not seen[r, c]]
    criteria = [
        _count(
            "views",
            len(views),
            LEAST_VIEWS,
            f"{len(views)} views of the board",
            "take {} more, each with the board elsewhere",
        ),
        _count(
            "coverage",
            cells,
            needed,
            f"corners of the board in {100 * cells // CELLS**2} % of the picture",
            f"hold the board to where it has not been yet, most of all {_emptiest(seen)}",
        ),
        _count(
            "corners",
            4 - len(unseen),
            4,
            f"{4 - len(unseen)} of the 4 corners of the picture reached",
            f"hold the board into {' and '.join(unseen)}",
        ),
    ]
    tilts = calibration.tilts_deg if calibration is not None else np.zeros(0)
    tilted = int(((tilts >= TILTED_DEG[0]) & (tilts <= TILTED_DEG[1])).sum())
    criteria.append(
        _count(
            "tilt",
            tilted,
            LEAST_TILTED,
            f"{tilted} views tilted by {TILTED_DEG[0]:.0f} to {TILTED_DEG[1]:.0f} deg",
            "tilt the board by about 30 deg, to another side each time, in {} more views",
        )
    )
    if calibration is None:
        unsolved = ("focal", "projection", "held back", "fit")
        return (*criteria, *(Criterion(name, False, 0.0, "not solved yet", "") for name in unsolved))
    matrix = calibration.intrinsics.camera_matrix
    focal = float(max(math.sqrt(calibration.covariance[k, k]) / matrix[k, k] for k in (0, 1)))
    sigma = calibration.projection_sigma_px
    worst = float(sigma.max())
    row, column = np.unravel_index(int(sigma.argmax()), sigma.shape)
    ratio = calibration.held_back_rms_px / max(calibration.rms_px, 1e-9)
    return (
        *criteria,
        _limit(
            "focal",
            focal,
            LARGEST_FOCAL_SIGMA,
            f"focal length known to {100 * focal:.2f} %",
            "tilt the board more, and bring it nearer so that it fills the picture",
        ),
        _limit(
            "projection",
            worst,
            LARGEST_PROJECTION_SIGMA_PX,
            f"pixels known to {worst:.2f} px at worst, in {place_in_words(int(row), int(column))}",
            f"take more views with the board in {place_in_words(int(row), int(column))}",
        ),
        _limit(
            "held back",
            ratio,
            LARGEST_HELD_BACK,
            f"views held back from the solve fit {ratio:.2f} times as badly"
            if math.isfinite(ratio)
            else "too few views to hold some back",
            "take more views, and hold the board still in each",
        ),
        _fit(calibration.rms_px, abs(matrix[0, 0] / matrix[1, 1] - 1.0)),
    )


def _count(name: str, value: int, needed: int, text: str, advice: str) -> Criterion:
    met = value >= needed
    return Criterion(name, met, min(1.0, value / needed), text, "" if met else advice.format(needed - value))


def _limit(name: str, value: float, limit: float, text: str, advice: str) -> Criterion:
    met = value <= limit
    return Criterion(name, met, 1.0 if met else min(1.0, limit / value), text, "" if met else advice)


def _fit(rms_px: float, stretch: float) -> Criterion:
    text = f"corners fit to {rms_px:.2f} px; focal lengths across and down differ by {100.0 * stretch:.1f} %"
    part = min(1.0, LARGEST_RMS_PX / max(rms_px, 1e-9), LARGEST_STRETCH / max(stretch, 1e-9))
    advice = "check that it is the board it is said to be, and flat; measure its squares across and down"
    return Criterion("fit", part == 1.0, part, text, "" if part == 1.0 else advice)


def _emptiest(seen: NDArray[np.bool_]) -> str:
    """The place of the cell with the fewest seen cells around it."""
    around = cv2.boxFilter(seen.astype(np.float32), -1, (3, 3), borderType=cv2.BORDER_REPLICATE)
    row, column = np.unravel_index(int((around + seen).argmin()), seen.shape)
    return place_in_words(int(row), int(column))
