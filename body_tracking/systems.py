"""The graph: nodes, options, topics and commands of all systems, and which nodes run for given options.

The single source for ``body_tracking up``, the launch file, ``body_tracking replay``, the nodes, the command line and
the documentation.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import sys
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Final

from body_tracking.core.arguments import SinglePath
from body_tracking.core.parameters import (
    Parameter,
    ParameterError,
    Value,
    as_yaml,
    check_all,
    is_ros_own,
    is_wildcard,
    read_file,
)
from body_tracking.pipeline import graph
from body_tracking.pipeline.system import NodeSpec, Options, Place, System, asked, load

if TYPE_CHECKING:
    from body_tracking.pipeline.stage import Stage

ENTRY_POINTS: Final = "body_tracking.systems"
"""The group of entry points by which another package adds a system."""


def _found() -> tuple[System, ...]:
    folders = sorted(
        path.parent.name for path in Path(__file__).parent.glob("*/system.py") if path.parent.name != "pipeline"
    )
    ours = [load(f"body_tracking.{folder}.system:SYSTEM") for folder in folders]
    others = []
    for entry in entry_points(group=ENTRY_POINTS):
        try:
            others.append(entry.load())
        except Exception as error:  # of another package, which must not stop ours
            print(f"body_tracking: system {entry.name} ({entry.value}) is left out: {error}", file=sys.stderr)
    return tuple(sorted([*ours, *others], key=lambda system: (system.order, system.name)))


SYSTEMS: Final = _found()
OPTIONS: Final = {option.name: option for system in SYSTEMS for option in system.options}
NODES: Final = {node.name: node for system in SYSTEMS for node in system.nodes}
EXECUTABLES: Final = tuple(NODES)
TOPICS: Final = tuple(topic for system in SYSTEMS for topic in system.topics)
"""Every topic of the graph; ``TF`` and ``TF_STATIC`` need ``tf2_msgs``, ``TRACKED`` needs ``hri_msgs``."""
SERVICES: Final = tuple(service for system in SYSTEMS for service in system.services)
COMMANDS: Final = {command.name: command for system in SYSTEMS for command in system.commands}
LAYERS: Final = tuple(layer for system in SYSTEMS for layer in system.layers)
VIEWS: Final = tuple(view for system in SYSTEMS for view in system.views)
_WIDTH: Final = 60
"""Characters of an option's choices that stand in the usage; more stand in its text."""
_PLACED: Final = sorted(NODES.values(), key=lambda node: node.place)
STAGES: Final = tuple(node.name for node in _PLACED if node.stage)
"""The nodes that host a stage, in the order in which messages go through them."""
FLOW: Final = tuple(node.name for node in _PLACED if node.place <= Place.ANGLES)
"""Executables from source to angles."""


# --- nodes


@cache
def stage_class(executable: str) -> type[Stage]:
    """The class of the stage that a node hosts; KeyError for an unknown node, or one without a stage."""
    node = NODES[executable]
    if not node.stage:
        raise KeyError(executable)
    found: type[Stage] = load(node.stage)
    return found


def parameters_of(executable: str) -> tuple[Parameter, ...]:
    """The parameters of a node: from its stage, or from its own module, which needs ROS to import."""
    node = NODES[executable]
    if node.stage:
        return stage_class(executable).PARAMETERS
    table: tuple[Parameter, ...] = importlib.import_module(node.module).PARAMETERS
    return table


# --- options


def options_of(**given: Value) -> Options:
    """All options, with defaults for those that are not given; KeyError for an unknown one."""
    unknown = given.keys() - OPTIONS.keys()
    if unknown:
        raise KeyError(f"no option {', '.join(sorted(unknown))}")
    found = {name: given.get(name, option.default) for name, option in OPTIONS.items()}
    computed = tuple(sensor for system in SYSTEMS for sensor in system.computes(found))
    if computed and not found["computed"]:
        others = given.get("sensors", ())
        found |= {"computed": computed, "sensors": (*(others if isinstance(others, tuple) else ()), *computed)}
    if found["imus"] and not found["sensors"] and not found["filter"]:
        found["filter"] = "ekf"  # the only filter that works with orientations alone
    return found


def add_options(parser: argparse.ArgumentParser, *names: str, **texts: str) -> None:
    """Add options to a command, in groups under the headings of their systems.

    Args:
        parser: of the command.
        names: of the options; all but the hidden ones when empty.
        texts: help texts that replace those of the options.
    """
    groups: dict[str, argparse._ArgumentGroup] = {}
    # what everybody tries first comes first: a recording to play
    systems = (
        SYSTEMS if names else sorted(SYSTEMS, key=lambda each: all(option.name != "bag" for option in each.options))
    )
    for system, option in [(each, option) for each in systems for option in each.options]:
        if option.hidden or (names and option.name not in names):
            continue
        if system.heading not in groups:
            groups[system.heading] = parser.add_argument_group(system.heading)
        group = groups[system.heading]
        flag, text = f"--{option.name.replace('_', '-')}", texts.get(option.name, option.text)
        if isinstance(option.default, bool):
            group.add_argument(flag, action="store_true", help=text)
        elif isinstance(option.default, tuple):
            group.add_argument(flag, action="append", metavar=option.metavar, help=text)
        else:
            kind = Path if option.path else type(option.default)
            choices = None if option.choices is None else tuple(option.choices())
            metavar = option.metavar or None
            if choices and len(joined := ", ".join(choices)) > _WIDTH:
                metavar, text = option.name.upper(), f"{text}; one of {joined}"
            number = isinstance(option.default, int | float) and option.least is None
            default = option.default if number else None
            action = SinglePath if option.path else "store"
            group.add_argument(
                flag, action=action, type=kind, choices=choices, metavar=metavar, default=default, help=text
            )


def options_from(args: argparse.Namespace) -> dict[str, Value]:
    """The options that a command line sets; others are left out.

    Raises:
        GraphError: a list of sensors without a name, or a number below the least one.
    """
    found: dict[str, Value] = {}
    for name, option in OPTIONS.items():
        value = getattr(args, name, None)
        if value is None:
            continue
        if isinstance(option.default, tuple):
            value = tuple(part for each in value for part in each.split(",") if part)
        if name == "sensors" and not value:
            raise graph.GraphError("sensors: no name")
        if option.least is not None and isinstance(value, int) and value < option.least:
            raise graph.GraphError(f"{name}: {value}, expected {option.least} or more")
        if name == "sensors" and value == (graph.NO_SENSORS,):
            value = ()
        found[name] = tuple(value) if isinstance(option.default, tuple) else str(value) if option.path else value
    return found


def in_order(sections: Mapping[str, dict[str, object]]) -> list[tuple[str, dict[str, object]]]:
    """The sections of a parameters file by increasing precedence: exact names after wildcards."""
    return sorted(sections.items(), key=lambda item: (not is_wildcard(item[0]), item[0].count("/")))


def with_file(options: Options, file: Path | None) -> Options:
    """The options, with values of a parameters file for those at their defaults.

    Where neither chooses a filter, it is that of the system of all sensors.

    Raises:
        ParameterError: an invalid file, or a number of people for a graph that tracks one.
    """
    found = dict(options)
    for pattern, values in in_order(read_file(file) if file is not None else {}):
        for option in OPTIONS.values():
            if option.parameter is None or options[option.name] != option.default:
                continue
            node, parameter = option.parameter
            value = values.get(parameter)
            if isinstance(value, list):
                value = tuple(entry for entry in value if isinstance(entry, str) and entry)
            # Other types are refused later, with the other parameters.
            if type(value) is type(option.default) and NodeSpec(node, node, str(options["namespace"])).in_section(
                pattern
            ):
                found[option.name] = value
    if options["people"] and found["subject"] != "all":
        raise ParameterError("people: needs --subject all")
    if not found["filter"]:
        found["filter"] = _filter_for(found)
    return found


def _filter_for(options: Options) -> str:
    """The default filter of the system that computes all sensors of a graph; empty if several do, or none."""
    sensors = options["sensors"]
    assert isinstance(sensors, tuple)
    filters = {sensor: system.filter for system in SYSTEMS for sensor in system.computes(options)}
    found = {filters.get(sensor, "") for sensor in sensors}
    return found.pop() if len(found) == 1 else ""


def played(options: Options, topics: Collection[str]) -> tuple[str, ...]:
    """The topics of a bag that take the place of the sensors.

    Raises:
        GraphError: a topic is missing.
    """
    return tuple(topic for system in SYSTEMS for topic in system.played(options, topics))


def found_sensors(topics: Mapping[str, str]) -> dict[str, Value]:
    """The options of a graph that takes every sensor that publishes, given the type of each topic; empty for none."""
    found = {name: value for system in SYSTEMS for name, value in system.finds(topics).items()}
    if found and "sensors" not in found and not any(OPTIONS[name].source for name in found):
        found["sensors"] = ()
    return found


def names_sensors(options: Mapping[str, Value]) -> bool:
    """Whether any of these options says where data come from."""
    return any(name in ("sensors", "adapt", "imus") or OPTIONS[name].source for name in options if options[name])


# --- the graph


def nodes_for(options: Options) -> tuple[NodeSpec, ...]:
    """The nodes of a graph; sources last, so that their subscribers start first.

    With two sensors and a filter it is the process of Schlagenhauf (2017), figure 5.1.

    Raises:
        GraphError: no sensor, or one twice; options that the filter does not support.
        SensorNameError: an invalid name of a sensor.
    """
    specs = [spec for system in SYSTEMS for spec in system.specs(options)]
    if not any(NODES[spec.executable].place < Place.CONSUMER and not is_player(spec) for spec in specs):
        flags = (f"--{option.name.replace('_', '-')}" for option in OPTIONS.values() if option.source)
        raise graph.GraphError(f"no sensors: name some with {', '.join(('--sensors', '--imus', *flags))}")
    specs.sort(key=lambda spec: -NODES[spec.executable].place)
    viewed = asked(options, **{view.option: view.option for view in VIEWS})
    return tuple(
        replace(
            spec,
            namespace=str(options["namespace"]),
            parameters=spec.parameters
            if is_player(spec)
            else {
                **spec.parameters,
                **(viewed if spec.executable == "viewer" else {}),
                "use_sim_time": bool(options["bag"]),
            },
        )
        for spec in specs
    )


def is_player(spec: NodeSpec) -> bool:
    """Whether the node plays a bag in place of sensors."""
    return spec.executable == "bag_player"


def is_source(spec: NodeSpec) -> bool:
    """Whether the node is a source, which starts after all others."""
    return NODES[spec.executable].place == Place.SOURCE


def all_nodes_for(options: Options) -> tuple[NodeSpec, ...]:
    """The nodes of a graph, and all that it could have: live, with a bag, with all optional nodes, and with the sensors
    of the default names, so that ``config/body_tracking.yaml`` holds for graphs of other sensors, too.
    """
    default = options_of(namespace=options["namespace"])
    found = {spec.name: spec for given in (default, options) for spec in _possible_nodes(given)}
    return tuple((found | {spec.name: spec for spec in nodes_for(options)}).values())


def _possible_nodes(options: Options) -> Iterable[NodeSpec]:
    examples = {each.name: options[each.name] or each.example for each in OPTIONS.values() if each.example is not None}
    more: Options = {**options, **examples}
    # an option may replace nodes, too: so each is left out once
    fewer = [{**more, "bag": "", name: OPTIONS[name].default} for name in examples]
    variants = [{**more, "bag": bag} for bag in (options["bag"] or "bag", "")]
    found = {spec.name: spec for variant in variants for spec in nodes_for(variant)}
    for variant in fewer:
        with contextlib.suppress(graph.GraphError):  # another option may need this one
            found |= {spec.name: spec for spec in nodes_for(variant) if spec.name not in found}
    return found.values()


def stage_hosts(specs: Iterable[NodeSpec]) -> list[NodeSpec]:
    """The nodes that host a stage, in the order in which messages go through them."""
    return sorted((spec for spec in specs if spec.executable in STAGES), key=lambda spec: STAGES.index(spec.executable))


def stages_for(specs: Iterable[NodeSpec], parameters: Mapping[str, Mapping[str, Value]]) -> dict[str, Stage]:
    """The connected stages of a graph, by the names of their nodes, in the order of their places.

    Args:
        specs: the nodes.
        parameters: of each.

    Raises:
        BodyTrackingError: invalid parameters of a node.
    """
    from body_tracking.pipeline.offline import connect  # numpy takes its time

    stages = {}
    for spec in stage_hosts(specs):
        own = {name: value for name, value in parameters[spec.name].items() if not is_ros_own(name)}
        stages[spec.name] = stage_class(spec.executable)(check_all(parameters_of(spec.executable), own))
    connect(tuple(stages.values()))
    return stages


def subscribers(specs: Sequence[NodeSpec], parameters: Mapping[str, Mapping[str, Value]]) -> dict[str, int]:
    """The number of nodes of a graph that take each topic; arguments and errors as of :func:`stages_for`."""
    stages = stages_for(specs, parameters)
    count = Counter(port.topic for stage in stages.values() for port in stage.inputs)
    published = {port.topic for stage in stages.values() for port in stage.outputs if not port.optional}
    for spec in specs:
        given = parameters[spec.name]
        if is_player(spec) and isinstance(played := given["topics"], tuple):
            published.update(played)
        elif is_source(spec) and spec.name not in stages:
            published.add(graph.skeleton_topic(str(given["sensor"])))
    for spec in specs:
        if (takes := NODES[spec.executable].takes) is not None:
            count.update(takes(parameters[spec.name], published))
    return dict(count)


def angles_topics(specs: Iterable[NodeSpec], parameters: Mapping[str, Mapping[str, Value]]) -> tuple[str, ...]:
    """The topics of joint angles that a graph publishes; arguments and errors as of :func:`stages_for`."""
    stages = stages_for(specs, parameters).values()
    return tuple(port.topic for stage in stages for port in stage.outputs if graph.is_joint_states(port.topic))


CONFIG_HEADER = """\
# The parameters of the nodes at their defaults. Written by `make docs` from the code; copy it, keep what you change:
#   body_tracking up --params-file my_parameters.yaml
#   ros2 launch body_tracking two_kinects.launch.py params_file:=my_parameters.yaml
# Left out is what connects the graph, which the command line sets: names of sensors, setups, the robot's mapping, the
# bag, simulated time; and skeleton_adapter, which stands in the place of the node of a sensor with another driver.
# A section /** applies to all nodes that have the parameter. A first session may need those under "basic"; the defaults
# of those under "advanced" fit nearly always.
"""


def config_text() -> str:
    """``config/body_tracking.yaml``; needs ROS to import the nodes."""
    settable = [option.parameter for option in OPTIONS.values() if option.parameter is not None]
    sections, basic = {}, {}
    for spec in sorted(all_nodes_for(options_of()), key=lambda spec: EXECUTABLES.index(spec.executable)):
        hidden = spec.parameters.keys() - {parameter for node, parameter in settable if node == spec.name}
        sections[spec.name] = [item for item in parameters_of(spec.executable) if item.name not in hidden]
        basic[spec.name] = NODES[spec.executable].basic
    return f"{CONFIG_HEADER}\n{as_yaml(sections, basic)}"
