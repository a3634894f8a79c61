"""Number of random seeds, or of recordings, in a test: a few in ``make test``, all in ``make test-all``."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import TypeVar

ALL = os.environ.get("TEST_DRAWS") == "all"

Item = TypeVar("Item")


def draws(few: int, many: int) -> int:
    """The number of seeds of a test whose bound holds for both numbers."""
    return many if ALL else few


def some(items: Sequence[Item], count: int = 1) -> Sequence[Item]:
    """``count`` items of a list, evenly spread; all of them in ``make test-all``."""
    return items if ALL else items[:: max(1, len(items) // count)][:count]
