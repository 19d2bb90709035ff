"""A robot's side of the wire, in a few lines of asyncio:

    async with Robot("ws://192.168.1.10:5678", "rover", token="...", pose_rate_hz=20) as robot:
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
import ssl
import time
from collections.abc import AsyncIterator, Callable, Iterable, Sequence
from types import TracebackType
from typing import Any, Literal, cast
from urllib.parse import urlsplit

import msgspec
from msgspec import UNSET
from websockets.asyncio.client import ClientConnection
from websockets.exceptions import ConnectionClosed, WebSocketException

from imu.clock import Reading
from server.connecting import FIRST_PAUSE, connect_to_service, longer
from server.messages import (
    FORMATS,
    ClockAnswer,
    ClockQuestion,
    Error,
    Hello,
    Imu,
    Notice,
    PoseMessage,
    ToRobot,
    Units,
    Welcome,
    WheelReading,
    Wheels,
)

log = logging.getLogger("steadfix.robot")

# s for which another connection of the robot's name is waited for at the start: longer than the service takes to see
# that one has died, as after a robot that was switched off and on.
TAKEN_FOR = 5.0
# Samples in one message, at most.
BATCH = 200

_json = msgspec.json.Decoder(ToRobot)
_msgpack = msgspec.msgpack.Decoder(ToRobot)


class RefusedError(ValueError):
    """The service does not take this robot; the text is its reason."""


class AddressError(ValueError):
    """An address that cannot be a service's. The text says what was found and what would be right."""


class Robot:
    """A connection to the service, for `async with`; entering waits until the service has welcomed the robot.

    `url`: of the service, without a path; wss:// where it has a certificate, and `certificate` is the path of that one
    if nobody else vouches for it. `token`: the robot's, by the service's configuration. `pose_rate_hz`: how many poses
    a second it wants back, 0 for none. `units`: of the samples. `format`: on the wire; msgpack is a third smaller.
    `clock`: the robot's clock in s; the IMU's stamps are by the same one.

    `pose`: the newest received, None before the first. `dropped`: samples that could not be sent for want of a
    connection. `notice`: what the service last said of the robot's data, "" for nothing. Raises AddressError for a
    wrong `url`. Entering raises RefusedError with the service's reason, such as a name that it does not know or a wrong
    token, and OSError (ssl.SSLError is one) for a certificate that cannot be read or that nobody vouches for.
    """

    def __init__(
        self,
        url: str,
        name: str,
        *,
        token: str = "",
        pose_rate_hz: float = 20.0,
        units: Units | None = None,
        format: Literal["json", "msgpack"] = "json",
        certificate: str | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        try:
            address = urlsplit(url)
            if address.scheme not in ("ws", "wss") or not address.hostname or address.path not in ("", "/"):
                raise ValueError
        except ValueError:
            raise AddressError(f"{url}: no address of a service; needed: one like ws://192.168.1.10:5678") from None
        self.name = name
        self.clock = clock
        self.pose: PoseMessage | None = None
        self.dropped = 0
        self.notice = ""
        self._url = url.rstrip("/") + "/v1/robot"
        self._certificate = certificate
        self._hello = Hello(name, pose_rate_hz, token, units or Units())
        self._text = format == "json"
        self._encode = FORMATS[format]
        self._pose_received = -math.inf
        self._pose_arrived = asyncio.Event()
        self._connection: ClientConnection | None = None
        self._task: asyncio.Task[None] | None = None
        self._taken_since = math.inf

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
        return await self._send_all(rows, lambda part: Imu(cast(list[Reading], part)))

    async def send_wheels(self, samples: Iterable[Sequence[float | None]]) -> bool:
        """Send readings of the wheels (t, forward speed, yaw rate), oldest first: s of the robot's clock, m/s, rad/s;
        None for one of the two that it does not know. Otherwise as `send`."""
        rows = [tuple(None if value is None else float(value) for value in sample) for sample in samples]
        return await self._send_all(rows, lambda part: Wheels(cast(list[WheelReading], part)))

    async def _send_all(self, rows: Sequence[Any], message: Callable[[Any], msgspec.Struct]) -> bool:
        # Their length is for the service to check: it answers a wrong one with an error in words.
        for i in range(0, len(rows), BATCH):
            if not await self._send(message(rows[i : i + BATCH])):
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

    async def _send(self, message: msgspec.Struct, connection: ClientConnection | None = None) -> bool:
        """Whether there is a connection that takes it."""
        connection = connection or self._connection
        if connection is None:
            return False
        try:
            await connection.send(self._encode(message), text=self._text)
        except ConnectionClosed:
            return False
        return True

    async def _run(self, welcomed: asyncio.Future[None]) -> None:
        """Connect, and again whenever the connection is lost."""
        tls = ssl.create_default_context(cafile=self._certificate) if self._url.startswith("wss:") else None
        pause, said = FIRST_PAUSE, ""
        while True:
            welcome = False
            try:
                async with connect_to_service(self._url, tls) as connection:
                    await self._send(self._hello, connection)
                    async for message in connection:
                        welcome |= await self._receive(connection, message, welcomed)
            except (OSError, TimeoutError, WebSocketException) as error:
                if isinstance(error, ssl.SSLCertVerificationError) and not welcomed.done():
                    raise
                if said != str(error):
                    log.warning("%s: no connection to %s, trying again: %s", self.name, self._url, error)
                said = str(error)
            finally:
                self._connection = None
            pause = FIRST_PAUSE if welcome else longer(pause)
            await asyncio.sleep(pause)

    async def _receive(self, connection: ClientConnection, data: str | bytes, welcomed: asyncio.Future[None]) -> bool:
        """Take one message in; whether it was the welcome."""
        received = self.clock()
        try:
            message: ToRobot = _json.decode(data) if isinstance(data, str) else _msgpack.decode(data)
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
                await self._send(ClockAnswer(id, received, self.clock()), connection)
            case Welcome():
                self._connection = connection
                if not welcomed.done():
                    welcomed.set_result(None)
                return True
            case Notice(text=text):
                self.notice = text
                log.warning("%s: the service says: %s", self.name, text)
            case Error(reason=reason, retry=retry):
                # Before the first welcome it is a refusal, for which trying again is no remedy; but a name that is
                # taken may be so by this very robot, before it was switched off and on.
                if not welcomed.done():
                    self._taken_since = min(self._taken_since, received)
                    if not retry or received - self._taken_since > TAKEN_FOR:
                        raise RefusedError(reason)
                log.warning("%s: the service says: %s", self.name, reason)
        return False
