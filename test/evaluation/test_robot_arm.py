"""Tracking of a robot arm: balls in images, their order, delay and registration, and the rows of table 4.1."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from body_tracking.core.skeleton import FloatArray
from body_tracking.evaluation.balls import bright_balls, red_balls
from body_tracking.evaluation.robot_arm import ArmError, Trial, by_distances, compare
from body_tracking.mesh.depth import to_metres
from body_tracking.simulation.baseline_scenes import RADIUS, ArmScene, PendulumScene
from draws import draws, some

SCENE = ArmScene()
"""With as many pixels of depth as a Kinect v2 has on a ball at 2 m."""


def trial(
    seed: int, delay: float = 0.0, noise: float = 1e-3, offset: FloatArray | None = None, lead: float = 0.3
) -> Trial:
    """Measurements of a camera with white noise; the balls of each image in any order."""
    rng = np.random.default_rng(seed)
    robot = np.arange(-0.5, SCENE.seconds + 1.5, 0.01)
    times = np.sort(rng.uniform(0.0, SCENE.seconds + lead, 300))
    balls = SCENE.balls(times - lead) + (0.0 if offset is None else offset)
    seen = (balls - SCENE.pose.translation) @ SCENE.pose.rotation + rng.normal(0.0, noise, balls.shape)
    seen = np.array([each[rng.permutation(3)] for each in seen])
    return Trial(f"trial{seed}", 1e9 + times + delay, seen, 330, 1e9 + robot, SCENE.balls(robot - lead))


@pytest.mark.parametrize("delay", some([0.047, -0.2, 0.0], 2))
def test_injected_delay_is_found_and_does_not_show_in_the_errors(delay: float) -> None:
    for seed in range(draws(1, 20)):
        rng = np.random.default_rng(seed)
        trials = [trial(3 * seed + k, delay, lead=rng.uniform(0.0, 0.8)) for k in range(3)]
        result = compare(trials)
        assert result.alignment.delay == pytest.approx(delay, abs=0.005)
        for each in result.errors:
            assert each.delay == pytest.approx(delay, abs=0.005)
            # of a normal distribution with 1 mm
            assert each.mae == pytest.approx(np.full(3, 0.8e-3), abs=0.3e-3)
            assert (each.largest < 6e-3).all()


def test_a_trial_that_is_off_shows_in_its_row_alone() -> None:
    result = compare([trial(1), trial(2), trial(3, offset=np.array([0.006, 0.0, 0.0]))])
    assert result.errors[2].mae[0] == pytest.approx(6e-3, abs=0.5e-3)
    assert result.errors[1].mae[0] < 1.5e-3
    # the mean of the trials is off by a third of it
    assert result.errors[2].deviation[0] == pytest.approx(4e-3, abs=0.5e-3)
    assert result.errors[1].deviation[0] == pytest.approx(2e-3, abs=0.5e-3)


def test_every_ball_gets_its_name() -> None:
    one = trial(5, noise=2e-3)
    placed = by_distances(one)
    true = SCENE.balls(placed.times - 1e9 - 0.3)
    optical = (true - SCENE.pose.translation) @ SCENE.pose.rotation
    assert np.linalg.norm(placed.positions - optical, axis=-1).max() < 0.02
    assert len(placed.times) > 0.6 * len(one.times)


def test_what_cannot_be_compared_is_refused() -> None:
    good = trial(1)
    with pytest.raises(ArmError, match="one trial alone"):
        compare([good])
    slow = replace(trial(2), true_times=good.true_times[:1] + 0.5 * (good.true_times - good.true_times[0]))
    with pytest.raises(ArmError, match="does not make the motion"):
        compare([good, slow])
    still = replace(good, true_positions=np.repeat(good.true_positions[:1], len(good.true_times), axis=0))
    with pytest.raises(ArmError, match="delay of the camera is unknown"):
        compare([still, good])
    swapped = replace(good, true_positions=good.true_positions[:, [1, 0, 2]] * [1.0, 1.0, 0.2])
    with pytest.raises(ArmError, match="are they in the order"):
        compare([swapped, good])


def test_balls_are_found_where_they_are_and_nothing_else_red_is() -> None:
    """A red square hangs on the wall behind."""
    errors: list[float] = []
    numbers = []
    for number, time in enumerate(np.linspace(0.0, SCENE.seconds, draws(3, 40))):
        image, depth = SCENE.images(float(time), number)
        found = red_balls(image, to_metres(depth), SCENE.colour, SCENE.depth, RADIUS)
        true = (SCENE.balls(np.array([time]))[0] - SCENE.pose.translation) @ SCENE.pose.rotation
        off = np.linalg.norm(found.centres[:, None] - true, axis=-1)
        numbers.append(len(found.centres))
        errors += off.min(axis=1).tolist()
    # a ball may lack depth in one image or another; the bar of the whole test is 10 mm
    assert np.mean(np.array(numbers) == 3) > 0.7
    assert max(numbers) == 3
    assert np.mean(errors) < 2e-3
    assert np.max(errors) < 8e-3


def test_balls_of_another_size_and_without_depth_are_none() -> None:
    image, depth = SCENE.images(1.0, 0)
    assert len(red_balls(image, to_metres(depth), SCENE.colour, SCENE.depth, 2.0 * RADIUS).centres) == 0
    none = red_balls(image, np.zeros(depth.shape, np.float32), SCENE.colour, SCENE.depth, RADIUS)
    assert len(none.centres) == 0
    assert none.without_depth == 3
    grey = np.repeat(image.mean(axis=2, keepdims=True).astype(np.uint8), 3, axis=2)
    assert red_balls(grey, to_metres(depth), SCENE.colour, SCENE.depth, RADIUS).without_depth == 0


def test_a_bright_bolt_with_depth_is_no_retro_reflective_ball() -> None:
    for bolt, with_depth in ((True, 1), (False, 0)):
        scene = PendulumScene(0.5, bolt=bolt)
        ball = scene.balls(np.array([0.4]))[0]
        infrared, depth = scene.images(ball, 0)
        found = bright_balls(infrared, to_metres(depth))
        assert found.with_depth == with_depth
        assert found.pixels == pytest.approx(scene.camera.project(ball)[None], abs=0.1)
