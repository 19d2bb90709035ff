"""Pictures of calibration boards through a known camera, each pixel traced through its distortion."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from camera.boards import Board
from camera.calibration import Intrinsics
from fusion.geometry import exp_so3, inverse, transform
from fusion.measurements import Array

# A lens that bends: 60 px at the corners of the picture.
CAMERA = Intrinsics(
    np.array([[612.0, 0.0, 327.3], [0.0, 609.5, 236.1], [0.0, 0.0, 1.0]]),
    np.array([-0.21, 0.07, 0.0011, -0.0006, 0.0]),
    640,
    480,
)
TEXELS = 40
RAYS = 3


def texture(board: Board) -> NDArray[np.uint8]:
    """The printed board with a white margin of one square, TEXELS per square."""
    across, down = board.squares
    if board.kind == "charuco":
        print_ = board.opencv().generateImage((across * TEXELS, down * TEXELS), marginSize=0)
    else:
        black = (np.add.outer(np.arange(down), np.arange(across)) % 2 == 0).astype(np.uint8)
        print_ = np.kron(255 * (1 - black), np.ones((TEXELS, TEXELS), np.uint8)).astype(np.uint8)
    return np.pad(20 + (print_ * (210 / 255)).astype(np.uint8), TEXELS, constant_values=230)


class Studio:
    """Takes pictures of one board with one camera."""

    def __init__(self, board: Board, intrinsics: Intrinsics = CAMERA, seed: int = 0) -> None:
        self.board = board
        self.intrinsics = intrinsics
        self._random = np.random.default_rng(seed)
        self._texture = texture(board)
        width, height = intrinsics.width_px * RAYS, intrinsics.height_px * RAYS
        x, y = np.meshgrid((np.arange(width) + 0.5) / RAYS - 0.5, (np.arange(height) + 0.5) / RAYS - 0.5)
        pixels = np.stack([x, y], axis=-1).reshape(-1, 1, 2)
        rays = cv2.undistortPoints(pixels, intrinsics.camera_matrix, intrinsics.distortion)
        self._rays = rays.reshape(height, width, 2).astype(np.float32)

    def picture(self, camera_from_board: Array, noise: float = 2.0, blur_px: float = 0.6) -> NDArray[np.uint8]:
        """(height, width) uint8; `camera_from_board` (4, 4) as OpenCV has a board: x right, y down, z into it."""
        texel = TEXELS / self.board.square
        to_texels = np.array([[texel, 0.0, TEXELS - 0.5], [0.0, texel, TEXELS - 0.5], [0.0, 0.0, 1.0]])
        plane = to_texels @ np.linalg.inv(camera_from_board[:3, [0, 1, 3]])
        where = cv2.perspectiveTransform(self._rays, plane).astype(np.float32)
        fine = cv2.remap(self._texture, where, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=90)
        size = (self.intrinsics.width_px, self.intrinsics.height_px)
        image = cv2.GaussianBlur(cv2.resize(fine, size, interpolation=cv2.INTER_AREA), (0, 0), blur_px)
        grain = self._random.normal(0.0, noise, image.shape)
        return np.clip(np.rint(image + grain), 0, 255).astype(np.uint8)

    def corners_px(self, camera_from_board: Array) -> Array:
        """(n, 2) px where the inner corners truly are."""
        points = self.board.corners @ camera_from_board[:3, :3].T + camera_from_board[:3, 3]
        return cv2.projectPoints(
            points, np.zeros(3), np.zeros(3), self.intrinsics.camera_matrix, self.intrinsics.distortion
        )[0].reshape(-1, 2)

    def held(self, at: tuple[float, float], distance: float, tilt_deg: float = 0.0, way_deg: float = 0.0) -> Array:
        """camera_from_board with the board's middle seen at a part (0..1, 0..1) of the picture, `distance` m away,
        turned by `tilt_deg` about an axis in its plane that points along `way_deg`."""
        pixel = np.array(at) * (self.intrinsics.width_px - 1, self.intrinsics.height_px - 1)
        ray = cv2.undistortPoints(
            pixel.reshape(1, 1, 2), self.intrinsics.camera_matrix, self.intrinsics.distortion
        ).ravel()
        way = np.radians(way_deg)
        R = exp_so3(np.radians(tilt_deg) * np.array([np.cos(way), np.sin(way), 0.0]))
        return transform(R, distance * np.append(ray, 1.0)) @ inverse(transform(np.eye(3), self.board.middle))


def good_poses(studio: Studio) -> list[Array]:
    """What a patient person does: over the whole picture, tilted every way, near and far."""
    poses = []
    size = max(studio.board.squares) * studio.board.square
    for k, (x, y) in enumerate([(x, y) for y in (0.22, 0.5, 0.78) for x in (0.2, 0.4, 0.6, 0.8)]):
        poses.append(studio.held((x, y), 1.9 * size, 30.0, 70.0 * k))
        poses.append(studio.held((x, y), 1.5 * size, 12.0, 70.0 * k + 100.0))
    return poses
