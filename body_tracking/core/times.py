"""Times are integer nanoseconds."""

from __future__ import annotations

from typing import Final

NANOSECONDS: Final = 1_000_000_000
"""Nanoseconds per second."""

MAX_STAMP_NS: Final = 2**31 * NANOSECONDS - 1
"""The last stamp that a ROS message can hold (``builtin_interfaces/Time``, January 2038); the first one is 0."""
