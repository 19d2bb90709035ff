"""Where cameras hang: world_from_camera from anchor markers on the floor, and its file.

`locate_camera` is for one camera and surveyed anchors, as often as one likes; `survey` solves cameras, anchors, tape
distances and the scale of the print jointly, for the day the room is set up.

The file is TOML, written by `steadfix floor`:

    world_from_camera = [[...], [...], [...], [0.0, 0.0, 0.0, 1.0]]     # 4 x 4, m
    covariance = [[...], ...]               # 6 x 6: position (m) and rotation (rad), along world axes
    anchors = [40, 41, 42, 43]              # that it was found from
    rms_px = 0.12                           # of their corners
    calibration = "5f1d7a3bd2c6e804"        # that it was found with, by `Intrinsics.fingerprint`; "" if unknown
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec
import numpy as np
from scipy.optimize import least_squares

from camera.calibration import Intrinsics
from camera.fix import MarkerMount, View, chi_square_limit, marker_corners, marker_poses, project, rays, solve_six
from camera.markers import MarkerSighting
from fusion.geometry import exp_so3, inverse, rotation_about_z, skew, transform, transform_points
from fusion.measurements import Array

# An anchor whose corners lie further than this, in m, from where the other anchors put them contradicts them. A careful
# survey is wrong by millimetres, a mistyped coordinate, a turned sheet or a wrong id by a lot more.
CONTRADICTION = 0.05


class PlacementError(ValueError):
    """The camera's place could not be found. The text says why and which anchors are concerned."""


@dataclass(frozen=True, slots=True)
class Anchor:
    """A marker at a known place. `size`: side of the black square, m. `world_from_marker`: (4, 4)."""

    id: int
    size: float
    world_from_marker: Array


@dataclass(frozen=True, slots=True)
class Placement:
    """Where a camera is.

    `covariance`: (6, 6), position and rotation, world axes. `rms_px`: of the anchors' corners. `calibration`: the
    fingerprint of the one that it was found with, and is right with; "" if unknown.
    """

    world_from_camera: Array
    covariance: Array
    rms_px: float
    anchors_seen: tuple[int, ...]
    calibration: str = ""


class _File(msgspec.Struct, forbid_unknown_fields=True):
    world_from_camera: list[list[float]]
    covariance: list[list[float]]
    anchors: list[int]
    rms_px: float
    calibration: str = ""


def load_placement(path: str | os.PathLike[str]) -> Placement:
    """Reads a placement file. Raises PlacementError naming file and key, OSError if it cannot be read."""
    try:
        content = msgspec.toml.decode(Path(path).read_text(encoding="utf-8"), type=_File)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise PlacementError(f"{path}: {error}") from None
    pose, covariance = _matrix(content.world_from_camera, 4), _matrix(content.covariance, 6)
    if (
        pose is None
        or np.abs(pose[:3, :3] @ pose[:3, :3].T - np.eye(3)).max() > 1e-6
        or np.linalg.det(pose[:3, :3]) < 0.0
        or pose[3].tolist() != [0.0, 0.0, 0.0, 1.0]
    ):
        raise PlacementError(
            f"{path}: world_from_camera: a 4 x 4 rigid transform is needed, as `steadfix floor` writes it"
        )
    if (
        covariance is None
        or np.abs(covariance - covariance.T).max() > 1e-9 * np.abs(covariance).max()
        or np.linalg.eigvalsh(covariance).min() < 0.0
    ):
        raise PlacementError(
            f"{path}: covariance: a symmetric, positive 6 x 6 matrix is needed, as `steadfix floor` writes it"
        )
    return Placement(pose, covariance, content.rms_px, tuple(content.anchors), content.calibration)


def save_placement(path: str | os.PathLike[str], placement: Placement, comment: str = "") -> None:
    """Writes a placement file that `load_placement` reads back exactly. Raises OSError if it cannot be written."""
    lines = [f"# {line}" for line in comment.splitlines()]
    for key, matrix in (("world_from_camera", placement.world_from_camera), ("covariance", placement.covariance)):
        lines += [f"{key} = [", *(f"    {row}," for row in matrix.tolist()), "]"]
    lines += [f"anchors = {list(placement.anchors_seen)}", f"rms_px = {placement.rms_px!r}"]
    lines += [f'calibration = "{placement.calibration}"']
    Path(path).write_text("\n".join(lines) + "\n", encoding="utf-8")


def _matrix(rows: list[list[float]], size: int) -> Array | None:
    if [len(row) for row in rows] != [size] * size:
        return None
    matrix = np.array(rows)
    return matrix if np.isfinite(matrix).all() else None


def locate_camera(sightings: Sequence[MarkerSighting], anchors: Sequence[Anchor], intrinsics: Intrinsics) -> Placement:
    """Fits world_from_camera to the corners of all anchors in view at once.

    Several sightings of an anchor, from several frames, weigh as so many. Errors of the survey show in the residuals,
    by which the covariance is widened. Raises PlacementError if no anchor is in view, or if anchors contradict each
    other by more than CONTRADICTION.
    """
    by_id = {anchor.id: anchor for anchor in anchors}
    seen = [(by_id[sighting.id], sighting) for sighting in sightings if sighting.id in by_id]
    ids = tuple(sorted({anchor.id for anchor, _ in seen}))
    if not seen:
        others = sorted({sighting.id for sighting in sightings})
        raise PlacementError(
            f"no anchor is in view: {listed(sorted(by_id))} expected, "
            f"{listed(others, 'marker') if others else 'no marker'} seen"
        )
    found = _fit(seen, intrinsics)
    if found is None:
        raise PlacementError(f"no place of the camera explains what it sees of {listed(ids)}: check size_mm and id")
    _check_consistent(seen, ids, intrinsics, found[0])
    world_from_camera, covariance, misfit = found
    corners = 4 * len(seen)
    rms_sigma = math.sqrt(misfit / corners)
    mean_sigma_px = math.sqrt(float(np.mean([sighting.sigma_px**2 for _, sighting in seen])))
    freedom = 2 * corners - 6
    widened = misfit / freedom if misfit > chi_square_limit(freedom) else 1.0
    rms_px = rms_sigma * mean_sigma_px
    return Placement(world_from_camera, covariance * widened, rms_px, ids, intrinsics.fingerprint)


def _fit(seen: Sequence[tuple[Anchor, MarkerSighting]], intrinsics: Intrinsics) -> tuple[Array, Array, float] | None:
    """world_from_camera, its covariance and the misfit; None if nothing in front of the camera fits."""
    # The anchors are one rigid body, seen from the camera's own frame: the same solve as for a robot.
    body = [(MarkerMount(anchor.id, anchor.size, anchor.world_from_marker), sighting) for anchor, sighting in seen]
    solutions = solve_six(View.of(body, np.eye(4), intrinsics), body)
    if not solutions:
        return None
    camera_from_world, covariance, misfit = solutions[0]
    # Perturbing camera_from_world = (R, p) by (dp, dtheta), along camera axes, moves its inverse (R^T, -R^T p) by
    # -R^T dp - R^T skew(p) dtheta and turns it by -R^T dtheta, along world axes.
    back = -camera_from_world[:3, :3].T
    by = np.zeros((6, 6))
    by[:3, :3] = back
    by[:3, 3:] = back @ skew(camera_from_world[:3, 3])
    by[3:, 3:] = back
    return inverse(camera_from_world), by @ covariance @ by.T, misfit


def _check_consistent(
    seen: Sequence[tuple[Anchor, MarkerSighting]], ids: Sequence[int], intrinsics: Intrinsics, world_from_camera: Array
) -> None:
    """Raises PlacementError if an anchor is not where the others put it."""
    worst = {id: _worst_shift(id, seen, intrinsics, world_from_camera) for id in ids}
    if len(ids) < 2 or max(worst.values()) <= CONTRADICTION / 2.0:
        return
    # The least squares spread one anchor's error over all: leave each out and see whether the others then agree. This
    # may be so for several, since a camera that is elsewhere explains much; wrong is the one without which the corners
    # fit best.
    agreeing: dict[int, tuple[float, float]] = {}
    if len(ids) > 2:
        for left_out in ids:
            rest = [pair for pair in seen if pair[0].id != left_out]
            found = _fit(rest, intrinsics)
            if found is None:
                continue
            if all(_worst_shift(id, rest, intrinsics, found[0]) <= CONTRADICTION / 2.0 for id in ids if id != left_out):
                agreeing[left_out] = found[2], _worst_shift(left_out, seen, intrinsics, found[0])
    if agreeing:
        id = min(agreeing, key=lambda key: agreeing[key])
        shift = agreeing[id][1]
        if shift > CONTRADICTION:
            others = [other for other in ids if other != id]
            raise PlacementError(
                f"anchor {id} is {shift:.2f} m away from where {listed(others)} put it, which agree with each "
                "other: check its id, size_mm, position_m and yaw_deg"
            )
        return
    if max(worst.values()) > CONTRADICTION / 2.0:
        shifts = ", ".join(f"{id} by {worst[id]:.2f} m" for id in ids)
        raise PlacementError(
            f"anchors contradict each other, and which is wrong cannot be told: {shifts} off the best common place; "
            "check their id, size_mm, position_m and yaw_deg"
        )


def _worst_shift(
    id: int, seen: Sequence[tuple[Anchor, MarkerSighting]], intrinsics: Intrinsics, world_from_camera: Array
) -> float:
    """How far, m, a corner of an anchor is seen from where it was surveyed, in the plane of its surveyed place."""
    camera = world_from_camera[:3, 3]
    worst = 0.0
    for anchor, sighting in seen:
        if anchor.id != id:
            continue
        surveyed = transform_points(anchor.world_from_marker, marker_corners(anchor.size))
        normal = anchor.world_from_marker[:3, 2]
        directions = rays(sighting.corners_px, intrinsics) @ world_from_camera[:3, :3].T
        slope = directions @ normal
        if (np.abs(slope) < 1e-6).any():
            return math.inf
        distance = ((surveyed - camera) @ normal) / slope
        seen_at = camera + distance[:, None] * directions
        worst = max(worst, float(np.linalg.norm(seen_at - surveyed, axis=1).max()))
    return worst


def listed(ids: Sequence[int], noun: str = "anchor") -> str:
    """In words: "anchors 40, 41"."""
    return f"{noun}{'s' * (len(ids) != 1)} {', '.join(map(str, ids))}"


# Standard deviations of what `survey` takes as known. Positions on the floor by a tape measure or a plan, m;
SURVEY_SIGMA = 0.005
# a distance between the middles of two sheets, by a tape measure, m;
TAPE_SIGMA = 0.003
# a sheet's height, m, and tilt, rad, on the floor; its yaw, rad, where it was surveyed;
SHEET_HEIGHT_SIGMA, SHEET_TILT_SIGMA, SHEET_YAW_SIGMA = 0.002, 0.005, math.radians(2.0)
# the size of all prints together, as a part of it: what is left of a printer's scale after measuring with a ruler.
PRINT_SIGMA = 0.003
# What defines the world is held so much more firmly than anything is measured, m.
_FIRMLY = 1e-6


@dataclass(frozen=True, slots=True)
class Tape:
    """A distance `length`, m, measured between the middles of two anchors."""

    first: int
    second: int
    length: float

    def __str__(self) -> str:
        return f"{self.first}-{self.second}"


@dataclass(frozen=True, slots=True)
class Survey:
    """Where cameras and anchors are.

    `placements` by camera. `anchors` with the places found, and `sigmas` of those on the floor, m, by id.
    `print_scale`: the true size of the markers over what they are said to have. `doubts`: sentences about what does
    not fit to the rest, by less than would be refused.
    """

    placements: Mapping[str, Placement]
    anchors: tuple[Anchor, ...]
    sigmas: Mapping[int, float]
    print_scale: float
    doubts: tuple[str, ...]


def averaged(looks: Sequence[Sequence[MarkerSighting]]) -> list[MarkerSighting]:
    """One sighting for each marker, its corners the mean over the frames of one camera: the camera stands still, its
    noise does not. The sigma stays that of one frame, since what is left is mostly bias.

    Raises PlacementError where a marker is seen in two places of one frame.
    """
    by_id: dict[int, list[MarkerSighting]] = {}
    for look in looks:
        for sighting in look:
            if any(sighting.id == other.id and sighting is not other for other in look):
                places = [other.corners_px.mean(axis=0) for other in look if other.id == sighting.id]
                words = " and ".join(f"{x:.0f}, {y:.0f} px" for x, y in places)
                raise PlacementError(
                    f"marker {sighting.id} is in the picture {len(places)} times, at {words}: two sheets with one id "
                    "cannot be told apart; take one away, or print it with another id"
                )
            by_id.setdefault(sighting.id, []).append(sighting)
    return [
        replace(same[-1], corners_px=np.mean([sighting.corners_px for sighting in same], axis=0))
        for same in by_id.values()
    ]


def survey(
    sightings: Sequence[MarkerSighting],
    anchors: Sequence[Anchor],
    intrinsics: Mapping[str, Intrinsics],
    tapes: Sequence[Tape] = (),
) -> Survey:
    """Solves for where all cameras and anchors are, by least squares over everything that is known of them.

    `intrinsics` by camera, for the cameras of the sightings; each marker at most once for each camera, see `averaged`.
    Without tapes the anchors are where they were surveyed, to SURVEY_SIGMA; a single one defines the world exactly.
    With tapes their surveyed places only say which way the world lies: the first anchor in view stays where it is, the
    second in its direction (along x where both are at one place), and distances come from the tapes.
    Raises PlacementError, which names the anchors or the tape concerned, if something is not in view, or contradicts
    the rest by more than CONTRADICTION.
    """
    by_id = {anchor.id: anchor for anchor in anchors}
    seen = [(by_id[sighting.id], sighting) for sighting in sightings if sighting.id in by_id]
    ids = [anchor.id for anchor in anchors if any(anchor.id == other.id for other, _ in seen)]
    for camera in intrinsics:
        if all(sighting.camera != camera for _, sighting in seen):
            others = sorted({sighting.id for sighting in sightings if sighting.camera == camera})
            raise PlacementError(
                f"camera {camera}: no anchor is in view: {listed(sorted(by_id))} expected, "
                f"{listed(others, 'marker') if others else 'no marker'} seen"
            )
    for tape in tapes:
        for id in (tape.first, tape.second):
            if id not in ids:
                raise PlacementError(
                    f"tape {tape}: anchor {id} is not in view"
                    + ("" if id in by_id else ", and not in the configuration")
                )
    by_camera = {camera: [pair for pair in seen if pair[1].camera == camera] for camera in intrinsics}
    if tapes:
        cameras, places = _layout(by_camera, intrinsics, [by_id[id] for id in ids])
    else:
        cameras, places = {}, {id: by_id[id].world_from_marker for id in ids}
        for camera, pairs in by_camera.items():
            # Says by itself what contradicts what.
            cameras[camera] = locate_camera([s for _, s in pairs], anchors, intrinsics[camera]).world_from_camera
    return _Problem([by_id[id] for id in ids], by_camera, intrinsics, tapes, cameras, places).solve()


def floor_sigma(placement: Placement, intrinsics: Intrinsics, points: Array) -> Array:
    """(n,) m: how well places on the floor, (n, 2) m, can be told from the picture: the standard deviation that the
    camera's place and its calibration leave, both directions taken together."""
    camera = placement.world_from_camera
    world = np.hstack([points, np.zeros((len(points), 1))])
    ray = world - camera[:3, 3]
    # A camera that is elsewhere by (dp, dtheta) carries the point with it; its ray meets the floor where it then does.
    carried = np.concatenate([np.broadcast_to(np.eye(3), (len(ray), 3, 3)), -np.stack([skew(r) for r in ray])], axis=2)
    onto_floor = np.broadcast_to(np.eye(3), (len(ray), 3, 3)).copy()
    onto_floor[:, :, 2] -= ray / ray[:, 2:]
    moved = (onto_floor @ carried)[:, :2]
    variance = np.trace(moved @ placement.covariance @ moved.transpose(0, 2, 1), axis1=1, axis2=2)
    if intrinsics.sigma_px > 0.0:
        _, by_point = project(transform_points(inverse(camera), world), intrinsics)
        floor_by_px = np.linalg.inv((by_point @ camera[:3, :3].T)[:, :, :2])
        variance = variance + intrinsics.sigma_px**2 * np.square(floor_by_px).sum(axis=(1, 2))
    sigma: Array = np.sqrt(variance)
    return sigma


def _layout(
    by_camera: Mapping[str, Sequence[tuple[Anchor, MarkerSighting]]],
    intrinsics: Mapping[str, Intrinsics],
    anchors: Sequence[Anchor],
) -> tuple[dict[str, Array], dict[int, Array]]:
    """A first guess of world_from_camera and world_from_marker where only heights are surveyed: from one marker's pose
    its plane, from the plane the others."""
    best: tuple[float, dict[str, Array], dict[int, Array]] | None = None
    for camera, pairs in by_camera.items():
        for anchor, sighting in pairs:
            flat = transform(np.eye(3), [0.0, 0.0, anchor.world_from_marker[2, 3]])
            for pose in marker_poses(sighting.corners_px, anchor.size, intrinsics[camera], sighting.sigma_px):
                world_from_camera = flat @ inverse(pose.camera_from_marker)
                places = _on_their_planes(pairs, intrinsics[camera], world_from_camera)
                if places is None:
                    continue
                cost = _misfit(pairs, intrinsics[camera], world_from_camera, places)
                if best is None or cost < best[0]:
                    best = cost, {camera: world_from_camera}, places
    if best is None:
        raise PlacementError(f"no place of the camera explains what it sees of {listed([a.id for a in anchors])}")
    _, cameras, places = best
    while missing := [camera for camera in by_camera if camera not in cameras]:
        found = None
        for camera in missing:
            known = [
                (replace(anchor, world_from_marker=places[anchor.id]), sighting)
                for anchor, sighting in by_camera[camera]
                if anchor.id in places
            ]
            if known and (found := _fit(known, intrinsics[camera])) is not None:
                cameras[camera] = found[0]
                places = (_on_their_planes(by_camera[camera], intrinsics[camera], found[0]) or {}) | places
                break
        if found is None:
            raise PlacementError(
                f"camera {missing[0]} sees no anchor that another camera sees: with tapes, put one where both see it"
            )
    # The world as the first two anchors say.
    wanted, there = (
        [anchor.world_from_marker[:2, 3] for anchor in anchors[:2]],
        [places[anchor.id][:2, 3] for anchor in anchors[:2]],
    )
    turn = _bearing(wanted[1] - wanted[0]) - _bearing(there[1] - there[0]) if len(anchors) > 1 else 0.0
    R = rotation_about_z(turn)
    world = transform(R, np.append(wanted[0] - R[:2, :2] @ there[0], 0.0))
    return (
        {camera: world @ pose for camera, pose in cameras.items()},
        {id: world @ place for id, place in places.items()},
    )


def _bearing(direction: Array) -> float:
    """0 for no direction at all."""
    return math.atan2(direction[1], direction[0])


def _on_their_planes(
    pairs: Sequence[tuple[Anchor, MarkerSighting]], intrinsics: Intrinsics, world_from_camera: Array
) -> dict[int, Array] | None:
    """world_from_marker of anchors that lie level at their surveyed heights, where they are seen."""
    places = {}
    camera = world_from_camera[:3, 3]
    for anchor, sighting in pairs:
        directions = rays(sighting.corners_px, intrinsics) @ world_from_camera[:3, :3].T
        height = anchor.world_from_marker[2, 3]
        if directions[:, 2].max() > -1e-3 or camera[2] <= height:
            return None
        corners = camera + ((height - camera[2]) / directions[:, 2])[:, None] * directions
        along = corners[1] - corners[0] + corners[2] - corners[3]
        places[anchor.id] = transform(rotation_about_z(_bearing(along)), corners.mean(axis=0))
    return places


def _misfit(
    pairs: Sequence[tuple[Anchor, MarkerSighting]],
    intrinsics: Intrinsics,
    world_from_camera: Array,
    places: Mapping[int, Array],
) -> float:
    """Squared px between where corners are seen and where they are expected."""
    camera_from_world = inverse(world_from_camera)
    return float(
        sum(
            np.square(
                project(
                    transform_points(camera_from_world @ places[anchor.id], marker_corners(anchor.size)), intrinsics
                )[0]
                - sighting.corners_px
            ).sum()
            for anchor, sighting in pairs
        )
    )


class _Problem:
    """The least squares of `survey`: cameras (6 unknowns each, as in `camera.fix`), anchors (6 each, of which what
    defines the world is held), and the scale of the print."""

    def __init__(
        self,
        anchors: Sequence[Anchor],
        by_camera: Mapping[str, Sequence[tuple[Anchor, MarkerSighting]]],
        intrinsics: Mapping[str, Intrinsics],
        tapes: Sequence[Tape],
        cameras: Mapping[str, Array],
        places: Mapping[int, Array],
    ) -> None:
        self._anchors = anchors
        self._by_camera = by_camera
        self._intrinsics = intrinsics
        self._tapes = tapes
        self._cameras = cameras
        self._places = places
        self._at_camera = {camera: slice(6 * k, 6 * k + 6) for k, camera in enumerate(cameras)}
        start = 6 * len(cameras)
        self._at_anchor = {anchor.id: slice(start + 6 * k, start + 6 * k + 6) for k, anchor in enumerate(anchors)}
        self._size = start + 6 * len(anchors) + 1
        # Standard deviations of the unknowns' offsets before anything is seen: 0 held, inf free.
        on_floor = math.inf if tapes else SURVEY_SIGMA
        yaw = math.inf if tapes else SHEET_YAW_SIGMA
        self._prior = np.full(self._size, math.inf)
        for at in self._at_anchor.values():
            self._prior[at] = (on_floor, on_floor, SHEET_HEIGHT_SIGMA, SHEET_TILT_SIGMA, SHEET_TILT_SIGMA, yaw)
        first = self._at_anchor[anchors[0].id].start
        if tapes or len(anchors) == 1:
            self._prior[first : first + 2] = 0.0
        if len(anchors) == 1:
            self._prior[first + 5] = 0.0
        self._prior[-1] = PRINT_SIGMA
        self._free = self._prior > 0.0
        self._believed = self._free & np.isfinite(self._prior)

    def solve(self) -> Survey:
        found = least_squares(lambda x: self._residuals(self._whole(x)), np.zeros(self._free.sum()), x_scale="jac")
        x, J, residuals = self._whole(found.x), found.jac, found.fun
        try:
            inner = np.linalg.inv(J.T @ J)
        except np.linalg.LinAlgError:
            raise PlacementError("the anchors in view do not determine where the camera is: put down more") from None
        covariance = np.zeros((self._size, self._size))
        covariance[np.ix_(self._free, self._free)] = inner
        doubts = self._doubts(x, covariance, residuals, J)
        misfit, freedom = 2.0 * found.cost, len(residuals) - len(found.x)
        if freedom > 0 and misfit > chi_square_limit(freedom):
            covariance *= misfit / freedom
        placements = {}
        for camera, at in self._at_camera.items():
            seen = self._by_camera[camera]
            off = np.concatenate(
                [self._corners_px(x, camera, anchor) - sighting.corners_px for anchor, sighting in seen]
            )
            placements[camera] = Placement(
                _moved(self._cameras[camera], x[at]),
                covariance[at, at],
                math.sqrt(float(np.mean(np.square(off).sum(axis=1)))),
                tuple(sorted(anchor.id for anchor, _ in seen)),
                self._intrinsics[camera].fingerprint,
            )
        return Survey(
            placements,
            tuple(replace(anchor, world_from_marker=self._place(x, anchor.id)) for anchor in self._anchors),
            {id: math.sqrt(np.trace(covariance[at, at][:2, :2])) for id, at in self._at_anchor.items()},
            1.0 + float(x[-1]),
            doubts,
        )

    def _whole(self, free: Array) -> Array:
        x = np.zeros(self._size)
        x[self._free] = free
        return x

    def _place(self, x: Array, id: int) -> Array:
        return _moved(self._places[id], x[self._at_anchor[id]])

    def _corners_px(self, x: Array, camera: str, anchor: Anchor) -> Array:
        camera_from_world = inverse(_moved(self._cameras[camera], x[self._at_camera[camera]]))
        corners = marker_corners(anchor.size * (1.0 + x[-1]))
        points = transform_points(camera_from_world @ self._place(x, anchor.id), corners)
        return project(points, self._intrinsics[camera])[0]

    def _residuals(self, x: Array) -> Array:
        """Everything over its standard deviation; the tapes first."""
        rows = [(self._length(x, tape) - tape.length) / TAPE_SIGMA for tape in self._tapes]
        if self._tapes and len(self._anchors) > 1:
            first, second = self._anchors[:2]
            wanted = _bearing(second.world_from_marker[:2, 3] - first.world_from_marker[:2, 3])
            dx, dy, _ = self._place(x, second.id)[:3, 3] - self._place(x, first.id)[:3, 3]
            rows.append((dy * math.cos(wanted) - dx * math.sin(wanted)) / _FIRMLY)
        parts = [np.array(rows), x[self._believed] / self._prior[self._believed]]
        for camera, seen in self._by_camera.items():
            for anchor, sighting in seen:
                sigma = math.hypot(sighting.sigma_px, self._intrinsics[camera].sigma_px)
                parts.append(((self._corners_px(x, camera, anchor) - sighting.corners_px) / sigma).ravel())
        return np.concatenate(parts)

    def _length(self, x: Array, tape: Tape) -> float:
        return float(np.linalg.norm(self._place(x, tape.first)[:3, 3] - self._place(x, tape.second)[:3, 3]))

    def _doubts(self, x: Array, covariance: Array, residuals: Array, J: Array) -> tuple[str, ...]:
        """What does not fit to the rest by more than chance, the likeliest culprit alone: its error pulls at all.

        Each thing is compared with what everything else says of it. Raises PlacementError where that is beyond
        CONTRADICTION.
        """
        # Statistic over its limit, error in m, sentence
        found: list[tuple[float, float, str]] = []

        def compare(at: slice, size: float, words: Callable[[Array], str]) -> None:
            """Unknowns with a prior, against what the posterior would be without it (the information form)."""
            prior = np.diag(np.square(self._prior[at]))
            posterior = np.linalg.inv(covariance[at, at])
            information = posterior - np.linalg.inv(prior)
            if np.linalg.eigvalsh(information).min() < 1e-6 * np.linalg.eigvalsh(posterior).max():
                return  # nothing else says anything of it
            others = np.linalg.inv(information)
            off = others @ posterior @ x[at]
            statistic = float(off @ np.linalg.solve(others + prior, off))
            found.append((statistic / chi_square_limit(len(off)), size * float(np.linalg.norm(off)), words(off)))

        scale = slice(self._size - 1, self._size)
        largest = max(anchor.size for anchor in self._anchors)
        compare(
            scale,
            largest,
            lambda off: (
                f"the markers are {100.0 * (1.0 + off[0]):.1f} % as large as size_mm says: measure the black squares"
            ),
        )
        for anchor in self._anchors:
            at = self._at_anchor[anchor.id]
            if np.isfinite(self._prior[at.start]) and self._prior[at.start] > 0.0:
                others = [other.id for other in self._anchors if other is not anchor]
                compare(
                    slice(at.start, at.start + 2),
                    1.0,
                    lambda off, id=anchor.id, others=others: (  # type: ignore[misc]
                        f"anchor {id} is {1e3 * np.linalg.norm(off):.0f} mm from where {listed(others)} put"
                        f"{'s' * (len(others) == 1)} it: measure its position again"
                    ),
                )
        for k, tape in enumerate(self._tapes):
            left = 1.0 - float(J[k] @ np.linalg.inv(J.T @ J) @ J[k])
            if left > 1e-6:
                off = -residuals[k] / left * TAPE_SIGMA
                found.append(
                    (
                        residuals[k] ** 2 / left / chi_square_limit(1),
                        abs(off),
                        f"tape {tape} says {1e3 * tape.length:.0f} mm, everything else "
                        f"{1e3 * (tape.length - off):.0f} mm: measure it again, from middle to middle",
                    )
                )
        statistic, error, words = max(found, default=(0.0, 0.0, ""))
        if statistic <= 1.0:
            return ()
        if error > CONTRADICTION:
            raise PlacementError(words)
        return (words,)


def _moved(a_from_b: Array, by: Array) -> Array:
    """A pose perturbed by (position, rotation) along the axes of a."""
    return transform(exp_so3(by[3:]) @ a_from_b[:3, :3], a_from_b[:3, 3] + by[:3])
