"""Every protocol against bytes written from its description, and against real captures."""

from __future__ import annotations

import csv
import itertools
import math
import shutil
import struct
import subprocess
import sys
from itertools import pairwise
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from imu.protocols import RawSample
from imu.protocols.bno08x_rvc import Bno08xRvc
from imu.protocols.csv_lines import ColumnsError, CsvLines, parse_columns
from imu.protocols.detection import Detector, ProtocolName, describe, open_parser
from imu.protocols.frames import START_ROOM
from imu.protocols.mavlink import Mavlink, MavlinkMissingError
from imu.protocols.steadfix_frames import SteadfixFrames, encode
from imu.protocols.vectornav_ascii import VectorNavAscii
from imu.protocols.vectornav_binary import VectorNavBinary
from imu.protocols.witmotion import WitMotion
from tests.data import data
from tests.imu.streams import (
    G,
    frames,
    highres_imu,
    rocking,
    rvc_frame,
    steadfix_frame,
    vectornav_message,
    witmotion_packet,
)

PROTOCOLS = [name for name in get_args(ProtocolName) if name != "auto"]
# What a step of each protocol's numbers is, rate and force; the others lose at most single precision.
STEPS = {
    "witmotion": (math.radians(2000.0) / 32768, 16 * G / 32768),
    "vectornav": (1e-6, 1e-6),
    "bno08x-rvc": (math.radians(1.5), 1e-3 * G),
}
SAMPLES = rocking(0.2)
every = pytest.mark.parametrize("protocol", PROTOCOLS)


def wire(protocol: str, samples: list[RawSample] = SAMPLES) -> list[bytes]:
    if protocol != "bno08x-rvc":
        return frames(protocol, samples)
    angles = [math.degrees(math.atan2(sample.ay, sample.az)) for sample in samples]
    return [
        rvc_frame(round(100 * (s.device_time or 0)), 0.0, angle, 0.0, s[4:])
        for s, angle in zip(samples, angles, strict=True)
    ]


@every
def test_what_is_sent_is_what_is_read(protocol: ProtocolName) -> None:
    parser = open_parser(protocol)
    # A line of CSV is only known to be whole when one has ended before it.
    samples = parser.feed(b"\n" * (protocol == "csv") + b"".join(wire(protocol)))
    assert parser.protocol == protocol
    assert (parser.dropped, parser.dropped_bytes, parser.missing) == (0, 0, 0)
    sent = SAMPLES[1:] if protocol == "bno08x-rvc" else SAMPLES
    assert len(samples) == len(sent)
    rate, force = STEPS.get(protocol, (1e-6, 1e-6))
    for read, true, before in zip(samples, sent, SAMPLES, strict=False):
        # Derived rates are the mean since the frame before.
        rates = true[1:4] if protocol != "bno08x-rvc" else np.mean([true[1:4], before[1:4]], axis=0)
        np.testing.assert_allclose(read[1:4], rates, atol=rate)
        np.testing.assert_allclose(read[4:], true[4:], atol=force)
    if protocol in ("witmotion", "vectornav"):
        assert all(sample.device_time is None for sample in samples)
    else:
        steps = np.diff([sample.device_time for sample in samples])
        np.testing.assert_allclose(steps, 0.01, atol=1e-6)


@every
@given(cuts=st.lists(st.integers(0, 2000), max_size=30), noise=st.binary(max_size=40))
@settings(max_examples=30, deadline=None)
def test_the_same_however_the_bytes_are_split(protocol: ProtocolName, cuts: list[int], noise: bytes) -> None:
    sent = wire(protocol)
    stream = b"\n" + b"".join(sent[:7]) + noise + b"".join(sent[7:])
    whole = open_parser(protocol)
    expected = whole.feed(stream)
    parser = open_parser(protocol)
    edges = [0, *sorted(min(cut, len(stream)) for cut in cuts), len(stream)]
    assert [sample for a, b in pairwise(edges) for sample in parser.feed(stream[a:b])] == expected
    assert (parser.reasons, parser.dropped_bytes, parser.missing) == (
        whole.reasons,
        whole.dropped_bytes,
        whole.missing,
    )


@every
@given(
    noise=st.lists(st.binary(max_size=60), min_size=3, max_size=3),
    halves=st.lists(st.tuples(st.integers(0, 15), st.integers(1, 40)), min_size=3, max_size=3),
    split=st.integers(1, 200),
)
@settings(max_examples=30, deadline=None)
def test_garbage_costs_at_most_the_frames_it_touches(
    protocol: ProtocolName, noise: list[bytes], halves: list[tuple[int, int]], split: int
) -> None:
    """Four samples, noise and half a frame, four samples, ...: of each four only the first may be lost (derived
    rates: two)."""
    sent = wire(protocol)
    # Long enough a tail for whatever length the noise claims to have, of samples that are none of those sent.
    tail = wire(protocol, [sample._replace(ax=1.0) for sample in rocking(3.0, begin=100.0)])
    # Half a frame claims to be a whole one.
    rubbish = [random + sent[i][:-1][:size] for random, (i, size) in zip(noise, halves, strict=True)]
    stream = b"\n" + b"".join(b"".join(sent[4 * i : 4 * i + 4]) + rubbish[i] for i in range(3))
    stream += b"".join(sent[12:16]) + b"".join(tail)
    parser = open_parser(protocol)
    samples = [sample for i in range(0, len(stream), split) for sample in parser.feed(stream[i : i + split])]
    first = 2 if protocol == "bno08x-rvc" else 1
    times = {round(s.device_time, 3) for s in samples if s.device_time is not None}
    forces = {s[4:] for s in samples}
    clean = open_parser(protocol).feed(b"\n" + b"".join(sent))
    untouched = [clean[i - (protocol == "bno08x-rvc")] for at in (4, 8, 12) for i in range(at + first, at + 4)]
    assert {s[4:] for s in untouched} <= forces
    if protocol not in ("witmotion", "vectornav", "bno08x-rvc"):
        assert {round(s.device_time or 0, 3) for s in untouched} <= times


@every
@given(noise=st.binary(max_size=3000))
@settings(max_examples=20, deadline=None)
def test_noise_alone_gives_nothing_and_memory_is_bounded(protocol: ProtocolName, noise: bytes) -> None:
    parser = open_parser(protocol)
    assert parser.feed(noise) == []
    assert len(parser._partial) <= 5000  # type: ignore[attr-defined]
    # The first frame after it may still be hidden by what it claims to be, none later is.
    assert len(parser.feed(b"\n" + b"".join(wire(protocol, rocking(8.0))))) >= 700


@pytest.mark.parametrize("protocol", ["witmotion", "bno08x-rvc", "vectornav-binary", "mavlink"])
def test_noise_is_counted_once_a_run(protocol: ProtocolName) -> None:
    sent = b"".join(wire(protocol))
    parser = open_parser(protocol)
    parser.feed(b"\x01" * START_ROOM + sent)
    assert (parser.dropped, parser.dropped_bytes) == (0, START_ROOM), "one begins in the middle of something"
    for _ in range(10):
        parser.feed(b"\x01\x02")
    parser.feed(sent)
    assert parser.reasons["no frame"] == 1
    assert parser.dropped_bytes == START_ROOM + 20
    parser = open_parser(protocol)
    parser.feed(b"\x01" * (START_ROOM + 1))
    assert parser.reasons == {"no frame": 1}, "another protocol altogether is said"


# Steadfix frames


def test_the_c_encoder_and_the_python_encoder_write_the_same(tmp_path: Path) -> None:
    """Compiled with all warnings as errors, and run on samples with zeros, wraps and extreme numbers in them."""
    compiler = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
    if compiler is None:
        pytest.skip("no C compiler (cc, gcc or clang) on the path")
    header = Path(__file__).parents[2] / "imu" / "protocols"
    numbers = [0.0, -0.0, 1.0, -34.9, 9.80665, 1e-30, 156.9, 0.1]
    samples = [
        (i * 37 % 256, i * 0x01010101 * 3 % 2**32, itertools.islice(itertools.cycle(numbers), i, i + 6))
        for i in range(200)
    ]
    lines, expected = [], b""
    for sequence, time_us, six in samples:
        v = tuple(six)
        lines.append(f"{sequence} {time_us} " + " ".join(map(repr, v)))
        expected += encode(sequence, time_us, v[:3], v[3:])  # type: ignore[arg-type]
    source = tmp_path / "device.c"
    source.write_text(
        '#include <stdio.h>\n#include "steadfix_imu.h"\n'
        "int main(void) {\n"
        "    unsigned sequence; unsigned long time_us; float g[3], a[3]; uint8_t frame[STEADFIX_FRAME_MAX];\n"
        '    while (scanf("%u %lu %f %f %f %f %f %f", &sequence, &time_us, g, g + 1, g + 2, a, a + 1, a + 2) == 8)\n'
        "        fwrite(frame, 1, steadfix_encode(frame, (uint8_t)sequence, (uint32_t)time_us, g, a), stdout);\n"
        "    return 0;\n}\n"
    )
    program = tmp_path / "device"
    flags = ["-std=c99", "-pedantic", "-Wall", "-Wextra", "-Wconversion", "-Werror", f"-I{header}"]
    subprocess.run([compiler, *flags, str(source), "-o", str(program)], check=True, capture_output=True, timeout=60)
    sent = subprocess.run(
        [str(program)], input="\n".join(lines).encode(), check=True, capture_output=True, timeout=60
    ).stdout
    assert sent == expected
    parser = SteadfixFrames()
    assert len(parser.feed(sent)) == 200
    assert parser.dropped == 0


def test_the_example_of_the_specification() -> None:
    page = (Path(__file__).parents[2] / "imu" / "protocols" / "steadfix_frames.md").read_text(encoding="utf-8")
    frame = bytes.fromhex(page.split("```")[1])
    assert SteadfixFrames().feed(frame) == [(1.0, 0.0, 0.0, 0.5, 0.0, 0.0, np.float32(G))]


def test_missing_frames_are_counted_and_the_microseconds_wrap() -> None:
    parser = SteadfixFrames()
    times = [2**32 - 20_000, 2**32 - 10_000, 0, 10_000]
    sent = [encode(254 + i, t, (0, 0, 0), (0, 0, G)) for i, t in enumerate(times)]
    samples = parser.feed(sent[0] + sent[1] + sent[2] + sent[3] + encode(5, 60_000, (0, 0, 0), (0, 0, G)))
    assert np.diff([s.device_time for s in samples]) == pytest.approx([0.01, 0.01, 0.01, 0.05])
    assert parser.missing == 3
    (restarted,) = parser.feed(encode(0, 100, (0, 0, 0), (0, 0, G)))
    assert restarted.device_time == pytest.approx(4294.9673 + 1e-4, abs=1e-3)


@pytest.mark.parametrize(
    ("frame", "reason"),
    [
        (bytearray(encode(1, 2, (0, 0, 0), (0, 0, G))), "wrong checksum"),
        (b"\0\x02\x01\0", "wrong checksum"),
        (b"\0\xff\x01\0", "wrong checksum"),
        (encode(1, 2, (0, 0, math.nan), (0, 0, G)), "not finite"),
        (encode(1, 2, (0, 0, 1e9), (0, 0, G)), "out of range"),
    ],
)
def test_frames_that_are_dropped(frame: bytes, reason: str) -> None:
    if isinstance(frame, bytearray):
        frame[20] ^= 0x10
    parser = SteadfixFrames()
    good = encode(0, 0, (0, 0, 0), (0, 0, G))
    assert len(parser.feed(good + bytes(frame) + good)) == 2
    assert parser.reasons == {reason: 1}


# WitMotion


def test_witmotion_time_and_pairs() -> None:
    """Sum and scale of the datasheet; a rate counts only right behind its acceleration."""
    clock = struct.pack("<6BH", 24, 1, 1, 0, 0, 1, 500)
    accel = witmotion_packet(0x51, struct.pack("<4h", 2048, -2048, 16384, 0))
    rate = witmotion_packet(0x52, struct.pack("<4h", 16384, 0, -32768, 0))
    parser = WitMotion()
    (sample,) = parser.feed(witmotion_packet(0x50, clock) + accel + rate)
    assert sample.device_time == 1704067201.5
    assert sample[1:4] == pytest.approx([math.radians(1000), 0, -math.radians(2000)])
    assert sample[4:] == pytest.approx([G, -G, 8 * G])
    assert parser.feed(rate + accel + witmotion_packet(0x53, bytes(8)) + rate) == []
    assert parser.reasons == {"incomplete": 2}


# BNO08x


def test_the_captured_rvc_frame() -> None:
    """The datasheet's example: yaw 0.01, pitch -1.10, roll 20.85 deg, accelerations -371, -20, 977 mg, sum 0xE7."""
    captured = (data("serial_captures") / "bno08x_rvc_sample.bin").read_bytes()
    parser = Bno08xRvc()
    assert parser.feed(captured) == [], "one frame alone has no rate"
    report = parser.report
    assert report is not None
    assert report.counter == 0xDE
    assert np.degrees([report.yaw, report.pitch, report.roll]) == pytest.approx([0.01, -1.10, 20.85])
    assert np.array(report[4:]) * 1000 / G == pytest.approx([-371, -20, 977])
    # Gravity is where the angles say, in this reading of them: to the step of an acceleration, 1 mg.
    up = Rotation.from_euler("ZXY", [-report.yaw, report.pitch, report.roll]).inv().apply([0, 0, 1])
    np.testing.assert_allclose(up, np.array(report[4:]) / np.linalg.norm(report[4:]), atol=1.5e-3)
    begin = captured.index(b"\xaa\xaa")
    broken = bytearray(captured[begin : begin + 19])
    broken[5] ^= 1
    parser = Bno08xRvc()
    parser.feed(bytes(broken))
    assert parser.report is None


@given(
    angles=st.tuples(st.floats(-179, 179), st.floats(-60, 60), st.floats(-60, 60)),
    turn=st.tuples(*[st.floats(-1, 1)] * 3),
)
def test_rvc_rates_are_those_of_the_angles(angles: tuple[float, ...], turn: tuple[float, ...]) -> None:
    a = np.round(angles, 2)
    b = np.round(a + turn, 2)
    parser = Bno08xRvc()
    (sample,) = parser.feed(rvc_frame(255, *a, (0, 0, G)) + rvc_frame(0, *b, (0, 0, G)))
    before, after = (Rotation.from_euler("ZXY", [-q[0], q[1], q[2]], degrees=True) for q in (a, b))
    np.testing.assert_allclose(sample[1:4], (before.inv() * after).as_rotvec() / 0.01, atol=1e-6)
    assert sample.device_time == pytest.approx(2.56)


def test_rvc_yaw_wraps_gaps_and_repeats() -> None:
    parser = Bno08xRvc()
    (turned,) = parser.feed(rvc_frame(1, 179.9, 0, 0, (0, 0, G)) + rvc_frame(2, -179.9, 0, 0, (0, 0, G)))
    # Yaw is clockwise.
    assert turned[1:4] == pytest.approx([0, 0, -math.radians(0.2) / 0.01])
    assert parser.feed(rvc_frame(2, -179.9, 0, 0, (0, 0, G))) == []
    assert parser.reasons == {"repeated": 1}
    assert len(parser.feed(rvc_frame(5, -179.9, 0, 0, (0, 0, G)))) == 1
    assert parser.missing == 2
    assert parser.feed(rvc_frame(50, 90, 0, 0, (0, 0, G))) == [], "too long ago for a rate"
    assert "no angular rates" in parser.note


# VectorNav

ASCII = b"$VNIMU,-01.0000,+02.0000,+03.0000,+00.5000,-00.2500,-09.8000,+00.1000,+00.2000,-00.3000,+25.0,+101.3*"


def checked(body: bytes) -> bytes:
    total = 0
    for byte in body:
        total ^= byte
    return b"$%s*%02X\r\n" % (body, total)


def test_vectornav_ascii_messages() -> None:
    expected = RawSample(None, 0.1, -0.2, 0.3, 0.5, 0.25, 9.8)
    numbers = ASCII[7:-1].split(b",")
    readings = b",".join(numbers[3:9])
    parser = VectorNavAscii()
    for body in (
        ASCII[1:-1],
        b"VNRRG,54," + ASCII[7:-1],
        b"VNQMR,0,0,0,1,1,1,1," + readings,
        b"VNMAR,1,1,1," + readings,
        b"VNYMR,1,2,3,1,1,1," + readings,
        b"VNRRG,27,1,2,3,1,1,1," + readings,
    ):
        assert parser.feed(checked(body)) == [expected], body
        assert parser.feed(b"\xfenoise" + checked(body)) == [expected]
    assert parser.feed(checked(b"VNYPR,1,2,3") + checked(b"VNRRG,05,115200")) == []
    assert parser.dropped == 0
    # The manual's own answer to a request of register 15, but for its blanks.
    (sample,) = parser.feed(
        b"$VNRRG,15,-0.017057,-0.000767,+0.056534,+0.998255,+1.0670,-0.2568,+3.0696,"
        b"-00.019,+00.320,-09.802,-0.002801,-0.001186,-0.001582*65\r\n"
    )
    assert sample == (None, -0.002801, 0.001186, 0.001582, -0.019, -0.320, 9.802)


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        (ASCII + b"00\r\n", "wrong checksum"),
        (ASCII + b"XX\r\n", "wrong checksum"),
        (b"VNIMU,1,2,3\r\n", "no message"),
        (checked(b"VNIMU,1,2,3"), "not a number"),
        (checked(b"VNIMU,1,2,3,4,5,x,7,8,9,10,11"), "not a number"),
        (checked(b"VNRRG,x"), "not a number"),
        (checked(b"VNIMU,1,2,3,4,5,nan,7,8,9,10,11"), "not finite"),
    ],
)
def test_vectornav_lines_that_are_dropped(line: bytes, reason: str) -> None:
    parser = VectorNavAscii()
    assert parser.feed(line) == []
    assert parser.reasons == {reason: 1}


def test_vectornav_binary_messages() -> None:
    """The manual's example of a message is understood, and has no readings; which fields count where there are many."""
    parser = VectorNavBinary()
    assert parser.feed(bytes.fromhex("FA 01 08 00 93 50 2E 42 83 3E F1 3F 48 B5 04 BB 92 88")) == []
    assert parser.reasons == {"no readings": 1}

    from binascii import crc_hqx

    def message(groups: int, fields: tuple[int, ...], payload: bytes) -> bytes:
        body = struct.pack(f"<B{len(fields)}H", groups, *fields) + payload
        return b"\xfa" + body + struct.pack(">H", crc_hqx(body, 0))

    # Common: TimeStartup, AngularRate, Accel, Imu (acceleration first).
    numbers = struct.pack("<Q3f3f6f", 1_500_000_000, 9, 9, 9, 8, 8, 8, 0.5, -0.25, -9.75, 0.125, 0.25, -0.5)
    (sample,) = parser.feed(message(1, (0b11_0010_0001,), numbers))
    assert sample == (1.5, 0.125, -0.25, 0.5, 0.5, 0.25, 9.75)
    # Time and IMU: TimeGps does not count; Accel, AngularRate.
    numbers = struct.pack("<Q3f3f", 10**18, 0.5, -0.25, -9.75, 0.125, 0.25, -0.5)
    (sample,) = parser.feed(message(0b110, (0b10, 0b110_0000_0000), numbers))
    assert sample == (None, 0.125, -0.25, 0.5, 0.5, 0.25, 9.75)


def test_vectornav_binary_of_a_real_table() -> None:
    """A static VN-310, the messages built of its recorded values: at rest, z up, as Steadfix wants it."""
    with open(data("serial_captures") / "vectornav_static.csv", newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    names = [f"IMU::UncompGyro::{axis} [rad/s]" for axis in "XYZ"] + [f"IMU::UncompAccel::{a} [m/s^2]" for a in "XYZ"]
    sent = b""
    for row in rows:
        gx, gy, gz, ax, ay, az = (float(row[name]) for name in names)
        sent += vectornav_message(0, RawSample(1e-9 * float(row["Time::TimeStartup [ns]"]), gx, -gy, -gz, ax, -ay, -az))
    parser = VectorNavBinary()
    samples = parser.feed(sent)
    assert len(samples) == len(rows) == 690
    assert parser.dropped == 0
    assert np.median(np.diff([s.device_time for s in samples])) == pytest.approx(0.05, abs=1e-4)
    mean = np.mean([s[1:] for s in samples], axis=0)
    assert np.abs(mean[:3]).max() < 0.01
    assert mean[5] == pytest.approx(9.77, abs=0.05)


# MAVLink


def test_mavlink_messages_and_versions() -> None:
    sample = RawSample(10.0, 0.5, -0.25, 0.125, 1.0, 2.0, 9.5)
    assert Mavlink().feed(highres_imu(0, sample, version=1)) == [sample]
    from pymavlink.dialects.v20 import common

    link = common.MAVLink(None, srcSystem=1, srcComponent=1)
    parser = Mavlink()

    def send(message: object) -> list[RawSample]:
        packed = message.pack(link)  # type: ignore[attr-defined]
        link.seq = (link.seq + 1) & 0xFF
        return parser.feed(bytes(packed))

    raw = common.MAVLink_raw_imu_message(10_000_000, 100, -200, -1000, 500, 250, -125, 0, 0, 0)
    (read,) = send(raw)
    assert read == pytest.approx((10.0, 0.5, -0.25, 0.125, 0.1 * G, 0.2 * G, G))
    assert send(common.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3)) == []
    scaled = common.MAVLink_scaled_imu_message(10_005, 100, -200, -1000, 500, 250, -125, 0, 0, 0)
    (read,) = send(scaled)
    assert read.device_time == 10.005
    assert send(raw) == [], "the finer message counts"
    highres = common.MAVLink_highres_imu_message(10_010_000, 1, -2, -9.5, 0.5, 0.25, -0.125, *[0] * 7, 0x3F)
    assert send(highres) == [(10.01, *sample[1:])]
    assert send(scaled) == []
    assert parser.dropped == 0
    link.seq += 3
    assert len(send(highres)) == 1
    assert parser.missing == 3
    highres.fields_updated = 0x07
    assert send(highres) == []
    assert parser.reasons == {"not updated": 1}
    other = common.MAVLink(None, srcSystem=2, srcComponent=1)
    highres.fields_updated = 0x3F
    assert parser.feed(bytes(highres.pack(other))) == [], "another autopilot on the same line"


# CSV columns


def test_columns_and_units_of_a_header_and_of_the_configuration() -> None:
    expected = (2.5, *np.radians([1.0, 2.0, 3.0]), 0.5 * G, 0.0, G)
    line = b"2500,0.5,0,1,1,2,3,99\n"
    for parser, header in (
        (CsvLines("t[ms],ax[g],ay[g],az[g],gx[deg/s],gy[dps],gz[deg/s],-"), b""),
        (CsvLines(), b"t_ms,ax_g,ay_g,az_g,gx_dps,gy_dps,gz_dps,temperature\n"),
        (CsvLines(), b'"Time (ms)",Acc X (g),Acc Y (g),Acc Z (g),Gyro X (deg/s),Gyro Y (deg/s),Gyro Z [dps],T (C)\r\n'),
    ):
        (sample,) = parser.feed((header or b"\n") + line)
        assert sample == pytest.approx(expected)
        assert parser.dropped == 0
    (counts,) = CsvLines("ax[0.5],ay[0.5],az[0.5],gx[0.25],gy[0.25],gz[0.25]").feed(b"\n2,4,6,4,8,12\n")
    assert counts == (None, 1.0, 2.0, 3.0, 1.0, 2.0, 3.0)


def test_a_header_that_was_cut_off_is_not_believed() -> None:
    """What is left of `t,gx,...` still names seven columns, but no time."""
    parser = CsvLines()
    assert parser.feed(b",gx,gy,gz,ax,ay,az\n1,0,0,0,0,0,9.8\n") == [(1.0, 0, 0, 0, 0, 0, 9.8)]
    assert parser.feed(b"t,ax,ay,az,gx,gy,gz\n1,0,0,9.8,0,0,0\n") == [(1.0, 0, 0, 0, 0, 0, 9.8)]
    assert parser.feed(b"t,x,y\n1,0,0,9.8,0,0,0\n") == [(1.0, 0, 0, 0, 0, 0, 9.8)]
    assert parser.reasons == {"unknown header": 1}


@pytest.mark.parametrize(
    ("columns", "says"),
    [
        ("t,gx,gy,gz,ax,ay", "no column for az"),
        ("t,gx,gy,gz,ax,ay,az[furlong]", 'column 7, "az[furlong]": unknown unit; known: m/s2'),
        ("t,gx,gy,gz,ax,ay,az[0]", "unknown unit"),
        ("t,gx,gy,gz,ax,ay,az,foo", 'column 8, "foo": unknown; known: t, gx'),
        ("t,gx,gx,gz,ax,ay,az", "gx is there twice"),
        ("id=x,t,gx,gy,gz,ax,ay,az", "a number is needed after ="),
    ],
)
def test_columns_that_are_wrong(columns: str, says: str) -> None:
    with pytest.raises(ColumnsError) as caught:
        CsvLines(columns)
    assert says in str(caught.value)


def test_five_sensors_on_one_line() -> None:
    """Each sensor's readings by itself, between GPS sentences and pulses; the last line is whole."""
    path = data("serial_captures") / "five_imus_interleaved_first_half.txt"
    rows = [line.split(",") for line in path.read_text().splitlines() if line.count(",") == 11]
    total = 0
    for sensor in range(1, 6):
        parser = CsvLines(f"id={sensor},t[s],t[us],-,ax[1e-3],ay[1e-3],az[1e-3],gx[1e-3],gy[1e-3],gz[1e-3],-,-")
        captured = path.read_bytes()
        samples = [s for i in range(0, len(captured), 97) for s in parser.feed(captured[i : i + 97])]
        own = np.array([row[1:10] for row in rows if row[0] == str(sensor)], float)
        read = np.array(samples)
        np.testing.assert_allclose(read[:, 0], own[:, 0] + 1e-6 * own[:, 1], atol=1e-6)
        np.testing.assert_allclose(read[:, 1:4], 1e-3 * own[:, 6:9])
        np.testing.assert_allclose(read[:, 4:7], 1e-3 * own[:, 3:6])
        assert parser.dropped == 16, "17 lines of other things, of which the first is taken for half a line"
        total += len(samples)
    assert total == len(rows) == 3732


def test_a_real_table_with_units_in_its_header() -> None:
    """x-io's recording in deg/s and g: at rest in the beginning, upright."""
    table = (data("rest_and_motion_100hz") / "sensor_data.csv").read_bytes()
    parser = CsvLines()
    samples = np.array(parser.feed(table))
    assert parser.dropped == 0
    assert len(samples) == 13514
    assert np.median(np.diff(samples[:, 0])) == pytest.approx(0.01, abs=1e-4)
    rest = samples[:300]
    assert np.linalg.norm(rest[:, 4:].mean(axis=0)) == pytest.approx(G, rel=0.02)
    assert np.abs(rest[:, 1:4].mean(axis=0)).max() < math.radians(1.0)


def test_columns_of_a_name() -> None:
    columns = parse_columns(
        "timestamp_us,gyr_x_degs,gyr_y_degs,gyr_z_degs,acc_x_mps2,acc_y_mps2,acc_z_mps2", header=True
    )
    assert columns.times == ((0, 1e-6),)
    assert columns.axes[0] == (1, math.radians(1.0))
    assert columns.axes[5] == (6, 1.0)


# Detection


@every
@given(cuts=st.lists(st.integers(0, 2000), max_size=20), noise=st.binary(max_size=100))
@settings(max_examples=10, deadline=None)
def test_a_protocol_is_recognised(protocol: str, cuts: list[int], noise: bytes) -> None:
    stream = noise + b"\n" + b"".join(wire(protocol))
    detector = Detector(baud=57600)
    edges = [0, *sorted(min(cut, len(stream)) for cut in cuts), len(stream)]
    samples = [sample for a, b in pairwise(edges) for sample in detector.feed(stream[a:b])]
    assert (detector.protocol, detector.baud) == (protocol, 57600)
    assert len(samples) >= len(SAMPLES) - 3, "those it was recognised by are not lost"


def test_the_speed_is_changed_when_nothing_is_understood_and_not_in_silence() -> None:
    detector = Detector(baud=9600)
    tried = []
    for _ in range(12):
        assert detector.feed(b"") == []
        tried.append(detector.baud)
        detector.feed(bytes([0x80, 0xF8, 0x00, 0x78, 0xC3]) * 103)
    assert tried[:3] == [9600, 115200, 57600]
    assert tried[10] == 9600
    assert len(set(tried)) == 10
    assert "wrong baud rate" in detector.last_error
    assert detector.dropped == 12
    text = Detector(baud=9600)
    text.feed(b"hello\n" * 300)
    assert text.baud == 9600, "text is listened to for longer"
    assert len(detector.feed(b"".join(wire("steadfix")))) == len(SAMPLES)
    assert detector.protocol == "steadfix"
    assert detector.baud == tried[11 - 10 + 1], "the speed at which it was understood stays"


@pytest.mark.parametrize(
    ("heard", "says"),
    [
        (b"half\nhello\nhel", "text of no known form, such as 'hello'"),
        (b"1,2,3,4,5,6\n" * 9, "its columns have to be named"),
        (b"\0" * 50, "nothing but the byte 0x00"),
        (bytes(range(128, 200)), "neither text nor known frames"),
    ],
)
def test_what_is_not_recognised_is_described(heard: bytes, says: str) -> None:
    assert says in describe(heard)


def test_the_detector_says_what_its_parser_says() -> None:
    detector = Detector()
    detector.feed(b"".join(wire("steadfix")))
    broken = bytearray(steadfix_frame(20, SAMPLES[0]))
    broken[10] ^= 1
    detector.feed(bytes(broken) + steadfix_frame(22, SAMPLES[0]))
    assert detector.reasons == {"wrong checksum": 1}
    assert detector.last_error.startswith("wrong checksum")
    assert detector.missing == 2
    rvc = Detector()
    rvc.feed(b"".join(wire("bno08x-rvc")))
    assert rvc.note == Bno08xRvc.note


def test_every_name_opens_a_parser_of_its_own() -> None:
    assert len({type(open_parser(name)) for name in get_args(ProtocolName)}) == len(PROTOCOLS) + 1


def test_without_pymavlink(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is an extra: everything else goes on, and what may be MAVLink is told what is missing."""
    sent = b"".join(wire("mavlink"))
    monkeypatch.setitem(sys.modules, "pymavlink.dialects.v20", None)
    with pytest.raises(MavlinkMissingError, match="pip install pymavlink"):
        open_parser("mavlink")
    detector = Detector()
    detector.feed(sent)
    assert "MAVLink needs pymavlink" in detector.last_error
    detector = Detector()
    assert len(detector.feed(b"".join(wire("json")))) == len(SAMPLES)


def test_a_known_protocol_without_readings_is_recognised_all_the_same() -> None:
    """An autopilot that sends only heartbeats, and a sensor that is set to angles."""
    from pymavlink.dialects.v20 import common

    heartbeat = bytes(common.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3).pack(common.MAVLink(None)))
    for sent, protocol in ((heartbeat, "mavlink"), (checked(b"VNYPR,1,2,3"), "vectornav")):
        detector = Detector(baud=57600)
        assert detector.feed(sent * 300) == []
        assert (detector.protocol, detector.baud) == (protocol, 57600)


def test_what_a_short_file_holds() -> None:
    detector = Detector()
    assert detector.feed(b"".join(wire("witmotion")[:2])) == []
    assert len(detector.settle()) == 2
    assert detector.protocol == "witmotion"
    assert detector.settle() == []
    detector = Detector()
    detector.feed(b"half\nhello\nhel")
    assert detector.settle() == []
    assert "such as 'hello'" in detector.last_error
    assert "baud)" not in detector.last_error
