"""Which of the bodies that a sensor sees is the one that is tracked."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from body_tracking.skeleton import NANOSECONDS, Skeleton

SUBJECTS = NEAREST, FIRST, ALL = "nearest", "first", "all"
"""Whom to track."""

MAX_PEOPLE = 6
"""As many bodies as a Kinect v2 tracks."""


class SubjectSelector:
    """Picks one body per frame of one sensor: the number that was picked last, else the one nearest to the sensor."""

    def __init__(self) -> None:
        self.body: int | None = None

    def pick(self, skeletons: Sequence[Skeleton]) -> Skeleton | None:
        """The subject.

        Args:
            skeletons: of one instant, in the sensor's own frame.

        Returns:
            One of them; None where none has a joint with a position.
        """
        seen = [skeleton for skeleton in skeletons if skeleton.valid.any()]
        if not seen:
            return None
        subject = next((skeleton for skeleton in seen if skeleton.body == self.body), None)
        if subject is None:
            subject = min(seen, key=_distance)
            self.body = subject.body
        return subject

    def reset(self) -> None:
        """Forget who was picked."""
        self.body = None


class HeldSubject:
    """Picks one of people with numbers of their own, some of whom may come in one message and others in the next.

    Args:
        hold: seconds without the one who was picked after which another is, the nearest to the frame's origin.
    """

    def __init__(self, hold: float) -> None:
        self._hold_ns = round(hold * NANOSECONDS)
        self.body: int | None = None
        self._seen_ns = 0

    def pick(self, skeletons: Sequence[Skeleton]) -> Skeleton | None:
        """The subject among skeletons of one instant; None where it is not among them."""
        seen = [skeleton for skeleton in skeletons if skeleton.valid.any()]
        subject = next((skeleton for skeleton in seen if skeleton.body == self.body), None)
        if subject is None and seen:
            if self.body is not None and 0 <= seen[0].stamp_ns - self._seen_ns <= self._hold_ns:
                return None
            subject = min(seen, key=_distance)
        if subject is not None:
            self.body, self._seen_ns = subject.body, subject.stamp_ns
        return subject


def _distance(skeleton: Skeleton) -> float:
    """Metres from the frame's origin to the mean of the joints."""
    return float(np.linalg.norm(skeleton.positions[skeleton.valid].mean(axis=0)))
