"""Depth images: units, back-projection, normals, edges."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from depth_shapes import camera, plane, sphere

from body_tracking.mesh.depth import DepthCamera, DepthError, axial_noise, supported, to_metres
from body_tracking.mesh.raster import render


def test_millimetres_and_metres_are_the_same_image_and_what_is_no_distance_is_missing() -> None:
    millimetres = np.array([[0, 1, 1500], [4500, 12000, 65535]], dtype=np.uint16)
    metres = np.array([[np.nan, 0.001, 1.5], [4.5, 12.0, np.inf]], dtype=np.float32)
    np.testing.assert_array_equal(to_metres(millimetres), [[0.0, np.float32(0.001), 1.5], [4.5, 12.0, 0.0]])
    np.testing.assert_array_equal(to_metres(metres), to_metres(millimetres))
    np.testing.assert_array_equal(to_metres(np.array([[-1.0, -np.inf]])), [[0.0, 0.0]])


@pytest.mark.parametrize("pixels", [np.zeros((2, 2), np.uint8), np.zeros((2, 2, 3), np.uint16), np.zeros(4, np.uint16)])
def test_what_is_no_depth_image_is_named(pixels: np.ndarray) -> None:
    with pytest.raises(DepthError, match=r"depth image of uint\d+ .*expected \(height, width\) uint16 or float32"):
        to_metres(pixels)


def test_points_project_onto_their_pixels_with_distortion() -> None:
    view = DepthCamera(camera(k1=0.09))
    rng = np.random.default_rng(0)
    depth = rng.uniform(0.5, 4.5, (106, 128)).astype(np.float32)
    depth[::7, ::5] = 0.0
    points = view.points(depth)
    assert np.isnan(points[::7, ::5]).all()
    seen = depth > 0.0
    rows, columns = np.nonzero(seen)
    # float32 of a ratio of 1, times the focal length of 91 pixels
    assert view.camera.project(points[seen].astype(float)) == pytest.approx(np.column_stack([columns, rows]), abs=1e-4)


def test_image_of_another_size_is_named() -> None:
    view = DepthCamera(camera())
    with pytest.raises(DepthError, match="64 x 53 pixels, but the calibration of kinect1_optical_frame says 128 x 106"):
        view.points(np.ones((53, 64), np.float32))
    with pytest.raises(DepthError, match="mask"):
        view.sample(np.ones((106, 128), np.float32), np.ones((53, 64), bool), 10)


def test_normals_of_a_sphere_point_away_from_its_centre() -> None:
    view, centre, radius = DepthCamera(camera(256, 212)), np.array([0.1, -0.05, 2.0]), 0.4
    depth = render(*sphere(centre, radius, 200), view.camera).depth
    cloud = view.sample(depth, np.ones_like(depth, bool), 300, radius=3)
    outward = (cloud.points - centre) / radius
    facing = -(cloud.points * outward).sum(-1) / np.linalg.norm(cloud.points, axis=1) > 0.3
    angles = np.degrees(np.arccos(np.clip((cloud.normals * outward).sum(-1), -1.0, 1.0)))
    # a window of 3 pixels (33 mm) is 5 degrees wide; beside the rim half of it is missing
    assert np.median(angles[facing]) < 1.0 and angles[facing].max() < 6.0
    assert ((cloud.normals * cloud.points).sum(-1)[facing] < 0.0).all()


def test_normals_of_a_noisy_wall_are_as_good_as_its_neighbours_allow() -> None:
    view = DepthCamera(camera(256, 212))
    normal = np.array([0.4, 0.0, 1.0]) / np.linalg.norm([0.4, 0.0, 1.0])
    rng = np.random.default_rng(1)
    depth = render(*plane(normal, 2.0, size=4.0), view.camera).depth
    depth += rng.normal(0.0, 1.0, depth.shape).astype(np.float32) * axial_noise(depth).astype(np.float32)
    cloud = view.sample(depth, np.ones_like(depth, bool), 400)
    angles = np.degrees(np.arccos(np.clip(-(cloud.normals @ normal), -1.0, 1.0)))
    # 2 mm over neighbours whose spread is 25 mm in each of two directions: 2 / 25 / sqrt(n), n = 60, is 0.6 degrees
    assert np.sqrt(np.mean(np.square(angles))) < 2.0


def test_normals_need_a_surface() -> None:
    view = DepthCamera(camera())
    depth = np.zeros((106, 128), np.float32)
    depth[50, 20:100] = 2.0
    depth[80, 60] = 1.0
    assert np.isnan(view.sample(depth, depth > 0.0, 100, reach=0.2).normals).all()


def test_flying_pixels_and_edges_are_left_out_and_surfaces_kept() -> None:
    view = DepthCamera(camera(256, 212))
    near = sphere(np.array([0.0, 0.0, 1.8]), 0.4, 100)
    depth = render(*near, view.camera).depth
    body = depth > 0.0
    depth[~body] = 3.0
    grown = cv2.dilate(body.astype(np.uint8), np.ones((3, 3))) > 0
    rim = grown & ~body
    rng = np.random.default_rng(2)
    depth[rim] = rng.uniform(2.0, 2.9, rim.sum())
    good = supported(depth)
    inner = cv2.erode(body.astype(np.uint8), np.ones((9, 9))) > 0
    assert (
        good[inner].all() and good[~cv2.dilate(rim.astype(np.uint8), np.ones((3, 3))).astype(bool)][600:].mean() > 0.9
    )
    # two neighbours that fly equally far are rare
    assert good[rim].mean() < 0.01
    assert not supported(np.zeros((20, 20), np.float32)).any()


def test_noise_of_a_real_frame_is_the_stated_one(shared_data: Path) -> None:
    folder = shared_data / "kinect_depth"
    if not folder.is_dir():
        pytest.skip(f"the real depth frame is absent ({folder})")
    depth = to_metres(cv2.imread(str(folder / "lab_004378_depth.png"), cv2.IMREAD_UNCHANGED)).astype(float)
    # the second difference of three neighbours cancels a slope; its variance is 6 times a pixel's
    second = np.abs(depth[:, 2:] - 2.0 * depth[:, 1:-1] + depth[:, :-2])
    there = np.minimum(np.minimum(depth[:, 2:], depth[:, 1:-1]), depth[:, :-2]) > 0.0
    for low, high in ((1.4, 2.0), (3.0, 4.0)):
        chosen = second[there & (depth[:, 1:-1] > low) & (depth[:, 1:-1] < high)]
        sigma = 1.4826 * np.median(chosen) / np.sqrt(6.0)
        # steps of 1 mm, folds of clothes and texture: within a factor of two
        assert 0.5 < sigma / axial_noise(np.array(0.5 * (low + high))) < 2.0
