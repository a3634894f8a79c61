"""Conversion of worn sensors' clocks to the output clock: the camera's, or without a camera that of receipt.

Times of receipt give the offset of a clock up to the difference of the transports' delays; with a camera, motion gives
this difference. The camera's own frames are used for its clock where they arrive. Its fused skeletons come later by the
processing time, which differs from run to run.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from body_tracking.core.clocks import ReceiptClock, jumped_back
from body_tracking.core.skeleton import NANOSECONDS
from body_tracking.inertial.parameters import REFERENCE, SHARED

_TRANSPORTS, _TRANSPORTS_WALK, _OFFSET_FLOOR = 0.03, 0.001, 0.003
"""Standard deviations of the transports' difference (seconds), of its random walk (seconds per root second), and that
added in quadrature to an offset by motion (seconds)."""


@dataclass(slots=True)
class _Transport:
    """Seconds by which a sensor's stamps are still late after correction by the times of receipt, and the variance."""

    offset: float = 0.0
    variance: float = _TRANSPORTS**2
    stamp: float = 0.0
    found: bool = False

    def correct(self, stamp: float, offset: float, stddev: float) -> None:
        """Update by an offset from motion (a scalar Kalman filter)."""
        self.variance += _TRANSPORTS_WALK**2 * max(0.0, stamp - self.stamp)
        gain = self.variance / (self.variance + stddev**2 + _OFFSET_FLOOR**2)
        self.offset += gain * (offset - self.offset)
        self.variance *= 1.0 - gain
        self.stamp, self.found = stamp, True


class SensorClocks:
    """Offsets of the clocks of several sensors.

    Args:
        kind: of :class:`~body_tracking.inertial.parameters.TrackingParameters`: ``own``, ``shared`` or ``reference``.
        sensors: their names.
    """

    def __init__(self, kind: str, sensors: Sequence[str]) -> None:
        self._kind, self._first = kind, sensors[0]
        self._all = ReceiptClock()
        self._camera = ReceiptClock()
        self._frame_ns: int | None = None
        self._transports = {name: _Transport() for name in sensors}

    @property
    def camera_known(self) -> bool:
        """Whether the offset of a camera's clock is known."""
        return self._frame_ns is not None or self._camera.delay_ns is not None

    @property
    def found(self) -> dict[str, float]:
        """Seconds from the stamp expected by the times of receipt to the estimated one, for sensors corrected by
        motion.
        """
        return {name: each.offset for name, each in self._transports.items() if each.found}

    def take_reading(self, stamp_ns: int, received_ns: int) -> None:
        """Take the times of a reading of any sensor; each sensor also has its own :class:`ReceiptClock`."""
        if self._kind == SHARED:
            self._all.add(stamp_ns, received_ns)

    def take_camera_frame(self, stamp_ns: int, received_ns: int) -> bool:
        """Take the times of a frame of the camera itself; True if the output clock changes."""
        before, self._frame_ns = self._frame_ns, stamp_ns
        if before is None or jumped_back(stamp_ns, before):
            self._camera.reset()
        known = self._camera.delay_ns is not None
        return not self._camera.add(stamp_ns, received_ns) or not known

    def take_skeleton(self, stamp_ns: int, received_ns: int, jumped: bool) -> bool:
        """Take the times of a camera's skeleton; True if its time has jumped or its clock was set."""
        if self._frame_ns is not None:
            return jumped
        if jumped:
            self._camera.reset()
        return not self._camera.add(stamp_ns, received_ns) or jumped

    def offset_ns(self, sensor: str, own: ReceiptClock) -> int:
        """Nanoseconds to add to a sensor's stamps.

        Args:
            sensor: its name.
            own: its clock, with at least one reading.
        """
        if self._kind == REFERENCE:
            return 0
        delay, camera = (self._all if self._kind == SHARED else own).delay_ns, self._camera.delay_ns
        assert delay is not None
        return delay - (0 if camera is None else camera) - round(self._transport(sensor).offset * NANOSECONDS)

    def correct(self, sensor: str, stamp: float, offset: float, stddev: float) -> None:
        """Take an offset by motion.

        Args:
            sensor: its name.
            stamp: seconds, time of the measurement.
            offset: seconds by which its stamps are still late after :meth:`offset_ns`.
            stddev: seconds, of the offset.
        """
        transport = self._transport(sensor)
        transport.correct(stamp, transport.offset + offset, stddev)

    def _transport(self, sensor: str) -> _Transport:
        return self._transports[self._first if self._kind == SHARED else sensor]
