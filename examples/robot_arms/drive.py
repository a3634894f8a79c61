"""A simulated arm that follows a person: ``python examples/robot_arms/drive.py two_joint_arm --bag bags/tpose_wave``.

Starts ``body_tracking up`` over a bag with the robot's mapping file, follows the commands in MuJoCo, and prints and
draws the resulting motion. Without ``--bag`` only the arm runs, until Ctrl-C, for a graph that is started elsewhere:
``body_tracking up --robot config/robots/two_joint_arm.yaml``. With ``--angles`` no filter runs: the bag holds joint
angles already. Needs ROS, and ``pip install -e '.[examples]'`` in the clone.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from sensor_msgs.msg import JointState
from simulated_arm import FloatArray, SimulatedArm
from std_msgs.msg import Float64MultiArray
from trajectory_msgs.msg import JointTrajectory

from body_tracking.core.errors import BodyTrackingError
from body_tracking.kinematics.conventions import ALL_CONVENTIONS, angle_names
from body_tracking.messages.diagnostics import statuses
from body_tracking.pipeline.graph import (
    DEFAULT_BODY,
    DIAGNOSTICS_TOPIC,
    joint_states_stddev_topic,
    joint_states_topic,
    sensors_among,
    skeleton_topic,
)
from body_tracking.recording.rosbag2 import BagReader
from body_tracking.robot.mapping import TRAJECTORY, RobotMapping, load
from body_tracking.ros.dds import domain

HERE = Path(__file__).resolve().parent
ROBOTS = HERE.parents[1] / "config" / "robots"
RESTART = 4.0
"""Seconds after which a killed player is started again."""
PERIOD = 0.01
"""Seconds between two messages with the robot's state."""
NUMBER = re.compile(r"\d+(\.\d+)?")
COMPARED_DELAYS = np.arange(0.0, 0.3, 0.01)
"""Assumed delays of the joints behind the commands, seconds; the best one separates delay from other errors."""


class Arm(Node):
    """Takes commands, moves the arm in real time, and publishes its state.

    Attributes:
        times: steady time of each entry of the next three, seconds.
        told: (n,) radians: the last command; NaN while no commands come.
        stood: (n,) radians: positions of the joints.
        points: (n + 1, 3) metres: places of the joints and of the tip.
        commands: number of received commands.
        first: steady time of the first command; infinite before.
        played: seconds of the bag, by the player's diagnostics.
        reason: text of the last diagnostics of ``robot_commands``.
        killed: steady time at which the player was killed; infinite if it was not.
    """

    def __init__(self, mapping: RobotMapping, arm: SimulatedArm, context: rclpy.Context) -> None:
        super().__init__(mapping.robot, context=context)
        self.mapping, self.arm = mapping, arm
        self.times: list[float] = []
        self.told: list[FloatArray] = []
        self.stood: list[FloatArray] = []
        self.points: list[FloatArray] = []
        self.commands = 0
        self.first = self.killed = np.inf
        self.command = np.full(len(mapping.joints), np.nan)
        self.heard = self.passed = time.monotonic()
        output = mapping.output
        if output.kind == TRAJECTORY:
            self.create_subscription(JointTrajectory, output.topic, self.on_trajectory, 10)
        else:
            self.create_subscription(Float64MultiArray, output.topic, self.on_array, 10)
        self.states = self.create_publisher(JointState, output.state_topic, 10)
        self.played = 0.0
        self.reason = "robot_commands was not heard of"
        self.create_subscription(DiagnosticArray, DIAGNOSTICS_TOPIC, self.on_diagnostics, 10)
        self.create_timer(PERIOD, self.advance, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def on_trajectory(self, message: JointTrajectory) -> None:
        """Callback of a trajectory of one point, in the order of the message's joint names."""
        place = [message.joint_names.index(name) for name in self.mapping.joints]
        (point,) = message.points
        seconds = point.time_from_start.sec + 1e-9 * point.time_from_start.nanosec
        self.go_to(np.array(point.positions)[place], seconds)

    def on_array(self, message: Float64MultiArray) -> None:
        """Callback of positions in the controller's order."""
        self.go_to(np.array(message.data), 0.0)

    def on_diagnostics(self, message: DiagnosticArray) -> None:
        """Note the player's position, and print why there are commands or none, unless only numbers have changed."""
        for status in statuses(message):
            if status.node == "bag_player":
                self.played = status.number("position s") or 0.0
            if status.node == "robot_commands":
                before, self.reason = self.reason, status.text
                if NUMBER.sub("", before) != NUMBER.sub("", self.reason):
                    print(f"robot_commands: {self.reason}")

    def go_to(self, position: FloatArray, seconds: float) -> None:
        """Follow a command."""
        self.command, self.heard = position, time.monotonic()
        self.commands += 1
        self.first = min(self.first, self.heard)
        self.arm.go_to(position, seconds)

    def advance(self) -> None:
        """Simulate up to the present, at most ten periods, and publish and record the state."""
        now = time.monotonic()
        self.arm.advance(min(now - self.passed, 10 * PERIOD))
        self.passed = now
        message = JointState(name=list(self.mapping.joints))
        message.header.stamp = self.get_clock().now().to_msg()
        message.position, message.velocity = self.arm.position.tolist(), self.arm.velocity.tolist()
        self.states.publish(message)
        self.times.append(now)
        self.told.append(self.command if now - self.heard < 0.1 else np.full_like(self.command, np.nan))
        self.stood.append(self.arm.position)
        self.points.append(self.arm.points)


def report(arm: Arm) -> str:
    """A table of how each joint followed its commands."""
    times, told, stood = np.array(arm.times), np.array(arm.told), np.array(arm.stood)
    heads = f"{'joint':<10} {'from':>7} {'to':>7} {'rms error':>10} {'behind':>8}"
    lines = [f"{heads}   (the arm against its commands; degrees, ms)"]
    for column, name in enumerate(arm.mapping.joints):
        errors = []
        for delay in COMPARED_DELAYS:
            then = np.interp(times + delay, times, stood[:, column])
            errors.append(float(np.sqrt(np.nanmean((then - told[:, column]) ** 2))))
        best = int(np.argmin(errors))
        low, high = np.degrees(np.nanmin(told[:, column])), np.degrees(np.nanmax(told[:, column]))
        behind = f"{1e3 * COMPARED_DELAYS[best]:.0f}" if high - low > 1.0 else "-"
        lines.append(f"{name:<10} {low:7.1f} {high:7.1f} {np.degrees(errors[best]):10.2f} {behind:>8}")
    return "\n".join(lines)


def draw(arm: Arm, path: Path) -> None:
    """Draw commands and joints over time, and the arm at some instants."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    times, told, stood = np.array(arm.times), np.degrees(arm.told), np.degrees(arm.stood)
    given = np.isfinite(told).all(axis=1)
    time_s = times - times[given][0]
    shown = (time_s >= -0.5) & (time_s <= time_s[given][-1] + 1.0)
    n = len(arm.mapping.joints)
    figure: Any = Figure(figsize=(10.0, 1.4 + 1.3 * n if n > 2 else 5.0), dpi=80, layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(n, 2, width_ratios=(3.0, 2.0))
    for column, name in enumerate(arm.mapping.joints):
        axis = figure.add_subplot(grid[column, 0])
        axis.plot(time_s[shown], told[shown, column], color="#d1571b", linewidth=2.2, label="commanded")
        axis.plot(time_s[shown], stood[shown, column], color="#1f6fb4", linewidth=1.0, label="followed")
        axis.set_ylabel(f"{name} (deg)", fontsize=8)
        low, high = axis.get_ylim()
        axis.set_ylim(min(low, 0.5 * (low + high) - 5.0), max(high, 0.5 * (low + high) + 5.0))
        axis.grid(color="#eeeeee")
        if np.isfinite(arm.killed):
            axis.axvline(arm.killed - times[given][0], color="black", linestyle=":", label="player killed")
        if column == 0:
            axis.legend(fontsize=8, loc="best")
    axis.set_xlabel("s since the first command; no orange line: no commands")
    picture = figure.add_subplot(grid[:, 1], projection="3d")
    instants = np.linspace(*np.flatnonzero(given)[[0, -1]], 7).astype(int)
    for number, instant in enumerate(instants):
        points = arm.points[instant]
        shade = 0.85 - 0.85 * number / (len(instants) - 1)
        picture.plot(*points.T, "-o", color=(shade, shade, shade), markersize=3)
    picture.set_title(f"{arm.mapping.robot}, light to dark", fontsize=9)
    picture.set_xlabel("x forward (m)", labelpad=8)
    picture.set_ylabel("y left (m)", labelpad=8)
    picture.zaxis.set_rotate_label(False)  # to be read upwards, whichever way the axis leans
    picture.set_zlabel("z up (m)", labelpad=8, rotation=90)
    low, high = np.min(arm.points, axis=(0, 1)), np.max(arm.points, axis=(0, 1))
    sizes = np.maximum(1.1 * (high - low), 0.5 * (high - low).max())  # on a narrow side the ticks would overlap
    ends = 0.5 * (low + high) + 0.5 * np.array([-sizes, sizes])
    picture.set(xlim=ends[:, 0], ylim=ends[:, 1], zlim=ends[:, 2])
    for axis in (picture.xaxis, picture.yaxis, picture.zaxis):
        axis.set_major_locator(MaxNLocator(2))  # intervals: at most three ticks
    picture.set_box_aspect(sizes, zoom=0.85)
    picture.view_init(elev=15, azim=-60)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, format="png")


class Graph:
    """The processes that command the arm: ``body_tracking up`` over a bag, or a player of a bag with joint angles.

    Args:
        bag: to play.
        file: the robot's mapping.
        filter_name: of the graph; empty if the bag holds angles.
    """

    def __init__(self, bag: Path, file: Path, filter_name: str) -> None:
        self._bag, self._live = bag, bool(filter_name)
        self._others: list[subprocess.Popen[bytes]] = []
        self._begun = self._again = np.inf
        self._played = 0.0
        if self._live:
            command = ["body_tracking.cli", "up", "--bag", bag, "--filter", filter_name, "--robot", file]
            self._main = subprocess.Popen([sys.executable, "-m", *command])
            return
        with BagReader(bag) as reader:
            self._sensors = sensors_among(reader.topics)
        listed = f"[{','.join(self._sensors)}]"
        self._others = [
            self._node("calibration", sensors=listed, use_sim_time=True),
            self._node("robot_commands", mapping=file, sensors=listed, use_sim_time=True),
        ]
        self._play()

    @staticmethod
    def _node(executable: str, **parameters: object) -> subprocess.Popen[bytes]:
        words = [word for name, value in parameters.items() for word in ("-p", f"{name}:={value}")]
        # what robot_commands logs of its states is in its diagnostics, too, which the arm prints
        words += ["--log-level", "warn"]
        return subprocess.Popen([sys.executable, "-m", "body_tracking.nodes", executable, "--ros-args", *words])

    def _play(self) -> None:
        skeletons = [skeleton_topic(sensor) for sensor in self._sensors]
        angles = [joint_states_topic(DEFAULT_BODY), joint_states_stddev_topic(DEFAULT_BODY)]
        self._main = self._node(
            "bag_player",
            bag=self._bag,
            topics=f"[{','.join([*skeletons, *angles])}]",
            wait_for_subscribers=f"[{','.join(repr(f'{topic}:2') for topic in skeletons)}]",
            start_offset=self._played,
        )

    def running(self) -> bool:
        """Whether the bag still plays; a killed player is restarted after ``RESTART``, as ``up`` does."""
        if self._main.poll() is None:
            return True
        if time.monotonic() > self._again:
            self._again = np.inf
            self._play()
            return True
        return np.isfinite(self._again)

    def kill(self, played: float) -> None:
        """Kill the player, ``played`` seconds into the bag, as a crash would. Linux only."""
        if not self._live:
            self._main.kill()
            self._again, self._played = time.monotonic() + RESTART, played
            return
        for child in Path(f"/proc/{self._main.pid}/task/{self._main.pid}/children").read_text().split():
            if b"bag_player" in Path(f"/proc/{child}/cmdline").read_bytes().split(b"\0"):
                os.kill(int(child), signal.SIGKILL)

    def end(self) -> int:
        """Stop all processes; returns the exit code."""
        for process in (self._main, *self._others):
            if process.poll() is None:
                process.send_signal(signal.SIGINT)
            process.wait()
        return max(0, self._main.returncode, *(process.returncode for process in self._others))


def parser() -> argparse.ArgumentParser:
    """The parser of the command line."""
    made = argparse.ArgumentParser(description=__doc__.partition("\n\n")[0] if __doc__ else "")
    made.add_argument("robot", choices=sorted(path.stem for path in HERE.glob("*.xml")), help="which arm")
    made.add_argument(
        "--bag", type=Path, metavar="BAG", help="play this through the graph; without it, wait for commands"
    )
    made.add_argument("--filter", default="ekf", help="of the graph (default: ekf)")
    made.add_argument(
        "--angles", action="store_true", help="the bag holds joint angles, by body_tracking replay: play these alone"
    )
    made.add_argument(
        "--kill",
        type=float,
        metavar="S",
        help="kill the player of the bag so long after the first command; up restarts it",
    )
    made.add_argument("-o", "--output", type=Path, metavar="PNG", help="draw a picture into this file")
    return made


def main() -> int:
    """Run until the bag ends, or Ctrl-C."""
    made = parser()
    args = made.parse_args()
    if args.bag is None and (args.angles or args.kill is not None):
        made.error("--angles and --kill need --bag")
    if args.kill is not None and not 0.0 <= args.kill < np.inf:
        made.error(f"--kill: {args.kill:g}, expected seconds from 0 on")
    if args.output is not None and args.output.is_dir():
        made.error(f"--output: {args.output} is a folder, expected a file")
    file = ROBOTS / f"{args.robot}.yaml"
    try:
        domain(os.environ)
        mapping = load(file, {name: angle_names(name) for name in ALL_CONVENTIONS})
        if args.angles:  # another bag is refused by the graph
            BagReader(args.bag).close()
    except BodyTrackingError as error:
        print(f"drive: {error}", file=sys.stderr)
        return 2
    context = rclpy.Context()
    rclpy.init(context=context)
    node = Arm(mapping, SimulatedArm(HERE / f"{args.robot}.xml", mapping.joints, mapping.home), context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    graph, kill = None, args.kill
    with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
        if args.bag is not None:
            graph = Graph(args.bag, file, "" if args.angles else args.filter)
        else:
            print(f"waiting for commands on {mapping.output.topic}, until Ctrl-C", flush=True)
        while graph is None or graph.running():
            executor.spin_once(timeout_sec=0.5)
            if graph is not None and kill is not None and time.monotonic() - node.first > kill:
                kill, node.killed = None, time.monotonic()
                graph.kill(node.played)
    code = graph.end() if graph is not None else 0
    executor.shutdown()
    rclpy.try_shutdown(context=context)
    if not node.commands:
        if not code:  # else the graph has said why
            print(f"no command came: {node.reason}", file=sys.stderr)
        return code or 1
    print(f"\n{mapping.robot}: {node.commands} commands\n{report(node)}")
    if args.output is not None:
        try:
            draw(node, args.output)
        except OSError as error:
            print(f"drive: {args.output}: the picture cannot be written ({error.strerror})", file=sys.stderr)
            return code or 2
        print(f"picture: {args.output}")
    return code


if __name__ == "__main__":
    sys.exit(main())
