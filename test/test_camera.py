"""The camera model: laws of projection, agreement with OpenCV where it is installed, and ``CameraInfo`` both ways."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from body_tracking.core.camera import Camera, CameraError
from body_tracking.core.skeleton import FloatArray
from body_tracking.messages.base import MessageError
from body_tracking.messages.cameras import CAMERA_INFO, camera_to_info, info_to_camera
from body_tracking.recording.rosbag2 import BAG_MESSAGES, deserialize, serialize

MATRIX = np.array([[364.7, 0.0, 257.2], [0.0, 365.1, 207.4], [0.0, 0.0, 1.0]])
LENSES = {
    "plumb_bob": (0.0893, -0.2722, 0.0011, -0.0007, 0.0943),
    "rational_polynomial": (5.1, 3.2, 0.0004, -0.0006, 0.16, 5.4, 5.0, 0.9),
}
"""Of a Kinect v2's and of an Azure Kinect's depth camera, about."""


def camera(model: str = "plumb_bob", distortion: tuple[float, ...] | None = None) -> Camera:
    return Camera("c_optical_frame", 512, 424, MATRIX, np.array(distortion or LENSES[model]), model)


def grid() -> FloatArray:
    """(n, 2) pixels all over the image."""
    return np.stack(np.meshgrid(np.linspace(0, 511, 12), np.linspace(0, 423, 11)), axis=-1).reshape(-1, 2)


@pytest.mark.parametrize("model", LENSES)
def test_a_ray_through_a_pixel_is_projected_onto_it_from_any_distance(model: str) -> None:
    lens = camera(model)
    rays = lens.rays(grid())
    np.testing.assert_allclose(np.linalg.norm(rays, axis=-1), 1.0, atol=1e-12)
    for distance in (0.5, 3.0):
        np.testing.assert_allclose(lens.project(distance * rays), grid(), atol=1e-8)
    assert lens.contains(grid()).all() and not lens.contains(np.array([[-1.0, 3.0], [512.0, 3.0], [3.0, 424.0]])).any()


@pytest.mark.parametrize(
    "change", [{"width": 640}, {"matrix": MATRIX + np.diag([1.0, 0.0, 0.0])}, {"distortion": np.zeros(5)}]
)
def test_a_calibration_is_like_another_one_with_the_same_numbers_alone(change: dict[str, object]) -> None:
    assert camera().is_like(replace(camera(), frame_id="other_optical_frame"))
    assert not camera().is_like(replace(camera(), **change))  # type: ignore[arg-type]
    assert not camera().is_like(camera("rational_polynomial"))


@pytest.mark.parametrize("model", LENSES)
def test_the_jacobian_is_the_derivative(model: str) -> None:
    lens, step = camera(model), 1e-6
    flat = lens.undistort(grid())
    jacobian = lens.jacobian(flat)
    for axis in range(2):
        change = step * np.eye(2)[axis]
        numeric = (lens.distort(flat + change) - lens.distort(flat - change)) / (2.0 * step)
        np.testing.assert_allclose(jacobian[..., axis], numeric, atol=1e-7)


@given(x=st.floats(-0.5, 0.5), y=st.floats(-0.5, 0.5), z=st.floats(0.3, 8.0))
def test_without_distortion_it_is_the_pinhole(x: float, y: float, z: float) -> None:
    pixel = camera(distortion=(0.0,) * 5).project(np.array([x, y, z]))
    np.testing.assert_allclose(pixel, [364.7 * x / z + 257.2, 365.1 * y / z + 207.4], rtol=1e-9)


def test_points_behind_the_camera_and_pixels_without_direction_are_nan() -> None:
    points = np.array([[0.1, 0.1, -1.0], [0.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    assert np.isfinite(camera().project(points)).all(axis=-1).tolist() == [False, False, True]
    barrel = camera(distortion=(-0.4, 0.0, 0.0, 0.0, 0.0))  # turns back at 0.61 of the radius
    assert np.isnan(barrel.rays(np.array([900.0, 207.4]))).all()


@pytest.mark.parametrize("model", LENSES)
def test_opencv_has_the_same_pixels_and_directions(model: str) -> None:
    cv2 = pytest.importorskip("cv2")
    lens = camera(model)
    points = 2.0 * lens.rays(grid())
    theirs, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), lens.matrix, lens.distortion)
    np.testing.assert_allclose(lens.project(points), theirs.reshape(-1, 2), atol=1e-8)


@pytest.mark.parametrize("model", LENSES)
def test_camera_round_trip_through_its_message(model: str) -> None:
    raw = serialize(camera_to_info(camera(model), 5, BAG_MESSAGES))
    back = info_to_camera(deserialize(CAMERA_INFO, raw))
    assert (back.frame_id, back.width, back.height, back.model) == ("c_optical_frame", 512, 424, model)
    np.testing.assert_array_equal(back.matrix, MATRIX)
    np.testing.assert_array_equal(back.distortion, LENSES[model])


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"k": np.zeros(9)}, "calibrated"),
        ({"distortion_model": "equidistant"}, "equidistant"),
        ({"d": np.zeros(14)}, "14 coefficients"),
        ({"d": np.array([np.nan])}, "finite"),
        ({"binning_x": 2}, "binned"),
        ({"width": 2**32 - 1, "height": 2**32 - 1}, "4294967295 x 4294967295 pixels"),
        ({"width": 0}, "0 x 424 pixels"),
    ],
)
def test_a_message_of_another_camera_is_refused(change: dict[str, object], text: str) -> None:
    message = camera_to_info(camera(), 5, BAG_MESSAGES)
    for name, value in change.items():
        object.__setattr__(message, name, value)
    with pytest.raises(MessageError, match=text):
        info_to_camera(message)


@pytest.mark.parametrize("matrix", [np.eye(4), np.array([[300.0, 1.0, 0.0], [0.0, 300.0, 0.0], [0.0, 0.0, 1.0]])])
def test_invalid_matrix_is_refused(matrix: FloatArray) -> None:
    with pytest.raises(CameraError, match="c_optical_frame"):
        Camera("c_optical_frame", 512, 424, matrix, np.zeros(5))
