"""Commands for evaluating results against the truth."""

from __future__ import annotations

from body_tracking.pipeline.system import Command, System

SYSTEM = System(
    "evaluation",
    order=8,
    commands=(
        Command("show", "body_tracking.evaluation.show", "show the joint angles in a recording"),
        Command("evaluate", "body_tracking.evaluation.evaluate", "compare a recording's estimates with the truth"),
        Command(
            "compare",
            "body_tracking.evaluation.compare",
            "compare every system that recorded a person with every other one",
        ),
        Command(
            "evaluate baseline",
            "body_tracking.evaluation.baseline",
            "test a camera: a robot arm with red balls, or a pendulum's frequency",
        ),
    ),
)
