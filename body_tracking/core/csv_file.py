"""``.csv`` and ``.csv.gz`` files line by line; errors state the line's number."""

from __future__ import annotations

import csv
import gzip
import os
import zlib
from collections.abc import Iterator
from decimal import Decimal, InvalidOperation
from io import TextIOWrapper
from pathlib import Path
from typing import BinaryIO, cast

from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.files import open_regular
from body_tracking.core.skeleton import NANOSECONDS

_MAX_SECONDS = 2**31  # builtin_interfaces/Time counts seconds in 32 bits


class CsvError(BodyTrackingError):
    """A file of separated values does not have its format; the text names file and line."""


class CsvFile:
    """Lines and cells of a file; the suffix ``.gz`` means gzip.

    Attributes:
        progress: share of the file that has been read, 0 to 1.
        cut: how the file is truncated, known once its last line was read; empty where it is whole.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.progress = 0.0
        self.cut = ""

    def error(self, line: int, text: str) -> CsvError:
        """The error of a line, counted from 1."""
        return CsvError(f"{self.path}, line {line}: {text}")

    def lines(self) -> Iterator[str]:
        """All lines with their ends.

        Raises:
            CsvError: the file cannot be read, its gzip stream is damaged, or it is not UTF-8 text.
        """
        number = 1
        try:
            with open_regular(self.path) as raw:
                size = max(1, os.fstat(raw.fileno()).st_size)
                source = cast(BinaryIO, gzip.GzipFile(fileobj=raw)) if self.path.suffix == ".gz" else raw
                # the text is decoded a block ahead of its lines: an error must name the line that is not UTF-8
                with TextIOWrapper(source, encoding="utf-8-sig", errors="surrogateescape") as text:
                    for line in text:
                        line.encode()
                        number += 1
                        self.progress = min(1.0, raw.tell() / size)
                        yield line
        except EOFError:
            self.cut = "the gzip stream is cut off"
        except (gzip.BadGzipFile, zlib.error) as error:
            raise self.error(number, f"the gzip stream is damaged ({error})") from error
        except UnicodeEncodeError as error:
            raise self.error(number, "not UTF-8 text") from error
        except OSError as error:
            raise CsvError(f"{self.path}: {error.strerror or error}") from error

    def rows(self, first: int, lines: list[str], separator: str = ",") -> list[list[str]]:
        """The cells of each line; ``first`` is the number of the first one. None for an empty line."""
        reader = csv.reader(lines, delimiter=separator, strict=True)
        rows: list[list[str]] = []
        fault = "a quoted cell goes on over several lines"
        try:
            for row in reader:
                if reader.line_num > len(rows) + 1:
                    break
                rows.append(row)
        except csv.Error as error:
            if reader.line_num == len(rows) + 1:
                fault = str(error)
        if len(rows) < len(lines):
            raise self.error(first + len(rows), fault)
        return rows

    def check_separator(self, header: list[str]) -> None:
        """Reject a header of one cell that holds another separator than the comma.

        Raises:
            CsvError: the cells are separated by semicolons or tabs.
        """
        if len(header) == 1 and (separator := next((each for each in ";\t" if each in header[0]), None)):
            raise self.error(1, f"cells are separated by {separator!r}, expected ','")

    def time_ns(self, line: int, text: str, name: str) -> int:
        """Seconds as text to nanoseconds, exactly: a double would round stamps since 1970."""
        try:
            seconds = Decimal(text.strip())
        except InvalidOperation:
            raise self.error(line, f"{name}: {text!r} is not a number") from None
        if not seconds.is_finite() or not 0 <= seconds < _MAX_SECONDS:
            raise self.error(line, f"{name}: {text!r} is not a time in seconds")
        return int((seconds * NANOSECONDS).to_integral_value())

    def check_whole(self, rows: int, partial: bool) -> list[str]:
        """A warning where the file is truncated; none where it is whole.

        Args:
            rows: number of complete rows.
            partial: whether to accept a truncated file.

        Raises:
            CsvError: the file is truncated and ``partial`` is not set, or it has no rows.
        """
        text = f"{self.path}: {self.cut}; {rows} row(s) before that are whole"
        if not self.cut and not rows:
            raise CsvError(f"{self.path}: no rows follow the header")
        if self.cut and not partial:
            raise CsvError(f"{text} (--partial reads these)")
        return [text] if self.cut else []
