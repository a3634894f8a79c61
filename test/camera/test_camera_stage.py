"""The stage of ``camera_skeleton`` on the shipped recording: people, and reports of unusable images."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from camera_recording import BAG, NAMES, recording

from body_tracking.camera.pose_model import PoseModel, PoseModelError
from body_tracking.camera.settings import PEOPLE
from body_tracking.camera.stage import CameraStage
from body_tracking.camera.topics import COMPRESSED, COMPRESSED_DEPTH, people_topic
from body_tracking.core.camera import Camera, CameraError
from body_tracking.core.parameters import Numbers, check_all
from body_tracking.core.skeleton import Joint, Skeleton, TrackingState
from body_tracking.core.sources import SensorNameError
from body_tracking.mesh.depth import DepthError
from body_tracking.node_parameters import parameters_for
from body_tracking.pipeline.graph import GraphError
from body_tracking.pipeline.stage import Now, Output
from body_tracking.simulation.camera_bags import SECONDS
from body_tracking.systems import nodes_for, options_of
from pose_networks import FOLDER, MISSING, REASON

networks = pytest.mark.skipif(bool(MISSING), reason=REASON)
SEEN = [Joint[f"{name}_{side}"] for side in ("LEFT", "RIGHT") for name in ("SHOULDER", "ELBOW", "WRIST", "KNEE")]


def stage(**values: Any) -> CameraStage:
    return CameraStage(check_all(CameraStage.PARAMETERS, {"camera": "camera1", **values}))


def now(stamp_ns: int) -> Now:
    return Now(stamp_ns, stamp_ns)


def calibrated(**values: Any) -> CameraStage:
    node = stage(**values)
    node.take(NAMES.colour_info, recording().colour_camera, now(0))
    node.take(NAMES.depth_info, recording().depth_camera, now(0))
    return node


def show(node: CameraStage, stamp_ns: int, colour: Any, depth: Any, at_ns: int | None = None) -> list[Skeleton]:
    """The skeletons of one pair of images, whose depth image has another stamp where one is given."""
    found: list[Output] = list(node.take(NAMES.colour, (stamp_ns, "camera1", colour), now(stamp_ns)))
    found += node.take(NAMES.depth, (at_ns or stamp_ns, "camera1", depth), now(at_ns or stamp_ns))
    return [skeleton for output in found for skeleton in output.payload]


def test_the_shipped_recording_is_small_and_whole() -> None:
    recorded = recording()
    assert sum(path.stat().st_size for path in BAG.iterdir()) < 3e6
    assert len(recorded.colour) == round(15 * SECONDS)
    assert recorded.colour.keys() == recorded.depth.keys() == recorded.joints.keys()


@networks
def test_the_joints_of_the_recorded_person_are_found_where_they_are() -> None:
    node, recorded = calibrated(), recording()
    errors, inside = [], []
    for stamp_ns in list(recorded.colour)[::8]:
        (skeleton,) = show(node, stamp_ns, recorded.colour[stamp_ns], recorded.depth[stamp_ns])
        assert skeleton.stamp_ns == stamp_ns and skeleton.frame_id == "camera1_optical_frame" and skeleton.body == 0
        assert skeleton.covariances is not None
        off = (skeleton.positions - recorded.joints[stamp_ns])[SEEN]
        errors.append(np.linalg.norm(off, axis=1))
        inverse = np.linalg.inv(skeleton.covariances[SEEN])
        inside.append(np.einsum("ji,jik,jk->j", off, inverse, off) < 7.815)
    assert np.nanmedian(errors) < 0.04 and np.nanmean(errors) < 0.06
    assert np.mean(inside) > 0.85
    assert node.counters["searches for people"] == 1  # then the person is followed
    assert node.state(0)[:2] == (0, "")


@networks
def test_nobody_is_found_in_an_empty_room_and_a_lost_person_is_searched_for_again() -> None:
    node, recorded = calibrated(), recording()
    stamps = list(recorded.colour)
    first = stamps[0]
    empty = np.full_like(recorded.colour[first], 170)
    assert show(node, first - 1_000_000_000, empty, recorded.depth[stamps[1]]) == []
    assert len(show(node, first, recorded.colour[first], recorded.depth[first])) == 1
    assert show(node, stamps[1], empty, recorded.depth[first]) == []
    assert node.counters["people lost"] == 1
    # at the next search, and as somebody else
    (again,) = show(node, stamps[8], recorded.colour[stamps[8]], recorded.depth[stamps[8]])
    assert again.body == 1


@networks
def test_images_within_the_tolerance_are_one_pair_and_others_are_counted() -> None:
    node, recorded = calibrated(), recording()
    stamps = list(recorded.colour)
    colour, depth = recorded.colour[stamps[0]], recorded.depth[stamps[0]]
    (skeleton,) = show(node, stamps[0], colour, depth, stamps[0] + 9_000_000)
    assert skeleton.stamp_ns == stamps[0]
    assert show(node, stamps[3], colour, depth, stamps[3] + 30_000_000) == []
    assert list(node.poll(stamps[3] + 1_000_000_000)) == []
    assert node.counters["images without the other one"] == 2


@networks
@pytest.mark.parametrize("frozen", ["colour", "depth"])
def test_images_that_repeat_are_not_used_and_named(frozen: str) -> None:
    node, recorded = calibrated(), recording()
    stamps, repeated = list(recorded.colour), []
    for stamp_ns in stamps[:8]:
        colour, depth = (
            getattr(recorded, kind)[stamps[0] if kind == frozen else stamp_ns] for kind in ("colour", "depth")
        )
        repeated.append(not show(node, stamp_ns, colour, depth))
    assert repeated == [stamp_ns - stamps[0] > 300_000_000 for stamp_ns in stamps[:8]]
    level, text, _ = node.state(0)
    assert level == 1 and text.startswith(f"the same {frozen} image again and again is not used")
    assert node.counters["repeated images of camera1"] == sum(repeated)
    assert show(node, stamps[8], recorded.colour[stamps[8]], recorded.depth[stamps[8]])
    assert node.state(0)[:2] == (0, "")


@networks
def test_a_picture_of_a_person_gives_no_skeleton_and_is_named() -> None:
    node, recorded = calibrated(), recording()
    stamp_ns = next(iter(recorded.colour))
    wall = np.full_like(recorded.depth[stamp_ns], 2.2)
    assert show(node, stamp_ns, recorded.colour[stamp_ns], wall) == []
    level, text, _ = node.state(0)
    assert level == 1 and "flat" in text and node.counters["pictures of people"] == 1


@networks
@pytest.mark.parametrize("virtual", [True, False])
def test_somebody_in_a_mirror_is_another_person_or_a_picture(virtual: bool) -> None:
    """Time-of-flight cameras see a mirrored person behind the mirror; other depth cameras see the mirror's surface."""
    node, recorded = calibrated(people=2), recording()
    stamp_ns = next(iter(recorded.colour))
    colour, depth = recorded.colour[stamp_ns], recorded.depth[stamp_ns]
    alone = show(node, stamp_ns, colour, depth)
    # the left third of the image is a mirror, in which the person is seen smaller
    height, width = colour.shape[:2]
    part = colour[:, width // 4 : width - width // 4, :][:, ::-1]
    small = cv2.resize(part, (width // 3, height * 2 // 3))
    mirrored = colour.copy()
    mirrored[height // 6 : height // 6 + len(small), : width // 3] = small
    rows, columns = depth.shape
    there = cv2.resize(depth[:, columns // 4 : columns - columns // 4][:, ::-1], (columns // 3, rows * 2 // 3))
    seen = depth.copy()
    region = seen[rows // 6 : rows // 6 + len(there), : columns // 3]
    region[:] = np.where(there > 0.0, there + 1.5, 0.0) if virtual else 2.6
    found = show(node, stamp_ns + 400_000_000, mirrored, seen)
    depths = sorted(float(np.nanmedian(each.positions[:, 2])) for each in found)
    assert depths[0] == pytest.approx(float(np.nanmedian(alone[0].positions[:, 2])), abs=0.05)
    assert len(depths) == 1 + virtual
    if virtual:
        assert depths[1] - depths[0] > 1.0
    else:
        assert node.counters["pictures of people"] == 1


@networks
def test_without_calibration_the_missing_topic_is_named() -> None:
    node, recorded = stage(), recording()
    stamp_ns = next(iter(recorded.colour))
    assert show(node, stamp_ns, recorded.colour[stamp_ns], recorded.depth[stamp_ns]) == []
    assert NAMES.colour_info in node.state(0)[1] and NAMES.depth_info in node.state(0)[1]
    node.take(NAMES.colour_info, recorded.colour_camera, now(0))
    node.take(NAMES.depth_info, recorded.depth_camera, now(0))
    assert node.state(0)[:2] == (0, "")


@networks
def test_depth_images_that_are_not_registered_are_refused_without_the_pose_of_their_camera() -> None:
    recorded = recording()
    one = recorded.depth_camera
    other = Camera(one.frame_id, one.width, one.height, one.matrix * [[1.2], [1.2], [1.0]], one.distortion)
    node = stage()
    node.take(NAMES.colour_info, recorded.colour_camera, now(0))
    with pytest.raises(CameraError, match="not registered"):
        node.take(NAMES.depth_info, other, now(0))
    assert "depth_pose" in node.state(0)[1]
    posed = stage(depth_pose=[0.02, 0, 0, 0, 0, 0, 1.0])
    posed.take(NAMES.colour_info, recorded.colour_camera, now(0))
    posed.take(NAMES.depth_info, other, now(0))
    assert posed.state(0)[:2] == (0, "")
    for wrong in ([0.02, 0, 0, 0, 0, 0, 0], [0.02, 0, 0, 0, 0, 0, 0.1]):
        with pytest.raises(GraphError, match="depth_pose"):
            stage(depth_pose=wrong)


@networks
def test_images_of_another_size_are_named_and_a_covered_lens() -> None:
    node, recorded = calibrated(), recording()
    stamps = list(recorded.colour)
    colour, depth = recorded.colour[stamps[0]], recorded.depth[stamps[0]]
    with pytest.raises(DepthError, match=r"^colour image of 240 x 180"):
        show(node, stamps[0], colour[::2, ::2], depth)
    assert node.counters["colour images of another size"] == 1
    assert show(node, stamps[1], colour, np.zeros_like(depth)) == []
    assert "covered" in node.state(0)[1]
    assert len(show(node, stamps[9], recorded.colour[stamps[9]], recorded.depth[stamps[9]])) == 1
    assert node.state(0)[:2] == (0, "")


@networks
def test_a_jump_back_forgets_the_people() -> None:
    node, recorded = calibrated(), recording()
    stamps = list(recorded.colour)
    for stamp_ns in stamps[:2]:
        show(node, stamp_ns, recorded.colour[stamp_ns], recorded.depth[stamp_ns])
    node.reset(NAMES.colour)
    assert len(show(node, stamps[0], recorded.colour[stamps[0]], recorded.depth[stamps[0]])) == 1
    assert node.counters["searches for people"] == 2


@networks
def test_pictures_are_published_at_their_rate_while_somebody_looks() -> None:
    recorded, wanted = recording(), set[str]()
    values = check_all(CameraStage.PARAMETERS, {"camera": "camera1", "picture_rate": 5.0})
    node = CameraStage(values, lambda topic: topic in wanted)
    node.take(NAMES.colour_info, recorded.colour_camera, now(0))
    node.take(NAMES.depth_info, recorded.depth_camera, now(0))
    stamps, pictures = list(recorded.colour)[:9], []
    for round_ in range(2):
        for stamp_ns in stamps:
            at_ns = stamp_ns + round_ * 1_000_000_000
            node.take(NAMES.colour, (at_ns, "camera1", recorded.colour[stamp_ns]), now(at_ns))
            found = node.take(NAMES.depth, (at_ns, "camera1", recorded.depth[stamp_ns]), now(at_ns))
            pictures += [output for output in found if output.topic == people_topic("camera1")]
        assert len(pictures) == 3 * round_
        wanted.add(people_topic("camera1"))
    changed = pictures[0].payload[2] != recorded.colour[stamps[0]]
    assert 0.001 < changed.any(axis=2).mean() < 0.1  # a skeleton is drawn in
    assert not any(port.topic == people_topic("camera1") for port in stage().outputs)


@networks
def test_topics_follow_driver_compression_and_the_lab() -> None:
    def topics(**values: Any) -> set[str]:
        return {port.topic for port in stage(**values).inputs}

    assert topics() == {NAMES.colour, NAMES.depth, NAMES.colour_info, NAMES.depth_info}
    assert "/camera/camera1/aligned_depth_to_color/image_raw" in topics(driver="realsense")
    assert NAMES.colour + COMPRESSED in topics(compressed="both")
    assert NAMES.depth + COMPRESSED_DEPTH in topics(compressed="both")
    own = topics(colour_topic="/lab/{camera}/rgb", driver="oak")
    assert "/lab/camera1/rgb" in own and "/camera1/stereo/camera_info" in own


@networks
@pytest.mark.parametrize("name", ["", "1st"])
def test_invalid_names_are_refused(name: str) -> None:
    with pytest.raises(SensorNameError, match="name"):
        stage(camera=name)


def test_each_camera_has_a_node_with_parameters_of_its_own(tmp_path: Path) -> None:
    file = tmp_path / "cameras.yaml"
    file.write_text(
        "/**: {ros__parameters: {search_every: 1.0}}\n"
        "camera2_skeleton: {ros__parameters: {driver: orbbec, depth_pose: [0.1, 0, 0, 0, 0, 0, 1]}}\n"
    )
    found = parameters_for(nodes_for(options_of(camera=("camera1", "camera2"))), file)
    drivers = [found[f"{name}_skeleton"].get("driver", "plain") for name in ("camera1", "camera2")]
    assert drivers == ["plain", "orbbec"]
    assert found["camera2_skeleton"]["depth_pose"] == Numbers((0.1, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0))
    assert "depth_pose" not in found["camera1_skeleton"]
    assert all(found[f"{name}_skeleton"]["search_every"] == 1.0 for name in ("camera1", "camera2"))


def test_cameras_look_for_as_many_people_as_the_graph_tracks() -> None:
    def people(**options: Any) -> set[Any]:
        given = options_of(camera=("camera1", "camera2"), **options)
        return {spec.defaults.get("people") for spec in nodes_for(given) if spec.executable == "camera_skeleton"}

    assert people() == {None} and people(people=3) == {None}
    assert people(subject="all", people=3) == {3}
    assert people(subject="all") == people(subject="all", people=16) == {PEOPLE.max}


def test_missing_and_foreign_networks_are_named(tmp_path: Path) -> None:
    pytest.importorskip("ai_edge_litert", reason="pip install ai-edge-litert")
    with pytest.raises(PoseModelError, match=r"no file .*pose_detection.tflite: `body_tracking camera model`"):
        PoseModel(tmp_path)
    (tmp_path / "pose_detection.tflite").write_bytes(b"no network")
    with pytest.raises(PoseModelError, match=r"pose_detection.tflite"):
        PoseModel(tmp_path)


@networks
def test_networks_load_without_a_line_on_the_terminal(capfd: pytest.CaptureFixture[str]) -> None:
    PoseModel(FOLDER)
    assert capfd.readouterr() == ("", "")


@networks
def test_states_follow_visibility() -> None:
    node, recorded = calibrated(), recording()
    stamp_ns = next(iter(recorded.colour))
    # the lower half of the person is outside of the image
    colour, depth = recorded.colour[stamp_ns], recorded.depth[stamp_ns]
    down = np.full_like(colour, 170)
    down[150:] = colour[:-150]
    low = np.zeros_like(depth)
    low[75:] = depth[:-75]
    (skeleton,) = show(node, stamp_ns, down, low)
    assert (skeleton.states[SEEN[:2]] == TrackingState.TRACKED).all()
    assert skeleton.states[Joint.ANKLE_LEFT] == TrackingState.NOT_TRACKED


def test_errors_of_neighbouring_joints_are_independent_where_cameras_are_alone() -> None:
    """And less correlated than a Kinect's where meshes are; ``ekf`` is told only of cameras."""

    def given(**options: tuple[str, ...]) -> tuple[object, object]:
        specs = {spec.name: spec for spec in nodes_for(options_of(**options))}
        names = ("joint_angles", "bone_correlation"), ("skeleton_filter", "ekf.bone_correlation")
        angles, model = (specs[node].defaults.get(name, "as of Kinects") for node, name in names)
        return angles, model

    assert given(camera=("camera1", "camera2")) == (0.0, 0.0)
    assert given(depth=("kinect1",)) == (0.77, "as of Kinects")
    assert given(sensors=("kinect1",), camera=("camera1",)) == ("as of Kinects", "as of Kinects")
