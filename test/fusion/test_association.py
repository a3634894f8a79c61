"""Laws of the assignment of bodies to people."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from body_tracking.core.skeleton import MIRROR, NANOSECONDS, FloatArray, Skeleton
from body_tracking.fusion.association import HOLD, Association, torso_distances, torso_points
from draws import draws
from walkers import performed

FIGURE = performed("standing_still", np.zeros(1))[0]
"""(25, 3) metres: a person who stands at the origin."""

START_NS = 40 * NANOSECONDS
TRACKED = np.full(25, 2, np.uint8)

Who = dict[int, int | None]
"""The number of each true person."""


def body(place: Sequence[float], stamp_ns: int, number: int, rng: np.random.Generator | None = None) -> Skeleton:
    noise = 0.0 if rng is None else 0.02 * rng.normal(size=(25, 3))
    return Skeleton(stamp_ns, "world", FIGURE + [*place, 0.0] + noise, TRACKED, number)


def walked(
    seconds: float, paths: Mapping[int, tuple[Sequence[float], Sequence[float]]], rate: float = 30.0
) -> Iterator[tuple[int, dict[int, FloatArray]]]:
    """Stamps, and where each person is: from one place to another, at a constant speed."""
    times = np.arange(0.0, seconds, 1.0 / rate)
    for time in times:
        share = time / seconds
        yield (
            START_NS + round(time * NANOSECONDS),
            {who: (1.0 - share) * np.array(a) + share * np.array(b) for who, (a, b) in paths.items()},
        )


def assign_frame(
    association: Association,
    sensor: str,
    stamp_ns: int,
    places: Mapping[int, FloatArray],
    numbers: Mapping[int, int] | None = None,
    rng: np.random.Generator | None = None,
) -> Who:
    """Assign one frame of a sensor, with these people in it."""
    bodies = [
        body(place.tolist(), stamp_ns, who if numbers is None else numbers[who], rng) for who, place in places.items()
    ]
    return dict(zip(places, association.assign(sensor, bodies), strict=True))


@settings(max_examples=draws(5, 12), deadline=None)
@given(seed=st.integers(0, 10_000), order=st.permutations(range(5)))
def test_assignment_is_independent_of_the_order_of_bodies(seed: int, order: list[int]) -> None:
    rng = np.random.default_rng(seed)
    starts, ends = rng.uniform(-2.0, 2.0, (2, 5, 2))
    paths = {who: (starts[who].tolist(), ends[who].tolist()) for who in range(5)}
    ordered, other = Association(), Association()
    for stamp_ns, places in walked(1.5, paths, rate=10.0):
        noise = [np.random.default_rng([seed, stamp_ns % 10_000]) for _ in range(2)]
        bodies = [body(places[who].tolist(), stamp_ns, who, noise[0]) for who in range(5)]
        expected = ordered.assign("kinect1", bodies)
        assert other.assign("kinect1", [bodies[who] for who in order]) == tuple(expected[who] for who in order)


def test_torso_distance_ignores_swapped_sides_and_an_outlier() -> None:
    points = torso_points(np.stack([FIGURE, FIGURE[MIRROR]]))
    assert torso_distances(points[:1], points[1:])[0, 0] == pytest.approx(0.0, abs=1e-12)
    astray = FIGURE.copy()
    astray[0] += 3.0
    partly = np.full((25, 3), np.nan)
    partly[7] = FIGURE[7]  # a hand alone
    apart = torso_distances(points[:1], torso_points(np.stack([astray, partly])))[0]
    assert apart[0] == pytest.approx(0.0, abs=1e-12) and 0.0 < apart[1] < 1.0
    unknown = torso_points(np.full((1, 25, 3), np.nan))
    assert torso_distances(points[:1], unknown)[0, 0] == np.inf


@pytest.mark.parametrize("gap", [0.5, 0.8 * HOLD])
def test_a_hidden_person_keeps_the_number_for_the_hold_time_only(gap: float) -> None:
    association = Association()
    standing = {0: np.array([2.0, 0.0]), 1: np.array([2.5, 1.5])}
    for stamp_ns, places in walked(1.0, {who: (at.tolist(), at.tolist()) for who, at in standing.items()}):
        before = assign_frame(association, "kinect1", stamp_ns, places)
    end_ns = stamp_ns + round(gap * NANOSECONDS)
    for at_ns in range(stamp_ns, end_ns, NANOSECONDS // 30):
        assign_frame(association, "kinect1", at_ns + 1, {0: standing[0]})
    # with a new number of the sensor's, half a metre further
    back = {0: standing[0], 1: standing[1] + [0.3, 0.4]}
    assert assign_frame(association, "kinect1", end_ns, back, numbers={0: 0, 1: 5}) == before
    later_ns = end_ns + round((HOLD + 0.5) * NANOSECONDS)
    for at_ns in range(end_ns, later_ns, NANOSECONDS // 30):
        assign_frame(association, "kinect1", at_ns + 1, {0: standing[0]})
    for step in range(12):  # a new person is confirmed after some frames
        after = assign_frame(association, "kinect1", later_ns + step * NANOSECONDS // 30, back)
        assert step > 0 or after[1] is None
    assert after[0] == before[0] and after[1] not in (None, *before.values())
    assert association.counters["lost"] == 1 and association.counters["new"] == 3


@pytest.mark.parametrize("numbers", ["kept", "exchanged", "shuffled"])
@pytest.mark.parametrize("hidden", [0.0, 0.6])
def test_crossing_people_keep_their_numbers_whatever_the_sensor_calls_them(numbers: str, hidden: float) -> None:
    """Two people pass each other 0.6 m apart at 1.2 m/s each; the farther one may be hidden meanwhile."""
    rng = np.random.default_rng(5)
    association = Association()
    paths = {0: ((2.0, -1.5), (2.0, 1.5)), 1: ((2.6, 1.5), (2.6, -1.5))}
    assigned: set[tuple[int | None, int | None]] = set()
    for stamp_ns, places in walked(2.5, paths):
        passing = abs(places[0][1] - places[1][1]) < hidden
        middle = stamp_ns > START_NS + 1.25 * NANOSECONDS
        names = {0: 0, 1: 1}
        if numbers == "exchanged" and middle:
            names = {0: 1, 1: 0}
        elif numbers == "shuffled":
            names = dict(enumerate(rng.permutation(6)[:2].tolist()))
        seen = {0: places[0]} if passing else places
        who = assign_frame(association, "kinect1", stamp_ns, seen, names, rng)
        if not passing:
            assigned.add((who[0], who[1]))
    assert len(assigned) == 1 and None not in (*assigned,)[0]
    assert association.counters["new"] == 2 and association.counters["lost"] == 0


def test_people_have_the_same_numbers_in_both_sensors() -> None:
    rng = np.random.default_rng(6)
    for count in (1, 3):
        association = Association()
        paths = {who: ((2.0 + who, -1.0), (2.0 + who, 1.0)) for who in range(count)}
        off = np.array([0.12, -0.1])  # the second sensor is calibrated that badly
        assigned: dict[str, set[tuple[int | None, ...]]] = {"kinect1": set(), "kinect2": set()}
        for step, (stamp_ns, places) in enumerate(walked(3.0, paths)):
            sensor = ("kinect1", "kinect2")[step % 2]
            shown = {who: place + (off if step % 2 else 0.0) for who, place in places.items()}
            numbers = dict(enumerate(np.random.default_rng(step % 2).permutation(6)[:count].tolist()))
            assigned[sensor].add(tuple(assign_frame(association, sensor, stamp_ns, shown, numbers, rng).values()))
        assert assigned["kinect1"] == assigned["kinect2"] and len(assigned["kinect1"]) == 1
        assert association.people == tuple(range(1, count + 1))


def test_bodies_beyond_the_gate_are_two_people_until_merged() -> None:
    association = Association()
    for step, (stamp_ns, places) in enumerate(walked(4.0, {0: ((2.0, 0.0), (2.0, 0.0))})):
        # the second sensor's pose is wrong until it is corrected
        wrong = np.array([0.0, 0.9]) if step < 60 else np.zeros(2)
        if step == 60:
            association.move_sensor("kinect2", np.eye(3), np.array([0.0, -0.9, 0.0]))
        sensor = ("kinect1", "kinect2")[step % 2]
        assign_frame(association, sensor, stamp_ns, {0: places[0] + (wrong if step % 2 else 0.0)})
        if step == 59:
            assert len(association.people) == 2
    assert association.people == (1,)
    assert association.counters["merged"] == 1


def test_an_assignment_that_other_sensors_contradict_for_long_changes() -> None:
    """One sensor sees both; the other one has seen only the second person, and assigned it to the first, nearby."""
    association = Association()
    assigned: list[int | None] = []
    for step, (stamp_ns, places) in enumerate(walked(4.0, {0: ((2.0, 0.0), (2.0, 0.0)), 1: ((2.4, 0.1), (2.6, 0.9))})):
        if step < 10:
            assign_frame(association, "kinect1", stamp_ns, {0: places[0]})
            assign_frame(association, "kinect2", stamp_ns + 1, {0: places[1]}, numbers={0: 4})
            continue
        who = assign_frame(association, "kinect1", stamp_ns, places)
        assigned.append(assign_frame(association, "kinect2", stamp_ns + 1, {0: places[1]}, numbers={0: 4})[0])
    assert who[1] is not None and who[0] != who[1]
    assert assigned[0] == who[0] and assigned[-1] == who[1]
    assert association.counters["exchanged"] >= 1 and association.counters["lost"] == 0


def test_reset_forgets_all_people_and_reuses_no_number() -> None:
    association = Association()
    assert assign_frame(association, "kinect1", START_NS, {0: np.zeros(2), 1: np.ones(2)}) == {0: 1, 1: 2}
    assert association.assign("kinect1", []) == ()
    association.reset()
    assert association.people == ()
    assert assign_frame(association, "kinect1", START_NS - 10 * NANOSECONDS, {0: np.zeros(2)}) == {0: 3}
