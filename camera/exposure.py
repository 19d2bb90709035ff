"""What a camera delivers, whether moving markers can be found in it, and what to change if not, in words."""

from __future__ import annotations

import math
import statistics
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from camera.capture import Frame
from camera.images import grey

# Beyond so much motion blur the small markers begin to be missed. px
BLUR_LIMIT_PX = 3.0
# m/s: the speed that blur is told for.
SPEED = 1.0
# Edges of markers at rest that are wider than this sigma are out of focus, or the lens is dirty. px
FOCUS_LIMIT_PX = 1.5
# s of sightings that the measured blur is of, and how many there must be.
BLUR_WINDOW, BLUR_COUNT = 10.0, 20
# Grey levels, of 255: white paper below the first cannot be told from nothing, below the second it drowns in noise.
BLACK, DARK = 10.0, 60.0
# A pixel of this grey level is saturated; above this share of them white paper glares, and its edges move.
SATURATED, GLARE = 250, 0.1
# s: one swing of the power of mains light at 50 Hz. Shorter exposures catch more or less of it.
MAINS = 0.01
# s over which the frame rate is counted, and between two looks at how bright the picture is.
RATE_WINDOW, LOOK_EVERY = 2.0, 1.0
# Every so many pixels are enough for a look.
_STRIDE = 8


@dataclass(frozen=True, slots=True)
class Delivery:
    """What a source delivers. `rate_hz`: frames that it had, and `used_hz`: those that were looked at, a second.

    `exposure`: s, nan where it is not known. `white`: grey level (of 255) of the brightest hundredth of the picture,
    `saturated`: share of the picture that is as bright as can be; nan where there are more than 8 bits.
    """

    rate_hz: float
    used_hz: float
    exposure: float
    white: float
    saturated: float


class DeliveryMeter:
    """Takes in each frame that is looked at; `delivery` says what came of it. Time is an argument, host monotonic s."""

    def __init__(self) -> None:
        self._arrivals: deque[tuple[float, int]] = deque()
        self._exposure = math.nan
        self._light = math.nan, math.nan
        self._next_look = -math.inf

    def add(self, frame: Frame, now: float) -> None:
        """A frame that is looked at now."""
        if self._arrivals and frame.sequence <= self._arrivals[-1][1]:
            self._arrivals.clear()  # the source was opened anew
        self._arrivals.append((now, frame.sequence))
        while self._arrivals[0][0] < now - RATE_WINDOW:
            self._arrivals.popleft()
        self._exposure = frame.exposure
        if now >= self._next_look:
            self._next_look = now + LOOK_EVERY
            self._light = _light(frame)

    def delivery(self, now: float) -> Delivery:
        """Of the last RATE_WINDOW."""
        recent = [(t, n) for t, n in list(self._arrivals) if t >= now - RATE_WINDOW]
        span = recent[-1][0] - recent[0][0] if recent else 0.0
        rate, used = (recent[-1][1] - recent[0][1], len(recent) - 1) if span > 0.0 else (0, 0)
        return Delivery(rate / (span or 1.0), used / (span or 1.0), self._exposure, *self._light)


def _light(frame: Frame) -> tuple[float, float]:
    if frame.image.dtype != np.uint8:
        return math.nan, math.nan
    sample = grey(frame.image[::_STRIDE, ::_STRIDE])
    return float(np.percentile(sample, 99.0)), float(np.mean(sample >= SATURATED))


class EdgeBlur:
    """How wide the edges of markers are in the picture: of those at rest by the lens, of the others by motion too."""

    def __init__(self) -> None:
        self._still: deque[tuple[float, float]] = deque()
        self._others: deque[tuple[float, float]] = deque()

    def add(self, t: float, still: Iterable[float], others: Iterable[float]) -> None:
        """Sigmas of the edges in a frame, px: of markers that never move, and of those that may."""
        for kept, new in ((self._still, still), (self._others, others)):
            kept.extend((t, sigma) for sigma in new if math.isfinite(sigma))
            while kept and kept[0][0] < t - BLUR_WINDOW:
                kept.popleft()

    def still_px(self) -> float:
        """Sigma of the edges of markers at rest, px; nan until enough were seen."""
        sigmas = [sigma for _, sigma in list(self._still)]
        return statistics.median(sigmas) if len(sigmas) >= BLUR_COUNT else math.nan

    def motion_px(self) -> float:
        """By how far the quickest tenth of the others is smeared, px, which is rather too little; nan until known.

        Smearing evenly over b px adds b^2 / 12 to an edge's variance.
        """
        sigmas = sorted(sigma for _, sigma in list(self._others))
        if len(sigmas) < BLUR_COUNT or not (still := self.still_px()) > 0.0:
            return math.nan
        return math.sqrt(12.0 * max(0.0, sigmas[-1 - len(sigmas) // 10] ** 2 - still**2))


def blur_px(exposure: float, focal_px: float, distance: float, speed: float = SPEED) -> float:
    """Motion blur, px, of what moves at `speed` (m/s) across the view at `distance` (m); `exposure` in s.

    By similar triangles: it moves speed * exposure, and focal_px / distance pixels show a metre.
    """
    return speed * exposure * focal_px / distance


def black(delivery: Delivery) -> str:
    """Why nothing can be seen at all, or ""."""
    if delivery.white < BLACK:
        return f"the picture is black (grey level {delivery.white:.0f} of 255): is the lens covered, or the light off?"
    return ""


def advice(
    delivery: Delivery,
    edges: EdgeBlur,
    *,
    focal_px: float,
    distance: float | None,
    asked_rate_hz: float = 0.0,
) -> dict[str, str]:
    """What is to be improved, a sentence each, by what it is about: focus, blur, light, rate, load.

    `focal_px`: the camera's focal length. `distance`: m from it to the robots, None while that is not known.
    `asked_rate_hz`: 0 where nothing was asked for.
    """
    texts = {}
    # In the dark the noise is what makes edges wide.
    if (still := edges.still_px()) > FOCUS_LIMIT_PX and not delivery.white < DARK:
        texts["focus"] = f"edges at rest are {still:.1f} px wide (sigma): is the lens out of focus, or dirty?"
    if math.isnan(delivery.exposure) and (motion := edges.motion_px()) > BLUR_LIMIT_PX:
        texts["blur"] = (
            f"robots that move are smeared by {motion:.1f} px: fix a shorter exposure, with exposure_ms or, where "
            "that is not taken, in the camera's own settings"
        )
    if distance is not None and delivery.exposure > 0.0:
        blur = blur_px(delivery.exposure, focal_px, distance)
        if blur > BLUR_LIMIT_PX:
            texts["blur"] = _shorter(blur, delivery)
    if black(delivery):
        pass  # this is no matter of a little more light
    elif delivery.white < DARK:
        texts["light"] = (
            f"the picture is dark (white is grey level {delivery.white:.0f} of 255): more light is best, else more gain"
        )
    elif delivery.saturated > GLARE:
        texts["light"] = f"{delivery.saturated:.0%} of the picture is saturated: less gain or a shorter exposure"
    if asked_rate_hz and 0.0 < delivery.rate_hz < 0.8 * asked_rate_hz:
        why = "a compressed pixel_format may be needed to get them through USB"
        if delivery.exposure > 0.9 / asked_rate_hz:
            why = f"an exposure of {1e3 * delivery.exposure:g} ms leaves time for no more"
        texts["rate"] = f"{delivery.rate_hz:.0f} frames a second come where {asked_rate_hz:g} were asked for: {why}"
    if delivery.used_hz < 0.5 * delivery.rate_hz:
        texts["load"] = (
            f"{delivery.used_hz:.0f} of {delivery.rate_hz:.0f} frames a second are looked at, since this computer is "
            "too slow for more: a smaller picture makes it faster"
        )
    return texts


def _shorter(blur: float, delivery: Delivery) -> str:
    halvings = math.ceil(math.log2(blur / BLUR_LIMIT_PX))
    exposure = delivery.exposure / 2**halvings
    text = f"{blur:.1f} px of blur at {SPEED:g} m/s: "
    text += {1: "halve the exposure", 2: "quarter the exposure"}.get(halvings, "shorten the exposure")
    text += f", from {1e3 * delivery.exposure:.3g} to {1e3 * exposure:.3g} ms"
    if delivery.white < DARK * 2**halvings:
        text += ", and make up for it with light or gain"
    if exposure < MAINS <= delivery.exposure:
        text += "; below 10 ms lamps that flicker with the mains are seen to"
    return text
