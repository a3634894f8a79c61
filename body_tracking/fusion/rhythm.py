"""When a sensor's next frame is due, and whether it is worth waiting for."""

from __future__ import annotations

from collections import deque

DUE_MARGIN = 0.002
"""A frame counts as due when it is expected up to this much after the frame that waits, seconds: stamps jitter."""

PATIENCE = 5
"""A sensor whose due frame came too late for this many outputs in a row is not waited for until one comes in time."""

_USUAL = 1.0 / 30.0
"""Seconds between the frames of a sensor of which only one is known: the rate of a Kinect."""


class Rhythm:
    """The rhythm of one sensor's frames.

    Attributes:
        period: seconds between frames, by the median: a lost frame does not make a sensor slower.
    """

    def __init__(self) -> None:
        self._steps: deque[float] = deque(maxlen=7)
        self.period = _USUAL
        self._missed = 0  # outputs in a row for which its frame was due and did not come in time

    def add(self, step: float) -> None:
        """A frame was captured so many seconds after the one before."""
        self._steps.append(step)
        self.period = sorted(self._steps)[len(self._steps) // 2]

    def due(self, age: float, silence: float) -> bool:
        """Whether another frame should have been captured by a time.

        Args:
            age: of the newest frame at that time, seconds; negative where that frame is newer.
            silence: a sensor of which nothing came for longer than this is not expected to go on.
        """
        return 0.0 < age < silence and age > self.period - DUE_MARGIN

    def record(self, *, arrived: bool) -> None:
        """What waited goes on, with this sensor's frame or without it."""
        self._missed = 0 if arrived else self._missed + 1

    @property
    def worth_waiting(self) -> bool:
        """Whether a frame that is due can be hoped for."""
        return self._missed < PATIENCE
