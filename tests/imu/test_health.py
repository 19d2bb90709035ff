"""What is said of a stream, for every mistake that makers of devices make, and that nothing is said of a good one."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import pytest

from fusion.measurements import Array
from imu.health import KEEP, WINDOW, Finding, StreamHealth
from imu.protocols.bno08x_rvc import Bno08xRvc
from imu.protocols.csv_lines import CsvLines
from imu.protocols.steadfix_frames import SteadfixFrames, encode
from imu.protocols.witmotion import WitMotion
from tests.data import data

G = 9.80665
STEP = 0.01


def still(seconds: float = 4.0, up: Sequence[float] = (0.0, 0.0, G), seed: int = 1) -> Array:
    """(n, 7): a consumer MEMS sensor at rest, its gyroscope off by half a degree a second."""
    noise = np.random.default_rng(seed)
    n = round(seconds / STEP)
    gyro = noise.normal([0.01, -0.005, 0.002], 1.5e-3, (n, 3))
    force = noise.normal(up, 0.03, (n, 3))
    return np.column_stack([100.0 + STEP * np.arange(n), gyro, force])


def tipping(seconds: float = 8.0) -> Array:
    """(n, 7): turned about all axes by hand, gravity moving as the gyroscope says."""
    readings = still(seconds)
    t = readings[:, 0] - readings[0, 0]
    rates = np.column_stack([np.cos(1.3 * t), 0.8 * np.cos(0.9 * t + 1.0), 0.6 * np.sin(0.7 * t)])
    up = np.array([0.0, 0.0, 1.0])
    for i, rate in enumerate(rates):
        readings[i, 4:] += G * up - [0.0, 0.0, G]
        # A direction of the world turns in the body by -rate.
        angle = STEP * float(np.linalg.norm(rate))
        axis = rate / np.linalg.norm(rate)
        up = up * math.cos(angle) - np.cross(axis, up) * math.sin(angle) + axis * (axis @ up) * (1 - math.cos(angle))
    readings[:, 1:4] += rates
    return readings


def health(readings: Array, arrivals: Array | None = None, batch: int = 1, **options: object) -> StreamHealth:
    """All of it fed, by default as a file."""
    health = StreamHealth(**options)  # type: ignore[arg-type]
    for i in range(0, len(readings), batch):
        part = readings[i : i + batch]
        arrival = math.nan if arrivals is None else float(arrivals[min(i + batch, len(readings)) - 1])
        health.feed([tuple(row) for row in part.tolist()], part, arrival)
    return health


def codes(findings: list[Finding]) -> list[str]:
    return [finding.code for finding in findings]


@pytest.mark.parametrize("readings", [still(), tipping()], ids=["still", "tipping"])
def test_nothing_is_said_of_a_good_stream(readings: Array) -> None:
    assert health(readings).findings() == []


def test_nothing_is_said_of_nothing() -> None:
    stream = StreamHealth()
    assert stream.findings() == []
    assert stream.rest() is None
    assert stream.figures()["rate_hz"] is None
    stream.feed([], np.empty((0, 7)))
    assert health(still(0.2)).findings() == []


def in_g(readings: Array) -> None:
    readings[:, 4:] /= G


def in_mg(readings: Array) -> None:
    readings[:, 4:] *= 1000.0 / G


def in_counts(readings: Array) -> None:
    readings[:, 4:] *= 4096.0 / G


def times_g_twice(readings: Array) -> None:
    readings[:, 4:] *= G


def half(readings: Array) -> None:
    readings[:, 4:] *= 0.5


def without_gravity(readings: Array) -> None:
    readings[:, 4:] -= [0.0, 0.0, G]


def in_degrees(readings: Array) -> None:
    readings[:, 1:4] = np.degrees(readings[:, 1:4])


def stuck(readings: Array) -> None:
    readings[-100:, 1:] = readings[-100, 1:]


def frozen_gyro(readings: Array) -> None:
    readings[:, 1:4] = 0.0


def repeated(readings: Array) -> None:
    readings[1::2, 1:] = readings[::2, 1:]


def biased(readings: Array) -> None:
    readings[:, 3] += 0.5


@pytest.mark.parametrize(
    ("wrong", "code", "severity", "says"),
    [
        (in_g, "accel_unit", "error", "gravity reads 1.0: these are g, not m/s2"),
        (in_mg, "accel_unit", "error", "gravity reads 1000: these are thousandths of g, not m/s2"),
        (in_counts, "accel_unit", "error", "gravity reads 4096: these are raw counts of a sensor with +-8 g"),
        (times_g_twice, "accel_unit", "error", "multiplied by 9.81 again"),
        (half, "accel_unit", "error", "gravity reads 4.9: not 9.81 m/s2: the unit or the scale is wrong"),
        (without_gravity, "accel_unit", "error", "it is not in these accelerations; specific force is needed"),
        (in_degrees, "gyro_unit", "error", "these are deg/s, not rad/s"),
        (stuck, "imu_stuck", "error", "the sensor repeats itself: "),
        (frozen_gyro, "imu_stuck", "warning", "the gyroscope repeats itself: 0, 0, 0 for the last 400 samples"),
        (repeated, "imu_repeats", "warning", "50% of the readings are the ones before"),
        (biased, "gyro_at_rest", "warning", "the gyroscope reads 0.50: these are deg/s, not rad/s, or it turns evenly"),
    ],
)
def test_mistakes_that_are_seen_at_rest(wrong: Callable[[Array], None], code: str, severity: str, says: str) -> None:
    readings = still()
    wrong(readings)
    (finding,) = health(readings).findings()
    assert (finding.code, finding.severity) == (code, severity)
    assert says in finding.text


@pytest.mark.parametrize(
    ("up", "says"),
    [
        ((0.0, 0.0, -G), "z reads it downwards; the IMU is upside down, or its z points down"),
        ((-G, 0.0, 0.0), "at rest -x reads it, not +z"),
        ((0.0, G, 0.0), "at rest +y reads it, not +z"),
        ((0.0, G * math.sin(0.4), G * math.cos(0.4)), "at rest z is 23 deg from upright"),
    ],
)
def test_gravity_on_the_wrong_axis(up: tuple[float, float, float], says: str) -> None:
    (finding,) = health(still(up=up)).findings()
    assert finding.code == "imu_mounting"
    assert says in finding.text
    assert health(still(up=up), upright=False).findings() == [], "what is carried may lie as it likes"


def swapped(readings: Array) -> None:
    readings[:, 1:4] = readings[:, [2, 1, 3]]


def one_sign(readings: Array) -> None:
    readings[:, 2] *= -1.0


def all_signs(readings: Array) -> None:
    readings[:, 1:4] *= -1.0


@pytest.mark.parametrize(
    ("wrong", "code", "says"),
    [
        (in_degrees, "gyro_unit", "the gyroscope turns 57 times as far as gravity does: these are deg/s, not rad/s"),
        (swapped, "gyro_axes", "as its x, y, z it should send what it sends as +y, +x, +z"),
        (one_sign, "gyro_axes", "as its x, y, z it should send what it sends as +x, -y, +z"),
        (all_signs, "gyro_sign", "gravity turns the other way than the gyroscope"),
    ],
)
def test_mistakes_that_are_seen_when_it_is_tipped(wrong: Callable[[Array], None], code: str, says: str) -> None:
    readings = tipping()
    wrong(readings)
    (finding,) = health(readings).findings()
    assert (finding.code, finding.severity) == (code, "error")
    assert says in finding.text
    # In whatever unit gravity is.
    in_g(readings)
    assert sorted(codes(health(readings).findings())) == sorted([code, "accel_unit"])


def test_more_than_any_gyroscope_measures() -> None:
    readings = still()
    readings[::5, 3] = 120.0
    assert "more than 2000 deg/s: these are deg/s" in health(readings).findings()[0].text


# Time


def test_the_figures_of_a_good_stream() -> None:
    readings = still(12.0)
    figures = health(readings, readings[:, 0] + 50.0).figures()
    assert figures["samples"] == 1200
    assert figures["rate_hz"] == pytest.approx(100.0)
    assert (figures["gaps"], figures["missing"], figures["dropped"]) == (0, 0, 0)
    assert figures["arrival_interval_ms"] == pytest.approx(10.0)
    assert figures["delay_jitter_ms"] == pytest.approx(0.0, abs=1e-6)
    assert figures["gravity"] == pytest.approx(G, abs=0.01)
    assert figures["gravity_direction"] == "+z"
    rest = figures["rest"]
    assert rest["seconds"] == pytest.approx(WINDOW, abs=0.5)
    assert rest["gyro"] == pytest.approx([0.01, -0.005, 0.002], abs=3e-4)
    assert rest["gyro_sigma"] == pytest.approx([1.5e-3] * 3, rel=0.15)
    assert rest["gyro_noise"] == pytest.approx([1.5e-4] * 3, rel=0.15)
    assert rest["accel_noise"] == pytest.approx([3e-3] * 3, rel=0.15)


def test_it_is_not_at_rest_while_it_moves_and_until_it_is_calm_again() -> None:
    assert health(tipping()).rest() is None
    both = np.concatenate([tipping(), still(2.0)])
    both[:, 0] = 100.0 + STEP * np.arange(len(both))
    rest = health(both).rest()
    assert rest is not None
    assert rest.seconds == pytest.approx(2.0)


def test_gaps_are_told_and_a_single_one_is_not() -> None:
    readings = still()
    assert health(np.delete(readings, slice(200, 210), axis=0)).findings() == []
    holes = np.delete(readings, [i + k for i in range(50, 350, 50) for k in range(3)], axis=0)
    stream = health(holes)
    (finding,) = stream.findings()
    assert finding.code == "imu_missing"
    assert "gaps of up to 40 ms" in finding.text
    assert finding.evidence["share"] == pytest.approx(18 / 400, abs=0.002)
    assert stream.figures()["gaps"] == 6


@pytest.mark.parametrize(
    ("factor", "says"),
    [(1e3, "these are milliseconds"), (1e6, "microseconds"), (1e9, "nanoseconds"), (1.3, "runs 1.3 times as fast")],
)
def test_a_clock_that_counts_something_else_than_seconds(factor: float, says: str) -> None:
    readings = still()
    raw = readings.copy()
    raw[:, 0] *= factor
    stream = StreamHealth()
    for row, true in zip(raw.tolist(), readings, strict=True):
        stream.feed([tuple(row)], true[np.newaxis], true[0] + 1e-3)
    assert [finding.code for finding in stream.findings()] == ["imu_stamp_unit"]
    assert says in stream.findings()[0].text


def test_a_clock_that_stands_still_and_none() -> None:
    readings = still()
    for value, code in ((7.0, "imu_clock"), (None, "imu_unstamped")):
        stream = StreamHealth()
        for row in readings:
            stream.feed([(value, *row[1:].tolist())], row[np.newaxis], row[0] + 1e-3)
        assert codes(stream.findings()) == [code]
    of_file = readings.copy()
    of_file[:, 0] = math.nan
    stream = StreamHealth()
    stream.feed([(None, *row[1:].tolist()) for row in readings], of_file)
    assert stream.findings() == [], "a file without times says nothing of its line"
    assert stream.rest() is not None


def test_batches_of_a_latency_timer() -> None:
    """At 400 Hz, every 16 ms; and the same over a network, where batches are as they should be."""
    readings = still(16.0)
    readings[:, 0] = 100.0 + (readings[:, 0] - 100.0) / 4.0
    arrivals = 100.0 + 0.016 * np.ceil((readings[:, 0] - 100.0) / 0.016 + 1e-9)
    stream = StreamHealth(port="/dev/ttyUSB3")
    for t in np.unique(arrivals):
        part = readings[arrivals == t]
        stream.feed([tuple(row) for row in part.tolist()], part, float(t))
    (finding,) = stream.findings()
    assert (finding.code, finding.severity) == ("imu_batches", "note")
    assert "batches of 16 ms: set the latency timer of the USB adapter to 1" in finding.text
    assert "/sys/bus/usb-serial/devices/ttyUSB3/latency_timer" in finding.text
    stream.port = ""
    assert stream.findings() == []


# What a parser knows


def test_what_was_dropped_and_what_never_came() -> None:
    parser = SteadfixFrames()
    stream = StreamHealth(parser=parser)
    samples = parser.feed(b"".join(encode(i, 10_000 * i, (0, 0, 0), (0, 0, math.nan)) for i in range(50)))
    assert samples == []
    (finding,) = stream.findings()
    assert finding.code == "imu_dropped"
    assert "100% of what it sends cannot be used (NaN or infinite numbers)" in finding.text
    parser = SteadfixFrames()
    stream = StreamHealth(parser=parser)
    samples = parser.feed(b"".join(encode(i, 10_000 * i, (0, 0, 0.1 * (i % 7)), (0, 0, G)) for i in range(0, 100, 2)))
    stream.feed(samples, np.array(samples))
    (missing,) = (finding for finding in stream.findings() if finding.code == "imu_missing")
    assert "49% of the frames that the device numbered never came" in missing.text


@pytest.mark.parametrize(
    ("parser", "sent", "says"),
    [
        (WitMotion(), b"\xf8\x00\x78" * 400, "noise, half frames, or a wrong baud rate"),
        (SteadfixFrames(), encode(0, 0, (0, 0, 0), (0, 0, G))[:20] * 9, "half frames, or a wrong baud rate"),
        (CsvLines(), b"t\n1,0.1,0.2,300,1,2,16384\n", "another unit, or raw counts"),
    ],
)
def test_dropped_bytes_have_likely_causes(parser: SteadfixFrames, sent: bytes, says: str) -> None:
    parser.feed(sent)
    (finding,) = StreamHealth(parser=parser).findings()
    assert says in finding.text


def test_a_protocol_without_rates_is_degraded() -> None:
    (finding,) = StreamHealth(parser=Bno08xRvc()).findings()
    assert (finding.code, finding.severity) == ("imu_degraded", "warning")
    assert "bno08x-rvc: this protocol has no angular rates" in finding.text


# Long streams


def test_only_the_last_seconds_count_however_they_are_cut() -> None:
    bad, good = still(), still(WINDOW + 1.0, seed=2)
    in_g(bad)
    readings = np.concatenate([bad, good])
    readings[:, 0] = 100.0 + STEP * np.arange(len(readings))
    one, all_ = health(readings), health(readings, batch=len(readings))
    assert one.findings() == all_.findings() == []
    assert one.figures() == all_.figures()


def test_the_ring_goes_round() -> None:
    readings = np.tile(still(10.0), (14, 1))
    readings[:, 0] = 100.0 + 1e-3 * np.arange(len(readings))
    assert len(readings) > 3 * KEEP
    stream = health(readings, batch=700)
    assert stream.samples == len(readings)
    assert stream.figures()["rate_hz"] == pytest.approx(1000.0)
    whole = health(readings, batch=len(readings))
    assert whole.samples == len(readings)
    assert whole.figures()["rest"] == stream.figures()["rest"]


@pytest.mark.parametrize("name", ["handheld_mocap/imu.csv", "rest_and_motion_100hz/sensor_data.csv"])
def test_nothing_is_wrong_with_real_recordings_and_their_mistakes_are_found(name: str) -> None:
    """Looked at every 500 samples, as sent and in degrees."""
    folder, _, file = name.partition("/")
    samples = np.array(CsvLines().feed((data(folder) / file).read_bytes()))[:13500]
    for wrong, expected in ((None, set()), (in_degrees, {"gyro_unit"}), (in_g, {"accel_unit"})):
        readings = samples.copy()
        if wrong is not None:
            wrong(readings)
        stream, found = StreamHealth(upright=False), set()
        for i in range(0, len(readings), 500):
            part = readings[i : i + 500]
            stream.feed([tuple(row) for row in part.tolist()], part)
            found |= set(codes(stream.findings()))
        assert found == expected
