"""Joints from two or more colour cameras: laws of triangulation and matching, and the shipped recording."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_lifting import PLACES

from body_tracking.camera.codecs import CompressedColour
from body_tracking.camera.lifting import ACROSS, BODY_SIDE
from body_tracking.camera.numbers import PersonNumbers
from body_tracking.camera.pose_model import Landmark, Landmarks, Region
from body_tracking.camera.rig_stage import RigStage
from body_tracking.camera.topics import COMPRESSED, DRIVERS
from body_tracking.camera.triangulation import ALIKE, SightLines, View, match, triangulate
from body_tracking.core.message_types import TRANSFORM
from body_tracking.core.parameters import check_all
from body_tracking.core.sensor_poses import SensorPose
from body_tracking.core.skeleton import FloatArray, Joint, Skeleton, TrackingState
from body_tracking.markers.rig import Rig
from body_tracking.markers.setup import SetupError
from body_tracking.mesh.depth import DepthError
from body_tracking.messages.calibration import transform_to_pose
from body_tracking.messages.cdr import decode_skeletons
from body_tracking.pipeline import graph
from body_tracking.pipeline.stage import Now
from body_tracking.recording.rosbag2 import BAG_WIRE, BagReader, deserialize
from body_tracking.simulation.camera_bags import SHIPPED_PAIR, pose_around, rig_of
from body_tracking.simulation.colour_images import colour_camera
from draws import draws
from pose_networks import MISSING, REASON

ROOT = Path(__file__).resolve().parents[2]
SETUP = ROOT / "config" / "camera_rig"
CAMERA = colour_camera()
ARMS = [Joint[f"{name}_{side}"] for side in ("LEFT", "RIGHT") for name in ("SHOULDER", "ELBOW", "WRIST")]


def poses(*angles: float) -> list[SensorPose]:
    return [pose_around(f"camera{number + 1}", angle) for number, angle in enumerate(angles)]


def person(at: FloatArray) -> FloatArray:
    """(33, 3) landmarks in ``world`` of somebody upright at a place, who faces the origin."""
    found = np.zeros((len(Landmark), 3))
    for landmark in Landmark:
        name, _, side = landmark.name.rpartition("_")
        x, y, z = PLACES.get(name, PLACES["NOSE"]) if side in ("LEFT", "RIGHT") else PLACES["NOSE"]
        found[landmark] = z, (-x if side != "RIGHT" else x), 1.0 - y
    return found + at


def seen(
    rig: Rig, where: list[SensorPose], points: FloatArray, noise: float, rng: np.random.Generator
) -> list[Landmarks]:
    """The landmarks in each camera, with errors in units of the stated deviations."""
    first = where[0]
    pixels = rig.project((points - first.translation) @ first.rotation)
    sure = np.ones(len(Landmark))
    found = []
    for each in pixels:
        side = 1.25 * float(np.ptp(each[:, 1]))
        region = Region(each.mean(axis=0), side, 0.0)
        moved = each + noise * ACROSS * side / BODY_SIDE * rng.normal(size=each.shape)
        found.append(Landmarks(moved, sure, sure, points, 1.0, region, region))
    return found


def in_world(positions: FloatArray, where: list[SensorPose]) -> FloatArray:
    return where[0].apply(positions)


def test_without_errors_the_joints_are_exact() -> None:
    where = poses(-0.5, 0.6)
    rig, points = rig_of(where, CAMERA), person(np.array([2.2, 0.1, 0.0]))
    one, other = seen(rig, where, points, 0.0, np.random.default_rng(0))
    body = triangulate(rig, [View(0, one), View(1, other)])
    placed = in_world(body.positions, where)
    for joint in ARMS:
        np.testing.assert_allclose(placed[joint], points[Landmark[joint.name]], atol=1e-5)
    assert (body.states[ARMS] == TrackingState.TRACKED).all()


def test_errors_are_as_large_as_stated() -> None:
    where = poses(-0.7, 0.0, 0.7)
    rig, points = rig_of(where, CAMERA), person(np.array([2.2, 0.0, 0.0]))
    rng, squared = np.random.default_rng(1), []
    for _ in range(draws(60, 400)):
        marked = points + rng.normal(scale=np.hypot(ALIKE, 0.01), size=points.shape)
        views = [View(k, each) for k, each in enumerate(seen(rig, where, marked, 1.0, rng))]
        body = triangulate(rig, views)
        for joint in (Joint.ELBOW_LEFT, Joint.KNEE_RIGHT):
            error = in_world(body.positions, where)[joint] - points[Landmark[joint.name]]
            covariance = where[0].rotation @ body.covariances[joint] @ where[0].rotation.T
            squared.append(error @ np.linalg.solve(covariance, error) / 3.0)
    # 120 draws of three squares have a deviation of 0.075
    assert 0.75 < np.mean(squared) < 1.25


def test_of_three_cameras_one_that_is_wrong_is_left_out() -> None:
    where = poses(-0.7, 0.0, 0.7)
    rig, points = rig_of(where, CAMERA), person(np.array([2.2, 0.0, 0.0]))
    views = seen(rig, where, points, 0.0, np.random.default_rng(2))
    views[1].pixels[Landmark.WRIST_LEFT] += [60.0, 0.0]
    body = triangulate(rig, [View(k, each) for k, each in enumerate(views)])
    error = in_world(body.positions, where)[Joint.WRIST_LEFT] - points[Landmark.WRIST_LEFT]
    assert np.linalg.norm(error) < 1e-3


def test_people_are_matched_across_cameras_whatever_their_order() -> None:
    where = poses(-0.5, 0.6)
    rig, rng = rig_of(where, CAMERA), np.random.default_rng(3)
    right = 0
    for _ in range(20):
        places = [np.array([2.2, y, 0.0]) + rng.uniform(-0.1, 0.1, 3) * [1.0, 1.0, 0.0] for y in (-0.6, 0.6)]
        both = [seen(rig, where, person(place), 1.0, rng) for place in places]
        groups = match(rig, [{4: both[0][0], 7: both[1][0]}, {1: both[1][1], 2: both[0][1]}])
        pairs = {tuple(id(view.landmarks) for view in sorted(group)) for group in groups}
        right += pairs == {(id(both[0][0]), id(both[0][1])), (id(both[1][0]), id(both[1][1]))}
    assert right == 20


def test_somebody_whom_one_camera_sees_alone_is_left_out() -> None:
    where = poses(-0.5, 0.6)
    rig, rng = rig_of(where, CAMERA), np.random.default_rng(4)
    one = seen(rig, where, person(np.array([2.2, -0.6, 0.0])), 1.0, rng)
    # who sits beside
    other = seen(rig, where, person(np.array([2.2, 0.6, -0.4])), 1.0, rng)
    assert match(rig, [{0: one[0]}, {}]) == []
    assert match(rig, [{0: one[0]}, {0: other[1]}]) == []


@pytest.mark.parametrize(("degrees", "named"), [(0.0, False), (2.0, True), (-4.0, True)])
def test_a_camera_that_was_turned_up_or_down_is_named(degrees: float, named: bool) -> None:
    """The lines of sight pass each other; with 4 degrees by so much that nobody is matched any more."""
    where = poses(-0.5, 0.6)
    turned = Rotation.from_euler("x", degrees, degrees=True)  # about the optical x axis
    there = SensorPose("camera2", where[1].translation, (Rotation.from_quat(where[1].quat_xyzw) * turned).as_quat())
    rig, actual, rng = rig_of(where, CAMERA), rig_of([where[0], there], CAMERA), np.random.default_rng(5)
    lines = SightLines()
    for _ in range(40):
        assert lines.problem() == "" or named
        points = person(np.array([2.2, 0.1, 0.0]) + rng.uniform(-0.2, 0.2, 3) * [1.0, 1.0, 0.0])
        one, other = seen(actual, [where[0], there], points, 1.0, rng)
        lines.add(rig, [{0: one}, {0: other}])
        lines.add(rig, [{0: one}, {}])
        lines.add(rig, [{0: one}, {0: other, 1: one}])  # who is whom is not known
    assert ("was a camera moved" in lines.problem()) == named


def test_numbers_stay_with_people_who_swap_their_order_or_are_gone_for_a_moment() -> None:
    numbers = PersonNumbers(2)
    left, right = person(np.array([2.0, -0.6, 0.0])), person(np.array([2.0, 0.6, 0.0]))
    assert numbers.of([left, right]) == [0, 1]
    assert numbers.of([right + 0.02, left - 0.02]) == [1, 0]
    assert numbers.of([left]) == [0]
    assert numbers.of([right, left]) == [1, 0]
    assert numbers.of([right + [3.0, 3.0, 0.0]]) == [2]


@cache
def recorded() -> tuple[dict[int, dict[str, Any]], dict[int, FloatArray]]:
    """Images by stamp and camera, and the true joints by stamp in the rig's frame."""
    images: dict[int, dict[str, Any]] = {}
    truth: dict[int, FloatArray] = {}
    topics = {DRIVERS["plain"].of(name).colour + COMPRESSED: name for name in ("camera1", "camera2")}
    with BagReader(ROOT / "bags" / SHIPPED_PAIR) as bag:
        for raw in bag.messages():
            if raw.topic in topics:
                stamp_ns, _, pixels = CompressedColour().decode(raw.cdr, BAG_WIRE)
                images.setdefault(stamp_ns, {})[topics[raw.topic]] = pixels
            elif raw.topic == graph.TRUE_SKELETON:
                (skeleton,) = decode_skeletons(raw.cdr) or ()
                truth[skeleton.stamp_ns] = skeleton.positions
            elif raw.topic == graph.TRUE_CALIBRATION:
                pose = transform_to_pose(deserialize(TRANSFORM, raw.cdr))
    return images, {stamp: (places - pose.translation) @ pose.rotation for stamp, places in truth.items()}


def stage(**values: Any) -> RigStage:
    return RigStage(check_all(RigStage.PARAMETERS, {"setup": str(SETUP), **values}))


def show(node: RigStage, stamp_ns: int, images: dict[str, Any]) -> list[Skeleton]:
    found: list[Skeleton] = []
    for name, pixels in images.items():
        topic = DRIVERS["plain"].of(name).colour
        for output in node.take(topic, (stamp_ns, name, pixels), Now(stamp_ns, stamp_ns)):
            found += output.payload
    return found


@pytest.mark.skipif(bool(MISSING), reason=REASON)
def test_the_joints_of_the_recorded_person_are_found_where_they_are() -> None:
    images, truth = recorded()
    assert sum(path.stat().st_size for path in (ROOT / "bags" / SHIPPED_PAIR).iterdir()) < 2e6
    node, errors, inside = stage(), [], []
    for stamp_ns in list(images)[::6]:
        (skeleton,) = show(node, stamp_ns, images[stamp_ns])
        assert skeleton.stamp_ns == stamp_ns and skeleton.frame_id == "camera_rig_optical_frame" and skeleton.body == 0
        assert skeleton.covariances is not None
        off = (skeleton.positions - truth[stamp_ns])[ARMS]
        errors.append(np.linalg.norm(off, axis=1))
        inside.append(np.einsum("ji,jik,jk->j", off, np.linalg.inv(skeleton.covariances[ARMS]), off) < 7.815)
    assert np.median(errors) < 0.05 and np.mean(inside) > 0.9
    assert node.state(0)[:2] == (0, "")


@pytest.mark.skipif(bool(MISSING), reason=REASON)
def test_a_camera_without_images_and_one_with_others_than_calibrated_are_named() -> None:
    images, _ = recorded()
    node, stamps = stage(), list(images)
    for stamp_ns in stamps[:12]:
        assert show(node, stamp_ns, {"camera1": images[stamp_ns]["camera1"]}) == []
        assert list(node.poll(stamp_ns + 1_000_000_000)) == []
    assert "camera2 lacks" in node.state(0)[1] and "nothing comes from it" in node.state(0)[1]
    other = stage()
    with pytest.raises(DepthError, match=r"^colour image of 240 x 180 .* the calibration of camera1"):
        show(other, stamps[0], {"camera1": images[stamps[0]]["camera1"][::2, ::2]})
    assert "camera1" in other.state(0)[1] and other.counters["camera1 images of another size"] == 1


@pytest.mark.skipif(bool(MISSING), reason=REASON)
def test_a_rig_is_needed_and_a_topic_for_each_camera(tmp_path: Path) -> None:
    with pytest.raises(SetupError, match=r"rig.yaml"):
        stage(setup=str(tmp_path))
    with pytest.raises(graph.GraphError, match="same of all cameras"):
        stage(colour_topic="/images")
    assert {port.topic for port in stage(driver="oak", compressed=True).inputs} == {
        f"/camera{number}/rgb/image_raw/compressed" for number in (1, 2)
    }
