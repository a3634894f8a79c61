"""Which of the bodies that a sensor sees is the one that is tracked."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from body_tracking.skeleton import Skeleton


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


def _distance(skeleton: Skeleton) -> float:
    """Metres from the frame's origin to the mean of the joints."""
    return float(np.linalg.norm(skeleton.positions[skeleton.valid].mean(axis=0)))
