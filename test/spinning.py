"""Waiting, while an executor handles callbacks."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any


def spin_until(executor: Any, condition: Callable[[], object], timeout: float) -> bool:
    """Spin an executor until a condition holds.

    Args:
        executor: of rclpy.
        condition: to be asked between callbacks.
        timeout: seconds.

    Returns:
        Whether the condition came to hold in time.
    """
    end = time.monotonic() + timeout
    while not condition():
        if time.monotonic() > end:
            return False
        executor.spin_once(timeout_sec=0.05)
    return True
