"""The corners of markers, measured on the edges of the black square: compiled, since it is most of what a frame costs.

Intensity profiles are taken across each side, an edge is found in each profile, a line is fitted through the edges near
each corner, and corners are where the lines of neighbouring sides meet. Beyond this file nothing is compiled here.
"""

# numba reads these functions: plain loops and scalars are what it compiles best.
# mypy cannot look through its decorator.
from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from fusion.measurements import Array

# No corner is believed to be known better than this: lens model, flatness of the paper, print. px
SIGMA_FLOOR_PX = 0.1
# Sigma of a detector's own corners, used where a marker's edges could not be measured. px
SIGMA_UNREFINED_PX = 0.8

# Profiles per leg, samples per profile. A leg is the part of a side next to a corner.
_PROFILES, _SAMPLES = 12, 15
# A leg begins this part of the side away from the corner, where the other leg's edge is out of the blur, ...
_GAP, _GAP_PX = 0.08, 4.0
# ... and is no longer than this, so that neither a lens nor wavy paper bends it: the rest of a long side says nothing
# about its corner. px
_LEG_PX = 36.0
# Rises below this part of a profile's largest are noise, and would pull the edge to the middle of the profile.
_NOISE = 0.15
# An edge counts if it is this much of the usual contrast of the marker's edges, and of so many grey levels.
_CLEAR, _CLEAR_LEVELS = 0.4, 2.0
# A line, if so much of its edges does. Each is fitted so often, with the weights that the last fit's residuals give.
_SUPPORT, _ROUNDS = 0.4, 4
# The part of a cell that the sigma of the edges' blur may reach before the next cells' edges come into the profiles: on
# rendered markers of 13 to 70 px under blur of 0.5 to 5 px the corners' error is what it exceeds this by.
_CROWDED = 0.185

_jit: Any = njit(cache=True, error_model="numpy", nogil=True)


def refine_corners(
    image: NDArray[np.uint8], corners_px: Array, cells: int, reach_px: Array | None = None
) -> tuple[Array, Array, Array]:
    """Measures corners on the edges of the black square.

    `image`: (height, width). (n, 4, 2) px, clockwise -> (n, 4, 2) px, (n,) sigma and (n,) sigma of the edges' blur, px.
    `cells`: of a marker's side, its black border included. `reach_px` (n,): how far the corners may be off and the edge
    be blurred together, where that is known. A marker whose sides do not show a clear edge from black to white, or
    whose corners would move further than the profiles reach, keeps the corners it came with and SIGMA_UNREFINED_PX.
    """
    start = np.ascontiguousarray(corners_px, np.float64)
    reach = np.full(len(start), np.inf) if reach_px is None else np.asarray(reach_px, np.float64)
    corners, sigma, blur = start.copy(), np.empty(len(start)), np.empty(len(start))
    _refine(image, start, float(cells), reach, corners, sigma, blur)
    return corners, sigma, blur


def warm_up() -> None:
    """Compile, or load from numba's cache, before the first picture needs it."""
    refine_corners(np.zeros((1, 1), np.uint8), np.zeros((1, 4, 2)), 6)


@_jit
def _refine(image, start, cells, reach_px, corners, sigma, blur):
    met = np.empty((4, 2))
    for m in range(len(start)):
        shortest = math.inf
        for c in range(4):
            n = (c + 1) % 4
            shortest = min(shortest, math.hypot(start[m, n, 0] - start[m, c, 0], start[m, n, 1] - start[m, c, 1]))
        cell = shortest / cells
        # Half a profile stays within the black border inside and the white margin outside, each a cell wide.
        furthest = max(0.8 * cell, 1.5)
        reach = min(max(reach_px[m], 1.5), furthest)
        clear, noise, crowding, widest = _measure(image, start[m], reach, cell, met)
        if clear:
            # Again, if the corners were off by pixels, since a profile that is not centred pulls its edge to its own
            # middle, or if another length suits: three sigma of the edge's own blur hold all of it, and a shorter
            # profile is sampled more finely.
            shorter = min(max(3.0 * widest, 1.5), 0.75 * furthest + 0.4)
            if _furthest(met, start[m]) > 0.25 * reach or abs(shorter - reach) > 0.35 * reach:
                clear, noise, crowding, widest = _measure(image, met.copy(), shorter, cell, met)
        blur[m] = widest
        sigma[m] = math.sqrt(SIGMA_FLOOR_PX**2 + noise**2 + crowding)
        if clear and _furthest(met, start[m]) <= max(furthest, 2.0):
            corners[m] = met
        else:
            sigma[m] = max(sigma[m], SIGMA_UNREFINED_PX)


@_jit
def _furthest(a, b):
    """The largest distance between corners (4, 2) of the same number."""
    longest = 0.0
    for c in range(4):
        longest = max(longest, math.hypot(a[c, 0] - b[c, 0], a[c, 1] - b[c, 1]))
    return longest


@_jit
def _measure(image, corners, reach, cell, met):
    """One marker's corners (4, 2), written to `met`. -> whether all eight legs had enough clear edges, sigma of the
    corners by the edges' scatter, px, mean square of what the edges' blur exceeds its part of a cell by, px², and the
    largest sigma of a leg's blur, px. `reach`: half of a profile's length, px."""
    edge = np.zeros((8, _PROFILES))
    spread = np.zeros((8, _PROFILES))
    contrast = np.zeros((8, _PROFILES))
    weight = np.zeros((8, _PROFILES))
    place = np.zeros((8, _PROFILES))
    along = np.zeros((8, 2))
    outward = np.zeros((8, 2))
    value = np.zeros(_SAMPLES)
    fifth = _SAMPLES // 5
    scarcity = np.zeros(8)
    for leg in range(8):
        corner, back = leg // 2, leg % 2
        end = (corner + 3) % 4 if back else (corner + 1) % 4
        dx, dy = corners[end, 0] - corners[corner, 0], corners[end, 1] - corners[corner, 1]
        length = max(math.hypot(dx, dy), 1e-6)
        along[leg, 0], along[leg, 1] = dx / length, dy / length
        # Out of the square, whose corners run clockwise in an image with y down: left of the leg to the next corner,
        # right of the one to the corner before.
        sign = -1.0 if back else 1.0
        outward[leg, 0], outward[leg, 1] = sign * along[leg, 1], -sign * along[leg, 0]
        gap = min(_GAP * length, max(_GAP_PX, 0.7 * reach))
        span = min(length - 2.0 * gap, _LEG_PX)
        # Profiles within a pixel see the same noise.
        scarcity[leg] = max(1.0, _PROFILES / min(length, _LEG_PX))
        for p in range(_PROFILES):
            u = gap + span * p / (_PROFILES - 1)
            place[leg, p] = u
            x, y = corners[corner, 0] + u * along[leg, 0], corners[corner, 1] + u * along[leg, 1]
            for s in range(_SAMPLES):
                v = reach * (2.0 * s / (_SAMPLES - 1) - 1.0)
                value[s] = _sample(image, x + v * outward[leg, 0], y + v * outward[leg, 1])
            # The edge is the middle of the gradient; only what grows brighter outwards and stands out counts.
            largest = 0.0
            for s in range(_SAMPLES - 1):
                largest = max(largest, value[s + 1] - value[s])
            total, first, second = 1e-6, 0.0, 0.0
            for s in range(_SAMPLES - 1):
                rise = max(value[s + 1] - value[s] - _NOISE * largest, 0.0)
                between = (2.0 * s + 1.0) / (_SAMPLES - 1) - 1.0
                total += rise
                first += rise * between
                second += rise * between * between
            edge[leg, p] = reach * first / total
            spread[leg, p] = reach * math.sqrt(max(second / total - (first / total) ** 2, 0.0))
            for s in range(fifth):
                contrast[leg, p] += (value[_SAMPLES - 1 - s] - value[s]) / fifth

    size = np.zeros(8 * _PROFILES)
    for leg in range(8):
        size[leg * _PROFILES : (leg + 1) * _PROFILES] = contrast[leg]
    least = max(_CLEAR * _median(size, 8 * _PROFILES), _CLEAR_LEVELS)
    clear, crowding, widest = True, 0.0, 0.0
    for leg in range(8):
        for p in range(_PROFILES):
            weight[leg, p] = 1.0 if contrast[leg, p] > least else 0.0
        blur = _median(spread[leg], _PROFILES)
        widest = max(widest, blur)
        crowding += max(blur - _CROWDED * cell, 0.0) ** 2 / 8.0

    # edge = offset + slope u along each leg, by least squares reweighted with Tukey's biweight
    offset, slope, at_corner = np.zeros(8), np.zeros(8), np.zeros(8)
    residual = np.zeros((8, _PROFILES))
    for _ in range(_ROUNDS):
        count = 0
        for leg in range(8):
            s0 = s1 = s2 = t0 = t1 = 0.0
            for p in range(_PROFILES):
                w, u, e = weight[leg, p], place[leg, p], edge[leg, p]
                s0 += w
                s1 += w * u
                s2 += w * u * u
                t0 += w * e
                t1 += w * u * e
            determinant = max(s0 * s2 - s1 * s1, 1e-6)
            offset[leg] = (s2 * t0 - s1 * t1) / determinant
            slope[leg] = (s0 * t1 - s1 * t0) / determinant
            # Variance of the offset at the corner over that of one edge
            at_corner[leg] = s2 / determinant
            for p in range(_PROFILES):
                residual[leg, p] = edge[leg, p] - offset[leg] - slope[leg] * place[leg, p]
                if contrast[leg, p] > least:
                    size[count] = abs(residual[leg, p])
                    count += 1
        if count == 0:
            break
        scale = 4.685 * max(1.4826 * _median(size, count), 0.03)
        for leg in range(8):
            for p in range(_PROFILES):
                inside = max(1.0 - (residual[leg, p] / scale) ** 2, 0.0)
                weight[leg, p] = inside * inside if contrast[leg, p] > least else 0.0

    squares, support, variance = 0.0, 0.0, 0.0
    for leg in range(8):
        own = 0.0
        for p in range(_PROFILES):
            own += weight[leg, p]
            squares += weight[leg, p] * residual[leg, p] ** 2
        clear = clear and own > _SUPPORT * _PROFILES
        support += own
        variance += at_corner[leg] * scarcity[leg] / 8.0
    noise = math.sqrt(squares / max(support, 1e-6) * variance)

    # Where the lines of the two legs of a corner meet
    for corner in range(4):
        a, b = 2 * corner, 2 * corner + 1
        vx, vy = along[a, 0] + slope[a] * outward[a, 0], along[a, 1] + slope[a] * outward[a, 1]
        wx, wy = along[b, 0] + slope[b] * outward[b, 0], along[b, 1] + slope[b] * outward[b, 1]
        px, py = offset[a] * outward[a, 0], offset[a] * outward[a, 1]
        qx, qy = offset[b] * outward[b, 0] - px, offset[b] * outward[b, 1] - py
        cross = vx * wy - vy * wx
        clear = clear and abs(cross) > 1e-3
        part = (qx * wy - qy * wx) / cross if abs(cross) > 1e-3 else 0.0
        met[corner, 0] = corners[corner, 0] + px + part * vx
        met[corner, 1] = corners[corner, 1] + py + part * vy
    return clear, noise, crowding, widest


@_jit
def _median(values, count):
    """Of the first `count` values, which are sorted for it. By insertion: they are few."""
    for i in range(1, count):
        value, k = values[i], i
        while k > 0 and values[k - 1] > value:
            values[k] = values[k - 1]
            k -= 1
        values[k] = value
    return values[count // 2]


@_jit
def _sample(image, x, y):
    """The grey value at a place, px, interpolated linearly; beyond the picture its border goes on."""
    x = min(max(x, 0.0), image.shape[1] - 1.0)
    y = min(max(y, 0.0), image.shape[0] - 1.0)
    i, j = int(y), int(x)
    a, b = y - i, x - j
    k, l = min(i + 1, image.shape[0] - 1), min(j + 1, image.shape[1] - 1)
    top = image[i, j] + b * (np.float64(image[i, l]) - image[i, j])
    bottom = image[k, j] + b * (np.float64(image[k, l]) - image[k, j])
    return top + a * (bottom - top)
