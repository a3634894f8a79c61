"""Data passed between the stages of the marker system: balls in an image, points in space, poses of targets."""

from __future__ import annotations

from dataclasses import dataclass

from body_tracking.core.skeleton import FloatArray, IntArray


@dataclass(frozen=True, slots=True, eq=False)
class ImageBalls:
    """Balls in one camera's image.

    Attributes:
        stamp_ns: capture time, nanoseconds.
        camera: the camera's frame.
        pixels: (n, 2) centroids in the distorted image; the origin is the centre of the upper left pixel.
        areas: (n,) pixels.
        covariance: (n, 2, 2) of the centroids by the noise of the image, pixels squared.
        dropped: number of bright regions that are not balls.
    """

    stamp_ns: int
    camera: str
    pixels: FloatArray
    areas: FloatArray
    covariance: FloatArray
    dropped: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class Points:
    """Points in space at one time, unordered.

    The covariance excludes the calibration error of the cameras, which is constant over frames and common to all
    points. :func:`body_tracking.markers.triangulation.sensitivity` gives it for a known rig.

    Attributes:
        stamp_ns: capture time, nanoseconds.
        frame_id: of the positions.
        positions: (n, 3) metres.
        covariance: (n, 3, 3) by the noise of the centroids, square metres.
        balls: (n, c) index of each point among the balls of each camera, -1 for a camera that does not see it;
            (n, 0) for points that do not come from images.
    """

    stamp_ns: int
    frame_id: str
    positions: FloatArray
    covariance: FloatArray
    balls: IntArray


@dataclass(frozen=True, slots=True, eq=False)
class TargetPose:
    """The pose of a target at one time.

    Attributes:
        name: of the target.
        stamp_ns: capture time, nanoseconds.
        frame_id: of the pose.
        rotation: (3, 3) and
        translation: (3,) metres: a point x of the target is at ``rotation @ x + translation``.
        covariance: (6, 6) as in ``geometry_msgs/PoseWithCovariance``: x, y, z, and rotations about the fixed axes x, y,
            z: the true rotation is ``exp(rotations) @ rotation``. From the noise of the points, without the
            calibration error of the rig (see :class:`Points`).
        points: (k,) index of each of the target's balls in :attr:`Points.positions`, -1 if unseen.
        residual: root mean square distance between the visible points and the fitted target, metres.
    """

    name: str
    stamp_ns: int
    frame_id: str
    rotation: FloatArray
    translation: FloatArray
    covariance: FloatArray
    points: IntArray
    residual: float
