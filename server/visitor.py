"""Whoever has opened a WebSocket: who it is, how it speaks, what it may still send, and what it is told."""

from __future__ import annotations

import asyncio
import functools
import logging
import time
from collections.abc import Callable
from typing import TypeVar

import msgspec
from websockets.asyncio.server import ServerConnection, broadcast
from websockets.datastructures import Headers
from websockets.frames import DATA_OPCODES, Frame, Opcode
from websockets.protocol import Event

from server.access import is_local, token_matches
from server.messages import Dialect, Error, MessageError, Notice

log = logging.getLogger("steadfix")

# Bytes a second that a connection may send, each message counting for so many more, and the seconds that it may have
# been silent to send more at once. An IMU of 1 kHz that sends each sample alone needs a third.
BYTES_PER_SECOND = 2_000_000
MESSAGE_COST = 500
SAVED_UP = 5.0
# s before one who showed a wrong token is told, so that nobody can try many.
WRONG_TOKEN_PAUSE = 1.0
# s until a robot must have said who it is.
HELLO_TIMEOUT = 10.0

T = TypeVar("T")


class RefusedError(Exception):
    """A client that cannot be served. The text is what it is told before its connection is closed.

    `retry`: whether the same may work later.
    """

    def __init__(self, reason: str, retry: bool = False) -> None:
        super().__init__(reason)
        self.retry = retry


class Connection(ServerConnection):
    """A connection that hands messages over where they come, to whoever waits for them, instead of waking it."""

    # Takes a message, or leaves it to `recv` by False.
    at_once: Callable[[str | bytes], bool] | None = None

    def process_event(self, event: Event) -> None:
        if self.at_once is not None and isinstance(event, Frame) and event.opcode in DATA_OPCODES:
            if event.fin and event.opcode is not Opcode.CONT and self._handed_over(event, self.at_once):
                return
            self.at_once = None  # what follows must wait behind this one
        super().process_event(event)

    def _handed_over(self, frame: Frame, at_once: Callable[[str | bytes], bool]) -> bool:
        try:
            data = str(frame.data, "utf-8") if frame.opcode is Opcode.TEXT else bytes(frame.data)
        except UnicodeDecodeError:
            return False
        return at_once(data)


class Visitor:
    """One connection: who it is, how it speaks, what it may still send, and what it was refused."""

    def __init__(self, connection: Connection, path: str) -> None:
        assert connection.request is not None
        self.connection = connection
        peer = connection.remote_address
        self.address = f"{peer[0]}:{peer[1]}" if isinstance(peer, tuple) else str(peer)
        self.name = f"{path} from {self.address}"
        self.headers = lower_case(connection.request.headers)
        self.local = is_local(host(connection), self.headers)
        self.dialect = Dialect()
        self.refused = 0
        self._credit = BYTES_PER_SECOND * SAVED_UP
        self._credited = time.monotonic()
        self._told = False

    async def receive(self, take: Callable[[str | bytes], None] | None = None) -> str | bytes:
        """Its next message. One that sends too much is not read for a while. Raises ConnectionClosed.

        `take` is given those that come while this waits; returned is then only what it refused with a MessageError,
        or what was more than may be sent.
        """
        if self._credit < 0.0:
            if not self._told:
                self._told = True
                text = f"more than {BYTES_PER_SECOND / 1e3:.0f} kB a second come, each message counting as "
                text += f"{MESSAGE_COST} bytes more: they have to wait"
                log.warning("%s: %s", self.name, text)
                self.tell_now(Notice(text))
            await asyncio.sleep(-self._credit / BYTES_PER_SECOND)
        self.connection.at_once = None if take is None else functools.partial(self._taken, take)
        try:
            data = await self.connection.recv()
        finally:
            self.connection.at_once = None
        self._spend(data)
        return data

    def _taken(self, take: Callable[[str | bytes], None], data: str | bytes) -> bool:
        if self._credit < 0.0:
            return False
        try:
            take(data)
        except MessageError:
            return False
        self._spend(data)
        return True

    def _spend(self, data: str | bytes) -> None:
        now = time.monotonic()
        earned = (now - self._credited) * BYTES_PER_SECOND
        self._credit = min(self._credit + earned, BYTES_PER_SECOND * SAVED_UP) - len(data) - MESSAGE_COST
        self._credited = now

    async def tell(self, message: msgspec.Struct) -> None:
        """Waits until the client takes it."""
        await self.connection.send(self.dialect.encode(message), text=not self.dialect.binary)

    def tell_now(self, message: msgspec.Struct) -> None:
        """Into its buffer."""
        broadcast([self.connection], self.dialect.encode(message), text=not self.dialect.binary)

    async def hello(self, decode: Callable[[str | bytes], T]) -> T:
        """The first message, which says who it is; anything else is answered and waited past."""
        try:
            async with asyncio.timeout(HELLO_TIMEOUT):
                while True:
                    data = await self.receive()
                    # One who sends JSON as binary is to read the answer.
                    self.dialect = Dialect(binary=isinstance(data, bytes) and data[:1] != b"{")
                    try:
                        return decode(data)
                    except MessageError as error:
                        await self.refuse(error)
        except TimeoutError:
            # It may not even read: no last word for it.
            self.connection.transport.abort()
            raise RefusedError(f"it has not said hello for {HELLO_TIMEOUT:.0f} s") from None

    async def refuse(self, error: MessageError) -> None:
        """Tell it what was wrong with its message. This waits until the client takes that, so none can flood."""
        self.refused += 1
        if self.refused == 1:
            log.warning("%s sent a message that cannot be used: %s", self.name, for_log(str(error)))
        await self.tell(Error(str(error)))

    async def admit(self, token: str, configured: str, whose: str) -> None:
        """Let in who shows the configured token, and from this machine, where none is configured, anybody."""
        if not configured:
            if self.local:
                return
            raise RefusedError(
                f"{whose} has no token in the configuration, and without one only this machine is served"
            )
        if not token:
            raise RefusedError(f'{whose} needs its token: "token" in the hello, or `Authorization: Bearer <token>`')
        if not token_matches(token, configured):
            await asyncio.sleep(WRONG_TOKEN_PAUSE)
            raise RefusedError(f"this is not the token of {whose}")


def for_log(text: str) -> str:
    """In one line of bearable length: what a client sent is quoted in it."""
    text = text if len(text) <= 300 else text[:297] + "..."
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


def lower_case(headers: Headers) -> dict[str, str]:
    return {name.lower(): value for name, value in headers.raw_items()}


def host(connection: ServerConnection) -> str:
    address = connection.remote_address
    return str(address[0]) if isinstance(address, tuple) else ""
