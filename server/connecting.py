"""How robots and the nodes of cameras connect to the service, and when again."""

from __future__ import annotations

import ssl

from websockets.asyncio.client import connect

# s before trying again: the first pause, which `longer` doubles up to the longest.
FIRST_PAUSE, LONGEST_PAUSE = 0.25, 5.0
# s between asking the service for a sign of life, and until a connection without one is given up.
_PING_INTERVAL, _PING_TIMEOUT = 2.0, 3.0


def connect_to_service(url: str, tls: ssl.SSLContext | None) -> connect:
    """A connection, for `async with`."""
    return connect(
        url,
        ssl=tls,
        compression=None,
        max_size=1 << 16,
        ping_interval=_PING_INTERVAL,
        ping_timeout=_PING_TIMEOUT,
        proxy=None,
    )


def longer(pause: float) -> float:
    """The pause after another failure."""
    return min(2.0 * pause, LONGEST_PAUSE)
