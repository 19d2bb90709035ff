"""The oracle: the kernels and filterpy, fed with the same, come to the same to nine digits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fusion import kernels as k
from fusion.consistency import attitude_angle
from fusion.localiser import Localiser
from fusion.measurements import ImuBatch, PoseFix, PoseHypothesis, WheelOdometry
from fusion.params import FilterParams
from fusion.simulator import CameraParams, ImuParams, WheelParams, random_ground, simulate
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


def trouble(seed):
    """A drive with stops on which all goes wrong, one thing after the other. -> measurements in order of arrival."""
    course = replace(random_ground(seed), go=4.0, period=6.0)
    wheels = WheelParams(rate=10.0, scale_sigma=0.05, slip_rate=0.5)
    drive = simulate(course, seed, 36.0, ImuParams(rate=100.0), CameraParams(rate=3.0), wheels=wheels)
    samples, readings = drive.samples.copy(), drive.wheels.copy()

    def at(t):
        return int(np.searchsorted(samples[:, 0], t - 1e-6))

    samples[at(8.0) : at(8.4), 1:] = samples[at(8.0), 1:]  # stuck
    samples[at(9.0), 4:] += 100.0  # a spike
    samples[at(9.5), 1] = 1000.0  # and one that no sensor can say
    samples[at(10.0) : at(10.06), 6] = 18.0  # saturated
    samples = np.delete(samples, slice(at(12.0), at(14.5)), axis=0)
    readings[20:23, 1], readings[40:43, 2] = np.nan, np.nan
    readings[50] = readings[49]  # the same stamp again
    pause = 30.0  # of everything
    samples[at(30.0) :, 0] += pause
    readings[readings[:, 0] >= 30.0, 0] += pause
    chunks = [ImuBatch("rover", 0.0, samples[i : i + 10]) for i in range(0, len(samples), 10)]
    chunks += [WheelOdometry("rover", 0.0, readings[i : i + 3]) for i in range(0, len(readings), 3)]
    measurements = [(chunk.samples[-1, 0] + 0.02, chunk) for chunk in chunks]
    for fix in drive.fixes:
        t, delay, (pose,) = fix.t, fix.arrival - fix.t, fix.hypotheses
        if 22.0 < t < 26.0:
            continue  # coasting
        if 16.0 < t < 18.0:
            pose = replace(pose, covariance=np.diag([2.5e-5] * 3 + [100.0] * 3))  # of the attitude it says nothing
        if 18.0 < t < 21.0:
            w, x, y, z = pose.quaternion_wxyz
            pose = replace(pose, quaternion_wxyz=np.array([w - z, x + y, y - x, z + w]) * np.sqrt(0.5))
        if t < 5.0:
            pose = replace(pose, systematic=np.diag([1e-4] * 6))
        t += pause if t >= 30.0 else 0.0
        measurements.append((t + delay, PoseFix("rover", t, t + delay, (pose,), "ceiling")))
    far = drive.fixes[0]
    measurements.append((27.0, ImuBatch("rover", 0.0, samples[:1] + [1e6, 0, 0, 0, 0, 0, 0])))
    measurements.append((27.0, WheelOdometry("rover", 0.0, readings[:1] + [2e6, 0, 0])))
    measurements.append((27.0, PoseFix("rover", 3e6, 3e6, far.hypotheses, "ceiling")))
    return [m for _, m in sorted(measurements, key=lambda pair: pair[0])]


def met(state):
    """Which of the troubles the kernels' state shows."""
    bridging, trailing = state[k.BRIDGING] > 0.0, state[k.TRAILING] > 0.0
    coasting = state[k.T] - state[k.T_ACCEPTED] > k.COAST_TIME and state[k.PLACE_COUNT] > 10.0
    attitude = np.diag(state[k.COV : k.COV + k.N * k.N].reshape(k.N, k.N))[:3].max()
    shown = {
        "stuck": state[k.SAME_RUN] >= k.STUCK_AFTER and bridging,
        "spike": state[k.SUSPECT] > 0.0,
        "saturated": state[k.BLIND] > 0.0 and state[k.SUSPECT] == 0.0,
        "still": state[k.STILL_FIXES] > 1.0,
        "wheels alone": trailing and state[k.T] - state[k.T_IMU] > 2.0 and state[k.T] - state[k.T_WHEEL] < 0.2,
        "one NaN": state[k.T_WHEEL] > 1.0 and state[k.WHEEL_RATE] == 0.0,
        "coasting": coasting and not bridging,
        "systematic": state[k.SYSTEMATIC] > 0.0,
        "lost": attitude > 2.0 * k.UNKNOWN_HEADING**2,
    }
    return {name for name, shows in shown.items() if shows}


def compare_states(engines):
    a, b = (engine._timeline.state[: k.CORRECTED] for engine in engines)
    b[: k.V] *= np.sign(a[: k.V] @ b[: k.V])  # q and -q are the same rotation
    np.testing.assert_allclose(a, b, atol=1e-9)


def compare_outcomes(kernels, reference):
    assert [o.outcome for o in kernels] == [o.outcome for o in reference]
    for a, b in zip(kernels, reference, strict=True):
        np.testing.assert_allclose(a.d2, b.d2, rtol=1e-9)
        np.testing.assert_allclose(a.margin, b.margin, rtol=1e-9)
        np.testing.assert_allclose(a.innovation, b.innovation, atol=1e-9)
        assert a.hypothesis == b.hypothesis


def compare_poses(engines, t, channel="best"):
    a, b = (engine.pose_at(t, channel) for engine in engines)
    np.testing.assert_allclose(a.position, b.position, atol=1e-9)
    same_way = np.sign(a.quaternion_wxyz @ b.quaternion_wxyz)
    np.testing.assert_allclose(same_way * a.quaternion_wxyz, b.quaternion_wxyz, atol=1e-9)
    np.testing.assert_allclose(a.velocity, b.velocity, atol=1e-9)
    np.testing.assert_allclose(a.angular_velocity, b.angular_velocity, atol=1e-9)
    np.testing.assert_allclose(a.covariance, b.covariance, atol=1e-9)
    np.testing.assert_allclose(a.velocity_covariance, b.velocity_covariance, atol=1e-9)
    assert (a.mode, a.reset_id) == (b.mode, b.reset_id)
    np.testing.assert_allclose(a.reset_step, b.reset_step, atol=1e-9)
    assert a.fix_age == pytest.approx(b.fix_age, abs=1e-9)


@pytest.mark.parametrize("motion", ["free", "ground", "differential"])
@pytest.mark.parametrize("seed", [0, 1])
def test_kernels_equal_filterpy(motion, seed):
    engines = [Localiser("rover", ALL_STATES, motion, engine) for engine in ("numba", "filterpy")]
    seen = set()
    for measurement in inputs(seed):
        kernels, reference = (engine.feed(measurement) for engine in engines)
        compare_outcomes(kernels, reference)
        seen |= {o.outcome.name for o in kernels}
        if engines[0].started:
            compare_states(engines)
    assert {"INITIALISED", "ACCEPTED", "REJECTED", "REINITIALISED"} <= seen
    assert engines[0].counts == engines[1].counts
    for t in (7.77, 8.9, 9.99, 10.05, 10.7, 30.0):
        compare_poses(engines, t)
    for t in (9.0, 9.99, 10.05, 10.7):
        compare_poses(engines, t, "smooth")


@pytest.mark.parametrize("motion", ["free", "ground", "differential"])
def test_in_trouble_too_kernels_equal_filterpy(motion):
    engines = [Localiser("rover", ALL_STATES, motion, engine) for engine in ("numba", "filterpy")]
    seen = set()
    for measurement in trouble(3):
        # sample by sample, so that nothing passes unseen
        parts = [measurement]
        if not isinstance(measurement, PoseFix):
            parts = [replace(measurement, samples=row[np.newaxis]) for row in measurement.samples]
        for part in parts:
            kernels, reference = (engine.feed(part) for engine in engines)
            compare_outcomes(kernels, reference)
            seen |= met(engines[0]._timeline.state) | {o.outcome.name for o in kernels}
            if any(o.outcome.name == "INFLATED" and o.d2_attitude > 3.0 * ALL_STATES.gate_block for o in kernels):
                seen.add("turned")
        if engines[0].started:
            compare_states(engines)
            newest = engines[0]._timeline.state[k.T]
            for t in (newest - 0.333, newest + 1e-6, newest + 0.1, newest + 1.0):
                if engines[0].pose_at(t) is not None:
                    compare_poses(engines, t, "smooth")
    assert seen >= {
        *("stuck", "spike", "saturated", "still", "wheels alone", "one NaN"),
        *("turned", "coasting", "systematic", "lost"),
        *("INITIALISED", "ACCEPTED", "INFLATED", "REINITIALISED", "TOO_LATE"),
    }
    assert engines[0].counts == engines[1].counts
    assert engines[0].counts["imu_late"] == engines[0].counts["wheel_late"] == engines[0].counts["too_late"] == 1
    assert engines[0].counts["wheel_duplicates"] == 1


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
