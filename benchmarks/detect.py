"""Detection and pose per frame, beside what one writes first: OpenCV's default detector and IPPE_SQUARE.

    .venv/bin/python -m benchmarks.detect

Rendered frames of 1088 x 1088 px with six 4X4_50 markers of 30 to 60 px, one thread. All see the same frames in turn,
so that the ratio holds on a busy machine too.
"""

from __future__ import annotations

import statistics
import time

import cv2
import numpy as np

from camera.calibration import Intrinsics
from camera.fix import MarkerMount, marker_corners, solve
from camera.markers import MarkerDetector
from camera.synthetic import Room, straight_down
from fusion.geometry import exp_so3, rotation_about_z, transform

FRAMES = 30
INTRINSICS = Intrinsics(
    np.array([[900.0, 0.0, 543.5], [0.0, 900.0, 543.5], [0.0, 0.0, 1.0]]),
    np.array([-0.12, 0.04, 0.0005, -0.0003, 0.0]),
    1088,
    1088,
)
WORLD_FROM_CAMERA = straight_down(0.0, 0.0, 3.0)
LIGHTS = {
    "clean": {},
    "noise 6": {"noise": 6.0},
    "blur 2.5 px": {"blur_px": 2.5},
    "12 % light": {"brightness": 0.12},
}


def main() -> None:
    """Prints a table: milliseconds of processor time, markers found and corner error, of each way."""
    cv2.setNumThreads(1)
    print(f"{'light':12} {'way':28} {'ms/frame':>9} {'ratio':>6} {'found':>8} {'corner error px':>16}")
    for name, light in LIGHTS.items():
        random = np.random.default_rng(1)
        room = Room(INTRINSICS, WORLD_FROM_CAMERA, "4X4_50", 1)
        plain = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50))
        stream, search = MarkerDetector("4X4_50", ids=range(6)), MarkerDetector("4X4_50")
        ways = ("default + IPPE_SQUARE", "Steadfix, stream + planar", "Steadfix, search + planar")
        times: dict[str, list[float]] = {way: [] for way in ways}
        errors: dict[str, list[float]] = {way: [] for way in ways}
        for _ in range(FRAMES):
            markers = {}
            for id in range(6):
                size = random.uniform(30.0, 60.0) * 2.9 / 900.0
                place = [(id % 3 - 1) * 1.0 + random.uniform(-0.2, 0.2), (id // 3 - 0.5) * 1.4, 0.1]
                pose = transform(
                    rotation_about_z(random.uniform(-3.0, 3.0)) @ exp_so3(random.normal(0, 0.02, 3)), place
                )
                markers[id] = (size, pose, pose)
            image = room.render(markers, **light)
            truth = {id: room.corners_px(size, pose) for id, (size, pose, _) in markers.items()}
            sizes = {id: size for id, (size, _, _) in markers.items()}
            for way, found, spent in (
                (ways[0], *_default(plain, image, sizes)),
                (ways[1], *_steadfix(stream.detect, image, sizes)),
                (ways[2], *_steadfix(search.search, image, sizes)),
            ):
                times[way].append(spent)
                errors[way] += [float(np.mean((found[id] - truth[id]) ** 2)) for id in found if id in truth]
        base = statistics.median(times[ways[0]])
        for way in ways:
            milliseconds = statistics.median(times[way])
            rms = np.sqrt(np.mean(errors[way])) if errors[way] else float("nan")
            print(
                f"{name:12} {way:28} {1000 * milliseconds:9.1f} {base / milliseconds:6.2f} "
                f"{len(errors[way]):4d}/{6 * FRAMES} {rms:15.3f}"
            )


def _default(detector, image, sizes):
    begin = time.process_time()
    corners, ids, _ = detector.detectMarkers(image)
    found = {} if ids is None else {int(id): c[0] for id, c in zip(ids.ravel(), corners, strict=True)}
    for id, seen in found.items():
        if id in sizes:
            cv2.solvePnPGeneric(
                marker_corners(sizes[id]), seen, INTRINSICS.camera_matrix, INTRINSICS.distortion,
                flags=cv2.SOLVEPNP_IPPE_SQUARE,
            )  # fmt: skip
    return found, time.process_time() - begin


def _steadfix(look, image, sizes):
    begin = time.process_time()
    sightings = look(image)
    for sighting in sightings:
        mount = MarkerMount(sighting.id, sizes[sighting.id], transform(np.eye(3), [0.0, 0.0, 0.1]))
        solve("robot", [mount], [sighting], INTRINSICS, WORLD_FROM_CAMERA, planar=True, arrival=0.0)
    return {sighting.id: sighting.corners_px for sighting in sightings}, time.process_time() - begin


if __name__ == "__main__":
    main()
