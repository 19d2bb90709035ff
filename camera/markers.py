"""Markers in an image: found, their corners measured, decoded.

1. OpenCV's ArucoDetector finds quadrilaterals; those that it cannot decode are kept as well.
2. Corners are measured on the image: intensity profiles across each side, an edge in each profile, a curve through the
   edges of a side, corners where neighbouring sides meet. The error is about a tenth of the detector's.
3. What is inside is compared with every marker of the dictionary, blurred as the image may be. This reads markers that
   are too small or too blurred for hard bits, and rejects what only happens to have the right ones.
"""

from __future__ import annotations

import difflib
import math
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

# Corners of the unit square in the order of a marker's
_UNIT = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]], np.float32)

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
        suggestion = f"; did you mean {near[0]}?" if near else "."
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


@dataclass(frozen=True, slots=True)
class _Pass:
    """One way to look for quadrilaterals: image scale, whether contrast is equalised first, threshold windows in px."""

    scale: float = 1.0
    equalise: bool = False
    windows: tuple[int, int, int] = (3, 23, 10)


# The cheap ones first. One window is enough for a sharp, well-lit marker, half the resolution for one of 40 px or more.
# A quarter finds large markers under strong blur, equalised contrast those in the dark, enlargement the small ones.
_PASSES = (
    _Pass(0.5, windows=(13, 13, 10)),
    _Pass(windows=(13, 13, 10)),
    _Pass(0.5, equalise=True, windows=(13, 13, 10)),
    _Pass(0.25),
    _Pass(),
    _Pass(equalise=True),
    _Pass(2.0, windows=(5, 45, 20)),
)
# Twofold enlargement is left out above this size: markers that are small there are none of a robot's. px
_ENLARGE_UP_TO = 6_000_000
# Contours shorter than four times this are noise. px
_SMALLEST_SIDE_PX = 6.0

# What a marker must reach. Chosen between 1 200 quadrilaterals around rendered markers (small, blurred, dark, moving,
# tilted) and those that 45 photographs yield, compared with 10 dictionaries: every rendered marker that OpenCV reads is
# read, and no marker that is not there.
# Shortest side over cells, px
_CELL_PX = 1.0
# Correlation of cell means with the best marker
_CELLS = 0.85
# What the best marker leaves unexplained, as a part of what the next best leaves
_AHEAD = 0.36
# The same two before the corners are measured
_FIRST_LOOK = 0.65, 0.9
# Correlation of the picture within the cells: thin strokes can have the right means, but not this. The second where
# the sides show no clear edge and OpenCV reads no marker.
_PICTURE, _PICTURE_UNCLEAR = 0.84, 0.87
# By how much it may fall when the corners are measured
_WORSE = 0.02
# Standard deviation of the grey values inside
_CONTRAST = 2.5

# In a stream, frames between two full searches while a marker is missing
_SEARCH_EVERY = 10


class MarkerDetector:
    """Finds the markers of one dictionary; of the `ids` given only, if any.

    OpenCV's detector writes into itself while it works: one MarkerDetector per thread.
    Raises DictionaryError for an unknown dictionary, ValueError for an id that it does not have.
    """

    def __init__(self, dictionary: str, ids: Collection[int] | None = None) -> None:
        cv2.setNumThreads(1)
        self._dictionary = dictionary_by_name(dictionary)
        size = len(self._dictionary.bytesList)
        if ids is not None and (unknown := sorted(id for id in ids if not 0 <= id < size)):
            raise ValueError(f"dictionary {dictionary} has the ids 0 to {size - 1}, not {unknown}")
        self.ids = None if ids is None else frozenset(ids)
        self._decoder = _Decoder(self._dictionary)
        self._detector = cv2.aruco.ArucoDetector(self._dictionary, cv2.aruco.DetectorParameters())
        self._equaliser = cv2.createCLAHE(4.0, (8, 8))
        self._ways: tuple[_Pass, ...] = ()
        self._frames = 0
        self._seen: frozenset[int] = frozenset()

    def search(self, image: Pixels, t: float = 0.0, camera: str = "") -> list[MarkerSighting]:
        """The markers of a single image, by id, with everything that can find one; `image` as in `grey`.

        With `ids` it stops as soon as each is found. A marker that is printed twice is returned twice.
        """
        return self._sightings(self._search(grey(image), []), t, camera)

    def detect(self, image: Pixels, t: float = 0.0, camera: str = "") -> list[MarkerSighting]:
        """The markers of the next frame of a stream, by id; `image` as in `grey`.

        Looks in the ways that were enough at the last search. Searches again when a marker has just been lost, and now
        and then while one of `ids` is missing (without `ids`: always, something new may have appeared).
        """
        picture = grey(image)
        due = self._frames % _SEARCH_EVERY == 0
        self._frames += 1
        found: list[_Found] = []
        for way in self._ways:
            found = _distinct(found + self._look(picture, way))
            if self._complete(found):
                break
        if not self._complete(found) and (due or not self._seen <= {marker.id for marker in found}):
            found = self._search(picture, found)
        self._seen = frozenset(marker.id for marker in found)
        return self._sightings(found, t, camera)

    def _search(self, picture: Image, found: list[_Found]) -> list[_Found]:
        by_way: dict[_Pass, set[int]] = {}
        for way in _PASSES:
            if way.scale > 1.0 and picture.size > _ENLARGE_UP_TO:
                continue
            if min(picture.shape) * way.scale < 1.0:
                continue
            new = self._look(picture, way)
            by_way[way] = {marker.id for marker in new}
            found = _distinct(found + new)
            if self._complete(found):
                break
        # The way that found most, and those that found what it did not.
        best = max(by_way, key=lambda way: len(by_way[way]))
        covered = set(by_way[best])
        ways = [best]
        for way, ids in by_way.items():
            if not ids <= covered:
                ways.append(way)
                covered |= ids
        self._ways = tuple(ways)
        return found

    def _complete(self, found: list[_Found]) -> bool:
        return self.ids is not None and self.ids <= {marker.id for marker in found}

    def _look(self, picture: Image, way: _Pass) -> list[_Found]:
        """What one pass finds."""
        image = np.asarray(self._equaliser.apply(picture), np.uint8) if way.equalise else picture
        if way.scale != 1.0:
            kind = cv2.INTER_CUBIC if way.scale > 1.0 else cv2.INTER_AREA
            image = np.asarray(cv2.resize(image, None, fx=way.scale, fy=way.scale, interpolation=kind), np.uint8)
        parameters = self._detector.getDetectorParameters()
        smallest = _SMALLEST_SIDE_PX * max(1.0, way.scale)
        parameters.minMarkerPerimeterRate = 4.0 * smallest / max(image.shape)
        parameters.adaptiveThreshWinSizeMin, parameters.adaptiveThreshWinSizeMax, _ = way.windows
        parameters.adaptiveThreshWinSizeStep = way.windows[2]
        self._detector.setDetectorParameters(parameters)
        decoded, _, others = self._detector.detectMarkers(image)
        if not decoded and not others:
            return []
        quads = np.array([*decoded, *others], np.float64).reshape(-1, 4, 2)
        by_opencv = np.arange(len(quads)) < len(decoded)
        # Middles of pixels are at whole numbers, and a scaled image's edges, not its middles, coincide.
        found = self._decoder.read(picture, (quads + 0.5) / way.scale - 0.5, by_opencv)
        return [marker for marker in found if self.ids is None or marker.id in self.ids]

    def _sightings(self, found: list[_Found], t: float, camera: str) -> list[MarkerSighting]:
        return [
            MarkerSighting(t, camera, marker.id, marker.corners_px, marker.sigma_px)
            for marker in sorted(found, key=lambda marker: marker.id)
        ]


@dataclass(frozen=True, slots=True)
class _Found:
    id: int
    corners_px: Array
    sigma_px: float
    score: float


def _distinct(found: list[_Found]) -> list[_Found]:
    """Of several that lie on each other the one with the sharper corners, then the better likeness."""
    kept: list[_Found] = []
    for marker in sorted(found, key=lambda marker: (marker.sigma_px, -marker.score)):
        middle = marker.corners_px.mean(axis=0)
        apart = 0.5 * float(_shortest_sides(marker.corners_px[None])[0])
        if all(np.hypot(*(middle - other.corners_px.mean(axis=0))) > apart for other in kept):
            kept.append(marker)
    return kept


def _shortest_sides(quads: Array) -> Array:
    """(n, 4, 2) -> (n,) px"""
    sides = quads[:, [1, 2, 3, 0]] - quads
    shortest: Array = np.sqrt(np.square(sides).sum(axis=-1)).min(axis=1)
    return shortest


# Samples per cell and axis
_PER_CELL = 3
# Blur that markers are compared under, sigma in cells
_BLURS = (0.1, 0.35, 0.6, 0.9)


class _Decoder:
    """Reads quadrilaterals by likeness: normalised correlation with all markers, in all turns, at several blurs."""

    def __init__(self, dictionary: cv2.aruco.Dictionary) -> None:
        bits = dictionary.markerSize
        self.cells = bits + 2
        # All of the dictionary, whatever ids are wanted: an unwanted marker must not be taken for the wanted one that
        # is most like it.
        rows = [dictionary.bytesList[id : id + 1] for id in range(len(dictionary.bytesList))]
        inner = np.array([cv2.aruco.Dictionary.getBitsFromByteList(row, bits) for row in rows], np.float64)
        # Black border, then two cells of white paper for the blur to reach into
        self._codes = np.pad(
            np.pad(inner.reshape(-1, bits, bits), ((0, 0), (1, 1), (1, 1))),
            ((0, 0), (2, 2), (2, 2)),
            constant_values=1.0,
        )
        self._blurs = [_blur(self.cells, sigma) for sigma in _BLURS]
        templates = []
        for blur in self._blurs:
            fine = blur @ self._codes @ blur.T
            shape = (-1, self.cells, _PER_CELL, self.cells, _PER_CELL)
            cells = fine.reshape(shape).mean(axis=(2, 4))
            turned = np.stack([np.rot90(cells, turn, axes=(1, 2)) for turn in range(4)], axis=1)
            templates.append(_normalised(turned.reshape(len(cells), 4, -1)))
        # By marker, made when it is first seen: (blur, sample)
        self._pictures: dict[int, NDArray[np.floating]] = {}
        # (blur, marker, turn, cell)
        self._templates = np.array(templates, np.float32)
        middles = (np.arange(self.cells * _PER_CELL) + 0.5) / (self.cells * _PER_CELL)
        x, y = np.meshgrid(middles, middles)
        self._places = np.stack([x, y], axis=-1).reshape(1, -1, 2)

    def read(self, image: Image, quads: Array, decoded: NDArray[np.bool_]) -> list[_Found]:
        """The markers among quadrilaterals (n, 4, 2) px, each place at most once. `decoded` (n,): those that OpenCV
        could read, of which less is demanded."""
        # A rough look first: measuring corners costs more, and most of what a textured floor yields is no marker.
        rough = self._samples(image, quads)
        _, _, ahead, likeness = self._best(rough)
        worth = (likeness >= _FIRST_LOOK[0]) & (ahead <= _FIRST_LOOK[1])
        worth &= decoded | (_shortest_sides(quads) >= _CELL_PX * self.cells)
        if not worth.any():
            return []
        quads, decoded, rough = quads[worth], decoded[worth], rough[worth]
        corners, sigma = refine_corners(image, quads, self.cells)
        samples = self._samples(image, corners)
        marker, turn, ahead, likeness = self._best(samples)
        found = []
        for k in np.flatnonzero((likeness >= _CELLS) & (ahead <= _AHEAD) & (samples.std(axis=(1, 2)) >= _CONTRAST)):
            at, sigma_px = corners[k], float(sigma[k])
            score, before = (self._likeness(picture[k], marker[k], turn[k]) for picture in (samples, rough))
            # Corners that fit the picture worse than those before were measured on something else than the edges.
            if before > score + _WORSE:
                at, sigma_px, score = quads[k], max(sigma_px, SIGMA_UNREFINED_PX), before
            if score >= (_PICTURE if decoded[k] or sigma_px < SIGMA_UNREFINED_PX else _PICTURE_UNCLEAR):
                found.append(_Found(int(marker[k]), np.roll(at, turn[k], axis=0), sigma_px, score))
        return _distinct(found)

    def _samples(self, image: Image, quads: Array) -> NDArray[np.float32]:
        """(n, rows, columns) grey values inside each quadrilateral, seen straight on."""
        side = self.cells * _PER_CELL
        if not len(quads):
            return np.zeros((0, side, side), np.float32)
        places = [
            cv2.perspectiveTransform(self._places, cv2.getPerspectiveTransform(_UNIT, quad.astype(np.float32)))
            for quad in quads
        ]
        where = np.array(places, np.float32).reshape(len(quads), side * side, 2)
        return sample_image(image, where, cv2.BORDER_REPLICATE).astype(np.float32).reshape(-1, side, side)

    def _best(self, samples: NDArray[np.float32]) -> tuple[NDArray[np.int_], NDArray[np.int_], Array, Array]:
        """Per quadrilateral: index of the likeliest marker, its turn, by what part its misfit is smaller than that of
        the next marker, and its correlation."""
        n = len(samples)
        cells = samples.reshape(n, self.cells, _PER_CELL, self.cells, _PER_CELL).mean(axis=(2, 4)).reshape(n, -1)
        blurs, markers, turns, size = self._templates.shape
        # Not numpy's product: its BLAS wakes threads, which on a busy machine cost more than they bring.
        templates = self._templates.reshape(-1, size)
        products = cv2.gemm(_normalised(cells), templates, 1.0, None, 0.0, flags=cv2.GEMM_2_T)  # type: ignore[call-overload]
        by_blur = np.asarray(products, np.float32).reshape(n, blurs, markers * turns)
        every = np.arange(n)
        blur = by_blur.max(axis=2).argmax(axis=1)
        likeness = by_blur[every, blur].reshape(n, markers, turns)
        by_marker = likeness.max(axis=2)
        marker = by_marker.argmax(axis=1)
        turn = likeness[every, marker].argmax(axis=1)
        best = by_marker[every, marker].astype(np.float64)
        by_marker[every, marker] = 0.0
        return marker, turn, (1.0 - best) / np.maximum(1.0 - by_marker.max(axis=1), 1e-9), best

    def _likeness(self, samples: NDArray[np.float32], marker: int, turn: int) -> float:
        """Correlation of all samples with one marker, at the blur that suits best."""
        if marker not in self._pictures:
            code = self._codes[marker]
            pictures = np.array([(blur @ code @ blur.T).ravel() for blur in self._blurs])
            self._pictures[marker] = _normalised(pictures.astype(np.float32))
        upright = np.rot90(samples, -turn).reshape(1, -1)
        return float((self._pictures[marker] * _normalised(upright)).sum(axis=1).max())


def _normalised(values: NDArray[np.floating]) -> NDArray[np.floating]:
    """Without mean and with length 1 along the last axis, so that a scalar product is a correlation."""
    centred = values - values.mean(axis=-1, keepdims=True)
    return np.asarray(centred / np.maximum(np.linalg.norm(centred, axis=-1, keepdims=True), 1e-6))


def _blur(cells: int, sigma: float) -> Array:
    """(cells * _PER_CELL, cells + 4): how sample points answer to cells, two more on each side, under Gaussian blur."""
    x = (np.arange(cells * _PER_CELL) + 0.5) / _PER_CELL + 2.0
    edges = np.arange(cells + 5)
    # The part of a Gaussian around x that lies left of each edge
    left = np.array([[0.5 * (1.0 + math.erf((edge - at) / (sigma * math.sqrt(2.0)))) for edge in edges] for at in x])
    response: Array = np.diff(left, axis=1)
    return response


# Edge refinement: profiles per leg, samples per profile. A leg is the part of a side next to a corner.
_PROFILES, _SAMPLES = 18, 21
# A leg begins this part of the side away from the corner, where the other leg's edge is out of the blur, ...
_GAP, _GAP_PX = 0.08, 4.0
# ... and is no longer than this, so that neither a lens nor wavy paper bends it: the rest of a long side says nothing
# about its corner. px
_LEG_PX = 36.0


def refine_corners(image: Image, corners_px: Array, cells: int) -> tuple[Array, Array]:
    """Measures corners on the edges of the black square. (n, 4, 2) px, clockwise -> (n, 4, 2) px and (n,) sigma, px.

    `cells`: of a marker's side, its black border included. A marker whose sides do not show a clear edge from black to
    white, or whose corners would move further than the profiles reach, keeps the corners it came with and
    SIGMA_UNREFINED_PX.
    """
    start = np.asarray(corners_px, dtype=np.float64)
    cell = np.maximum(_shortest_sides(start) / cells, 1e-9)
    # Half a profile stays within the black border inside and the white margin outside, each a cell wide.
    reach = np.maximum(0.8 * cell, 1.5)
    corners, _, blur, clear = _refine_once(image, start, reach)
    # Again: the detector's corners may be off by pixels, and a profile that is not centred pulls its edge to its own
    # middle. Three sigma of the edge's own blur hold all of it, and a shorter profile is sampled more finely.
    shorter = np.clip(3.0 * blur.max(axis=1), 1.5, 0.75 * reach + 0.4)
    corners, noise, blur, still_clear = _refine_once(image, corners, shorter)
    clear &= still_clear & (np.linalg.norm(corners - start, axis=2).max(axis=1) <= np.maximum(reach, 2.0))
    # Blur brings the next cells' edges into the profile: on rendered markers of 13 to 70 px under blur of 0.5 to 5 px
    # the corners' error is what the edges' width exceeds this part of a cell by.
    crowding = np.maximum(blur - 0.185 * cell[:, None], 0.0)
    sigma = np.sqrt(SIGMA_FLOOR_PX**2 + noise**2 + np.square(crowding).mean(axis=1))
    sigma = np.where(clear, sigma, np.maximum(sigma, SIGMA_UNREFINED_PX))
    return np.where(clear[:, None, None], corners, start), sigma


def _refine_once(image: Image, corners: Array, reach: Array) -> tuple[Array, Array, Array, NDArray[np.bool_]]:
    """(n, 4, 2) corners, (n,) their sigma by the edges' scatter, (n, 8) sigma of the blur of each leg's edge, and
    whether every leg had enough clear edges. `reach` (n,): half of a profile's length, px."""
    n = len(corners)
    # Two legs from each corner: to the next corner and to the one before. (n, 4, 2 legs, xy)
    leg = np.stack([corners[:, [1, 2, 3, 0]], corners[:, [3, 0, 1, 2]]], axis=2) - corners[:, :, None]
    length = np.maximum(np.linalg.norm(leg, axis=-1), 1e-9)
    along = leg / length[..., None]
    # Out of the square, whose corners run clockwise in an image with y down: left of the one leg, right of the other.
    outward = np.stack([along[..., 1], -along[..., 0]], axis=-1) * np.array([1.0, -1.0])[:, None]

    gap = np.minimum(_GAP * length, np.maximum(_GAP_PX, 0.7 * reach)[:, None, None])
    u = gap[..., None] + np.minimum(length - 2.0 * gap, _LEG_PX)[..., None] * np.linspace(0.0, 1.0, _PROFILES)
    across = np.linspace(-1.0, 1.0, _SAMPLES)
    on_leg = corners[:, :, None, None] + u[..., None] * along[..., None, :]
    off_leg = (reach[:, None] * across)[:, None, None, None, :, None] * outward[..., None, None, :]
    where = (on_leg[..., None, :] + off_leg).astype(np.float32)
    profile = sample_image(image, where.reshape(n * 8, _PROFILES * _SAMPLES, 2), cv2.BORDER_REPLICATE)
    profile = profile.reshape(n, 4, 2, _PROFILES, _SAMPLES).astype(np.float32)

    # The edge is the middle of the gradient. Only what grows brighter outwards and stands out counts: the rest is
    # noise, and would pull the edge to the middle of the profile.
    rise = np.maximum(np.diff(profile, axis=-1), 0.0)
    rise = np.maximum(rise - 0.15 * rise.max(axis=-1, keepdims=True), 0.0)
    between = 0.5 * (across[1:] + across[:-1])
    total = np.maximum(rise.sum(axis=-1), 1e-9)
    edge = np.einsum("nijks,s->nijk", rise, between) / total
    spread = np.sqrt(np.maximum(np.einsum("nijks,s->nijk", rise, between**2) / total - edge**2, 0.0))
    edge *= reach[:, None, None, None]
    blur = np.median(spread, axis=-1).reshape(n, 8) * reach[:, None]
    fifth = _SAMPLES // 5
    contrast = profile[..., -fifth:].mean(axis=-1) - profile[..., :fifth].mean(axis=-1)
    valid = (contrast > 0.4 * np.median(contrast, axis=(1, 2, 3), keepdims=True)) & (contrast > 2.0)

    # edge = offset + slope u along each leg, by least squares reweighted with Tukey's biweight
    weight = valid.astype(np.float64)
    for _ in range(4):
        wu = weight * u
        s0, s1, s2 = weight.sum(axis=-1), wu.sum(axis=-1), (wu * u).sum(axis=-1)
        t0, t1 = (weight * edge).sum(axis=-1), (wu * edge).sum(axis=-1)
        determinant = s0 * s2 - s1 * s1 + 1e-9
        offset, slope = (s2 * t0 - s1 * t1) / determinant, (s0 * t1 - s1 * t0) / determinant
        residual = edge - offset[..., None] - slope[..., None] * u
        scale = 4.685 * np.maximum(1.4826 * _median_where(np.abs(residual), valid), 0.03)
        weight = valid * np.square(np.maximum(1.0 - np.square(residual / scale[:, None, None, None]), 0.0))
    support = weight.sum(axis=-1)
    variance = (weight * residual**2).sum(axis=(1, 2, 3)) / np.maximum(support.sum(axis=(1, 2)), 1e-9)
    # Variance of a leg's offset at the corner over that of a profile; profiles within a pixel see the same noise.
    at_corner = s2 / determinant * np.maximum(1.0, _PROFILES / np.minimum(length, _LEG_PX))
    sigma = np.sqrt(variance * at_corner.mean(axis=(1, 2)))

    # Where the lines of the two legs meet
    on_line = corners[:, :, None] + offset[..., None] * outward
    direction = along + slope[..., None] * outward
    (p, q), (v, w) = np.moveaxis(on_line, 2, 0), np.moveaxis(direction, 2, 0)
    cross = v[..., 0] * w[..., 1] - v[..., 1] * w[..., 0]
    between_lines = (q - p)[..., 0] * w[..., 1] - (q - p)[..., 1] * w[..., 0]
    met = p + (between_lines / np.where(np.abs(cross) < 1e-9, 1e-9, cross))[..., None] * v
    return met, sigma, blur, (support > 0.4 * _PROFILES).all(axis=(1, 2))


def _median_where(values: Array, valid: NDArray[np.bool_]) -> Array:
    """(n,) median over all but the first axis of the valid values; 0 where there is none."""
    ordered = np.sort(np.where(valid, values, np.inf).reshape(len(values), -1), axis=1)
    count = valid.reshape(len(values), -1).sum(axis=1)
    return np.where(count > 0, ordered[np.arange(len(values)), count // 2], 0.0)
