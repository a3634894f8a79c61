"""The clock offset between two recordings of one person, from the angular speeds of the segments."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np

from body_tracking.core.clocks import ClockModel
from body_tracking.core.skeleton import FloatArray
from body_tracking.evaluation.hand_eye import Track
from body_tracking.evaluation.reading import EvaluationError
from body_tracking.inertial.clock import clock_offset, turning

STAMPS_AS_THEY_ARE: Final = "the motion does not determine the offset of the clocks; the stamps are taken as they are"
"""Text of a note."""
_SAME_CLOCK: Final = 1.0
"""Half width of the search if the stamps are assumed to be of one clock, seconds."""
_AGREE: Final = 0.1
"""Largest difference between the offsets of two segments, seconds; speeds of skin and bone differ."""


def start_clock(
    own: Mapping[str, Track], other: Mapping[str, Track], apart: float, sources: str, segments: Mapping[str, str]
) -> tuple[ClockModel, list[str]]:
    """The other recording's clock minus the own one, each counted from its first stamp.

    Args:
        own: orientations by name; unknown instants are left out.
        other: of the same segments, or of targets on them, by the same names.
        apart: own first stamp minus the other's, seconds, if both clocks were one.
        sources: both recordings, for the error message.
        segments: by name, its segment, for the notes.

    Returns:
        The clock, and notes.

    Raises:
        EvaluationError: no segment's angular speed determines the offset.
    """
    length, others = (max(float(track.times[-1]) for track in each.values()) for each in (own, other))
    searches = [(0.5 * (others - length), 0.5 * (others + length))]
    if -others < -apart < length:
        searches.append((apart, _SAME_CLOCK))
    series = {
        name: [turning(each.times, np.linalg.norm(each.rates(each.times), axis=1)) for each in (own[name], other[name])]
        for name in own
    }
    for attempt, (guess, window) in enumerate(searches):
        found = {
            name: clock
            for name, (mine, theirs) in series.items()
            if (clock := clock_offset(mine, theirs, guess, window)) is not None
        }
        if not found:
            continue
        best = min(found, key=lambda name: found[name].stddev)
        notes = []
        if attempt:
            notes.append(
                f"the movement alone does not tell the clocks' offset, as it repeats itself or is small: it was sought "
                f"within {_SAME_CLOCK:g} s of that by the stamps"
            )
        for name, clock in found.items():
            if abs(clock.offset - found[best].offset) > _AGREE:
                notes.append(
                    f"the angular speed of {name} puts the clocks {clock.offset - found[best].offset:+.2f} s from "
                    f"where {best} does: is it on {segments[name]}?"
                )
        missing = [name for name in own if name not in found]
        if missing:
            notes.append(f"the clocks' offset does not follow from {', '.join(missing)}, which move little or unlike")
        return found[best], notes
    rms = ", ".join(
        f"{name} {np.degrees(_rms(theirs.values)):.0f}, its segment {np.degrees(_rms(mine.values)):.0f}"
        for name, (mine, theirs) in series.items()
    )
    raise EvaluationError(
        f"{sources}: no segment's angular speed determines the offset of their clocks (deg/s RMS: {rms}); too little "
        "movement, or one that repeats itself, or another one"
    )


def _rms(values: FloatArray) -> float:
    return float(np.sqrt((values**2).mean())) if values.size else 0.0
