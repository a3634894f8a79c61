"""Mapping files are parsed, and errors in them are refused by name."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from small_mappings import ANGLES, content, mapping

from body_tracking.core.message_types import JOINT_STATE
from body_tracking.core.parameters import parameters_from
from body_tracking.kinematics.conventions import ALL_CONVENTIONS, angle_names
from body_tracking.pipeline.graph import joint_states_stddev_topic
from body_tracking.recording.rosbag2 import BagReader, deserialize
from body_tracking.robot.mapping import MappingError, SafetyLimits, load

ROOT = Path(__file__).resolve().parents[2]


def test_a_joint_is_scale_times_angle_plus_offset() -> None:
    made = content()
    made["joints"][0] |= {"scale": -0.5, "offset": 1.0}
    del made["joints"][1]["angle"]
    made["joints"][1]["angles"] = [
        {"angle": "elbow_flexion_left", "weight": 1.0},
        {"angle": "shoulder_elevation_left", "weight": -0.25},
    ]
    made["joints"][1]["scale"] = 2.0
    found = mapping(made)
    assert found.joints == ("shoulder", "elbow")
    assert found.angles == ("shoulder_elevation_left", "elbow_flexion_left")
    np.testing.assert_allclose(found.matrix, [[-0.5, 0.0], [-0.5, 2.0]])
    np.testing.assert_allclose(found.offset, [1.0, 0.0])
    # the first joint has a period of half a turn; the sum's terms have no common period
    np.testing.assert_allclose(found.period, [np.pi, 0.0])
    np.testing.assert_array_equal(found.acceleration, [20.0, np.inf])
    np.testing.assert_allclose(found.max_stddev, 0.4)


def test_a_constant_joint_follows_nothing() -> None:
    made = content()
    del made["joints"][0]["angle"]
    made["joints"][0]["constant"] = 0.7
    found = mapping(made)
    assert found.angles == ("elbow_flexion_left",)
    assert not found.matrix[0].any()
    assert found.offset[0] == 0.7


def _joint(**changes: Any) -> Callable[[dict[str, Any]], None]:
    return lambda made: made["joints"][1].update(changes)


def _section(name: str, **changes: Any) -> Callable[[dict[str, Any]], None]:
    return lambda made: made[name].update(changes)


def _without(*path: str | int) -> Callable[[dict[str, Any]], None]:
    def change(made: Any) -> None:
        for step in path[:-1]:
            made = made[step]
        del made[path[-1]]

    return change


def _swapped(made: dict[str, Any]) -> None:
    made["joints"].reverse()


def _sum(*terms: tuple[str, float]) -> Callable[[dict[str, Any]], None]:
    def change(made: dict[str, Any]) -> None:
        del made["joints"][1]["angle"]
        made["joints"][1]["angles"] = [{"angle": angle, "weight": weight} for angle, weight in terms]

    return change


WRONG: dict[str, tuple[Callable[[dict[str, Any]], object], str]] = {
    "unknown joint": (_joint(name="elbov"), "unknown joint 'elbov': the controller's order has none; did you mean"),
    "joint not mapped": (_without("joints", 1), "joint 'elbow' of the controller's order is missing"),
    "unknown angle": (_joint(angle="elbow_flexion"), "joint 'elbow': unknown angle 'elbow_flexion'; did you mean"),
    "unknown angle in a sum": (_sum(("nose", 1.0)), "joint 'elbow': unknown angle 'nose'; known: shoulder_elevation"),
    "an angle of another convention": (_joint(angle="neck"), "joint 'elbow': unknown angle 'neck'"),
    "unknown convention": (lambda made: made.update(convention="isc"), "unknown convention 'isc'"),
    "empty limits": (_joint(lower=1.0, upper=1.0), "joint 'elbow': empty limits"),
    "inverted limits": (_joint(lower=1.0, upper=0.5), "joint 'elbow': inverted limits"),
    "a missing limit": (_without("joints", 1, "upper"), "joint 'elbow': upper is missing"),
    "no limit of the rate": (_without("joints", 1, "rate"), "joint 'elbow': rate is missing"),
    "a rate of zero": (_joint(rate=0.0), "joint 'elbow': 'rate': 0.0, expected 0.001 to 100"),
    "wrong order": (_swapped, "wrong order: joint 1 is 'elbow', but 'shoulder' in the controller's order"),
    "joint twice": (_joint(name="shoulder"), "joint 'shoulder' comes twice"),
    "joint twice in the order": (_section("output", order=["elbow", "elbow"]), "joint 'elbow' comes twice"),
    "angle twice": (_sum(("elbow_flexion_left", 1.0), ("elbow_flexion_left", 2.0)), "'elbow_flexion_left' comes twice"),
    "no number": (_joint(lower="zero"), "joint 'elbow': 'lower': 'zero', expected a number"),
    "a truth value": (_joint(scale=True), "joint 'elbow': 'scale': True, expected a number"),
    "not finite": (_joint(offset=float("nan")), "joint 'elbow': 'offset': nan, expected"),
    "infinite": (_joint(upper=float("inf")), "joint 'elbow': 'upper': inf, expected"),
    "unknown key": (_joint(lowr=1.0), "joint 'elbow': unknown key 'lowr'; did you mean 'lower'?"),
    "two sources": (
        _joint(constant=0.3),
        "joint 'elbow': expected one of angle, angles, constant; it has angle, constant",
    ),
    "no source": (
        _without("joints", 1, "angle"),
        "joint 'elbow': expected one of angle, angles, constant; it has none",
    ),
    "scale zero": (_joint(scale=0.0), "joint 'elbow': scale 0 follows nothing"),
    "home beyond limits": (_joint(home=-0.1), "joint 'elbow': home -0.1 is beyond its limits 0 to 2"),
    "another answer to doubt": (_joint(when_uncertain="go"), "joint 'elbow': 'when_uncertain': 'go', expected one of"),
    "cannot brake": (_joint(acceleration=0.5), "joint 'elbow': cannot brake within stop_after 2 s"),
    "another kind": (_section("output", kind="twist"), "output: 'kind': 'twist', expected one of joint_trajectory"),
    "a topic that is none": (
        _section("output", topic="arm"),
        "output: topic 'arm', expected a topic that begins with /",
    ),
    "no order": (_without("output", "order"), "output: order is missing"),
    "unknown threshold": (_section("safety", silense=1.0), "safety: unknown key 'silense'; did you mean 'silence'?"),
    "a threshold out of range": (_section("safety", silence=60.0), "safety: 'silence': 60.0, expected 0.02 to 5"),
    "prediction beyond the age": (_section("safety", prediction=0.5, max_age=0.1), "prediction 0.5 s is longer than"),
    "no joints": (lambda made: made.update(joints=[]), "joints: expected a list of at least one joint"),
    "a section that is none": (lambda made: made.update(output=3), "output: expected names and values"),
}


FILES = {
    "robot: [": "is not YAML",
    "- a": "the file: expected names and values",
    "robot: a\nrobot: b": "line 2: 'robot' comes twice",
    "robot: a": "the file: convention is missing",
    "joints: [{lower: 1, lower: 2}]": "line 1: 'lower' comes twice",
}


def _written(change: Callable[[dict[str, Any]], object]) -> str:
    made = content()
    change(made)
    text: str = yaml.safe_dump(made)
    return text


@pytest.mark.parametrize(
    ("text", "reported"),
    [
        *(pytest.param(_written(change), reported, id=wrong) for wrong, (change, reported) in WRONG.items()),
        *FILES.items(),
        (None, "cannot be read"),
    ],
)
def test_invalid_mappings_are_refused_by_name(text: str | None, reported: str, tmp_path: Path) -> None:
    file = tmp_path / "robot.yaml"
    if text is not None:
        file.write_text(text)
    with pytest.raises(MappingError) as caught:
        load(file, ANGLES)
    assert str(caught.value).startswith(f"{file}: ")
    assert reported in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("robot", ["two_joint_arm", "iiwa7"])
def test_the_shipped_mappings_are_sound(robot: str) -> None:
    found = load(ROOT / "config" / "robots" / f"{robot}.yaml", {name: angle_names(name) for name in ALL_CONVENTIONS})
    assert found.robot == robot
    assert found.output.state_topic


def test_the_iiwa_keeps_the_joints_that_kinects_do_not_measure(extended_wave: Path) -> None:
    """Deviations of forearm and hand are hardly ever below the limits; in the model's convention they are the same."""
    found = load(ROOT / "config" / "robots" / "iiwa7.yaml", {"isb": angle_names("isb")})
    limits = dict(zip(found.angles, found.max_stddev, strict=True))
    topic = joint_states_stddev_topic("body1")
    with BagReader(extended_wave) as bag:
        states = [deserialize(JOINT_STATE, raw.cdr) for raw in bag.messages([topic])]
    for angle, name in (
        ("elbow_pronation_left", "forearm_pronation"),
        ("wrist_flexion_left", "wrist_flexion"),
        ("wrist_ulnar_deviation_left", "wrist_deviation"),
    ):
        stddevs = np.array([state.position[state.name.index(f"{name}_left_body1")] for state in states])
        assert (stddevs < limits[angle]).mean() < 0.02


def test_the_documentation_knows_every_threshold_and_its_default() -> None:
    text = (ROOT / "docs" / "robots.md").read_text(encoding="utf-8")
    rows = {line.split("|")[1].strip(" `"): line.split("|")[2].strip() for line in text.splitlines() if "|" in line}
    for item in parameters_from(SafetyLimits):
        reported = rows[item.name]
        value = item.default
        assert isinstance(value, bool | float)
        expected = str(value).lower() if isinstance(value, bool) else f"{value:g}"
        assert reported.split()[0] == ("any" if expected == "inf" else expected)
