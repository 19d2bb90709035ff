"""`steadfix detect`: the markers in image files, and their poses where camera and size are known."""

from __future__ import annotations

import argparse
import sys
import time
from typing import Any

import msgspec
import numpy as np

from camera.calibration import Intrinsics, load_intrinsics
from camera.capture import read_image
from camera.fix import MarkerPose, marker_poses
from camera.markers import DICTIONARIES, DictionaryError, MarkerDetector, MarkerSighting
from fusion.geometry import quaternion_from_rotation


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the command's arguments."""
    parser.add_argument("images", nargs="+", metavar="IMAGE", help="image files")
    parser.add_argument(
        "--dictionary", required=True, metavar="NAME", help=f"of the markers, one of {', '.join(DICTIONARIES)}"
    )
    parser.add_argument("--camera", metavar="CAMERA.toml", help="calibration of the camera, for poses")
    parser.add_argument("--size-mm", type=float, metavar="S", help="side of the markers' black square, for poses")
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
    except DictionaryError as error:
        return _fail(f"--dictionary: {error}", 2)
    except ValueError as error:
        return _fail(str(error), 2)
    except OSError as error:
        return _fail(f"{args.camera}: {error.strerror or error}", 2)
    size = None if args.size_mm is None else args.size_mm / 1000.0
    failed = False
    for path in args.images:
        try:
            content = _detect(path, detector, intrinsics, size)
        except (OSError, ValueError) as error:
            failed = True
            _fail(str(error) if str(error).startswith(path) else f"{path}: {error}", 1)
            content = {"image": path, "markers": [], "error": str(error)}
            if not args.json:
                continue
        sys.stdout.write(msgspec.json.encode(content).decode() + "\n" if args.json else _text(content))
        sys.stdout.flush()
    return 1 if failed else 0


def _detect(path: str, detector: MarkerDetector, intrinsics: Intrinsics | None, size: float | None) -> dict[str, Any]:
    """What is printed of one image. `ms` is the time of detection and poses, without reading the file."""
    image = read_image(path)
    if intrinsics is not None:
        intrinsics.check_size(image.shape[1], image.shape[0])
    begin = time.perf_counter()
    markers = [_marker(sighting, intrinsics, size) for sighting in detector.search(image)]
    return {"image": path, "markers": markers, "ms": round(1000.0 * (time.perf_counter() - begin), 2)}


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
