"""Leaving a process that the middleware blocks."""

from __future__ import annotations

import contextlib
import ctypes
import faulthandler
import sys
from collections.abc import Iterator

_CLOCK_MONOTONIC, _SIGEV_THREAD = 1, 2


class _Sigevent(ctypes.Structure):
    """``struct sigevent`` of Linux; ``value`` is the argument of the function."""

    _fields_ = (
        ("value", ctypes.c_void_p),
        ("signo", ctypes.c_int),
        ("notify", ctypes.c_int),
        ("function", ctypes.c_void_p),
        ("attributes", ctypes.c_void_p),
        ("rest", ctypes.c_char * 32),
    )


@contextlib.contextmanager
def leaving_within(seconds: float, code: int) -> Iterator[None]:
    """End the process if the body of the ``with`` statement takes too long.

    A process that is killed may hold a mutex in the shared memory by which Fast DDS 2.14 sends. Fast DDS's thread for
    timers in another process then waits for that mutex for ever (``SharedMemManager::Port::regenerate_port``), and the
    destruction of a writer waits for that thread. rclpy holds the interpreter's lock meanwhile, so that no thread of
    Python can end the process. A timer of the C library calls ``_exit`` in a thread of its own.

    Args:
        seconds: time after which the process ends.
        code: its exit code then.
    """
    for stream in (sys.stdout, sys.stderr):  # _exit would lose their buffers
        with contextlib.suppress(OSError, ValueError):
            stream.flush()
    library = ctypes.CDLL(None)
    event = _Sigevent(code, 0, _SIGEV_THREAD, ctypes.cast(library._exit, ctypes.c_void_p))
    timer = ctypes.c_void_p()
    create = getattr(library, "timer_create", None)  # before glibc 2.34 in another library
    if create is None or create(_CLOCK_MONOTONIC, ctypes.byref(event), ctypes.byref(timer)):
        faulthandler.dump_traceback_later(seconds, exit=True)
        try:
            yield
        finally:
            faulthandler.cancel_dump_traceback_later()
        return
    whole, part = divmod(seconds, 1.0)
    library.timer_settime(timer, 0, (ctypes.c_long * 4)(0, 0, int(whole), int(1e9 * part)), None)
    try:
        yield
    finally:
        library.timer_delete(timer)
