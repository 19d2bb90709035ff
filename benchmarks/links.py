"""Simulated links from an IMU to the host: when it was, what the device's clock said, and when it arrived.

For `benchmarks.imu` and the tests of `imu.clock`. The device samples by its own clock, which is 60 ppm fast and wanders
by some 2 ppm in ten minutes; so its samples drift through the host's polls, as they do in life. No way is shorter than
MINIMUM_DELAY; a part of the arrivals come a good deal later, and now and then the link stalls.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from fusion.measurements import Array

RATE = 200.0  # Hz
SKEW = 60e-6
WANDER = 1e-7  # 1/sqrt(s)
MINIMUM_DELAY = 0.002  # s
BATCH = 10  # samples a message on Wi-Fi
ANSWERING = 0.003  # s that the device takes to answer a question


class Traffic(NamedTuple):
    """All samples of a link, in order: true host time, the device's stamp, and arrival, each (n,) s."""

    t: Array
    device: Array
    arrival: Array

    def packets(self) -> Iterator[slice]:
        """The samples that arrived together, oldest first."""
        edges = np.flatnonzero(np.diff(self.arrival)) + 1
        for begin, end in zip([0, *edges], [*edges, len(self.t)], strict=True):
            yield slice(int(begin), int(end))


def usb(random: np.random.Generator, t: Array, poll: float) -> Array:
    """Arrivals on a USB serial line that is polled each `poll` s; sometimes the host is busy."""
    arrival = np.ceil((t + 0.75 * MINIMUM_DELAY) / poll) * poll + 0.25 * MINIMUM_DELAY
    arrival += random.exponential(20e-6, len(t))
    arrival += np.where(random.random(len(t)) < 2e-3, random.exponential(0.01, len(t)), 0.0)
    arrival += np.where(random.random(len(t)) < 5e-5, random.uniform(0.1, 1.0, len(t)), 0.0)
    return np.maximum.accumulate(arrival)


def usb_1ms(random: np.random.Generator, t: Array) -> Array:
    return usb(random, t, 0.001)


def usb_16ms(random: np.random.Generator, t: Array) -> Array:
    """With an FTDI chip's latency timer as it comes."""
    return usb(random, t, 0.016)


def wifi(random: np.random.Generator, t: Array) -> Array:
    """Messages of BATCH samples, 8 ms more than the least on average, retransmissions, a stall of up to 1 s."""
    messages = -(-len(t) // BATCH)
    delay = MINIMUM_DELAY + random.exponential(0.008, messages)
    delay += np.where(random.random(messages) < 0.05, 0.04, 0.0)
    delay += np.where(random.random(messages) < 1e-3, random.uniform(0.2, 1.0, messages), 0.0)
    last = np.minimum(np.arange(1, messages + 1) * BATCH, len(t)) - 1
    return np.repeat(np.maximum.accumulate(t[last] + delay), BATCH)[: len(t)]


Link = Callable[[np.random.Generator, Array], Array]
LINKS: dict[str, Link] = {"USB 1 ms": usb_1ms, "USB 16 ms": usb_16ms, "Wi-Fi": wifi}


def traffic(link: Link, seed: int, seconds: float = 600.0, start: float = 1.0, device_start: float = 1234.5) -> Traffic:
    """What goes over a link in `seconds` from host time `start`, when the device's clock reads `device_start`."""
    random = np.random.default_rng(seed)
    n = round(seconds * RATE)
    wander = np.cumsum(random.normal(0.0, WANDER / np.sqrt(RATE), n))
    t = start + np.cumsum(1.0 / RATE / (1.0 + SKEW + wander))
    return Traffic(t, device_start + np.arange(1, n + 1) / RATE, link(random, t))


def questions(seed: int, sent: Traffic) -> list[tuple[float, float, float, float]]:
    """A four-timestamp exchange a second, as `DeviceClock.exchange` takes them, in order of arrival.

    Both ways are alike on the mean, as on Wi-Fi, though not each time.
    """
    random = np.random.default_rng(seed)
    exchanges = []
    for asked in np.arange(sent.t[0] + 0.5, sent.t[-1] - 1.0):
        there, back = MINIMUM_DELAY + random.exponential(0.008, 2)
        received, answered = np.interp([asked + there, asked + there + ANSWERING], sent.t, sent.device).tolist()
        exchanges.append((float(asked), received, answered, float(asked + there + ANSWERING + back)))
    return sorted(exchanges, key=lambda exchange: exchange[3])
