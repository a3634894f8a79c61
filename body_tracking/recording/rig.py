"""Reads the recording of one rig, with topics in the root namespace and stamps in ROS time."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from pathlib import Path

from body_tracking.core import names
from body_tracking.recording.rosbag2 import BagReader, RawMessage
from body_tracking.recording.stamps import RecordedStamps


class RigReader(BagReader):
    """A bag whose topics are renamed to the root namespace, and whose header stamps are converted to ROS time.

    The clocks of sensors are fitted when messages are first read, see :mod:`body_tracking.recording.stamps`. Arguments
    and errors as of :class:`BagReader`. Topics of other namespaces keep their names, unless the rig has the same one.

    Attributes:
        namespace: in which the rig was recorded; also ``/`` for a bag of several rigs.
    """

    def __init__(self, path: Path | str) -> None:
        super().__init__(path)
        self.namespace = names.rig_namespace(self.topics)
        found = [(names.within(name, self.namespace), name) for name in self.topics]
        found.sort(key=lambda each: each[0] is not None)  # the rig's own override others of the same name
        self._recorded = {topic or name: name for topic, name in found}
        self._names = {name: topic for topic, name in self._recorded.items()}
        self.topics = {topic: self.topics[name] for topic, name in sorted(self._recorded.items())}
        self._stamps: RecordedStamps | None = None

    def messages(self, topics: Collection[str] | None = None, start_ns: int | None = None) -> Iterator[RawMessage]:
        """As of :class:`BagReader`, by the names in :attr:`topics` and stamped in ROS time."""
        if self._stamps is None:
            self._stamps = RecordedStamps(self.files, self._names)
        wanted = self._names if topics is None else {self._recorded[each] for each in topics if each in self._recorded}
        for message in super().messages(wanted, start_ns):
            yield self._stamps.in_ros_time(message._replace(topic=self._names[message.topic]))
