"""A joint fitted to the poses of two targets, for tests and benchmarks."""

from __future__ import annotations

from collections.abc import Sequence

from body_tracking.markers.joint_model import JointKind
from body_tracking.markers.joints import JointFit, fit_joint
from body_tracking.markers.observations import TargetPose
from body_tracking.markers.pose_table import pose_table


def fit_pair(
    kind: JointKind, parent: Sequence[TargetPose], child: Sequence[TargetPose], name: str = "joint"
) -> JointFit:
    """The joint between two targets, by as many poses of each, with equal stamps and frames."""
    targets = parent[0].name, child[0].name
    return fit_joint(name, kind, pose_table(list(zip(parent, child, strict=True)), targets), *targets)
