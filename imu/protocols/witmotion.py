"""WitMotion sensors (JY61, WT61, WT901, ...): packets of 11 bytes, 0x55, a type, four numbers, a sum.

"WT901 datasheet", WitMotion, v20-0702, section 5.1. A sample is an acceleration (0x51) and the angular rate (0x52)
that follows it. Its time is that of the time packet (0x50) before it, where the device is set to send one; by default
it is not, and samples are stamped when they arrive. The newer Bluetooth packets (0x61) have no checksum and are not
read.
"""

from __future__ import annotations

import calendar
import math
import re
from struct import Struct

from imu.protocols import DroppedError, RawSample, raw_sample
from imu.protocols.frames import INCOMPLETE, FrameParser

_LENGTH = 11
_VECTOR = Struct("<2x3h")
_TIME = Struct("<2x6BH")
_FORCE = 16.0 * 9.80665 / 32768.0  # m/s2 per count: 16 g are full scale
_RATE = math.radians(2000.0) / 32768.0  # rad/s per count


class WitMotion(FrameParser):
    """See `FrameParser`."""

    protocol = "witmotion"
    _START = re.compile(rb"\x55")

    def __init__(self) -> None:
        super().__init__()
        self._time: float | None = None
        self._forces: tuple[float, float, float] | None = None

    def _measure(self, data: bytes, at: int) -> int:
        if len(data) < at + _LENGTH:
            return INCOMPLETE if len(data) < at + 2 or 0x50 <= data[at + 1] <= 0x5F else 0
        whole = 0x50 <= data[at + 1] <= 0x5F and sum(data[at : at + 10]) & 0xFF == data[at + 10]
        return _LENGTH if whole else 0

    def _decode(self, frame: bytes) -> RawSample | None:
        kind = frame[1]
        forces, self._forces = self._forces, None
        if kind == 0x51:
            ax, ay, az = _VECTOR.unpack_from(frame)
            self._forces = _FORCE * ax, _FORCE * ay, _FORCE * az
        elif kind == 0x52:
            if forces is None:
                raise DroppedError("incomplete", "an angular rate (0x52) without the acceleration (0x51) before it")
            gx, gy, gz = _VECTOR.unpack_from(frame)
            time, self._time = self._time, None
            return raw_sample(time, (_RATE * gx, _RATE * gy, _RATE * gz), forces)
        elif kind == 0x50:
            year, month, *rest, ms = _TIME.unpack_from(frame)
            if 1 <= month <= 12:
                self._time = calendar.timegm((2000 + year, month, *rest)) + 1e-3 * ms
        return None
