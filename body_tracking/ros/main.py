"""How a node starts and ends."""

# rclpy is only partly typed, and absent where there is no ROS.
# mypy: disable-error-code="no-untyped-call, attr-defined, misc"

from __future__ import annotations

import contextlib
import faulthandler
import gc
import inspect
import signal
import socket
import sys
import threading
from typing import TYPE_CHECKING

import rclpy
from rclpy.exceptions import InvalidHandle
from rclpy.executors import ExternalShutdownException
from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.parameters import (
    as_yaml,
    read_file,
)
from body_tracking.core.signals import ENDING, release_signals
from body_tracking.ros import dds
from body_tracking.ros.declare import parameter_files
from body_tracking.ros.executor import LeanExecutor

if TYPE_CHECKING:
    from body_tracking.ros.node import GraphNode

RCLError: type[Exception] = _rclpy.RCLError
_LEAVE_S = 5.0
"""Seconds for the middleware to let a node go that is closed."""


class _SignalHandler:
    """Waits for SIGINT and SIGTERM in a thread of its own, and then ends the executor.

    SIGINT (Ctrl-C, the end of a recording in ``body_tracking up``) lets a node finish what it has been sent; SIGTERM,
    or a second SIGINT, does not.

    rclpy's own handler shuts the context down at once, from another thread; the main thread may then be destroying the
    node, and the process crashes now and then. Here everything ends in its order, and a second Ctrl-C waits until a
    recording is closed.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._asked = 0
        self._executor: LeanExecutor | None = None
        # Python runs its handlers only between two steps of the main thread, which mostly waits below Python; the byte
        # that it writes for each signal comes through at once.
        self._reader, self._writer = socket.socketpair()
        self._writer.setblocking(False)
        signal.set_wakeup_fd(self._writer.fileno(), warn_on_full_buffer=False)
        for number in ENDING:
            signal.signal(number, lambda *_: None)
        threading.Thread(target=self._wait, daemon=True).start()
        release_signals()

    def ignore_sigint(self) -> None:
        """Everything has ended: another Ctrl-C, as ``ros2 launch`` passes it on, must not kill what shuts down.

        Python lets go of its handlers then, but for signals that are ignored.
        """
        signal.signal(signal.SIGINT, signal.SIG_IGN)

    def _wait(self) -> None:
        while True:
            number = self._reader.recv(1)[0]
            if number not in ENDING:
                continue
            with self._lock:
                self._asked += 2 if number == signal.SIGTERM else 1
                self._end()

    def watch(self, executor: LeanExecutor) -> LeanExecutor:
        """End this executor; at once, if a signal has come already."""
        with self._lock:
            self._executor = executor
            self._end()
        return executor

    @property
    def graceful(self) -> bool:
        """Whether there is time to finish."""
        return self._asked < 2

    def _end(self) -> None:
        if self._executor is not None and self._asked:
            (self._executor.finish if self.graceful else self._executor.stop)()


def usage(node_class: type[GraphNode]) -> str:
    """What ``--help`` prints."""
    name = node_class.NAME
    return (
        f"usage: ros2 run body_tracking {name} [--ros-args [-p PARAMETER:=VALUE ...] [--params-file FILE]]\n\n"
        f"{inspect.getdoc(node_class)}\n\nIts parameters with their defaults, as a parameters file:\n\n"
        f"{as_yaml({name: node_class.PARAMETERS})}"
    ).rstrip()


def run(node_class: type[GraphNode]) -> None:
    """``main`` of every node: exit code 0 at its end or on Ctrl-C, 2 with one line when it cannot start."""
    if signal.sigpending() & set(ENDING):
        return  # it was to end while it was imported
    asked = {"-h", "--help"}
    if asked & set(sys.argv) and asked & set(remove_ros_args(sys.argv)[1:]):  # the latter reads parameters files
        print(usage(node_class))
        return
    code, node = 0, None
    faulthandler.enable()  # a crash below Python says where it was
    handler = _SignalHandler()
    try:
        for file in parameter_files():
            read_file(file)  # rcl's own complaint takes several lines
        dds.prepare()
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
        node = node_class()
        # What is there now stays: the collector need not look at it again while frames wait.
        gc.collect()
        gc.freeze()
        handler.watch(LeanExecutor(node)).spin()
        if handler.graceful:
            node.hand_over()
    except ExternalShutdownException:
        pass
    except BodyTrackingError as error:
        print(f"{node_class.NAME}: {error}", file=sys.stderr)
        code = 2
    except RCLError as error:
        if node is None:
            print(f"{node_class.NAME}: {' '.join(str(error).split())}", file=sys.stderr)
            code = 2
        elif node.context.ok():
            raise
        # else the node shut itself down between two steps of the executor: the end, like any other
    finally:
        if node is not None:
            node.close()
        # Nothing is lost any more: what waits for ever, below Python, is told and ended.
        faulthandler.dump_traceback_later(_LEAVE_S, exit=True)
        if node is not None:
            with contextlib.suppress(InvalidHandle):
                node.destroy_node()
        rclpy.try_shutdown()
        faulthandler.cancel_dump_traceback_later()
        handler.ignore_sigint()
    if code:
        sys.exit(code)
