"""Fixed-lag smoothing: a backward pass over the last frames (Rauch, Tung and Striebel 1965).

A frame is published, corrected by the later ones, when a frame later by at least the lag has been filtered.
With the smoothed estimate of the next frame ``x_s``, ``P_s`` and the prediction of that frame ``x-``, ``P-``:

    G = P F^T (P-)^-1,    x + G (x_s - x-),    P + G (P_s - P-) G^T                                          (1)
"""

from __future__ import annotations

from typing import Any, Protocol, runtime_checkable

import numpy as np

from body_tracking.core.estimate import ModelEstimate
from body_tracking.core.skeleton import NANOSECONDS, FloatArray, Skeleton

MAX_LAG = 0.3
"""Seconds; greatest lag of a live graph."""
WHOLE_LAG = 2.0
"""Seconds; the lag with which a replay smooths a whole recording: later frames add no information."""
_SILENCE = 0.1
"""Seconds without a frame from which on the sensors are silent."""


class Frame(Protocol):
    """The estimate after one frame, with the data for a backward pass."""

    @property
    def stamp_ns(self) -> int: ...


@runtime_checkable
class SmoothableFilter(Protocol):
    """A filter whose estimates can be smoothed. Frames are its own, and immutable."""

    def last_frame(self, filtered: Skeleton | None) -> Any:
        """The estimate after the last frame, with the output of ``update``; filters on a model take None."""

    def link(self, before: Any, after: Any) -> Any:
        """The backward gains between two successive frames and the prediction; None if the pose is not continuous."""

    def smoothed(self, frame: Any, link: Any, later: Any) -> Any:
        """The frame smoothed by the next one, which is smoothed already."""

    def results_of(self, frame: Any) -> tuple[Skeleton, ModelEstimate | None]:
        """The skeleton and the state as the filter publishes them; None without a model."""


def backward_gain(cross: FloatArray, prediction: FloatArray) -> FloatArray:
    """(..., n, n) gain of eq. 1 by ``F P`` and ``P-``, both (..., n, n).

    Raises:
        LinAlgError: the prediction is singular.
    """
    return np.asarray(np.linalg.solve(prediction, cross), dtype=np.float64).swapaxes(-1, -2)


def smoothed_covariance(own: FloatArray, gain: FloatArray, later: FloatArray, prediction: FloatArray) -> FloatArray:
    """(..., n, n) smoothed covariance of eq. 1; all arguments are (..., n, n)."""
    result: FloatArray = own + gain @ (later - prediction) @ gain.swapaxes(-1, -2)
    return result


class FixedLag:
    """Holds frames back for the lag, and smooths them.

    Args:
        smoother: whose frames they are.
        lag: seconds; above ``MAX_LAG``, frames are held for up to twice as long, so that each is smoothed about twice
            instead of once for every later frame.

    Attributes:
        due_ns: time at which the sensors count as silent and all frames are released, in the clock of :meth:`take`;
            None while no frame is held.
    """

    def __init__(self, smoother: SmoothableFilter, lag: float) -> None:
        self._smoother = smoother
        self._lag_ns = round(lag * NANOSECONDS)
        self._hold_ns = self._lag_ns * (2 if lag > MAX_LAG else 1)
        self._silence_ns = round(max(lag, _SILENCE) * NANOSECONDS)
        self._held: list[Any] = []
        self._links: list[Any] = []
        self.due_ns: int | None = None

    @property
    def newest_ns(self) -> int:
        """Stamp of the newest frame that is held; 0 without one."""
        return self._held[-1].stamp_ns if self._held else 0

    def take(self, frame: Frame, now_ns: int) -> list[Any]:
        """Hold a frame; returns the smoothed frames to publish, all that are held if time jumped back."""
        released = []
        if self._held:
            if frame.stamp_ns <= self._held[-1].stamp_ns:
                released = self.flush()
            else:
                self._links.append(self._smoother.link(self._held[-1], frame))
        self._held.append(frame)
        self.due_ns = now_ns + self._silence_ns
        return released + self.passed(frame.stamp_ns)

    def passed(self, newest_ns: int) -> list[Any]:
        """The smoothed frames to publish once there is a frame of this stamp."""
        if not self._held or newest_ns - self._held[0].stamp_ns < self._hold_ns:
            return []
        return self._released(sum(frame.stamp_ns <= newest_ns - self._lag_ns for frame in self._held))

    def flush(self) -> list[Any]:
        """All held frames, smoothed."""
        return self._released(len(self._held))

    def _released(self, count: int) -> list[Any]:
        """Smooth all held frames by the backward pass, and release the first ``count``."""
        if not count:
            return []
        smoothed = self._held[-1:]
        for frame, link in zip(self._held[-2::-1], reversed(self._links), strict=True):
            smoothed.append(frame if link is None else self._smoother.smoothed(frame, link, smoothed[-1]))
        self._held, self._links = self._held[count:], self._links[count:]
        if not self._held:
            self.due_ns = None
        return smoothed[::-1][:count]
