"""Loops, compiled by numba the first time they run.

Importing numba takes half a second: only modules that run such loops import this one.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import shutil
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
import numpy as np
from numba.core import event
from numba.core.caching import UserWideCacheLocator

from body_tracking.core.files import user_cache

_Function = TypeVar("_Function", bound=Callable[..., Any])

LOOPS: list[Any] = []
"""All compiled functions of the modules that have been imported."""

_VERSIONS_KEPT = 4
"""Versions of a module's machine code: one for each of a developer's checkouts."""

_digests: dict[str, str] = {}
"""Digest of each module that has compiled functions, by the module's name."""


QUIET = 2.0
"""Seconds of compiling after which the user reads why the program waits."""


class CompilingNotice(event.TimingListener):  # type: ignore[misc]
    """Prints one line to stderr where a process compiles for long; loading from the cache prints nothing."""

    def on_end(self, event: Any) -> None:
        """A loop has been compiled; ``duration`` grows where it is not part of another one."""
        before = self.duration if self.done else 0.0
        super().on_end(event)
        if self.done and before <= QUIET < self.duration:
            print("compiling loops, once for each version: this may take a minute", file=sys.stderr, flush=True)


NOTICE = CompilingNotice()
event.register("numba:compile", NOTICE)


def compiled(function: _Function) -> _Function:
    """Compile a function of numbers and arrays; its types stay those of the Python function.

    The machine code is kept in the user's cache folder; if that is not writable, each process compiles anew.
    """
    settings: Any = numba.config
    before, settings.CACHE_LOCATOR_CLASSES = settings.CACHE_LOCATOR_CLASSES, f"{__name__}.{ByContent.__name__}"
    try:
        loop = numba.njit(cache=True, error_model="numpy")(function)
    except RuntimeError:  # numba's: "no locator available"
        loop = numba.njit(error_model="numpy")(function)
    finally:
        settings.CACHE_LOCATOR_CLASSES = before
    LOOPS.append(loop)
    return cast("_Function", loop)


class ByContent(UserWideCacheLocator):  # type: ignore[misc]
    """Locator of machine code in a folder whose name holds the digest of the source and of its imports.

    numba's own locators check only the function's own file: after a change of an imported function or constant they
    return outdated code. Copies of the package with equal modules (an installed one, a workspace, a second checkout)
    share the machine code.
    """

    def __init__(self, function: Any, path: str) -> None:
        """For one function, in the file of this path."""
        super().__init__(function, path)
        self._digest = digest(function, path)
        self._cache_path = str(user_cache() / "compiled" / f"{function.__module__}-{self._digest[:16]}")

    def ensure_cache_path(self) -> None:
        """Make the folder.

        Raises:
            OSError: it cannot be written to.
        """
        folder = Path(self._cache_path)
        if not folder.exists():
            module = folder.name.rpartition("-")[0]
            _remove_oldest(folder.parent.glob(f"{module}-*"))
        super().ensure_cache_path()

    def get_source_stamp(self) -> str:
        """Digest of the source and of its imports."""
        return self._digest


def digest(function: Any, path: str) -> str:
    """SHA-256 of a module's source and of the compiled functions and constants that it imports, hexadecimal.

    Args:
        function: the module's first compiled function; the module has run its imports by then.
        path: of the module's file.
    """
    module = function.__module__
    if module not in _digests:
        content = hashlib.sha256(Path(path).read_bytes())
        for name, value in sorted(function.__globals__.items()):
            if name.startswith("__"):
                continue
            origin = getattr(value, "py_func", value)  # of a compiled function; a module may be imported as a whole
            within = _digests.get(str(getattr(origin, "__module__", getattr(origin, "__name__", ""))))
            if within is not None:
                content.update(f"{name} {within}\n".encode())
            elif isinstance(value, np.ndarray):
                content.update(f"{name} {value.dtype} {value.shape}\n".encode() + value.tobytes())
            elif isinstance(value, bool | int | float | str | tuple) and " at 0x" not in repr(value):
                content.update(f"{name} {value!r}\n".encode())
        _digests[module] = content.hexdigest()
    return _digests[module]


def _remove_oldest(folders: Iterable[Path]) -> None:
    """Remove a module's least recently used versions; with the one to be written, ``_VERSIONS_KEPT`` remain."""
    with contextlib.suppress(OSError):  # another process removes them too
        newest_first = sorted(folders, key=os.path.getmtime, reverse=True)
        for folder in newest_first[_VERSIONS_KEPT - 1 :]:
            shutil.rmtree(folder, ignore_errors=True)
