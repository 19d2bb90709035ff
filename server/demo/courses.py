"""What the three robots drive: closed courses in the floor plan that keep half a metre from each other."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise

Point = tuple[float, float]

# m between the points that stand for a course.
SPACING = 0.01


@dataclass(frozen=True, slots=True)
class Course:
    """A closed line, as points every SPACING m along it; `speed` in m/s where it is straight.

    `stops`: where along it (m from its start) a robot stands still, for `pause` s.
    """

    points: tuple[Point, ...]
    speed: float
    stops: tuple[float, ...] = ()
    pause: float = 0.0

    @property
    def length(self) -> float:
        return len(self.points) * SPACING

    def at(self, station: float) -> Point:
        """The point at `station` m along the course, which goes round."""
        return self.points[round(station / SPACING) % len(self.points)]

    def heading(self, station: float) -> float:
        """rad: the direction of the course there."""
        (x0, y0), (x1, y1) = self.at(station - SPACING), self.at(station + SPACING)
        return math.atan2(y1 - y0, x1 - x0)

    def nearest(self, x: float, y: float, near: float | None) -> float:
        """The station closest to (x, y): just before and ahead of `near`, or anywhere if that is None."""
        n = len(self.points)
        candidates: Iterable[int] = range(n)
        if near is not None:
            # Not the whole course: a figure of eight crosses itself.
            middle = round(near / SPACING)
            candidates = range(middle - 20, middle + 50)
        return SPACING * min(
            candidates, key=lambda i: (self.points[i % n][0] - x) ** 2 + (self.points[i % n][1] - y) ** 2
        )


def _evenly(corners: Sequence[Point]) -> tuple[Point, ...]:
    """The closed line through `corners` as points that are SPACING apart."""
    closed = [*corners, corners[0]]
    lengths = [0.0, *accumulate(math.dist(a, b) for a, b in pairwise(closed))]
    count = round(lengths[-1] / SPACING)
    points, i = [], 0
    for k in range(count):
        along = k * lengths[-1] / count
        while lengths[i + 1] <= along:
            i += 1
        s = (along - lengths[i]) / (lengths[i + 1] - lengths[i])
        (x0, y0), (x1, y1) = closed[i : i + 2]
        points.append((x0 + s * (x1 - x0), y0 + s * (y1 - y0)))
    return tuple(points)


def _figure_eight(x: float, y: float, half_length: float) -> tuple[Point, ...]:
    """Bernoulli's lemniscate, upright."""
    corners = []
    for i in range(1000):
        a = 2.0 * math.pi * i / 1000
        r = half_length / (1.0 + math.sin(a) ** 2)
        corners.append((x + r * math.sin(a) * math.cos(a), y + r * math.cos(a)))
    return _evenly(corners)


def _rounded_rectangle(x: float, y: float, width: float, height: float, radius: float) -> tuple[Point, ...]:
    """Anticlockwise, from the end of its lower side."""
    corners = []
    for quarter, (sx, sy) in enumerate(((1, -1), (1, 1), (-1, 1), (-1, -1))):
        for i in range(101):
            a = 0.5 * math.pi * (quarter - 1 + i / 100)
            corners.append(
                (
                    x + sx * (0.5 * width - radius) + radius * math.cos(a),
                    y + sy * (0.5 * height - radius) + radius * math.sin(a),
                )
            )
    return _evenly(corners)


def course(name: str) -> Course:
    """One of `eight`, `rectangle`, `stops`."""
    match name:
        case "eight":
            return Course(_figure_eight(-0.95, 0.0, 1.1), speed=0.6)
        case "rectangle":
            return Course(_rounded_rectangle(0.95, 0.75, 1.5, 0.9, 0.3), speed=0.8)
        case "stops":
            return Course(_rounded_rectangle(0.95, -0.75, 1.5, 0.9, 0.4), speed=0.5, stops=(0.4, 1.9, 2.6), pause=2.0)
    raise ValueError(f"{name}: eight, rectangle or stops")
