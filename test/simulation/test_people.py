"""Bodies keep to the tables that they are drawn from, and legs connect hips and ankles without changing length."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from body_tracking.core import so3
from body_tracking.core.skeleton import Joint
from body_tracking.simulation.people import MODEL, SEXES, Course, PeopleError, Person, joints
from draws import draws

seeds = st.integers(0, 2**32 - 1)
SIDES = (Joint.HIP_LEFT, Joint.HIP_RIGHT)


def standing(person: Person, rng: np.random.Generator, count: int = 5) -> Course:
    """Somebody upright, the hips anywhere that the legs can reach, the feet on the floor."""
    q = np.tile(MODEL.neutral(), (count, 1))
    q[:, :2] = 0.05 * rng.normal(size=(count, 2)).clip(-2.0, 2.0)
    q[:, 2] = rng.uniform(0.5, 0.95, count) * person.legs.min() + person.length("hip_drop")
    half = person.length("hip_width_left")
    ankles = np.tile([[0.0, half, person.ankle_height], [0.0, -half, person.ankle_height]], (count, 1, 1))
    toes = ankles + [np.sqrt(person.foot**2 - (person.ankle_height - person.toe_height) ** 2), 0.0, 0.0]
    toes[..., 2] = person.toe_height
    return Course(np.arange(count) / 30.0, q, ankles, toes)


@given(seeds)
def test_stature_and_mass_are_within_the_tables(seed: int) -> None:
    person = Person.draw(np.random.default_rng(seed))
    low, high = {"female": (1.46, 1.79), "male": (1.58, 1.93)}[person.sex]
    assert low < person.stature < high
    assert 17.5 < person.mass / person.stature**2 < 40.0
    # the legs and the trunk add up to the stature: the centre of the head is 4.9 % below the crown
    upright = sum(person.length(name) for name in ("hip_drop", "lower_trunk", "upper_trunk", "neck", "head"))
    assert_allclose(upright + person.legs.mean() + person.ankle_height, 0.951 * person.stature, rtol=1e-9)
    shares = person.lengths / MODEL.default_lengths(person.stature)
    assert shares.min() > 0.75 and shares.max() < 1.3


def test_many_people_are_spread_as_the_tables_say() -> None:
    rng = np.random.default_rng(0)
    people = [Person.draw(rng) for _ in range(2000)]
    for sex, stature, spread, mass in (("female", 1.6285, 0.0642, 67.8), ("male", 1.7558, 0.0686, 85.5)):
        some = [person for person in people if person.sex == sex]
        assert 0.45 < len(some) / len(people) < 0.55
        statures = np.array([person.stature for person in some])
        # of 1000 people: the standard error of the mean is 2 mm
        assert_allclose(statures.mean(), stature, atol=0.008)
        assert_allclose(statures.std(), spread, rtol=0.1)
        assert_allclose(np.mean([person.mass for person in some]), mass, rtol=0.02)


@given(seeds)
def test_the_capsules_have_the_persons_mass(seed: int) -> None:
    person = Person.draw(np.random.default_rng(seed))
    capsules = person.capsules()
    course = standing(person, np.random.default_rng(0), 1)
    positions = joints(person, course)[0]
    limbs = [
        number for number, (start, end) in enumerate(zip(capsules.starts, capsules.ends, strict=True))
        if {Joint(start), Joint(end)} <= {Joint.HIP_LEFT, Joint.KNEE_LEFT, Joint.ANKLE_LEFT}
    ]  # fmt: skip
    length = np.linalg.norm(positions[capsules.ends[limbs]] - positions[capsules.starts[limbs]], axis=1)
    mass = 1060.0 * np.pi * (capsules.radii[limbs] ** 2 * length).sum()
    # a thigh and a shank: 18.5 % of a man and 19.6 % of a woman (de Leva 1996)
    assert 0.18 < mass / person.mass < 0.20


@settings(max_examples=draws(8, 15))
@given(seeds)
def test_knees_are_where_thigh_and_shank_reach_and_bend_forward(seed: int) -> None:
    rng = np.random.default_rng(seed)
    person = Person.draw(rng)
    course = standing(person, rng)
    positions = joints(person, course)
    for side, hip in enumerate(SIDES):
        thigh = positions[:, hip + 1] - positions[:, hip]
        shank = positions[:, hip + 2] - positions[:, hip + 1]
        assert_allclose(np.linalg.norm(thigh, axis=1), person.thigh[side], atol=1e-12)
        assert_allclose(np.linalg.norm(shank, axis=1), person.shank[side], atol=1e-12)
        assert_allclose(np.linalg.norm(positions[:, hip + 3] - positions[:, hip + 2], axis=1), person.foot, atol=1e-12)
        assert (np.cross(thigh, shank)[:, 1] > 0.0).all()  # flexed, not overstretched: about the left-hand side


@given(seeds, st.floats(-np.pi, np.pi))
def test_a_course_is_placed_as_a_rigid_body(seed: int, yaw: float) -> None:
    rng = np.random.default_rng(seed)
    person = Person.average(SEXES[seed % 2])
    course, position = standing(person, rng), rng.normal(size=3)
    placed = course.placed(position, yaw)
    matrix = so3.quat_to_matrix(so3.exp(np.array([0.0, 0.0, yaw])))
    assert_allclose(joints(person, placed), joints(person, course) @ matrix.T + position, atol=1e-12)
    assert_array_equal(placed.times, course.times)


def test_no_leg_is_stretched() -> None:
    person = Person.average("male")
    course = standing(person, np.random.default_rng(0))
    course.q[3, 2] = 1.01 * person.legs[0] + person.length("hip_drop") + person.ankle_height
    with pytest.raises(PeopleError, match=r"instant 3: the left ankle is 0\.8\d\d m from its hip"):
        joints(person, course)
