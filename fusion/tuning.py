"""Which noise fits: what the innovations say of it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from fusion.consistency import chi2_bounds
from fusion.measurements import FixOutcome, PoseFix


def scale_fix_noise(fixes: Iterable[PoseFix], factor: float) -> list[PoseFix]:
    """The same fixes with every sigma `factor` times as large."""
    return [
        replace(fix, hypotheses=tuple(replace(pose, covariance=factor**2 * pose.covariance) for pose in fix.hypotheses))
        for fix in fixes
    ]


def explain_nis(outcomes: Sequence[FixOutcome]) -> str:
    """What the NIS of a run's fixes means, in words: one line for the pose, one each for position and attitude.

    The NIS of fixes that are believed and of those that are not counts alike: their mean is the number of degrees of
    freedom, within chi-square bounds, where the noise is right.
    """
    lines = []
    for name, dof, d2 in (
        ("pose", 6, [outcome.d2 for outcome in outcomes]),
        ("position", 3, [outcome.d2_position for outcome in outcomes]),
        ("attitude", 3, [outcome.d2_attitude for outcome in outcomes]),
    ):
        known = np.array(d2)[np.isfinite(d2)]
        if not known.size:
            return "NIS: no fix has been judged yet."
        mean = float(known.mean())
        low, high = chi2_bounds(dof, known.size)
        if mean < low:
            meaning = "too small: fixes are closer to the prediction than expected, the noise is overstated"
        elif mean > high:
            meaning = "too large: fixes are farther from the prediction than expected, the noise is understated"
        else:
            meaning = "as it should be: this noise fits"
        lines.append(f"NIS of the {name} {mean:.2f} ({low:.2f} to {high:.2f} for {known.size} fixes): {meaning}.")
    return "\n".join(lines)
