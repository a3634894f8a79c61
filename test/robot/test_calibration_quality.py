"""The calibration quality from the diagnostics of ``calibration``."""

from __future__ import annotations

import math

import pytest

from body_tracking.calibration.online import OnlineCalibration
from body_tracking.core.clocks import ClockModel
from body_tracking.core.sensor_poses import CalibrationResult, SensorQuality, level_pose
from body_tracking.robot.calibration import CalibrationQuality


def reported(calibration: OnlineCalibration) -> dict[str, str]:
    """The diagnostic values, as strings like in a message."""
    return {key: str(value) for key, value in calibration.status()[2].items()}


def test_before_there_is_a_calibration_the_other_sensors_are_missing() -> None:
    quality = CalibrationQuality.from_diagnostics(reported(OnlineCalibration(("a", "b", "c"))), ("a", "b", "c"))
    assert quality.missing == ("b", "c")
    assert math.isnan(quality.rotation_stddev)


def test_one_sensor_needs_none() -> None:
    assert CalibrationQuality.from_diagnostics(reported(OnlineCalibration(("a",))), ("a",)) == CalibrationQuality(
        (), 0.0, 0.0
    )


def test_the_least_certain_sensor_counts() -> None:
    calibration = OnlineCalibration(("a", "b", "c"))
    sensors = ("a", "b", "c")
    deviations = {"a": 0.0, "b": 0.02, "c": 0.05}
    calibration.load(
        CalibrationResult(
            "a",
            {name: level_pose(name) for name in sensors},
            {name: ClockModel(stddev=0.001) for name in sensors},
            {name: SensorQuality(0.03, deviations[name], 2.0 * deviations[name], 100) for name in sensors},
        )
    )
    quality = CalibrationQuality.from_diagnostics(reported(calibration), sensors)
    assert quality.missing == ()
    assert quality.rotation_stddev == pytest.approx(0.05, abs=1e-3)
    assert quality.translation_stddev == pytest.approx(0.1, abs=1e-3)


@pytest.mark.parametrize("text", ["much", "-5.0"])
def test_values_that_are_no_standard_deviation_are_nan(text: str) -> None:
    values = {"reference": "a", "b rotation_stddev_deg": text, "b translation_stddev_mm": "3"}
    quality = CalibrationQuality.from_diagnostics(values, ("a", "b"))
    assert math.isnan(quality.rotation_stddev)
    assert quality.translation_stddev == pytest.approx(0.003)
