"""What is wrong with an IMU's stream, in words, from the stream alone: no fixes and no filter are needed.

The last seconds are kept; `StreamHealth.findings` looks at them when it is asked. It judges by what every IMU on Earth
has in common: gravity, a gyroscope that is quiet at rest, noise in the last digits, and that gravity turns in the
sensor's axes as its gyroscope says.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Iterator, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion.measurements import Array
from fusion.params import GRAVITY
from imu.clock import Reading
from imu.protocols import Parser

KEEP = 4096  # samples that stay
WINDOW = 10.0  # s before the newest sample that are looked at
LEAST = 25  # samples, and s, without which nothing is said
LEAST_SECONDS = 0.5

# m/s2: a median specific force outside is in another unit, or of a broken sensor.
FORCE_RANGE = (0.7 * GRAVITY, 1.3 * GRAVITY)
# What gravity reads where it reads something else, within UNIT_SHARE; the counts are those of MEMS sensors of 16 bits.
UNIT_SHARE = 0.15
UNITS = (
    (1.0, "these are g, not m/s2"),
    (1000.0, "these are thousandths of g, not m/s2"),
    (GRAVITY * GRAVITY, "these are m/s2 that were taken for g and multiplied by 9.81 again"),
    (980.665, "these are cm/s2, not m/s2"),
    (32.174, "these are ft/s2, not m/s2"),
    *((2048.0 * 2**i, f"these are raw counts of a sensor with +-{16 >> i} g full scale, not m/s2") for i in range(4)),
)
# Of gravity: less is none. A phone's "linear acceleration" is such.
NO_FORCE = 0.05

# Rest: blocks of REST_BLOCK s whose specific force scatters by less and whose means differ by less than these shares of
# gravity, REST s of them.
REST_BLOCK, REST = 0.5, 1.0
REST_SCATTER, REST_CHANGE = 0.015, 0.01
# rad/s: a gyroscope that scatters more at rest, from sample to sample, or reads more, is in deg/s: the poorest have
# 0.005 and, before calibration, 0.1.
REST_NOISE, REST_RATE = 0.03, 0.2
# rad/s: 2000 deg/s are the full scale of nearly all gyroscopes.
FULL_SCALE, BEYOND = 35.0, 3
# rad: gravity further from +z than this, at rest, is said; further than the second, it is on another axis.
TILT, WRONG_AXIS = math.radians(15.0), math.radians(45.0)

# Gravity's turning against the gyroscope's: s between looks, rad in all that are needed, and how well they must agree.
TURN_STEP, TURN_LEAST, TURN_AGREE, TURN_DISAGREE = 0.1, 1.0, 0.9, 0.75

# Identical readings at the end, of both sensors or of one; some gyroscopes are set to send zeros at rest.
STUCK_SAMPLES, STUCK_SECONDS, STUCK_SECONDS_OF_ONE = 25, 0.5, 2.0
REPEATED = 0.3  # share of readings that are the ones before

GAP = 1.75  # times the usual step
GAPS_LEAST, GAPS_SHARE = 3, 0.01
DROPPED_LEAST, DROPPED_SHARE = 3, 0.01  # lines or frames, and their share, unless it is most of them
CLOCK_SPAN, CLOCK_SHARE = 2.0, 0.05  # s, share: by how much the device's clock may be fast
CLOCK_UNITS = ((1e3, "milliseconds"), (1e6, "microseconds"), (1e9, "nanoseconds"))
# s between the arrivals of batches that are those of an FTDI's latency timer; others are as the device makes them.
LATENCY_TIMER = (0.012, 0.020)

# A finding that only who has the sensor in hand can judge: a robot that drives even circles looks the same.
TURNS_AT_REST = "gyro_at_rest"


class Finding(NamedTuple):
    """As a `fusion.diagnosis.Diagnosis`, whose codes these share where they mean the same."""

    code: str
    severity: Literal["note", "warning", "error"]
    text: str
    evidence: dict[str, Any]


class Rest(NamedTuple):
    """The latest readings, which are at rest: (3,) each, in the units that come, sigmas of single samples.

    `seconds` is NaN where samples have no time. `gyro_noise`: the largest scatter from sample to sample of an axis of
    the gyroscope, which a slow turn does not have.
    """

    seconds: float
    gyro: Array
    gyro_sigma: Array
    force: Array
    force_sigma: Array
    gyro_noise: float


class _Window:
    """Samples (n, 9): by the device's clock, arrival, as stamped, rates, forces. They are kept one row a quantity:
    reductions along what lies side by side in memory are several times as fast."""

    def __init__(self, samples: Array) -> None:
        rows = np.ascontiguousarray(samples.T)
        self.device, self.arrival, self.t = rows[:3]
        self.readings, self.gyro, self.force = rows[3:], rows[3:6], rows[6:]

    def __len__(self) -> int:
        return len(self.t)

    @functools.cached_property
    def as_arrived(self) -> bool:
        """Whether there are samples whose stamps say no more than when they came."""
        return bool(np.isnan(self.device).any())

    @functools.cached_property
    def steps(self) -> Array:
        """s between samples: by the device's clock where it has one, else as they were stamped on arrival."""
        steps: Array = np.diff(self.t if self.as_arrived else self.device)
        return steps[steps > 0.0]

    @functools.cached_property
    def step(self) -> float:
        """s: the usual one; NaN where there is none."""
        if not len(self.steps):
            return math.nan
        if self.as_arrived:
            # They come in bunches: their number over their time.
            return float(self.steps.sum()) / (len(self) - 1)
        return float(np.median(self.steps))

    @functools.cached_property
    def newest(self) -> NDArray[np.intp]:
        """Which are the newest of their arrival, those that took least."""
        return np.flatnonzero((np.diff(self.arrival, append=np.inf) > 0.0) & np.isfinite(self.arrival))

    @functools.cached_property
    def gravity(self) -> float:
        """What it mostly reads of it."""
        return float(np.median(_sizes(self.force)))


class StreamHealth:
    """One IMU's latest samples, and what there is to say of them.

    `upright`: whether z should point up at rest, as on a robot that stays on the floor. `parser`: of a serial line or a
    file, for what it dropped. `port`: the name of a serial port, for advice on its driver.
    """

    def __init__(self, *, upright: bool = True, parser: Parser | None = None, port: str = "") -> None:
        self.upright = upright
        self.parser = parser
        self.port = port
        self.samples = 0
        # Stamp of the device, arrival, stamp on the host, readings. A row a sample is quicker to write than a column.
        self._ring = np.empty((2 * KEEP, 9))
        self._end = 0

    def feed(self, raw: Sequence[Reading], readings: Array, arrival: float = math.nan) -> None:
        """Samples that arrived together: as the device stamped them, and (n, 7) as in an `ImuBatch`.

        `arrival`: s on the host, NaN where it says nothing, as of a file.
        """
        n = len(readings)
        if n == 0:
            return
        if n > KEEP:
            raw, readings = raw[-KEEP:], readings[-KEEP:]
        self.samples += n
        n = len(readings)
        if self._end + n > 2 * KEEP:
            self._ring[:KEEP] = self._ring[self._end - KEEP : self._end]
            self._end = KEEP
        rows = self._ring[self._end : self._end + n]
        rows[:, 0] = [sample[0] for sample in raw]  # None becomes NaN.
        rows[:, 1] = arrival
        rows[:, 2:] = readings
        self._end += n

    def _window(self) -> _Window:
        """The last WINDOW seconds."""
        rows = self._ring[max(0, self._end - KEEP) : self._end]
        t = rows[:, 2]
        old = np.flatnonzero(t <= t[-1:] - WINDOW)
        return _Window(rows[old[-1] + 1 :] if len(old) else rows)

    def rest(self) -> Rest | None:
        """What the sensor reads at rest; None while it moves, or where too little is known."""
        return _rest(self._window())

    def figures(self) -> dict[str, Any]:
        """Plain values, None where nothing is known: of the last WINDOW seconds, `samples` and what is lost of all."""
        window, parser = self._window(), self.parser
        step, steps, rest = window.step, window.steps, _rest(window)
        intervals, delays = _arrivals(window)
        long = steps[steps > GAP * step]
        force = window.force.mean(axis=1) if len(window) else np.full(3, np.nan)
        return {
            "samples": self.samples,
            "rate_hz": _finite(1.0 / step if step > 0.0 else math.nan),
            "gaps": len(long),
            "longest_gap_ms": _finite(1e3 * float(steps.max(initial=0.0))) if len(long) else None,
            "missing": 0 if parser is None else parser.missing,
            "dropped": 0 if parser is None else parser.dropped,
            "dropped_bytes": 0 if parser is None else parser.dropped_bytes,
            "arrival_interval_ms": _finite(1e3 * float(np.median(intervals))) if len(intervals) else None,
            "delay_jitter_ms": _finite(1e3 * float(np.std(delays))) if len(delays) > 1 else None,
            "gravity": _finite(float(np.linalg.norm(force))),
            "gravity_direction": _direction(force) if len(window) else None,
            "rest": None
            if rest is None
            else {
                "seconds": rest.seconds,
                "gyro": rest.gyro.tolist(),
                "gyro_sigma": rest.gyro_sigma.tolist(),
                "gyro_noise": (rest.gyro_sigma * math.sqrt(step)).tolist(),
                "force": rest.force.tolist(),
                "force_sigma": rest.force_sigma.tolist(),
                "accel_noise": (rest.force_sigma * math.sqrt(step)).tolist(),
            },
        }

    def findings(self) -> list[Finding]:
        """What there is to say, what is wrong altogether first."""
        window = self._window()
        found = list(self._of_parser())
        if len(window) < LEAST or 0.0 < float(window.steps.sum()) < LEAST_SECONDS:
            return found
        rest = _rest(window)
        derived = self.parser is not None and bool(self.parser.note)
        found += _of_stuck(window, ("sensor",) if derived else ("sensor", "gyroscope", "accelerometer"))
        if not any(finding.code == "imu_stuck" and finding.severity == "error" for finding in found):
            found += _of_force(window)
            found += _of_rates(window, rest)
        if rest is not None and self.upright:
            found += _of_gravity(rest)
        found += _of_time(window)
        found += self._of_batches(window)
        order = ("error", "warning", "note")
        first = {finding.code: finding for finding in reversed(found)}
        return sorted(first.values(), key=lambda finding: order.index(finding.severity))

    def _of_parser(self) -> Iterator[Finding]:
        parser = self.parser
        if parser is None:
            return
        if parser.note:
            yield Finding("imu_degraded", "warning", f"{parser.protocol}: {parser.note}", {"protocol": parser.protocol})
        dropped = parser.dropped
        share = dropped / max(1, parser.frames + dropped)
        if share >= (DROPPED_SHARE if dropped >= DROPPED_LEAST else 0.5):
            reason = parser.reasons.most_common(1)[0][0]
            text = f"{share:.0%} of what it sends cannot be used ({_words(reason)}); the latest is {parser.last_error}"
            yield Finding("imu_dropped", "warning", text, {"share": share, **parser.reasons})
        if parser.missing and parser.missing >= GAPS_SHARE * self.samples:
            share = parser.missing / (parser.missing + self.samples)
            text = f"{share:.0%} of the frames that the device numbered never came: the line is too slow, or disturbed"
            yield Finding("imu_missing", "warning", text, {"share": share, "missing": parser.missing})

    def _of_batches(self, window: _Window) -> Iterator[Finding]:
        intervals, _ = _arrivals(window)
        step = window.step
        if not self.port or len(intervals) < LEAST or not step > 0.0:
            return
        interval = float(np.median(intervals))
        if not LATENCY_TIMER[0] <= interval <= LATENCY_TIMER[1] or interval < 2.0 * step:
            return
        ms, name = 1e3 * interval, self.port.rpartition("/")[2]
        text = (
            f"samples come in batches of {ms:.0f} ms: set the latency timer of the USB adapter to 1, on Linux by "
            f"`echo 1 | sudo tee /sys/bus/usb-serial/devices/{name}/latency_timer`"
        )
        yield Finding("imu_batches", "note", text, {"interval_ms": ms, "samples": interval / step})


def _rest(window: _Window) -> Rest | None:
    step = window.step
    if len(window) < LEAST:
        return None
    size = max(4, round(REST_BLOCK / step)) if step > 0.0 else LEAST
    count = len(window) // size
    if not count:
        return None
    blocks = window.force[:, -count * size :].reshape(3, count, size)
    means = blocks.mean(axis=2)
    gravity = math.hypot(*means[:, -1])
    quiet = (blocks.std(axis=2) <= REST_SCATTER * gravity) & (np.abs(means - means[:, -1:]) <= REST_CHANGE * gravity)
    moving = np.flatnonzero(~quiet.all(axis=0))
    still = count - 1 - int(moving[-1]) if len(moving) else count
    seconds = still * size * step
    if seconds < 0.99 * REST or still < 2:
        return None
    gyro, force = window.gyro[:, -still * size :], window.force[:, -still * size :]
    noise = float(np.diff(gyro).std(axis=1).max()) / math.sqrt(2.0)
    return Rest(seconds, gyro.mean(axis=1), gyro.std(axis=1), force.mean(axis=1), force.std(axis=1), noise)


def _of_stuck(window: _Window, names: Sequence[str]) -> Iterator[Finding]:
    """Readings that repeat themselves, which a sensor's noise does not allow; derived rates may well be all zero."""
    t = window.t
    same = np.diff(window.readings) == 0.0
    for name in names:
        rows = {"sensor": slice(0, 6), "gyroscope": slice(0, 3), "accelerometer": slice(3, 6)}[name]
        changes = np.flatnonzero(~same[rows].all(axis=0))
        first = int(changes[-1]) + 1 if len(changes) else 0
        count = len(t) - first
        seconds = float(t[-1] - t[first])
        both = name == "sensor"
        if count >= STUCK_SAMPLES and not seconds < (STUCK_SECONDS if both else STUCK_SECONDS_OF_ONE):
            values = ", ".join(f"{value:g}" for value in window.readings[rows, -1])
            text = (
                f"the {name} repeats itself: {values} for the last {count} samples; it is stuck, not read anew, or its "
                "numbers are rounded too much"
            )
            yield Finding("imu_stuck", "error" if both else "warning", text, {"which": name, "samples": count})
            return
    repeats = float(same.all(axis=0).mean())
    if repeats >= REPEATED:
        text = f"{repeats:.0%} of the readings are the ones before: the device sends faster than its sensor measures"
        yield Finding("imu_repeats", "warning", text, {"share": repeats})


def _of_force(window: _Window) -> Iterator[Finding]:
    """In which unit gravity is read."""
    force = window.gravity
    if FORCE_RANGE[0] < force < FORCE_RANGE[1]:
        return
    evidence = {"force": force, "expected": GRAVITY}
    if force < NO_FORCE * GRAVITY:
        text = (
            f"gravity reads {force:.2f}: it is not in these accelerations; specific force is needed, which at rest is "
            f"{GRAVITY:.2f} m/s2 upwards"
        )
    else:
        what = _unit(force) or f"not {GRAVITY:.2f} m/s2: the unit or the scale is wrong"
        text = f"gravity reads {force:.{1 if force < 100.0 else 0}f}: {what}"
    yield Finding("accel_unit", "error", text, evidence)


def _unit(force: float) -> str:
    """In which unit gravity reads so, in words; "" for none that is known."""
    if FORCE_RANGE[0] < force < FORCE_RANGE[1]:
        return "these are m/s2"
    return next((words for one, words in UNITS if abs(force / one - 1.0) <= UNIT_SHARE), "")


def _of_rates(window: _Window, rest: Rest | None) -> Iterator[Finding]:
    """In which unit, and about which axes, the gyroscope turns."""
    rates = np.abs(window.gyro)
    beyond = int((rates > FULL_SCALE).any(axis=0).sum())
    degrees = "these are deg/s, not rad/s"
    turning = _Turning.of(window) if _unit(window.gravity) else None
    if turning is not None and turning.agreement > TURN_AGREE and turning.slope < 0.05:
        text = f"the gyroscope turns {1.0 / turning.slope:.0f} times as far as gravity does: {degrees}"
        yield Finding("gyro_unit", "error", text, {"times": 1.0 / turning.slope, "agreement": turning.agreement})
    elif beyond >= BEYOND:
        text = f"the gyroscope reads up to {rates.max():.0f}, more than 2000 deg/s: {degrees}"
        yield Finding("gyro_unit", "error", text, {"largest": float(rates.max()), "samples": beyond})
    elif rest is not None:
        noise, mean = rest.gyro_noise, float(np.linalg.norm(rest.gyro))
        if noise > REST_NOISE:
            text = f"at rest the gyroscope scatters by {noise:.2f}, much more than one in rad/s: {degrees}"
            yield Finding("gyro_unit", "error", text, {"noise": noise, "mean": mean})
        elif mean > REST_RATE:
            text = (
                f"the accelerometer is at rest and the gyroscope reads {mean:.2f}: these are deg/s, not rad/s, or it "
                "turns evenly, or its bias is very large"
            )
            yield Finding(TURNS_AT_REST, "warning", text, {"noise": noise, "mean": mean})
    if turning is None or not turning.agreement < TURN_DISAGREE:
        return
    evidence = {"agreement": turning.agreement, "rotation_deg": math.degrees(turning.total)}
    if turning.agreement < -TURN_AGREE:
        text = (
            "gravity turns the other way than the gyroscope: the signs of its axes are wrong, or its axes left-handed"
        )
        yield Finding("gyro_sign", "error", text, evidence)
    elif (axes := turning.better_axes()) is not None:
        text = (
            f"gravity turns about other axes than the gyroscope: as its x, y, z it should send what it sends as {axes}"
        )
        yield Finding("gyro_axes", "error", text, evidence | {"axes": axes})


class _Turning:
    """How gravity turned in the sensor's axes, as rotation vectors (n, 3), beside the gyroscope's integrals.

    A direction u that is fixed in the world turns in the body by -omega: u' = -omega x u, so that u' x u is omega
    without its part along u, of which gravity knows nothing.
    """

    def __init__(self, up: Array, seen: Array, gyro: Array) -> None:
        self._up, self._seen, self._gyro = up, seen, gyro
        self.total = float(np.linalg.norm(seen, axis=1).sum())
        self.agreement, self.slope = self._compare(np.eye(3))

    @classmethod
    def of(cls, window: _Window) -> _Turning | None:
        """None where gravity has turned too little to say anything."""
        step = window.step
        size = max(1, round(TURN_STEP / step)) if step > 0.0 else 0
        count = len(window) // size if size else 0
        if count < 4:
            return None
        means = window.force[:, -count * size :].reshape(3, count, size).mean(axis=2).T
        norms = np.linalg.norm(means, axis=1)
        if not norms.min() > 0.0:
            return None
        up = means / norms[:, np.newaxis]
        # The gyroscope's integral from the middle of one block to that of the next.
        gyro = window.gyro[:, -count * size :]
        through = (np.cumsum(gyro, axis=1) - 0.5 * gyro) * step
        middles = through.reshape(3, count, size).mean(axis=2).T
        # Where something else than gravity acts, the direction says nothing.
        good = np.abs(norms / np.median(norms) - 1.0) < 0.1
        both = good[1:] & good[:-1]
        turning = cls(up[:-1][both], np.cross(up[1:], up[:-1])[both], np.diff(middles, axis=0)[both])
        return turning if turning.total >= TURN_LEAST else None

    def _compare(self, axes: Array) -> tuple[float, float]:
        """Correlation and slope of what is seen over what the gyroscope says with its axes exchanged."""
        gyro = self._gyro @ axes.T
        gyro = gyro - np.sum(gyro * self._up, axis=1, keepdims=True) * self._up
        product, square = float(np.sum(gyro * self._seen)), float(np.sum(gyro**2))
        scale = math.sqrt(square * float(np.sum(self._seen**2)))
        return (product / scale, product / square) if scale > 0.0 else (0.0, 0.0)

    def better_axes(self) -> str | None:
        """With which order and signs of its axes the gyroscope would agree; None if with none."""
        best, name = TURN_AGREE, None
        for order in itertools.permutations(range(3)):
            for signs in itertools.product((1.0, -1.0), repeat=3):
                agreement, _ = self._compare(np.diag(signs) @ np.eye(3)[list(order)])
                if agreement > best:
                    best = agreement
                    name = ", ".join("-+"[sign > 0] + "xyz"[axis] for sign, axis in zip(signs, order, strict=True))
        return name


def _of_gravity(rest: Rest) -> Iterator[Finding]:
    """Where up is."""
    angle = math.atan2(math.hypot(rest.force[0], rest.force[1]), rest.force[2])
    if angle < TILT:
        return
    degrees, name = math.degrees(angle), _direction(rest.force)
    evidence = {"angle_deg": degrees, "axis": name, "force": rest.force.tolist()}
    if angle < WRONG_AXIS:
        text = f"at rest z is {degrees:.0f} deg from upright: is it mounted tilted? `steadfix imu-rest` measures how"
    elif name == "-z":
        text = "gravity is on the wrong axis: z reads it downwards; the IMU is upside down, or its z points down"
    else:
        text = (
            f"gravity is on the wrong axis: at rest {name} reads it, not +z; the IMU is mounted on its side, or its "
            "axes are exchanged (`steadfix imu-rest` gives the rotation)"
        )
    yield Finding("imu_mounting", "warning", text, evidence)


def _of_time(window: _Window) -> Iterator[Finding]:
    """Stamps, gaps, and the pace of the device's clock against the host's."""
    device, steps, step = window.device, window.steps, window.step
    arrival = window.arrival[window.newest]
    span = float(np.ptp(arrival)) if len(arrival) else math.nan
    if np.isnan(device).all():
        if span >= 0.0:
            text = "it sends no time of its own: samples are stamped as they arrive, with all the jitter of the line"
            yield Finding("imu_unstamped", "note", text, {})
    else:
        elapsed = float(device[window.newest[-1]] - device[window.newest[0]]) if len(arrival) else math.nan
        forward = bool((np.diff(device) >= 0.0).all())
        if not (np.diff(device) != 0.0).any():
            text = f"its time stands still at {device[-1]:g} s"
            yield Finding("imu_clock", "error", text, {"t": float(device[-1])})
        elif span >= CLOCK_SPAN and forward and not abs(elapsed / span - 1.0) <= CLOCK_SHARE:
            times = elapsed / span
            units = next((f"these are {name}, not s" for one, name in CLOCK_UNITS if 0.8 < times / one < 1.25), "")
            text = f"its time runs {times:.3g} times as fast as it should{': ' if units else ''}{units}"
            yield Finding("imu_stamp_unit", "error", text, {"times": times, "seconds": span})
            return
    long = steps[steps > GAP * step]
    missing = float(np.sum(np.round(long / step) - 1.0)) if step > 0.0 else 0.0
    if len(long) >= GAPS_LEAST and missing >= GAPS_SHARE * len(window) and not window.as_arrived:
        share = missing / (missing + len(window))
        text = f"IMU samples are missing: {share:.0%} (gaps of up to {1e3 * long.max():.0f} ms)"
        yield Finding("imu_missing", "warning", text, {"share": share, "gaps": len(long)})


def _arrivals(window: _Window) -> tuple[Array, Array]:
    """s between arrivals, and s that the newest sample of each took, by its stamp, where the device stamped it."""
    arrival = window.arrival[window.newest]
    delays: Array = arrival - window.t[window.newest]
    return np.diff(arrival), delays[np.isfinite(window.device[window.newest])]


def _sizes(vectors: Array) -> Array:
    """Of vectors (3, n)."""
    sizes: Array = np.sqrt(np.einsum("in,in->n", vectors, vectors))
    return sizes


def _direction(force: Array) -> str:
    """The axis that points up, such as "+z"."""
    axis = int(np.argmax(np.abs(force)))
    return "-+"[int(force[axis] > 0.0)] + "xyz"[axis]


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _words(reason: str) -> str:
    """What the person who made the device may have done."""
    return {
        "not finite": "NaN or infinite numbers",
        "out of range": "numbers beyond any sensor: another unit, or raw counts",
        "no frame": "bytes that are no frames: noise, half frames, or a wrong baud rate",
        "wrong checksum": "frames that arrive broken: noise, half frames, or a wrong baud rate",
        "not recognised": "no known protocol",
    }.get(reason, reason)
