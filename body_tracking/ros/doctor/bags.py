"""Checks of a bag: it can be read, is complete, and has the topics and rates that the graph needs."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from body_tracking.core import names
from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.message_types import IMU, JOINT_STATE, POINT_CLOUD
from body_tracking.pipeline import graph
from body_tracking.recording.info import bag_info
from body_tracking.ros.doctor import OK, PROBLEM, WARNING, Finding

LEAST_RATE = {POINT_CLOUD: 20.0, JOINT_STATE: 20.0, IMU: 50.0}
"""Hertz: a Kinect has 30, and 15 in the dark; with less than 50 the orientation of an IMU drifts."""
GAP = 0.5
"""Seconds without a frame after which calibration and filter have lost the person."""


def bag(path: Path) -> Iterator[Finding]:
    """Findings on a folder or a single mcap file."""
    recover = f"body_tracking bag recover {path}"
    try:
        info = bag_info(path)
    except BodyTrackingError as error:
        yield Finding(PROBLEM, str(error), recover if path.is_dir() else "give the folder that the recorder made")
        return
    yield Finding(OK, f"{path}: {info.messages} messages in {info.duration_s:.1f} s")
    for warning in info.warnings:
        yield Finding(WARNING, warning, f"{recover}; its whole messages are played as it is, too")
    namespace = names.rig_namespace(topic.name for topic in info.topics)
    clouds = (topic.name for topic in info.topics if topic.type == POINT_CLOUD and topic.count)
    sensors = graph.sensors_among(names.within(name, namespace) or name for name in clouds)
    if not sensors:
        found = f"no skeletons on /<sensor>/skeleton; topics: {', '.join(topic.name for topic in info.topics)}"
        yield Finding(PROBLEM, f"{path}: {found}", "record the sensors' topics; docs/recordings.md has other formats")
    skeletons = {names.resolved(graph.skeleton_topic(sensor), namespace) for sensor in sensors}
    for topic in info.topics:
        if topic.name in skeletons or topic.type == IMU:
            rate, gap = topic.rate or 0.0, topic.longest_gap or 0.0
            text, remedy = f"{topic.name}: {topic.count} messages, {rate:.1f} Hz, longest gap {gap:.2f} s", ""
            if gap > GAP:
                remedy = "keep the person in view: in a gap angles are predicted, then lost"
            elif rate < LEAST_RATE[topic.type]:
                remedy = "more light, USB 3, the driver's settings: at this rate estimates are less certain"
            yield Finding(WARNING if remedy else OK, text, remedy)
