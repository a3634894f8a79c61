"""The clock by which angles are stamped, against ROS time."""

from __future__ import annotations

from body_tracking.clocks import LeastDelay
from body_tracking.skeleton import NANOSECONDS

AUTO_CLOCK, ROS_CLOCK, SENSOR_CLOCK = "auto", "ros", "sensor"

_YEAR_NS = 365 * 86_400 * NANOSECONDS
"""A stamp below this is a count from a start, such as a Kinect's; a time of day is more."""

_DRIFT = 5e-4
"""Seconds per second by which a sensor's clock and ROS time may drift apart: crystals by 1e-4, NTP slews by 5e-4."""

ANOTHER_CLOCK_NS = 10 * NANOSECONDS
"""Stamps of one clock do not jump forward by more than this."""


class StampClock:
    """Decides once by which clock stamps are, and then says how old they are.

    ``ROS_CLOCK``: stamps are ROS time. ``SENSOR_CLOCK``: stamps are by a clock of the sensor's own. Its offset from ROS
    time is taken from the quickest message, because transport only adds to it; later it may rise with the clocks'
    drift and no faster, so that messages which all come late are late. ``AUTO_CLOCK``: the first stamp decides. It is a
    sensor's where it counts from a start (less than a year) and ROS time is a time of day, and else ROS time, however
    old.

    Args:
        kind: one of the three.
        delay: seconds from capture to here of the quickest message, with a sensor's clock.

    Attributes:
        kind: as given, until the first stamp has decided.
    """

    def __init__(self, kind: str, delay: float) -> None:
        self._given, self._delay_ns = kind, round(delay * NANOSECONDS)
        self.reset()

    def reset(self) -> None:
        """Decide anew."""
        self.kind = self._given
        self._offset = LeastDelay(rise=_DRIFT)
        self._noted_ns = 0

    def note(self, stamp_ns: int, now_ns: int, steady_ns: int) -> None:
        """Take note of a message's stamp at its receipt, in ROS time and by a steady clock; nanoseconds."""
        if self.kind == AUTO_CLOCK:
            if now_ns <= 0:  # simulated time has not begun
                return
            self.kind = SENSOR_CLOCK if stamp_ns < _YEAR_NS <= now_ns else ROS_CLOCK
        if self.kind == ROS_CLOCK:
            return
        offset_ns = now_ns - stamp_ns
        if not self._offset or offset_ns > self._offset.at(steady_ns) - ANOTHER_CLOCK_NS:  # else it is another clock's
            self._offset.add(steady_ns, offset_ns)
        self._noted_ns = steady_ns

    def age_ns(self, stamp_ns: int, now_ns: int) -> int:
        """How long ago a stamp was, nanoseconds; negative in the future."""
        age_ns = now_ns - stamp_ns
        return age_ns - self._offset.at(self._noted_ns) + self._delay_ns if self._offset else age_ns
