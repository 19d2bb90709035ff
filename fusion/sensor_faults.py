"""What an IMU's samples show, alone and beside the fixes, and what wheels show beside both."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from fusion.diagnosis import NOISE_LEAST, SIGMAS, WAY_PAIRS, WAY_STEP, Diagnosis, JudgedFix, Seen, chords
from fusion.geometry import rotation_vectors
from fusion.measurements import Array
from fusion.params import GRAVITY

# When something is said: how large, and how significant
NOISE_BLOCKS = 20  # blocks of white noise that the IMU's is taken from
WHITE = 1.4  # variance by first over that by third differences: 1 for white noise, more in motion or vibration
MISSING_LEAST, GAPS_LEAST, GAP = 0.01, 5, 1.75  # share, number, times the usual step
REPEATS_LEAST = 0.01
# A sensor at its limit reads one value again and again; rates and forces below these are no full scale of any.
LIMIT_LEAST, LIMIT_SAMPLES, LIMIT_RATIO = (2.0, 15.0), 20, 2.0
FORCE_RANGE = (0.7 * GRAVITY, 1.3 * GRAVITY)  # m/s2: median specific force
GRAVITY_ANGLE = math.radians(20.0)
GYRO_NOISE_MOST = 0.01  # rad/s/sqrt(Hz), of a working one: twenty times a bad one's datasheet
TURN_LEAST, TURN_PAIRS, TURN_STEP = 3.0, 8, 0.3  # rad, number, s: rotation between fixes that can judge a gyroscope
UNIT_LEAST, UNIT_SIGMAS = 15.0, 8.0  # times what the fixes turn; of the correlation, which needs no large rotation then
STAMP_STEP = 0.5  # s: no IMU is slower
# Of wheels: readings, what their scale may be, m and rad/s by which they are off when they slip, how often.
WHEEL_READINGS, WHEEL_RANGE, SLIP_LEAST, SLIP_TIMES = 100, (0.7, 1.4), (0.05, 0.2), 3

_SENSORS = (("gyro", "gyroscope", "rad/s", slice(0, 3)), ("accel", "accelerometer", "m/s2", slice(3, 6)))
_WHEEL_CAUSES = "a unit, a sign, the wheels' radius or distance, or an encoder that tells nothing"


class Turns(NamedTuple):
    """Between fixes, what they turn (n, 3) and what the gyroscope does, rad."""

    fixes: Array
    gyro: Array


def of_samples(seen: Seen, blocks: Array, in_doubt: bool) -> Iterator[Diagnosis]:
    """Of the IMU alone: what is missing, clipped, noisy or in the wrong unit. `in_doubt`: the gyroscope's unit."""
    chunks = seen.chunks
    samples, missing = sum(c.samples for c in chunks), sum(c.missing for c in chunks)
    gaps, longest = sum(c.gaps for c in chunks), max(c.longest for c in chunks)
    share = missing / (samples + missing)
    evidence: dict[str, Any]
    if share >= MISSING_LEAST and gaps >= GAPS_LEAST:
        text = f"IMU samples are missing: {share:.0%} (gaps of up to {1e3 * longest:.0f} ms)"
        evidence = {"share": share, "gaps": gaps, "longest_ms": 1e3 * longest, "samples": samples}
        yield Diagnosis("imu_missing", "warning", text, evidence)
    repeats = sum(c.repeats for c in chunks) / samples
    if repeats >= REPEATS_LEAST:
        text = f"{repeats:.0%} of the IMU's stamps repeat the one before, and those samples are dropped"
        yield Diagnosis("imu_stamps_repeat", "warning", text, {"share": repeats, "samples": samples})

    step = float(np.median([chunk.step for chunk in chunks]))
    if STAMP_STEP <= step < math.inf:
        unit = next(unit for unit, least in (("nano", 1e5), ("micro", 1e2), ("milli", 0.0)) if step >= least)
        text = f"the IMU's samples are {step:.4g} s apart by their stamps: these are {unit}seconds, not seconds"
        yield Diagnosis("imu_stamp_unit", "error", text, {"step": step, "samples": samples})
    mean, by_first, by_third = blocks[:, 2:8], blocks[:, 8:14], blocks[:, 14:20]
    limit = np.max([chunk.top for chunk in chunks], axis=0)
    for (name, sensor, unit, axes), least in zip(_SENSORS, LIMIT_LEAST, strict=True):
        clipped = []
        for i in range(axes.start, axes.stop):
            there = [chunk for chunk in chunks if chunk.top[i] >= (1.0 - 1e-6) * limit[i]]
            at, near = sum(int(c.at_top[i]) for c in there), sum(int(c.near_top[i]) for c in there)
            if limit[i] >= least and at >= LIMIT_SAMPLES and at > LIMIT_RATIO * near:
                clipped.append((float(limit[i]), "xyz"[i % 3], at, near))
        if clipped:
            value, names = min(clipped)[0], ", ".join(axis for _, axis, _, _ in clipped)
            evidence = {"limit": value, "axes": names, "samples": sum(c[2] for c in clipped)}
            text = f"the {sensor} saturates at {value:.2f} {unit} ({names})"
            yield Diagnosis(f"{name}_saturates", "warning", text, evidence)
        white = np.sum(by_first[:, axes], axis=1) < WHITE * np.sum(by_third[:, axes], axis=1)
        if np.sum(white) >= NOISE_BLOCKS and math.isfinite(step):
            noise = math.sqrt(step * float(np.median(np.mean(by_third[white][:, axes], axis=1))))
            configured = getattr(seen.localiser.params, f"{name}_noise")
            # 3 axes and 29 differences a block, which are correlated: as good as 30 independent ones.
            sigmas = (noise / configured - 1.0) * math.sqrt(60.0 * np.sum(white))
            if noise >= NOISE_LEAST * configured and sigmas >= SIGMAS:
                text = f"the {sensor} is about {noise / configured:.1f} x noisier than configured ({name}_noise)"
                evidence = {"times": noise / configured, "noise": noise, "configured": configured, "sigmas": sigmas}
                if name == "gyro" and in_doubt and noise >= GYRO_NOISE_MOST:
                    text += ", and than any that works: is its unit deg/s, not rad/s?"
                    yield Diagnosis("gyro_unit", "error", text, evidence)
                else:
                    yield Diagnosis(f"{name}_noise", "warning", text, evidence)
    if len(blocks) >= NOISE_BLOCKS:
        force = float(np.median(np.linalg.norm(mean[:, 3:], axis=1)))
        if not FORCE_RANGE[0] < force < FORCE_RANGE[1]:
            what = f"not {GRAVITY:.2f} m/s2: its unit or its scale is wrong"
            for unit, one in (("g", 1.0), ("thousandths of g", 1000.0)):
                if 0.8 * one < force < 1.2 * one:
                    what = f"these are {unit}, not m/s2"
            text = f"the accelerometer reads {force:.2f} on the mean: {what}"
            yield Diagnosis("accel_unit", "error", text, {"force": force, "expected": GRAVITY, "blocks": len(blocks)})


def of_gravity(fixes: Sequence[JudgedFix], blocks: Array) -> Iterator[Diagnosis]:
    """Does the IMU's gravity point downwards in the fixes?"""
    t, quaternions = _within(fixes, blocks)
    if len(t) < TURN_PAIRS:
        return
    force = blocks[np.searchsorted(blocks[:, 0], t, side="right") - 1, 5:8]
    w, x, y, z = quaternions.T
    up = np.column_stack([2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x**2 + y**2)])
    # Medians, so that what the robot accelerates averages out; of one that turns over nothing remains to compare.
    force, up = np.median(force, axis=0), np.median(up, axis=0)
    angle = math.atan2(float(np.linalg.norm(np.cross(force, up))), float(force @ up))
    if angle >= GRAVITY_ANGLE and np.linalg.norm(up) > 0.5:
        axis = int(np.argmax(np.abs(force)))
        name = "-+"[int(force[axis] > 0.0)] + "xyz"[axis]
        text = (
            f"gravity is on the wrong axis: at rest {name} reads it, {math.degrees(angle):.0f} deg from where it is "
            "upwards in the fixes; the IMU is mounted turned, or its axes have other names or signs"
        )
        evidence = {"angle_deg": math.degrees(angle), "axis": name, "force": force.tolist(), "fixes": len(t)}
        yield Diagnosis("imu_mounting", "error", text, evidence)


def of_gyro(turns: Turns | None) -> Iterator[Diagnosis]:
    """Does the IMU turn as the fixes do?"""
    if turns is None:
        return
    agreement = correlation(turns)
    # Of a robot that rests most of the time, its bias is the most of what the gyroscope reads.
    moved = Turns(turns.fixes - turns.fixes.mean(axis=0), turns.gyro - turns.gyro.mean(axis=0))
    for fixed, gyro in (turns, moved):
        product, square, of_fixes = (float(np.sum(a * b)) for a, b in ((fixed, gyro), (gyro, gyro), (fixed, fixed)))
        sigmas = abs(product) / math.sqrt(square * of_fixes + 1e-12) * math.sqrt(fixed.size)
        evidence = {
            "times": square / product if product else math.inf,
            "correlation": product / math.sqrt(square * of_fixes + 1e-12),
            "rotation_deg": math.degrees(float(np.linalg.norm(turns.fixes, axis=1).sum())),
            "pairs": len(fixed),
        }
        # The noise of fixes makes this factor too small.
        if product > UNIT_LEAST * of_fixes and sigmas > UNIT_SIGMAS:
            text = f"the gyroscope reads {evidence['times']:.0f} x what the fixes turn: its unit is deg/s, not rad/s"
            yield Diagnosis("gyro_unit", "error", text, evidence)
            return
        if agreement < -0.8:
            text = "the gyroscope turns the other way than the fixes: a sign, or the IMU is upside down"
            yield Diagnosis("gyro_sign", "error", text, evidence)
            return


def turns_between(fixes: Sequence[JudgedFix], blocks: Array) -> Turns | None:
    """None where there are too few to judge by."""
    t, quaternions = _within(fixes, blocks)
    integral = np.concatenate([np.zeros((1, 3)), np.cumsum(np.diff(blocks[:, 0])[:, np.newaxis] * blocks[:-1, 2:5], 0)])
    gyro = np.column_stack([np.interp(t, blocks[:, 0], integral[:, i]) for i in range(3)])
    pairs, since = [], 0
    for i in range(1, len(t)):
        if t[i] - t[since] >= TURN_STEP:
            pairs += [(since, i)] if t[i] - t[since] < 5.0 * TURN_STEP else []
            since = i
    if len(pairs) < TURN_PAIRS:
        return None
    a, b = np.array(pairs).T
    turned, gyro = rotation_vectors(quaternions[a], quaternions[b]), gyro[b] - gyro[a]
    # Half a turn and more is ambiguous.
    clear = np.linalg.norm(turned, axis=1) < 2.5
    return Turns(turned[clear], gyro[clear]) if clear.sum() >= TURN_PAIRS else None


def correlation(turns: Turns) -> float:
    """Correlation: 1 where the gyroscope turns as the fixes do, but for a factor; 0 of rest."""
    total = float(np.linalg.norm(turns.fixes, axis=1).sum())
    square = float(np.sum(turns.gyro**2)) * float(np.sum(turns.fixes**2))
    return float(np.sum(turns.fixes * turns.gyro)) / math.sqrt(square + 1e-12) if total >= TURN_LEAST else 0.0


def _within(fixes: Sequence[JudgedFix], blocks: Array) -> tuple[Array, Array]:
    """Stamps (n,) and quaternions (n, 4) of the fixes while there are samples."""
    t = np.array([fix.outcome.t for fix in fixes])
    inside = (t >= blocks[0, 0]) & (t < blocks[-1, 1])
    return t[inside], np.array([fix.pose.quaternion_wxyz for fix in fixes]).reshape(-1, 4)[inside]


def of_wheels(seen: Seen, blocks: Array) -> Iterator[Diagnosis]:
    """Do the wheels go as far as the fixes, and turn as the gyroscope does?"""
    times, most = 0, 0.0
    fixes = [fix for fix in seen.fixes if math.isfinite(fix.outcome.d2)]
    t = np.array([fix.outcome.t for fix in fixes]) + seen.localiser.time_offset
    speed, rate = (seen.wheels[np.isfinite(seen.wheels[:, i])][:, [0, i]] for i in (1, 2))
    if len(speed) >= WHEEL_READINGS and len(fixes) >= WAY_PAIRS:
        way = np.interp(t, speed[:, 0], _integral(speed))
        ahead, _, turned = chords(fixes)
        expected = np.diff(way) * np.sinc(turned / (2.0 * math.pi))  # the chord of an arc
        noise = np.sqrt([2.0 * fix.pose.covariance[0, 0] for fix in fixes[1:]])
        inside = (np.diff(t) <= WAY_STEP) & (t[:-1] >= speed[0, 0]) & (t[1:] <= speed[-1, 0])
        moving = inside & (np.abs(ahead) > 10.0 * noise)
        if np.sum(moving) >= WAY_PAIRS:
            scale = float(np.median(expected[moving] / ahead[moving]))
            if not WHEEL_RANGE[0] < scale < WHEEL_RANGE[1]:
                text = f"by its wheels the robot goes {scale:.3g} x as far as in its fixes: {_WHEEL_CAUSES}"
                yield Diagnosis("wheel_unit", "error", text, {"times": scale, "pairs": int(np.sum(moving))})
                return
            off = (ahead - expected / scale)[inside]
            spread = np.maximum(noise[inside], 1.4826 * float(np.median(np.abs(off))))
            slips = np.abs(off) > np.maximum(6.0 * spread, SLIP_LEAST[0])
            times += int(np.sum(slips[1:] & ~slips[:-1]))
    if len(rate) >= WHEEL_READINGS:
        ends = np.interp(blocks[:, :2].T, rate[:, 0], _integral(rate))
        inside = (blocks[:, 0] >= rate[0, 0]) & (blocks[:, 1] <= rate[-1, 0]) & (blocks[:, 1] > blocks[:, 0])
        turns = ((ends[1] - ends[0])[inside]) / (blocks[:, 1] - blocks[:, 0])[inside]
        gyro = blocks[inside, 4] - seen.localiser.gyro_bias[2]
        turning = np.abs(gyro) > 0.2
        if np.sum(turning) >= WAY_PAIRS:
            scale = float(np.median(turns[turning] / gyro[turning]))
            if not WHEEL_RANGE[0] < scale < WHEEL_RANGE[1]:
                text = f"by its wheels the robot turns {scale:.3g} x as fast as by the gyroscope: {_WHEEL_CAUSES}"
                yield Diagnosis("wheel_turn_unit", "error", text, {"times": scale, "blocks": int(np.sum(turning))})
                return
            off = turns - scale * gyro
            slips = np.abs(off) > max(8.0 * 1.4826 * float(np.median(np.abs(off))), SLIP_LEAST[1])
            times += int(np.sum(slips[1:] & ~slips[:-1]))
            most = float(np.max(np.abs(off)[slips], initial=0.0))
    if times >= SLIP_TIMES:
        text = f"the wheels slip: {times} times they went or turned otherwise than the fixes and the gyroscope"
        yield Diagnosis("wheels_slip", "warning", text, {"times": times, "most_rad_s": most})


def _integral(values: Array) -> Array:
    """(n,): over values (n, 2) of t and a rate, up to each."""
    steps = np.diff(values[:, 0]) * 0.5 * (values[1:, 1] + values[:-1, 1])
    return np.concatenate([[0.0], np.cumsum(steps)])
