"""Where calibration commands get raw IMU readings from: a serial port, a file that was captured, or a recording."""

from __future__ import annotations

import argparse
import queue
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import get_args

import numpy as np
from tqdm import tqdm

from fusion.measurements import Array
from imu.calibration import CalibrationError
from imu.clock import DeviceClock
from imu.protocols.detection import Detector, ProtocolName, open_parser
from imu.uart import SerialImu

# s after which a port is given up: without a word; without a sample in what comes, since that may be at another speed.
SILENCE, PUZZLED = 5.0, 15.0
# bytes of a file that are read at once
CHUNK = 1 << 20


def add_source(parser: argparse.ArgumentParser, *, port: bool = True) -> None:
    """The arguments that say where from. `port`: whether that may be a serial one."""
    kinds = (
        "serial port, file of what one sent, or recording folder" if port else "file of what a port sent, or recording"
    )
    parser.add_argument("source", metavar="SOURCE" if port else "FILE", help=kinds)
    parser.add_argument("--protocol", choices=get_args(ProtocolName), default="auto", help="default: as it looks")
    parser.add_argument("--columns", default="", metavar="C", help="of CSV, such as t[us],gx[deg/s],...,az[g]")
    parser.add_argument("--rate-hz", type=_rate, metavar="HZ", help="of a file whose samples bear no time")
    if port:
        parser.add_argument("--baud", type=int, default=115200, help="of a serial port; default 115200")


def readings(args: argparse.Namespace, notice: str) -> Iterator[Array]:
    """(n, 7) of what `add_source` named, along the IMU's own axes: all of a file at once, of a port as they come.

    `notice` is what the one who holds the device is to do now, said once a port speaks. A port ends with OSError when
    it is lost or silent. Raises CalibrationError for a file that holds nothing usable.
    """
    path = Path(args.source)
    if path.is_file() or path.is_dir() or (path.suffix and not path.exists()):
        yield file_readings(args)
    else:
        yield from _port_readings(args, notice)


def _rate(text: str) -> float:
    rate = float(text)
    if not 0.0 < rate < 1e5:
        raise ValueError
    return rate


def file_readings(args: argparse.Namespace) -> Array:
    """(n, 7) of the file, or of the recording, that `add_source` named. Raises CalibrationError, and OSError."""
    path = Path(args.source)
    if path.is_dir():
        path /= "imu.csv"
    if not path.is_file():
        raise CalibrationError(f"{path}: {'this is no file' if path.exists() else 'no such file'}")
    parser = open_parser(args.protocol, args.columns)
    parts = []
    with (
        path.open("rb") as file,
        tqdm(total=path.stat().st_size, unit="B", unit_scale=True, delay=1.0, leave=False, disable=None) as bar,
    ):
        while data := file.read(CHUNK):
            parts.append(np.array(parser.feed(data), dtype=np.float64).reshape(-1, 7))
            bar.update(len(data))
    if parser.protocol in ("", "json", "csv", "vectornav"):
        # a last line without an end
        parts.append(np.array(parser.feed(b"\n"), dtype=np.float64).reshape(-1, 7))
    if isinstance(parser, Detector):
        parts.append(np.array(parser.settle(), dtype=np.float64).reshape(-1, 7))
    samples = np.concatenate(parts)
    if not len(samples):
        raise CalibrationError(f"{path}: no IMU sample in it: {parser.last_error or 'too little to tell what it is'}")
    if args.rate_hz is not None:
        samples[:, 0] = np.arange(len(samples)) / args.rate_hz
    if np.isnan(samples[:, 0]).any():
        raise CalibrationError(f"{path}: its samples bear no time; say with --rate-hz how many there are a second")
    return samples


def _port_readings(args: argparse.Namespace, notice: str) -> Iterator[Array]:
    parser = open_parser(args.protocol, args.columns, args.baud)
    clock = DeviceClock()
    arrived: queue.SimpleQueue[tuple[bytes, float] | OSError] = queue.SimpleQueue()
    port = SerialImu(args.source, args.baud, lambda data, arrival: arrived.put((data, arrival)), arrived.put)
    heard = time.monotonic()
    try:
        while True:
            try:
                found = arrived.get(timeout=SILENCE)
            except queue.Empty:
                raise OSError(f"{args.source}: nothing came for {SILENCE:.0f} s") from None
            if isinstance(found, OSError):
                raise found
            data, arrival = found
            if samples := parser.feed(data):
                if notice:
                    print(f"steadfix: {notice}", file=sys.stderr, flush=True)
                    notice = ""
                heard = arrival
                yield clock.stamp(samples, arrival)
            elif arrival - heard > PUZZLED:
                reason = parser.last_error or "wrong protocol?"
                raise OSError(f"{args.source}: no IMU sample in {PUZZLED:.0f} s: {reason}")
            if isinstance(parser, Detector) and parser.baud != port.baud:
                port.set_baud(parser.baud)
    finally:
        port.close()
