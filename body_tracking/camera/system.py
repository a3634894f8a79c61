"""The camera system: skeletons of people in the images of colour-and-depth cameras that one can buy."""

from __future__ import annotations

from collections.abc import Collection, Iterable

from body_tracking.camera.topics import COMPRESSION, DRIVERS, CameraTopics, images_of
from body_tracking.core.message_types import POINT_CLOUD
from body_tracking.core.parameters import Value
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
    asked,
    transport,
)


def _cameras(options: Options) -> tuple[str, ...]:
    given = options["camera"]
    return given if isinstance(given, tuple) else ()


def _topics(options: Options, camera: str) -> CameraTopics:
    # in a recording the topics have the names of the driver that it was made with
    return DRIVERS[str(options["driver"] or "plain")].of(camera)


def _specs(options: Options) -> Iterable[NodeSpec]:
    if _cameras(options):
        chosen = asked(options, driver="driver", model="pose_model", compressed="compressed")
        given: dict[str, Value] = {"cameras": _cameras(options), **chosen}
        yield NodeSpec("camera_skeleton", "camera_skeleton", parameters={**given, **transport(options)})


def _played(options: Options, topics: Collection[str]) -> tuple[str, ...]:
    wanted: list[str] = []
    for camera in _cameras(options):
        each = _topics(options, camera)
        wanted += [each.colour_info, each.depth_info, *images_of(each, str(options["compressed"] or "none"))]
    for topic in wanted:
        if topic not in topics:
            raise graph.GraphError(f"no topic {topic}")
    return tuple(wanted)


SYSTEM = System(
    "camera",
    order=1,
    nodes=(NodeType("camera_skeleton", Place.IMAGES, "body_tracking.camera.stage:CameraStage"),),
    specs=_specs,
    played=_played,
    computes=_cameras,
    options=(
        Option(
            "camera",
            (),
            "find people in the colour images of this camera, and their depth in its depth images",
            "SENSOR",
            example=("camera1",),
            offline=True,
            source=True,
        ),
        Option(
            "driver",
            "",
            "the ROS driver of --camera, which says on which topics it publishes (default: plain, "
            "/<sensor>/color/image_raw and /<sensor>/depth/image_raw)",
            choices=lambda: tuple(DRIVERS),
            parameter=("camera_skeleton", "driver"),
            offline=True,
        ),
        Option(
            "compressed",
            "",
            "which images of --camera come compressed by image_transport (default: none)",
            choices=lambda: COMPRESSION,
            parameter=("camera_skeleton", "compressed"),
            offline=True,
        ),
        Option(
            "pose_model",
            "",
            "folder of the networks for --camera (`body_tracking camera model` fetches them)",
            "FOLDER",
            path=True,
            parameter=("camera_skeleton", "model"),
            offline=True,
        ),
    ),
    topics=(
        TopicSpec(
            graph.skeleton_topic("<camera>"),
            POINT_CLOUD,
            graph.SKELETON,
            "camera_skeleton",
            "the joints of people in `<camera>_optical_frame`, those of the colour camera, with covariance as "
            "`/fused/skeleton`; joints that are hidden are inferred, those outside the image not tracked",
        ),
    ),
    commands=(
        Command("camera", "body_tracking.recording.camera_commands", "fetch the networks, and draw what they find"),
    ),
    prepare="body_tracking.camera.registration:prepare",
)
