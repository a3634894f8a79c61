"""Calibration while people move: skeletons in, poses and clocks of the sensors out.

Everything is a function of the stamps: an estimate at reference time T uses frames captured up to T minus
``settle_time`` and holds from T plus ``activation_delay``, so that times of arrival do not change the numbers.

Over 500 lines: one state machine from first frame to published pose, over estimators in their own modules.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from body_tracking.calibration.advice import APART, ROUGH, WAITING
from body_tracking.calibration.clock import LIKE, RECEIPT_PRIOR, correlate_clocks, joint_speeds
from body_tracking.calibration.clock_correlation import DRIFT_PRIOR, FINE_RANGE, ClockFit
from body_tracking.calibration.coverage import Coverage
from body_tracking.calibration.pairwise import PairEstimate, Pairs, residual, shared_motion, start_from_midline
from body_tracking.calibration.rigid import CalibrationError
from body_tracking.calibration.still_pose import FRAMES, is_still, is_t_pose, still_pose_registration
from body_tracking.calibration.turned import best_estimate, half_turn_from, registration
from body_tracking.calibration.upright import Tilt
from body_tracking.core import so3
from body_tracking.core.clocks import JUMP_BACK_NS, ClockModel, jumped_back
from body_tracking.core.measurement import joint_variance
from body_tracking.core.parameters import number_field
from body_tracking.core.sensor_poses import CalibrationResult, SensorPose, SensorQuality, level_pose
from body_tracking.core.skeleton import MIRROR, N_JOINTS, NANOSECONDS, FloatArray, Skeleton

PAIR_PERIOD = 0.1
"""Seconds of reference time between stored pairs: errors of frames closer together are correlated."""

MAX_BRACKET = 0.15
"""Longest interval between two frames of a sensor for interpolation, seconds: that of a camera with seven images per
second. For a limb that brakes by 5 m/s2 the error is 14 mm in the middle, no more than the joints' noise."""

GUESS_FRAMES = 30
"""Frames of a sensor whose delay of receipt gives the first guess of its clock."""

GUESS_GRID = 0.1
"""The guess is rounded to this, seconds, so that network delays do not change it."""

RECEIPT_FRAMES = 90
"""Frames of a sensor whose median delay of receipt gives its clock until the motion does: three seconds ..."""

RECEIPT_GRID = 0.04
"""... rounded to this, seconds. The medians of a live run and of its recording differ by some tenths of a millisecond
and seldom round differently; the minima differ by 30 ms and more, because a frame can overtake a bag's ``/clock``."""

PAIR_AGAIN_CLOCK = 0.004
"""Interpolate the frames anew when the clock has moved by more than this since they were paired, seconds."""

CLOCK_WINDOW_NS = 5 * NANOSECONDS
"""Length of the windows of motion that each measure the offset of the clock."""

REBASE_CLOCK = 0.05
"""The fit gets a new base when the clock differs from its base by this, seconds."""

MOVED_SIGMAS = 5.0
"""Standard deviations between estimate and saved pose or clock from which the saved one is dropped."""

MOVED_WINDOW = 5.0
"""Seconds of pairs that show whether a sensor has been moved."""

MOVED_SHIFT, MOVED_RATIO = 0.1, 2.0
"""A sensor has been moved if the pose by these pairs alone puts the person this many metres from where the pose by all
pairs does, with a residual that is smaller by this factor. Of the 517 windows of nine real pairs of Kinects that stood
still the greatest are 0.05 and 1.6; a turn by 10 degrees gives 0.5 and 10."""

MOVED_MOTION = 0.8
"""Least share of the motion in these pairs that both sensors see: they may see two people. Of one person who moves it
is 0.83 to 0.99 (nine real pairs, lower quartiles)."""

WANDER_PPM = 50.0
"""Standard deviation of a saved clock's change of drift, parts per million: quartz depends on the temperature."""

START_TIMEOUT = 8.0
"""Longest wait for a still pose, or for motion that determines the clock, seconds."""

JUMP_ANGLE = 0.5 * np.pi
"""A published pose farther than this from a better one is replaced at once, radians."""

FOREIGN_CLOCK = 5.0
"""Largest saved offset, seconds: clocks in ROS time have small ones."""

CLOCK_STEP = 1.0
"""Largest difference of a saved offset from the one by times of receipt, seconds."""

CLOCK_WINDOW = 3.0
"""Half width of the search for the clock offset around the guess by the times of receipt, seconds."""

RECEIPT_EXCLUDES = 2.0 * RECEIPT_PRIOR
"""Difference from the clock by times of receipt beyond which the best correlation's offset replaces it, seconds."""

CLOCK_CORRELATION, CLOCK_MARGIN = 0.6, 0.08
"""Least correlation of the joint speeds at the clock offset, and least difference to every other offset's."""

PAIRS_PER_PLACE, CAPACITY = 20, 500
"""Stored pairs of frames per place and heading, and in all."""

TILT_PERIOD_NS = 2 * NANOSECONDS
"""Time between two still poses that show how the reference is tilted, nanoseconds."""

SETTLE_NS = round(0.3 * NANOSECONDS)
"""Time to wait for late frames before they are paired, nanoseconds."""

ESTIMATE_PERIOD = 1.0
"""Seconds between estimates at first; it grows to five times this."""

SLEW_ROTATION, SLEW_TRANSLATION = 0.05, 0.05
"""Fastest turn of a published pose toward a better one, rad/s, and fastest move at the person's place, m/s."""

SAME_HEIGHT, SAME_TILT = 0.001, 0.001
"""Metres and radians by which a saved pose of the reference sensor may differ from the parameters: they are rounded."""

MAX_TRANSLATION_STDDEV = 0.05
"""Metres, at the person's place: greatest standard deviation of a good calibration."""

MAX_RESIDUAL = 0.3
"""Metres: greatest median residual of a good calibration. Nine real pairs of Kinects have 0.03 to 0.11, a simulated
sensor behind the person 0.21 to 0.23, sensors that see different people 0.57."""


@dataclass(frozen=True, slots=True)
class CalibrationParameters:
    """Parameters of the calibration; the defaults suit Kinect v2 sensors around one person."""

    method: str = field(
        default="robust",
        metadata={
            "doc": "thesis: one still pose, averaged over 50 frames; robust: refined while the person moves",
            "choices": ("robust", "thesis"),
        },
    )
    reference_height: float = number_field(
        0.0, "height of the reference sensor above the origin of world", "m", -10.0, 10.0
    )
    reference_pitch: float = number_field(0.0, "angle by which the reference sensor looks down", "rad", -1.6, 1.6)
    reference_roll: float = number_field(
        0.0, "roll of the reference sensor about its view, clockwise from behind", "rad", -3.2, 3.2
    )
    history: float = number_field(30.0, "raw frames kept for finding the clock offset", "s", 5.0, 600.0)
    activation_delay: float = number_field(0.5, "delay after which a new estimate comes into force", "s", 0.0, 10.0)
    max_rotation_stddev: float = number_field(
        0.05, "warn while the standard deviation of a sensor's rotation exceeds this", "rad", 0.001, 3.2
    )


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationUpdate:
    """A result to publish.

    Attributes:
        valid_from_ns: reference time from which it holds; 0 for always.
        result: poses and clocks of every calibrated sensor, the poses stamped with ``valid_from_ns``.
    """

    valid_from_ns: int
    result: CalibrationResult


class _Track:
    """The recent frames of one sensor, in ascending order of its own clock."""

    def __init__(self) -> None:
        self.least_delay: int | None = None
        self.late = 0
        self.forget()

    def forget(self) -> None:
        """Drop all frames."""
        self.stamps: list[int] = []
        self.positions: list[FloatArray] = []
        self.states: list[np.ndarray] = []
        self.variances: list[FloatArray] = []
        self.delays: list[int] = []  # receipt minus stamp

    def push(self, skeleton: Skeleton, received_ns: int) -> str:
        """Keep a frame, unless the sensor's clock jumped since the last one: returns the direction, else ""."""
        if self.stamps and skeleton.stamp_ns <= self.stamps[-1]:
            self.late += 1
            return "back" if jumped_back(skeleton.stamp_ns, self.stamps[-1]) else ""
        delay = received_ns - skeleton.stamp_ns
        if self.least_delay is not None and delay < self.least_delay - JUMP_BACK_NS:
            return "forward"  # after a mere gap the delay is as before
        self.least_delay = delay if self.least_delay is None else min(self.least_delay, delay)
        self.stamps.append(skeleton.stamp_ns)
        known = skeleton.valid
        self.positions.append(np.where(known[:, None], skeleton.positions, np.nan))
        self.states.append(np.where(known, skeleton.states, 0))
        self.variances.append(joint_variance(self.positions[-1], self.states[-1], skeleton.covariances))
        self.delays.append(delay)
        return ""

    def forget_before(self, stamp_ns: int) -> None:
        # In steps, because each deletion moves the whole list.
        old = bisect_right(self.stamps, stamp_ns)
        if old > 256:
            for values in (self.stamps, self.positions, self.states, self.variances, self.delays):
                del values[:old]

    def delay(self, first_ns: int, last_ns: int) -> float | None:
        """Median delay of receipt of the frames in an interval, nanoseconds; None for fewer than GUESS_FRAMES."""
        found = self.delays[bisect_left(self.stamps, first_ns) : bisect_right(self.stamps, last_ns)]
        return float(np.median(found)) if len(found) >= GUESS_FRAMES else None

    def until(self, stamp_ns: int, last: int | None = None) -> tuple[FloatArray, FloatArray, np.ndarray]:
        """Stamps (n,) seconds, positions (n, 25, 3), states (n, 25) up to a time of the sensor's clock."""
        stop = bisect_right(self.stamps, stamp_ns)
        start = 0 if last is None else max(0, stop - last)
        if stop - start == 0:
            return np.empty(0), np.empty((0, N_JOINTS, 3)), np.empty((0, N_JOINTS))
        return (
            np.array(self.stamps[start:stop]) / NANOSECONDS,
            np.stack(self.positions[start:stop]),
            np.stack(self.states[start:stop]),
        )

    def at(self, stamp_ns: int) -> tuple[FloatArray, FloatArray, FloatArray] | None:
        """Positions (25, 3), velocities and variances (25,) at a time of the sensor's clock, between two frames."""
        after = bisect_right(self.stamps, stamp_ns)
        if not 0 < after < len(self.stamps):
            return None
        step = (self.stamps[after] - self.stamps[after - 1]) / NANOSECONDS
        if step > MAX_BRACKET:
            return None
        velocity = (self.positions[after] - self.positions[after - 1]) / step
        elapsed = (stamp_ns - self.stamps[after - 1]) / NANOSECONDS
        positions = self.positions[after - 1] + elapsed * velocity
        variance = np.maximum(self.variances[after - 1], self.variances[after])
        # also where the difference of two valid positions overflows
        return positions, velocity, np.where(np.isfinite(positions).all(axis=1), variance, np.inf)


class _Sensor:
    """State of one sensor other than the reference; rotations and translations are sensor to reference, optical."""

    def __init__(self) -> None:
        self.track = _Track()
        self.rotation: FloatArray | None = None  # as published, slewing toward the target
        self.translation: FloatArray = np.zeros(3)
        self.target: tuple[FloatArray, FloatArray, FloatArray] | None = None  # rotation, translation, centre
        self.clock = ClockModel()  # in use
        self.loaded: ClockModel | None = None  # from another session
        self.quality = SensorQuality()  # of the pose
        self.turned = 0.0
        self.forget()

    def forget(self) -> None:
        """Start estimating anew; the published pose stays."""
        self.clock = replace(self.clock, stddev=np.inf, drift_stddev_ppm=np.inf)
        self.clock_guessed = False
        self.clock_saved = False
        self.clock_expected: ClockModel | None = None  # prior: from before the motion that the fit uses
        self.received: ClockModel | None = None  # by the times of receipt
        self.clock_locked = False
        self.clock_base = self.clock  # of the fit
        self.clock_fit: ClockFit | None = None
        self.clock_window_end: int | None = None
        self.paired_clock = self.clock
        self.pairs = Coverage(PAIRS_PER_PLACE, CAPACITY)
        self.paired_until: int | None = None
        self.moved_ns: int | None = None  # pairs from before are of another pose
        self.started: tuple[FloatArray, FloatArray] | None = None
        self.next_estimate = 0
        self.estimated = False
        self.movement_since: int | None = None


def _clock_source(sensor: _Sensor) -> str:
    if sensor.clock_locked:
        return "motion"
    return "saved" if sensor.clock_saved else "receipt"


def _angle_between(a: FloatArray, b: FloatArray) -> float:
    """Radians between two rotations (3, 3)."""
    return float(np.linalg.norm(so3.rotation_vectors(a @ b.T)))


def _difference(found: PairEstimate, rotation: FloatArray, translation: FloatArray) -> tuple[float, float]:
    """Between an estimate and a pose: radians, and metres at the place of the person."""
    place = rotation @ found.rotation.T @ (found.centre - found.translation) + translation
    return _angle_between(found.rotation, rotation), float(np.linalg.norm(place - found.centre))


class OnlineCalibration:
    """Calibrates any number of sensors against the reference sensor, continuously.

    Args:
        sensors: their names.
        parameters: see :class:`CalibrationParameters`.
        reference: the sensor that defines ``world`` and its time; the first one when None.

    Raises:
        CalibrationError: the reference is not among the sensors, or there are none.
    """

    def __init__(
        self, sensors: Sequence[str], parameters: CalibrationParameters | None = None, reference: str | None = None
    ) -> None:
        self.parameters = parameters or CalibrationParameters()
        self.reference = reference or next(iter(sensors), "")
        if self.reference not in sensors:
            listed = ", ".join(sensors) or "(none)"
            raise CalibrationError(f"reference sensor {self.reference!r} is not among the sensors {listed}")
        self.events: list[str] = []
        self._base = self._given_base()
        self._track = _Track()
        self._sensors = {name: _Sensor() for name in sensors if name != self.reference}
        self._anchor: int | None = None
        self._now: int | None = None
        self._last_step: int | None = None
        self._changed = False
        self._tilt = Tilt()
        self._tilt_ns: int | None = None

    def _given_base(self) -> SensorPose:
        """The reference sensor's pose by the parameters."""
        given = self.parameters
        return level_pose(self.reference, given.reference_height, given.reference_pitch, given.reference_roll)

    # --- frames in

    def push(self, sensor: str, skeleton: Skeleton, received_ns: int) -> list[CalibrationUpdate]:
        """Take one frame of one sensor.

        Args:
            sensor: its name; frames of unknown sensors are ignored.
            skeleton: in the sensor's optical frame and clock.
            received_ns: when it arrived, in a clock common to all sensors.

        Returns:
            The results to publish, usually none.
        """
        if sensor == self.reference:
            if way := self._track.push(skeleton, received_ns):
                self.restart(f"the clock of {sensor} went {way}: starting again from the calibration so far")
                self._track.push(skeleton, received_ns)
            return self._advance(skeleton.stamp_ns)
        other = self._sensors.get(sensor)
        if other is not None and (way := other.track.push(skeleton, received_ns)):
            self.events.append(f"the clock of {sensor} went {way}: estimating its offset again")
            other.track = _Track()
            other.loaded = None
            other.forget()
            other.track.push(skeleton, received_ns)
        return []

    def restart(self, event: str) -> None:
        """Estimate anew, from the calibration so far; ``event`` says why."""
        self.events.append(event)
        self._track = _Track()
        self._anchor = self._now = self._last_step = self._tilt_ns = None
        for other in self._sensors.values():
            other.track = _Track()
            other.forget()

    def _advance(self, now: int) -> list[CalibrationUpdate]:
        if self._anchor is None:
            self._anchor = now
        if self._now is not None and now <= self._now:
            return []
        gap = self._now is not None and now - self._now > NANOSECONDS
        self._now = now
        horizon = now - SETTLE_NS
        for name, other in self._sensors.items():
            self._process(name, other, horizon)
        self._track.forget_before(now - round(self.parameters.history * NANOSECONDS))
        if self._tilt_ns is None or now - self._tilt_ns >= TILT_PERIOD_NS:
            self._tilt_ns = now
            self._tilt.add(*self._track.until(now, FRAMES))
        if self._last_step is not None and now - self._last_step < PAIR_PERIOD * NANOSECONDS:
            return []
        elapsed = 0.0 if self._last_step is None else (now - self._last_step) / NANOSECONDS
        self._last_step = now
        for other in self._sensors.values():
            # The pose may jump after a gap: no person was seen.
            self._changed |= self._slew(other, np.inf if gap else elapsed)
        if not self._changed:
            return []
        self._changed = False
        valid_from_ns = now + round(self.parameters.activation_delay * NANOSECONDS)
        return [CalibrationUpdate(valid_from_ns, self._result(valid_from_ns, published=True))]

    # --- one sensor

    def _process(self, name: str, other: _Sensor, horizon: int) -> None:
        if not other.clock_guessed and not self._guess_clock(name, other):
            return
        if other.received is None:
            self._clock_from_receipt(name, other, horizon)
        own_horizon = other.clock.to_sensor(horizon)
        other.track.forget_before(own_horizon - round(self.parameters.history * NANOSECONDS))
        if not other.track.stamps or other.track.stamps[-1] < own_horizon - 2 * NANOSECONDS:
            return
        self._pair(other, horizon)
        if self._now is None or self._now < other.next_estimate:
            return
        period = ESTIMATE_PERIOD
        if other.movement_since is not None:
            period *= float(np.clip(0.1 * (self._now - other.movement_since) / NANOSECONDS, 1.0, 5.0))
        other.next_estimate = self._now + round(period * NANOSECONDS)
        if other.started is None:
            self._start(name, other, horizon)
        if self.parameters.method == "robust":
            if other.received is not None and not other.clock_locked:
                self._lock_clock(name, other, horizon)
            if other.clock_locked:
                self._update_clock(name, other, horizon)
            self._estimate(name, other)

    def _guess_clock(self, name: str, other: _Sensor) -> bool:
        if min(len(self._track.delays), len(other.track.delays)) < GUESS_FRAMES:
            return False
        own, theirs = (np.median(track.delays[:GUESS_FRAMES]) for track in (self._track, other.track))
        guess = float(own - theirs) / NANOSECONDS
        assert self._anchor is not None
        if other.rotation is None or abs(other.clock.offset_ns_at(self._anchor) / NANOSECONDS - guess) > CLOCK_STEP:
            if other.rotation is not None:
                self.events.append(f"the clock of {name} is not the one that was calibrated: estimating its offset")
                self._changed = True
            offset = GUESS_GRID * round(guess / GUESS_GRID)
            other.clock = ClockModel(round(offset * NANOSECONDS), 0.0, self._anchor)
            other.loaded = None
        elif other.loaded is None:
            other.clock_saved = True  # of this session: no prior, or its motion would count twice
        else:
            other.clock = other.clock_expected = self._at_session_start(other.loaded)
            other.clock_saved = other.clock.stddev < RECEIPT_PRIOR
        other.clock_guessed = True
        return True

    def _at_session_start(self, loaded: ClockModel) -> ClockModel:
        """A clock of another session, predicted to the beginning of this one."""
        assert self._anchor is not None
        return loaded.carried_to(self._anchor, WANDER_PPM)

    def _clock_from_receipt(self, name: str, other: _Sensor, horizon: int) -> None:
        """Replace the guess by the difference of both sensors' median delays over the same few seconds."""
        stamps = other.track.stamps
        start = bisect_left(stamps, other.clock.to_sensor(self._track.stamps[0]))
        stop = start + RECEIPT_FRAMES - 1
        # Only frames captured long enough ago, so that the order of arrival does not matter.
        if stop >= len(stamps) or other.clock.to_sensor(horizon) < stamps[stop]:
            return
        first, last = stamps[start], stamps[stop]
        own = self._track.delay(other.clock.to_reference(first), other.clock.to_reference(last))
        theirs = other.track.delay(first, last)
        if own is None or theirs is None:
            return
        offset = round(RECEIPT_GRID * round((own - theirs) / NANOSECONDS / RECEIPT_GRID) * NANOSECONDS)
        middle = (first + last) // 2 - offset
        other.received = ClockModel(offset, 0.0, middle, RECEIPT_PRIOR, 1e6 * DRIFT_PRIOR)
        if other.clock_saved and abs(first - other.clock.to_reference(first) - offset) < FINE_RANGE * NANOSECONDS:
            if other.clock_expected is None:
                other.clock = replace(
                    other.received, offset_ns=other.clock.offset_ns_at(middle), drift_ppm=other.clock.drift_ppm
                )
            return  # a calibrated clock that has not drifted away is better
        if other.clock_saved:
            self._drop_saved_clock(name, other)
        other.loaded = other.clock_expected = None
        other.clock = other.received
        self._pair_anew(other, horizon)
        self._changed = True

    def _pair(self, other: _Sensor, horizon: int) -> None:
        """Store pairs for the reference frames up to the horizon, one per :data:`PAIR_PERIOD`."""
        assert self._anchor is not None
        track, period = self._track, round(PAIR_PERIOD * NANOSECONDS)
        start = 0 if other.paired_until is None else bisect_right(track.stamps, other.paired_until)
        for index in range(start, bisect_right(track.stamps, horizon)):
            stamp = track.stamps[index]
            if other.paired_until is not None and stamp - other.paired_until < period:
                continue
            other.paired_until = stamp
            seen = other.track.at(other.clock.to_sensor(stamp))
            if seen is None:
                continue
            reference = track.positions[index]
            variance = track.variances[index] + seen[2]
            if np.isfinite(variance).sum() < 5:
                continue
            other.pairs.add((stamp - self._anchor) / NANOSECONDS, reference, seen[0], seen[1], variance)

    def _pair_anew(self, other: _Sensor, horizon: int) -> None:
        other.pairs.clear()
        other.paired_until = other.moved_ns
        other.paired_clock = other.clock
        self._pair(other, horizon)

    def _start(self, name: str, other: _Sensor, horizon: int) -> None:
        """The thesis's calibration, from the first still pose that both sensors see."""
        own = self._track.until(horizon, FRAMES)
        theirs = other.track.until(other.clock.to_sensor(horizon), FRAMES)
        still = is_still(own[0], own[1]) and is_still(theirs[0], theirs[1])
        if still:
            try:
                found = [still_pose_registration(own[1:], theirs[1:])]
                if self.parameters.method == "robust":
                    # One of them may see the body reversed.
                    exchanged = theirs[1][:, MIRROR], theirs[2][:, MIRROR]
                    found.append(still_pose_registration(own[1:], exchanged))
            except CalibrationError:
                return
            rotation, translation, residual = min(found, key=lambda each: each[2])
            pose = "T-pose" if is_t_pose(own[1]) else "still pose"
            self.events.append(
                f"{name}: calibrated from a {pose}, with a mean residual of {1e3 * residual:.0f} mm in it"
            )
            other.started = rotation, translation
            if other.rotation is None or self.parameters.method == "thesis":
                other.quality = SensorQuality(residual=residual, frames=FRAMES)
                self._set_target(other, rotation, translation, np.nanmean(own[1], axis=(0, 1)))
        elif self.parameters.method == "robust" and self._can_start_from_movement(other, horizon):
            # Without a still pose, start from the movement.
            start = registration(other.pairs.pairs())
            if start is not None:
                self.events.append(f"{name}: calibrated from motion without a still pose")
                other.started = start

    @staticmethod
    def _can_start_from_movement(other: _Sensor, horizon: int) -> bool:
        """Whether the clock is known from motion, or has been known from receipt for a while."""
        waited = other.received is not None and horizon - other.received.anchor_ns > START_TIMEOUT * NANOSECONDS
        return len(other.pairs) >= 20 and (other.clock_locked or waited)

    def _lock_clock(self, name: str, other: _Sensor, horizon: int) -> None:
        assert self._anchor is not None
        own = self._since_anchor(self._track, ClockModel(), None, horizon)
        theirs = self._since_anchor(other.track, other.clock, None, other.clock.to_sensor(horizon))
        found = correlate_clocks(own, theirs, 0.0, CLOCK_WINDOW)
        if found is None or found.likely < CLOCK_CORRELATION or found.margin < CLOCK_MARGIN:
            return
        other.clock_base = replace(other.clock, offset_ns=other.clock.offset_ns + round(found.offset * NANOSECONDS))
        if other.clock_expected is not None and abs(found.offset) > FINE_RANGE:
            self._drop_saved_clock(name, other)
        other.clock_locked = True
        other.movement_since = self._now
        # A few seconds of a twist seen from its side give an offset that is up to 60 ms wrong. Unless the times of
        # receipt exclude the old offset, the fit decides, which weighs both.
        if other.clock_expected is None and abs(found.offset) > RECEIPT_EXCLUDES:
            self.events.append(f"{name}: clock offset {other.clock_base.offset:+.2f} s found from the motion")
            other.clock = other.clock_base
            self._pair_anew(other, horizon)  # the pairs so far were made with the guess
        # Windows lie on multiples of their length, whenever the clock was found.
        first = (self._track.stamps[0] - self._anchor) // CLOCK_WINDOW_NS
        other.clock_window_end = self._anchor + first * CLOCK_WINDOW_NS
        self._changed = True

    def _since_anchor(
        self, track: _Track, clock: ClockModel, start: int | None, stop: int
    ) -> tuple[FloatArray, FloatArray]:
        """Reference seconds (n,) since the anchor and positions of the frames in (start, stop] of a sensor's clock."""
        # Differences first: a float has too few digits for microseconds since the epoch.
        first = 0 if start is None else bisect_right(track.stamps, start)
        last = bisect_right(track.stamps, stop)
        assert self._anchor is not None
        since = [clock.to_reference(stamp) - self._anchor for stamp in track.stamps[first:last]]
        stamps = np.array(since) / NANOSECONDS
        return stamps, np.array(track.positions[first:last]).reshape(-1, N_JOINTS, 3)

    def _drop_saved_clock(self, name: str, other: _Sensor) -> None:
        self.events.append(f"{name}: its clock was set since it was calibrated")
        other.loaded = other.clock_expected = None

    def _fitted_clock(self, name: str, other: _Sensor, fit: ClockFit) -> ClockModel | None:
        """The clock from all the motion so far and from the expected clock, unless these contradict each other."""
        found, expected = fit.solve(other.received), other.clock_expected
        if found is None or expected is None:
            return found
        apart = (found.offset_ns - expected.offset_ns_at(found.anchor_ns)) / NANOSECONDS
        if abs(apart) > MOVED_SIGMAS * np.hypot(found.stddev, expected.stddev_at(found.anchor_ns)):
            self._drop_saved_clock(name, other)
            return found
        return fit.solve(expected)

    def _update_clock(self, name: str, other: _Sensor, horizon: int) -> None:
        """Measure the offset over every complete window of motion, and fit the clock to all of them."""
        assert self._anchor is not None and other.clock_window_end is not None
        around = round(2 * FINE_RANGE * NANOSECONDS)
        measured = False
        while other.clock_window_end + CLOCK_WINDOW_NS + around <= horizon:
            start, stop = other.clock_window_end, other.clock_window_end + CLOCK_WINDOW_NS
            other.clock_window_end = stop
            if other.clock_fit is None:
                other.clock_fit = ClockFit(other.clock_base, self._anchor, LIKE)
            measured |= other.clock_fit.add(
                (start + CLOCK_WINDOW_NS // 2 - self._anchor) / NANOSECONDS,
                joint_speeds(*self._since_anchor(self._track, ClockModel(), start, stop)),
                joint_speeds(
                    *self._since_anchor(
                        other.track,
                        other.clock_base,
                        other.clock.to_sensor(start - around),
                        other.clock.to_sensor(stop + around),
                    )
                ),
            )
        found = self._fitted_clock(name, other, other.clock_fit) if measured and other.clock_fit is not None else None
        if found is None:
            return
        other.clock = found
        gone = other.clock.to_sensor(other.clock_window_end) - other.clock_base.to_sensor(other.clock_window_end)
        if abs(gone) > REBASE_CLOCK * NANOSECONDS:
            # The estimate so far is the next fit's prior.
            other.clock_expected, other.clock_base, other.clock_fit = other.clock, other.clock, None
        assert self._now is not None
        moved = (other.clock.to_sensor(self._now) - other.paired_clock.to_sensor(self._now)) / NANOSECONDS
        if abs(moved) > PAIR_AGAIN_CLOCK:
            if self._covers_all_pairs(other) and other.paired_until is not None:
                self._pair_anew(other, other.paired_until)
            else:
                other.pairs.shift_clock(
                    (other.clock.to_sensor(self._anchor) - other.paired_clock.to_sensor(self._anchor)) / NANOSECONDS,
                    1e-6 * (other.clock.drift_ppm - other.paired_clock.drift_ppm),
                )
                other.paired_clock = other.clock
        self._changed = True

    def _estimate(self, name: str, other: _Sensor) -> None:
        if other.started is None or len(other.pairs) < 20:
            return
        if other.estimated:
            self._drop_pairs_before_a_move(name, other)
        pairs = other.pairs.pairs()
        best = self._best(pairs, other)
        if best is None:
            return
        other.started = best.rotation, best.translation
        other.turned = best.turned
        if not other.estimated:
            # A loaded calibration of smaller stated uncertainty stays, unless the estimate contradicts it.
            moved = other.rotation is not None and self._contradicts(best, other)
            if best.rotation_stddev > other.quality.rotation_stddev and not (moved and other.clock_locked):
                return
            if moved:
                assert other.rotation is not None
                apart, shift = _difference(best, other.rotation, other.translation)
                self.events.append(
                    f"{name}: does not stand where the saved calibration says, but {1e3 * shift:.0f} mm and "
                    f"{np.degrees(apart):.1f} deg away; estimated anew"
                )
        other.estimated = True
        other.quality = SensorQuality(best.residual, best.rotation_stddev, best.translation_stddev, len(pairs))
        self._set_target(other, best.rotation, best.translation, best.centre)

    def _drop_pairs_before_a_move(self, name: str, other: _Sensor) -> None:
        """Find out whether the sensor, or the reference, was moved: then only the last seconds' pairs count."""
        assert other.started is not None and other.paired_until is not None and self._anchor is not None
        end = (other.paired_until - self._anchor) / NANOSECONDS
        recent = other.pairs.pairs(end - MOVED_WINDOW)
        if not 20 <= len(recent) < len(other.pairs):
            return
        found = self._best(recent, other)
        if found is None or shared_motion(recent, found.rotation) < MOVED_MOTION:
            return
        apart, shift = _difference(found, *other.started)
        least = MOVED_RATIO * found.residual
        earlier = recent.first(len(recent) // 2)  # if it was moved within this time, wait
        if shift < MOVED_SHIFT or residual(recent, *other.started) < least:
            return
        if residual(earlier, found.rotation, found.translation) > least:
            return
        other.pairs.forget_before(end - MOVED_WINDOW)
        other.moved_ns = other.paired_until - round(MOVED_WINDOW * NANOSECONDS)
        self._tilt = Tilt()
        other.started = found.rotation, found.translation
        self.events.append(
            f"{name} or {self.reference} was moved, by {1e3 * shift:.0f} mm at the person's place and "
            f"{np.degrees(apart):.1f} deg; estimated anew"
        )

    def _contradicts(self, found: PairEstimate, other: _Sensor) -> bool:
        """Whether published pose and estimate differ by more than their uncertainties explain."""
        assert other.rotation is not None
        apart, shift = _difference(found, other.rotation, other.translation)
        return bool(
            apart > MOVED_SIGMAS * np.hypot(found.rotation_stddev, other.quality.rotation_stddev)
            or shift > 0.05 + MOVED_SIGMAS * np.hypot(found.translation_stddev, other.quality.translation_stddev)
        )

    def _covers_all_pairs(self, other: _Sensor) -> bool:
        """Whether the raw frames still reach back to the oldest pair."""
        assert self._anchor is not None
        if not len(other.pairs):
            return False
        oldest = self._anchor + round(other.pairs.oldest * NANOSECONDS)
        return self._track.stamps[0] <= oldest and other.track.stamps[0] <= other.clock.to_sensor(oldest)

    def _best(self, pairs: Pairs, other: _Sensor) -> PairEstimate | None:
        """The best from three starts: the last estimate, half a turn from it, and the spines without left and right."""
        assert other.started is not None
        starts = [other.started]
        midline = start_from_midline(pairs)
        if midline is not None and _angle_between(midline[0], other.started[0]) > 0.5:
            starts.append(midline)
        opposite = half_turn_from(pairs, other.started[0])
        if opposite is not None:
            starts.append(opposite)
        return best_estimate(pairs, starts)

    def _set_target(self, other: _Sensor, rotation: FloatArray, translation: FloatArray, centre: FloatArray) -> None:
        other.target = rotation, translation, centre
        if other.rotation is None or _angle_between(rotation, other.rotation) > JUMP_ANGLE:
            other.rotation, other.translation = rotation, translation
            self._changed = True

    def _slew(self, other: _Sensor, elapsed: float) -> bool:
        """Move the published pose toward the target; True when it moved.

        The rotation is about the person's place, to disturb the person's motion least.
        """
        if other.target is None or other.rotation is None:
            return False
        rotation, translation, centre = other.target
        turn = so3.rotation_vectors(rotation @ other.rotation.T)
        own_centre = rotation.T @ (centre - translation)
        place = other.rotation @ own_centre + other.translation
        angle, distance = float(np.linalg.norm(turn)), float(np.linalg.norm(centre - place))
        if angle < 1e-9 and distance < 1e-9:
            return False
        share = min(1.0, SLEW_ROTATION * elapsed / max(angle, 1e-12))
        other.rotation = so3.quat_to_matrix(so3.exp(share * turn)) @ other.rotation
        place += (centre - place) * min(1.0, SLEW_TRANSLATION * elapsed / max(distance, 1e-12))
        other.translation = place - other.rotation @ own_centre
        return True

    # --- results

    def _result(self, valid_from_ns: int, *, published: bool) -> CalibrationResult:
        base_rotation = self._base.rotation
        poses = {self.reference: replace(self._base, valid_from_ns=valid_from_ns)}
        clocks = {self.reference: ClockModel(0, 0.0, self._anchor or 0, 0.0, 0.0)}
        quality = {self.reference: SensorQuality(0.0, 0.0, 0.0)}
        for name, other in self._sensors.items():
            if other.rotation is None or other.target is None:
                continue
            rotation, translation = (other.rotation, other.translation) if published else other.target[:2]
            poses[name] = SensorPose(
                name,
                base_rotation @ translation + self._base.translation,
                so3.matrix_to_quat(base_rotation @ rotation),
                valid_from_ns,
            )
            clocks[name] = other.clock
            quality[name] = other.quality
        return CalibrationResult(self.reference, poses, clocks, quality)

    def current_update(self) -> CalibrationUpdate:
        """The present result, valid for all times, to publish at the start."""
        return CalibrationUpdate(0, self._result(0, published=True))

    def result(self) -> CalibrationResult:
        """The best estimate so far, not slewed."""
        return self._result(0, published=False)

    def finish(self) -> CalibrationResult:
        """The best estimate from all frames up to the last one; for recordings."""
        if self._now is not None and self._anchor is not None and self.parameters.method == "robust":
            for name, other in self._sensors.items():
                if not other.clock_guessed:
                    continue
                if other.clock_locked and self._track.stamps[0] <= self._anchor:
                    # All frames are still stored: measure every window again with the final clock.
                    other.clock_fit, other.clock_window_end = None, self._anchor
                    other.clock_base = other.clock
                    other.clock_expected = None if other.loaded is None else self._at_session_start(other.loaded)
                if other.clock_locked:
                    self._update_clock(name, other, self._now)
                    if self._covers_all_pairs(other):
                        self._pair_anew(other, self._now)
                self._pair(other, self._now)
                self._estimate(name, other)
        return self.result()

    def load(self, result: CalibrationResult) -> None:
        """Load an earlier calibration; it holds until there is a better estimate.

        Its pose of the reference sensor defines ``world``, unless it contradicts parameters that are not 0: then they
        do, and it moves as a whole.

        Its clocks count as independent of this session's motion: a calibration from the same recording makes the stated
        standard deviations of clocks too small, by up to the square root of two.

        Raises:
            CalibrationError: it belongs to another reference sensor.
        """
        if result.reference != self.reference:
            raise CalibrationError(
                f"the calibration's reference sensor is {result.reference!r}, this graph's is {self.reference!r}"
            )
        base = result.poses.get(self.reference, self._base)
        self._base = self._world_of(base)
        for name, other in self._sensors.items():
            pose = result.poses.get(name)
            if pose is None:
                continue
            rotation = base.rotation.T @ pose.rotation
            translation = base.rotation.T @ (pose.translation - base.translation)
            other.rotation, other.translation = rotation, translation
            other.target = rotation, translation, translation
            other.quality = result.quality.get(name, SensorQuality())
            clock = result.clocks.get(name, ClockModel())
            if abs(clock.offset) > FOREIGN_CLOCK:
                self.events.append(f"{name}: its saved clock is {clock.offset:+.1f} s off, not in ROS time: left out")
                other.clock = other.loaded = ClockModel(drift_stddev_ppm=1e6 * DRIFT_PRIOR)
            else:
                drift_stddev_ppm = min(clock.drift_stddev_ppm, 1e6 * DRIFT_PRIOR)
                other.clock = other.loaded = replace(clock, drift_stddev_ppm=drift_stddev_ppm)

    def _world_of(self, saved: SensorPose) -> SensorPose:
        """The reference sensor's pose: the saved one, or the parameters' if they are given and contradict it."""
        parameters, given = self.parameters, self._given_base()
        if not (parameters.reference_height or parameters.reference_pitch or parameters.reference_roll):
            return saved
        higher = float(given.translation[2] - saved.translation[2])
        # angle between the two directions of gravity in the sensor's coordinates, which has no heading
        tilt = 2.0 * float(np.arcsin(min(1.0, 0.5 * float(np.linalg.norm(given.rotation[2] - saved.rotation[2])))))
        if abs(higher) < SAME_HEIGHT and tilt < SAME_TILT:
            return saved
        self.events.append(
            f"{self.reference}: reference_height, reference_pitch and reference_roll define world, not the saved "
            f"calibration, which differs by {1e3 * abs(higher):.0f} mm and {np.degrees(tilt):.1f} deg"
        )
        return given

    # --- services

    def start(self) -> str:
        """Estimate anew from the next still pose; the present calibration stays in force until then.

        Earlier frames are dropped: a sensor may have been moved since.
        """
        self._track.forget()
        self._tilt = Tilt()
        for other in self._sensors.values():
            other.loaded = None
            other.forget()
            other.track.forget()
            other.quality = SensorQuality()
        return "calibrating: stand still (a T-pose is best) for four seconds, then walk about"

    def reset(self) -> str:
        """Delete every calibration and start again, in the ``world`` of the parameters."""
        self._base = self._given_base()
        for name, other in list(self._sensors.items()):
            fresh = _Sensor()
            fresh.track = other.track
            self._sensors[name] = fresh
        self._changed = True
        return self.start()

    def status(self) -> tuple[int, str, dict[str, object]]:
        """Diagnostic level (0 OK, 1 warning), one line, and values per sensor."""
        values: dict[str, object] = {"reference": self.reference, "method": self.parameters.method}
        waiting, uncertain, apart = [], [], []
        for name, other in self._sensors.items():
            if other.rotation is None:
                waiting.append(name)
                continue
            quality, clock = other.quality, other.clock
            at_ns = clock.anchor_ns if self._now is None else self._now
            places = quality.translation_stddev < MAX_TRANSLATION_STDDEV
            if not (places and quality.rotation_stddev < self.parameters.max_rotation_stddev):
                uncertain.append(name)
            if quality.residual > MAX_RESIDUAL:
                apart.append(name)
            values |= {
                f"{name} residual_mm": round(1e3 * quality.residual, 1),
                f"{name} rotation_stddev_deg": round(float(np.degrees(quality.rotation_stddev)), 2),
                f"{name} translation_stddev_mm": round(1e3 * quality.translation_stddev, 1),
                f"{name} clock_offset_s": round(clock.offset_ns_at(at_ns) / NANOSECONDS, 4),
                f"{name} clock_drift_ppm": round(clock.drift_ppm, 1),
                f"{name} clock_stddev_ms": round(1e3 * clock.stddev_at(at_ns), 2),
                f"{name} clock_from": _clock_source(other),
                f"{name} pairs": len(other.pairs),
                f"{name} turned_share": round(other.turned, 3),
                f"{name} late_frames": other.track.late,
            }
        if waiting:
            return 1, f"{WAITING} seen by {self.reference} and {', '.join(waiting)}", values
        if apart:
            most = f"median residual above {1e3 * MAX_RESIDUAL:.0f} mm"
            return 1, f"{self.reference} and {', '.join(apart)} {APART} ({most})", values
        if uncertain:
            return 1, f"{', '.join(uncertain)}: {ROUGH}", values
        if self._now is None and not self._sensors:
            return 1, f"no skeleton of {self.reference} yet", values
        if tilted := self._tilt.problem(self.reference, self._base.rotation):
            return 1, tilted, values
        return 0, "calibrated", values
