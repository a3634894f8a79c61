"""The graph of ``body_tracking up``, for ``ros2 launch``: two Kinects, or a bag in their place, to joint angles.

ros2 launch body_tracking two_kinects.launch.py bag:=/path/to/bag record:=/path/to/new/bag filter:=ekf
"""

from launch import LaunchContext, LaunchDescription, LaunchDescriptionEntity
from launch.actions import DeclareLaunchArgument, OpaqueFunction, RegisterEventHandler, Shutdown
from launch.event_handlers import OnProcessExit
from launch.events.process import ProcessExited
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from body_tracking.graph import NodeSpec, nodes_for
from body_tracking.parameters import Value, to_ros
from body_tracking.up import CANNOT_START, UpError, all_parameters, arguments_from, options_for

ARGUMENTS = {
    "sensors": ("", "names of the sensors, the reference first; empty for those of the bag, else kinect1,kinect2"),
    "adapt": ("", "sensors whose skeletons come from an Azure Kinect's ROS driver: A,B or A:/topic,B:/topic"),
    "bag": ("", "play this bag in place of the sensors"),
    "rate": ("1.0", "play it this many times as fast"),
    "record": ("", "record everything into this new folder"),
    "model_covariance": ("false", "record /filtered/model_covariance, too; with ekf it is most of a recording"),
    "filter": ("", "which filter; overrides the parameters file"),
    "convention": ("", "of the joint angles; overrides the parameters file"),
    "subject": ("", "whom to track: nearest, first or all; overrides the parameters file"),
    "people": ("0", "with subject all: how many at most; overrides the parameters file, but for 0"),
    "calibration": ("", "YAML file to load the calibration from, if it is there, and save it to"),
    "robot": ("", "mapping file of a robot that is to follow; see share/body_tracking/config/robots"),
    "viewer": ("false", "show it on a live page in a browser"),
    "markers": ("false", "publish markers for RViz and Foxglove"),
    "namespace": ("/", "of all nodes, and so of their topics; a second rig needs one"),
    "params_file": ("", "ROS parameters file; see share/body_tracking/config"),
}
SWITCHES = ("model_covariance", "viewer", "markers")
LISTS = ("adapt",)
TRUTH = {"true": True, "1": True, "false": False, "0": False}
"""As conditions of launch take it."""


def words(context: LaunchContext) -> list[str]:
    """The same as options of ``body_tracking up``, which checks them."""
    found = []
    for name in ARGUMENTS:
        option, value = f"--{name.replace('_', '-')}", LaunchConfiguration(name).perform(context)
        if name in SWITCHES:
            if value.lower() not in TRUTH:
                raise UpError(f"{name}:={value}: expected true or false")
            found += [option] * TRUTH[value.lower()]
        elif value:
            found += [f"{option}={each}" for each in (value.split(",") if name in LISTS else [value])]
    return found


def action(spec: NodeSpec, parameters: dict[str, Value]) -> Node:
    """One node of the table."""
    return Node(
        package="body_tracking",
        executable=spec.executable,
        name=spec.name,
        namespace=spec.namespace,
        parameters=[{name: to_ros(value) for name, value in parameters.items()}],
        remappings=list(spec.remappings),
        output="screen",
        # The bag player ends with its bag.
        respawn=spec.executable != "bag_player",
        respawn_delay=0.5,
    )


def graph(context: LaunchContext) -> list[LaunchDescriptionEntity]:
    """The nodes for the arguments; everything ends with the bag, or with a node that cannot start."""
    args = arguments_from(words(context))
    options = options_for(args)
    specs = nodes_for(options)
    parameters = all_parameters(options, specs, args.params_file)
    nodes = {spec.name: action(spec, parameters[spec.name]) for spec in specs}

    def ended(event: ProcessExited, context: LaunchContext) -> Shutdown | None:
        if context.is_shutdown:
            return None
        if event.returncode == CANNOT_START:  # it has said why; a new one would end the same way
            raise UpError(f"{event.process_name}: cannot start")
        return Shutdown(reason="the bag has ended") if event.action is nodes.get("bag_player") else None

    return [RegisterEventHandler(OnProcessExit(on_exit=ended)), *nodes.values()]


def generate_launch_description() -> LaunchDescription:
    """What ``ros2 launch`` asks for."""
    declared = [
        DeclareLaunchArgument(name, default_value=default, description=text)
        for name, (default, text) in ARGUMENTS.items()
    ]
    return LaunchDescription([*declared, OpaqueFunction(function=graph)])
