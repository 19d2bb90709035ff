"""From corner pixels to poses with covariance.

A marker's frame has its origin in the middle, x to its right, y to its top and z out of the paper. Corners are
ordered as OpenCV orders them: clockwise from the top left.

Every pose here is perturbed as in `fusion.measurements`: position p + dp and rotation exp(dtheta) R, both along the
axes of the frame that the pose is given in (the left frame in `a_from_b`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from camera.calibration import Intrinsics
from camera.markers import MarkerSighting
from fusion.geometry import (
    exp_so3,
    inverse,
    quaternion_from_rotation,
    rotation_about_z,
    skew,
    transform,
    transform_points,
)
from fusion.measurements import Array, PoseFix, PoseHypothesis

# What the planar solve takes as known is known this well: the height of the body above the floor, m, ...
FLOOR_HEIGHT_SIGMA = 0.005
# ... and its roll and pitch, rad. An uneven floor, a soft tyre, a marker glued on a little askew.
FLOOR_TILT_SIGMA = 0.01

_PLANAR = [0, 1, 5]
_ASSUMED = [2, 3, 4]
_ASSUMED_COVARIANCE = np.diag([FLOOR_HEIGHT_SIGMA**2, FLOOR_TILT_SIGMA**2, FLOOR_TILT_SIGMA**2])


@dataclass(frozen=True, slots=True)
class MarkerMount:
    """A marker on a robot. `size`: side of the black square, m. `body_from_marker`: (4, 4)."""

    id: int
    size: float
    body_from_marker: Array


# A marker of a body with where it was seen.
Seen = tuple[MarkerMount, MarkerSighting]


@dataclass(frozen=True, slots=True)
class MarkerPose:
    """One pose that explains four corners.

    `camera_from_marker`: (4, 4). `covariance`: (6, 6), camera axes. `misfit`: squared reprojection error over its
    variance, 2 degrees of freedom. `rms_px`: the same as a root mean square over the four corners.
    """

    camera_from_marker: Array
    covariance: Array
    misfit: float
    rms_px: float


def marker_corners(size: float) -> Array:
    """(4, 3) corners of a marker of side `size` (m) in its own frame, clockwise from the top left."""
    h = 0.5 * size
    return np.array([[-h, h, 0.0], [h, h, 0.0], [h, -h, 0.0], [-h, -h, 0.0]])


def project(points_camera: Array, intrinsics: Intrinsics) -> tuple[Array, Array]:
    """(n, 3) points in the camera frame -> (n, 2) px and (n, 2, 3) derivatives of px by the point, px/m."""
    zero = np.zeros(3)
    pixels, jacobian = cv2.projectPoints(
        np.ascontiguousarray(points_camera), zero, zero, intrinsics.camera_matrix, intrinsics.distortion
    )
    # Columns of OpenCV's Jacobian: rotation, translation, ... With no rotation, moving the camera's translation is
    # moving the point.
    return np.asarray(pixels, np.float64).reshape(-1, 2), np.asarray(jacobian[:, 3:6], np.float64).reshape(-1, 2, 3)


def rays(corners_px: Array, intrinsics: Intrinsics) -> Array:
    """(n, 2) px -> (n, 3) directions in the camera frame with z = 1, distortion removed."""
    pixels = np.ascontiguousarray(corners_px, dtype=np.float64).reshape(-1, 1, 2)
    normalised = cv2.undistortPoints(pixels, intrinsics.camera_matrix, intrinsics.distortion)
    return np.hstack([normalised.reshape(-1, 2), np.ones((len(pixels), 1))])


def chi_square_limit(degrees_of_freedom: int) -> float:
    """The .999 quantile of the chi-square distribution, by Wilson and Hilferty (1931), within 3 % from 2 up."""
    k = 2.0 / (9.0 * degrees_of_freedom)
    return float(degrees_of_freedom * (1.0 - k + 3.0902 * math.sqrt(k)) ** 3)


@dataclass(frozen=True, slots=True)
class View:
    """What one camera saw of one rigid body: n points (n, 3) in its frame, where they were seen (n, 2), sigma (n,)."""

    points_body: Array
    corners_px: Array
    sigma_px: Array
    world_from_camera: Array
    intrinsics: Intrinsics

    @classmethod
    def of(cls, seen: Sequence[Seen], world_from_camera: Array, intrinsics: Intrinsics) -> View:
        """The corners of all these markers, each with its place on the body."""
        return cls(
            np.vstack([transform_points(mount.body_from_marker, marker_corners(mount.size)) for mount, _ in seen]),
            np.vstack([sighting.corners_px for _, sighting in seen]),
            np.repeat([sighting.sigma_px for _, sighting in seen], 4),
            world_from_camera,
            intrinsics,
        )

    def residuals(self, world_from_body: Array) -> tuple[Array, Array] | None:
        """(2n,) seen minus expected over sigma, and its (2n, 6) model derivative by (position, rotation), world axes.

        None where a point is not in front of the camera.
        """
        points_world = transform_points(world_from_body, self.points_body)
        points_camera = transform_points(inverse(self.world_from_camera), points_world)
        if points_camera[:, 2].min() < 1e-3:
            return None
        expected, by_point = project(points_camera, self.intrinsics)
        by_position = by_point @ self.world_from_camera[:3, :3].T
        lever = points_world - world_from_body[:3, 3]
        # d(p + exp(dtheta) R x) / d dtheta = -skew(R x)
        by_rotation = np.stack([-J @ skew(x) for J, x in zip(by_position, lever, strict=True)])
        weight = 1.0 / self.sigma_px
        residual = (self.corners_px - expected) * weight[:, None]
        jacobian = np.concatenate([by_position, by_rotation], axis=2) * weight[:, None, None]
        return residual.ravel(), jacobian.reshape(-1, 6)

    def refine(self, world_from_body: Array, columns: Sequence[int] = range(6)) -> tuple[Array, Array, float] | None:
        """Least squares over the named columns of (position, rotation), none of which is possible, by Levenberg and
        Marquardt.

        Returns the pose (4, 4), the Jacobian (2n, 6) there and the misfit; None where it starts behind the camera or
        where a column cannot be told from the corners.
        """
        at = self.residuals(world_from_body)
        if at is None:
            return None
        residual, jacobian = at
        misfit = float(residual @ residual)
        if not len(columns):
            return world_from_body, jacobian, misfit
        damping = 1e-6
        for _ in range(50):
            J = jacobian[:, columns]
            normal = J.T @ J
            try:
                step = np.linalg.solve(normal + damping * np.diag(np.diag(normal)), J.T @ residual)
            except np.linalg.LinAlgError:
                return None
            full = np.zeros(6)
            full[list(columns)] = step
            moved = transform(
                exp_so3(full[3:]) @ world_from_body[:3, :3],
                world_from_body[:3, 3] + full[:3],
            )
            tried = self.residuals(moved)
            if tried is None or (after := float(tried[0] @ tried[0])) > misfit:
                damping *= 10.0
                if damping > 1e6:
                    break
                continue
            gained, (residual, jacobian), world_from_body, misfit = misfit - after, tried, moved, after
            damping = max(0.1 * damping, 1e-9)
            # A gain this far below one unit of chi-square moves the pose by a thousandth of its sigma.
            if gained < 1e-6:
                break
        return world_from_body, jacobian, misfit


def marker_poses(
    corners_px: Array, size: float, intrinsics: Intrinsics, sigma_px: float = 1.0
) -> tuple[MarkerPose, ...]:
    """The two poses that one marker can have, the likelier first; none if the corners are no marker's.

    `corners_px` (4, 2), `size` in m. A flat square seen with little perspective looks the same tilted the other way:
    both solutions come from OpenCV's IPPE (Collins and Bartoli, 2014) and are refined on the corner pixels. Where
    perspective rules the second out, refining it leads to the first: it is then left as IPPE has it, with its misfit.
    """
    corners = np.ascontiguousarray(corners_px, dtype=np.float64)
    points = marker_corners(size)
    view = View(points, corners, np.full(4, sigma_px), np.eye(4), intrinsics)
    try:
        _, rotations, translations, _ = cv2.solvePnPGeneric(
            points, corners, intrinsics.camera_matrix, intrinsics.distortion, flags=cv2.SOLVEPNP_IPPE_SQUARE
        )
    except cv2.error:
        return ()
    starts = [transform(exp_so3(r.ravel()), t.ravel()) for r, t in zip(rotations, translations, strict=True)]
    found: list[MarkerPose] = []
    for start in starts:
        refined = view.refine(start) if np.isfinite(start).all() else None
        if refined is not None and any(_same(refined[0], other.camera_from_marker) for other in found):
            refined = view.refine(start, ())
        if refined is None:
            continue
        camera_from_marker, jacobian, misfit = refined
        covariance = _covariance(jacobian)
        # The paper's face must look at the camera.
        if covariance is not None and camera_from_marker[:3, 2] @ camera_from_marker[:3, 3] < 0.0:
            found.append(MarkerPose(camera_from_marker, covariance, misfit, sigma_px * math.sqrt(misfit / 4.0)))
    return tuple(sorted(found, key=lambda pose: pose.misfit))


def solve(
    robot: str,
    mounts: Sequence[MarkerMount],
    sightings: Sequence[MarkerSighting],
    intrinsics: Intrinsics,
    world_from_camera: Array,
    *,
    planar: bool,
    arrival: float,
    placement_covariance: Array | None = None,
) -> PoseFix | None:
    """The pose of one robot from what one frame of one camera saw of its markers, all of them jointly.

    `planar`: the body stands level on the floor (z = 0), known to FLOOR_HEIGHT_SIGMA and FLOOR_TILT_SIGMA, and the
    corners tell x, y and yaw: far better determined than six unknowns, because a marker seen from straight above hardly
    shows its tilt. Otherwise all six, with up to two hypotheses.
    `placement_covariance`: (6, 6) of `world_from_camera`, position and rotation, world axes.
    Returns None if no marker of the robot is among the sightings, or none that a pose in front of the camera explains.
    """
    by_id = {mount.id: mount for mount in mounts}
    seen = [(by_id[sighting.id], sighting) for sighting in sightings if sighting.id in by_id]
    if not seen:
        return None
    placement = np.zeros((6, 6)) if placement_covariance is None else placement_covariance
    view = View.of(seen, world_from_camera, intrinsics)
    hypotheses = _planar(view, placement) if planar else _six(view, seen, placement)
    if not hypotheses:
        return None
    markers = tuple(mount.id for mount, _ in seen)
    return PoseFix(robot, seen[0][1].t, arrival, tuple(hypotheses[:2]), seen[0][1].camera, markers)


def solve_six(view: View, seen: Sequence[Seen]) -> list[tuple[Array, Array, float]]:
    """The poses (4, 4) that explain a view, with covariance (6, 6) and misfit, the likelier first."""
    found: list[tuple[Array, Array, float]] = []
    # Started from both poses of every marker: with several in view the joint solve leaves one of them as a rule.
    for mount, sighting in seen:
        for pose in marker_poses(sighting.corners_px, mount.size, view.intrinsics, sighting.sigma_px):
            start = view.world_from_camera @ pose.camera_from_marker @ inverse(mount.body_from_marker)
            refined = view.refine(start)
            if refined is None or any(_same(refined[0], other[0]) for other in found):
                continue
            world_from_body, jacobian, misfit = refined
            covariance = _covariance(jacobian)
            if covariance is not None:
                found.append((world_from_body, covariance, misfit))
    return sorted(found, key=lambda item: item[2])


def _planar(view: View, placement: Array) -> list[PoseHypothesis]:
    start = _on_floor(view)
    refined = None if start is None else view.refine(start, _PLANAR)
    if refined is None:
        return []
    world_from_body, jacobian, misfit = refined
    J = jacobian[:, _PLANAR]
    noise = _covariance(J)
    if noise is None:
        return []
    # How the solved part answers to a motion of the body that the solve does not know of: dx = gain @ motion. Height
    # and tilt are errors of what was assumed ("consider" covariance), a misplaced camera is a motion of all six.
    gain = noise @ J.T @ jacobian
    assumed = np.zeros((6, 3))
    assumed[_PLANAR] = gain[:, _ASSUMED]
    assumed[_ASSUMED] = -np.eye(3)
    moved = gain @ _body_by_placement(world_from_body, view.world_from_camera)
    covariance = assumed @ _ASSUMED_COVARIANCE @ assumed.T
    covariance[np.ix_(_PLANAR, _PLANAR)] += noise * _inflation(misfit, len(jacobian) - 3) + moved @ placement @ moved.T
    return [_hypothesis(world_from_body, covariance, misfit)]


def _six(view: View, seen: Sequence[Seen], placement: Array) -> list[PoseHypothesis]:
    hypotheses = []
    for world_from_body, noise, misfit in solve_six(view, seen):
        moved = _body_by_placement(world_from_body, view.world_from_camera)
        covariance = noise * _inflation(misfit, 2 * len(view.points_body) - 6) + moved @ placement @ moved.T
        hypotheses.append(_hypothesis(world_from_body, covariance, misfit))
    return hypotheses


def _on_floor(view: View) -> Array | None:
    """world_from_body of a level body at z = 0: each corner's ray cut with the plane at that corner's height, then the
    rotation and shift of the plane that fit best (Umeyama, 1991, without scale, in two dimensions)."""
    directions = rays(view.corners_px, view.intrinsics) @ view.world_from_camera[:3, :3].T
    camera = view.world_from_camera[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = (view.points_body[:, 2] - camera[2]) / directions[:, 2]
    if not np.isfinite(distance).all() or distance.min() <= 0.0:
        return None
    floor = camera[:2] + distance[:, None] * directions[:, :2]
    body = view.points_body[:, :2]
    a, b = body - body.mean(axis=0), floor - floor.mean(axis=0)
    yaw = math.atan2(float(np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])), float(np.sum(a * b)))
    R = rotation_about_z(yaw)
    return transform(R, np.append(floor.mean(axis=0) - R[:2, :2] @ body.mean(axis=0), 0.0))


def _covariance(jacobian: Array) -> Array | None:
    """(J^T J)^-1 of a Jacobian over sigma; None where it has no inverse."""
    try:
        covariance = np.asarray(np.linalg.inv(jacobian.T @ jacobian), np.float64)
    except np.linalg.LinAlgError:
        return None
    return covariance if np.isfinite(covariance).all() and (np.diag(covariance) > 0.0).all() else None


def _inflation(misfit: float, degrees_of_freedom: int) -> float:
    """1, or by how much the corners' variance must have been larger to explain a misfit beyond chance."""
    return max(1.0, misfit / chi_square_limit(degrees_of_freedom))


def _body_by_placement(world_from_body: Array, world_from_camera: Array) -> Array:
    """(6, 6): how the body's pose moves with the camera's, both as position and rotation along world axes."""
    moved = np.eye(6)
    moved[:3, 3:] = -skew(world_from_body[:3, 3] - world_from_camera[:3, 3])
    return moved


def _same(a: Array, b: Array) -> bool:
    """The same pose to 1e-5 of the distance and 1e-4 rad, which is where the refinement stops."""
    shift = np.linalg.norm(a[:3, 3] - b[:3, 3]) <= 1e-5 * (1.0 + np.linalg.norm(a[:3, 3]))
    return bool(shift and np.linalg.norm(a[:3, :3] - b[:3, :3]) <= 2e-4)


def _hypothesis(world_from_body: Array, covariance: Array, misfit: float) -> PoseHypothesis:
    return PoseHypothesis(world_from_body[:3, 3], quaternion_from_rotation(world_from_body[:3, :3]), covariance, misfit)
