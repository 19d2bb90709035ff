"""`steadfix floor`: where the cameras of a configuration hang, from the anchors in view and, if there are any, tape
distances between them."""

from __future__ import annotations

import argparse
import datetime
import math
import re
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from camera.boards import BoardError, parse_length
from camera.calibration import Intrinsics, load_intrinsics
from camera.capture import read_image
from camera.fix import project, rays
from camera.floor import Placement, Survey, Tape, averaged, floor_sigma, save_placement, survey
from camera.images import Pixels
from camera.markers import MarkerDetector, MarkerSighting
from fusion.geometry import inverse, quaternion_from_rotation, transform_points, yaw_of
from fusion.measurements import Array
from server.cameras import configured_anchor, open_configured
from server.config import CameraConfig, Config, ConfigError, load
from server.frames import READ_TIMEOUT

# Frames of a live camera whose corners are averaged, and s after which a camera that sees no anchor is given up.
FRAMES, PATIENCE = 20, 30.0
# m: steps that the grid of errors may have, and what of the floor is too far away to matter.
_STEPS, _FAR = (0.1, 0.25, 0.5, 1.0, 2.0, 5.0), 20.0
_COLUMNS = 11


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the command's arguments."""
    parser.add_argument("config", type=Path, metavar="CONFIG.toml", help="with the cameras and the anchors")
    parser.add_argument("images", nargs="*", metavar="IMAGE", help="pictures by the camera, instead of the live one")
    parser.add_argument("--camera", metavar="NAME", help="only this one; without it all that the configuration has")
    parser.add_argument(
        "--tape",
        action="append",
        default=[],
        type=_tape,
        metavar="ID-ID:LENGTH",
        help="a distance between the middles of two anchors, such as 40-41:2003mm; with these, only ids, sizes and "
        "heights of the anchors are taken from the configuration, and the way from the first to the second",
    )
    parser.add_argument(
        "--out",
        type=Path,
        metavar="PLACEMENT.toml",
        help="the file to write; without it what `placement` names, else NAME-placement.toml beside the configuration",
    )
    parser.add_argument("--json", action="store_true", help="print the result as one JSON object")


def run(args: argparse.Namespace) -> int:
    """Runs the command. Returns 0. Raises ConfigError, CalibrationError, PlacementError and OSError."""
    config = load(args.config)
    cameras = _cameras(args, config)
    intrinsics = {camera.name: load_intrinsics(camera.calibration) for camera in cameras}
    sightings: list[MarkerSighting] = []
    for camera in cameras:
        try:
            detector = MarkerDetector(camera.dictionary, [anchor.id for anchor in config.anchor])
        except ValueError as error:
            raise ConfigError(f'camera "{camera.name}": {error}') from None
        watch = _Watch(camera.name, intrinsics[camera.name], detector)
        if args.images:
            for path in args.images:
                watch.see(read_image(path))
        else:
            _watch_live(camera, watch)
        sightings += averaged(watch.looks)
    found = survey(sightings, [configured_anchor(anchor) for anchor in config.anchor], intrinsics, args.tape)
    files = {camera.name: args.out or _file(camera, args.config) for camera in cameras}
    for name, placement in found.placements.items():
        comment = f'Where camera "{name}" hangs, by `steadfix floor` on {datetime.date.today()}.'
        save_placement(files[name], placement, comment)
    floors = {name: _floor(placement, intrinsics[name]) for name, placement in found.placements.items()}
    if args.json:
        sys.stdout.write(msgspec.json.encode(_content(found, floors, files)).decode() + "\n")
    else:
        for name, placement in found.placements.items():
            sys.stdout.write(_text(name, placement, floors[name]))
        if args.tape:
            sys.stdout.write(_tapes(found, args.tape) + _anchor_sections(found, config))
    sys.stdout.flush()
    for doubt in found.doubts:
        _say(f"DOUBT: {doubt}")
    if args.tape:
        _say(f"put the [[anchor]] sections above into {args.config}, in place of its own")
    for camera in cameras:
        _say(f"{files[camera.name]} is written")
        if not camera.placement:
            _say(
                f'for the service to use it, add to [[camera]] "{camera.name}": placement = "{files[camera.name].name}"'
            )
    return 0


def _tape(text: str) -> Tape:
    match = re.fullmatch(r"\s*(\d{1,5})-(\d{1,5}):(.+)", text)
    try:
        if match is None or match[1] == match[2]:
            raise BoardError(f"{text!r} is no distance between two anchors; 40-41:2003mm is")
        return Tape(int(match[1]), int(match[2]), parse_length(match[3]))
    except BoardError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def _cameras(args: argparse.Namespace, config: Config) -> list[CameraConfig]:
    """Those asked for. Raises ConfigError where that is none, or not to be told."""
    cameras = [camera for camera in config.camera if args.camera in (None, camera.name)]
    names = ", ".join(camera.name for camera in config.camera) or "none"
    if not cameras:
        what = "no camera" if args.camera is None else f'no camera "{args.camera}"'
        raise ConfigError(f"{args.config}: {what} in the configuration; there: {names}")
    if not config.anchor:
        raise ConfigError(f"{args.config}: no [[anchor]] section: a marker on the floor tells where the camera is")
    if len(cameras) > 1 and (args.images or args.out is not None):
        raise ConfigError(f"pictures and --out are of one camera: choose it with --camera ({names})")
    for camera in cameras:
        if camera.source == "remote" and not args.images:
            raise ConfigError(
                f'camera "{camera.name}" is on another machine: take pictures with it there, and name them here'
            )
    return cameras


def _file(camera: CameraConfig, config: Path) -> Path:
    return Path(camera.placement) if camera.placement else config.with_name(f"{camera.name}-placement.toml")


class _Watch:
    """What one camera sees of the anchors, frame by frame; says it when it changes."""

    def __init__(self, name: str, intrinsics: Intrinsics, detector: MarkerDetector) -> None:
        self.looks: list[list[MarkerSighting]] = []
        self._name = name
        self._intrinsics = intrinsics
        self._detector = detector
        self._seen: set[int] | None = None

    def see(self, image: Pixels) -> bool:
        """Whether an anchor is in view. Raises CalibrationError for another image size."""
        self._intrinsics.check_size(image.shape[1], image.shape[0])
        look = self._detector.search(image, camera=self._name)
        ids = {sighting.id for sighting in look}
        if ids != self._seen:
            missing = sorted((self._detector.ids or frozenset()) - ids)
            words = f"camera {self._name} sees anchors {_listed(sorted(ids)) or '- none'}"
            _say(words + (f"; not in view: {_listed(missing)}" if missing else ""))
            self._seen = ids
        self.looks.append(look)
        return bool(look)


def _watch_live(camera: CameraConfig, watch: _Watch) -> None:
    """Look until enough frames have shown an anchor, or none has for long."""
    source = open_configured(camera)
    try:
        deadline = time.monotonic() + PATIENCE
        good = 0
        while good < FRAMES and time.monotonic() < deadline:
            frame = source.read(READ_TIMEOUT)
            if frame is None:
                break
            good += watch.see(frame.image)
    finally:
        source.close()


def _floor(placement: Placement, intrinsics: Intrinsics) -> Array:
    """(n, 3): x, y (m) on a grid over what the camera sees of the floor, and the error there, m."""
    camera = placement.world_from_camera
    width, height = intrinsics.width_px, intrinsics.height_px
    if not width:  # the calibration does not say: as far as is usual for a lens
        width, height = (2.0 * intrinsics.camera_matrix[:2, 2]).round().astype(int).tolist()
    reach = np.arange(-_FAR, _FAR + 1e-9, _STEPS[0]).round(3)
    x, y = np.meshgrid(reach + round(camera[0, 3]), reach + round(camera[1, 3]))
    world = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    points = transform_points(inverse(camera), world)
    # Far outside the picture a distortion's polynomial may lead back into it.
    slope = np.linalg.norm(points[:, :2], axis=1) / np.maximum(points[:, 2], 1e-6)
    corners = rays(np.array([[u, v] for u in (0.0, width) for v in (0.0, height)]), intrinsics)
    widest = 1.01 * np.linalg.norm(corners[:, :2], axis=1).max()
    world = world[(points[:, 2] > 1e-3) & (slope < widest)]
    pixels = project(transform_points(inverse(camera), world), intrinsics)[0]
    world = world[((pixels >= 0.0) & (pixels <= (width - 1, height - 1))).all(axis=1)]
    if not len(world):
        return np.zeros((0, 3))
    across = np.ptp(world[:, 0])
    step = next((step for step in _STEPS if across / step < _COLUMNS), _STEPS[-1])
    world = world[(np.abs(np.remainder(world[:, :2] / step + 0.5, 1.0) - 0.5) < 1e-6).all(axis=1)]
    return np.column_stack([world[:, :2], floor_sigma(placement, intrinsics, world[:, :2])])


def _content(found: Survey, floors: Mapping[str, Array], files: Mapping[str, Path]) -> dict[str, Any]:
    cameras = {}
    for name, placement in found.placements.items():
        sigma = np.sqrt(np.diag(placement.covariance))
        floor = floors[name]
        cameras[name] = {
            "position_m": placement.world_from_camera[:3, 3].round(5).tolist(),
            "orientation_wxyz": quaternion_from_rotation(placement.world_from_camera[:3, :3]).round(7).tolist(),
            "sigma_m": sigma[:3].round(5).tolist(),
            "sigma_deg": np.degrees(sigma[3:]).round(4).tolist(),
            "rms_px": round(placement.rms_px, 4),
            "anchors": list(placement.anchors_seen),
            "floor_mm": [[x, y, round(1e3 * error, 2)] for x, y, error in floor.tolist()],
            "written": str(files[name]),
        }
    anchors = [
        {
            "id": anchor.id,
            "position_m": anchor.world_from_marker[:3, 3].round(5).tolist(),
            "yaw_deg": round(math.degrees(yaw_of(anchor.world_from_marker[:3, :3])), 3),
            "sigma_mm": round(1e3 * found.sigmas[anchor.id], 2),
        }
        for anchor in found.anchors
    ]
    return {
        "cameras": cameras,
        "anchors": anchors,
        "print_scale": round(found.print_scale, 5),
        "doubts": list(found.doubts),
    }


def _text(name: str, placement: Placement, floor: Array) -> str:
    """The same for people."""
    ids = placement.anchors_seen
    x, y, z = placement.world_from_camera[:3, 3]
    sigma = 1e3 * np.sqrt(np.diag(placement.covariance)[:3])
    lines = [
        f"camera {name}: at {x:.3f} {y:.3f} {z:.3f} m, +- {sigma[0]:.0f} {sigma[1]:.0f} {sigma[2]:.0f} mm, from "
        f"anchor{'s' * (len(ids) != 1)} {_listed(ids)}, whose corners fit to {placement.rms_px:.2f} px"
    ]
    if len(ids) == 1:
        lines.append(
            "From one anchor alone: a quick start. Four near the corners of the area are several times as good."
        )
    if len(floor):
        errors = 1e3 * floor[:, 2]
        lines += [
            f"error on the floor: typically {np.median(errors):.1f} mm, at worst {errors.max():.1f} mm (one standard "
            "deviation; mm, north up)"
        ]
        columns = sorted(set(floor[:, 0]))
        by_place = {(x, y): error for x, y, error in floor.tolist()}
        for y in sorted(set(floor[:, 1]), reverse=True):
            cells = [f"{1e3 * by_place[x, y]:6.1f}" if (x, y) in by_place else " " * 6 for x in columns]
            lines.append(f"  y {y:6.2f} {''.join(cells)}")
        lines.append(f"       x  {''.join(f'{x:6.2f}' for x in columns)}")
    return "\n".join(lines) + "\n"


def _tapes(found: Survey, tapes: Sequence[Tape]) -> str:
    """What was measured, and what came of it."""
    at = {anchor.id: anchor.world_from_marker[:3, 3] for anchor in found.anchors}
    lines = [
        f"tape {tape}: {1e3 * tape.length:.0f} mm measured, "
        f"{1e3 * np.linalg.norm(at[tape.first] - at[tape.second]):.1f} mm found"
        for tape in tapes
    ]
    return "\n".join(lines) + "\n"


def _anchor_sections(found: Survey, config: Config) -> str:
    """The anchors for the configuration, as they were found."""
    sizes = {anchor.id: anchor.size_mm for anchor in config.anchor}
    lines = []
    for anchor in found.anchors:
        x, y, z = anchor.world_from_marker[:3, 3]
        lines += [
            "",
            "[[anchor]]",
            f"id = {anchor.id}",
            f"size_mm = {sizes[anchor.id]:g}",
            f"position_m = [{x:.4f}, {y:.4f}, {z:.4f}]   # +- {1e3 * found.sigmas[anchor.id]:.1f} mm on the floor",
            f"yaw_deg = {math.degrees(yaw_of(anchor.world_from_marker[:3, :3])):.2f}",
        ]
    return "\n".join(lines) + "\n"


def _listed(ids: Sequence[int]) -> str:
    return ", ".join(map(str, ids))


def _say(text: str) -> None:
    sys.stderr.write(f"steadfix floor: {text}\n")
    sys.stderr.flush()
