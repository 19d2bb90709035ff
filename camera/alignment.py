"""Markers whose edges are lost in blur: what is printed is blurred likewise and moved until it fits the picture.

By the inverse compositional algorithm (S. Baker, I. Matthews, "Lucas-Kanade 20 years on", IJCV 56(3), 2004): the
derivatives are those of the printed picture, so that they are the same in each round. How bright and how strong in
contrast the picture is does not matter.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from fusion.measurements import Array

# What is compared reaches this far beyond the marker, into its white margin, and is sampled so often per cell. Cells
_MARGIN, _PER_CELL = 2.0 / 3.0, 3
# Pixels per cell of the picture that is blurred.
_FINE = 6
# Blur that markers are compared under: sigma of defocus, and length of motion in each of four directions. Cells
_DEFOCUS, _MOTION, _DIRECTIONS = (0.35, 0.9), (1.2, 2.2), 4
# Sigma of what the lens always blurs. Cells
_LENS = 0.15
_ROUNDS, _SMALL_STEP = 10, 0.003
# How much more the corners are off than if what does not fit were white noise: as much as on rendered markers of 30 px
# that moved by 12 px, where it is most.
_COLOURED = 4.0

_UNIT = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])


class Alignment:
    """One marker. `code`: (cells + 4, cells + 4), 0 for black and 1 for white, with two cells of white paper around."""

    def __init__(self, code: Array) -> None:
        self._cells = len(code) - 4
        fine = np.kron(code, np.ones((_FINE, _FINE))).astype(np.float32)
        # From the marker's top left corner, cells
        at = np.arange(-_MARGIN, self._cells + _MARGIN - 1e-6, 1.0 / _PER_CELL) + 0.5 / _PER_CELL
        places = np.stack(np.meshgrid(at, at), axis=-1)
        self._places = (places / self._cells).reshape(1, -1, 2)
        where = ((places + 2.0) * _FINE - 0.5).astype(np.float32)
        x, y = (places - 0.5 * self._cells).reshape(-1, 2).T
        pictures, steps, covariances = [], [], []
        for blurred in _blurred(fine):
            down, right = np.gradient(blurred)
            values, by_x, by_y = (
                cv2.remap(layer, where, None, cv2.INTER_LINEAR).ravel().astype(np.float64)  # type: ignore[call-overload]
                for layer in (blurred, _FINE * right, _FINE * down)
            )
            picture, length = _normalised(values)
            # Of a shift along x and y and a turn about the middle, and not of an enlargement, which cannot be told from
            # another blur; what is only more light or contrast is left out.
            J = np.column_stack([by_x, by_y, x * by_y - y * by_x]) / length
            J -= J.mean(axis=0)
            J -= np.outer(picture, picture @ J)
            covariance = np.linalg.inv(J.T @ J)
            pictures.append(picture)
            steps.append(covariance @ J.T)
            covariances.append(covariance)
        self._pictures, self._steps, self._covariances = np.array(pictures), np.array(steps), np.array(covariances)

    def fit(self, image: NDArray[np.uint8], corners_px: Array) -> tuple[Array, float, float]:
        """Corners (4, 2) px that are right to a cell -> corners, their sigma, px, and the correlation with the picture.

        Only moved and turned: size and perspective are taken as they come.
        """
        corners = np.asarray(corners_px, np.float64)
        for _ in range(_ROUNDS):
            seen, plane = self._sample(image, corners)
            likeness = self._pictures @ seen
            best = int(likeness.argmax())
            if likeness[best] < 0.1:
                break
            step = self._steps[best] @ (seen / likeness[best])
            c, s = math.cos(step[2]), math.sin(step[2])
            # What is seen is the picture moved by -step: the corners follow by its inverse.
            moved = (_UNIT - 0.5) @ np.array([[c, -s], [s, c]]) - step[:2] / self._cells + 0.5
            corners = np.asarray(cv2.perspectiveTransform(moved[None], plane)[0], np.float64)
            if np.abs(step).max() < _SMALL_STEP:
                break
        seen, _ = self._sample(image, corners)
        likeness = self._pictures @ seen
        best = int(likeness.argmax())
        score = float(likeness[best])
        covariance = self._covariances[best]
        # Of a corner's coordinate, half a side away from the middle along each axis
        variance = 0.5 * (covariance[0, 0] + covariance[1, 1])
        variance += 0.25 * self._cells**2 * covariance[2, 2]
        noise = (1.0 / max(score, 1e-3) ** 2 - 1.0) / len(seen)
        side = float(np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).mean())
        return corners, _COLOURED * math.sqrt(max(noise, 0.0) * variance) * side / self._cells, score

    def _sample(self, image: NDArray[np.uint8], corners: Array) -> tuple[Array, Array]:
        """What is seen at the places of the picture, normalised, and the transform from the unit square to it."""
        plane = np.asarray(
            cv2.getPerspectiveTransform(_UNIT.astype(np.float32), corners.astype(np.float32)), np.float64
        )
        where = cv2.perspectiveTransform(self._places, plane).astype(np.float32)
        values = cv2.remap(image, where, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)  # type: ignore[call-overload]
        return _normalised(values.ravel().astype(np.float64))[0], plane


def _normalised(values: Array) -> tuple[Array, float]:
    """Without mean and of length 1, so that a scalar product is a correlation; and the length."""
    centred = values - values.mean()
    length = max(float(np.linalg.norm(centred)), 1e-6)
    return centred / length, length


def _blurred(fine: NDArray[np.float32]) -> list[NDArray[np.float32]]:
    pictures = [cv2.GaussianBlur(fine, (0, 0), sigma * _FINE, borderType=cv2.BORDER_REPLICATE) for sigma in _DEFOCUS]
    for length in _MOTION:
        for direction in range(_DIRECTIONS):
            angle, half = math.pi * direction / _DIRECTIONS, int(0.5 * length * _FINE)
            kernel = np.zeros((2 * half + 1, 2 * half + 1), np.float32)
            along = np.linspace(-half, half, 8 * half + 1)
            rows, columns = (np.rint(half + along * f(angle)).astype(int) for f in (math.sin, math.cos))
            np.add.at(kernel, (rows, columns), 1.0 / len(along))
            moved = cv2.filter2D(fine, -1, kernel, borderType=cv2.BORDER_REPLICATE)
            pictures.append(cv2.GaussianBlur(moved, (0, 0), _LENS * _FINE, borderType=cv2.BORDER_REPLICATE))
    return [np.asarray(picture, np.float32) for picture in pictures]
