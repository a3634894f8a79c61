"""For any person and motion: constant bone lengths, angles within ranges, feet on the floor, bounded jerk."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from body_tracking.core.skeleton import BONES, FloatArray, Joint
from body_tracking.kinematics.ranges import Ranges
from body_tracking.simulation.people import MODEL, SEXES, Course, Person, joints
from body_tracking.simulation.repertoire import (
    END_S,
    MOTIONS,
    TPOSE_S,
    Movement,
    RepertoireError,
    make_movement,
)
from draws import draws, some

RANGES = Ranges(MODEL)
FREE = ("walking_and_turning", "standing_still", "random")
"""Motions without a T-pose."""
names = st.sampled_from(list(MOTIONS))
seeds = st.integers(0, 2**32 - 1)


def performance(name: str, seed: int | None) -> tuple[Person, Movement]:
    """A motion by the seed's person, or the standard performance by an average man."""
    if seed is None:
        person = Person.average("male")
        return person, make_movement(name, person)
    rng = np.random.default_rng(seed)
    person = Person.draw(rng)
    return person, make_movement(name, person, rng)


def watched(movement: Movement, rate: float = 30.0) -> Course:
    return movement.course(np.arange(0.0, movement.duration, 1.0 / rate))


@cache
def standard(name: str) -> tuple[Person, Course, FloatArray]:
    """The standard performance, at 100 Hz."""
    person, movement = performance(name, None)
    course = watched(movement, 100.0)
    return person, course, joints(person, course)


def coordinate(course: Course, name: str) -> FloatArray:
    """(n,) degrees of a joint that turns about axes."""
    return np.degrees(course.q[:, dict(zip(MODEL.scalar_v, MODEL.scalar_q, strict=True))[_index(name)]])


def _index(name: str) -> int:
    return MODEL.coordinate_names.index(name)


def between(a: FloatArray, b: FloatArray) -> FloatArray:
    """Degrees between vectors."""
    cosine = (a * b).sum(axis=-1) / (np.linalg.norm(a, axis=-1) * np.linalg.norm(b, axis=-1))
    return np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))


def bent(positions: FloatArray, *chain: Joint) -> FloatArray:
    """(n,) degrees by which a limb of three joints is bent; straight is 0."""
    first, middle, last = (positions[:, joint] for joint in chain)
    return between(middle - first, last - middle)


def shoulder_yaw(positions: FloatArray) -> FloatArray:
    """(n,) degrees by which the shoulders' line is turned to the left."""
    line = positions[:, Joint.SHOULDER_LEFT] - positions[:, Joint.SHOULDER_RIGHT]
    return np.degrees(np.unwrap(np.arctan2(-line[:, 0], line[:, 1])))


@settings(max_examples=draws(8, 15))
@given(names, seeds)
def test_no_angle_leaves_its_range(name: str, seed: int) -> None:
    _, movement = performance(name, seed)
    assert np.abs(RANGES.excess(watched(movement).q)).max() == 0.0


@settings(max_examples=draws(8, 15))
@given(names, seeds)
def test_bones_keep_their_lengths(name: str, seed: int) -> None:
    person, movement = performance(name, seed)
    positions = joints(person, watched(movement, 20.0))
    starts, ends = np.array(BONES).T
    lengths = np.linalg.norm(positions[:, ends] - positions[:, starts], axis=-1)
    assert_allclose(lengths, np.broadcast_to(lengths[0], lengths.shape), atol=1e-9)


@settings(max_examples=draws(8, 15))
@given(names, seeds)
def test_feet_are_never_below_the_floor_and_stay_where_they_stand(name: str, seed: int) -> None:
    person, movement = performance(name, seed)
    course = watched(movement)
    assert course.toes[..., 2].min() >= person.toe_height - 1e-9
    assert course.ankles[..., 2].min() >= person.ankle_height - 1e-9
    if name not in ("walking_and_turning", "random"):
        assert np.ptp(course.toes, axis=0).max() < 1e-12
        if name not in ("torso_twist", "calf_raise"):
            assert np.ptp(course.ankles, axis=0).max() < 1e-12


@pytest.mark.parametrize("name", ["walking_and_turning", "random"])
@pytest.mark.parametrize("seed", range(4))
def test_walking_always_has_a_foot_that_does_not_slide(name: str, seed: int) -> None:
    _, movement = performance(name, seed)
    times = np.arange(0.1, movement.duration - 0.1, 0.02)
    step = 1e-3
    before, after = movement.course(times - step), movement.course(times + step)
    speeds = np.linalg.norm(after.toes - before.toes, axis=-1) / (2.0 * step)
    assert speeds.min(axis=1).max() < 1e-9
    assert speeds.max() > 0.5


@pytest.mark.parametrize("name", some(list(MOTIONS), 2))
def test_accelerations_are_continuous(name: str) -> None:
    """A jump of the acceleration makes third differences grow with the rate; bounded jerk does not."""
    person, movement = performance(name, 5)
    largest = []
    for step in (6e-3, 2e-3):
        positions = joints(person, movement.course(np.arange(0.0, movement.duration, step)))
        largest.append(np.abs(np.diff(positions, 3, axis=0)).max() / step**3)
    assert largest[1] < 1.6 * largest[0]


@settings(max_examples=draws(5, 12))
@given(names, seeds)
def test_people_move_no_faster_than_people(name: str, seed: int) -> None:
    person, movement = performance(name, seed)
    positions = joints(person, watched(movement, 60.0))
    speeds = 60.0 * np.linalg.norm(np.diff(positions, axis=0), axis=-1)
    # a boxer's fist reaches 8 m/s, a walker's foot 4 m/s; random people step by 0.6 m in 0.5 s
    assert speeds.max() < 8.0
    assert speeds[:, Joint.SPINE_BASE].max() < 2.6


@settings(max_examples=draws(8, 15))
@given(st.sampled_from([name for name in MOTIONS if name not in FREE]), seeds)
def test_exercises_begin_and_end_in_a_t_pose(name: str, seed: int) -> None:
    person, movement = performance(name, seed)
    assert movement.tpose_s == TPOSE_S
    for begin, end in ((0.0, TPOSE_S), (movement.duration - END_S, movement.duration)):
        is_a_t_pose(joints(person, movement.course(np.linspace(begin, end, 20))))


@pytest.mark.parametrize("sex", SEXES)
def test_arms_spread_as_wide_as_the_person_is_tall(sex: str) -> None:
    """Leonardo's man, to 8 %; the middle of the head is below the crown, and the feet are on the floor."""
    person = Person.average(sex)
    positions = joints(person, make_movement("two_handed_wave", person).course(np.array([1.0])))[0]
    span = np.linalg.norm(positions[Joint.HAND_TIP_LEFT] - positions[Joint.HAND_TIP_RIGHT])
    assert span == pytest.approx(person.stature, rel=0.08)
    assert 0.91 * person.stature < positions[Joint.HEAD, 2] < person.stature
    assert 0.0 < positions[Joint.FOOT_LEFT, 2] < 0.1


def is_a_t_pose(positions: FloatArray) -> None:
    for side, outward in (("LEFT", 1.0), ("RIGHT", -1.0)):
        shoulder, elbow, wrist = (Joint[f"{part}_{side}"] for part in ("SHOULDER", "ELBOW", "WRIST"))
        arm = positions[:, wrist] - positions[:, shoulder]
        assert between(arm, np.array([0.0, outward, 0.0])).max() < 30.0
        assert bent(positions, shoulder, elbow, wrist).max() < 20.0
    spine = positions[:, Joint.SPINE_SHOULDER] - positions[:, Joint.SPINE_BASE]
    assert between(spine, np.array([0.0, 0.0, 1.0])).max() < 12.0


@pytest.mark.parametrize("name", MOTIONS)
def test_a_seed_repeats_and_people_differ(name: str) -> None:
    times = np.linspace(0.0, 9.0, 30)
    one, same, other = (performance(name, seed)[1].course(times) for seed in (1, 1, 2))
    assert_array_equal(one.q, same.q)
    assert_array_equal(one.ankles, same.ankles)
    assert np.abs(MODEL.difference(one.q, other.q)).max() > 0.01
    # the same person, another day
    person = Person.average("female")
    days = [make_movement(name, person, np.random.default_rng(seed)).course(times).q for seed in (1, 2)]
    assert np.abs(MODEL.difference(*days)).max() > 0.01


def test_any_instants_may_be_asked_for_in_any_order() -> None:
    _, movement = performance("random", 3)
    times = np.random.default_rng(0).uniform(0.0, movement.duration, 20)
    together = movement.course(times)
    alone = np.concatenate([movement.course(times[k : k + 1]).q for k in range(20)])
    assert_allclose(together.q, alone, atol=1e-12)


def beats(signal: FloatArray) -> FloatArray:
    """Sample numbers at which a signal rises through the middle of its range."""
    above = signal > 0.5 * (signal.max() + signal.min())
    return np.flatnonzero(above[1:] & ~above[:-1])


def test_the_standard_wave_is_the_thesis_s() -> None:
    _, course, positions = standard("two_handed_wave")
    moving = (course.times > 4.6) & (course.times < 11.8)
    wrists = positions[moving][:, [Joint.WRIST_LEFT, Joint.WRIST_RIGHT]]
    assert (wrists[..., 2] > positions[moving][:, [Joint.SHOULDER_LEFT, Joint.SHOULDER_RIGHT], 2] + 0.1).all()
    elbow = bent(positions[moving], Joint.SHOULDER_LEFT, Joint.ELBOW_LEFT, Joint.WRIST_LEFT)
    assert elbow.max() - elbow.min() > 50.0
    assert_allclose(np.diff(beats(elbow)).mean(), 160.0, rtol=0.03)  # 1.6 s at 100 Hz
    # in the frontal plane: sideways and up, little to and fro
    spread = np.ptp(wrists[:, 0], axis=0)
    assert spread[1] > 0.2 and spread[0] < 0.15


def test_the_standard_slow_down_is_in_the_sagittal_plane() -> None:
    _, course, positions = standard("slow_down")
    moving = (course.times > 4.8) & (course.times < 13.5)
    spread = np.ptp(positions[moving, Joint.WRIST_RIGHT], axis=0)
    assert spread[2] > 0.35 and spread[1] < 0.2
    assert (positions[moving, Joint.WRIST_RIGHT, 0] > 0.2).all()


def test_in_move_along_the_left_arm_points_and_the_right_hand_goes_round() -> None:
    _, course, positions = standard("move_along")
    moving = (course.times > 5.0) & (course.times < 12.5)
    left, right = (positions[moving, joint] for joint in (Joint.WRIST_LEFT, Joint.WRIST_RIGHT))
    assert (left[:, 1] > 0.5).all() and np.ptp(left, axis=0).max() < 0.12
    centred = (right - right.mean(axis=0))[:, 1:]
    turns = np.unwrap(np.arctan2(centred[:, 1], centred[:, 0]))
    assert abs(turns[-1] - turns[0]) > 3.0 * 2.0 * np.pi
    assert np.ptp(right, axis=0)[1:].min() > 0.15


def test_the_shoulders_of_the_standard_twist_turn_by_90_degrees_to_each_side() -> None:
    _, course, positions = standard("torso_twist")
    yaw = shoulder_yaw(positions)
    assert_allclose([yaw.max(), yaw.min()], [90.0, -90.0], atol=8.0)
    assert_allclose(np.diff(beats(yaw)).mean(), 360.0, rtol=0.03)
    # the spine alone could not: its joints stay within 50 degrees, the pelvis does the rest
    lumbar, thoracic = coordinate(course, "lumbar_axial"), coordinate(course, "thoracic_axial")
    assert 30.0 < (lumbar + thoracic).max() < 50.0
    assert ((lumbar[np.abs(lumbar) > 3.0] * thoracic[np.abs(lumbar) > 3.0]) > 0.0).all()


def test_a_clavicle_rises_by_a_third_of_the_arms_elevation() -> None:
    _, course, positions = standard("arm_raises")
    # against the chest: the trunk is upright
    arm = positions[:, Joint.ELBOW_LEFT] - positions[:, Joint.SHOULDER_LEFT]
    elevation, clavicle = between(arm, np.array([0.0, 0.0, -1.0])), coordinate(course, "clavicle_elevation_left")
    raised, low = elevation > 55.0, elevation < 15.0
    assert raised.sum() > 200 and low.sum() > 200
    slope = np.polyfit(elevation[raised], clavicle[raised], 1)[0]
    assert 0.28 < slope < 0.38
    assert np.ptp(clavicle[low]) < 5.0


def test_arms_are_raised_forward_then_half_sideways_then_sideways() -> None:
    _, course, positions = standard("arm_raises")
    arm = positions[:, Joint.ELBOW_LEFT] - positions[:, Joint.SHOULDER_LEFT]
    above = (arm[:, 2] > 0.0) & (course.times > 4.5)  # after the T-pose
    level = np.flatnonzero(above[1:] != above[:-1])
    plane = np.degrees(np.arctan2(arm[level, 0], arm[level, 1]))
    for expected, seen in zip((86.0, 86.0, 38.0, 38.0, 4.0, 4.0), plane[:6], strict=True):
        assert abs(seen - expected) < 12.0
    assert between(arm, np.array([0.0, 0.0, -1.0])).max() > 140.0


def test_knees_bend_in_a_squat_and_heels_rise_in_a_calf_raise() -> None:
    _, _, positions = standard("squat")
    knee = bent(positions, Joint.HIP_LEFT, Joint.KNEE_LEFT, Joint.ANKLE_LEFT)
    assert knee[:250].max() < 15.0 and 95.0 < knee.max() < 140.0
    base = positions[:, Joint.SPINE_BASE, 2]
    assert np.ptp(base) > 0.3
    person, course, positions = standard("calf_raise")
    assert 0.06 < np.ptp(course.ankles[:, 0, 2]) < 0.13
    assert bent(positions, Joint.HIP_LEFT, Joint.KNEE_LEFT, Joint.ANKLE_LEFT).max() < 15.0
    assert person.ankle_height == course.ankles[..., 2].min()


def test_a_comb_goes_over_the_hair_from_the_forehead_to_behind() -> None:
    _, course, positions = standard("hair_combing")
    moving = (course.times > 4.6) & (course.times < 13.0)
    hand = (positions[:, Joint.HAND_RIGHT] - positions[:, Joint.HEAD])[moving]
    distance = np.linalg.norm(hand, axis=1)
    assert distance.min() > 0.09 and distance.max() < 0.30
    assert hand[:, 0].max() > 0.08 and hand[:, 0].min() < -0.08


def test_forearms_roll_about_each_other() -> None:
    _, course, positions = standard("forearm_rolling")
    moving = (course.times > 5.0) & (course.times < 12.0)
    apart = (positions[:, Joint.WRIST_LEFT] - positions[:, Joint.WRIST_RIGHT])[moving]
    turns = np.unwrap(np.arctan2(apart[:, 2], apart[:, 0]))
    assert abs(turns[-1] - turns[0]) > 5.0 * 2.0 * np.pi
    assert (positions[moving][:, [Joint.WRIST_LEFT, Joint.WRIST_RIGHT], 0] > 0.1).all()


def test_fists_strike_in_turn_and_shoulders_lift() -> None:
    _, _, positions = standard("punching")
    reach = positions[:, [Joint.WRIST_LEFT, Joint.WRIST_RIGHT], 0]
    late = reach[500:1400]
    assert np.corrcoef(late.T)[0, 1] < 0.0 and late.max() > 0.45
    _, _, positions = standard("shoulder_lifts")
    lift = positions[500:1400, Joint.SHOULDER_LEFT, 2] - positions[500:1400, Joint.SPINE_SHOULDER, 2]
    assert 0.05 < np.ptp(lift) < 0.12


def test_arms_swing_against_the_legs_when_walking() -> None:
    person, course, positions = standard("walking_and_turning")
    legs = positions[:, Joint.ANKLE_LEFT] - positions[:, Joint.ANKLE_RIGHT]
    arms = positions[:, Joint.WRIST_LEFT] - positions[:, Joint.WRIST_RIGHT]
    pelvis = MODEL.forward(course.q, person.lengths).rotations[:, 0, :, 0]
    ahead_legs, ahead_arms = ((part * pelvis).sum(axis=1) for part in (legs, arms))
    assert np.corrcoef(ahead_legs, ahead_arms)[0, 1] < -0.5
    assert np.ptp(positions[:, Joint.SPINE_BASE, 1]) > 1.5
    assert np.ptp(shoulder_yaw(positions)) > 170.0
    assert np.ptp(positions[:, Joint.SPINE_BASE, 2]) < 0.10


def test_standing_people_sway_by_millimetres() -> None:
    _, _, positions = standard("standing_still")
    sway = np.ptp(positions[:, Joint.SPINE_BASE, :2], axis=0)
    assert (sway > 0.002).all() and (sway < 0.04).all()


@pytest.mark.parametrize("name", some(list(MOTIONS), 4))
def test_seconds_are_kept_by_repeating(name: str) -> None:
    person = Person.average("female")
    short, long = (make_movement(name, person, np.random.default_rng(0), seconds) for seconds in (32.0, 61.5))
    assert (short.duration, long.duration) == (32.0, 61.5)
    ways = []
    for movement in (short, long):
        positions = joints(person, watched(movement))
        ways.append(np.linalg.norm(np.diff(positions, axis=0), axis=-1).sum())
        if name not in FREE:
            is_a_t_pose(positions[-30:])
    assert ways[1] > 1.3 * ways[0]


def test_impossible_motions_are_refused() -> None:
    person = Person.average("male")
    with pytest.raises(RepertoireError, match="unknown motion 'juggling', expected one of two_handed_wave, slow_down"):
        make_movement("juggling", person)
    with pytest.raises(RepertoireError, match=r"torso_twist: 5\.0 s, it takes 11\.0 s at least"):
        make_movement("torso_twist", person, seconds=5.0)
    with pytest.raises(RepertoireError, match=r"walking_and_turning: 1\.5 s, too short"):
        make_movement("walking_and_turning", person, seconds=1.5)
    for seconds in (-1.0, 0.0, np.nan, np.inf):
        with pytest.raises(RepertoireError, match=f"random: {seconds} s"):
            make_movement("random", person, seconds=seconds)
