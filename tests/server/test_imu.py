"""`steadfix imu`: on a pty fed by each protocol, on files and standard input, and how it ends."""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import math
import os
import signal
import subprocess
import sys
import threading
import tty
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest

from imu.protocols import RawSample
from imu.protocols.detection import ProtocolName
from server import imu
from tests.data import data
from tests.imu.streams import G, frames, rocking, rvc_frame

ROOT = Path(__file__).parents[2]
TAKEN = 100_000
PROTOCOLS = [name for name in get_args(ProtocolName) if name != "auto"]


def still(n: int = 300, one: float = G) -> list[RawSample]:
    """A sensor at rest that reads gravity as `one`."""
    noise = np.random.default_rng(3).normal([0.01, -0.005, 0.002, 0.0, 0.0, one], [2e-3] * 3 + [0.02] * 3, (n, 6))
    return [RawSample(5.0 + 0.01 * i, *readings) for i, readings in enumerate(noise.tolist())]


def wire(protocol: str, samples: list[RawSample]) -> bytes:
    if protocol != "bno08x-rvc":
        # A line of CSV is only known to be whole when one has ended before it.
        return b"\n" * (protocol == "csv") + b"".join(frames(protocol, samples))
    return b"".join(rvc_frame(i, 0.01 * (i % 2), 1.0, 2.0, sample[4:]) for i, sample in enumerate(samples))


def parsed(*arguments: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    imu.add_arguments(parser)
    return parser.parse_args(arguments)


@pytest.fixture
def command(capfd: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str, str]]:
    """Runs the command: exit status, output, standard error."""

    def run(*arguments: object) -> tuple[int, str, str]:
        status = imu.run(parsed(*map(str, arguments)))
        output = capfd.readouterr()
        return status, output.out, output.err

    return run


class Device:
    """The far end of a serial line, which sends again and again what it was given, from a thread."""

    def __init__(self) -> None:
        self.master, slave = os.openpty()
        tty.setraw(slave)
        self.port = os.ttyname(slave)
        self._slave = slave
        # Once TAKEN bytes have been, which is more than a pty holds.
        self.taken = threading.Event()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=lambda: None)

    def send(self, content: bytes, again: bool = False) -> None:
        def run() -> None:
            count = 0
            with contextlib.suppress(OSError):
                while not self._ended.is_set() and (again or count < len(content)):
                    at = count % len(content)
                    count += os.write(self.master, content[at : at + 500])
                    if count > TAKEN:
                        self.taken.set()

        self._thread = threading.Thread(target=run)
        self._thread.start()

    def vanish(self) -> None:
        self._ended.set()
        with contextlib.suppress(OSError):
            # A writer that waits for room gets it.
            os.set_blocking(self._slave, False)
            while self._thread.is_alive():
                with contextlib.suppress(BlockingIOError):
                    os.read(self._slave, 4096)
                self._thread.join(0.01)
            os.close(self._slave)
            os.close(self.master)


@pytest.fixture
def device(monkeypatch: pytest.MonkeyPatch) -> Iterator[Device]:
    """A silence is seen at once."""
    monkeypatch.setattr(imu, "VIEW_EVERY", 0.01)
    monkeypatch.setattr(imu, "PAUSE", 0.01)
    device = Device()
    yield device
    device.vanish()


def listened(device: Device, content: bytes, until: Callable[[imu._Watch], bool], *options: str) -> dict[str, Any]:
    """The report once `until` holds; the timeout of the tests ends what never comes."""
    args = parsed(device.port, *options)
    watch = imu._Watch(args, True)
    with contextlib.closing(imu._port(watch, args)) as times:
        # What comes before a port is open is not for it.
        next(times)
        device.send(content)
        for _ in times:
            if until(watch):
                break
    return watch.report()


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_each_protocol_on_a_pty(device: Device, protocol: str) -> None:
    """Recognised at 115200 baud, whatever the pty makes of that, all samples read, at rest and upright."""
    sent = still()
    expected = len(sent) - (protocol == "bno08x-rvc")
    report = listened(device, wire(protocol, sent), lambda watch: watch.health.samples == expected)
    assert (report["protocol"], report["baud"]) == (protocol, 115200)
    assert report["low_latency"] is False, "a pty has none"
    assert (report["samples"], report["dropped"], report["missing"]) == (expected, 0, 0)
    assert report["gravity"] == pytest.approx(G, abs=0.05)
    assert report["gravity_direction"] == "+z"
    assert report["latest"][4:] == pytest.approx(sent[-1][4:], abs=0.02)
    assert report["stamped"] is (protocol not in ("witmotion", "vectornav"))
    if report["stamped"]:
        assert report["rate_hz"] == pytest.approx(100.0, rel=0.01)
        assert report["clock"]["restarts"] == 0
        assert report["rest"]["seconds"] > 2.0
    errors = [finding["text"] for finding in report["findings"] if finding["severity"] == "error"]
    assert errors == []
    degraded = [finding for finding in report["findings"] if finding["code"] == "imu_degraded"]
    assert len(degraded) == (protocol == "bno08x-rvc")
    json.dumps(report)
    assert f"{device.port}: {protocol}, 115200 baud" in imu._text(report)


def test_a_given_protocol_and_what_it_does_not_understand(device: Device) -> None:
    options = ("--protocol", "json", "--baud", "57600")
    report = listened(device, wire("csv", still()), lambda watch: watch.parser.dropped >= 100, *options)
    assert (report["protocol"], report["baud"], report["samples"]) == ("json", 57600, 0)
    assert any(
        "100% of what it sends cannot be used (wrong fields)" in finding["text"] for finding in report["findings"]
    )


def test_the_speed_is_searched(device: Device) -> None:
    """Garbage until another speed is tried, as from a device at that."""
    args = parsed(device.port)
    watch = imu._Watch(args, True)
    with contextlib.closing(imu._port(watch, args)) as times:
        next(times)
        device.send(b"\xf8\x00\x78\x80" * 200)
        next(time for time in times if watch.baud != 115200)
        device.send(wire("steadfix", still()))
        next(time for time in times if watch.health.samples == 300)
    report = watch.report()
    assert (report["protocol"], report["baud"]) == ("steadfix", 9600)
    assert watch.port is not None
    assert watch.port.baud == 9600


def test_g_on_a_port_is_said(device: Device) -> None:
    report = listened(device, wire("steadfix", still(one=1.0)), lambda watch: watch.health.samples == 300)
    assert "gravity reads 1.0: these are g, not m/s2" in imu._text(report)


def test_a_port_that_is_lost_is_waited_for(device: Device, tmp_path: Path) -> None:
    """By its name, behind which another device then is."""
    link = tmp_path / "imu"
    link.symlink_to(device.port)
    args = parsed(str(link))
    watch = imu._Watch(args, True)
    second = Device()
    try:
        with contextlib.closing(imu._port(watch, args)) as times:
            next(times)
            device.send(wire("json", still()))
            next(time for time in times if watch.health.samples == 300)
            device.vanish()
            link.unlink()
            next(time for time in times if watch.trouble)
            assert watch.findings()[0].code == "imu_lost"
            link.symlink_to(second.port)
            next(time for time in times if not watch.trouble)
            second.send(wire("json", still()))
            next(time for time in times if watch.health.samples == 600)
    finally:
        second.vanish()


def test_a_port_that_is_lost_ends_a_json_answer(device: Device, command: Callable[..., tuple[int, str, str]]) -> None:
    device.send(wire("json", still()), again=True)
    # More than a pty holds: the command has taken the rest.
    unplug = threading.Thread(target=lambda: device.taken.wait(60.0) and device.vanish())
    unplug.start()
    status, out, err = command(device.port, "--json", "--seconds", 60)
    unplug.join()
    report = json.loads(out)
    assert status == 1
    assert report["samples"] > 300
    assert report["error"] == f"serial port {device.port}: the device is gone"
    assert err == f"steadfix: {report['error']}\n"


def test_silence_is_said(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(imu, "SILENCE", 0.0)
    report = listened(device, b"", lambda _: True)
    (finding,) = report["findings"]
    assert finding["code"] == "imu_silent"
    assert "is the device on, and are its TX and RX the right way round?" in finding["text"]


def test_in_a_terminal_the_view_is_redrawn_and_ctrl_c_leaves_the_last(device: Device) -> None:
    """The command in a terminal of its own, as a user has it."""
    device.send(wire("steadfix", still() + still()), again=True)
    terminal, theirs = os.openpty()
    with subprocess.Popen(
        [sys.executable, "-m", "server.cli", "imu", device.port], cwd=ROOT, stdout=theirs, stderr=subprocess.PIPE
    ) as process:
        os.close(theirs)
        try:
            shown = b""
            # Twice: what is erased before the second has been drawn.
            while shown.count(b"\x1b[J") < 2:
                shown += os.read(terminal, 4096)
            process.send_signal(signal.SIGINT)
            with contextlib.suppress(OSError):  # EIO: the other end is closed
                while more := os.read(terminal, 4096):
                    shown += more
            assert process.stderr is not None
            assert process.stderr.read() == b""
            assert process.wait(30) == 0
        finally:
            process.kill()
            os.close(terminal)
    last = shown.rpartition(b"\x1b[J")[2].decode()
    assert f"{device.port}: steadfix, 115200 baud" in last
    assert "upwards on +z" in last


# Files and standard input


def test_a_file_of_what_was_sent(tmp_path: Path, command: Callable[..., tuple[int, str, str]]) -> None:
    path = tmp_path / "captured"
    path.write_bytes(wire("vectornav-binary", still(one=1.0)))
    status, out, err = command(path)
    assert (status, err) == (0, "")
    lines = out.splitlines()
    assert lines[0] == f"{path}: vectornav-binary"
    assert "300, 100.0 Hz, 0 missing, 0 dropped (0 bytes)" in lines[1]
    assert "  error: gravity reads 1.0: these are g, not m/s2" in lines
    status, out, _ = command(path, "--json")
    report = json.loads(out)
    assert status == 0
    assert (report["baud"], report["clock"], report["error"]) == (None, None, None)
    assert [finding["code"] for finding in report["findings"]] == ["accel_unit"]


def test_what_was_wrong_in_the_middle_of_a_file_is_still_said_at_its_end(
    tmp_path: Path, command: Callable[..., tuple[int, str, str]]
) -> None:
    samples = still(1100, one=1.0) + still(2500)
    path = tmp_path / "captured"
    path.write_bytes(wire("csv", [s._replace(device_time=0.01 * i) for i, s in enumerate(samples)]))
    _, out, _ = command(path, "--json")
    assert [finding["code"] for finding in json.loads(out)["findings"]] == ["accel_unit"]


@pytest.mark.parametrize("protocol", ["json", "csv", "vectornav"])
def test_a_last_line_without_an_end_counts(
    protocol: str, tmp_path: Path, command: Callable[..., tuple[int, str, str]]
) -> None:
    path = tmp_path / "captured"
    path.write_bytes(wire(protocol, still(30)).rstrip(b"\r\n"))
    _, out, _ = command(path, "--json")
    assert json.loads(out)["samples"] == 30


def test_standard_input_and_a_closed_pipe() -> None:
    """As `cat captured | steadfix imu - | head -1` has them."""
    answer = subprocess.run(
        [sys.executable, "-m", "server.cli", "imu", "-"],
        cwd=ROOT,
        input=wire("mavlink", rocking(2.0)),
        capture_output=True,
        timeout=60,
    )
    assert (answer.returncode, answer.stderr) == (0, b"")
    assert answer.stdout.startswith(b"-: mavlink\n")
    reader, writer = os.pipe()
    os.close(reader)
    with os.fdopen(writer, "wb") as closed:
        answer = subprocess.run(
            [sys.executable, "-m", "server.cli", "imu", "-"],
            cwd=ROOT,
            input=b"",
            stdout=closed,
            stderr=subprocess.PIPE,
            timeout=60,
        )
    assert (answer.returncode, answer.stderr) == (141, b"")


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"", "nothing has come yet"),
        (b"half\nhello\n", "text of no known form, such as 'hello'"),
        (b"1,2,3,4,5,6\n" * 500, "its columns have to be named"),
        (bytes(range(128, 250)) * 50, "a wrong baud rate, or an unknown protocol"),
        (b'{"gyro": [NaN, 0, 0], "accel": [0, 0, 9.8]}\n' * 200, "as JSON it needs"),
    ],
)
def test_files_without_a_sample(
    content: bytes, says: str, tmp_path: Path, command: Callable[..., tuple[int, str, str]]
) -> None:
    path = tmp_path / "captured"
    path.write_bytes(content)
    status, out, _ = command(path)
    assert status == 1
    assert says in out
    assert "baud)" not in out, "a file has none"


def test_the_captures(command: Callable[..., tuple[int, str, str]]) -> None:
    folder = data("serial_captures")
    status, out, _ = command(folder / "bno08x_rvc_sample.bin")
    assert status == 1, "one frame, and a rate needs two"
    assert out.startswith(f"{folder / 'bno08x_rvc_sample.bin'}: bno08x-rvc\n")
    assert "bno08x-rvc: 1 messages, none with a sample of an IMU yet" in out
    five = folder / "five_imus_interleaved_first_half.txt"
    assert "its columns have to be named" in command(five)[1]
    columns = "id=3,t[s],t[us],-,ax[1e-3],ay[1e-3],az[1e-3],gx[1e-3],gy[1e-3],gz[1e-3],-,-"
    status, out, _ = command(five, "--columns", columns, "--json")
    report = json.loads(out)
    assert (status, report["samples"], report["dropped"]) == (0, 749, 16)
    assert report["rate_hz"] == pytest.approx(25.06, abs=0.05)
    assert report["gravity_direction"] == "-z"


@pytest.mark.parametrize(
    ("arguments", "status", "says"),
    [
        (["/dev/nothing"], 1, "/dev/nothing: there is no such port or file; is the device plugged in?"),
        (["."], 1, ".: is a directory"),
        (["-", "--columns", "t,gx"], 2, "no column for gy gz ax ay az"),
        (["-", "--protocol", "xml"], 2, "invalid choice: 'xml'"),
        (["-", "--baud", "fast"], 2, "'fast' is no speed, 1200 to 12000000 are"),
        (["-", "--seconds", "0"], 2, "seconds above 0 are needed"),
        (["/dev/null", "--seconds", "1"], 1, "serial port /dev/null: "),
    ],
)
def test_what_cannot_be(arguments: list[str], status: int, says: str) -> None:
    answer = subprocess.run(
        [sys.executable, "-m", "server.cli", "imu", *arguments],
        cwd=ROOT,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert answer.returncode == status
    assert says in answer.stderr
    assert "Traceback" not in answer.stderr


def test_nothing_is_drawn_where_there_is_no_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    stdout = io.StringIO()
    monkeypatch.setattr(sys, "stdout", stdout)
    view = imu._View(True)
    view.show(imu._Watch(parsed("-"), False), math.inf)
    view.clear()
    assert stdout.getvalue() == ""
