"""Laws of the frames that move with a body's segments."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from body_tracking.core.skeleton import BONES, N_JOINTS, FloatArray, Joint
from body_tracking.evaluation.reading import read_skeletons
from body_tracking.evaluation.segments import segment_frames
from body_tracking.kinematics.upper_body import UpperBody
from body_tracking.pipeline import graph
from body_tracking.recording.rosbag2 import BagReader
from draws import draws

TWIST = Path(__file__).resolve().parents[2] / "bags" / "tpose_torso_twist"
TRUNK = ("SPINE", "NECK", "HEAD", "SHOULDER", "HIP")


@cache
def twist() -> tuple[FloatArray, FloatArray]:
    """(n,) s and (n, 25, 3) of a person who twists the trunk, arms spread."""
    with BagReader(TWIST) as bag:
        skeletons = read_skeletons(bag, graph.TRUE_SKELETON)
    return np.array([each.stamp for each in skeletons]), np.stack([each.positions for each in skeletons])


@settings(deadline=None, max_examples=draws(12, 30))
@given(st.tuples(st.floats(-3.0, 3.0), st.floats(-3.0, 3.0), st.floats(-3.0, 3.0)))
def test_frames_are_rotations_that_turn_with_the_body(turn: tuple[float, float, float]) -> None:
    positions = twist()[1][::20]
    frames = segment_frames(positions)
    assert frames.shape == (*positions.shape, 3)
    assert_allclose(np.swapaxes(frames, -1, -2) @ frames, np.broadcast_to(np.eye(3), frames.shape), atol=1e-9)
    assert_allclose(np.linalg.det(frames), 1.0)
    rotation = Rotation.from_rotvec(turn).as_matrix()
    assert_allclose(segment_frames(positions @ rotation.T + [1.0, 2.0, 3.0]), rotation @ frames, atol=1e-8)


def test_a_limbs_bone_keeps_its_direction_in_its_frame() -> None:
    _, positions = twist()
    frames = segment_frames(positions)
    for parent, child in BONES:
        if child.name.startswith(TRUNK):
            continue
        bone = positions[:, child] - positions[:, parent]
        own = np.einsum("nji,nj->ni", frames[:, child], bone / np.linalg.norm(bone, axis=1, keepdims=True))
        assert_allclose(own, np.broadcast_to(own[0], own.shape), atol=1e-9, err_msg=child.name)


def test_frames_move_no_faster_than_people_do() -> None:
    times, positions = twist()
    frames = segment_frames(positions)
    step = np.swapaxes(frames[:-1], -1, -2) @ frames[1:]
    angle = np.arccos(np.clip(0.5 * (np.trace(step, axis1=-2, axis2=-1) - 1.0), -1.0, 1.0))
    assert (angle / np.diff(times)[:, None]).max() < 15.0  # rad/s


@pytest.mark.parametrize("side", ["left", "right"])
def test_points_on_the_forearm_are_fixed_in_its_frame_for_any_elbow_flexion(side: str) -> None:
    model = UpperBody()
    bent = np.zeros((20, model.nv))
    bent[:, model.coordinate_names.index(f"elbow_flexion_{side}")] = np.linspace(0.0, 2.4, len(bent))
    postures = [model.forward(model.integrate(model.neutral(), each), model.default_lengths()) for each in bent]
    positions = np.full((len(bent), N_JOINTS, 3), np.nan)
    positions[:, model.joints] = [posture.positions for posture in postures]
    forearm = np.stack([posture.rotations[model.segment_names.index(f"forearm_{side}")] for posture in postures])
    frames = segment_frames(positions)[:, Joint[f"WRIST_{side.upper()}"]]
    apart = np.swapaxes(frames, -1, -2) @ forearm
    assert_allclose(apart, np.broadcast_to(apart[0], apart.shape), atol=1e-6)


def test_unknown_joints_are_stood_in_for_or_nan() -> None:
    positions = twist()[1][::20]
    whole = segment_frames(positions)
    legless, trunkless = positions.copy(), positions.copy()
    legless[:, [Joint.HIP_LEFT, Joint.HIP_RIGHT, Joint.KNEE_LEFT]] = np.nan
    assert np.isfinite(segment_frames(legless)).all()
    assert_allclose(segment_frames(legless)[:, Joint.ELBOW_LEFT], whole[:, Joint.ELBOW_LEFT])
    trunkless[:, [Joint.SPINE_BASE, Joint.SPINE_MID]] = np.nan
    assert np.isnan(segment_frames(trunkless)).all()
