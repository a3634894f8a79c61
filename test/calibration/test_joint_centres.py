"""Laws of the joint offsets estimated from a T-pose, on people with known offsets."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from body_tracking.calibration.joint_centres import (
    LEARNT,
    POSE_STDDEV,
    JointCentres,
    body_axes,
    posed,
    retained,
    t_pose_offsets,
)
from body_tracking.core.measurement import BASE_STDDEV, offset_correlation
from body_tracking.core.skeleton import MIRROR, N_JOINTS, NANOSECONDS, FloatArray, Joint, Skeleton, TrackingState
from body_tracking.evaluation.segments import segment_frames
from body_tracking.kinect.csv_recording import CsvRecording
from body_tracking.kinematics.positional import ANGLE_NAMES, positional_angles
from draws import draws, some
from walkers import performed

T_POSE = performed("reaching", np.array([1.0]))[0]
POSES = performed("reaching", np.arange(4.0, 14.0, 0.25))
"""Arms in many directions, stretched and bent."""
SIDES = ("left", "right")
ANGLES = [ANGLE_NAMES.index(f"{name}_{side}") for name in ("shoulder_elevation", "elbow_flexion") for side in SIDES]
FRAME_NS = NANOSECONDS // 30
EYE = np.broadcast_to(np.eye(3), (len(LEARNT), 3, 3)).copy()


def some_offsets(seed: int = 0) -> FloatArray:
    """(11, 3) metres in the frames of the segments."""
    return np.random.default_rng(seed).normal(size=(len(LEARNT), 3)) * BASE_STDDEV[LEARNT, None]


def seen(positions: FloatArray, local: FloatArray) -> FloatArray:
    """(25, 3) with joints displaced by offsets."""
    result = positions.copy()
    result[LEARNT] += posed(positions, local[:, None])[:, 0]
    return result


def skeleton(positions: FloatArray, stamp_ns: int = 0, *, stated: bool = True) -> Skeleton:
    states = np.where(np.isfinite(positions).all(axis=1), TrackingState.TRACKED, 0).astype(np.uint8)
    covariances = BASE_STDDEV[:, None, None] ** 2 * np.eye(3) if stated else None
    return Skeleton(stamp_ns, "world", positions, states, covariances=covariances)


def angles(positions: FloatArray) -> FloatArray:
    """Degrees: elevation and flexion of both arms."""
    return np.degrees(positional_angles(skeleton(positions)).position[ANGLES])


def corrected(centres: JointCentres, frame: Skeleton) -> FloatArray:
    return centres.corrected(frame.positions, frame.valid, frame.stamp_ns)


def held(centres: JointCentres, positions: FloatArray, *, start: float = 0.0, seconds: float = 2.0) -> int:
    """Show a still pose with a little noise; the stamp after it."""
    rng = np.random.default_rng(1)
    stamps = round(start * NANOSECONDS) + FRAME_NS * np.arange(round(seconds * 30))
    for stamp_ns in stamps.tolist():
        centres.update(skeleton(positions + rng.normal(scale=0.002, size=positions.shape), stamp_ns))
    return int(stamps[-1]) + FRAME_NS


def without(positions: FloatArray, *joints: Joint) -> FloatArray:
    """(25, 3) the positions with some joints unseen."""
    return np.where(np.isin(np.arange(N_JOINTS), joints)[:, None], np.nan, positions)


def test_offsets_turn_as_the_frames_of_the_segments_do() -> None:
    frames = segment_frames(POSES)[:, LEARNT]
    axes = np.stack([posed(each, EYE) for each in POSES])
    of_thorax = LEARNT != Joint.SPINE_BASE  # a pelvis has its own frame there
    assert_allclose(axes.swapaxes(-1, -2)[:, of_thorax], frames[:, of_thorax], atol=1e-9)


@settings(deadline=None, max_examples=draws(12, 30))
@given(st.tuples(st.floats(-3.0, 3.0), st.floats(-3.0, 3.0), st.floats(-3.0, 3.0)), st.integers(0, len(POSES) - 1))
def test_offsets_turn_with_the_body(turn: tuple[float, float, float], pose: int) -> None:
    rotation = Rotation.from_rotvec(turn).as_matrix()
    moved = POSES[pose] @ rotation.T + [1.0, 2.0, 3.0]
    local = some_offsets()[:, None]
    assert_allclose(posed(moved, local), posed(POSES[pose], local) @ rotation.T, atol=1e-9)


def test_an_unseen_bone_turns_no_offset_and_without_a_thorax_offsets_are_unknown() -> None:
    hidden = posed(without(POSES[3], Joint.HAND_LEFT), EYE)
    assert_allclose(hidden[5], posed(POSES[3], EYE)[5])
    assert np.isfinite(hidden).all()
    assert np.isnan(posed(without(POSES[3], Joint.SPINE_SHOULDER), EYE)).all()
    upright = POSES[3].copy()
    upright[Joint.SPINE_MID] = upright[Joint.SPINE_SHOULDER] - [0.0, 0.0, 0.2]
    assert_allclose(posed(without(upright, Joint.SPINE_MID), EYE), posed(upright, EYE))


def drawn(rng: np.random.Generator, correlation: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Drawn from the model of eq. (1): measured points of a T-pose, offsets, and variances of the transient errors.

    Args:
        rng: source of the draw.
        correlation: (25, 25) of the joints' offsets.
    """
    up, left = np.array([0.0, 0.0, 1.0]), np.array([0.0, 1.0, 0.0])
    points = np.full((N_JOINTS, 3), np.nan)
    spine = (Joint.SPINE_SHOULDER, Joint.SPINE_MID, Joint.SPINE_BASE)
    for joint, height in zip(spine, (0.0, -0.22, -0.5), strict=True):
        points[joint] = height * up + rng.normal(scale=0.01) * left
    lengths = 0.3, 0.25, 0.08
    for side, sign in (("LEFT", 1.0), ("RIGHT", -1.0)):
        at = sign * 0.18 * left - 0.02 * up + rng.normal(scale=0.007, size=3) * [0.0, 1.0, 1.0]
        points[Joint[f"SHOULDER_{side}"]] = at
        direction = sign * left
        stddev = ((POSE_STDDEV,) * 2, (np.radians(4.0), POSE_STDDEV), (2.0 * POSE_STDDEV,) * 2)
        for joint, length, deviations, bend in zip(
            ("ELBOW", "WRIST", "HAND"), lengths, stddev, (0.0, np.radians(4.0), 0.0), strict=True
        ):
            off = rng.normal(size=2) * deviations + [bend, 0.0]
            direction = direction + [off[0], 0.0, off[1]]
            at = at + length * direction / np.linalg.norm(direction) + sign * rng.normal(scale=0.007) * left
            points[Joint[f"{joint}_{side}"]] = at
    shared = np.linalg.cholesky(correlation[np.ix_(LEARNT, LEARNT)])
    offsets = shared @ rng.normal(size=(len(LEARNT), 3)) * BASE_STDDEV[LEARNT, None]
    transient = 0.3 * BASE_STDDEV[LEARNT] ** 2
    together = rng.normal(size=(len(LEARNT), 3))
    for arm in (slice(3, 7), slice(7, 11)):
        together[arm] = np.sqrt(0.8) * rng.normal(size=3) + np.sqrt(0.2) * together[arm]
    points[LEARNT] += offsets + np.sqrt(transient)[:, None] * together
    axes = body_axes(points)
    return (points - points[Joint.SPINE_SHOULDER]) @ axes, offsets @ axes, transient


def test_errors_of_offsets_agree_with_their_covariance() -> None:
    rng = np.random.default_rng(3)
    rows = (3 * LEARNT[:, None] + np.arange(3)).reshape(-1)
    errors = []
    for _ in range(draws(150, 400)):
        points, offsets, transient = drawn(rng, offset_correlation())
        found = t_pose_offsets(points, transient)
        local = posed(points, EYE) @ offsets[:, :, None]
        off = (found.local - local[:, :, 0]).reshape(-1)
        errors.append(off @ np.linalg.solve(found.covariance[np.ix_(rows, rows)], off))
    # the mean of chi-square; the measured axes come from displaced joints, which the equations neglect
    assert 0.85 < np.mean(errors) / (3 * len(LEARNT)) < 1.15


def test_the_gate_passes_t_poses_whose_joints_have_independent_offsets() -> None:
    rng = np.random.default_rng(3)
    found = [
        t_pose_offsets(points, transient)
        for points, _, transient in (drawn(rng, np.eye(N_JOINTS)) for _ in range(draws(150, 400)))
    ]
    assert 0.85 < np.mean([each.distance for each in found]) / found[0].dimension < 1.15


def test_after_a_t_pose_the_twist_of_the_trunk_is_known() -> None:
    """Left and right of a girdle are displaced alike; as independent ones they had a twist of 21 degrees."""
    centres = JointCentres({})
    spread = centres.spread(T_POSE, held(centres, T_POSE) + 5 * NANOSECONDS)
    turns = 0.0
    for girdle in ("SHOULDER", "HIP"):
        left, right = Joint[f"{girdle}_LEFT"], Joint[f"{girdle}_RIGHT"]
        row = np.zeros((N_JOINTS, 3))
        row[left, 0], row[right, 0] = 1.0, -1.0
        turns += row.reshape(-1) @ spread @ row.reshape(-1) / ((T_POSE[left] - T_POSE[right]) ** 2).sum()
    assert np.degrees(np.sqrt(turns)) < 10.0


def test_left_and_right_are_treated_alike() -> None:
    positions = seen(T_POSE, some_offsets())
    flip = np.array([1.0, -1.0, 1.0])
    axes = body_axes(positions)
    own = (positions - positions[Joint.SPINE_SHOULDER]) @ axes
    other = own[MIRROR] * flip
    transient = 0.3 * BASE_STDDEV[LEARNT] ** 2
    one, two = t_pose_offsets(own, transient), t_pose_offsets(other, transient)
    shift_one = (one.local[:, None] @ posed(own, EYE))[:, 0]
    shift_two = (two.local[:, None] @ posed(other, EYE))[:, 0]
    exchanged = [0, 1, 2, 7, 8, 9, 10, 3, 4, 5, 6]
    assert_allclose(shift_two, shift_one[exchanged] * flip, atol=1e-9)
    assert one.distance == pytest.approx(two.distance)
    assert np.trace(one.covariance) == pytest.approx(np.trace(two.covariance))


def test_angles_are_better_in_all_poses_after_a_t_pose() -> None:
    before, after = [], []
    for seed in range(draws(8, 20)):
        local = some_offsets(seed)
        counters: dict[str, int] = {}
        centres = JointCentres(counters)
        stamp_ns = held(centres, seen(T_POSE, local)) + 5 * NANOSECONDS
        assert counters == {"t_poses": 1, "t_poses_refused": 0, "t_poses_forgotten": 0}
        for pose in POSES[::3]:
            frame = skeleton(seen(pose, local), stamp_ns)
            before.append(angles(frame.positions) - angles(pose))
            after.append(angles(corrected(centres, frame)) - angles(pose))
    rms = [float(np.sqrt(np.mean(np.square(each)))) for each in (before, after)]
    assert rms[1] < 0.6 * rms[0]


def test_offsets_come_into_force_without_a_jump_and_stay() -> None:
    local = some_offsets()
    centres = JointCentres({})
    positions = seen(T_POSE, local)
    shifts = []
    for number in range(150):
        frame = skeleton(positions, number * FRAME_NS)
        centres.update(frame)
        shifts.append(corrected(centres, frame) - positions)
    shift = np.linalg.norm(shifts, axis=-1)
    assert not shift[:20].any()
    assert np.abs(np.diff(shift, axis=0)).max() < 0.006
    assert shift[60].max() > 0.02
    assert_allclose(shifts[-1], shifts[-20], atol=1e-4)
    # whatever stamps come, and in whatever order
    late = skeleton(positions, 10 * FRAME_NS)
    assert np.linalg.norm(corrected(centres, late) - positions, axis=-1).max() <= shift[-1].max()
    centres.reset()
    assert_allclose(corrected(centres, skeleton(positions, 200 * FRAME_NS)), positions)


def bent_elbows(degrees: float) -> FloatArray:
    """The T-pose with the forearms turned forward."""
    positions = T_POSE.copy()
    axes = body_axes(positions)
    for side, sign in (("LEFT", -1.0), ("RIGHT", 1.0)):
        elbow, wrist, hand = (positions[Joint[f"{name}_{side}"]].copy() for name in ("ELBOW", "WRIST", "HAND"))
        upper = elbow - positions[Joint[f"SHOULDER_{side}"]]
        upper /= np.linalg.norm(upper)
        turn = Rotation.from_rotvec(sign * np.radians(degrees) * axes[:, 2]).as_matrix()
        positions[Joint[f"WRIST_{side}"]] = elbow + turn @ (upper * np.linalg.norm(wrist - elbow))
        positions[Joint[f"HAND_{side}"]] = elbow + turn @ (upper * np.linalg.norm(hand - elbow))
    return positions


def turned_arms(degrees: float) -> FloatArray:
    """The T-pose with both arms lower."""
    positions = T_POSE.copy()
    axes = body_axes(positions)
    for side, sign in (("LEFT", 1.0), ("RIGHT", -1.0)):
        joints = [Joint[f"{name}_{side}"] for name in ("ELBOW", "WRIST", "HAND", "HAND_TIP", "THUMB")]
        shoulder = positions[Joint[f"SHOULDER_{side}"]]
        turn = Rotation.from_rotvec(-sign * np.radians(degrees) * axes[:, 0]).as_matrix()
        positions[joints] = (positions[joints] - shoulder) @ turn.T + shoulder
    return positions


ODD = (
    T_POSE
    + 0.3 * np.isin(np.arange(N_JOINTS), (Joint.ELBOW_LEFT, Joint.ELBOW_RIGHT))[:, None] * body_axes(T_POSE)[:, 2]
)
"""Resembles a T-pose, and is impossible for a person."""


@pytest.mark.parametrize(
    ("pose", "refused"),
    [(turned_arms(degrees), 0) for degrees in (-60.0, -45.0, 45.0, 60.0, 90.0)]
    + [(without(T_POSE, Joint[joint]), 0) for joint in ("SPINE_SHOULDER", "SHOULDER_LEFT", "ELBOW_RIGHT", "WRIST_LEFT")]
    + [(ODD, 1)],
)
def test_other_poses_give_no_offsets(pose: FloatArray, refused: int) -> None:
    """Neither does a T-pose with a needed joint unseen; a refused pose is counted once."""
    counters: dict[str, int] = {}
    centres = JointCentres(counters)
    stamp_ns = held(centres, pose)
    assert counters == {"t_poses": 0, "t_poses_refused": refused, "t_poses_forgotten": 0}
    assert centres.offsets is None
    assert_allclose(corrected(centres, skeleton(pose, stamp_ns)), pose)


def test_moving_or_briefly_seen_people_give_no_offsets() -> None:
    centres = JointCentres({})
    for number in range(90):
        wave = 0.08 * np.sin(number / 5.0) * body_axes(T_POSE)[:, 2]
        moving = T_POSE.copy()
        moving[[Joint.WRIST_LEFT, Joint.ELBOW_LEFT]] += wave
        centres.update(skeleton(moving, number * FRAME_NS))
    assert centres.offsets is None
    held(centres, T_POSE, start=10.0, seconds=0.6)
    held(centres, POSES[5], start=10.6, seconds=1.0)
    held(centres, T_POSE, start=11.6, seconds=0.6)
    assert centres.offsets is None
    # two short poses with a gap between are not one held pose
    held(centres, T_POSE, start=20.0, seconds=0.5)
    held(centres, T_POSE, start=21.0, seconds=0.5)
    assert centres.offsets is None
    for number in range(90):  # nor do skeletons that state no covariances
        centres.update(skeleton(T_POSE, 30 * NANOSECONDS + number * FRAME_NS, stated=False))
    assert centres.offsets is None
    held(centres, T_POSE, start=40.0)
    assert centres.offsets is not None


@pytest.mark.parametrize("more", [(), (Joint.SPINE_MID,)], ids=["", "at a table"])
def test_offsets_need_neither_hands_nor_hips(more: tuple[Joint, ...]) -> None:
    local = some_offsets(2)
    hidden = without(seen(T_POSE, local), Joint.HAND_LEFT, Joint.HAND_RIGHT, Joint.SPINE_BASE, *more)
    centres = JointCentres({})
    stamp_ns = held(centres, hidden)
    assert centres.offsets is not None
    assert np.isfinite(centres.offsets.local).all()
    found = corrected(centres, skeleton(hidden, stamp_ns + 5 * NANOSECONDS))
    for each in (found, hidden):
        each[list(more)] = T_POSE[list(more)]  # angles need it
    assert np.abs(angles(found) - angles(T_POSE)).max() < 0.5 * np.abs(angles(hidden) - angles(T_POSE)).max()


def test_broken_numbers_and_stamps_do_no_harm() -> None:
    centres = JointCentres({})
    for number in range(60):
        broken = T_POSE.copy()
        broken[number % N_JOINTS] = (np.nan, np.inf, 1e30)[number % 3]
        frame = skeleton(broken, (number - 2 * (number % 5)) * FRAME_NS)
        centres.update(frame)
        corrected(centres, frame)
    centres.update(replace(skeleton(T_POSE, 70 * FRAME_NS), covariances=np.full((N_JOINTS, 3, 3), np.nan)))
    held(centres, seen(T_POSE, some_offsets()), start=100.0)
    assert centres.offsets is not None
    assert np.isfinite(centres.offsets.local).all()
    # time runs backwards, as when a bag begins anew
    held(centres, seen(T_POSE, some_offsets()), start=0.0)
    assert np.isfinite(centres.offsets.local).all()


def test_evidence_of_several_sensors_is_combined() -> None:
    local = some_offsets(4)
    both, one = JointCentres({}), JointCentres({})
    for number in range(60):
        frame = skeleton(seen(T_POSE, local), number * FRAME_NS)
        one.update(frame, "kinect1")
        both.update(frame, "kinect1")
        both.update(replace(frame, stamp_ns=frame.stamp_ns + FRAME_NS // 2), "kinect2")
    assert both.offsets is not None
    assert one.offsets is not None
    # two sensors that saw the same leave less uncertainty
    assert (
        np.trace(both.offsets.covariance)
        < np.trace(one.offsets.covariance)
        < np.trace(JointCentres({}).spread(T_POSE, 0))
    )


def test_a_pose_is_counted_once_for_all_sensors() -> None:
    counters: dict[str, int] = {}
    centres = JointCentres(counters)
    aside = seen(T_POSE, some_offsets())
    aside[[Joint.ELBOW_LEFT, Joint.WRIST_LEFT]] -= 0.3 * body_axes(T_POSE)[:, 2]  # one sensor does not see it
    for start in (0, 20):
        for number in range(150):
            stamp_ns = start * NANOSECONDS + number * FRAME_NS
            for sensor, positions in (("kinect1", T_POSE), ("kinect2", T_POSE), ("kinect3", aside)):
                centres.update(skeleton(positions, stamp_ns), sensor)
        assert counters == {"t_poses": 1 + (start > 0), "t_poses_refused": 0, "t_poses_forgotten": 0}


def test_a_lost_frame_hardly_changes_when_a_pose_is_learnt_from() -> None:
    def learnt_at(lost: int) -> int:
        centres = JointCentres({})
        numbers = (number for number in range(120) if number != lost)
        return next(n for n in numbers if centres.update(skeleton(T_POSE, 5 * NANOSECONDS + n * FRAME_NS)))

    whole = learnt_at(-1)
    assert all(abs(learnt_at(lost) - whole) <= 1 for lost in range(1, whole + 1))


def test_a_short_second_pose_is_seen_too_and_a_slow_camera_does() -> None:
    counters: dict[str, int] = {}
    centres = JointCentres(counters)
    for start, pose, seconds in ((0.0, T_POSE, 1.0), (1.0, POSES[5], 9.0), (10.0, T_POSE, 1.0)):
        for number in range(round(8 * seconds)):
            centres.update(skeleton(pose, round((start + number / 8.0) * NANOSECONDS)))
    assert counters["t_poses"] == 2


def test_offsets_fade_with_the_angle_of_a_bone_from_the_t_pose() -> None:
    shares = np.array([retained(turned_arms(degrees)) for degrees in (0.0, 20.0, 45.0, 80.0)])
    assert (shares[:, :4] == 1.0).all()  # trunk and shoulders
    assert (shares[0] > 0.99).all()
    assert (np.diff(shares[:, 4:7], axis=0) < -0.01).all()
    assert (np.diff(shares[:, 8:], axis=0) < -0.01).all()
    assert shares.min() > 0.78
    rotation = Rotation.from_rotvec([0.3, 1.0, -0.5]).as_matrix()
    assert_allclose(retained(turned_arms(45.0) @ rotation.T), shares[2])
    hidden = without(turned_arms(45.0), Joint.WRIST_LEFT)
    assert retained(hidden)[5] == retained(hidden)[4] == pytest.approx(shares[2, 4], rel=1e-3)


def test_no_offset_is_kept_from_a_bent_elbow_on() -> None:
    bends = (0.0, 15.0, 45.0, 67.0, 90.0, 130.0)
    shares = np.array([retained(bent_elbows(degrees)) for degrees in bends])
    assert (shares[:, :4] == 1.0).all()
    assert (shares[:, 7] == 1.0).all()
    arms = shares[:, [4, 5, 6, 8, 9, 10]]
    assert (arms[1] > 0.97 * arms[0]).all()
    assert (arms[1] < arms[0]).all()
    assert (np.diff(arms[1:5], axis=0) < -0.05).all()
    assert_allclose(arms[3, [0, 3]], 1.0 - (1.0 - np.cos(np.radians(67.0))) ** 2, rtol=0.03)  # upper arms as before
    assert (arms[4] < 0.01).all()
    assert (arms[5] == 0.0).all()


def test_a_stretched_arm_that_is_seen_bent_is_put_right_as_a_stretched_one() -> None:
    local = np.zeros((len(LEARNT), 3))
    for side in SIDES:
        local[LEARNT.tolist().index(Joint[f"ELBOW_{side.upper()}"])] = -0.04, 0.0, 0.0
    centres = JointCentres({})
    frame = skeleton(seen(T_POSE, local), held(centres, seen(T_POSE, local)) + 5 * NANOSECONDS)
    assert (angles(frame.positions)[2:] > 15.0).all()
    assert (angles(corrected(centres, frame))[2:] < 8.0).all()


def test_the_spread_of_offsets_shrinks_and_turns_with_the_body() -> None:
    centres = JointCentres({})
    before = centres.spread(T_POSE, 0)
    assert_allclose(np.diagonal(before), np.repeat(BASE_STDDEV**2, 3))
    stamp_ns = held(centres, T_POSE) + 5 * NANOSECONDS
    rotation = Rotation.from_rotvec([0.2, -0.4, 1.1]).as_matrix()
    all_joints = np.kron(np.eye(N_JOINTS), rotation)
    for pose in POSES[::7]:
        after = centres.spread(pose, stamp_ns)
        assert_allclose(after, after.T, atol=1e-12)
        assert np.linalg.eigvalsh(after)[0] > -1e-9
        assert np.trace(after) < np.trace(before)
        assert_allclose(centres.spread(pose @ rotation.T, stamp_ns), all_joints @ after @ all_joints.T, atol=1e-9)


def test_real_movements_without_a_t_pose_are_not_taken_for_one(shared_data: Path) -> None:
    """Three people who stand, step, walk, reach and turn, by two real sensors each: thirteen minutes in all."""
    frames = 0
    for path in some(sorted((shared_data / "kinect_pairs").glob("[op]*.csv.gz")), 2):
        counters: dict[str, int] = {}
        centres = JointCentres(counters)
        for frame in CsvRecording(path):
            for each in frame.skeletons:
                stated = BASE_STDDEV[:, None, None] ** 2 * np.eye(3)
                centres.update(replace(each, covariances=stated), frame.sensor)
                frames += 1
        assert counters == {"t_poses": 0, "t_poses_refused": 0, "t_poses_forgotten": 0}, path.name
    assert frames > 3000
