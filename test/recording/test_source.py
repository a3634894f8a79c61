"""A recording in place of a sensor: frames at their time, in step, again from where it should be."""

from __future__ import annotations

import threading
import time
from pathlib import Path

import pytest

from body_tracking.errors import BodyTrackingError
from body_tracking.messages.skeletons import cloud_to_skeletons
from body_tracking.recording.rosbag2 import BagReader, deserialize
from body_tracking.recording.source import RecordingSource
from body_tracking.sensors.live import SkeletonSource, SourceSettings, backends, open_source
from body_tracking.skeleton import NANOSECONDS

BAG = Path(__file__).resolve().parents[2] / "bags" / "tpose_wave"


def stamps_in_bag(sensor: str) -> list[int]:
    topic = f"/{sensor}/skeleton"
    with BagReader(BAG) as reader:
        kind = reader.topics[topic].type_name
        return [cloud_to_skeletons(deserialize(kind, message.cdr))[0].stamp_ns for message in reader.messages([topic])]


def test_every_frame_comes_in_order_and_then_the_end_or_again() -> None:
    stamps = stamps_in_bag("kinect2")
    source = open_source("recording", SourceSettings("kinect2", file=str(BAG), rate=100.0))
    assert read(source, len(stamps)) == stamps
    assert source.read(1.0) is None and source.ended
    assert not source.counters
    source = RecordingSource(SourceSettings("kinect2", file=str(BAG), rate=100.0, loop=True))
    assert read(source, len(stamps) + 5) == stamps + stamps[:5]
    assert not source.ended


def read(source: SkeletonSource, count: int) -> list[int]:
    """The stamps of so many frames."""
    frames = [source.read(1.0) for _ in range(count)]
    return [frame.skeletons[0].stamp_ns for frame in frames if frame is not None]


def test_frames_are_due_when_they_were_received_then() -> None:
    start = time.time() + 0.2
    sources = [
        RecordingSource(SourceSettings(name, file=str(BAG), start_time=start)) for name in ("kinect1", "kinect2")
    ]
    with BagReader(BAG) as reader:
        zero_ns = reader.start_ns
    for source in sources:
        frame = source.read(2.0)
        assert frame is not None
        # Never early; how late is the machine's affair.
        assert time.time() >= start + (frame.received_ns - zero_ns) / NANOSECONDS - 1e-3


def test_one_that_is_started_again_goes_on_where_it_should_be() -> None:
    source = RecordingSource(SourceSettings("kinect1", file=str(BAG), start_time=time.time() - 5.0))
    frame = source.read(2.0)
    assert frame is not None
    with BagReader(BAG) as reader:
        position = (frame.received_ns - reader.start_ns) / NANOSECONDS
    assert position > 4.0
    assert source.counters["left out, late"] > 100


def test_another_name_may_be_given() -> None:
    source = RecordingSource(SourceSettings("left", file=str(BAG), recorded_sensor="kinect1", rate=100.0))
    frame = source.read(1.0)
    assert frame is not None
    assert frame.sensor == "left"
    assert frame.skeletons[0].frame_id == "left_optical_frame"


def test_real_recordings_play(shared_data: Path) -> None:
    file = sorted((shared_data / "kinect_pairs").glob("*.csv*"))[0]
    for sensor in ("kinect1", "kinect2"):
        source = RecordingSource(SourceSettings(sensor, file=str(file), rate=100.0))
        frames = [source.read(1.0) for _ in range(20)]
        assert all(frame is not None and frame.sensor == sensor for frame in frames)


def test_closing_ends_a_read_in_another_thread() -> None:
    source = RecordingSource(SourceSettings("kinect1", file=str(BAG), start_time=time.time() + 60.0))
    thread = threading.Thread(target=source.read, args=(60.0,))
    thread.start()
    source.close()
    thread.join(10.0)
    assert not thread.is_alive()


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        (SourceSettings("kinect1"), "needs the parameter 'file'"),
        (SourceSettings("kinect1", file="nowhere.csv"), "nowhere.csv"),
        (SourceSettings("kinect7", file=str(BAG)), "no topic /kinect7/skeleton"),
        (SourceSettings("fused", file=str(BAG)), "reserved"),
        (SourceSettings("kinect1", file=str(BAG), rate=0.0), "rate 0.0"),
    ],
)
def test_what_cannot_be_played(settings: SourceSettings, said: str) -> None:
    with pytest.raises(BodyTrackingError, match=said):
        open_source("recording", settings)
    assert "recording" in backends()
    with pytest.raises(BodyTrackingError, match="unknown backend 'xbox'"):
        open_source("xbox", settings)
