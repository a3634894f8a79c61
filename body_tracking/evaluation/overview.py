"""Summary of an evaluation: median, best and worst error, and coverage of the stated standard deviations."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from body_tracking.core.skeleton import FloatArray, IntArray


def errors_in_words(names: Sequence[str], errors: FloatArray, unit: str) -> str:
    """The median of the errors, and the names of the smallest and largest.

    Args:
        names: n names.
        errors: (n,) in the unit; NaN if there is none.
        unit: mm or deg.
    """
    there = np.isfinite(errors)
    if not there.any():
        return "no error can be stated"
    text = f"median RMS error {np.median(errors[there]):.1f} {unit}"
    if there.sum() > 1:
        best, worst = int(np.nanargmin(errors)), int(np.nanargmax(errors))
        text += f", best {names[best]} {errors[best]:.1f} {unit}, worst {names[worst]} {errors[worst]:.1f} {unit}"
    return text


def coverage_in_words(event: str, covered: FloatArray, frames: FloatArray | IntArray) -> str:
    """Share of frames in which the truth lies within the stated bounds, in words.

    Args:
        event: description of the event whose probability should be 95 %.
        covered: (n,) shares; NaN if no standard deviation is stated.
        frames: (n,) number of frames behind each share.
    """
    there = np.isfinite(covered)
    if not there.any():
        return "no standard deviations are stated"
    share = float(np.average(covered[there], weights=frames[there]))
    return f"{event} in {100.0 * share:.0f} % of the frames (ideal: 95 %)"
