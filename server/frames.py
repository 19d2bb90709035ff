"""A camera's frames, for as long as the process runs: its source is opened again whenever it is lost."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from typing import Generic, Protocol, TypeVar

from camera.calibration import CalibrationError

log = logging.getLogger("steadfix.camera")

# s without a frame after which a camera counts as lost. The first frame of a USB camera takes a second or two.
READ_TIMEOUT = 5.0

F = TypeVar("F")
F_co = TypeVar("F_co", covariant=True)


class Source(Protocol[F_co]):
    """As `camera.capture.FrameSource`, of whatever frames."""

    def read(self, timeout: float) -> F_co | None: ...
    def close(self) -> None: ...


class FrameThread(threading.Thread, Generic[F]):
    """Opens a source and hands on its frames, and opens it again whenever it is lost, until `stop`.

    Called in the thread: `open`; `see` with each frame; `lost` with what is wrong in words; `ended` at the end of a
    file, which is that of the thread. `pauses`: s before it tries again, the first and the longest, up to which they
    double.
    """

    def __init__(
        self,
        name: str,
        open: Callable[[], Source[F]],
        see: Callable[[F], None],
        lost: Callable[[str], None],
        ended: Callable[[], None],
        pauses: tuple[float, float],
    ) -> None:
        # A daemon: a driver that hangs must not keep the process from ending.
        super().__init__(name=name, daemon=True)
        self._open, self._see, self._lost, self._ended, self._pauses = open, see, lost, ended, pauses
        self._source: Source[F] | None = None
        self.stopping = threading.Event()

    def stop(self) -> None:
        """Ask it to end; `join` waits for that."""
        self.stopping.set()
        if (source := self._source) is not None:
            # Wakes a read that waits for a frame. It may itself wait for a driver that hangs.
            threading.Thread(target=source.close, daemon=True).start()

    def run(self) -> None:
        first, longest = self._pauses
        pause = first
        while not self.stopping.is_set():
            try:
                source = self._source = self._open()
                try:
                    while (frame := source.read(READ_TIMEOUT)) is not None and not self.stopping.is_set():
                        self._see(frame)
                        pause = first
                finally:
                    self._source = None
                    source.close()
                if not self.stopping.is_set():
                    self._ended()
                return
            except (OSError, CalibrationError) as error:
                trouble = str(error)
            except Exception as error:
                # A mistake of ours must not end the other cameras, nor be hidden.
                trouble = f"stopped by an error inside Steadfix: {error!r}"
                log.debug("%s", self.name, exc_info=True)
            self._lost(trouble)
            self.stopping.wait(pause)
            pause = min(2.0 * pause, longest)
