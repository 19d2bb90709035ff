"""A robot's side of the wire, in a few lines of asyncio:

    async with Robot("ws://192.168.1.10:5678", "rover", pose_rate_hz=20) as robot:
        while True:
            await robot.send([read_imu()])  # (t, gx, gy, gz, ax, ay, az), t by robot.clock()
            if robot.pose and robot.pose_age < 0.5:
                steer(robot.pose.position, robot.pose.yaw)

It answers the service's questions about the robot's clock by itself, and connects again whenever the connection is
lost.
"""

from __future__ import annotations

import asyncio
import logging
import math
import time
from collections.abc import AsyncIterator, Callable, Iterable, Sequence
from types import TracebackType

import msgspec
from msgspec import UNSET
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, WebSocketException

from server.messages import ClockAnswer, ClockQuestion, Error, Hello, Imu, PoseMessage, Welcome, encode

log = logging.getLogger("steadfix.robot")

# s before connecting again: the first pause, which doubles up to the longest.
FIRST_PAUSE, LONGEST_PAUSE = 0.25, 5.0
# s between asking the service for a sign of life, and until a connection without one is given up.
PING_INTERVAL, PING_TIMEOUT = 2.0, 3.0
# Samples in one message, at most.
BATCH = 200

_decoder = msgspec.json.Decoder(Welcome | ClockQuestion | PoseMessage | Error)


class RefusedError(ValueError):
    """The service does not take this robot; the text is its reason."""


class Robot:
    """A connection to the service, for `async with`; entering waits until the service has welcomed the robot.

    `url`: of the service, without a path. `pose_rate_hz`: how many poses a second it wants back, 0 for none.
    `clock`: the robot's clock in s; the IMU's stamps are by the same one.

    `pose`: the newest received, None before the first. `dropped`: samples that could not be sent for want of a
    connection. Entering raises RefusedError with the service's reason, such as a name it does not know.
    """

    def __init__(
        self, url: str, name: str, *, pose_rate_hz: float = 20.0, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.name = name
        self.clock = clock
        self.pose: PoseMessage | None = None
        self.dropped = 0
        self._url = url.rstrip("/") + "/v1/robot"
        self._pose_rate_hz = pose_rate_hz
        self._pose_received = -math.inf
        self._pose_arrived = asyncio.Event()
        self._connection: ClientConnection | None = None
        self._task: asyncio.Task[None] | None = None

    async def __aenter__(self) -> Robot:
        welcomed = asyncio.get_running_loop().create_future()
        self._task = asyncio.create_task(self._run(welcomed), name=f"robot {self.name}")
        try:
            await asyncio.wait((self._task, welcomed), return_when=asyncio.FIRST_COMPLETED)
            if self._task.done():
                self._task.result()
        except BaseException:
            await self.__aexit__(None, None, None)
            raise
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if self._task is not None:
            self._task.cancel()
            await asyncio.wait((self._task,))
            self._task = None
        self._pose_arrived.set()

    @property
    def connected(self) -> bool:
        return self._connection is not None

    @property
    def pose_age(self) -> float:
        """s since the instant that `pose` is for, by the robot's clock; inf without a pose."""
        if self.pose is None:
            return math.inf
        return self.clock() - (self._pose_received if self.pose.t_robot is UNSET else self.pose.t_robot)

    async def send(self, samples: Iterable[Sequence[float]]) -> bool:
        """Send IMU samples (t, gx, gy, gz, ax, ay, az), oldest first: s of the robot's clock, rad/s, m/s2.

        5 to 10 at a time are best. False if there is no connection at present: the samples are dropped, since those of
        some seconds ago are of no use to anybody.
        """
        rows = [tuple(map(float, sample)) for sample in samples]
        connection = self._connection
        try:
            for i in range(0, len(rows), BATCH):
                if connection is None:
                    self.dropped += len(rows) - i
                    return False
                # The tuples' length is for the service to check: it answers a wrong one with an error in words.
                await connection.send(encode(Imu(rows[i : i + BATCH])), text=True)
        except ConnectionClosed:
            self.dropped += len(rows) - i
            return False
        return True

    async def poses(self) -> AsyncIterator[PoseMessage]:
        """Each pose as it arrives; a consumer that is slow gets the newest next. Ends with the `async with`."""
        last: PoseMessage | None = None
        while self._task is not None:
            if self.pose is None or self.pose is last:
                await self._pose_arrived.wait()
            else:
                last = self.pose
                yield last

    async def _run(self, welcomed: asyncio.Future[None]) -> None:
        """Connect, and again whenever the connection is lost."""
        pause = FIRST_PAUSE
        while True:
            welcome = False
            try:
                async with connect(
                    self._url,
                    compression=None,
                    max_size=1 << 16,
                    ping_interval=PING_INTERVAL,
                    ping_timeout=PING_TIMEOUT,
                    proxy=None,
                ) as connection:
                    await connection.send(encode(Hello(self.name, self._pose_rate_hz)), text=True)
                    async for message in connection:
                        welcome |= await self._receive(connection, message, welcomed)
            except (OSError, TimeoutError, WebSocketException) as error:
                log.info("%s: no connection to %s: %s", self.name, self._url, error)
            finally:
                self._connection = None
            pause = FIRST_PAUSE if welcome else min(2.0 * pause, LONGEST_PAUSE)
            await asyncio.sleep(pause)

    async def _receive(self, connection: ClientConnection, data: str | bytes, welcomed: asyncio.Future[None]) -> bool:
        """Take one message in; whether it was the welcome."""
        received = self.clock()
        try:
            message = _decoder.decode(data)
        except msgspec.DecodeError as error:
            log.debug("%s: a message of a newer service? %s", self.name, error)
            return False
        match message:
            case PoseMessage():
                self.pose, self._pose_received = message, received
                # Those who wait now are woken; who comes later waits for the next.
                self._pose_arrived.set()
                self._pose_arrived = asyncio.Event()
            case ClockQuestion(id=id):
                await connection.send(encode(ClockAnswer(id, received, self.clock())), text=True)
            case Welcome():
                self._connection = connection
                if not welcomed.done():
                    welcomed.set_result(None)
                return True
            case Error(reason=reason):
                # Before the first welcome it is a refusal, for which trying again is no remedy.
                if not welcomed.done():
                    raise RefusedError(reason)
                log.warning("%s: the service says: %s", self.name, reason)
        return False
