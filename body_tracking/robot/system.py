"""Commands to robots that follow a person."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

from body_tracking.core.message_types import JOINT_TRAJECTORY
from body_tracking.core.parameters import Value
from body_tracking.core.qos import RELIABLE
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
    sensors_and_transport,
)


def _takes(parameters: Mapping[str, Value], topics: Iterable[str]) -> Iterable[str]:
    sensors = parameters.get("sensors", ())
    return [graph.skeleton_topic(sensor) for sensor in sensors] if isinstance(sensors, tuple) else []


def _specs(options: Options) -> Iterable[NodeSpec]:
    if options["robot"]:
        given = {"mapping": options["robot"], **sensors_and_transport(options)}
        yield NodeSpec("robot_commands", "robot_commands", parameters=given)


def convention_of(mapping: Path, asked: str) -> str:
    """The convention of the angles that a mapping file names.

    Args:
        mapping: the file.
        asked: the requested convention; empty or ``graph.AUTO`` for any.

    Raises:
        MappingError: not a mapping file.
        GraphError: another convention is requested.
    """
    # imported here: only a graph with a robot needs them
    from body_tracking.kinematics.conventions import ALL_CONVENTIONS, angle_names
    from body_tracking.robot.mapping import load

    found = load(mapping, {name: angle_names(name) for name in ALL_CONVENTIONS}).convention
    if asked not in ("", graph.AUTO, found):
        raise graph.GraphError(f"convention {asked}: {mapping} needs angles of the convention {found}")
    return found


SYSTEM = System(
    "robot",
    heading="robot",
    order=4,
    nodes=(NodeType("robot_commands", Place.CONSUMER, takes=_takes, basic=("mapping", "rate")),),
    specs=_specs,
    options=(
        Option(
            "robot",
            "",
            "mapping file of a robot that follows the angles; see docs/robots.md",
            "FILE",
            path=True,
            example="robot.yaml",
        ),
    ),
    topics=(
        TopicSpec(
            "<topic of the mapping>",
            JOINT_TRAJECTORY,
            RELIABLE,
            "robot_commands",
            "commands of the robot's joints, one point; or `std_msgs/Float64MultiArray`, as the mapping file says; "
            "none while stopped",
        ),
    ),
    services=(
        Service(
            "robot_commands/enable",
            "robot_commands",
            "an operator confirms that the robot is at `home` and may move; below the node's own name",
        ),
    ),
)
