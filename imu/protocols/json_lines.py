"""One JSON object a line: `{"t": 12.345, "gyro": [gx, gy, gz], "accel": [ax, ay, az]}`.

`t`: s of the device's own clock; may be left out. rad/s and m/s2, body axes. Other keys are ignored.
"""

from __future__ import annotations

import msgspec

from imu.protocols import DroppedError, RawSample, raw_sample
from imu.protocols.lines import LineParser


class _Reading(msgspec.Struct):
    gyro: tuple[float, float, float]
    accel: tuple[float, float, float]
    t: float | None = None


_DECODER = msgspec.json.Decoder(_Reading)


class JsonLines(LineParser):
    """See `LineParser`."""

    protocol = "json"

    def __init__(self) -> None:
        super().__init__(_decode)


def _decode(line: bytes) -> RawSample | None:
    try:
        reading = _DECODER.decode(line)
    except msgspec.ValidationError as error:
        raise DroppedError("wrong fields", f"{error} in {line[:80]!r}") from None
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        raise DroppedError("not JSON", repr(line[:80])) from None
    return raw_sample(reading.t, reading.gyro, reading.accel)
