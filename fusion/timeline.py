"""One robot's measurements in the order in which they happened, on the compiled kernels.

`Timeline` owns the memory that `fusion.kernels` works on; what it promises is described there. `fusion.reference`
has the same interface on filterpy.
"""

from __future__ import annotations

import numpy as np

from fusion import kernels as k
from fusion.measurements import Array, PoseFix
from fusion.params import Channel, FilterParams, Motion

CHANNELS: dict[Channel, int] = {"best": k.BEST, "smooth": k.SMOOTH}
MOTIONS: dict[Motion, float] = {"free": k.FREE, "ground": k.GROUND, "differential": k.DIFFERENTIAL}


def parameter_vector(params: FilterParams, motion: Motion) -> Array:
    """The parameters as the kernels take them: each in the place that its name has in `fusion.kernels`."""
    vector = np.full(k.PARAMS, np.nan)
    for name in FilterParams.__struct_fields__:
        place = getattr(k, name.upper(), None)
        if place is not None:
            vector[place] = getattr(params, name)
    vector[k.MOTION] = MOTIONS[motion]
    return vector


# A fix's row before anything is known of it.
_BLANK = np.zeros(k.FIX)
_BLANK[k.F_D2 : k.F_REPORTED] = np.nan


def fix_row(fix: PoseFix) -> Array:
    """A fix as a row of the kernels' ring."""
    row = _BLANK.copy()
    row[k.F_T], row[k.F_ARRIVAL], row[k.F_COUNT] = fix.t, fix.arrival, len(fix.hypotheses)
    for i, hypothesis in enumerate(fix.hypotheses):
        at = k.F_HYPOTHESES + i * k.HYPOTHESIS
        row[at + k.H_POS : at + k.H_POS + 3] = hypothesis.position
        row[at + k.H_QUAT : at + k.H_QUAT + 4] = hypothesis.quaternion_wxyz
        row[at + k.H_COV : at + k.H_COV + 36] = hypothesis.covariance.ravel()
        row[at + k.H_MISFIT] = hypothesis.misfit
        row[at + k.H_SYSTEMATIC : at + k.H_SYSTEMATIC + 36] = hypothesis.systematic.ravel()
    return row


class Timeline:
    """Measurements in, in any order; the state after all of them out."""

    def __init__(self, params: FilterParams, motion: Motion) -> None:
        self._memory = k.new_memory(parameter_vector(params, motion))
        self._meta, _, self._state, _, _, self._fixes, _ = k.views(self._memory)
        self._address = self._memory.ctypes.data
        self._nothing = np.zeros((0, 8))
        self._waiting = 0  # fixes in the ring whose outcome has not been told

    @property
    def state(self) -> Array:
        """(kernels.STATE,): the live filter, a view."""
        return self._state

    def feed_samples(self, samples: Array, track: Array | None = None, channel: Channel = "best") -> int:
        """IMU samples (n, 7): t, gyro, accel. -> how many were neither duplicates nor older than the buffer.

        `track` (n, 8) receives the newest pose after each sample: its instant (the sample's stamp, unless that came
        late), position, quaternion wxyz; NaN before the first fix.
        """
        outputs = self._nothing if track is None else track
        return int(k.process(self._address, k.FEED_SAMPLES, CHANNELS[channel], 0.0, samples, outputs))

    def feed_wheels(self, samples: Array) -> int:
        """Readings of the wheels (n, 3): t, forward speed, yaw rate. -> how many were neither repeated nor too late."""
        return int(k.process(self._address, k.FEED_WHEELS, k.BEST, 0.0, samples, self._nothing))

    def feed_fix(self, row: Array) -> int:
        """A fix as `fix_row` makes it. -> `kernels.PENDING`, `TOO_LATE` or `DUPLICATE`."""
        status = int(k.process(self._address, k.FEED_FIX, k.BEST, 0.0, row[np.newaxis], self._nothing))
        if status == k.PENDING:
            self._waiting += 1
        return status

    def judged(self) -> list[Array]:
        """The rows of the fixes that have been judged since this was last asked, oldest stamp first."""
        rows: list[Array] = []
        number, waiting = int(self._meta[k.FIX_END]), self._waiting
        while waiting and number > self._meta[k.FIX_FIRST]:
            number -= 1
            row = self._fixes[number & k.FIX_MASK]
            if not row[k.F_REPORTED]:
                waiting -= 1
                if row[k.F_OUTCOME] != k.PENDING:
                    row[k.F_REPORTED] = 1.0
                    rows.insert(0, row.copy())
        self._waiting -= len(rows)
        return rows

    def pose_at(self, t: float, channel: Channel = "best") -> Array | None:
        """A pose (kernels.POSE,) for instant t; None before the first fix, or before the buffer."""
        out = np.zeros((1, k.POSE))
        return out[0] if k.process(self._address, k.POSE_AT, CHANNELS[channel], t, self._nothing, out) else None

    @property
    def figures(self) -> dict[str, int]:
        """How many readings were seen twice, or came too late; how often the past was done again."""
        return {
            "imu_duplicates": int(self._meta[k.IMU_DUPLICATES]),
            "imu_late": int(self._meta[k.IMU_LATE]),
            "wheel_duplicates": int(self._meta[k.WHEEL_DUPLICATES]),
            "wheel_late": int(self._meta[k.WHEEL_LATE]),
            "rewinds": int(self._meta[k.REWINDS]),
        }
