"""What the innovations say of the noise: on a simulated robot whose noise is known."""

from __future__ import annotations

import numpy as np
import pytest

from fusion.localiser import Localiser
from fusion.measurements import FixOutcome
from fusion.params import FilterParams
from fusion.simulator import Simulation, random_ground, simulate
from fusion.tuning import explain_nis, scale_fix_noise


@pytest.fixture(scope="module")
def simulation() -> Simulation:
    return simulate(random_ground(2), 2, 60.0)


def run(simulation: Simulation, params: FilterParams, fix_noise: float) -> list[FixOutcome]:
    localiser = Localiser("robot", params, "free")
    outcomes = []
    at = 0
    for fix in scale_fix_noise(simulation.fixes, fix_noise):
        stop = int(np.searchsorted(simulation.arrival, fix.arrival))
        localiser.feed_samples(simulation.samples[at:stop])
        outcomes += localiser.feed(fix)
        at = stop
    return outcomes


def test_scaled_fixes_differ_in_their_covariance_alone(simulation: Simulation) -> None:
    for fix, scaled in zip(simulation.fixes, scale_fix_noise(simulation.fixes, 3.0), strict=True):
        assert (fix.t, fix.arrival, fix.source) == (scaled.t, scaled.arrival, scaled.source)
        np.testing.assert_array_equal(fix.hypotheses[0].position, scaled.hypotheses[0].position)
        np.testing.assert_allclose(9.0 * fix.hypotheses[0].covariance, scaled.hypotheses[0].covariance)


@pytest.mark.parametrize(
    ("params", "fix_noise", "pose"),
    [
        (FilterParams(), 1.0, "this noise fits"),
        (FilterParams(), 3.0, "the noise is overstated"),
        (FilterParams(), 0.3, "the noise is understated"),
        (FilterParams(gyro_noise=1e-2, accel_noise=0.2), 1.0, "the noise is overstated"),
        (FilterParams(gyro_noise=1e-4, accel_noise=2e-3), 1.0, "the noise is understated"),
    ],
)
def test_words_for_the_nis(simulation: Simulation, params: FilterParams, fix_noise: float, pose: str) -> None:
    lines = explain_nis(run(simulation, params, fix_noise)).splitlines()
    assert [line.split()[3] for line in lines] == ["pose", "position", "attitude"]
    assert pose in lines[0]


def test_position_and_attitude_are_told_apart(simulation: Simulation) -> None:
    _, position, attitude = explain_nis(run(simulation, FilterParams(accel_noise=0.2), 1.0)).splitlines()
    assert "overstated" in position
    assert "fits" in attitude


def test_nothing_to_explain() -> None:
    assert explain_nis([]) == "NIS: no fix has been judged yet."
