"""Selection of the tracked person: its parameters, and the choice of the subject among the bodies of a sensor."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from body_tracking.core.parameters import Value, fields_of, parameters_from
from body_tracking.core.skeleton import NANOSECONDS, Skeleton

SUBJECTS = NEAREST, FIRST, ALL = "nearest", "first", "all"
"""Values of the parameter ``subject``."""

MAX_PEOPLE = 6
"""As many bodies as a Kinect v2 tracks."""

HOLD = 3.0
"""Seconds for which an unseen person keeps the id."""


@dataclass(frozen=True, slots=True)
class PeopleParameters:
    """Parameters of the selection of people."""

    subject: str = field(
        default=NEAREST,
        metadata={
            "doc": "the tracked person, until that person leaves: the one nearest to the reference sensor at first, "
            "or the one seen first; or all, each with an id and topics of their own",
            "choices": SUBJECTS,
        },
    )
    people: int = field(
        default=MAX_PEOPLE,
        metadata={
            "doc": "with subject all: the largest number of people; their ids are body1, body2, ...",
            "min": 1,
            "max": 16,
        },
    )
    hold: float = field(
        default=HOLD,
        metadata={
            "doc": "an unseen person keeps the id for this long; then it is free for another person",
            "unit": "s",
            "min": 0.5,
            "max": 60.0,
        },
    )


PEOPLE = parameters_from(PeopleParameters, only=("subject", "people"))
"""Parameters of ``fusion``, ``skeleton_filter`` and ``joint_angles``."""


def people_from(values: Mapping[str, Value]) -> PeopleParameters:
    """The parameters among a node's values; ParameterError for one out of its range."""
    table = parameters_from(PeopleParameters)
    given = {item.name: item.check(values[item.name]) for item in table if item.name in values}
    return PeopleParameters(**fields_of(PeopleParameters, given))


class SubjectSelector:
    """Picks one body per instant: the one with the last picked number, else the body nearest to the frame's origin.

    Args:
        hold: seconds for which nobody else is picked while the picked body is absent, as where each body has a message
            of its own.
    """

    def __init__(self, hold: float = 0.0) -> None:
        self._hold_ns = round(hold * NANOSECONDS)
        self.body: int | None = None
        self._seen_ns = 0

    def pick(self, skeletons: Sequence[Skeleton]) -> Skeleton | None:
        """The subject among skeletons of one instant; None where none is valid, or ``hold`` has not passed yet."""
        seen = [skeleton for skeleton in skeletons if skeleton.valid.any()]
        subject = next((skeleton for skeleton in seen if skeleton.body == self.body), None)
        if subject is None and seen:
            if self.body is not None and 0 <= seen[0].stamp_ns - self._seen_ns < self._hold_ns:
                return None
            # the nearest by the mean of the joints, from the frame's origin
            subject = min(seen, key=lambda each: float(np.linalg.norm(each.positions[each.valid].mean(axis=0))))
        if subject is not None:
            self.body, self._seen_ns = subject.body, subject.stamp_ns
        return subject

    def reset(self) -> None:
        """Forget the picked body."""
        self.body = None
