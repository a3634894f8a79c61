"""The ending of an mcap file that was cut off: written afterwards, so that every mcap reader opens the file at once."""

from __future__ import annotations

import os
import struct
import zlib
from pathlib import Path
from typing import BinaryIO

import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    MessageIndex,
    Statistics,
    SummaryOffset,
)

from body_tracking.recording.mcap_file import (
    HEAD,
    LIBRARY,
    MAGIC,
    MESSAGE,
    BagError,
    Block,
    McapFile,
    StoredMessage,
    decompress,
    parse,
)


def finish(path: Path) -> bool:
    """Give a file that was cut off its ending.

    The whole chunks stay where they are; the messages of a cut chunk are written anew, and index, counts and footer are
    added. Nothing that could be read before is lost. A file that is whole, or damaged in other ways than by its end, is
    left as it is.

    Returns:
        Whether the file is whole now.

    Raises:
        BagError: the file cannot be read or written.
    """
    file = McapFile(path)
    try:
        if file.whole or file.damaged_at or not all(block.chunk for block in file.blocks):
            return file.whole
        kept = [block for block in file.blocks if not block.cut]
        rescued = [message for block in file.blocks if block.cut for message in file.read(block)]
        with path.open("r+b") as output:
            if file.sound_end <= len(MAGIC):
                # Cut off in its first bytes.
                builder = RecordBuilder()
                Header("ros2", LIBRARY).write(builder)
                output.write(MAGIC + _taken(builder))
            else:
                output.seek(file.sound_end)
            _Ending(file, kept, rescued).write(output)
            output.truncate()
            output.flush()
            os.fsync(output.fileno())
    except OSError as error:
        raise BagError(f"{path}: {error.strerror}") from error
    finally:
        file.close()
    return True


def _taken(builder: RecordBuilder) -> bytes:
    """What was built so far; the builder begins anew."""
    data: bytes = builder.end()  # type: ignore[no-untyped-call]
    return data


class _Ending:
    """What follows the last sound chunk of a file that was cut off: the rescued messages, then the summary."""

    def __init__(self, file: McapFile, kept: list[Block], rescued: list[StoredMessage]) -> None:
        self.file = file
        self.kept = kept
        self.rescued = rescued
        self.indexes: list[ChunkIndex] = []

    def write(self, output: BinaryIO) -> None:
        for block in self.kept:
            self.indexes.append(self._index_of(block))
        if self.kept and not self.indexes[-1].message_index_offsets:
            self._index_again(output, self.indexes[-1])
        if self.rescued:
            self._rescue(output)
        builder = RecordBuilder()
        DataEnd(0).write(builder)
        output.write(_taken(builder))
        self._summary(output)

    def _index_of(self, block: Block) -> ChunkIndex:
        """The index entry of a chunk that is there, with the message indexes that follow it."""
        content = self.file.bytes_at(block.offset, block.length)[HEAD.size :]
        chunk: Chunk = parse(Chunk, content)
        offsets: dict[int, int] = {}
        position = first = block.offset + block.length
        while len(head := self.file.bytes_at(position, HEAD.size + 2)) == HEAD.size + 2:
            opcode, length = HEAD.unpack_from(head)
            if opcode != Opcode.MESSAGE_INDEX or position + HEAD.size + length > self.file.sound_end:
                break
            offsets[struct.unpack_from("<H", head, HEAD.size)[0]] = position
            position += HEAD.size + length
        if set(offsets) != set(block.counts or ()):
            offsets, position = {}, first
        return ChunkIndex(
            chunk_length=block.length,
            chunk_start_offset=block.offset,
            compression=chunk.compression,
            compressed_size=len(chunk.data),
            message_end_time=block.end_ns,
            message_index_length=position - first,
            message_index_offsets=offsets,
            message_start_time=block.start_ns,
            uncompressed_size=chunk.uncompressed_size,
        )

    def _index_again(self, output: BinaryIO, index: ChunkIndex) -> None:
        """The file was cut between its last chunk and the message indexes that belong to it: write these anew."""
        content = self.file.bytes_at(index.chunk_start_offset, index.chunk_length)[HEAD.size :]
        output.seek(index.chunk_start_offset + index.chunk_length)
        self._message_indexes(output, decompress(parse(Chunk, content)), index)

    @staticmethod
    def _message_indexes(output: BinaryIO, records: bytes, index: ChunkIndex) -> None:
        """Write the message indexes of a chunk with these records, and enter their places into its index."""
        entries: dict[int, list[tuple[int, int]]] = {}
        position = 0
        while position < len(records):
            opcode, length = HEAD.unpack_from(records, position)
            if opcode == Opcode.MESSAGE:
                channel, _, log_time, _ = MESSAGE.unpack_from(records, position + HEAD.size)
                entries.setdefault(channel, []).append((log_time, position))
            position += HEAD.size + length
        builder, start = RecordBuilder(), output.tell()
        for channel, places in entries.items():
            index.message_index_offsets[channel] = start + builder.count
            MessageIndex(channel, places).write(builder)
        index.message_index_length = builder.count
        output.write(_taken(builder))

    def _rescue(self, output: BinaryIO) -> None:
        """The messages of the cut chunk as a chunk of their own."""
        builder = RecordBuilder()
        for record in (*self.file.schemas.values(), *self.file.channels.values()):
            record.write(builder)
        for message in self.rescued:
            builder.write(HEAD.pack(Opcode.MESSAGE, MESSAGE.size + len(message.data)))
            builder.write(MESSAGE.pack(message.channel, 0, message.log_time_ns, message.publish_time_ns))
            builder.write(message.data)
        records = _taken(builder)
        times = [message.log_time_ns for message in self.rescued]
        chunk = Chunk(
            compression="zstd",
            data=zstandard.compress(records),
            message_end_time=max(times),
            message_start_time=min(times),
            uncompressed_crc=zlib.crc32(records),
            uncompressed_size=len(records),
        )
        start = output.tell()
        chunk.write(builder)
        output.write(_taken(builder))
        index = ChunkIndex(
            chunk_length=output.tell() - start,
            chunk_start_offset=start,
            compression="zstd",
            compressed_size=len(chunk.data),
            message_end_time=max(times),
            message_index_length=0,
            message_index_offsets={},
            message_start_time=min(times),
            uncompressed_size=len(records),
        )
        self._message_indexes(output, records, index)
        self.indexes.append(index)

    def _summary(self, output: BinaryIO) -> None:
        file, start = self.file, output.tell()
        builder = RecordBuilder()
        groups: list[SummaryOffset] = []
        statistics = Statistics(
            attachment_count=0,
            channel_count=len(file.channels),
            channel_message_counts=dict(file.counts),
            chunk_count=len(self.indexes),
            message_count=file.message_count,
            message_end_time=file.end_ns,
            message_start_time=file.start_ns,
            metadata_count=0,
            schema_count=len(file.schemas),
        )
        kinds: tuple[tuple[Opcode, list[McapRecord]], ...] = (
            (Opcode.SCHEMA, list(file.schemas.values())),
            (Opcode.CHANNEL, list(file.channels.values())),
            (Opcode.STATISTICS, [statistics]),
            (Opcode.CHUNK_INDEX, list(self.indexes)),
        )
        for opcode, records in kinds:
            first = builder.count
            for record in records:
                record.write(builder)
            if records:
                groups.append(SummaryOffset(opcode, start + first, builder.count - first))
        offsets_start = start + builder.count
        for group in groups:
            group.write(builder)
        summary = _taken(builder)
        Footer(start, offsets_start, 0).write(builder)
        footer = _taken(builder)
        Footer(start, offsets_start, zlib.crc32(footer[:-4], zlib.crc32(summary))).write(builder)
        output.write(summary + _taken(builder) + MAGIC)
