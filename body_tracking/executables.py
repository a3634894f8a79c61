"""The entry points of setup.py: nodes, and commands.

A node needs a second for its imports, and a SIGINT during that time would end it with a traceback. So signals are
blocked until the node can handle them: from here on, or from the start of the process where ``up`` or a script that
colcon installs starts it with blocked signals.
"""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
import os
import signal
import sys
import threading
from collections.abc import Callable
from functools import partial

from body_tracking.core.signals import ENDING, hold_signals, release_signals


def start(name: str) -> None:
    """Run the node of this name; a signal during the imports ends the process."""
    hold_signals()
    imported = threading.Event()
    threading.Thread(target=_leave_unless, args=(imported,), daemon=True).start()
    if importlib.util.find_spec(f"body_tracking.nodes.{name}") is not None:
        node = importlib.import_module(f"body_tracking.nodes.{name}")
        main = node.main
        if not {"-h", "--help"} & set(sys.argv):
            for module in getattr(node, "IMPORTED_AT_START", ()):
                with contextlib.suppress(ImportError):  # the node says what it lacks
                    importlib.import_module(module)
    else:  # of a system of another package
        main = importlib.import_module("body_tracking.ros.host").main_of(name)
    imported.set()
    main()


def _leave_unless(imported: threading.Event) -> None:
    while not imported.wait(0.05):
        if signal.sigpending() & set(ENDING):
            os._exit(0)


def command(module: str) -> int:
    """Run the command in a module of the package; its exit code."""
    try:
        release_signals()
        code: int = importlib.import_module(f"body_tracking.{module}").main()
    except KeyboardInterrupt:
        return 130
    return code


_COMMANDS = {"body_tracking": "cli", "kinect_sender": "kinect.kinect_sender"}


def __getattr__(name: str) -> Callable[[], int | None]:
    """``body_tracking.executables:fusion`` is the entry point of ``fusion``."""
    if name.startswith("_"):
        raise AttributeError(name)
    return partial(command, _COMMANDS[name]) if name in _COMMANDS else partial(start, name)
