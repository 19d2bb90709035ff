"""What the filter costs and how right it is, beside what one would otherwise take for the same task.

    python -m benchmarks.fusion [--seeds 12] [--seconds 120] [--quick]

The task: a figure-eight with stops, a good MEMS IMU at 200 Hz, two fixes a second of 5 mm and 1 deg that come 100 to
300 ms late;
each estimator is told the true noise. Steadfix comes in two ways: with the model that all share (free motion, fifteen
errors), and as it is by default, which also looks for errors of clock, floor and noise that are not there, and for
rest, which is. Each gives a pose for every IMU sample from what has arrived by then, and what it takes to write that
pose out is in its time. Errors are medians over the seeds of the RMSE of each, without the first 10 s; rows of fewer
seeds have other medians.

Times are CPU time, so that neighbours on the machine count little: medians over the seeds, all estimators in turn on
each. IMU samples are pushed by a call for each ("one"), for ten, or for all between two fixes ("many"); what has no
call for several is timed with one. A fix's time is from its arrival until the pose is that of now again: it is put in
its place, and the samples since its capture, 40 on the mean, are done again. `x real time` is for a whole recording
with the largest calls, `robots a core` those that a core carries live with calls of ten. `x filterpy` compares both
with the plain filterpy filter on the same seeds.

What is not installed is named and left out. The project needs none of it but filterpy; to compare with all, make a
second environment outside the repository, from requirements.lock and the packages `stonesoup`, `gtsam` and
`robotpy-wpimath`, and run the command with its Python in the repository's root.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import importlib.util
import math
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from benchmarks import peers
from benchmarks.peers import IMU, PARAMS, TRUE, Estimator
from fusion.consistency import interpolate, rms
from fusion.localiser import Localiser, warm_up
from fusion.measurements import Array
from fusion.params import Engine, FilterParams, Motion
from fusion.simulator import Simulation, figure_eight, simulate

SETTLED = 10.0  # s
SLOW_SEEDS = 4  # of what takes seconds for each
ONE, TEN, MANY = 1, 10, 1_000_000  # samples a call


def steadfix(motion: Motion, engine: Engine, params: FilterParams, _: Simulation) -> Estimator:
    robot: Any = Localiser("robot", params, motion, engine)
    robot.imu, robot.fix = robot.feed_samples, robot.feed
    return robot  # type: ignore[no-any-return]


class Result(NamedTuple):
    """Of one row on one seed: RMSE in m and rad, CPU seconds for all samples by size of call, and for all fixes."""

    xy: float
    xyz: float
    yaw: float
    imu: dict[int, float]
    fix: dict[int, float]

    def total(self, size: int) -> float:
        return self.imu[size] + self.fix[size]


@dataclass
class Row:
    """A line of the table. `make` gives an estimator, or at once a track: `sizes` is empty then."""

    name: str
    make: Callable[[Simulation], Any]
    package: str = "numpy"
    sizes: tuple[int, ...] = (ONE,)
    seeds: int = 1000
    planar: bool = False
    results: list[Result] = field(default_factory=list)

    @property
    def installed(self) -> bool:
        return importlib.util.find_spec(self.package) is not None

    def run(self, simulation: Simulation) -> None:
        imu, fix = {}, {}
        for size in self.sizes:
            track, imu[size], fix[size] = live(simulation, self.make(simulation), size)
        if not self.sizes:
            began = time.process_time()
            track = self.make(simulation)
            imu[MANY], fix[MANY] = time.process_time() - began, 0.0
        self.results.append(Result(*errors(track, simulation), imu, fix))

    def line(self, plain: list[Result], simulation: Simulation) -> str:
        """The medians, and ratios to `plain`; all simulations had the length of `simulation`."""
        if not self.installed:
            return f"{self.name:<36}not installed"
        samples, fixes, seconds = len(simulation.samples), len(simulation.fixes), simulation.samples[-1, 0]

        def median(digits: int, of: Callable[[Result], float]) -> str:
            return f"{statistics.median(of(result) for result in self.results):.{digits}f}"

        def ratio(size: int) -> str:
            pairs = zip(self.results, plain, strict=False)
            return f"{statistics.median(p.total(ONE) / r.total(size) for r, p in pairs):.2f}"

        # the largest calls that it takes, up to ten and any
        ten, most = (size if size in self.sizes else ONE for size in (TEN, MANY))

        def each(size: int) -> str:
            return median(2, lambda r: 1e6 * r.imu[size] / samples) if size in self.sizes else ""

        cells = [str(len(self.results)), each(ONE), each(TEN), each(MANY)]
        if self.sizes:
            cells += [
                median(1, lambda r: 1e6 * r.fix[most] / fixes),
                median(0, lambda r: seconds / r.total(most)),
                median(0, lambda r: seconds / r.total(ten)),
                ratio(ten),
                ratio(most),
            ]
        else:
            cells += ["", median(0, lambda r: seconds / r.total(MANY)), "", "", ""]
        cells += [
            median(2, lambda r: 1e3 * r.xy),
            "" if self.planar else median(2, lambda r: 1e3 * r.xyz),
            median(3, lambda r: math.degrees(r.yaw)),
        ]
        return f"{self.name:<36}" + columns(cells)


def columns(cells: list[str]) -> str:
    return "".join(f"{cell:>{w}}" for cell, w in zip(cells, (5, 8, 8, 8, 9, 9, 8, 8, 8, 8, 8, 9), strict=True))


def live(simulation: Simulation, estimator: Estimator, size: int) -> tuple[Array, float, float]:
    """All measurements in order of arrival, at most `size` samples a call. -> track, CPU s of samples, of fixes."""
    samples, track = simulation.samples, np.full((len(simulation.samples), 8), np.nan)
    track[:, 0] = samples[:, 0]
    stops = np.searchsorted(simulation.arrival, [fix.arrival for fix in simulation.fixes]).tolist()
    imu = fixes = 0.0
    at = 0
    for fix, stop in zip([*simulation.fixes, None], [*stops, len(samples)], strict=True):
        calls = [(samples[i : min(i + size, stop)], track[i : min(i + size, stop)]) for i in range(at, stop, size)]
        began = time.process_time()
        for call in calls:
            estimator.imu(*call)
        between = time.process_time()
        if fix is not None:
            estimator.fix(fix)
        fixes += time.process_time() - between
        imu += between - began
        at = stop
    return track, imu, fixes


def errors(track: Array, simulation: Simulation) -> tuple[float, float, float]:
    """RMSE in the plane and in space, m, and of yaw, rad."""
    track = track[(track[:, 0] >= SETTLED) & np.isfinite(track[:, 1])]
    truth = interpolate(simulation.truth, track[:, 0])
    off = track[:, 1:4] - truth[:, 1:4]
    turned = yaw(track) - yaw(truth)
    return (
        rms(np.linalg.norm(off[:, :2], axis=1)),
        rms(np.linalg.norm(off, axis=1)),
        rms(np.arctan2(np.sin(turned), np.cos(turned))),
    )


def yaw(track: Array) -> Array:
    w, x, y, z = track[:, 4:].T
    angle: Array = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return angle


ALL = (ONE, TEN, MANY)
PLAIN = Row("plain filterpy", peers.filterpy, "filterpy")
ROWS = [
    Row("Steadfix, the others' model", partial(steadfix, "free", "numba", PARAMS), sizes=ALL),
    Row("Steadfix, free", partial(steadfix, "free", "numba", TRUE), sizes=ALL),
    Row("Steadfix, ground", partial(steadfix, "ground", "numba", TRUE), sizes=ALL),
    Row("Steadfix, differential", partial(steadfix, "differential", "numba", TRUE), sizes=ALL),
    Row(
        "engine filterpy, the others' model",
        partial(steadfix, "free", "filterpy", PARAMS),
        "filterpy",
        seeds=SLOW_SEEDS,
    ),
    PLAIN,
    Row("Stone Soup", peers.stone_soup, "stonesoup", seeds=SLOW_SEEDS),
    Row("gtsam, ISAM2 fixed lag 3 s", peers.FixedLag, "gtsam"),
    Row(
        "WPILib, speed by IMU and fixes", partial(peers.Wpilib, wheels=False, ratio=(0.2, 10.0)), "wpimath", planar=True
    ),
    Row("WPILib, with wheels besides", partial(peers.Wpilib, wheels=True, ratio=(0.6, 10.0)), "wpimath", planar=True),
    Row("constant velocity, no IMU", peers.constant_velocity, sizes=()),
    Row("holding the last fix", peers.holding, sizes=()),
    Row("gtsam, batch: knows the future", peers.gtsam_batch, "gtsam", sizes=()),
]


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.fusion", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--seeds", type=int, default=12)
    parser.add_argument("--seconds", type=float, default=120.0, help="of each recording")
    parser.add_argument("--quick", action="store_true", help="2 seeds of 30 s")
    args = parser.parse_args()
    seeds, seconds = (2, 30.0) if args.quick else (args.seeds, args.seconds)
    if seeds < 1 or seconds < 2.0 * SETTLED:
        parser.error(f"at least one seed, and {2.0 * SETTLED:g} s")
    warm_up()
    rows = [row for row in ROWS if row.installed]
    short = simulate(figure_eight(), 0, SETTLED + 1.0, imu=IMU)
    for row in rows:  # what it loads or compiles at its first use is not what is measured
        row.run(short)
        row.results.clear()
    for seed in range(1, seeds + 1):
        simulation = simulate(figure_eight(), seed, seconds, imu=IMU)
        for row in rows:
            if seed <= row.seeds:
                row.run(simulation)
    names = {"wpimath": "robotpy-wpimath"}
    packages = dict.fromkeys(names.get(row.package, row.package) for row in rows)
    print(f"figure-eight of {seconds:g} s; CPU time; RMSE without the first {SETTLED:g} s; medians over seeds")
    print(", ".join(f"{name} {importlib.metadata.version(name)}" for name in packages), end="\n\n")
    print(f"{'':41}{'us per IMU sample':>24}{'us per':>9}{'x real':>9}{'robots':>8}{'x filterpy':>16}{'RMSE':>8}")
    units = ["seeds", "one", "of ten", "many", "fix", "time", "a core", "live", "replay", "xy mm", "3-D mm", "yaw deg"]
    print(" " * 36 + columns(units))
    for row in ROWS:
        print(row.line(PLAIN.results, simulation))


if __name__ == "__main__":
    main()
