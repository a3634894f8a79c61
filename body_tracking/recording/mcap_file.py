"""One mcap file, whole or damaged: what is in it, and what is missing.

A file that was closed ends in a summary (channels, chunk index, counts) under a checksum, and opens from that at once.
A file without one, because the recorder or the power died, is read record by record; a cut chunk is decompressed as far
as it goes and yields its whole messages. Chunks carry a checksum, so that a damaged one is noticed and skipped.

Format: https://mcap.dev/spec, version 0. Record contents are read with the ``mcap`` library; what is here is what that
library does not do: survive files that break the format.
"""

from __future__ import annotations

import mmap
import os
import re
import struct
import zlib
from collections import Counter
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import lz4.frame  # type: ignore[import-untyped]
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, ChunkIndex, Footer, Schema, Statistics
from mcap.writer import MCAP0_MAGIC

from body_tracking.errors import BodyTrackingError
from body_tracking.files import open_regular
from body_tracking.skeleton import NANOSECONDS

MAGIC: bytes = MCAP0_MAGIC
LIBRARY = "body_tracking"
"""Who wrote a file, in its header."""

HEAD = struct.Struct("<BQ")  # opcode, length of the content
MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_CHUNK_TIMES = struct.Struct("<QQ")
_FOOTER_BYTES = HEAD.size + 20
_PIECE_BYTES = 1 << 20
_LOOSE_BYTES = 1 << 20  # messages outside of chunks are read in runs of about this size

# Everything that reading a broken record can raise.
_BROKEN = (
    McapError,
    struct.error,
    ValueError,
    KeyError,
    IndexError,
    OverflowError,
    MemoryError,
    EOFError,
    RuntimeError,
    zstandard.ZstdError,
)

_OTHER_CHUNK = re.compile(rb"\x06.{36}(?:\x00\x00\x00\x00|\x03\x00\x00\x00lz4|\x04\x00\x00\x00zstd)", re.DOTALL)
"""Where a chunk record may begin, for finding the thread again after damage."""


MAX_CHUNK_BYTES = 64 << 20
"""Decompressed bytes of a chunk that is read: recorders close theirs after some megabytes."""

MAX_RECORDS = 500_000
"""Records of a chunk that is read; they take a second."""


class BagError(BodyTrackingError):
    """A recording cannot be read or written."""


class Damaged(Exception):
    """A record is not what its place promises."""


class StoredMessage(NamedTuple):
    """A message as it lies in the file."""

    channel: int
    log_time_ns: int
    publish_time_ns: int
    data: bytes


@dataclass(slots=True)
class Block:
    """A run of messages that is read at once: a chunk, or messages that lie outside of chunks.

    Attributes:
        offset: of its first byte in the file.
        length: bytes in the file.
        start_ns: earliest log time in it.
        end_ns: latest log time in it.
        counts: messages per channel; None where only reading the block tells.
        chunk: whether it is a chunk record.
        cut: whether the file ends inside of it.
    """

    offset: int
    length: int
    start_ns: int
    end_ns: int
    counts: dict[int, int] | None
    chunk: bool = True
    cut: bool = False


@dataclass(slots=True)
class _Content:
    """What is in the records of one chunk, or of a run of loose records."""

    messages: list[StoredMessage] = field(default_factory=list)
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)


def parse(record: type[Any], content: bytes) -> Any:
    """The content of a record, read by the mcap library."""
    return record.read(ReadDataStream(BytesIO(content)))


def _contents(data: bytes) -> _Content:
    """The whole records at the beginning of ``data``; whatever is cut off at its end is left out."""
    found = _Content()
    position, end, left = 0, len(data), MAX_RECORDS
    while end - position >= HEAD.size:
        opcode, length = HEAD.unpack_from(data, position)
        left -= 1
        if opcode == 0 or left < 0:
            raise Damaged("records of no kind" if opcode == 0 else f"more than {MAX_RECORDS} records")
        first = position + HEAD.size
        stop = first + length
        if stop > end:
            break
        if opcode == Opcode.MESSAGE:
            if length < MESSAGE.size:
                raise Damaged("a message is shorter than its own header")
            channel, _, log_time, publish_time = MESSAGE.unpack_from(data, first)
            found.messages.append(StoredMessage(channel, log_time, publish_time, data[first + MESSAGE.size : stop]))
        elif opcode == Opcode.SCHEMA:
            schema = parse(Schema, data[first:stop])
            found.schemas[schema.id] = schema
        elif opcode == Opcode.CHANNEL:
            channel_record = parse(Channel, data[first:stop])
            found.channels[channel_record.id] = channel_record
        position = stop
    return found


def decompress(chunk: Chunk) -> bytes:
    """The records in a chunk, their checksum verified.

    Raises:
        Damaged: anything does not fit.
        BagError: it fits, and is larger than any that is read.
    """
    size = chunk.uncompressed_size
    # Before a size is believed: a damaged one must not allocate gigabytes.
    _refuse_bomb(size, _announced(chunk))
    try:
        if chunk.compression == "zstd":
            if zstandard.frame_content_size(chunk.data) not in (-1, size):
                raise Damaged("its size does not fit")
            data = zstandard.ZstdDecompressor().decompress(chunk.data, max_output_size=size)
        elif chunk.compression == "lz4":
            data = _whole_lz4(chunk.data, size)
        elif chunk.compression == "":
            data = chunk.data
        else:
            raise Damaged(f"compression {chunk.compression!r} is unknown")
    except _BROKEN as error:
        raise Damaged("it does not decompress") from error
    if len(data) != size:
        raise Damaged("its size does not fit")
    if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
        raise Damaged("its checksum does not fit")
    return bytes(data)


def _whole_lz4(data: bytes, size: int) -> bytes:
    """As much as decompresses, and a byte more than it should be where it is more.

    Raises:
        BagError: it is larger than any that is read.
    """
    decompressor = lz4.frame.LZ4FrameDecompressor()
    found: bytes = decompressor.decompress(data, max_length=size + 1)
    length = len(found)
    while length > size and not (decompressor.eof or decompressor.needs_input):
        length += len(decompressor.decompress(b"", max_length=_PIECE_BYTES))
        _refuse_bomb(length, None)
    return found


def _announced(chunk: Chunk) -> int | None:
    """The size that the compressed data says of itself; None where it says nothing."""
    try:
        if chunk.compression == "zstd":
            size = int(zstandard.frame_content_size(chunk.data))
            return None if size < 0 else size
        if chunk.compression == "lz4":
            size = int(lz4.frame.get_frame_info(chunk.data)["content_size"])  # under a checksum
            if size > MAX_CHUNK_BYTES:
                _refuse_bomb(size, size)
            return size or None
    except _BROKEN:
        return None
    return len(chunk.data) if chunk.compression == "" else None


def _refuse_bomb(size: int, announced: int | None) -> None:
    """Of two sizes of a chunk, that in its record and that in its data.

    Raises:
        BagError: the chunk is larger than any that is read.
        Damaged: only one of the two sizes says so.
    """
    most = max(size, announced or 0)
    if most <= MAX_CHUNK_BYTES:
        return
    if min(size, size if announced is None else announced) <= MAX_CHUNK_BYTES:
        raise Damaged("its size does not fit")
    raise BagError(f"a chunk of {most >> 20} MB when decompressed; at most {MAX_CHUNK_BYTES >> 20} MB are read")


def _chunk_contents(content: bytes) -> _Content:
    """A chunk record's messages, schemas and channels.

    Raises:
        Damaged: the chunk is not as it was written.
    """
    try:
        chunk: Chunk = parse(Chunk, content)
        return _contents(decompress(chunk))
    except _BROKEN as error:
        raise Damaged("it cannot be read") from error


def _cut_chunk_contents(content: bytes) -> _Content:
    """The whole messages in the first part of a chunk record; no checksum covers them."""
    try:
        name_length = struct.unpack_from("<I", content, 28)[0]
        name = content[32 : 32 + name_length]
        data = content[40 + name_length :]
        if name == b"zstd":
            data = _beginning_of_zstd(data)
        elif name == b"lz4":
            data = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=MAX_CHUNK_BYTES)
        elif name != b"":
            return _Content()
        return _contents(data)
    except (*_BROKEN, Damaged):
        return _Content()


def _beginning_of_zstd(data: bytes) -> bytes:
    """As much as decompresses, and no more than is read of a chunk."""
    reader, found = zstandard.ZstdDecompressor().stream_reader(BytesIO(data)), bytearray()
    while len(found) < MAX_CHUNK_BYTES and (piece := reader.read(_PIECE_BYTES)):
        found += piece
    return bytes(found)


def _seconds(nanoseconds: int) -> str:
    return f"{nanoseconds / NANOSECONDS:.3f} s"


class McapFile:
    """Reads one mcap file; damage is a line in :attr:`warnings`, not an exception.

    Attributes:
        path: of the file.
        schemas: by id.
        channels: by id.
        blocks: where the messages are, in the order of the file.
        counts: messages per channel.
        start_ns: earliest log time; 0 without messages.
        end_ns: latest log time; 0 without messages.
        whole: whether it ends in a valid summary, as a closed recording does.
        warnings: what is missing or damaged, as far as it is known yet.
        damaged_at: bytes at which something is damaged, other than that the end is missing.
        sound_end: of a file that was read record by record, the end of its first unbroken part.

    Raises:
        BagError: the file cannot be read, is empty, or is no mcap file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.blocks: list[Block] = []
        self.counts: Counter[int] = Counter()
        self.start_ns = 0
        self.end_ns = 0
        self.whole = False
        self.warnings: list[str] = []
        self.damaged_at: set[int] = set()
        self._unknown_channels: Counter[int] = Counter()
        self.sound_end = 0
        try:
            self._file: BinaryIO = open_regular(path)
        except OSError as error:
            raise BagError(f"{path}: {error.strerror}") from error
        try:
            self._open()
        except BaseException:
            self._file.close()
            raise

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    @property
    def message_count(self) -> int:
        """Messages of all channels."""
        return self.counts.total()

    def read(self, block: Block) -> list[StoredMessage]:
        """The messages of a block, in the order in which they were written; none of a damaged block."""
        try:
            data = self.bytes_at(block.offset, block.length)
        except OSError as error:
            raise BagError(f"{self.path}: {error.strerror}") from error
        try:
            if not block.chunk:
                content = _contents(data)
            elif block.cut:
                content = _cut_chunk_contents(data[HEAD.size :])
            elif len(data) < block.length or HEAD.unpack_from(data)[0] != Opcode.CHUNK:
                raise Damaged("no chunk is there")
            else:
                content = _chunk_contents(data[HEAD.size :])
        except Damaged as damage:
            self._skip(block, damage)
            return []
        except BagError as error:
            raise BagError(f"{self.path}: {error}") from None
        known = [message for message in content.messages if message.channel in self.channels]
        if len(known) < len(content.messages) and block.offset not in self.damaged_at:
            self.damaged_at.add(block.offset)
            lost = len(content.messages) - len(known)
            self._warn(f"{lost} message(s) at byte {block.offset} belong to a topic whose description is lost")
        return known

    # --- opening

    def _warn(self, text: str) -> None:
        self.warnings.append(f"{self.path.name}: {text}")

    def bytes_at(self, offset: int, length: int) -> bytes:
        """A piece of the file; shorter where the file ends."""
        self._file.seek(offset)
        return self._file.read(length)

    def _skip(self, block: Block, damage: Exception) -> None:
        if block.offset in self.damaged_at:
            return
        self.damaged_at.add(block.offset)
        messages = "" if block.counts is None else f" with {sum(block.counts.values())} message(s)"
        self._warn(
            f"damaged chunk at byte {block.offset} skipped ({damage}){messages},"
            f" {_seconds(block.start_ns)} to {_seconds(block.end_ns)}"
        )
        if self.whole and all(each.offset in self.damaged_at for each in self.blocks):
            raise BagError(f"{self.path}: none of its chunks can be read ({damage})")

    def _open(self) -> None:
        size = os.fstat(self._file.fileno()).st_size
        if size == 0:
            raise BagError(f"{self.path}: the file is empty")
        begin = self.bytes_at(0, len(MAGIC))
        self.whole = self._open_summary(size)
        if begin != MAGIC[: len(begin)]:
            if not self.whole:
                raise BagError(f"{self.path}: not an mcap file")
            self._warn("damaged in its first 8 bytes")
        if not self.whole:
            with mmap.mmap(self._file.fileno(), 0, access=mmap.ACCESS_READ) as data:
                _Scan(self, data).run()
            self.start_ns = min((block.start_ns for block in self.blocks), default=0)
            self.end_ns = max((block.end_ns for block in self.blocks), default=0)

    def _open_summary(self, size: int) -> bool:
        """Take everything from the summary; False if there is none, or it cannot be trusted."""
        tail = self.bytes_at(max(0, size - _FOOTER_BYTES - len(MAGIC)), _FOOTER_BYTES + len(MAGIC))
        if len(tail) < _FOOTER_BYTES + len(MAGIC) or tail[-len(MAGIC) :] != MAGIC:
            return False
        if HEAD.unpack_from(tail) != (Opcode.FOOTER, 20):
            return False
        footer: Footer = parse(Footer, tail[HEAD.size :])
        end = size - len(tail)
        if not len(MAGIC) < footer.summary_start < end:
            return False
        summary = self.bytes_at(footer.summary_start, end - footer.summary_start)
        if footer.summary_crc and zlib.crc32(tail[: HEAD.size + 16], zlib.crc32(summary)) != footer.summary_crc:
            return False
        try:
            return self._read_summary(summary, footer.summary_start)
        except (*_BROKEN, Damaged):
            self._forget()
            return False

    def _forget(self) -> None:
        self.schemas, self.channels, self.blocks, self.counts = {}, {}, [], Counter()

    def _read_summary(self, summary: bytes, data_end: int) -> bool:
        statistics: Statistics | None = None
        position = 0
        while position < len(summary):
            opcode, length = HEAD.unpack_from(summary, position)
            content = summary[position + HEAD.size : position + HEAD.size + length]
            if len(content) < length:
                raise Damaged("the summary is cut off")
            position += HEAD.size + length
            if opcode == Opcode.SCHEMA:
                schema: Schema = parse(Schema, content)
                self.schemas[schema.id] = schema
            elif opcode == Opcode.CHANNEL:
                channel: Channel = parse(Channel, content)
                self.channels[channel.id] = channel
            elif opcode == Opcode.STATISTICS:
                statistics = parse(Statistics, content)
            elif opcode == Opcode.CHUNK_INDEX:
                self._index(parse(ChunkIndex, content), data_end)
        if statistics is None or (statistics.message_count and (not self.blocks or not self.channels)):
            self._forget()
            return False  # the format allows all of these to be left out; the records themselves tell
        self.counts = Counter(statistics.channel_message_counts)
        if statistics.message_count:
            self.start_ns, self.end_ns = statistics.message_start_time, statistics.message_end_time
        return True

    def _index(self, index: ChunkIndex, data_end: int) -> None:
        if index.chunk_start_offset + index.chunk_length > data_end:
            raise Damaged("a chunk lies behind the data")
        self.blocks.append(
            Block(
                index.chunk_start_offset,
                index.chunk_length,
                index.message_start_time,
                index.message_end_time,
                self._index_counts(index),
            )
        )

    @staticmethod
    def _index_counts(index: ChunkIndex) -> dict[int, int] | None:
        """Messages per channel, from the places of the message indexes, which are 15 bytes and 16 a message."""
        places = sorted((offset, channel) for channel, offset in index.message_index_offsets.items())
        if not places:
            return None
        ends = [offset for offset, _ in places[1:]]
        ends.append(index.chunk_start_offset + index.chunk_length + index.message_index_length)
        return {
            channel: (end - offset - HEAD.size - 6) // 16 for (offset, channel), end in zip(places, ends, strict=True)
        }


class _Scan:
    """Reads the records of a file that has no summary, from the first to the last whole one."""

    def __init__(self, file: McapFile, data: mmap.mmap) -> None:
        self.file = file
        self.data = data
        self.end = len(data)
        self.closed = data[-len(MAGIC) :] == MAGIC and self.end > len(MAGIC)
        self.loose_start: int | None = None

    def run(self) -> None:
        position: int | None = len(MAGIC)
        self.file.sound_end = len(MAGIC)
        while position is not None:
            position = self._record(position)

    def _record(self, position: int) -> int | None:
        """Take in the record at ``position``; the place of the next one, None at the end."""
        data, end = self.data, self.end
        if end - position < HEAD.size:
            self._cut(position)
            return None
        opcode, length = HEAD.unpack_from(data, position)
        stop = int(position + HEAD.size + length)
        if opcode == Opcode.CHUNK:
            self._end_loose(position)
            return self._chunk(position, stop)
        if stop > end:
            if self.closed or self._chunk_after(position) is not None:
                return self._resync(position)
            self._cut(position)
            return None
        if opcode in (Opcode.DATA_END, Opcode.FOOTER):
            if length != (4 if opcode == Opcode.DATA_END else 20):
                return self._resync(position)
            self._end_loose(position)
            if not self.closed:
                self.file._warn(f"cut off in its index at byte {end}; every message is there")
            else:
                self.file._warn("its index is damaged; every record was read instead")
            return None
        try:
            self._small(opcode, position, stop)
        except (*_BROKEN, Damaged):
            return self._resync(position)
        return stop

    def _small(self, opcode: int, position: int, stop: int) -> None:
        """A record that is not a chunk."""
        content = self.data[position + HEAD.size : stop]
        if opcode == Opcode.MESSAGE:
            if len(content) < MESSAGE.size:
                raise Damaged("a message is shorter than its own header")
            if self.loose_start is None:
                self.loose_start = position
            elif position - self.loose_start > _LOOSE_BYTES:
                self._end_loose(position)
                self.loose_start = position
            return
        if opcode == Opcode.SCHEMA:
            schema: Schema = parse(Schema, content)
            self.file.schemas[schema.id] = schema
        elif opcode == Opcode.CHANNEL:
            channel: Channel = parse(Channel, content)
            self.file.channels[channel.id] = channel
        elif opcode == Opcode.MESSAGE_INDEX:
            if len(content) != 6 + struct.unpack_from("<I", content, 2)[0]:
                raise Damaged("a message index has another length")
            if self.file.blocks and self.file.sound_end == position:
                self.file.sound_end = stop
        elif not (opcode in (Opcode.HEADER, Opcode.ATTACHMENT, Opcode.METADATA) or opcode >= 0x80):
            raise Damaged("no such record")
        elif self.file.sound_end == position:
            self.file.sound_end = stop

    def _end_loose(self, position: int) -> None:
        if self.loose_start is None:
            return
        block = Block(self.loose_start, position - self.loose_start, 0, 0, None, chunk=False)
        self.loose_start = None
        self._add(block, _contents(self.data[block.offset : block.offset + block.length]))

    def _add(self, block: Block, content: _Content) -> None:
        file = self.file
        file.schemas.update(content.schemas)
        file.channels.update(content.channels)
        if not content.messages:
            return
        times = [message.log_time_ns for message in content.messages]
        block.start_ns, block.end_ns = min(times), max(times)
        block.counts = dict(Counter(message.channel for message in content.messages))
        file.blocks.append(block)
        file.counts.update({channel: count for channel, count in block.counts.items() if channel in file.channels})

    def _chunk(self, position: int, stop: int) -> int | None:
        """The chunk at ``position``, whose record ends at ``stop`` if its length is right."""
        data, end = self.data, self.end
        start = position + HEAD.size
        by_content = self._end_by_content(start)
        # Either length may be the damaged one: the checksum decides.
        damage = Damaged("it cannot be read")
        for candidate in dict.fromkeys((stop, by_content)):
            if candidate is None or candidate > end:
                continue
            try:
                content = _chunk_contents(data[start:candidate])
            except Damaged as error:
                damage = error
                continue
            except BagError as error:
                raise BagError(f"{self.file.path}: {error}") from None
            sound = candidate == stop
            if self.file.sound_end == position and sound:
                self.file.sound_end = stop
            if not sound:
                # Its own length is wrong: readable here, but nothing to build an ending upon.
                self.file.damaged_at.add(position)
            self._add(Block(position, candidate - position, 0, 0, None), content)
            return candidate
        if stop <= end or (by_content is not None and by_content <= end) or self.closed:
            return self._damaged_chunk(position, stop, damage)
        if self._chunk_after(position):
            return self._damaged_chunk(position, stop, damage)
        content = _cut_chunk_contents(data[start:end])
        before = max((block.end_ns for block in self.file.blocks), default=0)
        self._add(Block(position, end - position, 0, 0, None, cut=True), content)
        missing = ""
        if end - start >= _CHUNK_TIMES.size:
            last = max((message.log_time_ns for message in content.messages), default=before)
            missing = f", {_seconds(max(0, _CHUNK_TIMES.unpack_from(data, start)[1] - last))} of recording"
        self.file._warn(
            f"cut off at byte {end}: {stop - end} bytes of the last chunk are missing{missing};"
            f" {len(content.messages)} message(s) of it are whole"
        )
        return None

    def _end_by_content(self, start: int) -> int | None:
        """The end of the chunk record whose content begins at ``start``, from the lengths inside of it."""
        if self.end - start < 40:
            return None
        (name_length,) = struct.unpack_from("<I", self.data, start + 28)
        if name_length > 4 or self.end - start < 40 + name_length:
            return None
        (size,) = struct.unpack_from("<Q", self.data, start + 32 + name_length)
        return int(start + 40 + name_length + size)

    def _damaged_chunk(self, position: int, stop: int, damage: Exception) -> int | None:
        times = (0, 0)
        if self.end - position >= HEAD.size + _CHUNK_TIMES.size:
            times = _CHUNK_TIMES.unpack_from(self.data, position + HEAD.size)
        self.file._skip(Block(position, stop - position, *times, None), damage)
        # The record's length is believed only if something that looks like a record follows.
        if stop < self.end and 1 <= self.data[stop] <= Opcode.DATA_END:
            return stop
        following = self._chunk_after(position)
        if following is None:
            self._lost(position)
        return following

    def _chunk_after(self, position: int) -> int | None:
        """The next place at which a chunk record of consistent lengths begins."""
        for match in _OTHER_CHUNK.finditer(self.data, position + 1):
            place = match.start()
            _, length = HEAD.unpack_from(self.data, place)
            if self._end_by_content(place + HEAD.size) == place + HEAD.size + length:
                return place
        return None

    def _resync(self, position: int) -> int | None:
        """After a record that cannot be: on to the next chunk."""
        self._end_loose(position)
        following = self._chunk_after(position)
        self.file.damaged_at.add(position)
        if following is None:
            self._lost(position)
            return None
        self.file._warn(f"damaged at byte {position}: {following - position} bytes skipped")
        return following

    def _lost(self, position: int) -> None:
        self.file._warn(f"damaged at byte {position}: the {self.end - position} bytes from there on cannot be read")

    def _cut(self, position: int) -> None:
        self._end_loose(position)
        lost = self.end - position
        self.file._warn(
            f"cut off at byte {self.end}: it was not closed"
            + (f"; the last {lost} byte(s) are no whole record" if lost > 0 else "")
        )
