"""A system: the nodes, options, topics and commands that one folder of the package adds.

Each folder with a ``system.py`` exports one :class:`System` by the name ``SYSTEM``; another package adds one by an
entry point of the group ``body_tracking.systems``. :mod:`body_tracking.systems` collects them. A ``system.py`` names
its modules and classes instead of importing them; the caller loads them.
"""

from __future__ import annotations

import importlib
import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any, TypeAlias

from body_tracking.core.parameters import Value, matches
from body_tracking.core.qos import Qos

Options: TypeAlias = Mapping[str, Value]
"""The value of every :class:`Option`, by its name."""


class Place(IntEnum):
    """A node's place between the sensors and the angles.

    No node needs an output of a later one. One use is optional: a node of IMAGES takes orientations of inertial
    sensors, which improve its estimates.
    """

    SOURCE = 0
    IMAGES = 1
    CALIBRATION = 2
    FUSION = 3
    SENSING = 4
    FILTER = 5
    ANGLES = 6
    CONSUMER = 7
    RECORDER = 8


@dataclass(frozen=True, slots=True)
class Option:
    """An option of ``up``, ``ros2 launch`` and ``replay``.

    Attributes:
        name: with underscores; ``--name-with-dashes`` on a command line.
        default: its type is the option's type; a tuple makes an option that may be repeated, a bool a switch.
        text: for the help.
        metavar: placeholder of the value in the help.
        choices: returns the allowed values; None for any.
        path: it names a file or a folder.
        parameter: the equivalent (node, parameter) of a parameters file, which the option overrides.
        hidden: no command has it, only the parameters file.
        offline: ``replay`` has it, too.
        source: given a value, the graph has further sensors beside those of the option ``sensors``.
        least: the least number that may be given; None for any. A smaller default stands for no choice.
        example: a value with which a graph has the nodes that depend on it, for lists of all nodes.
    """

    name: str
    default: Value
    text: str = ""
    metavar: str = ""
    choices: Callable[[], Sequence[str]] | None = None
    path: bool = False
    parameter: tuple[str, str] | None = None
    hidden: bool = False
    offline: bool = False
    source: bool = False
    least: int | None = None
    example: Value | None = None


@dataclass(frozen=True, slots=True)
class TopicSpec:
    """A topic of the graph.

    Attributes:
        name: with ``<sensor>`` and ``<id>`` in place of names.
        type_name: such as ``sensor_msgs/msg/PointCloud2``.
        qos: of its publishers.
        publisher: the executable.
        content: one line.
    """

    name: str
    type_name: str
    qos: Qos
    publisher: str
    content: str


@dataclass(frozen=True, slots=True)
class Service:
    """A service of type ``std_srvs/srv/Trigger``: its name, the executable that offers it, its purpose.

    In a name ``<sensor>`` stands for the name of any sensor.
    """

    name: str
    executable: str
    text: str

    def is_called(self, name: str) -> bool:
        """Whether this is the service of a name, in whatever namespace."""
        pattern = re.escape(self.name).replace(re.escape("<sensor>"), "[^/]+")
        return re.fullmatch(f"(.*/)?{pattern}", name) is not None


@dataclass(frozen=True, slots=True)
class NodeType:
    """An executable.

    Attributes:
        name: ``ros2 run body_tracking <name>``.
        place: between the sensors and the angles.
        stage: ``module:Class`` of the stage that it hosts; empty for a node in ``body_tracking.nodes.<name>``.
        basic: names of the parameters that a first session may need; the defaults of all others fit nearly always.
        takes: of a node without a stage: returns its input topics, given its parameters and all topics of the graph.
    """

    name: str
    place: Place
    stage: str = ""
    takes: Callable[[Mapping[str, Value], Iterable[str]], Iterable[str]] | None = None
    basic: tuple[str, ...] = ()

    @property
    def module(self) -> str:
        """The module of a node without a stage."""
        return f"body_tracking.nodes.{self.name}"


@dataclass(frozen=True, slots=True)
class NodeSpec:
    """A node to be started.

    Attributes:
        name: of the node.
        executable: ``ros2 run body_tracking <executable>``.
        namespace: of the node.
        defaults: parameters that a parameters file may override.
        parameters: parameters that it may not override, because they connect the graph.
        remappings: (from, to) of topics.
    """

    name: str
    executable: str
    namespace: str = "/"
    defaults: Mapping[str, Value] = field(default_factory=dict)
    parameters: Mapping[str, Value] = field(default_factory=dict)
    remappings: tuple[tuple[str, str], ...] = ()

    @property
    def full_name(self) -> str:
        """With the namespace, as in a parameters file: ``/fusion``."""
        return f"{self.namespace.rstrip('/')}/{self.name}"

    def in_section(self, section: str) -> bool:
        """Whether a section of a parameters file applies to this node, with or without its namespace."""
        return matches(section, self.full_name) or matches(section, f"/{self.name}")


@dataclass(frozen=True, slots=True)
class Layer:
    """An additional layer of the viewer's scene.

    Attributes:
        name: in the scene.
        text: label on the page.
        topic: whose latest message is shown.
        codec: ``module:NAME`` of its codec.
        draw: ``module:function``; called with viser's scene, the path of the layer in it, and the payload, or None
            where the layer is switched off or its message is old.
        shown: whether it is switched on at first.
    """

    name: str
    text: str
    topic: str
    codec: str
    draw: str
    shown: bool = True


@dataclass(frozen=True, slots=True)
class View:
    """A view of a system in the viewer that combines several topics, or stands beside the scene.

    Attributes:
        option: name of the system's option that configures the view and becomes a parameter of the viewer; without a
            value there is no view.
        make: ``module:Class`` of a :class:`body_tracking.viewing.snapshot.SystemView`; it gets the option's value.
    """

    option: str
    make: str


@dataclass(frozen=True, slots=True)
class Command:
    """A subcommand of ``body_tracking``: name, module with ``add_parser(subparsers)``, one line for the help."""

    name: str
    module: str
    text: str


@dataclass(frozen=True, slots=True)
class System:
    """The contents of one system.

    Attributes:
        name: of the system.
        heading: over its options in the help of commands.
        order: among the systems, in tables.
        nodes: its executables.
        specs: returns the nodes that it runs for given options, without their namespace.
        played: returns the topics of a bag that replace its sensors, given the options and the bag's topics; none where
            it has no sensors in such a graph. Raises GraphError where the bag lacks one.
        finds: returns the options for those of its sensors that publish now, given the type of each topic; none where
            no sensor publishes.
        computes: returns the sensors whose skeletons its own nodes publish; they are added to those of the option
            ``sensors``, and replace its default.
        filter: the default filter of a graph all of whose sensors it computes; empty for that of other graphs.
        options, topics, services, commands, layers, views: that it adds.
        prepare: ``module:function`` that runs every compiled loop of the system once; empty where it has none.
    """

    name: str
    heading: str = "more"
    order: int = 100
    nodes: tuple[NodeType, ...] = ()
    specs: Callable[[Options], Iterable[NodeSpec]] = lambda options: ()
    played: Callable[[Options, Collection[str]], tuple[str, ...]] = lambda options, topics: ()
    finds: Callable[[Mapping[str, str]], Mapping[str, Value]] = lambda topics: {}
    computes: Callable[[Options], tuple[str, ...]] = lambda options: ()
    filter: str = ""
    options: tuple[Option, ...] = ()
    topics: tuple[TopicSpec, ...] = ()
    services: tuple[Service, ...] = ()
    commands: tuple[Command, ...] = ()
    layers: tuple[Layer, ...] = ()
    views: tuple[View, ...] = ()
    prepare: str = ""


def sensors_and_transport(options: Options) -> dict[str, Value]:
    """Parameters of every node that takes skeletons of sensors."""
    return {"sensors": options["sensors"], **transport(options)}


def transport(options: Options) -> dict[str, Value]:
    """Parameters of every node that takes or publishes skeletons."""
    return {"reliable": True} if options["reliable"] else {}


def independent_joints(options: Options) -> dict[str, Value]:
    """Parameter ``bone_correlation`` where all sensors are cameras whose skeletons come from landmarks.

    The errors of neighbouring joints of a Kinect, or of the fit of a mesh, are correlated (0.6 to 0.9 in simulated
    people); those of a camera's landmarks are independent.
    """
    cameras = bool(options["computed"]) and options["sensors"] == options["computed"] and not options["depth"]
    return {"bone_correlation": 0.0} if cameras else {}


def asked(options: Options, **parameters: str) -> dict[str, Value]:
    """Parameters with the values of options, ``parameter=option``; options without a value are left out."""
    return {name: options[option] for name, option in parameters.items() if options[option]}


def load(name: str) -> Any:
    """The object ``module:name``."""
    module, _, attribute = name.partition(":")
    return getattr(importlib.import_module(module), attribute)
