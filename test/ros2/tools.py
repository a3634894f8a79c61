"""The real ``ros2`` as a user runs it, in a domain and a working directory of its own."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Self

import psutil
from running import Running


def members(session: int) -> list[psutil.Process]:
    """The processes of a terminal's session that still run."""
    found = []
    for process in psutil.process_iter():
        with contextlib.suppress(ProcessLookupError, psutil.Error):
            if os.getsid(process.pid) == session and process.status() != psutil.STATUS_ZOMBIE:
                found.append(process)
    return found


def kill(session: int) -> None:
    """Kill all processes of a session."""
    for process in members(session):
        with contextlib.suppress(psutil.Error):
            process.kill()


class Tool:
    """A command that runs in a session of its own.

    Args:
        command: with its arguments.
        log: file for all that it and its processes print.
        environment: of the terminal.
        folder: working directory.
    """

    def __init__(self, command: Sequence[str | Path], log: Path, environment: Mapping[str, str], folder: Path) -> None:
        self.log = log
        with log.open("wb") as out:
            self.process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=out,
                stderr=subprocess.STDOUT,
                env=environment,
                cwd=folder,
                start_new_session=True,
            )

    def text(self) -> str:
        """Its output so far."""
        return self.log.read_text(encoding="utf-8")

    def ended(self, timeout: float = 60.0) -> int:
        """Wait for its end; returns the exit code. No process that it started may still run."""
        try:
            code = self.process.wait(timeout)
        except subprocess.TimeoutExpired as error:
            error.add_note(self.text())
            raise
        left = members(self.process.pid)
        assert not left, (left, self.text())
        return code

    def interrupt(self) -> None:
        """As Ctrl-C: everything in the foreground gets it."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.process.pid, signal.SIGINT)


class Tools:
    """``ros2``, and a node that observes.

    Args:
        environment: of a terminal in which the workspace is sourced.
        folder: the working directory, for all output.
    """

    def __init__(self, environment: Mapping[str, str], folder: Path) -> None:
        self.folder = folder
        self.bench = Running(folder)
        self.environment = {
            **environment,
            "ROS_DOMAIN_ID": self.bench.environment["ROS_DOMAIN_ID"],
            "RCUTILS_COLORIZED_OUTPUT": "0",
        }
        self.share = Path(environment["AMENT_PREFIX_PATH"].split(":")[0]) / "share" / "body_tracking"
        self.started: list[Tool] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, value: object, traceback: TracebackType | None) -> None:
        for tool in self.started:
            kill(tool.process.pid)
        self.bench.__exit__(kind, value, traceback)

    def bag(self, name: str = "tpose_wave") -> Path:
        """A shipped recording, as installed."""
        return self.share / "bags" / name

    def start(self, *words: str | Path) -> Tool:
        """``ros2`` with these words."""
        number = len(self.started)
        # launch warns where two make a folder of logs at once
        environment = {**self.environment, "ROS_LOG_DIR": str(self.folder / "logs" / str(number))}
        self.started.append(Tool(["ros2", *words], self.folder / f"ros2_{number}.log", environment, self.folder))
        return self.started[-1]

    def launch(self, *arguments: str, file: str = "two_kinects.launch.py") -> Tool:
        """``ros2 launch`` of the graph."""
        return self.start("launch", "body_tracking", file, *arguments)

    def run(self, executable: str, *arguments: str, **parameters: object) -> Tool:
        """``ros2 run`` of a node, or of a command."""
        words = [word for name, value in parameters.items() for word in ("-p", f"{name}:={value}")]
        return self.start("run", "body_tracking", executable, *arguments, *(["--ros-args", *words] if words else []))

    def ask(self, wanted: str, *words: str | Path, timeout: float = 120.0) -> str:
        """The output of a command, which is repeated until the output contains ``wanted``, as a user would.

        On a busy machine the command may look for a node too briefly, and a service may respond before it has
        discovered the client: DDS then drops the response, and the command waits for it for ever.
        """
        end, said = time.monotonic() + timeout, ""
        while time.monotonic() < end:
            tool = self.start(*words)
            with contextlib.suppress(subprocess.TimeoutExpired):
                tool.process.wait(20.0)
            with contextlib.suppress(subprocess.TimeoutExpired):  # killed, it may block others by shared memory
                tool.interrupt()
                tool.process.wait(5.0)
            kill(tool.process.pid)
            tool.process.wait()
            said = tool.text()
            if wanted in said:
                return said
        raise AssertionError(f"{words}: no {wanted!r} in: {said}")


NO_DAEMON = "--no-daemon"
"""Option of commands of ``ros2`` that would start a permanent process otherwise."""
