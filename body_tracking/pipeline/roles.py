"""The inputs and the angle convention that each filter implies."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

from body_tracking.core.parameters import Value
from body_tracking.pipeline import graph

DEFAULT_FILTER: Final = "lkf_constant_velocity"
"""The filter of nodes and commands unless another is chosen."""


@dataclass(frozen=True, slots=True)
class FilterRole:
    """Inputs and convention of a filter.

    Attributes:
        input: of ``skeleton_filter``: the fused skeleton, or every sensor.
        angles_input: of ``joint_angles``: the filtered skeleton, or the state of the filter's own model.
        convention: default convention of the joint angles.
    """

    input: str = graph.FUSED_INPUT
    angles_input: str = graph.SKELETON_INPUT
    convention: str = graph.POSITIONAL


NOTABLE_LATE: Final = 0.02
"""Share of the measurements that the filter may leave out as too late without a warning."""

ROLES: Final[Mapping[str, FilterRole]] = {
    "lkf_zero_velocity": FilterRole(),
    "lkf_constant_velocity": FilterRole(),
    "ekf": FilterRole(graph.SENSORS_INPUT, graph.MODEL_INPUT, "model"),
    "thesis_lkf1": FilterRole(),
    "thesis_lkf2": FilterRole(),
    "schlagenhauf_ekf": FilterRole(convention="model"),
}
"""The role of each filter in ``filters.FILTERS``."""


def role_of(options: Mapping[str, Value]) -> FilterRole:
    """The role of the filter in a graph: its own, overridden by options.

    Args:
        options: ``filter``, ``filter_input``, ``convention`` and ``angles_input``; absent or empty for the default.

    Raises:
        GraphError: the filter does not support the options.
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
