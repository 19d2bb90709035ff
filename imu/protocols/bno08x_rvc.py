"""BNO08x in UART-RVC mode: 19 bytes a hundred times a second, 0xAA 0xAA, a counter, angles and accelerations, a sum.

"BNO080 datasheet", Hillcrest Laboratories, 1000-3927 (October 2017), section 1.3.5.2. **There are no angular rates**:
they are taken from the angles of two successive frames, which come in steps of 0.01 deg. Their integral is as good as
the angles, but they are the mean over 10 ms, in steps of 1 deg/s, and what the sensor's own fusion has smoothed or
corrected is in them: good enough for a floor robot, and said to be degraded.

Axes are those printed on the sensor, z up. The angles are an aircraft's, whose nose is the sensor's y axis: yaw
clockwise seen from above, pitch about x, roll about y, to be applied in this order; so the datasheet's example, whose
acceleration fits no other reading, and the users of the sensor's yaw.
"""

from __future__ import annotations

import math
import re
from struct import Struct
from typing import NamedTuple

from imu.protocols import DroppedError, RawSample, raw_sample
from imu.protocols.frames import INCOMPLETE, FrameParser

_LENGTH = 19
_REPORT = Struct("<2xB6h")
_PERIOD = 0.01  # s
_LONGEST = 10  # frames between two whose angles still give a rate
_STEP = math.radians(0.01)
_FORCE = 9.80665e-3  # m/s2 per mg

Quaternion = tuple[float, float, float, float]


class Report(NamedTuple):
    """A frame as it is. Angles in rad, z and x and y as named above; specific force in m/s2."""

    counter: int
    yaw: float
    pitch: float
    roll: float
    ax: float
    ay: float
    az: float


class Bno08xRvc(FrameParser):
    """See `FrameParser`; `missing` counts gaps of the counter, which is also the clock. `report`: the latest frame."""

    protocol = "bno08x-rvc"
    note = (
        "this protocol has no angular rates: they are derived from its angles, in steps of 1 deg/s; "
        "the sensor's I2C or SPI modes give true ones"
    )
    _START = re.compile(rb"\xaa")

    def __init__(self) -> None:
        super().__init__()
        self.report: Report | None = None
        self._count = 0
        self._attitude: Quaternion | None = None

    def _measure(self, data: bytes, at: int) -> int:
        if data[at + 1 : at + 2] not in (b"\xaa", b""):
            return 0
        if len(data) < at + _LENGTH:
            return INCOMPLETE
        return _LENGTH if sum(data[at + 2 : at + 18]) & 0xFF == data[at + 18] else 0

    def _decode(self, frame: bytes) -> RawSample | None:
        counter, yaw, pitch, roll, ax, ay, az = _REPORT.unpack_from(frame)
        if abs(yaw) > 18000 or abs(pitch) > 18000 or abs(roll) > 18000:
            raise DroppedError("out of range", f"angles of {yaw / 100}, {pitch / 100}, {roll / 100} deg")
        self.report = Report(counter, _STEP * yaw, _STEP * pitch, _STEP * roll, _FORCE * ax, _FORCE * ay, _FORCE * az)
        frames = (counter - self._count) & 0xFF
        before, self._attitude = self._attitude, _attitude(-self.report.yaw, self.report.pitch, self.report.roll)
        self._count += frames
        if before is None:
            return None
        if frames == 0:
            raise DroppedError("repeated", f"frame {counter} came twice")
        self.missing += frames - 1
        if frames > _LONGEST:
            return None
        rates = _rate(before, self._attitude, frames * _PERIOD)
        return raw_sample(_PERIOD * self._count, rates, self.report[4:])


def _attitude(z: float, x: float, y: float) -> Quaternion:
    """wxyz of a rotation about z, then about the new x, then about the new y, rad."""
    cz, sz, cx, sx = math.cos(0.5 * z), math.sin(0.5 * z), math.cos(0.5 * x), math.sin(0.5 * x)
    cy, sy = math.cos(0.5 * y), math.sin(0.5 * y)
    w, i, j, k = cz * cx, cz * sx, sz * sx, sz * cx
    return w * cy - j * sy, i * cy - k * sy, j * cy + w * sy, k * cy + i * sy


def _rate(a: Quaternion, b: Quaternion, dt: float) -> tuple[float, float, float]:
    """rad/s in the axes of the sensor that turns it from attitude a to b in dt."""
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    w = aw * bw + ax * bx + ay * by + az * bz
    x = aw * bx - ax * bw - ay * bz + az * by
    y = aw * by - ay * bw - az * bx + ax * bz
    z = aw * bz - az * bw - ax * by + ay * bx
    half_sine = math.sqrt(x * x + y * y + z * z)
    if half_sine < 1e-9:
        return 0.0, 0.0, 0.0
    # Of the two ways round the shorter one.
    scale = 2.0 * math.atan2(half_sine, abs(w)) / (half_sine * dt) * (1.0 if w >= 0.0 else -1.0)
    return scale * x, scale * y, scale * z
