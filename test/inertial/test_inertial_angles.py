"""Angles with inertial sensors: a suit's are its own, an arm comes back, and no twist of the trunk is hidden."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from body_tracking.evaluation.reading import read
from body_tracking.inertial.simulated import SimulatedImu, usual_mounting
from body_tracking.recording.replay import ReplaySettings, replay
from body_tracking.simulation.bags import write_bag
from body_tracking.simulation.layouts import around
from body_tracking.simulation.scene import Setup, simulate
from draws import draws
from excerpts import beginning

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


@pytest.mark.slow
def test_sensors_on_an_arm_do_not_hide_how_the_person_twists(tmp_path: Path) -> None:
    """The twist was halved where the slow errors of the two shoulders, and hips, were independent: 10.8 degrees off.

    It shows in the first turns: later the filter has learnt the errors of its sources.
    """
    worn = ("forearm_left", "upper_arm_left")
    imus = tuple(SimulatedImu(segment, segment, usual_mounting(segment), 25.0, oriented=True) for segment in worn)
    squares = []
    for seed in range(8503, 8503 + draws(1, 4)):
        bag, out = tmp_path / f"bag{seed}", tmp_path / f"out{seed}"
        write_bag(simulate(Setup("torso_twist", around((0.0,)), imus=imus, seed=seed, seconds=12.0)), bag)
        replay(beginning(bag, tmp_path / f"first{seed}", 7.0), out, ReplaySettings((), filter_name="ekf", imus=worn))
        trial = read(out)
        assert trial.true_angles is not None
        found, true = (each.only(("trunk_axial",)) for each in (trial.angles, trial.true_angles))
        off = found.position[:, 0] - np.interp(found.stamps_ns, true.stamps_ns, true.position[:, 0])
        squares.append(np.nanmean(np.degrees(off) ** 2))
    assert np.sqrt(np.mean(squares)) < 9.0
