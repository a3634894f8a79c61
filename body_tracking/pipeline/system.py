"""A system: what one folder of the package adds to the graph and to the commands.

Each folder with a ``system.py`` exports one :class:`System` by the name ``SYSTEM``; another package brings one by an
entry point of the group ``body_tracking.systems``. :mod:`body_tracking.systems` puts them together. A ``system.py``
imports no more than it needs to describe itself: modules and classes are named, and loaded by who uses them.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any, TypeAlias

from body_tracking.core.parameters import Value, matches
from body_tracking.core.qos import Qos

Options: TypeAlias = Mapping[str, Value]
"""The value of every :class:`Option`, by its name."""


class Place(IntEnum):
    """Where a node stands on the way from the sensors to the angles; none needs what a later one publishes."""

    SOURCE = 0
    CALIBRATION = 1
    FUSION = 2
    SENSING = 3
    FILTER = 4
    ANGLES = 5
    CONSUMER = 6
    RECORDER = 7


@dataclass(frozen=True, slots=True)
class Option:
    """A word by which a user says what the graph is to do: of ``up``, of ``ros2 launch`` and of ``replay``.

    Attributes:
        name: with underscores; ``--name-with-dashes`` on a command line.
        default: its type is the option's type; a tuple is given several times, a switch has no value.
        text: what it does, for people.
        metavar: what stands for its value.
        choices: the values that it may have, as what returns them; None for any.
        path: it names a file or a folder.
        parameter: (node, parameter) that says the same in a parameters file; the option overrides it.
        hidden: only the parameters file says it.
    """

    name: str
    default: Value
    text: str = ""
    metavar: str = ""
    choices: Callable[[], Sequence[str]] | None = None
    path: bool = False
    parameter: tuple[str, str] | None = None
    hidden: bool = False


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


@dataclass(frozen=True, slots=True)
class Service:
    """A service of type ``std_srvs/srv/Trigger``: its name, the executable, what it does."""

    name: str
    executable: str
    text: str


@dataclass(frozen=True, slots=True)
class NodeType:
    """An executable.

    Attributes:
        name: ``ros2 run body_tracking <name>``.
        place: on the way from the sensors to the angles.
        stage: ``module:Class`` of the stage that it hosts; empty for a node of its own, ``body_tracking.nodes.<name>``.
        takes: of a node without a stage, given its parameters and all topics of the graph: those that it takes.
    """

    name: str
    place: Place
    stage: str = ""
    takes: Callable[[Mapping[str, Value], Iterable[str]], Iterable[str]] | None = None

    @property
    def module(self) -> str:
        """Of a node without a stage."""
        return f"body_tracking.nodes.{self.name}"


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
    """

    name: str
    executable: str
    namespace: str = "/"
    defaults: Mapping[str, Value] = field(default_factory=dict)
    parameters: Mapping[str, Value] = field(default_factory=dict)
    remappings: tuple[tuple[str, str], ...] = ()

    @property
    def full_name(self) -> str:
        """As in a parameters file: ``/fusion``."""
        return f"{self.namespace.rstrip('/')}/{self.name}"

    def in_section(self, section: str) -> bool:
        """Whether a section of a parameters file is about this node; one file serves in every namespace."""
        return matches(section, self.full_name) or matches(section, f"/{self.name}")


@dataclass(frozen=True, slots=True)
class Layer:
    """Something that the viewer can show beside the skeletons.

    Attributes:
        name: in the scene.
        text: what people read.
        topic: whose latest message is shown.
        codec: ``module:NAME`` of its codec.
        draw: ``module:function``; called with viser's scene, the path of the layer in it, and the payload, or None
            where the layer is switched off or nothing came for a while.
        shown: at first.
    """

    name: str
    text: str
    topic: str
    codec: str
    draw: str
    shown: bool = True


@dataclass(frozen=True, slots=True)
class Command:
    """A subcommand of ``body_tracking``: its name, the module with its ``add_parser(subparsers)``, what it does."""

    name: str
    module: str
    text: str


@dataclass(frozen=True, slots=True)
class System:
    """What a folder adds.

    Attributes:
        name: of the system.
        order: among the systems, in tables.
        nodes: its executables.
        specs: the nodes that it runs in a graph with such options, without their namespace.
        options: that it brings.
        topics, services, commands, layers: likewise.
    """

    name: str
    order: int = 100
    nodes: tuple[NodeType, ...] = ()
    specs: Callable[[Options], Iterable[NodeSpec]] = lambda options: ()
    options: tuple[Option, ...] = ()
    topics: tuple[TopicSpec, ...] = ()
    services: tuple[Service, ...] = ()
    commands: tuple[Command, ...] = ()
    layers: tuple[Layer, ...] = ()


def sensors_and_transport(options: Options) -> dict[str, Value]:
    """Parameters of every node that takes skeletons of sensors."""
    return {"sensors": options["sensors"], **transport(options)}


def transport(options: Options) -> dict[str, Value]:
    """Parameters of every node that takes or publishes skeletons."""
    return {"reliable": True} if options["reliable"] else {}


def asked(options: Options, **parameters: str) -> dict[str, Value]:
    """Parameters that options say, by the name of the option; what nobody asked for is left out."""
    return {name: options[option] for name, option in parameters.items() if options[option]}


def load(name: str) -> Any:
    """What ``module:name`` stands for."""
    module, _, attribute = name.partition(":")
    return getattr(importlib.import_module(module), attribute)
