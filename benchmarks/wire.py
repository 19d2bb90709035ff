"""What the WebSocket costs the service: `python -m benchmarks.imu decoding robots` runs it."""

from __future__ import annotations

import asyncio
import json
import multiprocessing as mp
import os
import time
import timeit
from collections import deque
from collections.abc import Callable
from multiprocessing.connection import Connection

import msgspec
import numpy as np
from tqdm import tqdm
from websockets.asyncio.client import ClientConnection, connect
from websockets.asyncio.server import ServerConnection, broadcast, serve

from fusion.measurements import Array, ImuBatch, Pose, PoseFix, PoseHypothesis, WheelOdometry
from server.app import Service
from server.config import parse
from server.messages import Dialect, Imu

ROBOTS, RATE_HZ, BATCH, POSE_RATE_HZ = 50, 200.0, 10, 50.0
# s: until all is at its pace, and what is then measured.
SETTLE, MEASURE = 3.0, 10.0
# Of the share of a core: it varies by a fifth with what else the machine does, from minute to minute.
RUNS = 5
# s between the fixes of each robot, and how old they are when they come.
FIX_EVERY, FIX_DELAY = 0.5, 0.15


def decoding() -> None:
    """Prints us for a message of ten samples, all of it checked, and of json alone, which checks nothing."""
    message = _message()
    text, binary = json.dumps(message), msgspec.msgpack.encode(message)
    dialect = Dialect()

    def decode(data: str | bytes) -> None:
        found = dialect.decode(data)
        assert isinstance(found, Imu)
        dialect.readings(found)

    for name, work in (
        ("JSON", lambda: decode(text)),
        ("msgpack", lambda: decode(binary)),
        ("json.loads alone", lambda: json.loads(text)),
    ):
        print(f"a batch of {BATCH}, {name:18}{_best_us(work):6.2f} us")


def _message() -> dict[str, object]:
    rng = np.random.default_rng(1)
    rows = np.column_stack([100.0 + np.arange(BATCH) / RATE_HZ, rng.normal(0.0, 1.0, (BATCH, 6))]).round(6)
    return {"type": "imu", "samples": rows.tolist()}


def _best_us(work: Callable[[], object]) -> float:
    return 1e6 * min(timeit.repeat(work, number=2000, repeat=20)) / 2000


def robots() -> None:
    """Prints the share of a core that the service takes for one robot and for fifty, each with a filter and two fixes a
    second, and how long after a batch has come the first pose that holds it leaves.

    Besides the share of what the same messages take where nothing is done with them: both depend on what else the
    machine does, their ratio less. Each is the median of runs that alternate, with the least and the most. The pace of
    the machine meanwhile: us of `json.loads` for a batch, in each round.
    """
    text = json.dumps(_message())
    kinds = (
        ("traffic alone", _traffic, ROBOTS, "json"),
        ("one robot", _service, 1, "json"),
        ("JSON", _service, ROBOTS, "json"),
        ("msgpack", _service, ROBOTS, "msgpack"),
    )
    found: dict[str, list[tuple[float, float, float, Array]]] = {name: [] for name, *_ in kinds}
    pace = []
    for _ in tqdm(range(RUNS), leave=False):
        pace.append(_best_us(lambda: json.loads(text)))
        for name, serving, count, format in kinds:
            found[name].append(_run(serving, count, format, latency=False))
    print(f"{'':14}{'samples/s':>11}{'poses/s':>9}{'of a core':>11}{'least':>8}{'most':>8}{'p50 ms':>9}{'p99 ms':>9}")
    for name, serving, count, format in kinds:
        shares, samples, poses = zip(
            *((share, samples, poses) for share, samples, poses, _ in found[name]), strict=True
        )
        figures = f"{np.median(samples):11.0f}{np.median(poses):9.0f}{np.median(shares):11.3f}"
        figures += f"{min(shares):8.3f}{max(shares):8.3f}"
        if serving is _service:
            *_, delays = _run(serving, count, format, latency=True)
            figures += "".join(f"{1e3 * delay:9.2f}" for delay in np.percentile(delays, (50, 99)))
        print(f"{name:14}{figures}", flush=True)
    print(f"json.loads {', '.join(f'{us:.1f}' for us in pace)} us", end="; ")
    print(f"load average {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")


def _run(
    serving: Callable[[Connection, int, bool], None], count: int, format: str, latency: bool
) -> tuple[float, float, float, Array]:
    context = mp.get_context("spawn")
    ours, theirs = context.Pipe()
    service = context.Process(target=serving, args=(theirs, count, latency), daemon=True)
    service.start()
    clients = context.Process(target=_clients, args=(ours.recv(), count, format), daemon=True)
    clients.start()
    try:
        found: tuple[float, float, float, Array] = ours.recv()
        return found
    finally:
        clients.kill()
        service.kill()
        clients.join()
        service.join()


class _Delays:
    """A recording of nothing but when samples came, and a receiver of poses: from the one to the other, s."""

    def __init__(self) -> None:
        self.found: list[float] = []
        self._waiting: dict[str, deque[float]] = {}

    def imu(self, batch: ImuBatch) -> None:
        self._waiting.setdefault(batch.robot, deque()).append(batch.arrival)

    def fix(self, fix: PoseFix) -> None: ...
    def wheels(self, odometry: WheelOdometry) -> None: ...
    def track(self, robot: str, track: Array) -> None: ...

    def pose(self, pose: Pose) -> None:
        now = time.monotonic()
        waiting = self._waiting.get(pose.robot, deque())
        self.found.extend(now - arrival for arrival in waiting)
        waiting.clear()


def _service(pipe: Connection, count: int, latency: bool) -> None:
    marker = "marker = [{{id = {0}, size_mm = 60}}]"
    config = "[server]\nport = 0\n" + "".join(f'[[robot]]\nname = "r{i}"\n{marker.format(i)}\n' for i in range(count))
    pose = PoseHypothesis(np.array([1.0, 2.0, 0.0]), np.array([1.0, 0.0, 0.0, 0.0]), 1e-5 * np.eye(6))
    delays = _Delays()

    async def main() -> None:
        watch = {"recording": delays, "published": delays.pose} if latency else {}
        async with Service(parse(config), **watch) as service:
            await service.ready.wait()
            fixing = asyncio.create_task(fixes(service))
            pipe.send(service.port)
            await asyncio.sleep(SETTLE)
            delays.found.clear()
            shares = await _measured(lambda: counts(service))
            fixing.cancel()
            pipe.send((*shares, np.array(delays.found)))
            await asyncio.Event().wait()

    async def fixes(service: Service) -> None:
        due = time.monotonic()
        while True:
            for name, robot in service.robots.items():
                due += FIX_EVERY / count
                await asyncio.sleep(due - time.monotonic())
                now = time.monotonic()
                robot.feed_fix(PoseFix(name, now - FIX_DELAY, now, (pose,)), now)

    def counts(service: Service) -> tuple[int, int]:
        robots = service.robots.values()
        return sum(robot.localiser.counts["imu_samples"] for robot in robots), sum(robot.published for robot in robots)

    asyncio.run(main())


async def _measured(counts: Callable[[], tuple[int, int]]) -> tuple[float, float, float]:
    """The share of a core over a while, and samples and poses a second, of which `counts` tells how many there were."""
    before = time.process_time(), time.monotonic(), *counts()
    await asyncio.sleep(MEASURE)
    now = time.process_time(), time.monotonic(), *counts()
    took, passed, samples, poses = (b - a for a, b in zip(before, now, strict=True))
    return took / passed, samples / passed, poses / passed


def _traffic(pipe: Connection, count: int, latency: bool) -> None:
    """In the place of `_service`: it takes the batches unread, and sends as many bytes as poses have."""
    pose = 1100 * b" "
    batches = poses = 0
    connections: set[ServerConnection] = set()

    async def serve_one(connection: ServerConnection) -> None:
        nonlocal batches, poses
        await connection.recv()
        connections.add(connection)
        async for _ in connection:
            batches, poses = batches + 1, poses + 1
            broadcast([connection], pose, text=True)

    async def main() -> None:
        nonlocal poses
        async with serve(serve_one, "127.0.0.1", 0, compression=None) as server:
            pipe.send(server.sockets[0].getsockname()[1])
            await asyncio.sleep(SETTLE)
            measuring = asyncio.create_task(_measured(lambda: (BATCH * batches, poses)))
            due, tick = time.monotonic(), 0
            while not measuring.done():
                # Besides the answers, in three ticks of five: 50 a second in all.
                for i, connection in enumerate(connections):
                    if (i + tick) % 5 < 3:
                        poses += 1
                        broadcast([connection], pose, text=True)
                due, tick = due + 1.0 / POSE_RATE_HZ, tick + 1
                await asyncio.sleep(due - time.monotonic())
            pipe.send((*measuring.result(), np.zeros(0)))
            await asyncio.Event().wait()

    asyncio.run(main())


def _clients(port: int, count: int, format: str) -> None:
    codec = msgspec.json if format == "json" else msgspec.msgpack
    period = BATCH / RATE_HZ

    async def robot(i: int) -> None:
        async with connect(
            f"ws://127.0.0.1:{port}/v1/robot", compression=None, proxy=None, ping_interval=None, max_queue=None
        ) as connection:
            await send(connection, {"type": "hello", "robot": f"r{i}", "pose_rate_hz": POSE_RATE_HZ})
            answering = asyncio.create_task(answer(connection))
            rng = np.random.default_rng(i)
            due = time.monotonic() + period * i / count
            while not answering.done():
                await asyncio.sleep(due - time.monotonic())
                stamps = due - np.arange(BATCH)[::-1] / RATE_HZ
                readings = rng.normal(0.0, 0.01, (BATCH, 6)) + [0.0, 0.0, 0.0, 0.0, 0.0, 9.80665]
                await send(connection, {"type": "imu", "samples": np.column_stack([stamps, readings]).tolist()})
                due += period

    async def send(connection: ClientConnection, message: dict[str, object]) -> None:
        await connection.send(codec.encode(message), text=format == "json")

    async def answer(connection: ClientConnection) -> None:
        async for data in connection:
            received = time.monotonic()
            # A question is short, a pose is not.
            if len(data) < 100 and (question := codec.decode(data))["type"] == "clock":
                times = {"received": received, "sent": time.monotonic()}
                await send(connection, {"type": "clock", "id": question["id"], **times})

    async def main() -> None:
        await asyncio.gather(*(robot(i) for i in range(count)))

    asyncio.run(main())
