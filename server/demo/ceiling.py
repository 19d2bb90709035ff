"""The demo room's camera, whose frames are rendered: in the service's process, or as a remote camera in one of its own.

`python -m server.demo.ceiling --server ws://...` is the latter: its standard input are the robots' places, a line
`robot t x y yaw` each, and it ends with them. Its clock is its own, as that of another machine would be.
"""

from __future__ import annotations

import argparse
import asyncio
import math
import os
import random
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from camera.calibration import load_intrinsics
from camera.capture import Frame, FrameSource
from camera.images import Image
from camera.synthetic import Room, straight_down
from fusion.geometry import exp_so3, rotation_about_z, transform
from fusion.measurements import Array
from server.camera_messages import CameraWelcome
from server.camera_node import Node
from server.config import Config, parse
from server.demo.robot import DeviceClock
from server.demo.truth import Truth, place
from server.terminal import log_to_stderr, until_stopped

FOLDER = Path(__file__).parent
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


def room_config(serial_port: str) -> Config:
    """room.toml, with the name of the serial port."""
    text = (FOLDER / "room.toml").read_text(encoding="utf-8").replace("SERIAL_PORT", serial_port)
    return parse(text, name="the demo room's room.toml", folder=FOLDER)


class DemoCamera:
    """A frame source as `camera.capture` has them: what a camera on the ceiling sees of the room.

    `light`: 1 for a well-lit room, less for a darker one.
    """

    def __init__(self, truth: Truth, config: Config, seed: int, light: float = 1.0) -> None:
        self._truth = truth
        self._light = light
        self._random = random.Random(seed)
        camera = config.camera[0]
        self._picture = Room(load_intrinsics(camera.calibration), WORLD_FROM_CAMERA, camera.dictionary, seed)
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
            if not self._truth.wait_until(start + EXPOSURE + 0.06):
                return None
            if self._random.random() < LOST_FRAMES:
                continue
            image = self._render(start)
            middle = start + 0.5 * EXPOSURE
            if not self._truth.wait_until(middle + self._random.uniform(*DELAY)):
                return None
            return Frame(middle + self._random.gauss(0.0, STAMP_ERROR), image, self._sequence, EXPOSURE)
        return None

    def close(self) -> None:
        """See FrameSource."""
        self._closed = True

    def _render(self, start: float) -> Image:
        markers = dict(self._anchors)
        for name, id, size, body_from_marker in self._robots:
            places = [self._truth.at(name, t) for t in (start, start + EXPOSURE)]
            poses = [
                transform(rotation_about_z(yaw), [x, y, 0.0]) @ body_from_marker for x, y, yaw in filter(None, places)
            ]
            # A robot that is not switched on yet, or any more, is not in the room.
            if len(poses) == 2:
                markers[id] = size, poses[0], poses[1]
        # Clouds pass before the sun.
        brightness = self._light * (1.0 + 0.1 * math.sin(0.3 * start))
        return self._picture.render(markers, noise=3.0, brightness=brightness)


class _OwnClock:
    """A source whose stamps are by another clock."""

    def __init__(self, source: FrameSource, clock: DeviceClock) -> None:
        self._source = source
        self._clock = clock

    def read(self, timeout: float) -> Frame | None:
        frame = self._source.read(timeout)
        return None if frame is None else replace(frame, t=self._clock.at(frame.t))

    def close(self) -> None:
        self._source.close()


def _listen(truth: Truth) -> None:
    """Take in what comes on standard input, until it ends."""
    partial = b""
    # Not sys.stdin, whose lock a daemon thread would hold when the interpreter ends.
    while data := os.read(0, 65536):
        *lines, partial = (partial + data).split(b"\n")
        for line in lines:
            robot, _, rest = line.partition(b" ")
            truth.append(robot.decode(), [place(rest)])
    truth.stop()


async def _main(args: argparse.Namespace) -> None:
    truth = Truth()
    threading.Thread(target=_listen, args=(truth,), daemon=True).start()
    config = room_config("/dev/none")
    clock = DeviceClock(f"ceiling {args.seed}")

    def open_here(welcome: CameraWelcome) -> FrameSource:
        return _OwnClock(DemoCamera(truth, config, args.seed, args.light), clock)

    await until_stopped(Node(args.server, config.camera[0].name, open_here, clock=clock).run())


def main() -> None:
    parser = argparse.ArgumentParser(description="The simulated camera of the demo room, as a remote camera.")
    parser.add_argument("--server", required=True, help="of the service, such as ws://127.0.0.1:5678")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--light", type=float, default=1.0)
    log_to_stderr()
    asyncio.run(_main(parser.parse_args()))


if __name__ == "__main__":
    main()
