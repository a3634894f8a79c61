"""A tilted reference sensor is noticed by people who stand still."""

from __future__ import annotations

import re
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from body_tracking.calibration.online import OnlineCalibration
from body_tracking.calibration.upright import levelling, standing_axis
from body_tracking.core.sensor_poses import level_pose
from body_tracking.core.skeleton import FloatArray, Joint
from body_tracking.kinect.csv_recording import CsvRecording
from draws import some
from walkers import TRACKED, frame, walk

TIMES = np.arange(0.0, 2.5, 1 / 30)
STATES = np.tile(TRACKED, (len(TIMES), 1))
PAIRS = [f"{person}_{layout}" for person, layout in product(("p02", "p07", "p12"), ("parallel", "45deg"))]


def tilted(positions: FloatArray, pitch: float, roll: float) -> FloatArray:
    """(..., 3) in a level sensor's optical frame, as a sensor sees them that is tilted by these degrees."""
    level, own = (level_pose("kinect1", 0.0, *np.radians(angles)).rotation for angles in ((0.0, 0.0), (pitch, roll)))
    return positions @ level.T @ own


def standing(seconds: float = 2.5) -> FloatArray:
    positions = walk(np.arange(0.0, seconds, 1 / 30), still=1000.0)
    return positions + np.random.default_rng(0).normal(scale=0.005, size=positions.shape)


def after(positions: FloatArray, calibration: OnlineCalibration, begun: float = 0.0) -> tuple[int, str]:
    """Level and text of the calibration's state after these frames of its reference sensor, from a time in seconds."""
    for number, each in enumerate(positions):
        seen = frame(begun + number / 30, each)
        calibration.push("kinect1", seen, seen.stamp_ns)
    return calibration.status()[:2]


def angles_in(text: str) -> tuple[float, float]:
    """Pitch and roll of the text, radians."""
    pitch, roll = (float(each) for each in re.findall(r"to (-?[0-9.]+)", text))
    return pitch, roll


@pytest.mark.parametrize(("pitch", "roll"), [(0.0, 0.0), (15.0, 0.0), (0.0, -10.0), (-20.0, 8.0)])
def test_the_angles_are_those_of_the_sensor(pitch: float, roll: float) -> None:
    exact = tilted(np.array([0.0, -1.0, 0.0]), pitch, roll)
    assert np.degrees(levelling(exact)) == pytest.approx((pitch, roll), abs=1e-9)
    axis = standing_axis(TIMES, tilted(standing(), pitch, roll), STATES)
    assert axis is not None
    assert np.degrees(levelling(axis)) == pytest.approx((pitch, roll), abs=2.5)


def test_who_sits_bends_or_moves_shows_nothing() -> None:
    person = standing()
    assert standing_axis(TIMES, walk(TIMES + 6.0), STATES) is None
    bent = person.copy()  # at the hips, by 30 degrees
    upper = [joint for joint in Joint if not joint.name.startswith(("HIP", "KNEE", "ANKLE", "FOOT", "SPINE_BASE"))]
    base = person[:, [Joint.SPINE_BASE]]
    bent[:, upper] = (person[:, upper] - base) @ Rotation.from_euler("x", 30, degrees=True).as_matrix().T + base
    assert standing_axis(TIMES, bent, STATES) is None
    sitting = person.copy()
    for side in ("LEFT", "RIGHT"):
        hip, knee, ankle = (Joint[f"{name}_{side}"] for name in ("HIP", "KNEE", "ANKLE"))
        sitting[:, knee] = person[:, hip] + [0.0, 0.0, -0.4]
        sitting[:, ankle] = sitting[:, knee] + [0.0, 0.4, 0.0]
    assert standing_axis(TIMES, sitting, STATES) is None
    hidden = STATES.copy()
    hidden[:, Joint.ANKLE_LEFT] = 1
    assert standing_axis(TIMES, person, hidden) is None


def test_it_is_said_once_people_have_stood_three_times_and_not_after_it_is_set() -> None:
    calibration, seen = OnlineCalibration(("kinect1",)), tilted(standing(8.0), 12.0, 0.0)
    assert after(seen[:120], calibration) == (0, "calibrated")
    level, text = after(seen[120:], calibration, 4.0)
    assert level == 1 and text.startswith("people stand tilted by 1")
    pitch, roll = angles_in(text)
    given = replace(calibration.parameters, reference_pitch=pitch, reference_roll=roll)
    assert after(seen, OnlineCalibration(("kinect1",), given)) == (0, "calibrated")
    calibration.start()  # maybe since the sensor was moved
    assert after(standing(8.0), calibration, 8.0) == (0, "calibrated")
    assert after(seen, calibration, 16.0)[0] == 1


@pytest.mark.parametrize("name", some(PAIRS))
@pytest.mark.parametrize("pitch", [0.0, 12.0])
def test_real_people_stand_upright(shared_data: Path, name: str, pitch: float) -> None:
    calibration = OnlineCalibration(("kinect1",))
    for each in CsvRecording(shared_data / "kinect_pairs" / f"{name}.csv.gz"):
        if each.sensor == "kinect1":
            seen = each.skeletons[0]
            calibration.push("kinect1", replace(seen, positions=tilted(seen.positions, pitch, 0.0)), each.received_ns)
    level, text, _ = calibration.status()
    assert level == (pitch > 0.0)
    if pitch:
        assert np.degrees(angles_in(text)) == pytest.approx((pitch, 0.0), abs=3.0)
