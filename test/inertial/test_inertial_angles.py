"""Real recordings: angles of a suit are its own, and an arm comes back to where it was aligned."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[2]


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
