"""The oracle: the kernels and filterpy, fed with the same, come to the same to nine digits."""

from __future__ import annotations

import numpy as np
import pytest

from fusion import kernels as k
from fusion.consistency import attitude_angle
from fusion.localiser import Localiser
from fusion.measurements import ImuBatch, PoseFix, PoseHypothesis
from fusion.params import FilterParams
from tests.fusion import circle

ALL_STATES = FilterParams(time_offset_sigma=0.05, tilt_sigma=0.03, stamp_jitter=0.005)


def inputs(seed):
    """Ten seconds of everything: late, early and overtaking fixes, outliers, flips, gaps, repeated and late samples."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, 10.0, 0.01)
    t = t[(t < 4.0) | (t > 4.5)]  # a pause of the IMU
    samples = circle.imu(t, rng)
    measurements = []
    for i in range(0, len(t), 10):
        chunk = samples[i : i + 10]
        if i == 300:
            chunk = np.vstack([chunk, chunk[-3:], chunk[2] + [0, 1, 0, 0, 0, 0, 0]])  # the same stamps again
        measurements.append((chunk[-1, 0] + (0.3 if i == 500 else 0.01), ImuBatch("rover", 0.0, chunk)))
    for i, at in enumerate(np.arange(0.05, 9.9, 0.25)):
        offset = rng.normal(0.0, 0.3, 3) if i % 7 == 3 else np.zeros(3)
        if i > 30:
            offset = np.array([0.4, 0.2, 0.0])  # carried away
        right = circle.hypothesis(at, rng, offset)
        hypotheses: tuple[PoseHypothesis, ...] = (right,)
        if i % 3 == 0:
            w, x, y, z = right.quaternion_wxyz
            flipped = PoseHypothesis(
                right.position + 0.01, [w, x + 0.2, y, z] / np.sqrt(1.04 + 0.4 * x), right.covariance
            )
            hypotheses = (flipped, right) if i % 2 else (right, flipped)
        arrival = at + rng.uniform(-0.02, 0.4)
        measurements.append((arrival, PoseFix("rover", at, arrival, hypotheses, "ceiling")))
    return [m for _, m in sorted(measurements, key=lambda pair: pair[0])]


@pytest.mark.parametrize("motion", ["free", "ground", "differential"])
@pytest.mark.parametrize("seed", [0, 1])
def test_kernels_equal_filterpy(motion, seed):
    engines = [Localiser("rover", ALL_STATES, motion, engine) for engine in ("numba", "filterpy")]
    seen = set()
    for measurement in inputs(seed):
        kernels, reference = (engine.feed(measurement) for engine in engines)
        assert [o.outcome for o in kernels] == [o.outcome for o in reference]
        for a, b in zip(kernels, reference, strict=True):
            np.testing.assert_allclose(a.d2, b.d2, rtol=1e-9)
            np.testing.assert_allclose(a.margin, b.margin, rtol=1e-9)
            np.testing.assert_allclose(a.innovation, b.innovation, atol=1e-9)
            assert a.hypothesis == b.hypothesis
            seen.add(a.outcome.name)
        if engines[0].started:
            a, b = (engine._timeline.state[: k.CORRECTED] for engine in engines)
            b[: k.V] *= np.sign(a[: k.V] @ b[: k.V])  # q and -q are the same rotation
            np.testing.assert_allclose(a, b, atol=1e-9)
    assert {"INITIALISED", "ACCEPTED", "REJECTED", "REINITIALISED"} <= seen
    assert engines[0].counts == engines[1].counts
    instants = [(7.77, "best"), (8.9, "best"), (9.99, "best"), (10.05, "best"), (10.7, "best"), (30.0, "best")]
    for t, channel in [*instants, (9.0, "smooth"), (9.99, "smooth"), (10.05, "smooth"), (10.7, "smooth")]:
        a, b = (engine.pose_at(t, channel) for engine in engines)
        np.testing.assert_allclose(a.position, b.position, atol=1e-9)
        assert abs(a.quaternion_wxyz @ b.quaternion_wxyz) == pytest.approx(1.0, abs=1e-15)
        np.testing.assert_allclose(a.velocity, b.velocity, atol=1e-9)
        np.testing.assert_allclose(a.covariance, b.covariance, atol=1e-9)
        np.testing.assert_allclose(a.velocity_covariance, b.velocity_covariance, atol=1e-9)
        assert (a.mode, a.reset_id) == (b.mode, b.reset_id)
        np.testing.assert_allclose(a.reset_step, b.reset_step, atol=1e-9)
        assert a.fix_age == pytest.approx(b.fix_age, abs=1e-9)


@pytest.mark.parametrize("channel", ["best", "smooth"])
def test_the_track_is_the_same(channel):
    tracks = []
    for engine in ("numba", "filterpy"):
        localiser = Localiser("rover", FilterParams(), "ground", engine)
        parts = []
        for measurement in inputs(2):
            track = np.full((len(measurement.samples), 8), np.nan) if isinstance(measurement, ImuBatch) else None
            localiser.feed(measurement, track, channel)
            localiser.pose_at(9.0, channel)  # that something is published changes what is smoothed
            parts += [] if track is None else [track]
        tracks.append(np.concatenate(parts))
    assert np.isfinite(tracks[0][:, 1]).sum() > 900
    np.testing.assert_allclose(tracks[0][:, :4], tracks[1][:, :4], atol=1e-9)
    known = np.isfinite(tracks[0][:, 1])
    assert attitude_angle(tracks[0][known, 4:], tracks[1][known, 4:]).max() < 1e-9


def test_the_reference_forgets_what_is_past_use():
    localiser = Localiser("rover", FilterParams(buffer=0.6), "ground", "filterpy")
    for i in range(40):
        t = np.arange(i, i + 1, 0.02)
        localiser.feed(circle.batch(t))
        localiser.feed(circle.fix(i + 0.5, 0.4))
    assert len(localiser._timeline._samples) < 1500
    assert localiser.counts["accepted"] == 39
