"""One worn inertial sensor: its orientation, its clock by receipt, and its problems.

Without a magnetometer the heading variance that a driver or VQF states grows without bound. A filter of headings must
not count the growth twice, so it is passed on once, apart from the covariance.
"""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from body_tracking.core import so3
from body_tracking.core.clocks import ReceiptClock
from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.imu import ImuSample, ImuWatch
from body_tracking.core.repeats import Repeats
from body_tracking.core.skeleton import NANOSECONDS, FloatArray
from body_tracking.inertial.imu_orientation import OUTAGE_S, OrientationEstimator

HISTORY_S: Final = 40.0
"""Seconds of readings in the history."""
NEAR_NS: Final = NANOSECONDS // 20
"""Time over which an orientation is extrapolated by its rate."""
UNKNOWN_HEADING: Final = np.pi**2 / 3.0
"""rad2: variance of a heading that is uniform over a turn."""
_OTHER_FRAME = 50
"""Readings of another frame in a row after which that frame is accepted."""
_SPACING_NS = NANOSECONDS // 55
"""Least time between readings in the history: 50 per second are enough."""
_STATED: Final = np.diag([0.03, 0.03, 0.1]) ** 2
"""rad2: covariance for a driver that states none."""
_FIELDS = 100
"""Number of readings for the strength of the undisturbed field."""
_FIELD_S = 0.5
"""Seconds of the low-pass of the field's strength."""
_DISTURBED = 0.15
"""Share of its strength by which a low-passed field differs when it is disturbed."""
_ELSEWHERE_S = 60.0
"""Seconds after which a different field is taken as that of another place."""
_TURNED, _TURNED_S = float(np.radians(60.0)) ** 2, 10.0
"""rad2 added to the heading of a driver that follows a disturbed field, and the time constant of this in seconds."""


class WornSensorError(BodyTrackingError):
    """Raised when a reading has another frame than the sensor."""


@dataclass(frozen=True, slots=True, eq=False)
class OrientedReading:
    """Orientation and rate of a sensor at one instant.

    Attributes:
        stamp_ns: in the sensor's clock.
        rotation: (3, 3) sensor to earth (z up, a heading of its own).
        covariance: (3, 3) rad2 about the earth's axes; for the heading, the bounded part.
        rate: (3,) rad/s in the sensor's frame.
        rate_measured: False if the rate is the difference of two orientations, or zero.
    """

    stamp_ns: int
    rotation: FloatArray
    covariance: FloatArray
    rate: FloatArray
    rate_measured: bool = True


class WornSensor:
    """Takes the readings of one sensor.

    A driver's orientation is used as it is. Raw readings are ignored while oriented ones arrive; otherwise VQF
    estimates the orientation.

    Args:
        segment: stated segment of the sensor.
        magnetometer: use the magnetic field.

    Attributes:
        stated: stated segment.
        segment: current segment; changes when sensors are found to be exchanged.
        clock: its clock by receipt.
        latest: the last reading; None before the first one.
        growth: rad2 of heading variance since the caller last reset it to zero.
        has_field: whether readings have a magnetic field that is used.
        counters: event counts.
        received_ns: receipt of the last reading; None before the first one.
    """

    def __init__(self, segment: str, *, magnetometer: bool = True) -> None:
        self.stated = self.segment = segment
        self.clock = ReceiptClock()
        self.counters: Counter[str] = Counter()
        self.received_ns: int | None = None
        self._magnetometer = magnetometer
        self._watch = ImuWatch()
        self._frame: str | None = None
        self._strange = 0
        self._begin()

    def _begin(self) -> None:
        self._estimator = OrientationEstimator(magnetometer=self._magnetometer)
        self._kept: deque[OrientedReading] = deque()
        self.latest: OrientedReading | None = None
        self.growth = 0.0
        self._level: float | None = None
        self._stated = 0.0
        self._oriented_ns: int | None = None
        self._field: float | None = None
        self._fields: list[float] = []
        self._usual = 1.0
        self._off_s = 0.0
        self._turned = 0.0
        self.has_field = False
        self._field_known = False
        self._repeats = Repeats()
        self.clock.reset()

    @property
    def frozen(self) -> bool:
        """Whether its driver repeats one reading, which is not used."""
        return self._repeats.frozen

    @property
    def problems(self) -> tuple[str, ...]:
        """Problems found in the readings."""
        return self._watch.problems

    @property
    def disturbed(self) -> bool:
        """Whether the magnetic field differs from the one that the heading refers to."""
        # VQF takes ten seconds and more to accept an undisturbed field
        by_vqf = self._oriented_ns is None and self._field_known and bool(self._estimator.magnetically_disturbed)
        return by_vqf or self._off_field() > _DISTURBED

    def reset(self) -> None:
        """Forget all readings, after a jump of time."""
        self._begin()
        self._watch = ImuWatch()
        self._frame, self._strange = None, 0
        self.received_ns = None

    def take(self, sample: ImuSample, received_ns: int) -> OrientedReading | None:
        """The orientation at a reading; None for an unusable reading, and while the estimator starts.

        Raises:
            WornSensorError: another frame than before, until many readings in a row have it.
            ImuOrientationError: neither orientation nor rate and acceleration.
        """
        self._check_frame(sample.frame_id)
        self.counters["readings"] += 1
        if self._is_frozen(sample, received_ns):
            return None
        if sample.orientation is None and self._oriented_ns is not None:
            if sample.stamp_ns - self._oriented_ns < OUTAGE_S * NANOSECONDS:
                return None
            self._oriented_ns = None
        self._receive(sample, received_ns)
        latest = self.latest
        if latest is not None and sample.stamp_ns <= latest.stamp_ns:
            if latest.stamp_ns - sample.stamp_ns < OUTAGE_S * NANOSECONDS:
                self.counters["late or repeated"] += 1
                return None
            self.counters["clock set back"] += 1
            refers_to_north = sample.orientation is not None and self.has_field
            self._begin()
            self.clock.add(sample.stamp_ns, received_ns)
            self.growth = 0.0 if refers_to_north else UNKNOWN_HEADING
        self._check_field(sample)
        reading = self._given(sample) if sample.orientation is not None else self._estimated(sample)
        for problem in self._watch.add(sample):
            self.counters[problem.partition(":")[0]] += 1
        if reading is None:
            return None
        self._count_growth(reading)
        covariance = reading.covariance
        if not self.has_field:
            assert self._level is not None
            # scales the covariances of heading and tilt with it
            scale = np.array([1.0, 1.0, np.sqrt(self._level / max(float(covariance[2, 2]), 1e-12))])
            covariance = covariance * np.outer(scale, scale)
        elif self._turned:
            covariance = covariance + np.diag([0.0, 0.0, self._turned])
        self.latest = reading = replace(reading, covariance=covariance)
        if not self._kept or reading.stamp_ns - self._kept[-1].stamp_ns >= _SPACING_NS:
            self._kept.append(reading)
            while reading.stamp_ns - self._kept[0].stamp_ns > HISTORY_S * NANOSECONDS:
                self._kept.popleft()
        return reading

    def history(self, since_ns: int) -> list[OrientedReading]:
        """Readings since a stamp of the sensor's clock, about 50 per second."""
        return [reading for reading in self._kept if reading.stamp_ns >= since_ns]

    def at(self, stamp_ns: int) -> FloatArray | None:
        """(3, 3) sensor to earth at a stamp of its clock, extrapolated from the nearest reading; None far from any."""
        nearest = self.latest
        if nearest is None:
            return None
        for reading in reversed(self._kept):
            if abs(reading.stamp_ns - stamp_ns) < abs(nearest.stamp_ns - stamp_ns):
                nearest = reading
            if reading.stamp_ns < stamp_ns:
                break
        elapsed_ns = stamp_ns - nearest.stamp_ns
        if abs(elapsed_ns) > NEAR_NS:
            return None
        turned: FloatArray = nearest.rotation @ so3.quat_to_matrix(so3.exp(nearest.rate * (elapsed_ns / NANOSECONDS)))
        return turned

    # --- one reading

    def _check_frame(self, frame: str) -> None:
        if frame == self._frame:
            self._strange = 0
            return
        self._strange += 1
        if self._frame is not None and self._strange < _OTHER_FRAME:
            raise WornSensorError(f"{self.segment}: a reading of frame {frame!r}, expected {self._frame!r}")
        if self._frame is not None:
            self.counters["frame changes"] += 1
            self._watch = ImuWatch()
            self._begin()
            self.growth = UNKNOWN_HEADING
        self._frame, self._strange = frame, 0

    def _is_frozen(self, sample: ImuSample, received_ns: int) -> bool:
        """Whether a driver has repeated one reading for a while, as no worn sensor does; it then counts as silent."""
        rate, force = sample.angular_velocity, sample.acceleration
        if rate is None or force is None:
            return False
        given = (rate, force) if sample.orientation is None else (rate, force, sample.orientation)
        return self._repeats.add(received_ns, *given)

    def _receive(self, sample: ImuSample, received_ns: int) -> None:
        """Update the clock, and count outages."""
        if not self.clock.add(sample.stamp_ns, received_ns):
            self.counters["clock set"] += 1
            self._kept.clear()
        if self.received_ns is not None and received_ns - self.received_ns > OUTAGE_S * NANOSECONDS:
            self.counters["outages"] += 1
            if sample.orientation is not None and not self.has_field:
                self.growth += UNKNOWN_HEADING  # a restarted driver has another heading
        self.received_ns = received_ns

    def _given(self, sample: ImuSample) -> OrientedReading:
        assert sample.orientation is not None
        self._oriented_ns = sample.stamp_ns
        covariance = _STATED if sample.orientation_covariance is None else sample.orientation_covariance
        rotation = so3.quat_to_matrix(sample.orientation)
        rate = sample.angular_velocity
        if rate is None:
            rate = np.zeros(3)
            if self.latest is not None:
                elapsed = (sample.stamp_ns - self.latest.stamp_ns) / NANOSECONDS
                if elapsed < OUTAGE_S:
                    rate = so3.rotation_vectors(self.latest.rotation.T @ rotation) / elapsed
        return OrientedReading(sample.stamp_ns, rotation, covariance, rate, sample.angular_velocity is not None)

    def _estimated(self, sample: ImuSample) -> OrientedReading | None:
        if self._off_field() > _DISTURBED:
            # before VQF knows the undisturbed field, it would accept this one as the reference
            sample = replace(sample, magnetic_field=None)
        found = self._estimator.update(sample)
        if found is None:
            return None
        self._field_known |= self._estimator.magnetically_disturbed is False
        return OrientedReading(
            found.stamp_ns, so3.quat_to_matrix(found.orientation), found.covariance, found.angular_velocity
        )

    def _count_growth(self, reading: OrientedReading) -> None:
        stated = float(reading.covariance[2, 2])
        if self._level is None:
            self._level = self._stated = stated
        self._level = min(self._level, stated)
        if not self.has_field:
            self.growth += max(0.0, stated - self._stated)
        self._stated = stated

    def _check_field(self, sample: ImuSample) -> None:
        """Compare the field's strength with that at the start; inflate a driver's heading in a disturbed field."""
        field = sample.magnetic_field
        if field is None or not self._magnetometer:
            return
        self.has_field = True
        strength = float(np.sqrt(field @ field))
        if len(self._fields) < _FIELDS:
            self._fields.append(strength)
            self._usual = max(float(np.median(self._fields)), 1e-9)
            return
        elapsed = _FIELD_S if self.latest is None else (sample.stamp_ns - self.latest.stamp_ns) / NANOSECONDS
        share = 1.0 - float(np.exp(-elapsed / _FIELD_S))
        self._field = strength if self._field is None else self._field + share * (strength - self._field)
        if self._off_field() > _DISTURBED:
            self._off_s += elapsed
            if self._off_s > _ELSEWHERE_S:
                self._fields.clear()
                self._field = None
        else:
            self._off_s = 0.0
        if sample.orientation is None:
            return  # VQF's covariance includes it
        towards = _TURNED if self._off_field() > _DISTURBED else 0.0
        self._turned += (1.0 - float(np.exp(-elapsed / _TURNED_S))) * (towards - self._turned)

    def _off_field(self) -> float:
        if self._field is None:
            return 0.0
        return abs(self._field / self._usual - 1.0)
