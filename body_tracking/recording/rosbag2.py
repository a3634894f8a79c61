"""Bags: folders of mcap files with a ``metadata.yaml``, as ``ros2 bag`` (Jazzy) reads and writes them.

Messages are CDR bytes; :func:`serialize` and :func:`deserialize` convert them. Layout: https://github.com/ros2/rosbag2
(metadata version 9) and the ``ros2`` profile of https://mcap.dev/spec/registry. All times are integer nanoseconds.

Over 500 lines: reader, writer and metadata of one format, which must agree.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import re
import time
from bisect import bisect_left
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from functools import cache
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, Self

from mcap.writer import Writer
from rosbags.interfaces import Nodetype

from body_tracking.core import qos as quality
from body_tracking.core.files import FileError, FileLimitError, dump_yaml, load_yaml, open_regular, read_text
from body_tracking.core.qos import Qos
from body_tracking.messages.base import BagMessages
from body_tracking.recording.mcap_file import LIBRARY, McapFile
from body_tracking.recording.mcap_file import BagError as BagError
from body_tracking.recording.mcap_repair import finish

METADATA = "metadata.yaml"
MAX_WAITING_BYTES = 1 << 28
"""Limit of the memory for messages of chunks that overlap in time, bytes."""
_MESSAGE_BYTES = 250
"""Approximate memory of a waiting message without its content."""
METADATA_VERSION = 9
ROS_DISTRO = "jazzy"
MAX_TIME_NS = 2**63 - 1


@cache
def _store() -> Any:
    """The message definitions of ROS 2 Jazzy, imported when first used: that takes a quarter of a second."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_JAZZY)


BAG_MESSAGES = BagMessages(lambda type_name: _store().types[type_name])
"""The message classes of recordings: ``BAG_MESSAGES.make("std_msgs/msg/String", data="")``."""


def is_known(type_name: str) -> bool:
    """Whether there is a definition of a message type, such as ``sensor_msgs/msg/PointCloud2``."""
    return type_name in _store().types


def first_field(type_name: str) -> tuple[str, str, bool]:
    """Name and message type of the first field of a message type, and whether it is a sequence of these.

    The type is empty for a number, a string, and an unknown message type.
    """
    fields: list[Any] = list(_store().fielddefs[type_name][1]) if is_known(type_name) else []
    if not fields:
        return "", "", False
    name, (node, what) = fields[0]
    sequence = node in (Nodetype.ARRAY, Nodetype.SEQUENCE)
    inner, kind = what[0] if sequence else (node, what)
    return str(name), str(kind) if inner == Nodetype.NAME else "", sequence


def serialize(message: Any) -> bytes:
    """A message of :data:`BAG_MESSAGES` as CDR bytes, little-endian, with the encapsulation header.

    Raises:
        BagError: a field's value does not fit its type.
    """
    try:
        return bytes(_store().serialize_cdr(message, message.__msgtype__))
    except Exception as error:
        raise BagError(f"{type(message).__name__} cannot be serialised: {error}") from error


def deserialize(type_name: str, cdr: bytes) -> Any:
    """The message in CDR bytes; its arrays are views of them.

    Raises:
        BagError: an unknown type, or bytes that are no such message.
    """
    if not is_known(type_name):
        raise BagError(f"message type {type_name!r} is unknown")
    # The client library leaves room for the alignment of each empty sequence of doubles, and anything in it: a joint
    # state without efforts, or without velocities and efforts, is longer than its content.
    for room in (0, 4, 8):
        try:
            return _store().deserialize_cdr(cdr[: len(cdr) - room], type_name)
        except Exception as error:
            if room == 0:
                first = error
    raise BagError(f"{len(cdr)} bytes are no {type_name}: {first}") from first


class BagWire:
    """Serialisation by ``rosbags``, without ROS."""

    types = BAG_MESSAGES

    def serialize(self, type_name: str, message: Any) -> bytes:
        return serialize(message)

    def deserialize(self, type_name: str, cdr: bytes) -> Any:
        return deserialize(type_name, cdr)


BAG_WIRE = BagWire()


@dataclass(frozen=True, slots=True)
class TopicInfo:
    """A topic of a bag.

    Attributes:
        type_name: such as ``sensor_msgs/msg/PointCloud2``.
        count: of messages.
        offered: QoS of each of its publishers.
    """

    type_name: str
    count: int
    offered: tuple[Qos, ...] = ()

    @property
    def qos(self) -> Qos:
        """QoS to publish it again."""
        return quality.offer_for(self.offered)


class RawMessage(NamedTuple):
    """A recorded message.

    Attributes:
        topic: its name.
        cdr: the serialised message.
        log_time_ns: time of receipt.
        publish_time_ns: time of publication, if the recorder knew it.
    """

    topic: str
    cdr: bytes
    log_time_ns: int
    publish_time_ns: int


# --- reading


class UnsupportedBagError(BagError):
    """Raised for a bag of another storage than mcap, or with rosbag2's own compression."""


class BagReader:
    """Reads a bag: a folder, also without its ``metadata.yaml``, or a single mcap file.

    Damaged or missing parts are lines in :attr:`warnings`, not exceptions. A damaged chunk is only noticed when it is
    read.

    Args:
        path: the folder or file.

    Raises:
        BagError: no readable recording.
    """

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        self.files: list[McapFile] = []
        self._notes: list[str] = []
        try:
            for path in self._paths():
                try:
                    self.files.append(McapFile(path))
                except BagError as error:
                    if path == self.path:
                        raise
                    self._notes.append(str(error))
            if not self.files:
                raise BagError(self._notes[-1] if _files(self.path) else _no_file_in(self.path))
        except BaseException:
            self.close()
            raise
        self.topics: dict[str, TopicInfo] = self._topics()
        recorded = [file for file in self.files if file.message_count]
        self.start_ns: int = min((file.start_ns for file in recorded), default=0)
        self.end_ns: int = max((file.end_ns for file in recorded), default=0)
        self.message_count: int = sum(file.message_count for file in self.files)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, value: object, traceback: TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        for file in self.files:
            file.close()

    @property
    def warnings(self) -> list[str]:
        """Missing or damaged parts found so far, a line each."""
        return self._notes + [warning for file in self.files for warning in file.warnings]

    @property
    def whole(self) -> bool:
        """Whether every file was closed properly."""
        return not self._notes and all(file.whole for file in self.files)

    def messages(self, topics: Collection[str] | None = None, start_ns: int | None = None) -> Iterator[RawMessage]:
        """The messages in the order of their log times; with equal log times in the order of writing.

        Args:
            topics: only these; None for all.
            start_ns: only those received at this time or later.
        """
        wanted = [
            {
                number: channel.topic
                for number, channel in file.channels.items()
                if channel.message_encoding == "cdr" and (topics is None or channel.topic in topics)
            }
            for file in self.files
        ]
        blocks = sorted(
            (block.start_ns, index, block.offset, block)
            for index, file in enumerate(self.files)
            for block in file.blocks
            if (start_ns is None or block.end_ns >= start_ns)
            and (block.channels is None or not block.channels.isdisjoint(wanted[index]))
        )
        # Blocks overlap in time if messages were written late: messages wait until all earlier blocks are read.
        waiting: list[tuple[int, int, int, int, RawMessage]] = []
        for begin_ns, index, offset, block in blocks:
            ready = bisect_left(waiting, (begin_ns,))
            yield from [each[-1] for each in waiting[:ready]]
            del waiting[:ready]
            if sum(len(each[-1].cdr) + _MESSAGE_BYTES for each in waiting) > MAX_WAITING_BYTES:
                raise BagError(f"{self.path}: more than {MAX_WAITING_BYTES >> 20} MB of chunks are of one time")
            names = wanted[index]
            waiting += [
                (at_ns, index, offset, number, RawMessage(names[channel], cdr, at_ns, sent_ns))
                for number, (channel, at_ns, sent_ns, cdr) in enumerate(self.files[index].read(block))
                if channel in names and (start_ns is None or at_ns >= start_ns)
            ]
            waiting.sort()
        yield from [each[-1] for each in waiting]

    def _paths(self) -> list[Path]:
        if not self.path.exists():
            raise BagError(f"{self.path}: no such recording{_similar(self.path)}")
        if not self.path.is_dir():
            return [self.path]
        found = _files(self.path)
        listed = self._listed()
        if listed is None:
            return found
        missing = [path for path in listed if not path.exists()]
        self._notes += [f"{path.name}: listed in {METADATA}, but missing" for path in missing]
        # A recorder that resumed in the same folder and crashed leaves a file that is not listed yet.
        further = [path for path in found if path not in listed and (missing or _is_part(self.path, path))]
        self._notes += [f"{path.name}: not listed in {METADATA}: the recording was not closed" for path in further]
        return [path for path in listed if path not in missing] + further

    def _listed(self) -> list[Path] | None:
        """The files listed in ``metadata.yaml``; None if it is missing or unreadable."""
        if not (self.path / METADATA).exists():
            self._notes.append(f"{self.path.name}: {METADATA} is missing: the recording was not closed")
            return None
        listed = _listed_in(self.path)
        if listed is None:
            self._notes.append(f"{METADATA}: damaged; the mcap files were read without it")
        return listed

    def _topics(self) -> dict[str, TopicInfo]:
        topics: dict[str, TopicInfo] = {}
        for file in self.files:
            for number, channel in sorted(file.channels.items()):
                name, schema = channel.topic, file.schemas.get(channel.schema_id)
                if channel.message_encoding != "cdr" or schema is None:
                    self._notes.append(
                        f"{file.path.name}: topic {name} has encoding {channel.message_encoding!r}"
                        f" and {'no' if schema is None else 'a'} schema; skipped"
                    )
                    continue
                if name in topics and topics[name].type_name != schema.name:
                    self._notes.append(f"{name}: recorded as {topics[name].type_name} and as {schema.name}")
                offered = quality.load(channel.metadata.get("offered_qos_profiles", ""))
                _add(topics, name, TopicInfo(schema.name, file.counts[number], offered))
        return dict(sorted(topics.items()))


def _add(topics: dict[str, TopicInfo], name: str, more: TopicInfo) -> None:
    """Add messages and publishers of a topic, which keeps its first type."""
    known = topics.get(name, TopicInfo(more.type_name, 0))
    offered = tuple(dict.fromkeys(known.offered + more.offered))
    topics[name] = TopicInfo(known.type_name, known.count + more.count, offered)


def _listed_in(folder: Path) -> list[Path] | None:
    """The files listed in a folder's ``metadata.yaml``; None if it is damaged.

    Raises:
        UnsupportedBagError: another storage than mcap, or rosbag2's own compression.
        BagError: no regular file, or larger than a limit.
    """
    path = folder / METADATA
    if not path.is_file():
        raise BagError(f"{path}: not a regular file")
    try:
        information = load_yaml(read_text(path))["rosbag2_bagfile_information"]
        storage = information["storage_identifier"]
        compression = str(information.get("compression_mode") or "none").lower()
        names = [Path(str(name)).name for name in information["relative_file_paths"]]
    except FileLimitError as error:
        raise BagError(f"{path}: {error}") from error
    except (FileError, KeyError, TypeError, AttributeError):
        return None
    if storage != "mcap" and not any(name.endswith(".mcap") for name in names):
        raise UnsupportedBagError(f"{folder}: storage {storage!r} is not supported, only mcap")
    if compression != "none":
        text = f"rosbag2 compression mode {compression!r} is not supported, only mcap's own"
        raise UnsupportedBagError(f"{folder}: {text}")
    return [folder / name for name in names]


def _refuse_unsupported(folder: Path) -> None:
    """Reject an unsupported bag: its storage is stated only in ``metadata.yaml``, which would be overwritten."""
    try:
        _listed_in(folder)
    except UnsupportedBagError:
        raise
    except BagError:
        pass  # missing, or not rosbag2's


def _natural(path: Path) -> tuple[str, int]:
    """Sort key with ``name_10`` after ``name_9``."""
    match = re.fullmatch(r"(.*?)_?(\d+)", path.stem)
    return (match[1], int(match[2])) if match else (path.stem, -1)


def _similar(path: Path) -> str:
    """A hint to a recording with a similar name, beside the path or in a folder ``bags``; empty where there is none."""
    files = [each for folder in (path.parent, path.parent / "bags") for each in folder.glob("*/*.mcap")]
    known = {each.parent.name: each.parent for each in files}
    similar = get_close_matches(path.name, known, n=1, cutoff=0.7)
    return f"; did you mean '{known[similar[0]]}'?" if similar else ""


def _files(folder: Path) -> list[Path]:
    return sorted(folder.glob("*.mcap"), key=_natural)


def _is_part(folder: Path, path: Path) -> bool:
    return re.fullmatch(re.escape(folder.name) + r"_\d+", path.stem) is not None


# --- writing


class _Sink:
    """An unbuffered file for the mcap writer, so that its position is exact after a failed write."""

    def __init__(self, path: Path) -> None:
        self.file = path.open("xb", buffering=0)

    def tell(self) -> int:
        return self.file.tell()

    def write(self, data: bytes) -> None:
        view = memoryview(data)
        while view:
            view = view[self.file.write(view) :]

    def flush(self) -> None:
        """Required by the mcap writer."""


def check_new_bag(folder: Path, *, overwrite: bool) -> None:
    """Refuse the folder of a bag to be written, if it cannot be made or must not be replaced.

    Raises:
        BagError: it exists and ``overwrite`` is false, or it is no bag.
    """
    if not folder.exists():
        return
    if not folder.is_dir():
        raise BagError(f"{folder}: exists and is no folder")
    if not _files(folder) and not (folder / METADATA).exists():
        raise BagError(f"{folder}: exists and is no bag")
    if not overwrite:
        raise BagError(f"{folder}: exists already; --overwrite replaces it")


class BagWriter:
    """Writes a bag.

    Each write closes the chunk and syncs it to the disk if the last sync was ``flush_interval_s`` ago, so that a power
    failure loses about that much; a caller without messages calls :meth:`flush`. After a failure (disk full) the file
    ends with its last whole chunk. The writer of ``rosbags`` has no checksums, and its files are unreadable before they
    are closed.

    Args:
        folder: of the bag; its files are called ``<folder>_<n>.mcap``.
        overwrite: replace an existing bag.
        resume: continue an existing bag in a new file; unclosed files are closed as well.
        chunk_bytes: a chunk is closed at this size, uncompressed.
        flush_interval_s: seconds; infinite for writing offline.

    Attributes:
        path: of the current file.
        message_count: messages written by this writer.
        failure: the error that ended writing; None for none.

    Raises:
        BagError: the folder exists and neither ``overwrite`` nor ``resume`` is given, is no bag, is being written by
            another process, or cannot be written.
    """

    def __init__(
        self,
        folder: Path | str,
        *,
        overwrite: bool = False,
        resume: bool = False,
        chunk_bytes: int = 768 * 1024,
        flush_interval_s: float = 1.0,
    ) -> None:
        self.folder = Path(folder).absolute()
        self.failure: BagError | None = None
        self._channels: dict[str, tuple[int, str]] = {}  # and type
        self._schemas: dict[str, int] = {}
        self.message_count = 0
        self._interval_s = flush_interval_s
        self._flushed_s = time.monotonic()
        self._open = False
        try:
            number = self._prepare(overwrite, resume)
            self.path = self.folder / f"{self.folder.name}_{number}.mcap"
            self._sink = _Sink(self.path)
            fcntl.flock(self._sink.file.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB)
            self._mcap = Writer(self._sink, chunk_size=chunk_bytes)  # type: ignore[arg-type]
            self._mcap.start(profile="ros2", library=LIBRARY)
        except OSError as error:
            raise BagError(f"{self.folder}: {error.strerror}") from error
        self._sound = self._sink.tell()
        self._open = True

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, value: object, traceback: TracebackType | None) -> None:
        """Close the bag; after an exception or Ctrl-C discard it."""
        if kind is None:
            self.close()
        else:
            self.discard()

    def add_topic(self, topic: str, type_name: str, qos: Qos | Sequence[Qos] = quality.RELIABLE) -> None:
        """Add a topic; repeated calls with the same type have no effect.

        Args:
            topic: its name.
            type_name: such as ``sensor_msgs/msg/PointCloud2``.
            qos: of its publisher, or of each of its publishers.

        Raises:
            BagError: an unknown type, or another one than before, or the bag cannot be written.
        """
        self._check()
        if topic in self._channels:
            known = self._channels[topic][1]
            if known != type_name:
                raise BagError(f"{topic}: is recorded as {known}, not as {type_name}")
            return
        if not is_known(type_name):
            raise BagError(f"{topic}: message type {type_name!r} is unknown (no definition of it is at hand)")
        offered = quality.dump((qos,) if isinstance(qos, Qos) else qos)
        metadata = {"offered_qos_profiles": offered, "topic_type_hash": _type_hash(type_name)}
        with self._writing():
            if type_name not in self._schemas:
                definition, _ = _store().generate_msgdef(type_name, ros_version=2)
                self._schemas[type_name] = self._mcap.register_schema(type_name, "ros2msg", definition.encode())
            number = self._mcap.register_channel(topic, "cdr", self._schemas[type_name], metadata)
        self._channels[topic] = number, type_name

    def write(self, topic: str, cdr: bytes, log_time_ns: int, publish_time_ns: int | None = None) -> None:
        """Write one message.

        Args:
            topic: as added.
            cdr: the serialised message.
            log_time_ns: time of receipt.
            publish_time_ns: time of publication; that of receipt if unknown.

        Raises:
            BagError: the topic was not added, a time is negative, or the bag cannot be written.
        """
        self._check()
        if topic not in self._channels:
            raise BagError(f"{topic}: was not added to the bag")
        sent_ns = log_time_ns if publish_time_ns is None else publish_time_ns
        if not (0 <= log_time_ns <= MAX_TIME_NS and 0 <= sent_ns <= MAX_TIME_NS):
            raise BagError(f"{topic}: a bag cannot hold the time {min(log_time_ns, sent_ns)} ns")
        with self._writing():
            self._mcap.add_message(self._channels[topic][0], log_time_ns, cdr, sent_ns)
        self.message_count += 1
        if time.monotonic() - self._flushed_s >= self._interval_s:
            self.flush()

    def write_message(self, topic: str, message: Any, log_time_ns: int) -> None:
        """Serialise and write one message of :data:`BAG_MESSAGES`."""
        self.write(topic, serialize(message), log_time_ns)

    def flush(self) -> None:
        """Close the chunk and sync the file to the disk.

        Raises:
            BagError: it cannot be written.
        """
        self._check()
        with self._writing():
            self._mcap.flush()  # type: ignore[no-untyped-call]
            os.fdatasync(self._sink.file.fileno())
            if not os.fstat(self._sink.file.fileno()).st_nlink:
                raise FileNotFoundError(errno.ENOENT, "the file was deleted")
        self._flushed_s = time.monotonic()

    def close(self) -> None:
        """Finish the file and write ``metadata.yaml``; repeated calls have no effect.

        Raises:
            BagError: it cannot be written.
        """
        if not self._open:
            return
        self.flush()
        with self._writing():
            self._mcap.finish()  # type: ignore[no-untyped-call]
            os.fdatasync(self._sink.file.fileno())
        self._shut()
        _close_folder(self.folder)

    def discard(self) -> None:
        """Stop, and delete this writer's file, and the folder if it is empty."""
        self._shut()
        remove_file(self.path)

    def _prepare(self, overwrite: bool, resume: bool) -> int:
        """Prepare the folder; returns the number of the file to write."""
        if not self.folder.exists() or (resume and self.folder.is_dir() and not any(self.folder.iterdir())):
            self.folder.mkdir(parents=True, exist_ok=True)
            return 0
        check_new_bag(self.folder, overwrite=overwrite or resume)
        parts = _files(self.folder)
        for path in parts:
            _refuse_if_in_use(path)
        if resume and not overwrite:
            _refuse_unsupported(self.folder)
        # The list of files is outdated from here on; readers find the files without it.
        (self.folder / METADATA).unlink(missing_ok=True)
        if overwrite:
            for path in parts:
                path.unlink()
            return 0
        return 1 + max((_natural(path)[1] for path in parts if _is_part(self.folder, path)), default=-1)

    def _check(self) -> None:
        if self.failure is not None:
            raise self.failure
        if not self._open:
            raise BagError(f"{self.folder}: the bag is closed")

    @contextlib.contextmanager
    def _writing(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            with contextlib.suppress(OSError):
                self._sink.file.truncate(self._sound)
            self.failure = BagError(f"{self.path}: {error.strerror}")
            self._shut()
            raise self.failure from error
        self._sound = self._sink.tell()

    def _shut(self) -> None:
        if self._open:
            self._open = False
            self._sink.file.close()


def remove_file(path: Path) -> None:
    """Delete a file of a bag, and the folder if it is empty."""
    with contextlib.suppress(OSError):
        path.unlink(missing_ok=True)
        path.parent.rmdir()


def _no_file_in(folder: Path) -> str:
    """Why a folder without mcap files is no recording; it may hold recordings."""
    inner = sorted(each.name for each in folder.iterdir() if each.is_dir() and any(each.glob("*.mcap")))
    hint = f"; give one of the recordings in it: {', '.join(inner)}" if inner else ""
    return f"{folder}: no mcap file is in the folder{hint}"


def recover(folder: Path | str) -> BagReader:
    """Close the bag of a crashed recorder: complete its files and write ``metadata.yaml``, without losing messages.

    Returns:
        A reader of the closed bag.

    Raises:
        BagError: it is no bag or one that is not supported, it is still being recorded, or it cannot be written.
    """
    folder = Path(folder)
    _refuse_unsupported(folder)
    paths = _files(folder)
    if not paths:
        reason = "not a folder" if folder.exists() else "no such folder"
        raise BagError(f"{folder}: {'no mcap file is in the folder' if folder.is_dir() else reason}")
    try:
        for path in paths:
            _refuse_if_in_use(path)
    except OSError as error:
        raise BagError(f"{folder}: {error.strerror}") from error
    _close_folder(folder)
    return BagReader(folder)


def _refuse_if_in_use(path: Path) -> None:
    """Raise if another process writes the file: a writer locks it while its process lives."""
    with open_regular(path) as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise BagError(f"{path}: is being recorded by another process") from error


# --- metadata


def _close_folder(folder: Path) -> None:
    """Complete unclosed files as far as they are readable, and list the files in ``metadata.yaml``.

    Raises:
        BagError: no file is readable, or the folder cannot be written.
    """
    parts: list[BagReader] = []
    for path in _files(folder):
        with contextlib.suppress(BagError):
            finish(path)
        with contextlib.suppress(BagError), BagReader(path) as reader:
            parts.append(reader)
    if not parts:
        raise BagError(f"{folder}: none of its mcap files can be read")
    draft = folder / f"{METADATA}.tmp"
    try:
        with draft.open("w", encoding="utf-8") as file:
            file.write(dump_yaml({"rosbag2_bagfile_information": _information(parts)}))
            file.flush()
            os.fsync(file.fileno())
        draft.replace(folder / METADATA)  # atomic
    except OSError as error:
        raise BagError(f"{folder / METADATA}: {error.strerror}") from error


def _type_hash(type_name: str) -> str:
    return _store().hash_rihs01(type_name) if is_known(type_name) else ""


def _information(parts: Sequence[BagReader]) -> dict[str, Any]:
    """The content of ``metadata.yaml`` for these files; without messages the start is ``MAX_TIME_NS``."""
    topics: dict[str, TopicInfo] = {}
    for part in parts:
        for name, topic in part.topics.items():
            _add(topics, name, topic)

    def summary(files: Sequence[BagReader]) -> dict[str, Any]:
        spans = [(file.start_ns, file.end_ns) for file in files if file.message_count] or [(MAX_TIME_NS, MAX_TIME_NS)]
        start_ns = min(start for start, _ in spans)
        return {
            "starting_time": {"nanoseconds_since_epoch": start_ns},
            "duration": {"nanoseconds": max(end for _, end in spans) - start_ns},
            "message_count": sum(file.message_count for file in files),
        }

    return {
        "version": METADATA_VERSION,
        "storage_identifier": "mcap",
        **summary(parts),
        "topics_with_message_count": [
            {
                "topic_metadata": {
                    "name": name,
                    "type": topic.type_name,
                    "serialization_format": "cdr",
                    "offered_qos_profiles": quality.to_yaml(topic.offered),
                    "type_description_hash": _type_hash(topic.type_name),
                },
                "message_count": topic.count,
            }
            for name, topic in topics.items()
        ],
        "compression_format": "",
        "compression_mode": "",
        "relative_file_paths": [part.path.name for part in parts],
        "files": [{"path": part.path.name, **summary([part])} for part in parts],
        "custom_data": None,
        "ros_distro": ROS_DISTRO,
    }
