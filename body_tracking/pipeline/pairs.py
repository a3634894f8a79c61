"""Two messages of one stamp, such as angles and their standard deviations, that arrive one after the other."""

from __future__ import annotations

from typing import Any


class Pairs:
    """Joins the two parts of each stamp, in either order of arrival.

    Args:
        most: stamps that may wait for their second part.

    Attributes:
        unpaired: parts that were dropped without their counterpart.
    """

    def __init__(self, most: int) -> None:
        self.unpaired = 0
        self._most = most
        self._waiting: dict[int, dict[str, Any]] = {}

    def add(self, stamp_ns: int, part: str, value: Any) -> dict[str, Any] | None:
        """Take a part; returns both by name once they are there, and drops those that came before them."""
        found = self._waiting.setdefault(stamp_ns, {})
        found[part] = value
        if len(found) == 2:
            while (oldest := next(iter(self._waiting))) != stamp_ns:
                self._drop(oldest)
            return self._waiting.pop(stamp_ns)
        if len(self._waiting) > self._most:
            self._drop(next(iter(self._waiting)))
        return None

    def clear(self) -> None:
        """Forget what waits."""
        self._waiting.clear()

    def _drop(self, stamp_ns: int) -> None:
        del self._waiting[stamp_ns]
        self.unpaired += 1
