import math
import time

import pytest

from camera.stamp import OLDEST, host_clocks, host_time


@pytest.mark.parametrize("clock", ["monotonic", "boot time", "wall"])
@pytest.mark.parametrize("suspended", [7.0, 3600.0])
def test_a_stamp_of_any_clock_comes_out_on_the_monotonic_one(clock, suspended):
    clocks = {"monotonic": 5000.0, "boot time": 5000.0 + suspended, "wall": 1.8e9}
    t, name = host_time(clocks[clock] - 0.03, clocks)
    assert name == clock
    assert t == pytest.approx(4999.97, abs=1e-6)


def test_where_two_clocks_read_the_same_the_monotonic_one_is_named():
    assert host_time(4999.97, {"monotonic": 5000.0, "boot time": 5000.0}) == (pytest.approx(4999.97), "monotonic")


def test_a_stamp_is_never_later_than_now():
    assert host_time(5000.0005, {"monotonic": 5000.0}) == (5000.0, "monotonic")


@pytest.mark.parametrize("stamp", [0.0, 5000.1, 5000.0 - OLDEST - 0.01, math.nan, math.inf, -1.0])
def test_a_stamp_that_fits_no_clock_is_none(stamp):
    """Such as the time since the start of a stream, or no stamp at all."""
    assert host_time(stamp, {"monotonic": 5000.0, "boot time": 9000.0, "wall": 1.8e9}) is None


def test_the_clocks_of_this_machine():
    clocks = host_clocks()
    assert next(iter(clocks)) == "monotonic"
    assert clocks["monotonic"] <= time.monotonic()
    t, name = host_time(clocks["wall"] - 0.2, clocks)
    assert name == "wall"
    assert t == pytest.approx(clocks["monotonic"] - 0.2, abs=1e-6)
