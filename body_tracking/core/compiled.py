"""Loops, compiled by numba the first time they run.

Importing numba takes half a second: only modules that run such loops import this one.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

_Function = TypeVar("_Function", bound=Callable[..., Any])

LOOPS: list[Any] = []
"""All compiled functions of the modules that have been imported."""


def compiled(function: _Function) -> _Function:
    """Compile a function of numbers and arrays; its types stay those of the Python function.

    The machine code is kept beside the module, or in the user's cache folder where that one cannot be written to.
    Where neither can, each process compiles anew.
    """
    try:
        loop = numba.njit(cache=True, error_model="numpy")(function)
    except RuntimeError:  # numba's: "no locator available"
        loop = numba.njit(error_model="numpy")(function)
    LOOPS.append(loop)
    return cast("_Function", loop)
