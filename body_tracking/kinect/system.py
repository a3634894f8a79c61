"""The Kinect system: skeletons of cameras, their calibration against each other, and their fusion."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from pathlib import Path

from body_tracking.core.message_types import MARKERS, POINT_CLOUD, TIME_REFERENCE, TRANSFORM
from body_tracking.core.parameters import Value
from body_tracking.core.qos import LATCHED
from body_tracking.core.sources import check_sensor_name
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
    asked,
    sensors_and_transport,
    transport,
)


def _subjects() -> tuple[str, ...]:
    from body_tracking.pipeline.people import SUBJECTS

    return SUBJECTS


def _specs(options: Options) -> Iterable[NodeSpec]:
    sensors = sensors_of(options)
    if not sensors:
        return
    several = sensors_and_transport(options)
    yield NodeSpec("fusion", "fusion", parameters={**several, **asked(options, subject="subject", people="people")})
    file = asked(options, calibration_file="calibration")
    if options["bag"] and file and Path(str(options["calibration"])).expanduser().exists():
        file["save"] = False  # the people and clocks of a bag may not be those of the file
    yield NodeSpec("calibration", "calibration", parameters={**several, **file})
    if options["bag"] or options["external"]:
        return
    adapted = _adapted(options)
    for sensor in _own(options):
        yield NodeSpec(
            f"{sensor}_skeleton",
            "skeleton_adapter" if sensor in adapted else "kinect_skeleton",
            parameters={"sensor": sensor, **adapted.get(sensor, {}), **transport(options)},
        )


def _played(options: Options, topics: Collection[str]) -> tuple[str, ...]:
    graph.check_skeletons(_own(options), topics)
    return tuple(map(graph.skeleton_topic, _own(options)))


_AZURE = "/body_tracking_data"
"""Suffix of the topic of Microsoft's driver of the Azure Kinect."""


def _finds(topics: Mapping[str, str]) -> dict[str, Value]:
    azure = sorted(topic for topic, kind in topics.items() if topic.endswith(_AZURE) and kind == MARKERS)
    sensors = tuple(
        each
        for each in graph.sensors_among(topic for topic, kind in topics.items() if kind == POINT_CLOUD)
        if graph.skeleton_topic(each) != graph.IMU_SKELETON
    )
    if sensors:
        return {"sensors": sensors, "external": True}
    if azure:
        names = tuple(f"azure{number}" for number, _ in enumerate(azure, 1))
        return {"sensors": names, "adapt": tuple(f"{name}:{topic}" for name, topic in zip(names, azure, strict=True))}
    return {}


def sensors_of(options: Options) -> tuple[str, ...]:
    """The cameras of a graph that see skeletons.

    Raises:
        GraphError: a duplicate.
        SensorNameError: an invalid name.
    """
    given = options["sensors"]
    sensors = tuple(check_sensor_name(sensor) for sensor in given) if isinstance(given, tuple) else ()
    if len(set(sensors)) < len(sensors):
        raise graph.GraphError(f"a sensor is named twice among {', '.join(sensors)}")
    return sensors


def _own(options: Options) -> tuple[str, ...]:
    """The sensors whose skeletons no other node computes."""
    computed = options["computed"]
    return tuple(each for each in sensors_of(options) if not (isinstance(computed, tuple) and each in computed))


def _adapted(options: Options) -> dict[str, dict[str, Value]]:
    """The adapter's parameters by sensor, for sensors with another driver.

    Raises:
        GraphError: a sensor that is not in the graph.
    """
    found: dict[str, dict[str, Value]] = {}
    sensors, given = _own(options), options["adapt"]
    for entry in given if isinstance(given, tuple) else ():
        sensor, _, topic = entry.partition(":")
        if sensor not in sensors:
            raise graph.GraphError(f"adapted sensor {sensor!r} is none of {', '.join(sensors)}")
        found[sensor] = {"topic": topic} if topic else {}
    return found


SYSTEM = System(
    "kinect",
    heading="skeletons, calibration and people",
    order=0,
    nodes=(
        NodeType("kinect_skeleton", Place.SOURCE, basic=("backend", "file", "address", "port", "key_file")),
        NodeType("skeleton_adapter", Place.SOURCE, basic=("sensor", "topic")),
        NodeType(
            "calibration",
            Place.CALIBRATION,
            "body_tracking.calibration.stage:CalibrationStage",
            basic=("reference", "calibration_file", "reference_height"),
        ),
        NodeType(
            "fusion", Place.FUSION, "body_tracking.fusion.stage:FusionStage", basic=("reference", "subject", "people")
        ),
    ),
    specs=_specs,
    played=_played,
    finds=_finds,
    options=(
        Option(
            "sensors",
            graph.DEFAULT_SENSORS,
            "the sensors, the reference first, or none (default: those in the bag, or those that publish)",
            "A,B",
            offline=True,
        ),
        Option("computed", (), hidden=True),
        Option("with_covariances", (), hidden=True),
        Option("external", False, "start no sensor nodes: other processes publish /<sensor>/skeleton"),
        Option(
            "adapt",
            (),
            "take this sensor's skeletons from the ROS driver of an Azure Kinect (default topic: body_tracking_data)",
            "SENSOR[:/TOPIC]",
        ),
        Option(
            "calibration",
            "",
            "YAML file of the calibration: loaded if it exists, saved when the result changes; a bag changes no "
            "existing file",
            "FILE",
            path=True,
            parameter=("calibration", "calibration_file"),
            offline=True,
        ),
        Option("reliable", False, "transport skeletons reliably: nothing is lost, but delays may grow"),
        Option(
            "subject",
            "",
            "whom to track: the nearest person, the one seen first, or all (default: nearest)",
            choices=_subjects,
            parameter=("skeleton_filter", "subject"),
            offline=True,
        ),
        Option(
            "people",
            0,
            "with --subject all: the largest number of people (default: 6)",
            "N",
            parameter=("skeleton_filter", "people"),
            offline=True,
            least=1,
        ),
    ),
    topics=(
        TopicSpec(
            graph.skeleton_topic("<sensor>"),
            POINT_CLOUD,
            graph.SKELETON,
            "kinect_skeleton",
            "the skeletons of one sensor, in `<sensor>_optical_frame`: a point per joint, SDK order; fields `x y z` "
            "float32, `joint` uint8, `tracking_state` uint8 (0 not tracked, 1 inferred, 2 tracked), `body` uint16",
        ),
        TopicSpec(
            graph.CALIBRATION,
            TRANSFORM,
            LATCHED,
            "calibration",
            "the pose of each sensor's optical frame in `world`, one message per sensor; in force from its stamp on "
            "(0: always), in the time of the reference sensor",
        ),
        TopicSpec(
            graph.CALIBRATION_CLOCK,
            TIME_REFERENCE,
            LATCHED,
            "calibration",
            "per other sensor (`source`): its time (`time_ref`) at the reference sensor's time in the header; in "
            "force from then on",
        ),
        TopicSpec(
            graph.TF_STATIC,
            "tf2_msgs/msg/TFMessage",
            LATCHED,
            "calibration",
            "the same poses, where tf2_msgs is installed",
        ),
        TopicSpec(
            graph.FUSED,
            POINT_CLOUD,
            graph.SKELETON,
            "fusion",
            "the person in `world`, as `/<sensor>/skeleton` with the stamps of the reference sensor, and covariance "
            "`xx xy xz yy yz zz`; with `subject: all` everybody, with the person's number in `body`",
        ),
    ),
    services=(
        Service(
            graph.START_SERVICE,
            "calibration",
            "estimate the poses anew; the published ones stay in force until then, and move slowly to the new ones",
        ),
        Service(
            graph.RESET_SERVICE,
            "calibration",
            "discard the calibration; the published poses stay in force until "
            "the new estimate, which replaces them at once",
        ),
    ),
    commands=(
        Command("calibrate", "body_tracking.recording.calibrate", "estimate the poses and clocks of a bag's sensors"),
    ),
)
