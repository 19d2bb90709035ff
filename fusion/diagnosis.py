"""What is wrong with a robot's localisation, in words, with the numbers that say so: what it looks at, what it is.

`fusion.sensor_faults` and `fusion.fix_faults` find it, `fusion.health` puts it together. Nothing is said unless it is
both large enough to matter and significant; the thresholds stand where they are used. Most tests do not need the filter
to be right: they compare samples with each other, fixes at rest with each other, the rotation between fixes with the
gyroscope's, and the way between them with the heading and the wheels. Where an IMU is wrong altogether its consequences
are not told as causes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np

from fusion.localiser import Localiser
from fusion.measurements import Array, FixOutcome, PoseHypothesis

Severity = Literal["note", "warning", "error"]

WINDOW = 120.0  # s that a diagnosis looks back
BLOCK = 32  # samples

# Thresholds that both rooms use
SIGMAS = 5.0  # what is estimated with a sigma must be that many of them from what it should be
NOISE_LEAST = 1.5  # times the noise that is configured, or that fixes say
WAY_PAIRS, WAY_STEP, WAY_SIGMAS = 20, 1.5, 8.0  # pairs of fixes, at most s apart


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """A likely cause of trouble, or of what the filter has to make up for.

    `code`: stable, for programs. `text`: for the person who can mend it. `evidence`: the numbers it rests on.
    A note needs no action to keep the pose good; a warning costs accuracy; with an error there is no pose to rely on.
    """

    code: str
    severity: Severity
    text: str
    evidence: dict[str, Any]

    @property
    def key(self) -> tuple[str, str]:
        """The same for the same trouble, whatever its numbers."""
        return self.code, " ".join(str(self.evidence[name]) for name in ("source", "markers") if name in self.evidence)


class Score(NamedTuple):
    """How far a published pose was from a fix that came later: age of the last fix in it, s; m and rad."""

    age: float
    distance: float
    angle: float


class JudgedFix(NamedTuple):
    """A fix: its outcome, the pose of it that was used, its markers, and what poses were published for its instant."""

    outcome: FixOutcome
    pose: PoseHypothesis
    markers: tuple[int, ...]
    scores: tuple[Score | None, ...]


class Chunk(NamedTuple):
    """What remains of a run of samples. `blocks` (k, 20): first and last stamp, mean (6), noise variances (6, 6)."""

    t: float
    samples: int
    step: float
    missing: float
    gaps: int
    longest: float
    repeats: int
    top: Array
    at_top: Array
    near_top: Array
    blocks: Array


class Seen(NamedTuple):
    """All that a diagnosis looks at: of `WINDOW` before `now`, on the clock of the stamps.

    `began`: stamp of the first sample, NaN before it. `wheels` (m, 3): as in `WheelOdometry`, sorted. `stamps`:
    earliest and latest stamp of a fix ever, inf and -inf before one. `fixes`: judged ones, by stamp. `lost`: how long
    after its stamp each arrived that came too late, s.
    `learned`: now and then the time and the filter's noise scale.
    """

    now: float
    localiser: Localiser
    began: float
    chunks: Sequence[Chunk]
    wheels: Array
    stamps: tuple[float, float]
    fixes: Sequence[JudgedFix]
    lost: Sequence[float]
    learned: Sequence[tuple[float, Array]]


def chords(fixes: Sequence[JudgedFix]) -> Array:
    """(3, n - 1): from each fix to the next of a robot on the floor, how far ahead and aside it went, m, and how far it
    turned, rad. On an arc the chord has the heading of its middle."""
    heading = np.unwrap([2.0 * math.atan2(z, w) for w, _, _, z in (fix.pose.quaternion_wxyz for fix in fixes)])
    middle = 0.5 * (heading[1:] + heading[:-1])
    x, y = np.diff([fix.pose.position[:2] for fix in fixes], axis=0).T
    c, s = np.cos(middle), np.sin(middle)
    return np.array([c * x + s * y, c * y - s * x, np.diff(heading)])
