"""Device time to host time, from nothing but stamps that arrive late.

A sample that the device stamped `d` arrives at `host(d) + delay`, and `delay` has a minimum that is met again and
again. A straight line under all points (d, arrival), touching them, is therefore the device's clock plus that minimum
delay: V. Paxson, "On calibrating measurements of packet transit times" (SIGMETRICS 1998); the line is the edge of the
lower convex hull under the middle of the window: S. Moon, P. Skelly, D. Towsley, "Estimation and removal of clock
skew from network delay measurements" (INFOCOM 1999). What is left, the minimum delay itself, is half the best round
trip where the device answers the four-timestamp exchange of NTP (RFC 5905, section 8). The best way there and the best
way back are taken each for itself, since they rarely fall into one exchange; the way back is the samples' line.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from itertools import islice, pairwise
from typing import NamedTuple, TypeGuard

import numpy as np

from fusion.measurements import Array

# s of device time in one bucket, of which only the earliest arrival is kept, and buckets in the window.
BUCKET = 1.0
WINDOW = 60
# s: the slope is believed in full only over a window much longer than this; until then the last one known counts.
SLOPE_SPAN = 10.0
# Largest skew: a crystal has 1e-4, the RC oscillator of a microcontroller 2e-2.
MAX_SKEW = 0.03
# s: a device clock that runs back, or ahead of its line, by more has jumped.
JUMP = 0.03
# s: arrivals that are later than the line by more, without a single better one for LATE_FOR, mean a jump as well (a
# device that slept and whose clock stood still); less is a network having a bad time.
LATE = 0.25
LATE_FOR = 1.5
# Neither is a network's bad time always the same: so many buckets in a row that are later by more than JUMP, but alike
# within ALIKE s, mean a jump.
ALIKE_BUCKETS = 6
ALIKE = 0.002
# s: where counters start again from zero: ticks of 1 us and 1 ms in 16, 24 or 32 bits, the day, the GPS week. Not below
# some seconds: a device that restarts again and again would be taken for one whose counter wraps.
WRAPS = (2**24 * 1e-6, 2**16 * 1e-3, 2**32 * 1e-6, 2**24 * 1e-3, 86400.0, 604800.0, 2**32 * 1e-3)
# Questions kept, for as long as the window at one a second, and by how much (s per s of age) an older one is trusted
# less: the error of the slope.
EXCHANGES = 64
AGEING = 3e-6
# s: the distance between samples that arrive together and bring no stamps, where nothing better is known because the
# one before came longer ago than this for each of them.
UNSTAMPED_SPACING = 1e-3
UNSTAMPED_PAUSE = 0.1
# s: what is put between two stamps that would fall together or back.
MONOTONE_STEP = 1e-6


# The fields of an `imu.protocols.RawSample`, which is one.
Reading = tuple[float | None, float, float, float, float, float, float]


class _Question(NamedTuple):
    """When the host sent it, and when the device received it by its own clock."""

    sent: float
    received: float


class DeviceClock:
    """Maps one device's clock to the host's. No I/O: arrival times are arguments, host monotonic s.

    `restarts` counts the jumps and reboots of the device's clock that were seen; a counter that starts again from zero
    where its digits end is neither. `skew` is the slope of the mapping less one: positive where the device's clock is
    slow. `minimum_delay`: s, half the best round trip; None without one. `has_stamps`: whether the device stamps its
    samples at all; where it does not, their times are no better than those of their arrival. None before the first.
    """

    def __init__(self) -> None:
        self.restarts = 0
        self.has_stamps: bool | None = None
        self.skew = 0.0
        self._last_stamp = -math.inf
        self._last_arrival = -math.inf
        self._forget()

    def _forget(self) -> None:
        """Start again with the next point; the skew is the oscillator's and outlives a reboot."""
        self._origin: tuple[float, float] | None = None
        # (x, y) of the earliest arrival in each bucket: x device time since the origin, y arrival since the origin - x
        self._buckets: deque[tuple[float, float]] = deque(maxlen=WINDOW)
        self._bucket = 0
        self._offset = 0.0
        self._newest = -math.inf
        self._suspect = False
        self._late_since = math.inf
        self._questions: deque[_Question] = deque(maxlen=EXCHANGES)
        self._best: _Question | None = None
        self.minimum_delay: float | None = None
        # s after which the device's counter starts again from zero; inf until it has been seen to.
        self._wrap = math.inf

    def observe(self, device_time: float, arrival: float) -> None:
        """A sample that the device stamped reached the host at `arrival`. Samples come in the order they were taken."""
        unwrapped = self._unwrap(device_time, self._device(arrival))
        if unwrapped < self._newest - JUMP:
            for wrap in WRAPS:
                if self._newest < wrap and -JUMP <= arrival - self._line(device_time + wrap) <= LATE:
                    self._wrap = wrap
                    unwrapped = device_time + wrap
        self._follow(unwrapped, arrival)

    def _follow(self, device_time: float, arrival: float) -> None:
        """The same, on a counter without end."""
        self._observe(device_time, arrival, back=device_time < self._newest - JUMP)
        if not self._suspect:
            self._newest = max(self._newest, device_time)

    def _unwrap(self, device_time: float, near: float) -> float:
        """`device_time` on a counter without end, where it is nearest to `near`."""
        if self._wrap == math.inf:
            return device_time
        return device_time + self._wrap * round((near - device_time) / self._wrap)

    def _observe(self, device_time: float, arrival: float, *, back: bool = False) -> None:
        if self._origin is None:
            self._origin = (device_time, arrival)
            self._buckets.append((0.0, 0.0))
            return
        excess = arrival - self._line(device_time)
        if back or excess < -JUMP:
            # One alone may be a broken number; a second in a row is not.
            if self._suspect:
                self._restart(device_time, arrival)
            else:
                self._suspect = True
            return
        self._suspect = False
        if excess <= LATE:
            self._late_since = math.inf
        elif self._late_since == math.inf:
            self._late_since = arrival
        elif arrival - self._late_since > LATE_FOR:
            self._restart(device_time, arrival)
            return
        x = device_time - self._origin[0]
        y = arrival - self._origin[1] - x
        if x // BUCKET > self._bucket:
            if self._have_moved():
                self._restart(device_time, arrival)
                return
            self._fit()
            self._bucket = int(x // BUCKET)
            self._buckets.append((x, y))
        elif x // BUCKET == self._bucket and y < self._buckets[-1][1]:
            self._buckets[-1] = (x, y)
        # Never above a point: no stamp may lie after its arrival.
        self._offset = min(self._offset, y - self.skew * x)
        self._find_delay()

    def exchange(self, sent: float, received_device: float, sent_device: float, arrival: float) -> None:
        """The host sent at `sent`, the device received and answered by its own clock, the answer came at `arrival`."""
        # The other way round a counter has wrapped between them, and nan is neither.
        if not received_device <= sent_device:
            return
        received_device, sent_device = (self._unwrap(t, self._device(arrival)) for t in (received_device, sent_device))
        # Not `observe`: samples that were waiting for their batch to fill follow, and are older.
        self._observe(sent_device, arrival)
        round_trip = (arrival - sent) - (sent_device - received_device)
        there = self._line(received_device) - sent
        if there < 0.0 or round_trip < 0.0 or self._suspect:
            return
        self._questions.append(_Question(sent, received_device))
        self._choose()
        self._find_delay()

    def to_host(self, device_time: float) -> float:
        """Host time of `device_time`; of a stamp that was observed never later than its arrival.

        nan before the first observation.
        """
        return self._line(self._unwrap(device_time, self._newest)) - (self.minimum_delay or 0.0)

    def to_device(self, t: float) -> float:
        """The device's time at host time `t`, the inverse of `to_host`; nan before the first observation."""
        device_time = self._device(t + (self.minimum_delay or 0.0))
        return device_time if self._wrap == math.inf else device_time % self._wrap

    def stamp(self, samples: Sequence[Reading], arrival: float) -> Array:
        """Samples that arrived together, oldest first -> (n, 7), host time and readings, as an `ImuBatch` takes them.

        Stamps rise from sample to sample, also over calls, and none is later than `arrival` (where both cannot be, at
        a jump of the device's clock, the second holds). Samples without a device time are spread evenly over the time
        since the last arrival: all that is known of them.
        """
        n = len(samples)
        if not n:
            return np.empty((0, 7))
        times = [sample[0] for sample in samples]
        if self._is_usual(times, arrival):
            self.has_stamps = True
            self._follow(times[-1], arrival)
        else:
            for device_time in times:
                self.has_stamps = device_time is not None
                if device_time is not None:
                    self.observe(device_time, arrival)
            if self._wrap != math.inf:
                times = [None if t is None else self._unwrap(t, self._newest) for t in times]
        spacing = (arrival - self._last_arrival) / n
        if not spacing < UNSTAMPED_PAUSE:
            spacing = UNSTAMPED_SPACING
        # `_line`, written out: a call for each sample would be much of the time that this takes.
        origin, host = self._origin or (math.nan, math.nan)
        host += self._offset - (self.minimum_delay or 0.0)
        slope, latest, stamps = 1.0 + self.skew, self._last_stamp, []
        for i, device_time in enumerate(times):
            t = arrival - (n - 1 - i) * spacing if device_time is None else host + slope * (device_time - origin)
            if t < latest + MONOTONE_STEP:
                t = latest + MONOTONE_STEP
            latest = t if t < arrival else arrival
            stamps.append(latest)
        self._last_stamp, self._last_arrival = latest, arrival
        stamped = np.array(samples, dtype=np.float64)
        stamped[:, 0] = stamps
        return stamped

    def _is_usual(self, times: list[float | None], arrival: float) -> TypeGuard[list[float]]:
        """Whether samples that arrived together follow the last ones, oldest first, without a jump or a wrap.

        Then the newest alone can move the line, since it has the least delay of them.
        """
        if self._suspect or self._wrap != math.inf:
            return False
        before = self._newest - JUMP
        for device_time in times:
            if device_time is None or device_time < before:
                return False
            before = device_time
        return self._origin is not None and arrival - self._line(before) >= -JUMP

    def _line(self, device_time: float) -> float:
        """The line under the arrivals, host s."""
        if self._origin is None:
            return math.nan
        x = device_time - self._origin[0]
        return self._origin[1] + x + self._offset + self.skew * x

    def _device(self, arrival: float) -> float:
        """The device's time on the line at `arrival`, on a counter without end."""
        if self._origin is None:
            return math.nan
        return self._origin[0] + (arrival - self._origin[1] - self._offset) / (1.0 + self.skew)

    def _restart(self, device_time: float, arrival: float) -> None:
        self.restarts += 1
        self._forget()
        self._newest = device_time
        self._observe(device_time, arrival)

    def _have_moved(self) -> bool:
        """Whether the newest buckets lie on a line of their own, above the one that they should."""
        if len(self._buckets) <= ALIKE_BUCKETS:
            return False
        above = [y - self.skew * x - self._offset for x, y in islice(reversed(self._buckets), ALIKE_BUCKETS)]
        return min(above) > JUMP and max(above) - min(above) < ALIKE

    def _fit(self) -> None:
        """Slope and offset from the buckets of the window."""
        points = self._buckets
        span = points[-1][0] - points[0][0]
        if span > 0.0:
            # Shrunk towards the last slope: over a short window the hull's slope is mostly the scatter of the delays.
            weight = span * span / (span * span + SLOPE_SPAN * SLOPE_SPAN)
            slope = self.skew + weight * (_hull_slope(points) - self.skew)
            self.skew = min(max(slope, -MAX_SKEW), MAX_SKEW)
        self._offset = min(y - self.skew * x for x, y in points)
        self._choose()

    def _choose(self) -> None:
        """The question that was the quickest on its way there."""
        slope = 1.0 + self.skew - AGEING
        self._best = min(self._questions, key=lambda q: slope * q.received - q.sent, default=None)

    def _find_delay(self) -> None:
        """Half of the best way there and the best way back, which the line is."""
        if self._best is not None:
            self.minimum_delay = max(0.0, 0.5 * (self._line(self._best.received) - self._best.sent))


def _hull_slope(points: Sequence[tuple[float, float]]) -> float:
    """Slope of the lower convex hull's edge under the middle of `points`, which are sorted by x.

    Of all lines below the points this edge has the least sum of distances to them (for evenly spread x).
    """
    hull: list[tuple[float, float]] = []
    for x, y in points:
        while len(hull) > 1:
            (x0, y0), (x1, y1) = hull[-2:]
            if (y1 - y0) * (x - x1) < (y - y1) * (x1 - x0):
                break
            hull.pop()
        hull.append((x, y))
    middle = 0.5 * (points[0][0] + points[-1][0])
    for (x0, y0), (x1, y1) in pairwise(hull):
        if x1 >= middle:
            return (y1 - y0) / (x1 - x0)
    return 0.0
