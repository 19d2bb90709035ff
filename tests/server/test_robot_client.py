"""The robot's client against the real service, on a real socket."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
from collections.abc import AsyncIterator, Coroutine
from itertools import pairwise
from typing import Any

import msgspec
import numpy as np
import pytest

from fusion.measurements import Pose, PoseFix, PoseHypothesis
from server.app import Service
from server.config import Config, parse
from server.messages import PoseMessage
from server.robot_client import RefusedError, Robot
from tests.server.room import beside

TIMEOUT = 100.0
CONFIG = parse("""
[server]
port = 0
[[robot]]
name = "rover"
[[robot.marker]]
id = 7
size_mm = 60
""")
# The robot's clock, s ahead of the host's.
AHEAD = 5000.0


def run(test: Coroutine[Any, Any, None]) -> None:
    asyncio.run(asyncio.wait_for(test, TIMEOUT))


def at_port(port: int) -> Config:
    return msgspec.structs.replace(CONFIG, server=msgspec.structs.replace(CONFIG.server, port=port))


def robot_of(service: Service, **options: Any) -> Robot:
    return Robot(f"ws://127.0.0.1:{service.port}", "rover", clock=lambda: time.monotonic() + AHEAD, **options)


@contextlib.asynccontextmanager
async def at_rest(service: Service, robot: Robot) -> AsyncIterator[None]:
    """The robot stands at (1, 2), sends its IMU at 100 Hz, and a camera sees it."""

    async def work() -> None:
        while True:
            await robot.send([(robot.clock() - 0.01 * i, 0, 0, 0, 0, 0, 9.80665) for i in (4, 3, 2, 1, 0)])
            if service.ready.is_set():
                now = time.monotonic()
                pose = PoseHypothesis(np.array([1.0, 2.0, 0.0]), np.array([1.0, 0, 0, 0]), np.eye(6) * 1e-4)
                service.robots["rover"].feed_fix(PoseFix("rover", now - 0.05, now, (pose,)), now)
            await asyncio.sleep(0.05)

    async with beside(work()):
        yield


async def poses(robot: Robot, count: int) -> list[PoseMessage]:
    received = []
    async for pose in robot.poses():
        received.append(pose)
        if len(received) == count:
            break
    return received


def test_imu_up_and_poses_down() -> None:
    async def test() -> None:
        async with (
            Service(CONFIG) as service,
            robot_of(service, pose_rate_hz=25) as robot,
            at_rest(service, robot),
        ):
            assert robot.connected
            received = await poses(robot, 10)
            assert received[-1] is robot.pose
            assert all(pose.robot == "rover" for pose in received)
            assert all(a.seq < b.seq and a.t < b.t for a, b in pairwise(received))
            assert received[-1].position == pytest.approx([1.0, 2.0, 0.0], abs=0.05)

    run(test())


def test_the_clock_is_exchanged() -> None:
    """The service knows the robot's clock to a few ms, and says the poses' time by it."""

    async def test() -> None:
        async with Service(CONFIG) as service, robot_of(service) as robot, at_rest(service, robot):
            async for pose in robot.poses():
                delay = service.robots["rover"].clock.minimum_delay
                if delay is not None and isinstance(pose.t_robot, float):
                    break
            assert 0.0 <= delay < 1.0
            # The round trip on one machine bounds the error; that takes long only where the machine is busy.
            assert pose.t_robot == pytest.approx(pose.t + AHEAD, abs=1.0)
            assert -1.0 < robot.pose_age < 10.0

    run(test())


def test_without_poses_none_come() -> None:
    async def test() -> None:
        published: list[Pose] = []
        async with (
            Service(CONFIG, published=published.append) as service,
            robot_of(service, pose_rate_hz=0) as robot,
            at_rest(service, robot),
        ):
            while len(published) < 10:
                await asyncio.sleep(0.01)
            assert robot.pose is None
            assert robot.pose_age == float("inf")

    run(test())


def test_an_unknown_name_is_refused_in_words() -> None:
    async def test() -> None:
        async with Service(CONFIG) as service:
            with pytest.raises(RefusedError, match=r'no robot "mule".*known: rover'):
                async with Robot(f"ws://127.0.0.1:{service.port}", "mule"):
                    pass

    run(test())


def test_it_waits_for_the_service_and_comes_back_to_it() -> None:
    async def test() -> None:
        async with Service(CONFIG) as service:
            port = service.port
        robot = robot_of(service)
        entering = asyncio.create_task(robot.__aenter__())
        async with Service(at_port(port)) as service:
            await entering
            async with at_rest(service, robot):
                first = (await poses(robot, 1))[0]
        async with Service(at_port(port)) as service, at_rest(service, robot):
            async for pose in robot.poses():
                if pose.seq < first.seq or pose.published > first.published + 1.0:
                    break
        assert robot.dropped > 0, "what could not be sent meanwhile"
        await robot.__aexit__(None, None, None)
        assert not await robot.send([(0, 0, 0, 0, 0, 0, 9.8)])
        assert [pose async for pose in robot.poses()] == []

    run(test())


def test_what_the_service_cannot_use_is_said_and_survived(caplog: pytest.LogCaptureFixture) -> None:
    async def test() -> None:
        async with Service(CONFIG) as service, robot_of(service) as robot, at_rest(service, robot):
            with caplog.at_level(logging.WARNING, "steadfix.robot"):
                await robot.send([(robot.clock(), 0, 0, 4000.0, 0, 0, 9.8)])
                await robot.send([(robot.clock(), 0, 0, 0, 0, 9.8)])
                await robot.send([(robot.clock(), 0, 0, 0, 0, 0, float("nan"))])
                await poses(robot, 2)
            said = [record.message for record in caplog.records if record.name == "steadfix.robot"]
            assert len(said) == 3
            assert "sample 0, gz: found 4000.0; needed: rad/s" in said[0]
            assert "sample 0: found a list of 6" in said[1]
            assert "sample 0, az: found null" in said[2]

    run(test())


def test_leaving_while_waiting_for_the_service() -> None:
    async def test() -> None:
        async with Service(CONFIG) as service:
            pass
        before = asyncio.all_tasks()
        with pytest.raises(TimeoutError):
            async with asyncio.timeout(0.2), robot_of(service):
                pass
        assert asyncio.all_tasks() == before

    run(test())
