"""The viewers of the graph: a page in a browser, and markers for RViz and Foxglove."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from body_tracking.core.message_types import MARKERS
from body_tracking.core.parameters import Value
from body_tracking.core.qos import RELIABLE
from body_tracking.pipeline import graph
from body_tracking.pipeline.system import NodeSpec, NodeType, Option, Options, Place, System, TopicSpec


def _skeletons(parameters: Mapping[str, Value], topics: Iterable[str]) -> Iterable[str]:
    sensors = parameters.get("sensors", ())
    own = map(graph.skeleton_topic, sensors if isinstance(sensors, tuple) else ())
    return (*own, graph.FUSED, graph.FILTERED)


def _specs(options: Options) -> Iterable[NodeSpec]:
    for name, option in (("body_markers", "markers"), ("viewer", "viewer")):
        if options[option]:
            yield NodeSpec(name, name, parameters={"sensors": options["sensors"]})


SYSTEM = System(
    "viewing",
    heading="pages and pictures",
    order=6,
    nodes=(
        NodeType("body_markers", Place.CONSUMER, takes=_skeletons),
        NodeType("viewer", Place.CONSUMER, takes=_skeletons, basic=("host", "port", "window")),
    ),
    specs=_specs,
    options=(
        Option("viewer", False, "show the graph on a live page in a browser", example=True),
        Option("markers", False, "publish markers for RViz and Foxglove", example=True),
    ),
    topics=(
        TopicSpec(
            graph.markers_topic("<id>"),
            MARKERS,
            RELIABLE,
            "body_markers",
            "in `world`: the sensors and their skeletons, the fused and the filtered skeleton, 95 % ellipsoids of its "
            "joints",
        ),
        TopicSpec(
            graph.TF,
            "tf2_msgs/msg/TFMessage",
            RELIABLE,
            "body_markers",
            "`ekf`: the pose of each segment in `world`, named as the links of the URDF, where tf2_msgs is installed",
        ),
    ),
)
