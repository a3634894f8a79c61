"""Mapping files: which joint of a robot follows which of the person's angles, within which limits.

A mapping is a YAML file; ``docs/robots.md`` explains it, ``config/robots/`` has two. Radians, seconds, metres::

    robot: two_joint_arm            # a name, for messages
    convention: isb                 # of the angles below
    output:
      kind: joint_trajectory        # or float64_multi_array
      topic: /arm_controller/joint_trajectory
      time_from_start: 0.02         # joint_trajectory: how long the controller takes to get there
      stamped: true                 # joint_trajectory: stamp with the present time, not with 0 ("now")
      state_topic: /arm/joint_states    # optional: the robot's own joint states
      order: [shoulder, elbow]      # as in the controller's own configuration
    joints:                         # in the same order
      - name: shoulder
        angle: shoulder_elevation_left          # or angles: [{angle: NAME, weight: NUMBER}, ...], or constant: NUMBER
        scale: -1.0                 # robot = scale * person + offset
        offset: 0.0
        lower: 0.0
        upper: 2.8
        rate: 2.0                   # rad/s
        acceleration: 20.0          # rad/s^2; optional: without it speed may change at once
        home: 0.0                   # where the robot stands at the start, without a state_topic
        max_stddev: 0.4             # of the person's angle; optional
        when_uncertain: hold_robot  # or hold_joint: only this joint holds its position
    safety: {...}                   # the fields of SafetyLimits

"""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from body_tracking.core import files
from body_tracking.core.errors import BodyTrackingError, did_you_mean
from body_tracking.core.parameters import (
    Parameter,
    ParameterError,
    Value,
    check_all,
    fields_of,
    number_field,
    parameters_from,
)
from body_tracking.core.skeleton import BoolArray, FloatArray

TRAJECTORY, ARRAY = "joint_trajectory", "float64_multi_array"
HOLD_ROBOT, HOLD_JOINT = "hold_robot", "hold_joint"


class MappingError(BodyTrackingError):
    """Raised when a mapping file cannot be read or its content is invalid."""


@dataclass(frozen=True, slots=True)
class SafetyLimits:
    """When to hold, when to stop, and how to resume."""

    silence: float = number_field(
        0.1,
        "the robot holds at the latest this long after the last new angles, and after the last frame of all sensors",
        "s",
        0.02,
        5.0,
    )
    max_age: float = number_field(0.3, "hold where angles are this long past their capture", "s", 0.02, 10.0)
    prediction: float = number_field(
        0.15, "predict angles at constant velocity from their capture to now, but no further than this", "s", 0.0, 1.0
    )
    max_stddev: float = number_field(
        0.35,
        "hold where the standard deviation of an angle, predicted to now, exceeds this; a joint may have its own",
        "rad",
        0.001,
        3.2,
    )
    recover_after: float = number_field(0.5, "begin again after everything was good for this long", "s", 0.0, 60.0)
    approach: float = number_field(
        1.5, "when it begins again, the rates grow from nothing to their limits over this time", "s", 0.0, 60.0
    )
    stop_after: float = number_field(2.0, "after holding for this long, publish nothing any more", "s", 0.1, 600.0)
    calibration: bool = field(
        default=True,
        metadata={"doc": "hold while the sensors are not calibrated, or their calibration is not reported"},
    )
    max_rotation_stddev: float = number_field(
        0.06, "hold where a sensor's orientation in world is less certain than this", "rad", 0.0001, 3.2
    )
    max_translation_stddev: float = number_field(
        0.05, "hold where a sensor's place in world, at the person's, is less certain than this", "m", 0.0001, 10.0
    )
    max_calibration_age: float = number_field(
        float("inf"),
        "hold where the calibration in use is older than this, or of unknown age; infinite: any age",
        "s",
        1.0,
        float("inf"),
    )
    max_tracking_error: float = number_field(
        # the error of an arm that lags by 0.2 s at 1.5 rad/s; also the greatest jump of an arm that is released
        0.3,
        "hold where a joint of the robot stands further than this from its command (with state_topic); while it "
        "approaches, less, in proportion to the rate, from a quarter of it on",
        "rad",
        0.001,
        float("inf"),
    )


@dataclass(frozen=True, slots=True)
class Output:
    """Where commands go, and in which form.

    Attributes:
        kind: ``TRAJECTORY`` or ``ARRAY``.
        topic: of the commands.
        time_from_start: seconds, of a trajectory's only point.
        stamped: whether a trajectory is stamped with its time; else with 0.
        state_topic: ``sensor_msgs/JointState`` of the robot; empty for none.
    """

    kind: str
    topic: str
    time_from_start: float
    stamped: bool
    state_topic: str


@dataclass(frozen=True, slots=True, eq=False)
class RobotMapping:
    """A checked mapping of m angles to n joints; arrays are by joint, in the controller's order.

    Attributes:
        robot: its name.
        convention: of the angles.
        output: where commands go.
        safety: when to hold.
        joints: n names.
        names: of all angles of the convention, in their order.
        angles: m names of the angles that are used, each once.
        matrix: (n, m) derivative of a joint's position by an angle: scale times weight; zeros for a constant joint.
        offset: (n,) radians.
        period: (n,) radians that a whole turn of an angle adds to the joint; 0 where the angles of a sum have
            different weights and so no common period.
        lower, upper, home: (n,) radians.
        rate: (n,) rad/s.
        acceleration: (n,) rad/s^2; infinite where not limited.
        max_stddev: (n,) radians, for each of a joint's angles.
        alone: (n,) whether only this joint holds while its angles are unknown, and the others continue.
    """

    robot: str
    convention: str
    output: Output
    safety: SafetyLimits
    joints: tuple[str, ...]
    names: tuple[str, ...]
    angles: tuple[str, ...]
    matrix: FloatArray
    offset: FloatArray
    period: FloatArray
    lower: FloatArray
    upper: FloatArray
    home: FloatArray
    rate: FloatArray
    acceleration: FloatArray
    max_stddev: FloatArray
    alone: BoolArray


def _number(name: str, default: float, doc: str) -> Parameter:
    return Parameter(name, default, doc, min=-1e3, max=1e3)


_JOINT = (
    Parameter("name", "", "of the robot's joint"),
    Parameter("angle", "", "of the person that it follows"),
    _number("scale", 1.0, "robot = scale * person + offset"),
    _number("offset", 0.0, "robot = scale * person + offset"),
    _number("constant", 0.0, "in place of an angle"),
    _number("lower", 0.0, "limit"),
    _number("upper", 0.0, "limit"),
    Parameter("rate", 0.0, "limit", min=1e-3, max=100.0),
    Parameter("acceleration", 1.0, "limit", min=1e-3, max=1e5),
    _number("home", 0.0, "at the start"),
    Parameter("max_stddev", 0.35, "of the angle", min=1e-3, max=3.2),
    Parameter("when_uncertain", HOLD_ROBOT, "who holds", choices=(HOLD_ROBOT, HOLD_JOINT)),
)
_TERM = (Parameter("angle", "", "of the person"), _number("weight", 1.0, "in the sum"))
_OUTPUT = (
    Parameter("kind", TRAJECTORY, "message", choices=(TRAJECTORY, ARRAY)),
    Parameter("topic", "", "of the commands"),
    Parameter("time_from_start", 0.02, "of the point", min=0.001, max=10.0),
    Parameter("stamped", True, "or 0"),
    Parameter("state_topic", "", "of the robot"),
    Parameter("order", (), "of the controller"),
)
_TOP = ("robot", "convention", "output", "joints", "safety")


class _Loader(files.SafeLoader):  # type: ignore[misc]
    """YAML that refuses duplicate keys, of which the second would silently replace the first."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        keys = [self.construct_object(key, deep=True) for key, _ in node.value]
        for number, key in enumerate(keys):
            if key in keys[:number]:
                raise MappingError(f"line {node.value[number][0].start_mark.line + 1}: {key!r} comes twice")
        mapping: dict[Hashable, Any] = super().construct_mapping(node, deep)
        return mapping


def load(path: Path, angle_names: Mapping[str, Sequence[str]]) -> RobotMapping:
    """Read and check a mapping file.

    Args:
        path: of the file.
        angle_names: the angles of each convention.

    Raises:
        MappingError: no such file, not YAML; an unknown, missing or duplicate key; a value that is no number, not
            finite or out of its range; an unknown convention, angle or joint; a joint or angle twice; empty or inverted
            limits, a home or constant beyond them; another joint order than the controller's; a stopping time too
            short to brake. The text names the file and the item.
    """
    try:
        content = files.read_yaml(path, _Loader)
    except (files.FileError, MappingError) as error:
        raise MappingError(f"{path}: {error}") from None
    try:
        return parse(content, angle_names)
    except (MappingError, ParameterError) as error:
        raise MappingError(f"{path}: {str(error).replace('parameter ', '')}") from None


def parse(content: object, angle_names: Mapping[str, Sequence[str]]) -> RobotMapping:
    """Parse the content of a mapping file; errors as of :func:`load`, without the file's name."""
    top = _section(content, "the file", "robot", "convention", "output", "joints", known=_TOP)
    robot, convention = (_text(top[key], key) for key in ("robot", "convention"))
    if convention not in angle_names:
        raise MappingError(f"unknown convention {convention!r}; known: {', '.join(angle_names)}")
    output, order = _output(top["output"])
    safety = _safety(top.get("safety", {}))
    if not isinstance(top["joints"], list) or not top["joints"]:
        raise MappingError("joints: expected a list of at least one joint")
    joints = [_joint(entry, number, angle_names[convention]) for number, entry in enumerate(top["joints"], 1)]
    names = tuple(str(joint["name"]) for joint in joints)
    _check_order(names, order)
    for joint in joints:
        _check_motion(joint, safety)
    angles = tuple(dict.fromkeys(angle for joint in joints for angle, _ in joint["terms"]))
    matrix = np.zeros((len(joints), len(angles)))
    for row, joint in zip(matrix, joints, strict=True):
        for angle, weight in joint["terms"]:
            row[angles.index(angle)] = joint["scale"] * weight

    def column(key: str) -> FloatArray:
        return np.array([joint[key] for joint in joints], dtype=np.float64)

    columns = ("offset", "lower", "upper", "home", "rate", "acceleration", "max_stddev")
    return RobotMapping(
        robot=robot,
        convention=convention,
        output=output,
        safety=safety,
        joints=names,
        names=tuple(angle_names[convention]),
        angles=angles,
        matrix=matrix,
        period=np.array([_period(row) for row in matrix]),
        alone=np.array([joint["when_uncertain"] == HOLD_JOINT for joint in joints]),
        **{key: column(key) for key in columns},
    )


def _period(row: FloatArray) -> float:
    used = np.abs(row[row != 0.0])
    return float(2.0 * np.pi * used[0]) if used.size and np.ptp(used) == 0.0 else 0.0


def _output(content: object) -> tuple[Output, tuple[str, ...]]:
    values: dict[str, Any] = _checked(_OUTPUT, _section(content, "output", "kind", "topic", "order"), "output")
    for key in ("topic", "state_topic"):
        topic = str(values[key])
        if not (topic.startswith("/") and topic.strip("/")) and (topic or key == "topic"):
            raise MappingError(f"output: {key} {topic!r}, expected a topic that begins with /")
    order = values.pop("order")
    return Output(**values), order


def _safety(content: object) -> SafetyLimits:
    table = parameters_from(SafetyLimits)
    safety = SafetyLimits(**fields_of(SafetyLimits, _checked(table, _section(content, "safety"), "safety")))
    if safety.prediction > safety.max_age:
        raise MappingError(
            f"safety: prediction {safety.prediction:g} s is longer than max_age {safety.max_age:g} s, "
            "after which nothing is followed"
        )
    return safety


def _joint(content: object, number: int, known_angles: Sequence[str]) -> dict[str, Any]:
    given = dict(_section(content, f"joint {number}"))
    what = f"joint {given['name']!r}" if isinstance(given.get("name"), str) else f"joint {number}"
    sources = [key for key in ("angle", "angles", "constant") if key in given]
    if len(sources) != 1:
        raise MappingError(f"{what}: expected one of angle, angles, constant; it has {', '.join(sources) or 'none'}")
    terms = given.pop("angles", None)
    _section(given, what, "name", "lower", "upper", "rate", "home")
    joint: dict[str, Any] = _checked(_JOINT, given, what)
    if not joint["name"]:
        raise MappingError(f"{what}: no name")
    joint |= {key: value for key, value in {"acceleration": np.inf, "max_stddev": None}.items() if key not in given}
    if sources == ["constant"]:
        if "scale" in given or "offset" in given:
            raise MappingError(f"{what}: a constant has neither scale nor offset")
        joint["terms"], joint["offset"] = [], joint["constant"]
    else:
        joint["terms"] = _terms(terms, what) if sources == ["angles"] else [(joint["angle"], 1.0)]
        if joint["scale"] == 0.0:
            raise MappingError(f"{what}: scale 0 follows nothing; use constant")
    for angle, _ in joint["terms"]:
        if angle not in known_angles:
            raise MappingError(f"{what}: unknown angle {angle!r}{_hint(angle, known_angles)}")
    return joint


def _terms(content: object, what: str) -> list[tuple[str, float]]:
    if not isinstance(content, list) or not content:
        raise MappingError(f"{what}: angles: expected a list of {{angle: NAME, weight: NUMBER}}")
    terms: list[tuple[str, float]] = []
    for entry in content:
        given = _section(entry, f"{what}: angles", "angle", "weight")
        values: dict[str, Any] = _checked(_TERM, given, f"{what}: angles")
        if values["weight"] == 0.0:
            raise MappingError(f"{what}: weight 0 of angle {values['angle']!r} follows nothing")
        terms.append((values["angle"], values["weight"]))
    _once([angle for angle, _ in terms], f"{what}: angle")
    return terms


def _once(names: Sequence[str], what: str) -> None:
    for name, count in Counter(names).items():
        if count > 1:
            raise MappingError(f"{what} {name!r} comes twice")


def _check_order(names: tuple[str, ...], order: tuple[str, ...]) -> None:
    _once(names, "joints: joint")
    _once(order, "output: order: joint")
    for name in names:
        if name not in order:
            raise MappingError(f"unknown joint {name!r}: the controller's order has none{_hint(name, order)}")
    for name in order:
        if name not in names:
            raise MappingError(f"joint {name!r} of the controller's order is missing among the joints")
    for place, (name, wanted) in enumerate(zip(names, order, strict=True), 1):
        if name != wanted:
            raise MappingError(f"wrong order: joint {place} is {name!r}, but {wanted!r} in the controller's order")


def _check_motion(joint: dict[str, Any], safety: SafetyLimits) -> None:
    what, lower, upper = f"joint {joint['name']!r}", joint["lower"], joint["upper"]
    if lower > upper:
        raise MappingError(f"{what}: inverted limits: lower {lower:g} is above upper {upper:g}")
    if lower == upper:
        raise MappingError(
            f"{what}: empty limits: lower and upper are {lower:g}; for a joint that stands, use constant"
        )
    for key, value in (("home", joint["home"]), *((("constant", joint["offset"]),) if not joint["terms"] else ())):
        if not lower <= value <= upper:
            raise MappingError(f"{what}: {key} {value:g} is beyond its limits {lower:g} to {upper:g}")
    if joint["rate"] / joint["acceleration"] > safety.stop_after:
        raise MappingError(f"{what}: cannot brake within stop_after {safety.stop_after:g} s")
    if joint["max_stddev"] is None:
        joint["max_stddev"] = safety.max_stddev


def _section(content: object, what: str, *required: str, known: Sequence[str] = ()) -> Mapping[str, object]:
    """Check that the content is a mapping with all required keys and, if ``known`` is given, no unknown ones."""
    if not isinstance(content, dict) or not all(isinstance(key, str) for key in content):
        raise MappingError(f"{what}: expected names and values")
    for key in content:
        if known and key not in known:
            raise MappingError(f"{what}: unknown key {key!r}{_hint(key, known)}")
    for key in required:
        if key not in content:
            raise MappingError(f"{what}: {key} is missing")
    return content


def _checked(table: Sequence[Parameter], given: Mapping[str, object], what: str) -> dict[str, Value]:
    _section(given, what, known=[item.name for item in table])
    try:
        return check_all(table, given)
    except ParameterError as error:
        raise MappingError(f"{what}: {error}") from None


def _text(value: object, what: str) -> str:
    if not isinstance(value, str) or not value:
        raise MappingError(f"{what}: {value!r}, expected a name")
    return value


def _hint(name: str, known: Sequence[str]) -> str:
    return did_you_mean(name, known) or f"; known: {', '.join(known)}"
