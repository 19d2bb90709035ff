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
from numpy.typing import NDArray

from camera.calibration import Intrinsics
from camera.markers import MarkerSighting
from camera.tracking import Prediction
from fusion.geometry import (
    exp_so3,
    inverse,
    quaternion_from_rotation,
    rotation_from_quaternion,
    transform,
    transform_points,
)
from fusion.measurements import Array, Pose, PoseFix, PoseHypothesis

# What the planar solve takes as known is known this well: the height of the body above the floor, m, ...
FLOOR_HEIGHT_SIGMA = 0.005
# ... and its roll and pitch, rad. An uneven floor, a soft tyre, a marker glued on a little askew.
FLOOR_TILT_SIGMA = 0.01

_PLANAR = [0, 1, 5]
_PLANAR_ROWS = [[0], [1], [5]]
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


class Body:
    """A robot with its markers.

    `planar`: it stands level on the floor (z = 0), known to FLOOR_HEIGHT_SIGMA and FLOOR_TILT_SIGMA, and the corners
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
    """Where the markers of bodies with known poses, by name, should be seen; those in front of the camera only.

    The poses are for the exposure of the image's first row. `line_time`: s from one row's exposure to the next one's.
    """
    known = [
        (poses[body.name], id, points) for body in bodies if body.name in poses for id, points in body.corners.items()
    ]
    if not known:
        return {}
    position = np.array([pose.position for pose, _, _ in known])
    R = np.array([rotation_from_quaternion(pose.quaternion_wxyz) for pose, _, _ in known])
    # (m, 4, 3): a marker's corners from its body's origin, along the world's axes
    lever = np.array([points for _, _, points in known]) @ R.transpose(0, 2, 1)
    camera = world_from_camera[:3, 3]
    in_camera = (lever + position[:, None] - camera) @ world_from_camera[:3, :3]
    visible = in_camera[..., 2].min(axis=1) > 1e-3
    pixels, by_point = project(np.where(visible[:, None, None], in_camera, [0.0, 0.0, 1.0]).reshape(-1, 3), intrinsics)
    corners = pixels.reshape(-1, 4, 2)
    by_position = (by_point @ world_from_camera[:3, :3].T).reshape(-1, 4, 2, 3)
    by_pose = _by_pose(by_position, lever)
    if line_time:
        motion = np.array([[*pose.velocity, *(R[k] @ pose.angular_velocity)] for k, (pose, _, _) in enumerate(known)])
        rows = corners[..., 1].mean(axis=1)
        corners = corners + line_time * rows[:, None, None] * np.einsum("mcai,mi->mca", by_pose, motion)
    covariance = np.array([pose.covariance for pose, _, _ in known])
    variance = np.einsum("mcai,mij,mcaj->mca", by_pose, covariance, by_pose)
    sigma = np.sqrt(variance.max(axis=(1, 2)))
    return {id: Prediction(corners[k], float(sigma[k])) for k, (_, id, _) in enumerate(known) if visible[k]}


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


# A step that lessens the misfit by no more is the last. It is one of ten sigma of a corner's coordinate, or a pixel:
# over such a distance the projection bends by a thousandth of one.
_GAIN = 100.0


def _planar(
    seen: Sequence[tuple[Body, Sequence[MarkerSighting]]],
    world_from_camera: Array,
    intrinsics: Intrinsics,
    placement: Array,
) -> dict[str, list[PoseHypothesis]]:
    """x, y and yaw of level bodies, all in one go: Gauss and Newton, from where rays meet the plane of the corners."""
    points = np.vstack([body.corners[sighting.id] for body, markers in seen for sighting in markers])
    corners = np.vstack([sighting.corners_px for _, markers in seen for sighting in markers])
    sigma_px = np.repeat([sighting.sigma_px for _, markers in seen for sighting in markers], 4)
    count = np.array([4 * len(markers) for _, markers in seen])
    # Corners lie body after body: `of` is whose each is, `first` where those of each body begin.
    of, first = np.repeat(np.arange(len(seen)), count), np.cumsum(count) - count
    state, possible = _on_floor(points, corners, world_from_camera, intrinsics, of, first)
    camera, R = world_from_camera[:3, 3], world_from_camera[:3, :3]
    for _ in range(20):
        lever = _turned(points, state[of, 2])
        in_camera = (lever - camera) @ R + state[of, :2] @ R[:2]
        possible &= np.minimum.reduceat(in_camera[:, 2], first) > 1e-3
        expected, by_point = project(np.where(possible[of, None], in_camera, [0.0, 0.0, 1.0]), intrinsics)
        J = _by_pose(by_point @ R.T, lever) / sigma_px[:, None, None]
        residual = (corners - expected) / sigma_px[:, None]
        normal = np.add.reduceat(J.transpose(0, 2, 1) @ J, first)
        gradient = np.add.reduceat((residual[:, None] @ J)[:, 0], first)[:, _PLANAR]
        misfit = np.add.reduceat(np.square(residual).sum(axis=1), first)
        noise = np.linalg.inv(normal[:, _PLANAR][:, :, _PLANAR])
        step = (noise @ gradient[..., None])[..., 0]
        gain = (step * gradient).sum(axis=1)
        state, misfit = state + step, np.maximum(misfit - gain, 0.0)
        if not ((gain > _GAIN) & possible).any():
            break
    # How the solved part answers to a motion of the body that it does not know of: dx = response @ motion. Height
    # and tilt are errors of what was assumed ("consider" covariance), a misplaced camera is a motion of all six.
    response = noise @ normal[:, _PLANAR]
    assumed = np.zeros((len(seen), 6, 3))
    assumed[:, _PLANAR] = response[:, :, _ASSUMED]
    assumed[:, _ASSUMED] = -np.eye(3)
    moved = response @ _body_by_placement(np.column_stack([state[:, :2], np.zeros(len(seen))]), camera)
    inflation = [_inflation(m, 2 * n - 3) for m, n in zip(misfit.tolist(), count.tolist(), strict=True)]
    covariance = assumed @ _ASSUMED_COVARIANCE @ assumed.transpose(0, 2, 1)
    covariance[:, _PLANAR_ROWS, _PLANAR] += noise * np.array(inflation)[:, None, None]
    covariance[:, _PLANAR_ROWS, _PLANAR] += moved @ placement @ moved.transpose(0, 2, 1)
    hypotheses: dict[str, list[PoseHypothesis]] = {}
    for k, (body, _) in enumerate(seen):
        x, y, yaw = state[k].tolist()
        if possible[k] and math.isfinite(x + y + yaw):
            quaternion = np.array([math.cos(0.5 * yaw), 0.0, 0.0, math.sin(0.5 * yaw)])
            hypotheses[body.name] = [PoseHypothesis(np.array([x, y, 0.0]), quaternion, covariance[k], float(misfit[k]))]
    return hypotheses


def _six(view: View, seen: Sequence[Seen], placement: Array) -> list[PoseHypothesis]:
    hypotheses = []
    for world_from_body, noise, misfit in solve_six(view, seen):
        moved = _body_by_placement(world_from_body[:3, 3], view.world_from_camera[:3, 3])
        covariance = noise * _inflation(misfit, 2 * len(view.points_body) - 6) + moved @ placement @ moved.T
        hypotheses.append(_hypothesis(world_from_body, covariance, misfit))
    return hypotheses


def _on_floor(
    points: Array,
    corners_px: Array,
    world_from_camera: Array,
    intrinsics: Intrinsics,
    of: NDArray[np.int_],
    first: NDArray[np.int_],
) -> tuple[Array, NDArray[np.bool_]]:
    """(m, 3) x, y and yaw of level bodies at z = 0, and for which there is one: each corner's ray cut with the plane at
    that corner's height, then the rotation and shift of the plane that fit best (Umeyama, 1991, without scale, in two
    dimensions)."""
    directions = rays(corners_px, intrinsics) @ world_from_camera[:3, :3].T
    camera = world_from_camera[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = (points[:, 2] - camera[2]) / directions[:, 2]
    met = np.isfinite(distance) & (distance > 0.0)
    floor = camera[:2] + np.where(met, distance, 0.0)[:, None] * directions[:, :2]
    count = np.bincount(of)[:, None]
    middle_floor, middle_body = (np.add.reduceat(p, first) / count for p in (floor, points[:, :2]))
    a, b = points[:, :2] - middle_body[of], floor - middle_floor[of]
    yaw = np.arctan2(
        np.add.reduceat(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0], first), np.add.reduceat((a * b).sum(axis=1), first)
    )
    middle = np.column_stack([middle_body, np.zeros(len(yaw))])
    return np.column_stack([middle_floor - _turned(middle, yaw)[:, :2], yaw]), np.logical_and.reduceat(met, first)


def _turned(points: Array, yaw: Array) -> Array:
    """(n, 3) points, each turned about z by its own angle (n,)."""
    c, s = np.cos(yaw), np.sin(yaw)
    x, y, z = points.T
    return np.column_stack([c * x - s * y, s * x + c * y, z])


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
    """(..., 6, 6): how the poses of bodies at places (..., 3) move with that of a camera at another, both as position
    and rotation along world axes."""
    x, y, z = np.moveaxis(body - camera, -1, 0)
    moved = np.zeros((*body.shape[:-1], 6, 6))
    moved[...] = np.eye(6)
    # -[x]x
    moved[..., 0, 4], moved[..., 0, 5], moved[..., 1, 5] = z, -y, x
    moved[..., 1, 3], moved[..., 2, 3], moved[..., 2, 4] = -z, y, -x
    return moved


def _same(a: Array, b: Array) -> bool:
    """The same pose to 1e-5 of the distance and 1e-4 rad, which is where the refinement stops."""
    shift = np.linalg.norm(a[:3, 3] - b[:3, 3]) <= 1e-5 * (1.0 + np.linalg.norm(a[:3, 3]))
    return bool(shift and np.linalg.norm(a[:3, :3] - b[:3, :3]) <= 2e-4)


def _hypothesis(world_from_body: Array, covariance: Array, misfit: float) -> PoseHypothesis:
    return PoseHypothesis(world_from_body[:3, 3], quaternion_from_rotation(world_from_body[:3, :3]), covariance, misfit)
