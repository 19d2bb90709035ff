"""A camera under a ceiling, and markers in front of it."""

from __future__ import annotations

import numpy as np

from camera.calibration import Intrinsics
from camera.fix import MarkerMount, marker_corners, project
from camera.markers import MarkerSighting
from camera.synthetic import straight_down
from fusion.geometry import exp_so3, inverse, log_so3, rotation_from_quaternion, transform, transform_points
from fusion.measurements import Array

INTRINSICS = Intrinsics(
    np.array([[600.0, 0.0, 319.5], [0.0, 600.0, 239.5], [0.0, 0.0, 1.0]]),
    np.array([-0.12, 0.04, 0.0005, -0.0003, 0.0]),
    640,
    480,
)
# 3 m up, a few degrees out of plumb
WORLD_FROM_CAMERA = straight_down(0.2, 0.1, 3.0) @ transform(exp_so3([0.10, -0.12, 0.02]), [0.0, 0.0, 0.0])


def sight(
    mounts: list[MarkerMount],
    world_from_body: Array,
    random: np.random.Generator,
    sigma_px: float,
    world_from_camera: Array = WORLD_FROM_CAMERA,
) -> list[MarkerSighting]:
    """What the camera sees of a body's markers, with white noise on every corner coordinate."""
    camera_from_body = inverse(world_from_camera) @ world_from_body
    return [
        MarkerSighting(
            1.0,
            "ceiling",
            mount.id,
            project(
                transform_points(camera_from_body @ mount.body_from_marker, marker_corners(mount.size)), INTRINSICS
            )[0]
            + random.normal(0.0, sigma_px, (4, 2)),
            sigma_px,
        )
        for mount in mounts
    ]


def pose_error(a_from_b: Array, position: Array, rotation: Array) -> Array:
    """(6,) of an estimate against the truth, along the axes of a."""
    return np.concatenate([position - a_from_b[:3, 3], log_so3(rotation @ a_from_b[:3, :3].T)])


def nees(a_from_b: Array, position: Array, quaternion_wxyz: Array, covariance: Array) -> float:
    """Squared error over its covariance, 6 degrees of freedom."""
    error = pose_error(a_from_b, position, rotation_from_quaternion(quaternion_wxyz))
    return float(error @ np.linalg.solve(covariance, error))


def moved(a_from_b: Array, by: Array) -> Array:
    """A pose perturbed by (position, rotation) along the axes of a."""
    return transform(exp_so3(by[3:]) @ a_from_b[:3, :3], a_from_b[:3, 3] + by[:3])
