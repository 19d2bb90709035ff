"""The service in a test's own loop, and what a test puts in front of it."""

from __future__ import annotations

import asyncio
import contextlib
import json
import math
import shutil
import subprocess
import time
import urllib.error
import urllib.request
from collections.abc import AsyncIterator, Callable, Coroutine, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from websockets.asyncio.client import ClientConnection, connect

from camera.calibration import Intrinsics
from camera.capture import Frame
from camera.images import Image
from camera.synthetic import Room, straight_down
from fusion.geometry import exp_so3, inverse, rotation_about_z, transform
from fusion.measurements import Array, PoseFix, PoseHypothesis
from server.app import Service
from server.config import CameraConfig, Config, parse

CONFIG = """
[server]
port = 0
pose_rate_hz = 100
[[robot]]
name = "rover"
[[robot.marker]]
id = 7
size_mm = 140
position_m = [0.0, 0.0, 0.1]
[[robot]]
name = "cart"
[[robot.marker]]
id = 8
size_mm = 140
"""
CAMERA = """
[[camera]]
name = "ceiling"
source = "nothing.mp4"
calibration = "camera.toml"
[[anchor]]
id = 40
size_mm = 180
position_m = [0.6, -0.6, 0.0]
[[anchor]]
id = 41
size_mm = 180
position_m = [-0.6, 0.6, 0.0]
"""
INTRINSICS = Intrinsics(np.array([[500.0, 0.0, 319.5], [0.0, 500.0, 239.5], [0.0, 0.0, 1.0]]), np.zeros(5), 640, 480)


def run(main: Callable[[], Coroutine[Any, Any, None]]) -> None:
    async def limited() -> None:
        async with asyncio.timeout(60.0):
            await main()

    asyncio.run(limited())


@contextlib.asynccontextmanager
async def serving(config: str | Config = CONFIG, **arguments: Any) -> AsyncIterator[Service]:
    async with Service(parse(config) if isinstance(config, str) else config, **arguments) as service:
        await service.ready.wait()
        yield service


@contextlib.asynccontextmanager
async def beside(work: Coroutine[Any, Any, None]) -> AsyncIterator[None]:
    """Work that goes on meanwhile."""
    task = asyncio.create_task(work)
    try:
        yield
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task


def client(service: Service, path: str) -> connect:
    return connect(
        f"ws://127.0.0.1:{service.port}{path}", compression=None, proxy=None, ping_interval=None, max_queue=None
    )


async def heard(connection: ClientConnection, kind: str = "") -> dict[str, Any]:
    """The next message of a type."""
    async for data in connection:
        message: dict[str, Any] = json.loads(data)
        if not kind or message["type"] == kind:
            return message
    raise AssertionError(f"the connection closed before a {kind} came")


async def hello(connection: ClientConnection, robot: str = "rover", pose_rate_hz: float = 0.0) -> dict[str, Any]:
    await connection.send(json.dumps({"type": "hello", "robot": robot, "pose_rate_hz": pose_rate_hz}))
    return await heard(connection)


def make_certificate(folder: Path) -> tuple[str, str]:
    """As the README makes one, for this machine."""
    if shutil.which("openssl") is None:
        pytest.skip("openssl, which makes the certificate, is not installed")
    certificate, key = str(folder / "certificate.pem"), str(folder / "key.pem")
    command = "openssl req -x509 -newkey rsa:2048 -nodes -days 800 -subj /CN=Steadfix"
    command += " -addext subjectAltName=IP:127.0.0.1,DNS:localhost -addext extendedKeyUsage=serverAuth"
    subprocess.run([*command.split(), "-keyout", key, "-out", certificate], check=True, capture_output=True, timeout=60)
    return certificate, key


def imu(device_time: float, n: int = 10) -> str:
    """The last n samples of a robot at rest, at 200 Hz."""
    stamps = [device_time - 0.005 * i for i in reversed(range(n))]
    return json.dumps({"type": "imu", "samples": [[t, 0.0, 0.0, 0.0, 0.0, 0.0, 9.80665] for t in stamps]})


def fix(robot: str = "rover", x: float = 1.0) -> PoseFix:
    now = time.monotonic()
    hypothesis = PoseHypothesis(np.array([x, 2.0, 0.0]), np.array([1.0, 0.0, 0.0, 0.0]), 1e-5 * np.eye(6))
    return PoseFix(robot, now - 0.05, now, (hypothesis,))


async def get(service: Service, path: str, method: str = "GET") -> tuple[int, str, str]:
    """Status, content type and text of a plain request."""

    def fetch() -> tuple[int, str, str]:
        request = urllib.request.Request(f"http://127.0.0.1:{service.port}{path}", method=method)
        try:
            with urllib.request.urlopen(request, timeout=10.0) as response:
                return response.status, response.headers["Content-Type"], response.read().decode()
        except urllib.error.HTTPError as error:
            with error:
                return error.code, error.headers["Content-Type"], error.read().decode()

    return await asyncio.to_thread(fetch)


async def health(service: Service) -> dict[str, Any]:
    status, kind, text = await get(service, "/healthz")
    assert (status, kind) == (200, "application/json")
    found: dict[str, Any] = json.loads(text)
    return found


async def until(condition: Callable[[], bool]) -> None:
    """Let the service's loop go on until it is so; the timeout of `run` ends what never comes."""
    while not condition():
        await asyncio.sleep(0.005)


class Ceiling:
    """A frame source: a rendered room with the rover at a fixed place, a frame whenever one is asked for."""

    WORLD_FROM_CAMERA = straight_down(0.0, 0.0, 2.5)
    WORLD_FROM_BODY = transform(rotation_about_z(0.5), [0.3, 0.2, 0.0])

    def __init__(self, config: CameraConfig, frames: float = math.inf) -> None:
        self._image = picture()
        self._left = frames
        self._sequence = 0

    def read(self, timeout: float) -> Frame | None:
        self._sequence += 1
        if self._sequence > self._left:
            raise OSError("camera 0: it was unplugged")
        time.sleep(0.05)  # the pace of this camera
        return Frame(time.monotonic() - 0.02, self._image, self._sequence, exposure=0.02)

    def close(self) -> None:
        pass


ANCHORS = {40: (0.6, -0.6, 0.0), 41: (-0.6, 0.6, 0.0)}
# The marker lies on the robot's origin, 0.1 m up.
BODY_FROM_MARKER = transform(np.eye(3), [0.0, 0.0, 0.1])


def picture(
    world_from_body: Array = Ceiling.WORLD_FROM_BODY,
    *,
    body_from_marker: Array = BODY_FROM_MARKER,
    moved: float = 0.0,
    shake: Sequence[float] = (0.0, 0.0, 0.0),
    anchors: Mapping[int, Sequence[float]] = ANCHORS,
) -> Image:
    """What the camera sees, turned by `shake` about its own axes, rad, of the rover, which moves by `moved`, m."""
    half, marker = transform(np.eye(3), [0.5 * moved, 0.0, 0.0]), world_from_body @ body_from_marker
    places = {id: transform(np.eye(3), place) for id, place in anchors.items()}
    room = Room(INTRINSICS, Ceiling.WORLD_FROM_CAMERA @ transform(exp_so3(shake), np.zeros(3)), "4X4_50", 1)
    return room.render(
        {7: (0.14, inverse(half) @ marker, half @ marker)} | {id: (0.18, at, at) for id, at in places.items()}
    )
