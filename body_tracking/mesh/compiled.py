"""Compilation of loops to machine code, kept on disk: only the first start after an installation compiles."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar, cast

import numba

_Function = TypeVar("_Function", bound=Callable[..., object])


def compiled(function: _Function) -> _Function:
    """Compile a function of numbers and arrays with numba, cached; its types stay those of the Python function."""
    return cast("_Function", numba.njit(cache=True, error_model="numpy")(function))
