"""`steadfix imu-rest`: some seconds at rest -> gyroscope bias, scatter, and how the IMU is mounted, from gravity."""

from __future__ import annotations

import argparse
import json
import math

import numpy as np

from fusion.measurements import Array
from fusion.params import GRAVITY
from imu.calibration import Rest, at_rest
from imu.mounting import ImuCalibration, toml_lines
from server.imu_readings import add_source, readings

# s more than asked for are read from a port: windows of rest are whole ones.
MARGIN = 0.5


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the command's arguments."""
    add_source(parser)
    parser.add_argument(
        "--seconds", type=_seconds, default=10.0, metavar="S", help="at rest that are needed; default 10"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of TOML")


def _seconds(text: str) -> float:
    seconds = float(text)
    if not 1.0 <= seconds <= 3600.0:
        raise argparse.ArgumentTypeError(f"{text} s: 1 to 3600 are possible")
    return seconds


def run(args: argparse.Namespace) -> int:
    """Runs the command; raises CalibrationError where the IMU moved."""
    parts: list[Array] = []
    for part in readings(args, f"keep it still for {args.seconds:g} s"):
        parts.append(part)
        if part[-1, 0] - parts[0][0, 0] > args.seconds + MARGIN:
            break
    rest = at_rest(np.concatenate(parts), args.seconds)
    print(json.dumps(rest._asdict(), default=np.ndarray.tolist) if args.json else _text(rest))
    return 0


def _text(rest: Rest) -> str:
    """A table in comments, and the section for the configuration."""
    calibration = ImuCalibration(rotation_deg=_rounded(rest.rotation_deg, 3), gyro_bias=_rounded(rest.gyro_bias, 7))
    gyro, accel = np.degrees(rest.gyro_scatter), rest.accel_scatter
    roll, pitch, _ = rest.rotation_deg
    norm = float(np.linalg.norm(rest.force))
    lines = [
        f"at rest for {rest.seconds:.1f} s from {rest.start:.1f} s on, {rest.rate_hz:.1f} Hz",
        f"gyroscope      bias {_three(np.degrees(rest.gyro_bias), 3)} deg/s, scatter {_three(gyro, 3)} deg/s",
        f"accelerometer  mean {_three(rest.force, 3)} m/s2, scatter {_three(accel, 3)} m/s2",
        f"gravity        {norm:.3f} m/s2, {100.0 * (norm / GRAVITY - 1.0):+.1f} %",
        f"mounting       roll {roll:.2f} deg, pitch {pitch:.2f} deg, if the robot stands level now; an accelerometer",
        f"               bias of 0.05 m/s2 is {math.degrees(0.05 / GRAVITY):.1f} deg of it. Gravity shows no yaw: "
        "`steadfix imu-mounting` does",
    ]
    return "\n".join([*(f"# {line}" for line in lines), "[robot.imu]", *toml_lines(calibration)])


def _rounded(values: object, digits: int) -> tuple[float, float, float]:
    x, y, z = (round(float(value), digits) + 0.0 for value in values)  # type: ignore[attr-defined]
    return x, y, z


def _three(values: object, digits: int) -> str:
    return " ".join(f"{value:.{digits}f}" for value in values)  # type: ignore[attr-defined]
