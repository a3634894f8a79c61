"""Images, balls, points and poses of the marker system, there and back, in both families of classes."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from body_tracking.markers.messages import (
    balls_to_cloud,
    cloud_to_balls,
    cloud_to_points,
    message_to_target_pose,
    points_to_cloud,
    target_pose_to_message,
)
from body_tracking.markers.observations import ImageBalls, Points, TargetPose
from body_tracking.messages.base import MessageError, MessageTypes
from body_tracking.messages.images import array_to_image, image_to_array

STAMP_NS = 1_750_000_000_123_456_789


def spread(count: int, size: int) -> Any:
    """Covariances (count, size, size)."""
    roots = np.random.default_rng(1).normal(size=(count, size, 2 * size))
    return 1e-3 * roots @ roots.transpose(0, 2, 1)


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
@pytest.mark.parametrize("pad", [0, 6])
def test_images_round_trip(types: MessageTypes, kind: Any, pad: int) -> None:
    pixels = np.random.default_rng(0).integers(0, np.iinfo(kind).max, size=(7, 11), dtype=kind, endpoint=True)
    message = array_to_image(pixels, STAMP_NS, "left_optical_frame", types)
    if pad:  # a driver may fill up its rows
        rows = np.frombuffer(bytes(message.data), np.uint8).reshape(7, -1)
        message.data = types.octets(np.pad(rows, ((0, 0), (0, pad))).tobytes())
        message.step += pad
    stamp_ns, frame, found = image_to_array(message)
    assert (stamp_ns, frame, found.dtype) == (STAMP_NS, "left_optical_frame", pixels.dtype)
    np.testing.assert_array_equal(found, pixels)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"encoding": "bgr8"}, "encoding 'bgr8', expected one of mono8"),
        ({"encoding": "mono16"}, "11 x 7 pixels of mono16"),
        ({"height": 8}, "11 x 8 pixels"),
        ({"width": 0}, "0 x 7 pixels"),
    ],
)
def test_invalid_images_are_refused(types: MessageTypes, changes: dict[str, Any], said: str) -> None:
    message = array_to_image(np.zeros((7, 11), np.uint8), STAMP_NS, "left", types)
    for name, value in changes.items():
        setattr(message, name, value)
    with pytest.raises(MessageError, match=said):
        image_to_array(message)


@pytest.mark.parametrize("count", [0, 5])
def test_balls_round_trip(types: MessageTypes, count: int) -> None:
    drawn = np.random.default_rng(2)
    balls = ImageBalls(
        STAMP_NS, "left", drawn.uniform(0, 640, (count, 2)), drawn.uniform(5, 90, count), spread(count, 2)
    )
    found = cloud_to_balls(balls_to_cloud(balls, types))
    assert (found.stamp_ns, found.camera) == (STAMP_NS, "left")
    np.testing.assert_allclose(found.pixels, balls.pixels, atol=5e-5)
    np.testing.assert_allclose(found.covariance, balls.covariance, rtol=1e-6)


@pytest.mark.parametrize("cameras", [0, 2])
def test_points_round_trip(types: MessageTypes, cameras: int) -> None:
    drawn = np.random.default_rng(3)
    balls = drawn.integers(-1, 9, (4, cameras))
    points = Points(STAMP_NS, "world", drawn.normal(size=(4, 3)), 1e-6 * spread(4, 3), balls)
    found = cloud_to_points(points_to_cloud(points, types))
    np.testing.assert_allclose(found.positions, points.positions, rtol=1e-6)
    np.testing.assert_allclose(found.covariance, points.covariance, rtol=1e-5)
    np.testing.assert_array_equal(found.balls, balls)


@pytest.mark.parametrize("seed", range(20))
def test_a_point_of_almost_parallel_rays_does_not_cost_the_others_of_its_frame(types: MessageTypes, seed: int) -> None:
    turned = Rotation.random(random_state=seed).as_matrix()
    covariance = np.stack([1e-9 * np.eye(3), turned @ np.diag([5e-10, 9e-10, 1.4]) @ turned.T])
    points = Points(STAMP_NS, "world", np.ones((2, 3)), covariance, np.empty((2, 0), np.intp))
    found = cloud_to_points(points_to_cloud(points, types))
    np.testing.assert_allclose(found.covariance[0], covariance[0], rtol=1e-6, atol=1e-15)
    np.testing.assert_allclose(found.covariance[1], covariance[1], atol=1e-6)


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e9])
def test_points_without_a_place_are_refused(types: MessageTypes, bad: float) -> None:
    points = Points(STAMP_NS, "world", np.full((1, 3), bad), spread(1, 3), np.empty((1, 0), np.intp))
    with pytest.raises(MessageError, match="a point without a place"):
        cloud_to_points(points_to_cloud(points, types))


def test_poses_round_trip(types: MessageTypes) -> None:
    rotation = Rotation.from_rotvec([0.3, -1.2, 0.7]).as_matrix()
    pose = TargetPose("hand", STAMP_NS, "world", rotation, np.array([1.0, -2.0, 0.5]), spread(1, 6)[0], np.arange(4), 0)
    found = message_to_target_pose(target_pose_to_message(pose, types), "hand")
    np.testing.assert_allclose(found.rotation, pose.rotation, atol=1e-12)
    np.testing.assert_array_equal(found.translation, pose.translation)
    np.testing.assert_allclose(found.covariance, pose.covariance)


def test_poses_without_a_deviation_are_refused(types: MessageTypes) -> None:
    pose = TargetPose("hand", STAMP_NS, "world", np.eye(3), np.zeros(3), np.zeros((6, 6)), np.arange(4), 0.0)
    with pytest.raises(MessageError, match="pose of hand: its covariance"):
        message_to_target_pose(target_pose_to_message(pose, types), "hand")
