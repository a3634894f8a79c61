"""Frames of cameras and targets on ``/tf``: those of the rig and of the poses."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rigs import rig
from scipy.spatial.transform import Rotation
from target_points import measure

from body_tracking.core.message_types import TF
from body_tracking.core.parameters import check_all
from body_tracking.core.skeleton import FloatArray
from body_tracking.markers import setup
from body_tracking.markers.chain_files import save_chain
from body_tracking.markers.rig_storage import save_rig
from body_tracking.markers.stages import TrackerStage, TriangulationStage
from body_tracking.markers.targets_file import save_targets
from body_tracking.messages.base import to_nanoseconds
from body_tracking.pipeline import graph
from body_tracking.pipeline.stage import Now, Stage
from body_tracking.recording.rosbag2 import BAG_WIRE, deserialize
from body_tracking.simulation.marker_scene import MarkerScene, marker_scene

NOW = Now(1_750_000_000_000_000_000, 5)


def transforms(stage: Stage, topic: str, outputs: Any) -> dict[str, tuple[str, FloatArray, FloatArray]]:
    """Of the messages on a topic: parent, rotation and translation by child frame."""
    ports = {port.topic: port for port in stage.outputs}
    found = {}
    for output in outputs:
        if output.topic == topic:
            message = deserialize(TF, ports[topic].codec.encode(output.payload, BAG_WIRE))
            for each in message.transforms:
                assert to_nanoseconds(each.header.stamp) == NOW.ros_ns
                t, q = each.transform.translation, each.transform.rotation
                rotation = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
                found[each.child_frame_id] = each.header.frame_id, rotation, np.array([t.x, t.y, t.z])
    return found


def test_cameras_stand_where_the_rig_has_them(tmp_path: Path) -> None:
    truth = rig(3)
    save_rig(truth, tmp_path / setup.RIG)
    given = {"setup": str(tmp_path)}
    stage = TriangulationStage(check_all(TriangulationStage.PARAMETERS, given))
    found = transforms(stage, graph.TF_STATIC, stage.start(NOW))
    assert list(found) == ["b", "c"]
    points = np.random.default_rng(0).uniform([-0.1, -0.1, 0.9], [0.4, 0.1, 1.5], (5, 3))
    for index, (parent, rotation, origin) in enumerate(found.values(), 1):
        assert parent == "a"
        own = (points - origin) @ rotation  # from the parent's frame into the child's
        np.testing.assert_allclose(truth.cameras[index].project(own), truth.project(points)[index], atol=1e-6)
    silent = TriangulationStage(check_all(TriangulationStage.PARAMETERS, {**given, "tf": False}))
    assert not list(silent.start(NOW)) and graph.TF_STATIC not in [port.topic for port in silent.outputs]


@pytest.fixture(scope="module")
def scene() -> MarkerScene:
    return marker_scene("slow_down", seed=1, rate=30.0, seconds=0.1)


@pytest.mark.parametrize(("tf", "framed"), [("targets", 3), ("root", 1), ("none", 0)])
def test_targets_are_where_their_poses_are(scene: MarkerScene, tmp_path: Path, tf: str, framed: int) -> None:
    save_targets(scene.targets, tmp_path / setup.TARGETS)
    save_chain(scene.chain, tmp_path / setup.CHAIN)
    stage = TrackerStage(check_all(TrackerStage.PARAMETERS, {"setup": str(tmp_path), "tf": tf, "deadline": 1.0}))
    points = measure(scene.balls(0), np.random.default_rng(0), NOW.ros_ns)
    outputs = list(stage.take(setup.POINTS, points, NOW))
    poses = [output.payload for output in outputs if output.topic != graph.TF]
    found = transforms(stage, graph.TF, outputs)
    assert len(poses) == 3 and list(found) == [pose.name for pose in poses[:framed]]
    for pose in poses[:framed]:
        parent, rotation, origin = found[pose.name]
        assert parent == pose.frame_id
        np.testing.assert_allclose(rotation, pose.rotation, atol=1e-9)
        np.testing.assert_allclose(origin, pose.translation, atol=1e-9)
