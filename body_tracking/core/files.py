"""Files: untrusted ones are read only if regular, YAML only within limits of size, nesting and aliases; writing."""

from __future__ import annotations

import errno
import os
import re
import stat
from pathlib import Path
from typing import Any, BinaryIO

import yaml

from body_tracking.core.errors import BodyTrackingError

MAX_BYTES = 4 << 20
"""Bytes of a YAML file; our largest, the metadata of a recording in a thousand files, has half of that."""
MAX_DEPTH = 40
"""Levels of nested lists and mappings; a parameters file has about five."""
MAX_NODES = 50_000
"""Values, lists and mappings, with every alias expanded; they take a second to read."""
MAX_NUMBER = 100
"""Characters of a number."""

SafeLoader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
"""libyaml's loader, ten times as fast, where PyYAML was built with it."""

_SafeDumper: Any = getattr(yaml, "CSafeDumper", yaml.SafeDumper)

_OPENING = (yaml.SequenceStartEvent, yaml.MappingStartEvent)
_CLOSING = (yaml.SequenceEndEvent, yaml.MappingEndEvent)
_NUMERIC = frozenset("+-.0123456789")


class FileError(BodyTrackingError):
    """A file cannot be read, or has another format; the text does not name the file."""


class OutputError(BodyTrackingError):
    """A file that a command is to write exists already."""


class FileLimitError(FileError):
    """A file exceeds a limit: of size, nesting, aliases or digits."""


def user_cache() -> Path:
    """The package's folder in the user's cache (XDG base directories)."""
    return Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser() / "body_tracking"


def open_regular(path: Path) -> BinaryIO:
    """Open a file for reading; never a FIFO or a device, whose reader may block forever.

    Raises:
        OSError: it cannot be opened, or is no regular file.
    """
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        mode = os.fstat(descriptor).st_mode
        if not stat.S_ISREG(mode):
            number = errno.EISDIR if stat.S_ISDIR(mode) else errno.EINVAL
            raise OSError(number, os.strerror(number) if stat.S_ISDIR(mode) else "Not a regular file", str(path))
        return os.fdopen(descriptor, "rb")
    except BaseException:
        os.close(descriptor)
        raise


def read_text(path: Path) -> str:
    """A text file in UTF-8.

    Raises:
        FileError: it cannot be read, is no regular file, or no text.
        FileLimitError: it is larger than :data:`MAX_BYTES`.
    """
    try:
        with open_regular(path) as file:
            data = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise FileError(f"cannot be read ({error.strerror or error})") from error
    if len(data) > MAX_BYTES:
        raise FileLimitError(f"cannot be read (more than {MAX_BYTES >> 20} MB)")
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError as error:
        raise FileError(f"cannot be read ({error})") from error


def write_text(path: Path, text: str, error: type[BodyTrackingError] | None = None) -> None:
    """Write a text file, as a whole or not at all; its folder is made.

    Raises:
        FileError: it cannot be written; or an ``error`` that names the file.
    """
    partial = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        partial.write_text(text, encoding="utf-8")
        partial.replace(path)
    except OSError as reason:
        # mkdir says that a file exists where a folder of the path should be
        number = errno.ENOTDIR if isinstance(reason, FileExistsError) else reason.errno
        said = f"cannot be written ({os.strerror(number or 0)})"
        raise FileError(said) if error is None else error(f"{path}: {said}") from reason


def natural(name: str) -> tuple[list[str | int], str]:
    """Sort key of a file name with its numbers as numbers: ``10.png`` after ``9.png``."""
    return [int(part) if k % 2 else part for k, part in enumerate(re.split(r"([0-9]+)", name))], name


def check_new(path: Path, *, overwrite: bool) -> None:
    """Refuse a command's output that exists already, before its content is computed.

    Raises:
        OutputError: the file exists and ``overwrite`` is false, or it is a folder.
    """
    if path.is_dir():
        raise OutputError(f"{path}: is a folder")
    if path.exists() and not overwrite:
        raise OutputError(f"{path}: exists already; --overwrite replaces it")


def dump_yaml(content: Any, **layout: Any) -> str:
    """``yaml.safe_dump`` in the given order; by libyaml where PyYAML was built with it, which is ten times as fast.

    Args:
        content: numbers, texts, lists and mappings.
        layout: ``width`` and ``default_flow_style`` of PyYAML.
    """
    text: str = yaml.dump(content, Dumper=_SafeDumper, sort_keys=False, **layout)
    return text


def load_yaml(text: str, loader: Any = SafeLoader, *, aliases: bool = True) -> Any:
    """The content of a YAML text.

    The limits are checked on the events, before any object is built of them.

    Args:
        text: untrusted.
        loader: a safe one.
        aliases: whether they are allowed.

    Raises:
        FileError: it is not YAML.
        FileLimitError: too long, too deep, too many values by aliases, a number of too many digits.
    """
    if len(text) > MAX_BYTES:
        raise FileLimitError(f"is not read (more than {MAX_BYTES >> 20} MB)")
    try:
        _check(text, loader, aliases)
        return yaml.load(text, loader)
    except BodyTrackingError:
        raise
    except yaml.MarkedYAMLError as error:
        if "nesting depth" in str(error):  # libyaml's own limit (1000), reached before it emits the first event
            raise FileLimitError(f"is not read (nested deeper than {MAX_DEPTH})") from error
        said = " ".join(str(error).split()).replace(' in "<unicode string>",', " in")
        raise FileError(f"is not YAML ({said})") from error
    except Exception as error:  # constructors of numbers and times raise errors of their own
        raise FileError(f"is not YAML ({' '.join(str(error).split()) or type(error).__name__})") from error


def read_yaml(
    path: Path, loader: Any = SafeLoader, *, aliases: bool = True, error: type[BodyTrackingError] | None = None
) -> Any:
    """The content of a YAML file.

    Raises:
        FileError: as :func:`read_text` and :func:`load_yaml`; or an ``error`` that names the file.
    """
    try:
        return load_yaml(read_text(path), loader, aliases=aliases)
    except FileError as reason:
        if error is None:
            raise
        raise error(f"{path}: {reason}") from reason


def _check(text: str, loader: Any, aliases: bool) -> None:
    """Refuse nesting, aliases and numbers beyond the limits (:class:`FileLimitError`)."""
    nodes = 0
    sizes: dict[str, int] = {}  # nodes by anchor
    open_at: list[tuple[str | None, int]] = []  # anchors of open collections, and the nodes before each
    for event in yaml.parse(text, loader):
        mark: Any = event.start_mark
        where = f"in line {mark.line + 1}"
        if isinstance(event, yaml.AliasEvent):
            if not aliases:
                raise FileLimitError(f"is not read (an alias {where})")
            if event.anchor not in sizes:
                raise FileLimitError(f"is not read (an alias of its own container, or of no anchor, {where})")
            nodes += sizes[event.anchor]
        elif isinstance(event, _OPENING):
            open_at.append((event.anchor, nodes))
            nodes += 1
            if len(open_at) > MAX_DEPTH:
                raise FileLimitError(f"is not read (nested deeper than {MAX_DEPTH} {where})")
        elif isinstance(event, _CLOSING):
            anchor, before = open_at.pop()
            if anchor is not None:
                sizes[anchor] = nodes - before
        elif isinstance(event, yaml.ScalarEvent):
            nodes += 1
            if event.anchor is not None:
                sizes[event.anchor] = 1
            long = len(event.value) > MAX_NUMBER
            if long and ((event.implicit[0] and event.value[0] in _NUMERIC) or event.tag in _NUMBER_TAGS):
                raise FileLimitError(f"is not read (a number of {len(event.value)} characters {where})")
        if nodes > MAX_NODES:
            raise FileLimitError(f"is not read (more than {MAX_NODES} values {where})")


_NUMBER_TAGS = ("tag:yaml.org,2002:int", "tag:yaml.org,2002:float", "tag:yaml.org,2002:timestamp")
