"""The pixels of a person, by background, floor, prediction and body index."""

from __future__ import annotations

import numpy as np
import pytest
from depth_shapes import camera, dummy, ellipsoid, joined, plane, room

from body_tracking.core.skeleton import BoolArray, FloatArray, SingleArray
from body_tracking.mesh.depth import DepthCamera, DepthError, axial_noise
from body_tracking.mesh.person import COVERED, NOBODY, PersonFinder, find_floor, near
from body_tracking.mesh.raster import render

VIEW = DepthCamera(camera(256, 212))
SMALL = DepthCamera(camera())


def seen(*parts: tuple[FloatArray, np.ndarray], view: DepthCamera = VIEW) -> SingleArray:
    """A depth image of meshes, with the noise of a Kinect v2."""
    depth = render(*joined(*parts), view.camera).depth
    noise = np.random.default_rng(0).normal(size=depth.shape) * axial_noise(depth)
    return np.where(depth > 0.0, depth + noise, 0.0).astype(np.float32)


def pixels_of(person: tuple[FloatArray, np.ndarray], depth: SingleArray, view: DepthCamera = VIEW) -> BoolArray:
    """Where a mesh is seen and not hidden."""
    own = render(*person, view.camera).depth
    return np.asarray((own > 0.0) & (np.abs(own - depth) < 0.03))


def overlap(one: BoolArray, other: BoolArray) -> float:
    """Intersection over union."""
    return float((one & other).sum() / max((one | other).sum(), 1))


@pytest.mark.parametrize("tilt", [0.0, 0.15, 0.3])
def test_floor_is_found_under_a_tilted_camera(tilt: float) -> None:
    turn = np.array([[1.0, 0.0, 0.0], [0.0, np.cos(tilt), -np.sin(tilt)], [0.0, np.sin(tilt), np.cos(tilt)]])
    vertices, faces = joined(room(1.1), dummy(0.0, 2.2, 1.1))
    floor = find_floor(VIEW, seen((vertices @ turn.T, faces)))
    assert floor is not None
    # 2 to 4 mm of noise over a hundred points and more than a metre
    assert np.degrees(np.arccos(np.clip(floor.up @ turn @ [0.0, -1.0, 0.0], -1.0, 1.0))) < 0.5
    assert floor.height == pytest.approx(1.1, abs=0.01)


def test_a_wall_is_no_floor() -> None:
    assert find_floor(VIEW, seen(plane(np.array([0.0, 0.0, 1.0]), 2.0))) is None
    assert find_floor(VIEW, np.zeros((212, 256), np.float32)) is None


@pytest.mark.parametrize("x", [-0.5, 0.0, 0.6])
def test_a_person_in_a_room_is_found_in_the_first_image(x: float) -> None:
    person = dummy(x, 2.3)
    depth = seen(room(), person)
    found = PersonFinder(VIEW).find(depth)
    assert (found.people, found.reason) == (1, "")
    # 5 cm above the floor are left out, 3 % of the height
    assert overlap(found.mask, pixels_of(person, depth)) > 0.93


def test_of_two_people_the_nearer_one_is_taken_unless_the_other_is_predicted() -> None:
    first, second = dummy(-0.7, 2.2), dummy(0.8, 2.8)
    depth = seen(room(), first, second)
    finder = PersonFinder(VIEW)
    found = finder.find(depth)
    assert found.people == 2 and overlap(found.mask, pixels_of(first, depth)) > 0.93
    assert overlap(finder.find(depth, choice=1).mask, pixels_of(second, depth)) > 0.93
    predicted = finder.find(depth, second[0] + [0.05, 0.0, 0.05])
    assert overlap(predicted.mask, pixels_of(second, depth)) > 0.93


def test_furniture_of_a_person_s_size_becomes_background_when_it_stays_for_ten_seconds() -> None:
    furniture = ellipsoid(np.array([0.3, 0.2, 1.7]), np.array([0.3, 0.8, 0.3]))
    finder, person, before = PersonFinder(SMALL), dummy(-0.6, 2.2), seen(room(), furniture, view=SMALL)
    assert finder.find(before).people == 1
    for _ in range(300):
        finder.find(before)
    depth = seen(room(), furniture, person, view=SMALL)
    found = finder.find(depth)
    assert found.people == 1 and overlap(found.mask, pixels_of(person, depth, SMALL)) > 0.9


def test_a_tracked_person_who_stands_still_never_becomes_background() -> None:
    finder, person = PersonFinder(SMALL), dummy(0.0, 2.2)
    depth = seen(room(), person, view=SMALL)
    for _ in range(320):
        found = finder.find(depth, person[0])
    assert overlap(found.mask, pixels_of(person, depth, SMALL)) > 0.9


def test_the_wall_that_a_person_has_hidden_so_far_is_no_second_person() -> None:
    finder = PersonFinder(VIEW)
    finder.find(seen(room(wall=2.9), dummy(-0.6, 2.2)))
    depth = seen(room(wall=2.9), dummy(0.7, 2.2))
    found = finder.find(depth)
    assert found.people == 1 and overlap(found.mask, pixels_of(dummy(0.7, 2.2), depth)) > 0.93
    predicted = finder.find(depth, dummy(0.7, 2.2)[0])
    assert overlap(predicted.mask, pixels_of(dummy(0.7, 2.2), depth)) > 0.93


def test_an_empty_room_and_a_covered_lens_are_told_apart() -> None:
    finder = PersonFinder(VIEW)
    empty = finder.find(seen(room()))
    assert (empty.people, empty.reason) == (0, NOBODY) and not empty.mask.any()
    dark = np.zeros((212, 256), np.float32)
    dark[:10, :20] = 0.5
    for covered in (np.zeros_like(dark), dark):
        found = finder.find(covered)
        assert (found.people, found.reason) == (0, COVERED) and not found.mask.any()
    with pytest.raises(DepthError, match="128 x 106 pixels"):
        finder.find(np.ones((106, 128), np.float32))


def test_a_prediction_where_nobody_is_finds_nobody() -> None:
    found = PersonFinder(VIEW).find(seen(room()), dummy(0.0, 2.2)[0])
    assert (found.people, found.reason) == (0, NOBODY) and not found.mask.any()


def test_a_tracked_person_is_kept_from_the_side_with_head_and_arms_in_view_alone() -> None:
    # 0.08 square metres, as of a person who turns at a desk
    person = ellipsoid(np.array([0.0, 0.1, 0.85]), np.array([0.11, 0.25, 0.2]))
    depth = seen(plane(np.array([0.0, 0.0, 1.0]), 2.6), person)
    found = PersonFinder(VIEW).find(depth, person[0])
    assert found.people == 1 and overlap(found.mask, pixels_of(person, depth)) > 0.9


def test_a_head_that_the_chin_cuts_off_belongs_to_the_person() -> None:
    trunk = ellipsoid(np.array([0.0, 0.3, 1.0]), np.array([0.25, 0.3, 0.1]))
    head = ellipsoid(np.array([0.0, -0.16, 0.9]), np.array([0.09, 0.13, 0.08]))
    depth = seen(plane(np.array([0.0, 0.0, 1.0]), 2.6), trunk, head)
    found = PersonFinder(VIEW).find(depth)
    assert overlap(found.mask, pixels_of(joined(trunk, head), depth)) > 0.9


def test_near_is_about_the_mesh_in_the_image_and_in_depth() -> None:
    vertices = ellipsoid(np.array([0.0, 0.0, 2.0]), np.full(3, 0.2))[0]
    wall = np.full((212, 256), 2.0, np.float32)
    points = VIEW.points(wall)
    distance = np.abs(np.linalg.norm(points - [0.0, 0.0, 2.0], axis=-1) - 0.2)
    inside = np.linalg.norm(points - [0.0, 0.0, 2.0], axis=-1) < 0.2
    found = near(vertices, wall, VIEW.camera, 0.25)
    assert found[inside | (distance < 0.2)].all()
    # the corner of a box, and three cells of four pixels (44 mm)
    assert not found[~inside & (distance > (0.25 + 0.13) * np.sqrt(2.0))].any()
    assert not near(vertices, np.full_like(wall, 2.6), VIEW.camera, 0.25).any()
    assert not near(np.full((5, 3), np.nan), wall, VIEW.camera, 0.25).any()
