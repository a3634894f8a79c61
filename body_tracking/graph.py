"""The table of the graph: its topics with their QoS, its executables, and which nodes run for given sensors.

``body_tracking up``, ``launch/two_kinects.launch.py``, the nodes and the documentation read it here; none repeats it.
Knows no ROS library.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

from body_tracking.errors import BodyTrackingError
from body_tracking.messages import (
    CLOCK,
    DIAGNOSTICS,
    JOINT_STATE,
    POINT_CLOUD,
    TIME_REFERENCE,
    TRANSFORM,
)
from body_tracking.parameters import Parameter, Value, as_yaml
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
DIAGNOSTICS_TOPIC = "/diagnostics"
CLOCK_TOPIC = "/clock"
TF_STATIC = "/tf_static"
START_SERVICE = "calibration/start"
RESET_SERVICE = "calibration/reset"
DEFAULT_SENSORS = ("kinect1", "kinect2")
DEFAULT_BODY = "body1"


class GraphError(BodyTrackingError):
    """A graph that cannot be."""


def skeleton_topic(sensor: str) -> str:
    """Where a sensor's skeletons are published."""
    return f"/{sensor}{SKELETON_SUFFIX}"


def joint_states_topic(body: str) -> str:
    """Where a person's joint angles are published."""
    return f"/humans/bodies/{body}/joint_states"


def joint_states_stddev_topic(body: str) -> str:
    """Where the standard deviations of a person's joint angles are published."""
    return f"{joint_states_topic(body)}_stddev"


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
        "what one sensor sees, in `<sensor>_optical_frame` and its own clock: a point per joint, SDK order; fields "
        "`x y z` float32, `joint` uint8, `tracking_state` uint8 (0 not tracked, 1 inferred, 2 tracked), `body` uint16",
    ),
    TopicSpec(
        CALIBRATION,
        TRANSFORM,
        LATCHED,
        "calibration",
        "the pose of each sensor's optical frame in `world`, one message per sensor; holds from its stamp on (0: "
        "always), in the reference sensor's clock",
    ),
    TopicSpec(
        CALIBRATION_CLOCK,
        TIME_REFERENCE,
        LATCHED,
        "calibration",
        "per other sensor (`source`): what its clock shows (`time_ref`) when the reference sensor's shows the stamp; "
        "holds from the stamp on",
    ),
    TopicSpec(
        TF_STATIC, "tf2_msgs/msg/TFMessage", LATCHED, "calibration", "the same poses, where tf2_msgs is installed"
    ),
    TopicSpec(
        FUSED,
        POINT_CLOUD,
        SKELETON,
        "fusion",
        "the person in `world`, in the reference sensor's clock; in addition covariance `xx xy xz yy yz zz`",
    ),
    TopicSpec(
        FILTERED,
        POINT_CLOUD,
        SKELETON,
        "skeleton_filter",
        "the same, filtered; in addition velocity `vx vy vz`",
    ),
    TopicSpec(
        joint_states_topic("<id>"),
        JOINT_STATE,
        RELIABLE,
        "joint_angles",
        "angle and angular velocity per name, capture stamp; names end in `_<id>`",
    ),
    TopicSpec(
        joint_states_stddev_topic("<id>"),
        JOINT_STATE,
        RELIABLE,
        "joint_angles",
        "the standard deviation of each, same names and order; infinity where nothing observes the angle",
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
"""Every topic of the graph; ``TF_STATIC`` only where ``tf2_msgs`` is installed."""

SERVICES: tuple[tuple[str, str, str], ...] = (
    (START_SERVICE, "calibration", "estimate the poses anew; what is published holds until the new estimate"),
    (RESET_SERVICE, "calibration", "forget the calibration"),
    ("recorder/start", "bag_recorder", "record, into a new file of the same bag"),
    ("recorder/stop", "bag_recorder", "stop recording and close the bag"),
    ("bag_player/pause", "bag_player", "stand still"),
    ("bag_player/resume", "bag_player", "go on"),
    ("bag_player/toggle_paused", "bag_player", "the one or the other"),
)
"""(name, executable, what it does) of each ``std_srvs/srv/Trigger`` service."""

EXECUTABLES: tuple[str, ...] = (
    "kinect_skeleton",
    "calibration",
    "fusion",
    "skeleton_filter",
    "joint_angles",
    "bag_player",
    "bag_recorder",
)


def parameters_of(executable: str) -> tuple[Parameter, ...]:
    """The parameters of an executable, from its own module, which needs ROS to import."""
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


@dataclass(frozen=True, slots=True)
class GraphOptions:
    """What the graph is to do.

    Attributes:
        sensors: the first one is the reference.
        bag: play this instead of running sensor nodes; empty for live.
        record: record into this folder; empty for not.
        rate: of the bag.
        filter_name: overrides the parameters file; empty for not.
        calibration_file: overrides the parameters file; empty for not.
        reliable: transport every skeleton reliably.
    """

    sensors: tuple[str, ...] = DEFAULT_SENSORS
    bag: str = ""
    record: str = ""
    rate: float = 1.0
    filter_name: str = ""
    calibration_file: str = ""
    reliable: bool = False


def nodes_for(options: GraphOptions) -> tuple[NodeSpec, ...]:
    """The nodes of a graph; sources last, so that those who listen are there first.

    Raises:
        GraphError: no sensor, or one twice.
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
    chosen: dict[str, Value] = {"filter": options.filter_name} if options.filter_name else {}
    specs = [
        NodeSpec("joint_angles", "joint_angles", parameters={**common, **skeletons}),
        NodeSpec("skeleton_filter", "skeleton_filter", parameters={**common, **skeletons, **chosen}),
        NodeSpec("fusion", "fusion", parameters=several),
        NodeSpec("calibration", "calibration", parameters={**several, **calibration}),
    ]
    if options.record:
        specs.append(NodeSpec("bag_recorder", "bag_recorder", parameters={"folder": options.record, **common}))
    recorders = int(bool(options.record))
    # Besides the next node and the recorder nobody is waited for.
    after = {FUSED: 1 + recorders, FILTERED: 1 + recorders}
    if options.bag:
        specs.append(_player(options, sensors, after))
    else:
        specs += [
            NodeSpec(
                f"{sensor}_skeleton",
                "kinect_skeleton",
                parameters={"sensor": sensor, **common, **skeletons},
                after=after,
            )
            for sensor in sensors
        ]
    return tuple(specs)


def all_nodes_for(options: GraphOptions) -> tuple[NodeSpec, ...]:
    """The nodes of a graph, and those that it would have live, with a bag and with a recorder."""
    variants = [options] + [replace(options, bag=bag, record="recording") for bag in ("", options.bag or "bag")]
    return tuple({spec.name: spec for variant in reversed(variants) for spec in nodes_for(variant)}.values())


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
        sections[spec.name] = [item for item in parameters_of(spec.executable) if item.name not in spec.parameters]
    return f"{CONFIG_HEADER}\n{as_yaml(sections)}"


def _player(options: GraphOptions, sensors: Sequence[str], after: Mapping[str, int]) -> NodeSpec:
    topics = tuple(skeleton_topic(sensor) for sensor in sensors)
    # Calibration, fusion and, maybe, the recorder.
    listeners = 3 if options.record else 2
    parameters: dict[str, Value] = {
        "bag": options.bag,
        "rate": options.rate,
        "topics": topics,
        "wait_for_subscribers": tuple(f"{topic}:{listeners}" for topic in topics),
        "reliable": options.reliable,
    }
    # Every message comes with the clock anyway; each node pays for every tick.
    return NodeSpec("bag_player", "bag_player", defaults={"clock_rate": 20.0}, parameters=parameters, after=after)
