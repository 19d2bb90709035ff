"""Seven numbers a line: `t,gx,gy,gz,ax,ay,az` in s of the device's own clock, rad/s and m/s2, body axes."""

from __future__ import annotations

from imu.protocols import DroppedError, RawSample, raw_sample
from imu.protocols.lines import LineParser

HEADER = b"t,gx,gy,gz,ax,ay,az"


class CsvLines(LineParser):
    """See `LineParser`. A header line is skipped wherever it stands: a device sends it again when it restarts.

    Everything up to the first end of line is skipped too: a line whose beginning was missed still has seven numbers.
    """

    def __init__(self) -> None:
        super().__init__(self._decode)
        self._synchronised = False

    def feed(self, data: bytes) -> list[RawSample]:
        if not self._synchronised:
            _, newline, data = data.partition(b"\n")
            self._synchronised = newline == b"\n"
        return super().feed(data)

    @staticmethod
    def _decode(line: bytes) -> RawSample | None:
        if line.replace(b" ", b"").lower() == HEADER:
            return None
        fields = line.split(b",")
        if len(fields) != 7:
            raise DroppedError("wrong columns", f"{len(fields)} instead of 7 in {line[:80]!r}")
        try:
            t, gx, gy, gz, ax, ay, az = map(float, fields)
        except ValueError:
            raise DroppedError("not a number", repr(line[:80])) from None
        return raw_sample(t, (gx, gy, gz), (ax, ay, az))
