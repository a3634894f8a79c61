"""The table of the graph holds together, and everyone who starts the graph uses it."""

from __future__ import annotations

import ast
import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import yaml

from body_tracking import graph
from body_tracking.errors import BodyTrackingError
from body_tracking.filters import FILTERS
from body_tracking.graph import EXECUTABLES, TOPICS, GraphOptions, NodeSpec, all_nodes_for, nodes_for
from body_tracking.kinematics.positional import ANGLE_NAMES
from body_tracking.node_parameters import parameters_for
from body_tracking.parameters import ParameterError
from body_tracking.recording.rosbag2 import is_known

ROOT = Path(__file__).resolve().parent.parent
LAUNCH = ROOT / "launch" / "two_kinects.launch.py"

VARIANTS = [
    GraphOptions(),
    GraphOptions(sensors=("a", "b", "c"), record="somewhere"),
    GraphOptions(bag="bag", filter_name="lkf_zero_velocity", calibration_file="c.yaml", reliable=True),
    GraphOptions(bag="bag", record="somewhere", rate=2.0),
    GraphOptions(bag="bag", record="somewhere", filter_name="ekf", convention="isb"),
    GraphOptions(filter_name="schlagenhauf_ekf"),
    GraphOptions(filter_name="ekf", subject="all", people=3, imus=("forearm_left",)),
    GraphOptions(bag="bag", filter_name="ekf", convention="isb", robot="robot.yaml"),
    GraphOptions(sensors=("a", "b"), adapted=("b:/k4a/body_tracking_data",)),
    GraphOptions(bag="bag", viewer=True, markers=True),
    GraphOptions(viewer=True, record="somewhere"),
]


def named(specs: Sequence[NodeSpec]) -> dict[str, NodeSpec]:
    return {spec.name: spec for spec in specs}


@pytest.mark.parametrize("options", VARIANTS)
def test_every_parameter_in_the_table_is_one_of_its_node(options: GraphOptions) -> None:
    pytest.importorskip("rclpy", reason="ROS is not installed")
    for spec in nodes_for(options):
        known = {parameter.name: parameter for parameter in graph.parameters_of(spec.executable)}
        for name, value in {**spec.defaults, **spec.parameters}.items():
            if name != "use_sim_time":
                assert known[name].check(value) == value


def test_a_bag_takes_the_place_of_the_sensors_and_gives_the_time() -> None:
    live, played = named(nodes_for(GraphOptions())), named(nodes_for(GraphOptions(bag="bag", record="r")))
    assert {"kinect1_skeleton", "kinect2_skeleton"} <= set(live)
    assert "bag_player" not in live
    assert not any(name.endswith("t1_skeleton") for name in played)
    assert played["bag_player"].parameters["topics"] == ("/kinect1/skeleton", "/kinect2/skeleton")
    assert not any(spec.parameters.get("use_sim_time") for spec in live.values())
    assert all(spec.parameters["use_sim_time"] for name, spec in played.items() if name != "bag_player")
    # Calibration, fusion and recorder listen to the sensors.
    assert played["bag_player"].parameters["wait_for_subscribers"] == ("/kinect1/skeleton:3", "/kinect2/skeleton:3")


def test_sensors_of_somebody_else_need_no_nodes() -> None:
    own, external = nodes_for(GraphOptions()), nodes_for(GraphOptions(external=True))
    assert [spec for spec in own if spec.executable != "kinect_skeleton"] == list(external)
    played = GraphOptions(bag="bag")
    assert nodes_for(replace(played, external=True)) == nodes_for(played)


def test_every_filter_has_a_role_and_the_nodes_around_it_follow_that() -> None:
    assert set(graph.ROLES) == set(FILTERS)
    for name, role in graph.ROLES.items():
        specs = named(nodes_for(GraphOptions(bag="bag", record="r", filter_name=name)))
        # The angles follow what the filter publishes.
        angles = specs["joint_angles"].parameters
        assert "input" not in angles
        asked = str(angles.get("convention", graph.AUTO))
        assert graph.angles_for(asked, role.angles_input) == (role.convention, role.angles_input)
        # Calibration, fusion, recorder, and the filter where it listens to sensors.
        listeners = 4 if role.input == graph.SENSORS_INPUT else 3
        wanted = specs["bag_player"].parameters["wait_for_subscribers"]
        assert wanted == (f"/kinect1/skeleton:{listeners}", f"/kinect2/skeleton:{listeners}")
        after = specs["bag_player"].after
        assert after[graph.FUSED] == (1 if role.input == graph.SENSORS_INPUT else 2)
        listened = (
            (graph.MODEL_STATE, graph.MODEL_COVARIANCE) if role.angles_input == "model_state" else (graph.FILTERED,)
        )
        # The recorder leaves the model's covariance out.
        assert all(after[topic] == (1 if topic == graph.MODEL_COVARIANCE else 2) for topic in listened)
        whole = named(nodes_for(GraphOptions(bag="bag", record="r", record_covariance=True, filter_name=name)))
        assert whole["bag_recorder"].parameters["model_covariance"] is True
        assert all(whole["bag_player"].after[topic] == 2 for topic in listened)
        assert specs["skeleton_filter"].parameters["sensors"] == ("kinect1", "kinect2")


def test_those_who_track_know_of_each_other_whom() -> None:
    options = GraphOptions(filter_name="ekf", subject="all", people=2, imus=("forearm_left",))
    specs = named(nodes_for(options))
    for name in ("fusion", "skeleton_filter", "joint_angles"):
        assert (specs[name].parameters["subject"], specs[name].parameters["people"]) == ("all", 2)
    assert specs["imu_skeleton"].parameters["subject"] == "all"
    topics = [graph.model_topics(body, several=True) for body in ("body1", "body2")]
    assert options.bodies == ("body1", "body2")
    after = specs["kinect1_skeleton"].after
    assert {topic.state for topic in topics} | {topic.covariance for topic in topics} <= set(after)
    alone = graph.model_topics("body1")
    assert (alone.state, alone.covariance) == (graph.MODEL_STATE, graph.MODEL_COVARIANCE)
    assert GraphOptions().bodies == () and not named(nodes_for(GraphOptions()))["fusion"].parameters.get("subject")


def test_whom_to_track_is_in_the_parameters_file_or_on_the_command_line(tmp_path: Path) -> None:
    file = tmp_path / "people.yaml"
    file.write_text("/**: {ros__parameters: {subject: all, people: 4}}\n")
    assert graph.with_file(GraphOptions(), file).bodies == graph.bodies(4)
    assert graph.with_file(GraphOptions(subject="first", people=3), file).people == 3
    assert graph.with_file(GraphOptions(subject="first"), file).bodies == ()


def test_one_parameters_file_serves_in_every_namespace(tmp_path: Path) -> None:
    pytest.importorskip("rclpy", reason="ROS is not installed")
    file = tmp_path / "parameters.yaml"
    file.write_text(
        "/lab/fusion: {ros__parameters: {silence: 0.3}}\n"
        "fusion: {ros__parameters: {silence: 0.2, max_wait: 0.01}}\n"
        "skeleton_filter: {ros__parameters: {filter: ekf}}\n"
        "/**: {ros__parameters: {silence: 0.1, gate: 4.0}}\n"
    )
    for namespace, prefix in (("/", "/"), ("/lab", "/lab/")):
        options = graph.with_file(GraphOptions(namespace=namespace), file)
        assert options.filter_name == "ekf"
        assert {spec.full_name for spec in nodes_for(options)} == {
            f"{prefix}{spec.name}" for spec in nodes_for(options)
        }
    found = parameters_for(nodes_for(options), file)["fusion"]
    assert [found[name] for name in ("silence", "max_wait", "gate")] == [0.3, 0.01, 4.0]
    with pytest.raises(ParameterError, match="/lab/fusion: no such node"):
        parameters_for(nodes_for(GraphOptions()), file)


def test_a_robot_listens_to_every_sensor_and_is_there_before_anything_moves() -> None:
    specs = nodes_for(GraphOptions(bag="bag", record="r", filter_name="ekf", robot="robot.yaml"))
    assert specs[0].executable == "robot_commands"
    assert specs[0].parameters["mapping"] == "robot.yaml"
    assert specs[0].parameters["sensors"] == ("kinect1", "kinect2")
    assert specs[-1].parameters["wait_for_subscribers"] == ("/kinect1/skeleton:5", "/kinect2/skeleton:5")
    assert "robot_commands" not in named(nodes_for(GraphOptions()))


def test_the_convention_is_the_robots() -> None:
    file = ROOT / "config" / "robots" / "iiwa7.yaml"
    assert graph.convention_of_robot(file, "") == graph.convention_of_robot(file, "auto") == "isb"
    with pytest.raises(graph.GraphError, match=r"model: .*iiwa7\.yaml is about angles of the convention isb"):
        graph.convention_of_robot(file, "model")
    with pytest.raises(BodyTrackingError, match="cannot be read"):
        graph.convention_of_robot(ROOT / "nowhere.yaml", "")


def test_a_bag_waits_for_those_who_show_it_and_a_page_has_a_recorder_for_its_button() -> None:
    shown = named(nodes_for(GraphOptions(bag="bag", viewer=True, markers=True)))
    assert {"viewer", "body_markers", "bag_recorder"} <= set(shown)
    assert shown["bag_recorder"].parameters["start_recording"] is False
    # Calibration, fusion and the two that show it; the recorder does not listen yet.
    assert shown["bag_player"].parameters["wait_for_subscribers"] == ("/kinect1/skeleton:4", "/kinect2/skeleton:4")
    assert shown["bag_player"].after == {graph.FUSED: 3, graph.FILTERED: 3}
    recorded = named(nodes_for(GraphOptions(viewer=True, record="r")))["bag_recorder"]
    assert recorded.parameters == {"folder": "r", "use_sim_time": False}


def test_whether_the_covariance_is_recorded_is_in_the_parameters_file_or_on_the_command_line(tmp_path: Path) -> None:
    file = tmp_path / "parameters.yaml"
    file.write_text("/bag_recorder: {ros__parameters: {model_covariance: true}}\n")
    assert graph.with_file(GraphOptions(), file).record_covariance
    assert not graph.with_file(GraphOptions(), None).record_covariance
    assert graph.with_file(GraphOptions(record_covariance=True), None).record_covariance


def test_covariances_of_models_are_known_among_topics_in_every_namespace() -> None:
    topics = [graph.model_topics("body1"), graph.model_topics("body2", several=True)]
    for namespace in ("", "/lab", "/lab/left"):
        for each in topics:
            assert graph.is_model_covariance(f"{namespace}{each.covariance}")
            assert not any(map(graph.is_model_covariance, (each.state, each.stddev, each.segments, each.urdf)))


def test_persons_are_found_among_topics() -> None:
    topics = ["/humans/bodies/b/joint_states", "/humans/bodies/a/joint_states", "/humans/bodies/a/joint_states_stddev"]
    assert graph.bodies_among(topics) == ("a", "b")


def test_angles_of_positions_need_no_model() -> None:
    options = GraphOptions(filter_name="ekf", convention="positional")
    assert named(nodes_for(options))["joint_angles"].parameters["convention"] == "positional"
    assert named(nodes_for(options))["kinect1_skeleton"].after[graph.FILTERED] == 1
    assert graph.angles_for("positional", "model_state") == ("positional", "skeleton")
    assert graph.angles_for(graph.AUTO, "model_state") == ("model", "model_state")


@pytest.mark.parametrize(
    "options",
    [
        GraphOptions(filter_name="lkf_zero_velocity", filter_input="sensors"),
        GraphOptions(filter_name="schlagenhauf_ekf", angles_input="model_state"),
    ],
)
def test_a_filter_is_not_asked_for_what_it_cannot_do(options: GraphOptions) -> None:
    with pytest.raises(graph.GraphError, match=f"filter {options.filter_name}"):
        nodes_for(options)


@pytest.mark.parametrize("options", VARIANTS)
def test_names_are_unique_and_sources_come_last(options: GraphOptions) -> None:
    specs = nodes_for(options)
    assert len(named(specs)) == len(specs)
    assert {spec.executable for spec in specs} <= set(EXECUTABLES)
    assert specs[-1].executable in ("bag_player", "kinect_skeleton", "skeleton_adapter")
    assert set(named(specs)) <= set(named(all_nodes_for(options)))


def test_another_cameras_driver_takes_the_place_of_a_sensors_node() -> None:
    specs = named(nodes_for(GraphOptions(sensors=("a", "b", "c"), adapted=("b:/k4a/bodies", "c"))))
    assert specs["a_skeleton"].executable == "kinect_skeleton"
    assert specs["b_skeleton"].executable == specs["c_skeleton"].executable == "skeleton_adapter"
    assert specs["b_skeleton"].parameters == {"sensor": "b", "topic": "/k4a/bodies", "use_sim_time": False}
    assert "topic" not in specs["c_skeleton"].parameters
    with pytest.raises(graph.GraphError, match="adapted sensor 'd' is none of a, b"):
        nodes_for(GraphOptions(sensors=("a", "b"), adapted=("d",)))


@pytest.mark.parametrize("sensors", [(), ("a", "a"), ("fused",), ("a/b",)])
def test_sensors_that_cannot_be(sensors: tuple[str, ...]) -> None:
    with pytest.raises(BodyTrackingError):
        nodes_for(GraphOptions(sensors=sensors))


def test_sensors_are_found_among_topics() -> None:
    topics = ["/b/skeleton", "/a/skeleton", "/fused/skeleton", "/ground_truth/skeleton", "/a/b/skeleton", "/skeleton"]
    assert graph.sensors_among(topics) == ("a", "b")


def test_topics_have_known_types_and_publishers() -> None:
    assert len({topic.name for topic in TOPICS}) == len(TOPICS)
    for topic in TOPICS:
        assert is_known(topic.type_name) or topic.name in (graph.TF, graph.TF_STATIC, graph.TRACKED)
        assert topic.publisher in (*EXECUTABLES, "every node")


def test_the_parameters_file_is_as_the_code_has_it() -> None:
    pytest.importorskip("rclpy", reason="ROS is not installed")
    text = (ROOT / "config" / "body_tracking.yaml").read_text(encoding="utf-8")
    assert text == graph.config_text(), "run `make docs`"
    assert set(yaml.safe_load(text)) == set(named(all_nodes_for(GraphOptions())))


# `launch` is not on PyPI: that the launch file runs is checked on a ROS install; here, that it compiles, that what it
# takes from us is there, and that it repeats nothing of the table.


def test_the_launch_file_takes_its_nodes_from_the_table() -> None:
    source = LAUNCH.read_text(encoding="utf-8")
    tree = ast.parse(source)
    compile(tree, LAUNCH.name, "exec")
    assert any(isinstance(node, ast.FunctionDef) and node.name == "generate_launch_description" for node in tree.body)
    imported = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
    ours = {
        node.module: [alias.name for alias in node.names] for node in imported if "body_tracking" in str(node.module)
    }
    assert "nodes_for" in ours["body_tracking.graph"]
    for module, names in ours.items():
        found = __import__(str(module), fromlist=names)
        assert all(hasattr(found, name) for name in names)
    (node,) = [
        call
        for call in ast.walk(tree)
        if isinstance(call, ast.Call) and isinstance(call.func, ast.Name) and call.func.id == "Node"
    ]
    given = {keyword.arg: ast.unparse(keyword.value) for keyword in node.keywords}
    assert {name: given[name] for name in ("executable", "name", "namespace")} == {
        "executable": "spec.executable",
        "name": "spec.name",
        "namespace": "spec.namespace",
    }
    strings = {node.value for node in ast.walk(tree) if isinstance(node, ast.Constant) and isinstance(node.value, str)}
    assert not strings & {topic.name for topic in TOPICS}


def test_the_foxglove_layout_shows_topics_of_the_graph() -> None:
    """The format in which the application exports layouts: panels by id, and a tree that places every one of them."""
    layout = json.loads((ROOT / "foxglove" / "body_tracking.json").read_text(encoding="utf-8"))
    assert {"configById", "globalVariables", "userNodes", "playbackConfig", "layout"} == set(layout)
    panels = layout["configById"]

    def placed(tree: Any) -> list[str]:
        return [tree] if isinstance(tree, str) else placed(tree["first"]) + placed(tree["second"])

    assert sorted(placed(layout["layout"])) == sorted(panels)
    assert {panel.partition("!")[0] for panel in panels} == {"3D", "Plot", "DiagnosticSummary"}
    body = graph.DEFAULT_BODY
    known = {topic.name.replace("<id>", body) for topic in TOPICS} | {
        graph.skeleton_topic(sensor) for sensor in graph.DEFAULT_SENSORS
    }
    for name, panel in panels.items():
        shown = {*panel.get("topics", {}), panel.get("topicToRender", graph.DIAGNOSTICS_TOPIC)}
        shown |= {path["value"].partition(".")[0] for path in panel.get("paths", [])}
        assert shown <= known, name
    scene = panels["3D!bodies"]
    assert scene["topics"][graph.markers_topic(body)]["visible"]
    assert scene["followTf"] == "world"
    assert {path["value"].partition(".")[2] for path in panels["Plot!angles"]["paths"]} == {
        f"position[{ANGLE_NAMES.index(name)}]"
        for name in ("elbow_flexion_left", "elbow_flexion_right", "shoulder_elevation_left", "shoulder_elevation_right")
    }


def test_the_rviz_view_shows_topics_of_the_graph() -> None:
    view = yaml.safe_load((ROOT / "rviz" / "body_tracking.rviz").read_text(encoding="utf-8"))
    displays = view["Visualization Manager"]["Displays"]
    shown = {display["Topic"]["Value"] for display in displays if "Topic" in display}
    sensors = {graph.skeleton_topic(sensor) for sensor in graph.DEFAULT_SENSORS}
    robots = {display["Description Topic"]["Value"] for display in displays if "Description Topic" in display}
    body = graph.DEFAULT_BODY
    assert shown == sensors | {graph.FUSED, graph.FILTERED, graph.markers_topic(body)}
    assert robots == {graph.urdf_topic(body)}
    assert view["Visualization Manager"]["Global Options"]["Fixed Frame"] == "world"
