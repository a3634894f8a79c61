"""The graph of ``body_tracking up``, for ``ros2 launch``: two Kinects, or a bag in their place, to joint angles.

ros2 launch body_tracking two_kinects.launch.py bag:=/path/to/bag record:=/path/to/new/bag filter:=ekf
"""

from dataclasses import replace
from pathlib import Path

from launch import LaunchContext, LaunchDescription, LaunchDescriptionEntity
from launch.actions import DeclareLaunchArgument, OpaqueFunction, RegisterEventHandler, Shutdown
from launch.event_handlers import OnProcessExit
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from body_tracking.graph import (
    DEFAULT_SENSORS,
    GraphOptions,
    NodeSpec,
    convention_of_robot,
    nodes_for,
    played_imu_topics,
    with_file,
)
from body_tracking.parameters import to_ros
from body_tracking.recording.rosbag2 import BagReader

ARGUMENTS = {
    "sensors": (",".join(DEFAULT_SENSORS), "names of the sensors, the reference first"),
    "adapt": ("", "sensors that an Azure Kinect's ROS driver tells of: A,B or A:/topic,B:/topic"),
    "bag": ("", "play this bag in place of the sensors"),
    "rate": ("1.0", "play it this many times as fast"),
    "record": ("", "record everything into this new folder"),
    "filter": ("", "which filter; overrides the parameters file"),
    "convention": ("", "of the joint angles; overrides the parameters file"),
    "subject": ("", "whom to track: nearest, first or all; overrides the parameters file"),
    "people": ("0", "with subject all: how many at most; overrides the parameters file, but for 0"),
    "calibration": ("", "YAML file to load the calibration from, if it is there, and save it to"),
    "robot": ("", "mapping file of a robot that is to follow; see share/body_tracking/config/robots"),
    "viewer": ("false", "show it on a live page in a browser"),
    "markers": ("false", "publish markers for RViz and Foxglove"),
    "params_file": ("", "ROS parameters file; see share/body_tracking/config"),
}


def action(spec: NodeSpec, params_file: str) -> Node:
    """One node of the table; what the graph needs comes last and so overrides the file."""
    files = [params_file] if params_file else []
    layers = [{name: to_ros(value) for name, value in values.items()} for values in (spec.defaults, spec.parameters)]
    return Node(
        package="body_tracking",
        executable=spec.executable,
        name=spec.name,
        namespace=spec.namespace,
        parameters=[layer for layer in (layers[0], *files, layers[1]) if layer],
        remappings=list(spec.remappings),
        output="screen",
        # The bag player ends with its bag; see below.
        respawn=spec.executable != "bag_player",
        respawn_delay=0.5,
    )


def graph(context: LaunchContext) -> list[LaunchDescriptionEntity]:
    """The nodes for the arguments; with a bag, everything ends with it."""
    given = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    convention = given["convention"]
    if given["robot"]:
        convention = convention_of_robot(Path(given["robot"]), convention)
    options = GraphOptions(
        sensors=tuple(name for name in given["sensors"].split(",") if name),
        bag=given["bag"],
        record=given["record"],
        rate=float(given["rate"]),
        filter_name=given["filter"],
        convention=convention,
        calibration_file=given["calibration"],
        subject=given["subject"],
        people=int(given["people"]),
        robot=given["robot"],
        adapted=tuple(entry for entry in given["adapt"].split(",") if entry),
        viewer=given["viewer"].lower() == "true",
        markers=given["markers"].lower() == "true",
    )
    file = Path(given["params_file"]) if given["params_file"] else None
    options = with_file(options, file)
    if options.bag and options.imus:
        with BagReader(options.bag) as reader:
            options = replace(options, imu_topics=played_imu_topics(options.imus, reader.topics))
    nodes = [action(spec, given["params_file"]) for spec in nodes_for(options)]
    if given["bag"]:  # the player is the last one
        end = OnProcessExit(target_action=nodes[-1], on_exit=[Shutdown(reason="the bag has ended")])
        return [*nodes, RegisterEventHandler(end)]
    return list(nodes)


def generate_launch_description() -> LaunchDescription:
    """What ``ros2 launch`` asks for."""
    arguments = [
        DeclareLaunchArgument(name, default_value=default, description=text)
        for name, (default, text) in ARGUMENTS.items()
    ]
    return LaunchDescription([*arguments, OpaqueFunction(function=graph)])
