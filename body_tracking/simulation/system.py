"""Commands of the simulator."""

from __future__ import annotations

from body_tracking.pipeline.system import Command, System

SYSTEM = System(
    "simulation",
    order=9,
    commands=(
        Command(
            "simulate",
            "body_tracking.simulation.bags",
            "simulate people in front of sensors, as a bag with the ground truth",
        ),
        Command(
            "simulate baseline",
            "body_tracking.simulation.baseline_bags",
            "simulate recordings for `evaluate baseline`",
        ),
        Command(
            "make-bags", "body_tracking.simulation.bags", "make the simulated recordings that are shipped in bags/"
        ),
    ),
)
