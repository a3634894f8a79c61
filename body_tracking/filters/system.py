"""The filter system: node, options and topics."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from body_tracking.core.message_types import IMAGE, JOINT_STATE, POINT_CLOUD, SEGMENTS, STRING
from body_tracking.core.parameters import Value
from body_tracking.core.qos import RELIABLE
from body_tracking.filters import THESIS_FILTERS
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
    sensors_and_transport,
)


def _filters() -> Sequence[str]:
    from body_tracking.filters import FILTERS

    return FILTERS


def _specs(options: Options) -> Iterable[NodeSpec]:
    if not (options["sensors"] or options["imus"]):
        return
    imus = options["imus"]
    worn = graph.imu_topics(imus if isinstance(imus, tuple) else ())
    # The mesh of a depth camera has used the arms' inertial sensors already, so that they would count twice. But no
    # mesh shows the axial rotation of an arm, which matters more when there are other sensors (docs/five_systems.md).
    depth, sensors = options["depth"], options["sensors"]
    meshes_alone = isinstance(depth, tuple) and isinstance(sensors, tuple) and len(depth) == len(sensors) > 0
    segments = tuple(each.segment for each in worn if not (meshes_alone and each.segment in graph.ARM_SEGMENTS))
    defaults: dict[str, Value] = {"orientations": segments} if segments else {}
    lists = (options["computed"], options["with_covariances"])
    if others := tuple(dict.fromkeys(each for found in lists if isinstance(found, tuple) for each in found)):
        defaults["not_kinects"] = others
    defaults |= {f"ekf.{name}": value for name, value in independent_joints(options).items()}
    if options["lag"] and options["filter"] in THESIS_FILTERS:
        raise graph.GraphError(f"filter {options['filter']} cannot smooth (lag)")
    chosen = asked(options, filter="filter", input="filter_input", subject="subject", people="people", lag="lag")
    yield NodeSpec(
        "skeleton_filter",
        "skeleton_filter",
        defaults=defaults,
        parameters={**sensors_and_transport(options), **chosen},
    )


SYSTEM = System(
    "filters",
    heading="filter and joint angles",
    order=2,
    nodes=(
        NodeType(
            "skeleton_filter",
            Place.FILTER,
            "body_tracking.filters.stage:FilterStage",
            basic=("filter", "subject", "people"),
        ),
    ),
    specs=_specs,
    options=(
        Option(
            "filter",
            "",
            "the filter (default: lkf_constant_velocity, or ekf where all sensors are colour cameras or inertial "
            "ones); overrides the parameters file",
            choices=_filters,
            parameter=("skeleton_filter", "filter"),
            offline=True,
        ),
        Option(
            "lag",
            0.0,
            "seconds (at most 0.3) by which the filter's output comes later, smoothed by the frames after it: for "
            "recording and looking, not for control",
            metavar="S",
            parameter=("skeleton_filter", "lag"),
            offline=True,
        ),
        Option("filter_input", "", parameter=("skeleton_filter", "input"), hidden=True),
    ),
    topics=(
        TopicSpec(
            graph.FILTERED,
            POINT_CLOUD,
            graph.SKELETON,
            "skeleton_filter",
            "the filtered person, as `/fused/skeleton`, and velocity `vx vy vz`; with `ekf` one message per sensor's "
            "frame, and predicted ones while nothing arrives",
        ),
        TopicSpec(
            graph.MODEL_STATE,
            JOINT_STATE,
            graph.SKELETON,
            "skeleton_filter",
            "`ekf`: coordinates of the body model and their rates; base x y z in `world`, rotation vectors of the base "
            "and of the upper arms, the other angles",
        ),
        TopicSpec(
            graph.MODEL_STATE_STDDEV,
            JOINT_STATE,
            graph.SKELETON,
            "skeleton_filter",
            "`ekf`: the standard deviation of each; of a rotation vector, that of a small further rotation in the "
            "segment's own frame",
        ),
        TopicSpec(
            graph.MODEL_COVARIANCE,
            IMAGE,
            graph.SKELETON,
            "skeleton_filter",
            "`ekf`: the whole covariance of these coordinates (rows 0 to 31) and of their rates (rows 32 to 63), "
            "`32FC1`, with the stamp of the state",
        ),
        TopicSpec(
            graph.model_topics("<id>", several=True).state,
            JOINT_STATE,
            graph.SKELETON,
            "skeleton_filter",
            "`ekf`, with `subject: all`: as `/filtered/model_state`, of each person; likewise "
            "`.../model_state_stddev` and `.../model_covariance`",
        ),
        TopicSpec(
            graph.TRACKED,
            "hri_msgs/msg/IdsList",
            RELIABLE,
            "skeleton_filter",
            "the ids of the people who are tracked (REP-155), where hri_msgs is installed",
        ),
        TopicSpec(
            graph.segments_topic("<id>"),
            SEGMENTS,
            RELIABLE,
            "skeleton_filter",
            "`ekf`: the pose of each segment of the body in `world`; quaternions have no singular pose",
        ),
        TopicSpec(
            graph.urdf_topic("<id>"),
            STRING,
            graph.URDF_QOS,
            "skeleton_filter",
            "`ekf`: the person's model with the segment lengths known so far, for robot_state_publisher; its joints "
            "are the angles of the convention `model`",
        ),
    ),
    prepare="body_tracking.filters.ekf.filter:prepare",
)
