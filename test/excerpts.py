"""Recordings as a whole, and parts of them for laws that do not need all of one."""

from __future__ import annotations

from pathlib import Path

from body_tracking.core.skeleton import NANOSECONDS
from body_tracking.recording.rosbag2 import BagReader, BagWriter, RawMessage


def contents(bag: Path) -> list[RawMessage]:
    """All messages of a bag."""
    with BagReader(bag) as reader:
        return list(reader.messages())


def beginning(bag: Path, excerpt: Path, seconds: float) -> Path:
    """The first seconds of a bag, as another one."""
    with BagReader(bag) as reader, BagWriter(excerpt) as writer:
        for topic, info in reader.topics.items():
            writer.add_topic(topic, info.type_name, info.offered)
        for raw in reader.messages():
            if raw.log_time_ns > reader.start_ns + seconds * NANOSECONDS:
                break
            writer.write(raw.topic, raw.cdr, raw.log_time_ns, raw.publish_time_ns)
    return excerpt
