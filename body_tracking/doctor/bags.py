"""A bag: does it open, is it whole, does it have what the graph needs."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from body_tracking import graph, names
from body_tracking.doctor.finding import OK, PROBLEM, WARNING, Finding
from body_tracking.errors import BodyTrackingError
from body_tracking.messages.base import IMU, POINT_CLOUD
from body_tracking.recording.info import TopicSummary, bag_info

SLOW_RATE = 20.0
"""Hertz; a Kinect has 30, and 15 in the dark."""
GAP = 0.5
"""Seconds without a frame after which calibration and filter have lost the thread."""


def bag(path: Path, deadline: float | None = None) -> Iterator[Finding]:
    """All of a bag.

    Args:
        path: a folder, or a single mcap file.
        deadline: steady time at which to stop reading, seconds; None for never.
    """
    try:
        info = bag_info(path, deadline)
    except BodyTrackingError as error:
        remedy = f"body_tracking bag recover {path}" if path.is_dir() else "give the folder that the recorder made"
        yield Finding("bag", PROBLEM, str(error), remedy)
        return
    looked = "" if info.complete else ", of which this is only what could be read in time"
    yield Finding("bag", OK, f"{path}: {info.messages} messages in {info.duration_s:.1f} s{looked}")
    for warning in info.warnings:
        yield Finding(
            "bag", WARNING, warning, f"body_tracking bag recover {path}; what is damaged is left out when it is played"
        )
    namespace = names.rig_namespace(topic.name for topic in info.topics)
    clouds = (topic.name for topic in info.topics if topic.type == POINT_CLOUD and topic.count)
    own = (names.within(name, namespace) for name in clouds)
    sensors = graph.sensors_among(name for name in own if name is not None)
    if not sensors:
        there = ", ".join(topic.name for topic in info.topics)
        yield Finding(
            "bag",
            PROBLEM,
            f"{path}: no skeletons on /<sensor>/skeleton; it has {there or 'no topics'}",
            "record the sensors' topics: ros2 bag record -a, or body_tracking up --record; "
            "see docs/your_own_sensor.md for another format",
        )
    elif len(sensors) == 1:
        yield Finding("bag", OK, f"{path}: one sensor, {sensors[0]}: nothing to calibrate")
    skeletons = {names.resolved(graph.skeleton_topic(sensor), namespace) for sensor in sensors}
    for topic in info.topics:
        if topic.name in skeletons or (topic.type == IMU and topic.count):
            yield _stream(topic)


def _stream(topic: TopicSummary) -> Finding:
    rate, gap = topic.rate or 0.0, topic.longest_gap or 0.0
    text = f"{topic.name}: {topic.count} messages, {rate:.1f} Hz, longest gap {gap:.2f} s"
    if gap > GAP:
        return Finding(
            "bag", WARNING, text, "nobody in view, or the sensor stalled; there the angles are predicted, then lost"
        )
    if rate < SLOW_RATE:
        return Finding("bag", WARNING, text, "a slow sensor: more light, USB 3; estimates are less certain by it")
    return Finding("bag", OK, text)
