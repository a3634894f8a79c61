"""``body_tracking up`` as a process: the real graph over a shipped recording, with each of its processes killed."""

from __future__ import annotations

import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest

from draws import some

rclpy = pytest.importorskip("rclpy", reason="ROS is not installed")

from rclpy.executors import SingleThreadedExecutor  # noqa: E402
from sensor_msgs.msg import JointState, PointCloud2  # noqa: E402

from body_tracking import cli, systems  # noqa: E402
from body_tracking.core.parameters import (  # noqa: E402
    ParameterError,
)
from body_tracking.messages.base import to_nanoseconds  # noqa: E402
from body_tracking.node_parameters import parameters_for  # noqa: E402
from body_tracking.pipeline import graph  # noqa: E402
from body_tracking.pipeline.roles import ROLES  # noqa: E402
from body_tracking.pipeline.system import Options  # noqa: E402
from body_tracking.recording.rosbag2 import BAG_MESSAGES, BagReader, BagWriter, deserialize  # noqa: E402
from body_tracking.ros import discovery  # noqa: E402
from body_tracking.ros.up import arguments_from, options_for, without_effect  # noqa: E402
from body_tracking.systems import options_of  # noqa: E402
from domains import domain  # noqa: E402
from excerpts import beginning  # noqa: E402
from spinning import spin_until  # noqa: E402

BAGS = Path(__file__).resolve().parent.parent / "bags"
BAG = BAGS / "tpose_wave"
ANGLES = graph.joint_states_topic("body1")
NODES = ("joint_angles", "skeleton_filter", "fusion", "calibration", "bag_recorder", "bag_player")


class Up:
    """A running ``body_tracking up``, and a subscriber of its angles."""

    def __init__(self, folder: Path, *arguments: str | Path, output: Path | None = None) -> None:
        number = domain()
        self.environment = {**os.environ, "ROS_DOMAIN_ID": str(number)}
        self.environment.pop("ROS_AUTOMATIC_DISCOVERY_RANGE", None)  # up stays on this machine by itself
        self.output = output or folder / "up.log"
        self.command = [sys.executable, "-m", "body_tracking.cli", "up", "--log-dir", folder, *arguments]
        self.start()
        os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
        self.context = rclpy.Context()
        rclpy.init(context=self.context, domain_id=number)
        self.node = rclpy.create_node("listener", context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.received: list[float] = []
        self.node.create_subscription(JointState, ANGLES, self._on_angles, 10)

    def start(self) -> None:
        """Start it, maybe again."""
        with self.output.open("wb") as log:
            self.process = subprocess.Popen(
                self.command, stdout=log, stderr=subprocess.STDOUT, env=self.environment, process_group=0
            )

    def _on_angles(self, message: JointState) -> None:
        self.received.append(time.monotonic())

    def text(self) -> str:
        return self.output.read_text()

    def nodes(self) -> dict[str, psutil.Process]:
        """The nodes by executable, as far as they have started."""
        found = {}
        for process in psutil.Process(self.process.pid).children():
            try:
                command = process.cmdline()
            except psutil.Error:
                continue
            if "body_tracking.nodes" in command and process.status() != psutil.STATUS_ZOMBIE:
                found[command[command.index("body_tracking.nodes") + 1]] = process
        return found

    def until(self, condition: Callable[[], object], timeout: float) -> bool:
        return spin_until(self.executor, condition, timeout)

    def close(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()
        rclpy.try_shutdown(context=self.context)


@pytest.fixture
def up(tmp_path: Path) -> Iterator[Callable[..., Up]]:
    started: list[Up] = []

    def start(*arguments: str | Path, output: Path | None = None) -> Up:
        started.append(Up(tmp_path, *arguments, output=output))
        return started[-1]

    yield start
    for each in started:
        each.close()


def angles_in(path: Path, topic: str) -> dict[int, Any]:
    """Position by capture time, and its names."""
    with BagReader(path) as reader:
        type_name = reader.topics[topic].type_name
        messages = [deserialize(type_name, found.cdr) for found in reader.messages([topic])]
    return {to_nanoseconds(message.header.stamp): np.array(message.position) for message in messages}


def contention() -> float:
    """Factor, at least 1, by which a start takes longer now because other processes use the processors."""

    def used() -> float:
        ended = resource.getrusage(resource.RUSAGE_CHILDREN)
        return ended.ru_utime + ended.ru_stime

    begun, before = time.monotonic(), used()
    subprocess.run([sys.executable, "-c", "import body_tracking.ros.main, sensor_msgs.msg"], check=True, timeout=60.0)
    return max(1.0, (time.monotonic() - begun) / (used() - before))


@pytest.mark.alone
def test_every_node_may_be_killed_and_tracking_is_back_within_three_seconds(
    up: Callable[..., Up], tmp_path: Path
) -> None:
    killed = some(NODES, 2)
    # it has to last as long
    bag, rate = (BAG, "0.5") if len(killed) > 2 else (beginning(BAG, tmp_path / "excerpt", 11.0), "1")
    graph_up = up("--bag", bag, "--rate", rate, "--record", tmp_path / "recording")
    assert graph_up.until(lambda: len(graph_up.received) > 30, timeout=120.0), graph_up.text()
    for name in killed:
        before = graph_up.nodes()
        assert set(before) == set(NODES)
        before[name].kill()
        pid = before[name].pid

        def restarted(name: str = name, pid: int = pid) -> bool:
            process = graph_up.nodes().get(name)
            return process is not None and process.pid != pid

        assert graph_up.until(restarted, timeout=10.0), graph_up.text()
        # Measured within the graph: the discovery of other processes has a delay of its own.
        back = re.compile(rf"{name} is back: angles ([\d.]+) s later")
        assert graph_up.until(lambda back=back: back.search(graph_up.text()), timeout=10.0), graph_up.text()
        found = back.search(graph_up.text())
        assert found is not None
        assert float(found[1]) < 3.0 * contention(), graph_up.text()
        received = len(graph_up.received)  # out here, where the node has to be discovered first
        assert graph_up.until(lambda received=received: len(graph_up.received) > received, timeout=5.0), graph_up.text()
        assert graph_up.process.poll() is None
        others = graph_up.nodes()
        assert all(others[other].pid == before[other].pid for other in NODES if other != name)
        graph_up.until(lambda: False, timeout=0.7)
    for name in killed:
        assert f"{name} died (killed by signal 9)" in graph_up.text()
    assert graph_up.until(lambda: graph_up.process.poll() is not None, timeout=120.0), graph_up.text()
    assert graph_up.process.returncode == 0, graph_up.text()
    with BagReader(tmp_path / "recording") as reader:
        assert reader.whole and reader.topics[ANGLES].count > 200
        assert sum(1 for _ in reader.messages([ANGLES])) == reader.topics[ANGLES].count
    stamps = sorted(angles_in(tmp_path / "recording", ANGLES))
    with BagReader(bag) as reader:
        first_ns, last_ns = reader.start_ns, reader.end_ns
    # The player went on where it was, not from the beginning: one pass over the bag, to its end.
    assert stamps[-1] - stamps[0] < last_ns - first_ns
    assert stamps[-1] - stamps[0] > 0.8 * (last_ns - first_ns)


@pytest.mark.parametrize("there", [True, False])
def test_a_calibration_that_is_there_is_only_loaded_while_a_bag_plays(tmp_path: Path, there: bool) -> None:
    """With the parameter that ``calibration/test_storage.py`` tests."""
    file = tmp_path / "lab.yaml"
    parameters = tmp_path / "parameters.yaml"
    parameters.write_text(f"calibration: {{ros__parameters: {{calibration_file: {file}}}}}")
    if there:
        file.write_text("")
    for named in (("--calibration", file), ("--params-file", parameters)):
        words = ["up", "--bag", str(BAG), *map(str, named)]
        specs = systems.nodes_for(options_for(cli.parser("up").parse_args(words)))
        (calibration,) = (spec.parameters for spec in specs if spec.name == "calibration")
        assert (calibration.get("save") is False) is there


@pytest.mark.parametrize("kept", [pytest.param(True, marks=pytest.mark.slow), False])
def test_a_bag_writes_a_calibration_only_where_there_was_none(
    up: Callable[..., Up], tmp_path: Path, kept: bool
) -> None:
    """A bag of other people or another day would replace the calibration of a laboratory."""
    file, bag = tmp_path / "lab.yaml", beginning(BAG, tmp_path / "excerpt", 5.0)
    if kept:
        assert cli.main(["calibrate", str(BAG), "-o", str(file)]) == 0
    before = file.read_text() if kept else None
    parameters = tmp_path / "parameters.yaml"
    parameters.write_text(f"calibration: {{ros__parameters: {{calibration_file: {file}}}}}")
    named = ("--params-file", parameters) if kept else ("--calibration", file)
    graph_up = up("--bag", bag, *named, "--reliable")
    assert graph_up.until(lambda: graph_up.process.poll() is not None, timeout=120.0), graph_up.text()
    assert graph_up.process.returncode == 0, graph_up.text()
    (log,) = tmp_path.glob("body_tracking_up_*/calibration.log")
    assert (file.read_text() == before) is kept
    assert (f"{file}: loaded, not to be written" in log.read_text()) is kept
    assert (f"{file}: only loaded, as a bag plays" in graph_up.text()) is kept


@pytest.mark.parametrize("how", some([signal.SIGKILL, signal.SIGTERM]))
def test_no_process_remains_of_an_up_that_ends_while_its_nodes_start(
    up: Callable[..., Up], tmp_path: Path, how: signal.Signals
) -> None:
    graph_up = up("--bag", BAG, "--record", tmp_path / "recording")
    assert graph_up.until(lambda: set(graph_up.nodes()) >= {"fusion", "calibration"}, timeout=120.0), graph_up.text()
    end(graph_up, how)
    assert graph_up.process.returncode == (0 if how is signal.SIGTERM else -9)


def end(graph_up: Up, how: signal.Signals) -> None:
    """End it by a signal; all its nodes end as well."""
    nodes = graph_up.nodes().values()
    graph_up.process.send_signal(how)
    assert graph_up.until(lambda: graph_up.process.poll() is not None, timeout=120.0)
    # a node that is still starting ends once it has started, which takes longer on a busy machine
    _, alive = psutil.wait_procs(list(nodes), timeout=5.0 * contention())
    assert not alive


def test_an_up_that_was_killed_with_all_its_nodes_is_back_when_it_is_started_again_and_ends_in_order(
    up: Callable[..., Up], tmp_path: Path
) -> None:
    graph_up = up("--bag", BAG)
    assert graph_up.until(lambda: graph_up.received, timeout=120.0), graph_up.text()
    nodes = graph_up.nodes().values()
    os.killpg(graph_up.process.pid, signal.SIGKILL)
    graph_up.process.wait()
    psutil.wait_procs(list(nodes), timeout=5.0)
    graph_up.command += ["--record", tmp_path / "recording"]
    graph_up.start()
    graph_up.received.clear()
    # its remains in DDS count neither as a first ``up`` nor as a second publisher
    assert graph_up.until(lambda: len(graph_up.received) > 60, timeout=120.0), graph_up.text()
    assert not re.search("another body_tracking up|publishers", graph_up.text()), graph_up.text()
    assert set(graph_up.nodes()) == set(NODES)
    end(graph_up, signal.SIGINT)
    assert graph_up.process.returncode == 0, graph_up.text()
    with BagReader(tmp_path / "recording") as reader:
        assert reader.whole


# --- input that is refused before anything starts


def refusal(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> str:
    assert cli.main(["up", *map(str, arguments)]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    return lines[0]


@pytest.mark.slow
def test_a_full_disk_and_lost_logs_end_no_graph(up: Callable[..., Up], tmp_path: Path) -> None:
    logs = tmp_path / "logs"
    graph_up = up("--bag", BAG, "--loop", "--log-dir", logs, output=Path("/dev/full"))
    assert graph_up.until(lambda: len(graph_up.received) > 30, timeout=120.0)
    shutil.rmtree(logs)
    logs.touch()  # no file can be written below it
    graph_up.nodes()["fusion"].kill()
    graph_up.until(lambda: False, timeout=2.0)
    assert graph_up.process.poll() is None and "fusion" not in graph_up.nodes()
    logs.unlink()
    assert graph_up.until(lambda: "fusion" in graph_up.nodes(), timeout=20.0)
    received = len(graph_up.received)
    assert graph_up.until(lambda: len(graph_up.received) > received + 30, timeout=30.0 * contention())
    end(graph_up, signal.SIGINT)


def test_a_graph_that_cannot_start_leaves_no_recording(up: Callable[..., Up], tmp_path: Path) -> None:
    file, session = tmp_path / "sensors.yaml", tmp_path / "session"
    file.write_text("kinect1_skeleton: {ros__parameters: {backend: network, key_file: /nowhere}}")
    graph_up = up("--sensors", "kinect1", "--params-file", file, "--record", session)
    assert graph_up.process.wait(120.0) == 2
    assert "body_tracking: kinect_skeleton: parameter 'key_file': /nowhere: cannot be read" in graph_up.text()
    assert not session.exists()


def test_invalid_bag_or_bag_without_skeletons_is_refused(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert "nowhere" in refusal(capsys, "--bag", tmp_path / "nowhere")
    with BagWriter(tmp_path / "other") as writer:
        writer.add_topic("/fused/skeleton", "std_msgs/msg/String")
        writer.write_message("/fused/skeleton", BAG_MESSAGES.make("std_msgs/msg/String", data=""), 1)
    assert "no topic /<sensor>/skeleton; it has /fused/skeleton" in refusal(capsys, "--bag", tmp_path / "other")
    reported = refusal(capsys, "--bag", BAG.with_name("markers_arm"))
    assert "/left/image_raw, " in reported and "/ground_truth" not in reported, "nothing plays the truth"
    assert reported.endswith(
        "; add to the command the option that takes them: "
        "--camera SENSOR, --camera-rig FOLDER, --depth SENSOR or --marker-setup FOLDER"
    )
    assert "no topic /kinect7/skeleton; its sensors are kinect1, kinect2" in refusal(
        capsys, "--bag", BAG, "--sensors", "kinect1,kinect7"
    )


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("fusion: {ros__parameters: {silense: 1.0}}", "/fusion: unknown parameter 'silense'; did you mean 'silence'?"),
        ("fusion: {ros__parameters: {silence: 99}}", "/fusion: parameter 'silence': 99, expected 0.02 to 5"),
        ("/**: {ros__parameters: {filtre: x}}", "/**: unknown parameter 'filtre'"),
        ("fusoin: {ros__parameters: {silence: 1.0}}", "; did you mean '/fusion'?"),
        ("fusion: {silence: 1.0}", "holds no ros__parameters"),
        ("fusion: [", "is not YAML"),
        (
            "skeleton_filter: {ros__parameters: {ekf.predict_fr: 1.0}}",
            "unknown parameter 'ekf.predict_fr'; did you mean 'ekf.predict_for'?",
        ),
        ("skeleton_filter: {ros__parameters: {filter: 3}}", "parameter 'filter': 3, expected a string"),
        ("joint_angles: {ros__parameters: {convention: isp}}", "parameter 'convention': 'isp', expected one of"),
    ],
)
def test_a_parameters_file_with_a_mistake(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, content: str, said: str
) -> None:
    file = tmp_path / "parameters.yaml"
    file.write_text(content)
    line = refusal(capsys, "--bag", BAG, "--params-file", file)
    assert str(file) in line
    assert said in line


def test_options_without_effect_are_named(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    markers, setup = BAG.with_name("markers_arm"), BAG.parents[1] / "config" / "marker_setup"
    given = [f"--bag={markers}", f"--marker-setup={setup}", "--filter=ekf", "--convention=isb"]
    args = arguments_from([*given, "--sensors=none", "--marker-images=render"])
    found = without_effect(args, systems.nodes_for(options_for(args)))
    assert found == ["--marker-images", "--filter", "--convention"]
    args = arguments_from([f"--bag={BAG}", "--filter=ekf", "--convention=isb"])
    assert not without_effect(args, systems.nodes_for(options_for(args)))
    (tmp_path / "targets.yaml").touch()
    assert "; without cameras, --marker-points names" in refusal(
        capsys, "--sensors", "none", "--marker-setup", tmp_path
    )


def test_other_mistakes_on_the_command_line(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    (tmp_path / "there").write_text("")
    assert "exists already" in refusal(capsys, "--bag", BAG, "--record", tmp_path / "there")
    assert "rate 0: expected" in refusal(capsys, "--bag", BAG, "--rate", "0")
    for start in ("600", "-1"):
        assert f"start {start}: expected 0 to" in refusal(capsys, "--bag", BAG, "--start", start)
    assert "loop: needs a bag" in refusal(capsys, "--loop")
    assert "people: needs --subject all" in refusal(capsys, "--bag", BAG, "--people", "2")
    assert "external" in refusal(capsys, "--bag", BAG, "--external")
    assert "cannot be read" in refusal(capsys, "--params-file", tmp_path / "nowhere.yaml")
    assert "kinect1_skeleton: nothing to read: give a bag" in refusal(capsys, "--sensors", "kinect1")
    assert "namespace" in refusal(capsys, "--namespace", "a b", "--bag", BAG)
    assert "reserved" in refusal(capsys, "--sensors", "fused")
    assert "twice" in refusal(capsys, "--sensors", "a,a")
    file = tmp_path / "parameters.yaml"
    file.write_text("joint_angles: {ros__parameters: {convention: isb, input: model_state}}")
    assert "has no model of the body" in refusal(
        capsys, "--external", "--filter", "lkf_zero_velocity", "--params-file", file
    )
    file.write_text("skeleton_filter: {ros__parameters: {input: sensors}}")
    assert "cannot smooth" in refusal(capsys, "--external", "--filter", "thesis_lkf1", "--lag", "0.15")
    robot = BAGS.parent / "config" / "robots" / "iiwa7.yaml"
    assert "must not follow angles that come late" in refusal(capsys, "--robot", robot, "--lag", "0.15")
    assert "expected 0 to 0.3" in refusal(capsys, "--bag", BAG, "--lag", "0.5")
    assert "takes fused skeletons" in refusal(
        capsys, "--external", "--filter", "lkf_zero_velocity", "--params-file", file
    )


# --- sensors that publish


def test_up_without_arguments_takes_the_sensors_that_publish(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    monkeypatch.setenv("ROS_DOMAIN_ID", str(domain()))
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=int(os.environ["ROS_DOMAIN_ID"]))
    node = rclpy.create_node("camera", context=context)
    publishers = [node.create_publisher(PointCloud2, graph.skeleton_topic(name), 1) for name in ("left", "right")]
    found = discovery.look(patience=60.0)
    assert found == discovery.Domain({"sensors": ("left", "right"), "external": True})
    assert not discovery.look("/elsewhere", patience=0.3).sensors
    assert len(publishers) == 2
    rclpy.try_shutdown(context=context)

    monkeypatch.setattr(discovery, "look", lambda namespace: discovery.Domain())
    assert "no sensor publishes in ROS domain" in refusal(capsys)
    (tmp_path / "slow.yaml").write_text("skeleton_filter: {ros__parameters: {filter: ekf}}")
    said = refusal(capsys, "--params-file", tmp_path / "slow.yaml")
    assert "no sensor publishes in ROS domain" in said and "slow.yaml has no section <sensor>_skeleton" in said


# --- parameters


def angles_of(parameters: dict[str, dict[str, Any]], options: Options) -> tuple[str, str]:
    """The input and the convention of ``joint_angles`` with these parameters."""
    given = parameters["joint_angles"]
    published = ROLES[options["filter"]].angles_input if options["filter"] else graph.SKELETON_INPUT
    source = given.get("input", graph.AUTO)
    convention, source = graph.angles_for(
        given.get("convention", graph.AUTO), published if source == graph.AUTO else source
    )
    return source, convention


def test_the_filter_in_the_file_decides_what_joint_angles_listens_to(tmp_path: Path) -> None:
    file = tmp_path / "parameters.yaml"
    for content, expected in (
        ("skeleton_filter: {ros__parameters: {filter: ekf}}", ("model_state", "model")),
        ("/**: {ros__parameters: {filter: ekf, convention: auto}}", ("model_state", "model")),
        ("skeleton_filter: {ros__parameters: {filter: schlagenhauf_ekf}}", ("skeleton", "model")),
        (
            "skeleton_filter: {ros__parameters: {filter: ekf, ekf: {predict_for: 2}}}\n"
            "joint_angles: {ros__parameters: {convention: isb, input: skeleton}}",
            ("skeleton", "isb"),
        ),
        ("joint_angles: {ros__parameters: {convention: dh26}}", ("skeleton", "dh26")),
    ):
        file.write_text(content)
        options = systems.with_file(options_of(), file)
        found = parameters_for(systems.nodes_for(options), file, absent=systems.all_nodes_for(options))
        assert angles_of(found, options) == expected
        if "predict_for" in content:
            assert found["skeleton_filter"]["ekf.predict_for"] == 2.0
    # The command line wins.
    options = systems.with_file(options_of(filter="lkf_zero_velocity", convention="rep155"), file)
    found = parameters_for(systems.nodes_for(options), file)
    assert angles_of(found, options) == ("skeleton", "rep155")


def test_the_command_line_wins_over_the_file_and_the_file_over_defaults(tmp_path: Path) -> None:
    file = tmp_path / "parameters.yaml"
    file.write_text(
        "/**: {ros__parameters: {world_frame: map, silence: 5}}\n"
        "fusion: {ros__parameters: {silence: 4}}\n"
        "skeleton_filter: {ros__parameters: {filter: lkf_constant_velocity, predict_for: 1}}\n"
        "calibration: {ros__parameters: {calibration_file: mine.yaml}}\n"
        "bag_recorder: {ros__parameters: {chunk_seconds: 2.0}}\n"  # not started, but part of a graph
    )
    options = options_of(filter="lkf_zero_velocity")
    defaults = {"calibration": {"calibration_file": "default.yaml"}}
    found = parameters_for(systems.nodes_for(options), file, defaults, systems.all_nodes_for(options))
    assert found["fusion"]["world_frame"] == found["calibration"]["world_frame"] == "map"
    assert "world_frame" not in found["joint_angles"]
    assert found["fusion"]["silence"] == 4.0
    assert found["skeleton_filter"]["filter"] == "lkf_zero_velocity"
    assert found["skeleton_filter"]["predict_for"] == 1.0
    assert found["calibration"]["calibration_file"] == "mine.yaml"
    with pytest.raises(ParameterError, match="no such node"):
        parameters_for(systems.nodes_for(options), file, defaults)
