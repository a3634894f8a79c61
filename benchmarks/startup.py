"""How long a user waits: --help, the first line of up, the first joint angle and the page of the viewer, in seconds.

``body_tracking up --bag bags/tpose_wave``, with and without ``--viewer``, is started anew each time; a subscriber in
another process notes the receipt of the first finite joint angles. Times are from the start of the command.
"""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from typing import Any

import common
import numpy as np

LIMITS = {"--help": 0.5, "up, first line": 1.0, "first angle": 5.0, "page": 5.0}
"""Bars in seconds, on an idle machine with two cores."""
PATIENCE = 120.0
COMMAND = (sys.executable, "-m", "body_tracking.cli")
BAG = common.ROOT / "bags" / "tpose_wave"


class Listener:
    """Notes the monotonic time of the first finite joint angles."""

    def __init__(self) -> None:
        import rclpy
        from rclpy.executors import SingleThreadedExecutor
        from sensor_msgs.msg import JointState

        from body_tracking.pipeline import graph

        self.first: float | None = None
        self._context = rclpy.Context()
        rclpy.init(context=self._context)
        node = rclpy.create_node("startup", context=self._context)
        node.create_subscription(JointState, graph.joint_states_topic(graph.DEFAULT_BODY), self._on_angles, 10)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(node)

    def _on_angles(self, message: Any) -> None:
        if self.first is None and np.isfinite(message.position).any():
            self.first = time.monotonic()

    def wait(self, begin: float) -> float:
        """Seconds from ``begin`` to the first angles."""
        for _ in range(20):  # angles of the graph before may still wait
            self._executor.spin_once(0.0)
        self.first = None
        while self.first is None and time.monotonic() < begin + PATIENCE:
            self._executor.spin_once(0.05)
        if self.first is None:
            raise SystemExit(f"no joint angles in {PATIENCE} s")
        return self.first - begin


def help_time() -> float:
    """Duration of ``body_tracking --help``, seconds."""
    begin = time.monotonic()
    subprocess.run([*COMMAND, "--help"], check=True, stdout=subprocess.DEVNULL)
    return time.monotonic() - begin


def up_times(listener: Listener, *, viewer: bool) -> dict[str, float]:
    """Seconds until the first line and the first angle; with a viewer instead of the angle until the page is served."""
    found: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as folder:
        words = ("up", "--bag", BAG, "--log-dir", folder, *(("--viewer",) if viewer else ()))
        begin = time.monotonic()
        process = subprocess.Popen(
            [*COMMAND, *words], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, process_group=0
        )

        def read() -> None:
            assert process.stdout is not None
            for line in process.stdout:
                found.setdefault("up, first line", time.monotonic() - begin)
                if viewer and "page" not in found and (address := re.search(r"open (http\S+)", line)):
                    with urllib.request.urlopen(address[1], timeout=10.0) as page:
                        page.read()
                    found["page"] = time.monotonic() - begin

        reader = threading.Thread(target=read, daemon=True)
        reader.start()
        try:
            first = listener.wait(begin)
            if not viewer:
                found["first angle"] = first
            while viewer and "page" not in found and time.monotonic() < begin + PATIENCE:
                time.sleep(0.05)
        finally:
            process.send_signal(signal.SIGINT)
            process.wait(30.0)
            reader.join(5.0)
    return found


def main() -> int:
    """The command; the exit code is 0 even if a target is missed."""
    parser = common.parser(__doc__)
    parser.add_argument("--runs", type=int, default=5, metavar="N", help="of each (default: %(default)s)")
    args = parser.parse_args()
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    os.environ["PYTHONUNBUFFERED"] = "1"
    listener, times = Listener(), {name: [] for name in LIMITS}  # type: tuple[Listener, dict[str, list[float]]]
    for _ in range(args.runs):
        times["--help"].append(help_time())
        for viewer in (False, True):
            for name, each in up_times(listener, viewer=viewer).items():
                times[name].append(each)
    figures = {
        name: {"median": round(float(np.median(each)), 2), "most": round(max(each), 2), "limit": LIMITS[name]}
        for name, each in times.items()
    }
    common.report(args, {"load": round(os.getloadavg()[0], 1), "seconds": figures})
    met = {f"{name}: at most {LIMITS[name]} s": each["median"] <= LIMITS[name] for name, each in figures.items()}
    common.verdicts(args, met)
    return 0


if __name__ == "__main__":
    sys.exit(main())
