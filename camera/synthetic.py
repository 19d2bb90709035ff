"""Rendered camera frames: markers above a textured floor, for the demo and the tests.

Every pixel is traced through the camera's full model, distortion included: its ray is cut with the floor or with the
plane of a marker and looks up what is printed there. Corner truth is therefore what `camera.fix.project` says.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import cv2
import numpy as np
from numpy.typing import NDArray

from camera.calibration import Intrinsics
from camera.dictionaries import dictionary_by_name
from camera.fix import marker_corners, project
from camera.images import sample_image
from fusion.geometry import inverse, transform, transform_points
from fusion.measurements import Array

# Grey levels of matte print and paper under the brightest light of the room.
_BLACK, _PAPER = 28, 225
# Texels per cell of a marker: those of a rendered marker are chosen so that about one falls on each ray.
_TEXELS = (2, 4, 8, 16, 32)
# Rays per pixel and axis.
_RAYS = 3
# px of the floor texture, which repeats, and m that it covers.
_FLOOR_PX, _FLOOR_M = 1024, 4.0


class Room:
    """A room seen by one fixed camera.

    `intrinsics` with an image size; `world_from_camera` (4, 4), above the floor z = 0; `dictionary` as in
    `camera.markers`. The same `seed` gives the same floor and the same noise.
    """

    def __init__(self, intrinsics: Intrinsics, world_from_camera: Array, dictionary: str, seed: int = 0) -> None:
        if not intrinsics.width_px or not intrinsics.height_px:
            raise ValueError("rendering needs intrinsics with width_px and height_px")
        self.intrinsics = intrinsics
        self.world_from_camera = np.asarray(world_from_camera, dtype=np.float64)
        self._random = np.random.default_rng(seed)
        self._dictionary = dictionary_by_name(dictionary)
        self._textures: dict[tuple[int, int], NDArray[np.uint8]] = {}
        self._at_rest: dict[int, tuple[float, bytes]] = {}
        self._noise = (0.0, np.zeros((0, 0), np.int16))

        width, height = intrinsics.width_px, intrinsics.height_px
        x, y = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
        pixels = np.stack([x, y], axis=-1).reshape(-1, 1, 2)
        # x/z and y/z of each pixel's ray in the camera frame
        self._rays = (
            cv2.undistortPoints(pixels, intrinsics.camera_matrix, intrinsics.distortion)
            .reshape(height, width, 2)
            .astype(np.float32)
        )
        # cos^4 of the angle to the axis, at half strength as in a lens that is stopped down
        self._light = (0.5 + 0.5 / (1.0 + np.square(self._rays).sum(axis=-1)) ** 2).astype(np.float32)
        self._floor = self._render_floor()
        self._background = self._floor.copy()

    def corners_px(self, size: float, world_from_marker: Array) -> Array:
        """(4, 2) px where a marker's corners are truly seen."""
        points = transform_points(inverse(self.world_from_camera) @ world_from_marker, marker_corners(size))
        return project(points, self.intrinsics)[0]

    def render(
        self,
        markers: Mapping[int, tuple[float, Array, Array]],
        *,
        noise: float = 2.0,
        brightness: float = 1.0,
        blur_px: float = 0.6,
    ) -> NDArray[np.uint8]:
        """One frame, (height, width) uint8.

        `markers`: id -> side in m, world_from_marker (4, 4) when the exposure starts and when it ends; the marker moves
        evenly in between. Each is printed on paper with a margin of one cell. Markers outside the picture are left out.
        `noise`: sigma of the sensor's noise in grey levels. `brightness`: of the light, 1 is a well-lit room.
        `blur_px`: sigma of the lens's point spread.
        """
        resting = {
            id: (size, np.asarray(start).tobytes())
            for id, (size, start, end) in markers.items()
            if start is end or np.array_equal(start, end)
        }
        # Anchors lie still: they are drawn again only when one of the resting markers has changed.
        if resting != self._at_rest:
            self._at_rest = resting
            self._background = self._floor.copy()
            for id in resting:
                self._draw(self._background, id, *markers[id])
        image = self._background.copy()
        for id in markers.keys() - resting.keys():
            self._draw(image, id, *markers[id])
        if blur_px > 0.0:
            image = np.asarray(cv2.GaussianBlur(image, (0, 0), blur_px), np.uint8)
        if brightness != 1.0:
            image = np.asarray(cv2.convertScaleAbs(image, alpha=brightness), np.uint8)
        return self._with_noise(image, noise) if noise > 0.0 else image

    def _render_floor(self) -> NDArray[np.uint8]:
        """The empty floor through the camera; beyond its horizon, darkness."""
        tile = _floor_texture(self._random)
        rotation, camera = self.world_from_camera[:3, :3], self.world_from_camera[:3, 3]
        directions = np.dstack([self._rays, np.ones_like(self._rays[..., 0])]) @ rotation.T.astype(np.float32)
        down = directions[..., 2] < -1e-3
        distance = np.where(down, -camera[2] / np.where(down, directions[..., 2], -1.0), 0.0)
        world = camera[:2].astype(np.float32) + distance[..., None].astype(np.float32) * directions[..., :2]
        texels = np.mod(world * (_FLOOR_PX / _FLOOR_M), _FLOOR_PX).astype(np.float32)
        floor = sample_image(tile, texels, cv2.BORDER_WRAP)
        return np.where(down, floor * self._light, 20.0).astype(np.uint8)

    def _draw(self, image: NDArray[np.uint8], id: int, size: float, start: Array, end: Array) -> None:
        """Draws one marker over `image`: each ray of a pixel is cut with the marker's plane at several instants."""
        camera_from_world = inverse(self.world_from_camera)
        poses = [camera_from_world @ start, camera_from_world @ end]
        cells = self._dictionary.markerSize + 2
        paper = size * (cells + 2) / cells
        outlines = [transform_points(pose, marker_corners(paper)) for pose in poses]
        if min(outline[:, 2].min() for outline in outlines) < 1e-2:
            return
        outline_px = np.vstack([project(outline, self.intrinsics)[0] for outline in outlines])
        height, width = image.shape
        left, top = np.maximum(np.floor(outline_px.min(axis=0)).astype(int) - 2, 0)
        right, bottom = np.minimum(np.ceil(outline_px.max(axis=0)).astype(int) + 3, (width, height))
        if right - left < 2 or bottom - top < 2:
            return
        moved_px = float(np.linalg.norm(outline_px[4:] - outline_px[:4], axis=1).max())
        # Half a pixel between exposures leaves no steps; the instants take over part of the work of the rays.
        exposures = 1 if moved_px < 1e-3 else min(2 + int(2.0 * moved_px), 32)
        per_axis = _RAYS if exposures == 1 else 2
        side_px = float(np.linalg.norm(outline_px[1] - outline_px[0]))
        texture = self._texture(id, next((n for n in _TEXELS if n * (cells + 2) > side_px * per_axis), _TEXELS[-1]))

        box = np.ascontiguousarray(self._rays[top:bottom, left:right])
        fine = cv2.resize(box, None, fx=per_axis, fy=per_axis, interpolation=cv2.INTER_LINEAR)
        shape = (bottom - top, right - left)
        total = np.zeros((*shape, 2), np.float32)
        texels = texture.shape[0]
        # Paper coordinates (m) -> texels; -0.5 because a texel's value stands for its middle.
        texel_from_paper = np.array(
            [[texels / paper, 0.0, 0.5 * texels - 0.5], [0.0, -texels / paper, 0.5 * texels - 0.5], [0.0, 0.0, 1.0]]
        )
        for k in range(exposures):
            s = (k + 0.5) / exposures
            pose = poses[0] if exposures == 1 else _between(poses[0], poses[1], s)
            # A ray (x, y, 1) meets the plane z = 0 of the marker where [r1 r2 t] (u, v, 1) is along it.
            plane = texel_from_paper @ np.linalg.inv(pose[:, [0, 1, 3]][:3])
            where = cv2.perspectiveTransform(fine, plane)
            sample = sample_image(texture, np.asarray(where, np.float32), cv2.BORDER_CONSTANT)
            total += cv2.resize(sample, shape[::-1], interpolation=cv2.INTER_AREA)
        total *= 1.0 / (255.0 * exposures)
        cover = total[..., 1]
        part = image[top:bottom, left:right]
        part[:] = part * (1.0 - cover) + total[..., 0] * 255.0 * self._light[top:bottom, left:right] + 0.5

    def _texture(self, id: int, texels: int) -> NDArray[np.uint8]:
        """(n, n, 2): brightness times coverage, and coverage, of a marker on its paper; transparent outside."""
        if (id, texels) not in self._textures:
            cells = self._dictionary.markerSize + 2
            bits = cv2.aruco.generateImageMarker(self._dictionary, id, cells)
            paper = np.pad(np.where(bits > 0, _PAPER, _BLACK).astype(np.uint8), 1, constant_values=_PAPER)
            fine = np.kron(paper, np.ones((texels, texels), np.uint8))
            # remap fades to its border value of 0 over one texel, centred on the edge of the paper
            self._textures[id, texels] = np.dstack([fine, np.full_like(fine, 255)])
        return self._textures[id, texels]

    def _with_noise(self, image: NDArray[np.uint8], noise: float) -> NDArray[np.uint8]:
        """Adds a random part of a larger sheet of noise, which is made once."""
        height, width = image.shape
        if self._noise[0] != noise:
            sheet = self._random.normal(0.0, noise, (height + 128, width + 128))
            self._noise = (noise, np.rint(sheet).astype(np.int16))
        top, left = self._random.integers(0, 128, 2)
        sheet16 = self._noise[1][top : top + height, left : left + width]
        return np.asarray(cv2.add(image, sheet16, dtype=cv2.CV_8U), np.uint8)


def _between(a: Array, b: Array, s: float) -> Array:
    """The pose at the part `s` of the way; over one exposure the chord of the rotation is as good as its arc."""
    U, _, Vt = np.linalg.svd((1.0 - s) * a[:3, :3] + s * b[:3, :3])
    return transform(U @ Vt, (1.0 - s) * a[:3, 3] + s * b[:3, 3])


def _floor_texture(random: np.random.Generator) -> NDArray[np.uint8]:
    """A floor of tiles 0.5 m wide with joints, stains and grain; it continues where it repeats."""
    texture = np.full((_FLOOR_PX, _FLOOR_PX), 120.0, np.float32)
    for octave, strength in ((4, 9.0), (16, 7.0), (64, 6.0), (256, 5.0)):
        coarse = random.normal(0.0, strength, (octave, octave)).astype(np.float32)
        # Wrapped by one cell on each side before it is enlarged, so that the seam does not show.
        scale = _FLOOR_PX // octave
        enlarged = cv2.resize(np.pad(coarse, 1, mode="wrap"), None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
        texture += enlarged[scale:-scale, scale:-scale]
    tile = _FLOOR_PX // int(_FLOOR_M / 0.5)
    shades = random.normal(0.0, 5.0, (_FLOOR_PX // tile, _FLOOR_PX // tile)).astype(np.float32)
    texture += np.kron(shades, np.ones((tile, tile), np.float32))
    joints = np.arange(_FLOOR_PX) % tile < 2
    texture[joints, :] -= 35.0
    texture[:, joints] -= 35.0
    return np.clip(texture, 0.0, 255.0).astype(np.uint8)


def straight_down(x: float, y: float, height: float, yaw: float = 0.0) -> Array:
    """world_from_camera (4, 4) of a camera at (x, y, height) m that looks straight down, its image's right-hand side
    along world x turned by `yaw` rad."""
    c, s = math.cos(yaw), math.sin(yaw)
    return transform([[c, s, 0.0], [s, -c, 0.0], [0.0, 0.0, -1.0]], [x, y, height])
