"""SIGINT and SIGTERM, which are blocked while a node starts."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Iterator

ENDING = (signal.SIGINT, signal.SIGTERM)


def hold_signals() -> None:
    """Block SIGINT and SIGTERM, also across ``exec``, by which the client library from PyPI restarts Python."""
    signal.pthread_sigmask(signal.SIG_BLOCK, ENDING)


def release_signals() -> None:
    """Unblock them; each that is pending is delivered once."""
    signal.pthread_sigmask(signal.SIG_UNBLOCK, ENDING)


@contextlib.contextmanager
def signals_held() -> Iterator[None]:
    """A context in which child processes start with these signals blocked."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, ENDING)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
