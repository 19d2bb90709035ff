"""Bytes to lines, with a bound and a count: what the JSON and the CSV protocol have in common."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

from imu.protocols import DroppedError, RawSample

# The longest line of either protocol, with every number in full precision, is under 250 bytes.
MAX_LINE = 1024


class LineParser:
    """Lines to samples by `decode`, which returns None for a line without meaning and raises DroppedError.

    `dropped`: lines that held no sample (a run of bytes longer than MAX_LINE counts as one); `reasons` says how many
    for which reason and `last_error` the latest in words. At most MAX_LINE bytes are kept between calls.
    """

    def __init__(self, decode: Callable[[bytes], RawSample | None]) -> None:
        self._decode = decode
        self._partial = b""
        self._overflowing = False
        self.reasons: Counter[str] = Counter()
        self.last_error = ""

    @property
    def dropped(self) -> int:
        return self.reasons.total()

    def feed(self, data: bytes) -> list[RawSample]:
        """The samples of the lines that `data` completes. Never raises."""
        samples: list[RawSample] = []
        *lines, partial = (self._partial + data).split(b"\n")
        for line in lines:
            try:
                if self._overflowing:
                    self._overflowing = False
                elif len(line) > MAX_LINE:
                    raise DroppedError("too long", f"more than {MAX_LINE} bytes without an end of line")
                elif (stripped := line.strip()) and (sample := self._decode(stripped)) is not None:
                    samples.append(sample)
            except DroppedError as error:
                self._count(error)
        if len(partial) > MAX_LINE:
            if not self._overflowing:
                self._count(DroppedError("too long", f"more than {MAX_LINE} bytes without an end of line"))
            self._overflowing = True
        # The bytes of an overlong line are not needed any more, only its end.
        self._partial = b"" if self._overflowing else partial
        return samples

    def _count(self, error: DroppedError) -> None:
        self.reasons[error.reason] += 1
        self.last_error = str(error)
