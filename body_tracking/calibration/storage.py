"""Calibrations as YAML files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from body_tracking.calibration.rigid import CalibrationError
from body_tracking.core import files
from body_tracking.core.clocks import ClockModel
from body_tracking.core.sensor_poses import CalibrationResult, SensorPose, SensorQuality
from body_tracking.core.skeleton import MAX_RANGE, MAX_STAMP_NS, NANOSECONDS

MAX_DRIFT_PPM = 10_000.0
"""Largest plausible drift; NTP slews by 500 ppm at most."""

_HEADER = """\
# Calibration written by body_tracking: the pose of each <sensor>_optical_frame (x right, y down, z forward) in world,
# metres and a unit quaternion x y z w; the sensor's clock against the reference sensor's (sensor minus reference,
# seconds, at the reference time clock_anchor_ns; drift in parts per million); standard deviations, of the clock's
# offset at that time, and residual as estimated.
"""


def to_dict(result: CalibrationResult) -> dict[str, Any]:
    """Plain numbers and strings, for YAML and JSON; unknown quality is None."""

    def known(value: float, scale: float = 1.0) -> float | None:
        return float(value) * scale if np.isfinite(value) else None

    return {
        "reference": result.reference,
        "sensors": {
            name: {
                "frame": f"{name}_optical_frame",
                "translation": [float(value) for value in pose.translation],
                "quat_xyzw": [float(value) for value in pose.quat_xyzw],
                "clock_offset_s": result.clocks[name].offset,
                "clock_drift_ppm": float(result.clocks[name].drift_ppm),
                "clock_anchor_ns": result.clocks[name].anchor_ns,
                "residual_mm": known(result.quality[name].residual, 1e3),
                "rotation_stddev_deg": known(result.quality[name].rotation_stddev, 180.0 / np.pi),
                "translation_stddev_mm": known(result.quality[name].translation_stddev, 1e3),
                "clock_stddev_ms": known(result.clocks[name].stddev, 1e3),
                "clock_drift_stddev_ppm": known(result.clocks[name].drift_stddev_ppm),
                "frames": result.quality[name].frames,
            }
            for name, pose in result.poses.items()
        },
    }


def save(result: CalibrationResult, path: Path) -> None:
    """Write a calibration; the file is replaced as a whole or not at all.

    Raises:
        CalibrationError: the file cannot be written.
    """
    files.write_text(path, _HEADER + files.dump_yaml(to_dict(result)), CalibrationError)


def _numbers(entry: dict[str, Any], key: str, count: int) -> np.ndarray:
    values = np.asarray(entry[key], dtype=float)
    if values.shape != (count,) or not np.isfinite(values).all():
        raise ValueError(f"{key} must be {count} finite numbers")
    return values


def _sensor(name: str, entry: dict[str, Any]) -> tuple[SensorPose, ClockModel, SensorQuality]:
    quaternion = _numbers(entry, "quat_xyzw", 4)
    norm = float(np.linalg.norm(quaternion))
    if abs(norm - 1.0) > 1e-3:
        raise ValueError(f"quat_xyzw has length {norm:.3g}, not 1")

    translation = _numbers(entry, "translation", 3)
    if (np.abs(translation) > MAX_RANGE).any():
        raise ValueError(f"translation {translation}, expected at most {MAX_RANGE:g} m")

    def stated(key: str, scale: float, unknown: float) -> float:
        return unknown if entry.get(key) is None else float(entry[key]) / scale

    def bounded(key: str, limit: float) -> float:
        value = float(entry.get(key, 0.0))
        if not abs(value) <= limit:
            raise ValueError(f"{key} is {value:g}, expected at most {limit:g} either way")
        return value

    return (
        SensorPose(name, translation, quaternion / norm),
        ClockModel(
            round(bounded("clock_offset_s", MAX_STAMP_NS / NANOSECONDS) * NANOSECONDS),
            bounded("clock_drift_ppm", MAX_DRIFT_PPM),
            int(bounded("clock_anchor_ns", MAX_STAMP_NS) and entry["clock_anchor_ns"]),
            stated("clock_stddev_ms", 1e3, float("inf")),
            stated("clock_drift_stddev_ppm", 1.0, float("inf")),
        ),
        SensorQuality(
            stated("residual_mm", 1e3, float("nan")),
            stated("rotation_stddev_deg", 180.0 / np.pi, float("inf")),
            stated("translation_stddev_mm", 1e3, float("inf")),
            int(entry.get("frames", 0)),
        ),
    )


def load(path: Path) -> CalibrationResult:
    """Read a calibration.

    Raises:
        CalibrationError: the file is missing, is not YAML, or lacks or misstates a value; the text names it.
    """
    data = files.read_yaml(path, error=CalibrationError)
    if not isinstance(data, dict) or not isinstance(data.get("sensors"), dict) or "reference" not in data:
        raise CalibrationError(f"{path}: expected the keys reference and sensors")
    poses, clocks, quality = {}, {}, {}
    for name, entry in data["sensors"].items():
        try:
            poses[name], clocks[name], quality[name] = _sensor(str(name), entry)
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise CalibrationError(f"{path}: sensor {name}: {error}") from error
    if data["reference"] not in poses:
        raise CalibrationError(f"{path}: the reference sensor {data['reference']!r} has no pose")
    return CalibrationResult(str(data["reference"]), poses, clocks, quality)
