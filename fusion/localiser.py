"""One robot: measurements in, outcomes and poses out."""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np

from fusion import kernels as k
from fusion.measurements import Array, FixOutcome, ImuBatch, Mode, Outcome, Pose, PoseFix, WheelOdometry
from fusion.params import Channel, Engine, FilterParams, Motion
from fusion.timeline import Timeline, fix_row


class _Timeline(Protocol):
    @property
    def state(self) -> Array: ...
    def feed_samples(self, samples: Array, track: Array | None = None, channel: Channel = "best") -> int: ...
    def feed_fix(self, row: Array) -> int: ...
    def feed_wheels(self, samples: Array) -> int: ...
    def judged(self) -> list[Array]: ...
    def pose_at(self, t: float, channel: Channel = "best") -> Array | None: ...
    @property
    def figures(self) -> dict[str, int]: ...


def _timeline(engine: Engine, params: FilterParams, motion: Motion) -> _Timeline:
    if engine == "filterpy":
        # Imported here: the compiled engine needs neither filterpy nor what it brings, and starts faster without.
        from fusion.reference import ReferenceTimeline

        return ReferenceTimeline(params, motion)
    return Timeline(params, motion)


def warm_up(engine: Engine = "numba") -> None:
    """Compile the kernels, or load them from numba's cache, before the first measurement needs them."""
    localiser = Localiser("warm-up", engine=engine)
    localiser.feed_samples(np.zeros((1, 7)))
    localiser.pose_at(0.0)
    localiser._timeline.feed_fix(np.zeros(k.FIX))


# So many IMU samples in a row that are older than the buffer, and none that is not: their clock has gone back.
CLOCK_WENT_BACK = 20


class Localiser:
    """The pose of one robot, from its IMU and from fixes in any order of arrival.

    `motion`: "ground" for a robot on the floor (no vertical speed, upright), "differential" for one on wheels that
    cannot move sideways either, "free" for a flying or hand-held one. `engine`: "numba", or "filterpy" for the same
    model without a compiler. Not safe to be used from several threads at once.
    """

    def __init__(
        self,
        robot: str,
        params: FilterParams | None = None,
        motion: Motion = "ground",
        engine: Engine = "numba",
    ) -> None:
        self.robot = robot
        self.params = params or FilterParams()
        self.motion = motion
        self.engine = engine
        self._timeline = _timeline(engine, self.params, motion)
        self._outcomes = dict.fromkeys(Outcome, 0)
        self._samples = self._readings = 0
        self._late_run = 0
        self._before: dict[str, int] = {}  # figures of timelines that were given up
        self._resets = 0  # and how often their poses had been set anew
        self._sources: dict[tuple[float, float], str] = {}

    def feed(
        self, measurement: ImuBatch | PoseFix | WheelOdometry, track: Array | None = None, channel: Channel = "best"
    ) -> list[FixOutcome]:
        """Take a measurement. -> the fixes that were judged by this call.

        That is usually the fix just fed, or none; a fix stamped later than all IMU data so far is judged when they
        have come. Late, repeated and unbelievable measurements are outcomes and counts, never exceptions.
        `track`: see `feed_samples`, for a batch of IMU samples.
        """
        if isinstance(measurement, ImuBatch):
            self.feed_samples(measurement.samples, track, channel)
        elif isinstance(measurement, WheelOdometry):
            self._readings += len(measurement.samples)
            self._timeline.feed_wheels(measurement.samples)
        else:
            # Also where nothing newer has come to show it: a start from where the robot was long ago is none.
            too_late = measurement.arrival - measurement.t > self.params.buffer
            status = k.TOO_LATE if too_late else self._timeline.feed_fix(fix_row(measurement))
            if status != k.PENDING:
                outcome = Outcome(status)
                self._outcomes[outcome] += 1
                return [FixOutcome(self.robot, measurement.t, measurement.arrival, outcome, source=measurement.source)]
            self._sources[measurement.t, measurement.arrival] = measurement.source
        return self.judged()

    def feed_samples(self, samples: Array, track: Array | None = None, channel: Channel = "best") -> None:
        """IMU samples (n, 7) as in `ImuBatch`, unchecked.

        `track` (n, 8) receives the newest pose as it is known when each sample has arrived: its instant (the sample's
        stamp, unless that came late), position, quaternion wxyz; NaN before the first fix.
        """
        self._samples += len(samples)
        if self._timeline.feed_samples(samples, track, channel) or not len(samples):
            self._late_run = 0
            return
        if samples[:, 0].max() < self._timeline.state[k.T_IMU] - self.params.buffer:
            self._late_run += len(samples)
            if self._late_run >= CLOCK_WENT_BACK:
                self._start_again()

    def _start_again(self) -> None:
        last = self._timeline.pose_at(float(self._timeline.state[k.T]), "smooth")
        self._resets += 1 if last is None else 1 + int(last[k.P_RESET_ID])
        self._before = {name: n + self._before.get(name, 0) for name, n in self._timeline.figures.items()}
        self._timeline = _timeline(self.engine, self.params, self.motion)
        self._sources.clear()
        self._late_run = 0

    def judged(self) -> list[FixOutcome]:
        """The fixes judged since this was last asked; `feed` asks by itself."""
        outcomes = [self._outcome(row) for row in self._timeline.judged()]
        for outcome in outcomes:
            self._outcomes[outcome.outcome] += 1
        return outcomes

    def _outcome(self, row: Array) -> FixOutcome:
        t, arrival = float(row[k.F_T]), float(row[k.F_ARRIVAL])
        outcome, d2, d2_position, d2_attitude, chosen, margin = row[k.F_OUTCOME : k.F_INNOVATION].tolist()
        return FixOutcome(
            robot=self.robot,
            t=t,
            arrival=arrival,
            outcome=Outcome(outcome),
            d2=d2,
            d2_position=d2_position,
            d2_attitude=d2_attitude,
            innovation=row[k.F_INNOVATION : k.F_INNOVATION + 6],
            innovation_sigma=row[k.F_SIGMA : k.F_SIGMA + 6],
            hypothesis=0 if math.isnan(chosen) else int(chosen),
            margin=margin,
            source=self._sources.pop((t, arrival), ""),
        )

    @property
    def counts(self) -> dict[str, int]:
        """Fixes by outcome; of readings of IMU and wheels those fed, those dropped as repeated and as late; rewinds."""
        return (
            {outcome.name.lower(): n for outcome, n in self._outcomes.items() if outcome is not Outcome.PENDING}
            | {"imu_samples": self._samples, "wheel_samples": self._readings}
            | {name: n + self._before.get(name, 0) for name, n in self._timeline.figures.items()}
        )

    @property
    def started(self) -> bool:
        """Whether there has been a fix to start from."""
        return bool(self._timeline.state[k.INITIALISED])

    @property
    def latest(self) -> Pose | None:
        """The pose at the newest instant that measurements have been taken for; None before the first fix."""
        return self.pose_at(float(self._timeline.state[k.T]))

    @property
    def last_fix(self) -> float:
        """s: the instant of the newest accepted fix; -inf before the first."""
        return float(self._timeline.state[k.T_ACCEPTED])

    @property
    def gyro_bias(self) -> Array:
        """(3,) rad/s, body axes."""
        return self._timeline.state[k.BG : k.BG + 3].copy()

    @property
    def gyro_bias_sigma(self) -> Array:
        """(3,) rad/s."""
        return self._sigma(k.DBG, 3)

    @property
    def accel_bias(self) -> Array:
        """(3,) m/s2, body axes."""
        return self._timeline.state[k.BA : k.BA + 3].copy()

    @property
    def accel_bias_sigma(self) -> Array:
        """(3,) m/s2."""
        return self._sigma(k.DBA, 3)

    @property
    def time_offset(self) -> float:
        """s: what is added to a fix's stamp; negative when the camera's stamps are late."""
        return float(self._timeline.state[k.TD])

    @property
    def time_offset_sigma(self) -> float:
        """s; 0 when the offset is held."""
        return float(self._sigma(k.DTD, 1)[0])

    @property
    def tilt(self) -> Array:
        """(2,): x and y of the unit vector upwards, in the world frame; nearly rad."""
        return self._timeline.state[k.TILT : k.TILT + 2].copy()

    @property
    def tilt_covariance(self) -> Array:
        """(2, 2): of the tilt; 0 when it is held."""
        return self._covariance[k.DTILT : k.DTILT + 2, k.DTILT : k.DTILT + 2].copy()

    @property
    def wheel_scale(self) -> Array:
        """(2,): by what share wheel odometry's forward speed and yaw rate say too much."""
        return self._timeline.state[k.WHEEL : k.WHEEL + 2].copy()

    @property
    def wheel_scale_sigma(self) -> Array:
        """(2,): 0 where it is held."""
        return self._sigma(k.DWHEEL, 2)

    @property
    def noise_scale(self) -> Array:
        """(4,): how much larger than said it has found sigmas: accelerometer, gyroscope, fix position, fix attitude.

        1 where it is not significant. The filterpy engine does not tell: 0.
        """
        scale = self._timeline.state[k.SCALE : k.SCALE + 4].copy()
        scale[2:] = np.sqrt(scale[2:])
        return scale

    @property
    def _covariance(self) -> Array:
        return self._timeline.state[k.COV : k.COV + k.N * k.N].reshape(k.N, k.N)

    def _sigma(self, first: int, n: int) -> Array:
        sigma: Array = np.sqrt(np.diag(self._covariance)[first : first + n])
        return sigma

    def pose_at(self, t: float, channel: Channel = "best") -> Pose | None:
        """The pose at instant t: of the past as far as the buffer reaches, or extrapolated into the near future.

        None before the first fix and before the buffer. `channel`: "best" is the filter's estimate, which steps with
        every correction. "smooth" is for steering: it glides to the best one at no more than 0.3 m/s and 60 deg/s, and
        steps only beyond 0.25 m or 20 deg and when the filter starts anew, which `reset_id` and `reset_step` tell. Of
        the past it is the best.
        """
        row = self._timeline.pose_at(t, channel)
        if row is None:
            return None
        fix_age = t - float(row[k.P_T_ACCEPTED])
        mode = self._mode(fix_age, t - float(row[k.P_T_IMU]), row)
        return Pose(self.robot, t, row, mode, self._resets + int(row[k.P_RESET_ID]), fix_age)

    def _mode(self, fix_age: float, imu_age: float, row: Array) -> Mode:
        coasting = fix_age > self.params.coast_after
        if imu_age > self.params.imu_gap:
            return Mode.LOST if coasting else Mode.NO_IMU
        if not coasting:
            return Mode.FULL
        covariance = row[k.P_COV : k.P_COV + 36].reshape(6, 6)
        sigma = math.sqrt(float(np.linalg.eigvalsh(covariance[:3, :3])[-1]))
        if sigma > self.params.invalid_sigma:
            return Mode.INVALID
        return Mode.DEGRADED if sigma > self.params.degraded_sigma else Mode.COAST
