"""What the IMU's way costs, and what it is worth: parsers, clocks, lever arms, the WebSocket.

    .venv/bin/python -m benchmarks.imu [parsers] [clocks] [lever-arms] [decoding] [robots]

A parser is compared with the fastest wire that can feed it: 921600 baud, 92160 bytes/s, and 115200 baud for the BNO08x,
which has no other.
"""

from __future__ import annotations

import argparse
import functools
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import get_args

import numpy as np
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from benchmarks import links, wire
from fusion.consistency import track_error
from fusion.geometry import rotation_from_quaternion, skew
from fusion.localiser import Localiser, warm_up
from fusion.measurements import Array, PoseFix
from fusion.params import Motion
from fusion.simulator import ImuParams, Trajectory, aggressive, figure_eight, random_ground, simulate
from imu.clock import DeviceClock
from imu.mounting import BodyReadings, ImuCalibration
from imu.protocols import RawSample
from imu.protocols.detection import ProtocolName, open_parser
from server.recording import Recording
from server.replay import replay
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


def clocks() -> None:
    """Prints the errors of stamps on simulated links, 10 minutes each, beside what one would otherwise do.

    Bias and jitter (standard deviation) are of all stamps after the first minute; `worst` is of those too. `us` is
    processor time a sample. The least that a link delays is 2 ms, which only an exchange can tell from the clock.
    """
    print(f"{'link':12}{'stamps':42}{'bias ms':>9}{'jitter ms':>11}{'worst ms':>10}{'us':>8}")
    for name, link in links.LINKS.items():
        sent = links.traffic(link, seed=1)
        asked = links.questions(2, sent)
        for way, stamps in (
            ("Steadfix", functools.partial(_stamped, sent, [])),
            ("Steadfix, with exchanges", functools.partial(_stamped, sent, asked)),
            ("arrival times", lambda sent=sent: sent.arrival),
            ("a Kalman filter of offset and skew", functools.partial(_kalman_clock, sent)),
            ("convex hull of all, in hindsight", functools.partial(_hull_clock, sent)),
            ("the best of 8 round trips, as NTP", functools.partial(_best_round_trip, sent, asked)),
        ):
            begin = time.process_time()
            error = 1e3 * (stamps() - sent.t)[sent.t > 60.0]
            took = 1e6 * (time.process_time() - begin) / len(sent.t)
            worst = np.abs(error).max()
            print(f"{name:12}{way:42}{error.mean():9.3f}{error.std():11.4f}{worst:10.2f}{took:8.2f}")
    print("after a reboot, s until all stamps are within 1.5 ms of the minimum delay again, the longest of ten:")
    for name, link in links.LINKS.items():
        print(f"{name:12}{max(_recovery(link, seed) for seed in range(10)):.2f}")


def _stamped(sent: links.Traffic, exchanges: list[tuple[float, float, float, float]]) -> Array:
    clock = DeviceClock()
    exchanges = exchanges[::-1]
    stamps = []
    for packet in sent.packets():
        arrival = float(sent.arrival[packet.start])
        while exchanges and exchanges[-1][3] < arrival:
            clock.exchange(*exchanges.pop())
        readings = [(t, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0) for t in sent.device[packet].tolist()]
        stamps.append(clock.stamp(readings, arrival)[:, 0])
    return np.concatenate(stamps)


def _kalman_clock(sent: links.Traffic) -> Array:
    """Offset and skew as a random walk, each arrival a measurement: the delay's mean stays in."""
    dt = 1.0 / links.RATE
    walk, scatter = links.WANDER**2 * dt, 0.01**2
    offset, skew = float(sent.arrival[0] - sent.device[0]), 0.0
    p00, p01, p11 = scatter, 0.0, 1e-8
    stamps = np.empty(len(sent.t))
    for i, (device, arrival) in enumerate(zip(sent.device.tolist(), sent.arrival.tolist(), strict=True)):
        offset += skew * dt
        p00, p01, p11 = p00 + dt * (2.0 * p01 + dt * p11), p01 + dt * p11, p11 + walk
        k0, k1 = p00 / (p00 + scatter), p01 / (p00 + scatter)
        y = arrival - device - offset
        offset, skew = offset + k0 * y, skew + k1 * y
        p00, p01, p11 = (1.0 - k0) * p00, (1.0 - k0) * p01, p11 - k1 * p01
        stamps[i] = device + offset
    return stamps


def _hull_clock(sent: links.Traffic) -> Array:
    """One line for all, under all arrivals and nearest to them: the lower hull's edge under the middle."""
    x, y = sent.device - sent.device[0], sent.arrival - sent.device
    corners = np.sort(ConvexHull(np.column_stack([x, y])).vertices)
    middle = 0.5 * x[-1]
    left, right = corners[x[corners] <= middle], corners[x[corners] > middle]
    rise = (y[right] - y[left][:, np.newaxis]) / (x[right] - x[left][:, np.newaxis])
    height = y[left][:, np.newaxis] + rise * (middle - x[left][:, np.newaxis])
    i, j = np.unravel_index(np.argmin(height), height.shape)
    return sent.device + height[i, j] + rise[i, j] * (x - middle)


def _best_round_trip(sent: links.Traffic, exchanges: list[tuple[float, float, float, float]]) -> Array:
    """The offset of the quickest of the last 8 exchanges, as NTP's clock filter takes it (RFC 5905, section 10)."""
    offsets, at = [], []
    for i, (_, _, _, arrival) in enumerate(exchanges):
        a, received, answered, b = min(exchanges[max(0, i - 7) : i + 1], key=lambda e: e[3] - e[0] - (e[2] - e[1]))
        offsets.append(0.5 * (a + b - received - answered))
        at.append(arrival)
    newest = np.maximum(np.searchsorted(at, sent.arrival) - 1, 0)
    return sent.device + np.array(offsets)[newest]


def _recovery(link: links.Link, seed: int) -> float:
    """s from the first sample after a reboot that takes 3 s, in a minute's traffic, to the last wrong stamp."""
    before = links.traffic(link, seed, seconds=30.0)
    after = links.traffic(link, seed + 100, seconds=30.0, start=float(before.t[-1]) + 3.0, device_start=0.0)
    sent = links.Traffic(*(np.concatenate(pair) for pair in zip(before, after, strict=True)))
    error = (_stamped(sent, []) - sent.t)[len(before.t) :]
    wrong = np.flatnonzero(np.abs(error - links.MINIMUM_DELAY) > 1.5e-3)
    return float(after.t[wrong[-1]] - after.t[0]) if len(wrong) else 0.0


def lever_arms() -> None:
    """Prints what a lever arm costs: RMSE in mm, medians of eight simulated drives of two minutes.

    `taken out`: of the specific force, by differences of the rate, as the service does. `carried`: the filter keeps the
    place of the IMU instead, and fixes and poses are moved to it and back.
    """
    drives: list[tuple[str, Motion, Callable[[int], Trajectory]]] = [
        ("eight, differential", "differential", lambda seed: figure_eight()),
        ("random, ground", "ground", random_ground),
        ("by hand, free", "free", aggressive),
    ]
    warm_up()
    print(f"{'drive':22}{'lever arm m':20}{'in the middle':>14}{'taken out':>11}{'carried':>9}{'ignored':>9}")
    for name, motion, trajectory in drives:
        for lever in ((0.1, 0.05, 0.05), (0.3, 0.0, 0.1)):
            errors = [_with_lever_arm(trajectory(seed), seed, motion, lever) for seed in range(8)]
            middle, taken_out, carried, ignored = np.median(errors, axis=0)
            print(f"{name:22}{lever!s:20}{middle:14.1f}{taken_out:11.1f}{carried:9.1f}{ignored:9.1f}")


def _with_lever_arm(
    trajectory: Trajectory, seed: int, motion: Motion, lever: tuple[float, float, float]
) -> tuple[float, float, float, float]:
    def error_mm(samples: Array, fixes: list[PoseFix], moved: Array) -> float:
        recording = Recording("robot", samples, there.arrival, fixes, None)
        track, _, _ = replay(recording, Localiser("robot", motion=motion))
        track = track[track[:, 0] > 10.0]
        track[:, 1:4] -= Rotation.from_quat(track[:, 4:], scalar_first=True).apply(moved)
        return 1e3 * track_error(track, there.truth).position_rmse

    middle = simulate(trajectory, seed)
    there = simulate(trajectory, seed, imu=ImuParams(lever_arm=lever))
    nowhere, arm = np.zeros(3), np.array(lever)
    return (
        error_mm(middle.samples, middle.fixes, nowhere),
        error_mm(BodyReadings(ImuCalibration(position_m=lever))(there.samples), there.fixes, nowhere),
        error_mm(there.samples, [_moved(fix, arm) for fix in there.fixes], arm),
        error_mm(there.samples, there.fixes, nowhere),
    )


def _moved(fix: PoseFix, arm: Array) -> PoseFix:
    """The pose of the IMU: its position errs with the attitude too, by δp = -[R l]x δθ."""
    hypotheses = []
    for pose in fix.hypotheses:
        lever = rotation_from_quaternion(pose.quaternion_wxyz) @ arm
        J = np.eye(6)
        J[:3, 3:] = -skew(lever)
        position, covariance = pose.position + lever, J @ pose.covariance @ J.T
        hypotheses.append(replace(pose, position=position, covariance=covariance))
    return replace(fix, hypotheses=tuple(hypotheses))


def _best(work: Callable[[], None], runs: int = 5) -> float:
    """s of processor time of the quickest run."""
    times = []
    for _ in range(runs):
        begin = time.process_time()
        work()
        times.append(time.process_time() - begin)
    return min(times)


PARTS = {
    "parsers": parsers,
    "clocks": clocks,
    "lever-arms": lever_arms,
    "decoding": wire.decoding,
    "robots": wire.robots,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", choices=[[], *PARTS], help="all if left out")
    for part in parser.parse_args().parts or PARTS:
        PARTS[part]()


if __name__ == "__main__":
    main()
