"""Start and monitoring of the whole graph."""

from __future__ import annotations

from body_tracking.core.message_types import DIAGNOSTICS
from body_tracking.core.qos import RELIABLE
from body_tracking.pipeline import graph
from body_tracking.pipeline.system import Command, Option, System, TopicSpec

SYSTEM = System(
    "graph",
    order=7,
    options=(
        Option("namespace", "/", "of all nodes, and so of their topics; a second rig needs one", "NAME"),
        Option("params_file", "", "ROS parameters file; see config/", "FILE", path=True),
    ),
    topics=(
        TopicSpec(
            graph.DIAGNOSTICS_TOPIC,
            DIAGNOSTICS,
            RELIABLE,
            "every node",
            "once a second: rates, gaps, drops, malformed messages, delay, calibration quality",
        ),
    ),
    commands=(
        Command("up", "body_tracking.ros.up", "run the live graph: sensors or a bag in, joint angles out"),
        Command(
            "doctor",
            "body_tracking.ros.doctor",
            "why nothing comes: what is wrong with the shell, the graph or a bag, and what to do",
        ),
        Command("compile", "body_tracking.compilation", "compile the loops over images ahead of the first one"),
    ),
)
