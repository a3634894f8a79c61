"""Joints from landmarks and a depth image: their positions, and the states of hidden ones."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from body_tracking.camera.lifting import Lifted, is_flat, lift, trunk_depth
from body_tracking.camera.pose_model import Landmark, Landmarks, Region
from body_tracking.core.camera import Camera
from body_tracking.core.skeleton import FloatArray, Joint, SingleArray, TrackingState

CAMERA = Camera("camera1", 640, 480, np.array([[465.0, 0.0, 319.5], [0.0, 465.0, 239.5], [0.0, 0.0, 1.0]]), np.zeros(5))
# metres in the optical frame, of somebody who faces the camera with arms hanging; left is on the right of the image
PLACES: dict[str, tuple[float, float, float]] = {
    "NOSE": (0.0, -0.62, -0.10),
    "EAR": (0.08, -0.64, 0.0),
    "SHOULDER": (0.19, -0.42, 0.0),
    "ELBOW": (0.24, -0.12, 0.02),
    "WRIST": (0.26, 0.12, 0.0),
    "HIP": (0.11, 0.08, 0.0),
    "KNEE": (0.12, 0.48, 0.0),
    "ANKLE": (0.12, 0.88, 0.04),
    "TOES": (0.14, 0.94, -0.10),
    "INDEX_FINGER": (0.26, 0.20, 0.0),
    "LITTLE_FINGER": (0.27, 0.20, 0.0),
}
DISTANCE = 2.6


def person() -> tuple[Landmarks, SingleArray]:
    """Landmarks as of a perfect network, and a depth image of boxes at their places before a wall."""
    world = np.zeros((len(Landmark), 3))
    for landmark in Landmark:
        name, _, side = landmark.name.rpartition("_")
        x, y, z = PLACES.get(name, PLACES["NOSE"]) if side in ("LEFT", "RIGHT") else PLACES["NOSE"]
        world[landmark] = (x if side != "RIGHT" else -x), y, z
    pixels = CAMERA.project(world + [0.0, 0.0, DISTANCE])
    depth = np.full((480, 640), 4.0, np.float32)

    def box(centre: FloatArray, z: float, half: float) -> None:
        column, row = np.round(centre).astype(int)
        reach = round(half * 465.0 / z)
        depth[max(row - reach, 0) : row + reach + 1, max(column - reach, 0) : column + reach + 1] = z

    for height in np.linspace(-0.42, 0.08, 12):
        for across in np.linspace(-0.15, 0.15, 7):
            surface = DISTANCE - 0.05 * np.cos(6.0 * across)
            box(CAMERA.project(np.array([across, height, surface])), surface, 0.05)
    for landmark in Landmark:
        box(pixels[landmark], DISTANCE + world[landmark, 2], 0.04)
    sure = np.ones(len(Landmark))
    side = 2.2 * 465.0 / DISTANCE
    region = Region(np.array([319.5, 239.5]), side, 0.0)
    return Landmarks(pixels, sure, sure, world, 1.0, region, region), depth


def test_joints_lie_behind_the_surface_at_their_landmarks_and_left_is_left() -> None:
    found, depth = person()
    body = lift(found, depth, CAMERA)
    assert body is not None
    for name in ("SHOULDER", "ELBOW", "WRIST", "HIP", "KNEE", "ANKLE"):
        for side, sign in (("LEFT", 1.0), ("RIGHT", -1.0)):
            joint = Joint[f"{name}_{side}"]
            x, y, z = PLACES[name]
            behind = body.positions[joint, 2] - (DISTANCE + z)
            assert 0.01 < behind < 0.15
            # on the line of sight through the landmark
            np.testing.assert_allclose(
                body.positions[joint, :2] / body.positions[joint, 2],
                np.array([sign * x, y]) / (DISTANCE + z),
                atol=2e-3,
            )
    assert body.positions[Joint.SHOULDER_LEFT, 0] > body.positions[Joint.SHOULDER_RIGHT, 0]
    assert (body.states[body.states > 0] == TrackingState.TRACKED).all()
    assert np.isnan(body.positions[Joint.HAND_TIP_LEFT]).all() and body.states[Joint.THUMB_LEFT] == 0


def lifted_with_guess(landmark: Landmark) -> Lifted:
    """The body of :func:`person`, one of whose landmarks the network guesses."""
    found, depth = person()
    visible = found.visible.copy()
    visible[landmark] = 0.1
    body = lift(replace(found, visible=visible), depth, CAMERA)
    assert body is not None
    return body


def test_covariances_are_positive_and_longest_along_the_line_of_sight_where_depth_is_guessed() -> None:
    body = lifted_with_guess(Landmark.ANKLE_LEFT)
    assert body.states[Joint.ANKLE_LEFT] == TrackingState.INFERRED
    values, vectors = np.linalg.eigh(body.covariances[Joint.ANKLE_LEFT])
    assert (values > 0.0).all()
    ray = body.positions[Joint.ANKLE_LEFT] / np.linalg.norm(body.positions[Joint.ANKLE_LEFT])
    assert abs(vectors[:, 2] @ ray) > 0.99
    seen = body.covariances[Joint.ANKLE_RIGHT]
    assert np.trace(body.covariances[Joint.ANKLE_LEFT]) > 4.0 * np.trace(seen)


def test_a_guessed_arm_is_unknown() -> None:
    """Its depth would be wrong by tenths of a metre for seconds, and with it the angle of the elbow."""
    body = lifted_with_guess(Landmark.WRIST_LEFT)
    for joint, state in {"WRIST_LEFT": 0, "HAND_LEFT": 0, "ELBOW_LEFT": 2, "WRIST_RIGHT": 2}.items():
        assert body.states[Joint[joint]] == state and np.isfinite(body.positions[Joint[joint]]).all() == (state > 0)


def test_a_joint_behind_a_table_is_inferred_where_it_is_expected() -> None:
    found, depth = person()
    hidden = depth.copy()
    hidden[300:] = 1.6
    body, free = lift(found, hidden, CAMERA), lift(found, depth, CAMERA)
    assert body is not None and free is not None
    for joint in (Joint.KNEE_LEFT, Joint.KNEE_RIGHT, Joint.ANKLE_LEFT, Joint.ANKLE_RIGHT):
        assert body.states[joint] == TrackingState.INFERRED
        assert np.linalg.norm(body.positions[joint] - free.positions[joint]) < 0.1
    assert body.states[Joint.ELBOW_LEFT] == TrackingState.TRACKED


@pytest.mark.parametrize(("gap", "hidden"), [(0.05, 0.0), (0.12, 0.5), (0.25, 1.0)])
def test_the_far_shoulder_of_somebody_who_stands_obliquely_is_not_at_the_chest(gap: float, hidden: float) -> None:
    found, depth = person()
    world = found.world.copy()
    far = [Landmark.SHOULDER_RIGHT, Landmark.HIP_RIGHT]
    world[far, 2] += gap
    before, body = lift(found, depth, CAMERA), lift(replace(found, world=world), depth, CAMERA)
    assert before is not None and body is not None
    for joint, other in ((Joint.SHOULDER_RIGHT, Joint.SHOULDER_LEFT), (Joint.HIP_RIGHT, Joint.HIP_LEFT)):
        np.testing.assert_allclose(body.positions[other], before.positions[other])
        moved = body.positions[joint, 2] - before.positions[joint, 2]
        assert abs(moved - hidden * gap) < 0.02
        deeper = np.linalg.eigvalsh(body.covariances[joint])[-1] - np.linalg.eigvalsh(before.covariances[joint])[-1]
        assert deeper > 0.0 or hidden < 1.0


def test_joints_outside_the_image_are_not_tracked() -> None:
    found, depth = person()
    above = replace(found, pixels=found.pixels + [0.0, 180.0])
    moved = np.full_like(depth, 4.0)
    moved[180:] = depth[:-180]
    body = lift(above, moved, CAMERA)
    assert body is not None
    for joint in (Joint.KNEE_LEFT, Joint.ANKLE_RIGHT, Joint.FOOT_LEFT):
        assert body.states[joint] == TrackingState.NOT_TRACKED and np.isnan(body.positions[joint]).all()
    assert body.states[Joint.SHOULDER_LEFT] == TrackingState.TRACKED


def test_without_depth_at_the_trunk_there_is_no_body() -> None:
    found, depth = person()
    assert trunk_depth(found, np.zeros_like(depth)) is None
    assert lift(found, np.zeros_like(depth), CAMERA) is None


@pytest.mark.parametrize("slope", [0.0, 0.3])
def test_a_picture_of_a_person_is_flat_and_a_person_is_not(slope: float) -> None:
    found, depth = person()
    columns = np.arange(640) - 319.5
    # a plane in space, seen at an angle, with the noise of a depth camera
    poster = (2.6 / (1.0 - slope * columns / 465.0))[None] * np.ones((480, 1))
    poster += np.random.default_rng(0).normal(scale=0.003, size=poster.shape)
    assert is_flat(found, poster.astype(np.float32), CAMERA)
    assert not is_flat(found, depth, CAMERA)


@pytest.mark.parametrize("corner", ["SHOULDER_LEFT", "HIP_RIGHT"])
def test_a_trunk_with_an_unknown_corner_has_no_depth(corner: str) -> None:
    """The lens model of a camera has no inverse far outside of the image: such landmarks have no pixels."""
    found, depth = person()
    pixels = found.pixels.copy()
    pixels[Landmark[corner]] = np.nan
    unknown = replace(found, pixels=pixels)
    assert trunk_depth(unknown, depth) is None
    assert lift(unknown, depth, CAMERA) is None
    # the other landmarks are too few points to decide
    assert not is_flat(unknown, depth, CAMERA)
