"""The stages by the names of their nodes, in the order in which messages go through them."""

from __future__ import annotations

import importlib
from typing import Final

from body_tracking.pipeline.stage import Stage

_STAGES: Final = {
    "calibration": ("calibration.stage", "CalibrationStage"),
    "fusion": ("fusion.stage", "FusionStage"),
    "imu_skeleton": ("inertial.stage", "ImuStage"),
    "skeleton_filter": ("filters.stage", "FilterStage"),
    "joint_angles": ("kinematics.stage", "AnglesStage"),
}
"""Module below ``body_tracking`` and class; a process imports those that it runs."""

STAGES: Final = tuple(_STAGES)


def stage_class(name: str) -> type[Stage]:
    """The class of the stage of a node.

    Raises:
        KeyError: the node has none.
    """
    module, class_name = _STAGES[name]
    found: type[Stage] = getattr(importlib.import_module(f"body_tracking.{module}"), class_name)
    return found
