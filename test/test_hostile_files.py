"""Hostile files: each is refused in one line, soon, and in little memory."""

from __future__ import annotations

import os
import resource
import struct
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import lz4.frame
import pytest
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, ChunkIndex, DataEnd, Footer, Header, McapRecord, Schema, Statistics

from body_tracking.calibration import storage
from body_tracking.core import files
from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.parameters import read_file
from body_tracking.kinect.csv_recording import CsvRecording
from body_tracking.kinect.ntu import NtuRecording
from body_tracking.recording.mcap_file import MAGIC
from body_tracking.recording.rosbag2 import METADATA, BagError, BagReader
from body_tracking.robot import mapping
from draws import some
from patience import PATIENCE

BAG = Path(__file__).resolve().parent.parent / "bags" / "tpose_wave"
SECONDS, BYTES = 2.0, 200 << 20

YAML: dict[str, str] = {
    "lists in each other": "[" * 200_000,
    "mappings in each other": "{a: " * 200_000,
    "mappings in each other, line by line": "".join(f"{' ' * depth}a:\n" for depth in range(1500)),
    "aliases of aliases": "a0: &a0 [x, x]\n" + "".join(f"a{n}: &a{n} [{f'*a{n - 1}, ' * 9}]\n" for n in range(1, 12)),
    "an alias of itself": "a: &a [*a]\n",
    "a number of 5000 digits": "a: " + "9" * 5000 + "\n",
    "a hexadecimal number": "a: 0x" + "f" * 100_000 + "\n",
    "a number in base 60": "a: 1" + ":59" * 30_000 + "\n",
    "a day that is none": "a: 2024-99-99\n",
    "many values": "a: [" + "1, " * 500_000 + "]\n",
    "a long file": "a: " + "x" * (files.MAX_BYTES + 1) + "\n",
    "an object": "a: !!python/object/apply:os.getcwd []\n",
    "a key that is a list": "? [a]\n: b\n",
    "no text": "a: \x00\x01\n",
}


def calibration(path: Path) -> object:
    return storage.load(path)


def parameters(path: Path) -> object:
    return read_file(path)


def robot(path: Path) -> object:
    return mapping.load(path, {})


def listing(path: Path) -> object:
    """A recording whose ``metadata.yaml`` it is."""
    for file in BAG.glob("*.mcap"):
        (path.parent / file.name).symlink_to(file)
    path.rename(path.parent / METADATA)
    return BagReader(path.parent)


READERS = (calibration, parameters, robot, listing)


def refused_soon(path: Path, read: Callable[[Path], object]) -> str:
    """The error line for a refused file, within the limits of time and memory."""
    before, begin = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.process_time()
    with pytest.raises(BodyTrackingError) as caught:
        read(path)
    assert time.process_time() - begin < SECONDS
    assert (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) << 10 < BYTES
    line = str(caught.value)
    assert "\n" not in line
    assert len(line) < 500
    return line


@pytest.mark.parametrize("read", READERS)
@pytest.mark.parametrize("content", YAML)
def test_hostile_yaml_is_refused_in_one_line(tmp_path: Path, content: str, read: Callable[[Path], object]) -> None:
    path = tmp_path / "file.yaml"
    path.write_text(YAML[content])
    harmless = ("a day that is none", "an object", "a key that is a list", "no text", "mappings in each other, line")
    if read is listing and content.startswith(harmless):
        try:
            reader = listing(path)  # an invalid listing is only damage: its content follows from the files
        except BagError as error:
            assert "nested deeper" in str(error)
            return
        assert isinstance(reader, BagReader)
        assert "damaged" in reader.warnings[0]
        return
    refused_soon(path, read)


@pytest.mark.parametrize("read", READERS)
def test_pipe_is_refused_as_yaml_file(tmp_path: Path, read: Callable[[Path], object]) -> None:
    os.mkfifo(tmp_path / "file.yaml")
    assert "regular file" in refused_soon(tmp_path / "file.yaml", read)


def test_anchors_and_depth_within_reason_are_read() -> None:
    text = "a: &a [1, 2]\nb: *a\nc: {<<: &d {x: 1}, y: 2}\ne: " + "[" * 30 + "]" * 30
    content = files.load_yaml(text)
    assert content["b"] == [1, 2]
    assert content["c"] == {"x": 1, "y": 2}


# --- chunks


def zeros(size: int, announced: bool = True) -> bytes:
    """A zstd frame (RFC 8878) of ``size`` zero bytes; it has four bytes for each 128 kB."""
    block = 1 << 17
    blocks = [block] * (size // block) + [size % block]
    head = struct.pack("<IBB", 0xFD2FB528, 0xC0 if announced else 0, 0x50) + struct.pack("<Q", size) * announced
    return head + b"".join(
        (int(number == len(blocks) - 1) | 1 << 1 | length << 3).to_bytes(3, "little") + b"\0"
        for number, length in enumerate(blocks)
    )


def bag(path: Path, compression: str, data: bytes, size: int, summary: bool) -> None:
    """A recording of one chunk."""

    def record(content: McapRecord) -> bytes:
        builder = RecordBuilder()
        content.write(builder)
        return builder.end()

    schema = Schema(id=1, name="std_msgs/msg/String", encoding="ros2msg", data=b"string data")
    channel = Channel(id=1, topic="/kinect1/skeleton", message_encoding="cdr", metadata={}, schema_id=1)
    chunk = record(
        Chunk(
            compression=compression,
            data=data,
            message_start_time=1,
            message_end_time=2,
            uncompressed_crc=0,
            uncompressed_size=size,
        )
    )
    begin = MAGIC + b"".join(map(record, (Header(profile="ros2", library="x"), schema, channel)))
    content = begin + chunk
    if summary:
        content += record(DataEnd(data_section_crc=0))
        start = len(content)
        statistics = Statistics(
            attachment_count=0,
            channel_count=1,
            channel_message_counts={1: 1},
            chunk_count=1,
            message_count=1,
            message_start_time=1,
            message_end_time=2,
            metadata_count=0,
            schema_count=1,
        )
        index = ChunkIndex(
            chunk_length=len(chunk),
            chunk_start_offset=len(begin),
            compression=compression,
            compressed_size=len(data),
            message_end_time=2,
            message_index_length=0,
            message_index_offsets={},
            message_start_time=1,
            uncompressed_size=size,
        )
        content += b"".join(map(record, (schema, channel, statistics, index)))
        content += record(Footer(summary_start=start, summary_offset_start=0, summary_crc=0)) + MAGIC
    path.write_bytes(content)


CHUNKS: dict[str, Callable[[], tuple[str, bytes, int]]] = {
    "zstd of 3.2 GB": lambda: ("zstd", zeros(3_200_000_000), 3_200_000_000),
    "zstd of 3.2 GB that does not say so": lambda: ("zstd", zeros(3_200_000_000, False), 3_200_000_000),
    "lz4 of more than it says": lambda: ("lz4", lz4.frame.compress(bytes(100 << 20)), 1000),
    "lz4 that says 3.2 GB": lambda: ("lz4", lz4.frame.compress(bytes(1000), store_size=False), 3_200_000_000),
}


def read_whole(path: Path) -> None:
    with BagReader(path) as reader:
        list(reader.messages())


@pytest.mark.parametrize("summary", [True, False])
@pytest.mark.parametrize("kind", CHUNKS)
def test_decompression_bomb_is_refused(tmp_path: Path, kind: str, summary: bool) -> None:
    compression, data, size = CHUNKS[kind]()
    bag(tmp_path / "a.mcap", compression, data, size, summary)
    refused_soon(tmp_path / "a.mcap", read_whole)


def test_truncated_chunk_takes_no_more_memory_than_a_whole_one(tmp_path: Path) -> None:
    bag(tmp_path / "a.mcap", "zstd", zeros(3_200_000_000), 3_200_000_000, False)
    data = (tmp_path / "a.mcap").read_bytes()
    (tmp_path / "a.mcap").write_bytes(data[:-1000])
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with BagReader(tmp_path / "a.mcap") as reader:
        assert reader.message_count == 0
    assert (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) << 10 < BYTES


@pytest.mark.parametrize("kind", ["chunk", "message", "summary"])
def test_a_sparse_file_of_gigabytes_is_not_read_into_memory(tmp_path: Path, kind: str) -> None:
    path, size = tmp_path / "a.mcap", 8 << 30
    opcode = {"chunk": Opcode.CHUNK, "message": Opcode.MESSAGE, "summary": 0}[kind]
    with path.open("wb") as file:
        file.write(MAGIC + struct.pack("<BQ", opcode, size))
        file.truncate(size + len(MAGIC) + 9)
        file.seek(0, os.SEEK_END)
        file.write(struct.pack("<BQQQI", Opcode.FOOTER, 20, 20, 0, 0) + MAGIC)
    assert path.stat().st_blocks < 1000
    refused_soon(path, read_whole)


# --- pipes and other special files


@pytest.mark.parametrize(
    "read", [BagReader, lambda path: list(CsvRecording(path)), lambda path: list(NtuRecording(path, "kinect1"))]
)
def test_pipe_is_refused_as_recording(tmp_path: Path, read: Callable[[Path], object]) -> None:
    os.mkfifo(tmp_path / "a.mcap")
    assert "regular file" in refused_soon(tmp_path / "a.mcap", read)


# --- as a user meets it

MEASURED = """
import re, sys, time
from body_tracking.cli import main
code = main(sys.argv[1:])
print(time.process_time(), re.search(r"VmHWM:\\s+(\\d+) kB", open("/proc/self/status").read())[1])
sys.exit(code)
"""
"""A command that prints the seconds of a processor and the kilobytes that it took."""


@pytest.mark.parametrize("kind", some(["chunk", "metadata", "parameters", "pipe", "calibration"]))
def test_command_ends_with_2_and_one_line(tmp_path: Path, kind: str) -> None:
    given: list[object] = ["bag", "info", tmp_path]
    if kind == "metadata":
        (tmp_path / METADATA).write_text(YAML["lists in each other"])
    elif kind == "chunk":
        bag(tmp_path / "a.mcap", *CHUNKS["zstd of 3.2 GB"](), True)
        given = ["replay", tmp_path / "a.mcap", "-o", tmp_path / "out"]
    elif kind == "pipe":
        os.mkfifo(tmp_path / "a.mcap")
        given = ["bag", "info", tmp_path / "a.mcap"]
    else:
        (tmp_path / "bad.yaml").write_text(YAML["aliases of aliases"])
        option = "--params-file" if kind == "parameters" else "--calibration"
        given = ["replay", BAG, "-o", tmp_path / "out", option, tmp_path / "bad.yaml"]
    done = subprocess.run(
        [sys.executable, "-c", MEASURED, *map(str, given)],
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        check=False,
    )
    assert done.returncode == 2, done.stderr
    (line,) = done.stderr.splitlines()
    assert line.startswith("body_tracking: ")
    seconds, kilobytes = map(float, done.stdout.split())
    assert seconds < SECONDS
    assert kilobytes * 1024 < BYTES
