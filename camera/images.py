"""Images as arrays: of what kind, made grey, sampled."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
Pixels = NDArray[np.uint8 | np.uint16]


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
