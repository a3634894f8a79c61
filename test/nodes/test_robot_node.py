"""Two simulated arms follow a recorded motion through real processes; then the sensor dies, and comes back."""

from __future__ import annotations

import itertools
import re
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest

rclpy = pytest.importorskip("rclpy", reason="ROS is not installed")

from diagnostic_msgs.msg import DiagnosticArray  # noqa: E402
from running import BAG, RELIABLE, ROOT, Running, environment, stop  # noqa: E402
from sensor_msgs.msg import JointState  # noqa: E402
from simulated_arm import SimulatedArm  # noqa: E402
from std_msgs.msg import Float64MultiArray  # noqa: E402
from trajectory_msgs.msg import JointTrajectory  # noqa: E402

from body_tracking.core.qos import RELIABLE as RELIABLE_QOS  # noqa: E402
from body_tracking.core.qos import SENSOR_DATA  # noqa: E402
from body_tracking.core.skeleton import NANOSECONDS, FloatArray  # noqa: E402
from body_tracking.kinematics.conventions import (  # noqa: E402
    ALL_CONVENTIONS,
    angle_names,
    angles_of,
)
from body_tracking.kinematics.stage import state_estimate  # noqa: E402
from body_tracking.kinematics.upper_body import UpperBody  # noqa: E402
from body_tracking.messages.angles import angles_to_joint_states  # noqa: E402
from body_tracking.messages.base import to_nanoseconds, to_time  # noqa: E402
from body_tracking.messages.model import joint_state_to_model  # noqa: E402
from body_tracking.pipeline import graph  # noqa: E402
from body_tracking.recording.rosbag2 import BAG_MESSAGES, BagReader, BagWriter, deserialize  # noqa: E402
from body_tracking.robot.follower import State  # noqa: E402
from body_tracking.robot.mapping import RobotMapping, load  # noqa: E402
from body_tracking.ros import dds  # noqa: E402
from body_tracking.ros.wire import ROS  # noqa: E402

SENSOR = graph.skeleton_topic("kinect1")
LATENCY_NS = 20_000_000
BODIES = {"two_joint_arm": "body1", "iiwa7": "body2"}
PERIOD = 0.01


def mapping_file(robot: str) -> Path:
    return ROOT / "config" / "robots" / f"{robot}.yaml"


# --- a recording of the angles that the graph would find, if it saw everything


def write_angles(path: Path, seconds: float = np.inf) -> None:
    """A bag with the frames of one sensor, and the true angles of the same moments, of two people who move alike.

    Args:
        path: of the bag.
        seconds: of the recording that are used.
    """
    model = UpperBody()
    covariance = 1e-3 * np.eye(2 * model.nv)
    with BagReader(BAG) as reader, BagWriter(path) as writer:
        writer.add_topic(SENSOR, reader.topics[SENSOR].type_name, SENSOR_DATA)
        for body in BODIES.values():
            for topic in (graph.joint_states_topic(body), graph.joint_states_stddev_topic(body)):
                writer.add_topic(topic, "sensor_msgs/msg/JointState", RELIABLE_QOS)
        for raw in reader.messages([SENSOR, graph.TRUE_MODEL_STATE]):
            if raw.log_time_ns - reader.start_ns > seconds * NANOSECONDS:
                break
            if raw.topic == SENSOR:
                writer.write(SENSOR, raw.cdr, raw.log_time_ns)
                continue
            state = joint_state_to_model(deserialize("sensor_msgs/msg/JointState", raw.cdr), model)
            angles = angles_of(state_estimate(model, *state, covariance), model, "isb")
            for body in BODIES.values():
                topics = (graph.joint_states_topic(body), graph.joint_states_stddev_topic(body))
                messages = angles_to_joint_states(angles, body, "isb", BAG_MESSAGES)
                for topic, message in zip(topics, messages, strict=True):
                    writer.write_message(topic, message, raw.log_time_ns + LATENCY_NS)


@dataclass
class Arm:
    """A simulated arm and its received commands: (wall time, stamp, position)."""

    mapping: RobotMapping
    body: SimulatedArm
    commands: list[tuple[float, float, FloatArray]] = field(default_factory=list)
    """Time of receipt, stamp (wall time, seconds; NaN without one) and position of each command."""
    stood: list[tuple[float, FloatArray]] = field(default_factory=list)

    def moving(self) -> bool:
        """Whether the last commands move a joint by more than 0.15 rad/s."""
        if len(self.commands) < 11:
            return False
        return bool(np.abs(self.commands[-1][2] - self.commands[-11][2]).max() > 0.015)


class Robots(Running):
    """Arms in this process that follow their commands."""

    def __init__(self, folder: Path, *robots: str) -> None:
        super().__init__(folder)
        names = {name: angle_names(name) for name in ALL_CONVENTIONS}
        self.arms: dict[str, Arm] = {}
        self.states: dict[str, Any] = {}
        for robot in robots:
            mapping = load(mapping_file(robot), names)
            model = ROOT / "examples" / "robot_arms" / f"{robot}.xml"
            arm = self.arms[robot] = Arm(mapping, SimulatedArm(model, mapping.joints, mapping.home))
            kind = JointTrajectory if robot == "two_joint_arm" else Float64MultiArray
            self.node.create_subscription(kind, mapping.output.topic, self._listener(arm), RELIABLE)
            self.states[robot] = self.node.create_publisher(JointState, mapping.output.state_topic, RELIABLE)
        self.advanced = time.monotonic()
        self.node.create_timer(0.02, self._advance)

    def _listener(self, arm: Arm) -> Any:
        def on_trajectory(message: JointTrajectory) -> None:
            (point,) = message.points
            assert message.joint_names == list(arm.mapping.joints)
            self._told(arm, to_nanoseconds(message.header.stamp) / NANOSECONDS, point.positions)
            arm.body.go_to(arm.commands[-1][2], point.time_from_start.nanosec / NANOSECONDS)

        def on_array(message: Float64MultiArray) -> None:
            self._told(arm, np.nan, message.data)
            arm.body.go_to(arm.commands[-1][2])

        return on_trajectory if arm.mapping.output.kind == "joint_trajectory" else on_array

    @staticmethod
    def _told(arm: Arm, stamp: float, position: Any) -> None:
        arm.commands.append((time.time(), stamp, np.array(position)))

    def _advance(self) -> None:
        now = time.monotonic()
        passed, self.advanced = now - self.advanced, now
        for robot, arm in self.arms.items():
            arm.body.advance(min(passed, 0.1))
            arm.stood.append((time.time(), arm.body.position))
            message = JointState(name=list(arm.mapping.joints), position=arm.body.position.tolist())
            self.states[robot].publish(message)

    def command(self, robot: str, **parameters: object) -> None:
        """Start a robot's ``robot_commands`` under the robot's name."""
        given = {"mapping": mapping_file(robot), "sensors": "[kinect1]", **parameters}
        self.start_interpreter("robot_commands", name=f"{robot}_commands", **given)


class PlayedRobots(Robots):
    """Arms with a ``robot_commands`` node each, and a player in place of the graph."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder, *BODIES)
        self.environment |= dds.loopback()  # as ``up`` does: a node killed while it writes locks no shared memory
        self.bag = folder / "angles"
        write_angles(self.bag, 12.0)  # in a loop; both arms move after half of it
        self.start("calibration", sensors="[kinect1]", use_sim_time=True)
        # One goes by the wall clock and stamps its commands by it: its person's angles are stamped anew. The other goes
        # by /clock, which ends with the player.
        self.offset_ns, self.last_ns = 0, 0
        played, live = BODIES["two_joint_arm"], "live"
        for name in (graph.joint_states_topic, graph.joint_states_stddev_topic):
            publisher = self.node.create_publisher(JointState, name(live), RELIABLE)
            self.node.create_subscription(JointState, name(played), self._relay(publisher, played, live), RELIABLE)
        self.command("two_joint_arm", body=live)
        self.command("iiwa7", body=BODIES["iiwa7"], use_sim_time=True)

    def _relay(self, publisher: Any, played: str, live: str) -> Any:
        """A callback that republishes the angles of a person in the bag with present stamps."""

        def on_angles(message: JointState) -> None:
            stamp_ns = to_nanoseconds(message.header.stamp)
            if not self.last_ns or stamp_ns < self.last_ns - NANOSECONDS:  # the bag begins, again
                self.offset_ns = time.time_ns() - LATENCY_NS - stamp_ns
            self.last_ns = stamp_ns
            message.header.stamp = to_time(stamp_ns + self.offset_ns, ROS)
            message.name = [f"{name.removesuffix(played)}{live}" for name in message.name]
            publisher.publish(message)

        return on_angles

    def play(self) -> None:
        """Start the sensor."""
        self.last_ns = 0
        self.start("bag_player", bag=self.bag, loop=True, wait_for_subscribers=f"['{SENSOR}:3']", wait_timeout=60.0)

    def robot(self, robot: str) -> dict[str, str]:
        """The last diagnostics of a robot's ``robot_commands``."""
        return self.said(f"{robot}_commands")

    def in_state(self, *states: State) -> bool:
        """Whether every robot is in one of these states, by the last diagnostics."""
        return all(self.robot(robot).get("state") in states for robot in self.arms)

    def report(self) -> str:
        """What every robot's node said last, for the text of a failure."""
        lines = []
        for name in self.arms:
            node = f"{name}_commands"
            lines += [f"{node}, exit code {self.processes[node].poll()}: {self.robot(name)}", self.log(node)[-2000:]]
        return "\n".join(lines)

    def kill_while_moving(self) -> float:
        """Kill the sensor while both arms follow and move; returns the wall time."""
        moving = {name: arm.moving for name, arm in self.arms.items()}
        assert self.until(lambda: self.in_state(State.FOLLOWING) and all(m() for m in moving.values()), 90.0), (
            self.report()
        )
        player = self.processes.pop("bag_player")
        killed = time.time()
        player.kill()
        player.wait()
        return killed


@dataclass(frozen=True)
class Run:
    """Results of a run: the arms, and for each kill its time, the reported reasons, and the commands after it."""

    arms: dict[str, Arm]
    killed: tuple[float, ...]
    followed: int
    reasons: dict[str, list[str]]
    quiet_at: tuple[dict[str, int], ...]
    logs: dict[str, str]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Run]:
    with PlayedRobots(tmp_path_factory.mktemp("robots")) as robots:
        killed, quiet = [], []
        reasons: dict[str, list[str]] = {robot: [] for robot in BODIES}
        for _ in range(2):
            robots.play()
            killed.append(robots.kill_while_moving())
            followed = len(robots.arms["iiwa7"].commands)
            assert robots.until(lambda: robots.in_state(State.STOPPED)), robots.report()
            for robot in BODIES:
                reasons[robot].append(robots.robot(robot)[""])
            robots.until(lambda: False, timeout=1.0)  # commands that were on their way
            quiet.append({robot: len(arm.commands) for robot, arm in robots.arms.items()})
            robots.until(lambda: False, timeout=0.5)
            assert quiet[-1] == {robot: len(arm.commands) for robot, arm in robots.arms.items()}
        for name in (*(f"{robot}_commands" for robot in BODIES), "calibration"):
            assert stop(robots.processes.pop(name)) == 0, robots.log(name)
        logs = {robot: robots.log(f"{robot}_commands") for robot in BODIES}
        yield Run(dict(robots.arms), tuple(killed), followed, reasons, tuple(quiet), logs)


def of_one_run(run: Run, arm: Arm, number: int) -> list[tuple[float, float, FloatArray]]:
    """The commands up to a stop, from the one before."""
    robot = arm.mapping.robot
    return arm.commands[run.quiet_at[number - 1][robot] if number else 0 : run.quiet_at[number][robot]]


def stall(times: list[float]) -> float:
    """Seconds that a process was held up beyond its period, as the times of its commands show."""
    return float(np.maximum(np.diff(times) - 2 * PERIOD, 0.0).sum())


@pytest.mark.alone
def test_both_arms_follow_the_recorded_motion(run: Run) -> None:
    for arm in run.arms.values():
        commanded = np.array([position for _, _, position in arm.commands])
        assert np.ptp(commanded, axis=0).max() > 0.5
        times = np.array([came for came, _, _ in arm.commands])
        stood_at = np.array([at for at, _ in arm.stood])
        stood = np.array([position for _, position in arm.stood])
        behind = [np.interp(times + 0.04, stood_at, stood[:, k]) - commanded[:, k] for k in range(commanded.shape[1])]
        assert np.median(np.abs(behind)) < 0.03
        assert np.sqrt(np.mean(np.square(behind))) < 0.15


@pytest.mark.alone
def test_commands_are_within_every_limit_and_jump_nowhere(run: Run) -> None:
    for arm in run.arms.values():
        commanded = np.array([position for _, _, position in arm.commands])
        assert np.isfinite(commanded).all()
        assert (commanded >= arm.mapping.lower).all()
        assert (commanded <= arm.mapping.upper).all()
        np.testing.assert_allclose(commanded[0], arm.mapping.home, atol=0.05)
        # A command that does not continue the one before begins where the arm stands: after a stop, and where the arm
        # could not follow, as when this process is held up.
        steps = np.abs(np.diff(commanded, axis=0))
        stood_at = np.array([at for at, _ in arm.stood])
        stood = np.array([position for _, position in arm.stood])
        for after in 1 + np.flatnonzero((steps > arm.mapping.rate * 2 * PERIOD + 1e-9).any(axis=1)):
            before = arm.commands[after][0] - stood_at
            lately = stood[(before >= 0.0) & (before < 0.5)]
            margin = arm.mapping.rate * 2 * PERIOD + 0.05
            assert (commanded[after] >= lately.min(axis=0) - margin).all(), (after, commanded[after], lately)
            assert (commanded[after] <= lately.max(axis=0) + margin).all(), (after, commanded[after], lately)


@pytest.mark.alone
def test_the_arm_stands_within_a_tenth_of_a_second_of_the_sensors_death(run: Run) -> None:
    for number, killed in enumerate(run.killed):
        for arm in run.arms.values():
            commands = of_one_run(run, arm, number)
            # time of each command: its stamp, or its receipt for arrays, which have no stamp
            made = [came if np.isnan(stamp) else stamp for came, stamp, _ in commands]
            last = max(k for k in range(1, len(commands)) if (commands[k][2] != commands[k - 1][2]).any())
            braking = np.where(np.isfinite(arm.mapping.acceleration), arm.mapping.rate / arm.mapping.acceleration, 0.0)
            held_up = stall([at for at in made if killed - 0.1 < at <= made[last] + 2 * PERIOD])
            assert made[last] - killed <= 0.1 + braking.max() + held_up


@pytest.mark.alone
def test_stops_within_the_stated_time_and_reports_the_reason(run: Run) -> None:
    for robot, arm in run.arms.items():
        for number, said in enumerate(run.reasons[robot]):
            assert said.startswith("stopped: held for 2."), said
            assert "no new angles for" in said or "no frame of kinect1 for" in said
            commands = of_one_run(run, arm, number)
            last = max(k for k in range(1, len(commands)) if (commands[k][2] != commands[k - 1][2]).any())
            standing = [came for came, _, _ in commands[last:]]
            late = stall([came for came, _, _ in commands[max(0, last - 200) :]])  # on a busy machine
            assert 1.7 - late < standing[-1] - standing[0] < 2.3 + late
        assert "following -> holding: no " in run.logs[robot]
        assert "holding -> stopped: held for 2." in run.logs[robot]


@pytest.mark.alone
def test_recovers_slowly_and_only_after_good_data(run: Run) -> None:
    for robot, arm in run.arms.items():
        log = run.logs[robot]
        assert log.count("stopped -> approaching: everything was good for 0.5") >= 2
        commands = of_one_run(run, arm, 1)
        before = of_one_run(run, arm, 0)[-1][2]
        np.testing.assert_allclose(commands[0][2], before, atol=0.05)
        begun = [position for _, _, position in itertools.islice(commands, 20)]
        # a fifth of a second into an approach of 1.5 s
        assert (np.abs(np.diff(begun, axis=0)) <= arm.mapping.rate * 2 * PERIOD * 0.4 / 1.5 + 1e-9).all()


@pytest.mark.slow
def test_the_example_follows_prints_and_draws(tmp_path: Path) -> None:
    write_angles(tmp_path / "angles", 8.0)
    example = ROOT / "examples" / "robot_arms" / "drive.py"
    picture = tmp_path / "arm.png"
    words = ["iiwa7", "--bag", tmp_path / "angles", "--angles", "-o", picture]
    done = subprocess.run(
        [sys.executable, example, *words], capture_output=True, text=True, timeout=120, env=environment(), check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "robot_commands: approaching: everything was good for 0.5" in done.stdout
    assert "robot_commands]" not in done.stderr  # the node's log, which has the same
    states = [re.sub(r"[\d.]+", "", line) for line in done.stdout.splitlines() if line.startswith("robot_commands: ")]
    assert all(one != next_one for one, next_one in itertools.pairwise(states))
    assert picture.read_bytes().startswith(b"\x89PNG")
    rows = {line.split()[0]: line.split() for line in done.stdout.splitlines() if line.startswith("joint_a")}
    assert len(rows) == 7
    assert all(float(row[3]) < 5.0 for row in rows.values())


# --- the whole of it


def joints_of(mapping: RobotMapping, angles: Sequence[tuple[float, JointState]], when: FloatArray) -> FloatArray:
    """(n, joints) a robot's positions by a mapping and the angles that the graph published.

    Args:
        mapping: the robot's.
        angles: with the wall times at which they came, seconds.
        when: (n,) wall times.
    """
    names = angles[0][1].name
    places = [names.index(f"{name}_body1") for name in mapping.angles]
    person = np.array([np.array(each.position)[places] for _, each in angles])
    whole = np.unwrap(person @ mapping.matrix.T + mapping.offset, axis=0)
    whole += 2.0 * np.pi * np.round((mapping.home - whole[0]) / (2.0 * np.pi))
    times = [came for came, _ in angles]
    return np.stack([np.interp(when, times, column) for column in whole.T], axis=1)


def following(log: str) -> list[tuple[float, float]]:
    """(begin, end) wall times in which ``robot_commands`` followed, by its log."""
    said = re.findall(r"\[(\d+\.\d+)\] \[robot_commands\]: (\w+) -> (\w+)", log)
    begun = [float(at) for at, _, state in said if state == State.FOLLOWING]
    ended = [float(at) for at, state, _ in said if state == State.FOLLOWING]
    return list(itertools.zip_longest(begun, ended, fillvalue=np.inf))


@pytest.mark.alone
def test_an_arm_follows_two_sensors_through_the_whole_graph_and_holds_when_they_die(tmp_path: Path) -> None:
    with Robots(tmp_path, "two_joint_arm") as robots:
        arm = robots.arms["two_joint_arm"]
        angles: list[tuple[float, JointState]] = []
        topic = graph.joint_states_topic("body1")
        robots.node.create_subscription(JointState, topic, lambda each: angles.append((time.time(), each)), RELIABLE)
        # At half the speed, in a loop, and with a longer allowed silence: a busy machine that cannot track at full
        # speed holds the robot, as it must. The shipped limits are tested above.
        mapping, silence = tmp_path / "two_joint_arm.yaml", 0.3
        shipped = mapping_file("two_joint_arm").read_text()
        mapping.write_text(f"{shipped}  silence: {silence}\n  max_age: {2 * silence}\n")
        words = ["--bag", BAG, "--rate", "0.5", "--loop", "--robot", mapping, "--log-dir", tmp_path]
        up = robots.start_module("up", "body_tracking.cli", "up", *words)

        def state() -> str | None:
            return robots.diagnostics.get("robot_commands", {}).get("state")

        assert robots.until(lambda: state() == State.FOLLOWING), (robots.log("up"), robots.diagnostics)
        begun = len(arm.commands)

        def travelled() -> float:
            """Radians between the extreme commands of the second joint since it follows."""
            return float(np.ptp([position[1] for _, _, position in arm.commands[begun:]] or [0.0]))

        def commands_while_following() -> int:
            (log,) = [path.read_text() for path in tmp_path.glob("*/robot_commands.log")]
            return sum(begin < at < end for begin, end in following(log) for at, _, _ in arm.commands[begun:])

        # long and far enough for the comparison below, whenever in the recording a busy machine let it begin, and
        # however often it held in between
        enough = np.radians(40.0)
        assert robots.until(lambda: commands_while_following() > 400 and arm.moving() and travelled() > enough), (
            robots.log("up")
        )
        (player,) = [each for each in psutil.Process(up.pid).children() if "bag_player" in each.cmdline()]
        killed = time.time()
        player.kill()
        assert robots.until(lambda: state() == State.HOLDING), robots.log("up")
        # diagnostics may come while the commands still brake
        assert robots.until(lambda: bool((arm.commands[-1][2] == arm.commands[-2][2]).all()), 5.0), arm.commands[-9:]
        followed = [each for each in arm.commands[begun:] if each[0] < killed]
        after = [each for each in arm.commands if each[0] >= killed]
        # on a busy machine a moment without angles may end an approach until the recording is over
        assert robots.until(lambda: state() in (State.APPROACHING, State.FOLLOWING)), robots.log("up")
        assert re.search(rf"\| robot ({'|'.join(State)})", robots.log("up"))  # the status line, every 5 s
        assert stop(up) == 0, robots.log("up")
    (robot_log,) = [path.read_text() for path in tmp_path.glob("*/robot_commands.log")]
    # The delay of the angles, here and at the robot's node, depends on the machine and changes within a second. So a
    # command has to lie between the least and the largest position by the angles within half a second of it; commands
    # while the robot held and came back are left out.
    came = np.array([each[0] for each in followed])
    while_following = np.any([(came > begin) & (came < end) for begin, end in following(robot_log)], axis=0)
    assert while_following.sum() > 200, robot_log
    came, commanded = came[while_following], np.array([each[2] for each in followed])[while_following]
    shifted = np.array([joints_of(arm.mapping, angles, came + shift) for shift in np.arange(-0.5, 0.51, 0.02)])
    off = np.degrees(np.maximum(commanded - shifted.max(axis=0), shifted.min(axis=0) - commanded)).max(axis=1)
    assert np.quantile(off, 0.9) < 5.0, np.quantile(off, [0.5, 0.9, 1.0])
    # after the kill, commands changed for no longer than the allowed silence
    last = max((k for k in range(1, len(after)) if (after[k][2] != after[k - 1][2]).any()), default=0)
    assert len(after) > last + 1
    held_up = stall([killed, *[came for came, _, _ in after[: last + 2]]])
    assert after[last][0] - killed <= silence + held_up


def test_the_diagnostics_of_many_nodes_are_not_taken_for_lost_messages(tmp_path: Path) -> None:
    """Sequence numbers do not say of which of a topic's publishers they are."""
    with Running(tmp_path) as running:
        running.start("robot_commands", mapping=mapping_file("two_joint_arm"))
        nodes = [running.node.create_publisher(DiagnosticArray, graph.DIAGNOSTICS_TOPIC, 10) for _ in range(8)]
        assert running.until(lambda: all(each.get_subscription_count() > 1 for each in nodes))

        ticks = itertools.count()

        def received() -> bool:
            # as often as it takes: a busy machine loses some
            tick = next(ticks)
            for number, each in enumerate(nodes):
                if tick % (1 + number) == 0:
                    each.publish(DiagnosticArray())
            return running.until(lambda: running.number("robot_commands", "received") > 100, timeout=0.02)

        assert running.until(received)
        assert f"lost {graph.DIAGNOSTICS_TOPIC}" not in running.said("robot_commands")
