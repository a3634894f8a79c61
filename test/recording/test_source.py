"""A recording in place of a sensor: frames come at their time, in step, and at the right position after a restart."""

from __future__ import annotations

import threading
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.skeleton import JOINT_NAMES, NANOSECONDS
from body_tracking.core.sources import RecordedFrame
from body_tracking.kinect.live import SourceSettings, backends, open_source
from body_tracking.messages.skeletons import cloud_to_skeletons
from body_tracking.recording import source as source_of_file
from body_tracking.recording.rig import RigReader
from body_tracking.recording.rosbag2 import deserialize
from body_tracking.recording.source import RecordingSource

BAG = Path(__file__).resolve().parents[2] / "bags" / "tpose_wave"


def times_in_bag(sensor: str) -> list[tuple[int, int]]:
    """Capture and receipt of each frame, nanoseconds since the beginning of the bag."""
    topic = f"/{sensor}/skeleton"
    with RigReader(BAG) as reader:
        kind, zero_ns = reader.topics[topic].type_name, reader.start_ns
        frames = [
            (cloud_to_skeletons(deserialize(kind, raw.cdr))[0], raw.log_time_ns) for raw in reader.messages([topic])
        ]
        return [(skeleton.stamp_ns - zero_ns, log_ns - zero_ns) for skeleton, log_ns in frames]


def played(frame: RecordedFrame | None) -> tuple[int, int]:
    assert frame is not None
    return frame.skeletons[0].stamp_ns, frame.received_ns


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """No frame is left out, however busy the machine is."""
    monkeypatch.setattr(source_of_file, "LATE_NS", 1000 * NANOSECONDS)


def test_every_frame_comes_in_order_and_then_the_end() -> None:
    start_ns = time.time_ns()
    source = open_source("recording", SourceSettings("kinect2", file=str(BAG), rate=100.0))
    got = []
    while not source.ended:
        frame = source.read(1.0)
        if frame is not None:
            got.append(played(frame))
            assert frame.received_ns <= time.time_ns()
    zero_ns = got[0][1] - round(times_in_bag("kinect2")[0][1] / 100.0)
    assert start_ns <= zero_ns
    expected = [[zero_ns + time_ns / 100.0 for time_ns in times] for times in times_in_bag("kinect2")]
    np.testing.assert_allclose(np.array(got) - zero_ns, np.array(expected) - zero_ns, rtol=0.0, atol=1e3)
    assert source.read(0.0) is None
    assert not source.counters


def test_frames_are_due_when_they_were_received_then() -> None:
    start = time.time() + 1.5
    sources = [
        RecordingSource(SourceSettings(name, file=str(BAG), start_time=start)) for name in ("kinect1", "kinect2")
    ]
    for name, source in zip(("kinect1", "kinect2"), sources, strict=True):
        stamp_ns, received_ns = played(source.read(10.0))
        captured, received = (start + time_ns / NANOSECONDS for time_ns in times_in_bag(name)[0])
        assert stamp_ns / NANOSECONDS == pytest.approx(captured, abs=1e-5)
        assert received_ns / NANOSECONDS == pytest.approx(received, abs=1e-5)
        # Never early; the delay depends on the machine.
        assert time.time() >= received - 1e-3


def test_a_restarted_source_continues_at_the_present_position(monkeypatch: pytest.MonkeyPatch) -> None:
    now_ns = time.time_ns()
    # A clock that stands still: on a busy machine the recording's end would be reached before its present position.
    monkeypatch.setattr(source_of_file, "time", SimpleNamespace(time_ns=lambda: now_ns))
    monkeypatch.setattr(source_of_file, "LATE_NS", NANOSECONDS)
    start = now_ns / NANOSECONDS - 5.0
    source = RecordingSource(SourceSettings("kinect1", file=str(BAG), start_time=start))
    received = played(source.read(2.0))[1] / NANOSECONDS - start
    assert 4.0 - 1e-6 <= received < 4.1
    assert source.counters["left out, late"] > 100


def test_a_loop_begins_again_and_time_goes_on() -> None:
    source = RecordingSource(SourceSettings("kinect1", file=str(BAG), rate=100.0, loop=True))
    stamps = np.array([stamp_ns for stamp_ns, _ in times_in_bag("kinect1")])
    got = np.array([played(source.read(1.0))[0] for _ in range(len(stamps) + 5)])
    first, second = got[: len(stamps)], got[len(stamps) :]
    np.testing.assert_allclose(first - first[0], (stamps - stamps[0]) / 100.0, atol=1e3)
    np.testing.assert_allclose(second - second[0], first[:5] - first[0], atol=1e3)
    assert second[0] > first[-1]
    assert not source.ended


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


def test_frames_of_a_file_with_another_clock_are_stamped_as_captured_now(tmp_path: Path) -> None:
    """As with a bag: the stamp of the quickest frame is the time at which it plays, those of others are earlier."""
    columns = [f"{joint}_{axis}" for joint in JOINT_NAMES for axis in "xyz"]
    late = [0.02, 0.0, 0.05, 0.01, 0.0, 0.03]
    rows = [
        ",".join([f"{40.0 + k / 30:.6f}", f"{1e9 + k / 30 + each:.6f}", *["1.0"] * len(columns)])
        for k, each in enumerate(late)
    ]
    file = tmp_path / "own_clock.csv"
    file.write_text("\n".join([",".join(["stamp", "received", *columns]), *rows, ""]))
    source = RecordingSource(SourceSettings("kinect1", file=str(file)))
    frames = [played(source.read(1.0)) for _ in late]
    np.testing.assert_allclose([(came - stamp) / NANOSECONDS for stamp, came in frames], late, atol=1e-5)
    np.testing.assert_allclose(np.diff([stamp for stamp, _ in frames]), NANOSECONDS / 30, atol=1e4)


def test_closing_ends_a_read_in_another_thread() -> None:
    source = RecordingSource(SourceSettings("kinect1", file=str(BAG), start_time=time.time() + 60.0))
    thread = threading.Thread(target=source.read, args=(60.0,))
    thread.start()
    source.close()
    thread.join(10.0)
    assert not thread.is_alive()


@pytest.mark.parametrize(
    ("settings", "reported"),
    [
        (SourceSettings("kinect1"), "needs the parameter 'file'"),
        (SourceSettings("kinect1", file="nowhere.csv"), "nowhere.csv"),
        (SourceSettings("kinect7", file=str(BAG)), "no topic /kinect7/skeleton"),
        (SourceSettings("fused", file=str(BAG)), "reserved"),
        (SourceSettings("kinect1", file=str(BAG), rate=0.0), "rate 0.0"),
    ],
)
def test_unplayable_recordings_are_an_error(settings: SourceSettings, reported: str) -> None:
    with pytest.raises(BodyTrackingError, match=reported):
        open_source("recording", settings)
    assert "recording" in backends()
    with pytest.raises(BodyTrackingError, match="unknown backend 'xbox'"):
        open_source("xbox", settings)
