"""A percentage on stderr, if that is a terminal."""

from __future__ import annotations

import sys


class Progress:
    """Shows the progress of a value from a start to an end.

    Args:
        start: first value, in any unit.
        end: in the same unit.
    """

    def __init__(self, start: float, end: float) -> None:
        self._start, self._length = start, (end - start) or 1
        self._shown = -1
        self._on = sys.stderr.isatty()

    def at(self, value: float) -> None:
        """Update the percentage."""
        percent = min(100, int(100 * (value - self._start) / self._length)) if self._on else -1
        if percent != self._shown:
            self._shown = percent
            print(f"\r{percent:3d} %", end="", file=sys.stderr, flush=True)

    def end(self) -> None:
        """Clear the line."""
        if self._shown >= 0:
            print("\r     \r", end="", file=sys.stderr, flush=True)
