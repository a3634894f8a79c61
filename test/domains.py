"""ROS domains of tests."""

from __future__ import annotations

import itertools
import os
import random
from functools import cache


@cache
def _in_turn() -> itertools.cycle[int]:
    """The domains of this worker, in an order of its own; each is used again only after all others."""
    workers = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    worker = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
    own = range(1 + worker, 101, workers)
    return itertools.cycle(random.sample(own, len(own)))


def domain() -> int:
    """A domain from 1 to 100, different from those of all tests that run at the same time, in any worker."""
    return next(_in_turn())
