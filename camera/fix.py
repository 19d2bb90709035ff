"""From corner pixels to poses with covariance.

A marker's frame has its origin in the middle, x to its right, y to its top and z out of the paper. Corners are
ordered as OpenCV orders them: clockwise from the top left.

Every pose here is perturbed as in `fusion.measurements`: position p + dp and rotation exp(dtheta) R, both along the
axes of the frame that the pose is given in (the left frame in `a_from_b`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from camera.calibration import Intrinsics
from camera.markers import MarkerSighting
from camera.planar import solve_planar
from camera.tracking import Prediction
from fusion.geometry import (
    exp_so3,
    inverse,
    quaternion_from_rotation,
    rotation_from_quaternion,
    skew,
    transform,
    transform_points,
)
from fusion.measurements import Array, Pose, PoseFix, PoseHypothesis


@dataclass(frozen=True, slots=True)
class MarkerMount:
    """A marker on a robot. `size`: side of the black square, m. `body_from_marker`: (4, 4)."""

    id: int
    size: float
    body_from_marker: Array


# m: sigma of a position that helps to find nothing.
LOST = 1.0
_NOWHERE = np.full((4, 2), -1e6)

# A marker of a body with where it was seen.
Seen = tuple[MarkerMount, MarkerSighting]


class Body:
    """A robot with its markers.

    `planar`: it stands level on the floor (z = 0), as `camera.planar` supposes it, and the corners
    tell x, y and yaw: far better determined than six unknowns, because a marker seen from straight above hardly shows
    its tilt. `corners`: (4, 3) m in the body's frame, by the marker's id.
    """

    def __init__(self, name: str, mounts: Sequence[MarkerMount], *, planar: bool) -> None:
        self.name = name
        self.mounts = {mount.id: mount for mount in mounts}
        self.planar = planar
        self.corners = {
            mount.id: transform_points(mount.body_from_marker, marker_corners(mount.size)) for mount in mounts
        }
        # m from the body's origin to the corner that is furthest away
        self.reach = {id: float(np.linalg.norm(corners, axis=1).max()) for id, corners in self.corners.items()}


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
        weight = 1.0 / self.sigma_px
        residual = (self.corners_px - expected) * weight[:, None]
        jacobian = _by_pose(by_position, lever) * weight[:, None, None]
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
    bodies: Sequence[Body],
    sightings: Sequence[MarkerSighting],
    intrinsics: Intrinsics,
    world_from_camera: Array,
    *,
    arrival: float,
    placement_covariance: Array | None = None,
) -> list[PoseFix]:
    """The poses of all bodies of which one frame of one camera shows a marker; each from all of its markers jointly.

    A body that is not planar has all six unknowns, and up to two hypotheses. `placement_covariance`: (6, 6) of
    `world_from_camera`, position and rotation, world axes. A body that no pose in front of the camera explains is left
    out.
    """
    placement = np.zeros((6, 6)) if placement_covariance is None else placement_covariance
    by_id = {sighting.id: sighting for sighting in sightings}
    seen = [(body, [by_id[id] for id in body.corners if id in by_id]) for body in bodies]
    seen = [(body, markers) for body, markers in seen if markers]
    found: dict[str, list[PoseHypothesis]] = {}
    planar = [(body, markers) for body, markers in seen if body.planar]
    if planar:
        found |= _planar(planar, world_from_camera, intrinsics, placement)
    for body, markers in seen:
        if not body.planar:
            pairs = [(body.mounts[sighting.id], sighting) for sighting in markers]
            found[body.name] = _six(View.of(pairs, world_from_camera, intrinsics), pairs, placement)
    return [
        PoseFix(
            body.name,
            sum(sighting.t for sighting in markers) / len(markers),
            arrival,
            tuple(hypotheses[:2]),
            markers[0].camera,
            tuple(sighting.id for sighting in markers),
        )
        for body, markers in seen
        if (hypotheses := found.get(body.name))
    ]


def predict(
    bodies: Sequence[Body],
    poses: Mapping[str, Pose],
    intrinsics: Intrinsics,
    world_from_camera: Array,
    line_time: float = 0.0,
) -> dict[int, Prediction]:
    """Where the markers of bodies with known poses, by name, should be seen; those that cannot be, from behind or
    behind the camera, far out of the picture. A pose that is not known to LOST is none.

    The poses are for the exposure of the image's first row. `line_time`: s from one row's exposure to the next one's.
    """
    known: list[tuple[int, float]] = []
    points, velocities = [], []
    for body in bodies:
        if (pose := poses.get(body.name)) is None:
            continue
        variance = pose.covariance.diagonal().tolist()
        sigma = math.sqrt(max(variance[:3]))
        if not sigma < LOST:
            continue
        R = rotation_from_quaternion(pose.quaternion_wxyz)
        for id, corners_body in body.corners.items():
            lever = corners_body @ R.T
            points.append(lever + pose.position)
            if line_time:
                velocities.append(pose.velocity + np.cross(R @ pose.angular_velocity, lever))
            # m; a bound: the largest of each three, and the corner furthest away
            known.append((id, sigma + math.sqrt(max(variance[3:])) * body.reach[id]))
    if not known:
        return {}
    world = np.array(points)
    corners, depth = _seen_at(world, intrinsics, world_from_camera)
    if line_time:
        # A row later, the robot is further.
        later = line_time * corners[..., 1].mean(axis=1)
        corners, depth = _seen_at(world + later[:, None, None] * np.array(velocities), intrinsics, world_from_camera)
    (ax, ay), (bx, by) = (corners[:, 1] - corners[:, 0]).T, (corners[:, 2] - corners[:, 1]).T
    # Clockwise in a picture with y down: its face is seen.
    visible = (depth > 0.0) & (ax * by > ay * bx)
    focal = float(intrinsics.camera_matrix[0, 0])
    return {
        id: Prediction(corners[k], sigma * focal / z) if seen else Prediction(_NOWHERE, 1.0)
        for k, ((id, sigma), z, seen) in enumerate(zip(known, depth.tolist(), visible.tolist(), strict=True))
    }


def _seen_at(points_world: Array, intrinsics: Intrinsics, world_from_camera: Array) -> tuple[Array, Array]:
    """(m, 4, 3) corners -> (m, 4, 2) px, and (m,) depth of the nearest, m: 0 for a marker behind the camera."""
    in_camera = (points_world - world_from_camera[:3, 3]) @ world_from_camera[:3, :3]
    depth = in_camera[..., 2].min(axis=1)
    if not (depth > 1e-3).all():
        depth = np.where(depth > 1e-3, depth, 0.0)
        in_camera = np.where(depth[:, None, None] > 0.0, in_camera, [0.0, 0.0, 1.0])
    return project(in_camera.reshape(-1, 3), intrinsics)[0].reshape(-1, 4, 2), depth


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


def _planar(
    seen: Sequence[tuple[Body, Sequence[MarkerSighting]]],
    world_from_camera: Array,
    intrinsics: Intrinsics,
    placement: Array,
) -> dict[str, list[PoseHypothesis]]:
    """Level bodies, by name, all in one go: what can be one call for all costs no more for many."""
    points = np.vstack([body.corners[sighting.id] for body, markers in seen for sighting in markers])
    corners = np.vstack([sighting.corners_px for _, markers in seen for sighting in markers])
    sigma_px = np.array([sighting.sigma_px for _, markers in seen for sighting in markers for _ in range(4)])
    directions = rays(corners, intrinsics)
    by_ray = np.ascontiguousarray(project(directions, intrinsics)[1][:, :, :2])
    count = np.array([4 * len(markers) for _, markers in seen])
    states, covariances, systematic, misfits = solve_planar(
        points, directions, by_ray, sigma_px, count, world_from_camera, placement
    )
    hypotheses: dict[str, list[PoseHypothesis]] = {}
    for (body, _), (x, y, yaw), covariance, repeats, misfit in zip(
        seen, states.tolist(), covariances, systematic, misfits.tolist(), strict=True
    ):
        if math.isfinite(misfit):
            quaternion = np.array([math.cos(0.5 * yaw), 0.0, 0.0, math.sin(0.5 * yaw)])
            hypotheses[body.name] = [PoseHypothesis(np.array([x, y, 0.0]), quaternion, covariance, misfit, repeats)]
    return hypotheses


def _six(view: View, seen: Sequence[Seen], placement: Array) -> list[PoseHypothesis]:
    hypotheses = []
    for world_from_body, noise, misfit in solve_six(view, seen):
        moved = _body_by_placement(world_from_body[:3, 3], view.world_from_camera[:3, 3])
        repeats = moved @ placement @ moved.T
        covariance = noise * _inflation(misfit, 2 * len(view.points_body) - 6) + repeats
        quaternion = quaternion_from_rotation(world_from_body[:3, :3])
        hypotheses.append(PoseHypothesis(world_from_body[:3, 3], quaternion, covariance, misfit, repeats))
    return hypotheses


def _by_pose(by_position: Array, lever: Array) -> Array:
    """(..., 2, 6): how pixels answer to a body's position and rotation, from how they do to a shift of a point of it
    (..., 2, 3) that is `lever` (..., 3) away from the body's origin.

    d(p + exp(dtheta) x) / d dtheta = -[x]x, and -j [x]x = x × j.
    """
    x, y, z = lever[..., 0, None], lever[..., 1, None], lever[..., 2, None]
    a, b, c = by_position[..., 0], by_position[..., 1], by_position[..., 2]
    both = np.empty((*by_position.shape[:-1], 6))
    both[..., :3] = by_position
    both[..., 3], both[..., 4], both[..., 5] = y * c - z * b, z * a - x * c, x * b - y * a
    return both


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


def _body_by_placement(body: Array, camera: Array) -> Array:
    """(6, 6): how the pose of a body at a place (3,) moves with that of a camera at another, both as position and
    rotation along world axes."""
    moved = np.eye(6)
    moved[:3, 3:] = -skew(body - camera)
    return moved


def _same(a: Array, b: Array) -> bool:
    """The same pose to 1e-5 of the distance and 1e-4 rad, which is where the refinement stops."""
    shift = np.linalg.norm(a[:3, 3] - b[:3, 3]) <= 1e-5 * (1.0 + np.linalg.norm(a[:3, 3]))
    return bool(shift and np.linalg.norm(a[:3, :3] - b[:3, :3]) <= 2e-4)
