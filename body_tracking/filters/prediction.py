"""When to say what is to be expected of a person, because nothing arrives."""

from __future__ import annotations

from body_tracking.core.skeleton import NANOSECONDS

PERIOD_NS = round(NANOSECONDS / 30)
"""Nanoseconds between two predicted frames: the rate of a Kinect."""


class Prediction:
    """After a silence of some length, predicted frames are due at a steady rate until the next frame or the end.

    The stamps are those that frames would have had which arrived then; they do not depend on when somebody asks.

    Args:
        after: seconds without a frame after which the first predicted one is due.

    Attributes:
        due_ns: when the next one is due, in the clock of :meth:`arrived`; None where nothing is to be expected.
    """

    def __init__(self, after: float) -> None:
        self._after_ns = round(after * NANOSECONDS)
        self._delay_ns = 0
        self.due_ns: int | None = None

    def arrived(self, stamp_ns: int, now_ns: int) -> None:
        """A frame of this capture time came just now, and the filter took it."""
        self._delay_ns = now_ns - stamp_ns
        self.due_ns = now_ns + self._after_ns

    def due(self, now_ns: int) -> int | None:
        """The stamp of a predicted frame that is due; ask again until there is none.

        Args:
            now_ns: as in :meth:`arrived`; any clock that goes on.
        """
        if self.due_ns is None or now_ns < self.due_ns:
            return None
        stamp_ns = self.due_ns - self._delay_ns
        self.due_ns += PERIOD_NS
        return stamp_ns

    def stop(self) -> None:
        """Nothing is to be expected any more, until a frame arrives."""
        self.due_ns = None
