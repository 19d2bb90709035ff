"""Bytes to binary frames that begin with a known byte, say how long they are, and carry a checksum."""

from __future__ import annotations

import re

from imu.protocols import DroppedError, Parser, RawSample

# How many bytes may come before the first frame: whoever opens a port begins in the middle of one.
START_ROOM = 512
# What `FrameParser._measure` says where the frame is not all there yet.
INCOMPLETE = -1


class FrameParser(Parser):
    """Frames to samples. A subclass gives `_START`, `_measure` and `_decode`.

    Where a frame turns out to be none, the search goes on with the byte after its first: what noise claims to be a
    frame cannot hide a true one behind it. A run of bytes that are no frame counts as one drop.
    """

    # Where a frame may begin, a pattern of one byte.
    _START: re.Pattern[bytes]

    def __init__(self) -> None:
        super().__init__()
        self._partial = b""
        self._room = START_ROOM
        self._run = 0

    def _measure(self, data: bytes, at: int) -> int:
        """Bytes of the frame that begins at `at`, its checksum being right; 0 if none does, or INCOMPLETE."""
        raise NotImplementedError

    def _decode(self, frame: bytes) -> RawSample | None:
        """The sample of a frame, None where it holds none. Raises DroppedError."""
        raise NotImplementedError

    def feed(self, data: bytes) -> list[RawSample]:
        samples: list[RawSample] = []
        data = self._partial + data
        at = 0
        while found := self._START.search(data, at):
            begin = found.start()
            length = self._measure(data, begin)
            if length == INCOMPLETE:
                self._skip(begin - at)
                at = begin
                break
            if length == 0:
                self._skip(begin + 1 - at)
                at = begin + 1
                continue
            self._skip(begin - at)
            self._room = self._run = 0
            self.frames += 1
            at = begin + length
            try:
                if (sample := self._decode(data[begin:at])) is not None:
                    samples.append(sample)
            except DroppedError as error:
                self._drop(error)
                self.dropped_bytes += length
        else:
            self._skip(len(data) - at)
            at = len(data)
        self._partial = data[at:]
        return samples

    def _skip(self, count: int) -> None:
        """Bytes that are no frame."""
        if count:
            if self._run <= self._room < self._run + count:
                self._drop(DroppedError("no frame", "bytes of another protocol, or a frame with a wrong checksum"))
            self._run += count
            self.dropped_bytes += count
