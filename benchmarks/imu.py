"""What the IMU's way costs: parsers.

    .venv/bin/python -m benchmarks.imu [parsers]

A parser is compared with the fastest wire that can feed it: 921600 baud, 92160 bytes/s, and 115200 baud for the BNO08x,
which has no other.
"""

from __future__ import annotations

import argparse
import functools
import math
import time
from collections.abc import Callable, Sequence
from typing import get_args

from imu.protocols import RawSample
from imu.protocols.detection import ProtocolName, open_parser
from tests.imu.streams import frames, rocking, rvc_frame

WIRE = 921600 / 10  # bytes/s: ten bits a byte
RVC_WIRE = 115200 / 10
# Bytes that a reader gets at once: 1 ms of the fastest wire, and what has gathered while something else ran.
CHUNKS = (92, 4096)


def parsers() -> None:
    """Prints bytes/s of processor time of each parser on its own clean stream, over those of the wire."""
    columns = "".join(f"{f'x wire, {chunk} B':>15}" for chunk in CHUNKS)
    print(f"{'protocol':18} {'bytes/sample':>12} {'us/sample':>10}{columns}")
    samples = rocking(20.0)
    for protocol in get_args(ProtocolName):
        if protocol == "auto":
            continue
        wire = _rvc(samples) if protocol == "bno08x-rvc" else frames(protocol, samples)
        data = b"\n" + b"".join(wire)
        speeds = []
        for chunk in CHUNKS:
            parts = [data[i : i + chunk] for i in range(0, len(data), chunk)]
            speeds.append(len(data) / _best(functools.partial(_parse, protocol, parts, len(samples))))
        limit = RVC_WIRE if protocol == "bno08x-rvc" else WIRE
        size = len(data) / len(samples)
        times = "".join(f"{speed / limit:15.0f}" for speed in speeds)
        print(f"{protocol:18} {size:12.1f} {1e6 * size / speeds[0]:10.2f}{times}")


def _parse(protocol: ProtocolName, parts: Sequence[bytes], expected: int) -> None:
    parser = open_parser(protocol)
    count = sum(len(parser.feed(part)) for part in parts)
    assert count >= expected - 1, f"{protocol}: {count} of {expected} samples were read"


def _rvc(samples: Sequence[RawSample]) -> list[bytes]:
    return [rvc_frame(i, 90.0 * math.sin(0.01 * i), 1.0, 20.0, sample[4:]) for i, sample in enumerate(samples)]


def _best(work: Callable[[], None], runs: int = 5) -> float:
    """s of processor time of the quickest run."""
    times = []
    for _ in range(runs):
        begin = time.process_time()
        work()
        times.append(time.process_time() - begin)
    return min(times)


PARTS = {"parsers": parsers}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", choices=[[], *PARTS], help="all if left out")
    for part in parser.parse_args().parts or PARTS:
        PARTS[part]()


if __name__ == "__main__":
    main()
