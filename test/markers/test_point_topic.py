"""Points that another motion capture system publishes: clouds and markers in, the marker system's points out."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from body_tracking import systems
from body_tracking.core.message_types import MARKERS, POINT_CLOUD
from body_tracking.core.parameters import check_all
from body_tracking.core.skeleton import NANOSECONDS
from body_tracking.markers import setup
from body_tracking.markers.codecs import SpacePoints
from body_tracking.markers.observations import Points
from body_tracking.markers.point_topic import PointTopicStage
from body_tracking.messages.base import to_header
from body_tracking.messages.clouds import COVARIANCE, POSITION, make_cloud, record_of
from body_tracking.pipeline import graph
from body_tracking.pipeline.offline import OfflineRunner
from body_tracking.recording.rosbag2 import BAG_MESSAGES, BAG_WIRE

TOPIC, STAMP_NS, ARRIVED_NS = "/mocap/points", 7 * NANOSECONDS, 8 * NANOSECONDS
PLACES = np.array([[0.5, -1.0, 2.0], [1.5, 0.25, -0.5], [-3.0, 0.0, 1.0]])
SPHERE, TEXT, SPHERES, ADD, DELETE_ALL = 2, 9, 7, 0, 3
NAN = float("nan")


def through(
    kind: str, type_name: str, *messages: Any, noise: float = 1e-3
) -> tuple[list[Points], PointTopicStage, int]:
    """The stage's outputs for messages, the stage, and the number of messages that it could not read."""
    stage = PointTopicStage(check_all(PointTopicStage.PARAMETERS, {"topic": TOPIC, "message": kind, "noise": noise}))
    found: list[Points] = []
    runner = OfflineRunner([stage], BAG_WIRE, lambda topic, cdr, at: found.append(SpacePoints().decode(cdr, BAG_WIRE)))
    assert stage.outputs[0].topic == setup.POINTS
    for message in messages:
        runner.push(TOPIC, BAG_WIRE.serialize(type_name, message), ARRIVED_NS)
    return found, stage, sum(runner.counters.values())


def cloud(positions: Any, covariance: tuple[float, ...] = (), stamp_ns: int = STAMP_NS, names: Any = COVARIANCE) -> Any:
    fields = POSITION + (names if covariance else ())
    rows = np.zeros(len(positions), dtype=record_of(fields))
    rows["x"], rows["y"], rows["z"] = np.asarray(positions).reshape(-1, 3).T
    for (name, _), value in zip(fields[3:], covariance, strict=False):
        rows[name] = value
    return make_cloud(rows, fields, stamp_ns, "vicon", BAG_MESSAGES)


def marker(kind: int, place: Any = (0.0, 0.0, 0.0), points: Any = (), action: int = ADD, **more: Any) -> Any:
    def point(values: Any) -> Any:
        return BAG_MESSAGES.make("geometry_msgs/msg/Point", **dict(zip("xyz", map(float, values), strict=True)))

    def numbers(type_name: str, names: str, *values: float) -> Any:
        return BAG_MESSAGES.make(type_name, **dict(zip(names, values, strict=True)))

    turned = more.get("turned", 0.0)
    quat = numbers("geometry_msgs/msg/Quaternion", "xyzw", 0.0, 0.0, turned, 1.0)
    duration = BAG_MESSAGES.make("builtin_interfaces/msg/Duration", sec=0, nanosec=0)
    image = BAG_MESSAGES.make(
        "sensor_msgs/msg/CompressedImage",
        header=to_header(0, "", BAG_MESSAGES),
        format="",
        data=np.zeros(0, np.uint8),
    )
    return BAG_MESSAGES.make(
        "visualization_msgs/msg/Marker",
        header=to_header(more.get("stamp_ns", STAMP_NS), more.get("frame", "vicon"), BAG_MESSAGES),
        ns="",
        id=1,
        type=kind,
        action=action,
        pose=BAG_MESSAGES.make("geometry_msgs/msg/Pose", position=point(place), orientation=quat),
        scale=numbers("geometry_msgs/msg/Vector3", "xyz", 0.01, 0.01, 0.01),
        color=numbers("std_msgs/msg/ColorRGBA", "rgba", 1.0, 1.0, 1.0, 1.0),
        lifetime=duration,
        frame_locked=False,
        points=[point(each) for each in points],
        colors=[],
        texture_resource="",
        texture=image,
        uv_coordinates=[],
        text="",
        mesh_resource="",
        mesh_file=BAG_MESSAGES.make("visualization_msgs/msg/MeshFile", filename="", data=np.zeros(0, np.uint8)),
        mesh_use_embedded_materials=False,
    )


def array(*markers: Any) -> Any:
    return BAG_MESSAGES.make(MARKERS, markers=list(markers))


def test_a_cloud_without_covariance_gets_the_stated_noise() -> None:
    (points,), stage, refused = through("PointCloud2", POINT_CLOUD, cloud(PLACES))
    np.testing.assert_allclose(points.positions, PLACES)
    np.testing.assert_allclose(points.covariance, np.tile(1e-6 * np.eye(3), (3, 1, 1)), rtol=1e-6)
    assert (points.stamp_ns, points.frame_id, refused, stage.state(0)[0]) == (STAMP_NS, "vicon", 0, 0)


def test_a_clouds_own_covariance_is_kept() -> None:
    (points,), _, _ = through("PointCloud2", POINT_CLOUD, cloud(PLACES, (4e-6, 1e-6, 0.0, 3e-6, 0.0, 5e-6)))
    np.testing.assert_allclose(points.covariance[1], [[4e-6, 1e-6, 0], [1e-6, 3e-6, 0], [0, 0, 5e-6]], rtol=1e-6)


@pytest.mark.parametrize(
    "message",
    [
        array(*(marker(SPHERE, place) for place in PLACES)),
        array(marker(SPHERES, points=PLACES)),
        array(marker(SPHERES, PLACES[0], points=PLACES - PLACES[0])),
        array(marker(TEXT, (9.0, 9.0, 9.0)), marker(SPHERE, action=DELETE_ALL), marker(SPHERES, points=PLACES)),
        array(marker(SPHERE, PLACES[0]), marker(SPHERES, points=PLACES[1:])),
    ],
    ids=["a sphere each", "a list", "a list with a pose", "with texts and deletions", "both"],
)
def test_markers_in_every_form_are_the_same_points(message: Any) -> None:
    (points,), _, refused = through("MarkerArray", MARKERS, message)
    np.testing.assert_allclose(points.positions, PLACES, atol=1e-6)
    assert (points.stamp_ns, points.frame_id, refused) == (STAMP_NS, "vicon", 0)


def test_what_is_no_point_is_left_out_and_counted() -> None:
    bad = [*PLACES, (NAN, 0.0, 0.0), (0.0, 1e6, 0.0)]
    found, stage, refused = through("PointCloud2", POINT_CLOUD, cloud(bad), cloud([(NAN, NAN, NAN)]), cloud([]))
    assert [len(points.positions) for points in found] == [3, 0, 0]
    assert {name: count for name, count in stage.counters.items() if count} == {
        "frames": 3,
        "points that are not finite": 2,
        "points farther away than 100 m: is the unit of length right?": 1,
        "frames without a point": 2,
    }
    assert not refused


def test_a_message_without_a_stamp_has_the_time_of_its_arrival() -> None:
    (points,), stage, _ = through("PointCloud2", POINT_CLOUD, cloud(PLACES, stamp_ns=0))
    assert points.stamp_ns == ARRIVED_NS and stage.counters["messages without a stamp"] == 1


def test_messages_that_contradict_themselves_are_refused_and_survived() -> None:
    wrong = [
        cloud(PLACES, (1e-6, 2e-6, 0.0, 1e-6, 0.0, 1e-6)),
        cloud(PLACES, (NAN, 0.0, 0.0, 1e-6, 0.0, 1e-6)),
        cloud(PLACES, (1e-6,), names=COVARIANCE[:1]),
        replace(cloud(PLACES), fields=[]),
    ]
    found, _, refused = through("PointCloud2", POINT_CLOUD, *wrong, cloud(PLACES))
    assert (len(found), refused) == (1, len(wrong))
    wrong = [
        array(marker(SPHERE), marker(SPHERE, stamp_ns=1)),
        array(marker(SPHERE), marker(SPHERE, frame="other")),
        array(marker(SPHERES, points=PLACES, turned=0.1)),
        array(marker(SPHERES, points=np.zeros((10_001, 3)))),
    ]
    found, _, refused = through("MarkerArray", MARKERS, *wrong, array(), array(marker(SPHERES, points=PLACES)))
    assert ([len(points.positions) for points in found], refused) == ([0, 3], len(wrong))


def test_the_option_replaces_the_cameras() -> None:
    given = {"sensors": (), "marker_setup": "lab"}
    options = systems.options_of(**given, marker_points="/mocap/points:MarkerArray")
    specs = {spec.name: spec for spec in systems.nodes_for(options)}
    assert specs.keys() == {"marker_points", "rigid_body_tracker", "marker_joint_angles"}
    assert specs["marker_points"].parameters["message"] == "MarkerArray"
    assert systems.played(options, ["/mocap/points"]) == ("/mocap/points",)
    assert "marker_detector" in {spec.name for spec in systems.all_nodes_for(options)}
    for name, detects in (("image_raw", True), ("balls", False)):
        recorded = systems.options_of(**given, bag="bag", played=(f"/left/{name}", f"/right/{name}"))
        assert ("marker_detector" in {spec.name for spec in systems.nodes_for(recorded)}) == detects
    for wrong in ({**given, "marker_points": "a:Odometry"}, {"marker_points": "a"}):
        with pytest.raises(graph.GraphError, match="marker points: "):
            systems.nodes_for(systems.options_of(**wrong))
    with pytest.raises(graph.GraphError, match="no topic /mocap/points; it has /other"):
        systems.played(options, ["/other"])
