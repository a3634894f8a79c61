"""The kinematics system: the node of the joint angles, its options and topics."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from body_tracking.core.message_types import JOINT_STATE
from body_tracking.core.parameters import Value
from body_tracking.core.qos import RELIABLE
from body_tracking.pipeline import graph
from body_tracking.pipeline.system import (
    NodeSpec,
    NodeType,
    Option,
    Options,
    Place,
    System,
    TopicSpec,
    asked,
    independent_joints,
    transport,
)


def _conventions() -> Sequence[str]:
    from body_tracking.kinematics.conventions import ALL_CONVENTIONS

    return ALL_CONVENTIONS


_OF_MESHES = 0.77
"""Correlation of the errors of an arm's neighbouring joints in the fit of a mesh (``benchmarks/mesh_fit.py``)."""


def _correlation(options: Options) -> dict[str, Value]:
    """Parameter ``bone_correlation`` of positional angles where no sensor is a Kinect."""
    if options["depth"] and options["sensors"] == options["computed"]:
        return {"bone_correlation": _OF_MESHES}
    return independent_joints(options)


def _specs(options: Options) -> Iterable[NodeSpec]:
    if not (options["sensors"] or options["imus"]):
        return
    from body_tracking.pipeline.roles import role_of

    role = role_of(options)
    # Options that were not given are left to joint_angles, which follows a change of the filter.
    angles: dict[str, Value] = asked(options, input="angles_input", subject="subject", people="people")
    if options["convention"] not in ("", graph.AUTO) or graph.convention_of(role.angles_input) != role.convention:
        angles["convention"] = role.convention
    yield NodeSpec(
        "joint_angles",
        "joint_angles",
        defaults=_correlation(options),
        parameters={**transport(options), **angles},
    )


SYSTEM = System(
    "kinematics",
    heading="filter and joint angles",
    order=3,
    nodes=(
        NodeType(
            "joint_angles",
            Place.ANGLES,
            "body_tracking.kinematics.stage:AnglesStage",
            basic=("convention", "subject", "people"),
        ),
    ),
    specs=_specs,
    options=(
        Option(
            "convention",
            "",
            "convention of the joint angles; overrides the parameters file",
            choices=_conventions,
            parameter=("joint_angles", "convention"),
            offline=True,
        ),
        Option("angles_input", "", parameter=("joint_angles", "input"), hidden=True),
    ),
    topics=(
        TopicSpec(
            graph.joint_states_topic("<id>"),
            JOINT_STATE,
            RELIABLE,
            "joint_angles",
            "joint angles and angular velocities, with the capture time; names end in `_<id>`; `frame_id` names the "
            "convention",
        ),
        TopicSpec(
            graph.joint_states_stddev_topic("<id>"),
            JOINT_STATE,
            RELIABLE,
            "joint_angles",
            "their standard deviations, with the same header, names and order; infinity where there is no estimate",
        ),
    ),
)
