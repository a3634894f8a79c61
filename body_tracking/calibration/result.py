"""What a calibration says of one sensor: where it stands, and how its clock runs."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from body_tracking.skeleton import NANOSECONDS, FloatArray

MAX_DRIFT_PPM = 10_000.0
"""A clock that is a hundredth faster than another is no drift but a damaged number; NTP slews by 500 ppm at most."""


@dataclass(frozen=True, slots=True)
class ClockModel:
    """A sensor's clock against the reference sensor's clock.

    ``sensor = reference + offset + drift * (reference - anchor)``; two sensors that count from their own start have an
    offset of seconds and a drift of some tens of parts per million.

    Attributes:
        offset_ns: sensor clock minus reference clock at the anchor, nanoseconds.
        drift_ppm: by how much the sensor's clock runs fast, parts per million.
        anchor_ns: reference time at which the offset holds exactly.
    """

    offset_ns: int = 0
    drift_ppm: float = 0.0
    anchor_ns: int = 0

    def to_sensor(self, reference_ns: int) -> int:
        """Reference time to the sensor's time."""
        return reference_ns + self.offset_ns + round(self.drift_ppm * 1e-6 * (reference_ns - self.anchor_ns))

    def to_reference(self, sensor_ns: int) -> int:
        """The sensor's time to reference time; the inverse of :meth:`to_sensor` to a nanosecond."""
        # In integers but for the drift's small share: stamps since an epoch have no room for nanoseconds in a float.
        elapsed = sensor_ns - self.offset_ns - self.anchor_ns
        drift = self.drift_ppm * 1e-6
        return self.anchor_ns + elapsed - round(elapsed * (drift / (1.0 + drift)))

    @property
    def offset(self) -> float:
        """The offset in seconds."""
        return self.offset_ns / NANOSECONDS

    def anchored_at(self, reference_ns: int) -> ClockModel:
        """The same clock by its offset at another reference time."""
        return ClockModel(self.to_sensor(reference_ns) - reference_ns, self.drift_ppm, reference_ns)


@dataclass(frozen=True, slots=True)
class KnownClock:
    """A clock, and how well it is known.

    Attributes:
        model: anchored where the errors of offset and drift have nothing to do with each other.
        stddev: of the offset at the anchor, seconds; infinity while unknown.
        drift_stddev_ppm: of the drift, parts per million; infinity while unknown.
    """

    model: ClockModel = ClockModel()
    stddev: float = float("inf")
    drift_stddev_ppm: float = float("inf")

    def stddev_at(self, reference_ns: int) -> float:
        """Standard deviation of the offset at a reference time, seconds."""
        elapsed = (reference_ns - self.model.anchor_ns) / NANOSECONDS
        return float(np.hypot(self.stddev, 1e-6 * self.drift_stddev_ppm * elapsed)) if elapsed else self.stddev

    def carried_to(self, reference_ns: int, wander_ppm: float) -> KnownClock:
        """What it says of another time, if the drift may have changed by so much on the way."""
        drift_stddev_ppm = float(np.hypot(self.drift_stddev_ppm, wander_ppm))
        changing = KnownClock(self.model, self.stddev, drift_stddev_ppm)
        return KnownClock(self.model.anchored_at(reference_ns), changing.stddev_at(reference_ns), drift_stddev_ppm)


@dataclass(frozen=True, eq=False)
class SensorPose:
    """The pose of ``<sensor>_optical_frame`` (x right, y down, z forward) in ``world``.

    Attributes:
        sensor: its name.
        translation: (3,) metres.
        quat_xyzw: (4,) unit quaternion that takes optical coordinates into ``world``.
        valid_from_ns: reference time from which it is to be used; 0 for always.
    """

    sensor: str
    translation: FloatArray
    quat_xyzw: FloatArray
    valid_from_ns: int = 0

    @cached_property
    def rotation(self) -> FloatArray:
        """(3, 3) rotation matrix, optical to world."""
        # Imported here because it takes a third of a second, and most nodes only pass poses on or have none.
        from scipy.spatial.transform import Rotation

        matrix: FloatArray = Rotation.from_quat(self.quat_xyzw).as_matrix()
        return matrix

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
    from scipy.spatial.transform import Rotation

    optical_to_level = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    tilt = Rotation.from_euler("YX", [pitch, roll])
    rotation = tilt * Rotation.from_matrix(optical_to_level)
    return SensorPose(sensor, np.array([0.0, 0.0, height]), rotation.as_quat())


@dataclass(frozen=True, slots=True)
class SensorQuality:
    """How well one sensor's calibration is known.

    Attributes:
        residual: median distance between what both sensors say of the same joint, metres; NaN before any overlap.
        rotation_stddev: radians; infinity while unknown.
        translation_stddev: metres at the place where the person was; infinity while unknown.
        clock_stddev: of the clock's offset at its anchor, seconds; infinity while unknown.
        frames: pairs of frames that the estimate stands on.
        clock_drift_stddev_ppm: of the clock's drift, parts per million; infinity while unknown.
    """

    residual: float = float("nan")
    rotation_stddev: float = float("inf")
    translation_stddev: float = float("inf")
    clock_stddev: float = float("inf")
    frames: int = 0
    clock_drift_stddev_ppm: float = float("inf")


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationResult:
    """Poses, clocks and quality of every calibrated sensor, the reference among them.

    Attributes:
        reference: the sensor that defines ``world`` and its time.
        poses: a pose per calibrated sensor; a sensor that is not calibrated yet is absent.
        clocks: the clock of each sensor in ``poses``.
        quality: likewise.
    """

    reference: str
    poses: dict[str, SensorPose]
    clocks: dict[str, ClockModel]
    quality: dict[str, SensorQuality]
