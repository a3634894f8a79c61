"""Names of the graph's topics and services, and values of parameters that several nodes share.

Topics have their names in the root namespace; see :mod:`body_tracking.core.names`. :mod:`body_tracking.systems` defines
which nodes run.
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
"""Environment variable: id of the process with which a node ends."""

END = "graph/end"
"""The service of ``up`` that ends the graph."""
UP_NODE = "body_tracking_up"
"""Prefix of the node's name of ``body_tracking up``."""

SKELETON = SENSOR_DATA
RELIABLE_SKELETON = Qos(reliability="reliable", depth=1000)
"""For skeletons with the parameter ``reliable``: no message is lost to a slow subscriber."""

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
NO_SENSORS = "none"
"""The value of the option ``sensors`` of a graph without cameras that see skeletons."""
DEFAULT_BODY = "body1"
ARM_SEGMENTS = tuple(f"{each}_{side}" for each in ("upper_arm", "forearm", "hand") for side in ("left", "right"))
"""Segments whose inertial sensors the mesh of a depth camera uses; the filter behind it does not use them again."""
EXAMPLE_IMUS = ("forearm_left", "forearm_right")
"""Segments with wrist-worn inertial sensors."""


class GraphError(BodyTrackingError):
    """Options or parameters that do not go together."""


def skeleton_topic(sensor: str) -> str:
    """The topic of a sensor's skeletons."""
    return f"/{sensor}{SKELETON_SUFFIX}"


def orientation_topic(segment: str) -> str:
    """The topic of a segment's orientation by its inertial sensor."""
    return f"/imu/{segment}/orientation"


def is_joint_states(topic: str) -> bool:
    """Whether a topic has joint angles, not their standard deviations (:func:`joint_states_topic`)."""
    return re.fullmatch(r"/humans/bodies/\w+/joint_states", topic) is not None


def is_model_covariance(topic: str) -> bool:
    """Whether a topic is the covariance of a person's model (:func:`model_topics`), in any namespace."""
    return re.fullmatch(r"(/\w+)*/(filtered|humans/bodies/\w+)/model_covariance", topic) is not None


@dataclass(frozen=True, slots=True)
class ImuTopics:
    """Topics of the driver of a segment's inertial sensor.

    Attributes:
        segment: that carries the sensor.
        imu: of ``sensor_msgs/Imu``, with orientation or raw.
        mag: of ``sensor_msgs/MagneticField``.
        absolute: the names hold in every namespace.
    """

    segment: str
    imu: tuple[str, ...]
    mag: str
    absolute: bool = False


def imu_topics(entries: Iterable[str]) -> tuple[ImuTopics, ...]:
    """The topics of the inertial sensors in a parameter's list.

    Args:
        entries: ``SEGMENT`` for ``/SEGMENT/imu/data``, ``data_raw`` and ``mag`` (REP-145), ``SEGMENT:NAME`` for another
            name there, or ``SEGMENT:/TOPIC`` for a topic of Imu, with ``mag`` in the same namespace.

    Raises:
        GraphError: an invalid entry, or a segment twice.
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


def _imus_among(topics: Iterable[str]) -> list[str]:
    """The inertial sensors among these topics, as entries of :func:`imu_topics`; SEGMENT for one that no name tells."""
    from body_tracking.core.body_model import SEGMENTS  # imports numpy, which --help does without

    found = (re.fullmatch(r"/(\w+)/imu/data(_raw)?", topic) for topic in topics)
    names = sorted({match[1] for match in found if match})
    segments = (next((each for each in SEGMENTS if f"_{name}".endswith(f"_{each}")), "SEGMENT") for name in names)
    return [name if name == segment else f"{segment}:{name}" for name, segment in zip(names, segments, strict=True)]


def played_imu_topics(entries: Iterable[str], there: Collection[str]) -> tuple[str, ...]:
    """The topics of inertial sensors that a bag has.

    Args:
        entries: as of :func:`imu_topics`.
        there: all topics of the bag.

    Raises:
        GraphError: an invalid entry, a segment twice, or a sensor without a topic in the bag.
    """
    found: list[str] = []
    for each in imu_topics(entries):
        own = [topic for topic in each.imu if topic in there]
        if not own:
            worn = _imus_among(there)
            names = f"its inertial sensors are {', '.join(worn)}" if worn else "it has no topic /<segment>/imu/data"
            raise GraphError(f"no topic {' or '.join(each.imu)} for {each.segment}; {names}")
        found += [*own, *([each.mag] if each.mag in there else [])]
    return tuple(found)


def has_one_publisher(topic: str) -> bool:
    """Whether a topic may have one publisher only: skeletons, calibration and joint angles, in any namespace."""
    return bool(re.search(r"/(skeleton|calibration(/clock)?|humans/bodies/\w+/joint_states(_stddev)?)$", topic))


def joint_states_topic(body: str) -> str:
    """The topic of a person's joint angles."""
    return f"/humans/bodies/{body}/joint_states"


def joint_states_stddev_topic(body: str) -> str:
    """The topic of the standard deviations of a person's joint angles."""
    return f"{joint_states_topic(body)}_stddev"


def true_angles_topic(body: str) -> str:
    """The topic of the true joint angles of one body among several, or of a chain of targets."""
    return f"/ground_truth/{body}/joint_states"


def bodies_among(topics: Iterable[str]) -> tuple[str, ...]:
    """The ids of the persons whose joint angles are among these topics, sorted."""
    found = (re.fullmatch(r"/humans/bodies/([A-Za-z]\w*)/joint_states", topic) for topic in topics)
    return tuple(sorted(match[1] for match in found if match))


def markers_topic(body: str) -> str:
    """The topic of a person's markers for RViz and Foxglove."""
    return f"/humans/bodies/{body}/markers"


def urdf_topic(body: str) -> str:
    """The topic of a person's URDF with the measured segment lengths."""
    return f"/humans/bodies/{body}/urdf"


def segments_topic(body: str) -> str:
    """The topic of the poses of a person's segments."""
    return f"/humans/bodies/{body}/segments"


@dataclass(frozen=True, slots=True)
class ModelTopics:
    """Topics of the estimated body model of a person.

    Attributes:
        state: coordinates and rates.
        stddev: their standard deviations.
        covariance: their covariance.
        segments: poses.
        urdf: the model with the person's lengths.
    """

    state: str
    stddev: str
    covariance: str
    segments: str
    urdf: str

    def types(self) -> dict[str, str]:
        """The message type of each topic."""
        topics = (self.state, self.stddev, self.covariance, self.segments, self.urdf)
        return dict(zip(topics, (JOINT_STATE, JOINT_STATE, IMAGE, SEGMENTS, STRING), strict=True))


def model_topics(body: str, several: bool = False) -> ModelTopics:
    """The topics of a person's model; the state of a single subject has fixed topics without the person's id."""
    own = segments_topic(body), urdf_topic(body)
    if not several:
        return ModelTopics(MODEL_STATE, MODEL_STATE_STDDEV, MODEL_COVARIANCE, *own)
    state = f"/humans/bodies/{body}/model_state"
    return ModelTopics(state, f"{state}_stddev", f"/humans/bodies/{body}/model_covariance", *own)


def bodies(count: int) -> tuple[str, ...]:
    """The ids of ``count`` people."""
    return tuple(f"body{number}" for number in range(1, count + 1))


URDF_QOS = Qos(durability="transient_local", depth=1)
"""Profile of a person's URDF: a late subscriber gets the latest one."""


def check_body(body: str) -> str:
    """The id, if it can be part of topics and names of angles.

    Raises:
        GraphError: it cannot be.
    """
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", body):
        raise GraphError(f"parameter 'body': {body!r}, expected letters, digits and _, a letter first")
    return body


def sensors_among(topics: Iterable[str]) -> tuple[str, ...]:
    """The sensors whose skeleton topics are among these, sorted."""
    found = []
    for topic in topics:
        name = topic.removeprefix("/").removesuffix(SKELETON_SUFFIX)
        if topic == skeleton_topic(name) and "/" not in name:
            try:
                found.append(check_sensor_name(name))
            except BodyTrackingError:
                continue  # fused, filtered, ground_truth
    return tuple(sorted(found))


def check_skeletons(wanted: Iterable[str], topics: Collection[str]) -> None:
    """Refuse a sensor without skeletons among a recording's topics.

    Raises:
        GraphError: a wanted sensor is missing; names those that are there.
    """
    for sensor in wanted:
        if skeleton_topic(sensor) not in topics:
            there = sensors_among(topics)
            names = f"its sensors are {', '.join(there)}" if there else "it has no sensor with skeletons"
            raise GraphError(f"no topic {skeleton_topic(sensor)}; {names}")


def listed(topics: Collection[str]) -> str:
    """What a recording has, the truth only if there is nothing else, for an error that names what it lacks."""
    measured = [topic for topic in sorted(topics) if not topic.startswith("/ground_truth/")]
    return f"it has {', '.join(measured or sorted(topics)) or 'no topics'}"


# --- inputs and conventions

AUTO = "auto"
"""Value of a parameter whose default follows from the filter."""
POSITIONAL = "positional"
"""The convention of angles from joint positions, which every filter allows."""
FUSED_INPUT, SENSORS_INPUT = "fused", "sensors"
SKELETON_INPUT, MODEL_INPUT = "skeleton", "model_state"

_CONVENTIONS: Final = {SKELETON_INPUT: POSITIONAL, MODEL_INPUT: "model"}


def angles_for(convention: str, source: str) -> tuple[str, str]:
    """The convention and the input of ``joint_angles``.

    Args:
        convention: a convention, or ``AUTO`` for that of the input.
        source: ``SKELETON_INPUT`` or ``MODEL_INPUT``.
    """
    if convention == AUTO:
        convention = _CONVENTIONS[source]
    return convention, SKELETON_INPUT if convention == POSITIONAL else source


def convention_of(source: str) -> str:
    """The default convention of angles from this input."""
    return _CONVENTIONS[source]
