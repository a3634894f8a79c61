"""The result of a calibration: the pose and the clock of each sensor."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from body_tracking.core import so3
from body_tracking.core.clocks import ClockModel
from body_tracking.core.skeleton import FloatArray


@dataclass(frozen=True, eq=False)
class SensorPose:
    """The pose of ``<sensor>_optical_frame`` (x right, y down, z forward) in ``world``.

    Attributes:
        sensor: its name.
        translation: (3,) metres.
        quat_xyzw: (4,) unit quaternion that takes optical coordinates into ``world``.
        valid_from_ns: reference time from which it is valid; 0 for always.
    """

    sensor: str
    translation: FloatArray
    quat_xyzw: FloatArray
    valid_from_ns: int = 0

    @cached_property
    def rotation(self) -> FloatArray:
        """(3, 3) rotation matrix, optical to world."""
        return so3.quat_to_matrix(self.quat_xyzw / np.linalg.norm(self.quat_xyzw))

    def apply(self, points: FloatArray) -> FloatArray:
        """(..., 3) optical coordinates into world."""
        return points @ self.rotation.T + self.translation


def level_pose(sensor: str, height: float = 0.0, pitch: float = 0.0, roll: float = 0.0) -> SensorPose:
    """The reference sensor's pose in ``world``: z up, x horizontal along its view.

    Args:
        sensor: its name.
        height: metres of the sensor above the world's origin.
        pitch: radians by which it looks down.
        roll: radians by which it is turned clockwise about its view, seen from behind it.
    """
    optical_to_level = so3.matrix_to_quat(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]))
    tilt = so3.quat_multiply(so3.exp(np.array([0.0, pitch, 0.0])), so3.exp(np.array([roll, 0.0, 0.0])))
    return SensorPose(sensor, np.array([0.0, 0.0, height]), so3.quat_multiply(tilt, optical_to_level))


@dataclass(frozen=True, slots=True)
class SensorQuality:
    """How well the pose of one sensor is known.

    Attributes:
        residual: median distance between both sensors' positions of a joint, metres; NaN before any overlap.
        rotation_stddev: radians; infinity while unknown.
        translation_stddev: metres, at the place of the person; infinity while unknown.
        frames: pairs of frames that the estimate is made of.
    """

    residual: float = float("nan")
    rotation_stddev: float = float("inf")
    translation_stddev: float = float("inf")
    frames: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationResult:
    """Poses, clocks and quality of every calibrated sensor, the reference among them.

    Attributes:
        reference: the sensor that defines ``world`` and its time.
        poses: a pose per calibrated sensor; a sensor that is not calibrated yet is absent.
        clocks: the clock of each sensor in ``poses``, with its standard deviations.
        quality: of the pose of each sensor in ``poses``.
    """

    reference: str
    poses: dict[str, SensorPose]
    clocks: dict[str, ClockModel]
    quality: dict[str, SensorQuality]
