"""What goes over the wire, as JSON or msgpack: msgspec structs with a `type`, and the one conversion from and to numpy.

Unknown fields are ignored, so that a newer robot can talk to an older service.
"""

from __future__ import annotations

import functools
import json
import math
import re
import struct
from collections.abc import Callable
from typing import Annotated, Any, Generic, Literal, TypeVar

import msgspec
from msgspec import UNSET, Meta, Struct, UnsetType

from fusion.measurements import (
    ANGULAR_VELOCITY,
    COVARIANCE,
    POSITION,
    QUATERNION,
    RESET_STEP,
    VELOCITY,
    Array,
    Pose,
    heading,
)
from fusion.params import GRAVITY
from imu.clock import Reading
from imu.protocols import FORCE_LIMIT, RATE_LIMIT, TIME_LIMIT

# rad/s, m/s2 and s in one of each unit.
RATES = {"rad/s": 1.0, "deg/s": math.radians(1.0)}
FORCES = {"m/s2": 1.0, "g": GRAVITY}
TIMES = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
# m/s: no robot indoors is as fast.
SPEED_LIMIT = 100.0
# s: the stamps of one message are nearer to each other, at any rate worth sending at.
MESSAGE_SPAN = 60.0

SampleT = TypeVar("SampleT")


class MessageError(ValueError):
    """A message that cannot be used. The text says what is wrong with it, for the one who sent it."""


class Units(Struct, frozen=True, forbid_unknown_fields=True):
    """What a robot's samples are in."""

    gyro: Literal["rad/s", "deg/s"] = "rad/s"
    accel: Literal["m/s2", "g"] = "m/s2"


class Clock(Struct, frozen=True, forbid_unknown_fields=True):
    """What a robot's stamps count: `unit`, and where the counter begins again at 0, in that unit, if it does."""

    unit: Literal["s", "ms", "us", "ns"] = "s"
    wraps_at: Annotated[float, Meta(gt=0.0)] | None = None


class Hello(Struct, frozen=True, tag_field="type", tag="hello"):
    """First message of a robot; `pose_rate_hz`: how often it wants its own pose, 0 for never."""

    robot: str
    pose_rate_hz: Annotated[float, Meta(ge=0.0, le=1000.0)] = 0.0
    token: str = ""
    units: Units = Units()
    clock: Clock = Clock()


class Imu(Struct, Generic[SampleT], frozen=True, tag_field="type", tag="imu"):
    """[t, gx, gy, gz, ax, ay, az] each, in the units of the hello, oldest first; t null where there is no clock."""

    samples: Annotated[list[SampleT], Meta(min_length=1, max_length=200)]


class Wheels(Struct, Generic[SampleT], frozen=True, tag_field="type", tag="wheels"):
    """[t, forward speed, yaw rate] each, t as in Imu, m/s and rad/s whatever the units of the IMU; null for one of the
    two that the robot does not know."""

    samples: Annotated[list[SampleT], Meta(min_length=1, max_length=200)]


class ClockAnswer(Struct, frozen=True, tag_field="type", tag="clock"):
    """`received` and `sent`: when the question came and this answer left, by the robot's own clock."""

    id: int
    received: float
    sent: float


WheelReading = tuple[float | None, float | None, float | None]
FromRobot = Hello | Imu[Reading] | Wheels[WheelReading] | ClockAnswer


class Watch(Struct, frozen=True, tag_field="type", tag="hello"):
    """First message to /v1/poses of a viewer who cannot send a header with its token: a page in a browser."""

    token: str


class Welcome(Struct, frozen=True, tag_field="type", tag="welcome"):
    robot: str
    service: str
    pose_rate_hz: float
    """What it will get: what it asked for, but no more than the service publishes."""


class ClockQuestion(Struct, frozen=True, tag_field="type", tag="clock"):
    id: int
    sent: float


class Error(Struct, frozen=True, omit_defaults=True, tag_field="type", tag="error"):
    reason: str
    retry: bool = False
    """Whether the same may work later: the robot's name may be free again."""


class Notice(Struct, frozen=True, tag_field="type", tag="notice"):
    """What looks wrong with a robot's data, which were taken."""

    text: str


class PoseMessage(Struct, frozen=True, tag_field="type", tag="pose"):
    """A published pose. `t` and `published`: s of the service's monotonic clock; SI units, radians, frame `world`.

    `covariance`: 36 numbers, row by row, order and axes as in `fusion.measurements`. `fix_age` is null before the
    first fix. `reset_step`: by how much the pose stepped when `reset_id` rose last: m, then rotation vector, world
    axes; absent before the first. `t_robot`: `t` in the robot's own clock, only on the way to that robot.
    """

    robot: str
    t: float
    published: float
    seq: int
    frame: str
    position: list[float]
    orientation_wxyz: list[float]
    yaw: float
    velocity: list[float]
    angular_velocity: list[float]
    covariance: list[float]
    mode: str
    reset_id: int
    fix_age: float | None
    reset_step: list[float] | UnsetType = UNSET
    t_robot: float | UnsetType = UNSET


ToRobot = Welcome | ClockQuestion | PoseMessage | Error | Notice

encode = msgspec.json.Encoder().encode
FORMATS: dict[str, Callable[[Struct], bytes]] = {"json": encode, "msgpack": msgspec.msgpack.Encoder().encode}


@functools.cache
def _decoders(gyro_unit: str, accel_unit: str, clock_unit: str) -> tuple[Any, Any]:
    """For text and for binary messages in these units. Ranges, and with them NaN, are checked while decoding."""
    gyro, accel, t = (
        Annotated[float, Meta(ge=-limit, le=limit)]
        for limit in (
            RATE_LIMIT / RATES[gyro_unit],
            FORCE_LIMIT / FORCES[accel_unit],
            TIME_LIMIT / TIMES[clock_unit],
        )
    )
    sample: Any = tuple[t | None, gyro, gyro, gyro, accel, accel, accel]  # type: ignore[valid-type]
    speed = Annotated[float, Meta(ge=-SPEED_LIMIT, le=SPEED_LIMIT)]
    rate = Annotated[float, Meta(ge=-RATE_LIMIT, le=RATE_LIMIT)]
    reading: Any = tuple[t | None, speed | None, rate | None]  # type: ignore[valid-type]
    kinds: Any = Hello | Imu[sample] | Wheels[reading] | ClockAnswer
    return msgspec.json.Decoder(kinds), msgspec.msgpack.Decoder(kinds)


class Dialect:
    """How one robot speaks: its units and its clock by its hello, text or binary as the hello was."""

    def __init__(self, hello: Hello | None = None, binary: bool = False) -> None:
        self.units = Units() if hello is None else hello.units
        self.clock = Clock() if hello is None else hello.clock
        self.binary = binary
        self.encode = FORMATS["msgpack" if binary else "json"]
        self._decoders = _decoders(self.units.gyro, self.units.accel, self.clock.unit)
        self._si = self.units == Units() and self.clock == Clock()
        self._ticks = math.nan

    def decode(self, data: str | bytes) -> FromRobot:
        """One message of the robot. Raises MessageError."""
        text, binary = self._decoders
        try:
            message: FromRobot = text.decode(data) if isinstance(data, str) else binary.decode(data)
        except (msgspec.DecodeError, RecursionError) as error:
            raise MessageError(_explain(data, str(error), self)) from None
        if isinstance(message, (Imu, Wheels)):  # a union is made anew each time
            stamps = [sample[0] for sample in message.samples if sample[0] is not None]
            span = (max(stamps) - min(stamps)) * TIMES[self.clock.unit] if stamps else 0.0
            # A counter that wraps within the message is no error.
            if span > MESSAGE_SPAN and self.clock.wraps_at is None:
                raise MessageError(
                    f"the stamps of one message are {span:.6g} s apart; needed: samples of one clock, "
                    f"in {self.clock.unit}, taken within {MESSAGE_SPAN:.0f} s"
                )
        return message

    def readings(self, message: Imu[Reading]) -> list[Reading]:
        """Its samples in SI units: s without wraps, rad/s, m/s2."""
        if self._si:
            return message.samples
        rate, force = RATES[self.units.gyro], FORCES[self.units.accel]
        return [
            (
                None if t is None else self.seconds(t),
                gx * rate,
                gy * rate,
                gz * rate,
                ax * force,
                ay * force,
                az * force,
            )
            for t, gx, gy, gz, ax, ay, az in message.samples
        ]

    def wheels(self, message: Wheels[WheelReading]) -> list[WheelReading]:
        """Its readings with stamps in s without wraps. Raises MessageError for one that says nothing."""
        for i, (_, speed, yaw_rate) in enumerate(message.samples):
            if speed is None and yaw_rate is None:
                raise MessageError(f"sample {i}: neither speed nor yaw rate; needed: at least one of the two")
        return [(None if t is None else self.seconds(t), speed, yaw_rate) for t, speed, yaw_rate in message.samples]

    def seconds(self, ticks: float) -> float:
        """A reading of the robot's clock in s, without its wraps: readings come less than half a wrap apart."""
        wraps_at = self.clock.wraps_at
        if wraps_at is not None:
            if not math.isnan(self._ticks):
                ticks += wraps_at * round((self._ticks - ticks) / wraps_at)
            self._ticks = ticks
        return ticks * TIMES[self.clock.unit]

    def ticks(self, seconds: float) -> float:
        """The inverse: what the robot's clock reads."""
        ticks = seconds / TIMES[self.clock.unit]
        return ticks if self.clock.wraps_at is None else ticks % self.clock.wraps_at


def decode_hello(data: str | bytes) -> Hello:
    """The first message of a robot. Raises MessageError."""
    message = Dialect().decode(data)
    if not isinstance(message, Hello):
        raise MessageError('the first message must be {"type":"hello","robot":"<name>"}')
    return message


def decode_watch(data: str | bytes) -> Watch:
    """A viewer's hello. Raises MessageError."""
    try:
        return (
            msgspec.json.decode(data, type=Watch) if isinstance(data, str) else msgspec.msgpack.decode(data, type=Watch)
        )
    except (msgspec.DecodeError, RecursionError):
        raise MessageError('the first message must be {"type":"hello","token":"<token>"}') from None


# What would be right, by message and field: for the sentence that follows a value that is not.
_NEEDED = {
    ("hello", "robot"): "the robot's name by the configuration, in quotes",
    ("hello", "pose_rate_hz"): "poses a second, 0 to 1000",
    ("hello", "token"): "the robot's token, in quotes",
    ("hello", "units"): '{"gyro": "rad/s" or "deg/s", "accel": "m/s2" or "g"}',
    ("hello", "clock"): '{"unit": "s", "ms", "us" or "ns"}, and "wraps_at" where its counter begins again at 0',
    ("imu", "samples"): "a list of 1 to 200 samples [t, gx, gy, gz, ax, ay, az]",
    ("wheels", "samples"): "a list of 1 to 200 samples [t, speed, yaw_rate]",
    ("clock", "id"): "the id of the question",
    ("clock", "received"): "when the question came, by the robot's clock",
    ("clock", "sent"): "when the answer left, by the robot's clock",
}
_TYPES = tuple(dict.fromkeys(kind for kind, _ in _NEEDED))
_FIELDS = {"imu": ("t", "gx", "gy", "gz", "ax", "ay", "az"), "wheels": ("t", "speed", "yaw_rate")}


def _explain(data: str | bytes, what: str, dialect: Dialect) -> str:
    """In plain words why a message does not decode. `what`: msgspec's own, which names the place."""
    try:
        message = json.loads(data) if isinstance(data, str) else msgspec.msgpack.decode(data)
    except RecursionError:
        return "nested too deeply"
    except json.JSONDecodeError as error:
        return f"this is not JSON: {error.msg} at byte {error.pos}, near {error.doc[max(0, error.pos - 10) :][:20]!r}"
    except msgspec.DecodeError:
        hint = "; JSON goes into text messages" if data[:1] in (b"{", b"[") else ""
        return f"a binary message of {len(data)} bytes that is not msgpack{hint}"
    if not isinstance(message, dict):
        return f'found {_shown(message)}; needed: an object {{"type": ...}}, with the type {_listed(_TYPES)}'
    if "type" not in message:
        return f'"type" is missing; needed: {_listed(_TYPES)}'
    kind = message["type"]
    if kind not in _TYPES:
        return f'"type" is {_shown(kind)}; needed: {_listed(_TYPES)}'
    if missing := re.search(r"missing required field `(\w+)`", what):
        return f'"{missing[1]}" is missing; needed: {_NEEDED[kind, missing[1]]}'
    path = [int(index) if index else key for key, index in re.findall(r"\.(\w+)|\[(\d+)\]", what.partition("`$")[2])]
    if not path:
        nan = isinstance(data, str) and ("NaN" in data or "Infinity" in data)
        return "JSON knows neither NaN nor Infinity, and neither is a measurement" if nan else f"cannot be used: {what}"
    value: Any = message
    for key in path:
        value = value[key]
    name = str(path[0])
    if len(path) == 3 and name == "samples" and isinstance(path[2], int):
        field = _FIELDS[kind][path[2]]
        return f"sample {path[1]}, {field}: found {_shown(value)}; needed: {_range(field, value, dialect)}"
    if len(path) == 2 and name == "samples":
        return f"sample {path[1]}: found {_shown(value)}; needed: the numbers [{', '.join(_FIELDS[kind])}]"
    if name == "samples" and isinstance(value, list):
        return f"{len(value)} samples in one message; needed: 1 to 200"
    return f'"{".".join(map(str, path))}": found {_shown(value)}; needed: {_NEEDED[kind, name]}'


def _range(field: str, value: object, dialect: Dialect) -> str:
    """What a number of a sample must be; `value` is what it was."""
    units = dialect.units
    if field == "t":
        return f"{dialect.clock.unit} of the robot's own clock, or null where it has none"
    unit, limit = {
        "g": (units.gyro, RATE_LIMIT / RATES[units.gyro]),
        "a": (units.accel, FORCE_LIMIT / FORCES[units.accel]),
        "s": ("m/s", SPEED_LIMIT),
        "y": ("rad/s", RATE_LIMIT),
    }[field[0]]
    right = f"{unit}, at most {limit:.6g}"
    if (
        field[0] == "g"
        and unit == "rad/s"
        and isinstance(value, float | int)
        and limit < abs(value) <= math.degrees(limit)
    ):
        right += ' (degrees a second are told by "units": {"gyro": "deg/s"} in the hello)'
    return right


def _listed(words: tuple[str, ...]) -> str:
    return ", ".join(words[:-1]) + f" or {words[-1]}"


def _shown(value: object) -> str:
    if isinstance(value, list):
        return f"a list of {len(value)}"
    if isinstance(value, dict):
        return "an object"
    text = json.dumps(value, default=str)
    return text if len(text) <= 60 else text[:57] + "..."


def pose_message(pose: Pose, published: float, seq: int, t_robot: float | None = None) -> PoseMessage:
    numbers = pose.numbers.tolist()
    return PoseMessage(
        robot=pose.robot,
        t=pose.t,
        published=published,
        seq=seq,
        frame="world",
        position=numbers[POSITION],
        orientation_wxyz=numbers[QUATERNION],
        yaw=heading(numbers[QUATERNION]),
        velocity=numbers[VELOCITY],
        angular_velocity=numbers[ANGULAR_VELOCITY],
        covariance=numbers[COVARIANCE],
        mode=pose.mode,
        reset_id=pose.reset_id,
        fix_age=pose.fix_age if math.isfinite(pose.fix_age) else None,
        reset_step=step if pose.reset_id and any(step := numbers[RESET_STEP]) else UNSET,
        t_robot=UNSET if t_robot is None else t_robot,
    )


def frame(data: bytes, text: bool) -> bytes:
    """A message as a server's WebSocket frame: RFC 6455, section 5.2."""
    kind, length = 0x81 if text else 0x82, len(data)
    if length < 126:
        return bytes((kind, length)) + data
    if length < 65536:
        return struct.pack("!BBH", kind, 126, length) + data
    return struct.pack("!BBQ", kind, 127, length) + data


def tracker_message(id: int, corners_px: Array, camera_from_marker: Array) -> bytes:
    """One sighting as the original tracker sent it, to the byte.

    x, y: the middle between corners 0 and 2, truncated to whole pixels; bearing: degrees in [0, 360) of the marker's
    x axis in the image plane, clockwise as seen in the image, because camera y points down.
    """
    x, y = 0.5 * (corners_px[0] + corners_px[2])
    bearing = math.degrees(math.atan2(camera_from_marker[1, 0], camera_from_marker[0, 0])) % 360.0
    # -1e-20 % 360.0 is 360.0 in floating point.
    bearing = 0.0 if bearing >= 360.0 else bearing
    return json.dumps({"id": str(id), "x": int(x), "y": int(y), "bearing": bearing}).encode()
