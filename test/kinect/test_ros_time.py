"""A driver's stamps come out in ROS time, whatever clock it stamps by."""

from __future__ import annotations

import numpy as np
import pytest

from body_tracking.core.skeleton import NANOSECONDS
from body_tracking.kinect.ros_time import RosTime

NOW_NS = 1_750_000_000 * NANOSECONDS
LEAST_NS = 4_000_000


@pytest.mark.parametrize("wrong_s", [-59.0, 0.0, 30.0])
def test_stamps_within_a_minute_of_receipt_are_unchanged(wrong_s: float) -> None:
    stamp_ns = NOW_NS + round(wrong_s * NANOSECONDS)
    assert RosTime().stamp(stamp_ns, NOW_NS) == stamp_ns


@pytest.mark.parametrize("start_s", [0.5, 40.0, 1e6])
def test_a_clock_of_its_own_is_related_to_receipt_by_the_least_delay(start_s: float) -> None:
    time, rng = RosTime(), np.random.default_rng(0)
    captured = np.arange(900) * (NANOSECONDS // 30)
    delays = LEAST_NS + rng.exponential(3e6, len(captured)).astype(np.int64)
    found = [
        time.stamp(round(start_s * NANOSECONDS) + at, NOW_NS + at + delay)
        for at, delay in zip(captured.tolist(), delays.tolist(), strict=True)
    ]
    assert (np.diff(found) > 0).all()
    late = np.array(found) - NOW_NS - captured - LEAST_NS
    assert (np.abs(late[300:]) < 1_000_000).all()  # the first ones come before a quick one is known


def test_before_simulated_time_has_begun_nothing_is_related() -> None:
    time = RosTime()
    assert time.stamp(40 * NANOSECONDS, 0) == 40 * NANOSECONDS
    assert time.stamp(41 * NANOSECONDS, NOW_NS) == NOW_NS
