"""Filters from skeletons to smoothed skeletons with covariances and velocities; one of them on a body model.

The stage chooses a filter by its name. A filter's module is imported when it is made, as importing scipy takes long.
"""

from __future__ import annotations

import importlib
from dataclasses import fields
from typing import TYPE_CHECKING, Any, Final, Protocol, runtime_checkable

from body_tracking.core.errors import one_of
from body_tracking.pipeline.roles import DEFAULT_FILTER as DEFAULT_FILTER

if TYPE_CHECKING:
    from body_tracking.core.estimate import ModelEstimate
    from body_tracking.core.orientation import SegmentOrientation
    from body_tracking.core.skeleton import Skeleton
    from body_tracking.kinematics.upper_body import UpperBody

_LINEAR: Final = ("linear:LinearKalmanFilter", "parameters:LinearKalmanParameters", "")
# name: module and class, those of its parameters, prefix of their names in the table of all filters
_FILTERS: Final = {
    "lkf_zero_velocity": _LINEAR,
    "lkf_constant_velocity": _LINEAR,
    "ekf": ("ekf.filter:ExtendedKalmanFilter", "ekf.parameters:EkfParameters", "ekf."),
    "thesis_lkf1": ("thesis:ThesisLkf1", "thesis:ThesisLkfParameters", "thesis_lkf."),
    "thesis_lkf2": ("thesis:ThesisLkf2", "thesis:ThesisLkfParameters", "thesis_lkf."),
    "schlagenhauf_ekf": (
        "schlagenhauf:SchlagenhaufKalmanFilter",
        "schlagenhauf:SchlagenhaufParameters",
        "schlagenhauf_ekf.",
    ),
}

FILTERS: Final = tuple(_FILTERS)
"""The names that :func:`make_filter` knows."""
THESIS_FILTERS: Final = ("thesis_lkf1", "thesis_lkf2", "schlagenhauf_ekf")
"""The published methods, which get uncorrected measurements."""


class SkeletonFilter(Protocol):
    """The interface of all filters."""

    counters: dict[str, int]

    def update(self, skeleton: Skeleton) -> Skeleton | None:
        """Take one frame; the filtered skeleton of the same stamp, or None without an estimate."""

    def reset(self) -> None:
        """Forget the person; the counters stay."""


@runtime_checkable
class LearningFilter(SkeletonFilter, Protocol):
    """A filter that learns a person's joint centres from a T-pose."""

    def forget_joint_centres(self) -> None:
        """Forget what a T-pose has shown, because the next frames may be of another person; all else stays."""


@runtime_checkable
class ModelFilter(SkeletonFilter, Protocol):
    """A filter on a body model, which takes each sensor's frames separately and predicts."""

    model: UpperBody

    def update(self, skeleton: Skeleton, sensor: str = "") -> Skeleton | None:
        """Take one frame of one sensor."""

    def take(self, skeleton: Skeleton, sensor: str = "") -> bool:
        """Take one frame without making the filtered skeleton; whether there is an estimate at its time."""

    def take_orientation(self, measurement: SegmentOrientation) -> bool:
        """Take the orientation of one segment; whether there is an estimate at its time."""

    def settle(self, until_ns: int) -> None:
        """Do deferred work while idle, if no measurement from before ``until_ns`` will come; results do not change."""

    @property
    def filtered(self) -> Skeleton | None:
        """The filtered skeleton at the latest frame; None before the first one."""

    @property
    def estimate(self) -> ModelEstimate | None:
        """The state of the model at the latest frame; None before the first one."""

    def predict(self, stamp_ns: int) -> tuple[Skeleton, ModelEstimate] | None:
        """The prediction at a later time; None where the person is lost."""


def _load(name: str) -> Any:
    module, _, attribute = name.partition(":")
    return getattr(importlib.import_module(f"{__name__}.{module}"), attribute)


def parameter_classes() -> dict[str, type[Any]]:
    """The parameter classes of all filters, by prefix."""
    return {prefix: _load(parameters) for _, parameters, prefix in _FILTERS.values()}


def _row(name: str) -> tuple[str, str, str]:
    if name not in _FILTERS:
        error: type[Exception] = _load("parameters:FilterError")
        raise error(f"unknown filter {name!r}, {one_of(name, FILTERS)}")
    return _FILTERS[name]


def prepare(name: str) -> None:
    """Compile the loops of a filter, or load them from the cache, before its first frames need them."""
    if _row(name)[2] == "ekf.":
        _load("ekf.filter:prepare")()


def parameter_prefix(name: str) -> str:
    """The prefix of a filter's parameters; see :func:`parameter_classes`.

    Raises:
        FilterError: an unknown name.
    """
    return _row(name)[2]


def make_filter(name: str, **parameters: Any) -> SkeletonFilter:
    """Make a filter by its name.

    Args:
        name: one of ``FILTERS``.
        parameters: fields of the filter's parameter class, without a prefix.

    Raises:
        FilterError: an unknown name, an unknown parameter, a value out of range.
    """
    filter_class, parameters_class, _ = _row(name)
    settings_class = _load(parameters_class)
    unknown = parameters.keys() - {item.name for item in fields(settings_class)}
    if unknown:
        error: type[Exception] = _load("parameters:FilterError")
        raise error(f"filter {name}: unknown parameter(s) {', '.join(sorted(unknown))}")
    made, settings = _load(filter_class), settings_class(**parameters)
    result: SkeletonFilter = made(name, settings) if filter_class == _LINEAR[0] else made(settings)
    return result
