"""Hands turned over: a pose with almost the same joint positions as the true one."""

from __future__ import annotations

import numpy as np

from body_tracking.core.skeleton import FloatArray, IntArray
from body_tracking.simulation.people import MODEL


def hand_columns(side: str) -> IntArray:
    """(3,) of the tangent: pronation, flexion and deviation."""
    names = ("forearm_pronation", "wrist_flexion", "wrist_deviation")
    return np.array([MODEL.coordinate_names.index(f"{name}_{side}") for name in names], dtype=np.intp)


def turned_over(q: FloatArray, side: str) -> FloatArray:
    """(35,) the forearm turned by half a turn and the wrist bent the other way, which moves the thumb alone."""
    columns = hand_columns(side)
    pronation, *wrist = MODEL.difference(MODEL.neutral(), q)[columns]
    tangent = np.zeros(MODEL.nv)
    tangent[columns] = -np.copysign(np.pi, pronation), *(-2.0 * np.array(wrist))
    return MODEL.integrate(q, tangent)
