"""Prediction of a sensor's next frame, and whether to wait for it."""

from __future__ import annotations

from collections import deque

DUE_MARGIN = 0.002
"""A frame counts as due up to this long before its expected time, seconds: stamps jitter."""

PATIENCE = 5
"""After this many outputs in a row without its due frame, no output waits for a sensor until one comes in time."""

_USUAL = 1.0 / 30.0
"""Initial frame period, seconds: a Kinect's."""


class Rhythm:
    """The frame period of one sensor.

    Attributes:
        period: seconds between frames, by the median: a lost frame does not make a sensor slower.
    """

    def __init__(self) -> None:
        self._steps: deque[float] = deque(maxlen=7)
        self.period = _USUAL
        self._missed = 0  # outputs in a row without the due frame

    def add(self, step: float) -> None:
        """Add the time between two frames, seconds."""
        self._steps.append(step)
        self.period = sorted(self._steps)[len(self._steps) // 2]

    def due(self, age: float, silence: float) -> bool:
        """Whether another frame should have been captured by a time.

        Args:
            age: of the newest frame at that time, seconds; negative where that frame is newer.
            silence: no further frame is expected from a sensor silent for longer than this, seconds.
        """
        return 0.0 < age < silence and age > self.period - DUE_MARGIN

    def record(self, *, arrived: bool) -> None:
        """Record whether an output went out with this sensor's due frame."""
        self._missed = 0 if arrived else self._missed + 1

    @property
    def worth_waiting(self) -> bool:
        """Whether recent due frames arrived in time."""
        return self._missed < PATIENCE
