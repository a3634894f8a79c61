"""Filters correct sensors' offsets of the joint centres after a T-pose."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from body_tracking.calibration.joint_centres import LEARNT, posed
from body_tracking.core.measurement import BASE_STDDEV
from body_tracking.core.skeleton import FloatArray, Joint, Skeleton
from body_tracking.filters import SkeletonFilter, make_filter
from body_tracking.kinematics import positional
from body_tracking.kinematics.positional import ANGLE_NAMES, angles_over_time
from draws import draws, some
from walkers import TRACKED, frame, performed

FILTERS = ("lkf_constant_velocity", "ekf")
ELBOWS, ARMS = (
    [ANGLE_NAMES.index(f"{angle}_{side}") for side in ("left", "right")]
    for angle in ("elbow_flexion", "shoulder_elevation")
)
RATE = 30.0
SECONDS = draws(7, 16)
HOLDING, MOVING = range(70, 88), range(150, round(SECONDS * RATE))
"""Frames in which the T-pose is held after it was learnt from, and in which the arms reach in many directions."""
GAP = 1.5
"""Seconds: longer than a linear filter goes on for, shorter than the other one."""


@cache
def reaching() -> FloatArray:
    """A T-pose of three seconds, then arms in many directions."""
    return performed("reaching")[: MOVING.stop]


@cache
def skeletons() -> tuple[Skeleton, ...]:
    """Skeletons of :func:`reaching` by a camera that sees elbows too low and wrists too high."""
    local = np.zeros((len(LEARNT), 3))
    for place, joint in enumerate(LEARNT):
        if joint in (Joint.ELBOW_LEFT, Joint.ELBOW_RIGHT):
            local[place] = [-0.02, 0.0, -0.03]
        elif joint in (Joint.WRIST_LEFT, Joint.WRIST_RIGHT):
            local[place] = [0.02, 0.0, 0.03]
    t_pose = reaching()[20]
    # offsets in the T-pose, converted to the frames of the segments
    axes = posed(t_pose, np.broadcast_to(np.eye(3), (len(LEARNT), 3, 3)).copy())
    local = np.einsum("jab,jb->ja", axes, local)
    rng = np.random.default_rng(0)
    covariances = BASE_STDDEV[:, None, None] ** 2 * np.eye(3)
    result = []
    for number, true in enumerate(reaching()):
        positions = true + rng.normal(scale=0.001, size=true.shape)
        positions[LEARNT] += posed(true, local[:, None])[:, 0]
        each = frame(number / RATE + 1.0, positions)
        result.append(Skeleton(each.stamp_ns, "world", positions, TRACKED, covariances=covariances))
    return tuple(result)


def run(
    tested: SkeletonFilter, frames: range = MOVING, left_out: range = range(0), angles: list[int] = ELBOWS
) -> tuple[FloatArray, FloatArray]:
    """Errors of angles in degrees in some frames, and their stated deviations."""
    found, right = [], []
    for number, (seen, true) in enumerate(zip(skeletons()[: frames.stop], reaching(), strict=False)):
        out = None if number in left_out else tested.update(seen)
        if out is None or number not in frames:
            continue
        found.append(out)
        right.append(true)
    covariances = np.stack([each.covariances for each in found])
    ours, stddev = angles_over_time(np.stack([each.positions for each in found]), covariances)
    errors = ours - angles_over_time(np.stack(right))[0]
    return np.degrees(errors[:, angles]), np.degrees(stddev[:, angles])


@cache
def taught(name: str) -> tuple[SkeletonFilter, FloatArray, FloatArray]:
    """A filter after all frames, the errors of the elbows and their stated deviations, degrees."""
    tested = make_filter(name)
    return tested, *run(tested)


@cache
def untaught(name: str) -> FloatArray:
    """Errors of the elbows without the correction by the T-pose, degrees."""
    tested = make_filter(name, t_pose=False)
    errors, _ = run(tested)
    assert tested.counters["t_poses"] == 0
    return errors


def rms(errors: FloatArray) -> float:
    return float(np.sqrt(np.mean(errors**2)))


@pytest.mark.parametrize("name", FILTERS)
def test_elbows_are_bent_as_they_are_after_a_t_pose(name: str) -> None:
    with_it, errors, stddev = taught(name)
    assert with_it.counters["t_poses"] == 1
    assert rms(untaught(name)) > 12.0
    assert rms(errors) < 0.4 * rms(untaught(name))
    assert (np.abs(errors) < 1.96 * stddev).mean() > 0.95


@pytest.mark.parametrize("name", FILTERS)
def test_they_are_not_too_sure_of_where_arms_point(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A person's own deviation from a T-pose is as large as a camera's errors: linear filters gain no certainty.

    The bend of the spine, of which the pose tells nothing, is left out of the deviations.
    """
    monkeypatch.setattr(positional, "_bend_variance", lambda _positions: 0.0)
    # posture makes the extended filter surer of arms without the pose, too
    alone = {"posture": False} if name == "ekf" else {}
    errors, stddev = run(make_filter(name, **alone), HOLDING, angles=ARMS)
    _, unsure = run(make_filter(name, t_pose=False, **alone), HOLDING, angles=ARMS)
    # the offsets of neighbouring joints are correlated before and after the pose, so that it tells less: 0.86
    assert np.median(stddev) < (0.9 if name == "ekf" else 1.02) * np.median(unsure)
    assert (np.abs(errors) < 1.96 * stddev).all()


@pytest.mark.parametrize("name", some(FILTERS))
def test_who_is_not_seen_for_a_moment_need_not_hold_the_pose_again(name: str) -> None:
    errors, _ = run(make_filter(name), left_out=range(100, 100 + round(GAP * RATE)))
    assert rms(errors) < 0.4 * rms(untaught(name))


def test_lengths_are_those_between_the_joints_as_they_are_known_then() -> None:
    ekf, _, _ = taught("ekf")
    lengths = ekf.estimate.lengths  # type: ignore[attr-defined]
    true = reaching()[0]
    for name, start, end in (("upper_arm", "SHOULDER", "ELBOW"), ("forearm", "ELBOW", "WRIST")):
        for side in ("left", "right"):
            known = lengths[ekf.model.length_names.index(f"{name}_{side}")]  # type: ignore[attr-defined]
            real = np.linalg.norm(true[Joint[f"{end}_{side.upper()}"]] - true[Joint[f"{start}_{side.upper()}"]])
            assert known == pytest.approx(real, abs=0.015)
