"""Files of whatever origin: opened only where they are regular ones, YAML read only as far as it harms nobody."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path
from typing import Any, BinaryIO

import yaml

from body_tracking.core.errors import BodyTrackingError

MAX_BYTES = 4 << 20
"""Bytes of a YAML file; the largest that anybody of us writes, of a recording in a thousand files, has half of that."""
MAX_DEPTH = 40
"""Lists and mappings in each other; a parameters file has about five."""
MAX_NODES = 50_000
"""Values, lists and mappings, each alias counted as what it stands for; they take a second to read."""
MAX_NUMBER = 100
"""Characters of a number."""

SafeLoader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
"""libyaml's, where PyYAML was built with it: ten times as fast."""

_OPENING = (yaml.SequenceStartEvent, yaml.MappingStartEvent)
_CLOSING = (yaml.SequenceEndEvent, yaml.MappingEndEvent)
_NUMERIC = frozenset("+-.0123456789")


class FileError(BodyTrackingError):
    """A file cannot be read as what it should be; the text does not name it."""


class FileLimitError(FileError):
    """A file asks for more than any honest one does: size, nesting, aliases, digits."""


def open_regular(path: Path) -> BinaryIO:
    """Open a file for reading; never a FIFO or a device, for which a reader waits without end.

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


def read_text(path: Path, limit: int = MAX_BYTES) -> str:
    """A text file in UTF-8.

    Raises:
        FileError: it cannot be read, is no regular file, or no text.
        FileLimitError: it is larger than the limit, bytes.
    """
    try:
        with open_regular(path) as file:
            data = file.read(limit + 1)
    except OSError as error:
        raise FileError(f"cannot be read ({error.strerror or error})") from error
    if len(data) > limit:
        raise FileLimitError(f"cannot be read (more than {limit >> 20} MB)")
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError as error:
        raise FileError(f"cannot be read ({error})") from error


def load_yaml(text: str, loader: Any = SafeLoader, *, aliases: bool = True) -> Any:
    """The content of a YAML text.

    Its events are looked at first, which takes no more memory than the text: what is built of them is then small.

    Args:
        text: of whatever origin.
        loader: a safe one.
        aliases: whether there may be any.

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
    except Exception as error:  # a number or time that is none raises whatever its constructor raises
        raise FileError(f"is not YAML ({' '.join(str(error).split()) or type(error).__name__})") from error


def read_yaml(path: Path, loader: Any = SafeLoader, *, aliases: bool = True) -> Any:
    """The content of a YAML file.

    Raises:
        FileError: as :func:`read_text` and :func:`load_yaml`.
    """
    return load_yaml(read_text(path), loader, aliases=aliases)


def _check(text: str, loader: Any, aliases: bool) -> None:
    """Refuse nesting, aliases and numbers beyond the limits.

    Raises:
        FileLimitError: one of them.
    """
    nodes = 0
    sizes: dict[str, int] = {}  # of what has an anchor
    open_at: list[tuple[str | None, int]] = []  # anchors of what is open, and the nodes before
    for event in yaml.parse(text, loader):
        mark: Any = event.start_mark
        where = f"in line {mark.line + 1}"
        if isinstance(event, yaml.AliasEvent):
            if not aliases:
                raise FileLimitError(f"is not read (an alias {where})")
            if event.anchor not in sizes:
                raise FileLimitError(f"is not read (an alias of what it stands in, or of nothing, {where})")
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
