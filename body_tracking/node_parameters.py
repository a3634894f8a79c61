"""The parameters of a graph's nodes, from defaults, a parameters file and the graph's own settings."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from body_tracking.core.errors import did_you_mean
from body_tracking.core.parameters import (
    Parameter,
    ParameterError,
    Value,
    check_all,
    is_ros_own,
    is_wildcard,
    read_file,
)
from body_tracking.pipeline.system import NodeSpec
from body_tracking.systems import in_order, parameters_of


def parameters_for(
    specs: Sequence[NodeSpec],
    file: Path | None,
    defaults: Mapping[str, Mapping[str, Value]] | None = None,
    absent: Sequence[NodeSpec] = (),
) -> dict[str, dict[str, Value]]:
    """Every parameter that is set, for each node: defaults, overridden by the file, overridden by the graph.

    Args:
        specs: the nodes.
        file: a ROS parameters file, or None.
        defaults: more defaults by node name.
        absent: nodes that the file may have sections for, although they are not started.

    Raises:
        ParameterError: the file is invalid, has a section for an unknown node, unknown names or values that are not
            allowed.
    """
    if file is None:  # each node checks the graph's own values
        return {
            spec.name: {**spec.defaults, **(defaults or {}).get(spec.name, {}), **spec.parameters} for spec in specs
        }
    possible = {spec.name: spec for spec in (*absent, *specs)}
    tables = {spec.name: _table([spec]) for spec in specs}
    sections = read_file(file)
    for pattern, values in sections.items():
        about = [spec for spec in possible.values() if spec.in_section(pattern)]
        if not about:
            there = [spec.full_name for spec in possible.values()]
            hint = did_you_mean(pattern, there) or f"; there are {', '.join(there)}"
            raise ParameterError(f"{file}: {pattern}: no such node{hint}")
        given_here = {name: value for name, value in values.items() if not is_ros_own(name)}
        known = _table(spec for spec in about if spec.name in tables)
        if not given_here.keys() <= known.keys():  # of absent nodes, whose modules take a second to import
            known = _table(about)
        _check(known.values(), given_here, f"{file}: {pattern}")
    result: dict[str, dict[str, Value]] = {}
    for spec in specs:
        given: dict[str, object] = {**spec.defaults, **((defaults or {}).get(spec.name) or {})}
        for pattern, values in in_order(sections):
            if spec.in_section(pattern):
                wildcard = is_wildcard(pattern)
                given |= {name: v for name, v in values.items() if not wildcard or name in tables[spec.name]}
        given |= spec.parameters
        own: dict[str, Any] = {name: given.pop(name) for name in list(given) if is_ros_own(name)}
        checked = _check(tables[spec.name].values(), given, f"{file}: {spec.full_name}")
        result[spec.name] = {**own, **{name: checked[name] for name in given}}
    return result


def _table(specs: Iterable[NodeSpec]) -> dict[str, Parameter]:
    """The parameters of all these nodes, by name."""
    return {item.name: item for spec in specs for item in parameters_of(spec.executable)}


def _check(table: Iterable[Parameter], given: Mapping[str, object], where: str) -> dict[str, Value]:
    try:
        return check_all(tuple(table), given)
    except ParameterError as error:
        raise ParameterError(f"{where}: {error}") from None
