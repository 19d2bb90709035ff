"""What the filter makes of a fixed set of simulated recordings, so that a change of behaviour shows in a diff.

`python -m tests.fusion.test_reference_figures` writes `reference_figures.json` anew.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from fusion.measurements import Outcome
from fusion.params import Motion
from fusion.simulator import CameraParams, ImuParams, Simulation, aggressive, figure_eight, random_ground, simulate
from tests.fusion.simulated import drive

FIGURES = Path(__file__).with_name("reference_figures.json")
SECONDS = 45.0
RELATIVE = 0.02
# For what may be near zero.
ABSOLUTE = {"time_offset_ms": 0.2, "tilt_deg": 0.01}


class Case(NamedTuple):
    motion: Motion
    simulate: Callable[[], Simulation]


def flips() -> Simulation:
    return simulate(random_ground(3), 2, SECONDS, camera=CameraParams(two_poses=True, flip=0.4, dropout=0.2))


def late_stamps() -> Simulation:
    return simulate(random_ground(4), 4, SECONDS, camera=CameraParams(stamp_error=0.08), tilt=(math.radians(1.0), 0.0))


def bad_accelerometer() -> Simulation:
    """Of 25 Hz, forward by half too much."""
    simulation = simulate(random_ground(5), 5, SECONDS, ImuParams(rate=25.0))
    samples = simulation.samples.copy()
    samples[:, 4] *= 1.5
    return replace(simulation, samples=samples)


def no_camera() -> Simulation:
    """For ten seconds."""
    simulation = simulate(figure_eight(), 6, SECONDS)
    return replace(simulation, fixes=[fix for fix in simulation.fixes if not 17.0 < fix.t < 27.0])


def no_imu() -> Simulation:
    """For a second, twice."""
    simulation = simulate(random_ground(7), 7, SECONDS)
    t = simulation.samples[:, 0]
    there = ~((t > 20.0) & (t % 20.0 < 1.0))
    return replace(simulation, samples=simulation.samples[there], arrival=simulation.arrival[there])


def carried() -> Simulation:
    """At 20 s by two metres, in no time, and back at 30 s."""
    simulation = simulate(aggressive(8), 8, SECONDS)

    def away(t: float) -> float:
        return 2.0 if 20.0 < t < 30.0 else 0.0

    fixes = []
    for fix in simulation.fixes:
        pose = fix.hypotheses[0]
        there = replace(pose, position=pose.position + [away(fix.t), 0.0, 0.0])
        fixes.append(replace(fix, hypotheses=(there,)))
    truth = simulation.truth.copy()
    truth[:, 1] += [away(t) for t in truth[:, 0]]
    return replace(simulation, fixes=fixes, truth=truth)


CASES = {
    "free": Case("free", lambda: simulate(aggressive(1), 1, SECONDS)),
    "ground": Case("ground", lambda: simulate(random_ground(1), 1, SECONDS)),
    "differential": Case("differential", lambda: simulate(random_ground(2), 2, SECONDS)),
    "flips": Case("ground", flips),
    "late stamps on a tilted floor": Case("ground", late_stamps),
    "bad accelerometer": Case("ground", bad_accelerometer),
    "no camera": Case("differential", no_camera),
    "no IMU": Case("ground", no_imu),
    "carried": Case("free", carried),
}


def figures(case: Case) -> dict[str, float]:
    run = drive(case.simulate(), None, case.motion)
    counts = {outcome.name.lower(): run.localiser.counts[outcome.name.lower()] for outcome in Outcome if outcome}
    measured = {
        "rmse_mm": run.mm(),
        "rmse_deg": run.deg(),
        "anees": run.anees,
        "time_offset_ms": 1e3 * run.localiser.time_offset,
        "tilt_deg": math.degrees(np.linalg.norm(run.localiser.tilt)),
    }
    return {name: round(float(value), 4) for name, value in measured.items()} | counts


@pytest.mark.parametrize("name", CASES)
def test_figures_are_as_before(name: str) -> None:
    """Counts exactly, the rest within 2 %."""
    expected = json.loads(FIGURES.read_text())[name]
    assert figures(CASES[name]) == {
        key: value if isinstance(value, int) else pytest.approx(value, rel=RELATIVE, abs=ABSOLUTE.get(key, 0.0))
        for key, value in expected.items()
    }


def test_there_are_figures_of_every_case() -> None:
    assert list(json.loads(FIGURES.read_text())) == list(CASES)


if __name__ == "__main__":
    FIGURES.write_text(json.dumps({name: figures(case) for name, case in CASES.items()}, indent=2) + "\n")
