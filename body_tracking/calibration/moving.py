"""Moving sums and minima in numpy: importing ``scipy.ndimage`` for them takes the node ``calibration`` 0.4 s."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from body_tracking.core.skeleton import BoolArray, FloatArray


def weighted(values: FloatArray, weights: Sequence[float] | FloatArray) -> FloatArray:
    """The weighted sums over a window along the last axis; beyond the ends, the end values are repeated.

    Args:
        values: (..., n).
        weights: (k,) with k odd.

    Returns:
        (..., n).
    """
    beyond = [(0, 0)] * (values.ndim - 1) + [(len(weights) // 2,) * 2]
    sums: FloatArray = sliding_window_view(np.pad(values, beyond, mode="edge"), len(weights), axis=-1) @ weights
    return sums


def all_in(flags: BoolArray, width: int) -> BoolArray:
    """(n,) whether all of (n,) flags hold in a window of an odd width."""
    windows = sliding_window_view(np.pad(flags, width // 2, mode="edge"), width)
    found: BoolArray = np.asarray(windows.all(axis=-1), dtype=np.bool_)
    return found
