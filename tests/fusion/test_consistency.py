from __future__ import annotations

import math

import numpy as np
import pytest

from fusion.consistency import attitude_angle, chi2_bounds, hold_last, interpolate, nees, rms, track_error
from fusion.geometry import exp_so3, quaternion_from_rotation


def turning(t, rate=0.5):
    """A track that moves along x at 1 m/s and turns about z."""
    q = [quaternion_from_rotation(exp_so3([0.0, 0.0, rate * a])) for a in t]
    return np.column_stack([t, t, np.zeros((len(t), 2)), q])


def test_interpolation_follows_line_and_great_circle():
    t = np.arange(0.0, 5.0, 0.1)
    between = np.array([0.033, 1.25, 4.871])
    np.testing.assert_allclose(interpolate(turning(t), between), turning(between), atol=1e-12)


def test_interpolation_takes_the_short_way_round():
    track = turning(np.arange(0.0, 2.0, 0.1))
    flipped = track.copy()
    flipped[1::2, 4:] *= -1.0
    between = np.array([0.55, 1.05])
    angle = attitude_angle(interpolate(track, between)[:, 4:], interpolate(flipped, between)[:, 4:])
    np.testing.assert_allclose(angle, 0.0, atol=1e-12)


def test_interpolation_guesses_nothing():
    track = np.delete(turning(np.arange(0.0, 5.0, 0.1)), slice(20, 30), axis=0)
    known = np.isfinite(interpolate(track, np.array([-0.01, 1.85, 2.5, 3.05, 4.91]))[:, 1])
    assert known.tolist() == [False, True, False, True, False]


def test_track_error():
    t = np.arange(0.0, 5.0, 0.01)
    track = turning(t)
    track[:, 2] += 0.003
    track[:, 3] += 0.004
    error = track_error(track, turning(np.arange(-1.0, 6.0, 0.05)))
    assert error.position_rmse == pytest.approx(0.005)
    assert error.attitude_rmse < 1e-9
    assert math.isnan(track_error(track[:0], track).position_rmse)


def test_attitude_angle_keeps_small_and_large():
    q = np.array([quaternion_from_rotation(exp_so3([a, 0.0, 0.0])) for a in (1e-9, 1e-3, 1.0, 3.1)])
    np.testing.assert_allclose(attitude_angle(np.tile([1.0, 0, 0, 0], (4, 1)), q), [1e-9, 1e-3, 1.0, 3.1], rtol=1e-6)


def test_hold_last_knows_only_what_has_arrived_and_keeps_the_newest():
    fixes = turning(np.array([0.0, 1.0, 2.0]))
    arrival = np.array([0.5, 2.9, 2.5])  # the second is overtaken by the third
    held = hold_last(fixes, arrival, np.array([0.4, 0.6, 2.6, 3.0]))
    assert math.isnan(held[0, 1])
    np.testing.assert_array_equal(held[1:, 1], [0.0, 2.0, 2.0])


def test_chi_square_bounds_are_those_of_the_tables():
    assert chi2_bounds(6) == pytest.approx((1.2373, 14.4494), abs=1e-4)
    low, high = chi2_bounds(3, n=100)
    assert (low, high) == pytest.approx((2.5391, 3.4988), abs=1e-3)


def test_nees_of_matched_noise_has_the_mean_of_its_dimension():
    rng = np.random.default_rng(1)
    A = rng.normal(0.0, 1.0, (4, 4))
    P = A @ A.T
    errors = rng.multivariate_normal(np.zeros(4), P, 5000)
    low, high = chi2_bounds(4, 5000, 0.999)
    assert low < nees(errors, np.broadcast_to(P, (5000, 4, 4))).mean() < high


def test_rms_of_nothing():
    assert math.isnan(rms([]))
