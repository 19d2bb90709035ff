"""What is found of an IMU at rest and in six positions."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fusion.measurements import Array
from fusion.params import GRAVITY
from imu.calibration import CalibrationError, at_rest, positions_seen, rests, solve_positions
from imu.mounting import rotation_from_deg
from imu.protocols.csv_lines import CsvLines
from tests.data import data

RATE = 100.0
MATRIX = np.array([[1.02, 0.010, -0.004], [-0.006, 0.985, 0.003], [0.008, -0.002, 1.01]])
BIAS = np.array([0.3, -0.2, 0.4])
SIDES = [(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)]


def readings(parts: list[tuple[float, Array, Array, float, float]], seed: int = 1) -> Array:
    """Of (seconds, mean rate, mean force, scatter of the rate, of the force) one after the other."""
    rng = np.random.default_rng(seed)
    rows = [
        np.hstack([rate + s * rng.standard_normal((n, 3)), force + u * rng.standard_normal((n, 3))])
        for seconds, rate, force, s, u in parts
        for n in [round(seconds * RATE)]
    ]
    body = np.concatenate(rows)
    return np.column_stack([np.arange(len(body)) / RATE, body])


def still(
    seconds: float, rate: tuple[float, ...] = (0.0,) * 3, force: Array | None = None
) -> tuple[float, Array, Array, float, float]:
    return seconds, np.array(rate), np.array([0.0, 0.0, GRAVITY]) if force is None else force, 0.002, 0.03


def moving(seconds: float) -> tuple[float, Array, Array, float, float]:
    return seconds, np.zeros(3), np.array([0.0, 0.0, GRAVITY]), 0.5, 2.0


def test_rest_gives_bias_scatter_and_mounting() -> None:
    mounted = rotation_from_deg((3.0, -5.0, 0.0))
    rest = at_rest(readings([still(12.0, (0.01, -0.02, 0.003), mounted.T @ [0.0, 0.0, GRAVITY])]))
    assert rest.gyro_bias == pytest.approx([0.01, -0.02, 0.003], abs=3e-4)
    assert rest.gyro_scatter == pytest.approx([0.002] * 3, rel=0.1)
    assert rest.accel_scatter == pytest.approx([0.03] * 3, rel=0.1)
    assert rest.rotation_deg == pytest.approx((3.0, -5.0, 0.0), abs=0.05)
    assert rest.rate_hz == pytest.approx(RATE)
    assert mounted @ rest.force == pytest.approx([0.0, 0.0, GRAVITY], abs=0.01)


@pytest.mark.parametrize("rate", [10.0, 99.2, 285.7, 1000.0])
def test_ten_seconds_are_enough_at_any_rate(rate: float) -> None:
    n = int(10.0 * rate) + 1
    lying = readings([still(n / RATE)])
    lying[:, 0] = np.arange(n) / rate
    assert at_rest(lying).rate_hz == pytest.approx(rate)


def test_an_imu_upside_down() -> None:
    rest = at_rest(readings([still(12.0, force=np.array([0.0, 0.0, -GRAVITY]))]))
    assert np.abs(rest.rotation_deg) == pytest.approx([180.0, 0.0, 0.0], abs=0.05)


@pytest.mark.parametrize(
    ("parts", "said"),
    [
        ([still(5.0), moving(1.0), still(6.0)], "it was still for 6 s at most; 10 s are needed"),
        ([moving(12.0)], "it was never still"),
        ([still(3.0)], "3.0 s of readings; 10 s at rest are needed"),
        ([still(12.0, (0.5, 0.0, 0.0))], "never still"),
        ([still(6.0), still(6.0, force=np.array([0.5, 0.0, GRAVITY]))], "still for 6 s at most"),
        ([still(6.0), still(6.0, (0.02, 0.0, 0.0))], "still for 6 s at most"),
        ([still(12.0, force=np.array([0.0, 0.0, 1.0]))], "gravity reads 1 instead of 9.81 m/s2: these are g"),
        ([still(12.0, force=np.array([0.0, 1000.0, 0.0]))], "these are thousandths of g"),
        ([(12.0, np.zeros(3), np.array([0.0, 0.0, 16384.0]), 0.002, 50.0)], "these are raw counts"),
        (
            [(12.0, np.full(3, 0.4), np.array([0.0, 0.0, GRAVITY]), 0.1, 0.03)],
            "never still, or its rates are not rad/s",
        ),
        ([still(12.0, force=np.array([0.0, 0.0, 5.0]))], "the unit or the scale is wrong"),
    ],
)
def test_what_is_no_rest_is_refused(parts: list[tuple[float, Array, Array, float, float]], said: str) -> None:
    with pytest.raises(CalibrationError, match=said):
        at_rest(readings(parts))


def test_a_hand_trembles() -> None:
    """2 deg/s at 5 Hz and level on the mean: no single reading tells it from noise."""
    held = readings([still(12.0)])
    held[:, 1] += 0.035 * np.sin(2.0 * np.pi * 5.0 * held[:, 0])
    with pytest.raises(CalibrationError, match="moved"):
        at_rest(held)


def test_a_fan_shakes_but_does_not_move() -> None:
    shaken = readings([still(12.0)])
    shaken[:, 1] += 0.05 * np.sin(2.0 * np.pi * 30.0 * shaken[:, 0])
    assert at_rest(shaken).gyro_bias == pytest.approx([0.0] * 3, abs=5e-4)


def test_the_longest_rest_counts() -> None:
    rest = at_rest(readings([moving(3.0), still(11.0), moving(2.0), still(14.0), moving(1.0)]))
    assert rest.start == pytest.approx(16.0, abs=1.1)
    assert rest.seconds == pytest.approx(13.0, abs=1.1)


def test_nothing_and_stamps_that_stand_still() -> None:
    for few in (np.empty((0, 7)), np.zeros((1, 7)), np.zeros((500, 7))):
        with pytest.raises(CalibrationError, match="without rising stamps"):
            at_rest(few)


def test_a_pause_of_the_device_is_no_rest() -> None:
    paused = readings([still(15.0)])
    paused[750:, 0] += 60.0
    assert all(stretch.stop <= 750 or stretch.start >= 750 for stretch in rests(paused))


def sides(askew_deg: float, seed: int, extra: int = 0) -> Array:
    """Mean specific forces of a device laid on its six sides by hand, and in `extra` directions more."""
    rng = np.random.default_rng(seed)
    up = [np.array(side, dtype=float) for side in SIDES]
    up += [v / np.linalg.norm(v) for v in rng.standard_normal((extra, 3))]
    lain = [Rotation.from_rotvec(np.radians(askew_deg) * rng.standard_normal(3)).apply(v) for v in up]
    return GRAVITY * np.array(lain) @ np.linalg.inv(MATRIX).T + BIAS


def test_six_sides_on_a_level_table_give_the_whole_matrix() -> None:
    found = solve_positions(sides(0.0, 1))
    assert found.matrix == pytest.approx(MATRIX, abs=1e-4)
    assert found.bias == pytest.approx(BIAS, abs=1e-3)
    assert set(found.sides.values()) == {1}
    assert np.abs(found.error_before).max() > 0.3
    assert np.abs(found.error).max() < 1e-3


def test_laid_by_hand_scale_and_bias_are_still_right_and_the_rest_as_good_as_it_says() -> None:
    pulls = []
    for seed in range(30):
        found = solve_positions(sides(1.0, seed))
        assert np.diag(found.matrix) == pytest.approx(np.diag(MATRIX), abs=2e-3)
        assert found.bias == pytest.approx(BIAS, abs=0.02)
        off = ~np.eye(3, dtype=bool)
        pulls.append(((found.matrix - MATRIX) / found.matrix_sigma)[off])
    assert 0.7 < np.std(pulls) < 1.3


def test_more_positions_make_the_angles_between_the_axes_better() -> None:
    """What turns all axes together is not seen in lengths, what shears them is."""

    def shear(extra: int) -> float:
        errors = [solve_positions(sides(1.0, seed, extra)).matrix @ np.linalg.inv(MATRIX) for seed in range(10)]
        return float(np.std([error + error.T - 2.0 * np.eye(3) for error in errors]))

    assert shear(12) < 0.5 * shear(0)


def test_a_side_that_is_missing_is_named() -> None:
    with pytest.raises(CalibrationError, match=r"5 positions at rest, none with -y up: lay the device"):
        solve_positions(np.delete(sides(0.0, 1), 3, axis=0))


def test_positions_are_found_between_motion_and_counted_once() -> None:
    forces = sides(1.0, 3)
    parts = [part for force in (*forces, forces[0]) for part in (still(4.0, force=force), moving(1.0))]
    seen = positions_seen(readings(parts))
    assert seen == pytest.approx(forces, abs=0.02)


def test_real_rests() -> None:
    """An IMU that lies, is picked up and turned, and lies again."""
    parser = CsvLines()
    lying = np.array(parser.feed((data("rest_and_motion_100hz") / "sensor_data.csv").read_bytes()), dtype=np.float64)
    rest = at_rest(lying)
    assert rest.rate_hz == pytest.approx(99.2, abs=0.1)
    assert rest.gyro_bias == pytest.approx([0.0] * 3, abs=3e-4)
    assert np.linalg.norm(rest.force) == pytest.approx(9.745, abs=0.005)
    with pytest.raises(CalibrationError, match="it was still for 3 s at most"):
        at_rest(lying[(lying[:, 0] > 14.0) & (lying[:, 0] < 75.0)])
    with pytest.raises(CalibrationError, match="never still"):
        at_rest(lying[(lying[:, 0] > 22.0) & (lying[:, 0] < 56.0)])


def test_real_rest_before_and_after_motion() -> None:
    moved = np.loadtxt(data("handheld_mocap") / "imu.csv", delimiter=",", skiprows=1)
    before, after = at_rest(moved[moved[:, 0] < 100.0]), at_rest(moved[moved[:, 0] > 100.0])
    assert before.seconds > 33.0
    assert after.seconds > 33.0
    assert before.gyro_bias == pytest.approx(after.gyro_bias, abs=2e-4)
