"""Bytes to lines, or to frames between delimiters, with a bound and a count."""

from __future__ import annotations

from collections.abc import Callable

from imu.protocols import DroppedError, Parser, RawSample

# A sample with every number in full precision takes under 500 bytes; the header of a wide table takes more.
MAX_LINE = 4096


class LineParser(Parser):
    """Lines to samples by `decode`, which returns None for a line without meaning and raises DroppedError.

    A run of more than MAX_LINE bytes without an `end` counts as one line. At most MAX_LINE bytes are kept between
    calls. Empty lines are none.
    """

    def __init__(self, decode: Callable[[bytes], RawSample | None], end: bytes = b"\n") -> None:
        super().__init__()
        self._decode = decode
        self._end = end
        self._partial = b""
        self._overflowing = False

    def feed(self, data: bytes) -> list[RawSample]:
        samples: list[RawSample] = []
        *lines, partial = (self._partial + data).split(self._end)
        for line in lines:
            try:
                if self._overflowing:
                    self._overflowing = False
                    self.dropped_bytes += len(line) + 1
                elif len(line) > MAX_LINE:
                    raise DroppedError("too long", f"more than {MAX_LINE} bytes without an end of line")
                elif line and not line.isspace():
                    sample = self._decode(line)
                    self.frames += 1
                    if sample is not None:
                        samples.append(sample)
            except DroppedError as error:
                self._drop(error)
                self.dropped_bytes += len(line) + 1
        if len(partial) > MAX_LINE or self._overflowing:
            if not self._overflowing:
                self._drop(DroppedError("too long", f"more than {MAX_LINE} bytes without an end of line"))
            # The bytes of an overlong line are not needed any more, only its end.
            self._overflowing = True
            self.dropped_bytes += len(partial)
            partial = b""
        self._partial = partial
        return samples
