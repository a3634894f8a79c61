"""The camera system: skeletons of people in the images of colour-and-depth cameras that one can buy."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from pathlib import Path

from body_tracking.camera.topics import (
    COMPRESSED,
    COMPRESSED_DEPTH,
    COMPRESSION,
    DRIVERS,
    RIG_SENSOR,
    CameraTopics,
    images_of,
    people_topic,
)
from body_tracking.core.message_types import COMPRESSED_IMAGE, IMAGE, POINT_CLOUD
from body_tracking.core.parameters import Value
from body_tracking.core.qos import RELIABLE
from body_tracking.markers.setup import camera_names
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
    asked,
    transport,
)


def _cameras(options: Options) -> tuple[str, ...]:
    given = options["camera"]
    return given if isinstance(given, tuple) else ()


def _topics(options: Options, camera: str) -> CameraTopics:
    # in a recording the topics have the names of the driver that it was made with
    return DRIVERS[str(options["driver"] or "plain")].of(camera)


def _finds(topics: Mapping[str, str]) -> dict[str, Value]:
    """Colour-and-depth cameras of one driver, unless other cameras publish skeletons."""
    if graph.sensors_among(topics):
        return {}
    for driver, each in DRIVERS.items():
        before, _, after = each.colour.partition("{camera}")
        found = []
        for topic in sorted(topics):
            camera = topic.removeprefix(before).removesuffix(after)
            own = each.of(camera)
            if "/" not in camera and topic == own.colour and topics[topic] == IMAGE and own.depth in topics:
                found.append(camera)
        if found:
            return {"camera": tuple(found), **({} if driver == "plain" else {"driver": driver})}
    return {}


def _finds_compressed(topics: Mapping[str, str]) -> dict[str, Value]:
    """As :func:`_finds`, for cameras with only compressed colour images, as in a recording."""
    plain = {
        topic.removesuffix(COMPRESSED): IMAGE if kind == COMPRESSED_IMAGE else kind for topic, kind in topics.items()
    }
    found = _finds(plain)
    return {**found, "compressed": "colour"} if found else {}


_MOST_PEOPLE = 6
"""Largest value of the parameter ``people`` of the nodes here."""


def _defaults(options: Options) -> dict[str, Value]:
    """Pictures for the viewer's page, and as many people as the graph tracks."""
    found: dict[str, Value] = {"picture_rate": 5.0} if options["viewer"] else {}
    if options["subject"] == "all":
        found["people"] = min(int(str(options["people"])) or _MOST_PEOPLE, _MOST_PEOPLE)
    return found


def _specs(options: Options) -> Iterable[NodeSpec]:
    if options["camera_rig"]:
        rig: dict[str, Value] = {**asked(options, setup="camera_rig", driver="driver", model="pose_model")}
        if options["compressed"] in ("colour", "both"):
            rig["compressed"] = True
        rig |= transport(options)
        yield NodeSpec("camera_rig", "camera_rig", defaults=_defaults(options), parameters=rig)
    own = asked(options, driver="driver", model="pose_model", compressed="compressed") | transport(options)
    for camera in _cameras(options):
        yield NodeSpec(
            f"{camera}_skeleton",
            "camera_skeleton",
            defaults=_defaults(options),
            parameters={"camera": camera, **own},
        )


def _instead(topic: str, topics: Collection[str]) -> str:
    """What a recording has in place of a camera's topic, for an error."""
    camera = topic.split("/")[1]
    own = sorted(each for each in topics if each.startswith(f"/{camera}/"))
    if any(each.startswith(f"{topic}/compressed") for each in topics):
        depth = any(each.startswith(f"/{camera}/") and each.endswith(COMPRESSED_DEPTH) for each in topics)
        return f" (it comes compressed: --compressed {'both' if depth else 'colour'})"
    if own:
        return f"; of {camera} it has {', '.join(own)}"
    cameras = sorted({each.split("/")[1] for each in topics if each.endswith("/camera_info") or "/image_raw" in each})
    return f"; it has the cameras {', '.join(cameras)}" if cameras else "; it has no camera"


def _played(options: Options, topics: Collection[str]) -> tuple[str, ...]:
    wanted: list[str] = []
    for camera in _cameras(options):
        each = _topics(options, camera)
        fits = [driver for driver in DRIVERS if DRIVERS[driver].of(camera).colour_info in topics]
        if fits and each.colour_info not in topics:
            raise graph.GraphError(f"no topic {each.colour_info}; it has those of --driver {fits[0]}")
        wanted += [each.colour_info, each.depth_info, *images_of(each, str(options["compressed"] or "none"))]
    if options["camera_rig"]:
        for camera in camera_names(Path(str(options["camera_rig"])).expanduser()):
            colour, _ = images_of(_topics(options, camera), str(options["compressed"] or "none"))
            wanted.append(colour)
    for topic in wanted:
        if topic not in topics:
            raise graph.GraphError(f"no topic {topic}{_instead(topic, topics)}")
    return tuple(wanted)


SYSTEM = System(
    "camera",
    heading="cameras with colour images",
    order=1,
    nodes=(
        NodeType(
            "camera_skeleton",
            Place.IMAGES,
            "body_tracking.camera.stage:CameraStage",
            basic=("driver", "model", "people"),
        ),
        NodeType(
            "camera_rig", Place.IMAGES, "body_tracking.camera.rig_stage:RigStage", basic=("driver", "model", "people")
        ),
    ),
    specs=_specs,
    played=_played,
    finds=lambda topics: _finds(topics) or _finds_compressed(topics),
    computes=lambda options: (*_cameras(options), *((RIG_SENSOR,) if options["camera_rig"] else ())),
    filter="ekf",  # a camera states its errors, of which a linear filter knows no arm to 30 degrees (docs/accuracy.md)
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
            "camera_rig",
            "",
            "find people in the colour images of calibrated cameras, without depth, with rig.yaml in this folder; the "
            "skeletons are those of a sensor camera_rig",
            "FOLDER",
            path=True,
            offline=True,
            source=True,
            example="config/camera_rig",
        ),
        Option(
            "driver",
            "",
            "the ROS driver of --camera and --camera-rig, which says on which topics it publishes (default: plain, "
            "/<sensor>/color/image_raw and /<sensor>/depth/image_raw)",
            choices=lambda: tuple(DRIVERS),
            parameter=("camera_skeleton", "driver"),  # in a section for all nodes; a camera's section is for its node
            offline=True,
        ),
        Option(
            "compressed",
            "",
            "which of their images come compressed by image_transport (default: none)",
            choices=lambda: COMPRESSION,
            parameter=("camera_skeleton", "compressed"),
            offline=True,
        ),
        Option(
            "pose_model",
            "",
            "folder of their networks (`body_tracking camera model` fetches them)",
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
            "`/fused/skeleton`; hidden joints are inferred, those of arms and those outside the image not tracked",
        ),
        TopicSpec(
            graph.skeleton_topic(RIG_SENSOR),
            POINT_CLOUD,
            graph.SKELETON,
            "camera_rig",
            "the same of the people whom two or more cameras of a rig see, in the frame of its first camera",
        ),
        TopicSpec(
            people_topic("<camera>"),
            COMPRESSED_IMAGE,
            RELIABLE,
            "camera_skeleton",
            "the colour images of a camera, or of each camera of `camera_rig`, with the people drawn in, left blue and "
            "right orange, JPEG; with the parameter `picture_rate`, which `--viewer` sets, and only while there is a "
            "subscriber",
        ),
    ),
    views=(
        View("camera", "body_tracking.viewing.camera_view:CameraView"),
        View("camera_rig", "body_tracking.viewing.camera_view:RigView"),
    ),
    commands=(
        Command("camera", "body_tracking.recording.camera_commands", "fetch the networks, and draw what they find"),
    ),
    prepare="body_tracking.camera.stage:prepare",
)
