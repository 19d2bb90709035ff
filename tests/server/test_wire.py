"""The messages and their fan-out, without a socket."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest

from fusion.geometry import rotation_about_z, transform
from fusion.measurements import Mode, Pose
from server.hub import STALL_LIMIT, Hub
from server.messages import (
    ClockAnswer,
    Hello,
    Imu,
    MessageError,
    decode,
    encode,
    pose_message,
    raw_samples,
    tracker_message,
)

POSE = Pose(
    robot="rover",
    t=10.0,
    position=np.array([1.0, 2.0, 0.12]),
    quaternion_wxyz=np.array([math.cos(0.25), 0.0, 0.0, math.sin(0.25)]),
    velocity=np.array([0.3, 0.0, 0.0]),
    angular_velocity=np.array([0.0, 0.0, 0.1]),
    covariance=np.arange(36.0).reshape(6, 6),
    velocity_covariance=np.eye(3),
    mode=Mode.FULL,
    reset_id=2,
    fix_age=0.41,
)


def test_a_pose_on_the_wire() -> None:
    message = json.loads(encode(pose_message(POSE, published=10.02, seq=7)))
    assert message == {
        "type": "pose",
        "robot": "rover",
        "t": 10.0,
        "published": 10.02,
        "seq": 7,
        "frame": "world",
        "position": [1.0, 2.0, 0.12],
        "orientation_wxyz": [math.cos(0.25), 0.0, 0.0, math.sin(0.25)],
        "yaw": pytest.approx(0.5),
        "velocity": [0.3, 0.0, 0.0],
        "angular_velocity": [0.0, 0.0, 0.1],
        "covariance": list(range(36)),
        "mode": "FULL",
        "reset_id": 2,
        "fix_age": 0.41,
    }


def test_the_robots_own_time_is_there_only_when_it_is_known() -> None:
    assert json.loads(encode(pose_message(POSE, 10.0, 1, t_robot=3.5)))["t_robot"] == 3.5
    assert "t_robot" not in json.loads(encode(pose_message(POSE, 10.0, 1)))


def test_what_a_robot_says() -> None:
    assert decode('{"type":"hello","robot":"rover","pose_rate_hz":20}') == Hello("rover", 20.0)
    assert decode('{"type":"hello","robot":"rover","token":"of a later version"}') == Hello("rover")
    assert decode('{"type":"clock","id":3,"received":1.5,"sent":1.6}') == ClockAnswer(3, 1.5, 1.6)
    imu = decode('{"type":"imu","samples":[[1,0,0,0,0,0,9.81],[1.005,0,0,0,0,0,9.81]]}')
    assert isinstance(imu, Imu)
    assert [sample.device_time for sample in raw_samples(imu)] == [1.0, 1.005]


@pytest.mark.parametrize(
    ("data", "expected"),
    [
        (b"\x00\x01", "a binary message of 2 bytes"),
        ("", "truncated"),
        ("hello", "malformed"),
        ("[]", "Expected `object`"),
        ("[" * 60000, "Expected `object`"),
        ('{"type":"hello","robot":"rover","x":' + "[" * 60000, "nested too deeply"),
        ('{"robot":"rover"}', "missing required field `type`"),
        ('{"type":"helo"}', "Invalid value 'helo' - at `$.type`; known here: hello, imu, clock"),
        ('{"type":"hello","robot":7}', "Expected `str`, got `int` - at `$.robot`"),
        ('{"type":"hello","robot":"rover","pose_rate_hz":-1}', "at `$.pose_rate_hz`"),
        ('{"type":"imu","samples":[]}', "length >= 1"),
        ('{"type":"imu","samples":[[0,0,0,0,0,0]]}', "length 7 - at `$.samples[0]`"),
        ('{"type":"imu","samples":[[0,0,0,0,0,0,"9.81"]]}', "Expected `float`, got `str` - at `$.samples[0][6]`"),
        ('{"type":"imu","samples":[[0,0,0,0,0,0,NaN]]}', "neither NaN nor Infinity"),
        ('{"type":"imu","samples":[[0,0,0,0,0,0,1e999]]}', "out of range - at `$.samples[0][6]`"),
        (json.dumps({"type": "imu", "samples": [[0.0] * 7] * 201}), "length <= 200"),
    ],
)
def test_what_is_said_about_rubbish(data: str | bytes, expected: str) -> None:
    with pytest.raises(MessageError) as caught:
        decode(data)
    assert expected in str(caught.value)
    assert len(str(caught.value)) < 300


def test_numbers_that_no_sensor_measures() -> None:
    with pytest.raises(MessageError, match=r"sample 1 is out of range.*rad/s"):
        raw_samples(Imu([(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 9.81), (0.005, 720.0, 0.0, 0.0, 0.0, 0.0, 9.81)]))


def test_the_original_trackers_message_to_the_byte() -> None:
    corners = np.array([[500.0, 290.0], [525.9, 290.0], [525.9, 311.8], [500.0, 311.8]])
    camera_from_marker = transform(rotation_about_z(math.radians(93.5)), [0.0, 0.0, 3.0])
    # 512.95 and 300.9 are truncated, not rounded.
    assert tracker_message(7, corners, camera_from_marker) == b'{"id": "7", "x": 512, "y": 300, "bearing": 93.5}'


@pytest.mark.parametrize(("angle", "bearing"), [(0.0, 0.0), (-math.pi / 2, 270.0), (-1e-20, 0.0), (math.pi, 180.0)])
def test_bearings_are_from_0_to_below_360(angle: float, bearing: float) -> None:
    message = json.loads(tracker_message(7, np.zeros((4, 2)), transform(rotation_about_z(angle), np.zeros(3))))
    assert message["bearing"] == pytest.approx(bearing)


class Client:
    """A client's buffer, taken from or not."""

    def __init__(self, hub: Hub, *topics: str, rate_hz: float = 0.0, room: int = 0) -> None:
        self.received: list[bytes] = []
        self.waiting = 0
        self.aborted = False
        self.subscribed = hub.subscribed(self._write, lambda: self.waiting, self._abort, topics, rate_hz, room)
        self.subscribed.__enter__()

    def _write(self, data: bytes) -> None:
        self.received.append(data)

    def _abort(self) -> None:
        self.aborted = True
        self.waiting = 0


def test_each_client_gets_its_topics() -> None:
    hub = Hub()
    a, b = Client(hub, "a"), Client(hub, "a", "b")
    assert hub.wants("b")
    assert not hub.wants("c")
    hub.publish(1.0, {"a": b"A", "b": b"B"})
    assert a.received == [b"A"]
    assert b.received == [b"A", b"B"]
    b.subscribed.__exit__(None, None, None)
    assert not hub.wants("b")


@pytest.mark.parametrize("rate_hz", [1.0, 20.0, 25.0, 37.0, 50.0, 100.0])
def test_a_client_gets_its_own_rate(rate_hz: float) -> None:
    hub = Hub()
    client = Client(hub, "a", rate_hz=rate_hz)
    rng = np.random.default_rng(3)
    for i in range(500):
        hub.publish(100.0 + i * 0.02 + rng.uniform(0.0, 0.004), {"a": b"A"})
    assert len(client.received) == pytest.approx(10.0 * min(rate_hz, 50.0), abs=2)


def test_after_a_pause_nothing_is_caught_up() -> None:
    hub = Hub()
    client = Client(hub, "a", rate_hz=10.0)
    hub.publish(0.0, {"a": b"A"})
    for i in range(10):
        hub.publish(60.0 + i * 0.01, {"a": b"A"})
    assert len(client.received) == 2


def test_a_slow_client_gets_the_latest_and_holds_nobody_up() -> None:
    hub = Hub()
    slow, fast = Client(hub, "a"), Client(hub, "a")
    slow.waiting = 1
    for i in range(10):
        hub.publish(i * 0.02, {"a": str(i).encode()})
    slow.waiting = 0
    hub.publish(0.2, {"a": b"10"})
    assert slow.received == [b"10"]
    assert len(fast.received) == 11
    assert hub.dropped == 10


def test_a_client_that_takes_nothing_is_cut_off() -> None:
    hub = Hub()
    stalled, slow = Client(hub, "a"), Client(hub, "a")
    stalled.waiting = slow.waiting = 1
    hub.sweep(0.0)
    slow.waiting = 0
    hub.sweep(0.5 * STALL_LIMIT)
    slow.waiting = 1
    assert len(hub.sweep(STALL_LIMIT + 0.1)) == 1
    assert stalled.aborted
    assert not slow.aborted
    assert hub.sweep(STALL_LIMIT + 0.2) == []
    assert hub.cut_off == 1
