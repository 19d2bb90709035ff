"""Clock mapping on simulated links: every figure is against the true time of the sample."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.links import LINKS, MINIMUM_DELAY, SKEW, Traffic, questions, traffic
from fusion.measurements import Array
from imu.clock import JUMP, LATE_FOR, WRAPS, DeviceClock


def stamp(clock: DeviceClock, times: list[float | None], arrival: float) -> Array:
    """The stamps alone; the readings must come through as they are."""
    stamped = clock.stamp([(t, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0) for t in times], arrival)
    assert (stamped[:, 1:] == [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]).all()
    return stamped[:, 0]


def run(sent: Traffic, answers: list[tuple[float, float, float, float]] | None = None) -> tuple[Array, DeviceClock]:
    """Errors of all stamps, and the clock in the end."""
    answers = (answers or [])[::-1]
    clock = DeviceClock()
    stamps = []
    for packet in sent.packets():
        arrival = float(sent.arrival[packet.start])
        while answers and answers[-1][3] < arrival:
            clock.exchange(*answers.pop())
        stamps.append(stamp(clock, sent.device[packet].tolist(), arrival))
    host = np.concatenate(stamps)
    assert (host <= sent.arrival).all(), "a stamp in the future"
    assert (np.diff(host) > 0.0).all(), "stamps that do not rise"
    return host - sent.t, clock


def one_after_the_other(first: Traffic, then: Traffic) -> Traffic:
    arrival = np.maximum(then.arrival, first.arrival[-1] + 1e-6)
    pairs = zip(first, then._replace(arrival=arrival), strict=True)
    return Traffic(*(np.concatenate(pair) for pair in pairs))


@pytest.mark.parametrize("link", LINKS)
def test_ten_minutes_by_arrival_alone(link: str) -> None:
    sent = traffic(LINKS[link], seed=1)
    error, clock = run(sent)
    settled = error[sent.t > 60.0]
    assert settled.std() < 1e-4
    assert MINIMUM_DELAY - 1e-4 < settled.mean() < MINIMUM_DELAY + 2e-4
    assert np.abs(error).max() < 0.05, "also while the line is still young, and in a stall"
    assert clock.skew == pytest.approx(-SKEW, abs=6e-6)
    assert clock.restarts == 0
    assert clock.minimum_delay is None


@pytest.mark.parametrize("link", LINKS)
def test_ten_minutes_with_exchanges(link: str) -> None:
    """The minimum delay goes as well."""
    sent = traffic(LINKS[link], seed=1)
    error, clock = run(sent, questions(2, sent))
    settled = error[sent.t > 60.0]
    assert abs(settled.mean()) < 2e-4
    assert settled.std() < 1e-4
    assert clock.minimum_delay == pytest.approx(MINIMUM_DELAY, abs=3e-4)
    assert clock.restarts == 0


@pytest.mark.parametrize(
    ("device_start", "gap"),
    [(0.0, 3.0), (0.0, 0.3), (5000.0, 0.005), (1234.5 + 29.0, 0.005), (1234.5 + 30.0, 3.0)],
    ids=["reboot", "quick reboot", "jump ahead", "jump back", "the clock slept"],
)
@pytest.mark.parametrize("link", LINKS)
def test_recovery_within_two_seconds(link: str, device_start: float, gap: float) -> None:
    before = traffic(LINKS[link], seed=3, seconds=30.0)
    after = traffic(LINKS[link], seed=4, seconds=5.0, start=float(before.t[-1]) + gap, device_start=device_start)
    error, clock = run(one_after_the_other(before, after))
    assert clock.restarts == 1
    recovered = error[len(before.t) :][after.t > after.t[0] + 2.0]
    # a poll each 16 ms is met within 1 ms by samples each 5 ms, and on the spot only as they drift
    assert np.abs(recovered - MINIMUM_DELAY).max() < 1.5e-3


@pytest.mark.parametrize("wrap", WRAPS)
@pytest.mark.parametrize("link", LINKS)
def test_a_counter_that_starts_again_from_zero_changes_nothing(link: str, wrap: float) -> None:
    sent = traffic(LINKS[link], seed=5, seconds=20.0, device_start=wrap - 4.0)
    answers = questions(6, sent)
    endless, _ = run(sent, answers)
    counted = [(a, received % wrap, answered % wrap, b) for a, received, answered, b in answers]
    error, clock = run(sent._replace(device=sent.device % wrap), counted)
    assert clock.restarts == 0
    # an exchange that lies across the wrap is not used
    assert error == pytest.approx(endless, abs=5e-4)
    assert clock.to_device(float(sent.t[-1])) == pytest.approx(sent.device[-1] % wrap, abs=1e-3)


def test_an_answer_from_beyond_the_wrap_is_no_round_trip() -> None:
    """It overtakes the samples by which the wrap is noticed."""
    clock, wrap = DeviceClock(), 2**32 * 1e-6
    steady(clock, 100.0, wrap - 10.0, 10.0)
    clock.exchange(109.9, wrap - 0.095, wrap - 0.094, 109.911)
    clock.exchange(110.0, 0.005, 0.006, 110.011)
    assert clock.minimum_delay == pytest.approx(0.005, abs=1e-4)
    steady(clock, 110.01, 0.01, 1.0)
    assert clock.restarts == 0
    assert clock.to_host(0.5) == pytest.approx(110.5, abs=1e-4)


def steady(clock: DeviceClock, start: float, device_start: float, seconds: float) -> None:
    """100 Hz, 5 ms of delay."""
    for i in range(int(100 * seconds)):
        clock.observe(device_start + 0.01 * i, start + 0.01 * i + 0.005)


def test_nothing_is_known_before_the_first_stamp() -> None:
    clock = DeviceClock()
    assert math.isnan(clock.to_host(1.0))
    assert math.isnan(clock.to_device(1.0))
    assert clock.minimum_delay is None
    assert clock.stamp([], 1.0).shape == (0, 7)


def test_to_device_is_the_inverse_of_to_host() -> None:
    clock = DeviceClock()
    steady(clock, 100.0, 7.0, 10.0)
    clock.exchange(110.0, 17.002, 17.003, 110.005)
    assert clock.to_device(clock.to_host(12.345)) == pytest.approx(12.345, abs=1e-9)
    assert clock.to_host(17.0025) == pytest.approx(110.0025, abs=1e-5)


def test_a_reboot_is_followed_at_once() -> None:
    clock = DeviceClock()
    steady(clock, 100.0, 500.0, 10.0)
    stamps = stamp(clock, [0.5 + 0.01 * i for i in range(10)], 113.0)
    assert clock.restarts == 1
    assert stamps == pytest.approx(113.0 - 0.09 + 0.01 * np.arange(10), abs=1e-4)


@pytest.mark.parametrize("step", [-1000.0, -1.0, 2.0, 3.15e7])
def test_a_jump_of_the_device_clock_is_followed(step: float) -> None:
    clock = DeviceClock()
    steady(clock, 100.0, 500.0, 10.0)
    steady(clock, 110.0, 510.0 + step, 1.0)
    assert clock.restarts == 1
    assert clock.to_host(511.0 + step) == pytest.approx(111.005, abs=1e-3)


def test_a_device_clock_that_slept_is_followed() -> None:
    clock = DeviceClock()
    steady(clock, 100.0, 500.0, 10.0)
    steady(clock, 120.0, 510.0, LATE_FOR + 0.5)
    assert clock.restarts == 1
    assert clock.to_host(510.0) == pytest.approx(120.005, abs=1e-3)


@pytest.mark.parametrize("link", LINKS)
def test_a_short_sleep_of_the_device_clock_is_followed(link: str) -> None:
    """A tenth of a second is no more than a network's bad time, but always the same."""
    before = traffic(LINKS[link], seed=3, seconds=30.0)
    slept = float(before.t[-1]) + 0.1
    after = traffic(LINKS[link], seed=4, seconds=15.0, start=slept, device_start=float(before.device[-1]))
    error, clock = run(one_after_the_other(before, after))
    assert clock.restarts == 1
    recovered = error[len(before.t) :][after.t > after.t[0] + 9.0]
    assert np.abs(recovered - MINIMUM_DELAY).max() < 1.5e-3


def test_a_crowded_network_is_not_a_jump() -> None:
    """For ten seconds nothing comes within 60 ms, and now more, now less."""
    sent = traffic(LINKS["Wi-Fi"], seed=1, seconds=60.0)
    random = np.random.default_rng(1)
    crowded = np.where(
        (sent.t > 30.0) & (sent.t < 40.0), 0.06 + 0.05 * np.interp(sent.t, np.arange(70), random.random(70)), 0.0
    )
    error, clock = run(sent._replace(arrival=np.maximum.accumulate(sent.arrival + crowded)))
    assert clock.restarts == 0
    assert np.abs(error[sent.t > 20.0] - MINIMUM_DELAY).max() < 2e-3


@settings(max_examples=200)
@given(st.lists(st.tuples(st.none() | st.floats(-1e12, 1e12), st.floats(0.0, 10.0)), max_size=40))
def test_whatever_a_device_stamps_times_rise_and_are_not_in_the_future(sent: list[tuple[float | None, float]]) -> None:
    clock = DeviceClock()
    arrival, last = 100.0, -math.inf
    for device_time, pause in sent:
        arrival += pause
        clock.exchange(arrival - 0.1, device_time or 0.0, (device_time or 0.0) + 0.01, arrival)
        stamps = stamp(clock, [device_time], arrival)
        assert last <= stamps[0] <= arrival
        last = stamps[0]
        assert math.isfinite(clock.to_host(7.0))


def test_a_stall_is_not_a_jump() -> None:
    """Three seconds of samples arrive at once, the oldest three seconds late."""
    clock = DeviceClock()
    steady(clock, 100.0, 500.0, 10.0)
    stamps = stamp(clock, [510.0 + 0.01 * i for i in range(300)], 113.0)
    assert stamps == pytest.approx(110.005 + 0.01 * np.arange(300), abs=1e-3)
    assert clock.restarts == 0


@pytest.mark.parametrize("broken", [-1e12, 0.0, 1e12])
def test_one_broken_stamp_moves_nothing(broken: float) -> None:
    clock = DeviceClock()
    steady(clock, 100.0, 500.0, 10.0)
    before = stamp(clock, [510.0], 110.005)[0]
    odd = stamp(clock, [broken], 110.015)[0]
    after = stamp(clock, [510.02], 110.025)[0]
    assert before < odd < after <= 110.025 + 1e-9
    assert clock.restarts == 0


def test_a_better_route_is_taken_at_once() -> None:
    """The delay falls by less than a jump: the line falls with it, so that no stamp lies in the future."""
    clock = DeviceClock()
    steady(clock, 100.0, 500.0, 10.0)
    earlier = 0.005 - 0.9 * JUMP
    clock.observe(510.0, 110.0 + earlier)
    assert clock.to_host(510.0) == pytest.approx(110.0 + earlier, abs=1e-9)


@pytest.mark.parametrize(
    "answer",
    [(10.0, 5.0, 4.9, 10.01), (10.0, 5.0, 5.5, 10.01), (10.0, math.nan, 5.5, 10.01), (10.0, 5.0, math.nan, 10.01)],
)
def test_an_impossible_exchange_is_ignored(answer: tuple[float, float, float, float]) -> None:
    clock = DeviceClock()
    clock.exchange(*answer)
    assert clock.minimum_delay is None


def test_an_answer_that_overtakes_a_batch_is_no_jump() -> None:
    clock = DeviceClock()
    steady(clock, 100.0, 500.0, 10.0)
    for t in (110.0, 110.1):
        clock.exchange(t + 0.05, t + 400.06, t + 400.061, t + 0.071)
        stamp(clock, [t + 400.0 + 0.01 * i for i in range(10)], t + 0.095)
    assert clock.restarts == 0


def test_samples_without_stamps_fill_the_time_since_the_last_arrival() -> None:
    clock = DeviceClock()
    assert clock.has_stamps is None
    stamp(clock, [None], 10.0)
    assert stamp(clock, [None] * 4, 10.02) == pytest.approx([10.005, 10.01, 10.015, 10.02])
    assert clock.has_stamps is False
    stamp(clock, [7.0], 10.03)
    assert clock.has_stamps is True


def test_a_batch_moves_the_line_as_if_each_of_its_samples_had_been_observed() -> None:
    """Of a usual batch only the newest is."""
    rng = np.random.default_rng(6)
    together, each = DeviceClock(), DeviceClock()
    for i in range(400):
        times: list[float | None] = [50.0 + 0.05 * i + 0.005 * k + (1e4 if i > 300 else 0.0) for k in range(10)]
        if i % 37 == 36:
            times[4] = 1.0
        arrival = 1000.1 + 0.05 * i + float(rng.exponential(3e-3))
        for t in times:
            each.observe(float(t or 0.0), arrival)
        stamp(together, times, arrival)
        assert together.to_host(60.0) == each.to_host(60.0)
        assert together.restarts == each.restarts
    assert each.restarts == 1
