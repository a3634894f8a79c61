"""Many small matrices that a filter written for one takes for one.

``filterpy.kalman.KalmanFilter`` writes its equations with ``numpy.dot``, ``.T``, ``+`` and ``-`` alone. Those mean the
wrong thing on a stack of matrices; on a :class:`Stacked` they mean, of every matrix in it, what they mean on one. So
one filter object runs a whole skeleton of independent filters in some twenty numpy calls instead of five hundred, and
its equations stay filterpy's own.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike


class Stacked(np.ndarray[Any, np.dtype[np.float64]]):
    """An array of matrices (..., rows, columns) that multiplies and transposes matrix by matrix.

    ``numpy.dot`` is ``numpy.matmul`` (which broadcasts, so one shared (6, 6) matrix may meet a (25, 6, 6) stack) and
    ``.T`` exchanges the last two axes. All else is an ordinary array.
    """

    @classmethod
    def of(cls, values: ArrayLike) -> Stacked:
        """The same numbers, not copied where they already are an array of float64."""
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
