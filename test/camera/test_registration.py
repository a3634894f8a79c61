"""Depth images in the view of the colour camera."""

from __future__ import annotations

import numpy as np
import pytest

from body_tracking.camera.pose_model import Landmark, Landmarks, Region
from body_tracking.camera.registration import Registration, moved
from body_tracking.core import so3
from body_tracking.core.camera import Camera
from body_tracking.core.sensor_poses import SensorPose
from body_tracking.mesh.depth import DepthError


def camera(width: int, focal: float, *distortion: float) -> Camera:
    height = width * 3 // 4
    matrix = np.array([[focal, 0.0, (width - 1) / 2], [0.0, focal, (height - 1) / 2], [0.0, 0.0, 1.0]])
    return Camera("camera", width, height, matrix, np.array([*distortion, *[0.0] * (5 - len(distortion))]))


DEPTH, COLOUR = camera(320, 280.0, 0.05), camera(640, 520.0)
POSE = SensorPose("depth", np.array([0.05, -0.01, 0.004]), so3.exp(np.array([0.0, 0.03, 0.01])))


def test_a_plane_stays_the_plane_that_it_is() -> None:
    # the plane normal . x = 2 in the colour camera's frame, as the depth camera measures it
    normal = np.array([0.1, -0.2, 1.0])
    columns, rows = np.meshgrid(np.arange(320), np.arange(240))
    rays = DEPTH.rays(np.stack([columns, rows], axis=-1).astype(float))
    turned = rays @ POSE.rotation.T
    along = (2.0 - normal @ POSE.translation) / (turned @ normal)
    image = (along * rays[..., 2]).astype(np.float32)
    register = Registration(DEPTH, COLOUR, POSE)
    seen = register(image)
    assert seen.shape == (240, 320)
    inside = seen[40:-40, 40:-40]
    assert (inside > 0.0).mean() > 0.99
    columns, rows = np.meshgrid(np.arange(40, 280), np.arange(40, 200))
    flat = register.camera.undistort(np.stack([columns, rows], axis=-1).astype(float))
    expected = 2.0 / (flat @ normal[:2] + normal[2])
    off = np.abs(inside - expected)[inside > 0.0]
    # a pixel has the distance of a point up to one pixel beside it
    assert np.median(off) < 0.006 and off.max() < 0.03


def test_near_surfaces_hide_those_behind() -> None:
    image = np.full((240, 320), 3.0, np.float32)
    image[100:140, 140:180] = 1.0
    seen = Registration(DEPTH, COLOUR, POSE)(image)
    rows, columns = np.nonzero((seen > 0.0) & (seen < 2.0))
    block = seen[rows.min() + 1 : rows.max(), columns.min() + 1 : columns.max()]
    assert (block < 2.0).all()


def test_registered_images_are_taken_as_they_are_and_of_another_size_refused() -> None:
    image = np.ones((240, 320), np.float32)
    register = Registration(DEPTH, COLOUR)
    assert register(image) is image and register.camera is DEPTH
    with pytest.raises(DepthError, match="320 x 240"):
        register(np.ones((480, 640), np.float32))


def test_landmarks_move_with_the_lines_of_sight() -> None:
    points = np.random.default_rng(3).uniform([-0.5, -0.4, 2.0], [0.5, 0.4, 3.0], (len(Landmark), 3))
    ones = np.ones(len(Landmark))
    region = Region(COLOUR.project(points).mean(axis=0), 200.0, 0.0)
    found = Landmarks(COLOUR.project(points), ones, ones, points, 1.0, region, region)
    there = moved(found, COLOUR, DEPTH)
    np.testing.assert_allclose(there.pixels, DEPTH.project(points), atol=1e-6)
    assert there.region.side == pytest.approx(200.0 * 280.0 / 520.0)
    assert moved(found, COLOUR, COLOUR) is found
