"""The intrinsics of a camera: what they are, and their file.

The file is TOML:

    width_px = 1280                 # the image size that the calibration was made at; leave both out if unknown
    height_px = 960
    camera_matrix = [[1006.1, 0.0, 655.9], [0.0, 1004.0, 490.6], [0.0, 0.0, 1.0]]
    distortion = [0.135, -0.234, 0.0007, 0.0049, 0.0]      # OpenCV's order: k1 k2 p1 p2 k3 ...; [] for none
    rms_px = 0.21                   # reprojection error of the calibration, optional
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np

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
    """

    camera_matrix: Array
    distortion: Array
    width_px: int = 0
    height_px: int = 0
    rms_px: float | None = None

    def check_size(self, width_px: int, height_px: int) -> None:
        """Raises CalibrationError if an image of this size is not what was calibrated."""
        if self.width_px and (width_px, height_px) != (self.width_px, self.height_px):
            raise CalibrationError(
                f"the image is {width_px} x {height_px} px, "
                f"the calibration is for {self.width_px} x {self.height_px} px"
            )


class _File(msgspec.Struct, forbid_unknown_fields=True, omit_defaults=True):
    camera_matrix: list[list[float]]
    distortion: list[float]
    width_px: int = 0
    height_px: int = 0
    rms_px: float | None = None


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
    return Intrinsics(matrix, distortion, content.width_px, content.height_px, content.rms_px)


def save_intrinsics(path: str | os.PathLike[str], intrinsics: Intrinsics) -> None:
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
    Path(path).write_text("\n".join(lines) + "\n", encoding="utf-8")
