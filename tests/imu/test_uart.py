"""The serial reader on a real pty."""

from __future__ import annotations

import contextlib
import os
import queue
import threading
import tty
from collections.abc import Iterator
from pathlib import Path

import pytest

from imu.protocols.json_lines import JsonLines
from imu.uart import SerialImu

TIMEOUT = 20.0
LINE = b'{"t": 1.5, "gyro": [0.1, 0.2, 0.3], "accel": [0.0, 0.0, 9.81]}\n'


class Device:
    """The far end of a serial line."""

    def __init__(self) -> None:
        self.master, slave = os.openpty()
        tty.setraw(slave)
        self.port = os.ttyname(slave)
        self._slave = slave

    def send(self, data: bytes) -> None:
        os.write(self.master, data)

    def receive(self, count: int) -> bytes:
        data = b""
        while len(data) < count:
            data += os.read(self.master, count - len(data))
        return data

    def vanish(self) -> None:
        for fd in (self._slave, self.master):
            with contextlib.suppress(OSError):
                os.close(fd)


@pytest.fixture
def device() -> Iterator[Device]:
    device = Device()
    yield device
    device.vanish()


class Host:
    """What the reader says."""

    def __init__(self, port: str) -> None:
        self.data: queue.Queue[tuple[bytes, float]] = queue.Queue()
        self.errors: queue.Queue[OSError] = queue.Queue()
        self.serial = SerialImu(port, 115200, lambda *call: self.data.put(call), self.errors.put)


def test_samples_arrive_with_a_rising_time(device: Device) -> None:
    host = Host(device.port)
    parser = JsonLines()
    samples, arrivals = [], []
    for i in range(50):
        device.send(LINE * (1 + i % 3))
        while len(samples) < sum(1 + k % 3 for k in range(i + 1)):
            data, arrival = host.data.get(timeout=TIMEOUT)
            samples += parser.feed(data)
            arrivals.append(arrival)
    host.serial.close()
    assert samples == [(1.5, 0.1, 0.2, 0.3, 0.0, 0.0, 9.81)] * len(samples)
    assert arrivals == sorted(arrivals)
    assert parser.dropped == 0
    assert host.errors.empty(), "closing is no loss"


def test_lines_go_back(device: Device) -> None:
    host = Host(device.port)
    host.serial.write(b"pose 1\n")
    assert device.receive(7) == b"pose 1\n"
    host.serial.write(b"pose 2\n")
    assert device.receive(7) == b"pose 2\n"
    host.serial.close()


def test_a_device_that_does_not_listen_holds_up_nothing(device: Device) -> None:
    """The line fills up; writing stays immediate, reading goes on, closing works."""
    host = Host(device.port)
    for _ in range(2000):
        host.serial.write(b"x" * 99 + b"\n")
    device.send(LINE)
    assert host.data.get(timeout=TIMEOUT)[0] in LINE
    host.serial.close()


def test_a_device_that_goes_away_is_an_oserror(device: Device) -> None:
    host = Host(device.port)
    device.send(LINE)
    host.data.get(timeout=TIMEOUT)
    device.vanish()
    error = host.errors.get(timeout=TIMEOUT)
    assert str(error) == f"serial port {device.port}: the device is gone"
    host.serial.close()
    host.serial.close()
    assert host.errors.empty(), "said once"


def test_it_ends_its_threads(device: Device) -> None:
    host = Host(device.port)
    threads = [thread for thread in threading.enumerate() if thread.name.endswith(device.port)]
    assert len(threads) == 2
    host.serial.close()
    assert not any(thread.is_alive() for thread in threads)


def test_closing_by_a_callback(device: Device) -> None:
    closed = threading.Event()
    host = Host(device.port)

    def close(_: bytes, __: float) -> None:
        host.serial.close()
        closed.set()

    host.serial._received = close
    device.send(LINE)
    assert closed.wait(TIMEOUT)


def test_a_port_that_is_not_there(tmp_path: Path) -> None:
    port = str(tmp_path / "ttyUSB9")
    with pytest.raises(OSError, match=f"serial port {port}: there is no such port; is the device plugged in"):
        SerialImu(port, 115200, lambda *_: None, lambda _: None)


def test_a_port_in_use(device: Device) -> None:
    host = Host(device.port)
    with pytest.raises(OSError, match="another program is using it"):
        Host(device.port)
    host.serial.close()


def test_a_speed_that_does_not_exist(device: Device) -> None:
    with pytest.raises(OSError, match="it does not do -1 baud"):
        SerialImu(device.port, -1, lambda *_: None, lambda _: None)


def test_another_speed_while_it_is_open(device: Device) -> None:
    """A pty takes any speed; what counts is that reading goes on, and that a speed nobody has is passed over."""
    host = Host(device.port)
    assert host.serial.low_latency is False, "a pty cannot"
    for baud, then in ((921600, 921600), (-1, 921600)):
        host.serial.set_baud(baud)
        assert host.serial.baud == then
        device.send(LINE)
        assert host.data.get(timeout=TIMEOUT)[0] in LINE
        while not host.data.empty():
            host.data.get()
    assert host.errors.empty()
    host.serial.close()


def test_something_that_is_no_port(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.touch()
    with pytest.raises(OSError, match=f"serial port {path}: "):
        SerialImu(str(path), 115200, lambda *_: None, lambda _: None)
