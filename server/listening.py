"""What every server of this project shares: its port, its address, its pages, and its words where it cannot listen."""

from __future__ import annotations

import argparse
import errno
import http
import socket
from email.utils import formatdate

from websockets.datastructures import Headers
from websockets.http11 import Request, Response


def port_number(text: str) -> int:
    """For argparse: 0 to 65535."""
    if not (text.isdecimal() and text.isascii() and int(text) <= 65535):
        raise argparse.ArgumentTypeError(f"{text!r} is no port, 0 to 65535 are")
    return int(text)


def reachable(host: str) -> str:
    """The host to put into an address on this machine."""
    if host in ("", "0.0.0.0", "::"):
        return "127.0.0.1"
    return f"[{host}]" if ":" in host else host


def own_address() -> str:
    """This machine's address on its network, for another machine; 127.0.0.1 where it has none."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            # Of a datagram socket this chooses the way out, and sends nothing.
            probe.connect(("10.255.255.255", 1))
        except OSError:
            return "127.0.0.1"
        address: str = probe.getsockname()[0]
        return address


def is_local(host: str) -> bool:
    """Whether only this machine can reach what listens there."""
    return host in ("127.0.0.1", "localhost", "::1")


def cannot_listen(error: OSError, host: str, port: int) -> OSError:
    """The same error in words."""
    if error.errno == errno.EADDRINUSE:
        what = f"port {port} on {host} is in use: is another Steadfix running? `--port` takes another, 0 any free one"
    elif error.errno == errno.EACCES:
        what = f"port {port} on {host} is not allowed: ports below 1024 need rights; `--port` takes another"
    else:
        what = f"cannot listen on {host}, port {port}: {error.strerror or error}"
    return OSError(error.errno or errno.EIO, what)


def response(status: int, body: bytes, kind: str, request: Request) -> Response:
    """An answer to a plain GET or HEAD."""
    headers = Headers(
        {
            "Date": formatdate(usegmt=True),
            "Connection": "close",
            "Content-Type": kind,
            "Content-Length": str(len(body)),
            "Cache-Control": "no-cache",
            "Content-Security-Policy": "default-src 'self'; connect-src 'self' ws: wss:",
            "X-Content-Type-Options": "nosniff",
        }
    )
    status_line = http.HTTPStatus(status)
    return Response(status_line.value, status_line.phrase, headers, b"" if request.method == "HEAD" else body)
