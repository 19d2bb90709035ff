"""The demo room: what there would be in front of the service, were it real.

Three robots, each a process of its own (`server.demo.robot`), that reach the service over WebSocket or a serial line,
and a ceiling camera whose frames are rendered. The robots print the truth on their standard output; it goes to the
camera and to the score, and to nobody else.
"""

from __future__ import annotations

import contextlib
import logging
import math
import os
import selectors
import subprocess
import sys
import threading
import time
import tty
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

import msgspec
import numpy as np

from fusion.geometry import wrap
from fusion.measurements import Array, Pose
from server.config import CameraConfig, Config
from server.demo.ceiling import DemoCamera, room_config
from server.demo.truth import HISTORY, Place, Truth, place

log = logging.getLogger("steadfix.demo")

# Which course each robot of room.toml drives.
COURSES = {"rover": "eight", "scout": "rectangle", "mule": "stops"}
# s after which the process of the remote camera is started again when it has ended, as systemd would.
RESTART = 2.0

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

    `remote_camera`: the camera is a process of its own and reaches the service over /v1/camera; `open_camera` is not
    used then. `light`: 1 for a well-lit room, less for a darker one.
    """

    def __init__(
        self,
        record_truth: RecordTruth | None = None,
        seed: int = 1,
        *,
        remote_camera: bool = False,
        light: float = 1.0,
    ) -> None:
        self.record_truth = record_truth
        self._seed = seed
        self._light = light
        self._remote_camera = remote_camera
        self._camera: subprocess.Popen[bytes] | None = None
        self._keeper: threading.Thread | None = None
        self._robots: dict[str, subprocess.Popen[bytes]] = {}
        self._truth = Truth()
        self._scores = {name: _Score() for name in COURSES}
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._listen, name="demo room", daemon=True)
        # Both ends stay open here until `stop`: as with a real port, the line is there while nobody listens.
        self._line: tuple[int, ...] = os.openpty()
        tty.setraw(self._line[1])
        self.serial_port = os.ttyname(self._line[1])

    def config(self) -> Config:
        """room.toml, with the name of this room's serial port, and the camera here or elsewhere."""
        config = room_config(self.serial_port)
        if not self._remote_camera:
            return config
        return msgspec.structs.replace(config, camera=(msgspec.structs.replace(config.camera[0], source="remote"),))

    def open_camera(self, config: CameraConfig) -> DemoCamera:
        """The frame source, in place of `camera.capture.open_source`."""
        return DemoCamera(self._truth, self.config(), self._seed, self._light)

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
        if self._remote_camera:
            self._keeper = threading.Thread(target=self._keep_camera, args=(url,), name="demo camera", daemon=True)
            self._keeper.start()

    def _keep_camera(self, url: str) -> None:
        """Run the camera's process, and again whenever it has ended."""
        command = [sys.executable, "-m", "server.demo.ceiling", "--server", url]
        command += ["--seed", str(self._seed), "--light", str(self._light)]
        while not self._stopping.is_set():
            camera = subprocess.Popen(command, stdin=subprocess.PIPE, process_group=0)
            assert camera.stdin is not None
            # A camera that hangs must not hold up the room.
            os.set_blocking(camera.stdin.fileno(), False)
            self._camera = camera
            log.info("the camera is process %d", camera.pid)
            status = camera.wait()
            self._camera = None
            camera.stdin.close()
            if not self._stopping.is_set():
                log.info("the camera's process has ended (%d) and is started again in %g s", status, RESTART)
            self._stopping.wait(RESTART)

    def stop(self) -> None:
        """End the robots, the camera and the line. May be called twice."""
        self._stopping.set()
        self._truth.stop()
        if (camera := self._camera) is not None:
            camera.terminate()
        if self._keeper is not None:
            self._keeper.join()
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
                    self._append(key.data, [place(line) for line in lines])

    def _append(self, robot: str, places: list[Place]) -> None:
        self._truth.append(robot, places)
        if (camera := self._camera) is not None and camera.stdin is not None and places:
            lines = "".join(f"{robot} {t!r} {x!r} {y!r} {yaw!r}\n" for t, x, y, yaw in places)
            # It hangs, or it has just ended.
            with contextlib.suppress(BlockingIOError, BrokenPipeError, ValueError):
                os.write(camera.stdin.fileno(), lines.encode())
        if self.record_truth is not None:
            for t, x, y, yaw in places:
                half = 0.5 * yaw
                self.record_truth(robot, t, np.array([x, y, 0.0]), np.array([math.cos(half), 0.0, 0.0, math.sin(half)]))

    def score(self, pose: Pose) -> None:
        """Take a published pose in. It is compared once the truth of its time is known."""
        score = self._scores[pose.robot]
        score.waiting.append((pose.t, float(pose.position[0]), float(pose.position[1]), float(pose.yaw)))
        while score.waiting:
            t, x, y, yaw = score.waiting[0]
            if (truth := self._truth.at(pose.robot, t)) is None:
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

    waiting: deque[Place] = field(default_factory=deque)
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
