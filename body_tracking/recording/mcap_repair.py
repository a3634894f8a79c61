"""Rewrites a truncated mcap file with a summary, so that every mcap reader can open it."""

from __future__ import annotations

import os
from contextlib import closing
from pathlib import Path

from mcap.writer import Writer

from body_tracking.recording.mcap_file import LIBRARY, BagError, McapFile


def finish(path: Path) -> None:
    """Replace a truncated file by a complete copy of its readable messages.

    A complete file, or one damaged elsewhere than at its end, is left unchanged.

    Raises:
        BagError: the file cannot be read or written.
    """
    draft = path.with_name(f"{path.name}.tmp")
    with closing(McapFile(path)) as file:
        if file.whole or file.damaged_at:
            return
        try:
            with draft.open("wb") as output:
                _copy(file, Writer(output))
                output.flush()
                os.fsync(output.fileno())
            draft.replace(path)
        except OSError as error:
            draft.unlink(missing_ok=True)
            raise BagError(f"{path}: {error.strerror}") from error


def _copy(file: McapFile, writer: Writer) -> None:
    writer.start(profile="ros2", library=LIBRARY)
    schemas = {key: writer.register_schema(each.name, each.encoding, each.data) for key, each in file.schemas.items()}
    channels = {
        key: writer.register_channel(each.topic, each.message_encoding, schemas.get(each.schema_id, 0), each.metadata)
        for key, each in file.channels.items()
    }
    for block in file.blocks:
        for message in file.read(block):
            number = channels[message.channel]
            writer.add_message(number, message.log_time_ns, message.data, message.publish_time_ns)
    writer.finish()  # type: ignore[no-untyped-call]
