"""Names of the graph: its topics and services, and what parameters say of each other's nodes.

Topics have their names in the root namespace; see :mod:`body_tracking.core.names`. Which nodes run is in
:mod:`body_tracking.systems`. Knows no ROS library.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from typing import Final

from body_tracking.core import names
from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.message_types import (
    IMAGE,
    JOINT_STATE,
    SEGMENTS,
    STRING,
)
from body_tracking.core.qos import SENSOR_DATA, Qos
from body_tracking.core.sources import check_sensor_name

PARENT_VARIABLE = "BODY_TRACKING_SUPERVISOR"
"""Environment variable: the process without which a node is to end."""

SKELETON = SENSOR_DATA
RELIABLE_SKELETON = Qos(reliability="reliable", depth=1000)
"""For skeletons with the parameter ``reliable``: nothing is lost, however long a receiver takes."""

SKELETON_SUFFIX = "/skeleton"
CALIBRATION = "/calibration"
CALIBRATION_CLOCK = "/calibration/clock"
FUSED = "/fused/skeleton"
FILTERED = "/filtered/skeleton"
MODEL_STATE = "/filtered/model_state"
MODEL_STATE_STDDEV = f"{MODEL_STATE}_stddev"
MODEL_COVARIANCE = "/filtered/model_covariance"
TRACKED = "/humans/bodies/tracked"
IMU_SKELETON = "/imu/skeleton"
TRUE_SKELETON = "/ground_truth/skeleton"
TRUE_MODEL_STATE = "/ground_truth/model_state"
TRUE_ANGLES = "/ground_truth/joint_states"
TRUE_CALIBRATION = "/ground_truth/calibration"
TRUE_CLOCK = f"{TRUE_CALIBRATION}/clock"
DIAGNOSTICS_TOPIC = names.DIAGNOSTICS
CLOCK_TOPIC = names.CLOCK
TF = names.TF
TF_STATIC = names.TF_STATIC
START_SERVICE = "calibration/start"
RESET_SERVICE = "calibration/reset"
ALIGN_SERVICE = "imu_skeleton/align"
DEFAULT_SENSORS = ("kinect1", "kinect2")
DEFAULT_BODY = "body1"
EXAMPLE_IMUS = ("forearm_left", "forearm_right")
"""Segments of which wrist-worn inertial sensors tell."""


class GraphError(BodyTrackingError):
    """A graph that cannot be."""


def skeleton_topic(sensor: str) -> str:
    """Where a sensor's skeletons are published."""
    return f"/{sensor}{SKELETON_SUFFIX}"


def orientation_topic(segment: str) -> str:
    """Where the orientation of a segment by its inertial sensor is published."""
    return f"/imu/{segment}/orientation"


def is_model_covariance(topic: str) -> bool:
    """Whether a topic is the covariance of a person's model (:func:`model_topics`), in any namespace."""
    return re.fullmatch(r"(/\w+)*/(filtered|humans/bodies/\w+)/model_covariance", topic) is not None


def is_orientation_topic(topic: str) -> bool:
    """Whether a topic is :func:`orientation_topic` of some segment, and no sensor's own."""
    return re.fullmatch(r"(/\w+)*/imu/\w+/orientation", topic) is not None


@dataclass(frozen=True, slots=True)
class ImuTopics:
    """Where the driver of a segment's inertial sensor publishes.

    Attributes:
        segment: on which it is.
        imu: of ``sensor_msgs/Imu``, with orientation or raw.
        mag: of ``sensor_msgs/MagneticField``.
        absolute: the names hold in every namespace.
    """

    segment: str
    imu: tuple[str, ...]
    mag: str
    absolute: bool = False


def imu_topics(entries: Iterable[str]) -> tuple[ImuTopics, ...]:
    """The topics of inertial sensors, as a parameter lists them.

    Args:
        entries: ``SEGMENT`` for ``/SEGMENT/imu/data``, ``data_raw`` and ``mag`` (REP-145), ``SEGMENT:NAME`` for another
            name there, or ``SEGMENT:/TOPIC`` for a topic of Imu, with ``mag`` beside it.

    Raises:
        GraphError: an entry that is none, or a segment twice.
    """
    found = []
    for entry in entries:
        segment, colon, where = entry.partition(":")
        if not segment or (colon and not re.fullmatch(r"/?[A-Za-z][A-Za-z0-9_]*(/[A-Za-z][A-Za-z0-9_]*)*", where)):
            raise GraphError(f"inertial sensor {entry!r}: expected SEGMENT, SEGMENT:NAME or SEGMENT:/TOPIC")
        if where.startswith("/"):
            found.append(ImuTopics(segment, (where,), f"{where.rpartition('/')[0]}/mag", absolute=True))
        else:
            base = f"/{where or segment}/imu"
            found.append(ImuTopics(segment, (f"{base}/data", f"{base}/data_raw"), f"{base}/mag"))
    names = [each.segment for each in found]
    if len(set(names)) < len(names):
        raise GraphError(f"a segment comes twice among the inertial sensors {', '.join(names)}")
    return tuple(found)


def played_imu_topics(entries: Iterable[str], there: Collection[str]) -> tuple[str, ...]:
    """The topics of inertial sensors that a bag has.

    Args:
        entries: as of :func:`imu_topics`.
        there: all topics of the bag.

    Raises:
        GraphError: as above, or a sensor of which the bag has nothing.
    """
    found: list[str] = []
    for each in imu_topics(entries):
        own = [topic for topic in each.imu if topic in there]
        if not own:
            raise GraphError(f"the bag has no topic {' nor '.join(each.imu)} of the inertial sensor on {each.segment}")
        found += [*own, *([each.mag] if each.mag in there else [])]
    return tuple(found)


def has_one_publisher(topic: str) -> bool:
    """Whether a topic may have one publisher only: skeletons, calibration and joint angles, in any namespace."""
    return bool(re.search(r"/(skeleton|calibration(/clock)?|humans/bodies/\w+/joint_states(_stddev)?)$", topic))


def joint_states_topic(body: str) -> str:
    """Where a person's joint angles are published."""
    return f"/humans/bodies/{body}/joint_states"


def joint_states_stddev_topic(body: str) -> str:
    """Where the standard deviations of a person's joint angles are published."""
    return f"{joint_states_topic(body)}_stddev"


def bodies_among(topics: Iterable[str]) -> tuple[str, ...]:
    """The persons whose joint angles are among these topics, by name."""
    found = (re.fullmatch(r"/humans/bodies/([A-Za-z]\w*)/joint_states", topic) for topic in topics)
    return tuple(sorted(match[1] for match in found if match))


def markers_topic(body: str) -> str:
    """Where a person's markers for RViz and Foxglove are published."""
    return f"/humans/bodies/{body}/markers"


def urdf_topic(body: str) -> str:
    """Where the model of a person with measured segment lengths is published."""
    return f"/humans/bodies/{body}/urdf"


def segments_topic(body: str) -> str:
    """Where the poses of a person's segments are published."""
    return f"/humans/bodies/{body}/segments"


@dataclass(frozen=True, slots=True)
class ModelTopics:
    """Where the filter publishes the model of a person.

    Attributes:
        state: coordinates and rates.
        stddev: their standard deviations.
        covariance: the whole of it.
        segments: poses.
        urdf: the model with the person's lengths.
    """

    state: str
    stddev: str
    covariance: str
    segments: str
    urdf: str

    def types(self) -> dict[str, str]:
        """The type of each."""
        topics = (self.state, self.stddev, self.covariance, self.segments, self.urdf)
        return dict(zip(topics, (JOINT_STATE, JOINT_STATE, IMAGE, SEGMENTS, STRING), strict=True))


def model_topics(body: str, several: bool = False) -> ModelTopics:
    """The topics of a person's model; those of the only subject are not below the person's name, where they can."""
    own = segments_topic(body), urdf_topic(body)
    if not several:
        return ModelTopics(MODEL_STATE, MODEL_STATE_STDDEV, MODEL_COVARIANCE, *own)
    state = f"/humans/bodies/{body}/model_state"
    return ModelTopics(state, f"{state}_stddev", f"/humans/bodies/{body}/model_covariance", *own)


def bodies(count: int) -> tuple[str, ...]:
    """The ids of several people, by their numbers from 1 on."""
    return tuple(f"body{number}" for number in range(1, count + 1))


URDF_QOS = Qos(durability="transient_local", depth=1)
"""Of a person's model: who comes late gets the latest."""


def check_body(body: str) -> str:
    """The id of a person, as topics and names of angles take it.

    Raises:
        GraphError: it is none.
    """
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", body):
        raise GraphError(f"parameter 'body': {body!r}, expected letters, digits and _, a letter first")
    return body


def sensors_among(topics: Iterable[str]) -> tuple[str, ...]:
    """The sensors whose skeleton topics are among these, by name."""
    found = []
    for topic in topics:
        name = topic.removeprefix("/").removesuffix(SKELETON_SUFFIX)
        if topic == skeleton_topic(name) and "/" not in name:
            try:
                found.append(check_sensor_name(name))
            except BodyTrackingError:
                continue  # fused, filtered, ground_truth
    return tuple(sorted(found))


# --- filters

AUTO = "auto"
"""What a parameter says to go by the filter's name."""
POSITIONAL = "positional"
"""The convention that is made of positions, of any filter."""
FUSED_INPUT, SENSORS_INPUT = "fused", "sensors"
SKELETON_INPUT, MODEL_INPUT = "skeleton", "model_state"


_CONVENTIONS: Final = {SKELETON_INPUT: POSITIONAL, MODEL_INPUT: "model"}


def angles_for(convention: str, source: str) -> tuple[str, str]:
    """The convention and the input of ``joint_angles``.

    Args:
        convention: a convention, or ``AUTO`` for that of the input.
        source: ``SKELETON_INPUT`` or ``MODEL_INPUT``: what the filter publishes, or what was asked for.
    """
    if convention == AUTO:
        convention = _CONVENTIONS[source]
    return convention, SKELETON_INPUT if convention == POSITIONAL else source


def convention_of(source: str) -> str:
    """The convention of angles that are made of this input, where none is asked for."""
    return _CONVENTIONS[source]
