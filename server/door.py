"""What comes before a WebSocket: pages and health over HTTP, and who may open one at all."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from importlib.resources import files
from typing import Any
from urllib.parse import urlsplit

import msgspec
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from server.access import bearer, is_local, origin_allowed, token_matches
from server.config import ServerConfig
from server.listening import response
from server.visitor import for_log, host, lower_case

log = logging.getLogger("steadfix")

# Connections at a time.
MAX_CONNECTIONS = 500

_PAGE = {
    "/": ("index.html", "text/html; charset=utf-8"),
    "/dashboard.css": ("dashboard.css", "text/css; charset=utf-8"),
    "/dashboard.js": ("dashboard.js", "text/javascript; charset=utf-8"),
    "/favicon.svg": ("favicon.svg", "image/svg+xml"),
    "/phone": ("phone.html", "text/html; charset=utf-8"),
    "/phone.css": ("phone.css", "text/css; charset=utf-8"),
    "/phone.js": ("phone.js", "text/javascript; charset=utf-8"),
}
_WEBSOCKETS = ("/", "/v1/poses", "/v1/robot", "/v1/camera")
_THERE_IS = (
    "There is:\n"
    "  GET        /           the page that shows the robots\n"
    "  GET        /phone      the page that makes a phone an IMU\n"
    "  GET        /healthz    health, as JSON\n"
    "  WebSocket  /v1/poses   poses; ?robots=a,b&rate=50&channel=best&format=msgpack\n"
    "  WebSocket  /v1/robot   for a robot: IMU up, its pose down\n"
    "  WebSocket  /v1/camera  for the node of a remote camera, `steadfix camera`\n"
    "  WebSocket  /           marker sightings, as the original tracker sent them\n"
)


class Door:
    """`health`: what /healthz answers. `connections`: how many there are."""

    def __init__(
        self, config: ServerConfig, health: Callable[[], dict[str, Any]], connections: Callable[[], int]
    ) -> None:
        self._config = config
        self._health = health
        self._connections = connections
        self._page = {
            path: (files("server").joinpath("dashboard", name).read_bytes(), kind)
            for path, (name, kind) in _PAGE.items()
        }

    def answer(self, connection: ServerConnection, request: Request) -> Response | None:
        """Answers what is no WebSocket; None lets a WebSocket in."""
        try:
            path = urlsplit(request.path).path
        except ValueError:
            return _text(400, f"This is no path: {request.path}\n{_THERE_IS}", request)
        headers = lower_case(request.headers)
        local = is_local(host(connection), headers)
        if headers.get("upgrade", "").lower() == "websocket":
            if path not in _WEBSOCKETS:
                return _text(404, f"No WebSocket at {path}\n{_THERE_IS}", request)
            return self._websocket(path, headers, local, request)
        if request.method not in ("GET", "HEAD"):
            return _text(405, f"{request.method} is not possible here.\n{_THERE_IS}", request)
        if path == "/healthz":
            if not local and not self._is_viewer(bearer(headers)):
                return self._locked(request)
            return response(200, msgspec.json.encode(self._health()) + b"\n", "application/json", request)
        if path in self._page:
            return response(200, *self._page[path], request)
        if path in _WEBSOCKETS:
            return _text(426, f"{path} is a WebSocket.\n{_THERE_IS}", request)
        return _text(404, f"Nothing at {path}\n{_THERE_IS}", request)

    def _websocket(self, path: str, headers: Mapping[str, str], local: bool, request: Request) -> Response | None:
        """What keeps a WebSocket out before it has said anything; None lets it in."""
        if self._connections() >= MAX_CONNECTIONS:
            return _text(503, f"{MAX_CONNECTIONS} connections are open, and no more are taken.\n", request)
        if path == "/":
            # As open as the original was, unless those who look on need a token.
            if self._config.token and not local and not self._is_viewer(bearer(headers)):
                return self._locked(request)
        elif not origin_allowed(headers, local, self._config.origins):
            origin = headers["origin"]
            log.warning("%s: a page of %s was kept out; `origins` under [server] lets it in", path, for_log(origin))
            return _text(
                403, f"Pages of {origin} are not let in; needed: `origins` under [server] names it.\n", request
            )
        return None

    def _is_viewer(self, token: str) -> bool:
        return bool(self._config.token) and token_matches(token, self._config.token)

    def _locked(self, request: Request) -> Response:
        if not self._config.token:
            text = "[server] has no token in the configuration, and without one only this machine is shown anything.\n"
            return _text(403, text, request)
        return _text(401, "This needs the token of [server], as `Authorization: Bearer <token>`.\n", request)


def _text(status: int, text: str, request: Request) -> Response:
    return response(status, text.encode(), "text/plain; charset=utf-8", request)
