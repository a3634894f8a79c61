"""Left and right from the headings that sensors report."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping

import numpy as np
import pytest

from body_tracking.core.sides import PAIRS
from body_tracking.core.skeleton import NANOSECONDS, Joint
from body_tracking.fusion.sides import MIN_HOLD, Sides

HOLD = 1.0
ROUND = math.pi
WEIGHTS = [[50.0, 10.0]] * 4


def accepted_headings(seconds: float, seen: Mapping[str, tuple[float, float]], hold: float = HOLD) -> list[float]:
    """The error of the upper body's heading while sensors see the body turned round for part of the time.

    Args:
        seconds: how long it lasts, 30 times a second.
        seen: from when to when each sensor, which the body faces, sees it turned round, s.
        hold: of a reversal, s.
    """
    sides, counters = Sides(hold), Counter[str]()
    found = []
    for number in range(round(30 * seconds)):
        time = number / 30.0
        headings = [[ROUND if begin <= time < end else 0.0] * 2 for begin, end in seen.values()]
        stamp = 10 * NANOSECONDS + round(time * NANOSECONDS)
        heading, _ = sides.accepted_headings(
            stamp, tuple(seen), [upper for upper, _ in headings], headings, WEIGHTS[: len(headings)], counters
        )
        found.append(math.remainder(heading, math.tau))
    return found


@pytest.mark.parametrize("others", [1, 2, 3])
def test_a_reversal_seen_by_one_sensor_is_rejected(others: int) -> None:
    right = {f"right{number}": (0.0, 0.0) for number in range(others)}
    assert accepted_headings(6.0, {"wrong": (2.0, 4.5)} | right) == pytest.approx([0.0] * 180)
    assert accepted_headings(6.0, right | {"wrong": (2.0, 4.5)}) == pytest.approx([0.0] * 180)


@pytest.mark.parametrize("right", [["front"], ["front", "left"]])
def test_a_sensor_that_still_errs_does_not_block_a_correct_majority(right: list[str]) -> None:
    """Two sensors behind a person err alike; the trusted one recovers, the other one does not."""
    seen = {"behind": (0.0, 3.0)} | dict.fromkeys(right, (0.0, 0.0)) | {"also behind": (0.0, 8.0)}
    found = accepted_headings(8.0, seen)
    assert found[round(30 * (3.0 + HOLD)) + 2 :] == pytest.approx([0.0] * 118)


@pytest.mark.parametrize("wrong", [2.5, 4.0])
def test_a_temporary_reversal_of_a_person_facing_the_sensors_is_rejected(wrong: float) -> None:
    """Also at the beginning, and where all sensors err at once."""
    for begin in (0.5, 5.0):
        seen = {"left": (begin, begin + wrong), "right": (begin, begin + 2.0)}
        assert accepted_headings(12.0, seen, hold=10.0) == pytest.approx([0.0] * 360)


@pytest.mark.parametrize(("wrong", "until"), [(0.3, 0.3 + MIN_HOLD), (3.0, 6.0)])
def test_a_wrong_start_is_corrected_after_its_own_duration(wrong: float, until: float) -> None:
    """A Kinect assumes that people face it, so a back view is the rarer error."""
    found = accepted_headings(10.0, {"alone": (0.0, wrong)}, hold=10.0)
    turned = round(30 * until)
    assert np.abs(found[: turned - 2]) == pytest.approx(ROUND)
    assert found[turned + 2 :] == pytest.approx([0.0] * (298 - turned))


def test_a_lasting_reversal_is_accepted_after_the_hold_time() -> None:
    found = accepted_headings(30.0, {"alone": (5.0, 30.0)}, hold=10.0)
    assert found[: 30 * 15] == pytest.approx([0.0] * 450)
    assert np.abs(found[30 * 15 + 2 :]) == pytest.approx(ROUND)


def test_the_heading_survives_the_loss_of_the_trusted_sensor() -> None:
    sides, counters, found = Sides(), Counter[str](), []
    for number in range(240):
        time = number / 30.0
        other = ROUND if 2.5 <= time < 5.5 else 0.0
        headings = [[math.nan if time >= 2.0 else 0.0] * 2, [other] * 2]
        stamp = 10 * NANOSECONDS + round(time * NANOSECONDS)
        heading, _ = sides.accepted_headings(
            stamp, ("front", "side"), [0.0, other], headings, WEIGHTS[: len(headings)], counters
        )
        found.append(math.remainder(heading, math.tau))
    assert found == pytest.approx([0.0] * 240)
    assert sides.trusted == "side"


def test_a_trusted_sensor_with_a_side_view_has_little_weight_on_the_heading() -> None:
    """The trusted sensor comes to see the body from the side, its hips 6 cm apart, while another faces it."""
    sides, counters = Sides(), Counter[str]()
    for number in range(60):
        turn = min(number / 30.0, 1.2)
        seen, weights = [[0.3 * turn] * 2, [turn] * 2], [[5.0, 2.0], [60.0, 15.0]]
        stamp = 10 * NANOSECONDS + number * NANOSECONDS // 30
        accepted = sides.accepted_headings(stamp, ("side", "front"), [0.1 + turn, 0.0], seen, weights, counters)
    assert accepted == pytest.approx([1.2, 1.2], abs=0.15)


def test_shoulders_and_hips_are_never_reversed_against_each_other() -> None:
    """However long a sensor reports one half reversed."""
    sides, counters = Sides(), Counter[str]()
    for number in range(600):
        seen = [[0.0 if number < 60 else ROUND, 0.0]]
        stamp = 10 * NANOSECONDS + number * NANOSECONDS // 30
        upper, lower = sides.accepted_headings(stamp, ("alone",), [0.0], seen, [[50.0, 60.0]], counters)
        assert math.cos(upper - lower) > 0.0


def test_a_sensor_of_small_weight_reverses_no_body_during_a_short_silence() -> None:
    """In a side view a Kinect reports any heading; the trusted one is silent for a quarter of a second."""
    sides, counters = Sides(), Counter[str]()
    for number in range(150):
        silent = 60 <= number < 68
        seen = [[math.nan if silent else 0.0] * 2, [-1.8 if number < 90 else 2.5] * 2]
        weights = [[0.0 if silent else 30.0] * 2, [3.0, 5.0]]
        stamp = 10 * NANOSECONDS + number * NANOSECONDS // 30
        headings = sides.accepted_headings(stamp, ("front", "side"), [0.2, 0.0], seen, weights, counters)
    assert np.cos(headings).min() > 0.8


def test_a_jump_of_one_hip_does_not_turn_the_hips() -> None:
    """A label that jumps by 25 cm for two frames, in the only sensor."""
    sides = Sides()
    hips, shoulders = PAIRS[1], PAIRS[0]
    for number in range(40):
        points = np.zeros((1, len(Joint), 3))
        points[0, shoulders[0], 1], points[0, shoulders[1], 1] = 0.18, -0.18
        points[0, hips[0], 1], points[0, hips[1], 1] = 0.08, -0.08
        wild = number in (30, 31)
        if wild:
            points[0, hips[1], 0] += 0.25
        variance = np.full((1, len(Joint)), 0.03**2)
        states = np.full((1, len(Joint)), 2, dtype=np.uint8)
        stamp = 10 * NANOSECONDS + number * NANOSECONDS // 30
        sides.correct(stamp, ("alone",), [0.0], points, variance, states, Counter())
        assert np.isinf(variance[0, hips]).all() == wild
        assert np.isfinite(variance[0, shoulders]).all()
