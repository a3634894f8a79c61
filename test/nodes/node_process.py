"""Nodes as processes of their own, forked from one that has already imported everything.

Importing takes a node over a second of a processor, and the tests start some hundred nodes. What is forked is as real
a process as any: DDS, signals, exit codes and limits are its own. ``test/ros2`` and ``test_up.py`` start nodes
as users do.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import resource
import runpy
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from body_tracking.pipeline.graph import PARENT_VARIABLE
from body_tracking.systems import EXECUTABLES

_FORKING = multiprocessing.get_context("forkserver")
_FORKING.set_forkserver_preload([f"body_tracking.nodes.{executable}" for executable in EXECUTABLES])


class NodeProcess:
    """A running node, with the part of ``subprocess.Popen`` that tests use.

    Args:
        executable: as for ``ros2 run``.
        arguments: of the executable.
        log: file for all that it prints.
        environment: of the process.
        folder: working directory; None for that of the tests.
        file_size_limit: bytes beyond which a file cannot grow; None for no limit.
    """

    def __init__(
        self,
        executable: str,
        arguments: Sequence[str],
        log: Path,
        environment: Mapping[str, str],
        folder: Path | None = None,
        file_size_limit: int | None = None,
    ) -> None:
        self.args = (executable, *arguments)
        self._log = log
        given = (tuple(self.args), log.absolute(), dict(environment), folder, file_size_limit)
        self._process = _FORKING.Process(target=_run, args=given, daemon=True)
        self._process.start()

    @property
    def pid(self) -> int:
        assert self._process.pid is not None
        return self._process.pid

    @property
    def returncode(self) -> int | None:
        return self._process.exitcode

    def poll(self) -> int | None:
        return self._process.exitcode

    def wait(self, timeout: float | None = None) -> int:
        self._process.join(timeout)
        if self._process.exitcode is None:
            raise subprocess.TimeoutExpired(self.args, timeout or 0.0)
        return self._process.exitcode

    def send_signal(self, number: signal.Signals) -> None:
        """As ``Popen`` does: nothing happens to a process that has ended, or ends just now."""
        if self.poll() is None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.pid, number)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)

    def output(self) -> str:
        """Its output so far."""
        return self._log.read_text()


def _run(
    arguments: tuple[str, ...],
    log: Path,
    environment: dict[str, str],
    folder: Path | None,
    file_size_limit: int | None,
) -> None:
    """Run in the new process: as ``python -m body_tracking.nodes`` does."""
    os.environ.clear()
    os.environ.update(environment | {PARENT_VARIABLE: str(os.getppid())})
    target = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_APPEND)
    for number in (1, 2):
        os.dup2(target, number)
    if folder is not None:
        os.chdir(folder)
    sys.stdout.reconfigure(line_buffering=True)  # type: ignore[union-attr]
    if file_size_limit is not None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (file_size_limit, resource.RLIM_INFINITY))
    signal.signal(signal.SIGINT, signal.default_int_handler)
    sys.argv = ["body_tracking.nodes", *arguments]
    runpy.run_module("body_tracking.nodes", run_name="__main__", alter_sys=True)
