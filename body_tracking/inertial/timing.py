"""From the clocks of worn sensors to the one in which everything comes out.

That is the camera's, or that of receipt where there is none. The times of receipt tell what a clock is off to within
what transports differ by; motion tells that difference, beside a camera. Where the camera's own frames are heard, they
tell of its clock, and its skeletons do not: those come later by what was made of them meanwhile, which is another time
in every run.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from body_tracking.core.clocks import ReceiptClock, jumped_back
from body_tracking.core.skeleton import NANOSECONDS
from body_tracking.inertial.parameters import REFERENCE, SHARED

_TRANSPORTS, _TRANSPORTS_WALK, _OFFSET_FLOOR = 0.03, 0.001, 0.003
"""Seconds by which transports differ, per root second by which that changes, and that motion tells at best."""


@dataclass(slots=True)
class _Transport:
    """Seconds by which a sensor's stamps come later than by the times of receipt, and how sure that is."""

    offset: float = 0.0
    variance: float = _TRANSPORTS**2
    stamp: float = 0.0
    found: bool = False

    def correct(self, stamp: float, offset: float, stddev: float) -> None:
        """By what motion tells (a scalar Kalman filter)."""
        self.variance += _TRANSPORTS_WALK**2 * max(0.0, stamp - self.stamp)
        gain = self.variance / (self.variance + stddev**2 + _OFFSET_FLOOR**2)
        self.offset += gain * (offset - self.offset)
        self.variance *= 1.0 - gain
        self.stamp, self.found = stamp, True


class SensorClocks:
    """How far the clocks of several sensors are off.

    Args:
        kind: of :class:`~body_tracking.inertial.parameters.TrackingParameters`: whose clocks they are.
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
        """Whether anything is known of a camera's clock."""
        return self._frame_ns is not None or self._camera.delay_ns is not None

    @property
    def found(self) -> dict[str, float]:
        """Seconds, of the sensors of which motion has told something: by how much later they are than by receipt."""
        return {name: each.offset for name, each in self._transports.items() if each.found}

    def take(self, stamp_ns: int, received_ns: int) -> None:
        """Note a reading, of whichever sensor; each notes its own clock besides."""
        if self._kind == SHARED:
            self._all.add(stamp_ns, received_ns)

    def hear(self, stamp_ns: int, received_ns: int) -> bool:
        """Note a frame of the camera itself; whether another clock counts from now on."""
        before, self._frame_ns = self._frame_ns, stamp_ns
        if before is None or jumped_back(stamp_ns, before):
            self._camera.reset()
        known = self._camera.delay_ns is not None
        return not self._camera.add(stamp_ns, received_ns) or not known

    def see(self, stamp_ns: int, received_ns: int, jumped: bool) -> bool:
        """Note a skeleton of the camera, whose time has jumped or not; whether it has, or its clock was set."""
        if self._frame_ns is not None:
            return jumped
        if jumped:
            self._camera.reset()
        return not self._camera.add(stamp_ns, received_ns) or jumped

    def offset_ns(self, sensor: str, own: ReceiptClock) -> int:
        """Nanoseconds to add to a sensor's stamps.

        Args:
            sensor: its name.
            own: its clock, that has been told of a reading.
        """
        if self._kind == REFERENCE:
            return 0
        delay, camera = (self._all if self._kind == SHARED else own).delay_ns, self._camera.delay_ns
        assert delay is not None
        return delay - (0 if camera is None else camera) - round(self._transport(sensor).offset * NANOSECONDS)

    def correct(self, sensor: str, stamp: float, offset: float, stddev: float) -> None:
        """Take what motion tells.

        Args:
            sensor: its name.
            stamp: seconds, when.
            offset: seconds by which its stamps still are too late after :meth:`offset_ns`.
            stddev: seconds, of that.
        """
        transport = self._transport(sensor)
        transport.correct(stamp, transport.offset + offset, stddev)

    def _transport(self, sensor: str) -> _Transport:
        return self._transports[self._first if self._kind == SHARED else sensor]
