"""A filter takes every stamp once and in order, and starts anew where time or place jump."""

from __future__ import annotations

import numpy as np

from body_tracking.core.skeleton import N_JOINTS, NANOSECONDS, Skeleton
from body_tracking.filters.arrival import Arrival, Arrivals

POSITIONS, STATES = np.zeros((N_JOINTS, 3)), np.zeros(N_JOINTS, dtype=np.uint8)


def test_each_frame_is_compared_with_the_last_one_that_was_taken() -> None:
    counters = {"measured": 7}
    arrivals = Arrivals(counters, reorder_window=0.1, reset_gap=1.0)
    course = (
        (10.0, "world", Arrival.FIRST, 0.0),
        (10.5, "world", Arrival.NEXT, 0.5),
        (10.5, "world", Arrival.IGNORED, 0.5),
        (10.45, "world", Arrival.IGNORED, 0.5),
        (11.0, "world", Arrival.NEXT, 0.5),
        (13.0, "world", Arrival.AFTER_GAP, 2.0),
        (12.0, "world", Arrival.AFTER_JUMP, 0.0),
        (12.1, "map", Arrival.AFTER_JUMP, 0.0),
        (12.2, "map", Arrival.NEXT, 0.1),
    )
    for seconds, frame_id, expected, elapsed in course:
        assert arrivals.take(Skeleton(round(seconds * NANOSECONDS), frame_id, POSITIONS, STATES)) is expected
        assert arrivals.elapsed == elapsed
    arrivals.reset()
    assert arrivals.take(Skeleton(NANOSECONDS, "world", POSITIONS, STATES)) is Arrival.FIRST
    assert counters == {
        "measured": 7,
        "frames": 8,
        "repeated_stamps": 1,
        "late_frames": 1,
        "backward_jumps": 1,
        "gaps": 1,
        "frame_changes": 1,
    }
