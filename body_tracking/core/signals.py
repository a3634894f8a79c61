"""SIGINT and SIGTERM, which wait while a node starts."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Iterator

ENDING = (signal.SIGINT, signal.SIGTERM)


def hold_signals() -> None:
    """Let SIGINT and SIGTERM wait; also across ``exec``, by which the client library from PyPI starts Python anew."""
    signal.pthread_sigmask(signal.SIG_BLOCK, ENDING)


def release_signals() -> None:
    """Take those that have come meanwhile, each once, and all later ones."""
    signal.pthread_sigmask(signal.SIG_UNBLOCK, ENDING)


@contextlib.contextmanager
def signals_held() -> Iterator[None]:
    """Within it, processes are started with these signals blocked."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, ENDING)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
