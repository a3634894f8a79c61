"""Parameters that several nodes have, and the quality of service that follows from them."""

from __future__ import annotations

from collections.abc import Mapping

from body_tracking.core.parameters import Parameter, Value
from body_tracking.core.qos import RELIABLE as RELIABLE_QOS
from body_tracking.core.qos import Qos
from body_tracking.core.sources import check_sensor_name
from body_tracking.messages.codecs import Skeletons
from body_tracking.pipeline import graph
from body_tracking.pipeline.stage import Port

RELIABLE = Parameter(
    "reliable",
    False,
    "lose nothing: skeletons and marker points come reliably instead of best effort, and no image or frame is left out "
    "where a node is too slow or stood still; slower when a receiver hangs",
    fixed="a topic keeps the quality of service that it was made with",
)
WORLD_FRAME = Parameter(
    "world_frame",
    "world",
    "name of the world frame; map for REP-155",
    fixed="what is published in this frame would lie in two",
)
BODY = Parameter(
    "body",
    "body1",
    "the id of the person in topics and names of angles (REP-155)",
    fixed="the names of topics and angles hold it",
)
SENSORS = Parameter(
    "sensors",
    ("kinect1", "kinect2"),
    "the sensors; the node takes /<sensor>/skeleton of each",
    fixed="every node of the graph must have the same sensors",
)
REFERENCE = Parameter(
    "reference",
    "",
    "the sensor that defines world and its time; empty for the first one",
    fixed="world and its time would jump for everyone who uses them",
)

FRAMES_KEPT = 16
"""Queue of half a second of a Kinect's frames, so that a node delayed by that long loses none; a node that is always
too slow drops the oldest (:mod:`body_tracking.ros.backlog`)."""


def names_in(value: Value) -> tuple[str, ...]:
    """The value of a parameter that is a list of names."""
    return value if isinstance(value, tuple) else ()


def sensors_of(values: Mapping[str, Value]) -> tuple[str, ...]:
    """The names of the sensors; SensorNameError for an invalid one."""
    return tuple(check_sensor_name(sensor) for sensor in names_in(values["sensors"]))


def skeleton_qos(values: Mapping[str, Value]) -> Qos:
    """The profile of skeleton topics."""
    return graph.RELIABLE_SKELETON if values["reliable"] else graph.SKELETON


def result_qos(values: Mapping[str, Value]) -> Qos:
    """The profile of results: always reliable, and with the parameter ``reliable`` as deep as that of skeletons."""
    return graph.RELIABLE_SKELETON if values["reliable"] else RELIABLE_QOS


def skeleton_input(topic: str, values: Mapping[str, Value]) -> Port:
    """The port of a skeleton topic that a stage takes.

    A sensor of another package may publish best effort, of which a reliable subscription would receive nothing.
    """
    best_effort = not values["reliable"]
    return Port(
        *(topic, Skeletons(), skeleton_qos(values), FRAMES_KEPT),
        droppable=best_effort,
        perishable=best_effort,
        foreign=not best_effort and bool(graph.sensors_among((topic,))),
    )
