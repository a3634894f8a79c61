"""Whom to track: parameters that several nodes have, and which of the bodies that a sensor sees is the subject."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from body_tracking.core.parameters import Value, fields_of, parameters_from
from body_tracking.core.skeleton import NANOSECONDS, Skeleton

SUBJECTS = NEAREST, FIRST, ALL = "nearest", "first", "all"
"""Whom to track."""

MAX_PEOPLE = 6
"""As many bodies as a Kinect v2 tracks."""


HOLD = 3.0
"""Seconds for which a person whom no sensor sees keeps the id."""


@dataclass(frozen=True, slots=True)
class PeopleParameters:
    """Whom to track."""

    subject: str = field(
        default=NEAREST,
        metadata={
            "doc": "whom to track: the person who is nearest to the reference sensor at first, or the one who is seen "
            "first, for as long as that person is there; or all, each under a number and with topics of their own",
            "choices": SUBJECTS,
        },
    )
    people: int = field(
        default=MAX_PEOPLE,
        metadata={
            "doc": "subject all: how many people at most; their ids are body1, body2, ...",
            "min": 1,
            "max": 16,
        },
    )
    hold: float = field(
        default=HOLD,
        metadata={
            "doc": "a person whom no sensor sees keeps the id for this long; another is chosen, or gets it, then",
            "unit": "s",
            "min": 0.5,
            "max": 60.0,
        },
    )


PEOPLE = parameters_from(PeopleParameters, only=("subject", "people"))
"""Whom to track: of ``fusion`` and ``skeleton_filter``; ``joint_angles`` needs to know of it."""


def people_from(values: Mapping[str, Value]) -> PeopleParameters:
    """Whom to track, of the values of :data:`PEOPLE`.

    Raises:
        ParameterError: one of them is out of its range.
    """
    table = parameters_from(PeopleParameters)
    given = {item.name: item.check(values[item.name]) for item in table if item.name in values}
    return PeopleParameters(**fields_of(PeopleParameters, given))


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
