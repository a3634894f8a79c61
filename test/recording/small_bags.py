"""Small bags for the tests of recordings."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

from mcap.writer import CompressionType, Writer

from body_tracking.core.qos import LATCHED, RELIABLE, SENSOR_DATA, Qos
from body_tracking.recording import rosbag2
from body_tracking.recording.rosbag2 import BAG_MESSAGES, BagReader, BagWriter, serialize

TOPICS: dict[str, tuple[str, Qos]] = {
    "/text": ("std_msgs/msg/String", RELIABLE),
    "/number": ("std_msgs/msg/Float64", SENSOR_DATA),
    "/pose": ("geometry_msgs/msg/TransformStamped", LATCHED),
}

Stored = tuple[str, bytes, int]


def message(topic: str, text: str, number: float) -> Any:
    if topic == "/text":
        return BAG_MESSAGES.make("std_msgs/msg/String", data=text)
    if topic == "/number":
        return BAG_MESSAGES.make("std_msgs/msg/Float64", data=number)
    return BAG_MESSAGES.make(
        "geometry_msgs/msg/TransformStamped",
        header=BAG_MESSAGES.make(
            "std_msgs/msg/Header",
            stamp=BAG_MESSAGES.make("builtin_interfaces/msg/Time", sec=1, nanosec=2),
            frame_id=text,
        ),
        child_frame_id="child",
        transform=BAG_MESSAGES.make(
            "geometry_msgs/msg/Transform",
            translation=BAG_MESSAGES.make("geometry_msgs/msg/Vector3", x=number, y=0.0, z=0.0),
            rotation=BAG_MESSAGES.make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
        ),
    )


def messages(count: int) -> list[Stored]:
    """Messages of all topics in turn, no two alike, 10 ms apart."""
    names = list(TOPICS)
    return [
        (
            names[index % 3],
            serialize(message(names[index % 3], f"message {index} " + "x" * (index % 40), float(index))),
            1_000_000_000 + 10_000_000 * index,
        )
        for index in range(count)
    ]


COMPRESSION = {"zstd": CompressionType.ZSTD, "lz4": CompressionType.LZ4, "none": CompressionType.NONE}


def write(folder: Path, stored: Sequence[Stored], compression: str = "zstd", **options: Any) -> Path:
    """Write a closed bag; returns the path of its file. Other compressions are those of ``ros2 bag``."""
    with (
        patch.object(rosbag2, "Writer", partial(Writer, compression=COMPRESSION[compression])),
        BagWriter(folder, **options) as writer,
    ):
        for topic, (type_name, qos) in TOPICS.items():
            writer.add_topic(topic, type_name, qos)
        for topic, cdr, log_time_ns in stored:
            writer.write(topic, cdr, log_time_ns)
    return writer.path


def read(path: Path) -> list[Stored]:
    with BagReader(path) as reader:
        return [(found.topic, found.cdr, found.log_time_ns) for found in reader.messages()]
