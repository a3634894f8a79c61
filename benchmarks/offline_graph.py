"""The graph of ``body_tracking replay``, in memory."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from body_tracking.core.sources import RecordedFrame
from body_tracking.messages.cdr import encode_skeletons
from body_tracking.pipeline import graph
from body_tracking.pipeline.offline import OfflineRunner
from body_tracking.recording.forked import is_second
from body_tracking.recording.replay import ReplaySettings
from body_tracking.recording.rosbag2 import BAG_WIRE


def play(settings: ReplaySettings, frames: Sequence[RecordedFrame], sink: Callable[[str, bytes, int], None]) -> None:
    """Pass frames of the settings' sensors, in the order of receipt, through the stages of the graph.

    ``sink`` is called with topic, message and time (ns) of each input and output.
    """
    hosted = settings.stages()
    upstream = [each.make() for each in hosted if not is_second(each.executable)]
    published = {port.topic for stage in upstream for port in stage.outputs}
    published.update(map(graph.skeleton_topic, settings.sensors))
    second = OfflineRunner([each.make() for each in hosted if is_second(each.executable)], BAG_WIRE, sink, published)

    def pass_on(topic: str, cdr: bytes, at_ns: int) -> None:
        sink(topic, cdr, at_ns)
        second.push(topic, cdr, at_ns)

    first = OfflineRunner(upstream, BAG_WIRE, pass_on)
    first.start(frames[0].received_ns)
    for frame in frames:
        message = graph.skeleton_topic(frame.sensor), encode_skeletons(frame.skeletons), frame.received_ns
        pass_on(*message)
        first.push(*message)
    for runner in (first, second):
        runner.finish(frames[-1].received_ns)
