"""The overlay of markers: each ball in its target's colour, and the chain at its joints."""

from __future__ import annotations

import numpy as np
import pytest

from body_tracking.markers.observations import ImageBalls
from body_tracking.markers.overlay import annotate, chain_places, targets_of_balls
from body_tracking.simulation.marker_scene import MarkerScene, marker_scene

COLOURS = ((250, 0, 0), (0, 250, 0), (0, 0, 250))


@pytest.fixture(scope="module")
def scene() -> MarkerScene:
    return marker_scene("slow_down", seed=1, rate=30.0, seconds=0.1)


def test_each_ball_gets_the_name_of_its_target(scene: MarkerScene) -> None:
    poses = scene.poses(0, 5)
    targets = {target.name: target for target in scene.targets}
    expected = np.repeat([0, 1, 2], [len(target.points) for target in scene.targets])
    rng = np.random.default_rng(0)
    for camera in range(2):
        pixels = scene.rig.project(scene.balls(0))[camera] + rng.uniform(-0.5, 0.5, (len(expected), 2))
        strangers = pixels + np.array([200.0, 0.0])
        order = rng.permutation(2 * len(expected))
        every = np.concatenate([pixels, strangers])[order]
        found = targets_of_balls(scene.rig, camera, every, targets, poses)
        assert (found == np.concatenate([expected, np.full(len(expected), -1)])[order]).all()
    # a target that is not seen has no balls
    assert set(targets_of_balls(scene.rig, 0, pixels, targets, poses[:1]).tolist()) <= {-1, 0}
    assert (targets_of_balls(scene.rig, 0, pixels, targets, ()) == -1).all()


@pytest.mark.parametrize(("kind", "white"), [(np.uint8, 200), (np.uint16, 200 << 8), (np.uint16, 200 << 2)])
def test_a_circle_in_the_targets_colour_is_around_a_ball(kind: type, white: int) -> None:
    image = np.zeros((120, 160), kind)
    image[48:53, 68:73] = white
    pixels = np.array([[70.0, 50.0], [20.0, 90.0]])
    balls = ImageBalls(5, "left", pixels, np.array([25.0, 25.0]), np.tile(0.01 * np.eye(2), (2, 1, 1)))
    drawn = annotate(image, balls, np.array([1, -1]), ("a", "b", "c"), COLOURS)
    assert drawn.shape == (120, 160, 3) and drawn.dtype == np.uint8
    assert (drawn[50, 70] == 200).all()  # the ball itself is left as it is
    radius = int(np.sqrt(25.0 / np.pi)) + 4
    assert drawn[50, 70 + radius].argmax() == 1 and drawn[50, 70 + radius, 1] > 150
    ring = drawn[90, 20 + radius]
    assert ring.min() > 150 and ring.max() - ring.min() == 0
    assert not (drawn[..., 2] > drawn[..., 0]).any()  # no name of a target that is not there
    assert (annotate(image, None, np.empty(0, dtype=int), (), ()).max(axis=(0, 1)) == 200).all()


def test_the_chain_is_drawn_through_its_joints(scene: MarkerScene) -> None:
    poses, chain = scene.poses(0, 5), scene.chain
    centres, lines = chain_places(chain, poses)
    assert centres.shape == (2, 3) and lines.shape == (4, 2, 3)
    # in a chain that fits exactly, either target of a joint gives its place
    for seen in (poses[:2], poses[1:], poses[::2]):
        some, _ = chain_places(chain, seen)
        assert all(np.linalg.norm(centres - each, axis=1).min() < 1e-6 for each in some)
    origins = {tuple(pose.translation) for pose in poses}
    assert {tuple(line[0]) for line in lines} == origins
    centres, lines = chain_places(chain, ())
    assert centres.shape == (0, 3) and lines.shape == (0, 2, 3)
