"""Readings of an IMU that is crooked, wrong and not in the middle become the body's."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from fusion.consistency import track_error
from fusion.localiser import Localiser
from fusion.measurements import Array
from fusion.simulator import ImuParams, figure_eight, simulate
from imu.mounting import BodyReadings, ImuCalibration, deg_from_rotation, rotation_from_deg, toml_lines
from server.recording import Recording
from server.replay import replay

CROOKED = ImuCalibration(
    position_m=(0.11, -0.05, 0.04),
    rotation_deg=(178.0, 3.0, -91.0),
    gyro_bias=(0.01, -0.02, 0.003),
    accel_bias=(0.2, -0.1, 0.05),
    accel_matrix=((1.01, 0.002, 0.0), (-0.003, 0.99, 0.001), (0.0, 0.004, 1.02)),
)


def some_readings(n: int = 200) -> Array:
    t = 0.005 * np.arange(n)
    w = np.column_stack([np.sin(3.0 * t), 0.5 * np.cos(5.0 * t), 2.0 * np.sin(t)])
    f = np.column_stack([np.cos(2.0 * t), np.sin(7.0 * t), 9.8 + np.cos(t)])
    return np.column_stack([t, w, f])


def test_a_perfect_imu_is_left_as_it_is() -> None:
    readings = some_readings()
    assert BodyReadings(ImuCalibration())(readings) is readings


@given(*(st.floats(-180.0, 180.0),) * 3)
def test_angles_and_rotations_are_each_others_inverse(roll: float, pitch: float, yaw: float) -> None:
    rotation = rotation_from_deg((roll, pitch, yaw))
    assert rotation == pytest.approx(Rotation.from_euler("ZYX", [yaw, pitch, roll], degrees=True).as_matrix())
    assert rotation_from_deg(deg_from_rotation(rotation)) == pytest.approx(rotation, abs=1e-7)


@pytest.mark.parametrize("pitch", [90.0, -90.0])
def test_an_imu_on_its_side(pitch: float) -> None:
    rotation = rotation_from_deg((0.0, pitch, 30.0))
    assert deg_from_rotation(rotation) == pytest.approx((0.0, pitch, 30.0))


def test_errors_and_rotation_are_taken_out() -> None:
    true = some_readings()
    body_from_imu = rotation_from_deg(CROOKED.rotation_deg)
    seen = true.copy()
    seen[:, 1:4] = true[:, 1:4] @ body_from_imu + CROOKED.gyro_bias
    seen[:, 4:] = true[:, 4:] @ body_from_imu @ np.linalg.inv(CROOKED.accel_matrix).T + CROOKED.accel_bias
    here = ImuCalibration(
        *((0.0, 0.0, 0.0), *(getattr(CROOKED, name) for name in ImuCalibration.__struct_fields__[1:]))
    )
    assert BodyReadings(here)(seen) == pytest.approx(true, abs=1e-12)


def test_on_a_turntable_the_lever_arm_pulls_outwards() -> None:
    """0.2 m off the axis at 3 rad/s: 1.8 m/s2 towards it; while it speeds up by 2 rad/s2, 0.4 m/s2 along."""
    t = 0.005 * np.arange(1000)
    still = np.zeros((len(t), 7))
    still[:, 0], still[:, 6] = t, 9.8
    seen = still.copy()
    seen[:, 3] = np.minimum(2.0 * t, 3.0)
    seen[:, 4] = -0.2 * seen[:, 3] ** 2
    seen[:, 5] = np.where(t <= 1.5, 0.4, 0.0)
    corrected = BodyReadings(ImuCalibration(position_m=(0.2, 0.0, 0.0)))(seen)
    assert corrected[:, 1:4] == pytest.approx(seen[:, 1:4])
    # not the first sample, which has none before it, nor those at the edge
    settled = (t > 0.004) & (np.abs(t - 1.5) > 0.006)
    assert corrected[settled, 4:] == pytest.approx(still[settled, 4:], abs=1e-9)


@settings(max_examples=50)
@given(st.lists(st.integers(0, 200), max_size=8))
def test_how_readings_are_cut_into_batches_changes_not_one_bit(cuts: list[int]) -> None:
    readings = some_readings()
    to_body = BodyReadings(CROOKED)
    parts = [to_body(part) for part in np.split(readings, sorted(cuts))]
    np.testing.assert_array_equal(np.concatenate(parts), BodyReadings(CROOKED)(readings))


@pytest.mark.parametrize("step", [0.0, 1e-6, -0.5, 30.0])
def test_a_stamp_out_of_step_is_no_blow(step: float) -> None:
    """Where angular acceleration cannot be told, the sample that comes with it stays within what samples are."""
    readings = some_readings()
    readings[100:, 0] += step - 0.005
    corrected = BodyReadings(ImuCalibration(position_m=(0.2, 0.1, 0.0)))(readings)
    assert np.isfinite(corrected).all()
    assert np.abs(corrected[:, 4:] - readings[:, 4:]).max() < 3.0


@pytest.mark.parametrize("motion", ["differential", "free"])
def test_the_filter_does_as_well_as_with_an_imu_in_the_middle(motion: str) -> None:
    """Also on wheels, where it is the robot that does not slide sideways, and not the IMU."""
    lever = (0.3, 0.0, 0.1)

    def error_mm(place: tuple[float, float, float], told: tuple[float, float, float], seed: int) -> float:
        simulation = simulate(figure_eight(), seed, duration=40.0, imu=ImuParams(lever_arm=place))
        samples = BodyReadings(ImuCalibration(position_m=told))(simulation.samples)
        recording = Recording("robot", samples, simulation.arrival, simulation.fixes, None)
        track, _, _ = replay(recording, Localiser("robot", None, motion))  # type: ignore[arg-type]
        return 1e3 * track_error(track[track[:, 0] > 10.0], simulation.truth).position_rmse

    nowhere = (0.0, 0.0, 0.0)
    middle, told, ignored = (
        np.mean([error_mm(place, say, seed) for seed in range(3)])
        for place, say in ((nowhere, nowhere), (lever, lever), (lever, nowhere))
    )
    assert told < 1.1 * middle
    assert ignored > 2.0 * middle


def test_what_is_as_by_default_is_not_written() -> None:
    assert toml_lines(ImuCalibration()) == []
    assert toml_lines(ImuCalibration(gyro_bias=(1e-5, 0.0, -0.25))) == ["gyro_bias = [1e-05, 0.0, -0.25]"]
