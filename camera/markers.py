"""Markers in an image: found, decoded, their corners measured.

OpenCV's detector says which markers are there and roughly where. The corners are then measured again on the image:
intensity profiles across each side, an edge in each profile, a curve through the edges of a side, and corners where
neighbouring sides meet. That is a tenth of the error of the detector's own corners.
"""

from __future__ import annotations

import difflib
from collections.abc import Collection
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from fusion.measurements import Array

Image = NDArray[np.uint8]
Pixels = NDArray[np.uint8 | np.uint16]

# 4X4_50 ... 7X7_1000, APRILTAG_16H5 ... APRILTAG_36H11, ARUCO_MIP_36H12, ARUCO_ORIGINAL
DICTIONARIES = tuple(sorted({name.removeprefix("DICT_").upper() for name in dir(cv2.aruco) if name[:5] == "DICT_"}))

# No corner is believed to be known better than this: lens model, flatness of the paper, print. px
SIGMA_FLOOR_PX = 0.1
# Sigma of the detector's own corners, used where a marker's edges could not be measured. px
SIGMA_UNREFINED_PX = 0.8


class DictionaryError(ValueError):
    """There is no such marker dictionary. The text suggests one and lists them all."""


@dataclass(frozen=True, slots=True)
class MarkerSighting:
    """One marker in one frame of one camera.

    `t`: s, mid-exposure. `corners_px`: (4, 2), clockwise from the marker's top left; pixel (0, 0) is the middle of the
    first pixel. `sigma_px`: standard deviation of each coordinate.
    """

    t: float
    camera: str
    id: int
    corners_px: Array
    sigma_px: float


def dictionary_by_name(name: str) -> cv2.aruco.Dictionary:
    """A dictionary of OpenCV by its name, in any case, with or without `DICT_`. Raises DictionaryError."""
    plain = name.strip().upper().removeprefix("DICT_")
    if plain not in DICTIONARIES:
        near = difflib.get_close_matches(plain, DICTIONARIES, 1, 0.5)
        suggestion = f"; did you mean {near[0]}?" if near else ""
        raise DictionaryError(f"no marker dictionary {name!r}{suggestion} There are: {', '.join(DICTIONARIES)}")
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{plain}"))


def grey(image: Pixels) -> Image:
    """Any image with 1, 3 or 4 channels (BGR, BGRA) of 8 or 16 bits -> (height, width) uint8.

    16 bits are stretched: cameras deliver 10 or 12 of them, and only contrast matters. Raises ValueError for others.
    """
    pixels: NDArray[np.integer] = np.asarray(image)
    if pixels.ndim == 3 and pixels.shape[2] == 1:
        pixels = pixels[..., 0]
    if pixels.ndim not in (2, 3) or (pixels.ndim == 3 and pixels.shape[2] not in (3, 4)) or pixels.size == 0:
        raise ValueError(f"an image of shape {pixels.shape}: (height, width) or (height, width, 1, 3 or 4) is needed")
    if pixels.dtype not in (np.uint8, np.uint16):
        raise ValueError(f"an image of {pixels.dtype}: 8 or 16 bit unsigned is needed")
    if pixels.ndim == 3:
        pixels = np.asarray(cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY if pixels.shape[2] == 3 else cv2.COLOR_BGRA2GRAY))
    if pixels.dtype == np.uint16:
        # Not the maximum: one hot pixel would make the picture dark.
        white = max(float(np.percentile(pixels, 99.9)), 1.0)
        pixels = np.asarray(cv2.convertScaleAbs(pixels, alpha=255.0 / white))
    return np.ascontiguousarray(pixels, np.uint8)


def sample_image(image: Image, where: NDArray[np.float32], border: int) -> NDArray[np.uint8]:
    """Values of an image at (rows, columns, 2) px, interpolated linearly. `border`: one of OpenCV's BORDER_ modes."""
    # The stubs demand a second map, where None is what says that the first one holds both coordinates.
    return np.asarray(cv2.remap(image, where, None, cv2.INTER_LINEAR, borderMode=border), np.uint8)  # type: ignore[call-overload]


class MarkerDetector:
    """Finds the markers of one dictionary; of the `ids` given only, if any.

    OpenCV's detector writes into itself while it works: one MarkerDetector per thread.
    Raises DictionaryError for an unknown dictionary, ValueError for an id that it does not have.
    """

    def __init__(self, dictionary: str, ids: Collection[int] | None = None) -> None:
        cv2.setNumThreads(1)
        self._dictionary = dictionary_by_name(dictionary)
        self.cells = self._dictionary.markerSize + 2
        size = len(self._dictionary.bytesList)
        if ids is not None and (unknown := sorted(id for id in ids if not 0 <= id < size)):
            raise ValueError(f"dictionary {dictionary} has the ids 0 to {size - 1}, not {unknown}")
        self.ids = None if ids is None else frozenset(ids)
        parameters = cv2.aruco.DetectorParameters()
        self._detector = cv2.aruco.ArucoDetector(self._dictionary, parameters)

    def detect(self, image: Pixels, t: float = 0.0, camera: str = "") -> list[MarkerSighting]:
        """The markers of one frame, by id. `image` as in `grey`, which says what it raises."""
        picture = grey(image)
        corners, ids, _ = self._detector.detectMarkers(picture)
        found = (
            []
            if ids is None
            else [
                (int(id), corner.reshape(4, 2))
                for id, corner in zip(ids.ravel(), corners, strict=True)
                if self.ids is None or int(id) in self.ids
            ]
        )
        if not found:
            return []
        refined, sigma = refine_corners(picture, np.array([c for _, c in found], np.float64), self.cells)
        return [MarkerSighting(t, camera, id, refined[k], float(sigma[k])) for k, (id, _) in enumerate(found)]


# Edge refinement: profiles per side, samples per profile, where along a side the profiles lie
_PROFILES = 24
_SAMPLES = 21
# From this length a side is fitted with a parabola: a lens bends it by more than a line's corners are uncertain. px
_CURVED_PX = 60.0


def refine_corners(image: Image, corners_px: Array, cells: int) -> tuple[Array, Array]:
    """Measures corners on the edges of the black square. (n, 4, 2) px -> (n, 4, 2) px and (n,) sigma, px.

    `cells`: of a marker's side, its black border included. A marker whose sides do not show a clear edge from black to
    white keeps the corners it came with, and SIGMA_UNREFINED_PX.
    """
    start = np.asarray(corners_px, dtype=np.float64)
    length = np.linalg.norm(np.roll(start, -1, axis=1) - start, axis=2)
    cell = length.min(axis=1) / cells
    # Half a profile: within the black border inside and the white margin outside, each a cell wide.
    reach = np.clip(0.8 * cell, 1.5, 8.0)
    corners, good = start, np.ones(len(start), dtype=bool)
    sigma = np.full(len(start), SIGMA_UNREFINED_PX)
    # Twice: the detector's corners may be off by more than a pixel, which tilts the profiles and cuts them short.
    for half in (reach, np.clip(0.6 * cell, 1.5, 4.0)):
        corners, sigma, clear = _refine_once(image, corners, half)
        good &= clear
    good &= np.linalg.norm(corners - start, axis=2).max(axis=1) <= np.maximum(reach, 2.0)
    corners = np.where(good[:, None, None], corners, start)
    return corners, np.where(good, np.maximum(sigma, SIGMA_FLOOR_PX), SIGMA_UNREFINED_PX)


def _refine_once(image: Image, corners: Array, reach: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
    n = len(corners)
    side = np.roll(corners, -1, axis=1) - corners
    length = np.linalg.norm(side, axis=2)
    along = side / np.maximum(length, 1e-9)[..., None]
    # Corners run clockwise in the image (y down), so that this points out of the square.
    outward = np.stack([along[..., 1], -along[..., 0]], axis=-1)
    # -1 ... 1 over the side. The ends are left out: there the other side's edge is within the blur.
    u = np.linspace(-0.84, 0.84, _PROFILES)
    s = np.linspace(-1.0, 1.0, _SAMPLES)
    middle = corners + 0.5 * side
    base = middle[:, :, None] + (0.5 * u)[:, None] * side[:, :, None]
    offset = reach[:, None] * s
    where = base[:, :, :, None] + offset[:, None, None, :, None] * outward[:, :, None, None]
    maps = where.reshape(n * 4, _PROFILES * _SAMPLES, 2).astype(np.float32)
    values = sample_image(image, maps, cv2.BORDER_REPLICATE)
    profile = values.reshape(n, 4, _PROFILES, _SAMPLES).astype(np.float64)
    gradient = np.diff(profile, axis=-1)
    between = 0.5 * (s[1:] + s[:-1])
    # Only what grows brighter outwards, and only what stands out: the rest is noise and would pull to the middle.
    rise = np.maximum(gradient, 0.0)
    rise = np.maximum(rise - 0.3 * rise.max(axis=-1, keepdims=True), 0.0)
    strength = rise.sum(axis=-1)
    edge = (rise @ between) / np.maximum(strength, 1e-9) * reach[:, None, None]
    contrast = profile[..., -_SAMPLES // 4 :].mean(axis=-1) - profile[..., : _SAMPLES // 4].mean(axis=-1)
    usual = np.median(contrast, axis=(1, 2), keepdims=True)
    valid = (contrast > 0.4 * usual) & (contrast > 2.0)
    # Robust least squares, Tukey's biweight: edge = a + b u (+ c u^2) along each side.
    curved = (length.min(axis=1) >= _CURVED_PX).astype(np.float64)
    powers = np.stack([np.ones_like(u), u, u * u], axis=-1)
    weight = valid.astype(np.float64)
    ridge = np.diag([1e-9, 1e-9, 1e-9])
    for _ in range(4):
        A = powers * curved_columns(curved)[:, None, None, :]
        normal = np.einsum(
            "nijp,nij,nijq->nipq",
            np.broadcast_to(A, (n, 4, _PROFILES, 3)),
            weight,
            np.broadcast_to(A, (n, 4, _PROFILES, 3)),
        )
        right = np.einsum("nijp,nij->nip", np.broadcast_to(A, (n, 4, _PROFILES, 3)), weight * edge)
        # A straight side has no third unknown: its row is 0 = 0 and the ridge makes it c = 0.
        fit = np.linalg.solve(normal + ridge, right[..., None])[..., 0]
        residual = edge - np.einsum("nijp,nip->nij", np.broadcast_to(A, (n, 4, _PROFILES, 3)), fit)
        spread = 1.4826 * np.median(
            np.where(valid, np.abs(residual), np.nan) if valid.all() else np.abs(residual), axis=(1, 2), keepdims=True
        )
        scale = 4.685 * np.maximum(spread, 0.03)
        weight = valid * np.square(np.maximum(1.0 - np.square(residual / scale), 0.0))
    support = weight.sum(axis=2)
    return (
        _intersections(corners, side, outward, fit),
        _sigma(weight, residual, support),
        (support > 0.4 * _PROFILES).all(axis=1),
    )


def curved_columns(curved: Array) -> Array:
    return np.stack([np.ones_like(curved), np.ones_like(curved), curved], axis=-1)


def _sigma(weight: Array, residual: Array, support: Array) -> Array:
    variance = (weight * residual**2).sum(axis=(1, 2)) / np.maximum(support.sum(axis=1), 1e-9)
    sigma: Array = np.sqrt(variance * 4.0 / np.maximum(support.min(axis=1), 1.0) * 2.0)
    return sigma


def _intersections(corners: Array, side: Array, outward: Array, fit: Array) -> Array:
    """Where each fitted side meets the one before it."""
    point = corners.copy()
    middle = corners + 0.5 * side
    for _ in range(2):
        tangents = []
        for k in (0, 1):
            # corner i lies on side i (k = 0) and on side i - 1 (k = 1)
            m, d, o, f = (np.roll(x, k, axis=1) for x in (middle, 0.5 * side, outward, fit))
            u = ((point - m) * d).sum(axis=-1) / np.maximum((d * d).sum(axis=-1), 1e-9)
            on = m + u[..., None] * d + (f[..., 0] + f[..., 1] * u + f[..., 2] * u * u)[..., None] * o
            direction = d + (f[..., 1] + 2.0 * f[..., 2] * u)[..., None] * o
            tangents.append((on, direction))
        (p, v), (q, w) = tangents
        cross = v[..., 0] * w[..., 1] - v[..., 1] * w[..., 0]
        gap = q - p
        step = (gap[..., 0] * w[..., 1] - gap[..., 1] * w[..., 0]) / np.where(np.abs(cross) < 1e-9, 1e-9, cross)
        point = p + step[..., None] * v
    return point
