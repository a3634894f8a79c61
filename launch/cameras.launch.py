"""The same graph with colour-and-depth cameras in place of Kinects; their drivers run beside it.

ros2 launch body_tracking cameras.launch.py driver:=realsense camera:=camera1,camera2 filter:=ekf
"""

from pathlib import Path

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource

from body_tracking import systems
from body_tracking.core.names import in_launch

DEFAULTS = {"camera": "camera1", "driver": "realsense"}


def generate_launch_description() -> LaunchDescription:
    """What ``ros2 launch`` asks for; all further arguments are those of the graph."""
    declared = [
        DeclareLaunchArgument(name, default_value=value, description=in_launch(systems.OPTIONS[name].text))
        for name, value in DEFAULTS.items()
    ]
    graph = PythonLaunchDescriptionSource(str(Path(__file__).parent / "two_kinects.launch.py"))
    return LaunchDescription([*declared, IncludeLaunchDescription(graph)])
