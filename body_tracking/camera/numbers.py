"""Persistent numbers of the people whom several cameras see."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from body_tracking.core.skeleton import FloatArray

_STEP: Final = 0.5
"""Metres that a person may move from one time to the next."""


class PersonNumbers:
    """Gives each person the number of the nearest person at the last time.

    Args:
        most: the largest number of people.
    """

    def __init__(self, most: int) -> None:
        self.most = most
        self._places: dict[int, FloatArray] = {}
        self._next = 0

    def of(self, people: Sequence[FloatArray]) -> list[int]:
        """The numbers of people, by their joints (n, 3) in metres, NaN where unknown."""
        centres = [np.nanmedian(each, axis=0) if np.isfinite(each).any() else np.full(3, np.inf) for each in people]
        numbers = [-1] * len(people)
        pairs = [
            (float(np.linalg.norm(centre - place)), k, number)
            for k, centre in enumerate(centres)
            for number, place in self._places.items()
        ]
        for distance, k, number in sorted(pairs):
            if distance < _STEP and numbers[k] < 0 and number not in numbers:
                numbers[k] = number
        for k, number in enumerate(numbers):
            if number < 0:
                numbers[k] = self._next
                self._next = (self._next + 1) % (1 << 16)
        # a person who is not seen for a moment keeps the number
        kept = {number: place for number, place in self._places.items() if number not in numbers}
        latest = dict(list(kept.items())[-self.most :])
        self._places = {**latest, **dict(zip(numbers, centres, strict=True))}
        return numbers
