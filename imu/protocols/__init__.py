"""One sans-I/O parser a file: `feed(bytes) -> samples`, the same however the bytes are split."""

from __future__ import annotations

import math
from collections import Counter
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


class Parser:
    """Bytes of one protocol to samples. A subclass says how, in `feed`.

    `frames`: lines or frames that were understood, with a sample in them or without. `reasons` says how many were
    dropped for which reason, and `last_error` the latest in words. `dropped_bytes`: bytes that belong to no line or
    frame that could be used. `missing`: frames that the device numbered and that never came. `note`: what this protocol
    cannot give, "" for nothing.
    """

    protocol = ""
    note = ""

    def __init__(self) -> None:
        self.frames = 0
        self.reasons: Counter[str] = Counter()
        self.last_error = ""
        self.dropped_bytes = 0
        self.missing = 0

    @property
    def dropped(self) -> int:
        return self.reasons.total()

    def feed(self, data: bytes) -> list[RawSample]:
        """The samples that `data` completes. Never raises for what a device sends."""
        raise NotImplementedError

    def _drop(self, error: DroppedError) -> None:
        self.reasons[error.reason] += 1
        self.last_error = str(error)


# Beyond what any device measures (4000 deg/s are 70 rad/s, 200 g are 1960 m/s2): such a number is a broken one. A
# clock that counts seconds from 1970 reads 2e9, one that counts nanoseconds by mistake 2e18.
TIME_LIMIT = 1e12
RATE_LIMIT = 200.0
FORCE_LIMIT = 4000.0


def raw_sample(
    device_time: float | None, rates: tuple[float, float, float], forces: tuple[float, float, float]
) -> RawSample:
    """A sample whose numbers are finite and possible. Raises DroppedError."""
    gx, gy, gz = rates
    ax, ay, az = forces
    # A comparison with nan is false.
    if (
        -RATE_LIMIT <= gx <= RATE_LIMIT
        and -RATE_LIMIT <= gy <= RATE_LIMIT
        and -RATE_LIMIT <= gz <= RATE_LIMIT
        and -FORCE_LIMIT <= ax <= FORCE_LIMIT
        and -FORCE_LIMIT <= ay <= FORCE_LIMIT
        and -FORCE_LIMIT <= az <= FORCE_LIMIT
        and (device_time is None or -TIME_LIMIT <= device_time <= TIME_LIMIT)
    ):
        return RawSample(device_time, gx, gy, gz, ax, ay, az)
    found = [device_time, gx, gy, gz, ax, ay, az]
    finite = all(value is None or math.isfinite(value) for value in found)
    raise DroppedError("out of range" if finite else "not finite", found)
