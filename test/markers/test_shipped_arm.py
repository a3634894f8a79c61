"""``bags/markers_arm`` and its setup: whole, small, made by the command, and true."""

from __future__ import annotations

from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from body_tracking.core.message_types import IMAGE, JOINT_STATE
from body_tracking.core.parameters import check_all
from body_tracking.core.skeleton import NANOSECONDS
from body_tracking.evaluation.reading import read, true_at
from body_tracking.markers import setup
from body_tracking.markers.camera_images import CameraImagesStage
from body_tracking.markers.chain_files import load_chain
from body_tracking.markers.codecs import CameraImage
from body_tracking.markers.joint_model import free_directions
from body_tracking.markers.rig_storage import load_rig
from body_tracking.markers.targets_file import load_targets
from body_tracking.messages.cameras import CAMERA_INFO
from body_tracking.pipeline.stage import Now
from body_tracking.recording.rosbag2 import BAG_WIRE, BagReader, deserialize
from body_tracking.simulation import marker_bags
from body_tracking.simulation.marker_bags import DARK, SEED, SHIPPED, START_NS, TRUE_ANGLES, images, shipped_scene
from body_tracking.simulation.marker_scene import MarkerScene

ROOT = Path(__file__).resolve().parents[2]
BAG, SETUP = ROOT / "bags" / SHIPPED, ROOT / "config" / "marker_setup"
CAMERAS = ("left", "right")


@pytest.fixture(scope="module")
def scene() -> MarkerScene:
    return shipped_scene()


def test_the_bag_is_whole_and_small(scene: MarkerScene) -> None:
    with BagReader(BAG) as bag:
        assert not bag.warnings
        assert {topic: (info.type_name, info.count) for topic, info in bag.topics.items()} == {
            **{setup.image_topic(camera): (IMAGE, len(scene.times)) for camera in CAMERAS},
            **{setup.info_topic(camera): (CAMERA_INFO, 1) for camera in CAMERAS},
            TRUE_ANGLES: (JOINT_STATE, len(scene.times)),
        }
    assert sum(path.stat().st_size for path in BAG.iterdir()) < 3_000_000


def test_the_command_reproduces_images_and_truth(scene: MarkerScene) -> None:
    """To one grey level: other versions of numpy and OpenCV round differently."""
    true = scene.angles()
    # the elbow turns as the person's does, whose zero and senses are others
    assert np.abs(np.abs(np.diff(true[:, 3:], axis=0)) - np.abs(np.diff(scene.elbow, axis=0))).max() < 1e-9
    with BagReader(BAG) as bag:
        for index, raw in enumerate(bag.messages([TRUE_ANGLES])):
            message = deserialize(JOINT_STATE, raw.cdr)
            assert raw.log_time_ns == START_NS + round((scene.times[index] - scene.times[0]) * NANOSECONDS)
            assert tuple(message.name) == scene.chain.angle_names
            np.testing.assert_allclose(message.position, true[index], atol=1e-9)
        for number, camera in enumerate(CAMERAS):
            for index, raw in enumerate(islice(bag.messages([setup.image_topic(camera)]), 2)):
                _, _, pixels = CameraImage().decode(raw.cdr, BAG_WIRE)
                made = images(scene, index, DARK, SEED)[number]
                away = np.abs(pixels.astype(int) - made)
                assert away.max() <= 1 and (away > 0).mean() < 0.001


def test_the_setup_is_the_scenes_within_its_deviations(scene: MarkerScene) -> None:
    rig, chain = load_rig(SETUP / setup.RIG), load_chain(SETUP / setup.CHAIN)
    for number, (camera, other) in enumerate(zip(rig.cameras, scene.rig.cameras, strict=True)):
        variance = rig.covariance.diagonal()[15 * number : 15 * number + 9]
        away = camera.matrix[[0, 1, 0, 1], [0, 1, 2, 2]] - other.matrix[[0, 1, 0, 1], [0, 1, 2, 2]]
        away = np.concatenate([away, camera.distortion - other.distortion])
        assert (np.abs(away) <= 4.0 * np.sqrt(variance)).all()
    for one, other in zip(load_targets(SETUP / setup.TARGETS), scene.targets, strict=True):
        assert one.name == other.name
        np.testing.assert_allclose(one.points, other.points, atol=1e-9)
    # of the noise of the poses and of the calibration of the cameras
    covariance = chain.covariance + chain.sensitivity @ rig.covariance @ chain.sensitivity.T
    for index, (joint, other) in enumerate(zip(chain.joints, scene.chain.joints, strict=True)):
        own = slice(12 * index, 12 * index + 12)
        free = free_directions(joint)
        away = free.T @ joint.difference(other)
        assert (np.abs(away) < 4.0 * np.sqrt(np.diag(free.T @ covariance[own, own] @ free))).all()


def test_rendered_cameras_show_the_recordings_motion(scene: MarkerScene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(marker_bags, "shipped_scene", lambda: scene)
    stage = CameraImagesStage(check_all(CameraImagesStage.PARAMETERS, {"setup": str(SETUP), "images": "render"}))
    list(stage.start(Now(START_NS, 0)))
    outputs = {output.topic: output.payload for output in stage.poll(0)}
    with BagReader(BAG) as bag:
        for camera in CAMERAS:
            topic = setup.image_topic(camera)
            raw = next(iter(bag.messages([topic])))
            stamp_ns, frame_id, pixels = CameraImage().decode(raw.cdr, BAG_WIRE)
            assert outputs[topic][:2] == (stamp_ns, frame_id)
            assert np.abs(pixels.astype(int) - outputs[topic][2]).max() <= 1


@pytest.mark.slow
def test_its_angles_are_as_exact_as_stated(tmp_path: Path) -> None:
    from body_tracking.cli import main

    words = ["markers", "angles", str(BAG), "--setup", str(SETUP), "-o", str(tmp_path / "angles")]
    assert main(words) == 0
    tracked = read(tmp_path / "angles", truth=BAG)
    error = tracked.angles.known - true_at(tracked.angles, tracked.true_angles)
    assert np.isfinite(error).mean() > 0.95
    assert np.degrees(np.nanmax(np.abs(error))) < 0.3
    assert np.nanmean(np.abs(error) < 2.0 * tracked.angles.stddev) > 0.9
