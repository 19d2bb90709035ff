"""The jump-free pose that robots steer by, for the engine without a compiler: what `fusion.kernels` does with E.

The smooth pose is the filter's moved by E = (position, rotation), world axes. A correction sets E such that the pose
does not move; E then decays with a time constant of 0.1 s, at 0.3 m/s and 60 deg/s at most. Beyond 0.25 m or 20 deg,
and when the filter starts anew, the pose steps and counts a reset.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from fusion import kernels as k
from fusion.geometry import exp_so3, log_so3
from fusion.measurements import Array


class Motion(NamedTuple):
    """Where a filter is and how it moves: t, until when its last IMU sample is good, position, rotation (3, 3),
    velocity (world), IMU sample u (6,) and its bias, its reset_id."""

    t: float
    fresh_until: float
    position: Array
    rotation: Array
    velocity: Array
    u: Array
    bias: Array
    reset_id: int

    def at(self, t: float, fresh_until: float) -> tuple[Array, Array]:
        """Position and rotation at t, straight on; from `fresh_until` the speed decays."""
        dt = t - self.t
        fresh = min(max(fresh_until - self.t, 0.0), dt)
        far = fresh + k.COAST_TIME * (1.0 - math.exp((fresh - dt) / k.COAST_TIME))
        return self.position + self.velocity * far, self.rotation @ exp_so3((self.u - self.bias)[:3] * dt)


class Smoother:
    """E, and what has been published of it."""

    def __init__(self) -> None:
        self._e = [0.0] * 6
        self._t = -math.inf
        self._published = -math.inf
        self._reset_id = 0
        self.resets = 0
        self.step = np.zeros(6)

    def _left(self, t: float) -> list[float]:
        dt = t - self._t
        if dt <= 0.0:
            return self._e
        left = []
        for x, y, z, speed in ((*self._e[:3], k.SMOOTH_SPEED), (*self._e[3:], k.SMOOTH_RATE)):
            size = math.hypot(x, y, z)
            # at the greatest speed until the exponential is slower
            knee = min(speed * k.SMOOTH_TIME, size)
            straight = (size - knee) / speed
            share = 1.0
            if 0.0 < dt <= straight:
                share = 1.0 - speed * dt / size
            elif size > 0.0:
                share = knee / size * math.exp((straight - dt) / k.SMOOTH_TIME)
            left += [share * x, share * y, share * z]
        return left

    def offset(self, t: float) -> Array:
        """(6,): what is left of E at t."""
        return np.array(self._left(t))

    def publish(self, t: float) -> Array:
        """`offset`, and from now on the pose at t is kept from moving."""
        self._published = max(self._published, t)
        return self.offset(t)

    def absorb(self, before: Motion, after: Motion, corrected: Array | None) -> None:
        """Take what an input has done to the filter's pose into E.

        `corrected` (6,): the sum of the moves by pseudo-measurements, where that is all that happened; None where the
        past was done again or a fix was taken.
        """
        at = after.t
        if corrected is None:
            at = min(max(self._published, after.t), after.t + k.SMOOTH_REACH)
        e = self.offset(at)
        self._t = max(at, self._t)
        if corrected is not None:
            e = e - corrected
        else:
            (old, old_rotation), (new, new_rotation) = before.at(at, after.fresh_until), after.at(at, after.fresh_until)
            turn = log_so3(exp_so3(e[3:]) @ old_rotation @ new_rotation.T)
            e = np.concatenate([e[:3] + old - new, turn])
        far = math.hypot(*e[:3]) > k.SMOOTH_DISTANCE
        turned = math.hypot(*e[3:]) > k.SMOOTH_ANGLE
        if far or turned or after.reset_id != self._reset_id:
            self.resets += 1
            self._reset_id = after.reset_id
            self.step, e = -e, np.zeros(6)
        self._e = e.tolist()
