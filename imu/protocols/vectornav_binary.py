"""VectorNav's binary output: 0xFA, groups, a word of fields for each group, the fields, a CRC.

"VN-100 user manual", VectorNav, UM001 v2.22, section 4; the lengths of the fields that this product has not are those
of VectorNav's own library. Any message with accelerations and angular rates will do; uncompensated ones are preferred,
since the filter estimates biases itself. The axes (x forward, y right, z down) are turned to Steadfix's.
"""

from __future__ import annotations

import re
from binascii import crc_hqx
from collections.abc import Sequence
from functools import lru_cache
from struct import Struct
from typing import NamedTuple

from imu.protocols import DroppedError, RawSample, raw_sample
from imu.protocols.frames import INCOMPLETE, FrameParser

# Bytes of each field, by group; the satellites' details, which vary in length, are not read.
_LENGTHS: tuple[tuple[int, ...], ...] = (
    (8, 8, 8, 12, 16, 12, 24, 12, 12, 24, 20, 28, 2, 4, 8),  # common
    (8, 8, 8, 2, 8, 8, 8, 4, 4, 1),  # time
    (2, 12, 12, 12, 4, 4, 16, 12, 12, 12, 12, 2),  # IMU
    (8, 8, 2, 1, 1, 24, 24, 12, 12, 12, 4, 4),  # GNSS
    (2, 12, 16, 36, 12, 12, 12, 12, 12),  # attitude
    (2, 24, 24, 12, 12, 12, 12, 12, 12, 4, 4),  # INS
)
_COMMON, _TIME, _IMU = range(3)
# (group, bit) of the time since startup in ns; the others may be a GPS's, which jumps when that finds its time.
_STARTUP = ((_COMMON, 0), (_TIME, 0))
# Of acceleration and angular rate: (group, bit, byte within the field), best first.
_READINGS = (
    ((_IMU, 2, 0), (_IMU, 3, 0)),
    ((_COMMON, 9, 0), (_COMMON, 9, 12)),
    ((_IMU, 9, 0), (_IMU, 10, 0)),
    ((_COMMON, 8, 0), (_COMMON, 5, 0)),
)
_VECTOR = Struct("<3f")
_NANOSECONDS = Struct("<Q")


class _Layout(NamedTuple):
    """Bytes of a whole message, and where in it the time, acceleration and angular rate are; None where not."""

    length: int
    time: int | None
    readings: tuple[int, int] | None


class VectorNavBinary(FrameParser):
    """See `FrameParser`."""

    protocol = "vectornav-binary"
    _START = re.compile(rb"\xfa")

    def _measure(self, data: bytes, at: int) -> int:
        if len(data) < at + 2:
            return INCOMPLETE
        begin = at + 2 + 2 * data[at + 1].bit_count()
        if len(data) < begin:
            return INCOMPLETE
        layout = _layout(data[at + 1 : begin])
        if layout is None:
            return 0
        if len(data) < at + layout.length:
            return INCOMPLETE
        # Over a message with its own CRC it is zero.
        return layout.length if crc_hqx(data[at + 1 : at + layout.length], 0) == 0 else 0

    def _decode(self, frame: bytes) -> RawSample | None:
        layout = _layout(frame[1 : 2 + 2 * frame[1].bit_count()])
        assert layout is not None
        if layout.readings is None:
            raise DroppedError("no readings", "a message without UncompAccel and UncompGyro, or Accel and AngularRate")
        ax, ay, az = _VECTOR.unpack_from(frame, layout.readings[0])
        gx, gy, gz = _VECTOR.unpack_from(frame, layout.readings[1])
        time = None if layout.time is None else 1e-9 * _NANOSECONDS.unpack_from(frame, layout.time)[0]
        return raw_sample(time, (gx, -gy, -gz), (ax, -ay, -az))


# A device sends a few kinds of message, noise any.
@lru_cache(maxsize=256)
def _layout(head: bytes) -> _Layout | None:
    """Of the byte of groups and the words of fields behind it; None where such a message does not exist."""
    groups = [bit for bit in range(8) if head[0] >> bit & 1]
    at = 1 + len(head)
    where: dict[tuple[int, int], int] = {}
    for i, group in enumerate(groups):
        fields = int.from_bytes(head[1 + 2 * i : 3 + 2 * i], "little")
        lengths: Sequence[int] = _LENGTHS[group] if group < len(_LENGTHS) else ()
        if fields == 0 or fields >> len(lengths):
            return None
        for bit, length in enumerate(lengths):
            if fields >> bit & 1:
                where[group, bit] = at
                at += length
    if not groups:
        return None
    readings = next(
        ((where[a[:2]] + a[2], where[g[:2]] + g[2]) for a, g in _READINGS if a[:2] in where and g[:2] in where), None
    )
    return _Layout(at + 2, next((where[field] for field in _STARTUP if field in where), None), readings)
