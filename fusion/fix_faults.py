"""What fixes show: alone, beside what the filter had predicted and beside what it has found out from them."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion.diagnosis import (
    BLOCK,
    NOISE_LEAST,
    SIGMAS,
    WAY_PAIRS,
    WAY_SIGMAS,
    WAY_STEP,
    WINDOW,
    Diagnosis,
    JudgedFix,
    Seen,
    chords,
)
from fusion.geometry import rotation_from_quaternion, rotation_vectors
from fusion.localiser import Localiser
from fusion.measurements import Array, Outcome

# When something is said: how large, and how significant
OFFSET_LEAST = 0.008  # s of the stamps
TILT_LEAST = math.radians(0.3)
TILT_CHI2 = 30.0  # 2 degrees of freedom: 3e-7
REST_RESIDUALS = 30  # components of fixes at rest that their noise is taken from
REST_SIGMAS = 4.0
STILL_RATE, STILL_FORCE = 0.02, 0.15  # rad/s, m/s2: a block at rest turns less, and differs less from the one before
LEARNED_STEP, LEARNED_SPAN, LEARNED_LEAST = 0.25, 40.0, 2.0  # s between looks, s, times the IMU's noise
PART_OF_FIX, PART_OF_IMU = 0.05, 0.2  # of the variance of an innovation, to learn about the one or the other
TURNED_LEAST, TURNED_FIXES, TURNED_AGREE = math.radians(20.0), 8, 0.97  # agreement: length of the mean unit vector
CAMERA_LEAST = 0.005  # m between the fixes of cameras
CLOCKS_LEAST = 60.0  # s between the stamps of the IMU and of fixes
# An offset of a marker or of the IMU on the robot: m; sigmas; its share of the innovations; fixes in all, of a marker.
PLACE_LEAST, PLACE_SIGMAS, PLACE_SHARE, PLACE_FIXES, PLACE_GROUP = 0.015, 10.0, 0.2, 30, 10
PLACE_TURN, PLACE_LIKELY = math.radians(2.0), 0.05  # and the share from which the filter's states are not told
RISE_LEAST = 0.15  # m between the 5th and the 95th percentile of the height
WHEEL_SCALE_LEAST = 0.01
HEADING_LEAST, ASIDE_LEAST = 2.0, 0.15  # deg; share of the way
LATE_SHARE, LATE_FIXES, LATE_OF_BUFFER = 0.01, 3, 0.8
NO_FIX = 5.0  # s
RESETS = 2

BELIEVED = (Outcome.ACCEPTED, Outcome.INFLATED)
_EIGHT = ("+x", "+x and +y", "+y", "-x and +y", "-x", "-x and -y", "-y", "+x and -y")


def of_arrivals(seen: Seen) -> Iterator[Diagnosis]:
    """Of when fixes come, and whether they are of use."""
    localiser, fixes, lost, last = seen.localiser, seen.fixes, len(seen.lost), seen.localiser.last_fix
    delays = [fix.outcome.delay for fix in fixes]
    apart = max(seen.stamps[0] - seen.chunks[-1].t, seen.began - seen.stamps[1]) if seen.chunks else 0.0
    delay = float(np.median([*delays, *seen.lost])) if len(fixes) + lost >= LATE_FIXES else 0.0
    if max(apart, abs(delay)) >= CLOCKS_LEAST and seen.stamps[1] > -math.inf:
        if abs(delay) >= CLOCKS_LEAST:
            way = "after" if delay > 0.0 else "before"
            text = f"fixes arrive {abs(delay):.4g} s {way} their stamps: of another clock, or in another unit"
        else:
            text = (
                f"fixes and IMU samples are {apart:.4g} s apart by their stamps: two clocks or two units, if both ran"
            )
        yield Diagnosis("fixes_clock", "error", text, {"apart_s": apart, "delay_s": delay})
    age = seen.now - (last if math.isfinite(last) else seen.began)
    if age >= NO_FIX:
        ignored = sum(fix.outcome.t > last and fix.outcome.outcome is Outcome.REJECTED for fix in fixes)
        text = f"no fix for {age:.0f} s" if math.isfinite(last) else f"no fix yet, after {age:.0f} s"
        text += f": {ignored} came and were not believed" if ignored else ""
        yield Diagnosis("no_fix", "error", text, {"age_s": age, "not_believed": ignored})
    buffer = localiser.params.buffer
    if lost >= LATE_FIXES and lost >= LATE_SHARE * (lost + len(fixes)):
        text = f"{lost} of {lost + len(fixes)} fixes came later than the buffer of {buffer:g} s and are lost"
        if (after := float(np.median(seen.lost))) < buffer:
            text = f"{lost} of {lost + len(fixes)} fixes came {after:.1f} s late and are lost: at this rate of the IMU "
            text += "so much is not kept"
        yield Diagnosis("fixes_lost", "error", text, {"lost": lost, "fixes": lost + len(fixes), "buffer_s": buffer})
    elif len(delays) >= TURNED_FIXES and (p95 := float(np.percentile(delays, 95))) > LATE_OF_BUFFER * buffer:
        text = f"fixes arrive {p95:.1f} s late: beyond the buffer of {buffer:g} s they are lost"
        yield Diagnosis("fixes_late", "warning", text, {"delay_p95_s": p95, "buffer_s": buffer})
    early = [-delay for delay in delays if delay < 0.0]
    if len(early) >= LATE_FIXES:
        text = f"{len(early)} fixes are stamped up to {1e3 * max(early):.0f} ms after they arrived: another clock?"
        yield Diagnosis("fixes_early", "warning", text, {"fixes": len(early), "most_ms": 1e3 * max(early)})
    resets = sum(fix.outcome.outcome is Outcome.REINITIALISED for fix in fixes)
    if resets >= RESETS:
        text = f"the pose was set anew {resets} times in the last {WINDOW:.0f} s"
        yield Diagnosis("resets", "warning", text, {"resets": resets})


def of_states(localiser: Localiser, understated: float) -> Iterator[Diagnosis]:
    """Of what the filter has found out. `understated`: factor of its sigmas."""
    offset, sigma = localiser.time_offset, understated * localiser.time_offset_sigma
    if abs(offset) >= max(OFFSET_LEAST, SIGMAS * sigma) and sigma > 0.0:
        which = "late" if offset < 0.0 else "early"
        size = f"{1e3 * abs(offset):.0f} +- {1e3 * sigma:.0f} ms"
        text = f"the camera's stamps are {size} {which}; that is made up for"
        evidence = {"late_ms": -1e3 * offset, "sigma_ms": 1e3 * sigma, "sigmas": abs(offset) / sigma}
        yield Diagnosis("stamps", "note", text, evidence)
    tilt, covariance = localiser.tilt, localiser.tilt_covariance
    angle = float(np.linalg.norm(tilt))
    if angle >= TILT_LEAST and covariance[0, 0] > 0.0:
        chi2 = float(tilt @ np.linalg.solve(covariance, tilt)) / understated**2
        if chi2 >= TILT_CHI2:
            towards = _EIGHT[round(math.atan2(tilt[1], tilt[0]) / (0.25 * math.pi)) % 8]
            text = f"the floor rises by {math.degrees(angle):.1f} deg towards {towards}; that is made up for"
            x, y = np.degrees(tilt).tolist()
            yield Diagnosis("floor_tilt", "note", text, {"x_deg": x, "y_deg": y, "chi2": chi2})
    scales, of_scales = localiser.wheel_scale.tolist(), (understated * localiser.wheel_scale_sigma).tolist()
    for what, scale, sigma in zip(("speed", "turning"), scales, of_scales, strict=True):
        if sigma > 0.0 and abs(scale) >= max(WHEEL_SCALE_LEAST, SIGMAS * sigma):
            size, way = f"{abs(scale):.1%} +- {sigma:.1%}", "much" if scale > 0.0 else "little"
            text = f"the wheels tell {size} too {way} {what}; that is made up for"
            yield Diagnosis(f"wheel_{what}", "note", text, {"scale": scale, "sigma": sigma})


def of_learned(seen: Seen, known: set[str]) -> Iterator[Diagnosis]:
    """What noise the filter has learned, where no more direct test has found it."""
    looks = seen.learned
    seconds = looks[-1][0] - looks[0][0] if looks else 0.0
    judged = [fix for fix in seen.fixes if math.isfinite(fix.outcome.d2)]
    if seconds < LEARNED_SPAN or not judged:
        return
    accel, gyro, position, attitude = np.median([scale for _, scale in looks], axis=0).tolist()
    # What an innovation is made of: where the prediction has next to no part in it, it says nothing of the IMU, and
    # what is learned of that wanders; and the same of fixes.
    of_fix = np.array([fix.pose.covariance for fix in judged]).diagonal(axis1=1, axis2=2).reshape(-1, 2, 3).sum(axis=2)
    of_all = (np.array([fix.outcome.innovation_sigma for fix in judged]) ** 2).reshape(-1, 2, 3).sum(axis=2)
    parts = np.median(of_fix / of_all, axis=0).tolist()
    noise = any("noise" in code for code in known)
    for block, times, part in zip(("position", "attitude"), (position, attitude), parts, strict=True):
        if times >= NOISE_LEAST and times**2 * part >= PART_OF_FIX and f"fix_{block}_noise" not in known:
            text = f"fixes are about {times:.1f} x less accurate in {block} than they say, or their stamps jitter"
            yield Diagnosis(f"fix_{block}_noise", "warning", text, {"times": times, "seconds": seconds})
            noise = True
    # Of the two sensors one can get the blame for the other, or for fixes.
    if noise:
        return
    for name, sensor, times, part in zip(
        ("accel", "gyro"), ("accelerometer", "gyroscope"), (accel, gyro), parts, strict=True
    ):
        if times >= LEARNED_LEAST and 1.0 - part >= PART_OF_IMU:
            text = f"in motion the {sensor} is about {times:.1f} x worse than configured: vibration, or its scale"
            yield Diagnosis(f"{name}_motion", "warning", text, {"times": times, "seconds": seconds})


def of_rest(seen: Seen, blocks: Array) -> Iterator[Diagnosis]:
    """Fixes of a robot that stands still, or goes straight on, are on a line, but for their noise."""
    noise = blocks[:, 8:14].reshape(-1, 2, 3).sum(axis=2)
    quiet = np.all(noise <= 2.5 * np.quantile(noise, 0.1, axis=0), axis=1)
    rate = np.linalg.norm(blocks[:, 2:5] - seen.localiser.gyro_bias, axis=1)
    change = np.linalg.norm(np.diff(blocks[:, 5:8], axis=0, prepend=blocks[:1, 5:8]), axis=1)
    of_rate, of_force = np.sqrt(noise / BLOCK).T
    calm = quiet & (rate < STILL_RATE + 2.0 * of_rate) & (change < STILL_FORCE + 2.0 * of_force)
    # Nor do the blocks around it: within one, a start can hide.
    still = calm & np.append(calm[1:], False) & np.append(False, calm[:-1])
    moving = np.concatenate([[0], np.cumsum(~still)])
    for (source, markers), own in _by_origin(fix for fix in seen.fixes if not is_turned(fix)).items():
        t = np.array([fix.outcome.t for fix in own]) + seen.localiser.time_offset
        first, last = np.searchsorted(blocks[:, 1], t[:-1]), np.searchsorted(blocks[:, 0], t[1:], side="right")
        rest = (last > first) & (moving[last] == moving[first]) & (last <= len(blocks)) & (t[1:] <= blocks[-1, 1])
        residuals: list[Array] = []
        begin = 0
        for i in range(len(own)):
            if i == len(own) - 1 or not rest[i]:
                if i - begin >= 3:
                    residuals.append(_residuals(t[begin : i + 1], own[begin : i + 1]))
                begin = i + 1
        if not residuals:
            continue
        for block, e in zip(("position", "attitude"), np.split(np.concatenate(residuals), 2, axis=1), strict=True):
            # By the median, which a flipped pose does not disturb: 0.6745 sigma; its sigma is 1.17 / sqrt(n), and a
            # little more since the residuals of a line are correlated.
            times = float(np.median(np.abs(e))) / 0.6745
            sigmas = (times - 1.0) * math.sqrt(e.size) / 1.4
            if e.size >= REST_RESIDUALS and times >= NOISE_LEAST and sigmas >= REST_SIGMAS:
                name = (f" of camera {source}" if source else "") + (f" by {_named(markers)}" if markers else "")
                text = f"fixes{name} are about {times:.1f} x less accurate in {block} than they say"
                evidence = {"times": times, "components": e.size, "sigmas": sigmas}
                yield Diagnosis(f"fix_{block}_noise", "warning", text, _origin(source, markers) | evidence)


def _residuals(t: Array, fixes: Sequence[JudgedFix]) -> Array:
    """(n, 6): of straight lines through the poses of fixes, over the sigmas that the fixes say, studentised."""
    quaternions = np.array([fix.pose.quaternion_wxyz for fix in fixes])
    turned = -rotation_vectors(quaternions * [1.0, -1.0, -1.0, -1.0], quaternions[:1] * [1.0, -1.0, -1.0, -1.0])
    poses = np.column_stack([[fix.pose.position for fix in fixes], turned])
    sigma = np.sqrt(np.array([fix.pose.covariance for fix in fixes]).diagonal(axis1=1, axis2=2))
    line = np.column_stack([np.ones_like(t), t - t.mean()])
    hat = line @ np.linalg.pinv(line)
    free: Array = 1.0 - np.diag(hat)
    residuals: Array = (poses - hat @ poses) / sigma / np.sqrt(free)[:, np.newaxis]
    return residuals


def of_motion(seen: Seen) -> Iterator[Diagnosis]:
    """Does the robot move as its motion model says? By the fixes alone."""
    motion = seen.localiser.motion
    fixes = [fix for fix in seen.fixes if fix.outcome.outcome in BELIEVED]
    if motion == "free" or len(fixes) < WAY_PAIRS:
        return
    height = np.array([fix.pose.position[2] for fix in fixes])
    low, high = np.percentile(height, (5.0, 95.0)).tolist()
    sigmas = (high - low) / math.sqrt(float(np.median([fix.pose.covariance[2, 2] for fix in fixes])))
    if high - low >= RISE_LEAST and sigmas >= WAY_SIGMAS:
        text = (
            f'it rises and falls by {high - low:.2f} m in its fixes, with motion = "{motion}": is it carried, or are '
        )
        text += 'there ramps? motion = "free" is for that'
        yield Diagnosis("motion", "warning", text, {"rise_m": high - low, "sigmas": sigmas})
    if motion == "differential":
        groups: dict[tuple[int, ...], list[JudgedFix]] = {}
        for fix in fixes:
            groups.setdefault(fix.markers, []).append(fix)
        for markers, own in groups.items():
            yield from _of_way(markers, own)


def _of_way(markers: tuple[int, ...], fixes: Sequence[JudgedFix]) -> Iterator[Diagnosis]:
    """Does a robot on two wheels go where its fixes head?

    A marker that is turned on the robot turns the way by as much, and one that sits in front of the axle goes aside as
    the robot turns.
    """
    t = np.array([fix.outcome.t for fix in fixes])
    close = np.diff(t) <= WAY_STEP
    if np.sum(close) < WAY_PAIRS:
        return
    ahead, aside, turned = chords(fixes)[:, close]
    variance = np.array([fix.pose.covariance for fix in fixes]).diagonal(axis1=1, axis2=2)
    both = (variance[1:] + variance[:-1])[close]
    noise = both[:, :2].mean(axis=1) + 0.25 * (ahead**2 + aside**2) * both[:, 5]
    ways = np.column_stack([ahead, turned])
    normal = (ways / noise[:, np.newaxis]).T @ ways + 1e-6 * np.eye(2)
    slope, lever = np.linalg.solve(normal, (ways / noise[:, np.newaxis]).T @ aside).tolist()
    left = aside - slope * ahead - lever * turned
    scatter = max(1.0, float(np.mean(left**2 / noise)))
    of_slope, of_lever = np.sqrt(scatter * np.linalg.inv(normal).diagonal()).tolist()

    evidence: dict[str, Any] = {"markers": list(markers)} if markers else {}
    name, pairs = _named(markers) or "its marker", len(left)
    degrees, mm = math.degrees(math.atan(slope)), 1e3 * lever
    if abs(degrees) >= HEADING_LEAST and abs(slope) >= WAY_SIGMAS * of_slope:
        text = (
            f"it drives {abs(degrees):.1f} deg to the {'left' if degrees > 0.0 else 'right'} of where its fixes head: "
        )
        text += f"{name} is turned on the robot otherwise than is entered"
        figures = {"off_deg": degrees, "sigmas": abs(slope) / of_slope, "pairs": pairs}
        yield Diagnosis("marker_heading", "warning", text, evidence | figures)
    if abs(lever) >= PLACE_LEAST and abs(lever) >= WAY_SIGMAS * of_lever:
        text = f"{name} sits {abs(mm):.0f} mm farther to the {'front' if mm > 0.0 else 'back'} than is entered: "
        text += "so far from the axle it goes aside in turns, and the body's origin is on the axle"
        figures = {"mm": [mm], "sigmas": abs(lever) / of_lever, "pairs": pairs}
        yield Diagnosis("marker_place", "warning", text, evidence | figures)
    share = math.sqrt(max(0.0, float(np.sum(left**2 - noise))) / max(float(np.sum(ahead**2 + aside**2)), 1e-9))
    sigmas = float(np.sum(np.minimum(left**2 / noise - 1.0, 9.0))) / math.sqrt(2.0 * pairs)
    if share >= ASIDE_LEAST and sigmas >= WAY_SIGMAS:
        text = (
            f"{share:.0%} of its way is sideways in its fixes: its wheels slip or slide, or it is no differential drive"
        )
        yield Diagnosis("wheels_slide", "warning", text, evidence | {"share": share, "sigmas": sigmas, "pairs": pairs})


def is_turned(fix: JudgedFix) -> bool:
    """Its attitude is far off and was not believed; its position may have been."""
    outcome = fix.outcome
    return outcome.outcome is not Outcome.ACCEPTED and float(np.linalg.norm(outcome.innovation[3:])) > TURNED_LEAST


def of_turns(fixes: Sequence[JudgedFix]) -> Iterator[Diagnosis]:
    """Fixes that are far off in attitude: alike about the vertical, or tipped as the other pose of a flat marker is."""
    turned: list[tuple[str, dict[str, Any]]] = []
    for (source, markers), own in _by_origin(fixes).items():
        turn = np.array([fix.outcome.innovation[3:] for fix in own if is_turned(fix)]).reshape(-1, 3)
        if not len(turn):
            continue
        angle = np.linalg.norm(turn, axis=1)
        upright = np.abs(turn[:, 2]) / angle
        about_z = turn[upright > 0.9, 2]
        mean = np.mean(np.exp(1j * about_z)) if about_z.size else 0.0
        evidence = _origin(source, markers)
        if about_z.size >= TURNED_FIXES and abs(mean) >= TURNED_AGREE:
            degrees = abs(math.degrees(float(np.angle(mean))))
            evidence |= {"turn_deg": degrees, "fixes": int(about_z.size), "agreement": float(abs(mean)), "of": len(own)}
            turned.append((_named(markers) or (f"camera {source}" if source else "the camera"), evidence))
        tipped = angle[upright < 0.7]
        if tipped.size >= TURNED_FIXES:
            degrees = math.degrees(float(np.median(tipped)))
            name = (f"camera {source}" if source else "the camera") + (f" by {_named(markers)}" if markers else "")
            text = (
                f"{name} shows the robot tipped by about {degrees:.0f} deg in {tipped.size / len(own):.0%} of its "
                "fixes: the other pose of a flat marker; a larger marker or a sharper image helps"
            )
            tip = {"tip_deg": degrees, "fixes": int(tipped.size), "of": len(own)}
            yield Diagnosis("fixes_flipped", "note", text, {**evidence, **tip})
    for name, evidence in turned:
        by = f"{evidence['turn_deg']:.0f} deg"
        agree = f"{evidence['fixes']} of its {evidence['of']} fixes"
        if "markers" not in evidence:
            text = f"{name} gives fixes turned by {by}: {agree} agree in that; is a marker mounted or entered turned?"
        elif len(turned) > 1:
            # The filter has believed now the one, now the other.
            text = f"{name} disagrees with another marker by {by}, in {agree}: one of them is mounted or entered turned"
        else:
            text = f"{name} is mounted or entered turned by {by}: {agree} agree in that"
        yield Diagnosis("fixes_turned", "warning", text, evidence)


def _by_origin(fixes: Iterable[JudgedFix]) -> dict[tuple[str, tuple[int, ...]], list[JudgedFix]]:
    """By camera and markers."""
    groups: dict[tuple[str, tuple[int, ...]], list[JudgedFix]] = {}
    for fix in fixes:
        groups.setdefault((fix.outcome.source, fix.markers), []).append(fix)
    return groups


def _named(markers: tuple[int, ...]) -> str:
    return f"marker{'s' * (len(markers) > 1)} {' and '.join(map(str, markers))}" if markers else ""


def _origin(source: str, markers: tuple[int, ...]) -> dict[str, Any]:
    return {"source": source} | ({"markers": list(markers)} if markers else {})


class Innovations(NamedTuple):
    """Of n fixes that are not far off in attitude, for what explains them.

    `markers`, `cameras`: those that occur often enough, the most frequent first; `marker`, `camera` (n,): whose each
    is, -1 of the others. `used` (n,): whether it is to be explained. `value`, `variance`, `of_fix` (n, 6): the
    innovation, its variance, and the part that the fix has in that, position and rotation.
    """

    fixes: Sequence[JudgedFix]
    markers: list[tuple[int, ...]]
    marker: Array
    cameras: list[str]
    camera: Array
    used: NDArray[np.bool_]
    value: Array
    variance: Array
    of_fix: Array


def _innovations(seen: Seen) -> Innovations | None:
    """None where there are too few."""
    fixes = [fix for fix in seen.fixes if math.isfinite(fix.outcome.d2) and not is_turned(fix)]
    markers, marker = _most([fix.markers for fix in fixes])
    cameras, camera = _most([fix.outcome.source for fix in fixes])
    # What the filter had of fixes before the first ones is not known.
    used = (marker >= 0) & (camera >= 0) & (np.arange(len(fixes)) >= 5)
    if np.sum(used) < PLACE_FIXES:
        return None
    of_fix = np.array([fix.pose.covariance for fix in fixes]).diagonal(axis1=1, axis2=2).copy()
    looks, scales = np.array([t for t, _ in seen.learned]), np.array([scale for _, scale in seen.learned])
    arrivals = [fix.outcome.arrival for fix in fixes]
    for i, block in enumerate((slice(0, 3), slice(3, 6)), start=2):  # as large as the filter took them for
        of_fix[:, block] *= np.maximum(1.0, np.interp(arrivals, looks, scales[:, i]))[:, np.newaxis] ** 2
    value = np.array([fix.outcome.innovation for fix in fixes])
    variance = np.array([fix.outcome.innovation_sigma for fix in fixes]) ** 2
    return Innovations(fixes, markers, marker, cameras, camera, used, value, variance, of_fix)


def of_places(seen: Seen, axes: int) -> tuple[list[Diagnosis], bool]:
    """Where markers sit on the robot, or its IMU, and whether cameras agree; and whether there may be more to that.

    An offset on the robot turns with it, one between cameras comes and goes with them, and the prediction does neither.
    What the filter makes of such a constant is linear in it, nearly. That response is worked out for one unit along
    each axis, and the constants are those by which it explains the innovations best. Those on the robot come out too
    small, since biases take a part of them.
    """
    of = _innovations(seen)
    if of is None:
        return [], False
    world_from_body = np.array([rotation_from_quaternion(fix.pose.quaternion_wxyz) for fix in of.fixes])
    on_robot = [_only(of.marker == i) * world_from_body[:, :, :axes] for i in range(len(of.markers))]
    in_world = [_only(of.camera == i) * np.eye(3)[:, :axes] for i in range(1, len(of.cameras))]
    total, own = of.variance[:, :3].mean(axis=1), of.of_fix[:, :3].mean(axis=1)
    accel = seen.localiser.params.accel_noise * max(1.0, float(np.median([scale[0] for _, scale in seen.learned])))
    response = _response(of.fixes, np.concatenate([*on_robot, *in_world], axis=2), total, own, accel)[:, :axes]
    moved = np.einsum("nij,nj->ni", world_from_body, of.value[:, :3])[:, :axes]
    offset, covariance, share = _explanation(response, moved, total, of.used)

    unit = np.eye(len(on_robot) + len(in_world))
    parts = [_combined(signs, offset, covariance) for signs in unit]

    said: list[Diagnosis] = []
    off, likely = [], False
    for i, (by, size, sigmas) in enumerate(parts[: len(of.markers)]):
        likely |= share >= PLACE_LIKELY and size >= PLACE_LEAST and sigmas >= SIGMAS
        if share >= PLACE_SHARE and size >= PLACE_LEAST and sigmas >= PLACE_SIGMAS:
            off.append(i)
            axis = int(np.argmax(np.abs(by)))
            way = (("back", "right", "down"), ("front", "left", "up"))[int(by[axis] > 0.0)][axis]
            name = _named(of.markers[i]) if len(of.markers) > 1 else "the marker"
            text = f"{name} sits {1e3 * size:.0f} mm or more farther to the {way} of the robot than is entered"
            text += ", or the IMU as much to the other side" if len(of.markers) == 1 else ""
            evidence: dict[str, Any] = {"markers": list(of.markers[i])} if len(of.markers) > 1 else {}
            evidence |= {"mm": (1e3 * by).tolist(), "sigmas": sigmas, "explained": share}
            said.append(Diagnosis("marker_place", "warning", text, evidence))
    for i in range(1, len(of.markers)):
        by, size, sigmas = _combined(unit[i] - unit[0], offset, covariance)
        # Markers can be compared more sharply with each other than each with the IMU.
        if not {0, i} & set(off) and share >= PLACE_SHARE and size >= PLACE_LEAST and sigmas >= PLACE_SIGMAS:
            text = f"{_named(of.markers[0])} and {_named(of.markers[i])} disagree by {1e3 * size:.0f} mm: "
            text += "one of them sits elsewhere on the robot than is entered"
            evidence = {"markers": [*of.markers[0], *of.markers[i]], "mm": (1e3 * by).tolist(), "sigmas": sigmas}
            said.append(Diagnosis("marker_place", "warning", text, evidence | {"explained": share}))
    for camera, (by, size, sigmas) in zip(of.cameras[1:], parts[len(of.markers) :], strict=True):
        if size >= CAMERA_LEAST and sigmas >= PLACE_SIGMAS:
            text = f"fixes of camera {camera} disagree with those of camera {of.cameras[0]} by {1e3 * size:.0f} mm"
            evidence = {"source": f"{of.cameras[0]}, {camera}", "mm": (1e3 * by).tolist(), "sigmas": sigmas}
            said.append(Diagnosis("cameras_disagree", "warning", text, evidence))
    if len(of.markers) > 1:
        said += _of_headings(of)
    return said, likely or bool(said)


def _combined(signs: Array, offset: Array, covariance: Array) -> tuple[Array, float, float]:
    """A sum of the constants that stand together in `offset`, its length, and that in sigmas."""
    pick = np.kron(signs, np.eye(len(offset) // len(signs)))
    by = pick @ offset
    return by, float(np.linalg.norm(by)), math.sqrt(float(by @ np.linalg.solve(pick @ covariance @ pick.T, by)))


def _of_headings(of: Innovations) -> Iterator[Diagnosis]:
    """Are markers turned about the vertical against the one that is seen most?"""
    effect = np.concatenate([_only(of.marker == i) for i in range(len(of.markers))], axis=2)[:, :, 1:]
    total, own = of.variance[:, 5], of.of_fix[:, 5]
    response = _response(of.fixes, effect, total, own, 0.0)
    turns, covariance, share = _explanation(response, of.value[:, 5:], total, of.used)
    for i, markers in enumerate(of.markers[1:]):
        turn = abs(float(turns[i]))
        sigmas = turn / math.sqrt(covariance[i, i])
        if share >= PLACE_SHARE and PLACE_TURN <= turn < TURNED_LEAST and sigmas >= PLACE_SIGMAS:
            degrees = math.degrees(turn)
            text = (
                f"{_named(of.markers[0])} and {_named(markers)} disagree by {degrees:.1f} deg: one of them is turned "
            )
            text += "on the robot otherwise than is entered"
            evidence = {"markers": [*of.markers[0], *markers], "turn_deg": degrees, "sigmas": sigmas}
            yield Diagnosis("marker_turn", "warning", text, evidence | {"explained": share})


def _only(which: Array) -> Array:
    return which[:, np.newaxis, np.newaxis].astype(np.float64)


def _most(names: Sequence[Any]) -> tuple[list[Any], Array]:
    """The up to four that occur often enough, the most frequent first, and the place there (n,) of each; -1: none."""
    often = [name for name, n in Counter(names).most_common(4) if n >= PLACE_GROUP]
    return often, np.array([often.index(name) if name in often else -1 for name in names])


def _response(fixes: Sequence[JudgedFix], effect: Array, total: Array, of_fix: Array, accel_noise: float) -> Array:
    """(n, a, m): by how much innovations are off, for each of m constants that move fixes by `effect` (n, a, m) a unit.

    What an update does is known from the variances (n,) of the innovation and of the fix; how the speed follows, from
    a filter of place and speed alone with `accel_noise`, a density, whose variance of the place is made what is known.
    """
    steps = np.diff([fix.outcome.t for fix in fixes], prepend=fixes[0].outcome.t).tolist()
    of_state = np.maximum(total - of_fix, 0.02 * total).tolist()
    q = accel_noise**2
    moved, speed = effect[0].copy(), np.zeros_like(effect[0])
    response = np.zeros_like(effect)
    p, c, v = of_state[0], 0.0, 0.0  # the covariance: of the place, of both, of the speed
    for i, (fix, dt, known, of) in enumerate(zip(fixes, steps, of_state, of_fix.tolist(), strict=True)):
        p, c, v = p + dt * (2.0 * c + dt * (v + q * dt / 3.0)), c + dt * (v + q * dt / 2.0), v + q * dt
        p, c, v = known, c * known / p, v * known / p
        moved = moved + dt * speed
        response[i] = effect[i] - moved
        outcome = fix.outcome.outcome
        if outcome in BELIEVED:
            gain, of_speed = p / (p + of), c / (p + of)
            moved, speed = moved + gain * response[i], speed + of_speed * response[i]
            p, c, v = (1.0 - gain) * p, (1.0 - gain) * c, v - of_speed * c
        elif outcome is not Outcome.REJECTED:
            moved, speed = effect[i].copy(), np.zeros_like(speed)
            p, c, v = of, 0.0, 1.0
    return response


def _explanation(response: Array, value: Array, variance: Array, used: NDArray[np.bool_]) -> tuple[Array, Array, float]:
    """The constants (m,) whose `response` (n, a, m) is nearest to `value` (n, a), their covariance, and its share."""
    sigma = np.sqrt(variance[used])[:, np.newaxis]
    A, b = response[used] / sigma[..., np.newaxis], value[used] / sigma
    weight = np.ones(len(b))
    for _ in range(8):  # Huber's weights: a flipped or a strayed fix says little
        weighted = A * weight[:, np.newaxis, np.newaxis]
        # A prior of one unit, for what cannot be told from this motion.
        normal = np.einsum("ijk,ijl->kl", weighted, A) + np.eye(A.shape[2])
        x = np.linalg.solve(normal, np.einsum("ijk,ij->k", weighted, b))
        residual = b - A @ x
        weight = np.minimum(1.0, 3.0 / np.maximum(np.linalg.norm(residual, axis=1), 1e-9))
    left, whole = (float(np.sum(weight[:, np.newaxis] * r**2)) for r in (residual, b))
    return x, np.linalg.inv(normal) * max(1.0, left / b.size), 1.0 - left / whole if whole > 0.0 else 0.0
