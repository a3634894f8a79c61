"""The inertial system: sensors on segments of a body."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping

from body_tracking.core.message_types import IMU, POINT_CLOUD
from body_tracking.core.parameters import Value
from body_tracking.pipeline import graph
from body_tracking.pipeline.system import (
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
)


def _specs(options: Options) -> Iterable[NodeSpec]:
    if options["imus"]:
        given = {"segments": options["imus"], **sensors_and_transport(options), **asked(options, subject="subject")}
        # without cameras there is no skeleton to wait for
        alone: dict[str, Value] = {} if options["sensors"] else {"camera": False}
        yield NodeSpec("imu_skeleton", "imu_skeleton", defaults=alone, parameters=given)


def _played(options: Options, topics: Collection[str]) -> tuple[str, ...]:
    imus = options["imus"]
    return graph.played_imu_topics(imus if isinstance(imus, tuple) else (), topics)


def _finds(topics: Mapping[str, str]) -> dict[str, Value]:
    """Sensors that publish under the names of segments."""
    from body_tracking.core.body_model import SEGMENTS  # imports numpy, which --help does without

    there = {topic for topic, kind in topics.items() if kind == IMU}
    worn = tuple(each for each in SEGMENTS if there.intersection(graph.imu_topics([each])[0].imu))
    return {"imus": worn} if worn else {}


SYSTEM = System(
    "inertial",
    heading="inertial sensors (IMUs)",
    order=1,
    nodes=(
        NodeType(
            "imu_skeleton",
            Place.SENSING,
            "body_tracking.inertial.stage:ImuStage",
            basic=("segments", "mountings", "pose", "stature"),
        ),
    ),
    specs=_specs,
    played=_played,
    finds=_finds,
    options=(
        Option(
            "imus",
            (),
            "a segment with an inertial sensor, and the sensor's name in its topics if it is not the segment's: "
            "pelvis, lower_trunk, upper_trunk, head, or clavicle, upper_arm, forearm, hand with _left or _right; "
            "may be repeated, or a list: A,B",
            "SEGMENT[:NAME]",
            parameter=("imu_skeleton", "segments"),
            example=graph.EXAMPLE_IMUS,
            offline=True,
        ),
    ),
    topics=(
        TopicSpec(
            graph.IMU_SKELETON,
            POINT_CLOUD,
            graph.SKELETON,
            "imu_skeleton",
            "the body that fits the orientations of inertial sensors, in `world`, with covariance as "
            "`/fused/skeleton`; joints that the sensors do not place are inferred",
        ),
        TopicSpec(
            graph.orientation_topic("<segment>"),
            IMU,
            graph.SKELETON,
            "imu_skeleton",
            "the orientation of a segment with an inertial sensor in `world`, with covariance in `world`, and its "
            "angular velocity about its own axes",
        ),
    ),
    services=(
        Service(
            graph.ALIGN_SERVICE, "imu_skeleton", "align the inertial sensors anew in the next pose that is held still"
        ),
    ),
)
