"""``bags/mesh_reaching``: small, whole, and its truth is in its images."""

from __future__ import annotations

import numpy as np
import pytest
from depth_recording import BAG, recording

from body_tracking.core.skeleton import NANOSECONDS, Joint
from body_tracking.mesh.depth import DepthCamera
from body_tracking.mesh.person import PersonFinder
from body_tracking.simulation.depth_bags import SECONDS
from body_tracking.simulation.depth_scene import RATE


def test_it_is_small_and_whole() -> None:
    camera, images, joints, _ = recording()
    assert sum(path.stat().st_size for path in BAG.iterdir()) < 4e6
    assert len(images) == round(SECONDS * RATE) and images.keys() == joints.keys()
    stamps = np.array(list(images)) / NANOSECONDS
    assert np.diff(stamps) == pytest.approx(1.0 / RATE, abs=1e-6)
    assert {image.shape for image in images.values()} == {(camera.height, camera.width)}


def test_the_person_is_found_in_its_images_and_the_true_joints_are_inside() -> None:
    camera, images, joints, _ = recording()
    finder = PersonFinder(DepthCamera(camera))
    # not the wrists, which are the first to leave the outline
    chosen = [Joint.SHOULDER_LEFT, Joint.SHOULDER_RIGHT, Joint.ELBOW_LEFT, Joint.ELBOW_RIGHT, Joint.SPINE_MID]
    inside = []
    for stamp_ns in list(images)[::30]:
        found = finder.find(images[stamp_ns])
        assert found.people == 1
        columns, rows = np.round(camera.project(joints[stamp_ns][chosen])).astype(int).T
        near = np.array(
            [found.mask[row - 2 : row + 3, c - 2 : c + 3].any() for row, c in zip(rows, columns, strict=True)]
        )
        inside.append(near)
    assert np.mean(inside) > 0.95
