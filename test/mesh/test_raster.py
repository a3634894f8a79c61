"""The depth buffer against the intersections of rays."""

from __future__ import annotations

import numpy as np
import pytest
from depth_shapes import camera, plane, sphere

from body_tracking.mesh.depth import DepthCamera
from body_tracking.mesh.raster import render


def test_depth_of_a_tilted_plane_is_that_of_each_ray() -> None:
    view = DepthCamera(camera())
    normal = np.array([0.2, -0.25, 1.0]) / np.linalg.norm([0.2, -0.25, 1.0])
    # small enough to be all in front of the camera, large enough to fill the image
    depth = render(*plane(normal, 2.0, size=4.0), view.camera).depth
    rays = np.concatenate([view.rays, np.ones_like(view.rays[..., :1])], axis=-1)
    # float32 of 2 m
    assert depth == pytest.approx(2.0 / (rays @ normal), abs=1e-6)


@pytest.mark.parametrize("k1", [0.0, 0.09])
def test_sphere_is_where_rays_meet_it_without_gaps(k1: float) -> None:
    view, centre, radius = DepthCamera(camera(k1=k1)), np.array([0.1, -0.05, 2.0]), 0.4
    found = render(*sphere(centre, radius, 100), view.camera)
    rays = np.concatenate([view.rays, np.ones_like(view.rays[..., :1])], axis=-1).astype(float)
    a, b, c = (rays**2).sum(-1), rays @ centre, centre @ centre - radius**2
    root = b * b - a * c
    depth = np.where(root > 0.0, (b - np.sqrt(np.maximum(root, 0.0))) / a, 0.0)
    # the faces are up to 2 r (1 - cos(pi / 100)) = 0.4 mm inside; rays meet them at 70 degrees at most
    inside = root > 0.1 * a * radius**2
    assert found.depth[inside] == pytest.approx(depth[inside], abs=1.5e-3)
    assert (found.faces >= 0).sum() == (found.depth > 0.0).sum()
    assert ((found.depth > 0.0) & (root <= 0.0)).sum() == 0 or k1 > 0.0
    assert (found.depth > 0.0)[inside].all()


def test_the_nearer_of_two_faces_is_seen_whatever_their_order() -> None:
    near, far = sphere(np.array([0.0, 0.0, 1.5]), 0.1), plane(np.array([0.0, 0.0, 1.0]), 3.0)
    faces = np.concatenate([near[1], far[1] + len(near[0])])
    vertices = np.concatenate([near[0], far[0]])
    one, other = render(vertices, faces, camera()), render(vertices, faces[::-1], camera())
    np.testing.assert_array_equal(one.depth, other.depth)
    assert one.depth[53, 64] == pytest.approx(1.4, abs=2e-3)
    assert one.depth[0, 0] == pytest.approx(3.0, abs=1e-6)


def test_what_is_behind_the_camera_or_without_extent_is_left_out() -> None:
    vertices, faces = sphere(np.array([0.0, 0.0, -2.0]), 0.4)
    assert not render(vertices, faces, camera()).depth.any()
    assert not render(np.array([[0.0, 0.0, 2.0], [0.1, 0.0, 2.0], [0.2, 0.0, 2.0]]), np.array([[0, 1, 2]]), camera())[
        0
    ].any()
    assert not render(np.full((3, 3), np.nan), np.array([[0, 1, 2]]), camera()).depth.any()


def test_distortion_beyond_the_image_brings_nothing_back_into_it() -> None:
    # 80 degrees from the axis, where the polynomial of k1 and k2 has long turned back
    far = np.array([[10.0, 0.0, 1.5], [11.0, 0.0, 1.5], [10.0, 1.0, 1.5]])
    assert not render(far, np.array([[0, 1, 2]]), camera(k1=0.09)).depth.any()


def test_a_coarse_buffer_is_the_same_view() -> None:
    vertices, faces = plane(np.array([0.2, 0.1, 1.0]), 2.0, size=4.0)
    fine, coarse = render(vertices, faces, camera()).depth, render(vertices, faces, camera(), scale=2).depth
    assert coarse.shape == (53, 64)
    # 1/z is linear in the image, so that its mean over four pixels is that in the middle of them
    nearness = (1.0 / fine).reshape(53, 2, 64, 2).mean(axis=(1, 3))
    assert 1.0 / coarse == pytest.approx(nearness, rel=1e-5)
