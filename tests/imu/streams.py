"""The wire of each protocol, written from its description: what a device would send for given samples."""

from __future__ import annotations

import json
import math
import struct
from binascii import crc_hqx
from collections.abc import Sequence
from functools import reduce
from operator import xor

from imu.protocols import RawSample
from imu.protocols.steadfix_frames import encode

G = 9.80665


def frames(protocol: str, samples: Sequence[RawSample]) -> list[bytes]:
    """The bytes of each sample, in SI and Steadfix's axes as the parser gives them. Not for bno08x-rvc."""
    return [_WIRE[protocol](i, sample) for i, sample in enumerate(samples)]


def json_line(_: int, sample: RawSample) -> bytes:
    t, gx, gy, gz, ax, ay, az = sample
    return json.dumps({"t": t, "gyro": [gx, gy, gz], "accel": [ax, ay, az]}).encode() + b"\n"


def csv_line(_: int, sample: RawSample) -> bytes:
    return ",".join(map(repr, sample)).encode() + b"\r\n"


def steadfix_frame(i: int, sample: RawSample) -> bytes:
    t, *rest = sample
    return encode(i, round((t or 0.0) * 1e6), (rest[0], rest[1], rest[2]), (rest[3], rest[4], rest[5]))


def witmotion_packet(kind: int, payload: bytes) -> bytes:
    packet = bytes([0x55, kind]) + payload
    return packet + bytes([sum(packet) & 0xFF])


def witmotion_packets(_: int, sample: RawSample) -> bytes:
    """Acceleration, rate and angle, as the sensors send them by default."""
    forces = struct.pack("<4h", *(round(a / (16 * G) * 32768) for a in sample[4:]), 2500)
    rates = struct.pack("<4h", *(round(math.degrees(g) / 2000 * 32768) for g in sample[1:4]), 2500)
    return (
        witmotion_packet(0x51, forces)
        + witmotion_packet(0x52, rates)
        + witmotion_packet(0x53, struct.pack("<4h", 1, 2, 3, 4))
    )


def rvc_frame(i: int, yaw_deg: float, pitch_deg: float, roll_deg: float, forces: Sequence[float]) -> bytes:
    """Of a BNO08x; forces in m/s2."""
    angles = (round(100 * angle) for angle in (yaw_deg, pitch_deg, roll_deg))
    body = struct.pack("<B6h3x", i & 0xFF, *angles, *(round(1000 * a / G) for a in forces))
    return b"\xaa\xaa" + body + bytes([sum(body) & 0xFF])


def vectornav_line(_: int, sample: RawSample) -> bytes:
    _t, gx, gy, gz, ax, ay, az = sample
    numbers = (0.1, 0.2, 0.3, ax, -ay, -az, gx, -gy, -gz, 25.0, 101.3)
    body = b"VNIMU," + b",".join(b"%+010.6f" % number for number in numbers)
    return b"$%s*%02X\r\n" % (body, reduce(xor, body))


def vectornav_message(_: int, sample: RawSample) -> bytes:
    """Groups 1 and 3: TimeStartup and YawPitchRoll; UncompAccel, UncompGyro and Temp."""
    t, gx, gy, gz, ax, ay, az = sample
    body = struct.pack("<BHH", 0b101, 0b1001, 0b11100)
    body += struct.pack("<Q3f", round((t or 0.0) * 1e9), 10.0, 20.0, 30.0)
    body += struct.pack("<7f", ax, -ay, -az, gx, -gy, -gz, 25.0)
    return b"\xfa" + body + struct.pack(">H", crc_hqx(body, 0))


def highres_imu(i: int, sample: RawSample, version: int = 2) -> bytes:
    from pymavlink.dialects.v10 import common as v1
    from pymavlink.dialects.v20 import common as v2

    dialect = v1 if version == 1 else v2
    link = dialect.MAVLink(None, srcSystem=1, srcComponent=1)
    link.seq = i & 0xFF
    t, gx, gy, gz, ax, ay, az = sample
    message = dialect.MAVLink_highres_imu_message(
        round((t or 0.0) * 1e6), ax, -ay, -az, gx, -gy, -gz, 0, 0, 0, 0, 0, 0, 25, 0x3F
    )
    return bytes(message.pack(link))


_WIRE = {
    "json": json_line,
    "csv": csv_line,
    "steadfix": steadfix_frame,
    "witmotion": witmotion_packets,
    "vectornav": vectornav_line,
    "vectornav-binary": vectornav_message,
    "mavlink": highres_imu,
}


def rocking(seconds: float = 1.0, rate_hz: float = 100.0, begin: float = 10.0) -> list[RawSample]:
    """A sensor that is tipped to and fro about x, gravity moving with it, by up to 30 deg, and turns about z."""
    samples = []
    for i in range(round(seconds * rate_hz)):
        t = i / rate_hz
        angle, rate = 0.5 * math.sin(6.0 * t), 3.0 * math.cos(6.0 * t)
        samples.append(RawSample(begin + t, rate, 0.0, 0.0, 0.0, G * math.sin(angle), G * math.cos(angle)))
    return samples
