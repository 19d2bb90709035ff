import math
import random
import time

import pytest

from camera.stamp import LATEST, OLDEST, WINDOW, StreamClock, host_clocks, host_time


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


def stream(clock, frames):
    """(stamp, arrival) -> what the clock makes of them."""
    return [clock.host_time(stamp, arrival) for stamp, arrival in frames]


def test_a_stream_is_stamped_as_evenly_as_its_camera_does_it():
    """Frames are 20 to 100 ms under way; the stamps' only error is what the promptest took."""
    chance = random.Random(3)
    taken = [500.0 + 0.04 * k for k in range(1000)]
    frames = [(t - 480.0, t + chance.uniform(0.02, 0.1)) for t in taken]
    # The first is of the backlog, as far as anybody knows; the promptest has come within two seconds.
    found = stream(StreamClock(), frames)
    late = [t - true for t, true in zip(found[1:], taken[1:], strict=True)]
    assert max(late[50:]) < 0.03
    assert min(late) >= 0.02 - 1e-9


def test_the_backlog_of_a_stream_that_is_opened_is_left_out():
    backlog = [(0.1 * k, 2.0 + 0.001 * k) for k in range(20)]
    live = [(0.1 * k, 0.03 + 0.1 * k) for k in range(20, 40)]
    found = stream(StreamClock(), backlog + live)
    assert found[:20] == [None] * 20
    assert found[21:] == pytest.approx([arrival for _, arrival in live[1:]])


def test_a_stream_that_stalls_is_stamped_when_it_was_taken():
    clock = StreamClock()
    stream(clock, [(0.1 * k, 7.0 + 0.1 * k) for k in range(20)])
    assert stream(clock, [(2.0 + 0.1 * k, 12.0 + 0.001 * k) for k in range(20)]) == pytest.approx(
        [9.0 + 0.1 * k for k in range(20)]
    )


def test_a_slow_crystal_and_a_clock_that_is_set_are_followed():
    clock = StreamClock()
    *_, last = stream(clock, [(0.04 * k * (1.0 - 1e-4), 0.04 * k) for k in range(20_000)])
    assert last == pytest.approx(0.04 * 19_999, abs=1.1e-4 * WINDOW)
    assert clock.host_time(5.0, 801.0) == pytest.approx(801.0), "set back"
    assert clock.host_time(5.04, 801.04 + LATEST + 1.0) == pytest.approx(802.04 + LATEST), "no frame is so late"


def test_a_stream_without_stamps_is_stamped_on_arrival():
    assert stream(StreamClock(), [(0.0, 5.0 + 0.1 * k) for k in range(200)])[1:] == pytest.approx(
        [5.0 + 0.1 * k for k in range(1, 200)]
    )
