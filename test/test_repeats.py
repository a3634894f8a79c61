"""Measurements that a driver repeats."""

from __future__ import annotations

import numpy as np

from body_tracking.core.repeats import FROZEN_NS, Repeats
from body_tracking.core.skeleton import NANOSECONDS


def test_equal_measurements_are_frozen_after_a_while_and_any_other_one_ends_it() -> None:
    repeats, values = Repeats(), np.array([1.0, np.nan, 3.0])
    step = NANOSECONDS // 50
    for k in range(50):
        assert repeats.add(k * step, values, np.arange(3)) == (k * step > FROZEN_NS)
    assert not repeats.add(50 * step, np.nextafter(values, 2.0), np.arange(3))
    assert not repeats.add(51 * step, values, np.arange(3))


def test_time_that_runs_backwards_starts_anew() -> None:
    repeats, values = Repeats(), np.zeros(3)
    assert [repeats.add(NANOSECONDS * time, values) for time in (5, 6, 1, 2)] == [False, True, False, True]
