"""What goes over the wire, as JSON: msgspec structs with a `type`, and the one conversion from and to numpy.

Unknown fields are ignored, so that a newer robot can talk to an older service.
"""

from __future__ import annotations

import json
import math
import re
from typing import Annotated

import msgspec
from msgspec import UNSET, Meta, Struct, UnsetType

from fusion.measurements import Array, Pose
from imu.protocols import DroppedError, RawSample, raw_sample

Sample = tuple[float, float, float, float, float, float, float]


class MessageError(ValueError):
    """A message that cannot be used. The text says what is wrong with it, for the one who sent it."""


class Hello(Struct, frozen=True, tag_field="type", tag="hello"):
    """First message of a robot; `pose_rate_hz`: how often it wants its own pose, 0 for never."""

    robot: str
    pose_rate_hz: Annotated[float, Meta(ge=0.0, le=1000.0)] = 0.0


class Imu(Struct, frozen=True, tag_field="type", tag="imu"):
    """t in s of the robot's own clock, gx gy gz in rad/s, ax ay az in m/s2, oldest first."""

    samples: Annotated[list[Sample], Meta(min_length=1, max_length=200)]


class ClockAnswer(Struct, frozen=True, tag_field="type", tag="clock"):
    """`received` and `sent`: when the question came and this answer left, s of the robot's own clock."""

    id: int
    received: float
    sent: float


FromRobot = Hello | Imu | ClockAnswer


class Welcome(Struct, frozen=True, tag_field="type", tag="welcome"):
    robot: str
    service: str
    pose_rate_hz: float
    """What it will get: what it asked for, but no more than the service publishes."""


class ClockQuestion(Struct, frozen=True, tag_field="type", tag="clock"):
    id: int
    sent: float


class Error(Struct, frozen=True, tag_field="type", tag="error"):
    reason: str


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


_decoder: msgspec.json.Decoder[FromRobot] = msgspec.json.Decoder(FromRobot)
encode = msgspec.json.Encoder().encode


def decode(data: str | bytes) -> FromRobot:
    """One message of a robot. Raises MessageError."""
    if isinstance(data, bytes):
        raise MessageError(f"a binary message of {len(data)} bytes; JSON in text messages is spoken here")
    try:
        return _decoder.decode(data)
    except RecursionError:
        raise MessageError("JSON nested too deeply") from None
    except msgspec.DecodeError as error:
        text = str(error)
        if at := re.search(r"\(byte (\d+)\)", text):
            i = int(at[1])
            text += f", near {data.encode()[max(0, i - 10) : i + 10].decode(errors='replace')!r}"
            if "NaN" in data or "Infinity" in data:
                text += "; JSON knows neither NaN nor Infinity, and neither is a measurement"
        elif text.endswith("`$.type`"):
            text += "; known here: hello, imu, clock"
        raise MessageError(text) from None


def raw_samples(message: Imu) -> list[RawSample]:
    """The readings of a message, checked for numbers that cannot be. Raises MessageError."""
    checked = []
    for i, (t, gx, gy, gz, ax, ay, az) in enumerate(message.samples):
        try:
            checked.append(raw_sample(t, (gx, gy, gz), (ax, ay, az)))
        except DroppedError as error:
            raise MessageError(f"sample {i} is {error}; needed: t in s, gx gy gz in rad/s, ax ay az in m/s2") from None
    return checked


def pose_message(pose: Pose, published: float, seq: int, t_robot: float | None = None) -> PoseMessage:
    return PoseMessage(
        robot=pose.robot,
        t=pose.t,
        published=published,
        seq=seq,
        frame="world",
        position=pose.position.tolist(),
        orientation_wxyz=pose.quaternion_wxyz.tolist(),
        yaw=pose.yaw,
        velocity=pose.velocity.tolist(),
        angular_velocity=pose.angular_velocity.tolist(),
        covariance=pose.covariance.ravel().tolist(),
        mode=pose.mode.value,
        reset_id=pose.reset_id,
        fix_age=pose.fix_age if math.isfinite(pose.fix_age) else None,
        reset_step=pose.reset_step.tolist() if pose.reset_id and pose.reset_step.any() else UNSET,
        t_robot=UNSET if t_robot is None else t_robot,
    )


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
