"""The node, option, topic and layer that the system adds to the graph."""

from __future__ import annotations

from collections.abc import Iterable

from body_tracking.core.message_types import IMAGE
from body_tracking.core.qos import RELIABLE
from body_tracking.pipeline.system import (
    Layer,
    NodeSpec,
    NodeType,
    Option,
    Options,
    Place,
    System,
    TopicSpec,
    transport,
)

HEIGHT = "/humans/height"


def _specs(options: Options) -> Iterable[NodeSpec]:
    yield NodeSpec("heights", "heights", defaults={"margin": options["height_margin"]}, parameters=transport(options))


SYSTEM = System(
    "heights",
    nodes=(NodeType("heights", Place.CONSUMER, "heights.stage:HeightStage"),),
    specs=_specs,
    options=(Option("height_margin", 0.1, "metres above the head", "METRES", parameter=("heights", "margin")),),
    topics=(
        TopicSpec(
            HEIGHT, IMAGE, RELIABLE, "heights", "one pixel, `32FC1`: metres from the lowest joint to above the head"
        ),
    ),
    layers=(Layer("heights", "height", HEIGHT, "heights.stage:Height", "heights.layer:draw"),),
)
