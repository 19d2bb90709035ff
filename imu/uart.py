"""Serial ports: a reader and a writer thread each. The only importer of pyserial."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable

import serial

# s: how long a write may take before its message is given up; a device that does not listen must not hold up anybody.
WRITE_TIMEOUT = 0.5


class SerialImu:
    """A port, open until `close` or until the device goes away.

    `received(data, arrival)` is called in the reader thread for all bytes that came together, with the host monotonic
    time at which they were read. `lost(error)` is called there once, with an OSError that names the port, if the device
    goes away; not after `close`. Raises OSError in plain words if the port cannot be opened, or not at this speed.

    `low_latency`: whether the driver was told to hand bytes on at once; where it cannot be told, `imu.health` notices
    batches and says how to set its latency timer.
    """

    def __init__(
        self,
        port: str,
        baud: int,
        received: Callable[[bytes, float], None],
        lost: Callable[[OSError], None],
    ) -> None:
        self.port = port
        self.baud = baud
        self._received = received
        self._lost = lost
        try:
            self._serial = serial.Serial(port, baud, timeout=1.0, write_timeout=WRITE_TIMEOUT, exclusive=True)
        except ValueError:
            raise OSError(f"serial port {port}: it does not do {baud} baud") from None
        except serial.SerialException as error:
            raise OSError(f"serial port {port}: {_plain(error)}") from None
        self.low_latency = False
        # Drivers that cannot do it (a pty, most USB modems) say so in different ways.
        with contextlib.suppress(OSError, ValueError, AttributeError, NotImplementedError):
            self._serial.set_low_latency_mode(True)
            self.low_latency = True
        self._closing = threading.Event()
        self._message: bytes | None = None
        self._message_ready = threading.Condition()
        self._threads = [
            threading.Thread(target=run, name=f"{name} {port}", daemon=True)
            for name, run in (("read", self._read), ("write", self._write))
        ]
        for thread in self._threads:
            thread.start()

    def set_baud(self, baud: int) -> None:
        """Go on at another speed, if the port has it; what has come at the old one is dropped."""
        with contextlib.suppress(OSError, ValueError):
            self._serial.baudrate = baud
            self.baud = baud
            self._serial.reset_input_buffer()

    def write(self, data: bytes) -> None:
        """Send `data` as soon as the line is free. Does not block; what still waits is replaced: the latest wins."""
        with self._message_ready:
            self._message = data
            self._message_ready.notify()

    def close(self) -> None:
        """Close the port and end the threads. May be called twice, also by the callbacks."""
        self._stop()
        for thread in self._threads:
            if thread is not threading.current_thread():
                thread.join()
        self._serial.close()

    def _stop(self) -> None:
        self._closing.set()
        with contextlib.suppress(OSError):
            self._serial.cancel_read()
        with self._message_ready:
            self._message_ready.notify()

    def _read(self) -> None:
        while not self._closing.is_set():
            try:
                # What is there at once: byte by byte costs several times the time.
                data = self._serial.read(max(1, self._serial.in_waiting))
            except (OSError, TypeError) as error:  # TypeError: pyserial, when the port is closed under it
                if not self._closing.is_set():
                    self._stop()
                    self._lost(OSError(f"serial port {self.port}: {_plain(error)}"))
                return
            if data:
                self._received(data, time.monotonic())

    def _write(self) -> None:
        gap = b""
        while True:
            with self._message_ready:
                self._message_ready.wait_for(lambda: self._message is not None or self._closing.is_set())
                message, self._message = self._message, None
            if self._closing.is_set() or message is None:
                return
            try:
                self._serial.write(gap + message)
                gap = b""
            except serial.SerialTimeoutException:
                # A part of it may have left: its line is ended before the next one begins.
                gap = b"\n"
            except OSError:
                return  # the reader sees it too, and says so


def _plain(error: BaseException) -> str:
    text = str(error)
    if "No such file" in text:
        return "there is no such port; is the device plugged in?"
    if "Permission denied" in text:
        return "no permission to open it; on Linux its group (often dialout) may"
    if "exclusively lock" in text:
        return "another program is using it"
    if "returned no data" in text or "Input/output error" in text or isinstance(error, TypeError):
        return "the device is gone"
    return text
