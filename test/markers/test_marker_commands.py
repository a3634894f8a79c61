"""``body_tracking markers`` from recordings of points to a setup, and what it refuses."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from body_tracking import cli
from body_tracking.core.message_types import POINT_CLOUD
from body_tracking.core.qos import RELIABLE
from body_tracking.core.skeleton import FloatArray
from body_tracking.markers import setup
from body_tracking.markers.codecs import SpacePoints
from body_tracking.markers.rig_storage import save_rig
from body_tracking.markers.targets import Target
from body_tracking.markers.targets_file import load_targets, save_targets
from body_tracking.recording.rosbag2 import BAG_WIRE, BagWriter
from body_tracking.simulation.marker_scene import stereo_rig
from body_tracking.simulation.target_points import TARGET_POINTS, measure, random_rotation

START_NS, PERIOD_NS = 1_750_000_000_000_000_000, 16_666_667


def distances(points: FloatArray) -> FloatArray:
    return np.sort(np.linalg.norm(points[:, None] - points, axis=2)[np.triu_indices(len(points), 1)])


@pytest.fixture(scope="module")
def turned(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a rig, and a recording of the points of one target that is turned before it."""
    folder = tmp_path_factory.mktemp("target")
    save_rig(stereo_rig(), folder / setup.RIG)
    rng = np.random.default_rng(0)
    with BagWriter(folder / "bag") as bag:
        bag.add_topic(setup.POINTS, POINT_CLOUD, RELIABLE)
        for number in range(60):
            stamp_ns = START_NS + number * PERIOD_NS
            points = TARGET_POINTS @ random_rotation(rng).T + np.array([0.0, 0.0, 1.0])
            bag.write(setup.POINTS, SpacePoints().encode(measure(points, rng, stamp_ns), BAG_WIRE), stamp_ns)
    return folder


def test_a_target_is_measured_from_a_recording(turned: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["target", str(turned / "bag"), "--setup", str(turned), "--name", "hand", "--balls", "5", "--json"]
    assert cli.main(["markers", *words]) == 0
    report = json.loads(capsys.readouterr().out)
    (found,) = load_targets(turned / setup.TARGETS)
    assert (found.name, report["name"]) == ("hand", "hand")
    assert np.abs(distances(found.points) - distances(TARGET_POINTS)).max() < 2e-4
    assert report["views"] > 50 and report["stddev_mm"] < 0.1
    # the same again takes its place; another of the same shape is refused
    assert cli.main(["markers", *words]) == 0
    assert cli.main(["markers", *[word if word != "hand" else "twin" for word in words]]) == 2
    assert [each.name for each in load_targets(turned / setup.TARGETS)] == ["hand"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["target", "{bag}", "--name", "a", "--balls", "4"], "no frame with 4 points; 5 in 60 frames"),
        (["fit", "{bag}", "--joint", "elbow:knee:a:b"], "joint 'elbow:knee:a:b': expected NAME:KIND:PARENT:CHILD"),
        (["angles", "{bag}", "-o", "{folder}/out"], "chain.yaml: no such file; body_tracking markers fit makes it"),
        (["calibrate", "--camera", "left", "--columns", "9", "--rows", "6", "--square", "0.1"], "expected NAME=FOLDER"),
    ],
)
def test_what_does_not_serve_is_refused_in_one_line(
    turned: Path, tmp_path: Path, words: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    save_rig(stereo_rig(), tmp_path / setup.RIG)
    save_targets([Target("hand", TARGET_POINTS, np.zeros((15, 15)))], tmp_path / setup.TARGETS)
    given = [word.format(bag=turned / "bag", folder=tmp_path) for word in words]
    assert cli.main(["markers", *given, "--setup", str(tmp_path)]) == 2
    out = capsys.readouterr()
    assert said in out.err and out.err.count("\n") == 1
    assert not (tmp_path / "out").exists()
