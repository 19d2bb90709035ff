"""A robot whose IMU has a calibration: what it is fed, what is recorded, and what a replay makes of it."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import msgspec
import numpy as np
import pytest

from fusion.localiser import Localiser
from fusion.simulator import random_ground, simulate
from imu.mounting import ImuCalibration, rotation_from_deg, toml_lines
from server.config import ConfigError, ImuConfig, RobotConfig, parse
from server.recording import Recorder, RecordingError, load, load_calibration
from server.replay import replay
from server.robots import Robot

CONFIG = """
[[robot]]
name = "rover"
[[robot.marker]]
id = 7
size_mm = 60
[robot.imu]
position_m = [0.1, -0.02, 0.03]
rotation_deg = [180.0, 2.0, 90.0]
gyro_bias = [0.01, 0.02, -0.03]
accel_bias = [0.1, 0.0, -0.1]
accel_matrix = [[1.01, 0.0, 0.0], [0.0, 0.99, 0.0], [0.0, 0.0, 1.0]]
"""


def drive(robot: Robot) -> None:
    """Ten seconds of a simulated robot through one with a crooked IMU, ten readings at a time."""
    imu = robot.config.imu
    simulation = simulate(random_ground(1), 1, duration=10.0, robot="rover")
    readings = simulation.samples.copy()
    imu_from_body = rotation_from_deg(imu.rotation_deg).T
    readings[:, 1:4] = readings[:, 1:4] @ imu_from_body.T + imu.gyro_bias
    readings[:, 4:] = readings[:, 4:] @ imu_from_body.T @ np.linalg.inv(imu.accel_matrix).T + imu.accel_bias
    fixes = simulation.fixes[::-1]
    for i in range(0, len(readings), 10):
        arrival = float(readings[min(i + 9, len(readings) - 1), 0])
        while fixes and fixes[-1].arrival < arrival:
            robot.feed_fix(fixes[-1], fixes.pop().arrival)
        robot.feed_imu([tuple(row) for row in readings[i : i + 10].tolist()], arrival, arrival)


def test_live_is_as_replayed_and_the_recording_holds_what_the_imu_read(tmp_path: Path) -> None:
    config = parse(CONFIG).robot[0]
    recorder = Recorder(tmp_path, ["rover"], {"rover": config.imu})
    robot = Robot(msgspec.structs.replace(config, imu=msgspec.structs.replace(config.imu, position_m=(0.0,) * 3)))
    lever = Robot(config, recorder)
    drive(robot)
    drive(lever)
    recorder.close()
    assert robot.localiser.counts["rejected"] == 0, "the calibration is not taken out"
    assert robot.localiser.counts["accepted"] > 10
    raw = np.loadtxt(tmp_path / "rover" / "imu.csv", delimiter=",", skiprows=1)
    assert raw[:, 6].mean() == pytest.approx(-9.9, abs=0.2), "upside down, as it is mounted"
    assert load(tmp_path / "rover").samples[:, 6].mean() == pytest.approx(9.8, abs=0.2)
    track, _, _ = replay(load(tmp_path / "rover"), Localiser("rover"))
    live = np.loadtxt(tmp_path / "rover" / "poses.tum")
    np.testing.assert_array_equal(track[np.isfinite(track).all(axis=1)][:, [0, 1, 2, 3, 5, 6, 7, 4]], live)
    # and of a calibration that has been found since
    other, _, _ = replay(load(tmp_path / "rover", calibration=robot.config.imu), Localiser("rover"))
    assert np.nanmax(np.abs(other[:, 1:4] - track[:, 1:4])) > 1e-4


def test_the_service_records_the_calibration(tmp_path: Path) -> None:
    (tmp_path / "room.toml").write_text(CONFIG)
    command = ["run", str(tmp_path / "room.toml"), "--port", "0", "--record", str(tmp_path / "kept")]
    service = subprocess.Popen([sys.executable, "-m", "server.cli", *command], stdout=subprocess.PIPE, text=True)
    assert service.stdout is not None
    with service, service.stdout as told:
        assert "http://" in told.readline()
        service.send_signal(signal.SIGINT)
        assert service.wait(60.0) == 0
    calibration = load_calibration(tmp_path / "kept" / "rover")
    assert toml_lines(calibration) == toml_lines(parse(CONFIG).robot[0].imu)


def test_a_perfect_imu_leaves_no_file(tmp_path: Path) -> None:
    Recorder(tmp_path, ["rover"], {"rover": ImuConfig(source="/dev/ttyUSB0")}).close()
    assert not (tmp_path / "rover" / "imu.toml").exists()
    assert load_calibration(tmp_path / "rover") == ImuCalibration()


@pytest.mark.parametrize("text", ["rotation_deg = [1, 2]", "lever = 1", "rotation_deg = ", "[[[[", b"\xff\xfe\x00"])
def test_a_broken_calibration_in_a_recording_is_said(tmp_path: Path, text: str | bytes) -> None:
    (tmp_path / "imu.toml").write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(RecordingError, match=r"imu\.toml: "):
        load_calibration(tmp_path)


def test_stamps_are_told() -> None:
    robot = Robot(RobotConfig("rover", parse(CONFIG).robot[0].marker))
    told = []
    for device_time in (None, 7.0):
        told.append(robot.health(1.0, ready=False)["stamps"])
        robot.feed_imu([(device_time, 0.0, 0.0, 0.0, 0.0, 0.0, 9.8)], 1.0, 1.0)
    told.append(robot.health(1.0, ready=False)["stamps"])
    assert told == ["none yet", "at arrival, since it sends none", "by the IMU's own clock"]


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        ("position_m", "[100, 0, 0]", r"found 100; needed: three numbers \[forward, left, up\] in metres"),
        ("rotation_deg", "[0, 0]", r"found \[0, 0\]; needed: three angles \[roll, pitch, yaw\] in degrees"),
        ("rotation_deg", "[0, 0, nan]", "found nan; needed: three angles"),
        ("gyro_bias", "[1.5, 0, 0]", "found 1.5; needed: three numbers .* rad/s"),
        ("accel_bias", '"none"', "needed: three numbers .* m/s2"),
        ("accel_matrix", "[[0, 0, 0], [0, 0, 0], [0, 0, 0]]", "needed: three rows of three numbers, near 1"),
        ("lever_arm", "[0, 0, 0]", "unknown key"),
    ],
)
def test_mistakes_are_explained(key: str, value: str, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        parse(CONFIG.partition("[robot.imu]")[0] + f"[robot.imu]\n{key} = {value}\n")
