"""The graph of ``body_tracking up``, for ``ros2 launch``: two Kinects, or a bag in their place, to joint angles.

ros2 launch body_tracking two_kinects.launch.py bag:=/path/to/bag record:=/path/to/new/bag filter:=ekf
"""

import sys
from pathlib import Path

from launch import LaunchContext, LaunchDescription, LaunchDescriptionEntity
from launch.actions import DeclareLaunchArgument, OpaqueFunction, RegisterEventHandler, Shutdown
from launch.event_handlers import OnProcessExit
from launch.events.process import ProcessExited
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from body_tracking import systems
from body_tracking.core.errors import BodyTrackingError, did_you_mean
from body_tracking.core.names import in_launch
from body_tracking.core.parameters import Value, to_ros
from body_tracking.pipeline.system import NodeSpec, Option
from body_tracking.ros.up import CANNOT_START, STOP_TIMEOUT, UpError, all_parameters, arguments_from, options_for

OPTIONS = [option for option in systems.OPTIONS.values() if not option.hidden]
TRUTH = {"true": True, "1": True, "false": False, "0": False}
"""As conditions of launch take it."""


def check_names(context: LaunchContext) -> None:
    """Refuse a misspelt argument, which launch would ignore.

    Only where the command line starts a launch file of this package: one that includes this may have its own arguments.
    """
    own = {path.name for path in Path(__file__).parent.glob("*.launch.py")}
    if own.isdisjoint(Path(word).name for word in sys.argv):
        return
    names = [option.name for option in OPTIONS]
    for argument in context.argv:
        name, assigned, _ = argument.partition(":=")
        if assigned and name not in names:
            raise UpError(f"{name}: no such argument{did_you_mean(name, names) or '; --show-args lists them'}")


def default_of(option: Option) -> str:
    """As launch has it; empty for what nobody asks for."""
    if isinstance(option.default, bool):
        return "false"
    return "" if isinstance(option.default, tuple) else str(option.default)


def words(context: LaunchContext) -> list[str]:
    """The same as options of ``body_tracking up``, which checks them."""
    found = []
    for option in OPTIONS:
        flag, value = f"--{option.name.replace('_', '-')}", LaunchConfiguration(option.name).perform(context)
        if isinstance(option.default, bool):
            if value.lower() not in TRUTH:
                raise UpError(f"{option.name}:={value}: expected true or false")
            found += [flag] * TRUTH[value.lower()]
        elif value != default_of(option):  # 0 people stand for the largest number, and up refuses them
            found.append(f"{flag}={value}")
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
        # launch's own 5 s are too few on a busy machine: a recorder may still write, the middleware waits for others
        sigterm_timeout=str(STOP_TIMEOUT),
    )


def graph(context: LaunchContext) -> list[LaunchDescriptionEntity]:
    """The actions for the arguments; an error names them as launch does."""
    try:
        check_names(context)
        return actions(context)
    except BodyTrackingError as error:
        raise UpError(in_launch(str(error))) from error


def actions(context: LaunchContext) -> list[LaunchDescriptionEntity]:
    """The nodes for the arguments; everything ends with the bag, or with a node that cannot start."""
    args = arguments_from(words(context))
    options = options_for(args)
    specs = systems.nodes_for(options)
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
        DeclareLaunchArgument(option.name, default_value=default_of(option), description=in_launch(option.text))
        for option in OPTIONS
    ]
    return LaunchDescription([*declared, OpaqueFunction(function=graph)])
