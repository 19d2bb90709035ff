"""MAVLink 1 and 2, through pymavlink (the extra `mavlink`): HIGHRES_IMU, SCALED_IMU or RAW_IMU of an autopilot.

"MAVLink serialization" and "common message set", mavlink.io. Of several IMUs the first that is heard counts, and of
its messages the finest: HIGHRES_IMU before SCALED_IMU before RAW_IMU, whose units are by definition open and are taken
as ArduPilot's, those of SCALED_IMU. The body axes (x forward, y right, z down) are turned to Steadfix's.
"""

from __future__ import annotations

import re
from typing import Any

from imu.protocols import DroppedError, RawSample, raw_sample
from imu.protocols.frames import INCOMPLETE, FrameParser

_V1, _V2 = 0xFE, 0xFD
# Bytes of header and checksum by version, and of the signature that a flag of version 2 announces.
_OVERHEAD = {_V1: 8, _V2: 12}
_SIGNED, _SIGNATURE = 0x01, 13
_SCALED_IMU, _RAW_IMU, _HIGHRES_IMU = 26, 27, 105
_FINENESS = (_RAW_IMU, _SCALED_IMU, _HIGHRES_IMU)
_ALL_UPDATED = 0x3F  # acceleration and angular rate, each axis
_FORCE = 9.80665e-3  # m/s2 per mg


class MavlinkMissingError(ValueError):
    """pymavlink is not installed. The text says how to get it."""


class Mavlink(FrameParser):
    """See `FrameParser`; `missing` counts gaps of the autopilot's sequence number. Raises MavlinkMissingError."""

    protocol = "mavlink"
    _START = re.compile(rb"[\xfe\xfd]")

    def __init__(self) -> None:
        super().__init__()
        try:
            from pymavlink.dialects.v20 import all as dialect
        except ImportError:
            raise MavlinkMissingError(
                "MAVLink needs pymavlink, which is not installed: pip install pymavlink"
            ) from None
        self._messages: dict[int, Any] = dialect.mavlink_map
        self._checksum = dialect.x25crc
        self._decoder = dialect.MAVLink(None)
        # System, component and number of the IMU that counts, and its finest message so far.
        self._source: tuple[int, int, int] | None = None
        self._finest = _RAW_IMU
        self._sequence: int | None = None

    def _measure(self, data: bytes, at: int) -> int:
        if len(data) < at + 3:
            return INCOMPLETE
        version, length, flags = data[at : at + 3]
        size = length + _OVERHEAD[version] + (_SIGNATURE if version == _V2 and flags & _SIGNED else 0)
        if version == _V2 and flags & ~_SIGNED:
            return 0
        if len(data) < at + size:
            return INCOMPLETE
        message = self._messages.get(_id(data, at))
        if message is None:
            return 0
        end = at + length + _OVERHEAD[version] - 2
        checksum = self._checksum(data[at + 1 : end] + bytes([message.crc_extra])).crc
        return size if checksum == int.from_bytes(data[end : end + 2], "little") else 0

    def _decode(self, frame: bytes) -> RawSample | None:
        kind = _id(frame, 0)
        sequence, system, component = frame[2:5] if frame[0] == _V1 else frame[4:7]
        if self._source is not None and (system, component) == self._source[:2]:
            if self._sequence is not None:
                self.missing += (sequence - self._sequence - 1) & 0xFF
            self._sequence = sequence
        if kind not in _FINENESS:
            return None
        message = self._decoder.decode(bytearray(frame))
        # SCALED_IMU is of the first IMU; there `id` would be the message's own number.
        source = (system, component, 0 if kind == _SCALED_IMU else message.id)
        if self._source is None:
            self._source, self._sequence = source, sequence
        if source != self._source or _FINENESS.index(kind) < _FINENESS.index(self._finest):
            return None
        self._finest = kind
        if kind == _HIGHRES_IMU:
            if message.fields_updated & _ALL_UPDATED != _ALL_UPDATED:
                raise DroppedError("not updated", f"HIGHRES_IMU whose fields_updated is {message.fields_updated:#x}")
            force, rate, time = 1.0, 1.0, 1e-6 * message.time_usec
        else:
            force, rate = _FORCE, 1e-3
            time = 1e-6 * message.time_usec if kind == _RAW_IMU else 1e-3 * message.time_boot_ms
        return raw_sample(
            time,
            (rate * message.xgyro, -rate * message.ygyro, -rate * message.zgyro),
            (force * message.xacc, -force * message.yacc, -force * message.zacc),
        )


def _id(data: bytes, at: int) -> int:
    return data[at + 5] if data[at] == _V1 else int.from_bytes(data[at + 7 : at + 10], "little")
