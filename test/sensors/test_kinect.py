"""The step from Kinect camera space to the optical frame."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from body_tracking.sensors.kinect import camera_space_to_optical

numbers = st.floats(-10, 10)


@given(st.lists(st.tuples(numbers, numbers, numbers), min_size=1))
def test_it_is_its_own_inverse_and_keeps_handedness(points):
    array = np.array(points)
    np.testing.assert_array_equal(camera_space_to_optical(camera_space_to_optical(array)), array)
    assert np.linalg.det(camera_space_to_optical(np.eye(3))) == 1.0


def test_left_up_forward_of_the_sensor():
    left, up, forward = np.eye(3)
    np.testing.assert_array_equal(camera_space_to_optical(left), [-1, 0, 0])
    np.testing.assert_array_equal(camera_space_to_optical(up), [0, -1, 0])
    np.testing.assert_array_equal(camera_space_to_optical(forward), [0, 0, 1])
