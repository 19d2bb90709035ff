"""`steadfix imu-mounting`: how an IMU is turned on its robot, from a recorded drive and its fixes."""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from tqdm import tqdm

from fusion.geometry import exp_so3, rotation_about_z
from fusion.localiser import Localiser
from fusion.measurements import Array
from fusion.params import GRAVITY, FilterParams
from imu.calibration import CalibrationError, check_gravity
from imu.mounting import BodyReadings, ImuCalibration, deg_from_rotation, rotation_from_deg, toml_lines
from server.compiling import compile_filter
from server.recording import Recording, load, load_calibration, robot_folders
from server.replay import replay

# The filter needs a few to know anything.
FEWEST_FIXES = 20
# Yaws that are tried: a fit from the nearest finds the right one, which the filter's gates hide from farther away.
YAWS = 16
# Of a fix that does not fit at all: sigmas, d2. What lies beyond is not more wrong.
MOST_SIGMAS, MOST_D2 = 10.0, 100.0
# d2 that is too much for noise, which makes 6, even where that is understated.
POOR_D2 = 20.0
# 1/rad^2: what is not seen at all is within half a turn anyhow.
ANYHOW = 0.1
# deg: what is known no better than this is not known, and than that is known badly.
UNKNOWN_DEG, POOR_DEG = 5.0, 1.0


class Mounting(NamedTuple):
    """`rotation_deg` as in `ImuCalibration`; `sigma_deg` (3,) about the body's x, y, z.

    `d2`: mean squared Mahalanobis distance of the `fixes` from the filter's prediction, 6 where noise is all there is;
    `d2_before` with the rotation that the recording was made with.
    """

    rotation_deg: tuple[float, float, float]
    sigma_deg: Array
    fixes: int
    d2: float
    d2_before: float


def find(raw: Recording, known: ImuCalibration, progress: Callable[[], object]) -> Mounting:
    """The rotation with which the filter predicts the fixes of a drive best.

    `raw`: with samples as the IMU gave them; `known`: the rest of its calibration. Innovations, over their expected
    size, are the residuals of a least-squares fit; biases, camera delay and floor tilt are the filter's own concern.
    Motion is free: that the robot stays upright would be believed of a crooked IMU too. Raises CalibrationError for a
    drive that does not tell.
    """
    params = FilterParams(adaptation=0.0)
    place = {(fix.t, fix.arrival): i for i, fix in enumerate(raw.fixes)}

    def innovations(body_from_imu: Array) -> tuple[Array, float]:
        """Over their sigmas (n, 6), and the mean d2."""
        progress()
        calibration = msgspec.structs.replace(known, rotation_deg=deg_from_rotation(body_from_imu))
        samples = BodyReadings(calibration)(raw.samples)
        _, outcomes, _ = replay(raw._replace(samples=samples), Localiser(raw.name, params, "free"))
        y = np.zeros((len(raw.fixes), 6))
        for outcome in outcomes:
            y[place[outcome.t, outcome.arrival]] = outcome.innovation / outcome.innovation_sigma
        d2 = [min(outcome.d2, MOST_D2) for outcome in outcomes if math.isfinite(outcome.d2)]
        if len(d2) < FEWEST_FIXES:
            raise CalibrationError(
                f"{raw.name}: {len(d2)} fixes that the IMU leads from one to the next; {FEWEST_FIXES} are needed, of a "
                "minute's drive"
            )
        return np.clip(np.nan_to_num(y), -MOST_SIGMAS, MOST_SIGMAS), float(np.mean(d2))

    norm = float(np.median(np.linalg.norm(raw.samples[:, 4:], axis=1)))
    if not 0.5 * GRAVITY < norm < 2.0 * GRAVITY:
        check_gravity(norm)
    # Upright on the mean, as it drives; then all round.
    up = np.median(raw.samples[:, 4:], axis=0)
    upright = Rotation.align_vectors(np.array([[0.0, 0.0, 1.0]]), up[np.newaxis])[0].as_matrix()
    start = min(
        (rotation_about_z(2.0 * math.pi * i / YAWS) @ upright for i in range(YAWS)), key=lambda R: innovations(R)[1]
    )

    def residuals(turn: Array) -> Array:
        return innovations(exp_so3(turn) @ start)[0].ravel()

    def jacobian(turn: Array) -> Array:
        # 1e-3 rad: far above what rounding does to a filter, far below what a gate notices
        return np.column_stack([(residuals(turn + s) - residuals(turn - s)) / 2e-3 for s in 1e-3 * np.eye(3)])

    solved = least_squares(residuals, np.zeros(3), jac=jacobian, loss="soft_l1", xtol=1e-5, ftol=1e-6)
    found = exp_so3(solved.x) @ start
    # Where the fixes' noise is understated the residuals say by how much.
    scale = max(1.0, 2.0 * solved.cost / len(solved.fun))
    return Mounting(
        deg_from_rotation(found),
        np.degrees(np.sqrt(scale * np.diag(np.linalg.inv(solved.jac.T @ solved.jac + ANYHOW * np.eye(3))))),
        len(raw.fixes),
        innovations(found)[1],
        innovations(rotation_from_deg(known.rotation_deg))[1],
    )


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the command's arguments."""
    parser.add_argument("recording", type=Path, help="folder with imu.csv and fixes.csv of one robot's drive")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of TOML")


def run(args: argparse.Namespace) -> int:
    """Runs the command. Raises CalibrationError where the drive does not tell, and RecordingError."""
    folders = robot_folders(args.recording)
    if len(folders) > 1:
        names = ", ".join(str(folder) for folder in folders)
        raise CalibrationError(f"{args.recording}: several robots; name one of {names}")
    known = load_calibration(folders[0])
    raw = load(folders[0], calibration=ImuCalibration())
    compile_filter()
    with tqdm(unit=" replays", delay=1.0, leave=False, disable=None) as bar:
        found = find(raw, known, bar.update)
    worst = float(found.sigma_deg.max())
    if found.d2 > POOR_D2:
        raise CalibrationError(
            f"{raw.name}: no rotation fits: the fixes are {math.sqrt(found.d2 / 6.0):.1f} times as far from the "
            "prediction as expected. Are units and axes those of one right-handed IMU, and do both clocks agree?"
        )
    if worst > UNKNOWN_DEG:
        raise CalibrationError(
            f"{raw.name}: the drive shows the rotation to {min(worst, 180.0):.0f} deg only; drive a minute of curves, "
            "with changes of speed, where the camera sees"
        )
    if worst > POOR_DEG:
        print(f"steadfix: known to {worst:.1f} deg only; a longer drive with more curves tells more", file=sys.stderr)
    print(json.dumps(found._asdict(), default=np.ndarray.tolist) if args.json else _text(raw, found))
    return 0


def _text(raw: Recording, found: Mounting) -> str:
    """A table in comments, and the key for the configuration."""
    roll, pitch, yaw = (round(angle, 3) + 0.0 for angle in found.rotation_deg)
    sigma = " ".join(f"{s:.2f}" for s in found.sigma_deg)
    lines = [
        f"{raw.name}: {found.fixes} fixes in {np.ptp(raw.samples[:, 0]):.0f} s",
        f"roll, pitch, yaw known to +- {sigma} deg about the robot's x, y, z",
        f"mean d2 of the fixes {found.d2:.1f}, with the configured rotation {found.d2_before:.1f}; noise makes 6",
    ]
    key = toml_lines(ImuCalibration(rotation_deg=(roll, pitch, yaw))) or ["rotation_deg = [0.0, 0.0, 0.0]"]
    return "\n".join([*(f"# {line}" for line in lines), "[robot.imu]", *key])
