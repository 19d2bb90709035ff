"""How well a robot's localisation is: running figures, and what is wrong with it (`fusion.diagnosis`).

`Health` looks on while a `Localiser` is fed and changes nothing. What is fed and published it only keeps, for a fix it
looks up what was published; all else is done when it is asked. What it says is about the last two minutes.

**Accuracy without ground truth.** A fix judges the pose that was published for its instant before the fix had arrived:
a ring keeps what was published, of the channel that was. The innovation would not do, since it is computed after
rewinding, when fixes that arrived after the publication are in the state. The difference holds the fix's own error
too, so that it errs to the safe side. Fixes that are not believed count when the filter gives in to them later, for
then it was the pose that was wrong.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections import deque
from collections.abc import Sequence
from typing import Any

import numpy as np

from fusion import fix_faults, sensor_faults
from fusion.consistency import chi2_bounds
from fusion.diagnosis import BLOCK, WINDOW, Chunk, Diagnosis, JudgedFix, Score, Seen
from fusion.fix_faults import BELIEVED, LEARNED_STEP, is_turned
from fusion.localiser import Localiser
from fusion.measurements import (
    LAST_FIX,
    Array,
    FixOutcome,
    Outcome,
    Pose,
    PoseFix,
    PoseHypothesis,
    WheelOdometry,
)
from fusion.params import Channel

NIS_FIXES = 60  # fixes of the running NIS
AGES = (0.2, 0.7, 1.7, 4.7)  # s: between the buckets of fix age; not the usual intervals of fixes themselves

# With one of these much else is wrong too, but nothing of it is the cause; what is said besides.
_ROOTS = {"accel_unit", "gyro_unit", "gyro_sign", "imu_mounting", "gyro_saturates", "accel_saturates"}
_ROOTS |= {"wheel_unit", "wheel_turn_unit"}
_BESIDES = {"imu_missing", "imu_stamps_repeat", "no_fix", "fixes_lost", "fixes_late", "fixes_early"}

_KEEP = 4096  # poses that stay when their ring is full, and samples of which a chunk is made at the latest


class _Poses:
    """Poses that were given out, and the last fix in each: rows of t, position, quaternion wxyz, instant of the fix."""

    def __init__(self) -> None:
        self._rows = np.empty((2 * _KEEP, 9))
        self._instants = self._rows[:, 0]
        self._end = 0

    def next(self, n: int) -> Array:
        """(n, 9), to be filled with as many more; n <= _KEEP."""
        if self._end + n > len(self._rows):
            self._rows[:_KEEP] = self._rows[self._end - _KEEP : self._end]
            self._end = _KEEP
        self._end += n
        return self._rows[self._end - n : self._end]

    def at(self, t: float, longest: float) -> tuple[Array, float] | None:
        """The pose (7,) for instant t and the last fix in it; None if there was none, in a gap longer than that, s."""
        after = bisect_left(self._instants, t, 0, self._end)
        if not 0 < after < self._end:
            return None
        a, b = self._rows[after - 1], self._rows[after]
        span = b[0] - a[0]
        if not (math.isfinite(a[1]) and span <= longest):
            return None
        # Successive quaternions are nearly the same: a line will do.
        return a[1:8] + (t - a[0]) / span * (b[1:8] - a[1:8]), float(a[8])


class Health:
    """The figures of one robot. Tell it in this order, around feeding the localiser:

    `arrived(fix)` before a fix is fed; `judged(outcomes)` after; `sampled(samples, track)` and `wheels(odometry)` after
    these are. `channel` is that of the track. Where poses are published apart from it, on the smooth channel,
    `published(pose)`.
    """

    def __init__(self, localiser: Localiser, channel: Channel = "best") -> None:
        self.localiser = localiser
        self.reordered = 0
        # By key: when it was first and last said, and how it was said last.
        self.said: dict[tuple[str, str], tuple[float, float, Diagnosis]] = {}
        self._planar = localiser.motion != "free"
        # Samples of which no chunk has been made.
        self._samples: list[Array] = []
        self._undigested = 0
        self._began = self._t_before = math.nan
        self._last_fix = -math.inf
        self._oldest, self._newest = math.inf, -math.inf  # stamps of fixes
        self._chunks: deque[Chunk] = deque()
        self._wheels: deque[Array] = deque(maxlen=20_000)
        self._arriving: dict[tuple[str, float, float], tuple[PoseFix, list[tuple[Array, float] | None]]] = {}
        self._fixes: deque[JudgedFix] = deque(maxlen=400)
        self._learned: deque[tuple[float, Array]] = deque(maxlen=round(WINDOW / LEARNED_STEP))
        self._late: deque[FixOutcome] = deque(maxlen=400)
        self._doubtful: deque[JudgedFix] = deque(maxlen=100)
        # What was given out, and of each the fixes' scores by fix age: along the track, and apart from it.
        self._channels: tuple[Channel, Channel] = (channel, "smooth")
        self._given = _Poses(), _Poses()
        self._scores = tuple([deque[Score](maxlen=400) for _ in range(len(AGES) + 1)] for _ in self._given)

    # Looking on

    def sampled(self, samples: Array, track: Array) -> None:
        """Samples (n, 7) that were fed, and the track (n, 8) of it: what was published with each."""
        if len(samples) > _KEEP:
            for at in range(0, len(samples), _KEEP):
                self.sampled(samples[at : at + _KEEP], track[at : at + _KEEP])
            return
        self._samples.append(samples)
        self._undigested += len(samples)
        if self._undigested >= _KEEP:
            self._digest()
        given = self._given[0].next(len(samples))
        given[:, :8], given[:, 8] = track, self._last_fix

    def wheels(self, odometry: WheelOdometry) -> None:
        """Readings of the wheels that were fed."""
        self._wheels.append(odometry.samples)
        while self._wheels[0][-1, 0] < odometry.samples[-1, 0] - WINDOW:
            self._wheels.popleft()

    def published(self, pose: Pose) -> None:
        """A pose that was given out, later than the one before."""
        self._given[1].next(1)[0] = pose.numbers[: LAST_FIX + 1]

    def another_imu(self) -> None:
        """The device has connected anew, or it is another one: what the last one sent is no measure for it."""
        self._chunks.clear()
        self._samples.clear()
        self._undigested = 0
        self._t_before = math.nan

    def arrived(self, fix: PoseFix) -> None:
        """A fix that is about to be fed."""
        if fix.t < self._newest:
            self.reordered += 1
        self._oldest, self._newest = min(self._oldest, fix.t), max(self._newest, fix.t)
        t, longest = fix.t + self.localiser.time_offset, self.localiser.params.imu_gap
        self._arriving[fix.source, fix.t, fix.arrival] = fix, [poses.at(t, longest) for poses in self._given]
        if len(self._arriving) > 256:
            del self._arriving[next(iter(self._arriving))]

    def judged(self, outcomes: Sequence[FixOutcome]) -> None:
        """What the localiser made of fixes."""
        if not outcomes:
            return
        for outcome in outcomes:
            if outcome.outcome is Outcome.DUPLICATE:
                continue
            known = self._arriving.pop((outcome.source, outcome.t, outcome.arrival), None)
            if outcome.outcome is Outcome.TOO_LATE:
                self._late.append(outcome)
            if known is None:
                continue
            fix, given = known
            pose = fix.hypotheses[outcome.hypothesis]
            self._score(JudgedFix(outcome, pose, fix.markers, tuple(self._compared(outcome.t, pose, g) for g in given)))
            if not self._learned or abs(outcome.arrival - self._learned[-1][0]) >= LEARNED_STEP:
                self._learned.append((outcome.arrival, self.localiser.noise_scale))
        self._last_fix = self.localiser.last_fix

    def _score(self, fix: JudgedFix) -> None:
        self._fixes.append(fix)
        outcome = fix.outcome.outcome
        if outcome is Outcome.REJECTED or (outcome is Outcome.INFLATED and is_turned(fix)):
            self._doubtful.append(fix)
            return
        before = list(self._doubtful) if outcome is Outcome.REINITIALISED else []
        self._doubtful.clear()
        for judged in (*before, fix):
            for scores, score in zip(self._scores, judged.scores, strict=True):
                if score is not None:
                    scores[bisect_left(AGES, score.age)].append(score)

    def _compared(self, t: float, pose: PoseHypothesis, given: tuple[Array, float] | None) -> Score | None:
        """Only on the floor, and about the vertical, for a robot that stays there."""
        if given is None:
            return None
        (x, y, z, pw, px, py, pz), used = given[0].tolist(), given[1]
        fx, fy, fz = pose.position.tolist()
        qw, qx, qy, qz = pose.quaternion_wxyz.tolist()
        w = pw * qw + px * qx + py * qy + pz * qz
        c = pw * qz - pz * qw + py * qx - px * qy
        if self._planar:
            return Score(t - used, math.hypot(fx - x, fy - y), 2.0 * math.atan2(abs(c), abs(w)))
        a, b = pw * qx - px * qw - py * qz + pz * qy, pw * qy - py * qw - pz * qx + px * qz
        distance = math.hypot(fx - x, fy - y, fz - z)
        return Score(t - used, distance, 2.0 * math.atan2(math.hypot(a, b, c), abs(w)))

    def _digest(self) -> None:
        """Make a chunk of the rows since the last one."""
        count = self._undigested // BLOCK
        if not count:
            return
        together = np.concatenate(self._samples)
        rows, rest = together[: count * BLOCK], together[count * BLOCK :]
        self._samples, self._undigested = [rest], len(rest)
        t = rows[:, 0]
        if math.isnan(self._t_before):
            self._t_before = float(t[0])
            self._began = self._t_before if math.isnan(self._began) else self._began
            t = t[1:]
        steps = np.diff(t, prepend=self._t_before)
        self._t_before = float(t[-1])
        forward = steps[steps > 0.0]
        step = float(np.median(forward)) if forward.size else math.inf
        # The rate may change: a step is long beside those around it.
        usual = np.repeat(np.median(np.resize(steps, (count, BLOCK)), axis=1), BLOCK)[: len(steps)]
        usual = np.where(usual > 0.0, usual, step)
        long, beside = steps[steps > sensor_faults.GAP * usual], usual[steps > sensor_faults.GAP * usual]
        # Jittered stamps make long steps too, but short ones make up for those.
        absent = float(np.sum(steps / usual)) - int(np.sum(steps > 0.0))
        missing = max(0.0, min(float(np.sum(np.round(long / beside) - 1.0)), absent))
        # One row an axis: reductions along what lies side by side in memory are several times as fast.
        u = rows[:, 1:].T.copy()
        size = np.abs(u)
        top = size.max(axis=1)
        at_top = np.count_nonzero(size >= (1.0 - 1e-6) * top[:, np.newaxis], axis=1)
        near_top = np.count_nonzero(size >= 0.95 * top[:, np.newaxis], axis=1) - at_top
        in_blocks = u.reshape(6, count, BLOCK)
        first = np.diff(in_blocks)
        third = np.diff(first, n=2)
        means = (
            in_blocks.mean(axis=2),
            np.einsum("ijk,ijk->ij", first, first) / (2.0 * (BLOCK - 1)),
            np.einsum("ijk,ijk->ij", third, third) / (20.0 * (BLOCK - 3)),
        )
        blocks = np.vstack([rows[::BLOCK, 0], rows[BLOCK - 1 :: BLOCK, 0], *means]).T
        longest, repeats = float(long.max(initial=0.0)), int(np.sum(steps == 0.0))
        chunk = Chunk(
            self._t_before, len(steps), step, missing, len(long), longest, repeats, top, at_top, near_top, blocks
        )
        self._chunks.append(chunk)
        while self._chunks[0].t < self._chunks[-1].t - WINDOW:
            self._chunks.popleft()

    # Figures

    def figures(self, now: float) -> dict[str, Any]:
        """Plain values; None where nothing is known. NIS is per degree of freedom, with its 95 % bounds."""
        localiser = self.localiser
        delays = [fix.outcome.delay for fix in self._fixes]
        tilt_sigma = np.sqrt(np.diag(localiser.tilt_covariance))
        age = now - localiser.last_fix
        edges = (0.0, *AGES, None)
        published = int(any(self._scores[1]))
        by_age = self._scores[published]
        return {
            "nis": {name: self._nis(name) for name in ("pose", "position", "attitude")},
            "time_offset_ms": 1e3 * localiser.time_offset,
            "time_offset_sigma_ms": 1e3 * localiser.time_offset_sigma,
            "tilt_deg": np.degrees(localiser.tilt).tolist(),
            "tilt_sigma_deg": np.degrees(tilt_sigma).tolist(),
            "gyro_bias": localiser.gyro_bias.tolist(),
            "gyro_bias_sigma": localiser.gyro_bias_sigma.tolist(),
            "accel_bias": localiser.accel_bias.tolist(),
            "accel_bias_sigma": localiser.accel_bias_sigma.tolist(),
            "wheel_scale": localiser.wheel_scale.tolist(),
            "wheel_scale_sigma": localiser.wheel_scale_sigma.tolist(),
            "fix_age_s": age if math.isfinite(age) else None,
            "fix_delay_ms": {"p50": _percentile(delays, 50, 1e3), "p95": _percentile(delays, 95, 1e3)},
            "fixes_reordered": self.reordered,
            "accuracy": {"channel": self._channels[published]}
            | _accuracy([score for scores in by_age for score in scores])
            | {
                "by_fix_age": [
                    {"from_s": edges[i], "to_s": edges[i + 1]} | _accuracy(scores) for i, scores in enumerate(by_age)
                ]
            },
        }

    def _nis(self, name: str) -> dict[str, float | None]:
        dof = 6 if name == "pose" else 3
        d2 = self._d2(name)
        if not d2:
            return {"mean": None, "low": None, "high": None, "fixes": 0}
        low, high = chi2_bounds(dof, len(d2))
        return {"mean": float(np.mean(d2)) / dof, "low": low / dof, "high": high / dof, "fixes": len(d2)}

    def _d2(self, name: str) -> list[float]:
        attribute = "d2" if name == "pose" else f"d2_{name}"
        believed = [fix.outcome for fix in self._fixes if fix.outcome.outcome in BELIEVED]
        return [getattr(outcome, attribute) for outcome in believed[-NIS_FIXES:]]

    # Diagnosis

    def diagnoses(self, now: float) -> list[Diagnosis]:
        """What there is to say at `now`, on the clock of the stamps; it is also entered in `said`."""
        found = _diagnose(self._seen(now))
        for diagnosis in found:
            since = self.said[diagnosis.key][0] if diagnosis.key in self.said else now
            self.said[diagnosis.key] = since, now, diagnosis
        return found

    def _seen(self, now: float) -> Seen:
        self._digest()
        since = now - WINDOW
        fixes = sorted((fix for fix in self._fixes if fix.outcome.arrival > since), key=lambda fix: fix.outcome.t)
        lost = [outcome.delay for outcome in self._late if outcome.arrival > since]
        learned = [look for look in self._learned if look[0] > since]
        stamps = self._oldest, self._newest
        wheels = np.concatenate([np.empty((0, 3)), *self._wheels])
        wheels = wheels[np.argsort(wheels[:, 0], kind="stable")]
        return Seen(now, self.localiser, self._began, self._chunks, wheels, stamps, fixes, lost, learned)


def _diagnose(seen: Seen) -> list[Diagnosis]:
    """What there is to say, likely causes before what the filter makes up for."""
    fixes, planar = seen.fixes, seen.localiser.motion != "free"
    found: list[Diagnosis] = []
    if seen.chunks:
        blocks = np.concatenate([chunk.blocks for chunk in seen.chunks])
        turns = sensor_faults.turns_between(fixes, blocks)
        gyro = list(sensor_faults.of_gyro(turns))
        in_doubt = not gyro and (turns is None or sensor_faults.correlation(turns) < 0.8)
        found += [*sensor_faults.of_samples(seen, blocks, in_doubt), *sensor_faults.of_gravity(fixes, blocks), *gyro]
        found += fix_faults.of_rest(seen, blocks)
    found += fix_faults.of_arrivals(seen)
    # They are compared with the gyroscope, which must be right for that.
    wheels = list(sensor_faults.of_wheels(seen, blocks)) if seen.chunks and not gyro else []
    found += [diagnosis for diagnosis in wheels if diagnosis.code in _ROOTS]
    codes = {diagnosis.code for diagnosis in found}
    for causes, besides in (({"imu_stamp_unit"}, set()), ({"fixes_clock"}, set()), (_ROOTS, _BESIDES)):
        if codes & causes:
            return [diagnosis for diagnosis in found if diagnosis.code in causes | besides]
    odd = [*wheels, *fix_faults.of_turns(fixes), *fix_faults.of_motion(seen)]
    # Where the robot does not move as is assumed, innovations tell nothing else.
    places, likely = ([], False) if odd else fix_faults.of_places(seen, 2 if planar else 3)
    if not odd and not places:
        found += fix_faults.of_learned(seen, codes)
    if not likely:
        # Where noise is understated, so are the filter's sigmas, also of what it has come to take for noise.
        noise = [diagnosis.evidence["times"] for diagnosis in found if diagnosis.code.endswith("_noise")]
        understated = max([1.0, *noise, *seen.localiser.noise_scale.tolist()])
        found += fix_faults.of_states(seen.localiser, understated)
    return [*found, *odd, *places]


def _percentile(values: Sequence[float], percent: float, scale: float) -> float | None:
    return scale * float(np.percentile(values, percent)) if values else None


def _accuracy(scores: Sequence[Score] | deque[Score]) -> dict[str, Any]:
    mm, deg = [score.distance for score in scores], [score.angle for score in scores]
    degrees = math.degrees(1.0)
    return {
        "fixes": len(scores),
        "mm_p50": _percentile(mm, 50, 1e3),
        "mm_p95": _percentile(mm, 95, 1e3),
        "deg_p50": _percentile(deg, 50, degrees),
        "deg_p95": _percentile(deg, 95, degrees),
    }
