"""By how much a camera has turned from where it hangs, from the anchors that it sees in this very frame.

A tenth of a degree moves what a camera 3 m up sees by 5 mm: a door, a fan or a passing lorry is enough.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from camera.calibration import Intrinsics
from camera.fix import rays
from camera.markers import MarkerSighting
from fusion.geometry import exp_so3
from fusion.measurements import Array

# How far a camera that is fixed to a ceiling turns, rad: what one anchor says of the rotation about itself, which is
# next to nothing, is weighed against it.
SIGMA_PRIOR = 2e-3
# Root mean square of what is left, in sigma of the corners, above which anchors contradict each other.
CONTRADICTION = 4.0


@dataclass(frozen=True, slots=True)
class Shake:
    """`rotation`: (3, 3), camera_at_rest_from_camera. `covariance`: (3, 3), rad², axes of the camera."""

    rotation: Array
    covariance: Array


def measure_shake(
    at_rest: Mapping[int, Array], sightings: Sequence[MarkerSighting], intrinsics: Intrinsics
) -> Shake | None:
    """The rotation that brings the anchors of a frame to the corners (4, 2) px where they are `at_rest`, by id.

    Corners are compared with corners, not with a survey, whose errors stay the same. An anchor that does not fit is
    left out if the others agree; None where no anchor is in view or they do not.
    """
    seen = [sighting for sighting in sightings if sighting.id in at_rest]
    while seen:
        rotation, covariance, misfit = _fit(at_rest, seen, intrinsics)
        if misfit.max() <= CONTRADICTION**2:
            return Shake(rotation, covariance)
        if len(seen) < 3:
            break
        del seen[int(misfit.argmax())]
    return None


def _fit(
    at_rest: Mapping[int, Array], seen: Sequence[MarkerSighting], intrinsics: Intrinsics
) -> tuple[Array, Array, Array]:
    """Rotation, covariance and (n,) mean squared residual of each anchor over its variance."""
    directions = rays(np.vstack([at_rest[s.id] for s in seen] + [s.corners_px for s in seen]), intrinsics)
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    rest, now = directions[: 4 * len(seen)], directions[4 * len(seen) :]
    # One pixel's angle, as it is on the camera's axis.
    sigma = np.repeat([sighting.sigma_px for sighting in seen], 4) / float(intrinsics.camera_matrix[0, 0])
    weight = 1.0 / np.square(sigma)
    # Turning the camera by R brings what was seen along r at rest to R^T r: to first order r + [r]x dtheta.
    # The normal matrix, the sum of [r]x^T [r]x = I - r r^T, hardly changes with a rotation of a degree.
    normal = np.eye(3) * weight.sum() - (rest * weight[:, None]).T @ rest + np.eye(3) / SIGMA_PRIOR**2
    covariance: Array = np.linalg.inv(normal)
    turned = np.zeros(3)
    for _ in range(3):
        R = exp_so3(turned)
        residual = now - rest @ R
        # [r]x^T v = v x r
        gradient = np.cross(residual, rest @ R) * weight[:, None]
        turned = turned + covariance @ (gradient.sum(axis=0) - turned / SIGMA_PRIOR**2)
    residual = now - rest @ exp_so3(turned)
    misfit = (np.square(residual).sum(axis=1) * weight).reshape(-1, 4).mean(axis=1)
    return exp_so3(turned), covariance, misfit


def shaken(world_from_camera: Array, covariance: Array, shake: Shake) -> tuple[Array, Array]:
    """A camera's pose (4, 4) and its covariance (6, 6), as in `camera.floor.Placement`, in the frame of a shake."""
    pose, total = world_from_camera.copy(), covariance.copy()
    pose[:3, :3] = world_from_camera[:3, :3] @ shake.rotation
    total[3:, 3:] += world_from_camera[:3, :3] @ shake.covariance @ world_from_camera[:3, :3].T
    return pose, total
