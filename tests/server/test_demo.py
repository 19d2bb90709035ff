"""The demo room: its parts by themselves, and for a few seconds in front of the real service."""

from __future__ import annotations

import asyncio
import math
import os
import random
import select
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import msgspec
import numpy as np
import pytest

from fusion.geometry import wrap
from fusion.measurements import Array, Mode, Pose
from fusion.params import GRAVITY
from server.app import Service
from server.config import Config
from server.demo.body import ROOM_X, ROOM_Y, Body, Imu
from server.demo.courses import SPACING, course
from server.demo.robot import STALE, Driver
from server.demo.room import COURSES, DemoRoom
from server.demo.truth import HISTORY
from server.messages import PoseMessage, pose_message

TIMEOUT = 100.0
H = 0.005
CHILDREN = Path("/proc/self/task") / str(os.getpid()) / "children"

linux = pytest.mark.skipif(not CHILDREN.exists(), reason="this system has no /proc to look for processes in")


def published(body: Body, t: float = 0.0, mode: Mode = Mode.FULL) -> PoseMessage:
    """The truth, as a pose."""
    pose = Pose.of(
        robot="rover",
        t=t,
        position=np.array([body.x, body.y, 0.0]),
        quaternion_wxyz=np.array([math.cos(0.5 * body.yaw), 0.0, 0.0, math.sin(0.5 * body.yaw)]),
        velocity=np.array([body.speed * math.cos(body.yaw), body.speed * math.sin(body.yaw), 0.0]),
        angular_velocity=np.array([0.0, 0.0, body.turn_rate]),
        covariance=np.eye(6),
        velocity_covariance=np.eye(3),
        mode=mode,
        reset_id=0,
        fix_age=0.1,
    )
    return pose_message(pose, t, 1)


@pytest.mark.parametrize("name", COURSES.values())
def test_a_course_is_closed_and_even(name: str) -> None:
    points = course(name).points
    steps = [math.dist(a, b) for a, b in pairwise([*points, points[0]])]
    assert steps == pytest.approx([SPACING] * len(steps), rel=0.02)
    assert all(abs(x) < ROOM_X - 0.15 and abs(y) < ROOM_Y - 0.15 for x, y in points)


def test_the_courses_keep_apart() -> None:
    courses = [course(name).points for name in COURSES.values()]
    for i in range(3):
        for j in range(i):
            assert min(math.dist(a, b) for a in courses[i][::5] for b in courses[j][::5]) > 0.5


@pytest.mark.parametrize("name", COURSES.values())
@pytest.mark.parametrize("turned", [0.0, 3.0])
def test_a_robot_that_knows_where_it_is_stays_on_its_course(name: str, turned: float) -> None:
    """Ninety seconds of simulated time, steering 40 times a second; also after a start in the wrong direction."""
    path = course(name)
    body = Body(*path.at(0.0), path.heading(0.0) + turned, seed="test")
    driver = Driver(path)
    distances, speeds = [], []
    for i in range(18000):
        if i % 5 == 0:
            body.command(*driver.steer(published(body), 0.0, i * H))
            distances.append(math.dist((body.x, body.y), path.at(path.nearest(body.x, body.y, None))))
        body.step(H)
        speeds.append(body.speed)
    assert max(distances[600:]) < 0.08
    rounds = sum(speeds) * H / path.length
    assert rounds > 5.0
    assert max(speeds) < path.speed * 1.1
    at_rest = sum(abs(speed) < 1e-3 for speed in speeds[3000:]) * H
    assert (at_rest > 0.8 * path.pause * len(path.stops) * (rounds - 2.0)) if path.stops else at_rest == 0.0


def test_when_a_robot_stops() -> None:
    path = course("rectangle")
    body = Body(*path.at(0.0), path.heading(0.0), seed="test")
    speed, turn_rate = Driver(path).steer(None, math.inf, 0.0)
    assert 0.0 < speed < 0.1, "it creeps as long as it has never had a pose"
    assert turn_rate > 0.0
    assert Driver(path).steer(published(body), STALE * 1.01, 0.0) == (0.0, 0.0)
    for mode in set(Mode) - {Mode.FULL, Mode.COAST}:
        assert Driver(path).steer(published(body, mode=mode), 0.1, 0.0) == (0.0, 0.0)
    full, coast = (Driver(path).steer(published(body, mode=mode), 0.1, 0.0)[0] for mode in (Mode.FULL, Mode.COAST))
    assert 0.4 * full < coast < 0.6 * full


def test_a_body_without_commands_comes_to_rest() -> None:
    body = Body(0.0, 0.0, 0.0, seed="test")
    body.command(0.5, 1.0)
    for _ in range(40):
        body.step(H)
    assert body.speed > 0.3
    for _ in range(200):
        body.step(H)
    assert abs(body.speed) < 1e-3
    assert abs(body.turn_rate) < 1e-2


def test_a_body_does_not_pass_the_walls() -> None:
    body = Body(ROOM_X - 0.1, 0.0, 0.0, seed="test")
    for _ in range(400):
        body.command(0.5, 0.0)
        body.step(H)
    assert ROOM_X - 0.01 < body.x <= ROOM_X


def test_the_imu_measures_what_the_body_does() -> None:
    """A circle at constant speed: the mean over whole turns, beside what bias and scale allow."""
    body, imu = Body(0.0, 0.0, 0.0, seed="test"), Imu("test", 1.0 / H)
    gyro, accel = [], []
    for _ in range(4000):
        body.command(0.4, 1.0)
        body.step(H)
        rate, force = imu.read(body)
        gyro.append(rate)
        accel.append(force)
    assert np.mean(gyro[1000:], axis=0) == pytest.approx([0.0, 0.0, 1.0], abs=0.05)
    assert np.mean(accel[1000:], axis=0) == pytest.approx([0.0, 0.4, GRAVITY], abs=0.4)
    assert 0.1 < np.std(accel[1000:], axis=0)[2] < 0.5, "it shakes"
    assert len({value for sample in gyro for value in sample}) < 3 * 1000, "the digits have steps"


def test_the_score() -> None:
    """Poses that are 30 mm and 2 degrees off, one that comes before its truth, and one that jumps by 40 mm."""
    room = DemoRoom()
    try:
        now = time.monotonic()
        times = now - 1.0 + 0.01 * np.arange(101)
        room._append("rover", [(t, math.sin(t), 0.5 * t, 3.0 * t) for t in times.tolist()])
        early = float(times[-1]) + 0.005
        for t in (*times[10:60:2].tolist(), early):
            room.score(_off(t, 0.03))
        room._append("rover", [(t, math.sin(t), 0.5 * t, 3.0 * t) for t in (early + 0.005, early + 0.015)])
        room.score(_off(early + 0.01, 0.07))
        score = room._scores["rover"]
        assert score.count == 27
        assert math.sqrt(score.position_squares / score.count) == pytest.approx(
            math.sqrt((26 * 0.03**2 + 0.07**2) / 27), rel=1e-3
        )
        assert score.yaw_worst == pytest.approx(math.radians(2.0), rel=1e-3)
        assert score.step == pytest.approx(0.04, rel=1e-3)
        assert score.gap == pytest.approx(early - times[58], abs=1e-9)
        room.score(_off(now - 3 * HISTORY, 0.0))
        room.score(_off(now + 3600.0, 0.0))
        assert score.count == 27, "poses without truth do not count"
        rover, mule = (line for line in room.report().splitlines() if line.startswith(("rover", "mule")))
        assert rover.split()[:4] == ["rover", "27", "32.4", "70.0"]
        assert mule.split() == ["mule", "0", "no", "pose"]
    finally:
        room.stop()


def _off(t: float, error: float) -> Pose:
    yaw = wrap(3.0 * t + math.radians(2.0))
    return Pose.of(
        robot="rover",
        t=t,
        position=np.array([math.sin(t) - error, 0.5 * t, 0.01]),
        quaternion_wxyz=np.array([math.cos(0.5 * yaw), 0.0, 0.0, math.sin(0.5 * yaw)]),
        velocity=np.zeros(3),
        angular_velocity=np.zeros(3),
        covariance=np.eye(6),
        velocity_covariance=np.eye(3),
        mode=Mode.FULL,
        reset_id=0,
        fix_age=0.1,
    )


def at_any_port(config: Config) -> Config:
    return msgspec.structs.replace(config, server=msgspec.structs.replace(config.server, port=0))


def open_files() -> set[str]:
    """Pipes, terminals and shared memory that this process holds."""
    there = set()
    for fd in Path("/proc/self/fd").iterdir():
        try:
            target = os.readlink(fd)
        except OSError:
            continue
        if target.startswith(("pipe:", "/dev/pts", "/dev/ptmx", "/dev/shm")):
            there.add(target)
    return there


@linux
def test_the_robots_drive_by_the_published_poses_and_nothing_remains() -> None:
    before = open_files()
    children = CHILDREN.read_text()

    async def test() -> DemoRoom:
        room = DemoRoom()
        truth: dict[str, list[Array]] = {name: [] for name in COURSES}
        room.record_truth = lambda robot, t, position, quaternion: truth[robot].append(position)
        enough = asyncio.Event()

        def score(pose: Pose) -> None:
            room.score(pose)
            if all(score.count >= 150 for score in room._scores.values()):
                enough.set()

        try:
            async with Service(at_any_port(room.config()), None, room.open_camera, score) as service:
                room.start(f"ws://127.0.0.1:{service.port}")
                await asyncio.wait_for(enough.wait(), TIMEOUT)
        finally:
            room.stop()
        assert all(robot.poll() is not None for robot in room._robots.values())
        for name, positions in truth.items():
            assert np.ptp(positions, axis=0)[:2].max() > 0.15, f"{name} has not driven"
        return room

    room = asyncio.run(test())
    for name, score in room._scores.items():
        assert math.sqrt(score.position_squares / score.count) < 0.05, name
    room.stop()
    assert CHILDREN.read_text() == children
    assert open_files() == before


@linux
def test_the_remote_camera_is_killed_and_comes_back(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fixes come from a process with a clock of its own; poses are as good as with the camera here."""

    monkeypatch.setattr("server.demo.room.RESTART", 0.1)
    errors: dict[str, float] = {}

    async def test() -> None:
        room = DemoRoom(remote_camera=True)
        try:
            async with Service(at_any_port(room.config()), None, room.open_camera, room.score) as service:
                room.start(f"ws://127.0.0.1:{service.port}")
                camera = service.cameras["ceiling"]

                async def until(what: Callable[[], bool]) -> None:
                    async with asyncio.timeout(TIMEOUT):
                        while not what():
                            await asyncio.sleep(0.01)

                await until(lambda: all(score.count >= 150 for score in room._scores.values()))
                errors.update(
                    {name: math.sqrt(score.position_squares / score.count) for name, score in room._scores.items()}
                )
                first = room._camera
                assert first is not None
                first.kill()
                await until(lambda: "has gone; waiting for it" in camera.status)
                frames = camera.frames
                await until(lambda: camera.frames > frames and camera.status == "")
                assert room._camera is not None
                assert room._camera.pid != first.pid
        finally:
            room.stop()

    children = CHILDREN.read_text()
    asyncio.run(test())
    # As long as the camera was there; without it the robots drift, as they have learnt little of their IMUs yet. Stamps
    # of the wrong clock would put them metres away, or nowhere.
    assert max(errors.values()) < 0.1
    assert CHILDREN.read_text() == children


@linux
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
def test_the_robots_end_with_the_service_however_it_ends(number: signal.Signals) -> None:
    service = subprocess.Popen(
        [sys.executable, "-m", "server.cli", "run", "--port", "0"],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    robots: list[int] = []
    try:
        assert service.stdout is not None
        assert "http://" in service.stdout.readline()
        children = Path(f"/proc/{service.pid}/task/{service.pid}/children")
        robots = [os.pidfd_open(int(pid)) for pid in children.read_text().split()]
        assert len(robots) == 3
        service.send_signal(number)
        status = service.wait(TIMEOUT)
        assert status == (-signal.SIGKILL if number == signal.SIGKILL else 0)
        for robot in robots:
            assert select.select([robot], [], [], TIMEOUT)[0], "a robot without a room"
    finally:
        service.kill()
        service.communicate()
        for robot in robots:
            os.close(robot)


def test_frames_come_late_and_not_all_of_them() -> None:
    """An empty room: the anchors alone. Twelve frames take about five seconds."""
    room = DemoRoom()
    try:
        config = room.config()
        camera = room.open_camera(config.camera[0])
        camera._random = random.Random(5)
        frames = []
        while len(frames) < 12:
            frame = camera.read(1.0)
            assert frame is not None
            assert frame.image.shape == (1088, 1088)
            assert time.monotonic() - frame.t > 0.09
            frames.append(frame)
        assert all(a.t < b.t and a.sequence < b.sequence for a, b in pairwise(frames))
    finally:
        room.stop()
    assert camera.read(1.0) is None
    camera.close()
