"""Schedule of predicted frames while no measurement arrives."""

from __future__ import annotations

from body_tracking.core.skeleton import NANOSECONDS

PERIOD_NS = round(NANOSECONDS / 30)
"""Nanoseconds between two predicted frames: the rate of a Kinect."""


class Prediction:
    """After a silence, predicted frames are due at a steady rate until the next frame or :meth:`stop`.

    Their stamps are those of frames that would have arrived then, and do not depend on the times of the calls.

    Args:
        after: seconds without a frame after which the first predicted one is due.

    Attributes:
        due_ns: time of the next predicted frame, in the clock of :meth:`arrived`; None after :meth:`stop`.
    """

    def __init__(self, after: float) -> None:
        self.set_after(after)
        self._delay_ns = 0
        self.due_ns: int | None = None

    def set_after(self, after: float) -> None:
        """Change the time without a frame, seconds; counts from the next frame."""
        self._after_ns = round(after * NANOSECONDS)

    def arrived(self, stamp_ns: int, now_ns: int) -> None:
        """A frame with this capture time has just been filtered."""
        self._delay_ns = now_ns - stamp_ns
        self.due_ns = now_ns + self._after_ns

    def due(self, now_ns: int) -> int | None:
        """The stamp of a predicted frame that is due, to be called until None; now in any steady clock."""
        if self.due_ns is None or now_ns < self.due_ns:
            return None
        stamp_ns = self.due_ns - self._delay_ns
        self.due_ns += PERIOD_NS
        return stamp_ns

    def stop(self) -> None:
        """End the predictions until the next frame."""
        self.due_ns = None
