"""Where a camera hangs: world_from_camera from anchor markers at surveyed places, and its file.

The file is TOML, written by `steadfix floor`:

    world_from_camera = [[...], [...], [...], [0.0, 0.0, 0.0, 1.0]]     # 4 x 4, m
    covariance = [[...], ...]               # 6 x 6: position (m) and rotation (rad), along world axes
    anchors = [40, 41, 42, 43]              # that it was found from
    rms_px = 0.12                           # of their corners
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np

from camera.calibration import Intrinsics
from camera.fix import MarkerMount, View, chi_square_limit, marker_corners, rays, solve_six
from camera.markers import MarkerSighting
from fusion.geometry import inverse, skew, transform_points
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

    `covariance`: (6, 6), position and rotation, world axes. `rms_px`: of the anchors' corners.
    """

    world_from_camera: Array
    covariance: Array
    rms_px: float
    anchors_seen: tuple[int, ...]


class _File(msgspec.Struct, forbid_unknown_fields=True):
    world_from_camera: list[list[float]]
    covariance: list[list[float]]
    anchors: list[int]
    rms_px: float


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
    return Placement(pose, covariance, content.rms_px, tuple(content.anchors))


def save_placement(path: str | os.PathLike[str], placement: Placement, comment: str = "") -> None:
    """Writes a placement file that `load_placement` reads back exactly. Raises OSError if it cannot be written."""
    lines = [f"# {line}" for line in comment.splitlines()]
    for key, matrix in (("world_from_camera", placement.world_from_camera), ("covariance", placement.covariance)):
        lines += [f"{key} = [", *(f"    {row}," for row in matrix.tolist()), "]"]
    lines += [f"anchors = {list(placement.anchors_seen)}", f"rms_px = {placement.rms_px!r}"]
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
            f"no anchor is in view: {_listed(sorted(by_id))} expected, "
            f"{_listed(others, 'marker') if others else 'no marker'} seen"
        )
    found = _fit(seen, intrinsics)
    if found is None:
        raise PlacementError(f"no place of the camera explains what it sees of {_listed(ids)}: check size_mm and id")
    _check_consistent(seen, ids, intrinsics, found[0])
    world_from_camera, covariance, misfit = found
    corners = 4 * len(seen)
    rms_sigma = math.sqrt(misfit / corners)
    mean_sigma_px = math.sqrt(float(np.mean([sighting.sigma_px**2 for _, sighting in seen])))
    freedom = 2 * corners - 6
    widened = misfit / freedom if misfit > chi_square_limit(freedom) else 1.0
    return Placement(world_from_camera, covariance * widened, rms_sigma * mean_sigma_px, ids)


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
    # The least squares spread one anchor's error over all: leave each out and see whether the others then agree.
    agreeing: dict[int, float] = {}
    if len(ids) > 2:
        for left_out in ids:
            rest = [pair for pair in seen if pair[0].id != left_out]
            found = _fit(rest, intrinsics)
            if found is None:
                continue
            if all(_worst_shift(id, rest, intrinsics, found[0]) <= CONTRADICTION / 2.0 for id in ids if id != left_out):
                agreeing[left_out] = _worst_shift(left_out, seen, intrinsics, found[0])
    if agreeing:
        id = max(agreeing, key=lambda key: agreeing[key])
        if agreeing[id] > CONTRADICTION:
            others = [other for other in ids if other != id]
            raise PlacementError(
                f"anchor {id} is {agreeing[id]:.2f} m away from where {_listed(others)} put it, which agree with each "
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


def _listed(ids: Sequence[int], noun: str = "anchor") -> str:
    return f"{noun}{'s' * (len(ids) != 1)} {', '.join(map(str, ids))}"
