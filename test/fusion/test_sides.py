"""Whom to believe on left and right, by the headings that sensors report."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping

import pytest

from body_tracking.fusion.sides import Sides
from body_tracking.skeleton import NANOSECONDS

HOLD = 1.0
ROUND = math.pi


def believed(seconds: float, seen: Mapping[str, tuple[float, float]]) -> list[float]:
    """The upper body's heading while sensors see it turned round in a part of the time, relative to what it is.

    Args:
        seconds: how long it lasts, 30 times a second.
        seen: from when to when each sensor sees the body turned round, s.
    """
    sides, counters = Sides(HOLD), Counter[str]()
    found = []
    for number in range(round(30 * seconds)):
        time = number / 30.0
        headings = [[ROUND if begin <= time < end else 0.0] * 2 for begin, end in seen.values()]
        stamp = 10 * NANOSECONDS + round(time * NANOSECONDS)
        heading, _ = sides.believed(stamp, tuple(seen), [0.0] * len(seen), headings, counters)
        found.append(math.remainder(heading, math.tau))
    return found


@pytest.mark.parametrize("others", [1, 2, 3])
def test_one_that_turns_the_body_at_once_is_not_followed(others: int) -> None:
    right = {f"right{number}": (0.0, 0.0) for number in range(others)}
    assert believed(6.0, {"wrong": (2.0, 4.5)} | right) == pytest.approx([0.0] * 180)
    assert believed(6.0, right | {"wrong": (2.0, 4.5)}) == pytest.approx([0.0] * 180)


def test_one_that_still_errs_does_not_keep_the_others_from_being_believed() -> None:
    """Two sensors behind somebody err alike; the believed one comes to its senses, the other one never does."""
    found = believed(8.0, {"behind": (0.0, 3.0), "front": (0.0, 0.0), "also behind": (0.0, 8.0)})
    assert found[round(30 * (3.0 + HOLD)) + 2 :] == pytest.approx([0.0] * 118)


def test_nor_does_one_of_four() -> None:
    seen = {"behind": (0.0, 3.0), "front": (0.0, 0.0), "left": (0.0, 0.0), "also behind": (0.0, 8.0)}
    assert believed(8.0, seen)[-1] == pytest.approx(0.0)
