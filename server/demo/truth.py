"""Where the demo room's robots truly are: what they print, and what the simulated camera and the score look up."""

from __future__ import annotations

import threading
import time
from bisect import bisect_left
from collections import defaultdict
from operator import itemgetter

# s of truth that are kept; it comes each 10 ms.
HISTORY = 5.0

# t (s), x, y (m), yaw (rad)
Place = tuple[float, float, float, float]


def place(line: bytes) -> Place:
    """A line `t x y yaw`."""
    t, x, y, yaw = map(float, line.split())
    return t, x, y, yaw


class Truth:
    """The places of each robot, of the last HISTORY at least. For any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._places: defaultdict[str, list[Place]] = defaultdict(list)
        self._stopping = threading.Event()

    def append(self, robot: str, places: list[Place]) -> None:
        """What came, in order of time."""
        with self._lock:
            kept = self._places[robot]
            kept.extend(places)
            if kept and kept[-1][0] - kept[0][0] > 2.0 * HISTORY:
                del kept[: len(kept) // 2]

    def at(self, robot: str, t: float) -> tuple[float, float, float] | None:
        """(x, y, yaw) of a robot at `t`, m and rad; None for a time that is not known, or not yet."""
        with self._lock:
            kept = self._places[robot]
            i = bisect_left(kept, t, key=itemgetter(0))
            if not 0 < i < len(kept):
                return None
            (t0, *a), (t1, *b) = kept[i - 1], kept[i]
        s = (t - t0) / (t1 - t0)
        x, y, yaw = (u + s * (v - u) for u, v in zip(a, b, strict=True))
        return x, y, yaw

    def wait_until(self, t: float) -> bool:
        """Sleep until `t`, s of the monotonic clock; False if `stop` is called meanwhile, or was."""
        return not self._stopping.wait(max(0.0, t - time.monotonic()))

    def stop(self) -> None:
        """No more will come."""
        self._stopping.set()
