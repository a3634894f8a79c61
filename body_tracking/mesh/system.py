"""The mesh system: a body mesh fitted to the images of depth cameras."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping

from body_tracking.core.message_types import IMAGE, POINT_CLOUD
from body_tracking.core.parameters import Value
from body_tracking.core.qos import RELIABLE
from body_tracking.mesh.topics import (
    body_index_topic,
    depth_topic,
    info_topic,
    mesh_sensor,
    mesh_topic,
    personalise_service,
)
from body_tracking.pipeline import graph
from body_tracking.pipeline.system import (
    Command,
    NodeSpec,
    NodeType,
    Option,
    Options,
    Place,
    Service,
    System,
    TopicSpec,
    View,
    asked,
    transport,
)


def _cameras(options: Options) -> tuple[str, ...]:
    given = options["depth"]
    return given if isinstance(given, tuple) else ()


def _specs(options: Options) -> Iterable[NodeSpec]:
    own = asked(options, person="person") | transport(options)
    for camera in _cameras(options):
        yield NodeSpec(
            mesh_sensor(camera),
            "mesh_tracker",
            defaults=_orientations(options),
            parameters={"camera": camera, **own},
        )


def _orientations(options: Options) -> dict[str, Value]:
    """Default of ``orientations``: the arm segments with inertial sensors."""
    imus = options["imus"]
    worn = graph.imu_topics(imus if isinstance(imus, tuple) else ())
    segments = tuple(each.segment for each in worn if each.segment in graph.ARM_SEGMENTS)
    return {"orientations": segments} if segments else {}


def _finds(topics: Mapping[str, str]) -> dict[str, Value]:
    """Depth cameras without colour, unless other cameras publish skeletons."""
    cameras = (topic.removeprefix("/").removesuffix(depth_topic("").removeprefix("/")) for topic in sorted(topics))
    found = tuple(
        each
        for each in cameras
        if "/" not in each
        and topics.get(depth_topic(each)) == IMAGE
        and not {f"/{each}/color/image_raw", f"/{each}/color/image_raw/compressed"} & topics.keys()
    )
    return {"depth": found} if found and not graph.sensors_among(topics) else {}


def _played(options: Options, topics: Collection[str]) -> tuple[str, ...]:
    wanted = tuple(topic(camera) for camera in _cameras(options) for topic in (info_topic, depth_topic))
    for topic in wanted:
        if topic not in topics:
            there = sorted(
                camera for camera in {each.split("/")[1] for each in topics} if depth_topic(camera) in topics
            )
            has = f"its depth cameras are {', '.join(there)}" if there else graph.listed(topics)
            raise graph.GraphError(f"no topic {topic}; {has}")
    return (*wanted, *(topic for topic in map(body_index_topic, _cameras(options)) if topic in topics))


SYSTEM = System(
    "mesh",
    heading="depth cameras",
    order=1,
    nodes=(NodeType("mesh_tracker", Place.IMAGES, "body_tracking.mesh.stage:MeshStage", basic=("person",)),),
    specs=_specs,
    played=_played,
    finds=_finds,
    computes=lambda options: tuple(map(mesh_sensor, _cameras(options))),
    options=(
        Option(
            "depth",
            (),
            "fit the mesh of a body to the images of this depth camera, /<sensor>/depth/image_raw; the skeletons are "
            "published as those of a sensor SENSOR_mesh",
            "SENSOR",
            example=("kinect1",),
            offline=True,
            source=True,
        ),
        Option(
            "person",
            "",
            "YAML file with the shape of the person's body for --depth; written after a personalisation if it does "
            "not exist",
            "FILE",
            path=True,
            offline=True,
        ),
    ),
    topics=(
        TopicSpec(
            graph.skeleton_topic(mesh_sensor("<sensor>")),
            POINT_CLOUD,
            graph.SKELETON,
            "mesh_tracker",
            "the joints (centres of rotation) of the fitted body in `<sensor>_mesh_optical_frame`, with covariance as "
            "`/fused/skeleton`; joints that the image does not show are inferred",
        ),
        TopicSpec(
            mesh_topic("<sensor>"),
            "visualization_msgs/msg/Marker",
            RELIABLE,
            "mesh_tracker",
            "the fitted mesh, a list of triangles in the same frame; only while there is a subscriber",
        ),
    ),
    services=(
        Service(
            personalise_service("<sensor>"),
            "mesh_tracker",
            "estimate the shape of the person's body anew from the next different poses",
        ),
    ),
    commands=(
        Command("mesh", "body_tracking.recording.mesh_commands", "the shape of a person, and pictures of the mesh"),
    ),
    views=(View("depth", "body_tracking.viewing.mesh_view:MeshView"),),
    prepare="body_tracking.mesh.tracking:prepare",
)
