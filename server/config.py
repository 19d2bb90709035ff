"""The configuration file: TOML in, checked structs out.

Units are in the keys (`size_mm`, `yaw_deg`, `position_m`); a key without one is in SI units. Every mistake is a
ConfigError whose text names the file, the line where it can be found, the key, what is there and what would be right.
"""

from __future__ import annotations

import contextlib
import difflib
import json
import math
import re
import tomllib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Annotated, Any, get_args, get_type_hints

import msgspec
import numpy as np
from msgspec import Meta, Struct

from camera.settings import CaptureSettings
from fusion.params import Engine, FilterParams, Motion
from imu.mounting import ImuCalibration
from imu.protocols.csv_lines import ColumnsError, parse_columns
from imu.protocols.detection import ProtocolName
from server.access import HASHED

DEFAULT_PORT = 5678

Metres = Annotated[float, Meta(ge=-1000.0, le=1000.0)]
Position = tuple[Metres, Metres, Metres]
Degrees = Annotated[float, Meta(ge=-360.0, le=360.0)]
MarkerId = Annotated[int, Meta(ge=0, le=65535)]
MarkerSize = Annotated[float, Meta(ge=5.0, le=2000.0)]
Rate = Annotated[float, Meta(gt=0.0, le=1000.0)]
RateOrNone = Annotated[float, Meta(ge=0.0, le=1000.0)]
# Names appear in addresses (`?robots=a,b`) and as folders of a recording.
Name = Annotated[str, Meta(pattern=r"^[A-Za-z0-9_][A-Za-z0-9_.\-]*$", max_length=64)]
Text = Annotated[str, Meta(min_length=1)]
KeyPath = tuple[str | int, ...]


class ConfigError(ValueError):
    """A configuration that cannot be used. The text says where, what was found and what would be right."""


class ServerConfig(Struct, frozen=True, forbid_unknown_fields=True):
    host: Text = "127.0.0.1"
    port: Annotated[int, Meta(ge=0, le=65535)] = DEFAULT_PORT
    """0: any free one, which the log names."""
    pose_rate_hz: Rate = 50.0
    token: str = ""
    """Of those who look on from other machines, plain or `sha256:` and hexadecimal; "": this machine only."""
    certificate: str = ""
    key: str = ""
    """Paths of a TLS certificate (PEM, with its chain) and its key; `load` makes them absolute."""
    origins: tuple[Text, ...] = ()
    """Web pages of other addresses that may connect, such as "https://panel.example"."""


class CameraConfig(CaptureSettings, frozen=True, forbid_unknown_fields=True):
    name: Name
    source: Annotated[int, Meta(ge=0)] | Text
    calibration: Text
    """Path of the intrinsics; `load` makes it absolute, and `source` too where that is a path."""
    dictionary: Text = "4X4_50"
    time_offset: Annotated[float, Meta(ge=-2.0, le=2.0)] = 0.0
    """s, added to the stamps of its frames."""
    token: str = ""
    """Of the node of a remote camera, plain or `sha256:` and hexadecimal; "": a node on this machine, without."""
    placement: str = ""
    """Path of where it hangs, as `steadfix floor` writes it; "": found from the anchors in view. `load` makes it
    absolute."""


class AnchorConfig(Struct, frozen=True, forbid_unknown_fields=True):
    id: MarkerId
    size_mm: MarkerSize
    position_m: Position
    yaw_deg: Degrees = 0.0


class MarkerConfig(Struct, frozen=True, forbid_unknown_fields=True):
    id: MarkerId
    size_mm: MarkerSize
    position_m: Position = (0.0, 0.0, 0.0)
    roll_deg: Degrees = 0.0
    pitch_deg: Degrees = 0.0
    yaw_deg: Degrees = 0.0
    """Turned by roll about the body's x axis, then by pitch about its y, then by yaw about its z."""


class ImuConfig(ImuCalibration, frozen=True, forbid_unknown_fields=True):
    source: Text = "websocket"
    protocol: ProtocolName = "json"
    columns: str = ""
    """Of CSV lines, where they are others than `t,gx,gy,gz,ax,ay,az`; imu/protocols/csv_lines.py says how."""
    baud: Annotated[int, Meta(ge=1200, le=12_000_000)] = 115200
    """With the protocol "auto" the first that is tried."""
    pose_rate_hz: RateOrNone = 0.0
    """Poses sent back down a serial line; a WebSocket robot says its rate itself."""


class RobotConfig(Struct, frozen=True, forbid_unknown_fields=True):
    name: Name
    marker: Annotated[tuple[MarkerConfig, ...], Meta(min_length=1)]
    token: str = ""
    """What it shows to speak on /v1/robot, plain or `sha256:` and hexadecimal; "": from this machine, without."""
    motion: Motion = "ground"
    engine: Engine = "numba"
    imu: ImuConfig = ImuConfig()
    filter: FilterParams = FilterParams()


class Config(Struct, frozen=True, forbid_unknown_fields=True):
    server: ServerConfig = ServerConfig()
    camera: tuple[CameraConfig, ...] = ()
    anchor: tuple[AnchorConfig, ...] = ()
    robot: tuple[RobotConfig, ...] = ()


# What would be right, by key: for the sentence that follows a value that is not.
_RIGHT = {
    "server": "a [server] section",
    "camera": "[[camera]] sections, with two brackets",
    "anchor": "[[anchor]] sections, with two brackets",
    "robot": "[[robot]] sections, with two brackets",
    "marker": "at least one [[robot.marker]] section, with two brackets",
    "imu": "a [robot.imu] section",
    "filter": "a [robot.filter] section",
    "host": 'an address to listen on, such as "127.0.0.1"',
    "port": "a port number, 0 to 65535",
    "pose_rate_hz": "poses a second, up to 1000",
    "token": 'a secret in quotes, or "sha256:" and the 64 hexadecimal digits of its SHA-256',
    "certificate": 'the path of a TLS certificate in PEM format, such as "certificate.pem"',
    "key": 'the path of the certificate\'s private key in PEM format, such as "key.pem"',
    "origins": 'a list of addresses of web pages, such as ["https://panel.example"]',
    "name": "a name of letters, digits, `_`, `-` and `.`, at most 64",
    "calibration": "the path of the camera's calibration file, such as example-camera.toml beside example.toml",
    "dictionary": 'the name of a marker dictionary, such as "4X4_50" or "APRILTAG_36H11"',
    "width_px": "a whole number of pixels, 0 for the camera's own",
    "height_px": "a whole number of pixels, 0 for the camera's own",
    "frame_rate_hz": "frames a second, 0 for the camera's own",
    "pixel_format": 'four letters for a USB camera, such as "MJPG", or "" for the camera\'s own',
    "exposure_ms": "milliseconds up to 1000, 0 for the camera's own",
    "gain": "a number of 0 or more, 0 for the camera's own",
    "line_time": "seconds between two rows of the image, such as 19e-6; 0 where all are exposed together",
    "time_offset": "seconds, -2 to 2, added to the camera's stamps",
    "placement": "the path of a file that `steadfix floor` wrote",
    "id": "the number of the marker in its dictionary, 0 or more",
    "size_mm": "the side of the marker's black square in millimetres, 5 to 2000",
    "position_m": "three numbers [x, y, z] in metres, each within 1000",
    "imu.position_m": "three numbers [forward, left, up] in metres from the robot's origin, each within 10",
    "rotation_deg": "three angles [roll, pitch, yaw] in degrees, each -360 to 360",
    "gyro_bias": "three numbers [x, y, z] in rad/s, each within 1, as `steadfix imu-rest` prints them",
    "accel_bias": "three numbers [x, y, z] in m/s2, each within 5, as `steadfix imu-positions` prints them",
    "accel_matrix": "three rows of three numbers, near 1 on the diagonal, as `steadfix imu-positions` prints them",
    "roll_deg": "an angle in degrees about the robot's x axis, -360 to 360",
    "pitch_deg": "an angle in degrees about the robot's y axis, -360 to 360",
    "yaw_deg": "an angle in degrees, anticlockwise, -360 to 360",
    "motion": '"ground", "differential" or "free"',
    "engine": '"numba" or "filterpy"',
    "protocol": " or ".join(f'"{name}"' for name in get_args(ProtocolName)),
    "columns": 'the columns of CSV lines, such as "t[us],gx[deg/s],gy[deg/s],gz[deg/s],ax[g],ay[g],az[g]"',
    "baud": "the speed of the serial line in bits a second, such as 115200",
}
_SOURCE = {
    "camera": 'a camera number, "/dev/video0", "rtsp://...", a video file, a folder of images, "picamera", or "remote" '
    "for one on another machine",
    "robot": '"websocket" or a serial port such as "/dev/ttyUSB0"',
}


def load(path: str | Path) -> Config:
    """Read, decode and check a configuration file. Raises OSError, and ConfigError for what it says."""
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: not a text file in UTF-8 ({error.reason} at byte {error.start})") from None
    return parse(text, name=str(path), folder=path.parent)


def parse(text: str, name: str = "configuration", folder: Path = Path()) -> Config:
    """The same from a text. `name` stands for the file in errors; relative paths start at `folder`."""
    try:
        raw = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{name}: not valid TOML: {error}") from None
    except RecursionError:
        raise ConfigError(f"{name}: nested too deeply for a configuration") from None
    source = _Source(name, text, raw)
    for path, value in _leaves(raw):
        if isinstance(value, float) and not math.isfinite(value):
            raise source.error(path, f"found {value}; needed: {_right(path)}")
    try:
        config = msgspec.convert(raw, Config)
    except msgspec.ValidationError as error:
        raise source.explain(str(error)) from None
    _check(config, source)
    server = config.server
    if server.certificate:
        certificate, key = (str((folder / file).absolute()) for file in (server.certificate, server.key))
        server = msgspec.structs.replace(server, certificate=certificate, key=key)
    cameras = tuple(_with_absolute_paths(camera, folder) for camera in config.camera)
    return msgspec.structs.replace(config, server=server, camera=cameras)


def with_settings(params: FilterParams, settings: Iterable[str]) -> FilterParams:
    """A filter's parameters with some given as on a command line, `gyro_noise=0.002`. Raises ConfigError."""
    for setting in settings:
        name, _, text = (part.strip() for part in setting.partition("="))
        if name not in FilterParams.__struct_fields__:
            nearest = difflib.get_close_matches(name, FilterParams.__struct_fields__, n=1)
            advice = f"did you mean {nearest[0]}?" if nearest else "fusion/params.py lists them"
            raise ConfigError(f"--set {setting}: the filter has no parameter {name!r}; {advice}")
        changed = None
        with contextlib.suppress(msgspec.ValidationError):
            changed = msgspec.convert(msgspec.structs.asdict(params) | {name: text}, FilterParams, strict=False)
        if changed is None or not math.isfinite(getattr(changed, name)):
            raise ConfigError(f"--set {setting}: found {text or 'nothing'}; needed: {_range(name)}")
        params = changed
    return params


def _with_absolute_paths(camera: CameraConfig, folder: Path) -> CameraConfig:
    source = camera.source
    is_path = isinstance(source, str) and "://" not in source and not source.isdecimal()
    if is_path and source not in ("picamera", "remote"):
        source = str((folder / str(source)).absolute())
    calibration = str((folder / camera.calibration).absolute())
    placement = str((folder / camera.placement).absolute()) if camera.placement else ""
    return msgspec.structs.replace(camera, source=source, calibration=calibration, placement=placement)


def _check(config: Config, source: _Source) -> None:
    """What no type says: names, marker ids and serial ports are each used once."""
    seen: dict[tuple[str, object], KeyPath] = {}

    def once(kind: str, value: object, path: KeyPath) -> None:
        before = seen.setdefault((kind, value), path)
        if before != path:
            raise source.error(path, f"{kind} {value} is used twice, first by {source.words(before[:-1])}")

    for i, camera in enumerate(config.camera):
        once("the camera name", camera.name, ("camera", i, "name"))
    for i, anchor in enumerate(config.anchor):
        once("the marker id", anchor.id, ("anchor", i, "id"))
    for i, robot in enumerate(config.robot):
        once("the robot name", robot.name, ("robot", i, "name"))
        for j, marker in enumerate(robot.marker):
            once("the marker id", marker.id, ("robot", i, "marker", j, "id"))
        if not 0.5 < np.linalg.det(robot.imu.accel_matrix) < 2.0:
            matrix: KeyPath = ("robot", i, "imu", "accel_matrix")
            raise source.error(matrix, f"found {_shown(robot.imu.accel_matrix)}; needed: {_right(matrix)}")
        if robot.imu.source != "websocket":
            once("the serial port", robot.imu.source, ("robot", i, "imu", "source"))
        if robot.imu.columns:
            columns: KeyPath = ("robot", i, "imu", "columns")
            if robot.imu.protocol not in ("csv", "auto"):
                raise source.error(columns, f'the protocol "{robot.imu.protocol}" has none; "csv" has')
            try:
                parse_columns(robot.imu.columns)
            except ColumnsError as error:
                raise source.error(columns, str(error)) from None
    for given, other in (("certificate", "key"), ("key", "certificate")):
        if getattr(config.server, given) and not getattr(config.server, other):
            raise source.error(("server", given), f'the key "{other}" is missing: {_RIGHT[other]}')
    tokens: list[tuple[KeyPath, str]] = [(("server", "token"), config.server.token)]
    tokens += [(("robot", i, "token"), robot.token) for i, robot in enumerate(config.robot)]
    tokens += [(("camera", i, "token"), camera.token) for i, camera in enumerate(config.camera)]
    for path, token in tokens:
        if token.startswith(HASHED) and not re.fullmatch(HASHED + "[0-9A-Fa-f]{64}", token):
            raise source.error(path, f"found {_shown(token)}; needed: {_RIGHT['token']}")
    if not config.anchor and not all(camera.placement for camera in config.camera):
        raise source.error(
            ("camera",),
            "cameras need anchors: at least one [[anchor]], a marker on the floor at a known place (id, size_mm, "
            "position_m), tells where the camera is; or each a `placement`, a file that `steadfix floor` wrote",
        )


class _Source:
    """The text behind a configuration, to say where in it something is."""

    def __init__(self, name: str, text: str, raw: dict[str, Any]) -> None:
        self.name = name
        self.raw = raw
        self.lines = _line_numbers(text)

    def error(self, path: KeyPath, what: str) -> ConfigError:
        found = next((self.lines[path[:n]] for n in range(len(path), 0, -1) if path[:n] in self.lines), None)
        where = self.name if found is None else f"{self.name}, line {found}"
        return ConfigError(f"{where}: {self.words(path)}: {what}" if path else f"{where}: {what}")

    def words(self, path: KeyPath) -> str:
        """`robot "rover", marker 7, size_mm`."""
        parts: list[str] = []
        value: Any = self.raw
        for key in path:
            try:
                value = value[key]
            except (KeyError, IndexError, TypeError):
                value = None
            if isinstance(key, str):
                parts.append(key)
            elif isinstance(value, dict):
                label = value.get("name", value.get("id"))
                parts[-1] += f" number {key + 1}" if label is None else f" {json.dumps(label, default=str)}"
            else:
                parts[-1] += f"[{key}]"
        return ", ".join(parts)

    def explain(self, message: str) -> ConfigError:
        """msgspec's message in words. Its forms: `... - at `$.camera[0].source``, unknown field, missing field."""
        what, _, place = message.partition(" - at `$")
        path: KeyPath = tuple(int(index) if index else key for key, index in re.findall(r"\.(\w+)|\[(\d+)\]", place))
        if unknown := re.search(r"unknown field `(.*)`", what):
            return self._unknown(path, unknown[1])
        if missing := re.search(r"missing required field `(.*)`", what):
            return self.error(path, f'the key "{missing[1]}" is missing: {_right((*path, missing[1]))}')
        value: Any = self.raw
        for key in path:
            value = value[key]
        return self.error(path, f"found {_shown(value)}; needed: {_right(path) or what}")

    def _unknown(self, path: KeyPath, key: str) -> ConfigError:
        known = _fields(path)
        nearest = difflib.get_close_matches(key, known, n=1, cutoff=0.6)
        if nearest:
            right = _right((*path, nearest[0]))
            advice = f'did you mean "{nearest[0]}"' + (f" ({right})?" if right else "?")
        else:
            advice = f"known here: {', '.join(known)}"
        return self.error((*path, key), f"unknown key; {advice}")


def _fields(path: KeyPath) -> tuple[str, ...]:
    """The keys known in the section at `path`."""
    names = tuple(key for key in path if isinstance(key, str))
    section: dict[tuple[str, ...], type[Struct]] = {
        (): Config,
        ("server",): ServerConfig,
        ("camera",): CameraConfig,
        ("anchor",): AnchorConfig,
        ("robot",): RobotConfig,
        ("robot", "marker"): MarkerConfig,
        ("robot", "imu"): ImuConfig,
        ("robot", "filter"): FilterParams,
    }
    return section[names].__struct_fields__


def _right(path: KeyPath) -> str:
    names = [key for key in path if isinstance(key, str)]
    if names[-1:] == ["source"]:
        return _SOURCE.get(names[0], "")
    if "filter" in names[:-1]:
        return _range(names[-1])
    return _RIGHT.get(".".join(names[-2:]), _RIGHT.get(names[-1], "")) if names else ""


def _range(parameter: str) -> str:
    """What a filter parameter may be, by its type."""
    hint = get_type_hints(FilterParams, include_extras=True).get(parameter)
    limits = [limit for limit in getattr(hint, "__metadata__", ()) if isinstance(limit, Meta)]
    words = {"gt": "above", "ge": "at least", "lt": "below", "le": "at most"}
    ranges = [f"{words[k]} {getattr(limit, k):g}" for limit in limits for k in words if getattr(limit, k) is not None]
    kind = "a whole number" if getattr(hint, "__origin__", hint) is int else "a number"
    return " ".join([kind, " and ".join(ranges)]) + "; fusion/params.py says of what"


def _shown(value: object) -> str:
    text = json.dumps(value, default=str)
    return text if len(text) <= 60 else text[:57] + "..."


def _leaves(value: object, path: KeyPath = ()) -> Iterator[tuple[KeyPath, object]]:
    if isinstance(value, dict):
        for key, item in value.items():
            yield from _leaves(item, (*path, key))
    elif isinstance(value, list):
        for i, item in enumerate(value):
            yield from _leaves(item, (*path, i))
    else:
        yield path, value


_HEADER = re.compile(r"""^\s*(\[\[?)\s*([\w."' -]+?)\s*\]\]?\s*(?:#.*)?$""")
_KEY = re.compile(r"""^\s*([\w."'-]+)\s*=""")


def _line_numbers(text: str) -> dict[KeyPath, int]:
    """Path -> line of the sections and keys of a TOML text.

    tomllib keeps no places; this reads the plain way of writing them and may miss others, which costs the number only.
    """
    lines: dict[KeyPath, int] = {}
    count: dict[KeyPath, int] = {}
    section: KeyPath = ()
    for number, line in enumerate(text.splitlines(), start=1):
        if header := _HEADER.match(line):
            section = ()
            keys = [key.strip(" \"'") for key in header[2].split(".")]
            for depth, key in enumerate(keys):
                section = (*section, key)
                if header[1] == "[[" and depth == len(keys) - 1:
                    count[section] = count.get(section, -1) + 1
                if section in count:
                    lines.setdefault(section, number)
                    section = (*section, count[section])
            lines.setdefault(section, number)
        elif key_match := _KEY.match(line):
            path = (*section, *(key.strip("\"'") for key in key_match[1].split(".")))
            lines.setdefault(path, number)
    return lines
