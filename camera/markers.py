"""Markers in an image: found, their corners measured, decoded.

1. OpenCV's ArucoDetector finds quadrilaterals; those that it cannot decode are kept as well.
2. Corners are measured on the edges in the image, see `camera.edges`. The error is about a tenth of the detector's.
3. What is inside is compared with every marker of the dictionary, blurred as the image may be. This reads markers that
   are too small or too blurred for hard bits, and rejects what only happens to have the right ones.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from camera.alignment import Alignment
from camera.dictionaries import dictionary_by_name
from camera.edges import SIGMA_FLOOR_PX, SIGMA_UNREFINED_PX, refine_corners
from camera.images import Image, Pixels, grey, sample_image
from fusion.measurements import Array

# Corners of the unit square in the order of a marker's
_UNIT = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]], np.float32)


@dataclass(frozen=True, slots=True)
class MarkerSighting:
    """One marker in one frame of one camera.

    `t`: s, mid-exposure. `corners_px`: (4, 2), clockwise from the marker's top left; pixel (0, 0) is the middle of the
    first pixel. `sigma_px`: standard deviation of each coordinate. `blur_px`: sigma of the edges' blur, nan where it is
    not known.
    """

    t: float
    camera: str
    id: int
    corners_px: Array
    sigma_px: float
    blur_px: float = math.nan


@dataclass(frozen=True, slots=True)
class Pass:
    """One way to look for quadrilaterals: image scale, whether contrast is equalised first, threshold windows in px
    (first, last, step), and by how much a pixel must be darker than its window to be black."""

    scale: float = 1.0
    equalise: bool = False
    windows: tuple[int, int, int] = (3, 23, 10)
    darker: float = 7.0


# The cheap ones first. One window is enough for a sharp, well-lit marker, half the resolution for one of 40 px or more.
# A quarter finds large markers under strong blur, equalised contrast those in the dark, enlargement the small ones.
_PASSES = (
    Pass(0.5, windows=(13, 13, 10)),
    Pass(windows=(13, 13, 10)),
    Pass(0.5, equalise=True, windows=(13, 13, 10)),
    Pass(0.25),
    Pass(),
    Pass(equalise=True),
    Pass(2.0, windows=(5, 45, 20)),
)
# Twofold enlargement is left out above this size: markers that are small there are none of a robot's. px
ENLARGE_UP_TO = 6_000_000
# Contours shorter than four times this are noise. px
SMALLEST_SIDE_PX = 6.0

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
# Correlation of the picture and its margin where a marker is followed into blur: between what markers that are there
# reach and others at their place, see tests/camera/test_alignment.py.
_ALIGNED = 0.87
# Sigma of edges from which on the whole picture may know more, px.
_BLURRED_PX = 0.25
# By how much it may fall when the corners are measured
_WORSE = 0.02
# Standard deviation of the grey values inside
_CONTRAST = 2.5


@dataclass(frozen=True, slots=True)
class Found:
    """A marker in a picture. `blur_px`: sigma of its edges' blur; `score`: correlation with what is printed;
    `decoded`: whether it was told from all other markers of the dictionary."""

    id: int
    corners_px: Array
    sigma_px: float
    blur_px: float
    score: float
    decoded: bool = True


# left, top, right, bottom, px; right and bottom are outside.
Box = tuple[int, int, int, int]


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

    def search(self, image: Pixels, t: float = 0.0, camera: str = "") -> list[MarkerSighting]:
        """The markers of a single image, by id, with everything that can find one; `image` as in `grey`.

        With `ids` it stops as soon as each is found. A marker that is printed twice is returned twice.
        """
        picture = grey(image)
        found: list[Found] = []
        for way in _PASSES:
            if way.scale > 1.0 and picture.size > ENLARGE_UP_TO:
                continue
            found = distinct(found + self.look(picture, way))
            if self.ids is not None and self.ids <= {marker.id for marker in found}:
                break
        return [
            MarkerSighting(t, camera, marker.id, marker.corners_px, marker.sigma_px, marker.blur_px)
            for marker in sorted(found, key=lambda marker: marker.id)
        ]

    def look(
        self,
        picture: Image,
        way: Pass,
        sides_px: tuple[float, float] = (SMALLEST_SIDE_PX, math.inf),
        boxes: Sequence[Box] | None = None,
    ) -> list[Found]:
        """What one pass finds, in the whole picture or in some boxes of it, of markers whose sides are about so long.

        The narrower the bounds, the fewer contours there are to follow: half of the time goes there.
        """
        height, width = picture.shape
        quads: list[Array] = []
        by_opencv: list[bool] = []
        parameters = self._detector.getDetectorParameters()
        parameters.adaptiveThreshWinSizeMin, parameters.adaptiveThreshWinSizeMax, _ = way.windows
        parameters.adaptiveThreshWinSizeStep = way.windows[2]
        parameters.adaptiveThreshConstant = way.darker
        for left, top, right, bottom in ((0, 0, width, height),) if boxes is None else boxes:
            image: Image = picture[top:bottom, left:right]
            if min(image.shape) * way.scale < 1.0:
                continue
            if way.equalise:
                image = np.asarray(self._equaliser.apply(image), np.uint8)
            if way.scale != 1.0:
                kind = cv2.INTER_CUBIC if way.scale > 1.0 else cv2.INTER_AREA
                image = np.asarray(cv2.resize(image, None, fx=way.scale, fy=way.scale, interpolation=kind), np.uint8)
            shortest = max(sides_px[0] * way.scale, SMALLEST_SIDE_PX)
            # OpenCV counts a contour's pixels, of which a slanted side has fewer than its length.
            parameters.minMarkerPerimeterRate = _SLANTED * 4.0 * shortest / max(image.shape)
            parameters.maxMarkerPerimeterRate = min(4.0 * sides_px[1] * way.scale / max(image.shape), 4.0)
            self._detector.setDetectorParameters(parameters)
            decoded, _, others = self._detector.detectMarkers(image)
            if decoded or others:
                # Middles of pixels are at whole numbers, and a scaled image's edges, not its middles, coincide.
                here = (np.array([*decoded, *others], np.float64).reshape(-1, 4, 2) + 0.5) / way.scale - 0.5
                quads.append(here + np.array([left, top]))
                by_opencv += [True] * len(decoded) + [False] * len(others)
        if not quads:
            return []
        found = self._decoder.read(picture, np.vstack(quads), np.array(by_opencv))
        return [marker for marker in found if self.ids is None or marker.id in self.ids]

    def follow(
        self,
        picture: Image,
        ids: Sequence[int],
        corners_px: Array,
        shape_px: Array,
        reach_px: Array,
        decode: NDArray[np.bool_],
    ) -> list[Found | None]:
        """The markers `ids` (n) at places that are already nearly known, corners (n, 4, 2), None for one not there.

        `shape_px` (n,): sigma of the corners about where the middles put them; `reach_px` (n,) as in `refine_corners`.
        No quadrilateral is looked for; what is there must look like that very
        marker. `decode` (n,): which are also compared with all others, so that none goes by another's name for long.
        """
        return self._decoder.follow(picture, ids, corners_px, shape_px, reach_px, decode)


# A contour at 45 degrees has one pixel for each step of the square root of two.
_SLANTED = 0.7


def distinct(found: Collection[Found]) -> list[Found]:
    """Of several that lie on each other the one with the sharper corners, then the better likeness."""
    if len(found) < 2:
        return list(found)
    ordered = sorted(found, key=lambda marker: (marker.sigma_px, -marker.score))
    corners = np.array([marker.corners_px for marker in ordered])
    middles = corners.mean(axis=1)
    apart = np.hypot(*np.moveaxis(middles[:, None] - middles, -1, 0)) > 0.5 * _shortest_sides(corners)[:, None]
    kept: list[int] = []
    for k in range(len(ordered)):
        if apart[k, kept].all():
            kept.append(k)
    return [ordered[k] for k in kept]


def _shortest_sides(quads: NDArray[np.floating]) -> NDArray[np.floating]:
    """(n, 4, 2) -> (n,) px"""
    squares = np.square(quads[:, [1, 2, 3, 0]] - quads)
    return np.asarray(np.sqrt((squares[..., 0] + squares[..., 1]).min(axis=1)))


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
            templates.append(_normalised(turned.reshape(len(cells), 4, -1).astype(np.float32)))
        # By marker, made when they are first needed; a picture is (blur, sample)
        self._pictures: dict[int, NDArray[np.float32]] = {}
        self._alignments: dict[int, Alignment] = {}
        # (blur, marker, turn, cell)
        self._templates = np.array(templates, np.float32)
        middles = (np.arange(self.cells * _PER_CELL) + 0.5) / (self.cells * _PER_CELL)
        x, y = np.meshgrid(middles, middles)
        self._places = np.stack([x, y], axis=-1).reshape(1, -1, 2)

    def read(self, image: Image, quads: Array, decoded: NDArray[np.bool_]) -> list[Found]:
        """The markers among quadrilaterals (n, 4, 2) px, each place at most once. `decoded` (n,): those that OpenCV
        could read, of which less is demanded."""
        # A rough look first: measuring corners costs more, and most of what a textured floor yields is no marker.
        unread = np.flatnonzero(~decoded & (_shortest_sides(quads) >= _CELL_PX * self.cells))
        worth = decoded.copy()
        if unread.size:
            _, _, ahead, likeness = self._best(self._samples(image, quads[unread]))
            worth[unread] = (likeness >= _FIRST_LOOK[0]) & (ahead <= _FIRST_LOOK[1])
        if not worth.any():
            return []
        quads, decoded = quads[worth], decoded[worth]
        corners, sigma, blur = refine_corners(image, quads, self.cells)
        samples = self._samples(image, corners)
        marker, turn, ahead, likeness = self._best(samples)
        like = np.flatnonzero((likeness >= _CELLS) & (ahead <= _AHEAD) & (samples.std(axis=(1, 2)) >= _CONTRAST))
        if not like.size:
            return []
        rough = self._samples(image, quads[like])
        upright = [
            np.rot90(picture, -turn[k])
            for pictures in (samples[like], rough)
            for picture, k in zip(pictures, like, strict=True)
        ]
        scores = self._likeness(np.array(upright), marker[like].tolist() * 2).reshape(2, -1)
        found = []
        for k, score, before in zip(like.tolist(), *scores.tolist(), strict=True):
            at, sigma_px = corners[k], float(sigma[k])
            # Corners that fit the picture worse than those before were measured on something else than the edges.
            if before > score + _WORSE:
                at, sigma_px, score = quads[k], max(sigma_px, SIGMA_UNREFINED_PX), before
            if score >= (_PICTURE if decoded[k] or sigma_px < SIGMA_UNREFINED_PX else _PICTURE_UNCLEAR):
                at = at[[(i - turn[k]) % 4 for i in range(4)]]
                found.append(Found(int(marker[k]), at, sigma_px, float(blur[k]), score))
        return distinct(found)

    def follow(
        self,
        image: Image,
        ids: Sequence[int],
        quads: Array,
        shape_px: Array,
        reach_px: Array,
        decode: NDArray[np.bool_],
    ) -> list[Found | None]:
        """See MarkerDetector."""
        quads = np.asarray(quads, np.float64)
        corners, sigma, blur = refine_corners(image, quads, self.cells, reach_px)
        samples = self._samples(image, corners)
        score = self._likeness(samples, ids)
        # Without clear edges there is nothing new: the corners would be those that were predicted.
        there = (score >= _PICTURE) & (sigma < SIGMA_UNREFINED_PX)
        decoded = np.zeros(len(ids), np.bool_)
        if (compare := np.flatnonzero(decode & there)).size:
            marker, turn, ahead, likeness = self._best(samples[compare])
            itself = (marker == np.array(ids)[compare]) & (turn == 0)
            sure = (likeness >= _CELLS) & (ahead <= _AHEAD)
            decoded[compare] = itself & sure
            there[compare] &= itself | ~sure
        for k in np.flatnonzero(~there | (sigma > _BLURRED_PX)).tolist():
            aligned, sigma_px, correlation = self._align(image, ids[k], quads[k])
            sigma_px = math.hypot(sigma_px, max(float(shape_px[k]), SIGMA_FLOOR_PX))
            if correlation >= _ALIGNED and not (there[k] and sigma[k] <= sigma_px):
                there[k], corners[k], sigma[k], score[k] = True, aligned, sigma_px, correlation
        return [
            Found(ids[k], corners[k], float(sigma[k]), float(blur[k]), float(score[k]), bool(decoded[k]))
            if there[k]
            else None
            for k in range(len(ids))
        ]

    def _align(self, image: Image, id: int, quad: Array) -> tuple[Array, float, float]:
        """One marker's corners by its whole picture: what they are, their sigma, px, and the correlation; that is 0
        where they would be further away than the cell within which alignment is reliable."""
        if id not in self._alignments:
            self._alignments[id] = Alignment(self._codes[id])
        corners, sigma_px, score = self._alignments[id].fit(image, quad)
        cell = float(_shortest_sides(quad[None])[0]) / self.cells
        near = float(np.linalg.norm(corners - quad, axis=1).max()) <= max(cell, 3.0)
        return corners, sigma_px, score if near else 0.0

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

    def _likeness(self, samples: NDArray[np.float32], ids: Sequence[int]) -> NDArray[np.float32]:
        """(n,) correlation of all samples of each with its marker, upright, at the blur that suits best."""
        for id in set(ids) - self._pictures.keys():
            code = self._codes[id]
            pictures = np.array([(blur @ code @ blur.T).ravel() for blur in self._blurs])
            self._pictures[id] = _normalised(pictures.astype(np.float32))
        pictures = np.array([self._pictures[id] for id in ids])
        seen = _normalised(samples.reshape(len(ids), 1, -1))
        return np.asarray((pictures * seen).sum(axis=2).max(axis=1), np.float32)


def _normalised(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Without mean and with length 1 along the last axis, so that a scalar product is a correlation."""
    centred = values - values.mean(axis=-1, keepdims=True)
    length = np.sqrt(np.square(centred).sum(axis=-1, keepdims=True))
    return np.asarray(centred / np.maximum(length, 1e-6), np.float32)


def _blur(cells: int, sigma: float) -> Array:
    """(cells * _PER_CELL, cells + 4): how sample points answer to cells, two more on each side, under Gaussian blur."""
    x = (np.arange(cells * _PER_CELL) + 0.5) / _PER_CELL + 2.0
    edges = np.arange(cells + 5)
    # The part of a Gaussian around x that lies left of each edge
    left = np.array([[0.5 * (1.0 + math.erf((edge - at) / (sigma * math.sqrt(2.0)))) for edge in edges] for at in x])
    response: Array = np.diff(left, axis=1)
    return response
