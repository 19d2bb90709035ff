"""`steadfix imu-rest`, `imu-positions`: from files, and from a device on a pty."""

from __future__ import annotations

import json
import os
import threading
import time
import tomllib
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from fusion.measurements import Array
from fusion.params import GRAVITY
from server.cli import main
from server.config import parse

ROBOT = '[[robot]]\nname = "rover"\n[[robot.marker]]\nid = 7\nsize_mm = 60\n'
LEVEL = np.array([0.0, 0.0, GRAVITY])


def rows(
    seconds: float, force: Array = LEVEL, scatter: float = 0.002, start: float = 0.0, rate: float = 100.0
) -> Array:
    rng = np.random.default_rng(1)
    n = round(seconds * rate)
    gyro = [0.01, -0.02, 0.003] + scatter * rng.standard_normal((n, 3))
    return np.column_stack([start + np.arange(n) / rate, gyro, force + 10.0 * scatter * rng.standard_normal((n, 3))])


def write(path: Path, samples: Array) -> str:
    np.savetxt(path, samples, delimiter=",", header="t_s,gx,gy,gz,ax,ay,az", comments="", fmt="%.7g")
    return str(path)


@contextmanager
def device(samples: Array) -> Iterator[str]:
    """A port on which the samples come as JSON lines in their own time."""
    master, slave = os.openpty()
    tty.setraw(slave)
    done = threading.Event()

    def send() -> None:
        began = time.monotonic()
        for t, *row in samples.tolist():
            if done.wait(max(0.0, began + t - time.monotonic())):
                return
            os.write(master, json.dumps({"t": t, "gyro": row[:3], "accel": row[3:]}).encode() + b"\n")

    thread = threading.Thread(target=send)
    thread.start()
    yield os.ttyname(slave)
    done.set()
    thread.join()
    os.close(slave)
    os.close(master)


@pytest.mark.parametrize("source", ["file", "folder", "json lines"])
def test_rest_of_a_file_gives_a_section_of_the_configuration(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], source: str
) -> None:
    path = write(tmp_path / "imu.csv", rows(12.0))
    if source == "json lines":
        path = str(tmp_path / "captured")
        lines = [json.dumps({"t": t, "gyro": row[:3], "accel": row[3:]}) for t, *row in rows(12.0).tolist()]
        Path(path).write_text("\n".join(lines))
    assert main(["imu-rest", str(tmp_path) if source == "folder" else path]) == 0
    text, warnings = capsys.readouterr()
    assert warnings == ""
    tomllib.loads(text)
    imu = parse(ROBOT + text).robot[0].imu
    assert imu.gyro_bias == pytest.approx((0.01, -0.02, 0.003), abs=3e-4)
    assert imu.rotation_deg == pytest.approx((0.0, 0.0, 0.0), abs=0.05)


def test_rest_as_json(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["imu-rest", write(tmp_path / "a.csv", rows(12.0)), "--json"]) == 0
    rest = json.loads(capsys.readouterr().out)
    assert rest["gyro_bias"] == pytest.approx([0.01, -0.02, 0.003], abs=3e-4)
    assert rest["rate_hz"] == pytest.approx(100.0)


def test_rest_on_a_port(capsys: pytest.CaptureFixture[str]) -> None:
    with device(rows(30.0)) as port:
        assert main(["imu-rest", port, "--seconds", "1"]) == 0
    text, told = capsys.readouterr()
    assert told == "steadfix: keep it still for 1 s\n"
    assert parse(ROBOT + text).robot[0].imu.gyro_bias == pytest.approx((0.01, -0.02, 0.003), abs=2e-3)


def test_moved_on_a_port(capsys: pytest.CaptureFixture[str]) -> None:
    with device(rows(30.0, scatter=0.3)) as port:
        assert main(["imu-rest", port, "--seconds", "1"]) == 2
    text, told = capsys.readouterr()
    assert text == ""
    assert "the IMU moved: it was never still, or its rates are not rad/s; 1 s are needed" in told


def test_six_sides_in_a_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    parts = []
    for i, axis in enumerate(np.vstack([np.eye(3), -np.eye(3)])):
        force = GRAVITY * axis * [1.02, 1.0, 0.99] + [0.3, -0.2, 0.1]
        parts += [rows(4.0, force, start=5.0 * i), rows(1.0, force, scatter=0.5, start=5.0 * i + 4.0)]
    path = write(tmp_path / "imu.csv", np.concatenate(parts))
    assert main(["imu-positions", path]) == 0
    text, told = capsys.readouterr()
    assert told == ""
    imu = parse(ROBOT + text).robot[0].imu
    assert imu.accel_bias == pytest.approx((0.3, -0.2, 0.1), abs=0.01)
    assert np.linalg.inv(imu.accel_matrix) == pytest.approx(np.diag([1.02, 1.0, 0.99]), abs=2e-3)
    assert main(["imu-positions", write(tmp_path / "five.csv", np.concatenate(parts[:-2]))]) == 2
    assert "none with -z up" in capsys.readouterr().err


@pytest.mark.long
def test_six_sides_on_a_port(capsys: pytest.CaptureFixture[str]) -> None:
    sides = [rows(5.0, GRAVITY * axis, start=5.0 * i) for i, axis in enumerate(np.vstack([np.eye(3), -np.eye(3)]))]
    with device(np.concatenate([*sides, rows(30.0, start=30.0)])) as port:
        assert main(["imu-positions", port]) == 0
    text, told = capsys.readouterr()
    assert "steadfix: +x up is done, 5 to go\n" in told
    assert parse(ROBOT + text).robot[0].imu.accel_bias == pytest.approx((0.0, 0.0, 0.0), abs=0.02)


@pytest.mark.parametrize(
    ("make", "status", "said"),
    [
        (lambda folder: folder / "nothing.csv", 2, "nothing.csv: no such file"),
        (lambda folder: folder / "ttyNOT", 1, "ttyNOT: there is no such port"),
        (lambda folder: folder, 2, "imu.csv: no such file"),
        (lambda folder: write(folder / "a.csv", rows(3.0)), 2, "3.0 s of readings; 10 s at rest are needed"),
        (lambda folder: _text(folder, "t_s,gx,gy\n1,2,3\n" * 900), 2, "no IMU sample in it: "),
        (lambda folder: _text(folder, ""), 2, "too little to tell what it is"),
        (lambda folder: _text(folder, "gx,gy,gz,ax,ay,az\n" + "0,0,0,0,0,9.8\n" * 2000), 2, "--rate-hz"),
        (lambda folder: write(folder / "g.csv", rows(12.0, LEVEL / GRAVITY)), 2, "these are g"),
    ],
)
@pytest.mark.parametrize("command", ["imu-rest", "imu-positions"])
def test_what_cannot_be_used_is_said(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    command: str,
    make: Callable[[Path], object],
    status: int,
    said: str,
) -> None:
    assert main([command, str(make(tmp_path))]) == status
    text, told = capsys.readouterr()
    assert text == ""
    assert told.startswith("steadfix: ")
    assert "Traceback" not in told
    if command == "imu-rest" or "--rate-hz" in said or status == 1:
        assert said in told


def _text(folder: Path, text: str) -> Path:
    (folder / "file").write_text(text)
    return folder / "file"


def test_a_file_without_stamps_at_a_rate(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = _text(tmp_path, "gx,gy,gz,ax,ay,az\n" + "0.01,0,0,0,0,9.8\n" * 2000)
    assert main(["imu-rest", str(path), "--rate-hz", "100"]) == 0
    assert "at rest for 20.0 s" in capsys.readouterr().out
