"""One subject among several bodies."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from body_tracking.core.skeleton import NANOSECONDS, Skeleton
from body_tracking.pipeline.people import SubjectSelector


def body(number: int, distance: float, state: int = 2) -> Skeleton:
    positions = np.tile([0.0, 0.0, distance], (25, 1))
    return Skeleton(0, "kinect1_optical_frame", positions, np.full(25, state, np.uint8), number)


def test_the_nearest_with_a_joint_is_picked_and_kept_until_gone() -> None:
    selector = SubjectSelector()

    def pick(*bodies: Skeleton) -> int | None:
        picked = selector.pick(list(bodies))
        return None if picked is None else picked.body

    assert pick() is None
    assert pick(body(1, 1.0, state=0)) is None
    assert pick(body(1, 1.0, state=0), body(3, 2.0), body(5, 1.5)) == 5
    assert pick(body(3, 1.0), body(5, 4.0)) == 5
    assert pick(body(3, 3.0), body(4, 2.0)) == 4
    selector.reset()
    assert pick(body(3, 1.0), body(4, 2.0)) == 3


def test_one_of_several_is_held_through_messages_without_that_one() -> None:
    held = SubjectSelector(1.0)

    def pick(seconds: float, *numbers: tuple[int, float]) -> int | None:
        stamp_ns = round(seconds * NANOSECONDS)
        found = held.pick([replace(body(number, distance), stamp_ns=stamp_ns) for number, distance in numbers])
        return None if found is None else found.body

    assert pick(10.0, (1, 3.0), (2, 2.0)) == 2
    assert pick(10.1, (1, 1.0)) is None
    assert pick(10.2, (1, 1.0), (2, 2.0)) == 2
    assert pick(11.1, (1, 1.0)) is None
    assert pick(11.3, (1, 1.0), (3, 4.0)) == 1
    assert pick(2.0, (3, 1.0)) == 3  # time jumped back
