"""A driver's stamp -> the host's monotonic clock, whichever of the host's clocks the driver stamps by."""

from __future__ import annotations

import time
from collections.abc import Mapping

# s: a frame reaches the program within this time.
OLDEST = 1.0
# s: by how much the clocks may differ through being read one after the other.
SLACK = 1e-3


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
