"""What the long-running commands share at a terminal: the log on standard error, and an end by Ctrl-C or SIGTERM."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import signal
import sys
from collections.abc import Coroutine
from typing import Any


def log_to_stderr() -> None:
    """The log, a line with the time each."""
    # A descriptor of its own: `camera.capture` silences the process's standard error now and then, for C libraries.
    stream = os.fdopen(os.dup(sys.stderr.fileno()), "w", buffering=1, errors="backslashreplace")
    logging.basicConfig(format="%(asctime)s  %(message)s", datefmt="%H:%M:%S", level=logging.INFO, stream=stream)
    # Its INFO is one line for each connection.
    logging.getLogger("websockets").setLevel(logging.ERROR)


def stop_signals() -> asyncio.Event:
    """An event that Ctrl-C and SIGTERM set, for the running loop."""
    stop = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        # Not the loop's own way, which loses a signal while the loop is too busy to read what threads tell it.
        signal.signal(number, lambda *_: _set(loop, stop))
    return stop


def _set(loop: asyncio.AbstractEventLoop, stop: asyncio.Event) -> None:
    # A second Ctrl-C may come when the loop is closed already.
    with contextlib.suppress(RuntimeError):
        loop.call_soon_threadsafe(stop.set)


async def until_stopped(work: Coroutine[Any, Any, None]) -> None:
    """Run to its end, or until Ctrl-C or SIGTERM, which ends it as well. Raises what it raises."""
    stopped = asyncio.create_task(stop_signals().wait())
    working = asyncio.create_task(work)
    await asyncio.wait((stopped, working), return_when=asyncio.FIRST_COMPLETED)
    stopped.cancel()
    working.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await working
