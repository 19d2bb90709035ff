"""`steadfix imu-mounting`: a crooked IMU, seen through a drive."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from fusion.geometry import log_so3
from fusion.measurements import Array, ImuBatch, PoseFix
from fusion.params import GRAVITY
from fusion.simulator import ImuParams, figure_eight, random_ground, simulate
from imu.mounting import ImuCalibration, rotation_from_deg
from server.cli import main
from server.config import parse
from server.imu_mounting import Mounting, find
from server.recording import Recorder, Recording, load
from tests.data import data

ROBOT = '[[robot]]\nname = "rover"\n[[robot.marker]]\nid = 7\nsize_mm = 60\n'


def crooked(samples: Array, rotation_deg: tuple[float, float, float]) -> Array:
    """What an IMU that is turned so reads."""
    imu_from_body = rotation_from_deg(rotation_deg).T
    return np.column_stack([samples[:, 0], samples[:, 1:4] @ imu_from_body.T, samples[:, 4:] @ imu_from_body.T])


def error_deg(found: Mounting, rotation_deg: tuple[float, float, float]) -> Array:
    return np.degrees(log_so3(rotation_from_deg(found.rotation_deg) @ rotation_from_deg(rotation_deg).T))


def write(folder: Path, samples: Array, fixes: list[PoseFix], calibration: ImuCalibration | None = None) -> Path:
    """As the service records it."""
    recorder = Recorder(folder, ["rover"], {"rover": calibration or ImuCalibration()})
    for i in range(0, len(samples), 10):
        recorder.imu(ImuBatch("rover", float(samples[i : i + 10, 0].max()), samples[i : i + 10]))
    for fix in fixes:
        recorder.fix(fix)
    recorder.close()
    return folder / "rover"


@pytest.mark.parametrize("rotation_deg", [(2.0, -3.0, 75.0), (180.0, 0.0, -160.0), (1.0, 90.0, 20.0)])
def test_a_drive_shows_the_rotation_as_well_as_is_said(rotation_deg: tuple[float, float, float]) -> None:
    known = ImuCalibration(position_m=(0.15, 0.1, 0.0))
    simulation = simulate(random_ground(3), 3, duration=60.0, imu=ImuParams(lever_arm=known.position_m), robot="rover")
    samples = crooked(simulation.samples, rotation_deg)
    found = find(Recording("rover", samples, simulation.arrival, simulation.fixes, None), known, lambda: None)
    assert (np.abs(error_deg(found, rotation_deg)) < 4.0 * found.sigma_deg).all()
    assert found.sigma_deg.max() < 1.5
    assert found.d2 < 10.0
    assert found.d2_before > 20.0


def test_the_command_prints_what_the_configuration_takes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    simulation = simulate(figure_eight(), 1, duration=40.0, robot="rover")
    folder = write(tmp_path, crooked(simulation.samples, (2.0, -3.0, 75.0)), simulation.fixes)
    assert main(["imu-mounting", str(folder)]) == 0
    rotation = parse(ROBOT + capsys.readouterr().out).robot[0].imu.rotation_deg
    assert rotation == pytest.approx((2.0, -3.0, 75.0), abs=1.5)
    assert main(["imu-mounting", str(folder), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["rotation_deg"] == pytest.approx(rotation, abs=1e-3)


def test_a_calibration_in_the_recording_is_known_but_for_its_rotation(tmp_path: Path) -> None:
    bias = (0.1, -0.05, 0.02)
    simulation = simulate(figure_eight(), 1, duration=40.0, robot="rover")
    samples = crooked(simulation.samples, (0.0, 0.0, 40.0))
    samples[:, 1:4] += bias
    known = ImuCalibration(gyro_bias=bias, rotation_deg=(0.0, 0.0, 40.0))
    folder = write(tmp_path, samples, simulation.fixes, known)
    found = find(load(folder, calibration=ImuCalibration()), known, lambda: None)
    assert found.rotation_deg == pytest.approx((0.0, 0.0, 40.0), abs=1.0)
    assert found.d2_before == pytest.approx(found.d2, rel=0.1)


def test_a_robot_that_stands_shows_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    simulation = simulate(figure_eight(speed=1e-3), 1, duration=30.0, robot="rover")
    assert main(["imu-mounting", str(write(tmp_path, simulation.samples, simulation.fixes))]) == 2
    assert "deg only; drive a minute of curves" in capsys.readouterr().err


def test_axes_that_no_rotation_makes_right(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The gyroscope's y has the wrong sign, and the rates are in degrees."""
    simulation = simulate(figure_eight(), 1, duration=30.0, robot="rover")
    samples = simulation.samples.copy()
    samples[:, 1:4] = np.degrees(samples[:, 1:4]) * [1.0, -1.0, 1.0]
    assert main(["imu-mounting", str(write(tmp_path, samples, simulation.fixes))]) == 2
    assert "no rotation fits: " in capsys.readouterr().err


def test_what_cannot_be_done_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    simulation = simulate(figure_eight(), 1, duration=30.0, robot="rover")
    few = write(tmp_path / "few", simulation.samples, simulation.fixes[:5])
    none = simulation.samples * [1.0, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0]
    in_g = simulation.samples / [1.0, 1.0, 1.0, 1.0, *[GRAVITY] * 3]
    late = write(tmp_path / "late", simulation.samples + [1000.0, *[0.0] * 6], simulation.fixes)
    (tmp_path / "both").mkdir()
    for name in ("a", "b"):
        write(tmp_path / "both" / name, simulation.samples, simulation.fixes).rename(
            tmp_path / "both" / f"robot_{name}"
        )
    for folder, said in (
        (tmp_path / "none", "no such folder"),
        (few, "4 fixes that the IMU leads from one to the next; 20 are needed"),
        (write(tmp_path / "g", in_g, simulation.fixes), "these are g"),
        (write(tmp_path / "zero", none, simulation.fixes), "gravity reads 0 instead of 9.81"),
        (late, "the drive shows the rotation to 180 deg only"),
        (tmp_path / "both", "several robots; name one of "),
    ):
        assert main(["imu-mounting", str(folder)]) == 2
        assert said in capsys.readouterr().err


def test_a_real_imu_held_askew() -> None:
    """Its own axes are those of the motion capture to a few tenths of a degree."""
    recording = load(data("handheld_mocap"))
    moving = (recording.samples[:, 0] > 37.0) & (recording.samples[:, 0] < 100.0)
    fixes = [fix for fix in recording.fixes if 37.5 < fix.arrival < 100.0]
    samples = crooked(recording.samples[moving], (170.0, -20.0, 130.0))
    found = find(Recording("held", samples, recording.arrival[moving], fixes, None), ImuCalibration(), lambda: None)
    assert np.abs(error_deg(found, (170.0, -20.0, 130.0))).max() < 1.5
