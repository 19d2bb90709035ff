"""The stamps that frames come with -> the host's monotonic clock."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Mapping

# s: a frame reaches the program within this time.
OLDEST = 1.0
# s: by how much the clocks may differ through being read one after the other.
SLACK = 1e-3
# s of arrivals of which the promptest tells the delay of a network camera: its crystal drifts 1 ms off in that time.
WINDOW = 10.0
# s: no frame is later than this by its network; its camera's clock has been set back.
LATEST = 5.0


def host_clocks() -> dict[str, float]:
    """What the host's clocks read now, s, by name; `monotonic` first, which is the one that everything else uses."""
    now = {"monotonic": time.monotonic()}
    # Linux alone has it: the monotonic clock, but for the time that the machine was suspended.
    if hasattr(time, "CLOCK_BOOTTIME"):
        now["boot time"] = time.clock_gettime(time.CLOCK_BOOTTIME)
    return now | {"wall": time.time()}


def host_time(stamp: float, clocks: Mapping[str, float]) -> tuple[float, str] | None:
    """A frame's stamp, s by an unknown one of `clocks` -> s on the monotonic one, and which it was; None for none.

    libcamera documents its stamps as of the boot time, its drivers give the monotonic clock; V4L2 drivers give the
    monotonic clock, or the wall's where they are told to. A frame is never from the future and hardly ever older than
    OLDEST, which tells the clocks apart: the one by which it is youngest. Where two read the same, it does not matter.
    """
    ages = {name: now - stamp for name, now in clocks.items() if -SLACK <= now - stamp <= OLDEST}
    if not ages:
        return None
    name = min(ages, key=ages.__getitem__)
    return clocks["monotonic"] - max(0.0, ages[name]), name


class StreamClock:
    """A network camera's own stamps -> the host's clock, by the frames that reach it promptest.

    Arrivals scatter by what network and encoder take, stamps do not: each frame is as much older than its stamp says as
    the promptest of the last WINDOW was on arrival. What that one took nobody knows; it is a constant.
    """

    def __init__(self) -> None:
        # (arrival, arrival - stamp), the differences rising: the first is the least of the window.
        self._delays: deque[tuple[float, float]] = deque()
        self._last = math.inf, -math.inf
        self._live = False

    def host_time(self, stamp: float, arrival: float) -> float | None:
        """s; None for a frame of the backlog that comes at once when a stream is opened, when no delay is known yet."""
        (last_arrival, last_stamp), self._last = self._last, (arrival, stamp)
        # Of a backlog the stamps go on faster than the time.
        self._live |= stamp - last_stamp <= 2.0 * (arrival - last_arrival)
        delay = arrival - stamp
        if stamp <= last_stamp or (self._delays and delay - self._delays[0][1] > LATEST):
            self._delays.clear()  # no clock, or one that was set
        while self._delays and self._delays[-1][1] >= delay:
            self._delays.pop()
        self._delays.append((arrival, delay))
        while self._delays[0][0] < arrival - WINDOW:
            self._delays.popleft()
        return stamp + self._delays[0][1] if self._live else None
