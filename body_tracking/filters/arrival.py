"""Classification of frames by their stamps: every stamp once and in order; jumps restart the filter."""

from __future__ import annotations

import math
from enum import Enum, auto

from body_tracking.core.skeleton import NANOSECONDS, Skeleton


class Arrival(Enum):
    """Relation of a frame to the previous one."""

    FIRST = auto()
    NEXT = auto()
    AFTER_GAP = auto()
    """Later than ``reset_gap`` allows."""
    AFTER_JUMP = auto()
    """In another frame of reference, or so much earlier that time jumped back: the estimate is void."""
    IGNORED = auto()
    """A repeated stamp, or a late frame."""


class Arrivals:
    """Classifies each frame, and counts the irregular ones.

    The body's number may change from frame to frame, as sensors number bodies differently.

    Args:
        counters: those of the filter; ``NAMES`` are added to them.
        reorder_window: greatest age of a late frame against the last one, seconds; an older one is a jump of time.
        reset_gap: seconds between frames from which there is a gap.

    Attributes:
        elapsed: seconds from the previous frame to the last one; 0 for the first one and after a jump.
    """

    NAMES = ("frames", "repeated_stamps", "late_frames", "backward_jumps", "gaps", "frame_changes")

    def __init__(self, counters: dict[str, int], reorder_window: float, reset_gap: float = math.inf) -> None:
        self._counters = counters
        counters.update(dict.fromkeys(self.NAMES, 0))
        self._late_ns = reorder_window * NANOSECONDS
        self._gap_ns = reset_gap * NANOSECONDS
        self.reset()

    def reset(self) -> None:
        """Forget the last frame; the counters stay."""
        self._frame_id: str | None = None
        self._stamp_ns = 0
        self.elapsed = 0.0

    def take(self, skeleton: Skeleton) -> Arrival:
        """Classify a frame, and make it the last one unless it is ignored."""
        arrival = self._compared(skeleton.frame_id, skeleton.stamp_ns - self._stamp_ns)
        if arrival is Arrival.IGNORED:
            return arrival
        following = arrival in (Arrival.NEXT, Arrival.AFTER_GAP)
        self.elapsed = (skeleton.stamp_ns - self._stamp_ns) / NANOSECONDS if following else 0.0
        self._frame_id, self._stamp_ns = skeleton.frame_id, skeleton.stamp_ns
        self._counters["frames"] += 1
        return arrival

    def _compared(self, frame_id: str, elapsed_ns: int) -> Arrival:
        if self._frame_id is None:
            return Arrival.FIRST
        if frame_id != self._frame_id:
            return self._counted("frame_changes", Arrival.AFTER_JUMP)
        if elapsed_ns == 0:
            return self._counted("repeated_stamps", Arrival.IGNORED)
        if -self._late_ns <= elapsed_ns < 0:
            return self._counted("late_frames", Arrival.IGNORED)
        if elapsed_ns < 0:
            return self._counted("backward_jumps", Arrival.AFTER_JUMP)
        if elapsed_ns > self._gap_ns:
            return self._counted("gaps", Arrival.AFTER_GAP)
        return Arrival.NEXT

    def _counted(self, name: str, arrival: Arrival) -> Arrival:
        self._counters[name] += 1
        return arrival
