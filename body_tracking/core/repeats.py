"""Sensors whose driver publishes one measurement again and again, with new stamps."""

from __future__ import annotations

from typing import Any, Final

from numpy.typing import NDArray

from body_tracking.core.skeleton import NANOSECONDS

FROZEN_NS: Final = round(0.3 * NANOSECONDS)
"""A measurement that is repeated for longer is no longer used: the noise of a real sensor makes each one differ.
All angles of three simulated people before two Kinects, either of which repeats a frame for 3 s, err by 28 degrees if
the repeated frames are used, and by 22 if not (``ekf`` 28 and 20)."""
REPEATED: Final = "the same {} again and again is not used: restart the sensor's driver"


class Repeats:
    """Detects that a sensor repeats one measurement, as a driver does that has lost its sensor.

    Attributes:
        frozen: whether the last measurement has been repeated for longer than :data:`FROZEN_NS`.
    """

    def __init__(self) -> None:
        self.frozen = False
        self._last = b""
        self._since_ns = 0

    def add(self, stamp_ns: int, *values: NDArray[Any]) -> bool:
        """Take a measurement, and return :attr:`frozen`.

        Args:
            stamp_ns: its time; one before that of the first of equal measurements starts anew.
            values: everything that is measured.
        """
        given = b"".join(each.tobytes() for each in values)
        if given != self._last or stamp_ns < self._since_ns:
            self._last, self._since_ns = given, stamp_ns
        self.frozen = stamp_ns - self._since_ns > FROZEN_NS
        return self.frozen
