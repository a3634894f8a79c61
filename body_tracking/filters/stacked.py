"""Stacks of small matrices for filters that are written for single matrices.

``filterpy.kalman.KalmanFilter`` uses only ``numpy.dot``, ``.T``, ``+`` and ``-``. On a :class:`Stacked` these apply to
every matrix, so one filter object runs a whole skeleton of independent filters in some twenty numpy calls instead of
five hundred, with filterpy's own equations.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike


class Stacked(np.ndarray[Any, np.dtype[np.float64]]):
    """An array of matrices (..., rows, columns) that multiplies and transposes matrix by matrix.

    ``numpy.dot`` is ``numpy.matmul`` (which broadcasts, so one shared (6, 6) matrix may meet a (25, 6, 6) stack) and
    ``.T`` exchanges the last two axes.
    """

    @classmethod
    def of(cls, values: ArrayLike) -> Stacked:
        """A view of the values, without a copy for an array of float64."""
        return np.asarray(values, dtype=np.float64).view(cls)

    @property
    def T(self) -> Stacked:
        """Every matrix transposed."""
        return self.swapaxes(-1, -2)

    def __array_function__(
        self, func: Callable[..., Any], types: Iterable[Any], args: Iterable[Any], kwargs: Mapping[str, Any]
    ) -> Any:
        if func is np.dot:
            return np.matmul(*args, **kwargs)
        return super().__array_function__(func, types, args, kwargs)
