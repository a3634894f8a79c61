"""The joints of the Azure Kinect as those of the Kinect v2."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.skeleton import BONES, MIRROR, FloatArray, Joint, Skeleton, TrackingState
from body_tracking.kinect.azure import COUNTERPARTS, AzureJoint, bodies_of
from draws import draws


def upright(height: float = 1.75) -> FloatArray:
    """(32, 3) a person in a T-pose who faces the camera at two metres, x right, y down, z forward: metres.

    Heights over the floor as parts of the body's height, lengths across likewise; the SDK's left is the person's.
    """
    heights = {
        **{"PELVIS": 0.54, "SPINE_NAVEL": 0.64, "SPINE_CHEST": 0.72, "NECK": 0.85, "HEAD": 0.92},
        **{"NOSE": 0.93, "EYE": 0.94, "EAR": 0.93, "HIP": 0.53, "KNEE": 0.285, "ANKLE": 0.04, "FOOT": 0.02},
    }
    across = {"CLAVICLE": 0.02, "SHOULDER": 0.115, "ELBOW": 0.29, "WRIST": 0.43, "HAND": 0.48, "HANDTIP": 0.53}
    across |= {"THUMB": 0.47, "HIP": 0.05, "KNEE": 0.05, "ANKLE": 0.05, "FOOT": 0.05, "EYE": 0.02, "EAR": 0.04}
    points = np.zeros((32, 3))
    for joint in AzureJoint:
        name, _, side = joint.name.rpartition("_")
        name, side = (name, side) if side in ("LEFT", "RIGHT") else (joint.name, "")
        x = across.get(name, 0.0) * {"LEFT": 1.0, "RIGHT": -1.0, "": 0.0}[side]
        points[joint] = height * x, 1.0 - height * heights.get(name, 0.83), 2.0
    return points


def ids(body: int) -> list[int]:
    return [100 * body + joint for joint in AzureJoint]


def one(points: FloatArray, body: int = 1) -> Skeleton:
    (skeleton,) = bodies_of(ids(body), points, 5, "f")
    return skeleton


def test_joints_of_one_name_are_the_same_and_two_lie_between() -> None:
    points = upright()
    skeleton = one(points)
    assert (skeleton.states == TrackingState.TRACKED).all()
    for joint in Joint:
        first, second = COUNTERPARTS[joint]
        np.testing.assert_allclose(skeleton.positions[joint], (points[first] + points[second]) / 2)
    between = {joint for joint, (first, second) in COUNTERPARTS.items() if first != second}
    assert between == {Joint.SPINE_MID, Joint.SPINE_SHOULDER}
    renamed = {joint.name for joint in Joint if joint.name not in AzureJoint.__members__} - {j.name for j in between}
    assert renamed == {"SPINE_BASE", "HAND_TIP_LEFT", "HAND_TIP_RIGHT"}
    used = {each for pair in COUNTERPARTS.values() for each in pair}
    face = ["NOSE", "EYE_LEFT", "EAR_LEFT", "EYE_RIGHT", "EAR_RIGHT"]
    assert [joint.name for joint in AzureJoint if joint not in used] == face


def test_left_is_left_and_the_order_along_the_body_is_that_of_the_kinect_v2() -> None:
    skeleton = one(upright())
    # who faces the camera has the left hand at its right
    left = skeleton.positions[Joint.HAND_LEFT, 0]
    assert left > 0 > skeleton.positions[Joint.HAND_RIGHT, 0]
    mirrored = skeleton.positions[MIRROR] * [-1.0, 1.0, 1.0]
    np.testing.assert_allclose(mirrored, skeleton.positions, atol=1e-12)
    spine = [Joint.SPINE_BASE, Joint.SPINE_MID, Joint.SPINE_SHOULDER, Joint.NECK, Joint.HEAD]
    assert (np.diff(skeleton.positions[spine, 1]) < 0).all()
    lengths = [np.linalg.norm(skeleton.positions[b] - skeleton.positions[a]) for a, b in BONES]
    assert 0.01 < min(lengths) < max(lengths) < 0.5


@settings(max_examples=draws(12, 50), deadline=None)
@given(st.permutations(range(64)), st.integers(0, 2**24), st.integers(1, 100))
def test_bodies_are_separated_in_any_order_of_markers(order: list[int], body: int, more: int) -> None:
    first, second = upright(), upright(1.6) + [0.8, 0.0, 0.5]
    all_ids = np.array(ids(body) + ids(body + more))[order]
    got = bodies_of(all_ids.tolist(), np.concatenate([first, second])[order], 5, "f")
    assert [skeleton.body for skeleton in got] == [body % 65536, (body + more) % 65536]
    np.testing.assert_array_equal(got[0].positions, one(first).positions)
    np.testing.assert_array_equal(got[1].positions, one(second).positions)


def test_missing_and_nonfinite_joints_are_not_tracked() -> None:
    points = upright()
    points[AzureJoint.HEAD] = np.nan
    points[AzureJoint.SPINE_CHEST, 1] = 1e9
    kept = [k for k in range(32) if k != AzureJoint.FOOT_LEFT]
    (skeleton,) = bodies_of([100 + k for k in kept], points[kept], 5, "f", TrackingState.INFERRED)
    lost = [Joint.SPINE_MID, Joint.HEAD, Joint.FOOT_LEFT]
    assert np.flatnonzero(skeleton.states == TrackingState.NOT_TRACKED).tolist() == sorted(lost)
    assert np.isnan(skeleton.positions[lost]).all()
    assert (np.delete(skeleton.states, lost) == TrackingState.INFERRED).all()
    assert bodies_of([], np.empty((0, 3)), 5, "f") == ()
    assert bodies_of(ids(1), np.full((32, 3), np.nan), 5, "f") == ()


@pytest.mark.parametrize(
    ("given_ids", "reported"),
    [
        ([100, 132], "marker 132, expected"),
        ([-1, 100], "marker -1, expected"),
        ([100, 101, 100], "a marker twice"),
        ([100 * k for k in range(65)], "65 bodies"),
    ],
)
def test_markers_that_are_no_bodies_are_refused(given_ids: list[int], reported: str) -> None:
    with pytest.raises(BodyTrackingError, match=reported):
        bodies_of(given_ids, np.zeros((len(given_ids), 3)), 5, "f")
