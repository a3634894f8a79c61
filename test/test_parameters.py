"""Parameters as data: types, ranges, files."""

from __future__ import annotations

from array import array
from dataclasses import dataclass, field
from pathlib import Path

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from body_tracking.core.parameters import (
    Numbers,
    Parameter,
    ParameterError,
    as_yaml,
    check_all,
    fields_of,
    matches,
    parameters_from,
    read_file,
    to_ros,
)
from body_tracking.systems import NODES, parameters_of

TABLE = (
    Parameter("gain", 1.0, "how much", unit="m", min=0.0, max=2.0),
    Parameter("count", 3, "how many", min=1, max=9),
    Parameter("mode", "fast", "how", choices=("fast", "slow")),
    Parameter("active", True, "whether"),
    Parameter("names", (), "who"),
    Parameter("place", Numbers((0.0, 0.0, 1.0)), "where"),
)


def test_given_values_are_taken_and_others_default() -> None:
    values = check_all(TABLE, {"gain": 2, "names": ["a", "", "b"], "place": array("d", [1.0, -2.0, 0.5])})
    expected = {"gain": 2.0, "count": 3, "mode": "fast", "active": True, "names": ("a", "b")}
    assert values == {**expected, "place": Numbers((1.0, -2.0, 0.5))}
    assert type(values["gain"]) is float
    # of whole numbers, as YAML has them, and once more
    place = TABLE[5].check([1, 2, 3])
    assert (TABLE[5].check(place), to_ros(place)) == (Numbers((1.0, 2.0, 3.0)), [1.0, 2.0, 3.0])
    # an empty list has a type in ROS
    assert (to_ros(()), to_ros(("a",))) == ([""], ["a"])
    assert TABLE[4].check(to_ros(())) == ()


@pytest.mark.parametrize(
    ("given_values", "said"),
    [
        ({"gian": 1.0}, "unknown parameter 'gian'; did you mean 'gain'?"),
        ({"gain": 2.1}, "'gain': 2.1, expected 0 to 2"),
        ({"gain": float("nan")}, "'gain': nan, expected 0 to 2"),
        ({"gain": "1"}, "'gain': '1', expected a number"),
        ({"gain": True}, "'gain': True, expected a number"),
        ({"count": 1.0}, "'count': 1.0, expected a whole number"),
        ({"count": 0}, "'count': 0, expected 1 to 9"),
        ({"mode": "medium"}, "'mode': 'medium', expected one of fast, slow"),
        ({"mode": "fsat"}, "'mode': 'fsat', expected one of fast, slow; did you mean 'fast'?"),
        ({"active": 1}, "'active': 1, expected true or false"),
        ({"names": "a"}, "'names': 'a', expected a list of strings"),
        ({"names": ["a", 1]}, "expected a list of strings"),
        ({"gain": None}, "'gain': None, expected a number"),
        ({"place": ["1", "2", "3"]}, "'place': ['1', '2', '3'], expected a list of 3 numbers"),
        ({"place": [1.0, 2.0]}, "'place': [1.0, 2.0], expected a list of 3 numbers"),
        ({"place": [1.0, 2.0, True]}, "expected a list of 3 numbers"),
        ({"place": [1.0, 2.0, float("nan")]}, "expected a list of 3 numbers"),
        ({"place": "1.0"}, "'place': '1.0', expected a list of 3 numbers"),
        ({"place": None}, "'place': None, expected a list of 3 numbers"),
    ],
)
def test_values_that_are_not_allowed_are_refused_in_one_line(given_values: dict[str, object], said: str) -> None:
    with pytest.raises(ParameterError) as caught:
        check_all(TABLE, given_values)
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


@given(st.floats(allow_nan=True, allow_infinity=True))
def test_a_number_is_taken_exactly_when_it_lies_in_its_range(value: float) -> None:
    parameter = TABLE[0]
    if 0.0 <= value <= 2.0:
        assert parameter.check(value) == value
    else:
        with pytest.raises(ParameterError):
            parameter.check(value)


@dataclass(frozen=True)
class Settings:
    """As the library's parameter classes are written."""

    speed: float = field(default=0.5, metadata={"doc": "how fast", "unit": "m/s", "min": 0.0, "max": 9.0})
    method: str = field(default="a", metadata={"doc": "how", "choices": ("a", "b")})
    plain: bool = False


def test_a_dataclass_becomes_parameters_and_back() -> None:
    table = parameters_from(Settings, live=True)
    assert table == (
        Parameter("speed", 0.5, "how fast", "m/s", 0.0, 9.0, live=True),
        Parameter("method", "a", "how", choices=("a", "b"), live=True),
        Parameter("plain", False, "", live=True),
    )
    values = check_all((*table, *TABLE), {"speed": 2})
    assert Settings(**fields_of(Settings, values)) == Settings(speed=2.0)
    prefixed = parameters_from(Settings, prefix="one.")
    assert [item.name for item in prefixed] == ["one.speed", "one.method", "one.plain"]
    values = check_all((*table, *prefixed), {"speed": 2, "one.speed": 3})
    assert Settings(**fields_of(Settings, values, prefix="one.")) == Settings(speed=3.0)


def test_the_written_file_reads_as_the_defaults(tmp_path: Path) -> None:
    file = tmp_path / "parameters.yaml"
    dotted = (Parameter("a.b", 1.0, "a part of a part"),)
    file.write_text(as_yaml({"node": TABLE, "other": TABLE[:1], "dotted": dotted}))
    sections = read_file(file)
    assert set(sections) == {"/node", "/other", "/dotted"}
    assert sections["/dotted"] == {"a.b": 1.0}
    assert check_all(TABLE, sections["/node"]) == check_all(TABLE, {})
    for parameter in TABLE:
        assert parameter.doc in file.read_text()


def test_namespaces_and_dotted_names_may_be_nested_and_lists_be_tuples_as_launch_writes_them(tmp_path: Path) -> None:
    file = tmp_path / "parameters.yaml"
    content = {"a": {"b": {"ros__parameters": {"x": {"y": 1}, "z": 2}}}, "/a/c": {"ros__parameters": {"z": ("a", "b")}}}
    file.write_text(yaml.dump(content))
    assert "!!python/tuple" in file.read_text()
    assert read_file(file) == {"/a/b": {"x.y": 1, "z": 2}, "/a/c": {"z": ["a", "b"]}}


@pytest.mark.parametrize("content", ["[1, 2]", "a: 1", "a: {ros__parameters: 1}", "a: [", "\x00"])
def test_invalid_file_is_refused(tmp_path: Path, content: str) -> None:
    file = tmp_path / "parameters.yaml"
    file.write_text(content)
    with pytest.raises(ParameterError, match=r"parameters\.yaml"):
        read_file(file)


@pytest.mark.parametrize(
    ("pattern", "node", "match"),
    [
        ("/**", "/fusion", True),
        ("/**", "/a/b/fusion", True),
        ("/*", "/fusion", True),
        ("/*", "/a/fusion", False),
        ("/**/fusion", "/fusion", True),
        ("/a/*", "/a/fusion", True),
        ("fusion", "/fusion", True),
        ("/fusion", "/fusion2", False),
    ],
)
def test_sections_match_nodes_as_in_ros(pattern: str, node: str, match: bool) -> None:
    assert matches(pattern, node) is match


def test_basic_parameters_come_first_and_are_some_of_the_nodes(tmp_path: Path) -> None:
    text = as_yaml({"node": TABLE}, {"node": [TABLE[-1].name]})
    assert text.index("# --- basic") < text.index(f"{TABLE[-1].name}:") < text.index("# --- advanced")
    file = tmp_path / "parameters.yaml"
    file.write_text(text)
    assert set(read_file(file)["/node"]) == {each.name for each in TABLE}
    for node in NODES.values():
        if node.stage:
            assert set(node.basic) <= {each.name for each in parameters_of(node.name)}
