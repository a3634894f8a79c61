"""The table of the graph is consistent, and every way to start the graph uses it."""

from __future__ import annotations

import ast
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
import yaml

from body_tracking import systems
from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.parameters import ParameterError
from body_tracking.filters import FILTERS
from body_tracking.kinematics.positional import ANGLE_NAMES
from body_tracking.node_parameters import parameters_for
from body_tracking.pipeline import graph
from body_tracking.pipeline.roles import ROLES
from body_tracking.pipeline.system import NodeSpec, Options
from body_tracking.recording.rosbag2 import is_known
from body_tracking.robot.system import convention_of
from body_tracking.systems import EXECUTABLES, TOPICS, all_nodes_for, angles_topics, nodes_for, options_of, subscribers

ROOT = Path(__file__).resolve().parent.parent
LAUNCH = ROOT / "launch" / "two_kinects.launch.py"

VARIANTS = [
    options_of(),
    options_of(sensors=("a", "b", "c"), record="somewhere"),
    options_of(bag="bag", filter="lkf_zero_velocity", calibration="c.yaml", reliable=True),
    options_of(bag="bag", record="somewhere", rate=2.0, loop=True, start=3.0),
    options_of(bag="bag", record="somewhere", filter="ekf", convention="isb"),
    options_of(filter="schlagenhauf_ekf"),
    options_of(filter="ekf", subject="all", people=3, imus=("forearm_left",)),
    options_of(bag="bag", filter="ekf", convention="isb", robot="robot.yaml"),
    options_of(sensors=("a", "b"), adapt=("b:/k4a/body_tracking_data",)),
    options_of(bag="bag", viewer=True, markers=True),
    options_of(viewer=True, record="somewhere"),
]


def named(specs: Sequence[NodeSpec]) -> dict[str, NodeSpec]:
    return {spec.name: spec for spec in specs}


@pytest.mark.parametrize("options", VARIANTS)
def test_every_parameter_in_the_table_is_one_of_its_node(options: Options) -> None:
    pytest.importorskip("rclpy", reason="ROS is not installed")
    for spec in nodes_for(options):
        known = {parameter.name: parameter for parameter in systems.parameters_of(spec.executable)}
        for name, value in {**spec.defaults, **spec.parameters}.items():
            if name != "use_sim_time":
                assert known[name].check(value) == value


CLOUD, IMAGES, JPEGS, READINGS, MARKERS = (
    f"{package}/msg/{name}"
    for package, name in (
        ("sensor_msgs", "PointCloud2"),
        ("sensor_msgs", "Image"),
        ("sensor_msgs", "CompressedImage"),
        ("sensor_msgs", "Imu"),
        ("visualization_msgs", "MarkerArray"),
    )
)


@pytest.mark.parametrize(
    ("topics", "expected"),
    [
        ({"/rosout": "rcl_interfaces/msg/Log", "/fused/skeleton": CLOUD, "/imu/skeleton": CLOUD}, {}),
        ({"/b/skeleton": CLOUD, "/a/skeleton": CLOUD}, {"sensors": ("a", "b"), "external": True}),
        (
            {"/a/skeleton": CLOUD, "/a/depth/image_raw": IMAGES, "/hand_left/imu/data": READINGS},
            {"sensors": ("a",), "external": True, "imus": ("hand_left",)},
        ),
        (
            {"/forearm_left/imu/data_raw": READINGS, "/pelvis/imu/data": READINGS, "/table/imu/data": READINGS},
            {"imus": ("pelvis", "forearm_left"), "sensors": ()},
        ),
        ({"/k4a/body_tracking_data": MARKERS}, {"sensors": ("azure1",), "adapt": ("azure1:/k4a/body_tracking_data",)}),
        ({"/a/color/image_raw": IMAGES, "/a/depth/image_raw": IMAGES}, {"camera": ("a",)}),
        (
            {"/camera/d435/color/image_raw": IMAGES, "/camera/d435/aligned_depth_to_color/image_raw": IMAGES},
            {"camera": ("d435",), "driver": "realsense"},
        ),
        (
            {"/a/color/image_raw/compressed": JPEGS, "/a/depth/image_raw": IMAGES},
            {"camera": ("a",), "compressed": "colour"},
        ),
        ({"/a/depth/image_raw": IMAGES}, {"depth": ("a",)}),
    ],
)
def test_sensors_that_publish_become_options_of_a_graph(topics: dict[str, str], expected: dict[str, Any]) -> None:
    found = systems.found_sensors(topics)
    assert found == expected
    if found:
        assert systems.names_sensors(found)
        nodes_for(options_of(**found))


def test_a_bag_takes_the_place_of_the_sensors_and_gives_the_time() -> None:
    topics = ("/kinect1/skeleton", "/kinect2/skeleton")
    live, played = named(nodes_for(options_of())), named(nodes_for(options_of(bag="bag", record="r", played=topics)))
    assert {"kinect1_skeleton", "kinect2_skeleton"} <= set(live)
    assert "bag_player" not in live
    assert not any(name.endswith("t1_skeleton") for name in played)
    assert played["bag_player"].parameters["topics"] == topics
    assert not any(spec.parameters.get("use_sim_time") for spec in live.values())
    assert all(spec.parameters["use_sim_time"] for name, spec in played.items() if name != "bag_player")


def test_external_sensors_need_no_nodes() -> None:
    own, external = nodes_for(options_of()), nodes_for(options_of(external=True))
    assert [spec for spec in own if spec.executable != "kinect_skeleton"] == list(external)
    assert nodes_for(options_of(bag="bag", external=True)) == nodes_for(options_of(bag="bag"))


def counted(**given: Any) -> dict[str, int]:
    """The number of nodes that take each topic of a graph."""
    played = tuple(map(graph.skeleton_topic, graph.DEFAULT_SENSORS)) if given.get("bag") else ()
    specs = nodes_for(options_of(**given, played=played))
    return subscribers(specs, parameters_for(specs, None))


def published_angles(options: Options) -> tuple[str, ...]:
    """The ids of the people whose angles a graph publishes."""
    specs = nodes_for(options)
    return tuple(topic.split("/")[3] for topic in angles_topics(specs, parameters_for(specs, None)))


@pytest.mark.parametrize("name", FILTERS)
def test_nodes_follow_the_filters_role_and_sources_wait_for_subscribers(name: str) -> None:
    role = ROLES[name]
    specs = named(nodes_for(options_of(bag="bag", record="r", filter=name)))
    angles = specs["joint_angles"].parameters
    assert "input" not in angles
    asked = str(angles.get("convention", graph.AUTO))
    assert graph.angles_for(asked, role.angles_input) == (role.convention, role.angles_input)
    by_sensor, of_model = role.input == graph.SENSORS_INPUT, role.angles_input == graph.MODEL_INPUT
    alone, recorded = counted(bag="bag", filter=name), counted(bag="bag", filter=name, record="r")
    sensors = {graph.skeleton_topic(sensor): 2 + by_sensor for sensor in graph.DEFAULT_SENSORS}
    wanted = {**sensors, graph.FUSED: int(not by_sensor), graph.FILTERED: int(not of_model)}
    wanted |= {graph.MODEL_STATE: int(of_model), graph.MODEL_COVARIANCE: int(of_model)}
    assert {topic: alone.get(topic, 0) for topic in wanted} == wanted
    written = {topic for topic in wanted if topic in recorded} - {graph.MODEL_COVARIANCE}
    assert all(recorded[topic] == wanted[topic] + 1 for topic in written) and graph.FILTERED in written
    # the recorder leaves the model's covariance out, unless it is asked for
    assert recorded.get(graph.MODEL_COVARIANCE, 0) == of_model
    whole = counted(bag="bag", filter=name, record="r", model_covariance=True)
    assert whole.get(graph.MODEL_COVARIANCE, 0) == 2 * of_model


def test_all_tracking_nodes_have_the_same_subject() -> None:
    given: dict[str, Any] = {"filter": "ekf", "subject": "all", "people": 2, "imus": ("forearm_left",)}
    specs = named(nodes_for(options_of(**given)))
    for name in ("fusion", "skeleton_filter", "joint_angles"):
        assert (specs[name].parameters["subject"], specs[name].parameters["people"]) == ("all", 2)
    assert specs["imu_skeleton"].parameters["subject"] == "all"
    topics = [
        angles_topics(each, parameters_for(each, None)) for each in (tuple(specs.values()), nodes_for(options_of()))
    ]
    assert topics == [tuple(map(graph.joint_states_topic, ("body1", "body2"))), (graph.joint_states_topic("body1"),)]
    found = counted(**given)
    for body in ("body1", "body2"):
        topics = graph.model_topics(body, several=True)
        assert found[topics.state] == found[topics.covariance] == 1
    # inertial sensors take their world from the fusion, and the reference sensor's clock
    assert found[graph.FUSED] == 1 and found["/kinect1/skeleton"] == found["/kinect2/skeleton"] + 1
    assert found[graph.orientation_topic("forearm_left")] == 1
    alone = graph.model_topics("body1")
    assert (alone.state, alone.covariance) == (graph.MODEL_STATE, graph.MODEL_COVARIANCE)


def test_subject_is_set_by_file_or_command_line(tmp_path: Path) -> None:
    file = tmp_path / "people.yaml"
    file.write_text("/**: {ros__parameters: {subject: all, people: 4}}\n")
    assert published_angles(systems.with_file(options_of(), file)) == graph.bodies(4)
    assert systems.with_file(options_of(people=3), file)["people"] == 3
    assert published_angles(systems.with_file(options_of(subject="first"), file)) == ("body1",)


def test_one_parameters_file_serves_in_every_namespace(tmp_path: Path) -> None:
    pytest.importorskip("rclpy", reason="ROS is not installed")
    file = tmp_path / "parameters.yaml"
    file.write_text(
        "/lab/calibration: {ros__parameters: {reference_height: 0.3}}\n"
        "calibration: {ros__parameters: {reference_height: 0.2, reference_roll: 0.01}}\n"
        "skeleton_filter: {ros__parameters: {filter: ekf}}\n"
        "/**: {ros__parameters: {reference_height: 0.1, reference_pitch: 0.4}}\n"
    )
    for namespace, prefix in (("/", "/"), ("/lab", "/lab/")):
        options = systems.with_file(options_of(namespace=namespace), file)
        assert options["filter"] == "ekf"
        assert {spec.full_name for spec in nodes_for(options)} == {
            f"{prefix}{spec.name}" for spec in nodes_for(options)
        }
    found = parameters_for(nodes_for(options), file)["calibration"]
    assert [found[name] for name in ("reference_height", "reference_roll", "reference_pitch")] == [0.3, 0.01, 0.4]
    with pytest.raises(ParameterError, match="/lab/calibration: no such node"):
        parameters_for(nodes_for(options_of()), file)


def test_robot_and_viewers_subscribe_to_every_sensor() -> None:
    specs = named(nodes_for(options_of(bag="bag", robot="robot.yaml")))
    assert specs["robot_commands"].parameters["mapping"] == "robot.yaml"
    assert specs["robot_commands"].parameters["sensors"] == ("kinect1", "kinect2")
    assert "robot_commands" not in named(nodes_for(options_of()))
    shown = named(nodes_for(options_of(bag="bag", viewer=True, markers=True)))
    assert {"viewer", "body_markers", "bag_recorder"} <= set(shown)
    assert shown["bag_recorder"].parameters["start_recording"] is False
    recorded = named(nodes_for(options_of(viewer=True, record="r")))["bag_recorder"]
    assert recorded.parameters == {"folder": "r", "use_sim_time": False}
    plain = counted(bag="bag")
    for given, listeners in (({"robot": "robot.yaml"}, 1), ({"viewer": True, "markers": True}, 2)):
        found = counted(bag="bag", **given)
        for sensor in graph.DEFAULT_SENSORS:
            topic = graph.skeleton_topic(sensor)
            assert found[topic] == plain[topic] + listeners


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({}, ""),
        ({"camera": ("camera1",)}, "ekf"),
        ({"camera": ("camera1", "camera2"), "imus": ("forearm_left",)}, "ekf"),
        ({"camera": ("camera1",), "sensors": ("kinect1",)}, ""),
        ({"camera": ("camera1",), "depth": ("kinect1",)}, ""),
        ({"camera": ("camera1",), "filter": "lkf_zero_velocity"}, "lkf_zero_velocity"),
    ],
)
def test_cameras_alone_are_filtered_by_the_filter_that_knows_angles_by_their_deviations(
    given: dict[str, Any], expected: str
) -> None:
    assert systems.with_file(options_of(**given), None)["filter"] == expected


def test_a_parameters_file_chooses_the_filter_of_cameras(tmp_path: Path) -> None:
    file = tmp_path / "parameters.yaml"
    file.write_text("skeleton_filter: {ros__parameters: {filter: lkf_constant_velocity}}")
    assert systems.with_file(options_of(camera=("camera1",)), file)["filter"] == "lkf_constant_velocity"


def test_convention_follows_the_robot() -> None:
    file = ROOT / "config" / "robots" / "iiwa7.yaml"
    assert convention_of(file, "") == convention_of(file, "auto") == "isb"
    with pytest.raises(graph.GraphError, match=r"model: .*iiwa7\.yaml needs angles of the convention isb"):
        convention_of(file, "model")
    with pytest.raises(BodyTrackingError, match="cannot be read"):
        convention_of(ROOT / "nowhere.yaml", "")


def test_recording_of_the_covariance_is_set_by_file_or_command_line(tmp_path: Path) -> None:
    file = tmp_path / "parameters.yaml"
    file.write_text("/bag_recorder: {ros__parameters: {model_covariance: true}}\n")
    assert systems.with_file(options_of(), file)["model_covariance"]
    assert not systems.with_file(options_of(), None)["model_covariance"]
    assert systems.with_file(options_of(model_covariance=True), None)["model_covariance"]


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
    options = options_of(filter="ekf", convention="positional")
    assert named(nodes_for(options))["joint_angles"].parameters["convention"] == "positional"
    assert counted(filter="ekf", convention="positional")[graph.FILTERED] == 1
    assert graph.angles_for("positional", "model_state") == ("positional", "skeleton")
    assert graph.angles_for(graph.AUTO, "model_state") == ("model", "model_state")


@pytest.mark.parametrize(
    "options",
    [
        options_of(filter="lkf_zero_velocity", filter_input="sensors"),
        options_of(filter="schlagenhauf_ekf", angles_input="model_state"),
    ],
)
def test_options_that_the_filter_does_not_support_are_refused(options: Options) -> None:
    with pytest.raises(graph.GraphError, match=f"filter {options['filter']}"):
        nodes_for(options)


@pytest.mark.parametrize("given", [{"sensors": ("left", "right")}, {"sensors": ("kinect1",)}, {"camera": ("cam7",)}])
def test_the_shipped_parameters_file_holds_for_other_sensors(given: dict[str, Any]) -> None:
    pytest.importorskip("rclpy", reason="ROS is not installed")
    options = options_of(**given)
    specs = nodes_for(options)
    assert parameters_for(specs, ROOT / "config" / "body_tracking.yaml", absent=all_nodes_for(options)).keys() == {
        spec.name for spec in specs
    }


@pytest.mark.parametrize("options", VARIANTS)
def test_names_are_unique_and_sources_come_last(options: Options) -> None:
    specs = nodes_for(options)
    assert len(named(specs)) == len(specs)
    assert {spec.executable for spec in specs} <= set(EXECUTABLES)
    assert specs[-1].executable in ("bag_player", "kinect_skeleton", "skeleton_adapter")
    assert set(named(specs)) <= set(named(all_nodes_for(options)))


def test_another_cameras_driver_takes_the_place_of_a_sensors_node() -> None:
    specs = named(nodes_for(options_of(sensors=("a", "b", "c"), adapt=("b:/k4a/bodies", "c"))))
    assert specs["a_skeleton"].executable == "kinect_skeleton"
    assert specs["b_skeleton"].executable == specs["c_skeleton"].executable == "skeleton_adapter"
    assert specs["b_skeleton"].parameters == {"sensor": "b", "topic": "/k4a/bodies", "use_sim_time": False}
    assert "topic" not in specs["c_skeleton"].parameters
    with pytest.raises(graph.GraphError, match="adapted sensor 'd' is none of a, b"):
        nodes_for(options_of(sensors=("a", "b"), adapt=("d",)))


@pytest.mark.parametrize("sensors", [(), ("a", "a"), ("fused",), ("a/b",)])
def test_invalid_sensors_are_refused(sensors: tuple[str, ...]) -> None:
    with pytest.raises(BodyTrackingError):
        nodes_for(options_of(sensors=sensors))


def test_sensors_are_found_among_topics() -> None:
    topics = ["/b/skeleton", "/a/skeleton", "/fused/skeleton", "/ground_truth/skeleton", "/a/b/skeleton", "/skeleton"]
    assert graph.sensors_among(topics) == ("a", "b")


def test_the_viewer_shows_the_marker_system_where_there_is_one() -> None:
    given = options_of(sensors=(), marker_setup="lab", viewer=True)
    specs = {spec.name: spec for spec in nodes_for(given)}
    assert specs["viewer"].parameters["marker_setup"] == "lab"
    assert "marker_setup" not in specs["rigid_body_tracker"].parameters
    without = {spec.name: spec for spec in nodes_for(options_of(viewer=True))}
    assert "marker_setup" not in without["viewer"].parameters


def test_topics_have_known_types_and_publishers() -> None:
    assert len({(topic.name, topic.publisher) for topic in TOPICS}) == len(TOPICS)  # several nodes share /tf
    for topic in TOPICS:
        assert is_known(topic.type_name) or topic.name in (graph.TF, graph.TF_STATIC, graph.TRACKED)
        assert topic.publisher in (*EXECUTABLES, "every node")


# `launch` is not on PyPI, so a ROS install checks that the launch file runs. Here: it compiles, its imports from this
# package exist, and it repeats nothing of the table.


def test_the_launch_file_takes_its_nodes_from_the_table() -> None:
    source = LAUNCH.read_text(encoding="utf-8")
    tree = ast.parse(source)
    compile(tree, LAUNCH.name, "exec")
    assert any(isinstance(node, ast.FunctionDef) and node.name == "generate_launch_description" for node in tree.body)
    imported = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
    ours = {
        node.module: [alias.name for alias in node.names] for node in imported if "body_tracking" in str(node.module)
    }
    assert {"systems.nodes_for", "systems.OPTIONS"} <= {
        ast.unparse(node) for node in ast.walk(tree) if isinstance(node, ast.Attribute)
    }
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
