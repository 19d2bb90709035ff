"""The messages and their fan-out, without a socket."""

from __future__ import annotations

import json
import math
from collections.abc import Callable

import msgspec
import numpy as np
import pytest
from websockets.frames import Frame, Opcode

from fusion.geometry import rotation_about_z, transform
from fusion.measurements import Mode, Pose
from server.hub import STALL_LIMIT, Hub, Topic
from server.messages import (
    Clock,
    ClockAnswer,
    Dialect,
    Hello,
    Imu,
    MessageError,
    Units,
    Wheels,
    encode,
    frame,
    pose_message,
    tracker_message,
)

POSE = Pose.of(
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


@pytest.mark.parametrize("opcode", [Opcode.TEXT, Opcode.BINARY])
@pytest.mark.parametrize("length", [0, 125, 126, 65535, 65536])
def test_a_frame_is_the_librarys(length: int, opcode: Opcode) -> None:
    data = bytes(length)
    assert frame(data, opcode is Opcode.TEXT) == Frame(opcode, data).serialize(mask=False)


def test_the_robots_own_time_is_there_only_when_it_is_known() -> None:
    assert json.loads(encode(pose_message(POSE, 10.0, 1, t_robot=3.5)))["t_robot"] == 3.5
    assert "t_robot" not in json.loads(encode(pose_message(POSE, 10.0, 1)))


def test_what_a_robot_says() -> None:
    decode = Dialect().decode
    assert decode('{"type":"hello","robot":"rover","pose_rate_hz":20}') == Hello("rover", 20.0)
    assert decode('{"type":"hello","robot":"rover","colour":"of a later version"}') == Hello("rover")
    assert decode('{"type":"clock","id":3,"received":1.5,"sent":1.6}') == ClockAnswer(3, 1.5, 1.6)
    imu = decode('{"type":"imu","samples":[[1,0,0,0,0,0,9.81],[1.005,0,0,0,0,0,9.81]]}')
    assert isinstance(imu, Imu)
    assert [sample[0] for sample in Dialect().readings(imu)] == [1.0, 1.005]


def test_msgpack_says_the_same_as_json() -> None:
    for text in (
        '{"type":"hello","robot":"rover","pose_rate_hz":20,"units":{"gyro":"deg/s"}}',
        '{"type":"imu","samples":[[1,0,0,0.5,0,0,9.81],[null,0,0,0,0,0,9.81]]}',
        '{"type":"clock","id":3,"received":1.5,"sent":1.6}',
    ):
        assert Dialect().decode(msgspec.msgpack.encode(json.loads(text))) == Dialect().decode(text)
    pose = pose_message(POSE, published=10.02, seq=7)
    assert msgspec.msgpack.decode(Dialect(binary=True).encode(pose)) == json.loads(Dialect().encode(pose))


def test_what_the_wheels_say() -> None:
    dialect = Dialect(Hello("rover", units=Units(gyro="deg/s"), clock=Clock("ms", wraps_at=65536.0)))
    wheels = dialect.decode('{"type":"wheels","samples":[[65530,0.5,-0.1],[4,0.5,null],[null,null,0.1]]}')
    assert isinstance(wheels, Wheels)
    # m/s and rad/s, whatever the gyroscope's unit is.
    assert dialect.wheels(wheels) == [(65.53, 0.5, -0.1), (65.54, 0.5, None), (None, None, 0.1)]
    nothing = dialect.decode('{"type":"wheels","samples":[[1,0,null],[2,null,null]]}')
    assert isinstance(nothing, Wheels)
    with pytest.raises(MessageError, match="sample 1: neither speed nor yaw rate"):
        dialect.wheels(nothing)


def test_other_units_become_si_and_a_counter_does_not_wrap() -> None:
    dialect = Dialect(Hello("rover", units=Units("deg/s", "g"), clock=Clock("us", wraps_at=2.0**32)))
    imu = dialect.decode('{"type":"imu","samples":[[4294967000,180,0,-90,0,0,1],[4704,2000,0,0,0,-2,0]]}')
    assert isinstance(imu, Imu)
    first, second = dialect.readings(imu)
    assert first == pytest.approx((4294.967, math.pi, 0.0, -math.pi / 2, 0.0, 0.0, 9.80665))
    assert second == pytest.approx((4294.972, math.radians(2000.0), 0.0, 0.0, 0.0, -19.6133, 0.0))
    assert dialect.ticks(first[0] + 0.005) == pytest.approx(4704.0, abs=1e-3)
    # Answers to the clock's questions and samples come in any order, and on both sides of the wrap.
    assert dialect.seconds(4294967200.0) == pytest.approx(4294.9672)


@pytest.mark.parametrize("stamp", [365 * 86400.0, -365 * 86400.0])
def test_a_stamp_a_year_off_among_others(stamp: float) -> None:
    samples = [[5.0 + 0.005 * i, 0, 0, 0, 0, 0, 9.8] for i in range(10)]
    samples[4][0] += stamp
    with pytest.raises(MessageError, match=r"the stamps of one message are 3\.15\d+e\+07 s apart"):
        Dialect().decode(json.dumps({"type": "imu", "samples": samples}))


@pytest.mark.parametrize(
    ("data", "expected"),
    [
        (b"\x00\x01", "a binary message of 2 bytes that is not msgpack"),
        (b'{"type":"imu"}', "not msgpack; JSON goes into text messages"),
        (b"\x81" * 60000, "nested too deeply"),
        ("", "this is not JSON"),
        ("hello", "this is not JSON: Expecting value at byte 0, near 'hello'"),
        ('{"type":"imu","samples":[[1,2', "this is not JSON: Expecting ',' delimiter at byte 29"),
        ("[]", 'found a list of 0; needed: an object {"type": ...}'),
        ("[" * 60000, "nested too deeply"),
        ('{"type":"hello","robot":"rover","x":' + "[" * 60000, "nested too deeply"),
        ('{"robot":"rover"}', '"type" is missing; needed: hello, imu, wheels or clock'),
        ('{"type":"helo"}', '"type" is "helo"; needed: hello, imu, wheels or clock'),
        ('{"type":["hello"]}', '"type" is a list of 1; needed: hello, imu, wheels or clock'),
        ('{"type":"hello"}', '"robot" is missing; needed: the robot\'s name'),
        ('{"type":"hello","robot":7}', '"robot": found 7; needed: the robot\'s name'),
        ('{"type":"hello","robot":"\\ud800"}', "cannot be used: "),
        ('{"type":"hello","robot":"rover","pose_rate_hz":-1}', "found -1; needed: poses a second, 0 to 1000"),
        ('{"type":"hello","robot":"r","units":{"gyro":"dps"}}', '"units.gyro": found "dps"; needed: {"gyro": "rad/s"'),
        ('{"type":"hello","robot":"r","units":{"acceleration":"g"}}', '"units": found an object; needed: {"gyro"'),
        (
            '{"type":"hello","robot":"r","clock":{"unit":"us","wraps_at":0}}',
            '"clock.wraps_at": found 0; needed: {"unit"',
        ),
        ('{"type":"imu","samples":[]}', "0 samples in one message; needed: 1 to 200"),
        ('{"type":"imu","samples":"none"}', '"samples": found "none"; needed: a list of 1 to 200 samples'),
        ('{"type":"imu","samples":[7]}', "sample 0: found 7; needed: the numbers [t, gx, gy"),
        ('{"type":"imu","samples":[[0,0,0,0,0,0]]}', "sample 0: found a list of 6; needed: the numbers [t, gx, gy"),
        ('{"type":"imu","samples":[[0,0,0,0,0,0,"9.81"]]}', 'sample 0, az: found "9.81"; needed: m/s2, at most 4000'),
        ('{"type":"imu","samples":[[0,0,0,0,0,0,NaN]]}', "JSON knows neither NaN nor Infinity"),
        ('{"type":"imu","samples":[[0,0,0,0,0,0,1e999]]}', "sample 0, az: found Infinity; needed: m/s2"),
        (
            '{"type":"imu","samples":[[1e300,0,0,0,0,0,0]]}',
            "sample 0, t: found 1e+300; needed: s of the robot's own clock",
        ),
        ('{"type":"imu","samples":[[0,0,0,0,0,0,9.8],[0,720,0,0,0,0,0]]}', "sample 1, gx: found 720; needed: rad/s"),
        ('{"type":"imu","samples":[[0,720,0,0,0,0,0]]}', 'degrees a second are told by "units": {"gyro": "deg/s"}'),
        (json.dumps({"type": "imu", "samples": [[0.0] * 7] * 201}), "201 samples in one message; needed: 1 to 200"),
        (
            '{"type":"wheels","samples":[[0,1]]}',
            "sample 0: found a list of 2; needed: the numbers [t, speed, yaw_rate]",
        ),
        ('{"type":"wheels","samples":[[0,1000,0]]}', "sample 0, speed: found 1000; needed: m/s, at most 100"),
        ('{"type":"wheels","samples":[[0,0,720]]}', "sample 0, yaw_rate: found 720; needed: rad/s, at most 200"),
        ('{"type":"clock","id":1}', '"received" is missing; needed: when the question came'),
    ],
)
def test_what_is_said_about_rubbish(data: str | bytes, expected: str) -> None:
    with pytest.raises(MessageError) as caught:
        Dialect().decode(data)
    assert expected in str(caught.value)
    assert "$" not in str(caught.value)
    assert len(str(caught.value)) < 300


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("field", range(7))
def test_what_is_no_number_passes_msgpack_but_not_the_service(value: float, field: int) -> None:
    sample = [0.0] * 7
    sample[field] = value
    with pytest.raises(MessageError, match=r"sample 1, \w+: found -?(NaN|Infinity); needed: "):
        Dialect().decode(msgspec.msgpack.encode({"type": "imu", "samples": [[0.0] * 7, sample]}))


def test_the_original_trackers_message_to_the_byte() -> None:
    corners = np.array([[500.0, 290.0], [525.9, 290.0], [525.9, 311.8], [500.0, 311.8]])
    camera_from_marker = transform(rotation_about_z(math.radians(93.5)), [0.0, 0.0, 3.0])
    # 512.95 and 300.9 are truncated, not rounded.
    assert tracker_message(7, corners, camera_from_marker) == b'{"id": "7", "x": 512, "y": 300, "bearing": 93.5}'


@pytest.mark.parametrize(("angle", "bearing"), [(0.0, 0.0), (-math.pi / 2, 270.0), (-1e-20, 0.0), (math.pi, 180.0)])
def test_bearings_are_from_0_to_below_360(angle: float, bearing: float) -> None:
    message = json.loads(tracker_message(7, np.zeros((4, 2)), transform(rotation_about_z(angle), np.zeros(3))))
    assert message["bearing"] == pytest.approx(bearing)


A, B, C = ("a",), ("b",), ("c",)


def about(**messages: bytes) -> Callable[[Topic], bytes | None]:
    return lambda topic: messages.get(topic[0])


class Client:
    """A client's buffer, taken from or not."""

    def __init__(self, hub: Hub, *topics: Topic, rate_hz: float = 0.0, room: int = 0) -> None:
        self.received: list[bytes] = []
        self.waiting = 0
        self.aborted = False
        self.subscribed = hub.subscribed(self._write, lambda: self.waiting, self._abort, topics, rate_hz, room)
        self.subscription = self.subscribed.__enter__()

    def _write(self, data: bytes) -> None:
        self.received.append(data)

    def _abort(self) -> None:
        self.aborted = True
        self.waiting = 0


def test_each_client_gets_its_topics() -> None:
    hub = Hub()
    a, b, nothing = Client(hub, A), Client(hub, A, B, A), Client(hub, C)
    asked: list[Topic] = []

    def message(topic: Topic) -> bytes | None:
        asked.append(topic)
        return None if topic == C else topic[0].upper().encode()

    hub.publish(1.0, message)
    assert a.received == [b"A"]
    assert b.received == [b"A", b"B"]
    assert nothing.received == []
    # Each is encoded once, whoever gets it.
    assert asked == [A, B, C]
    assert hub.wants(B)
    b.subscribed.__exit__(None, None, None)
    assert not hub.wants(B)


@pytest.mark.parametrize("rate_hz", [1.0, 20.0, 25.0, 37.0, 50.0, 100.0])
def test_a_client_gets_its_own_rate(rate_hz: float) -> None:
    hub = Hub(tick=0.02)
    client = Client(hub, A, rate_hz=rate_hz)
    rng = np.random.default_rng(3)
    for i in range(500):
        hub.publish(100.0 + i * 0.02 + rng.uniform(0.0, 0.004), about(a=b"A"))
    assert len(client.received) == pytest.approx(10.0 * min(rate_hz, 50.0), abs=2)


def test_ticks_that_are_late_now_and_then_cost_nobody_a_message() -> None:
    hub = Hub(tick=0.02)
    # Due at any time between two ticks.
    clients = [Client(hub, A, rate_hz=50.0) for _ in range(20)]
    for i, client in enumerate(clients):
        client.subscription.due = 100.0 + 1e-3 * i
    rng = np.random.default_rng(4)
    for i in range(500):
        late = rng.uniform(0.0, 2e-4) + (rng.uniform(0.0, 0.008) if rng.random() < 0.1 else 0.0)
        hub.publish(100.0 + i * 0.02 + late, about(a=b"A"))
    assert min(len(client.received) for client in clients) >= 499


@pytest.mark.parametrize("tick", [0.01, 0.02])
@pytest.mark.parametrize("phase", [3, 17, 32, 46])
@pytest.mark.parametrize("due", [0, 4, 9, 13])
def test_an_early_answer_does_not_change_the_rate(tick: float, phase: int, due: int) -> None:
    hub = Hub(tick)
    client = Client(hub, A, rate_hz=50.0)
    client.subscription.due = 100.0 + 1e-3 * due
    # 20 batches a second, each answered at once; ticks send what is due in between.
    answered = 0
    for i in range(1, 10_001):
        now = 100.0 + i * 1e-3
        if i % 50 == phase:
            assert hub.is_due(now, client.subscription, answer=True)
            hub.send(now, client.subscription, b"early")
            assert client.received[-1] == b"early"
            answered += 1
        if i % round(1e3 * tick) == 0:
            hub.publish(now, about(a=b"A"))
    assert answered == 200
    assert len(client.received) == pytest.approx(500, abs=2)


def test_more_batches_than_poses_are_not_all_answered() -> None:
    hub = Hub()
    client = Client(hub, A, rate_hz=20.0)
    for i in range(2000):
        now = 100.0 + i * 0.005
        if hub.is_due(now, client.subscription, answer=True):
            hub.send(now, client.subscription, b"early")
    assert len(client.received) == pytest.approx(200, abs=2)


def test_after_a_pause_nothing_is_caught_up() -> None:
    hub = Hub(tick=0.01)
    client = Client(hub, A, rate_hz=10.0)
    hub.publish(0.0, about(a=b"A"))
    for i in range(10):
        hub.publish(60.0 + i * 0.01, about(a=b"A"))
    assert len(client.received) == 2


def test_a_slow_client_gets_the_latest_and_holds_nobody_up() -> None:
    hub = Hub()
    slow, fast = Client(hub, A), Client(hub, A)
    slow.waiting = 1
    for i in range(10):
        hub.publish(i * 0.02, about(a=str(i).encode()))
    slow.waiting = 0
    hub.publish(0.2, about(a=b"10"))
    assert slow.received == [b"10"]
    assert len(fast.received) == 11
    assert hub.dropped == 10


def test_a_client_that_takes_nothing_is_cut_off() -> None:
    hub = Hub()
    stalled, slow = Client(hub, A), Client(hub, A)
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
