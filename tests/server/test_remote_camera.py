"""Remote cameras: the endpoint /v1/camera, the node by itself, and the node as a process of its own."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
import pytest
from websockets.asyncio.client import ClientConnection
from websockets.asyncio.server import ServerConnection, serve
from websockets.exceptions import ConnectionClosed

from camera.calibration import save_intrinsics
from camera.capture import Frame
from camera.markers import MarkerDetector
from server.app import Service
from server.camera_messages import CameraWelcome, encode
from server.camera_node import Node, NodeError
from server.config import Config, parse
from tests.server.room import CAMERA, CONFIG, INTRINSICS, Ceiling, beside, client, health, heard, run, serving, until

IDS = [7, 8, 40, 41]


@pytest.fixture
def room(tmp_path: Path) -> Config:
    """The room of `CONFIG` with a remote camera, whose calibration is in a file."""
    save_intrinsics(tmp_path / "camera.toml", INTRINSICS)
    text = (CONFIG + CAMERA).replace('source = "nothing.mp4"', 'source = "remote"\nframe_rate_hz = 20')
    return parse(text, folder=tmp_path)


@pytest.fixture(scope="module")
def picture() -> np.ndarray[Any, np.dtype[np.uint8]]:
    """What the camera sees, rendered once."""
    return Ceiling(None)._image  # type: ignore[arg-type]


def markers(picture: Any, t: float) -> list[dict[str, Any]]:
    """The markers in the picture, as a node would send them."""
    found = MarkerDetector("4X4_50", IDS).search(picture)
    return [{"id": s.id, "t": t, "corners_px": s.corners_px.tolist(), "sigma_px": s.sigma_px} for s in found]


def frame(t: float, sequence: int, found: list[dict[str, Any]], **changes: Any) -> str:
    content = {"t": t, "sent": t + 0.01, "sequence": sequence, "width_px": 640, "height_px": 480, "detect_ms": 5.0}
    content |= {"type": "frame", "markers": [marker | {"t": t} for marker in found]}
    return json.dumps(content | changes)


def status(trouble: str = "", **changes: Any) -> str:
    content = {"rate_hz": 20.0, "used_hz": 20.0, "exposure": 0.002, "white": 200.0, "saturated": 0.0, "dropped": 0}
    return json.dumps({"type": "status", "trouble": trouble} | content | changes)


async def camera_hello(connection: ClientConnection, camera: str = "ceiling", **more: str) -> dict[str, Any]:
    await connection.send(json.dumps({"type": "hello", "camera": camera} | more))
    return await heard(connection)


async def answer_clock(connection: ClientConnection, clock: Callable[[], float], times: int = 1) -> None:
    """As a node does, by its clock."""
    for _ in range(times):
        question = await heard(connection, "clock")
        now = clock()
        await connection.send(json.dumps({"type": "clock", "id": question["id"], "received": now, "sent": now}))


def ahead(seconds: float) -> Callable[[], float]:
    """The clock of another machine."""
    return lambda: time.monotonic() + seconds


# The endpoint


def test_a_node_is_told_what_to_look_for_and_its_sightings_become_fixes(room: Config, picture: Any) -> None:
    """Its clock is eleven days ahead of ours; the fixes are not."""
    clock = ahead(1e6)

    async def main() -> None:
        async with serving(room) as service:
            robot = service.robots["rover"]
            fixes = []
            feed = robot.feed_fix

            def keep(fix: Any, now: float) -> None:
                fixes.append(fix)
                feed(fix, now)

            robot.feed_fix = keep  # type: ignore[method-assign]
            async with client(service, "/v1/camera") as connection:
                welcome = await camera_hello(connection)
                assert welcome | {"service": ""} == {
                    "type": "welcome",
                    "camera": "ceiling",
                    "service": "",
                    "dictionary": "4X4_50",
                    "ids": IDS,
                    "still": [40, 41],
                    "width_px": 0,
                    "height_px": 0,
                    "frame_rate_hz": 20.0,
                    "pixel_format": "",
                    "exposure_ms": 0.0,
                    "gain": 0.0,
                    "line_time": 0.0,
                }
                await answer_clock(connection, clock, 3)
                found = markers(picture, 0.0)
                sequence = 0
                while len(fixes) < 5:
                    sequence += 1
                    taken = time.monotonic() - 3.0
                    await connection.send(frame(clock() - 3.0, sequence, found, sent=clock()))
                    await until(lambda: service.cameras["ceiling"].frames == sequence)  # noqa: B023
                fix = fixes[-1]
                # When they were taken, not when they came; how exactly is the clock's affair and this machine's.
                assert fix.t == pytest.approx(taken, abs=1.0)
                position = fix.hypotheses[0].position
                assert np.linalg.norm(position - Ceiling.WORLD_FROM_BODY[:3, 3]) < 0.005
                state = (await health(service))["cameras"]["ceiling"]
                assert (state["status"], state["located"], state["markers"]) == ("ok", True, [7, 40, 41])
                assert state["node"].startswith("127.0.0.1:")
                assert state["detect_ms"] == 5.0
                # Which makes searching for them cheaper: 0.14 and 0.18 m, 2.5 m below 500 px of focal length.
                sizes = await heard(connection, "sizes")
                assert 20.0 < sizes["shortest_px"] < 28.0 < 36.0 < sizes["longest_px"] < 45.0
                await connection.send(frame(clock() - 3.0, sequence + 1, found, sent=clock(), repeated=[8]))
                await until(lambda: service.cameras["ceiling"].repeated == {8})
                # Now and then, as nodes do: the last frame may still be worked on.
                while service.cameras["ceiling"].status != "camera /dev/video0: lost":
                    await connection.send(status("camera /dev/video0: lost"))
                    await asyncio.sleep(0.01)
                found_health = await health(service)
                assert "camera ceiling: camera /dev/video0: lost" in found_health["reasons"]
            await until(lambda: "has gone" in service.cameras["ceiling"].status)
            state = (await health(service))["cameras"]["ceiling"]
            assert state["node"] is None
            assert state["status"].endswith("has gone; waiting for it (camera /dev/video0: lost)")

    run(main)


def test_what_the_picture_lacks_is_said(room: Config, picture: Any) -> None:
    async def main() -> None:
        async with serving(room) as service, client(service, "/v1/camera") as connection:
            await camera_hello(connection)
            await answer_clock(connection, time.monotonic)
            await connection.send(frame(time.monotonic(), 1, markers(picture, 0.0)))
            camera = service.cameras["ceiling"]
            await until(lambda: camera.placement is not None)
            await connection.send(status(exposure=0.02, white=40.0, rate_hz=12.0, used_hz=12.0))
            await until(lambda: camera.delivery(0.0) is not None)
            # 500 px of focal length 2.5 m above the floor.
            expected = [
                "4.0 px of blur at 1 m/s: halve the exposure, from 20 to 10 ms, and make up for it with light or gain",
                "the picture is dark (white is grey level 40 of 255): more light is best, else more gain",
                "12 frames a second come where 20 were asked for: a compressed pixel_format may be needed to get them "
                "through USB",
            ]
            assert (await health(service))["cameras"]["ceiling"]["advice"] == expected
            assert camera.news(100.0) == expected
            assert camera.news(105.0) == [], "once is enough"
            assert [(await heard(connection, "notice"))["text"] for _ in expected] == expected
            await connection.send(status(white=2.0, exposure=None))
            await until(lambda: camera.delivery(0.0).white == 2.0)  # type: ignore[union-attr]
            state = (await health(service))["cameras"]["ceiling"]
            assert state["status"].startswith("the picture is black")
            assert state["advice"] == []
            assert [text[:20] for text in camera.news(110.0)] == ["the picture is black"]

    run(main)


def test_what_a_node_must_not_send(room: Config) -> None:
    corners = [[1.0, 1.0], [9.0, 1.0], [9.0, 9.0], [1.0, 9.0]]
    marker = {"id": 7, "t": 0.0, "corners_px": corners, "sigma_px": 0.1}

    async def main() -> None:
        async with serving(room) as service, client(service, "/v1/camera") as connection:
            await camera_hello(connection)
            await answer_clock(connection, time.monotonic)
            now = time.monotonic()
            for message, says in (
                ("{}", "type"),
                ('{"type":"frame","x":' + "[" * 60_000, "nested too deeply"),
                ('{"type":"hello","camera":"ceiling"}', "a second hello"),
                ('{"type":"clock","id":99,"received":1.0,"sent":1.0}', "was not asked"),
                (frame(now, 1, [marker | {"id": 9}]), "not asked for: [9]"),
                (frame(now, 1, [marker, marker]), "a marker twice, in [7, 7]"),
                (frame(now, 1, [marker | {"corners_px": corners[:3]}]), "corners_px"),
                (frame(now, 1, [marker | {"sigma_px": 0.0}]), "sigma_px"),
                (frame(now, 1, [marker | {"corners_px": [[1e300, 1.0], *corners[1:]]}]), "corners_px"),
                (frame(now, 1, [marker]).replace("0.1", "NaN"), "malformed"),
                (frame(now, 1, [marker], sent=now - 0.5), "a frame of 0.5 s after it was sent"),
                (frame(now, 1, [], width_px=0), "width_px"),
                (frame(1e300, 1, []), "$.t"),
                (frame(now, 1, [], width_px=1280, height_px=720), "the calibration is for 640 x 480 px"),
            ):
                await connection.send(message)
                assert says in (await heard(connection, "error"))["reason"]
            assert service.cameras["ceiling"].frames == 0
            found = await health(service)
            assert "camera ceiling: the image is 1280 x 720 px, the calibration is for 640 x 480 px" in found["reasons"]
            await connection.send(frame(time.monotonic(), 2, []))
            await until(lambda: service.cameras["ceiling"].frames == 1)
            assert (await health(service))["cameras"]["ceiling"]["status"] == "ok"

    run(main)


def test_who_is_no_remote_camera_is_refused(room: Config) -> None:
    async def main() -> None:
        async with serving(room) as service:
            for hello, says in (
                ('{"type":"hello","camera":"floor"}', "known: ceiling"),
                ("nonsense", "malformed"),
                ('{"type":"status"}', "missing"),
            ):
                async with client(service, "/v1/camera") as connection:
                    await connection.send(hello)
                    assert says in (await heard(connection, "error"))["reason"]
            found = await health(service)
            (reason,) = (reason for reason in found["reasons"] if reason.startswith("camera ceiling"))
            assert "its node has not connected yet" in reason
            assert "steadfix camera SOURCE --server ws://" in reason

    run(main)


def test_a_camera_with_a_token_is_taken_with_it_alone(room: Config) -> None:
    secret = msgspec.structs.replace(room, camera=(msgspec.structs.replace(room.camera[0], token="swordfish"),))

    async def main() -> None:
        async with serving(secret) as service:
            for more, says in (
                ({}, "needs its token"),
                ({"token": "sword"}, "not the token"),
                ({"token": "swordfish"}, "welcome"),
            ):
                async with client(service, "/v1/camera") as connection:
                    answer = await camera_hello(connection, **more)
                    assert says in (answer["type"] + " " + answer.get("reason", ""))

    run(main)


def test_a_second_node_of_one_name_has_to_wait_until_the_first_is_silent(
    room: Config, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def main() -> None:
        async with serving(room) as service:
            camera = service.cameras["ceiling"]
            async with client(service, "/v1/camera") as first:
                assert (await camera_hello(first))["type"] == "welcome"
                async with client(service, "/v1/camera") as second:
                    refused = await camera_hello(second)
                    assert (refused["type"], refused["retry"]) == ("error", True)
                    assert 'camera "ceiling" is already connected, from 127.0.0.1' in refused["reason"]
                monkeypatch.setattr("server.remote_cameras.SILENCE", 0.3)
                await until(lambda: "says nothing any more" in camera.status)
                async with client(service, "/v1/camera") as third:
                    assert (await camera_hello(third))["type"] == "welcome"
                    with pytest.raises(ConnectionClosed):
                        await heard(first, "welcome")
                    assert "has connected" in camera.status

    run(main)


# The node by itself


class Moving:
    """A source that gives a frame whenever the test says so; the picture is empty."""

    def __init__(self) -> None:
        self.due = threading.Semaphore(0)
        self.read_ones = 0
        self.closed = False

    def read(self, timeout: float) -> Frame | None:
        self.due.acquire()
        if self.closed:
            return None
        self.read_ones += 1
        return Frame(time.monotonic(), np.full((48, 64), 128, np.uint8), self.read_ones)

    def close(self) -> None:
        self.closed = True
        self.due.release()


WELCOME = CameraWelcome("ceiling", "test", "4X4_50", [7], [])


@contextlib.asynccontextmanager
async def listening(handler: Callable[[ServerConnection], Any]) -> AsyncIterator[str]:
    """A service of the test's own, which takes in little at a time."""
    sock = socket.socket()
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    sock.bind(("127.0.0.1", 0))
    async with serve(handler, sock=sock, compression=None, max_queue=1):
        yield f"ws://127.0.0.1:{sock.getsockname()[1]}"


def test_where_the_link_stalls_the_newest_frame_replaces_the_one_that_waits() -> None:
    async def main() -> None:
        source = Moving()
        resume, done = asyncio.Event(), asyncio.Event()
        sequences: list[int] = []

        async def service(connection: ServerConnection) -> None:
            await connection.recv()
            await connection.send(encode(WELCOME), text=True)
            await resume.wait()  # nothing is read meanwhile
            async for data in connection:
                message = json.loads(data)
                if message["type"] == "frame":
                    sequences.append(message["sequence"])
                    if sequences[-1] == source.read_ones:
                        done.set()

        async with listening(service) as url:
            node = Node(url, "ceiling", lambda welcome: source)
            async with beside(node.run()):
                while node.dropped < 1000:
                    source.due.release()
                    await asyncio.sleep(0)
                resume.set()
                await done.wait()
                source.due.release()
        # What was replaced never came; what came last is the newest.
        assert sequences == sorted(sequences)
        assert len(sequences) <= source.read_ones - node.dropped

    run(main)


def test_a_node_connects_again_and_opens_its_camera_only_once() -> None:
    async def main() -> None:
        opened: list[Moving] = []
        connections: asyncio.Queue[ServerConnection] = asyncio.Queue()

        async def service(connection: ServerConnection) -> None:
            await connection.recv()
            await connection.send(encode(WELCOME), text=True)
            connections.put_nowait(connection)
            await connection.wait_closed()

        def open_(welcome: CameraWelcome) -> Moving:
            opened.append(Moving())
            return opened[-1]

        async with listening(service) as url, beside(Node(url, "ceiling", open_).run()):
            for _ in range(3):
                (await connections.get()).transport.abort()
            await connections.get()
        assert len(opened) == 1
        assert opened[0].closed

    run(main)


def test_a_camera_that_is_pulled_out_is_opened_again() -> None:
    class Loose(Moving):
        def read(self, timeout: float) -> Frame | None:
            if self.read_ones == 2:
                raise OSError("camera /dev/video0: lost; it no longer delivers frames")
            return super().read(timeout)

    async def main() -> None:
        opened = 0
        told: asyncio.Queue[Any] = asyncio.Queue()

        async def service(connection: ServerConnection) -> None:
            await connection.recv()
            await connection.send(encode(WELCOME), text=True)
            async for data in connection:
                told.put_nowait(json.loads(data))

        def open_(welcome: CameraWelcome) -> Moving:
            nonlocal opened
            opened += 1
            if opened == 2:
                raise FileNotFoundError("camera /dev/video0: not there; cameras found: none")
            source = Loose() if opened == 1 else Moving()
            for _ in range(5):
                source.due.release()
            return source

        async with listening(service) as url, beside(Node(url, "ceiling", open_).run()):
            troubles = [None]
            while opened < 3 or troubles[-1] != "":
                message = await told.get()
                if message["type"] == "status" and message["trouble"] != troubles[-1]:
                    troubles.append(message["trouble"])
        assert opened == 3
        assert set(troubles[1:]) <= {
            "the camera is being opened",
            "camera /dev/video0: lost; it no longer delivers frames",
            "camera /dev/video0: not there; cameras found: none",
            "",
        }

    run(main)


def test_what_a_node_cannot_be_started_with() -> None:
    async def main() -> None:
        with pytest.raises(NodeError, match=r"--certificate nothing.pem: No such file"):
            Node("wss://there:5678", "ceiling", lambda welcome: Moving(), certificate="nothing.pem")
        for url in ("192.168.1.10:5678", "http://there:5678", "ws://", "there"):
            with pytest.raises(NodeError, match=r"--server .*: an address such as ws://192.168.1.10:5678 is needed"):
                Node(url, "ceiling", lambda welcome: Moving())

    run(main)


# The node as a process of its own


class Process:
    """`steadfix camera` over a folder of pictures, 20 a second."""

    def __init__(self, folder: Path, url: str, name: str = "ceiling") -> None:
        self._command = [sys.executable, "-m", "server.cli", "camera", str(folder), "--server", url, "--name", name]

    async def __aenter__(self) -> asyncio.subprocess.Process:
        self._process = await asyncio.create_subprocess_exec(
            *self._command, stdout=asyncio.subprocess.DEVNULL, stderr=asyncio.subprocess.PIPE
        )
        return self._process

    async def __aexit__(self, *error: object) -> None:
        if self._process.returncode is None:
            self._process.kill()
        await self._process.communicate()


@pytest.fixture
def pictures(tmp_path: Path, picture: Any) -> Path:
    """A minute of them, all the same."""
    folder = tmp_path / "pictures"
    folder.mkdir()
    cv2.imwrite(str(folder / "0000.png"), picture)
    for k in range(1, 1200):
        os.link(folder / "0000.png", folder / f"{k:04}.png")
    return folder


def test_a_node_that_is_killed_is_missed_and_taken_back(room: Config, pictures: Path) -> None:
    async def main() -> None:
        async with serving(room) as service:
            camera, rover = service.cameras["ceiling"], service.robots["rover"].localiser
            url = f"ws://127.0.0.1:{service.port}"
            async with Process(pictures, url) as node:
                await until(lambda: sum(rover.counts.values()) >= 3)
                node.send_signal(signal.SIGKILL)
                await until(lambda: "has gone; waiting for it" in camera.status)
                assert any("has gone; waiting for it" in reason for reason in (await health(service))["reasons"])
            before = camera.frames
            async with Process(pictures, url):
                await until(lambda: camera.frames > before and camera.status == "")
            pose = rover.pose_at(time.monotonic())
            assert pose is not None
            assert np.linalg.norm(pose.position[:2] - Ceiling.WORLD_FROM_BODY[:2, 3]) < 0.02

    run(main)


def test_a_node_waits_for_a_service_that_is_not_there_and_for_one_that_went(room: Config, pictures: Path) -> None:
    async def main() -> None:
        with socket.socket() as sock:
            sock.bind(("127.0.0.1", 0))
            port = sock.getsockname()[1]
        fixed = parse((CONFIG + CAMERA).replace("port = 0", f"port = {port}"))
        config = Config(fixed.server, room.camera, room.anchor, room.robot)
        async with Process(pictures, f"ws://127.0.0.1:{port}") as node:
            assert node.stderr is not None
            assert b"no connection to ws://127.0.0.1" in await node.stderr.readline()
            for _ in range(2):
                async with Service(config) as service:
                    await until(lambda: service.cameras["ceiling"].frames >= 2)
            node.send_signal(signal.SIGTERM)
            rest = (await node.communicate())[1].decode()
            assert node.returncode == 0
            assert "Traceback" not in rest

    run(main)


def test_a_node_whose_pictures_end_says_so_and_ends(room: Config, tmp_path: Path, picture: Any) -> None:
    folder = tmp_path / "few"
    folder.mkdir()
    for k in range(8):
        cv2.imwrite(str(folder / f"{k}.png"), picture)

    async def main() -> None:
        async with serving(room) as service, Process(folder, f"ws://127.0.0.1:{service.port}") as node:
            assert await node.wait() == 0
            camera = service.cameras["ceiling"]
            await until(lambda: camera.status.endswith("has gone; waiting for it (the source has ended)"))

    run(main)


def test_a_node_that_is_not_wanted_says_why_and_ends(room: Config, pictures: Path) -> None:
    async def main() -> None:
        async with serving(room) as service, Process(pictures, f"ws://127.0.0.1:{service.port}", "floor") as node:
            words = (await node.communicate())[1].decode()
            assert node.returncode == 2
            assert words.startswith('steadfix: the service refuses camera floor: there is no remote camera "floor"')
            assert "Traceback" not in words

    run(main)
