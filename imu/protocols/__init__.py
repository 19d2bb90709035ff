"""One sans-I/O parser a file: `feed(bytes) -> samples`, the same however the bytes are split."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple


class RawSample(NamedTuple):
    """One reading as the device stamped it.

    `device_time`: s of the device's own clock, None where it has none. Angular rate in rad/s, specific force in m/s2.
    """

    device_time: float | None
    gx: float
    gy: float
    gz: float
    ax: float
    ay: float
    az: float


class DroppedError(ValueError):
    """Bytes that hold no sample. `reason` is one of a few fixed words, to be counted; `found` is what was there."""

    def __init__(self, reason: str, found: object) -> None:
        super().__init__(f"{reason}: {found}")
        self.reason = reason


# Beyond what any device measures (4000 deg/s are 70 rad/s, 200 g are 1960 m/s2): such a number is a broken one. A
# clock that counts seconds from 1970 reads 2e9, one that counts nanoseconds by mistake 2e18.
TIME_LIMIT = 1e12
RATE_LIMIT = 200.0
FORCE_LIMIT = 4000.0


def raw_sample(device_time: float | None, rates: Iterable[float], forces: Iterable[float]) -> RawSample:
    """A sample whose numbers are finite and possible. Raises DroppedError."""
    sample = RawSample(device_time, *rates, *forces)
    for value, limit in zip(
        (device_time or 0.0, *sample[1:]), (TIME_LIMIT, *(RATE_LIMIT,) * 3, *(FORCE_LIMIT,) * 3), strict=True
    ):
        if not math.isfinite(value):
            raise DroppedError("not finite", list(sample))
        if abs(value) > limit:
            raise DroppedError("out of range", list(sample))
    return sample
