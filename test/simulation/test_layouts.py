"""Facts of the thesis's layouts and laws of any."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from standing import placed, standing

from body_tracking.core.sensor_poses import SensorPose, level_pose
from body_tracking.core.skeleton import FloatArray, Joint
from body_tracking.simulation.layouts import DISTANCE, NUMBERS, Layout, LayoutError, around, layout
from draws import draws

ANGLES = st.floats(-np.pi, np.pi)


def azimuths(made: Layout) -> FloatArray:
    """Degrees to the person's left at which the sensors stand."""
    forward = np.array([np.cos(made.yaw), np.sin(made.yaw)])
    left = np.array([-forward[1], forward[0]])
    to_sensor = np.array([pose.translation[:2] for pose in made.poses]) - made.position[:2]
    result: FloatArray = np.degrees(np.arctan2(to_sensor @ left, to_sensor @ forward))
    return result


def seen_by(pose: SensorPose, made: Layout) -> FloatArray:
    """(25, 3) a person who stands there, in the optical frame."""
    joints = placed(standing(), made.position, made.yaw)[0]
    sight: FloatArray = (joints - pose.translation) @ pose.rotation
    return sight


@pytest.mark.parametrize(
    ("number", "left", "right"),
    [(2, 15, 15), (3, 30, 30), (4, 45, 45), (5, 60, 60), (6, 75, 75), (7, 0, 30), (8, 0, 60), (9, 0, 90)],
)
def test_layouts_are_those_of_table_5_1(number: int, left: float, right: float) -> None:
    assert azimuths(layout(number)) == pytest.approx([left, -right], abs=1e-9)


def test_the_first_layout_has_the_sensors_side_by_side() -> None:
    first, second = layout(1).poses
    assert np.linalg.norm(first.translation - second.translation) == pytest.approx(0.249)


@pytest.mark.parametrize("number", NUMBERS)
def test_every_sensor_has_the_person_before_it(number: int) -> None:
    made = layout(number)
    for pose in made.poses:
        spine = seen_by(pose, made)[Joint.SPINE_MID]
        assert spine[0] == pytest.approx(0.0, abs=1e-9)
        assert spine[2] == pytest.approx(DISTANCE)
        assert seen_by(pose, made)[Joint.HEAD, 1] < spine[1], "y is down"


@given(st.lists(ANGLES, min_size=1, max_size=5), st.floats(0.5, 4.5), st.floats(0.0, 3.0))
@settings(max_examples=draws(12, 40), deadline=None)
def test_any_layout_has_the_angles_it_was_asked_for(angles: list[float], distance: float, height: float) -> None:
    made = around(angles, distance, height)
    apart = np.radians(azimuths(made)) - angles
    assert np.allclose(np.cos(apart), 1.0)
    reference = level_pose("kinect1", 0.0)
    assert np.allclose(made.poses[0].rotation, reference.rotation) and np.allclose(made.poses[0].translation, 0.0)
    for pose in made.poses:
        assert pose.translation[2] - made.position[2] == pytest.approx(height)


@pytest.mark.parametrize("number", [0, 10, -1])
def test_no_other_numbers(number: int) -> None:
    with pytest.raises(LayoutError, match="expected 1 to 9"):
        layout(number)


def test_impossible_layouts_are_refused() -> None:
    with pytest.raises(LayoutError):
        around(())
    with pytest.raises(LayoutError):
        around((0.0, np.nan))
