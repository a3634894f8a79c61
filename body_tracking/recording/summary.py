"""Summary of a bag with joint angles: the poses of the sensors, the known angles and their standard deviations."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Final

import numpy as np

from body_tracking.core.sensor_poses import SensorPose
from body_tracking.kinematics.labels import UNKNOWN, by_limb, label_of
from body_tracking.messages.angles import joint_state_values
from body_tracking.messages.calibration import transform_to_pose
from body_tracking.pipeline import graph
from body_tracking.recording.rosbag2 import BagReader, deserialize

_READ: Final = 1000
"""Number of messages read per person, evenly over the bag; at most twice this number."""


def summary(path: Path) -> Iterator[str]:
    """A line for each sensor with a pose, and for each limb of each person with angles.

    Args:
        path: a bag that the graph has written.

    Raises:
        BagError: the bag cannot be read.
        MessageError: a malformed message.
    """
    with BagReader(path) as bag:
        yield from _poses(bag)
        for body in graph.bodies_among(bag.topics):
            yield from _angles(bag, body)


def _poses(bag: BagReader) -> Iterator[str]:
    if graph.CALIBRATION not in bag.topics:
        return
    kind = bag.topics[graph.CALIBRATION].type_name
    poses: dict[str, SensorPose] = {}
    for raw in bag.messages([graph.CALIBRATION]):
        pose = transform_to_pose(deserialize(kind, raw.cdr))
        poses[pose.sensor] = pose
    for sensor, pose in sorted(poses.items()):
        x, y, z = pose.translation
        ahead = pose.rotation[:, 2]
        if not pose.translation.any() and np.allclose(ahead, [1.0, 0.0, 0.0]):
            yield f"{sensor}: the reference sensor, at the origin of world, whose x is where it looks and z is up"
            continue
        left, down = np.round(np.degrees([np.arctan2(ahead[1], ahead[0]), np.arcsin(np.clip(-ahead[2], -1.0, 1.0))]))
        tilt = f"{abs(down):.0f} deg {'up' if down < 0.0 else 'down'}" if down else "level"
        yield (
            f"{sensor}: at x {x:.2f}, y {y:.2f}, z {z:.2f} m of world, looks {abs(left):.0f} deg to the "
            f"{'right' if left < 0.0 else 'left'} of x and {tilt}"
        )


def _angles(bag: BagReader, body: str) -> Iterator[str]:
    topic = graph.joint_states_stddev_topic(body)
    if topic not in bag.topics or not (count := bag.topics[topic].count):
        return
    kind, step = bag.topics[topic].type_name, max(1, count // _READ)
    found: dict[str, list[float]] = {}
    for number, raw in enumerate(bag.messages([topic])):
        if number % step == 0:
            _, names, stddevs = joint_state_values(deserialize(kind, raw.cdr))
            for name, stddev in zip(names, np.degrees(stddevs), strict=True):
                found.setdefault(name.removesuffix(f"_{body}"), []).append(float(stddev))
    for limb, names_of_limb in by_limb(found).items():
        medians: list[float] = []
        shares: dict[str, float] = {}
        unknown: list[str] = []
        for name in names_of_limb:
            stddevs = np.array(found[name])
            known = stddevs[stddevs < UNKNOWN]  # not NaN or infinity
            if 2 * len(known) < len(stddevs):
                unknown.append(label_of(name))
            else:
                medians.append(float(np.median(known)))
                shares[label_of(name)] = 100.0 * len(known) / len(stddevs)
        text = f"{body}, {limb}: {len(medians)} of {len(names_of_limb)} angles known"
        if medians:
            digits = 1 if min(medians) >= 1.0 else 3  # markers give hundredths of a degree
            size = " to ".join(dict.fromkeys((f"{min(medians):.{digits}f}", f"{max(medians):.{digits}f}")))
            least = min(shares, key=lambda name: shares[name])
            rare = f" ({least} least often)" if round(shares[least]) < round(max(shares.values())) else ""
            share = f"at least {shares[least]:.0f} % of the frames" if shares[least] < 99.5 else "every frame"
            text += f" in {share}{rare}: standard deviation below {UNKNOWN:.0f} deg, median {size} deg"
        yield text + (f"; not known: {', '.join(unknown)}" if unknown else "")
