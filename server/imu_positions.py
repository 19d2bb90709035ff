"""`steadfix imu-positions`: the device at rest on each of its six sides -> accelerometer bias, scale, misalignment."""

from __future__ import annotations

import argparse
import json
import sys

import numpy as np

from fusion.measurements import Array
from imu.calibration import SIDES, CalibrationError, Positions, positions_seen, side_of, solve_positions
from imu.mounting import ImuCalibration, toml_lines
from server.imu_readings import add_source, readings

# s between two looks at what a port has sent.
LOOK_EVERY = 1.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the command's arguments."""
    add_source(parser)
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of TOML")


def run(args: argparse.Namespace) -> int:
    """Runs the command: a port until all six sides have been seen. Raises CalibrationError for a file without one."""
    parts: list[Array] = []
    looked = -np.inf
    told: set[str] = set()
    notice = "lay it on each of its six sides, some seconds still on each, in any order"
    for part in readings(args, notice):
        parts.append(part)
        if part[-1, 0] - looked < LOOK_EVERY:
            continue
        live = np.isfinite(looked)  # a file comes all at once
        looked = part[-1, 0]
        parts = [np.concatenate(parts)]
        sides = {side_of(force) for force in _positions(parts[0])} - {""}
        for side in sorted(sides - told) if live else ():
            print(f"steadfix: {side} up is done, {len(SIDES) - len(sides)} to go", file=sys.stderr, flush=True)
        told |= sides
        if len(told) == len(SIDES):
            break
    found = solve_positions(_positions(np.concatenate(parts)))
    print(json.dumps(found._asdict(), default=np.ndarray.tolist) if args.json else _text(found))
    return 0


def _positions(samples: Array) -> Array:
    try:
        return positions_seen(samples)
    except CalibrationError:
        return np.empty((0, 3))  # too few samples yet


def _text(found: Positions) -> str:
    """A table in comments, and the keys for the configuration."""
    scale, scale_sigma = np.diag(found.matrix), np.diag(found.matrix_sigma)
    off = ~np.eye(3, dtype=bool)
    x, y, z = found.bias.round(5).tolist()
    rows = [tuple(row) for row in found.matrix.round(6).tolist()]
    lines = [
        f"{len(found.error)} positions, upright {' '.join(f'{side} ({n})' for side, n in found.sides.items())}",
        f"bias          {_three(found.bias, 4)} +- {found.bias_sigma.max():.4f} m/s2",
        f"scale         {_three(100.0 * (scale - 1.0), 2)} +- {100.0 * scale_sigma.max():.2f} %",
        f"misalignment  up to {np.degrees(np.abs(found.matrix[off]).max()):.2f} "
        f"+- {np.degrees(found.matrix_sigma[off].max()):.2f} deg: as well as it was laid, by hand 1 deg",
        f"gravity       misread by up to {np.abs(found.error_before).max():.3f} m/s2 before, "
        f"{np.abs(found.error).max():.3f} m/s2 after",
    ]
    calibration = ImuCalibration(accel_bias=(x, y, z), accel_matrix=(rows[0], rows[1], rows[2]))
    return "\n".join([*(f"# {line}" for line in lines), "[robot.imu]", *toml_lines(calibration)])


def _three(values: Array, digits: int) -> str:
    return " ".join(f"{value:+.{digits}f}" for value in values.tolist())
