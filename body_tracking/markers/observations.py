"""What the stages of the marker system pass on: balls in an image, points in space, poses of targets."""

from __future__ import annotations

from dataclasses import dataclass

from body_tracking.core.skeleton import FloatArray, IntArray


@dataclass(frozen=True, slots=True, eq=False)
class ImageBalls:
    """The balls that one camera sees at one time.

    Attributes:
        stamp_ns: capture time, nanoseconds.
        camera: the camera's frame.
        pixels: (n, 2) centroids, pixels from the centre of the upper left one; of the image as it is, distorted.
        areas: (n,) pixels.
        covariance: (n, 2, 2) of the centroids by the noise of the image, pixels squared.
        dropped: number of bright regions that are no balls.
    """

    stamp_ns: int
    camera: str
    pixels: FloatArray
    areas: FloatArray
    covariance: FloatArray
    dropped: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class Points:
    """Points in space at one time, in no order.

    What the calibration of the cameras is wrong by is not in the covariance: it is the same for all frames and common
    to all points. :func:`body_tracking.markers.triangulation.sensitivity` gives it where the rig is known.

    Attributes:
        stamp_ns: capture time, nanoseconds.
        frame_id: of the positions.
        positions: (n, 3) metres.
        covariance: (n, 3, 3) by the noise of the centroids, square metres.
        balls: (n, c) index of each point among the balls of each camera, -1 where that camera does not see it;
            (n, 0) for points that come from no images.
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
            z, so that the true rotation is ``exp(rotations) @ rotation``; by the noise of the points and, for
            measurements of the rig, without its calibration (see :class:`Points`).
        points: (k,) index among :attr:`Points.positions` of each ball of the target, -1 for one that is not seen.
        residual: root of the mean squared distance between the seen points and the fitted target, metres.
    """

    name: str
    stamp_ns: int
    frame_id: str
    rotation: FloatArray
    translation: FloatArray
    covariance: FloatArray
    points: IntArray
    residual: float
