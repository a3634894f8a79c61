"""Real points without labels: a walking person's targets (Motive), and a racer's (Optotrak).

The labels are the truth, and pick the points of a target in one frame; nothing else uses them.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from body_tracking.core.skeleton import FloatArray, IntArray
from body_tracking.markers.distinct import TargetsAlikeError, check_distinct
from body_tracking.markers.observations import Points
from body_tracking.markers.target_calibration import calibrate_target, ordered_views
from body_tracking.markers.targets import Target
from body_tracking.markers.tracking import TargetTracker
from draws import draws

NOISE = 5e-4
"""Metres; of a marker's centre."""
BENDING = {"Foot": 2e-3, "Knee": 1e-3, "Leg": 5e-4}
"""Metres by which the balls move on the skin and the shoe, before it is calibrated."""


@dataclass(frozen=True)
class Recording:
    points: FloatArray
    labels: list[str]
    rate: float

    def columns(self, prefix: str) -> list[int]:
        return [index for index, label in enumerate(self.labels) if label.startswith(prefix) and label[-1].isdigit()]

    def frame(self, number: int, noise: float, rng: np.random.Generator) -> tuple[Points, IntArray]:
        """The points of a frame in any order, and the labels' indices of them."""
        seen = rng.permutation(np.flatnonzero(np.isfinite(self.points[number]).all(axis=1)))
        covariance = np.tile(noise**2 * np.eye(3), (len(seen), 1, 1))
        stamp = round(number / self.rate * 1e9)
        return Points(stamp, "world", self.points[number, seen], covariance, np.zeros((len(seen), 0), int)), seen


def read(path: Path) -> Recording:
    ezc3d = pytest.importorskip("ezc3d")
    if not path.exists():
        pytest.skip(f"{path.name} is absent")
    file = ezc3d.c3d(str(path))
    point = file["parameters"]["POINT"]
    scale = 1e-3 if point["UNITS"]["value"][0] == "mm" else 1.0
    return Recording(
        scale * file["data"]["points"][:3].transpose(2, 1, 0), point["LABELS"]["value"], point["RATE"]["value"][0]
    )


def calibrated(recording: Recording, name: str, every: int) -> Target:
    """A target from every ``every``-th frame without labels; its balls were picked in the first frame with all."""
    columns, rng = recording.columns(name), np.random.default_rng(0)
    complete = np.flatnonzero(np.isfinite(recording.points[:, columns]).all(axis=(1, 2)))
    frames = [
        recording.frame(number, BENDING[name], rng) for number in (complete[0], *range(0, len(recording.points), every))
    ]
    balls = np.array([int(np.flatnonzero(frames[0][1] == column)[0]) for column in columns])
    views, covariance = ordered_views([points for points, _ in frames], balls)
    noise = np.where(covariance > 0.0, NOISE**2, 0.0)
    return calibrate_target(name, views, noise, flexible=True).target


@pytest.mark.slow
def test_walking_targets_are_tracked_without_labels(shared_data: Path) -> None:
    """None is wrong, and 98 % of the frames with four or more visible balls of a target give its pose."""
    recording = read(shared_data / "marker_unlabelled" / "walkingOptiTrack.c3d")
    names = ("Foot", "Knee", "Leg")
    targets = [calibrated(recording, name, draws(60, 20)) for name in names]
    columns = {name: recording.columns(name) for name in names}
    tracker, rng = TargetTracker(targets), np.random.default_rng(1)
    visible, found = dict.fromkeys(names, 0), dict.fromkeys(names, 0)
    for number in range(draws(300, len(recording.points))):
        points, labels = recording.frame(number, NOISE, rng)
        poses = {pose.name: pose for pose in tracker.update(points)}
        for name in names:
            seen = np.isfinite(recording.points[number, columns[name]]).all(axis=1)
            visible[name] += seen.sum() >= 4
            found[name] += seen.sum() >= 4 and name in poses
            if name in poses and not mislabelled(recording, columns[name], number):
                chosen = poses[name].points
                balls = np.flatnonzero(chosen >= 0)
                assert (labels[chosen[balls]] == np.array(columns[name])[balls]).all(), (name, number)
    assert all(found[name] >= 0.98 * visible[name] for name in names)


def mislabelled(recording: Recording, columns: list[int], number: int) -> bool:
    """Whether a distance between labelled balls is off by 2 cm: frame 1952 has two labels of the foot exchanged."""
    points = recording.points[:, columns]
    distances = np.linalg.norm(points[number, :, None] - points[number, None], axis=2)
    usual = np.nanmedian(np.linalg.norm(points[::50, :, None] - points[::50, None], axis=3), axis=0)
    return bool(np.nanmax(np.abs(distances - usual)) > 0.02)


@pytest.mark.slow
def test_equilateral_arm_targets_are_refused(shared_data: Path) -> None:
    recording = read(shared_data / "marker_unlabelled" / "racing_full.c3d")
    targets = [
        calibrate_target(name, recording.points[:, recording.columns(name)]).target
        for name in ("ArmL", "ForearmL", "GloveL", "Head")
    ]
    for target in targets[:3]:
        with pytest.raises(TargetsAlikeError, match=f"{target.name} and itself"):
            check_distinct([target], 2e-4)
    with pytest.raises(TargetsAlikeError, match="ArmL"):
        check_distinct(targets[:3], 2e-4)
    check_distinct(targets[3:], 2e-4)
