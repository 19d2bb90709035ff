"""Finding markers and making fixes of them, beside what one writes first: OpenCV's default detector and IPPE_SQUARE.

    .venv/bin/python -m benchmarks.camera [--frames 20] [--long]

Rendered frames of 1088 x 1088 px with 4X4_50 markers of 30 to 60 px under a camera 3 m up, one thread. All see the same
frames in turn and processor time is counted, so that the ratios hold on a busy machine too. In each frame the robots
are anywhere; `tracking` is told where, as a filter knows it, to 4 mm and 0.6 deg, `searching` knows nothing but which
ids there are and how large they appear. Steadfix's times are of all that the service does with a frame: prediction,
detection, planar fixes.
"""

from __future__ import annotations

import argparse
import math
import resource
import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import cv2
import numpy as np

from camera import planar
from camera.calibration import Intrinsics
from camera.fix import Body, MarkerMount, marker_corners, predict, solve
from camera.images import Image
from camera.markers import MarkerSighting
from camera.synthetic import Room, straight_down
from camera.tracking import MarkerTracker
from fusion.consistency import chi2_bounds, nees
from fusion.geometry import (
    exp_so3,
    log_so3,
    quaternion_from_rotation,
    rotation_about_z,
    rotation_from_quaternion,
    transform,
)
from fusion.measurements import Array, Mode, Pose, PoseFix

INTRINSICS = Intrinsics(
    np.array([[900.0, 0.0, 543.5], [0.0, 900.0, 543.5], [0.0, 0.0, 1.0]]),
    np.array([-0.12, 0.04, 0.0005, -0.0003, 0.0]),
    1088,
    1088,
)
WORLD_FROM_CAMERA = straight_down(0.0, 0.0, 3.0)
BODY_FROM_MARKER = transform(np.eye(3), [0.0, 0.0, 0.1])
PX_PER_M = 900.0 / 2.9
SIDES_PX = (30.0, 60.0)
RATE_HZ = 30.0
LOOKS = 5
# What the filter knows of a moving robot between two fixes, m and rad.
POSITION_SIGMA, YAW_SIGMA = 0.004, 0.01
# A marker counts as found with its id and its middle within this of the truth, px.
FOUND_PX = 5.0

# Light and lens as `Room.render` takes them; `moved`: px during the exposure; `shadow`: how bright it is in there.
CLEAN = {"noise 2": {"noise": 2.0}, "noise 3": {"noise": 3.0}, "noise 6": {"noise": 6.0}}
DEGRADED: dict[str, dict[str, float]] = {
    "blur 8 px": {"noise": 3.0, "moved": 8.0},
    "blur 12 px": {"noise": 3.0, "moved": 12.0},
    "12 % light": {"noise": 3.0, "brightness": 0.12},
    "dark, shadow, blur": {"noise": 3.0, "brightness": 0.35, "shadow": 0.4, "moved": 5.0},
    "defocus": {"noise": 3.0, "blur_px": 3.5},
}


def sizes(count: int) -> dict[int, float]:
    """Side of each marker, m."""
    return {id: side / PX_PER_M for id, side in enumerate(np.linspace(*SIDES_PX, count).tolist())}


def places(random: np.random.Generator, count: int, uneven: bool = False) -> dict[int, Array]:
    """world_from_body of robots on a grid, anyhow turned; `uneven`: on a floor as the planar solve supposes it."""
    columns, rows = (3, 2) if count == 6 else (6, 3)
    poses = {}
    for id in range(count):
        x, y = (id % columns - 0.5 * (columns - 1)) * 3.0 / columns, (id // columns - 0.5 * (rows - 1)) * 2.8 / rows
        z, tilt = 0.0, np.zeros(3)
        if uneven:
            z, tilt[:2] = random.normal(0.0, planar.FLOOR_HEIGHT_SIGMA), random.normal(0.0, planar.FLOOR_TILT_SIGMA, 2)
        R = rotation_about_z(random.uniform(-math.pi, math.pi)) @ exp_so3(tilt)
        poses[id] = transform(R, [x + random.uniform(-0.1, 0.1), y + random.uniform(-0.1, 0.1), z])
    return poses


def picture(
    room: Room, random: np.random.Generator, poses: Mapping[int, Array], light: Mapping[str, float]
) -> tuple[Image, dict[int, Array]]:
    """A frame, and where the corners are in the middle of its exposure."""
    light = dict(light)
    heading, moved = random.uniform(-math.pi, math.pi), light.pop("moved", 0.0) / PX_PER_M
    shadow = light.pop("shadow", 1.0)
    half = transform(np.eye(3), [0.5 * moved * math.cos(heading), 0.5 * moved * math.sin(heading), 0.0])
    side = sizes(len(poses))
    markers, truth = {}, {}
    for id, pose in poses.items():
        middle = pose @ BODY_FROM_MARKER
        markers[id] = (side[id], np.linalg.inv(half) @ middle, half @ middle) if moved else (side[id], middle, middle)
        truth[id] = room.corners_px(side[id], middle)
    image = room.render(markers, **light)
    if shadow < 1.0:
        # Its edge, which is soft, runs across the picture.
        x, y = np.meshgrid(np.arange(1088), np.arange(1088))
        inside = 1.0 / (1.0 + np.exp(-(x + 0.6 * y - 850.0) / 6.0))
        image = (image * (1.0 - (1.0 - shadow) * inside)).astype(np.uint8)
    return image, truth


def believed(random: np.random.Generator, poses: Mapping[int, Array]) -> dict[str, Pose]:
    """Where a filter believes the robots to be: off by as much as it says."""
    covariance = np.diag([POSITION_SIGMA**2, POSITION_SIGMA**2, 1e-8, 1e-8, 1e-8, YAW_SIGMA**2])
    still: dict[str, Any] = {"velocity": np.zeros(3), "angular_velocity": np.zeros(3), "velocity_covariance": np.eye(3)}
    known = {}
    for id, pose in poses.items():
        dx, dy, dyaw = random.normal(0.0, [POSITION_SIGMA, POSITION_SIGMA, YAW_SIGMA]).tolist()
        quaternion = quaternion_from_rotation(rotation_about_z(dyaw) @ pose[:3, :3])
        position = pose[:3, 3] + [dx, dy, 0.0]
        known[str(id)] = Pose.of(
            str(id), 0.0, position, quaternion, covariance=covariance, mode=Mode.FULL, reset_id=0, fix_age=0.0, **still
        )
    return known


class Default:
    """What one writes first."""

    def __init__(self, sizes: Mapping[int, float]) -> None:
        self._detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50))
        self._sizes = sizes

    def see(self, image: Image) -> dict[int, Array]:
        corners, ids, _ = self._detector.detectMarkers(image)
        found = {} if ids is None else {int(id): c[0] for id, c in zip(ids.ravel(), corners, strict=True)}
        for id, seen in found.items():
            if id in self._sizes:
                cv2.solvePnPGeneric(
                    marker_corners(self._sizes[id]),
                    seen,
                    INTRINSICS.camera_matrix,
                    INTRINSICS.distortion,
                    flags=cv2.SOLVEPNP_IPPE_SQUARE,
                )
        return found


class Steadfix:
    """What the service does with a frame."""

    def __init__(self, sizes: Mapping[int, float]) -> None:
        self._bodies = [
            Body(str(id), [MarkerMount(id, size, BODY_FROM_MARKER)], planar=True) for id, size in sizes.items()
        ]
        self.fixes: list[PoseFix] = []
        self.t = 0.0
        self.tracker = MarkerTracker("4X4_50", list(sizes))
        self.tracker.sides_px = SIDES_PX

    def search(self, image: Image) -> dict[int, Array]:
        """As when nothing was seen for a minute."""
        self.t += 60.0
        return self.see(image)

    def see(self, image: Image, poses: Mapping[str, Pose] | None = None) -> dict[int, Array]:
        self.t += 1.0 / RATE_HZ
        predictions = predict(self._bodies, poses or {}, INTRINSICS, WORLD_FROM_CAMERA)
        sightings = self.tracker.track(image, self.t, "ceiling", predictions)
        self.fixes = solve(self._bodies, sightings, INTRINSICS, WORLD_FROM_CAMERA, arrival=self.t)
        return {sighting.id: sighting.corners_px for sighting in sightings}


@dataclass
class Tally:
    """What one way did: s of processor time of each frame, markers there were, found, and seen where there are none,
    and the mean squared corner error of each that was found, px²."""

    times: list[float] = field(default_factory=list)
    there: int = 0
    found: int = 0
    false: int = 0
    squares: list[float] = field(default_factory=list)

    def add(self, truth: Mapping[int, Array], seen: Mapping[int, Array], spent: float) -> None:
        """One frame, in which the markers are where `truth` says."""
        self.times.append(spent)
        self.there += len(truth)
        for id, corners in seen.items():
            if id not in truth or np.linalg.norm((corners - truth[id]).mean(axis=0)) > FOUND_PX:
                self.false += 1
                continue
            self.found += 1
            self.squares.append(float(np.mean(np.square(corners - truth[id]))))

    def row(self, name: str, way: str, base: Tally) -> str:
        spent, default = statistics.median(self.times), statistics.median(base.times)
        error = math.sqrt(statistics.fmean(self.squares)) if self.squares else math.nan
        return (
            f"{name:20} {way:10} {1e3 * spent:9.2f} {default / spent:7.1f} {self.found:6}/{self.there:<5} "
            f"{self.false:6} {error:16.3f}"
        )


def compare(name: str, count: int, light: Mapping[str, float], frames: int, seed: int = 1) -> None:
    """Prints a row for each way. Each frame is looked at LOOKS times by all in turn; what counts is what the first look
    finds, and the time of the fastest, since the others' differ by what else the machine does.

    Before each degraded frame `tracking` has seen a clean one: a robot's marker was sharp before the light went or the
    robot sped up.
    """
    random, room = np.random.default_rng(seed), Room(INTRINSICS, WORLD_FROM_CAMERA, "4X4_50", seed)
    default, tracking, searching = Default(sizes(count)), Steadfix(sizes(count)), Steadfix(sizes(count))
    tallies = {"default": Tally(), "tracking": Tally(), "searching": Tally()}
    for k in range(frames):
        if k == 0 or name in DEGRADED:
            before = places(random, count)
            tracking.see(picture(room, random, before, {})[0], believed(random, before))
        poses = places(random, count)
        image, truth = picture(room, random, poses, light)
        known = believed(random, poses)
        ways: dict[str, Callable[[], dict[int, Array]]] = {
            "default": partial(default.see, image),
            "tracking": partial(tracking.see, image, known),
            "searching": partial(searching.search, image),
        }
        looks = [{way: timed(see) for way, see in ways.items()} for _ in range(LOOKS)]
        for way, tally in tallies.items():
            tally.add(truth, looks[0][way][0], min(look[way][1] for look in looks))
    for way, tally in tallies.items():
        print(tally.row(name, way, tallies["default"]))


def timed(see: Callable[[], dict[int, Array]]) -> tuple[dict[int, Array], float]:
    """What is seen, and the s of processor time that it took."""
    begin = time.process_time()
    seen = see()
    return seen, time.process_time() - begin


def fix_noise(frames: int) -> None:
    """Prints how far fixes are from the truth on clean frames, where the floor is level and nothing else is wrong."""
    random, room = np.random.default_rng(2), Room(INTRINSICS, WORLD_FROM_CAMERA, "4X4_50", 2)
    way, errors = Steadfix(sizes(6)), []
    for _ in range(frames):
        poses = places(random, 6)
        way.see(picture(room, random, poses, {"noise": 3.0})[0], believed(random, poses))
        errors += [error(found, poses[int(found.robot)]) for found in way.fixes]
    x, y, yaw = np.sqrt(np.mean(np.square(errors), axis=0))[[0, 1, 5]].tolist()
    print(f"fixes on clean frames: {1e3 * math.hypot(x, y):.3f} mm, {math.degrees(yaw):.3f} deg RMS")


def fix_honesty(frames: int) -> None:
    """Prints whether fixes are as far off as they say, where corners, floor and camera are as much so as supposed."""
    random, room = np.random.default_rng(6), Room(INTRINSICS, WORLD_FROM_CAMERA, "4X4_50", 6)
    placement = np.diag([2e-3, 2e-3, 3e-3, 1e-3, 1e-3, 5e-4]) ** 2
    side, errors, covariances = sizes(6), [], []
    bodies = [Body(str(id), [MarkerMount(id, size, BODY_FROM_MARKER)], planar=True) for id, size in side.items()]
    for _ in range(frames):
        poses = places(random, 6, uneven=True)
        for body, pose in zip(bodies, poses.values(), strict=True):
            corners = room.corners_px(side[int(body.name)], pose @ BODY_FROM_MARKER) + random.normal(0.0, 0.1, (4, 2))
            off = random.multivariate_normal(np.zeros(6), placement)
            hung = transform(exp_so3(off[3:]) @ WORLD_FROM_CAMERA[:3, :3], WORLD_FROM_CAMERA[:3, 3] + off[:3])
            sighting = MarkerSighting(0.0, "ceiling", int(body.name), corners, 0.1)
            (found,) = solve([body], [sighting], INTRINSICS, hung, arrival=0.0, placement_covariance=placement)
            errors.append(error(found, pose))
            covariances.append(found.hypotheses[0].covariance)
    low, high = chi2_bounds(6.0, len(errors))
    mean = float(nees(np.array(errors), np.array(covariances)).mean())
    print(f"NEES of {len(errors)} planar fixes: {mean:.2f}; 95 % bounds {low:.2f} to {high:.2f}")


def error(found: PoseFix, pose: Array) -> Array:
    """(6,) position and rotation, world axes."""
    best = found.hypotheses[0]
    turn = log_so3(rotation_from_quaternion(best.quaternion_wxyz) @ pose[:3, :3].T)
    return np.concatenate([best.position - pose[:3, 3], turn])


def false_locks(frames: int) -> None:
    """Prints how often a robot is seen that has gone, where its filter still believes it to be."""
    random = np.random.default_rng(3)
    way, wrong = Steadfix(sizes(6)), 0
    for k in range(frames):
        if k % 50 == 0:
            room = Room(INTRINSICS, WORLD_FROM_CAMERA, "4X4_50", 100 + k)
            empty = [room.render({}, noise=3.0, brightness=brightness) for brightness in (1.0, 0.12)]
        if k % 10 == 0:
            there = places(random, 6)
            way.search(picture(room, random, there, {})[0])
        # Within the time for which edges alone would do
        wrong += len(way.see(empty[k % 2], believed(random, places(random, 6))))
    print(f"robots that have gone, seen in {frames} frames: {wrong} of {6 * frames}")


def false_ids(frames: int) -> None:
    """Prints how many markers a search finds on textures without any."""
    random, wrong, default_wrong = np.random.default_rng(4), 0, 0
    searching, default = Steadfix(sizes(6)), Default(sizes(6))
    for _ in range(frames):
        image = texture(random)
        wrong += len(searching.search(image))
        default_wrong += len(default.see(image).keys() & sizes(6).keys())
    print(f"false ids of a whitelist of six on {frames} textures: {wrong}, by the default detector {default_wrong}")


def texture(random: np.random.Generator) -> Image:
    """Noise at many scales, with rectangles and lines thrown in."""
    image = np.full((1088, 1088), 128.0, np.float32)
    for cells in (8, 32, 128, 272):
        coarse = random.normal(0.0, random.uniform(5.0, 40.0), (cells, cells)).astype(np.float32)
        image += cv2.resize(
            coarse, (1088, 1088), interpolation=int(random.choice([cv2.INTER_NEAREST, cv2.INTER_CUBIC]))
        )
    for _ in range(200):
        corner, side = random.integers(0, 1088, 2), random.integers(5, 80, 2)
        cv2.rectangle(image, corner.tolist(), (corner + side).tolist(), float(random.uniform(0, 255)), -1)
    return np.clip(image + random.normal(0.0, 3.0, image.shape), 0, 255).astype(np.uint8)


def at_rest(frames: int) -> None:
    """Prints the share of the default's time that a room takes in which nothing moves, and what memory grows by."""
    random, room = np.random.default_rng(5), Room(INTRINSICS, WORLD_FROM_CAMERA, "4X4_50", 5)
    poses = places(random, 6)
    images = [picture(room, random, poses, {"noise": 3.0})[0] for _ in range(10)]
    default, way = Default(sizes(6)), Steadfix(sizes(6))
    known = believed(random, poses)
    times: dict[str, list[float]] = {"default": [], "tracking": []}
    for image in images:
        way.see(image, known)
    for k in range(300):
        begin = time.process_time()
        default.see(images[k % 10])
        between = time.process_time()
        way.see(images[k % 10], known)
        times["default"].append(between - begin)
        times["tracking"].append(time.process_time() - between)
    share = statistics.fmean(times["tracking"]) / statistics.fmean(times["default"])
    print(f"at rest: {100 * share:.1f} % of the default detector's time")
    for k in range(frames):
        if k == frames // 10:
            before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        way.see(images[k % 10], known)
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    print(f"memory after {frames} frames: {grown / 1024:+.1f} MiB since frame {frames // 10}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=20, help="of each row")
    parser.add_argument(
        "--long", action="store_true", help="also what takes some minutes: false locks, false ids, memory"
    )
    args = parser.parse_args()
    cv2.setNumThreads(1)
    print(f"{'frames':20} {'way':10} {'ms/frame':>9} {'ratio':>7} {'found':>9} {'false':>9} {'corner error px':>16}")
    for name, light in CLEAN.items():
        compare(name, 6, light, args.frames)
    compare("noise 3, 18 markers", 18, CLEAN["noise 3"], args.frames)
    for name, light in DEGRADED.items():
        compare(name, 6, light, args.frames)
    fix_noise(args.frames)
    fix_honesty(10 * args.frames)
    at_rest(10_000 if args.long else 1_000)
    if args.long:
        false_locks(1_000)
        false_ids(200)


if __name__ == "__main__":
    main()
