"""`steadfix replay`: a recording through the filter in order of arrival, as it would have gone live."""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from pathlib import Path
from typing import Any, get_args

import numpy as np
from tqdm import tqdm

from fusion.consistency import hold_last, track_error
from fusion.health import Health
from fusion.localiser import Localiser
from fusion.measurements import Array, FixOutcome, Outcome, PoseFix, WheelOdometry
from fusion.params import Channel, Engine, FilterParams, Motion
from imu.mounting import ImuCalibration
from server import config
from server.compiling import compile_filter
from server.recording import Recording, RecordingError, load, robot_folders, write_tum

# s of the recording between two diagnoses: what is wrong in between only is to be told too.
DIAGNOSE_EVERY = 20.0

ACCEPTED = (Outcome.INITIALISED, Outcome.ACCEPTED, Outcome.INFLATED, Outcome.REINITIALISED)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The command's options."""
    parser.add_argument("recording", type=Path, help="folder with imu.csv and fixes.csv, or one of such folders")
    parser.add_argument("--out", type=Path, metavar="POSES", help="write a pose per IMU sample, in TUM format")
    parser.add_argument("--config", type=Path, metavar="FILE", help="motion model, noise and IMU mounting from here")
    parser.add_argument("--robot", metavar="NAME", help="which robot of the configuration it is")
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="a parameter of the filter, such as gyro_noise=0.002, as in [robot.filter]; may be given several times",
    )
    parser.add_argument("--engine", choices=get_args(Engine), help="default: the robot's, else numba")
    parser.add_argument("--motion", choices=get_args(Motion), help="default: the robot's, else ground")
    parser.add_argument(
        "--channel",
        choices=get_args(Channel),
        default="best",
        help="of the poses: the filter's (default), or jump-free",
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of the table")


def replay(
    recording: Recording,
    localiser: Localiser,
    progress: Any = None,
    health: Health | None = None,
    channel: Channel = "best",
) -> tuple[Array, list[FixOutcome], float]:
    """Feed a recording to a localiser in order of arrival, a fix or the wheels before a sample that arrives with it.

    -> the causal track (n, 8), a row per IMU sample in order of arrival: its stamp, position, quaternion wxyz, NaN
    before the first fix; the fixes' outcomes; the seconds that the filter took. `progress` is called with the number of
    samples done; `health` looks on.
    """
    track = np.full((len(recording.samples), 8), np.nan)
    outcomes: list[FixOutcome] = []
    inputs: list[PoseFix | WheelOdometry] = sorted(
        (*recording.fixes, *recording.wheels), key=lambda given: given.arrival
    )
    stops = np.searchsorted(recording.arrival, [given.arrival for given in inputs], side="left")
    at = 0
    took = 0.0

    def feed_samples(stop: int) -> None:
        nonlocal took
        began = time.perf_counter()
        localiser.feed_samples(recording.samples[at:stop], track[at:stop], channel)
        judged = localiser.judged()
        took += time.perf_counter() - began
        outcomes.extend(judged)
        if health is not None:
            health.judged(judged)
            health.sampled(recording.samples[at:stop], track[at:stop])

    due = recording.arrival[0] + DIAGNOSE_EVERY
    for given, stop in zip(inputs, stops, strict=True):
        if stop > at:
            feed_samples(int(stop))
            at = int(stop)
            if progress is not None:
                progress(at)
        if health is not None and isinstance(given, WheelOdometry):
            health.wheels(given)
        if health is not None and isinstance(given, PoseFix):
            health.arrived(given)
            if given.arrival >= due:
                health.diagnoses(given.arrival)
                due = given.arrival + DIAGNOSE_EVERY
        began = time.perf_counter()
        judged = localiser.feed(given)
        took += time.perf_counter() - began
        outcomes += judged
        if health is not None:
            health.judged(judged)
    feed_samples(len(recording.samples))
    if health is not None:
        health.diagnoses(_end(recording))
    return track, outcomes, took


def _end(recording: Recording) -> float:
    return max(float(recording.arrival[-1]), recording.fixes[-1].arrival if recording.fixes else -math.inf)


def summary(recording: Recording, health: Health, track: Array, outcomes: list[FixOutcome], took: float) -> Any:
    """What there is to say of a replay, as plain values; None where nothing can be said."""
    localiser = health.localiser
    began, end = float(recording.arrival[0]), _end(recording)
    span = float(np.ptp(recording.samples[:, 0]))
    counts = localiser.counts
    d2 = [outcome.d2 for outcome in outcomes if outcome.outcome in (Outcome.ACCEPTED, Outcome.INFLATED)]
    answer: dict[str, Any] = {
        "recording": recording.name,
        "motion": localiser.motion,
        "engine": localiser.engine,
        "duration_s": span,
        "ended_s": end - began,
        "samples": counts["imu_samples"],
        "samples_dropped": counts["imu_duplicates"] + counts["imu_late"],
        "fixes": len(recording.fixes),
        "fixes_accepted": sum(counts[outcome.name.lower()] for outcome in ACCEPTED),
        "fixes_rejected": counts["rejected"],
        "fixes_late": counts["too_late"],
        "outcomes": {outcome.name.lower(): counts[outcome.name.lower()] for outcome in Outcome if outcome},
        "resets": counts["reinitialised"],
        "nis_mean": float(np.mean(d2)) if d2 else None,
        "speed": span / took if took > 0.0 else None,
        **health.figures(end),
        "diagnoses": [
            {"code": diagnosis.code, "severity": diagnosis.severity, "text": diagnosis.text}
            | {"evidence": diagnosis.evidence, "from_s": since - began, "to_s": until - began}
            for since, until, diagnosis in health.said.values()
        ],
    }
    if recording.truth is not None:
        error = track_error(track, recording.truth)
        poses = [(fix.t, *fix.hypotheses[0].position, *fix.hypotheses[0].quaternion_wxyz) for fix in recording.fixes]
        held = hold_last(np.array(poses), np.array([fix.arrival for fix in recording.fixes]), track[:, 0])
        holding = track_error(held, recording.truth)
        answer |= {
            "truth_matched": len(error.t),
            "rmse_mm": 1e3 * error.position_rmse,
            "rmse_deg": math.degrees(error.attitude_rmse),
            "hold_last_mm": 1e3 * holding.position_rmse,
            "hold_last_deg": math.degrees(holding.attitude_rmse),
        }
        answer = {key: None if isinstance(v, float) and math.isnan(v) else v for key, v in answer.items()}
    return answer


def _table(s: Any) -> str:
    rows = [
        ("recording", f"{s['recording']}, {s['duration_s']:.1f} s, motion {s['motion']}, engine {s['engine']}"),
        ("IMU samples", f"{s['samples']}" + (f", {s['samples_dropped']} dropped" if s["samples_dropped"] else "")),
        (
            "fixes",
            f"{s['fixes']}: {s['fixes_accepted']} accepted, {s['fixes_rejected']} rejected, {s['fixes_late']} too late",
        ),
    ]
    if s["resets"]:
        rows.append(("resets", str(s["resets"])))
    if s.get("rmse_mm") is not None:
        rows.append(("RMSE", f"{s['rmse_mm']:.1f} mm, {s['rmse_deg']:.2f} deg over {s['truth_matched']} instants"))
        rows.append(("holding the last fix", f"{s['hold_last_mm']:.1f} mm, {s['hold_last_deg']:.2f} deg"))
    elif "rmse_mm" in s:
        rows.append(("RMSE", "no pose at an instant that the truth covers"))
    accuracy = s["accuracy"]
    if accuracy["fixes"]:
        half, most = ((accuracy[f"mm_{p}"], accuracy[f"deg_{p}"]) for p in ("p50", "p95"))
        text = f"half within {half[0]:.1f} mm, {half[1]:.2f} deg; 95 % within {most[0]:.1f} mm, {most[1]:.2f} deg"
        rows.append(("poses against fixes", text))
    if s["speed"]:
        rows.append(("speed", f"{s['speed']:.0f} x real time"))
    lines = [f"{name:<22}{text}" for name, text in rows]
    for diagnosis in s["diagnoses"]:
        when = "" if diagnosis["to_s"] >= s["ended_s"] else f" (last seen at {diagnosis['to_s']:.0f} s)"
        lines.append(f"{diagnosis['severity']:<22}{diagnosis['text']}{when}")
    return "\n".join(lines)


def _settings(args: argparse.Namespace, name: str) -> tuple[FilterParams, Motion, Engine, ImuCalibration | None]:
    params = FilterParams()
    imu: ImuCalibration | None = None
    motion: Motion = "ground"
    engine: Engine = "numba"
    if args.config is not None:
        robots = {robot.name: robot for robot in config.load(args.config).robot}
        wanted = args.robot or (name if name in robots else next(iter(robots), "") if len(robots) == 1 else "")
        if wanted not in robots:
            raise RecordingError(
                f"{args.config}: no robot {wanted or name!r}; it has {', '.join(sorted(robots)) or 'none'}: "
                "say with --robot which one the recording is of"
            )
        robot = robots[wanted]
        params, motion, engine, imu = robot.filter, robot.motion, robot.engine, robot.imu
    elif args.robot is not None:
        raise RecordingError(f"--robot {args.robot}: a robot of which configuration? --config names its file")
    return config.with_settings(params, args.set), args.motion or motion, args.engine or engine, imu


def run(args: argparse.Namespace) -> int:
    """Replay, print, write. -> exit status."""
    folders = robot_folders(args.recording)
    failed = False
    if args.out is not None and len(folders) > 1:
        args.out.mkdir(parents=True, exist_ok=True)
    for folder in folders:
        params, motion, engine, imu = _settings(args, folder.resolve().name)
        try:
            recording = load(folder, params, imu)
        except RecordingError as error:
            if len(folders) == 1:
                raise
            # A robot that never spoke, say, must not keep the others from being replayed.
            print(f"steadfix: {error}", file=sys.stderr)
            failed = True
            continue
        if engine == "numba":
            compile_filter()
        health = Health(Localiser(recording.name, params, motion, engine), args.channel)
        with tqdm(
            total=len(recording.samples), unit=" samples", delay=1.0, leave=False, disable=not sys.stderr.isatty()
        ) as bar:
            result = replay(
                recording, health.localiser, lambda done, bar=bar: bar.update(done - bar.n), health, args.channel
            )
        track, _, _ = result
        figures = summary(recording, health, *result)
        print(json.dumps(figures) if args.json else _table(figures))
        if args.out is not None:
            write_tum(args.out / f"{recording.name}.tum" if len(folders) > 1 else args.out, track)
    return 2 if failed else 0
