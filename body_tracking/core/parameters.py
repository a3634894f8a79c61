"""Parameters as data: name, unit, range and default of each parameter of a node.

The nodes declare these parameters, ``body_tracking up`` checks a parameters file against them before it starts a node,
and the documentation prints them.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, fields
from fnmatch import fnmatchcase
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeAlias

import yaml

from body_tracking.core import files
from body_tracking.core.errors import BodyTrackingError, did_you_mean, one_of


@dataclass(frozen=True, slots=True)
class Numbers:
    """A list of numbers as the value of a parameter."""

    values: tuple[float, ...]


Value: TypeAlias = bool | int | float | str | tuple[str, ...] | Numbers

SECTION = "ros__parameters"


class ParameterError(BodyTrackingError):
    """A parameter with an unknown name, of the wrong type or out of its range; or an invalid parameters file."""


@dataclass(frozen=True, slots=True)
class Parameter:
    """One parameter of a node.

    Attributes:
        name: as in a parameters file.
        default: its type is the parameter's type; a tuple is a list of strings, none of them empty, and
            :class:`Numbers` one of as many finite numbers.
        doc: one line.
        unit: or empty.
        min: the least value, of a number.
        max: the greatest value, of a number.
        choices: the allowed values, of a string; empty for any.
        live: whether it may change while the node runs.
        fixed: why it may not change while the node runs; empty for the usual reason, that it is read at the start.
    """

    name: str
    default: Value
    doc: str
    unit: str = ""
    min: float | None = None
    max: float | None = None
    choices: tuple[str, ...] = ()
    live: bool = False
    fixed: str = ""

    @property
    def type_name(self) -> str:
        """The type in words."""
        if isinstance(self.default, Numbers):
            return f"a list of {len(self.default.values)} numbers"
        names = {bool: "true or false", int: "a whole number", float: "a number", str: "a string"}
        return names.get(type(self.default), "a list of strings")

    @property
    def constraint(self) -> str:
        """The allowed values in words; empty for any."""
        if self.choices:
            return ", ".join(self.choices)
        if self.min is None and self.max is None:
            return ""
        if self.max is None:
            return f"at least {self.min:g}"
        return f"at most {self.max:g}" if self.min is None else f"{self.min:g} to {self.max:g}"

    def check(self, value: object) -> Value:
        """The value in the parameter's own type; an integer is accepted for a float.

        Raises:
            ParameterError: another type, or out of range.
        """
        checked = self._typed(value)
        if checked is None:
            raise ParameterError(f"parameter {self.name!r}: {value!r}, expected {self.type_name}")
        if isinstance(checked, int | float) and not isinstance(checked, bool):
            low = -math.inf if self.min is None else self.min
            high = math.inf if self.max is None else self.max
            # infinity is allowed only as a bound
            if not low <= checked <= high or (math.isinf(checked) and checked not in (self.min, self.max)):
                raise ParameterError(f"parameter {self.name!r}: {value!r}, expected {self.constraint or 'finite'}")
        if self.choices and checked not in self.choices:
            raise ParameterError(f"parameter {self.name!r}: {value!r}, {one_of(checked, self.choices)}")
        return checked

    def check_change(self, value: object) -> Value:
        """As :meth:`check`, for a change while the node runs.

        Raises:
            ParameterError: not allowed at all, or not while the node runs; states the reason and the remedy.
        """
        checked = self.check(value)
        if not self.live:
            why = self.fixed or "it is read at the start"
            raise ParameterError(
                f"parameter {self.name!r} cannot change while the node runs: {why}. "
                f"Restart it with the value in --params-file, or with -p {self.name}:=VALUE"
            )
        return checked

    def _typed(self, value: object) -> Value | None:
        if isinstance(self.default, tuple):
            if isinstance(value, list | tuple) and all(isinstance(item, str) for item in value):
                return tuple(item for item in value if item)  # ROS has no empty lists: [""] is one
            return None
        if isinstance(self.default, Numbers):
            items = value.values if isinstance(value, Numbers) else value
            if not isinstance(items, Sequence) or len(items) != len(self.default.values):
                return None
            if not all(isinstance(item, int | float) and not isinstance(item, bool) for item in items):
                return None
            return Numbers(tuple(float(item) for item in items)) if all(map(math.isfinite, items)) else None
        if isinstance(value, bool) or isinstance(self.default, bool):
            return value if isinstance(value, bool) and isinstance(self.default, bool) else None
        if isinstance(self.default, float) and isinstance(value, int | float):
            return float(value)
        return value if type(value) is type(self.default) else None


def number_field(default: float, doc: str, unit: str, low: float, high: float) -> float:
    """A field of a parameter dataclass that is a number from ``low`` to ``high``; see :func:`parameters_from`."""
    result: float = field(default=default, metadata={"doc": doc, "unit": unit, "min": low, "max": high})
    return result


def described_field(default: Value, doc: str) -> Any:
    """A field of a parameter dataclass of any type, without limits."""
    return field(default=default, metadata={"doc": doc})


def parameters_from(
    parameter_class: type[Any],
    *,
    only: Collection[str] = (),
    live: bool = False,
    prefix: str = "",
    fixed: Mapping[str, str] = MappingProxyType({}),
) -> tuple[Parameter, ...]:
    """A parameter per field of a library's parameter dataclass.

    Args:
        parameter_class: a dataclass with a default for every field; ``field(metadata=...)`` may hold ``doc``, ``unit``,
            ``min``, ``max`` and ``choices``.
        only: the fields that become parameters, by name; all when empty.
        live: whether they may change while the node runs.
        prefix: of the parameters' names, such as ``ekf.``.
        fixed: fields that may not change even if ``live``, with the reason; an empty reason for the usual one.
    """
    table = []
    for item in fields(parameter_class):
        if only and item.name not in only:
            continue
        default: Any = item.default
        known = {key: item.metadata[key] for key in ("unit", "min", "max") if key in item.metadata}
        choices = tuple(item.metadata.get("choices", ()))
        name, doc = f"{prefix}{item.name}", item.metadata.get("doc", "")
        known |= {"live": live and item.name not in fixed, "fixed": fixed.get(item.name, "")}
        table.append(Parameter(name, default, doc, choices=choices, **known))
    return tuple(table)


def check_fields(parameters: Any, what: str, error: type[BodyTrackingError]) -> None:
    """Check the values of a parameter dataclass by the metadata of its fields.

    Args:
        parameters: an instance of a class that :func:`parameters_from` takes.
        what: begins the error's text.
        error: the class of the error.

    Raises:
        BodyTrackingError: of the class ``error``; a value is of another type, or out of its range.
    """
    for item in parameters_from(type(parameters)):
        try:
            item.check(getattr(parameters, item.name))
        except ParameterError as problem:
            raise error(f"{what}: {problem}") from problem


def fields_of(parameter_class: type[Any], values: Mapping[str, Value], *, prefix: str = "") -> dict[str, Any]:
    """The node's values that are fields of a parameter dataclass; ``prefix`` as in :func:`parameters_from`."""
    names = (item.name for item in fields(parameter_class))
    return {name: values[f"{prefix}{name}"] for name in names if f"{prefix}{name}" in values}


def check_all(table: Sequence[Parameter], given: Mapping[str, object]) -> dict[str, Value]:
    """The value of every parameter: as given, else its default.

    Raises:
        ParameterError: an unknown name, a wrong type, a value out of range.
    """
    known = {parameter.name: parameter for parameter in table}
    for name in sorted(given.keys() - known.keys()):
        raise unknown_parameter(name, known)
    return {
        name: parameter.check(given[name]) if name in given else parameter.default for name, parameter in known.items()
    }


def unknown_parameter(name: str, known: Collection[str]) -> ParameterError:
    """The error for an unknown name, with the most similar known one."""
    hint = did_you_mean(name, known) or f"; known: {', '.join(sorted(known))}"
    return ParameterError(f"unknown parameter {name!r}{hint}")


# --- files


class _Loader(files.SafeLoader):  # type: ignore[misc]
    """PyYAML's safe loader that also reads the tuples that ``ros2 launch`` writes for lists."""


yaml.add_constructor("tag:yaml.org,2002:python/tuple", _Loader.construct_yaml_seq, _Loader)


def read_file(path: Path) -> dict[str, dict[str, object]]:
    """A ROS parameters file: for each node name or pattern, its parameters by full name.

    Raises:
        ParameterError: no such file, not YAML, or not of the form ``node: {ros__parameters: {name: value}}``.
    """
    content = files.read_yaml(path, _Loader, aliases=False, error=ParameterError)  # rcl takes no aliases
    sections: dict[str, dict[str, object]] = {}
    _collect(path, content if content is not None else {}, "", sections)
    return sections


def _collect(path: Path, content: object, name: str, sections: dict[str, dict[str, object]]) -> None:
    """Collect the sections of nested namespaces: ``ns: {node: {ros__parameters: ...}}``."""
    if not isinstance(content, dict):
        raise ParameterError(f"{path}: {name or 'the file'} holds no {SECTION}")
    for key, value in content.items():
        if key == SECTION:
            if not isinstance(value, dict):
                raise ParameterError(f"{path}: {name}: {SECTION} holds no names and values")
            flat = sections.setdefault(name, {})
            _flatten(value, "", flat)
            for parameter, given in flat.items():
                if isinstance(given, list) and any(isinstance(each, (list, dict)) for each in given):
                    raise ParameterError(f"{path}: {name}: {parameter}: a list holds no lists or mappings")
        else:
            _collect(path, value, f"{name}/{str(key).strip('/')}" if name else f"/{str(key).strip('/')}", sections)


def _flatten(values: Mapping[object, object], prefix: str, flat: dict[str, object]) -> None:
    """Collect full names: ROS writes ``a.b`` as ``a: {b: ...}`` too."""
    for key, value in values.items():
        if isinstance(value, dict):
            _flatten(value, f"{prefix}{key}.", flat)
        else:
            flat[f"{prefix}{key}"] = value


def as_yaml(
    sections: Mapping[str, Sequence[Parameter]], basic: Mapping[str, Collection[str]] = MappingProxyType({})
) -> str:
    """A commented parameters file with every parameter of each node at its default.

    Args:
        sections: by node.
        basic: by node the names of the parameters that come first, in a group of their own.
    """
    lines: list[str] = []
    for node, table in sections.items():
        lines += ["", f"{node}:", f"  {SECTION}:"]
        first, rest = grouped(table, basic.get(node, ()))
        for title, group in (("basic", first), ("advanced", rest)):
            if first and group:
                lines.append(f"    # --- {title}")
            for parameter in group:
                lines += _commented(parameter)
    return "\n".join(lines[1:]) + "\n"


def grouped(table: Sequence[Parameter], basic: Collection[str]) -> tuple[list[Parameter], list[Parameter]]:
    """The parameters of these names, and all others, each in their order."""
    return [each for each in table if each.name in basic], [each for each in table if each.name not in basic]


def _commented(parameter: Parameter) -> list[str]:
    notes = [part for part in (parameter.unit, parameter.constraint) if part]
    notes += ["may change while running"] if parameter.live else []
    text = parameter.doc + (f" ({'; '.join(notes)})" if notes else "")
    value = yaml.safe_dump(to_ros(parameter.default), default_flow_style=True).splitlines()[0]
    lines = textwrap.wrap(text, 112, initial_indent="    # ", subsequent_indent="    # ")
    return [*lines, f"    {parameter.name}: {value}"]


def matches(pattern: str, node: str) -> bool:
    """Whether a section of a parameters file applies to the node of this full name, such as ``/fusion``.

    ``*`` stands for one part of the name, ``**`` for any number of them.
    """
    parts, names = pattern.strip("/").split("/"), node.strip("/").split("/")

    def match(i: int, j: int) -> bool:
        if i == len(parts):
            return j == len(names)
        if parts[i] == "**":
            return any(match(i + 1, k) for k in range(j, len(names) + 1))
        return j < len(names) and fnmatchcase(names[j], parts[i]) and match(i + 1, j + 1)

    return match(0, 0)


def to_ros(value: Value) -> bool | int | float | str | list[str] | list[float]:
    """A value in ROS's types; an empty list, which has no type there, becomes ``[""]``."""
    if isinstance(value, Numbers):
        return list(value.values)
    return list(value) or [""] if isinstance(value, tuple) else value


def is_wildcard(pattern: str) -> bool:
    """Whether a section may apply to several nodes."""
    return "*" in pattern


def is_ros_own(name: str) -> bool:
    """Whether every ROS node has this parameter."""
    return name in ("use_sim_time", "start_type_description_service") or name.startswith("qos_overrides.")
