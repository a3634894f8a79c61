"""Correction of a Kinect v2's spine: on real people, and under rotation and mirroring of the body."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from kinect_vs_vicon import kinect_skeletons
from scipy.spatial.transform import Rotation

from body_tracking.calibration.joint_centres import body_axes
from body_tracking.calibration.kinect_spine import corrected_kinect, corrected_spine
from body_tracking.core.skeleton import MIRROR, FloatArray, Joint, Skeleton, TrackingState
from body_tracking.filters import ModelFilter, make_filter
from body_tracking.kinematics.conventions import angles_of
from body_tracking.kinematics.positional import positional_angles
from draws import some
from walkers import performed, tracked

BODY = performed("reaching", np.array([6.0]))[0]
MOVED = [Joint.SPINE_BASE, Joint.SPINE_MID, Joint.SPINE_SHOULDER, Joint.NECK, Joint.HEAD]


def base_above_hips(each: Skeleton) -> FloatArray:
    """(2,) metres forward and up in the axes of the pelvis, from the middle of the hips to SpineBase."""
    p = each.positions
    up = (p[Joint.SPINE_MID] - p[Joint.SPINE_BASE]) / np.linalg.norm(p[Joint.SPINE_MID] - p[Joint.SPINE_BASE])
    forward = np.cross(p[Joint.HIP_LEFT] - p[Joint.HIP_RIGHT], up)
    forward /= np.linalg.norm(forward)
    away = p[Joint.SPINE_BASE] - (p[Joint.HIP_LEFT] + p[Joint.HIP_RIGHT]) / 2
    return np.array([away @ forward, away @ up])


@pytest.mark.parametrize("subject", some(["s01", "s02", "s03", "s04", "s05"]))
def test_real_people_have_their_spine_above_the_hips_and_stand_upright(shared_data: Path, subject: str) -> None:
    """Shoulder exercises, standing: without the correction a trunk bent by 17 to 21 degrees against the pelvis."""
    seen = kinect_skeletons(shared_data / "kinect_vs_vicon" / f"m07_{subject}_e01_kinect.csv.gz")
    places = np.array([base_above_hips(each) for each in seen])
    assert np.median(places, axis=0) == pytest.approx([-0.036, 0.001], abs=0.006)
    filter_ = make_filter("ekf")
    assert isinstance(filter_, ModelFilter)
    flexion, angles = [], None
    for each in seen:
        filter_.update(corrected_kinect(each))
        if filter_.estimate is not None:
            angles = angles_of(filter_.estimate, filter_.model, "model", angles)
            flexion.append(np.degrees(angles.position[angles.names.index("trunk_flexion")]))
    assert abs(np.median(flexion[len(flexion) // 2 :])) < 6.0


def test_only_the_spine_moves_and_the_thorax_keeps_its_direction() -> None:
    found = corrected_spine(tracked(BODY)).positions
    still = [joint for joint in Joint if joint not in MOVED]
    assert np.array_equal(found[still], BODY[still])
    assert np.allclose(body_axes(found), body_axes(BODY))
    away = np.linalg.norm(found - BODY, axis=1)[MOVED]
    assert away == pytest.approx([np.hypot(0.036, 0.029), 0.027, 0.027, 0.027, 0.027])
    before, after = positional_angles(tracked(BODY)), positional_angles(tracked(found))
    arms = [name.startswith(("shoulder", "humeral", "elbow")) for name in before.names]
    assert np.allclose(after.position[arms], before.position[arms])


def test_the_correction_turns_with_the_body_and_left_is_the_mirror_of_right() -> None:
    found = corrected_spine(tracked(BODY)).positions
    turn = Rotation.from_euler("xyz", [0.3, -0.8, 2.0])
    assert np.allclose(corrected_spine(tracked(turn.apply(BODY) + 1.0)).positions, turn.apply(found) + 1.0)
    mirrored = (BODY * [1.0, -1.0, 1.0])[MIRROR]
    assert np.allclose(corrected_spine(tracked(mirrored)).positions, (found * [1.0, -1.0, 1.0])[MIRROR])


@pytest.mark.parametrize("missing", [Joint.SPINE_MID, Joint.SHOULDER_LEFT, Joint.HIP_RIGHT, Joint.HEAD])
def test_a_missing_joint_leaves_the_others_where_they_were(missing: Joint) -> None:
    """But for the angle between pelvis and thorax, of which one stands for the other, or both count as upright."""
    frame = tracked(BODY.copy())
    frame.positions[missing] = np.nan
    frame.states[missing] = TrackingState.NOT_TRACKED
    found, whole = corrected_spine(frame).positions, corrected_spine(tracked(BODY)).positions
    assert np.array_equal(np.isfinite(found), np.isfinite(frame.positions))
    hips, shoulders = (BODY[left] - BODY[right] for left, right in ((12, 16), (4, 8)))
    twist = np.arccos(hips @ shoulders / np.linalg.norm(hips) / np.linalg.norm(shoulders))
    apart = np.nanmax(np.linalg.norm(found - whole, axis=1))
    assert apart < 0.047 * (twist + 0.1)  # and what the spine is bent
    assert apart < 0.015  # not the whole correction, which a filter would take for a velocity
