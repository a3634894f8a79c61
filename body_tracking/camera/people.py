"""The people in the images of one camera, each with a number that stays while the person is seen."""

from __future__ import annotations

from collections import Counter

from body_tracking.camera.pose_model import ImageArray, Landmarks, PoseModel, Region
from body_tracking.core.skeleton import NANOSECONDS

_LOST_BELOW = 0.5
"""Probability that a region has a person in it, below which the person is gone."""
_SAME_PERSON = 0.6
"""Overlap of two people's next regions from which on they are the same person, found twice."""
_KNOWN = 0.3
"""Overlap with a tracked person's region from which on a detection is not of another person."""


class PersonTracker:
    """Finds people by the detector, and follows each from image to image.

    Args:
        model: the networks.
        people: the largest number of people.
        search_every: seconds between two searches for more of them.

    Attributes:
        counters: of searches, and of people lost or found twice.
    """

    def __init__(self, model: PoseModel, people: int, search_every: float) -> None:
        self._model, self._people, self._every_ns = model, people, round(search_every * NANOSECONDS)
        self.counters: Counter[str] = Counter()
        self.reset()

    def reset(self) -> None:
        """Forget everybody."""
        self._tracked: dict[int, Region] = {}
        self._searched_ns: int | None = None
        self._next = 0

    def update(self, stamp_ns: int, image: ImageArray) -> dict[int, Landmarks]:
        """The people in an image, by their numbers.

        Args:
            stamp_ns: of the image.
            image: (height, width, 3) red, green, blue.
        """
        if self._searches(stamp_ns):
            self._searched_ns = stamp_ns
            self.counters["searches for people"] += 1
            for region in self._model.detect(image):
                known = any(region.overlap(each) > _KNOWN for each in self._tracked.values())
                if not known and len(self._tracked) < self._people:
                    self._tracked[self._next] = region
                    self._next = (self._next + 1) % (1 << 16)
        found: dict[int, Landmarks] = {}
        for number, region in self._tracked.items():
            landmarks = self._model.find(image, region)
            if landmarks.presence < _LOST_BELOW or landmarks.next_region.side < 1.0:
                self.counters["people lost"] += 1
            elif any(landmarks.next_region.overlap(each.next_region) > _SAME_PERSON for each in found.values()):
                self.counters["people found twice"] += 1
            else:
                found[number] = landmarks
        self._tracked = {number: each.next_region for number, each in found.items()}
        return found

    def _searches(self, stamp_ns: int) -> bool:
        if len(self._tracked) >= self._people:
            return False
        return self._searched_ns is None or not 0 <= stamp_ns - self._searched_ns < self._every_ns
