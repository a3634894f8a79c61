"""Start and monitoring of the whole graph."""

from __future__ import annotations

from body_tracking.core.message_types import DIAGNOSTICS
from body_tracking.core.qos import RELIABLE
from body_tracking.pipeline import graph
from body_tracking.pipeline.system import Command, Option, Service, System, TopicSpec

SYSTEM = System(
    "graph",
    heading="the graph as a whole",
    order=7,
    options=(
        Option(
            "namespace", "/", "namespace of all nodes and topics, for a second graph in the same ROS domain", "NAME"
        ),
        Option("params_file", "", "ROS parameters file; see config/", "FILE", path=True, offline=True),
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
    services=(Service(graph.END, "up", "end the whole graph, as Ctrl-C does"),),
    commands=(
        Command(
            "view", "body_tracking.ros.view", "open a page in the browser to choose a recording or sensors, and watch"
        ),
        Command("up", "body_tracking.ros.up", "run the live graph: sensors or a bag in, joint angles out"),
        Command(
            "doctor",
            "body_tracking.ros.doctor",
            "find out why nothing arrives: check the shell, the graph or a bag",
        ),
        Command("call", "body_tracking.ros.call", "call a service of the running graph, or list its services"),
        Command("compile", "body_tracking.compilation", "compile image processing and the filter ekf in advance"),
    ),
)
