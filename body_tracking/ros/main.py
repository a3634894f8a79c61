"""Start and end of a node's process."""

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
from rclpy.exceptions import InvalidHandle, InvalidParameterTypeException
from rclpy.executors import ExternalShutdownException
from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.parameters import as_yaml, read_file
from body_tracking.core.signals import ENDING, release_signals
from body_tracking.ros import dds
from body_tracking.ros.declare import parameter_files
from body_tracking.ros.executor import LeanExecutor
from body_tracking.ros.leaving import leaving_within

if TYPE_CHECKING:
    from body_tracking.ros.node import GraphNode

RCLError: type[Exception] = _rclpy.RCLError
_LEAVE_S = 10.0
"""Seconds for the middleware to destroy a closed node; with 24 nodes that end at once on a busy machine 5 may pass."""


class _SignalHandler:
    """Waits for SIGINT and SIGTERM in a thread of its own, and then ends the executor.

    After SIGINT (Ctrl-C, the end of a recording in ``body_tracking up``) a node handles the messages that were already
    sent; after SIGTERM, or a second SIGINT, it does not.

    rclpy's own handler shuts down the context at once from another thread, which crashes the process if the main thread
    destroys the node at that moment.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._asked = 0
        self._executor: LeanExecutor | None = None
        # Python runs its handlers only in the main thread, which mostly waits in C code; but it writes a byte for each
        # signal at once.
        self._reader, self._writer = socket.socketpair()
        self._writer.setblocking(False)
        signal.set_wakeup_fd(self._writer.fileno(), warn_on_full_buffer=False)
        for number in ENDING:
            signal.signal(number, lambda *_: None)
        threading.Thread(target=self._wait, daemon=True).start()
        release_signals()

    def _wait(self) -> None:
        while True:
            number = self._reader.recv(1)[0]
            if number not in ENDING:
                continue
            with self._lock:
                self._asked += 2 if number == signal.SIGTERM else 1
                self._end()

    def watch(self, executor: LeanExecutor) -> LeanExecutor:
        """End this executor on a signal; at once if one has been received already."""
        with self._lock:
            self._executor = executor
            self._end()
        return executor

    @property
    def graceful(self) -> bool:
        """Whether the node may handle its remaining messages."""
        return self._asked < 2

    def _end(self) -> None:
        if self._executor is not None and self._asked:
            (self._executor.finish if self.graceful else self._executor.stop)()


def usage(node_class: type[GraphNode]) -> str:
    """The text of ``--help``."""
    from body_tracking.systems import NODES  # not before every start

    name = node_class.NAME
    basic = NODES[name].basic if name in NODES else ()
    return (
        f"usage: ros2 run body_tracking {name} [--ros-args [-p PARAMETER:=VALUE ...] [--params-file FILE]]\n\n"
        f"{inspect.getdoc(node_class)}\n\nIts parameters with their defaults, as a parameters file:\n\n"
        f"{as_yaml({name: node_class.PARAMETERS}, {name: basic})}"
    ).rstrip()


def run(node_class: type[GraphNode]) -> None:
    """``main`` of every node: exit code 0 at its end or on Ctrl-C, 2 with one line when it cannot start."""
    if signal.sigpending() & set(ENDING):
        return  # a signal during the imports
    flags = {"-h", "--help"}
    if flags & set(sys.argv) and flags & set(remove_ros_args(sys.argv)[1:]):  # the latter reads parameters files
        signal.signal(signal.SIGPIPE, signal.SIG_DFL)  # the reader may end, as `head` does
        print(usage(node_class))
        return
    code, node = 0, None
    faulthandler.enable()  # prints a traceback after a crash in C code
    handler = _SignalHandler()
    try:
        for file in parameter_files():
            read_file(file)  # for an error in one line, where rcl's takes several
        dds.prepare()
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
        node = node_class()
        # The present objects stay; later collections skip them.
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
    except (RCLError, InvalidParameterTypeException) as error:  # the latter of use_sim_time, which rclpy declares
        if node is None:
            print(f"{node_class.NAME}: {' '.join(str(error).split())}", file=sys.stderr)
            code = 2
        elif node.context.ok():
            raise
        # otherwise the node shut itself down between two steps of the executor
    finally:
        if node is not None:
            node.close()
        # the node is closed: leaving early loses nothing
        with leaving_within(_LEAVE_S, code if sys.exc_info()[0] is None else 1):
            if node is not None:
                with contextlib.suppress(InvalidHandle):
                    node.destroy_node()
            rclpy.try_shutdown()
        # Python removes its handlers while it shuts down, except for ignored signals; ros2 launch passes Ctrl-C on then
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    if code:
        sys.exit(code)
