"""ROS domains of tests."""

from __future__ import annotations

import itertools
import os
import random
from functools import cache


@cache
def _in_turn() -> itertools.cycle[int]:
    """This worker's, in an order of its own: none comes again before all others were there."""
    workers = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    worker = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
    own = range(1 + worker, 101, workers)
    return itertools.cycle(random.sample(own, len(own)))


def domain() -> int:
    """From 1 to 100; what runs at the same time, in this worker or in others, has none in common."""
    return next(_in_turn())
