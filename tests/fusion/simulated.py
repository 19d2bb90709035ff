"""A simulated robot through the filter, as it would have gone live, and how good that was."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from fusion.consistency import TrackError, hold_last, interpolate, nees, rms, track_error
from fusion.localiser import Localiser
from fusion.measurements import Array, FixOutcome, WheelOdometry
from fusion.params import FilterParams, Motion
from fusion.simulator import Simulation


@dataclass
class Drive:
    """What came of it.

    `track` (n, 8): the causal pose at each IMU sample. `times` (m,), `errors` (m, 6), truth less pose, position and
    rotation in world axes, and `covariances` (m, 6, 6): just before each fix arrived, once there was a pose.
    """

    simulation: Simulation
    localiser: Localiser
    track: Array
    times: Array
    errors: Array
    covariances: Array
    outcomes: list[FixOutcome] = field(default_factory=list)

    def error(self, after: float = 0.0) -> TrackError:
        """Of the track from the instant `after`, s."""
        return track_error(self.track[self.track[:, 0] >= after], self.simulation.truth)

    def mm(self, after: float = 0.0) -> float:
        """RMSE of the position; infinite if there are NaN poses after the first pose."""
        known = np.isfinite(self.track).all(axis=1)
        return 1e3 * self.error(after).position_rmse if known[np.argmax(known) :].all() else math.inf

    def deg(self, after: float = 0.0) -> float:
        """RMSE of the attitude."""
        return math.degrees(self.error(after).attitude_rmse)

    @property
    def anees(self) -> float:
        """Mean squared error over what the covariance expects; 1 is honest, more is too sure."""
        return float(nees(self.errors, self.covariances).mean() / 6.0)


def drive(simulation: Simulation, params: FilterParams | None = None, motion: Motion = "ground") -> Drive:
    """Feed a simulation in order of arrival; of the wheels, ten readings come together with the last of them."""
    localiser = Localiser("robot", params, motion)
    track = np.full((len(simulation.samples), 8), np.nan)
    times, errors, covariances, outcomes = [], [], [], []
    at = 0
    groups = [simulation.wheels[i : i + 10] for i in range(0, len(simulation.wheels), 10)]
    wheels = [WheelOdometry("robot", float(group[-1, 0]), group) for group in groups]
    for given in sorted((*simulation.fixes, *wheels), key=lambda given: given.arrival):
        stop = int(np.searchsorted(simulation.arrival, given.arrival))
        localiser.feed_samples(simulation.samples[at:stop], track[at:stop])
        at = stop
        if isinstance(given, WheelOdometry):
            outcomes += localiser.judged() + localiser.feed(given)
            continue
        pose = localiser.latest
        # With stamps that jump it may be of an instant that the truth does not cover.
        if pose is not None and simulation.truth[0, 0] <= pose.t <= simulation.truth[-1, 0]:
            truth = interpolate(simulation.truth, np.array([pose.t]))[0]
            attitude, true_attitude = Rotation.from_quat([pose.quaternion_wxyz, truth[4:]], scalar_first=True)
            errors.append(np.append(truth[1:4] - pose.position, (true_attitude * attitude.inv()).as_rotvec()))
            times.append(pose.t)
            covariances.append(pose.covariance)
        outcomes += localiser.judged() + localiser.feed(given)
    localiser.feed_samples(simulation.samples[at:], track[at:])
    outcomes += localiser.judged()
    return Drive(simulation, localiser, track, np.array(times), np.array(errors), np.array(covariances), outcomes)


def held_mm(simulation: Simulation, after: float = 0.0) -> float:
    """RMSE of who holds the last fix, mm."""
    fixes = np.array([(f.t, *f.hypotheses[0].position, *f.hypotheses[0].quaternion_wxyz) for f in simulation.fixes])
    t = simulation.samples[simulation.samples[:, 0] >= after, 0]
    held = hold_last(fixes, np.array([fix.arrival for fix in simulation.fixes]), t)
    return 1e3 * rms(track_error(held, simulation.truth).position)
