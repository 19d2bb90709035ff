"""`steadfix detect`: the markers in image files, and their poses where camera and size are known."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np

from camera.calibration import Intrinsics, load_intrinsics
from camera.capture import read_image
from camera.dictionaries import DICTIONARIES, DictionaryError
from camera.edges import SIGMA_UNREFINED_PX, warm_up
from camera.fix import MarkerPose, marker_poses
from camera.images import Pixels, grey
from camera.markers import MarkerDetector, MarkerSighting
from fusion.geometry import quaternion_from_rotation


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the command's arguments."""
    parser.add_argument("images", nargs="+", metavar="IMAGE", help="image files")
    parser.add_argument(
        "--dictionary", required=True, metavar="NAME", help=f"of the markers, one of {', '.join(DICTIONARIES)}"
    )
    parser.add_argument("--camera", metavar="CAMERA.toml", help="calibration of the camera, for poses")
    parser.add_argument("--size-mm", type=float, metavar="S", help="side of the markers' black square, for poses")
    parser.add_argument(
        "--overlay", type=Path, metavar="FOLDER", help="draw what was seen over each image, as a PNG in this folder"
    )
    parser.add_argument("--json", action="store_true", help="one JSON object per image, one a line")


def run(args: argparse.Namespace) -> int:
    """Runs the command. Returns 0; 1 if an image could not be used, the others are done all the same; 2 for arguments
    that cannot be followed."""
    try:
        detector = MarkerDetector(args.dictionary)
        if (args.camera is None) != (args.size_mm is None):
            raise ValueError("poses need both --camera and --size-mm")
        if args.size_mm is not None and not 0.0 < args.size_mm < float("inf"):
            raise ValueError(f"--size-mm {args.size_mm:g}: a length above zero is needed")
        intrinsics = None if args.camera is None else load_intrinsics(args.camera)
        overlays = _overlays(args.images, args.overlay)
    except DictionaryError as error:
        return _fail(f"--dictionary: {error}", 2)
    except ValueError as error:
        return _fail(str(error), 2)
    except OSError as error:
        return _fail(f"{error.filename}: {error.strerror or error}", 2)
    # Not in the time that is told for the first image.
    warm_up()
    size = None if args.size_mm is None else args.size_mm / 1000.0
    failed = False
    for path, overlay in zip(args.images, overlays, strict=True):
        try:
            content = _detect(path, detector, intrinsics, size, overlay)
        except (OSError, ValueError) as error:
            failed = True
            _fail(str(error) if str(error).startswith(path) else f"{path}: {error}", 1)
            content = {"image": path, "markers": [], "error": str(error)}
            if not args.json:
                continue
        sys.stdout.write(msgspec.json.encode(content).decode() + "\n" if args.json else _text(content))
        sys.stdout.flush()
    return 1 if failed else 0


def _detect(
    path: str, detector: MarkerDetector, intrinsics: Intrinsics | None, size: float | None, overlay: Path | None
) -> dict[str, Any]:
    """What is printed of one image. `ms` is the time of detection and poses, without reading and writing files."""
    image = read_image(path)
    if intrinsics is not None:
        intrinsics.check_size(image.shape[1], image.shape[0])
    begin = time.perf_counter()
    sightings = detector.search(image)
    markers = [_marker(sighting, intrinsics, size) for sighting in sightings]
    content = {"image": path, "markers": markers, "ms": round(1000.0 * (time.perf_counter() - begin), 2)}
    if overlay is not None:
        encoded = cv2.imencode(".png", _drawn(image, sightings))[1]
        overlay.write_bytes(encoded.tobytes())
        content["overlay"] = str(overlay)
    return content


def _overlays(images: Sequence[str], folder: Path | None) -> list[Path | None]:
    """The file for each image's overlay. Names never clash, neither with each other nor with the image's own."""
    if folder is None:
        return [None] * len(images)
    folder.mkdir(parents=True, exist_ok=True)
    paths: list[Path | None] = []
    for image in images:
        path, count = folder / f"{Path(image).stem}-markers.png", 1
        while path in paths:
            count += 1
            path = folder / f"{Path(image).stem}-markers-{count}.png"
        paths.append(path)
    return paths


def _drawn(image: Pixels, sightings: Sequence[MarkerSighting]) -> Pixels:
    """The image in colour with each marker's outline, first corner and id: green, orange if its edges are unclear."""
    colour = image.ndim == 3 and image.shape[2] == 3 and image.dtype == np.uint8
    picture = image.copy() if colour else cv2.cvtColor(grey(image), cv2.COLOR_GRAY2BGR)
    width = max(1, round(max(image.shape[:2]) / 1000))
    for sighting in sightings:
        tint = (0, 200, 0) if sighting.sigma_px < SIGMA_UNREFINED_PX else (0, 128, 255)
        # Sixteenths of a pixel, see `shift`.
        corners = np.rint(16.0 * sighting.corners_px).astype(np.int32)
        cv2.polylines(picture, [corners], True, tint, width, cv2.LINE_AA, shift=4)
        cv2.circle(picture, corners[0].tolist(), 16 * 3 * width, tint, -1, cv2.LINE_AA, shift=4)
        x, y = int(sighting.corners_px[:, 0].max()) + 4 * width, int(sighting.corners_px[:, 1].mean())
        for thickness, shade in ((4 * width, (255, 255, 255)), (width, (0, 0, 200))):
            cv2.putText(
                picture, str(sighting.id), (x, y), cv2.FONT_HERSHEY_SIMPLEX, 0.7 * width, shade, thickness, cv2.LINE_AA
            )
    return np.asarray(picture)


def _marker(sighting: MarkerSighting, intrinsics: Intrinsics | None, size: float | None) -> dict[str, Any]:
    content: dict[str, Any] = {
        "id": sighting.id,
        "corners_px": np.round(sighting.corners_px, 3).tolist(),
        "sigma_px": round(sighting.sigma_px, 3),
    }
    if intrinsics is not None and size is not None:
        poses = marker_poses(sighting.corners_px, size, intrinsics, sighting.sigma_px)
        content["poses"] = [_pose(pose) for pose in poses]
    return content


def _pose(pose: MarkerPose) -> dict[str, Any]:
    """camera_from_marker; `sigma_m` along the camera's axes."""
    position = pose.camera_from_marker[:3, 3]
    return {
        "position_m": np.round(position, 6).tolist(),
        "orientation_wxyz": np.round(quaternion_from_rotation(pose.camera_from_marker[:3, :3]), 6).tolist(),
        "distance_m": round(float(np.linalg.norm(position)), 6),
        "sigma_m": np.round(np.sqrt(np.diag(pose.covariance)[:3]), 6).tolist(),
        "sigma_rad": np.round(np.sqrt(np.diag(pose.covariance)[3:]), 6).tolist(),
        "misfit": round(pose.misfit, 3),
        "rms_px": round(pose.rms_px, 4),
    }


def _text(content: dict[str, Any]) -> str:
    """The same for people."""
    count = len(content["markers"])
    lines = [f"{content['image']}: {count or 'no'} marker{'s' * (count != 1)}, {content['ms']:.0f} ms"]
    for marker in content["markers"]:
        corners = "  ".join(f"{x:.2f},{y:.2f}" for x, y in marker["corners_px"])
        lines.append(f"  id {marker['id']:<4} corners {corners} px (sigma {marker['sigma_px']:.2f})")
        for k, pose in enumerate(marker.get("poses", [])):
            x, y, z = pose["position_m"]
            w, i, j, l = pose["orientation_wxyz"]
            lines.append(
                f"    pose {k + 1}: at {x:+.4f} {y:+.4f} {z:+.4f} m, distance {pose['distance_m']:.4f} m, "
                f"orientation wxyz {w:+.4f} {i:+.4f} {j:+.4f} {l:+.4f}, rms {pose['rms_px']:.2f} px"
            )
    return "\n".join(lines) + "\n"


def _fail(text: str, status: int) -> int:
    sys.stderr.write(f"steadfix detect: {text}\n")
    return status
