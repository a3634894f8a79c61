"""The table of the graph: its topics with their QoS, its executables, and which nodes run for given sensors.

Topics have their names in the root namespace; see :mod:`body_tracking.names`.
``body_tracking up``, ``launch/two_kinects.launch.py``, the nodes and the documentation read it here; none repeats it.
Knows no ROS library.
"""

from __future__ import annotations

import argparse
import importlib
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

from body_tracking import names
from body_tracking.errors import BodyTrackingError
from body_tracking.filters import DEFAULT_FILTER
from body_tracking.fusion.subject import ALL, MAX_PEOPLE, SUBJECTS
from body_tracking.messages.base import (
    CLOCK,
    DIAGNOSTICS,
    IMAGE,
    IMU,
    JOINT_STATE,
    JOINT_TRAJECTORY,
    MARKERS,
    POINT_CLOUD,
    SEGMENTS,
    STRING,
    TIME_REFERENCE,
    TRANSFORM,
)
from body_tracking.parameters import Parameter, Value, as_yaml, is_wildcard, matches, read_file
from body_tracking.recording.qos import LATCHED, RELIABLE, SENSOR_DATA, Qos
from body_tracking.sensors import check_sensor_name

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
SOME_IMUS = ("forearm_left", "forearm_right")
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


@dataclass(frozen=True, slots=True)
class FilterRole:
    """What a filter means for the nodes around it.

    Attributes:
        input: what ``skeleton_filter`` listens to: the fused skeleton, or every sensor.
        angles_input: what ``joint_angles`` listens to: the filtered skeleton, or the state of the filter's own model.
        convention: of the joint angles, where none is asked for.
    """

    input: str = FUSED_INPUT
    angles_input: str = SKELETON_INPUT
    convention: str = POSITIONAL


ROLES: Final[Mapping[str, FilterRole]] = {
    "lkf_zero_velocity": FilterRole(),
    "lkf_constant_velocity": FilterRole(),
    "ekf": FilterRole(SENSORS_INPUT, MODEL_INPUT, "model"),
    "thesis_lkf1": FilterRole(),
    "thesis_lkf2": FilterRole(),
    "schlagenhauf_ekf": FilterRole(convention="model"),
}
"""Of each filter in ``filters.FILTERS``."""


_CONVENTIONS: Final = {SKELETON_INPUT: POSITIONAL, MODEL_INPUT: "model"}


# --- topics


@dataclass(frozen=True, slots=True)
class TopicSpec:
    """A topic of the graph.

    Attributes:
        name: with ``<sensor>`` and ``<id>`` in place of names.
        type_name: such as ``sensor_msgs/msg/PointCloud2``.
        qos: what its publishers offer.
        publisher: the executable.
        content: one line.
    """

    name: str
    type_name: str
    qos: Qos
    publisher: str
    content: str


TOPICS: tuple[TopicSpec, ...] = (
    TopicSpec(
        skeleton_topic("<sensor>"),
        POINT_CLOUD,
        SKELETON,
        "kinect_skeleton",
        "what one sensor sees, in `<sensor>_optical_frame`: a point per joint, SDK order; fields `x y z` float32, "
        "`joint` uint8, `tracking_state` uint8 (0 not tracked, 1 inferred, 2 tracked), `body` uint16",
    ),
    TopicSpec(
        IMU_SKELETON,
        POINT_CLOUD,
        SKELETON,
        "imu_skeleton",
        "the body that fits the orientations of inertial sensors, in `world`, with covariance as `/fused/skeleton`; "
        "joints that these do not place are inferred",
    ),
    TopicSpec(
        orientation_topic("<segment>"),
        IMU,
        SKELETON,
        "imu_skeleton",
        "the orientation of a segment in `world` with its covariance there, and its angular velocity about its own "
        "axes, by an inertial sensor",
    ),
    TopicSpec(
        CALIBRATION,
        TRANSFORM,
        LATCHED,
        "calibration",
        "the pose of each sensor's optical frame in `world`, one message per sensor; holds from its stamp on (0: "
        "always), by the stamps of the reference sensor",
    ),
    TopicSpec(
        CALIBRATION_CLOCK,
        TIME_REFERENCE,
        LATCHED,
        "calibration",
        "per other sensor (`source`): what it stamps (`time_ref`) when the reference sensor stamps with the header's "
        "stamp; holds from there on",
    ),
    TopicSpec(
        TF_STATIC, "tf2_msgs/msg/TFMessage", LATCHED, "calibration", "the same poses, where tf2_msgs is installed"
    ),
    TopicSpec(
        FUSED,
        POINT_CLOUD,
        SKELETON,
        "fusion",
        "the person in `world`, by the stamps of the reference sensor; in addition covariance `xx xy xz yy yz zz`; "
        "with `subject: all` everybody, with the person's number in `body`",
    ),
    TopicSpec(
        FILTERED,
        POINT_CLOUD,
        SKELETON,
        "skeleton_filter",
        "the same, filtered; in addition velocity `vx vy vz`; with `ekf` one per sensor's frame, and predicted ones "
        "while nothing arrives",
    ),
    TopicSpec(
        MODEL_STATE,
        JOINT_STATE,
        SKELETON,
        "skeleton_filter",
        "`ekf`: coordinates of the body model and their rates; base x y z in `world`, rotation vectors of the base and "
        "of the upper arms, the other angles",
    ),
    TopicSpec(
        MODEL_STATE_STDDEV,
        JOINT_STATE,
        SKELETON,
        "skeleton_filter",
        "`ekf`: the standard deviation of each; of a rotation, that of a small one more in the segment's own frame",
    ),
    TopicSpec(
        MODEL_COVARIANCE,
        IMAGE,
        SKELETON,
        "skeleton_filter",
        "`ekf`: the whole covariance of these coordinates (rows 0 to 31) and of their rates (rows 32 to 63), `32FC1`, "
        "with the stamp of the state",
    ),
    TopicSpec(
        model_topics("<id>", several=True).state,
        JOINT_STATE,
        SKELETON,
        "skeleton_filter",
        "`ekf`, of each of several people (`subject: all`) what `/filtered/model_state` is of one; so are "
        "`.../model_state_stddev` and `.../model_covariance`",
    ),
    TopicSpec(
        TRACKED,
        "hri_msgs/msg/IdsList",
        RELIABLE,
        "skeleton_filter",
        "the ids of the people who are tracked (REP-155), where hri_msgs is installed",
    ),
    TopicSpec(
        segments_topic("<id>"),
        SEGMENTS,
        RELIABLE,
        "skeleton_filter",
        "`ekf`: the pose of each segment of the body in `world`; quaternions have no singular pose",
    ),
    TopicSpec(
        urdf_topic("<id>"),
        STRING,
        URDF_QOS,
        "skeleton_filter",
        "`ekf`: the person's model with the segment lengths known so far, for robot_state_publisher; its joints are "
        "the angles of the convention `model`",
    ),
    TopicSpec(
        joint_states_topic("<id>"),
        JOINT_STATE,
        RELIABLE,
        "joint_angles",
        "angle and angular velocity per name, capture stamp; names end in `_<id>`; `frame_id` names the convention",
    ),
    TopicSpec(
        joint_states_stddev_topic("<id>"),
        JOINT_STATE,
        RELIABLE,
        "joint_angles",
        "the standard deviation of each, same header, names and order; infinity where there is no estimate",
    ),
    TopicSpec(
        "<topic of the mapping>",
        JOINT_TRAJECTORY,
        RELIABLE,
        "robot_commands",
        "one point for the robot's joints; or `std_msgs/Float64MultiArray`, as the mapping file says; silent while "
        "stopped",
    ),
    TopicSpec(
        markers_topic("<id>"),
        MARKERS,
        RELIABLE,
        "body_markers",
        "what the sensors see, the fused and the filtered skeleton, 95 % ellipsoids of its joints, and the sensors, in "
        "`world`",
    ),
    TopicSpec(
        TF,
        "tf2_msgs/msg/TFMessage",
        RELIABLE,
        "body_markers",
        "`ekf`: the pose of each segment in `world`, named as the links of the URDF, where tf2_msgs is installed",
    ),
    TopicSpec(
        DIAGNOSTICS_TOPIC,
        DIAGNOSTICS,
        RELIABLE,
        "every node",
        "once a second: rates, gaps, drops, malformed messages, delay, calibration quality",
    ),
    TopicSpec(CLOCK_TOPIC, CLOCK, RELIABLE, "bag_player", "the bag's time, for `use_sim_time`"),
)
"""Every topic of the graph; ``TF`` and ``TF_STATIC`` only where ``tf2_msgs`` is installed, and ``TRACKED`` only where
``hri_msgs`` is."""

SERVICES: tuple[tuple[str, str, str], ...] = (
    (START_SERVICE, "calibration", "estimate the poses anew; what is published holds until the new estimate"),
    (RESET_SERVICE, "calibration", "forget the calibration"),
    (ALIGN_SERVICE, "imu_skeleton", "align the inertial sensors anew in the next pose that is held"),
    (
        "robot_commands/enable",
        "robot_commands",
        "a person says that the robot stands at `home` or where it was left, and may move; below the node's own name",
    ),
    ("recorder/start", "bag_recorder", "record, into a new file of the same bag"),
    ("recorder/stop", "bag_recorder", "stop recording and close the bag"),
    ("bag_player/pause", "bag_player", "stand still"),
    ("bag_player/resume", "bag_player", "go on"),
    ("bag_player/toggle_paused", "bag_player", "the one or the other"),
)
"""(name, executable, what it does) of each ``std_srvs/srv/Trigger`` service."""

EXECUTABLES: tuple[str, ...] = (
    "kinect_skeleton",
    "skeleton_adapter",
    "imu_skeleton",
    "calibration",
    "fusion",
    "skeleton_filter",
    "joint_angles",
    "robot_commands",
    "bag_player",
    "bag_recorder",
    "body_markers",
    "viewer",
)

FLOW: tuple[str, ...] = (
    "bag_player",
    "kinect_skeleton",
    "skeleton_adapter",
    "calibration",
    "fusion",
    "imu_skeleton",
    "skeleton_filter",
    "joint_angles",
)
"""Executables from source to angles: none needs what a later one says."""


def parameters_of(executable: str) -> tuple[Parameter, ...]:
    """The parameters of an executable: from its stage, or from its own module, which needs ROS to import."""
    from body_tracking.pipeline.registry import STAGES, stage_class

    if executable in STAGES:
        return stage_class(executable).PARAMETERS
    table: tuple[Parameter, ...] = importlib.import_module(f"body_tracking.nodes.{executable}").PARAMETERS
    return table


# --- nodes


@dataclass(frozen=True, slots=True)
class NodeSpec:
    """A node to be started.

    Attributes:
        name: of the node.
        executable: ``ros2 run body_tracking <executable>``.
        namespace: of the node.
        defaults: parameters that a parameters file may override.
        parameters: parameters that it may not, because the graph hangs together by them.
        remappings: (from, to) of topics.
        after: how many subscribers topics must have before it is started, as far as the starter can see to that: a
            source is to wait until everybody listens.
    """

    name: str
    executable: str
    namespace: str = "/"
    defaults: Mapping[str, Value] = field(default_factory=dict)
    parameters: Mapping[str, Value] = field(default_factory=dict)
    remappings: tuple[tuple[str, str], ...] = ()
    after: Mapping[str, int] = field(default_factory=dict)

    @property
    def full_name(self) -> str:
        """As in a parameters file: ``/fusion``."""
        return f"{self.namespace.rstrip('/')}/{self.name}"

    def meant_by(self, section: str) -> bool:
        """Whether a section of a parameters file is about this node; one file serves in every namespace."""
        return matches(section, self.full_name) or matches(section, f"/{self.name}")


@dataclass(frozen=True, slots=True)
class GraphOptions:
    """What the graph is to do.

    Attributes:
        sensors: the first one is the reference.
        bag: play this instead of running sensor nodes; empty for live.
        record: record into this folder; empty for not.
        record_covariance: record the covariance of the filter's model, too.
        rate: of the bag.
        filter_name: overrides the parameters file; empty for not.
        filter_input: likewise: what the filter listens to.
        convention: likewise: of the joint angles.
        angles_input: likewise: what the angles are made of.
        calibration_file: overrides the parameters file; empty for not.
        reliable: transport every skeleton reliably.
        imus: segments with inertial sensors, as the parameter ``segments`` of ``imu_skeleton`` lists them.
        imu_topics: of the bag, those that are played for these.
        subject: overrides the parameters file; empty for not: whom to track.
        people: likewise, 0 for not: how many at most.
        namespace: of all nodes.
        robot: mapping file of a robot that follows; empty for none.
        external: live, somebody else publishes the sensors' skeletons.
        adapted: sensors whose skeletons come from another camera's ROS driver: ``SENSOR`` or ``SENSOR:/TOPIC``.
        viewer: show it on a live page, with a recorder that waits for its button where nothing is recorded anyway.
        markers: publish markers for RViz and Foxglove.
    """

    sensors: tuple[str, ...] = DEFAULT_SENSORS
    bag: str = ""
    record: str = ""
    record_covariance: bool = False
    rate: float = 1.0
    filter_name: str = ""
    filter_input: str = ""
    convention: str = ""
    angles_input: str = ""
    calibration_file: str = ""
    reliable: bool = False
    imus: tuple[str, ...] = ()
    imu_topics: tuple[str, ...] = ()
    subject: str = ""
    people: int = 0
    namespace: str = "/"
    robot: str = ""
    external: bool = False
    adapted: tuple[str, ...] = ()
    viewer: bool = False
    markers: bool = False

    @property
    def bodies(self) -> tuple[str, ...]:
        """The ids of those who may be tracked, of several people; empty with one subject."""
        return bodies(self.people or MAX_PEOPLE) if self.subject == ALL else ()


def nodes_for(options: GraphOptions) -> tuple[NodeSpec, ...]:
    """The nodes of a graph; sources last, so that those who listen are there first.

    With two sensors and a filter it is the process of Schlagenhauf (2017), figure 5.1.

    Raises:
        GraphError: no sensor, or one twice; a filter was asked for what it cannot do.
        SensorNameError: a name that cannot be a sensor's.
    """
    sensors = tuple(check_sensor_name(sensor) for sensor in options.sensors)
    if not sensors:
        raise GraphError("no sensors")
    if len(set(sensors)) < len(sensors):
        raise GraphError(f"a sensor is named twice among {', '.join(sensors)}")
    common: dict[str, Value] = {"use_sim_time": bool(options.bag)}
    skeletons: dict[str, Value] = {"reliable": True} if options.reliable else {}
    several: dict[str, Value] = {"sensors": sensors, **common, **skeletons}
    calibration: dict[str, Value] = {"calibration_file": options.calibration_file} if options.calibration_file else {}
    role = role_of(options)
    asked = {"filter": options.filter_name, "input": options.filter_input}
    chosen: dict[str, Value] = {name: value for name, value in asked.items() if value}
    # What nobody asked for is left to joint_angles, which follows the filter while that changes.
    angles: dict[str, Value] = {}
    if options.convention not in ("", AUTO) or role.convention != _CONVENTIONS[role.angles_input]:
        angles["convention"] = role.convention
    if options.angles_input:
        angles["input"] = options.angles_input
    asked_of_people: dict[str, Value] = {"subject": options.subject, "people": options.people}
    people = {name: value for name, value in asked_of_people.items() if value}
    subject: dict[str, Value] = {"subject": options.subject} if options.subject else {}
    worn = imu_topics(options.imus)
    orientations: dict[str, Value] = {"orientations": tuple(each.segment for each in worn)} if worn else {}
    specs = [
        NodeSpec("joint_angles", "joint_angles", parameters={**common, **skeletons, **angles, **people}),
        NodeSpec(
            "skeleton_filter", "skeleton_filter", defaults=orientations, parameters={**several, **chosen, **people}
        ),
        NodeSpec("fusion", "fusion", parameters={**several, **people}),
        NodeSpec("calibration", "calibration", parameters={**several, **calibration}),
    ]
    if worn:
        specs.append(
            NodeSpec("imu_skeleton", "imu_skeleton", parameters={"segments": options.imus, **several, **subject})
        )
    if options.robot:
        specs.insert(0, NodeSpec("robot_commands", "robot_commands", parameters={"mapping": options.robot, **several}))
    recorded: dict[str, Value] = {**common, **({"model_covariance": True} if options.record_covariance else {})}
    if options.record:
        specs.append(NodeSpec("bag_recorder", "bag_recorder", parameters={"folder": options.record, **recorded}))
    elif options.viewer:
        specs.append(NodeSpec("bag_recorder", "bag_recorder", parameters={"start_recording": False, **recorded}))
    # These listen to every skeleton.
    watchers = [name for name, wanted in (("body_markers", options.markers), ("viewer", options.viewer)) if wanted]
    specs += [NodeSpec(name, name, parameters={"sensors": sensors, **common}) for name in watchers]
    recorders = int(bool(options.record))
    # Besides the next node and the recorder nobody is waited for; inertial sensors take their world from the fusion.
    to_filter = {FUSED: len(watchers) + int(role.input == FUSED_INPUT) + int(bool(worn))}
    models = [model_topics(body, several=True) for body in options.bodies] or [model_topics(DEFAULT_BODY)]
    states = {topic: 1 for each in models for topic in (each.state, each.covariance)}
    to_angles = {FILTERED: 1 + len(watchers)} if role.angles_input == SKELETON_INPUT else states
    after = {
        topic: count + (recorders if options.record_covariance or not is_model_covariance(topic) else 0)
        for topic, count in {**to_filter, **to_angles}.items()
    }
    if options.record:
        after |= {joint_states_stddev_topic(body): 1 for body in options.bodies or [DEFAULT_BODY]}
    if options.bag:
        # Calibration, fusion and, maybe, the filter, the robot's commands, the recorder and those who show.
        others = int(role.input == SENSORS_INPUT) + int(bool(options.robot)) + recorders + len(watchers)
        listeners = 2 + others
        specs.append(_player(options, sensors, listeners, after))
    elif not options.external:
        adapted = _adapted(options.adapted, sensors)
        specs += [
            NodeSpec(
                f"{sensor}_skeleton",
                "skeleton_adapter" if sensor in adapted else "kinect_skeleton",
                parameters={"sensor": sensor, **adapted.get(sensor, {}), **common, **skeletons},
                after=after,
            )
            for sensor in sensors
        ]
    return tuple(replace(spec, namespace=options.namespace) for spec in specs)


def _adapted(entries: Iterable[str], sensors: Collection[str]) -> dict[str, dict[str, Value]]:
    """Of each sensor that another driver's topic is adapted for, the adapter's parameters.

    Raises:
        GraphError: a sensor that is none of the graph's.
    """
    found: dict[str, dict[str, Value]] = {}
    for entry in entries:
        sensor, _, topic = entry.partition(":")
        if sensor not in sensors:
            raise GraphError(f"adapted sensor {sensor!r} is none of {', '.join(sensors)}")
        found[sensor] = {"topic": topic} if topic else {}
    return found


def role_of(options: GraphOptions) -> FilterRole:
    """What the filter does in this graph: its own role, but for what was asked for otherwise.

    Raises:
        GraphError: it was asked for what this filter cannot do.
    """
    name = options.filter_name or DEFAULT_FILTER
    own = ROLES.get(name, FilterRole())
    asked = {"input": options.filter_input, "convention": options.convention, "angles_input": options.angles_input}
    role = replace(own, **{name: value for name, value in asked.items() if value not in ("", AUTO)})
    if role.input == SENSORS_INPUT != own.input:
        raise GraphError(f"filter {name} takes fused skeletons; its input cannot be the sensors")
    if role.convention == POSITIONAL:
        return replace(role, angles_input=SKELETON_INPUT)
    if role.angles_input == MODEL_INPUT != own.angles_input:
        raise GraphError(f"filter {name} has no model of the body; joint angles must be made of its skeleton")
    return role


def convention_of_robot(mapping: Path, asked: str) -> str:
    """The convention whose angles a robot's mapping file is about.

    Args:
        mapping: the file.
        asked: the convention that somebody asks for; empty or ``AUTO`` for any.

    Raises:
        MappingError: the file is none.
        GraphError: another convention is asked for.
    """
    # only who drives a robot pays for these
    from body_tracking.kinematics.tracking import ALL_CONVENTIONS, angle_names
    from body_tracking.robot.mapping import load

    found = load(mapping, {name: angle_names(name) for name in ALL_CONVENTIONS}).convention
    if asked not in ("", AUTO, found):
        raise GraphError(f"convention {asked}: {mapping} is about angles of the convention {found}")
    return found


def angles_for(convention: str, source: str) -> tuple[str, str]:
    """The convention and the input of ``joint_angles``.

    Args:
        convention: a convention, or ``AUTO`` for that of the input.
        source: ``SKELETON_INPUT`` or ``MODEL_INPUT``: what the filter publishes, or what was asked for.
    """
    if convention == AUTO:
        convention = _CONVENTIONS[source]
    return convention, SKELETON_INPUT if convention == POSITIONAL else source


_FROM_FILE: Final = (
    ("filter_name", "skeleton_filter", "filter"),
    ("filter_input", "skeleton_filter", "input"),
    ("convention", "joint_angles", "convention"),
    ("angles_input", "joint_angles", "input"),
    ("subject", "skeleton_filter", "subject"),
)
"""(option, node, parameter) by which the nodes must know of each other, whoever says it."""


def in_order(sections: Mapping[str, dict[str, object]]) -> list[tuple[str, dict[str, object]]]:
    """The sections of a parameters file, those later that hold against the ones before: the more exact ones."""
    return sorted(sections.items(), key=lambda item: (not is_wildcard(item[0]), item[0].count("/")))


_IMUS_FROM_FILE: Final = ("imus", "imu_skeleton", "segments")
"""The same, of a list."""
_PEOPLE_FROM_FILE: Final = ("people", "skeleton_filter", "people")
"""The same, of a number."""
_COVARIANCE_FROM_FILE: Final = ("record_covariance", "bag_recorder", "model_covariance")
"""The same, of a switch."""


def with_file(options: GraphOptions, file: Path | None) -> GraphOptions:
    """The options with what a parameters file says where they say nothing.

    Raises:
        ParameterError: the file is none.
    """
    sections = read_file(file) if file is not None else {}
    found: dict[str, Any] = {}
    for pattern, values in in_order(sections):

        def meant(node: str, pattern: str = pattern) -> bool:
            return NodeSpec(node, node, options.namespace).meant_by(pattern)

        for option, node, parameter in _FROM_FILE:
            value = values.get(parameter)
            # What is no string at all is refused by whoever checks the parameters.
            if isinstance(value, str) and not getattr(options, option) and meant(node):
                found[option] = value
        option, node, parameter = _IMUS_FROM_FILE
        listed = values.get(parameter)
        if isinstance(listed, list) and not getattr(options, option) and meant(node):
            found[option] = tuple(entry for entry in listed if isinstance(entry, str) and entry)
        option, node, parameter = _PEOPLE_FROM_FILE
        count = values.get(parameter)
        if type(count) is int and not getattr(options, option) and meant(node):
            found[option] = count
        option, node, parameter = _COVARIANCE_FROM_FILE
        switch = values.get(parameter)
        if isinstance(switch, bool) and not getattr(options, option) and meant(node):
            found[option] = switch
    return replace(options, **found)


def all_nodes_for(options: GraphOptions) -> tuple[NodeSpec, ...]:
    """The nodes of a graph, and those that it would have live, with a bag and with everything that may be added."""
    more = replace(
        options,
        record="recording",
        imus=options.imus or SOME_IMUS,
        robot=options.robot or "robot.yaml",
        viewer=True,
        markers=True,
    )
    variants = [options] + [replace(more, bag=bag) for bag in ("", options.bag or "bag")]
    return tuple({spec.name: spec for variant in reversed(variants) for spec in nodes_for(variant)}.values())


def add_people(command: argparse.ArgumentParser) -> None:
    """The options of a command that say whom to track."""
    command.add_argument(
        "--subject",
        choices=SUBJECTS,
        help="whom to track: one, who is the nearest or is seen first, or all (default: nearest)",
    )
    command.add_argument(
        "--people", type=int, default=0, metavar="N", help=f"with --subject all: how many at most ({MAX_PEOPLE})"
    )


CONFIG_HEADER = """\
# Every parameter of every node at its default. Written by `make docs` from the code; copy it, keep what you change:
#   body_tracking up --params-file my_parameters.yaml
#   ros2 launch body_tracking two_kinects.launch.py params_file:=my_parameters.yaml
# What the graph hangs together by (names of sensors, the bag, simulated time) is the command line's to say, not the
# file's. A section /** is about all nodes that have the parameter.
"""


def config_text() -> str:
    """``config/body_tracking.yaml``; needs ROS to import the nodes."""
    sections = {}
    for spec in sorted(all_nodes_for(GraphOptions()), key=lambda spec: EXECUTABLES.index(spec.executable)):
        shown = {
            parameter for _, node, parameter in (*_FROM_FILE, _IMUS_FROM_FILE, _PEOPLE_FROM_FILE) if node == spec.name
        }
        hidden = spec.parameters.keys() - shown
        sections[spec.name] = [item for item in parameters_of(spec.executable) if item.name not in hidden]
    return f"{CONFIG_HEADER}\n{as_yaml(sections)}"


def _player(options: GraphOptions, sensors: Sequence[str], listeners: int, after: Mapping[str, int]) -> NodeSpec:
    topics = tuple(skeleton_topic(sensor) for sensor in sensors)
    # one listener to each of these: the recorder comes later, or not at all
    inertial = options.imu_topics
    parameters: dict[str, Value] = {
        "bag": options.bag,
        "rate": options.rate,
        "topics": (*topics, *inertial),
        "wait_for_subscribers": (
            # the inertial sensors' node hears the reference, which is the first
            *(f"{topic}:{listeners + int(bool(options.imus) and not place)}" for place, topic in enumerate(topics)),
            *(f"{topic}:1" for topic in inertial),
        ),
        "reliable": options.reliable,
    }
    # Every message comes with the clock anyway; each node pays for every tick.
    return NodeSpec("bag_player", "bag_player", defaults={"clock_rate": 20.0}, parameters=parameters, after=after)
