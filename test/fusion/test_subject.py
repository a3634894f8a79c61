"""One subject among several bodies."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from body_tracking.fusion.subject import HeldSubject, SubjectSelector
from body_tracking.skeleton import NANOSECONDS, Skeleton


def body(number: int, distance: float, state: int = 2) -> Skeleton:
    positions = np.tile([0.0, 0.0, distance], (25, 1))
    return Skeleton(0, "kinect1_optical_frame", positions, np.full(25, state, np.uint8), number)


def test_the_nearest_is_picked_and_kept() -> None:
    selector = SubjectSelector()
    picked = selector.pick([body(3, 2.0), body(5, 1.5)])
    assert picked is not None
    assert picked.body == 5
    picked = selector.pick([body(3, 1.0), body(5, 4.0)])
    assert picked is not None
    assert picked.body == 5


def test_who_is_gone_is_replaced_by_the_nearest() -> None:
    selector = SubjectSelector()
    selector.pick([body(5, 1.5)])
    picked = selector.pick([body(3, 3.0), body(4, 2.0)])
    assert picked is not None
    assert picked.body == 4
    selector.reset()
    picked = selector.pick([body(3, 1.0), body(4, 2.0)])
    assert picked is not None
    assert picked.body == 3


def test_a_body_without_a_joint_is_nobody() -> None:
    selector = SubjectSelector()
    assert selector.pick([]) is None
    assert selector.pick([body(1, 1.0, state=0)]) is None
    picked = selector.pick([body(1, 1.0, state=0), body(2, 9.0)])
    assert picked is not None
    assert picked.body == 2


def test_one_of_several_is_held_through_messages_without_that_one() -> None:
    held = HeldSubject(1.0)

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
