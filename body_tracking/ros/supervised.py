"""Ending with the supervisor: no node outlives the ``body_tracking up`` that started it."""

from __future__ import annotations

import ctypes
import os
import signal

from body_tracking.pipeline.graph import PARENT_VARIABLE

_PR_SET_PDEATHSIG = 1


def die_with_parent() -> None:
    """Have this process killed when the one that started it ends, however that ends. Linux only."""
    parent = os.environ.get(PARENT_VARIABLE)
    if parent is None:
        return
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != int(parent):  # it ended before the line above
        os.kill(os.getpid(), signal.SIGKILL)
