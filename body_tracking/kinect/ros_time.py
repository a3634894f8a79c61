"""Converts a driver's stamps to ROS time."""

from __future__ import annotations

from typing import Final

from body_tracking.core.skeleton import NANOSECONDS
from body_tracking.kinect.remote_clock import CaptureClock

OTHER_CLOCK_NS: Final = 60 * NANOSECONDS
"""Stamps farther from the time of receipt are of another clock: delays and errors of synchronisation are smaller."""


class RosTime:
    """ROS time of the messages of one driver, in order of receipt.

    Drivers should stamp in ROS time (REP-145 requires it of inertial sensors). Any other clock is related to the times
    of receipt by the least delay so far, see :class:`CaptureClock`.
    """

    def __init__(self) -> None:
        self._clock = CaptureClock()

    def stamp(self, stamp_ns: int, received_ns: int) -> int:
        """Capture time of a message in ROS time, nanoseconds.

        Args:
            stamp_ns: its header stamp.
            received_ns: ROS time of its receipt; 0 before simulated time has begun, which leaves the stamp unchanged.
        """
        if not received_ns or abs(received_ns - stamp_ns) <= OTHER_CLOCK_NS:
            return stamp_ns
        return self._clock.stamp(stamp_ns, received_ns, 0)
