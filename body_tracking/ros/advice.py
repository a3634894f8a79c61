"""``body_tracking`` without a command: suggests commands, depending on ROS, sensors, a running graph and recordings."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Final, TypeAlias

from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.extras import pip_install
from body_tracking.ros import dds
from body_tracking.ros.up import flags, has_sensors, no_ros

_SHOWN: Final = 3
"""Recordings that are named at most."""

Step: TypeAlias = tuple[str, tuple[str, ...]]
"""What was found, and commands for it."""


def steps(folder: Path) -> Iterator[Step]:
    """The possible next steps in a folder, the most likely first."""
    page = " --viewer" if find_spec("viser") is not None else ""
    if find_spec("rclpy") is None:
        ways = (pip_install("ros"), ". /opt/ros/jazzy/setup.bash")
        yield "The client library of ROS is not here, so no graph can run. Install it, or source a ROS install:", ways
        yield from _recordings(folder, page, live=False)
        return
    if page:
        yield "Choose a recording or sensors on a page in the browser, which then shows them:", ("body_tracking view",)
    yield from _domain(page)
    for file in sorted(folder.glob("*.yaml")):
        if has_sensors(file):
            yield (
                f"{file.name} names sensors. Start the graph with them:",
                (f"body_tracking up --params-file {file.name}{page}",),
            )
    yield from _recordings(folder, page, live=True)
    if not page:
        yield "The live page in a browser needs viser:", (pip_install("viewer"),)


def _domain(page: str) -> Iterator[Step]:
    """The next step by the nodes that publish in the ROS domain."""
    try:
        from body_tracking.ros.discovery import PATIENCE, look
    except ImportError as error:
        raise no_ros(error) from error
    dds.stay_on_this_machine()
    dds.prepare()
    found = look()
    if found.runs:
        yield (
            "A graph runs. Find out what is wrong with it, and which services it has:",
            (
                *(("ros2 topic echo /humans/bodies/body1/joint_states",) if shutil.which("ros2") else ()),
                "body_tracking doctor",
                "body_tracking call",
            ),
        )
    elif found.sensors:
        yield (
            f"Sensors publish ({' '.join(flags(found.sensors))}). Start the graph with them:",
            (f"body_tracking up{page}",),
        )
    else:
        name = os.environ.get("ROS_DOMAIN_ID") or "0"
        yield (
            f"No sensor publishes in ROS domain {name} (none in {PATIENCE:.0f} s). "
            "Once yours do, start the graph with them:",
            (f"body_tracking up{page}",),
        )


def _recordings(folder: Path, page: str, *, live: bool) -> Iterator[Step]:
    from body_tracking.recording.finding import bags_in, shipped_bags

    own = bags_in(folder)
    bags = own or shipped_bags()
    if not bags:
        return
    where = "in this folder" if own else "that come with the package"
    names = [str(_short(each, folder)) if own else each.name for each in bags[:_SHOWN]]
    more = f" and {len(bags) - _SHOWN} more" if len(bags) > _SHOWN else ""
    first = _short(bags[0], folder)
    play = [f"body_tracking up --bag {first}{page}"] if live else []
    if own and _holds_angles(bags[0]):
        what, commands = "Show the angles of one, or play it", [f"body_tracking show {first}", *play]
    else:
        what = "Play one, or compute its angles offline"
        commands = [*play, f"body_tracking replay {first} -o {first.stem}_angles"]
    yield f"Recordings {where}: {', '.join(names)}{more}. {what}:", tuple(commands)


def _holds_angles(bag: Path) -> bool:
    from body_tracking.pipeline.graph import bodies_among
    from body_tracking.recording.rig import RigReader

    try:
        with RigReader(bag) as reader:
            return bool(bodies_among(reader.topics))
    except BodyTrackingError:
        return False


def _short(bag: Path, folder: Path) -> Path:
    return bag.relative_to(folder) if bag != folder and bag.is_relative_to(folder) else bag


def run() -> int:
    """``body_tracking`` alone."""
    print("body_tracking: joint angles with standard deviations from several sensors\n", flush=True)
    for text, commands in steps(Path.cwd()):
        print(text, *(f"  {each}" for each in commands), "", sep="\n", flush=True)
    print("All commands: body_tracking --help")
    return 0
