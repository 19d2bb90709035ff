"""Recording folders: inputs as CSV, one folder a robot, so that a run can be done again.

    imu.csv     t_s,gx,gy,gz,ax,ay,az            rad/s and m/s2; optional arrival_s
    imu.toml    position_m, rotation_deg, ...    optional: how imu.csv, which is what the IMU read, becomes readings at
                the body's origin along its axes, as `imu.mounting` says; without it imu.csv holds those
    fixes.csv   t_s,arrival_s,x,y,z,qw,qx,qy,qz  world_from_body at t_s; optional sigma_position,sigma_attitude
                (m, rad), or what a camera knows more: misfit, source, markers (ids, with spaces between), cov_00 ...
                cov_55 (upper triangle of the covariance as in `fusion.measurements`), sys_00 ... sys_55 (of its
                systematic part), and a second hypothesis with the same columns headed alt_
    wheels.csv  t_s,speed,yaw_rate,arrival_s      optional: m/s forward and rad/s to the left, empty where not known
    truth.csv   t_s,x,y,z,qw,qx,qy,qz            optional, never an input
    poses.tum   t x y z qx qy qz qw              what was published live, one line an IMU sample (TUM format)

Without arrival_s an IMU sample counts as arrived at its stamp. Numbers are written with all their digits: a replay
gives the same poses to the last bit.
"""

from __future__ import annotations

import csv
import math
import tomllib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple, TextIO

import msgspec
import numpy as np

from fusion.measurements import Array, ImuBatch, MeasurementError, PoseFix, PoseHypothesis, WheelOdometry
from fusion.params import FilterParams
from imu.mounting import BodyReadings, ImuCalibration, toml_lines

IMU_COLUMNS = ("t_s", "gx", "gy", "gz", "ax", "ay", "az")
WHEEL_COLUMNS = ("t_s", "speed", "yaw_rate", "arrival_s")
POSE_COLUMNS = ("x", "y", "z", "qw", "qx", "qy", "qz")
TRUTH_COLUMNS = ("t_s", *POSE_COLUMNS)
UPPER = [(i, j) for i in range(6) for j in range(i, 6)]
COVARIANCE_COLUMNS = tuple(f"cov_{i}{j}" for i, j in UPPER)
SYSTEMATIC_COLUMNS = tuple(f"sys_{i}{j}" for i, j in UPPER)
HYPOTHESIS_COLUMNS = (*POSE_COLUMNS, "misfit", *COVARIANCE_COLUMNS, *SYSTEMATIC_COLUMNS)
FIX_COLUMNS = (
    "t_s",
    "arrival_s",
    *HYPOTHESIS_COLUMNS,
    "source",
    "markers",
    *(f"alt_{name}" for name in HYPOTHESIS_COLUMNS),
)


class RecordingError(ValueError):
    """A recording that cannot be replayed. The text names file and line, what was found and what would be right."""


class Recording(NamedTuple):
    """What one robot's folder holds.

    `samples` (n, 7) as in `ImuBatch`, of the body, in order of arrival; `arrival` (n,) s; `fixes` in order of arrival;
    `truth` (m, 8): t, position, quaternion wxyz, or None. `wheels` in order of arrival.
    """

    name: str
    samples: Array
    arrival: Array
    fixes: list[PoseFix]
    truth: Array | None
    wheels: tuple[WheelOdometry, ...] = ()


def robot_folders(folder: Path) -> list[Path]:
    """The folder itself if it holds an imu.csv, else its subfolders that do. Raises RecordingError if there is none."""
    if not folder.is_dir():
        what = "is no folder" if folder.exists() else "no such folder"
        raise RecordingError(f"{folder}: {what}; a recording is a folder with imu.csv and fixes.csv")
    if (folder / "imu.csv").is_file():
        return [folder]
    found = sorted(path.parent for path in folder.glob("*/imu.csv"))
    if not found:
        raise RecordingError(f"{folder}: neither it nor a folder in it holds an imu.csv")
    return found


def load_calibration(folder: Path) -> ImuCalibration:
    """What a robot's folder says of its IMU. Raises RecordingError."""
    path = folder / "imu.toml"
    try:
        return msgspec.convert(tomllib.loads(path.read_text(encoding="utf-8")), ImuCalibration)
    except FileNotFoundError:
        return ImuCalibration()
    except OSError as error:
        raise RecordingError(f"{path}: {error.strerror or error}") from None
    except (ValueError, RecursionError) as error:
        raise RecordingError(f"{path}: {error}") from None


def load(folder: Path, params: FilterParams | None = None, calibration: ImuCalibration | None = None) -> Recording:
    """Read and check one robot's folder. Raises RecordingError.

    Fixes without a covariance get that of `params`. `calibration` is taken instead of the recording's own.
    """
    params = params or FilterParams()
    to_body = BodyReadings(load_calibration(folder) if calibration is None else calibration)
    imu_path = folder / "imu.csv"
    names = _header(imu_path, IMU_COLUMNS)
    table = _numbers(imu_path, names, (*IMU_COLUMNS, *(["arrival_s"] if "arrival_s" in names else [])))
    if not len(table):
        raise RecordingError(f"{imu_path}: no sample after the header")
    clock = "arrival_s" if "arrival_s" in names else "t_s"
    arrival = np.ascontiguousarray(table[:, -1] if clock == "arrival_s" else table[:, 0])
    _must_rise(imu_path, clock, arrival)
    truth = None
    if (folder / "truth.csv").exists():
        truth = _numbers(folder / "truth.csv", _header(folder / "truth.csv", TRUTH_COLUMNS), TRUTH_COLUMNS)
        _must_rise(folder / "truth.csv", "t_s", truth[:, 0])
    fixes = _load_fixes(folder / "fixes.csv", params)
    if not fixes:
        raise RecordingError(f"{folder / 'fixes.csv'}: no fix after the header; without one there is no start")
    name, samples = folder.resolve().name, to_body(np.ascontiguousarray(table[:, :7]))
    return Recording(name, samples, arrival, fixes, truth, _load_wheels(folder / "wheels.csv", name))


def _load_wheels(path: Path, robot: str) -> tuple[WheelOdometry, ...]:
    """Readings that arrived together are one."""
    if not path.exists():
        return ()
    columns = [_header(path, WHEEL_COLUMNS).index(name) for name in WHEEL_COLUMNS]
    rows: list[list[float]] = []
    for line, row in _rows(path):
        cells = [row[column] if column < len(row) else None for column in columns]
        known = [
            name in ("t_s", "arrival_s") or cell not in (None, "")
            for name, cell in zip(WHEEL_COLUMNS, cells, strict=True)
        ]
        rows.append(
            [
                _number(path, line, name, cell) if there else math.nan
                for name, cell, there in zip(WHEEL_COLUMNS, cells, known, strict=True)
            ]
        )
        if not any(known[1:3]):
            raise RecordingError(f"{path}, line {line}: neither speed nor yaw_rate; at least one of the two is needed")
    table = np.array(rows).reshape(-1, len(WHEEL_COLUMNS))
    _must_rise(path, "arrival_s", table[:, 3])
    groups = np.split(table, np.flatnonzero(np.diff(table[:, 3])) + 1) if len(table) else []
    return tuple(WheelOdometry(robot, float(group[0, 3]), group[:, :3]) for group in groups)


def _open(path: Path) -> TextIO:
    try:
        return path.open(encoding="utf-8", newline="")
    except OSError as error:
        raise RecordingError(f"{path}: {error.strerror or error}") from None


def _header(path: Path, needed: Iterable[str]) -> list[str]:
    with _open(path) as file:
        try:
            names = [name.strip() for name in file.readline().lstrip("\ufeff").split(",")]
        except UnicodeDecodeError:
            raise RecordingError(f"{path}: this is no text file") from None
    missing = [name for name in needed if name not in names]
    if missing:
        raise RecordingError(
            f"{path}, line 1: no column {', '.join(missing)}; found {', '.join(names) or 'nothing'}; "
            f"needed are {', '.join(needed)}"
        )
    return names


def _numbers(path: Path, names: list[str], wanted: Sequence[str]) -> Array:
    """The wanted columns as (n, m) finite numbers."""
    columns = [names.index(name) for name in wanted]
    try:
        with _open(path) as file:
            file.readline()
            body = file.tell()
            if not file.read(100).strip():
                return np.empty((0, len(wanted)))
            file.seek(body)
            table = np.loadtxt(file, delimiter=",", usecols=columns, ndmin=2, comments=None)
        if np.isfinite(table).all():
            return table.reshape(-1, len(wanted))
    except (ValueError, IndexError):
        pass  # said with its line below
    for line, row in _rows(path):
        for name, column in zip(wanted, columns, strict=True):
            _number(path, line, name, row[column] if column < len(row) else None)
    raise RecordingError(f"{path}: cannot be read as numbers")


def _rows(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Line number and cells of each line after the header that is not empty."""
    with _open(path) as file:
        try:
            for line, row in enumerate(csv.reader(file), start=1):
                if line > 1 and row:
                    yield line, row
        except UnicodeDecodeError:
            raise RecordingError(f"{path}: this is no text file") from None
        except csv.Error as error:
            raise RecordingError(f"{path}: cannot be read as CSV: {error}") from None


def _number(path: Path, line: int, name: str, text: str | None, above: float = -math.inf) -> float:
    if text is None:
        raise RecordingError(f"{path}, line {line}: no value for {name}, the line is too short")
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and value > above):
        found = text.strip() or "empty"
        found = found if len(found) <= 60 else found[:57] + "..."
        needed = "a finite number" + (f" above {above:g}" if math.isfinite(above) else "")
        raise RecordingError(f"{path}, line {line}: {name} is {found!r}, {needed} is needed")
    return value


def _ids(path: Path, line: int, text: str) -> tuple[int, ...]:
    try:
        return tuple(map(int, text.split()))
    except ValueError:
        raise RecordingError(f"{path}, line {line}: markers is {text!r}, ids with spaces between are needed") from None


def _must_rise(path: Path, name: str, t: Array) -> None:
    falls = np.flatnonzero(np.diff(t) < 0.0)
    if falls.size:
        row = int(falls[0])
        line, _ = next(islice(_rows(path), row + 1, None))
        raise RecordingError(
            f"{path}, line {line}: {name} runs backwards, {t[row + 1]:.6f} after {t[row]:.6f}; "
            "it must not fall from line to line"
        )


def _load_fixes(path: Path, params: FilterParams) -> list[PoseFix]:
    names = _header(path, ("t_s", "arrival_s", *POSE_COLUMNS))
    fixes = []
    for line, row in _rows(path):
        # a column that is not there, or empty, is absent
        cells = {name: text for name, text in zip(names, row, strict=False) if text.strip()}

        def number(name: str, above: float = -math.inf, line: int = line, cells: dict[str, str] = cells) -> float:
            return _number(path, line, name, cells.get(name), above)

        try:
            hypotheses = [_hypothesis(cells, number, "", params)]
            if "alt_x" in cells:
                hypotheses.append(_hypothesis(cells, number, "alt_", params))
            source = cells.get("source", "").strip()
            markers = _ids(path, line, cells.get("markers", ""))
            fix = PoseFix("", number("t_s"), number("arrival_s"), tuple(hypotheses), source, markers)
        except MeasurementError as error:
            raise RecordingError(f"{path}, line {line}: {error}") from None
        fixes.append(fix)
    return sorted(fixes, key=lambda fix: fix.arrival)


def _hypothesis(cells: dict[str, str], number: Any, head: str, params: FilterParams) -> PoseHypothesis:
    covariance, systematic = np.zeros((6, 6)), np.zeros((6, 6))
    for matrix, names in ((covariance, COVARIANCE_COLUMNS), (systematic, SYSTEMATIC_COLUMNS)):
        if head + names[0] in cells:
            for (i, j), name in zip(UPPER, names, strict=True):
                matrix[i, j] = matrix[j, i] = number(head + name)
    if f"{head}cov_00" not in cells:
        position = number("sigma_position", 0.0) if "sigma_position" in cells else params.fix_position_sigma
        attitude = number("sigma_attitude", 0.0) if "sigma_attitude" in cells else params.fix_attitude_sigma
        np.fill_diagonal(covariance, [position**2] * 3 + [attitude**2] * 3)
    pose = [number(head + name) for name in POSE_COLUMNS]
    misfit = number(f"{head}misfit") if f"{head}misfit" in cells else 0.0
    return PoseHypothesis(np.array(pose[:3]), np.array(pose[3:]), covariance, misfit, systematic)


def write_tum(path: Path, track: Array) -> None:
    """A track (n, 8) with quaternions wxyz as TUM lines `t x y z qx qy qz qw`, without rows that are not finite."""
    rows = track[np.isfinite(track).all(axis=1)][:, [0, 1, 2, 3, 5, 6, 7, 4]]
    with path.open("w", encoding="ascii") as file:
        file.writelines(" ".join(map(repr, row)) + "\n" for row in rows.tolist())


class Recorder:
    """Writes a recording folder with a folder for each robot, as things arrive.

    What is fed must be recorded in the order in which it is fed, with the `arrival` of that moment. Each line is in
    the file by the end of the second. `calibrations`: of the robots' IMUs, by name; who is absent has a perfect one.
    Raises RecordingError if the folder holds a recording already, OSError if it cannot be made.
    """

    def __init__(
        self, folder: Path, robots: Iterable[str], calibrations: Mapping[str, ImuCalibration] | None = None
    ) -> None:
        self._folder = folder
        self._files: dict[tuple[str, str], TextIO] = {}
        for robot in robots:
            if (folder / robot / "imu.csv").exists():
                raise RecordingError(f"{folder / robot}: holds a recording already; name a new folder")
            for file, columns in (("imu.csv", (*IMU_COLUMNS, "arrival_s")), ("fixes.csv", FIX_COLUMNS)):
                self._write(robot, file, columns)
        for robot, calibration in (calibrations or {}).items():
            if lines := toml_lines(calibration):
                (folder / robot / "imu.toml").write_text("\n".join(lines) + "\n", encoding="utf-8")

    def _write(self, robot: str, name: str, values: Iterable[Any], separator: str = ",") -> None:
        file = self._files.get((robot, name))
        if file is None:
            (self._folder / robot).mkdir(parents=True, exist_ok=True)
            file = self._files[robot, name] = (self._folder / robot / name).open("w", encoding="utf-8", buffering=1)
        file.write(separator.join(value if isinstance(value, str) else repr(float(value)) for value in values) + "\n")

    def imu(self, batch: ImuBatch) -> None:
        """The samples of a batch, as the IMU gave them."""
        for row in batch.samples.tolist():
            self._write(batch.robot, "imu.csv", (*row, batch.arrival))

    def wheels(self, odometry: WheelOdometry) -> None:
        """Readings of the wheels."""
        if (odometry.robot, "wheels.csv") not in self._files:
            self._write(odometry.robot, "wheels.csv", WHEEL_COLUMNS)
        for row in odometry.samples.tolist():
            cells = ["" if math.isnan(value) else value for value in row]
            self._write(odometry.robot, "wheels.csv", (*cells, odometry.arrival))

    def fix(self, fix: PoseFix) -> None:
        """A fix with all that it knows."""
        cells: list[Any] = [fix.t, fix.arrival]
        origin = fix.source.replace(",", " "), " ".join(map(str, fix.markers))
        for i, hypothesis in enumerate(fix.hypotheses):
            if i == 1:
                cells += origin
            cells += [*hypothesis.position, *hypothesis.quaternion_wxyz, hypothesis.misfit]
            cells += [matrix[at] for matrix in (hypothesis.covariance, hypothesis.systematic) for at in UPPER]
        if len(fix.hypotheses) == 1:
            cells += [*origin, *([""] * len(HYPOTHESIS_COLUMNS))]
        self._write(fix.robot, "fixes.csv", cells)

    def track(self, robot: str, track: Array) -> None:
        """The poses (n, 8) after each IMU sample, as `Localiser.feed` gives them."""
        for row in track[np.isfinite(track).all(axis=1)][:, [0, 1, 2, 3, 5, 6, 7, 4]].tolist():
            self._write(robot, "poses.tum", row, " ")

    def truth(self, robot: str, t: float, position: Array, quaternion_wxyz: Array) -> None:
        """The true pose at t, where it is known."""
        if (robot, "truth.csv") not in self._files:
            self._write(robot, "truth.csv", TRUTH_COLUMNS)
        self._write(robot, "truth.csv", (t, *position, *quaternion_wxyz))

    def close(self) -> None:
        """Close all files."""
        for file in self._files.values():
            file.close()
        self._files.clear()
