"""How good an estimate is: errors against truth, and whether they are as large as the filter says.

A track is (n, 8): t, position xyz, quaternion wxyz (world_from_body), sorted by t.
NEES and NIS: Y. Bar-Shalom, X. Li, T. Kirubarajan, "Estimation with Applications to Tracking and Navigation" (2001),
section 5.4.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import gammaincinv

from fusion.measurements import Array


class TrackError(NamedTuple):
    """Errors of a track against truth.

    `t` (m,): the instants that were compared. `position` (m,): distance, m. `attitude` (m,): angle of the rotation
    from one to the other, rad.
    """

    t: Array
    position: Array
    attitude: Array

    @property
    def position_rmse(self) -> float:
        """m; NaN where nothing could be compared."""
        return rms(self.position)

    @property
    def attitude_rmse(self) -> float:
        """rad; NaN where nothing could be compared."""
        return rms(self.attitude)


def rms(errors: ArrayLike) -> float:
    """Root mean square; NaN of nothing."""
    errors = np.asarray(errors, dtype=np.float64)
    return float(np.sqrt(np.mean(errors**2))) if errors.size else float("nan")


def interpolate(track: Array, t: Array, longest_gap: float = 0.5) -> Array:
    """(m, 8): the track at the instants t (m,), position linear, attitude along the great circle.

    NaN outside the track and in its gaps longer than `longest_gap` s, where a line would be a guess.
    """
    out = np.full((len(t), 8), np.nan)
    out[:, 0] = t
    if len(track) < 2:
        return out
    after = np.clip(np.searchsorted(track[:, 0], t), 1, len(track) - 1)
    a, b = track[after - 1], track[after]
    span = b[:, 0] - a[:, 0]
    known = (t >= track[0, 0]) & (t <= track[-1, 0]) & (span <= longest_gap) & (span > 0.0)
    s = np.where(known, (t - a[:, 0]) / np.where(span > 0.0, span, 1.0), 0.0)[:, np.newaxis]
    cosine = np.sum(a[:, 4:] * b[:, 4:], axis=1, keepdims=True)
    target = b[:, 4:] * np.where(cosine < 0.0, -1.0, 1.0)
    angle = np.arccos(np.clip(np.abs(cosine), 0.0, 1.0))
    small = angle < 1e-6
    sine = np.where(small, 1.0, np.sin(angle))
    q = np.where(
        small,
        (1.0 - s) * a[:, 4:] + s * target,
        (np.sin((1.0 - s) * angle) * a[:, 4:] + np.sin(s * angle) * target) / sine,
    )
    out[known, 1:4] = ((1.0 - s) * a[:, 1:4] + s * b[:, 1:4])[known]
    out[known, 4:] = (q / np.linalg.norm(q, axis=1, keepdims=True))[known]
    return out


def attitude_angle(a_wxyz: Array, b_wxyz: Array) -> Array:
    """(n,) rad: angle of the rotation from quaternions a (n, 4) to b (n, 4).

    From the length of the shorter chord: the arc cosine of the product would lose half the digits of a small angle.
    """
    chord = np.minimum(np.linalg.norm(a_wxyz - b_wxyz, axis=1), np.linalg.norm(a_wxyz + b_wxyz, axis=1))
    angle: Array = 4.0 * np.arcsin(np.clip(0.5 * chord, 0.0, 1.0))
    return angle


def track_error(track: Array, truth: Array) -> TrackError:
    """Errors of every row of a track at whose instant the truth is known."""
    reference = interpolate(truth, track[:, 0])
    known = np.isfinite(reference[:, 1]) & np.isfinite(track[:, 1])
    track, reference = track[known], reference[known]
    return TrackError(
        track[:, 0],
        np.linalg.norm(track[:, 1:4] - reference[:, 1:4], axis=1),
        attitude_angle(track[:, 4:], reference[:, 4:]),
    )


def hold_last(fixes: Array, arrival: Array, t: Array) -> Array:
    """(m, 8): what one has without a filter, the newest fix that had arrived by each instant of t (m,).

    `fixes`: (n, 8) as a track; `arrival`: (n,) s. NaN before the first.
    """
    order = np.argsort(arrival, kind="stable")
    # a fix overtaken on the way by a newer one is of no use
    newest = np.maximum.accumulate(np.where(order >= 0, fixes[order, 0], 0.0))
    holder = np.maximum.accumulate(np.where(fixes[order, 0] == newest, np.arange(len(order)), 0))
    have = np.searchsorted(arrival[order], t, side="right") - 1
    out = np.full((len(t), 8), np.nan)
    out[:, 0] = t
    known = have >= 0
    out[known, 1:] = fixes[order[holder[have[known]]], 1:]
    return out


def nees(errors: Array, covariances: Array) -> Array:
    """(n,): eᵀ P⁻¹ e of errors (n, m) with covariances (n, m, m); mean m where the covariance is honest."""
    solved = np.linalg.solve(covariances, errors[..., np.newaxis])[..., 0]
    value: Array = np.sum(errors * solved, axis=1)
    return value


def chi2_bounds(dof: float, n: int = 1, confidence: float = 0.95) -> tuple[float, float]:
    """Two-sided bounds of the mean of n independent chi-square numbers of `dof` degrees of freedom each."""
    tail = 0.5 * (1.0 - confidence)
    # the quantile of chi-square with k degrees of freedom is twice that of the gamma distribution of shape k/2
    low, high = (2.0 * gammaincinv(0.5 * n * dof, p) / n for p in (tail, 1.0 - tail))
    return float(low), float(high)
