"""Checks the quality of the sensors' calibration, as the node ``calibration`` reports it, before a robot moves."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from body_tracking.core.skeleton import NANOSECONDS
from body_tracking.robot.mapping import SafetyLimits

SILENCE = 5.0
"""Seconds after which a report counts as outdated; ``calibration`` reports once a second."""


@dataclass(frozen=True, slots=True)
class CalibrationQuality:
    """Certainty of the sensors' poses.

    Attributes:
        missing: sensors without a pose.
        rotation_stddev: radians, of the least certain sensor; NaN where it is not reported.
        translation_stddev: metres, of the least certain sensor; NaN where it is not reported.
    """

    missing: tuple[str, ...]
    rotation_stddev: float
    translation_stddev: float

    @classmethod
    def from_diagnostics(cls, values: Mapping[str, str], sensors: Iterable[str]) -> CalibrationQuality:
        """From the diagnostics of ``calibration``, for these sensors; the reference needs no calibration."""
        others = [sensor for sensor in sensors if sensor != values.get("reference")]

        def worst(key: str) -> float:
            numbers = [_number(values.get(f"{sensor} {key}", "nan")) for sensor in others]
            return math.nan if any(map(math.isnan, numbers)) else max(numbers, default=0.0)

        missing = tuple(sensor for sensor in others if f"{sensor} rotation_stddev_deg" not in values)
        return cls(missing, math.radians(worst("rotation_stddev_deg")), worst("translation_stddev_mm") / 1e3)


def _number(text: str) -> float:
    """The standard deviation; NaN for a text that is none."""
    try:
        number = float(text)
    except ValueError:
        return math.nan
    return number if number >= 0.0 else math.nan


class CalibrationWatch:
    """Keeps the last report on the calibration, and checks it against the limits."""

    def __init__(self) -> None:
        self._quality: CalibrationQuality | None = None
        self._received_ns = 0
        self._valid_from_ns: dict[str, int] = {}

    def receive_quality(self, quality: CalibrationQuality, steady_ns: int) -> None:
        """Update the quality."""
        self._quality, self._received_ns = quality, steady_ns

    def receive_pose(self, sensor: str, valid_from_ns: int) -> None:
        """Update the stamp from which a sensor's pose holds; 0 for always."""
        self._valid_from_ns[sensor] = valid_from_ns

    def fault(self, limits: SafetyLimits, stamp_ns: int, steady_ns: int) -> str:
        """Why the calibration does not suffice; empty if it does.

        Args:
            limits: of the mapping.
            stamp_ns: of the angles to follow, in the clock of the poses' stamps.
            steady_ns: now.
        """
        if not limits.calibration:
            return ""
        if self._quality is None:
            return "no diagnostics of calibration yet"
        silent = (steady_ns - self._received_ns) / NANOSECONDS
        if silent > SILENCE:
            return f"no diagnostics of calibration for {silent:.0f} s"
        if self._quality.missing:
            return f"calibration is missing: {', '.join(self._quality.missing)}"
        for what, value, most, unit in (
            ("orientation", self._quality.rotation_stddev, limits.max_rotation_stddev, "rad"),
            ("place", self._quality.translation_stddev, limits.max_translation_stddev, "m"),
        ):
            if not value <= most:
                return (
                    f"calibration is poor: standard deviation {value:.3g} {unit} of a sensor's {what}, limit {most:g}"
                )
        if math.isfinite(limits.max_calibration_age):
            oldest = min(self._valid_from_ns.values(), default=0)
            if oldest == 0:
                return "the age of the calibration is not known"
            age = (stamp_ns - oldest) / NANOSECONDS
            if age > limits.max_calibration_age:
                return f"calibration is {age:.0f} s old, limit {limits.max_calibration_age:g} s"
        return ""
