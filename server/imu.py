"""`steadfix imu`: what an IMU sends, live or from a file, and what is wrong with it in words."""

from __future__ import annotations

import argparse
import contextlib
import math
import os
import queue
import stat
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, get_args

import msgspec
import numpy as np

from imu.clock import DeviceClock
from imu.health import WINDOW, Finding, StreamHealth
from imu.protocols import RawSample
from imu.protocols.detection import Detector, ProtocolName, open_parser
from imu.uart import SerialImu

# s between two views, and of a silence or of a port that is gone.
VIEW_EVERY = 0.5
SILENCE = 3.0
PAUSE = 1.0
# s that a port is listened to where the answer is one JSON object and nobody says for how long.
JSON_SECONDS = 5.0
# Samples after which a file is looked at, and bytes of it that are read at once.
LOOK_EVERY = 1000
CHUNK = 1 << 16


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the command's arguments."""
    parser.add_argument("source", metavar="PORT", help="serial port, file of what one sent, or - for standard input")
    parser.add_argument("--protocol", choices=get_args(ProtocolName), default="auto", help="default: as it looks")
    parser.add_argument("--columns", default="", metavar="C", help="of CSV, such as t[us],gx[deg/s],...,az[g]")
    parser.add_argument(
        "--baud", type=_baud, default=115200, help="of a port; default 115200, then others until one is understood"
    )
    parser.add_argument("--seconds", type=_seconds, metavar="S", help="of listening to a port; default until Ctrl-C")
    parser.add_argument("--json", action="store_true", help="print one JSON object at the end")


def _baud(text: str) -> int:
    if not (text.isdecimal() and text.isascii() and 1200 <= int(text) <= 12_000_000):
        raise argparse.ArgumentTypeError(f"{text!r} is no speed, 1200 to 12000000 are")
    return int(text)


def _seconds(text: str) -> float:
    seconds = float(text)
    if not 0.0 < seconds < math.inf:
        raise argparse.ArgumentTypeError(f"{text!r}: seconds above 0 are needed")
    return seconds


def run(args: argparse.Namespace) -> int:
    """Runs the command. Returns 0, or 1 where not one sample came. Raises OSError and ColumnsError."""
    path = Path(args.source)
    is_port = path.exists() and stat.S_ISCHR(path.stat().st_mode)
    if not is_port and args.source != "-" and not path.exists():
        if os.name == "posix":
            raise OSError(f"{args.source}: there is no such port or file; is the device plugged in?")
        is_port = True  # COM3 is no path
    watch = _Watch(args, is_port)
    view = _View(not args.json)
    error = ""
    try:
        with contextlib.suppress(KeyboardInterrupt):
            for now in _port(watch, args) if is_port else _file(watch, args.source):
                view.show(watch, now)
    except OSError as lost:
        # What was heard until then is worth saying too.
        if watch.bytes == 0:
            raise
        error = str(lost)
    report = watch.report()
    if args.json:
        # A number that is none becomes null.
        print(msgspec.json.encode(report | {"error": error or None}).decode())
    else:
        view.clear()
        print(_text(report))
    if error:
        print(f"steadfix: {error}", file=sys.stderr)
    return 1 if error or report["samples"] == 0 else 0


class _Watch:
    """All that is known of one device."""

    def __init__(self, args: argparse.Namespace, is_port: bool) -> None:
        self.source = args.source
        self.port: SerialImu | None = None
        self.is_port = is_port
        self.baud = args.baud if is_port else 0
        self.parser = open_parser(args.protocol, args.columns, self.baud)
        self.health = StreamHealth(parser=self.parser, port=args.source if is_port else "")
        self.clock = DeviceClock()
        self.bytes = 0
        self.began = self.heard = time.monotonic()
        self.trouble = ""
        self.latest: RawSample | None = None
        self._said: dict[str, Finding] = {}

    def feed(self, data: bytes, arrival: float) -> None:
        """Bytes that came together; `arrival` is NaN for those of a file."""
        self.bytes += len(data)
        self.heard = time.monotonic()
        self._take(self.parser.feed(data), arrival)
        if self.port is not None and isinstance(self.parser, Detector) and self.parser.baud != self.baud:
            self.baud = self.parser.baud
            self.port.set_baud(self.baud)

    def end(self) -> None:
        """No more comes: what is left in the parser."""
        # A last line without an end.
        if self.bytes and self.parser.protocol in ("", "json", "csv", "vectornav"):
            self._take(self.parser.feed(b"\n"), math.nan)
        if isinstance(self.parser, Detector):
            self._take(self.parser.settle(), math.nan)

    def _take(self, samples: Sequence[RawSample], arrival: float) -> None:
        for at in range(0, len(samples), LOOK_EVERY):
            self._look(samples[at : at + LOOK_EVERY], arrival)

    def _look(self, samples: Sequence[RawSample], arrival: float) -> None:
        of_file = math.isnan(arrival)
        readings = np.array(samples, dtype=np.float64) if of_file else self.clock.stamp(samples, arrival)
        before = self.health.samples
        self.health.feed(samples, readings, arrival)
        self.latest = samples[-1]
        if self.health.samples // LOOK_EVERY != before // LOOK_EVERY:
            self.findings()

    def findings(self) -> list[Finding]:
        """What there is to say now."""
        found = self.health.findings()
        if self.is_port and self.trouble:
            found.insert(0, Finding("imu_lost", "error", self.trouble, {}))
        elif self.is_port and (silence := time.monotonic() - self.heard) > SILENCE:
            text = f"nothing has come for {silence:.0f} s: is the device on, and are its TX and RX the right way round?"
            found.insert(0, Finding("imu_silent", "error", text, {"seconds": silence}))
        elif self.health.samples == 0 and (self.parser.frames or not found):
            text = f"{self.bytes} bytes, and no sample yet" if self.bytes else "nothing has come yet"
            if self.parser.frames:
                text = f"{self.parser.protocol}: {self.parser.frames} messages, none with a sample of an IMU yet"
            found.append(Finding("imu_silent", "note" if self.is_port else "error", text, {"bytes": self.bytes}))
        self._said.update((finding.code, finding) for finding in found if finding.code != "imu_silent")
        return found

    def report(self) -> dict[str, Any]:
        """Plain values; `findings` are those of now, then those that were made before."""
        current = self.findings()
        codes = {finding.code for finding in current}
        findings = [*current, *(finding for code, finding in self._said.items() if code not in codes)]
        figures = self.health.figures()
        clock = None
        if self.is_port and self.latest is not None and self.latest.device_time is not None:
            t = self.latest.device_time
            clock = {
                "offset_s": self.clock.to_host(t) - t,
                "skew_ppm": 1e6 * self.clock.skew,
                "restarts": self.clock.restarts,
            }
        return {
            "source": self.source,
            "protocol": self.parser.protocol or None,
            "baud": self.baud or None,
            "low_latency": None if self.port is None else self.port.low_latency,
            "seconds": round(self.heard - self.began, 3) if self.is_port else None,
            "bytes": self.bytes,
            "stamped": None if self.latest is None else self.latest.device_time is not None,
            **figures,
            "clock": clock,
            "latest": None if self.latest is None else list(self.latest),
            "findings": [finding._asdict() for finding in findings],
        }


def _port(watch: _Watch, args: argparse.Namespace) -> Iterator[float]:
    """Listens to the port, and says the time after whatever came, and in silence now and then.

    A port that is lost is opened again, unless the answer is one object: then the OSError is for the caller.
    """
    seconds = args.seconds if args.seconds is not None else JSON_SECONDS if args.json else math.inf
    opened = False
    while time.monotonic() - watch.began < seconds:
        heard: queue.SimpleQueue[tuple[bytes, float] | OSError] = queue.SimpleQueue()
        try:
            watch.port = SerialImu(args.source, watch.baud, lambda *data, heard=heard: heard.put(data), heard.put)
        except OSError as error:
            if not opened:
                raise
            watch.trouble = f"{error}; trying again"
            time.sleep(PAUSE)
            yield time.monotonic()
            continue
        opened, watch.trouble = True, ""
        with contextlib.closing(watch.port):
            while (left := watch.began + seconds - time.monotonic()) > 0.0:
                try:
                    event = heard.get(timeout=min(VIEW_EVERY, left))
                except queue.Empty:
                    pass
                else:
                    if isinstance(event, OSError):
                        if args.json:
                            raise event
                        watch.trouble = f"{event}; waiting for it to come back"
                        break
                    watch.feed(*event)
                yield time.monotonic()


def _file(watch: _Watch, source: str) -> Iterator[float]:
    with contextlib.ExitStack() as stack:
        fd = 0 if source == "-" else stack.enter_context(open(source, "rb")).fileno()
        while data := os.read(fd, CHUNK):
            watch.feed(data, math.nan)
            yield time.monotonic()
    watch.end()


class _View:
    """The report over and over in the same place of a terminal; of anything else nothing until the end."""

    def __init__(self, wanted: bool) -> None:
        self._wanted = wanted and sys.stdout.isatty()
        self._shown = -math.inf
        self._lines = 0

    def show(self, watch: _Watch, now: float) -> None:
        if self._wanted and now - self._shown >= VIEW_EVERY:
            self._shown = now
            self.clear()
            text = _text(watch.report())
            # Long lines are broken here: how the terminal breaks them, nobody tells.
            columns, rows = os.get_terminal_size(sys.stdout.fileno())
            width = max(20, columns or 80)
            lines = [line[at : at + width] for line in text.splitlines() for at in range(0, max(1, len(line)), width)]
            # What has scrolled out of sight cannot be erased.
            lines = lines[: max(1, (rows or 25) - 1)]
            print("\n".join(lines), flush=True)
            self._lines = len(lines)

    def clear(self) -> None:
        if self._lines:
            # Up, and from there all is erased.
            print(f"\x1b[{self._lines}F\x1b[J", end="")
            self._lines = 0


def _text(report: dict[str, Any]) -> str:
    """The same for people."""
    baud = f", {report['baud']} baud" if report["baud"] else ""
    lines = [f"{report['source']}: {report['protocol'] or 'protocol not recognised yet'}{baud}"]
    rate = "rate unknown" if report["rate_hz"] is None else f"{report['rate_hz']:.1f} Hz"
    lost = f"{report['missing']} missing, {report['dropped']} dropped ({report['dropped_bytes']} bytes)"
    longest = f" of up to {report['longest_gap_ms']:.0f} ms" if report["longest_gap_ms"] else ""
    lines.append(f"  samples  {report['samples']}, {rate}, {lost}")
    lines.append(f"  gaps     {report['gaps']}{longest} in the last {WINDOW:.0f} s")
    if clock := report["clock"]:
        lines.append(
            f"  clock    the device's {clock['offset_s']:+.6f} s is this machine's, skew {clock['skew_ppm']:+.0f} ppm, "
            f"{clock['restarts']} restarts"
        )
    elif report["stamped"] is False:
        lines.append("  clock    the samples bear no time")
    if report["arrival_interval_ms"] is not None:
        jitter = "" if report["delay_jitter_ms"] is None else f", jitter {report['delay_jitter_ms']:.2f} ms"
        lines.append(f"  line     arrivals every {report['arrival_interval_ms']:.1f} ms{jitter}")
    if report["latest"] is not None:
        _, gx, gy, gz, ax, ay, az = report["latest"]
        lines.append(f"  gyro     {math.degrees(gx):+9.3f} {math.degrees(gy):+9.3f} {math.degrees(gz):+9.3f} deg/s")
        lines.append(f"  accel    {ax:+9.3f} {ay:+9.3f} {az:+9.3f} m/s2")
        lines.append(f"  gravity  {report['gravity']:.3f} m/s2 upwards on {report['gravity_direction']}")
    if rest := report["rest"]:
        seconds = "" if math.isnan(rest["seconds"]) else f" for {rest['seconds']:.1f} s"
        bias, scatter = (" ".join(f"{math.degrees(v):.3f}" for v in rest[key]) for key in ("gyro", "gyro_sigma"))
        lines.append(f"  rest     still{seconds}: gyro bias {bias} deg/s, scatter {scatter} deg/s,")
        noise = " ".join(f"{value:.4f}" for value in rest["force_sigma"])
        lines.append(f"           accel scatter {noise} m/s2")
    elif report["samples"]:
        lines.append("  rest     it moves, or too little is known")
    lines += [f"  {finding['severity']}: {finding['text']}" for finding in report["findings"]]
    if not report["findings"]:
        lines.append("  nothing is wrong")
    return "\n".join(lines)
