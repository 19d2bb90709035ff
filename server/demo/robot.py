"""One simulated robot, as a process of its own: `python -m server.demo.robot --name rover --url ws://... `.

It knows the service only as a real robot does: it sends its IMU's samples, stamped by its own clock, and steers by the
poses that come back. Its standard output is the truth, one line `t x y yaw` (host monotonic s, m, rad) each 10 ms, for
the simulated camera and the score; when nobody reads that any more, it ends.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import math
import os
import random
import sys
import time
from collections.abc import Sequence
from typing import Protocol

import msgspec

from fusion.geometry import wrap
from server.demo.body import Body, Imu
from server.demo.courses import Course, course
from server.messages import PoseMessage
from server.robot_client import RefusedError, Robot

IMU_RATE_HZ = 200.0
# Samples that are sent together.
BATCH = 5
POSE_RATE_HZ = 20.0
# s: a pose of an older instant is not steered by.
STALE = 0.5
# m from the robot along its course to the point that it heads for; rad/s that it allows itself.
LOOK_AHEAD = 0.2
MAX_TURN_RATE = 3.0
# m from the course at which the robot looks for it anew.
LOST = 0.4


class DeviceClock:
    """The robot's clock: s since it was switched on, by a crystal that is a little off."""

    def __init__(self, seed: str) -> None:
        chance = random.Random(f"clock {seed}")
        self.rate = 1.0 + chance.uniform(-60e-6, 60e-6)
        self._started = time.monotonic() - chance.uniform(10.0, 1000.0)

    def __call__(self) -> float:
        return self.at(time.monotonic())

    def at(self, t: float) -> float:
        """Device time at host time `t`."""
        return (t - self._started) * self.rate


class Link(Protocol):
    """What a robot needs of its connection: `Robot` is one, `SerialLink` the other."""

    @property
    def pose(self) -> PoseMessage | None: ...
    @property
    def pose_age(self) -> float: ...
    async def send(self, samples: Sequence[Sequence[float]]) -> bool: ...


class SerialLink:
    """A microcontroller's side of a serial line: JSON lines up, poses down. `fd` is the line."""

    def __init__(self, fd: int, clock: DeviceClock) -> None:
        self.pose: PoseMessage | None = None
        self._fd = fd
        self._clock = clock
        self._partial = b""
        self._decoder = msgspec.json.Decoder(PoseMessage)
        os.set_blocking(fd, False)

    @property
    def pose_age(self) -> float:
        if self.pose is None or not isinstance(self.pose.t_robot, float):
            return math.inf
        return self._clock() - self.pose.t_robot

    async def send(self, samples: Sequence[Sequence[float]]) -> bool:
        self._receive()
        lines = [
            json.dumps({"t": round(t, 6), "gyro": [round(v, 6) for v in gyro], "accel": [round(v, 5) for v in accel]})
            for t, gyro, accel in ((row[0], row[1:4], row[4:7]) for row in samples)
        ]
        data = ("\n".join(lines) + "\n").encode()
        try:
            return os.write(self._fd, data) == len(data)
        except BlockingIOError:
            return False  # nobody listens; a UART would send into the void as well

    def _receive(self) -> None:
        with contextlib.suppress(BlockingIOError):
            while data := os.read(self._fd, 65536):
                *lines, self._partial = (self._partial + data).split(b"\n")
                for line in lines:
                    with contextlib.suppress(msgspec.DecodeError):
                        self.pose = self._decoder.decode(line)
        self._partial = self._partial[-8192:]


class Driver:
    """Follows a course by published poses: pure pursuit (R. C. Coulter, CMU-RI-TR-92-01, 1992)."""

    def __init__(self, course: Course) -> None:
        self.course = course
        self._station: float | None = None
        self._stop_until = -math.inf

    def steer(self, pose: PoseMessage | None, age: float, now: float) -> tuple[float, float]:
        """(speed, turn rate) in m/s and rad/s for a pose that is `age` s old."""
        if pose is None:
            # Turning on the spot, a little forward: what a robot can do that does not know where it is.
            return 0.03, 0.3
        if age > STALE or pose.mode not in ("FULL", "COAST"):
            return 0.0, 0.0
        if now < self._stop_until:
            return 0.0, 0.0
        # From the instant of the pose to now, by its own velocity.
        yaw = pose.yaw + pose.angular_velocity[2] * age
        x, y = (pose.position[i] + pose.velocity[i] * age for i in range(2))
        course = self.course
        station = course.nearest(x, y, self._station)
        px, py = course.at(station)
        if math.hypot(px - x, py - y) > LOST:
            station = course.nearest(x, y, None)
        before, self._station = self._station, station
        if before is not None and any(
            0.0 < (stop - before) % course.length <= (station - before) % course.length < 0.5 for stop in course.stops
        ):
            self._stop_until = now + course.pause
        tx, ty = course.at(station + LOOK_AHEAD)
        distance, bearing = math.hypot(tx - x, ty - y), wrap(math.atan2(ty - y, tx - x) - yaw)
        if abs(bearing) > 0.5 * math.pi:
            return 0.0, math.copysign(1.0, bearing)
        curvature = 2.0 * math.sin(bearing) / max(distance, LOOK_AHEAD)
        speed = course.speed if pose.mode == "FULL" else 0.5 * course.speed
        speed = min(speed, MAX_TURN_RATE / max(abs(curvature), 1e-6)) * max(0.2, math.cos(bearing))
        return speed, speed * curvature


async def drive(link: Link, clock: DeviceClock, course: Course, seed: str) -> None:
    """Until the truth is not read any more, which is a BrokenPipeError."""
    chance = random.Random(f"start {seed}")
    start = chance.uniform(0.0, course.length)
    x, y = course.at(start)
    body = Body(x + chance.gauss(0.0, 0.03), y + chance.gauss(0.0, 0.03), course.heading(start), seed)
    imu, driver = Imu(seed, IMU_RATE_HZ), Driver(course)
    h = 1.0 / (IMU_RATE_HZ * clock.rate)
    t, count = time.monotonic(), 0
    truth: list[str] = []
    samples: list[tuple[float, ...]] = []
    while True:
        await asyncio.sleep(t + BATCH * h - time.monotonic())
        samples.clear()
        truth.clear()
        for _ in range(BATCH):
            body.step(h)
            t += h
            count += 1
            gyro, accel = imu.read(body)
            samples.append((clock.at(t), *gyro, *accel))
            if count % 2 == 0:
                truth.append(f"{t:.6f} {body.x:.6f} {body.y:.6f} {body.yaw:.6f}\n")
        os.write(sys.stdout.fileno(), "".join(truth).encode())
        await link.send(samples)
        body.command(*driver.steer(link.pose, link.pose_age, time.monotonic()))


async def _main(args: argparse.Namespace) -> None:
    seed = f"{args.name} {args.seed}"
    clock = DeviceClock(seed)
    path = course(args.course)
    if args.serial_fd is not None:
        await drive(SerialLink(args.serial_fd, clock), clock, path, seed)
    else:
        robot = Robot(args.url, args.name, pose_rate_hz=POSE_RATE_HZ, clock=clock)
        # Side by side: a robot stands in the room, and can be seen, before it has reached the service.
        both = [asyncio.create_task(_connect(robot)), asyncio.create_task(drive(robot, clock, path, seed))]
        done, _ = await asyncio.wait(both, return_when=asyncio.FIRST_COMPLETED)
        for task in done:
            task.result()


async def _connect(robot: Robot) -> None:
    async with robot:
        await asyncio.Event().wait()


def main() -> int:
    parser = argparse.ArgumentParser(description="One simulated robot of the demo room.")
    parser.add_argument("--name", required=True)
    parser.add_argument("--course", required=True, choices=["eight", "rectangle", "stops"])
    parser.add_argument("--seed", type=int, default=0)
    way = parser.add_mutually_exclusive_group(required=True)
    way.add_argument("--url", help="of the service, such as ws://127.0.0.1:5678")
    way.add_argument("--serial-fd", type=int, help="an open file descriptor: the device's end of a serial line")
    try:
        asyncio.run(_main(parser.parse_args()))
    except BrokenPipeError:
        pass  # the room is gone
    except (OSError, RefusedError) as error:
        print(f"demo robot: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
