"""Filling of short gaps in marker trajectories and smoothing, as Schlagenhauf (2017, section 5.6.3)."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.linalg import solveh_banded
from scipy.optimize import minimize_scalar

from body_tracking.core.skeleton import BoolArray, FloatArray

LONGEST_GAP = 0.2
"""Seconds: gaps of this length or longer stay open (Schlagenhauf 2017, section 5.6.3)."""

_LEAST_TO_SMOOTH = 5
_SMOOTHEST = 8.0
_ROUGHEST = -4.0
"""Search range of the smoothing parameter, as decades in sample intervals cubed."""


def fill_gaps(values: FloatArray, rate: float) -> FloatArray:
    """Fill gaps shorter than 0.2 s by cubic splines (Schlagenhauf 2017, section 5.6.3).

    A spline passes through all known samples between two longer gaps. The ends are not extrapolated.

    Args:
        values: (n, 3), NaN where unknown.
        rate: samples per second.
    """
    filled = values.copy()
    known = np.flatnonzero(np.isfinite(values).all(axis=1))
    missing = np.diff(known) - 1
    breaks = (
        np.flatnonzero(missing >= rate * LONGEST_GAP - 1e-6) + 1
    )  # 20 frames at 100 Hz are 0.2 s in spite of rounding
    for each in np.split(known, breaks):
        if len(each) > 1 and each[-1] - each[0] >= len(each):
            inside = np.arange(each[0], each[-1] + 1)
            unknown = np.setdiff1d(inside, each, assume_unique=True)
            filled[unknown] = CubicSpline(each, values[each])(unknown)
    return filled


def smooth(values: FloatArray) -> FloatArray:
    """Replace every run of known samples by its smoothing spline with generalised cross-validation.

    As Schlagenhauf 2017, section 5.6.3, except for the spline's order. The cubic spline minimises the squared
    residuals plus ``lambda`` times the integral of the squared second derivative. One ``lambda`` for all coordinates of
    a run minimises (Craven and Wahba 1979; Woltring, Adv. Eng. Softw. 8, 1986)::

        GCV = mean squared residual / (1 - trace of the influence matrix / n)^2

    ``scipy.interpolate.make_smoothing_spline`` gives this spline, but its search takes seconds per coordinate and
    minute of recording: here the samples are equidistant, so that one banded system gives the residuals (Reinsch 1967)
    and eigenvalues in closed form the trace (within 0.5 % from 20 samples on).

    Args:
        values: (n, k), equidistant in time, NaN where unknown. Runs of fewer than 5 samples are not smoothed.
    """
    smoothed = values.copy()
    for first, end in runs(np.isfinite(values.sum(axis=1))):
        if end - first >= _LEAST_TO_SMOOTH:
            smoothed[first:end] -= _gcv_residual(values[first:end])
    return smoothed


def _gcv_residual(values: FloatArray) -> FloatArray:
    """(n, k) residuals of the smoothing spline."""
    n = len(values)
    curvature = np.diff(values, 2, axis=0)
    roughness = np.repeat([[1.0], [-4.0], [6.0]], n - 2, axis=1)  # Q'Q, and R below, in Reinsch's notation
    spread = np.repeat([[0.0], [1.0 / 6.0], [2.0 / 3.0]], n - 2, axis=1)
    frequency = (np.arange(1, n - 1) + 0.5) * np.pi / n
    eigenvalues = 3.0 * (2.0 - 2.0 * np.cos(frequency)) ** 2 / (2.0 + np.cos(frequency))

    def residual(decade: float) -> FloatArray:
        weight = 10.0**decade
        solved = solveh_banded(spread + weight * roughness, curvature)
        taken: FloatArray = weight * np.diff(np.pad(solved, ((2, 2), (0, 0))), 2, axis=0)
        return taken

    def gcv(decade: float) -> float:
        trace = 2.0 + (1.0 / (1.0 + 10.0**decade * eigenvalues)).sum()
        return float((residual(decade) ** 2).mean() / (1.0 - trace / n) ** 2)

    decades = np.linspace(_ROUGHEST, _SMOOTHEST, 25)
    best = decades[np.argmin([gcv(decade) for decade in decades])]
    step = decades[1] - decades[0]
    bounds = (max(best - step, _ROUGHEST), min(best + step, _SMOOTHEST))
    found = minimize_scalar(gcv, bounds=bounds, method="bounded", options={"xatol": 0.01})
    return residual(found.x if found.fun < gcv(best) else best)


def runs(flags: BoolArray) -> list[tuple[int, int]]:
    """(first, end) of every run of true flags; ``end`` is exclusive."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8)))
    return [(int(first), int(end)) for first, end in edges.reshape(-1, 2)]
