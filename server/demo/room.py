"""The demo room: what there would be in front of the service, were it real.

Three robots, each a process of its own (`server.demo.robot`), that reach the service over WebSocket or a serial line,
and a ceiling camera whose frames are rendered. The robots print the truth on their standard output; it goes to the
camera and to the score, and to nobody else.
"""

from __future__ import annotations

import math
import os
import random
import selectors
import subprocess
import sys
import threading
import time
import tty
from bisect import bisect_left
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from operator import itemgetter
from pathlib import Path

import numpy as np

from camera.calibration import load_intrinsics
from camera.capture import Frame
from camera.markers import Image
from camera.synthetic import Room, straight_down
from fusion.geometry import exp_so3, rotation_about_z, transform, wrap
from fusion.measurements import Array, Pose
from server.config import CameraConfig, Config, parse

FOLDER = Path(__file__).parent
# Which course each robot of room.toml drives.
COURSES = {"rover": "eight", "scout": "rectangle", "mule": "stops"}
# Where the camera really hangs: not where anybody measured it, and not quite straight.
WORLD_FROM_CAMERA = straight_down(0.06, -0.05, 3.0, yaw=0.05) @ transform(exp_so3([0.025, -0.015, 0.0]), np.zeros(3))
# m: how far the anchors lie from where the configuration says; a tape measure is no better.
SURVEY_ERROR = 0.001
# s: between frames, of one exposure, from its middle until the frame is delivered, and the error of a frame's stamp.
FRAME_INTERVAL = (0.28, 0.42)
EXPOSURE = 0.008
DELAY = (0.10, 0.25)
STAMP_ERROR = 0.001
# The share of frames that get lost on their way.
LOST_FRAMES = 0.03
# s of truth that are kept; it comes each 10 ms.
HISTORY = 5.0

# t, x, y, yaw
Truth = tuple[float, float, float, float]
# robot, t, position (3,), quaternion wxyz (4,)
RecordTruth = Callable[[str, float, Array, Array], None]


class DemoRoom:
    """The room, for a service that runs in this process:

        room = DemoRoom()                                   # makes the pty of the serial line
        service = Service(room.config(), recording, room.open_camera, room.score)
        room.record_truth = recorder.truth                  # if there is a recording
        room.start(f"ws://127.0.0.1:{service.port}")        # as soon as the service listens: the robots
        room.stop()
        print(room.report())

    `score` and `report` are for one thread, the service's. `record_truth(robot, t, position, quaternion_wxyz)` is
    called for each line of truth, 100 a second and robot, in a thread of the room.
    The robots end with this process however it ends, since nobody reads their truth any more.
    """

    def __init__(self, record_truth: RecordTruth | None = None, seed: int = 1) -> None:
        self.record_truth = record_truth
        self._seed = seed
        self._robots: dict[str, subprocess.Popen[bytes]] = {}
        self._truth: dict[str, list[Truth]] = {name: [] for name in COURSES}
        self._news = threading.Condition()
        self._scores = {name: _Score() for name in COURSES}
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._listen, name="demo room", daemon=True)
        # Both ends stay open here until `stop`: as with a real port, the line is there while nobody listens.
        self._line: tuple[int, ...] = os.openpty()
        tty.setraw(self._line[1])
        self.serial_port = os.ttyname(self._line[1])

    def config(self) -> Config:
        """room.toml, with the name of this room's serial port."""
        text = (FOLDER / "room.toml").read_text(encoding="utf-8").replace("SERIAL_PORT", self.serial_port)
        return parse(text, name="the demo room's room.toml", folder=FOLDER)

    def open_camera(self, config: CameraConfig) -> DemoCamera:
        """The frame source, in place of `camera.capture.open_source`."""
        return DemoCamera(self, self.config(), Path(config.calibration), self._seed)

    def start(self, url: str) -> None:
        """Switch the robots on. `url`: of the service, such as ws://127.0.0.1:5678."""
        for robot in self.config().robot:
            serial = robot.imu.source == self.serial_port
            way = ["--serial-fd", str(self._line[0])] if serial else ["--url", url]
            self._robots[robot.name] = subprocess.Popen(
                [sys.executable, "-m", "server.demo.robot", "--name", robot.name, "--course", COURSES[robot.name]]
                + ["--seed", str(self._seed), *way],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                pass_fds=self._line[:1] if serial else (),
                # Ctrl-C is for the service, which ends the robots.
                process_group=0,
            )
        self._thread.start()

    def stop(self) -> None:
        """End the robots, the camera and the line. May be called twice."""
        self._stopping.set()
        with self._news:
            self._news.notify_all()
        for robot in self._robots.values():
            robot.terminate()
        for robot in self._robots.values():
            try:
                robot.wait(timeout=2.0)
            except subprocess.TimeoutExpired:
                robot.kill()
                robot.wait()
        if self._thread.ident is not None:
            self._thread.join()
        for robot in self._robots.values():
            assert robot.stdout is not None
            robot.stdout.close()
        for fd in self._line:
            os.close(fd)
        self._line = ()

    def _listen(self) -> None:
        """Read what the robots print, until all have ended."""
        with selectors.DefaultSelector() as selector:
            partial = dict.fromkeys(self._robots, b"")
            for name, robot in self._robots.items():
                assert robot.stdout is not None
                selector.register(robot.stdout, selectors.EVENT_READ, name)
            while selector.get_map():
                for key, _ in selector.select():
                    data = os.read(key.fd, 65536)
                    if not data:
                        selector.unregister(key.fileobj)
                        continue
                    *lines, partial[key.data] = (partial[key.data] + data).split(b"\n")
                    self._append(key.data, [_truth(line) for line in lines])

    def _append(self, robot: str, lines: list[Truth]) -> None:
        with self._news:
            kept = self._truth[robot]
            kept.extend(lines)
            if kept and kept[-1][0] - kept[0][0] > 2.0 * HISTORY:
                del kept[: len(kept) // 2]
            self._news.notify_all()
        if self.record_truth is not None:
            for t, x, y, yaw in lines:
                half = 0.5 * yaw
                self.record_truth(robot, t, np.array([x, y, 0.0]), np.array([math.cos(half), 0.0, 0.0, math.sin(half)]))

    def at(self, robot: str, t: float) -> tuple[float, float, float] | None:
        """(x, y, yaw) of a robot at `t`, m and rad; None for a time that is not known, or not yet."""
        with self._news:
            truth = self._truth[robot]
            i = bisect_left(truth, t, key=itemgetter(0))
            if not 0 < i < len(truth):
                return None
            (t0, *a), (t1, *b) = truth[i - 1], truth[i]
        s = (t - t0) / (t1 - t0)
        x, y, yaw = (u + s * (v - u) for u, v in zip(a, b, strict=True))
        return x, y, yaw

    def wait_until(self, t: float) -> bool:
        """Sleep until `t`; False if the room is stopped meanwhile."""
        return not self._stopping.wait(max(0.0, t - time.monotonic()))

    def score(self, pose: Pose) -> None:
        """Take a published pose in. It is compared once the truth of its time is known."""
        score = self._scores[pose.robot]
        score.waiting.append((pose.t, float(pose.position[0]), float(pose.position[1]), float(pose.yaw)))
        while score.waiting:
            t, x, y, yaw = score.waiting[0]
            if (truth := self.at(pose.robot, t)) is None:
                # Older than all that is kept, or than the robot: never to be known.
                if t > time.monotonic() - HISTORY:
                    break
            else:
                score.add(t, x - truth[0], y - truth[1], wrap(yaw - truth[2]))
            score.waiting.popleft()

    def report(self) -> str:
        """A table: how far the published poses were from the truth."""
        lines = [
            "published poses against the simulation's truth",
            f"{'robot':8}{'poses':>8}{'RMSE':>10}{'worst':>10}{'RMSE':>10}{'worst':>10}{'largest step':>15}"
            f"{'longest gap':>14}",
            f"{'':8}{'':8}{'mm':>10}{'mm':>10}{'deg':>10}{'deg':>10}{'mm':>15}{'ms':>14}",
        ]
        for name, score in self._scores.items():
            if score.count == 0:
                lines.append(f"{name:8}{0:8}   no pose")
                continue
            lines.append(
                f"{name:8}{score.count:8}"
                f"{1e3 * math.sqrt(score.position_squares / score.count):10.1f}{1e3 * score.position_worst:10.1f}"
                f"{math.degrees(math.sqrt(score.yaw_squares / score.count)):10.2f}{math.degrees(score.yaw_worst):10.2f}"
                f"{1e3 * score.step:15.1f}{1e3 * score.gap:14.0f}"
            )
        lines.append("step: between two published poses, beyond what the robot moved")
        return "\n".join(lines)


@dataclass
class _Score:
    """Of one robot: sums over its published poses, m and rad. `waiting`: poses whose truth has not come yet."""

    waiting: deque[Truth] = field(default_factory=deque)
    count: int = 0
    position_squares: float = 0.0
    position_worst: float = 0.0
    yaw_squares: float = 0.0
    yaw_worst: float = 0.0
    step: float = 0.0
    gap: float = 0.0
    _last: tuple[float, float, float] | None = None

    def add(self, t: float, dx: float, dy: float, dyaw: float) -> None:
        error = math.hypot(dx, dy)
        self.count += 1
        self.position_squares += error * error
        self.position_worst = max(self.position_worst, error)
        self.yaw_squares += dyaw * dyaw
        self.yaw_worst = max(self.yaw_worst, abs(dyaw))
        if self._last is not None:
            before, x, y = self._last
            self.step = max(self.step, math.hypot(dx - x, dy - y))
            self.gap = max(self.gap, t - before)
        self._last = t, dx, dy


class DemoCamera:
    """A frame source as `camera.capture` has them: what a camera on the ceiling sees of the room."""

    def __init__(self, room: DemoRoom, config: Config, calibration: Path, seed: int) -> None:
        self._room = room
        self._random = random.Random(seed)
        self._picture = Room(load_intrinsics(calibration), WORLD_FROM_CAMERA, config.camera[0].dictionary, seed)
        self._robots = [
            (
                robot.name,
                marker.id,
                marker.size_mm / 1000.0,
                transform(rotation_about_z(math.radians(marker.yaw_deg)), marker.position_m),
            )
            for robot in config.robot
            for marker in robot.marker
        ]
        self._anchors: dict[int, tuple[float, Array, Array]] = {}
        for anchor in config.anchor:
            slip = [self._random.gauss(0.0, SURVEY_ERROR), self._random.gauss(0.0, SURVEY_ERROR), 0.0]
            there = transform(rotation_about_z(math.radians(anchor.yaw_deg)), np.add(anchor.position_m, slip))
            self._anchors[anchor.id] = anchor.size_mm / 1000.0, there, there
        self._sequence = 0
        self._next = time.monotonic()
        self._closed = False

    def read(self, timeout: float) -> Frame | None:
        """The next frame when it is delivered; None once the room has stopped. `timeout` is not needed: frames come."""
        while not self._closed:
            start = max(self._next, time.monotonic())
            self._next = start + self._random.uniform(*FRAME_INTERVAL)
            self._sequence += 1
            # Until the robots have told where they were, which they do each 25 ms.
            if not self._room.wait_until(start + EXPOSURE + 0.06):
                return None
            if self._random.random() < LOST_FRAMES:
                continue
            image = self._render(start)
            middle = start + 0.5 * EXPOSURE
            if not self._room.wait_until(middle + self._random.uniform(*DELAY)):
                return None
            return Frame(middle + self._random.gauss(0.0, STAMP_ERROR), image, self._sequence)
        return None

    def close(self) -> None:
        self._closed = True

    def _render(self, start: float) -> Image:
        markers = dict(self._anchors)
        for name, id, size, body_from_marker in self._robots:
            places = [self._room.at(name, t) for t in (start, start + EXPOSURE)]
            poses = [
                transform(rotation_about_z(yaw), [x, y, 0.0]) @ body_from_marker for x, y, yaw in filter(None, places)
            ]
            # A robot that is not switched on yet, or any more, is not in the room.
            if len(poses) == 2:
                markers[id] = size, poses[0], poses[1]
        # Clouds pass before the sun.
        return self._picture.render(markers, noise=3.0, brightness=1.0 + 0.1 * math.sin(0.3 * start))


def _truth(line: bytes) -> Truth:
    t, x, y, yaw = map(float, line.split())
    return t, x, y, yaw
