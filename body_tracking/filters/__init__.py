"""Filters: skeletons in, smoother skeletons with covariances and velocities out.

Knows ``skeleton.py`` and ``kinematics`` (how people move; later the body model of the extended filter); used by the
nodes and the offline replay, which choose a filter by its name.
"""

from __future__ import annotations

from dataclasses import fields
from typing import Protocol

from body_tracking.filters.linear import LINEAR_MODELS, FilterError, LinearKalmanFilter, LinearKalmanParameters
from body_tracking.skeleton import Skeleton

__all__ = [
    "FILTERS",
    "FilterError",
    "LinearKalmanFilter",
    "LinearKalmanParameters",
    "SkeletonFilter",
    "make_filter",
]

FILTERS: tuple[str, ...] = LINEAR_MODELS
"""The names that :func:`make_filter` knows."""


class SkeletonFilter(Protocol):
    """What a filter of skeletons offers, whatever is inside."""

    counters: dict[str, int]

    def update(self, skeleton: Skeleton) -> Skeleton | None:
        """Take one frame; the filtered skeleton of the same stamp, or None where there is nothing to say."""

    def reset(self) -> None:
        """Forget the person; the counters stay."""


def make_filter(name: str, **parameters: float) -> SkeletonFilter:
    """A filter by its name.

    Args:
        name: one of ``FILTERS``.
        parameters: fields of the filter's parameter class (:class:`LinearKalmanParameters`).

    Raises:
        FilterError: an unknown name, an unknown parameter, a value out of range.
    """
    if name not in FILTERS:
        raise FilterError(f"unknown filter {name!r}, expected one of {', '.join(FILTERS)}")
    unknown = parameters.keys() - {item.name for item in fields(LinearKalmanParameters)}
    if unknown:
        raise FilterError(f"filter {name}: unknown parameter(s) {', '.join(sorted(unknown))}")
    return LinearKalmanFilter(name, LinearKalmanParameters(**parameters))
