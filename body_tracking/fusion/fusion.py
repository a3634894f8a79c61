"""Fusion of several sensors' skeletons into one, by capture time.

The fused skeleton is a function of the stamps alone: one per frame of the reference sensor (or, while that is silent,
of another), at that frame's capture time, from each sensor's newest frame captured up to then. A frame waits only while
another sensor's is due, and then a few milliseconds; so the delay stays small, and the time of arrival does not change
the numbers.
"""

from __future__ import annotations

import math
from bisect import insort
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from body_tracking.core.clocks import JUMP_BACK_NS, jumped_back
from body_tracking.core.measurement import BASE_STDDEV, COMMON_SHARE, joint_variance, viewing_angle
from body_tracking.core.parameters import number_field
from body_tracking.core.sensor_poses import SensorPose
from body_tracking.core.sides import PAIRS
from body_tracking.core.skeleton import BONES, N_JOINTS, NANOSECONDS, BoolArray, FloatArray, Skeleton, TrackingState
from body_tracking.fusion.placement import WORLD, PlacedSensors, Placement
from body_tracking.fusion.rhythm import Rhythm
from body_tracking.fusion.sides import Sides
from body_tracking.fusion.weights import thesis_formula, thesis_text

MAX_SPEED = 8.0
"""Fastest motion of a joint along an axis, metres per second."""

SMOOTHING = 0.1
"""Time constant of the velocities that carry older frames and the prediction forward, seconds."""

ACCELERATION = 30.0
"""Typical peak acceleration of a limb, m/s^2: the process noise of extrapolation and prediction."""

_WIDTHS = ((0.15, 0.6), (0.05, 0.4))
"""Plausible (least, greatest) lengths of the left-right axes of shoulders and hips, as a Kinect sees them, metres."""

MAX_OUTPUT_GAP = round(0.065 * NANOSECONDS)
"""Time without an output after which one is made at another sensor's frame, nanoseconds."""

_SLOWER = 1.5
"""Ratio of frame periods from which the reference is slower than another sensor, as a Kinect v2 in the dark is.
With every second frame of it left out three recordings gave 15 outputs a second, now 19 to 28, with the same errors."""

SHARE_OF_PERIOD = 0.75
"""The same while the reference is silent or slower, in periods of the fastest sensor: with 0.75 every frame of one
other sensor gives an output, of two others not each (14 outputs a second with :data:`MAX_OUTPUT_GAP`, 27 with this)."""

EXTRAPOLATE = 0.05
"""Longest time by which a sensor's older frame is carried forward, seconds."""

GATE = 3.5
"""Standard deviations from its prediction beyond which a joint is rejected ..."""

REACQUIRE = 0.3
"""... unless a sensor has reported it there for this long, seconds."""

_SLOW = 0.04
"""Period from which a sensor is slow, seconds."""

_MISSED = 2.5
"""Periods without a frame after which a slow sensor is silent, at the earliest: one frame may be lost."""

_LONGEST_PERIOD = 1.0
"""Longest time between two frames that is taken for a sensor's period, seconds; a longer one is an absence."""

_DIAGONAL = np.arange(3)
_FOREARMS = tuple((parent, child) for parent, child in BONES if parent.name.startswith(("ELBOW", "WRIST", "HAND")))


@dataclass(frozen=True, slots=True)
class FusionParameters:
    """Parameters of the fusion."""

    method: str = field(
        default="covariance",
        metadata={
            "doc": "covariance: inverse variances, with a gate and repair of swapped sides; thesis_text: only tracked "
            "joints where any sensor tracks them; thesis_formula: in proportion to the tracking states",
            "choices": ("covariance", "thesis_text", "thesis_formula"),
        },
    )
    silence: float = number_field(
        0.1,
        "drop a sensor whose newest frame is older than this; below 25 frames a second, than 2.5 periods if longer",
        "s",
        0.02,
        5.0,
    )
    max_wait: float = number_field(
        0.05, "wait at most this long for another sensor's frame that is due; 0 for the least delay", "s", 0.0, 1.0
    )
    fade_in: float = number_field(
        0.5, "let a sensor that appears or returns gain its full weight over this time", "s", 0.0, 10.0
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Frame:
    """One frame of one sensor, in its optical frame and clock."""

    stamp_ns: int
    positions: FloatArray
    velocities: FloatArray
    variance: FloatArray
    states: np.ndarray
    angle: float
    body: int
    since_ns: int  # reference time of the first frame of its run, after a silence


def _with_hidden_forearms(states: np.ndarray) -> np.ndarray:
    """(25,) the states, with the joints beyond an inferred elbow, wrist or hand inferred, too.

    The joints of one arm are hidden together, and a Kinect calls some hidden ones tracked (in the simulator a third).
    """
    if not (states == TrackingState.INFERRED).any():
        return states
    states = states.copy()
    for parent, child in _FOREARMS:
        if states[parent] == TrackingState.INFERRED:
            states[child] = min(states[child], TrackingState.INFERRED)
    return states


class _Sensor(Placement):
    """Recent frames, pose and clock of one sensor."""

    def clear(self) -> None:
        super().clear()
        self.frames: deque[_Frame] = deque(maxlen=8)
        self.rhythm = Rhythm()


class Fusion(PlacedSensors[_Sensor]):
    """Fuses the skeletons of any number of calibrated sensors.

    Args:
        sensors: their names.
        parameters: see :class:`FusionParameters`.
        reference: the sensor whose clock is the output's and at whose frames it is made; the first one when None.
        world: the frame of the output.

    Attributes:
        behind: by sensor, seconds by which its last frame was older than the newest output when it arrived.
    """

    def __init__(
        self,
        sensors: Sequence[str],
        parameters: FusionParameters | None = None,
        reference: str | None = None,
        world: str = WORLD,
    ) -> None:
        super().__init__(sensors, reference, _Sensor)
        self.parameters = parameters or FusionParameters()
        self.world = world
        # Frames at whose time an output may be due: capture time, whether not the reference's, and deadline.
        self._pending: list[tuple[int, bool, int]] = []
        self._forget_output()

    def _forget_output(self) -> None:
        self._pending.clear()
        self._last_ns: int | None = None
        self._behind_since_ns: int | None = None
        self._position: FloatArray = np.zeros((N_JOINTS, 3))
        self._velocity: FloatArray = np.zeros((N_JOINTS, 3))
        self._known_ns: FloatArray = np.full(N_JOINTS, -np.inf)
        self._rejected_since: dict[str, FloatArray] = {name: np.full(N_JOINTS, np.nan) for name in self._sensors}
        self._rejecting = False
        self._sides = Sides()
        self.behind: dict[str, float] = {}

    def forget(self) -> None:
        """Forget all frames, because the next ones are of another person."""
        super().forget()
        self._forget_output()

    # --- frames in

    def push(self, sensor: str, skeleton: Skeleton, now_ns: int) -> list[Skeleton]:
        """Take one frame of one sensor.

        Args:
            sensor: its name.
            skeleton: in the sensor's optical frame and clock.
            now_ns: when it arrived, in a clock that never goes back.

        Returns:
            The fused skeletons that are complete now, mostly one or none.
        """
        # The result does not depend on whether the caller polled in between.
        fused = self.poll(now_ns)
        source = self._known(sensor)
        if source is not None and self._accepts(sensor, source, skeleton, now_ns):
            fused += self.poll(now_ns)
        return fused

    def _accepts(self, sensor: str, source: _Sensor, skeleton: Skeleton, now_ns: int) -> bool:
        """Keep a frame, and queue an output at its time; False when the frame is unusable."""
        if source.frames and skeleton.stamp_ns <= source.frames[-1].stamp_ns:
            if not jumped_back(skeleton.stamp_ns, source.frames[-1].stamp_ns):
                self.counters["late"] += 1
                return False
            self._clock_jumped_back(sensor)
        stamp = source.stamp(skeleton.stamp_ns)
        if stamp is None or not self._in_step(sensor, stamp):
            self.counters["other_clock"] += 1
            return False
        if sensor == self.reference:
            self._restart_behind(stamp, now_ns)
        if skeleton.covariances is not None:  # not a Kinect, which states none
            self._sides.reliable.add(sensor)
        if self._last_ns is not None:
            self.behind[sensor] = (self._last_ns - stamp) / NANOSECONDS
        # Frames are stored before the sensor is calibrated, so that its frame period is known by then.
        self._remember(source, skeleton, stamp)
        if source.pose(stamp) is None:
            self.counters["uncalibrated"] += 1
        elif self._last_ns is not None and stamp <= self._last_ns:
            self.counters["late" if sensor == self.reference else "missed"] += 1
        else:
            deadline = now_ns + round(self.parameters.max_wait * NANOSECONDS)
            insort(self._pending, (stamp, sensor != self.reference, deadline))
        return True

    def _restart_behind(self, stamp: int, now_ns: int) -> None:
        """Restart the output when the reference's frames have been over a second behind it for over a second.

        A wrong clock relation of another sensor may have put the output far ahead.
        """
        if self._last_ns is None or self._last_ns <= stamp + JUMP_BACK_NS:
            self._behind_since_ns = None
        elif self._behind_since_ns is None:
            self._behind_since_ns = now_ns
        elif now_ns - self._behind_since_ns > JUMP_BACK_NS:
            self._forget_output()
            self.counters["resets"] += 1

    def _remember(self, source: _Sensor, skeleton: Skeleton, stamp: int) -> None:
        known = skeleton.valid
        positions, states = skeleton.positions, skeleton.states
        if not known.all():
            positions = np.where(known[:, None], positions, np.nan)
            states = np.where(known, states, 0)
        last = source.frames[-1] if source.frames else None
        step = math.inf if last is None else (skeleton.stamp_ns - last.stamp_ns) / NANOSECONDS
        if step < _LONGEST_PERIOD:
            source.rhythm.add(step)
        if last is not None and step < self._silence_of(source):
            # Smoothed over about three frames: the difference of two is mostly noise.
            share = 1.0 - math.exp(-step / SMOOTHING)
            change = (positions - last.positions) / step
            velocities = last.velocities + share * (change - last.velocities)
            fast = ~(np.abs(change).max(axis=1) < MAX_SPEED)  # or NaN; only a label that jumps is so fast
            if fast.any():
                velocities[fast] = 0.0
            since = last.since_ns
        else:
            velocities = np.zeros((N_JOINTS, 3))
            since = stamp
        angle = viewing_angle(positions)
        variance = joint_variance(positions, _with_hidden_forearms(states), skeleton.covariances, angle)
        source.frames.append(
            _Frame(skeleton.stamp_ns, positions, velocities, variance, states, float(angle), skeleton.body, since)
        )

    def _silence_of(self, source: _Sensor) -> float:
        """Seconds without a frame after which a sensor is silent; more than ``silence`` for one that is slow."""
        period = source.rhythm.period
        return self.parameters.silence if period < _SLOW else max(self.parameters.silence, _MISSED * period)

    def poll(self, now_ns: int) -> list[Skeleton]:
        """The fused skeletons whose wait is over."""
        fused = []
        while self._pending:
            stamp, other, deadline = self._pending[0]
            # Another sensor's frame gives an output only when the reference has been silent for a while.
            if other and stamp - self._last_output(stamp) <= self._least_gap(stamp):
                del self._pending[0]
                continue
            due = self._due(stamp)
            if now_ns < deadline and any(rhythm.worth_waiting for rhythm in due):
                break
            for source in self._sensors.values():
                source.rhythm.record(arrived=source.rhythm not in due)
            del self._pending[0]
            skeleton = self._fuse(stamp)
            if skeleton is not None:
                fused.append(skeleton)
        return fused

    def _least_gap(self, stamp: int) -> int:
        """Time since the last output that a frame of another sensor than the reference needs for the next one."""
        reference = self._sensors[self.reference]
        if not reference.frames:
            return MAX_OUTPUT_GAP
        fastest = min(source.rhythm.period for source in self._sensors.values() if source.frames)
        silent = stamp - reference.frames[-1].stamp_ns > self._silence_of(reference) * NANOSECONDS
        if silent or reference.rhythm.period > _SLOWER * fastest:
            return round(SHARE_OF_PERIOD * fastest * NANOSECONDS)
        return MAX_OUTPUT_GAP

    def _last_output(self, stamp: int) -> int:
        """Time of the last output or, at the start, of the first frame."""
        if self._last_ns is not None:
            return self._last_ns
        return min((source.frames[0].since_ns for source in self._sensors.values() if source.frames), default=stamp)

    def _due(self, stamp: int) -> list[Rhythm]:
        """Rhythms of the calibrated sensors whose frame captured up to a time is due and has not arrived."""
        due = []
        for source in self._sensors.values():
            if not source.frames or source.pose(stamp) is None:
                continue
            age = (stamp - source.to_reference(source.frames[-1].stamp_ns)) / NANOSECONDS
            if source.rhythm.due(age, self._silence_of(source)):
                due.append(source.rhythm)
        return due

    @property
    def deadline_ns(self) -> int | None:
        """When :meth:`poll` should be called, in the clock of ``now_ns``; None while nothing waits."""
        return self._pending[0][2] if self._pending else None

    # --- fusion

    def _fuse(self, stamp: int) -> Skeleton | None:
        names: list[str] = []
        frames: list[_Frame] = []
        ages: list[float] = []
        poses: list[SensorPose] = []
        shares: list[float] = []
        for name, source in self._sensors.items():
            source.forget_before(stamp)
            pose = source.pose(stamp)
            frame = next(
                (each for each in reversed(source.frames) if source.to_reference(each.stamp_ns) <= stamp), None
            )
            if pose is None or frame is None:
                continue
            age = (stamp - source.to_reference(frame.stamp_ns)) / NANOSECONDS
            if age > self._silence_of(source):
                self.counters["silent"] += 1
                continue
            names.append(name)
            frames.append(frame)
            ages.append(age)
            poses.append(pose)
            fade = max(self.parameters.fade_in, 1e-9)
            shares.append(min(1.0, max(0.02, (stamp - frame.since_ns) / NANOSECONDS / fade)))
        if not names:
            return None
        self.counters["fused"] += 1
        self._last_ns = stamp
        thesis = self.parameters.method != "covariance"
        points = np.stack(
            [
                pose.apply(frame.positions + (0.0 if thesis else min(age, EXTRAPOLATE)) * frame.velocities)
                for pose, frame, age in zip(poses, frames, ages, strict=True)
            ]
        )
        states = np.stack([frame.states for frame in frames])
        variance = np.stack([frame.variance for frame in frames])
        body = frames[0].body
        if thesis:
            weights = thesis_text(states) if self.parameters.method == "thesis_text" else thesis_formula(states)
            return self._combined(stamp, body, points, variance, weights, states)
        # Process noise between a sensor's capture and the output's.
        variance += np.array([[(0.5 * ACCELERATION * age**2) ** 2] for age in ages])
        angles = [frame.angle for frame in frames]
        heading_agrees = self._sides.correct(stamp, names, angles, points, variance, states, self.counters)
        weights = self._gated(stamp, names, points, variance, heading_agrees)
        if min(shares) < 1.0:
            weights *= np.array(shares)[:, None]
        fused = self._combined(stamp, body, points, variance, weights, states)
        fused = self._sides.limit_turn_rate(stamp, fused, self.counters)
        self._follow(stamp, fused.positions)
        return fused

    def _gated(
        self, stamp: int, names: list[str], points: FloatArray, variance: FloatArray, heading_agrees: BoolArray
    ) -> FloatArray:
        """(k, 25) weights: inverse variances, reduced by the residual to the prediction, 0 beyond the gate."""
        # An unknown joint has an infinite variance; one without a recent past has an infinite prediction error.
        weights = 1.0 / variance
        elapsed = (stamp - self._known_ns) / NANOSECONDS
        spread = 0.03**2 + (0.5 * ACCELERATION * elapsed**2 + 0.5 * elapsed) ** 2
        spread[elapsed > REACQUIRE] = np.inf
        away = points - (self._position + np.minimum(elapsed, 1.0)[:, None] * self._velocity)
        squared = np.einsum("kji,kji->kj", away, away) / (variance + spread)
        far = squared > GATE**2  # False for NaN
        if far.any() or self._rejecting:
            self._readmit(stamp, names, far)
        # The shoulders, and the hips, are gated together: the axis between them needs both from the same sensors. Axes
        # of plausible width that agree with the accepted heading are not gated: the prediction lags behind a turn.
        for half, (pair, (least, most)) in enumerate(zip(PAIRS, _WIDTHS, strict=True)):
            far[:, pair] |= far[:, pair[::-1]]
            width = np.linalg.norm(points[:, pair[0]] - points[:, pair[1]], axis=1)
            turned = np.flatnonzero(heading_agrees[:, half] & (least < width) & (width < most))
            far[turned[:, None], pair] = False
            squared[turned[:, None], pair] = 0.0
        weights /= 1.0 + squared / 4.0
        weights[far | ~np.isfinite(weights)] = 0.0
        self.counters["gated_joints"] += int(np.count_nonzero(far))
        return weights

    def _readmit(self, stamp: int, names: list[str], far: BoolArray) -> None:
        """Accept, in place, joints that a sensor has reported outside the gate for :data:`REACQUIRE`."""
        for index, name in enumerate(names):
            since = self._rejected_since[name]
            since[~far[index]] = np.nan
            since[far[index] & np.isnan(since)] = stamp
            far[index] &= stamp - since <= REACQUIRE * NANOSECONDS
        self._rejecting = any(not np.isnan(since).all() for since in self._rejected_since.values())

    def _combined(
        self, stamp: int, body: int, points: FloatArray, variance: FloatArray, weights: FloatArray, states: np.ndarray
    ) -> Skeleton:
        """The weighted mean (Schlagenhauf 2017, eq. 5.8, for any number of sensors).

        Its covariance is the stated one, or the sensors' disagreement if larger.
        """
        used = weights > 0.0
        if not used.all():
            used &= np.isfinite(points[..., 0])
            weights = np.where(used, weights, 0.0)
            points = np.where(used[..., None], points, 0.0)
            variance = np.where(used, variance, 0.0)
            states = np.where(used, states, 0)
        total = weights.sum(axis=0)
        known = total > 0.0
        share = weights / np.where(known, total, 1.0)
        mean = np.einsum("kj,kji->ji", share, points)
        away = points - mean
        # what displaces a joint before all sensors alike does not average out
        common = np.where(used, np.minimum(variance, COMMON_SHARE * BASE_STDDEV**2), 0.0)
        claimed = np.einsum("kj,kj,kj->j", share, share, variance - common) + np.einsum("kj,kj->j", share, common)
        covariance = np.einsum("kj,kji,kjl->jil", share, away, away)
        # Add only the disagreement beyond the stated variance: along two sensors' difference the larger one results.
        spread = np.einsum("jii->j", covariance)
        covariance *= (np.maximum(spread - claimed, 0.0) / np.maximum(spread, 1e-12))[:, None, None]
        covariance[:, _DIAGONAL, _DIAGONAL] += claimed[:, None]
        if not known.all():
            mean[~known], covariance[~known] = np.nan, np.nan
        return Skeleton(stamp, self.world, mean, states.max(axis=0), body, covariance)

    def _follow(self, stamp: int, positions: FloatArray) -> None:
        """Update position and smoothed velocity of the output for the next prediction."""
        known = np.isfinite(positions[:, 0])
        elapsed = (stamp - self._known_ns) / NANOSECONDS
        smoothing = (1.0 - np.exp(-elapsed / SMOOTHING))[:, None]
        velocity = self._velocity + smoothing * ((positions - self._position) / elapsed[:, None] - self._velocity)
        velocity[~(elapsed < REACQUIRE)] = 0.0
        if known.all():
            self._position, self._velocity, self._known_ns = positions, velocity, np.full(N_JOINTS, float(stamp))
        else:
            self._position = np.where(known[:, None], positions, self._position)
            self._velocity = np.where(known[:, None], velocity, self._velocity)
            self._known_ns = np.where(known, stamp, self._known_ns)
