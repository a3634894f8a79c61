"""The graph of ``body_tracking replay``, in memory."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

from body_tracking.core.sources import RecordedFrame
from body_tracking.messages.cdr import encode_skeletons
from body_tracking.pipeline import graph
from body_tracking.pipeline.offline import OfflineRunner
from body_tracking.recording.forked import is_second
from body_tracking.recording.replay import ReplaySettings
from body_tracking.recording.rosbag2 import BAG_WIRE


class OfflineGraph:
    """The stages from calibration to joint angles, fed with messages.

    Args:
        settings: with the sensors.
        sink: called with topic, message and time (ns) of each input and output.
        topics: of the inputs.

    Attributes:
        stages: by name.
    """

    def __init__(
        self, settings: ReplaySettings, sink: Callable[[str, bytes, int], None], topics: Iterable[str]
    ) -> None:
        hosted = settings.stages()
        self.stages = {each.node: each.make() for each in hosted}
        self._sink = sink
        upstream = [self.stages[each.node] for each in hosted if not is_second(each.executable)]
        downstream = [self.stages[each.node] for each in hosted if is_second(each.executable)]
        published = {*topics, *(port.topic for stage in upstream for port in stage.outputs)}
        self._upstream = OfflineRunner(upstream, BAG_WIRE, self._pass)
        self._downstream = OfflineRunner(downstream, BAG_WIRE, sink, published)

    def _pass(self, topic: str, cdr: bytes, at_ns: int) -> None:
        self._sink(topic, cdr, at_ns)
        self._downstream.push(topic, cdr, at_ns)

    def start(self, at_ns: int) -> None:
        """Start the calibration and fusion, before the first message."""
        self._upstream.start(at_ns)

    def push(self, topic: str, cdr: bytes, at_ns: int) -> None:
        """Pass on one message of a sensor."""
        self._pass(topic, cdr, at_ns)
        self._upstream.push(topic, cdr, at_ns)

    def finish(self, at_ns: int) -> None:
        """Finish all stages, after the last message."""
        self._upstream.finish(at_ns)
        self._downstream.finish(at_ns)

    def play(self, frames: Sequence[RecordedFrame]) -> None:
        """Pass on all frames of the sensors, in the order of receipt, from start to finish."""
        self.start(frames[0].received_ns)
        for frame in frames:
            self.push(graph.skeleton_topic(frame.sensor), encode_skeletons(frame.skeletons), frame.received_ns)
        self.finish(frames[-1].received_ns)
