"""A file that was cut off, written anew with an ending, so that every mcap reader opens it at once."""

from __future__ import annotations

import os
from contextlib import closing
from pathlib import Path

from mcap.writer import Writer

from body_tracking.recording.mcap_file import LIBRARY, BagError, McapFile


def finish(path: Path) -> None:
    """Give a file that was cut off its ending: what can be read of it is copied, and the copy takes its place.

    A file that is whole, or damaged in other ways than by its end, is left as it is.

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
