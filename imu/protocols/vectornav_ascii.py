"""VectorNav's ASCII messages with rates and accelerations: `$VNIMU,...*hh`, VNQMR, VNMAR, VNYMR, and answers `$VNRRG`.

"VN-100 user manual", VectorNav, UM001 v2.22, sections 3.3 and 6. Its axes (x forward, y right, z down) are turned to
Steadfix's (x forward, y left, z up). The messages have no time: samples are stamped when they arrive, which the binary
output does better.
"""

from __future__ import annotations

from binascii import crc_hqx
from functools import reduce
from operator import xor

from imu.protocols import DroppedError, RawSample, raw_sample
from imu.protocols.lines import LineParser

# Where the acceleration stands among the numbers of a message; the angular rate follows it.
_ACCEL_AT = {b"VNIMU": 3, b"VNMAR": 3, b"VNYMR": 6, b"VNQMR": 7}
_REGISTERS = {15: b"VNQMR", 19: b"VNMAR", 27: b"VNYMR", 54: b"VNIMU"}


class VectorNavAscii(LineParser):
    """See `LineParser`. A line counts from its last `$` on; messages without both quantities are passed over."""

    protocol = "vectornav"

    def __init__(self) -> None:
        super().__init__(_decode)


def _decode(line: bytes) -> RawSample | None:
    begin, star = line.rfind(b"$"), line.rfind(b"*")
    if begin < 0 or star < begin:
        raise DroppedError("no message", repr(line[:80]))
    body, checksum = line[begin + 1 : star], line[star + 1 :].strip()
    expected = reduce(xor, body, 0) if len(checksum) == 2 else crc_hqx(body, 0)
    try:
        right = len(checksum) in (2, 4) and int(checksum, 16) == expected
    except ValueError:
        right = False
    if not right:
        raise DroppedError("wrong checksum", repr(line[:80]))
    name, *fields = body.split(b",")
    try:
        if name == b"VNRRG" and fields:
            name, fields = _REGISTERS.get(int(fields[0]), b""), fields[1:]
        at = _ACCEL_AT.get(name)
        if at is None:
            return None
        ax, ay, az, gx, gy, gz = map(float, fields[at : at + 6])
    except ValueError:
        raise DroppedError("not a number", repr(line[:80])) from None
    return raw_sample(None, (gx, -gy, -gz), (ax, -ay, -az))
