"""A pinhole camera with lens distortion: from points to pixels and back.

The model is OpenCV's, which ``sensor_msgs/CameraInfo`` names ``plumb_bob`` (k1 k2 p1 p2 k3) and
``rational_polynomial`` (k1 k2 p1 p2 k3 k4 k5 k6). Camera axes: x right, y down, z forward (REP-103).
Pixels count from the centre of the upper left one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.skeleton import BoolArray, FloatArray

MODELS: Final = {"plumb_bob": 5, "rational_polynomial": 8}
"""Number of coefficients of each distortion model."""

_ITERATIONS: Final = 30
_CONVERGED: Final = 1e-12
"""Largest Newton step at convergence, normalised image coordinates."""


class CameraError(BodyTrackingError):
    """The parameters of a camera are invalid, or not calibrated."""


@dataclass(frozen=True, slots=True, eq=False)
class Camera:
    """A calibrated camera.

    Attributes:
        frame_id: its optical frame.
        width: pixels.
        height: pixels.
        matrix: (3, 3) focal lengths and principal point, pixels.
        distortion: (5,) or (8,) coefficients; zeros for an ideal lens.
        model: one of :data:`MODELS`.

    Raises:
        CameraError: no frame, no pixels, focal lengths that are not positive, a skewed matrix, another number of
            coefficients, or numbers that are not finite.
    """

    frame_id: str
    width: int
    height: int
    matrix: FloatArray
    distortion: FloatArray
    model: str = "plumb_bob"

    def __post_init__(self) -> None:
        where = f"camera {self.frame_id or '(no frame_id)'}"
        if not self.frame_id or self.width < 1 or self.height < 1:
            raise CameraError(
                f"{where}: {self.width} x {self.height} pixels; a frame id and a positive size are needed"
            )
        if self.model not in MODELS:
            raise CameraError(f"{where}: distortion model {self.model!r}, expected one of {', '.join(MODELS)}")
        if self.matrix.shape != (3, 3) or self.distortion.shape != (MODELS[self.model],):
            raise CameraError(
                f"{where}: matrix {self.matrix.shape} and {self.distortion.shape[0] if self.distortion.ndim else 0} "
                f"coefficients, expected (3, 3) and {MODELS[self.model]}"
            )
        if not (np.isfinite(self.matrix).all() and np.isfinite(self.distortion).all()):
            raise CameraError(f"{where}: a number is not finite")
        (fx, skew, _), (other, fy, _), last = self.matrix.tolist()
        if fx <= 0.0 or fy <= 0.0 or skew or other or last != [0.0, 0.0, 1.0]:
            raise CameraError(
                f"{where}: matrix {self.matrix.tolist()}, expected [fx 0 cx; 0 fy cy; 0 0 1]; calibrated?"
            )

    def is_like(self, other: Camera) -> bool:
        """Whether another calibration differs at most in the frame's name: drivers send one with each image."""
        same = (self.width, self.height, self.model) == (other.width, other.height, other.model)
        return same and np.array_equal(self.matrix, other.matrix) and np.array_equal(self.distortion, other.distortion)

    def project(self, points: FloatArray) -> FloatArray:
        """Pixels (..., 2) of points (..., 3) in the camera's frame, metres; NaN for points that are not in front."""
        with np.errstate(divide="ignore", invalid="ignore"):
            flat = points[..., :2] / np.where(points[..., 2:] > 0.0, points[..., 2:], np.nan)
        return self.to_pixels(self.distort(flat))

    def rays(self, pixels: FloatArray) -> FloatArray:
        """Unit vectors (..., 3) from the camera through pixels (..., 2); NaN where no direction gives this pixel."""
        flat = self.undistort(pixels)
        through = np.concatenate([flat, np.ones_like(flat[..., :1])], axis=-1)
        rays: FloatArray = through / np.linalg.norm(through, axis=-1, keepdims=True)
        return rays

    def contains(self, pixels: FloatArray) -> BoolArray:
        """Which pixels (..., 2) are in the image."""
        inside = (pixels >= -0.5) & (pixels < np.array([self.width, self.height]) - 0.5)
        return np.asarray(inside.all(axis=-1))

    def to_pixels(self, flat: FloatArray) -> FloatArray:
        """Pixels (..., 2) of distorted image coordinates (..., 2), x/z and y/z."""
        pixels: FloatArray = flat * self.matrix[[0, 1], [0, 1]] + self.matrix[:2, 2]
        return pixels

    def distort(self, flat: FloatArray) -> FloatArray:
        """Distorted coordinates (..., 2) of ideal image coordinates (..., 2), x/z and y/z."""
        x, y = flat[..., 0], flat[..., 1]
        r2 = x * x + y * y
        return np.stack(self._seen(x, y, r2, self._radial(r2)), axis=-1)

    def jacobian(self, flat: FloatArray) -> FloatArray:
        """The Jacobian (..., 2, 2) of :meth:`distort`."""
        x, y = flat[..., 0], flat[..., 1]
        r2 = x * x + y * y
        a, b, d = self._derivatives(x, y, r2, self._radial(r2))
        return np.stack([np.stack([a, b], axis=-1), np.stack([b, d], axis=-1)], axis=-2)

    @property
    def _coefficients(self) -> list[float]:
        """k1 k2 p1 p2 k3 k4 k5 k6."""
        return [*self.distortion.tolist(), 0.0, 0.0, 0.0][:8]

    def _radial(self, r2: FloatArray) -> FloatArray:
        """The factor of the radial distortion."""
        k1, k2, _, _, k3, k4, k5, k6 = self._coefficients
        above: FloatArray = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        return above / (1.0 + r2 * (k4 + r2 * (k5 + r2 * k6))) if k4 or k5 or k6 else above

    def _seen(self, x: FloatArray, y: FloatArray, r2: FloatArray, radial: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Distorted x and y."""
        _, _, p1, p2, *_ = self._coefficients
        twice = 2.0 * x * y
        return x * radial + p1 * twice + p2 * (r2 + 2.0 * x * x), y * radial + p1 * (r2 + 2.0 * y * y) + p2 * twice

    def _derivatives(
        self, x: FloatArray, y: FloatArray, r2: FloatArray, radial: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Of distorted x by x, by y, which is that of y by x, and of y by y."""
        k1, k2, p1, p2, k3, k4, k5, k6 = self._coefficients
        slope = k1 + r2 * (2.0 * k2 + 3.0 * k3 * r2)
        if k4 or k5 or k6:
            slope = slope - radial * (k4 + r2 * (2.0 * k5 + 3.0 * k6 * r2))
            slope /= 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6))
        slope = 2.0 * slope
        return (
            radial + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x,
            x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y,
            radial + y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x,
        )

    def undistort(self, pixels: FloatArray) -> FloatArray:
        """Ideal image coordinates (..., 2), x/z and y/z, of pixels (..., 2), by Newton's method.

        Gaschler (2011): eq. 3.3, 4.7.

        NaN where it does not converge: far outside the image the polynomials are not monotonic.
        """
        seen: FloatArray = (pixels - self.matrix[:2, 2]) / self.matrix[[0, 1], [0, 1]]
        if not self.distortion.any():
            return seen
        # by coordinate, in memory of its own: half the time of the pairs
        seen_x, seen_y = np.ascontiguousarray(seen[..., 0]), np.ascontiguousarray(seen[..., 1])
        x, y = seen_x, seen_y
        with np.errstate(all="ignore"):
            for _ in range(_ITERATIONS):
                r2 = x * x + y * y
                radial = self._radial(r2)
                made_x, made_y = self._seen(x, y, r2, radial)
                a, b, d = self._derivatives(x, y, r2, radial)
                missing_x, missing_y, determinant = seen_x - made_x, seen_y - made_y, a * d - b * b
                step_x = (d * missing_x - b * missing_y) / determinant
                step_y = (a * missing_y - b * missing_x) / determinant
                x, y = x + step_x, y + step_y
                step = np.maximum(np.abs(step_x), np.abs(step_y))
                if not (step > _CONVERGED).any():
                    break
            # determinant and sign: within the range where the polynomials are monotonic
            known = (step < 1e3 * _CONVERGED) & (determinant > 0.0) & (x * seen_x + y * seen_y >= 0.0)
        return np.where(known[..., None], np.stack([x, y], axis=-1), np.nan)
