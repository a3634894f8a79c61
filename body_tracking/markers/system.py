"""The marker system: infrared cameras that see retro-reflective balls on rigid targets."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from pathlib import Path

from body_tracking.core.message_types import IMAGE, POINT_CLOUD, TF
from body_tracking.core.qos import LATCHED, RELIABLE, Qos
from body_tracking.markers import setup
from body_tracking.pipeline import graph
from body_tracking.pipeline.system import (
    Command,
    NodeSpec,
    NodeType,
    Option,
    Options,
    Place,
    System,
    TopicSpec,
    View,
    transport,
)

FOREIGN_TYPES = ("PointCloud2", "MarkerArray")
"""Message types of another system's points."""
_STAGES = "body_tracking.markers.stages"


def _specs(options: Options) -> Iterable[NodeSpec]:
    foreign = _foreign(options) if options["marker_points"] else None
    if options["marker_setup"]:
        sent = transport(options)
        given = {"setup": options["marker_setup"], **sent}
        if foreign is not None:
            topic, message = foreign
            yield NodeSpec("marker_points", "marker_points", parameters={"topic": topic, "message": message, **sent})
        elif setup.POINTS not in _played_topics(options):
            if options["marker_images"] and not options["bag"]:
                yield NodeSpec(
                    "marker_cameras",
                    "marker_cameras",
                    parameters={"setup": options["marker_setup"], "images": options["marker_images"]},
                )
            if not any(topic.endswith("/balls") for topic in _played_topics(options)):
                yield NodeSpec("marker_detector", "marker_detector", parameters=given)
            yield NodeSpec("marker_triangulation", "marker_triangulation", parameters=given)
        yield NodeSpec("rigid_body_tracker", "rigid_body_tracker", parameters=given)
        yield NodeSpec("marker_joint_angles", "marker_joint_angles", parameters=given)


def _foreign(options: Options) -> tuple[str, str]:
    """Topic and type of another system's points.

    Raises:
        GraphError: no setup, or an unknown type.
    """
    topic, _, message = str(options["marker_points"]).partition(":")
    if not options["marker_setup"]:
        raise graph.GraphError("marker points: the targets are missing; give a marker setup, too")
    if message not in ("", *FOREIGN_TYPES):
        raise graph.GraphError(f"marker points: {message!r}, expected one of {', '.join(FOREIGN_TYPES)}")
    return topic, message or FOREIGN_TYPES[0]


def _played_topics(options: Options) -> tuple[str, ...]:
    played = options["played"]
    return played if isinstance(played, tuple) else ()


def _played(options: Options, topics: Collection[str]) -> tuple[str, ...]:
    if not options["marker_setup"]:
        return ()
    if options["marker_points"]:
        topic = f"/{_foreign(options)[0].lstrip('/')}"
        if topic not in topics:
            raise graph.GraphError(f"no topic {topic}; {graph.listed(topics)}")
        return (topic,)
    sources = setup.sources_in(Path(str(options["marker_setup"])))
    for source in sources:
        if all(topic in topics for topic in source):
            return source
    wanted = " or ".join(source[0] for source in sources)
    raise graph.GraphError(f"no topic {wanted}; {graph.listed(topics)}")


SYSTEM = System(
    "markers",
    heading="infrared markers",
    order=1,
    nodes=(
        NodeType(
            "marker_cameras",
            Place.SOURCE,
            "body_tracking.markers.camera_images:CameraImagesStage",
            basic=("rate", "loop"),
        ),
        NodeType("marker_points", Place.SENSING, "body_tracking.markers.point_topic:PointTopicStage", basic=("noise",)),
        NodeType("marker_detector", Place.SENSING, f"{_STAGES}:DetectorStage", basic=("cameras",)),
        NodeType("marker_triangulation", Place.SENSING, f"{_STAGES}:TriangulationStage", basic=("diameter",)),
        NodeType("rigid_body_tracker", Place.SENSING, f"{_STAGES}:TrackerStage"),
        NodeType("marker_joint_angles", Place.ANGLES, f"{_STAGES}:AnglesOfTargetsStage"),
    ),
    specs=_specs,
    played=_played,
    options=(
        Option(
            "marker_setup",
            "",
            "track infrared markers with the rig.yaml, targets.yaml and chain.yaml in this folder (without rig.yaml "
            "if another motion capture system measures the points)",
            "FOLDER",
            path=True,
            example="setup",
            offline=True,
            source=True,
        ),
        Option(
            "marker_images",
            "",
            "take the images from these topics of drivers, one per camera, in place of /<camera>/image_raw; or from "
            "folder:PATH, a folder of files per camera; or render the simulated arm of config/marker_setup",
            "TOPIC,TOPIC",
            example="render",
        ),
        Option(
            "marker_points",
            "",
            "take the points of another motion capture system from this topic, in place of cameras; TYPE is "
            f"{' (default) or '.join(FOREIGN_TYPES)}",
            "TOPIC[:TYPE]",
            example="/mocap/points",
            offline=True,
        ),
    ),
    topics=(
        TopicSpec(
            setup.image_topic("<camera>"),
            IMAGE,
            Qos(reliability="reliable", depth=10),
            "marker_cameras",
            "sets of images with equal stamps, `mono8` or `mono16`; a driver may publish them instead",
        ),
        TopicSpec(
            setup.info_topic("<camera>"),
            "sensor_msgs/msg/CameraInfo",
            LATCHED,
            "marker_cameras",
            "the calibration of the camera, from the setup",
        ),
        TopicSpec(
            setup.balls_topic("<camera>"),
            POINT_CLOUD,
            RELIABLE,
            "marker_detector",
            "the balls in an image of `/<camera>/image_raw` (`mono8` or `mono16`): `u v` in pixels, `area`, and "
            "`uu uv vv`, their covariance",
        ),
        TopicSpec(
            setup.POINTS,
            POINT_CLOUD,
            RELIABLE,
            "marker_triangulation",
            "the balls in space, in the frame of the rig's first camera, with covariance, and `ball0`, `ball1`, ...: "
            "which ball of each camera it is",
        ),
        TopicSpec(
            setup.pose_topic("<target>"),
            "geometry_msgs/msg/PoseWithCovarianceStamped",
            RELIABLE,
            "rigid_body_tracker",
            "the pose of a target, in the same frame",
        ),
        TopicSpec(
            graph.TF,
            TF,
            RELIABLE,
            "rigid_body_tracker",
            "the targets in the frame of the rig's first camera, where tf2_msgs is installed",
        ),
        TopicSpec(
            graph.TF_STATIC,
            TF,
            LATCHED,
            "marker_triangulation",
            "the other cameras in the same frame, where tf2_msgs is installed",
        ),
    ),
    prepare="body_tracking.markers.stages:prepare",
    views=(View("marker_setup", "body_tracking.viewing.marker_view:MarkerView"),),
    commands=(
        Command("markers", "body_tracking.recording.marker_commands", "calibrate and use infrared cameras and markers"),
    ),
)
