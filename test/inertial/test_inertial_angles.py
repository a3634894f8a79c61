"""Angles straight from segments are those of the convention, and a real suit's own."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from body_tracking.core import so3
from body_tracking.core.estimate import ModelEstimate
from body_tracking.inertial.alignment import AlignmentError
from body_tracking.inertial.angles import SegmentAngles
from body_tracking.kinematics.conventions import angles_of
from body_tracking.kinematics.upper_body import UpperBody
from body_tracking.simulation.random_people import RandomMotion

MODEL = UpperBody()
LENGTHS = MODEL.default_lengths()
ROOT = Path(__file__).resolve().parents[2]


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_of_the_model_they_are_those_of_the_convention(seed: int) -> None:
    rng = np.random.default_rng(seed)
    q = RandomMotion(rng, 4.0).configuration(np.array([2.0]))[0]
    covariance = 1e-8 * np.eye(2 * MODEL.nv)
    estimate = ModelEstimate(0, "world", 0, q, np.zeros(MODEL.nv), covariance, LENGTHS, np.zeros(len(LENGTHS)))
    theirs = angles_of(estimate, MODEL, "isb")
    angles = SegmentAngles(MODEL)
    ours = angles(0, MODEL.forward(q, LENGTHS).rotations, np.broadcast_to(1e-8 * np.eye(3), (12, 3, 3)))
    columns = [ours.names.index(name) for name in theirs.names]
    apart = ours.position[columns] - theirs.position
    np.testing.assert_allclose(np.remainder(apart + np.pi, 2.0 * np.pi), np.pi, atol=1e-6)
    rest = [ours.position[n] for n, name in enumerate(ours.names) if name.startswith(("elbow_carrying", "wrist_twist"))]
    np.testing.assert_allclose(rest, 0.0, atol=1e-9)


def test_deviations_are_those_of_random_errors() -> None:
    rng = np.random.default_rng(0)
    q = RandomMotion(rng, 4.0).configuration(np.array([2.0]))[0]
    rotations = MODEL.forward(q, LENGTHS).rotations
    angles, stddev = SegmentAngles(MODEL), np.radians(1.0)
    covariance = np.broadcast_to(stddev**2 * np.eye(3), (12, 3, 3))
    first = angles(0, rotations, covariance)
    drawn = np.array(
        [
            angles(
                0, rotations @ so3.quat_to_matrix(so3.exp(stddev * rng.normal(size=(12, 3)))), covariance, first
            ).position
            for _ in range(400)
        ]
    )
    known = first.position_stddev < np.radians(4.0)
    assert known.sum() > 20
    np.testing.assert_allclose(drawn.std(axis=0)[known], first.position_stddev[known], rtol=0.2)


def test_a_segment_without_sensor_has_no_angles() -> None:
    rotations = np.tile(np.eye(3), (12, 1, 1))
    rotations[MODEL.segment_names.index("forearm_left")] = np.nan
    angles = SegmentAngles(MODEL)
    found = angles(0, rotations)
    missing = np.isnan(found.position)
    assert {name.partition("_")[0] for name, gone in zip(found.names, missing, strict=True) if gone} == {
        "elbow",
        "wrist",
    }
    assert all(name.endswith("_left") for name, gone in zip(found.names, missing, strict=True) if gone)
    assert np.isinf(found.position_stddev).all()
    with pytest.raises(AlignmentError, match="expected"):
        angles(0, np.eye(3))


@pytest.fixture
def imu_recordings(shared_data: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """The benchmark of this name."""
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    yield importlib.import_module("imu_recordings")
    sys.modules.pop("imu_recordings")


def present(path: Path) -> Path:
    if not path.is_file():
        pytest.skip(f"{path} is absent")
    return path


def test_a_real_suit_tells_its_own_angles(shared_data: Path, imu_recordings: Any) -> None:
    figures = imu_recordings.xsens(present(shared_data / "imu" / imu_recordings.XSENS))
    rows = {name: row for name, row in figures.items() if isinstance(row, dict) and "rms_deg" in row}
    assert len(rows) == 10
    for name, row in rows.items():
        assert row["rms_deg"] < 3.0, name
        assert row["convention_deg"] < 0.01, name


def test_a_real_arm_comes_back_to_where_it_was_aligned(shared_data: Path, imu_recordings: Any) -> None:
    figures = imu_recordings.two_arm(present(shared_data / "imu" / imu_recordings.TWO_ARM))["upper_arm_right"]
    assert figures["passages"] > 30
    assert figures["median_deg"] < 5.0
    assert figures["last_deg"] < 5.0
