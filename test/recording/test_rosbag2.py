"""Written bags are read by this reader and by others, and damaged files do not break the reader."""

from __future__ import annotations

import random
import signal
import struct
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import Writer as McapWriter
from rosbags.interfaces import Qos as RosbagsQos
from rosbags.interfaces import QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from small_bags import TOPICS, Stored, message, messages, read, write

from body_tracking.core import qos as quality
from body_tracking.core.qos import INFINITE_NS, Qos
from body_tracking.recording.rosbag2 import (
    BAG_MESSAGES,
    BagError,
    BagReader,
    BagWriter,
    UnsupportedBagError,
    deserialize,
    recover,
    serialize,
)
from draws import draws
from patience import PATIENCE

HERE = Path(__file__).parent
TYPES = get_typestore(Stores.ROS2_JAZZY)

texts = st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=30)
contents = st.lists(
    st.tuples(st.sampled_from(list(TOPICS)), texts, st.floats(), st.integers(0, 2**63 - 1)), max_size=40
)


def rosbags_read(path: Path) -> list[Stored]:
    with Reader(path) as reader:
        return [(connection.topic, bytes(data), at) for connection, at, data in reader.messages(reader.connections)]


# --- round trips


@settings(max_examples=draws(12, 40))
@given(contents, st.sampled_from(["zstd", "lz4", "none"]), st.sampled_from([100, 10_000]))
def test_messages_are_read_in_the_order_of_log_times(drawn, compression, chunk_bytes):
    stored = [(topic, serialize(message(topic, text, number)), at) for topic, text, number, at in drawn]
    expected = sorted(stored, key=lambda item: item[2])
    with tempfile.TemporaryDirectory() as folder:
        write(Path(folder) / "bag", stored, compression=compression, chunk_bytes=chunk_bytes)
        with BagReader(Path(folder) / "bag") as reader:
            assert [(found.topic, found.cdr, found.log_time_ns) for found in reader.messages()] == expected
            assert reader.warnings == []
            assert reader.message_count == len(stored)
            assert {name: (topic.type_name, topic.qos) for name, topic in reader.topics.items()} == TOPICS
            for name, topic in reader.topics.items():
                assert topic.count == sum(item[0] == name for item in stored)
            if stored:
                assert (reader.start_ns, reader.end_ns) == (expected[0][2], expected[-1][2])
        # Only the order among equal times is arbitrary.
        assert sorted(rosbags_read(Path(folder) / "bag")) == sorted(stored)


def test_selection_of_topics_and_start(tmp_path):
    stored = messages(60)
    path = write(tmp_path / "bag", stored, chunk_bytes=300)
    with BagReader(path) as reader:
        start_ns = stored[30][2]
        found = [(item.topic, item.cdr, item.log_time_ns) for item in reader.messages({"/text"}, start_ns)]
    assert found == [item for item in stored if item[0] == "/text" and item[2] >= start_ns]


# --- with others


@pytest.mark.parametrize("version", [8, 9])
def test_bags_are_exchangeable_with_rosbags(tmp_path, version):
    stored = messages(100)
    write(tmp_path / "ours", stored, chunk_bytes=1000)
    endless = QosTime(9223372036, 854775807)
    profile = RosbagsQos(
        *(QosHistory.KEEP_LAST, 7, QosReliability.BEST_EFFORT, QosDurability.TRANSIENT_LOCAL, endless, endless),
        *(QosLiveliness.AUTOMATIC, endless, False),
    )
    writer = Writer(tmp_path / "theirs", version=version, storage_plugin=StoragePlugin.MCAP)
    with writer:
        connections = {
            name: writer.add_connection(name, kind, typestore=TYPES, offered_qos_profiles=[profile])
            for name, (kind, _) in TOPICS.items()
        }
        for topic, cdr, at in stored:
            writer.write(connections[topic], at, cdr)
    for path in (tmp_path / "theirs", tmp_path / "theirs" / "theirs.mcap"):
        with BagReader(path) as reader:
            assert [(found.topic, found.cdr, found.log_time_ns) for found in reader.messages()] == stored
            assert reader.topics["/pose"].offered == (Qos("best_effort", "transient_local", 7),)
            assert reader.warnings == []
    with Reader(tmp_path / "ours") as ours, Reader(tmp_path / "theirs") as theirs:
        assert (ours.message_count, ours.start_time, ours.duration) == (100, theirs.start_time, theirs.duration)
        for one, other in zip(ours.connections, sorted(theirs.connections, key=lambda each: each.topic), strict=True):
            assert one[1:4] == other[1:4], "topic, type, definition"
            assert one.digest == other.digest


@pytest.mark.parametrize("chunked", [True, False])
@pytest.mark.parametrize("size", [None, -2000])
def test_files_of_other_recorders_are_read_and_recovered(tmp_path, chunked, size):
    """``ros2 bag record --storage-preset-profile fastwrite`` writes no chunks."""
    stored = messages(100)
    path = tmp_path / "bag" / "bag_0.mcap"
    path.parent.mkdir()
    with path.open("wb") as file:
        writer = McapWriter(file, chunk_size=900, use_chunking=chunked)
        writer.start("ros2")
        channels = {
            name: writer.register_channel(name, "cdr", writer.register_schema(kind, "ros2msg", b""))
            for name, (kind, _) in TOPICS.items()
        }
        for topic, cdr, at in stored:
            writer.add_message(channels[topic], at, cdr, at - 5)
        writer.finish()
    path.write_bytes(path.read_bytes()[:size])
    found = read(path.parent)
    assert found == (stored if size is None else stored[: len(found)]) and found
    recover(path.parent).close()
    assert read(path.parent) == rosbags_read(path.parent) == found
    with BagReader(path) as reader:
        assert {message.log_time_ns - message.publish_time_ns for message in reader.messages()} == {5}


def test_metadata_has_the_form_that_jazzy_writes(tmp_path):
    stored = messages(30)
    write(tmp_path / "bag", stored)
    information = yaml.safe_load((tmp_path / "bag" / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    span = {
        "starting_time": {"nanoseconds_since_epoch": stored[0][2]},
        "duration": {"nanoseconds": stored[-1][2] - stored[0][2]},
        "message_count": 30,
    }
    topics = information.pop("topics_with_message_count")
    assert information == span | {
        "version": 9,
        "storage_identifier": "mcap",
        "compression_format": "",
        "compression_mode": "",
        "relative_file_paths": ["bag_0.mcap"],
        "files": [{"path": "bag_0.mcap"} | span],
        "custom_data": None,
        "ros_distro": "jazzy",
    }
    endless = {"sec": 9223372036, "nsec": 854775807}
    offered = {
        "history": "keep_last",
        "depth": 5,
        "reliability": "best_effort",
        "durability": "volatile",
        "deadline": endless,
        "lifespan": endless,
        "liveliness": "automatic",
        "liveliness_lease_duration": endless,
        "avoid_ros_namespace_conventions": False,
    }
    topic = {
        "name": "/number",
        "type": "std_msgs/msg/Float64",
        "serialization_format": "cdr",
        "offered_qos_profiles": [offered],
        "type_description_hash": TYPES.hash_rihs01("std_msgs/msg/Float64"),
    }
    assert {"topic_metadata": topic, "message_count": 10} in topics


def test_qos_of_older_bags_is_read():
    humble = """- history: 1
  depth: 5
  reliability: 2
  durability: 1
  deadline: {sec: 2147483647, nsec: 4294967295}
  lifespan: {sec: 0, nsec: 0}
  liveliness: 1
  liveliness_lease_duration: {sec: 1, nsec: 5}
  avoid_ros_namespace_conventions: false"""
    assert quality.load(humble) == (
        Qos("best_effort", "transient_local", 5, "keep_last", INFINITE_NS, INFINITE_NS, "automatic", 1_000_000_005),
    )


durations = st.one_of(st.just(INFINITE_NS), st.integers(1, 10**15))
profiles = st.builds(
    Qos,
    st.sampled_from(["reliable", "best_effort"]),
    st.sampled_from(["volatile", "transient_local"]),
    st.integers(0, 1000),
    st.sampled_from(["keep_last", "keep_all", "unknown"]),
    durations,
    durations,
    st.sampled_from(["automatic", "manual_by_topic"]),
    durations,
    st.booleans(),
)


@given(st.lists(profiles, max_size=3))
def test_qos_survives_its_text_form(offers):
    assert quality.load(quality.dump(offers)) == tuple(offers)


@given(st.one_of(st.text(max_size=40), st.lists(st.dictionaries(st.text(max_size=9), st.integers() | st.text()))))
def test_qos_that_makes_no_sense_is_no_error(value):
    assert all(isinstance(profile, Qos) for profile in quality.load(value))


@given(st.lists(profiles, min_size=1, max_size=4))
def test_a_request_matches_every_offer_and_the_offer_every_request(offers):
    request, offer = quality.request_for(offers, 10), quality.offer_for(offers)
    if request.reliability == "reliable":
        assert all(profile.reliability == "reliable" for profile in offers) and offer.reliability == "reliable"
    if request.durability == "transient_local":
        assert all(profile.durability == "transient_local" for profile in offers)
        assert offer.durability == "transient_local"


# --- several files


def test_a_bag_is_continued_in_its_next_file(tmp_path):
    stored = messages(90)
    for part in range(3):
        write(tmp_path / "bag", stored[part::3], resume=True)  # files of one time
    names = [path.name for path in sorted((tmp_path / "bag").iterdir())]
    assert names == ["bag_0.mcap", "bag_1.mcap", "bag_2.mcap", "metadata.yaml"]
    assert read(tmp_path / "bag") == stored
    assert sorted(rosbags_read(tmp_path / "bag")) == sorted(stored)
    information = yaml.safe_load((tmp_path / "bag" / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert information["message_count"] == 90
    assert [file["message_count"] for file in information["files"]] == [30, 30, 30]


def test_resuming_closes_truncated_files(tmp_path):
    stored = messages(90)
    first = write(tmp_path / "bag", stored[:60], chunk_bytes=500)
    first.write_bytes(first.read_bytes()[:-700])
    (tmp_path / "bag" / "metadata.yaml").unlink()
    before = read(tmp_path / "bag")
    assert 0 < len(before) <= 60
    write(tmp_path / "bag", stored[60:], resume=True)
    assert rosbags_read(tmp_path / "bag") == before + stored[60:]
    with BagReader(tmp_path / "bag") as reader:
        assert reader.warnings == []


def test_unlisted_and_missing_files_are_reported(tmp_path):
    stored = messages(60)
    write(tmp_path / "bag", stored[:30])
    metadata = tmp_path / "bag" / "metadata.yaml"
    first = metadata.read_bytes()
    write(tmp_path / "bag", stored[30:], resume=True)
    both = metadata.read_bytes()
    metadata.write_bytes(first)
    with BagReader(tmp_path / "bag") as reader:
        assert [found.cdr for found in reader.messages()] == [item[1] for item in stored]
        assert any("bag_1.mcap" in warning for warning in reader.warnings)
    metadata.write_bytes(both)
    (tmp_path / "bag" / "bag_0.mcap").unlink()
    with BagReader(tmp_path / "bag") as reader:
        assert [found.cdr for found in reader.messages()] == [item[1] for item in stored[30:]]
        assert any("bag_0.mcap" in warning and "missing" in warning for warning in reader.warnings)


@pytest.mark.parametrize("text", [None, "", "{", "rosbag2_bagfile_information: 3", "\xff"])
def test_a_folder_without_readable_metadata_is_read(tmp_path, text):
    stored = messages(10)
    write(tmp_path / "bag", stored)
    metadata = tmp_path / "bag" / "metadata.yaml"
    metadata.unlink() if text is None else metadata.write_bytes(text.encode("latin-1"))
    with BagReader(tmp_path / "bag") as reader:
        assert [found.cdr for found in reader.messages()] == [item[1] for item in stored]
        assert len(reader.warnings) == 1 and "metadata.yaml" in reader.warnings[0]


# --- damage


def offsets(size: int) -> list[int]:
    """Dense offsets near both ends, where records are short, and many in between."""
    near_start, between, near_end = draws(5, 2), draws(61, 23), draws(7, 3)
    return sorted(
        {*range(1, 120, near_start), *range(120, size, between), *range(max(0, size - 300), size, near_end), size - 1}
    )


@pytest.mark.parametrize("compression", ["zstd", "lz4", "none"])
def test_a_file_cut_anywhere_opens_with_a_prefix_of_its_messages(tmp_path, compression):
    stored = messages(40)
    data = write(tmp_path / "bag", stored, chunk_bytes=900, compression=compression).read_bytes()
    path = tmp_path / "cut.mcap"
    longest = 0
    for size in offsets(len(data)):
        path.write_bytes(data[:size])
        with BagReader(path) as reader:
            found = [(item.topic, item.cdr, item.log_time_ns) for item in reader.messages()]
            assert found == stored[: len(found)], f"cut at {size}"
            assert len(found) >= longest, f"cut at {size}: fewer messages than in a shorter file"
            assert reader.message_count == len(found)
            assert reader.warnings and "cut off" in reader.warnings[0], f"cut at {size}"
        longest = len(found)
    assert longest == len(stored)


def test_a_cut_file_is_closed_without_losing_a_message(tmp_path):
    stored = messages(40)
    data = write(tmp_path / "bag", stored, chunk_bytes=900, compression="none").read_bytes()
    folder = tmp_path / "cut"
    folder.mkdir()
    for size in offsets(len(data))[:: draws(30, 12)]:
        (folder / "cut_0.mcap").write_bytes(data[:size])
        before = read(folder)
        with recover(folder) as reader:
            assert reader.warnings == [], f"cut at {size}"
        assert read(folder) == rosbags_read(folder) == before, f"cut at {size}"
        (folder / "metadata.yaml").unlink()


def test_the_missing_part_of_a_truncated_chunk_is_reported(tmp_path):
    stored = messages(40)
    path = write(tmp_path / "bag", stored, chunk_bytes=10_000, compression="none")
    data = path.read_bytes()
    cut = data.index(stored[20][1])
    path.write_bytes(data[: cut + 3])
    with BagReader(path) as reader:
        assert reader.message_count == 20
        # The chunk's own header has its end 200 ms later.
        assert "0.200 s of recording" in reader.warnings[0] and "20 message(s)" in reader.warnings[0]


@pytest.mark.parametrize("closed", [True, False])
@pytest.mark.parametrize("compression", ["zstd", "none"])
def test_flipped_bits_never_bring_up_a_message_that_was_not_written(tmp_path, compression, closed):
    stored = messages(40)
    data = write(tmp_path / "bag", stored, chunk_bytes=900, compression=compression).read_bytes()
    if not closed:
        # Up to the last chunk, as after kill -9.
        data = data[: int.from_bytes(data[-28:-20], "little") - 13]
    path = tmp_path / "flipped.mcap"
    generator = random.Random(20)
    whole = 0
    count = draws(180, 250)
    for _ in range(count):
        broken = bytearray(data)
        for _ in range(generator.choice([1, 1, 2, 5])):
            broken[generator.randrange(len(broken))] ^= 1 << generator.randrange(8)
        path.write_bytes(broken)
        try:
            with BagReader(path) as reader:
                found = [(item.topic, item.cdr, item.log_time_ns) for item in reader.messages()]
                lost = [item for item in stored if item not in found]
                assert found == [item for item in stored if item in found]
                assert not lost or reader.warnings
        except BagError as error:
            assert any(text in str(error) for text in ("not an mcap file", "nothing in it can be read"))
        else:
            whole += not lost
    assert 0 < whole < count


def test_a_damaged_chunk_is_named_and_the_rest_is_read(tmp_path):
    stored = messages(40)
    path = write(tmp_path / "bag", stored, chunk_bytes=900, compression="none")
    data = bytearray(path.read_bytes())
    data[data.index(stored[12][1]) + 6] ^= 4
    path.write_bytes(data)
    with BagReader(tmp_path / "bag") as reader:
        found = [item.cdr for item in reader.messages()]
        assert [item.cdr for item in reader.messages()] == found
        (warning,) = reader.warnings  # said once, however often it is read
        assert reader.message_count == len(stored), "the index still tells how many there were"
    lost = [item[1] for item in stored if item[1] not in found]
    assert stored[12][1] in lost and 0 < len(lost) < 20
    assert "damaged chunk at byte" in warning and f"with {len(lost)} message(s), 1." in warning


@settings(max_examples=draws(12, 60), deadline=None)
@given(st.builds(struct.Struct("<BQ").pack, st.integers(0, 255), st.integers(0, 2**64 - 1)) | st.just(b""), st.binary())
def test_any_bytes_after_the_magic_are_no_crash(head, data):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "random.mcap"
        path.write_bytes(b"\x89MCAP0\r\n" + head + data)
        try:
            with BagReader(path) as reader:
                list(reader.messages())
                assert reader.warnings
        except BagError as error:
            assert "nothing in it can be read" in str(error)


def test_files_that_are_no_recordings_are_refused_in_one_line(tmp_path):
    (tmp_path / "empty.mcap").touch()
    (tmp_path / "text.mcap").write_text("no recording at all")
    (tmp_path / "folder").mkdir()
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "metadata.yaml").write_text(
        "rosbag2_bagfile_information: {storage_identifier: sqlite3, relative_file_paths: [a.db3]}"
    )
    for name, text in (
        ("empty.mcap", "empty"),
        ("text.mcap", "not an mcap file"),
        ("absent", "no such"),
        ("folder", "no mcap file"),
        ("other", "sqlite3"),
    ):
        with pytest.raises(BagError, match=text) as caught:
            BagReader(tmp_path / name)
        assert "\n" not in str(caught.value) and name in str(caught.value)


def test_a_folder_of_recordings_names_them(tmp_path):
    for name in ("b", "a"):
        write(tmp_path / name, messages(1))
    (tmp_path / "empty").mkdir()
    with pytest.raises(BagError, match=r"no mcap file is in the folder; give one of the recordings in it: a, b$"):
        BagReader(tmp_path)


# --- writing


def test_a_folder_that_is_there_is_refused(tmp_path):
    stored = messages(10)
    write(tmp_path / "bag", stored)
    with pytest.raises(BagError, match="exists already"):
        BagWriter(tmp_path / "bag")
    write(tmp_path / "bag", stored[:3], overwrite=True)
    assert read(tmp_path / "bag") == stored[:3]


@pytest.mark.parametrize("option", ["overwrite", "resume"])
def test_a_folder_that_is_no_bag_is_never_touched(tmp_path, option):
    (tmp_path / "chapter.txt").write_text("precious")
    with pytest.raises(BagError, match="no bag"):
        BagWriter(tmp_path, **{option: True})
    assert (tmp_path / "chapter.txt").read_text() == "precious"


@pytest.mark.parametrize(
    "changed",
    [{"compression_mode": "MESSAGE"}, {"storage_identifier": "sqlite3", "relative_file_paths": ["bag_0.db3"]}],
)
def test_what_only_the_metadata_says_of_a_bag_is_not_overwritten(tmp_path, changed):
    """Without this metadata ``ros2 bag`` would read compressed messages as uncompressed ones."""
    with Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        writer.add_connection("/text", "std_msgs/msg/String", typestore=TYPES)
    metadata = tmp_path / "bag" / "metadata.yaml"
    information = yaml.safe_load(metadata.read_text())["rosbag2_bagfile_information"]
    metadata.write_text(before := yaml.safe_dump({"rosbag2_bagfile_information": information | changed}))
    for touch in (recover, lambda folder: BagWriter(folder, resume=True)):
        with pytest.raises(UnsupportedBagError, match=r"bag: .* is not supported"):
            touch(tmp_path / "bag")
        assert metadata.read_text() == before


def test_an_interrupted_writer_leaves_no_bag(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt), BagWriter(tmp_path / "bag") as writer:
        writer.add_topic("/text", "std_msgs/msg/String")
        raise KeyboardInterrupt
    assert not list(tmp_path.iterdir())


def test_two_writers_do_not_share_a_bag(tmp_path):
    with BagWriter(tmp_path / "bag"):
        with pytest.raises(BagError, match="another process"):
            BagWriter(tmp_path / "bag", resume=True)
        with pytest.raises(BagError, match="another process"):
            recover(tmp_path / "bag")


def test_failed_writes_are_an_error(tmp_path):
    cdr = serialize(message("/text", "a", 0.0))
    with BagWriter(tmp_path / "bag") as writer:
        with pytest.raises(BagError, match="my_msgs/msg/Own"):
            writer.add_topic("/own", "my_msgs/msg/Own")
        with pytest.raises(BagError, match="not added"):
            writer.write("/text", cdr, 0)
        writer.add_topic("/text", "std_msgs/msg/String")
        writer.add_topic("/text", "std_msgs/msg/String")
        with pytest.raises(BagError, match="recorded as"):
            writer.add_topic("/text", "std_msgs/msg/Float64")
        with pytest.raises(BagError, match="-1 ns"):
            writer.write("/text", cdr, -1)
        writer.write("/text", cdr, 5)
    with pytest.raises(BagError, match="closed"):
        writer.write("/text", cdr, 6)
    assert read(tmp_path / "bag") == [("/text", cdr, 5)]
    with pytest.raises(BagError, match="serialised"):
        serialize(BAG_MESSAGES.make("std_msgs/msg/UInt8", data=-1))
    with pytest.raises(BagError, match="no std_msgs/msg/Float64"):
        deserialize("std_msgs/msg/Float64", cdr[:6])


def test_an_unfinished_bag_has_the_flushed_messages(tmp_path):
    stored = messages(10)
    for interval_s, held in ((3600.0, 0), (0.0, 10)):
        path = tmp_path / f"bag{held}"
        with BagWriter(path, flush_interval_s=interval_s) as writer:
            for topic, (kind, qos) in TOPICS.items():
                writer.add_topic(topic, kind, qos)
            for item in stored:
                writer.write(*item)
            assert read(path) == stored[:held]
            writer.flush()
            assert read(path) == stored[:10]


WRITE_FOREVER = """
import sys, time
from small_bags import TOPICS, messages
from body_tracking.recording.rosbag2 import BagWriter
writer = BagWriter(sys.argv[1], flush_interval_s=0.05)
for topic, (kind, qos) in TOPICS.items():
    writer.add_topic(topic, kind, qos)
for item in messages(20_000):
    writer.write(*item)
    time.sleep(0.0005)
"""


def test_kill_9_leaves_a_bag_that_opens(tmp_path):
    process = subprocess.Popen([sys.executable, "-c", WRITE_FOREVER, str(tmp_path / "bag")], cwd=HERE)
    try:
        until = time.monotonic() + PATIENCE
        while time.monotonic() < until:
            time.sleep(0.1)
            file = tmp_path / "bag" / "bag_0.mcap"
            if file.exists() and file.stat().st_size and len(read(tmp_path / "bag")) > 100:
                break
        process.send_signal(signal.SIGKILL)
    finally:
        process.kill()
        process.wait(PATIENCE)
    found = read(tmp_path / "bag")
    assert len(found) > 100 and found == messages(len(found))
    with recover(tmp_path / "bag") as reader:
        assert reader.message_count == len(found) and reader.warnings == []
    assert rosbags_read(tmp_path / "bag") == found


FILL_THE_DISK = """
import resource, sys
resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))
from small_bags import TOPICS, messages
from body_tracking.recording.rosbag2 import BagError, BagWriter
writer = BagWriter(sys.argv[1], flush_interval_s=0.0)
for topic, (kind, qos) in TOPICS.items():
    writer.add_topic(topic, kind, qos)
try:
    for count, item in enumerate(messages(2000)):
        writer.write(*item)
except BagError as error:
    print(count, error)
    writer.close()
"""


def test_a_full_disk_is_an_error_and_costs_nothing_written_before(tmp_path):
    run = subprocess.run(
        [sys.executable, "-c", FILL_THE_DISK, str(tmp_path / "bag")],
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        cwd=HERE,
    )
    assert run.returncode == 0, run.stderr
    count, text = run.stdout.split(maxsplit=1)
    assert "bag_0.mcap" in text
    found = read(tmp_path / "bag")
    assert len(found) == int(count) > 10 and found == messages(int(count))


@pytest.mark.parametrize("velocities", [0, 2])
@pytest.mark.parametrize("efforts", [0, 2])
@pytest.mark.parametrize("name", ["a", "ab", "abc", "abcd", "abcde"])
def test_joint_states_of_ros_are_read_whatever_they_leave_out(name: str, velocities: int, efforts: int) -> None:
    serialization = pytest.importorskip("rclpy.serialization")
    from sensor_msgs.msg import JointState

    message = JointState(name=[name, "b"], position=[1.0, 2.0])
    message.velocity, message.effort = [3.0] * velocities, [4.0] * efforts
    read = deserialize("sensor_msgs/msg/JointState", bytes(serialization.serialize_message(message)))
    assert read.name == message.name
    for field in ("position", "velocity", "effort"):
        assert getattr(read, field).tolist() == list(getattr(message, field))
