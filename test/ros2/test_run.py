"""``ros2 run`` of nodes, and ``ros2 service call`` of services of docs/reference.md: some, all in ``make test-all``."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import pytest
from tools import Tool, Tools

from body_tracking import systems
from draws import some
from pose_networks import startable

MARKER_NODES = (
    "marker_cameras",
    "marker_detector",
    "marker_triangulation",
    "rigid_body_tracker",
    "marker_joint_angles",
)
LACKING = ("robot_commands", "bag_player", "kinect_skeleton", "camera_rig")
"""Nodes that do nothing without a parameter."""
NODES = startable(systems.EXECUTABLES)
GROUPS = 4
"""Groups of nodes that run at the same time: the time in which n nodes find each other grows with the square of n.

``make test`` runs the one with calibration, filter and recorder; ``nodes/test_namespaces.py`` makes every node."""


class Nodes:
    """A group of nodes in one domain, each in a process of its own."""

    def __init__(self, tools: Tools, names: Sequence[str]) -> None:
        self.tools = tools
        bag, mapping = tools.bag(), tools.share / "config" / "robots" / "iiwa7.yaml"
        parameters: dict[str, dict[str, object]] = {
            "kinect_skeleton": {"sensor": "kinect1", "file": bag},
            "imu_skeleton": {"segments": "[forearm_left]"},
            "robot_commands": {"mapping": mapping},
            "bag_player": {"bag": bag, "topics": "[/kinect2/skeleton]", "start_paused": "true"},
            "camera_rig": {"setup": tools.share / "config" / "camera_rig"},
            "bag_recorder": {"folder": "recording", "start_recording": "false"},
            "viewer": {"port": 0},
            **{name: {"setup": tools.share / "config" / "marker_setup"} for name in MARKER_NODES},
        }
        parameters["marker_cameras"]["rate"] = 1.0  # rendered ones; 30 a second keep a processor busy
        self.tools_of: dict[str, Tool] = {
            executable: tools.run(executable, **parameters.get(executable, {})) for executable in names
        }

    def text(self) -> str:
        """The output of all nodes."""
        return "\n".join(f"{name}: {tool.text()}" for name, tool in self.tools_of.items())


@pytest.fixture(scope="module", params=some((2, 3, 0, 1)))
def nodes(
    workspace: dict[str, str], tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest
) -> Iterator[Nodes]:
    with Tools(workspace, tmp_path_factory.mktemp("nodes")) as tools:
        yield Nodes(tools, NODES[request.param :: GROUPS])


def test_every_node_publishes_diagnostics(nodes: Nodes) -> None:
    seen = nodes.tools.bench.diagnostics
    wanted = nodes.tools_of.keys()
    assert nodes.tools.bench.until(lambda: wanted <= seen.keys(), 60.0), (wanted - seen.keys(), nodes.text())


def test_every_service_answers(nodes: Nodes) -> None:
    services = [
        each.name.replace("<sensor>", "kinect1") for each in systems.SERVICES if each.executable in nodes.tools_of
    ]
    if not services:
        pytest.skip("no node of this group has a service")
    # The recorder is to start before it stops.
    first, later = [name for name in services if "start" in name], [name for name in services if "start" not in name]
    for name in (*first, *some(later)):
        said = nodes.tools.ask("success=", "service", "call", f"/{name}", "std_srvs/srv/Trigger")
        answer = said.partition("response:")[2]
        assert "success=True" in answer or ("success=False" in answer and "message=''" not in answer), said


def test_ctrl_c_ends_every_node_in_order(nodes: Nodes) -> None:
    assert all(tool.process.poll() is None for tool in nodes.tools_of.values()), nodes.text()
    for tool in nodes.tools_of.values():
        tool.interrupt()
    codes = {name: tool.ended() for name, tool in nodes.tools_of.items()}
    wrong = {name: (code, nodes.tools_of[name].text()) for name, code in codes.items() if code}
    assert not wrong, wrong
    assert "Traceback" not in nodes.text()


def test_missing_required_parameter_is_reported(tools: Tools) -> None:
    for name, tool in {name: tools.run(name) for name in some(LACKING)}.items():
        assert tool.ended() == 2
        said, of_ros2_run = tool.text().splitlines()
        assert said.startswith(f"{name}: ") and "exit" in of_ros2_run
