"""Weights of the sensors' joints, by tracking state."""

from __future__ import annotations

import numpy as np

from body_tracking.core.skeleton import FloatArray, TrackingState


def thesis_text(states: np.ndarray) -> FloatArray:
    """The weights that Schlagenhauf 2017, section 5.3.2, describes in words, for any number of sensors.

    The average where the sensors agree on the state; only the Tracked ones where some track and others infer.

    Args:
        states: (k, 25) tracking states.

    Returns:
        (k, 25) weights that sum to 1 over the sensors, or to 0 where no sensor has the joint.
    """
    best = states.max(axis=0)
    chosen = ((states == best) & (best > TrackingState.NOT_TRACKED)).astype(np.float64)
    return _normalised(chosen)


def thesis_formula(states: np.ndarray) -> FloatArray:
    """The weights of Schlagenhauf 2017, eq. 5.9-5.10: in proportion to the numbers of the tracking states.

    A Tracked and an Inferred joint get 2/3 and 1/3, where the text says 1 and 0; where no sensor has the joint the
    formula is 0/0 and the weights are 0 here.

    Args:
        states: (k, 25) tracking states.

    Returns:
        (k, 25) weights that sum to 1 over the sensors, or to 0 where no sensor has the joint.
    """
    return _normalised(states.astype(np.float64))


def _normalised(weights: FloatArray) -> FloatArray:
    total = weights.sum(axis=0)
    share: FloatArray = weights / np.where(total > 0.0, total, 1.0)
    return share
