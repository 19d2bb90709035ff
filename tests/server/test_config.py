"""The configuration file: what is accepted, and what is said about what is not."""

import re
from pathlib import Path

import pytest

from camera.calibration import load_intrinsics
from server.config import ConfigError, load, parse

ROOT = Path(__file__).parents[2]

GOOD = """
[server]
port = 0

[[camera]]
name = "ceiling"
source = "room.mp4"
calibration = "camera.toml"

[[anchor]]
id = 40
size_mm = 150
position_m = [0, 0, 0]

[[robot]]
name = "rover"
[[robot.marker]]
id = 7
size_mm = 60
position_m = [0.0, 0.0, 0.12]
[[robot.marker]]
id = 8
size_mm = 60
[robot.imu]
source = "/dev/ttyUSB0"
[robot.filter]
gyro_noise = 1e-3

[[robot]]
name = "cart"
[[robot.marker]]
id = 9
size_mm = 60
"""


def test_a_whole_configuration() -> None:
    config = parse(GOOD, folder=Path("/floor"))
    assert config.server.port == 0
    assert config.server.host == "127.0.0.1"
    assert config.camera[0].source == "/floor/room.mp4"
    assert config.camera[0].calibration == "/floor/camera.toml"
    assert [marker.id for marker in config.robot[0].marker] == [7, 8]
    assert config.robot[0].marker[0].position_m == (0.0, 0.0, 0.12)
    assert config.robot[0].filter.gyro_noise == 1e-3
    assert config.robot[1].imu.source == "websocket"


@pytest.mark.parametrize("source", ['"picamera"', '"rtsp://camera.local/1"', "2"])
def test_a_source_that_is_no_path_stays_as_it_is(source: str) -> None:
    config = parse(GOOD.replace('"room.mp4"', source), folder=Path("/floor"))
    assert str(config.camera[0].source) == source.strip('"')


def test_the_example_is_accepted() -> None:
    config = load(ROOT / "example.toml")
    assert config.robot[0].name == "rover"
    intrinsics = load_intrinsics(config.camera[0].calibration)
    assert (intrinsics.width_px, intrinsics.height_px) == (config.camera[0].width_px, config.camera[0].height_px)


def test_the_example_is_accepted_with_everything_in_it_switched_on() -> None:
    text = re.sub(r"^#(?=[\[a-z])", "", (ROOT / "example.toml").read_text(), flags=re.MULTILINE)
    config = parse(text)
    assert [robot.name for robot in config.robot] == ["rover", "cart"]
    assert len(config.anchor) == 2


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ('source = "room.mp4"', 'sorce = "room.mp4"', ["line 7", 'camera "ceiling"', "sorce", 'did you mean "source"']),
        ("[server]", "[sever]", ["line 2", "sever", 'did you mean "server"']),
        ("port = 0", "port = 0\nfrobnicate = 1", ["line 4", "frobnicate", "known here: host, port, pose_rate_hz"]),
        ("gyro_noise", "gyro_noize", ['robot "rover", filter, gyro_noize', 'did you mean "gyro_noise"']),
        ("gyro_noise = 1e-3", "gyro_noise = -1.0", ['robot "rover", filter, gyro_noise', "found -1.0", "needed"]),
        ("port = 0", 'port = "0"', ["line 3", "server, port", 'found "0"', "a port number"]),
        ("port = 0", "port = 99999", ["found 99999", "0 to 65535"]),
        ("size_mm = 150", "size_mm = 0.15", ["line 12", "anchor 40", "size_mm", "found 0.15", "millimetres"]),
        ("size_mm = 150", 'size_mm = "150 mm"', ["found", "150 mm", "millimetres"]),
        ("size_mm = 150", "size_m = 0.15", ["line 12", "size_m", 'did you mean "size_mm"', "millimetres"]),
        ("size_mm = 150\n", "", ["line 10", "anchor 40", '"size_mm" is missing', "millimetres"]),
        ("[0, 0, 0]", "[0, 0]", ["line 13", "position_m", "found [0, 0]", "three numbers", "metres"]),
        ("[0, 0, 0]", '[0, "a", 0]', ["line 13", "position_m[1]", 'found "a"']),
        ("[0, 0, 0]", "[2500, 0, 0]", ["line 13", "found 2500", "metres, each within 1000"]),
        ("[0, 0, 0]", "[nan, 0, 0]", ["line 13", "found nan", "metres"]),
        ("gyro_noise = 1e-3", "gyro_noise = inf", ["found inf"]),
        ('name = "cart"', 'name = "cart"\nmotion = "flying"', ["motion", '"flying"', '"ground"']),
        ('name = "cart"', 'name = "rover"', ['the robot name rover is used twice, first by robot "rover"']),
        ('name = "cart"', 'name = "my cart/../x"', ["my cart", "letters, digits"]),
        ("id = 9", "id = 7", ["the marker id 7 is used twice", 'robot "rover", marker 7']),
        ("id = 9", "id = 40", ["the marker id 40 is used twice", "anchor 40"]),
        ("id = 9", "id = -1", ["id", "found -1", "0 or more"]),
        ('[[robot.marker]]\nid = 9\nsize_mm = 60\n', "", ['robot "cart"', '"marker" is missing', "[[robot.marker]]"]),
        ("[[camera]]", "[camera]", ["line 5", "camera", "two brackets"]),
        ('calibration = "camera.toml"\n', "", ['"calibration" is missing', "example-camera.toml"]),
        ('source = "room.mp4"', "source = 1.5", ["found 1.5", "rtsp://"]),
        ("[[anchor]]\nid = 40\nsize_mm = 150\nposition_m = [0, 0, 0]\n", "", ["cameras need anchors"]),
        ('source = "/dev/ttyUSB0"', 'source = "/dev/ttyUSB0"\nprotocol = "xml"', ['"xml"', '"auto" or "json"']),
        (
            'source = "/dev/ttyUSB0"',
            'source = "/dev/ttyUSB0"\nprotocol = "csv"\ncolumns = "t,gx,gy"',
            ['robot "rover", imu, columns', "no column for gz ax ay az"],
        ),
        ('source = "/dev/ttyUSB0"', 'source = "/dev/ttyUSB0"\ncolumns = "t,gx,gy"', ['the protocol "json" has none']),
        ("port = 0", "port = ", ["not valid TOML", "line 3"]),
    ],
)  # fmt: skip
def test_what_is_said_about_a_mistake(old: str, new: str, expected: list[str]) -> None:
    assert old in GOOD
    with pytest.raises(ConfigError) as caught:
        parse(GOOD.replace(old, new, 1), name="room.toml")
    text = str(caught.value)
    assert text.startswith("room.toml")
    for part in expected:
        assert part in text


def test_a_serial_port_for_two_robots() -> None:
    with pytest.raises(ConfigError, match=r"line \d+: robot \"cart\".*serial port /dev/ttyUSB0 is used twice"):
        parse(GOOD + '[robot.imu]\nsource = "/dev/ttyUSB0"\n')


def test_a_file_that_is_no_text(tmp_path: Path) -> None:
    path = tmp_path / "room.toml"
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match=r"room\.toml: not a text file in UTF-8"):
        load(path)


def test_a_byte_order_mark_is_passed_over(tmp_path: Path) -> None:
    path = tmp_path / "room.toml"
    path.write_text("[server]\nport = 4242\n", encoding="utf-8-sig")
    assert load(path).server.port == 4242


def test_nested_too_deeply() -> None:
    with pytest.raises(ConfigError, match="nested too deeply"):
        parse("a = " + "[" * 5000 + "]" * 5000)
