"""ROS domains of tests."""

from __future__ import annotations

import os
import random


def domain() -> int:
    """One at random, from 1 to 100; tests that run at the same time in several workers have none in common."""
    workers = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    worker = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
    return 1 + worker + workers * random.randrange((100 - worker - 1) // workers + 1)
