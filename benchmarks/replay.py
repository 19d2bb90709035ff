"""What the IMU and the filter are worth on one recording, and how fast it is replayed.

    python -m benchmarks.replay [RECORDING] [--motion free]

Causal errors against truth at every IMU sample, of what one has at that moment. Without RECORDING it is
`handheld_mocap` from STEADFIX_DATA or ../shared/data, or a simulated robot where that is not there.
"""

from __future__ import annotations

import argparse
import math
import os
import statistics
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import get_args

import numpy as np
from filterpy.kalman import KalmanFilter
from scipy.spatial.transform import Rotation

from fusion.consistency import TrackError, hold_last, track_error
from fusion.localiser import Localiser, warm_up
from fusion.measurements import Array
from fusion.params import Engine, FilterParams, Motion
from fusion.simulator import figure_eight, simulate
from server.recording import Recording, RecordingError, load
from server.replay import replay

RUNS = 7
# s: filterpy's share of the recording, since all of it would take many seconds.
PART = 30.0


def without_imu(recording: Recording, accel_noise: float, rate_noise: float, slowing: float = math.inf) -> Array:
    """(n, 8): a Kalman filter on the fixes alone, as a track at each IMU sample.

    State: position, rotation vector since the last fix, velocity, angular rate, all in world axes and driven by white
    noise of `accel_noise` m/s2/sqrt(Hz) and `rate_noise` rad/s2/sqrt(Hz). Velocity and rate are constant, or fade with
    the time constant `slowing` in s. Delay is dealt with: the filter stands at the newest fix's capture, and a pose is
    predicted from there to the sample.
    """

    def reach(dt: Array | float) -> Array:
        """s: how far a velocity carries in dt, as a share of it."""
        return np.asarray(dt if math.isinf(slowing) else slowing * -np.expm1(-np.asarray(dt) / slowing))

    kf = KalmanFilter(dim_x=12, dim_z=6)
    kf.H = np.eye(6, 12)
    drive = np.diag([accel_noise**2] * 3 + [rate_noise**2] * 3)
    attitude = Rotation.identity()
    t = -math.inf
    track = np.full((len(recording.samples), 8), np.nan)
    track[:, 0] = recording.samples[:, 0]
    arrivals = [fix.arrival for fix in recording.fixes]
    ends = np.searchsorted(recording.arrival, [*arrivals[1:], math.inf])
    for fix, start, end in zip(recording.fixes, np.searchsorted(recording.arrival, arrivals), ends, strict=True):
        pose = fix.hypotheses[0]
        seen = Rotation.from_quat(pose.quaternion_wxyz, scalar_first=True)
        if t == -math.inf:
            kf.x = np.concatenate([pose.position, np.zeros(9)])
            kf.P = np.diag([0.0] * 6 + [1.0] * 6)
            kf.P[:6, :6] = pose.covariance
            attitude, t = seen, fix.t
        elif fix.t > t:  # one overtaken by a newer fix says little more, and would have to be put in its place
            dt = fix.t - t
            kf.predict(
                F=np.block(
                    [[np.eye(6), reach(dt) * np.eye(6)], [np.zeros((6, 6)), math.exp(-dt / slowing) * np.eye(6)]]
                ),
                Q=np.block([[dt**3 / 3.0 * drive, dt**2 / 2.0 * drive], [dt**2 / 2.0 * drive, dt * drive]]),
            )
            attitude = Rotation.from_rotvec(kf.x[3:6]) * attitude
            kf.x[3:6] = 0.0
            kf.update(np.concatenate([pose.position, (seen * attitude.inv()).as_rotvec()]), R=pose.covariance)
            attitude = Rotation.from_rotvec(kf.x[3:6]) * attitude
            kf.x[3:6] = 0.0
            t = fix.t
        if end > start:
            ahead = reach(track[start:end, 0] - t)[:, np.newaxis]
            track[start:end, 1:4] = kf.x[:3] + ahead * kf.x[6:9]
            turned = Rotation.from_rotvec(ahead * kf.x[9:]) * attitude
            track[start:end, 4:] = turned.as_quat(scalar_first=True)
    return track


def best_without_imu(
    recording: Recording, error: Callable[[Array], TrackError], times: Sequence[float]
) -> tuple[TrackError, str]:
    """That filter at its best: for position and for attitude with the noise and slowing that hindsight chooses."""
    settings = [(noise, slowing) for slowing in times for noise in np.logspace(-2.0, 2.0, 9)]
    errors = [error(without_imu(recording, noise, noise, slowing)) for noise, slowing in settings]
    p = int(np.argmin([e.position_rmse for e in errors]))
    a = int(np.argmin([e.attitude_rmse for e in errors]))
    chosen = [f"{settings[i][0]:.2g} {unit}/s2/rtHz" for i, unit in ((p, "m"), (a, "rad"))]
    if len(times) > 1:
        chosen = [f"{text} and {settings[i][1]:g} s" for text, i in zip(chosen, (p, a), strict=True)]
    return TrackError(errors[p].t, errors[p].position, errors[a].attitude), "in hindsight " + ", ".join(chosen)


def first(recording: Recording, seconds: float) -> Recording:
    """The beginning of a recording."""
    end = recording.arrival[0] + seconds
    n = int(np.searchsorted(recording.arrival, end))
    return recording._replace(
        samples=recording.samples[:n],
        arrival=recording.arrival[:n],
        fixes=[fix for fix in recording.fixes if fix.arrival < end],
    )


def timed_replay(recording: Recording, motion: Motion, engine: Engine, runs: int) -> tuple[Array, list[float]]:
    """The track, and the seconds that each run took."""
    taken = []
    for _ in range(runs):
        track, _, seconds = replay(recording, Localiser(recording.name, FilterParams(), motion, engine))
        taken.append(seconds)
    return track, taken


def find(folder: Path | None) -> Recording:
    """The recording to use. Raises RecordingError, also for one without truth."""
    if folder is None:
        data = Path(os.environ.get("STEADFIX_DATA", Path(__file__).parents[1] / "../shared/data"))
        folder = data / "handheld_mocap"
        if not folder.is_dir():
            simulation = simulate(figure_eight(), seed=1)
            return Recording("simulated", simulation.samples, simulation.arrival, simulation.fixes, simulation.truth)
    recording = load(folder)
    if recording.truth is None:
        raise RecordingError(f"{folder}: without a truth.csv there is nothing to compare with")
    return recording


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.replay", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("recording", nargs="?", type=Path, help="one robot's folder, with truth.csv")
    parser.add_argument("--motion", choices=get_args(Motion), default="free")
    args = parser.parse_args()
    try:
        recording = find(args.recording)
    except RecordingError as problem:
        parser.error(str(problem))
    truth = recording.truth
    assert truth is not None

    def error(track: Array) -> TrackError:
        return track_error(track, truth)

    def line(name: str, e: TrackError, text: str = "") -> None:
        print(f"{name:<30}{1e3 * e.position_rmse:8.1f} mm{math.degrees(e.attitude_rmse):8.2f} deg  {text}")

    span = float(np.ptp(recording.samples[:, 0]))
    print(
        f"{recording.name}: {span:.0f} s, {len(recording.samples)} IMU samples, {len(recording.fixes)} fixes; "
        f"motion {args.motion}; causal RMSE"
    )
    warm_up()
    track, taken = timed_replay(recording, args.motion, "numba", RUNS)
    speed = span / statistics.median(taken)
    line("Steadfix", error(track), f"{speed:7.0f} x real time, median of {RUNS} runs")
    part = first(recording, PART)
    slow, taken = timed_replay(part, args.motion, "filterpy", 1)
    slow_speed = float(np.ptp(part.samples[:, 0])) / taken[0]
    line(f"Steadfix, first {PART:.0f} s", error(track[: len(slow)]))
    line("  and on the engine filterpy", error(slow), f"{slow_speed:7.1f} x real time")
    line("constant velocity, no IMU", *best_without_imu(recording, error, [math.inf]))
    line("slowing velocity, no IMU", *best_without_imu(recording, error, [0.03, 0.1, 0.3, 1.0, 3.0]))
    fixes = [(fix.t, *fix.hypotheses[0].position, *fix.hypotheses[0].quaternion_wxyz) for fix in recording.fixes]
    arrival = np.array([fix.arrival for fix in recording.fixes])
    line("holding the last fix", error(hold_last(np.array(fixes), arrival, track[:, 0])))


if __name__ == "__main__":
    main()
