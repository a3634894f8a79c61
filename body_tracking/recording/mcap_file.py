"""Reads one mcap file, complete or damaged.

A closed file ends in a summary (channels, chunk index, counts) with a checksum, and is opened from that. A file without
a summary, after a crash or power failure, is read record by record; a truncated chunk is decompressed as far as
possible and yields its whole messages. A chunk with a wrong checksum is skipped.

Records are parsed by the ``mcap`` library (format: https://mcap.dev/spec, version 0). Its readers, and those of
``rosbags``, stop at the first damaged record, do not limit the size of decompressed chunks, and take 1.6 and 2.4 times
as long for a recording (tpose_torso_twist, 3204 messages, one run, rosbags 0.11.9, mcap 1.6.0).
"""

from __future__ import annotations

import os
import struct
import zlib
from collections import Counter
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import lz4.frame  # type: ignore[import-untyped]
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, ChunkIndex, Schema, Statistics
from mcap.stream_reader import StreamReader
from mcap.writer import MCAP0_MAGIC

from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.files import open_regular
from body_tracking.core.skeleton import NANOSECONDS

MAGIC: bytes = MCAP0_MAGIC
LIBRARY = "body_tracking"
"""Name of the writer in a file's header."""

_HEAD = struct.Struct("<BQ")  # opcode, length of the content
_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_FOOTER = struct.Struct("<QQI")  # start of the summary and of its offsets, checksum
_ENDING_BYTES = _HEAD.size + _FOOTER.size + len(MAGIC)
_LAST = (Opcode.DATA_END, Opcode.FOOTER)
_RUN_BYTES = 1 << 20
"""Records outside of chunks are read in runs of about this size."""

MAX_CHUNK_BYTES = 64 << 20
"""Limit of a chunk's decompressed bytes: recorders close theirs after some megabytes."""
MAX_RECORDS = 500_000
"""Limit of a chunk's records; parsing them takes a second."""


class BagError(BodyTrackingError):
    """Raised when a recording cannot be read or written."""


class Damaged(Exception):
    """Raised for a damaged record."""


class StoredMessage(NamedTuple):
    """A serialised message in the file."""

    channel: int
    log_time_ns: int
    publish_time_ns: int
    data: bytes


@dataclass(slots=True)
class Block:
    """A unit of reading: a chunk, or a run of messages outside of chunks.

    Attributes:
        offset: of its first byte in the file.
        length: bytes in the file.
        chunk: whether it is a chunk record.
        cut: whether the file ends inside of it.
        start_ns: earliest log time in it.
        end_ns: latest log time in it.
        channels: of its messages; None if unknown before it is read.
        count: of its messages; None if unknown before it is read.
    """

    offset: int
    length: int
    chunk: bool = True
    cut: bool = False
    start_ns: int = 0
    end_ns: int = 0
    channels: frozenset[int] | None = None
    count: int | None = None


def _parse(record: type[Any], content: bytes) -> Any:
    return record.read(ReadDataStream(BytesIO(content)))


def _chunk_records(content: bytes, cut: bool) -> bytes:
    """The records in a chunk; of a truncated chunk the readable beginning.

    Raises:
        Damaged: the chunk is damaged or too large.
    """
    chunk: Chunk = _parse(Chunk, content)
    size = chunk.uncompressed_size
    if size > MAX_CHUNK_BYTES:
        raise Damaged(_too_large(size))
    data = _decompress(chunk.compression, chunk.data, size + 1)  # one byte more, to detect a wrong size
    if not cut and len(data) != size:
        raise Damaged("its size does not fit")
    # a chunk with a damaged length looks truncated, but may be complete
    if len(data) == size and chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
        raise Damaged("its checksum does not fit")
    return data


def _decompress(compression: str, data: bytes, limit: int) -> bytes:
    """Decompress up to the limit, regardless of the size that the data claims."""
    if compression == "zstd":
        return zstandard.ZstdDecompressor().stream_reader(data).read(limit)
    if compression == "lz4":
        return bytes(lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=limit))
    if compression == "":
        return data
    raise Damaged(f"compression {compression!r} is unknown")


def _too_large(size: int) -> str:
    return f"a chunk of {size >> 20} MB; at most {MAX_CHUNK_BYTES >> 20} MB are read"


def _seconds(nanoseconds: int) -> str:
    return f"{nanoseconds / NANOSECONDS:.3f} s"


class McapFile:
    """Reads one mcap file; damage is a line in :attr:`warnings`, not an exception.

    Attributes:
        path: of the file.
        schemas: by id.
        channels: by id.
        blocks: of the messages, in the order of the file.
        counts: messages per channel.
        start_ns: earliest log time; 0 without messages.
        end_ns: latest log time; 0 without messages.
        whole: whether it ends in a valid summary, as a closed recording does.
        warnings: missing or damaged parts found so far.
        damaged_at: offsets of damaged parts, other than a missing end.

    Raises:
        BagError: the file is unreadable, empty, no mcap file, or has no readable content.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.warnings: list[str] = []
        self.damaged_at: set[int] = set()
        self._forget()
        try:
            self._file: BinaryIO = open_regular(path)
        except OSError as error:
            raise BagError(f"{path}: {error.strerror}") from error
        try:
            self._open(os.fstat(self._file.fileno()).st_size)
        except BaseException:
            self._file.close()
            raise

    def close(self) -> None:
        self._file.close()

    @property
    def message_count(self) -> int:
        """Messages of all channels."""
        return self.counts.total()

    def read(self, block: Block) -> list[StoredMessage]:
        """The messages of a block, in the order of writing; none of a damaged block."""
        messages = self._messages(block)
        known = [message for message in messages if message.channel in self.channels]
        if len(known) < len(messages) and block.offset not in self.damaged_at:
            self.damaged_at.add(block.offset)
            lost = len(messages) - len(known)
            self._warn(f"{lost} message(s) at byte {block.offset} belong to a topic whose description is lost")
        return known

    def _forget(self) -> None:
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.blocks: list[Block] = []
        self.counts: Counter[int] = Counter()
        self.start_ns = self.end_ns = 0

    def _warn(self, text: str) -> None:
        self.warnings.append(f"{self.path.name}: {text}")

    def _bytes_at(self, offset: int, length: int) -> bytes:
        """Bytes of the file; fewer at its end."""
        try:
            self._file.seek(offset)
            return self._file.read(length)
        except OSError as error:
            raise BagError(f"{self.path}: {error.strerror}") from error

    def _messages(self, block: Block) -> list[StoredMessage]:
        """The messages of a block; none, and a warning, if it is damaged."""
        try:
            if block.length > MAX_CHUNK_BYTES + _RUN_BYTES:
                raise Damaged(_too_large(block.length))
            data = self._bytes_at(block.offset, block.length)
            if len(data) < block.length:
                raise Damaged("the file ends in it")
            if block.chunk:
                if _HEAD.unpack_from(data)[0] != Opcode.CHUNK:
                    raise Damaged("no chunk is there")
                data = _chunk_records(data[_HEAD.size :], block.cut)
            return self._records(data)
        except BagError:
            raise
        except Exception as error:  # parsers and decompressors do not document what they raise for damaged data
            if not block.cut:
                self._skip(block, error if isinstance(error, Damaged) else Damaged("it cannot be read"))
            return []

    def _records(self, data: bytes) -> list[StoredMessage]:
        """The whole messages in ``data``; without a summary, also stores schemas and channels."""
        messages: list[StoredMessage] = []
        position, end, left = 0, len(data), MAX_RECORDS
        while end - position >= _HEAD.size:
            opcode, length = _HEAD.unpack_from(data, position)
            left -= 1
            if opcode == 0 or left < 0:
                raise Damaged("records of no kind" if opcode == 0 else f"more than {MAX_RECORDS} records")
            first = position + _HEAD.size
            position = first + length
            if position > end:
                break
            if opcode == Opcode.MESSAGE:
                if length < _MESSAGE.size:
                    raise Damaged("a message is shorter than its own header")
                channel, _, log_time, sent = _MESSAGE.unpack_from(data, first)
                messages.append(StoredMessage(channel, log_time, sent, data[first + _MESSAGE.size : position]))
            elif not self.whole and opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self._describe(_parse(Schema if opcode == Opcode.SCHEMA else Channel, data[first:position]))
        return messages

    def _describe(self, record: Schema | Channel) -> None:
        known: dict[int, Any] = self.schemas if isinstance(record, Schema) else self.channels
        known[record.id] = record

    def _skip(self, block: Block, damage: Damaged) -> None:
        if block.offset in self.damaged_at:
            return
        self.damaged_at.add(block.offset)
        messages = "" if block.count is None else f" with {block.count} message(s)"
        times = f", {_seconds(block.start_ns)} to {_seconds(block.end_ns)}" if block.end_ns else ""
        self._warn(f"damaged chunk at byte {block.offset} skipped ({damage}){messages}{times}")
        if self.whole and all(each.offset in self.damaged_at for each in self.blocks):
            raise BagError(f"{self.path}: none of its chunks can be read ({damage})")

    # --- opening

    def _open(self, size: int) -> None:
        if size == 0:
            raise BagError(f"{self.path}: the file is empty")
        if not MAGIC.startswith(self._bytes_at(0, len(MAGIC))):
            way = "" if self.path.suffix == ".mcap" else "; body_tracking import makes a bag of other formats"
            raise BagError(f"{self.path}: not an mcap file{way}")
        self.whole = False
        self.whole = self._read_summary(size)
        if not self.whole:
            self._forget()
            self._scan(size)
            self.start_ns = min((block.start_ns for block in self.blocks), default=0)
            self.end_ns = max((block.end_ns for block in self.blocks), default=0)
            if self.damaged_at and not self.blocks:
                raise BagError(f"{self.path}: nothing in it can be read ({self.warnings[0]})")

    def _read_summary(self, size: int) -> bool:
        """Read the summary; False if it is missing, damaged or incomplete."""
        ending = self._bytes_at(max(0, size - _ENDING_BYTES), _ENDING_BYTES)
        if not ending.endswith(MAGIC) or not ending.startswith(_HEAD.pack(Opcode.FOOTER, _FOOTER.size)):
            return False
        start, _, checksum = _FOOTER.unpack_from(ending, _HEAD.size)
        end = size - _ENDING_BYTES
        if not len(MAGIC) < start < end <= start + MAX_CHUNK_BYTES:
            return False
        summary = self._bytes_at(start, end - start)
        covered = summary + ending[: _HEAD.size + _FOOTER.size - 4]
        if checksum and zlib.crc32(covered) != checksum:
            return False
        try:
            complete = False
            for record in StreamReader(BytesIO(summary + ending), skip_magic=True, emit_chunks=True).records:
                if isinstance(record, Schema | Channel):
                    self._describe(record)
                elif isinstance(record, ChunkIndex):
                    self._index(record, start)
                elif isinstance(record, Statistics):
                    complete = True
                    self.counts = Counter(record.channel_message_counts)
                    if record.message_count:
                        self.start_ns, self.end_ns = record.message_start_time, record.message_end_time
        except BagError:
            raise
        except Exception:  # as above
            return False
        return complete and (not self.message_count or bool(self.blocks and self.channels))

    def _index(self, index: ChunkIndex, data_end: int) -> None:
        """Add a chunk from the summary. A channel's message index has 15 bytes, plus 16 for each message."""
        if index.chunk_start_offset + index.chunk_length > data_end:
            raise Damaged("a chunk lies behind the data")
        if index.uncompressed_size > MAX_CHUNK_BYTES:
            raise BagError(f"{self.path}: {_too_large(index.uncompressed_size)}")
        channels = index.message_index_offsets.keys()
        self.blocks.append(
            Block(
                index.chunk_start_offset,
                index.chunk_length,
                start_ns=index.message_start_time,
                end_ns=index.message_end_time,
                channels=frozenset(channels) if channels else None,
                count=(index.message_index_length - 15 * len(channels)) // 16 if channels else None,
            )
        )

    def _scan(self, size: int) -> None:
        """Read the records one by one, to the last whole one."""
        position = run = len(MAGIC)  # offsets of the next record, and of the first one not in a block yet
        opcode = stop = 0
        while size - position >= _HEAD.size:
            opcode, length = _HEAD.unpack(self._bytes_at(position, _HEAD.size))
            stop = position + _HEAD.size + length
            if stop > size or opcode == 0 or opcode in _LAST:
                break
            if opcode == Opcode.CHUNK:
                self._take(Block(run, position - run, chunk=False))
                self._take(Block(position, stop - position))
                run = stop
            elif stop - run > _RUN_BYTES:
                self._take(Block(run, stop - run, chunk=False))
                run = stop
            position, opcode = stop, 0
        self._take(Block(run, position - run, chunk=False))
        closed = self._bytes_at(max(0, size - len(MAGIC)), len(MAGIC)) == MAGIC and size > len(MAGIC)
        if opcode in _LAST and stop <= size:
            what = "it has no index that can be used; every record was read instead"
            self._warn(what if closed else f"cut off in its index at byte {size}; every message is there")
        elif closed or (size - position >= _HEAD.size and stop <= size):
            self.damaged_at.add(position)
            self._warn(f"damaged at byte {position}: the {size - position} bytes from there on cannot be read")
        elif opcode == Opcode.CHUNK:
            self._take_cut_chunk(position, size, stop)
        else:
            rest = f"; the last {size - position} byte(s) are no whole record" if size > position else ""
            self._warn(f"cut off at byte {size}: it was not closed{rest}")

    def _take(self, block: Block) -> list[StoredMessage]:
        """Read a block without index, and add it if it has messages."""
        messages = self._messages(block)
        if messages:
            times = [message.log_time_ns for message in messages]
            counts = Counter(message.channel for message in messages)
            block.start_ns, block.end_ns = min(times), max(times)
            block.channels, block.count = frozenset(counts), len(times)
            self.blocks.append(block)
            self.counts.update({channel: count for channel, count in counts.items() if channel in self.channels})
        return messages

    def _take_cut_chunk(self, position: int, size: int, stop: int) -> None:
        """Read the truncated chunk from ``position`` to ``stop``; the file ends at ``size``."""
        before = max((block.end_ns for block in self.blocks), default=0)
        messages = self._take(Block(position, size - position, cut=True))
        missing = ""
        times = self._bytes_at(position + _HEAD.size, 16)
        if len(times) == 16:
            last = max((message.log_time_ns for message in messages), default=before)
            missing = f", {_seconds(max(0, struct.unpack('<QQ', times)[1] - last))} of recording"
        self._warn(
            f"cut off at byte {size}: {stop - size} bytes of the last chunk are missing{missing};"
            f" {len(messages)} message(s) of it are whole"
        )
