"""The service on real sockets: what it answers, and what it survives."""

from __future__ import annotations

import asyncio
import contextlib
import json
import math
import os
import socket
import time
import tty
from collections.abc import AsyncIterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from websockets.asyncio.client import ClientConnection
from websockets.exceptions import ConnectionClosed

from camera.calibration import CalibrationError, Intrinsics, save_intrinsics
from fusion.measurements import Array, ImuBatch, Pose, PoseFix, WheelOdometry
from imu.protocols import RawSample
from server.app import Service
from server.config import CameraConfig, Config, ConfigError, parse
from server.robot_client import Robot
from tests.imu.streams import rvc_frame, steadfix_frame
from tests.server.room import (
    CAMERA,
    CONFIG,
    INTRINSICS,
    Ceiling,
    beside,
    client,
    fix,
    get,
    health,
    heard,
    hello,
    imu,
    run,
    serving,
    until,
)

# Plain requests


def test_plain_requests() -> None:
    async def main() -> None:
        async with serving() as service:
            status, kind, text = await get(service, "/")
            assert (status, kind) == (200, "text/html; charset=utf-8")
            assert "<canvas" in text
            assert (await get(service, "/dashboard.js"))[:2] == (200, "text/javascript; charset=utf-8")
            assert (await get(service, "/dashboard.css"))[:2] == (200, "text/css; charset=utf-8")
            assert await get(service, "/", "HEAD") == (200, "text/html; charset=utf-8", "")
            for path in ("/nothing", "/../server/app.py", "/dashboard.js/"):
                status, _, text = await get(service, path)
                assert status == 404
                assert "/healthz" in text
                assert "/v1/poses" in text
            # urlsplit takes what is before the next slash for a host.
            assert (await get(service, "//[/"))[0] == 400
            assert (await get(service, "/v1/poses"))[0] == 426
            assert (await get(service, "/", "DELETE"))[0] == 405

    run(main)


def test_health() -> None:
    async def main() -> None:
        async with serving() as service:
            found = await health(service)
            assert found["status"] == "degraded"
            assert found["reasons"][0] == "robot rover: no IMU has connected yet"
            assert found["robots"]["rover"]["mode"] == "INIT"
            assert found["robots"]["rover"]["fix_age"] is None
            service.robots["rover"].feed_fix(fix(), time.monotonic())
            found = await health(service)
            assert found["robots"]["rover"]["mode"] == "NO_IMU"
            assert 0.04 < found["robots"]["rover"]["fix_age"] < 10.0
            assert found["robots"]["rover"]["counts"]["initialised"] == 1

    run(main)


def test_a_diagnosis_is_in_the_health_and_told_once_when_it_comes_and_once_when_it_goes() -> None:
    async def main() -> None:
        async with serving() as service:
            robot = service.robots["rover"]
            now = time.monotonic()
            noise = np.random.default_rng(1)

            def on(seconds: float, one: float) -> None:
                """An IMU at rest that reads gravity as `one`, and fixes, as fast as the filter takes them."""
                nonlocal now
                for _ in range(round(seconds / 0.5)):
                    stamps = (now + 0.01 * np.arange(50)).tolist()
                    readings = noise.normal([0.0, 0.0, 0.0, 0.0, 0.0, one], 1e-3, (50, 6)).tolist()
                    samples = [RawSample(t, *six) for t, six in zip(stamps, readings, strict=True)]
                    robot.feed_imu(samples, stamps[-1], stamps[-1])
                    robot.feed_fix(replace(fix(), t=stamps[25]), stamps[-1])
                    now += 0.5

            on(20.0, 1.0)
            (news,) = robot.diagnose(now)
            assert news == "the accelerometer reads 1.00 on the mean: these are g, not m/s2"
            assert robot.diagnose(now) == []
            found = await health(service)
            assert f"robot rover: {news}" in found["reasons"]
            (diagnosis,) = found["robots"]["rover"]["diagnoses"]
            assert (diagnosis["code"], diagnosis["severity"], diagnosis["text"]) == ("accel_unit", "error", news)
            assert found["robots"]["rover"]["nis"]["pose"]["fixes"] > 0
            assert found["robots"]["rover"]["accuracy"]["fixes"] > 0
            on(60.0, 9.81)
            assert [text for text in robot.diagnose(now) if news in text] == [f"no longer: {news}"]
            assert [text for text in robot.diagnose(now) if news in text] == []

    run(main)


# Poses


def test_poses_of_all_robots_or_of_some() -> None:
    async def main() -> None:
        async with (
            serving() as service,
            client(service, "/v1/poses") as all_,
            client(service, "/v1/poses?robots=cart&rate=20") as some,
        ):
            service.robots["rover"].feed_fix(fix("rover", x=1.0), time.monotonic())
            service.robots["cart"].feed_fix(fix("cart", x=3.0), time.monotonic())
            seen = {}
            while len(seen) < 2:
                pose = await heard(all_, "pose")
                seen[pose["robot"]] = pose
            assert seen["rover"]["position"][0] == pytest.approx(1.0)
            assert seen["cart"]["frame"] == "world"
            assert len(seen["cart"]["covariance"]) == 36
            poses = [await heard(some, "pose") for _ in range(10)]
            assert {pose["robot"] for pose in poses} == {"cart"}
            assert [pose["seq"] for pose in poses] == sorted({pose["seq"] for pose in poses})
            # 20 Hz, or less on a slow machine, but never the 100 Hz of the service.
            assert poses[-1]["t"] - poses[0]["t"] > 8 / 20

    run(main)


def test_the_smooth_channel_is_published_and_the_best_one_on_request() -> None:
    async def main() -> None:
        async with (
            serving() as service,
            client(service, "/v1/poses?robots=rover&channel=best") as best,
            client(service, "/v1/poses?robots=rover&channel=smooth") as smooth,
        ):
            rover = service.robots["rover"]
            now = time.monotonic()
            rover.feed_fix(replace(fix("rover", 1.0), t=now - 0.2), now)
            rover.publish(now)
            rover.feed_fix(replace(fix("rover", 1.1), t=now - 0.1), now)
            # without any time between: the one has moved, the other not yet
            published, moved = rover.publish(now), rover.localiser.pose_at(now)
            assert published is not None
            assert moved is not None
            assert published.position[0] == pytest.approx(1.0, abs=1e-3)
            assert moved.position[0] > 1.05
            assert (await heard(best, "pose"))["robot"] == (await heard(smooth, "pose"))["robot"] == "rover"

    run(main)


@pytest.mark.parametrize(
    ("query", "expected"),
    [
        ("robots=rover,tank", 'there is no robot "tank" in the configuration; known: rover, cart'),
        ("rate=fast", "rate=fast"),
        ("rate=-1", "rate=-1"),
        ("rate=nan", "rate=nan"),
        ("channel=rough", "channel=rough: there are best and smooth"),
        ("format=xml", "format=xml: there are json and msgpack"),
        ("colour=red", "robots=a,b, rate=50, channel=best and format=msgpack are"),
    ],
)
def test_poses_that_cannot_be_had(query: str, expected: str) -> None:
    async def main() -> None:
        async with serving() as service, client(service, f"/v1/poses?{query}") as connection:
            assert expected in (await heard(connection, "error"))["reason"]
            with pytest.raises(ConnectionClosed) as closed:
                await connection.recv()
            assert closed.value.rcvd is not None
            assert closed.value.rcvd.code == 1008

    run(main)


# Robots


def test_a_robot_sends_its_imu_and_gets_its_pose() -> None:
    async def main() -> None:
        published: list[Pose] = []
        recording = Recording()
        async with serving(recording=recording, published=published.append) as service:
            async with client(service, "/v1/robot") as connection:
                welcome = await hello(connection, pose_rate_hz=50)
                assert welcome["type"] == "welcome"
                assert welcome["robot"] == "rover"
                assert welcome["service"].startswith("steadfix ")
                assert welcome["pose_rate_hz"] == 50
                # Its own clock: another origin.
                offset = 1000.0 - time.monotonic()
                await connection.send(imu(time.monotonic() + offset))
                await until(lambda: service.robots["rover"].localiser.counts["imu_samples"] == 10)
                service.robots["rover"].feed_fix(fix(), time.monotonic())
                questions = 0
                poses = []
                while len(poses) < 20 or questions < 3:
                    message = await heard(connection)
                    if message["type"] == "clock":
                        questions += 1
                        now = time.monotonic() + offset
                        answer = {"type": "clock", "id": message["id"], "received": now, "sent": now}
                        await connection.send(json.dumps(answer))
                    elif message["type"] == "pose":
                        poses.append(message)
                        await connection.send(imu(time.monotonic() + offset, n=1))
                assert {pose["robot"] for pose in poses} == {"rover"}
                assert poses[-1]["mode"] == "FULL"
                # Within the exchange's round trip, of which nothing is known on a busy machine.
                assert poses[-1]["t_robot"] == pytest.approx(poses[-1]["t"] + offset, abs=0.2)
                found = (await health(service))["robots"]["rover"]
                assert found["imu"] == "ok"
                assert found["imu_rate_hz"] > 0.0
                assert found["link_delay_ms"] >= 0.0
            await until(lambda: service.robots["rover"].trouble == "its connection has ended")
        assert len(published) == service.robots["rover"].published
        assert sum(len(track) for track in recording.tracks) == sum(len(batch.samples) for batch in recording.batches)
        assert np.isfinite(recording.tracks[-1]).all()
        assert len(recording.fixes) == 1
        arrivals = [batch.arrival for batch in recording.batches]
        assert arrivals == sorted(arrivals)
        assert all((batch.samples[:, 0] <= batch.arrival).all() for batch in recording.batches)

    run(main)


class Recording:
    """Keeps what it is given."""

    def __init__(self) -> None:
        self.batches: list[ImuBatch] = []
        self.fixes: list[PoseFix] = []
        self.odometry: list[WheelOdometry] = []
        self.tracks: list[Array] = []
        self.imu, self.fix, self.wheels = self.batches.append, self.fixes.append, self.odometry.append

    def track(self, robot: str, track: Array) -> None:
        self.tracks.append(track)


def test_no_more_poses_than_the_service_publishes() -> None:
    async def main() -> None:
        async with serving() as service, client(service, "/v1/robot") as connection:
            assert (await hello(connection, pose_rate_hz=400))["pose_rate_hz"] == 100

    run(main)


def test_a_robot_that_is_not_known() -> None:
    async def main() -> None:
        async with serving() as service, client(service, "/v1/robot") as connection:
            error = await hello(connection, "tank")
            assert error["reason"] == 'there is no robot "tank" in the configuration; known: rover, cart'
            with pytest.raises(ConnectionClosed):
                await connection.recv()

    run(main)


def test_a_second_robot_of_one_name_is_refused_while_the_first_is_there() -> None:
    async def main() -> None:
        async with serving() as service, client(service, "/v1/robot") as first:
            await hello(first)
            async with client(service, "/v1/robot") as second:
                error = await hello(second)
                assert error["type"] == "error"
                assert 'robot "rover" is already connected' in error["reason"]
            await first.send(imu(5.0))
            await until(lambda: service.robots["rover"].localiser.counts["imu_samples"] == 10)

    run(main)


def test_a_silent_connection_gives_way_to_a_new_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("server.app.SILENCE", 0.0)

    async def main() -> None:
        async with serving() as service, client(service, "/v1/robot") as first:
            await hello(first)
            async with client(service, "/v1/robot") as second:
                assert (await hello(second))["type"] == "welcome"
                await first.wait_closed()
                await second.send(imu(5.0))
                await until(lambda: service.robots["rover"].localiser.counts["imu_samples"] == 10)
                assert service.robots["rover"].trouble == ""

    run(main)


# Rubbish


@pytest.mark.parametrize(
    ("data", "expected"),
    [
        ("rubbish", "this is not JSON"),
        (b"\x00" * 100, "a binary message of 100 bytes"),
        ("[" * 60_000, "nested too deeply"),
        ('{"type":"imu","samples":"none"}', "needed: a list of 1 to 200 samples"),
        ('{"type":"imu","samples":[[0,0,0,0,0,0,NaN]]}', "neither NaN nor Infinity"),
        ('{"type":"imu","samples":[[0,1e9,0,0,0,0,0]]}', "sample 0, gx: found 1000000000"),
        ('{"type":"imu","samples":[[1e300,0,0,0,0,0,0]]}', "sample 0, t: found 1e+300"),
        ('{"type":"clock","id":99,"received":0,"sent":0}', "which was not asked"),
        ('{"type":"hello","robot":"cart"}', "a second hello"),
    ],
)
def test_rubbish_is_answered_counted_and_survived(data: str | bytes, expected: str) -> None:
    async def main() -> None:
        async with serving() as service, client(service, "/v1/robot") as connection:
            await hello(connection)
            await connection.send(data)
            assert expected in (await heard(connection, "error"))["reason"]
            found = await health(service)
            assert found["messages_refused"] == 1
            assert found["robots"]["rover"]["imu_refused"] == 1
            # The connection is as good as before.
            await connection.send(imu(5.0))
            await until(lambda: service.robots["rover"].localiser.counts["imu_samples"] == 10)

    run(main)


def test_messages_that_come_together_are_taken_in_their_order() -> None:
    """Whole ones where they come, what is refused or comes in parts by the task that waits for it."""
    recording = Recording()

    def numbered(k: int) -> str:
        return json.dumps({"type": "imu", "samples": [[5.0 + 0.005 * k, 1e-3 * k, 0.0, 0.0, 0.0, 0.0, 9.80665]]})

    async def main() -> None:
        async with serving(recording=recording) as service, client(service, "/v1/robot") as connection:
            await hello(connection)
            for k in range(0, 40, 4):
                parts = numbered(k + 2)
                for message in (numbered(k), numbered(k + 1), "rubbish", [parts[:20], parts[20:]], numbered(k + 3)):
                    await connection.send(message)
            await until(lambda: len(recording.batches) == 40)
            assert [batch.samples[0, 1] for batch in recording.batches] == [1e-3 * k for k in range(40)]
            for _ in range(10):
                assert "this is not JSON" in (await heard(connection, "error"))["reason"]
            assert (await health(service))["messages_refused"] == 10

    run(main)


def test_before_the_hello_nothing_else_is_heard() -> None:
    async def main() -> None:
        async with serving() as service, client(service, "/v1/robot") as connection:
            await connection.send(imu(5.0))
            assert "the first message must be" in (await heard(connection, "error"))["reason"]
            assert (await hello(connection))["type"] == "welcome"

    run(main)


def test_one_that_never_says_hello(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("server.visitor.HELLO_TIMEOUT", 0.1)

    async def main() -> None:
        async with serving() as service, client(service, "/v1/robot") as connection:
            await connection.wait_closed()

    run(main)


def test_ten_megabytes() -> None:
    async def main() -> None:
        async with serving() as service:
            # Not `async with`: the service closes this connection while the client still sends.
            connection = await client(service, "/v1/robot")
            await hello(connection)
            with contextlib.suppress(ConnectionClosed):
                await connection.send("x" * 10_000_000)
            await connection.wait_closed()
            assert connection.close_code in (1006, 1009)
            await until(lambda: service.refused == 1)
            async with client(service, "/v1/robot") as connection:
                assert (await hello(connection))["type"] == "welcome"

    run(main)


def test_what_is_no_http_at_all() -> None:
    async def main() -> None:
        async with serving() as service:
            for data in (
                b"\x16\x03\x01\x02\x00\x01\x00",
                b"GET\r\n\r\n",
                b"POST / HTTP/1.1\r\nContent-Length: 5\r\n\r\n12345",
            ):
                reader, writer = await asyncio.open_connection("127.0.0.1", service.port)
                writer.write(data)
                writer.write_eof()
                await reader.read()
                writer.close()
                await writer.wait_closed()
            assert (await get(service, "/"))[0] == 200

    run(main)


# Clients that go away, or do not keep up


def test_clients_that_vanish() -> None:
    async def main() -> None:
        async with serving() as service:
            service.robots["rover"].feed_fix(fix(), time.monotonic())
            async with client(service, "/v1/poses") as other:
                for path in ("/v1/poses", "/v1/robot", "/"):
                    async with client(service, path) as connection:
                        if path == "/v1/robot":
                            await hello(connection)
                        connection.transport.abort()
                await until(lambda: len(service.hub.subscriptions) == 1)
                await heard(other, "pose")

    run(main)


def test_a_client_that_does_not_read_is_cut_off_and_holds_nobody_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("server.hub.STALL_LIMIT", 0.3)

    async def main() -> None:
        config = CONFIG.replace("pose_rate_hz = 100", "pose_rate_hz = 1000")
        async with serving(config) as service:
            service.robots["rover"].feed_fix(fix(), time.monotonic())
            with socket.socket() as stalled:
                # A small window, so that it does not take megabytes to fill.
                stalled.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
                stalled.setblocking(False)
                await asyncio.get_running_loop().sock_connect(stalled, ("127.0.0.1", service.port))
                key = (
                    "Upgrade: websocket\r\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Version: 13\r\n"
                )
                request = f"GET /v1/poses HTTP/1.1\r\nHost: localhost\r\nConnection: Upgrade\r\n{key}\r\n"
                await asyncio.get_running_loop().sock_sendall(stalled, request.encode())
                await until(lambda: len(service.hub.subscriptions) == 1)
                async with client(service, "/v1/poses?rate=100") as other:
                    last = 0
                    while service.hub.cut_off == 0:
                        assert max(s.waiting() for s in service.hub.subscriptions) < 100_000
                        last = (await heard(other, "pose"))["seq"]
                    assert service.hub.dropped > 0
                    await until(lambda: len(service.hub.subscriptions) == 1)
                    assert (await heard(other, "pose"))["seq"] > last

    run(main)


def test_a_port_in_use() -> None:
    async def main() -> None:
        async with serving() as service:
            with pytest.raises(OSError, match=f"port {service.port} on 127.0.0.1 is in use"):
                async with serving(CONFIG.replace("port = 0", f"port = {service.port}")):
                    pass

    run(main)


def test_ending_tells_the_clients() -> None:
    async def main() -> None:
        async with contextlib.AsyncExitStack() as clients:
            async with serving() as service:
                connection = await clients.enter_async_context(client(service, "/v1/poses"))
            with pytest.raises(ConnectionClosed) as closed:
                await connection.recv()
            assert closed.value.rcvd is not None
            assert closed.value.rcvd.code == 1001

    run(main)


# Cameras


@pytest.fixture
def camera_config(tmp_path: Path) -> Config:
    save_intrinsics(tmp_path / "camera.toml", INTRINSICS)
    return parse(CONFIG + CAMERA, folder=tmp_path)


def test_a_camera_locates_itself_and_the_robot(camera_config: Config) -> None:
    async def main() -> None:
        async with serving(camera_config, open_camera=Ceiling) as service, client(service, "/v1/poses") as connection:
            pose = await heard(connection, "pose")
            assert pose["robot"] == "rover"
            assert pose["position"] == pytest.approx([0.3, 0.2, 0.0], abs=0.01)
            assert pose["yaw"] == pytest.approx(0.5, abs=0.02)
            found = await health(service)
            ceiling = found["cameras"]["ceiling"]
            assert ceiling["status"] == "ok"
            assert ceiling["located"]
            assert ceiling["position_m"] == pytest.approx([0.0, 0.0, 2.5], abs=0.01)
            assert ceiling["markers"] == [7, 40, 41]
            # 640 px at a focal length of 500 px from 2.5 m.
            outline = np.array(ceiling["view_m"])
            assert np.ptp(outline, axis=0) == pytest.approx([3.2, 2.4], abs=0.1) or np.ptp(
                outline, axis=0
            ) == pytest.approx([2.4, 3.2], abs=0.1)
            assert [anchor["id"] for anchor in found["anchors"]] == [40, 41]

    run(main)


def test_the_original_trackers_stream(camera_config: Config) -> None:
    async def main() -> None:
        async with serving(camera_config, open_camera=Ceiling) as service, client(service, "/") as connection:
            await connection.send("what a client sends is ignored")
            seen = {}
            while len(seen) < 3:
                data = await connection.recv()
                assert isinstance(data, str)
                message = json.loads(data)
                assert data == json.dumps(message)
                assert list(message) == ["id", "x", "y", "bearing"]
                seen[message["id"]] = message
            assert set(seen) == {"7", "40", "41"}
            # Where a pinhole at 2.5 m sees the marker 0.1 m up.
            camera_from_world = np.linalg.inv(Ceiling.WORLD_FROM_CAMERA)
            x, y, z, _ = camera_from_world @ [0.3, 0.2, 0.1, 1.0]
            assert seen["7"]["x"] == pytest.approx(500.0 * x / z + 319.5, abs=1.5)
            assert seen["7"]["y"] == pytest.approx(500.0 * y / z + 239.5, abs=1.5)
            R = camera_from_world[:3, :3] @ Ceiling.WORLD_FROM_BODY[:3, :3]
            bearing = math.degrees(math.atan2(R[1, 0], R[0, 0])) % 360.0
            assert seen["7"]["bearing"] == pytest.approx(bearing, abs=2.0)
            assert isinstance(seen["7"]["x"], int)

    run(main)


def test_a_camera_that_is_not_there(camera_config: Config) -> None:
    async def main() -> None:
        async with serving(camera_config) as service:
            await until(lambda: "nothing.mp4" in service.cameras["ceiling"].status)
            found = await health(service)
            assert any("camera ceiling: " in reason and "nothing.mp4" in reason for reason in found["reasons"])
            assert not found["cameras"]["ceiling"]["located"]

    run(main)


def test_a_camera_that_is_lost_is_opened_again(camera_config: Config, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("server.cameras.FIRST_PAUSE", 0.01)
    opened: list[Ceiling] = []

    def open_camera(config: CameraConfig) -> Ceiling:
        opened.append(Ceiling(config, frames=3))
        return opened[-1]

    async def main() -> None:
        async with serving(camera_config, open_camera=open_camera):
            await until(lambda: len(opened) >= 3)

    run(main)
    assert len(opened) >= 3


def test_a_frame_of_another_size_than_the_calibration(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("server.cameras.FIRST_PAUSE", 0.01)
    caplog.set_level("INFO")
    opened: list[Ceiling] = []

    def open_camera(config: CameraConfig) -> Ceiling:
        opened.append(Ceiling(config))
        return opened[-1]

    other = Intrinsics(INTRINSICS.camera_matrix, INTRINSICS.distortion, 1280, 960)
    save_intrinsics(tmp_path / "camera.toml", other)

    async def main() -> None:
        async with serving(parse(CONFIG + CAMERA, folder=tmp_path), open_camera=open_camera) as service:
            camera = service.cameras["ceiling"]
            await until(lambda: "640 x 480" in camera.status)
            # Nor does it come and go in the health and in the log with each frame.
            await until(lambda: len(opened) > 2)

    run(main)
    assert "frames are coming" not in caplog.text
    assert caplog.text.count("640 x 480") == 1


def test_a_camera_without_calibration(tmp_path: Path) -> None:
    async def main() -> None:
        with pytest.raises(CalibrationError, match=r"no calibration file .*camera\.toml.*example-camera"):
            Service(parse(CONFIG + CAMERA, folder=tmp_path))

    run(main)


def test_a_dictionary_that_is_not_known(tmp_path: Path) -> None:
    save_intrinsics(tmp_path / "camera.toml", INTRINSICS)
    config = (CONFIG + CAMERA).replace('name = "ceiling"', 'name = "ceiling"\ndictionary = "5X5"')

    async def main() -> None:
        with pytest.raises(ConfigError, match=r'camera "ceiling".*5X5'):
            Service(parse(config, folder=tmp_path))

    run(main)


# Serial lines


@pytest.fixture
def serial_line() -> Any:
    """(our end, name of the service's end) of a pty."""
    ours, theirs = os.openpty()
    tty.setraw(theirs)
    try:
        yield ours, os.ttyname(theirs)
    finally:
        os.close(ours)
        os.close(theirs)


def test_a_robot_on_a_serial_line(serial_line: tuple[int, str]) -> None:
    ours, name = serial_line
    config = CONFIG.replace('name = "cart"', f'name = "cart"\nimu = {{source = "{name}", pose_rate_hz = 50}}')

    async def main() -> None:
        async with serving(config) as service:
            cart = service.robots["cart"]
            await until(lambda: cart.trouble.startswith("it has connected"))
            os.write(ours, b"rubbish\n")
            await until(lambda: cart.dropped == 1)
            assert "cannot be used" in cart.trouble
            for i in range(10):
                sample = {"t": 7.0 + 0.005 * i, "gyro": [0.0, 0.0, 0.0], "accel": [0.0, 0.0, 9.81]}
                os.write(ours, json.dumps(sample).encode() + b"\n")
            await until(lambda: cart.localiser.counts["imu_samples"] == 10)
            assert cart.trouble == ""
            cart.feed_fix(fix("cart"), time.monotonic())
            line = (await asyncio.to_thread(_read_line, ours)).decode()
            pose = json.loads(line)
            assert pose["type"] == "pose"
            assert pose["robot"] == "cart"
            assert pose["t_robot"] == pytest.approx(7.0, abs=30.0)
            async with client(service, "/v1/robot") as connection:
                assert "is on /dev/" in (await hello(connection, "cart"))["reason"]

    run(main)


def _read_line(fd: int) -> bytes:
    line = b""
    while not line.endswith(b"\n"):
        line += os.read(fd, 1)
    return line


def test_a_serial_robot_is_found_out_and_its_mistakes_are_said_before_any_fix(serial_line: tuple[int, str]) -> None:
    """Steadfix frames in g, after a line of something else: the protocol by itself, the unit in words."""
    ours, name = serial_line
    config = CONFIG.replace('name = "cart"', f'name = "cart"\nimu = {{source = "{name}", protocol = "auto"}}')
    noise = np.random.default_rng(1).normal([0, 0, 0, 0, 0, 1], 1e-3, (60, 6)).tolist()

    async def main() -> None:
        async with serving(config) as service:
            cart = service.robots["cart"]
            await until(lambda: cart.trouble.startswith("it has connected"))
            os.write(ours, b"hello\n")
            for i, six in enumerate(noise):
                os.write(ours, steadfix_frame(i, RawSample(0.01 * i, *six)))
            await until(lambda: cart.localiser.counts["imu_samples"] == 60)
            text = "gravity reads 1.0: these are g, not m/s2"
            assert text in cart.diagnose(time.monotonic())
            found = await health(service)
            assert f"robot cart: {text}" in found["reasons"]
            assert found["robots"]["cart"]["imu_protocol"] == "steadfix"
            assert found["robots"]["rover"]["imu_protocol"] is None

    run(main)


def test_a_robot_without_rates_is_degraded_and_says_so(serial_line: tuple[int, str]) -> None:
    """A BNO08x in its RVC mode, which turns to the right: the rates are those of its angles."""
    ours, name = serial_line
    config = CONFIG.replace('name = "cart"', f'name = "cart"\nimu = {{source = "{name}", protocol = "bno08x-rvc"}}')

    async def main() -> None:
        async with serving(config) as service:
            cart = service.robots["cart"]
            await until(lambda: cart.trouble.startswith("it has connected"))
            for i in range(50):
                os.write(ours, rvc_frame(i, 0.5 * i, 0.0, 0.0, (0.0, 0.01 * (i % 3), 9.80665)))
            await until(lambda: cart.localiser.counts["imu_samples"] == 49)
            (said,) = [text for text in cart.diagnose(time.monotonic()) if "no angular rates" in text]
            found = await health(service)
            assert f"robot cart: {said}" in found["reasons"]
            assert found["status"] == "degraded"
            cart.feed_fix(fix("cart"), time.monotonic())
            pose = cart.publish(time.monotonic())
            assert pose is not None
            assert pose.angular_velocity[2] == pytest.approx(-math.radians(50.0), abs=0.1)

    run(main)


def test_a_serial_port_that_is_not_there() -> None:
    config = CONFIG.replace('name = "cart"', 'name = "cart"\nimu = {source = "/dev/nothing"}')

    async def main() -> None:
        async with serving(config) as service:
            await until(lambda: "/dev/nothing" in service.robots["cart"].trouble)
            assert "is the device plugged in?" in service.robots["cart"].trouble

    run(main)


# Data that look wrong


@contextlib.asynccontextmanager
async def sending(connection: ClientConnection, reading: list[float]) -> AsyncIterator[None]:
    """One reading again and again, with some noise, at 200 Hz."""

    async def send() -> None:
        noise = np.random.default_rng(2)
        while True:
            await asyncio.sleep(0.05)  # the pace of this robot
            rows = np.tile(reading, (10, 1)) * noise.normal(1.0, 1e-3, (10, 6))
            stamps = time.monotonic() - 0.005 * np.arange(10)[::-1]
            await connection.send(json.dumps({"type": "imu", "samples": np.column_stack([stamps, rows]).tolist()}))

    async with beside(send()):
        yield


def test_g_that_were_not_declared_are_noticed_and_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("server.app.DIAGNOSE_EVERY", 0.1)

    async def main() -> None:
        async with serving() as service, client(service, "/v1/robot") as connection:
            await hello(connection)
            async with sending(connection, [0.01, 0.01, 0.01, 0.02, 0.01, 1.0]):
                while "these are g" not in (said := (await heard(connection, "notice"))["text"]):
                    pass
            assert any(said in reason for reason in (await health(service))["reasons"])

    run(main)


def test_g_and_degrees_that_were_declared_are_converted() -> None:
    async def main() -> None:
        recording = Recording()
        async with serving(recording=recording) as service, client(service, "/v1/robot") as connection:
            units = {"gyro": "deg/s", "accel": "g"}
            await connection.send(json.dumps({"type": "hello", "robot": "rover", "units": units}))
            await heard(connection, "welcome")
            await connection.send('{"type":"imu","samples":[[5.0,90,-90,720,0.5,0,1]]}')
            await until(lambda: len(recording.batches) == 1)
            expected = [math.pi / 2, -math.pi / 2, 4 * math.pi, 4.903325, 0.0, 9.80665]
            assert recording.batches[0].samples[0, 1:] == pytest.approx(expected)
            assert service.refused == 0

    run(main)


@pytest.mark.parametrize("offset", [365 * 86400.0, -365 * 86400.0])
def test_stamps_a_year_off_are_said_and_survived(offset: float) -> None:
    async def main() -> None:
        async with serving() as service, client(service, "/v1/robot") as connection:
            await hello(connection)
            rover = service.robots["rover"]
            for shift, samples in ((0.0, 10), (offset, 20), (0.0, 30)):
                await connection.send(imu(time.monotonic() + shift))
                await until(lambda samples=samples: rover.localiser.counts["imu_samples"] == samples)
            assert "its clock has jumped or started anew" in (await heard(connection, "notice"))["text"]
            assert (await health(service))["robots"]["rover"]["clock_restarts"] > 0
            rover.feed_fix(fix(), time.monotonic())
            pose = rover.publish(time.monotonic())
            assert pose is not None
            assert pose.position == pytest.approx([1.0, 2.0, 0.0], abs=0.1)

    run(main)


def test_a_robot_that_comes_back_with_another_imu_is_not_judged_by_the_first() -> None:
    async def main() -> None:
        async with serving() as service:
            robot = service.robots["rover"]
            noise = np.random.default_rng(3)
            now = time.monotonic()
            for rate_hz, one, wrong in ((200.0, 1.0, {"accel_unit"}), (50.0, 9.80665, set())):
                robot.connected()
                for _ in range(40):
                    stamps = now + np.arange(1, round(rate_hz / 2) + 1) / rate_hz
                    readings = noise.normal([0.0, 0.0, 0.0, 0.0, 0.0, one], 1e-2, (len(stamps), 6))
                    rows = [(t, *reading) for t, reading in zip(stamps.tolist(), readings.tolist(), strict=True)]
                    now = float(stamps[-1])
                    robot.feed_imu(rows, now, now)
                robot.diagnose(now)
                found = {diagnosis.code for diagnosis in robot.diagnoses}
                assert found & {"accel_unit", "imu_missing", "imu_stamps_repeat"} == wrong
                now += 20.0  # nobody is there meanwhile

    run(main)


def test_a_robot_tells_how_its_wheels_turn() -> None:
    async def main() -> None:
        recording = Recording()
        async with (
            serving(recording=recording) as service,
            Robot(f"ws://127.0.0.1:{service.port}", "rover", clock=lambda: time.monotonic() + 500.0) as robot,
        ):
            rover = service.robots["rover"]
            # Without a stamp they count from their arrival.
            assert await robot.send_wheels([(None, 0.5, None)])
            await until(lambda: len(recording.odometry) == 1)
            assert recording.odometry[0].samples[0, 0] == recording.odometry[0].arrival
            assert await robot.send([(robot.clock(), 0.0, 0.0, 0.0, 0.0, 0.0, 9.80665)])
            await until(lambda: rover.localiser.counts["imu_samples"] == 1)
            now = robot.clock()
            assert await robot.send_wheels([(now - 0.1, 0.5, 0.1), (now, None, 0.2)])
            await until(lambda: len(recording.odometry) == 2)
            samples = recording.odometry[1].samples
            assert samples[:, 0] == pytest.approx([now - 500.1, now - 500.0], abs=0.5)
            assert samples[1, 0] - samples[0, 0] == pytest.approx(0.1, abs=1e-3)
            assert (samples[:, 0] <= recording.odometry[1].arrival).all()
            np.testing.assert_array_equal(samples[:, 1:], [[0.5, 0.1], [np.nan, 0.2]])
            assert service.refused == 0

    run(main)
