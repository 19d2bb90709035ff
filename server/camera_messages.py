"""What goes over the wire between the service and the node of a remote camera, as JSON on `/v1/camera`.

The node says hello, the service answers with all that the node has to know, and asks for the node's clock as it asks a
robot (`ClockQuestion`, `ClockAnswer` of `server.messages`). Then the node sends what it saw in each frame, and about
once a second how it is. Unknown fields are ignored, so that a newer node can talk to an older service.
"""

from __future__ import annotations

from typing import Annotated, Any

import msgspec
from msgspec import Meta, Struct

from camera.settings import CaptureSettings
from imu.protocols import TIME_LIMIT
from server.messages import ClockAnswer, ClockQuestion, Error, MessageError, Notice

# px; no camera is larger.
_Pixel = Annotated[float, Meta(ge=-100_000.0, le=100_000.0)]
_Corner = tuple[_Pixel, _Pixel]
_Size = Annotated[int, Meta(ge=1, le=100_000)]
# s of any clock.
_Time = Annotated[float, Meta(ge=-TIME_LIMIT, le=TIME_LIMIT)]


class CameraHello(Struct, frozen=True, tag_field="type", tag="hello"):
    """First message of a node."""

    camera: str
    token: str = ""


class CameraWelcome(CaptureSettings, frozen=True, tag_field="type", tag="welcome"):
    """How the node's camera is to be set, and what it is to look for. `ids`: of all markers; `still`: of those of them
    that lie on the floor."""

    camera: str
    service: str
    dictionary: str
    ids: list[int]
    still: list[int]


class MarkerSizes(Struct, frozen=True, tag_field="type", tag="sizes"):
    """How long the sides of the smallest and the largest marker appear in the picture, px, now that the service knows
    where the camera is; null for as large as can be."""

    shortest_px: float
    longest_px: float | None


class MarkerSeen(Struct, frozen=True):
    """`t`: s of the node's clock, mid-exposure of the marker's rows. The rest as in `MarkerSighting`."""

    id: Annotated[int, Meta(ge=0, le=65535)]
    t: _Time
    corners_px: tuple[_Corner, _Corner, _Corner, _Corner]
    sigma_px: Annotated[float, Meta(gt=0.0, le=1000.0)]
    blur_px: Annotated[float, Meta(ge=0.0, le=1000.0)] | None = None


class FrameSeen(Struct, frozen=True, tag_field="type", tag="frame"):
    """What one frame showed, which may be nothing. `t`: mid-exposure of its first row; `sent`: when this message left;
    both s of the node's clock. `detect_ms`: what finding the markers took. `repeated`: ids that are at several places,
    and left out."""

    t: _Time
    sent: _Time
    sequence: Annotated[int, Meta(ge=1)]
    width_px: _Size
    height_px: _Size
    detect_ms: float
    markers: Annotated[list[MarkerSeen], Meta(max_length=200)]
    repeated: Annotated[list[int], Meta(max_length=200)] = []


class NodeStatus(Struct, frozen=True, tag_field="type", tag="status"):
    """`trouble`: what keeps the node's camera from its work, "" for nothing. `dropped`: frames not sent, because
    the link was slower or away. The rest: as in `camera.exposure.Delivery`, null for what is not known."""

    trouble: str
    rate_hz: float
    used_hz: float
    exposure: float | None
    white: float | None
    saturated: float | None
    dropped: int


FromNode = CameraHello | FrameSeen | NodeStatus | ClockAnswer
ToNode = CameraWelcome | MarkerSizes | ClockQuestion | Notice | Error

encode = msgspec.json.Encoder().encode
_from_node: msgspec.json.Decoder[FromNode] = msgspec.json.Decoder(FromNode)
_to_node: msgspec.json.Decoder[ToNode] = msgspec.json.Decoder(ToNode)


def from_node(data: str | bytes) -> FromNode:
    """One message of a node. Raises MessageError."""
    message: FromNode = _decode(_from_node, data)
    return message


def camera_hello(data: str | bytes) -> CameraHello:
    """The first message of a node. Raises MessageError."""
    message = from_node(data)
    if not isinstance(message, CameraHello):
        raise MessageError('the first message must be {"type":"hello","camera":"<name>"}')
    return message


def to_node(data: str | bytes) -> ToNode:
    """One message of the service. Raises MessageError."""
    message: ToNode = _decode(_to_node, data)
    return message


def _decode(decoder: msgspec.json.Decoder[Any], data: str | bytes) -> Any:
    try:
        return decoder.decode(data)
    except RecursionError:
        raise MessageError("JSON nested too deeply") from None
    except msgspec.DecodeError as error:
        raise MessageError(str(error)) from None
