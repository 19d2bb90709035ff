"""Steadfix's own frames for microcontrollers: COBS with a CRC, see steadfix_frames.md and steadfix_imu.h beside this.

S. Cheshire, M. Baker, "Consistent overhead byte stuffing" (IEEE/ACM Transactions on Networking 7(2), 1999).
"""

from __future__ import annotations

from binascii import crc_hqx
from struct import Struct

from imu.protocols import DroppedError, RawSample, raw_sample
from imu.protocols.lines import LineParser

IMU_SAMPLE = 1
# type, sequence number, us, angular rate (3), specific force (3); then the CRC.
_SAMPLE = Struct("<BBI6f")
_CRC = Struct("<H")
_WRAP = 1 << 32  # us, 71.6 minutes


def encode(sequence: int, time_us: int, gyro: tuple[float, float, float], accel: tuple[float, float, float]) -> bytes:
    """A sample as steadfix_imu.h encodes it: for devices that speak Python, and for tests."""
    body = _SAMPLE.pack(IMU_SAMPLE, sequence & 0xFF, time_us % _WRAP, *gyro, *accel)
    body += _CRC.pack(crc_hqx(body, 0xFFFF))
    # No run without a zero is longer than the frame, which is shorter than the 254 bytes where COBS has to cut one.
    return b"\0" + b"".join(bytes([len(run) + 1]) + run for run in body.split(b"\0")) + b"\0"


class SteadfixFrames(LineParser):
    """See `LineParser`; `missing` counts gaps of the sequence number. The time goes on rising where the us wrap."""

    protocol = "steadfix"

    def __init__(self) -> None:
        super().__init__(self._read, end=b"\0")
        self._sequence = -1
        self._time_us = 0

    def _read(self, frame: bytes) -> RawSample:
        body = _unstuffed(frame)
        if len(body) < 3 or crc_hqx(body[:-2], 0xFFFF) != _CRC.unpack_from(body, len(body) - 2)[0]:
            raise DroppedError("wrong checksum", f"{len(frame)} bytes between delimiters: {frame[:40].hex(' ')}")
        if body[0] != IMU_SAMPLE or len(body) != _SAMPLE.size + _CRC.size:
            raise DroppedError("unknown frame", f"type {body[0]} with {len(body)} bytes; 1 with 32 is known")
        _, sequence, time_us, gx, gy, gz, ax, ay, az = _SAMPLE.unpack_from(body)
        if self._sequence >= 0:
            self.missing += (sequence - self._sequence - 1) & 0xFF
            # Forwards by up to half the range, or backwards: a device that has restarted.
            time_us = self._time_us + (time_us - self._time_us + _WRAP // 2) % _WRAP - _WRAP // 2
        self._sequence, self._time_us = sequence, time_us
        return raw_sample(1e-6 * time_us, (gx, gy, gz), (ax, ay, az))


def _unstuffed(frame: bytes) -> bytes:
    """A frame without its COBS; b"" where it has none."""
    runs, at = [], 0
    while at < len(frame):
        end = at + frame[at]
        runs.append(frame[at + 1 : end])
        at = end
    # The last run has to end with the frame.
    return b"\0".join(runs) if at == len(frame) else b""
