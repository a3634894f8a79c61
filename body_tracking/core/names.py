"""Names of topics in namespaces.

Everywhere in this package a topic has its name in the root namespace, as in ``/fused/skeleton``. A node uses the
:func:`relative` name, so that the node's namespace holds the whole rig; a recording holds :func:`resolved` names, and
:func:`rig_namespace` finds the rig's namespace among them.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Final

from body_tracking.core.errors import BodyTrackingError

CLOCK: Final = "/clock"
DIAGNOSTICS: Final = "/diagnostics"
TF: Final = "/tf"
TF_STATIC: Final = "/tf_static"
WHOLE_DOMAIN: Final = frozenset({CLOCK, DIAGNOSTICS, TF, TF_STATIC, "/rosout", "/parameter_events"})
"""Topics that all rigs of a domain share."""

_RIG: Final = re.compile(r"((?:/\w+)*?)/(?:\w+/skeleton|humans/bodies/\w+/\w+)")
"""Topics that every rig has, whatever it consists of."""


class NamespaceError(BodyTrackingError):
    """Not a valid namespace."""


def check_namespace(text: str) -> str:
    """A namespace as ROS writes it: ``/`` for the root, else with a leading slash and none at the end.

    Raises:
        NamespaceError: it is not a valid one.
    """
    name = text.strip("/")
    if name and not re.fullmatch(r"[A-Za-z_]\w*(/[A-Za-z_]\w*)*", name, re.ASCII):
        raise NamespaceError(f"namespace {text!r}: expected letters, digits and _, with / between the parts")
    return f"/{name}"


def relative(topic: str) -> str:
    """The name that a node uses, relative to its namespace; topics of the whole domain keep their names."""
    return topic if topic in WHOLE_DOMAIN else topic.removeprefix("/")


def resolved(topic: str, namespace: str) -> str:
    """The full name of a topic of the rig in a namespace."""
    return topic if topic in WHOLE_DOMAIN else f"{namespace.rstrip('/')}{topic}"


def within(topic: str, namespace: str) -> str | None:
    """The rig's name for a topic with this full name; None where it is outside the namespace."""
    prefix = namespace.rstrip("/")
    if topic in WHOLE_DOMAIN:
        return topic
    return topic.removeprefix(prefix) if topic.startswith(f"{prefix}/") else None


def rig_namespace(topics: Iterable[str]) -> str:
    """The namespace of the rig with these full topic names; the root where there is no rig or more than one."""
    found = {match[1] for topic in topics if (match := _RIG.fullmatch(topic))}
    return found.pop() or "/" if len(found) == 1 else "/"


def in_launch(text: str) -> str:
    """A text with options as ``ros2 launch`` names them: ``camera_rig`` for ``--camera-rig``."""
    return re.sub(r"--([a-z]+(?:-[a-z]+)*)", lambda found: found[1].replace("-", "_"), text)
