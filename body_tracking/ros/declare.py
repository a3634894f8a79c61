"""Declaration of the nodes' parameters in ROS."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence, Set
from pathlib import Path
from types import MappingProxyType

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter

from body_tracking import systems
from body_tracking.core.parameters import (
    Parameter,
    Value,
    check_all,
    is_ros_own,
    is_wildcard,
    matches,
    read_file,
    to_ros,
)


def declare(node: Node, table: Sequence[Parameter]) -> Mapping[str, Value]:
    """Declare parameters; returns their values, set by file, by ``-p`` or by default.

    Raises:
        ParameterError: an unknown name, which rclpy would silently ignore, or a value that is not allowed.
    """
    overrides: dict[str, RosParameter] = node._parameter_overrides
    known = {parameter.name: parameter for parameter in table}
    given = {name: item.value for name, item in overrides.items() if not is_ros_own(name)}
    for name in _of_other_nodes(node, given.keys() - known.keys()):
        del given[name]
    for name in given.keys() & known.keys():
        if given[name] is None and isinstance(known[name].default, tuple):
            given[name] = ()  # rcl reads an empty list as no value
    values = check_all(table, given)
    for name, value in values.items():
        # rclpy would refuse an integer for a float; check_all has converted it.
        if name in overrides:
            overrides[name] = RosParameter(name, value=to_ros(value))
        node.declare_parameter(name, to_ros(value), _descriptor(known[name]))
    return MappingProxyType(values)


def _of_other_nodes(node: Node, unknown: Set[str]) -> Set[str]:
    """Unknown names in wildcard sections of parameters files that are parameters of other nodes."""
    shared: set[str] = set()
    for file in parameter_files() if unknown else ():
        for pattern, values in read_file(file).items():
            if is_wildcard(pattern) and matches(pattern, node.get_fully_qualified_name()):
                shared |= unknown & values.keys()
    if not shared:
        return shared
    return shared & {parameter.name for name in systems.EXECUTABLES for parameter in systems.parameters_of(name)}


def parameter_files() -> list[Path]:
    """The parameters files on the command line."""
    return [Path(sys.argv[i + 1]) for i, word in enumerate(sys.argv[:-1]) if word == "--params-file"]


def _descriptor(parameter: Parameter) -> ParameterDescriptor:
    description = f"{parameter.doc} [{parameter.unit}]" if parameter.unit else parameter.doc
    descriptor = ParameterDescriptor(
        description=description, additional_constraints=parameter.constraint, read_only=not parameter.live
    )
    if parameter.min is not None and parameter.max is not None:
        if isinstance(parameter.default, float):
            descriptor.floating_point_range = [
                FloatingPointRange(from_value=float(parameter.min), to_value=float(parameter.max))
            ]
        else:
            descriptor.integer_range = [
                IntegerRange(from_value=int(parameter.min), to_value=int(parameter.max), step=1)
            ]
    return descriptor
