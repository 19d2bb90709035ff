"""The page of `steadfix calibrate`: the live picture, what to do next, and how far it is."""

from __future__ import annotations

import asyncio
import contextlib
from importlib.resources import files
from types import TracebackType
from typing import Any, Self
from urllib.parse import urlsplit

import msgspec
from websockets.asyncio.server import Server, ServerConnection, serve
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from server.listening import cannot_listen, response

_WEBSOCKET = "/v1/calibration"
_PAGE = {
    "/": ("calibrate.html", "text/html; charset=utf-8"),
    "/calibrate.css": ("calibrate.css", "text/css; charset=utf-8"),
    "/calibrate.js": ("calibrate.js", "text/javascript; charset=utf-8"),
    "/dashboard.css": ("dashboard.css", "text/css; charset=utf-8"),
    "/favicon.svg": ("favicon.svg", "image/svg+xml"),
}
# s that viewers get to take the last word before they are cut off.
_LAST_WORD = 2.0


class CalibrationPage:
    """`async with CalibrationPage(host, port) as page:` serves it on `page.port`; `page.show(...)` sends each viewer
    the newest state, and the picture that belongs to it. A slow viewer skips states.

    Raises OSError in words when the port cannot be had.
    """

    def __init__(self, host: str, port: int) -> None:
        self.port = port
        self._host = host
        self._files = {
            path: (files("server").joinpath("dashboard", name).read_bytes(), kind)
            for path, (name, kind) in _PAGE.items()
        }
        self._changed = asyncio.Condition()
        self._state = b""
        self._picture = b""
        # Of the states and the pictures so far
        self._count = self._pictures = 0
        self._ending = False
        self._viewers: set[asyncio.Task[Any]] = set()
        self._server: Server | None = None

    async def __aenter__(self) -> Self:
        try:
            self._server = await serve(
                self._serve,
                self._host,
                self.port,
                process_request=self._answer,
                compression=None,
                max_size=1024,
                server_header=None,
            )
        except OSError as error:
            raise cannot_listen(error, self._host, self.port) from None
        self.port = self._server.sockets[0].getsockname()[1]
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        async with self._changed:
            self._ending = True
            self._changed.notify_all()
        if self._viewers:
            await asyncio.wait(self._viewers, timeout=_LAST_WORD)
        assert self._server is not None
        self._server.close()
        await self._server.wait_closed()

    @property
    def watched(self) -> bool:
        """Whether anybody looks at it."""
        return bool(self._viewers)

    async def show(self, state: dict[str, Any], picture: bytes) -> None:
        """`state` as the script of the page reads it, `picture` a JPEG that belongs to it, b"" for none."""
        async with self._changed:
            self._state = msgspec.json.encode(state)
            self._count += 1
            if picture:
                self._picture = picture
                self._pictures += 1
            self._changed.notify_all()

    async def _serve(self, connection: ServerConnection) -> None:
        task = asyncio.current_task()
        assert task is not None
        self._viewers.add(task)
        shown = seen = 0
        try:
            with contextlib.suppress(ConnectionClosed):
                while True:
                    async with self._changed:
                        while self._count == shown and not self._ending:
                            await self._changed.wait()
                        if self._count == shown:
                            return
                        shown, state = self._count, self._state
                        picture, seen = (b"" if seen == self._pictures else self._picture), self._pictures
                    await connection.send(state, text=True)
                    if picture:
                        await connection.send(picture)
        finally:
            self._viewers.discard(task)

    def _answer(self, connection: ServerConnection, request: Request) -> Response | None:
        path = urlsplit(request.path).path
        if request.headers.get("Upgrade", "").lower() == "websocket":
            return None if path == _WEBSOCKET else response(404, b"", "text/plain", request)
        if path in self._files:
            return response(200, *self._files[path], request)
        return response(404, b"The page is at /\n", "text/plain; charset=utf-8", request)
