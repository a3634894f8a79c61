"""The simulated person has rigid limbs, and the angles that were asked for."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from body_tracking.kinematics.positional import positional_angles
from body_tracking.simulation.figure import Figure, Pose
from body_tracking.simulation.motions import MOTIONS, TPOSE_S, Motion
from body_tracking.skeleton import BONES, N_JOINTS, FloatArray, Joint, Skeleton, TrackingState

TRACKED = np.full(N_JOINTS, TrackingState.TRACKED, dtype=np.uint8)


def lengths(positions: FloatArray) -> FloatArray:
    parents, children = np.array(BONES).T
    return np.linalg.norm(positions[:, children] - positions[:, parents], axis=2)


@pytest.mark.parametrize("motion", MOTIONS, ids=lambda motion: motion.name)
def test_limbs_keep_their_length_and_scale_with_the_stature(motion: Motion) -> None:
    pose = motion.pose(np.arange(0.0, motion.duration, 0.05))
    small, tall = (lengths(Figure(stature).positions(pose)) for stature in (1.5, 1.9))
    assert_allclose(small, np.broadcast_to(small[0], small.shape), rtol=1e-12)
    assert_allclose(tall[0], small[0] * 1.9 / 1.5, rtol=1e-12)


def test_the_positional_angles_are_those_of_the_pose() -> None:
    rng = np.random.default_rng(4)
    count = 30
    pose = Pose(
        trunk=np.zeros((count, 3)),
        plane=rng.uniform(-1.0, 1.8, (count, 2)),
        elevation=rng.uniform(0.3, 2.5, (count, 2)),
        rotation=rng.uniform(-1.5, 1.5, (count, 2)),
        elbow=rng.uniform(0.2, 2.4, (count, 2)),
        sway=rng.normal(size=(count, 3)) * 0.01,
    )
    for k, positions in enumerate(Figure().positions(pose)):
        angles = positional_angles(Skeleton(1, "body", positions, TRACKED))
        by_name = dict(zip(angles.names, angles.position, strict=True))
        for column, side in enumerate(("left", "right")):
            assert by_name[f"shoulder_plane_{side}"] == pytest.approx(pose.plane[k, column])
            assert by_name[f"shoulder_elevation_{side}"] == pytest.approx(pose.elevation[k, column])
            assert by_name[f"humeral_rotation_{side}"] == pytest.approx(pose.rotation[k, column])
            assert by_name[f"elbow_flexion_{side}"] == pytest.approx(pose.elbow[k, column])


def test_the_stature_is_that_of_an_adult() -> None:
    time = np.zeros(1)
    positions = Figure(1.75).positions(MOTIONS[0].pose(time))[0]
    assert 1.60 < positions[Joint.HEAD, 2] < 1.75  # the middle of the head
    assert -0.01 < positions[Joint.FOOT_LEFT, 2] < 0.1
    span = positions[Joint.HAND_TIP_LEFT, 1] - positions[Joint.HAND_TIP_RIGHT, 1]
    assert span == pytest.approx(1.75, rel=0.08)


@pytest.mark.parametrize("motion", MOTIONS, ids=lambda motion: motion.name)
def test_motions_start_and_end_in_a_t_pose_and_are_smooth(motion: Motion) -> None:
    step = 1e-3
    time = np.arange(0.0, motion.duration, step)
    positions = Figure().positions(motion.pose(time))
    for name in ("ELBOW_LEFT", "ELBOW_RIGHT", "WRIST_LEFT", "WRIST_RIGHT"):
        side = name.split("_")[1]
        arm = positions[:, Joint[name]] - positions[:, Joint[f"SHOULDER_{side}"]]
        still = np.concatenate([arm[time < TPOSE_S], arm[time > motion.duration - 1.0]])
        assert (np.abs(still[:, 1]) > 0.95 * np.linalg.norm(still, axis=1)).all()
    speed = np.linalg.norm(np.diff(positions, axis=0), axis=2) / step
    acceleration = np.linalg.norm(np.diff(positions, n=2, axis=0), axis=2) / step**2
    assert speed.max() < 4.0 and acceleration.max() < 50.0
    assert speed[time[:-1] < TPOSE_S].max() < 0.1


def test_the_twist_turns_the_chest_by_50_degrees_both_ways() -> None:
    motion = MOTIONS[2]
    positions = Figure().positions(motion.pose(np.arange(0.0, motion.duration, 0.02)))
    turn = [positional_angles(Skeleton(1, "body", frame, TRACKED)).position[2] for frame in positions]
    assert np.degrees(max(turn)) == pytest.approx(50.0, abs=2.0)
    assert np.degrees(min(turn)) == pytest.approx(-50.0, abs=2.0)
