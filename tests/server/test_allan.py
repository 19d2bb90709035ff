"""`steadfix allan`: the noise that is put in is the noise that comes out."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from fusion.measurements import Array
from fusion.params import GRAVITY
from imu.allan import analyse
from imu.calibration import CalibrationError
from server.cli import main
from server.config import parse
from tests.data import data

RATE = 20.0
ROBOT = '[[robot]]\nname = "rover"\n[[robot.marker]]\nid = 7\nsize_mm = 60\n'


def lying(seconds: float, seed: int, *, density: float = 2e-4, walk: float = 2e-5, digits: float = 0.0) -> Array:
    """An IMU at rest whose accelerometer is ten times as bad as its gyroscope, in SI units."""
    rng = np.random.default_rng(seed)
    n = round(seconds * RATE)
    noise = density * math.sqrt(RATE) * rng.standard_normal((n, 6))
    noise += walk / math.sqrt(RATE) * rng.standard_normal((n, 6)).cumsum(axis=0)
    body = noise * [1.0, 1.0, 1.0, 10.0, 10.0, 10.0] + [0.01, -0.02, 0.0, 0.0, 0.0, GRAVITY]
    return np.column_stack([np.arange(n) / RATE, np.round(body / digits) * digits if digits else body])


def write(path: Path, samples: Array) -> str:
    np.savetxt(path, samples, delimiter=",", header="t_s,gx,gy,gz,ax,ay,az", comments="", fmt="%.9g")
    return str(path)


def test_noise_and_bias_walk_are_found() -> None:
    found = analyse(lying(3600.0, 1))
    assert found.rate_hz == pytest.approx(RATE)
    for noises, factor in ((found.gyro, 1.0), (found.accel, 10.0)):
        assert [noise.density for noise in noises] == pytest.approx([factor * 2e-4] * 3, rel=0.05)
        assert [noise.walk for noise in noises] == pytest.approx([factor * 2e-5] * 3, rel=0.4)


def test_what_does_not_show_is_not_claimed() -> None:
    """Half an hour of white noise alone; a walk is seen in few of many."""
    walks = [noise.walk for seed in range(5) for noise in analyse(lying(1800.0, seed, walk=0.0)).gyro]
    assert np.isnan(walks).sum() >= 13


def test_coarse_digits_are_not_taken_for_noise() -> None:
    found = analyse(lying(600.0, 1, density=3e-4, walk=0.0, digits=0.001))
    assert [noise.density for noise in found.gyro] == pytest.approx([3e-4] * 3, rel=0.1)


def test_a_sensor_that_always_says_the_same_has_no_noise_to_show() -> None:
    found = analyse(lying(60.0, 1, density=0.0, walk=0.0))
    assert math.isnan(found.gyro[0].density)


def test_motion_is_left_out() -> None:
    moved = lying(600.0, 1)
    shaken = round(30.0 * RATE)
    moved[:shaken, 1:] += np.random.default_rng(1).standard_normal((shaken, 6))
    found = analyse(moved)
    assert found.start == pytest.approx(30.0, abs=1.0)
    assert found.gyro[0].density == pytest.approx(2e-4, rel=0.1)
    with pytest.raises(CalibrationError, match="the longest rest lasts 0 s"):
        analyse(moved[:shaken])


def test_a_section_for_the_configuration_and_a_picture(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write(tmp_path / "rest.csv", lying(900.0, 2, walk=1e-4))
    picture = tmp_path / "allan.svg"
    assert main(["allan", path, "--plot", str(picture)]) == 0
    text, told = capsys.readouterr()
    params = parse(ROBOT + text).robot[0].filter
    assert params.gyro_noise == pytest.approx(2e-4, rel=0.05)
    assert params.accel_noise == pytest.approx(2e-3, rel=0.05)
    assert params.gyro_bias_walk == pytest.approx(1e-4, rel=0.5)
    assert "10 to 20 times that of one at rest" in told
    assert "10 to 20 times that of one" in text
    assert "<svg" in picture.read_text()[:1000]
    assert main(["allan", path, "--mounted", "10"]) == 0
    assert parse(ROBOT + capsys.readouterr().out).robot[0].filter.gyro_noise == pytest.approx(2e-3, rel=0.05)


def test_as_json(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["allan", write(tmp_path / "rest.csv", lying(60.0, 1, walk=0.0)), "--json"]) == 0
    text, told = capsys.readouterr()
    found = json.loads(text)
    assert len(found["gyro"]) == len(found["accel"]) == 3
    assert found["gyro"][0]["density"] == pytest.approx(2e-4, rel=0.1)
    assert found["gyro"][0]["walk"] is None
    assert "60 s of rest show the white noise, but hardly how the biases walk" in told


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["nothing.csv"], "nothing.csv: no such file"),
        (["/dev/null"], "/dev/null: this is no file"),
        (["{short}"], "the longest rest lasts 5 s: 10 s are needed"),
        (["{rest}", "--plot", "{folder}/no/such/folder.png"], "folder.png: no such file or directory"),
    ],
)
def test_what_cannot_be_done_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], said: str
) -> None:
    names = {"folder": str(tmp_path)}
    for name, seconds in (("short", 5.0), ("rest", 20.0)):
        names[name] = write(tmp_path / f"{name}.csv", lying(seconds, 1))
    assert main(["allan", *(argument.format(**names) for argument in arguments)]) in (1, 2)
    assert said in capsys.readouterr().err


def test_a_picture_of_another_kind_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["allan", "rest.csv", "--plot", "a.gif"])
    assert "a name that ends in .png or .svg is needed" in capsys.readouterr().err


def test_a_real_imu_at_rest() -> None:
    found = analyse(np.loadtxt(data("handheld_mocap") / "imu.csv", delimiter=",", skiprows=1))
    assert found.seconds == pytest.approx(34.5, abs=0.1)
    assert 5e-5 < found.gyro[0].density < 2e-4
    assert 1e-3 < found.accel[0].density < 5e-3
