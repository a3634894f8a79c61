"""What each filter means for the nodes around it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

from body_tracking.core.parameters import Value
from body_tracking.pipeline import graph

DEFAULT_FILTER: Final = "lkf_constant_velocity"
"""The filter of nodes and commands that are given none."""


@dataclass(frozen=True, slots=True)
class FilterRole:
    """What a filter means for the nodes around it.

    Attributes:
        input: what ``skeleton_filter`` listens to: the fused skeleton, or every sensor.
        angles_input: what ``joint_angles`` listens to: the filtered skeleton, or the state of the filter's own model.
        convention: of the joint angles, where none is asked for.
    """

    input: str = graph.FUSED_INPUT
    angles_input: str = graph.SKELETON_INPUT
    convention: str = graph.POSITIONAL


ROLES: Final[Mapping[str, FilterRole]] = {
    "lkf_zero_velocity": FilterRole(),
    "lkf_constant_velocity": FilterRole(),
    "ekf": FilterRole(graph.SENSORS_INPUT, graph.MODEL_INPUT, "model"),
    "thesis_lkf1": FilterRole(),
    "thesis_lkf2": FilterRole(),
    "schlagenhauf_ekf": FilterRole(convention="model"),
}
"""Of each filter in ``filters.FILTERS``."""


def role_of(options: Mapping[str, Value]) -> FilterRole:
    """What the filter does in a graph with such options: its own role, but for what was asked for otherwise.

    Args:
        options: ``filter``, ``filter_input``, ``convention`` and ``angles_input``; absent or empty for nobody asked.

    Raises:
        GraphError: it was asked for what this filter cannot do.
    """
    name = str(options.get("filter") or DEFAULT_FILTER)
    own = ROLES.get(name, FilterRole())
    asked: dict[str, Any] = {
        "input": options.get("filter_input"),
        "convention": options.get("convention"),
        "angles_input": options.get("angles_input"),
    }
    role = replace(own, **{field: value for field, value in asked.items() if value and value != graph.AUTO})
    if role.input == graph.SENSORS_INPUT != own.input:
        raise graph.GraphError(f"filter {name} takes fused skeletons; its input cannot be the sensors")
    if role.convention == graph.POSITIONAL:
        return replace(role, angles_input=graph.SKELETON_INPUT)
    if role.angles_input == graph.MODEL_INPUT != own.angles_input:
        raise graph.GraphError(f"filter {name} has no model of the body; joint angles must be made of its skeleton")
    return role
