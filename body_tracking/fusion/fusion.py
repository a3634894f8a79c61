"""One skeleton from what several sensors see, by capture time.

The fused skeleton is a function of the stamps alone: one comes out per frame of the reference sensor (or, while that
is silent, of another), at that frame's capture time, from each sensor's newest frame captured up to then. A frame
waits only while another sensor's is due, and then a few milliseconds; so the delay stays small, and what arrives a
little earlier or later gives the same numbers.
"""

from __future__ import annotations

from bisect import bisect_right, insort
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from body_tracking.calibration.result import ClockModel, SensorPose
from body_tracking.errors import BodyTrackingError
from body_tracking.fusion.weights import thesis_formula, thesis_text
from body_tracking.measurement import joint_stddev, left_right_axes, viewing_angle
from body_tracking.skeleton import MIRROR, N_JOINTS, NANOSECONDS, BoolArray, FloatArray, Joint, Skeleton

WORLD = "world"

CLOCK_JUMP = 1.0
"""A sensor whose stamps go back by more than this starts again, seconds."""

DUE_MARGIN = 0.002
"""A frame counts as due when it is expected up to this much after the frame that waits, seconds: stamps jitter."""

FASTEST = 8.0
"""No joint moves faster than this along an axis, metres per second."""

ACCELERATION = 30.0
"""Typical peak acceleration of a limb, m/s^2; what extrapolation and prediction cannot know."""

MORE_FRONTAL = np.pi / 6
"""A sensor is believed more on left and right when it sees the body this much more from the front, radians ..."""

TRUST_AFTER = 1.0
"""... for this long, while it agrees with the one believed so far, seconds."""

SAME_SENSE = 0.5
"""Cosine between two axes above which they have the same sense; a mean of axes farther apart has no length left."""

_LOWER = np.isin(
    np.arange(N_JOINTS), [joint for joint in Joint if joint.name.startswith(("HIP", "KNEE", "ANKLE", "FOOT"))]
)
_LATERAL = np.arange(N_JOINTS) != MIRROR
_HALVES = (np.flatnonzero(_LATERAL & ~_LOWER), np.flatnonzero(_LATERAL & _LOWER))
"""The joints that have a left and a right: of the upper and of the lower body."""

_PAIRS = (
    np.array([Joint.SHOULDER_LEFT, Joint.SHOULDER_RIGHT], dtype=np.intp),
    np.array([Joint.HIP_LEFT, Joint.HIP_RIGHT], dtype=np.intp),
)
"""The ends of their left-right axes."""

_WIDTHS = ((0.15, 0.6), (0.05, 0.4))
"""Lengths of these axes that can be a person's, as a Kinect sees it, metres."""

TURN_RATE = 8.0
"""A person's shoulders turn no faster than this, radians per second (throwing athletes' trunks reach it)."""

TURN_ONCE = np.pi / 3
"""... and by no more than this between two outputs, however long they are apart, radians."""


class FusionError(BodyTrackingError):
    """The sensors or parameters given to the fusion make no sense."""


@dataclass(frozen=True, slots=True)
class FusionParameters:
    """Parameters of the fusion."""

    method: str = field(
        default="covariance",
        metadata={
            "doc": "covariance: weighted by each joint's uncertainty, gated, turned bodies repaired; thesis_text: only "
            "Tracked joints where any sensor tracks them; thesis_formula: in proportion to the tracking states",
            "choices": ("covariance", "thesis_text", "thesis_formula"),
        },
    )
    silence: float = field(
        default=0.1,
        metadata={"doc": "drop a sensor whose newest frame is older than this", "unit": "s", "min": 0.02, "max": 5.0},
    )
    max_wait: float = field(
        default=0.05,
        metadata={
            "doc": "wait at most this long for another sensor's frame that is due; 0 for the least delay",
            "unit": "s",
            "min": 0.0,
            "max": 1.0,
        },
    )
    max_output_gap: float = field(
        default=0.065,
        metadata={
            "doc": "let another sensor give the beat when the reference is silent for this long",
            "unit": "s",
            "min": 0.01,
            "max": 5.0,
        },
    )
    extrapolate: float = field(
        default=0.05,
        metadata={"doc": "carry a sensor's older frame forward by at most this", "unit": "s", "min": 0.0, "max": 0.5},
    )
    gate: float = field(
        default=3.5,
        metadata={
            "doc": "reject a joint farther from its prediction than this many standard deviations",
            "min": 1.0,
            "max": 100.0,
        },
    )
    reacquire: float = field(
        default=0.3,
        metadata={
            "doc": "believe a sensor again that insists on a rejected joint for this long",
            "unit": "s",
            "min": 0.0,
            "max": 10.0,
        },
    )
    fade_in: float = field(
        default=0.5,
        metadata={
            "doc": "let a sensor that appears or returns gain its full weight over this time",
            "unit": "s",
            "min": 0.0,
            "max": 10.0,
        },
    )
    turned_hold: float = field(
        default=1.0,
        metadata={
            "doc": "hold left and right against a body that all sensors see reversed at once, for this long",
            "unit": "s",
            "min": 0.0,
            "max": 60.0,
        },
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Frame:
    """One frame of one sensor, in its optical frame and clock."""

    stamp_ns: int
    positions: FloatArray
    velocities: FloatArray
    stddev: FloatArray
    states: np.ndarray
    angle: float
    body: int
    since_ns: int  # reference time of the first frame of its run, after a silence


class _Sensor:
    """The recent frames of one sensor and where and when it is."""

    def __init__(self) -> None:
        self.poses: list[SensorPose] = []  # by valid_from_ns, from the one in force at the last output on
        self.clocks: list[tuple[int, ClockModel]] = []  # likewise
        self.clear()

    def clear(self) -> None:
        self.frames: deque[_Frame] = deque(maxlen=8)
        self._steps: deque[float] = deque(maxlen=7)

    def remember(self, frame: _Frame, step: float | None) -> None:
        """Keep a frame, and how long after the one before it came, if it is of one run with that."""
        self.frames.append(frame)
        if step is not None:
            self._steps.append(step)

    @property
    def period(self) -> float:
        """Seconds between frames, by the median: a lost frame does not make a sensor slower."""
        return sorted(self._steps)[len(self._steps) // 2] if self._steps else 1.0 / 30.0

    def to_reference(self, sensor_ns: int) -> int:
        """A stamp of this sensor in the reference's clock, by the relation that is in force then."""
        found = sensor_ns
        for index, (valid_from_ns, clock) in enumerate(self.clocks):
            reference_ns = clock.to_reference(sensor_ns)
            if index > 0 and reference_ns < valid_from_ns:
                break
            found = reference_ns
        return found

    def pose(self, now_ns: int) -> SensorPose | None:
        """The pose in force at a reference time."""
        at = bisect_right(self.poses, now_ns, key=_valid_from)
        return self.poses[at - 1] if at else None

    def forget_before(self, now_ns: int) -> None:
        """Drop poses and clocks that others have replaced by then."""
        del self.poses[: max(0, bisect_right(self.poses, now_ns, key=_valid_from) - 1)]
        del self.clocks[: max(0, bisect_right(self.clocks, now_ns, key=lambda each: each[0]) - 1)]


def _valid_from(pose: SensorPose) -> int:
    return pose.valid_from_ns


class Fusion:
    """Fuses the skeletons of any number of calibrated sensors.

    Args:
        sensors: their names.
        parameters: see :class:`FusionParameters`.
        reference: the sensor whose clock is the output's and that gives the beat; the first one when None.
        world: the frame of the output.
    """

    def __init__(
        self,
        sensors: Sequence[str],
        parameters: FusionParameters | None = None,
        reference: str | None = None,
        world: str = WORLD,
    ) -> None:
        self.parameters = parameters or FusionParameters()
        self.reference = reference or (sensors[0] if sensors else "")
        if self.reference not in sensors:
            raise FusionError(f"reference sensor {self.reference!r} is not among the sensors {', '.join(sensors)}")
        self.world = world
        self.counters: Counter[str] = Counter()
        self._sensors = {name: _Sensor() for name in sensors}
        # Frames that may be answered: capture time, whether not the reference's, and until when it may wait.
        self._pending: list[tuple[int, bool, int]] = []
        self._forget_output()

    def _forget_output(self) -> None:
        self._pending.clear()
        self._last_ns: int | None = None
        self._position: FloatArray = np.full((N_JOINTS, 3), np.nan)
        self._velocity: FloatArray = np.zeros((N_JOINTS, 3))
        self._known_ns: FloatArray = np.full(N_JOINTS, -np.inf)
        self._rejected_since: dict[str, FloatArray] = {name: np.full(N_JOINTS, np.nan) for name in self._sensors}
        self._trusted: str | None = None
        self._trusted_ns = 0
        self._axes: FloatArray = np.zeros((2, 3))
        self._heading: FloatArray = np.zeros(2)
        self._heading_ns: FloatArray = np.full(2, -np.inf)
        self._better_since: int | None = None
        self._reversed_since: FloatArray = np.full(2, np.nan)

    def reset(self) -> None:
        """Forget all frames; calibrations stay, and those that wait for their time come into force."""
        for sensor in self._sensors.values():
            sensor.clear()
            del sensor.poses[:-1], sensor.clocks[:-1]
            if sensor.poses:
                pose = sensor.poses[0]
                sensor.poses[0] = SensorPose(pose.sensor, pose.translation, pose.quat_xyzw)
        self._forget_output()
        self.counters["resets"] += 1

    # --- calibration in

    def set_pose(self, pose: SensorPose) -> None:
        """Take a sensor's pose, in force from its ``valid_from_ns``; unknown sensors are counted and ignored."""
        sensor = self._sensors.get(pose.sensor)
        if sensor is None:
            self.counters["unknown_sensor"] += 1
            return
        at = bisect_right(sensor.poses, pose.valid_from_ns, key=_valid_from)
        sensor.poses.insert(at, pose)

    def set_clock(self, sensor: str, valid_from_ns: int, clock: ClockModel) -> None:
        """Take a sensor's clock, in force from a reference time; unknown sensors are counted and ignored."""
        known = self._sensors.get(sensor)
        if known is None:
            self.counters["unknown_sensor"] += 1
            return
        at = bisect_right(known.clocks, valid_from_ns, key=lambda each: each[0])
        known.clocks.insert(at, (valid_from_ns, clock))

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
        # What has waited long enough does not know this frame, whether or not somebody polled in between.
        fused = self.poll(now_ns)
        source = self._sensors.get(sensor)
        if source is None:
            self.counters["unknown_sensor"] += 1
        elif self._accepts(sensor, source, skeleton, now_ns):
            fused += self.poll(now_ns)
        return fused

    def _accepts(self, sensor: str, source: _Sensor, skeleton: Skeleton, now_ns: int) -> bool:
        """Remember a frame, and note whether the output is to answer it; False when it is of no use."""
        if source.frames and skeleton.stamp_ns <= source.frames[-1].stamp_ns:
            if source.frames[-1].stamp_ns - skeleton.stamp_ns < CLOCK_JUMP * NANOSECONDS:
                self.counters["late"] += 1
                return False
            if sensor == self.reference:
                self.reset()
            else:
                source.clear()
                self.counters["resets"] += 1
        stamp = source.to_reference(skeleton.stamp_ns)
        # Frames are remembered before the sensor is calibrated, so that it is known by then when its next one is due.
        self._remember(source, skeleton, stamp)
        if source.pose(stamp) is None:
            self.counters["uncalibrated"] += 1
        elif self._last_ns is not None and stamp <= self._last_ns:
            self.counters["late"] += sensor == self.reference
        else:
            deadline = now_ns + round(self.parameters.max_wait * NANOSECONDS)
            insort(self._pending, (stamp, sensor != self.reference, deadline))
        return True

    def _remember(self, source: _Sensor, skeleton: Skeleton, stamp: int) -> None:
        known = skeleton.valid
        positions = np.where(known[:, None], skeleton.positions, np.nan)
        states = np.where(known, skeleton.states, 0)
        velocities = np.zeros((N_JOINTS, 3))
        last = source.frames[-1] if source.frames else None
        step = np.inf if last is None else (skeleton.stamp_ns - last.stamp_ns) / NANOSECONDS
        if last is not None and step < self.parameters.silence:
            # Smoothed over about three frames: the difference of two is mostly noise.
            share = 1.0 - np.exp(-step / 0.1)
            change = (positions - last.positions) / step
            moved = np.abs(change).max(axis=1, keepdims=True) < FASTEST  # False for NaN; a label that jumps is faster
            velocities = np.where(moved, last.velocities + share * (change - last.velocities), 0.0)
            since = last.since_ns
        else:
            since = stamp
        angle = viewing_angle(positions)
        stddev = joint_stddev(positions, states, angle)
        source.remember(
            _Frame(skeleton.stamp_ns, positions, velocities, stddev, states, float(angle), skeleton.body, since),
            step if step < self.parameters.silence else None,
        )

    def poll(self, now_ns: int) -> list[Skeleton]:
        """The fused skeletons that need wait no longer.

        Args:
            now_ns: as in :meth:`push`.
        """
        fused = []
        while self._pending:
            stamp, other, deadline = self._pending[0]
            # The beat is the reference's; another's frame is answered only when that has been silent for a while.
            if other and stamp - self._beat(stamp) <= self.parameters.max_output_gap * NANOSECONDS:
                del self._pending[0]
                continue
            if now_ns < deadline and self._waits(stamp):
                break
            del self._pending[0]
            skeleton = self._fuse(stamp)
            if skeleton is not None:
                fused.append(skeleton)
        return fused

    def _beat(self, stamp: int) -> int:
        """When the last output was, or, at the start, when somebody was first seen."""
        if self._last_ns is not None:
            return self._last_ns
        return min((source.frames[0].since_ns for source in self._sensors.values() if source.frames), default=stamp)

    def _waits(self, stamp: int) -> bool:
        """Whether a calibrated sensor's frame captured up to a time is due and has not arrived."""
        for source in self._sensors.values():
            if not source.frames or source.pose(stamp) is None:
                continue
            age = (stamp - source.to_reference(source.frames[-1].stamp_ns)) / NANOSECONDS
            if 0.0 < age < self.parameters.silence and age > source.period - DUE_MARGIN:
                return True
        return False

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
            if age > self.parameters.silence:
                self.counters["silent"] += 1
                continue
            fade = self.parameters.fade_in
            names.append(name)
            frames.append(frame)
            ages.append(age)
            poses.append(pose)
            shares.append(1.0 if fade <= 0.0 else min(1.0, max(0.02, (stamp - frame.since_ns) / NANOSECONDS / fade)))
        if not names:
            return None
        self.counters["fused"] += 1
        gap = np.inf if self._last_ns is None else (stamp - self._last_ns) / NANOSECONDS
        self._last_ns = stamp
        thesis = self.parameters.method != "covariance"
        ahead = np.zeros(len(ages)) if thesis else np.minimum(ages, self.parameters.extrapolate)
        points = np.stack(
            [
                pose.apply(frame.positions + step * frame.velocities)
                for pose, frame, step in zip(poses, frames, ahead.tolist(), strict=True)
            ]
        )
        states = np.stack([frame.states for frame in frames])
        stddev = np.stack([frame.stddev for frame in frames])
        body = frames[0].body
        if thesis:
            weights = thesis_text(states) if self.parameters.method == "thesis_text" else thesis_formula(states)
            return self._combined(stamp, body, points, stddev**2, weights, states)
        # What moves between a sensor's capture and the output's is not known better than this.
        variance = stddev**2 + (0.5 * ACCELERATION * np.square(ages))[:, None] ** 2
        self._settle_sides(stamp, names, frames, points, variance, states)
        weights = self._gated(stamp, gap, names, points, variance) * np.array(shares)[:, None]
        fused = self._turned_gently(stamp, self._combined(stamp, body, points, variance, weights, states))
        self._follow(stamp, gap, fused.positions)
        return fused

    def _turned_gently(self, stamp: int, fused: Skeleton) -> Skeleton:
        """Turn shoulders and hips, with arms and legs, no faster than a person can.

        When the sensors that are believed change their mind at once about which way a body faces, the output follows
        them on the way that a body would take, and never through a mirror.
        """
        axes = left_right_axes(fused.positions)
        heading = np.arctan2(axes[:, 1], axes[:, 0])
        known = np.isfinite(heading)
        elapsed = (stamp - self._heading_ns) / NANOSECONDS
        turn = (heading - self._heading + np.pi) % (2 * np.pi) - np.pi
        most = np.minimum(TURN_RATE * elapsed, TURN_ONCE)
        excess = np.where(
            known & (elapsed < TRUST_AFTER) & (np.abs(turn) > most), np.sign(turn) * (np.abs(turn) - most), 0.0
        )
        self._heading = np.where(known, heading - excess, self._heading)
        self._heading_ns = np.where(known, stamp, self._heading_ns)
        if not excess.any():
            return fused
        assert fused.covariances is not None
        positions, covariances = fused.positions.copy(), fused.covariances.copy()
        for half in np.flatnonzero(excess):
            joints, angle = _HALVES[half], -float(excess[half])
            pair = _PAIRS[half]
            centre = positions[pair].mean(axis=0)
            arms = positions[joints] - centre
            rotation = np.array(
                [[np.cos(angle), -np.sin(angle), 0.0], [np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]]
            )
            moved = arms @ rotation.T
            # What was turned is as uncertain as it was moved.
            covariances[joints] += np.einsum("ji,jk->jik", moved - arms, moved - arms)
            positions[joints] = centre + moved
        self.counters["turned_gently"] += 1
        return Skeleton(
            fused.stamp_ns, fused.frame_id, positions, fused.states, fused.body, covariances, fused.velocities
        )

    def _settle_sides(
        self,
        stamp: int,
        names: list[str],
        frames: list[_Frame],
        points: FloatArray,
        variance: FloatArray,
        states: np.ndarray,
    ) -> None:
        """Repair or reject, in place, what a sensor sees turned around or with its sides swapped.

        A Kinect takes every body to face it, and sometimes turns only the shoulders. Of sensors that contradict each
        other one is believed: the one that saw the body from the front while they agreed. Where a sensor's left-right
        axis is opposite to the believed one, left and right are exchanged; where it is across, only the joints of the
        midline are kept; upper and lower body each by their own axis.
        """
        axes = left_right_axes(points)
        axes[..., 2] = 0.0
        length = np.linalg.norm(axes, axis=-1)
        usable = np.isfinite(length) & (length > 0.02)
        units = np.where(usable[..., None], axes / np.where(usable, length, 1.0)[..., None], 0.0)
        if not usable.any():
            return
        believed = self._believed(stamp, names, frames, units, usable)
        agreement = np.einsum("kai,ai->ka", units, believed)
        for index, half in np.argwhere(usable & (agreement < SAME_SENSE)):
            joints = _HALVES[half]
            if agreement[index, half] < -SAME_SENSE:
                other = MIRROR[joints]
                points[index, joints] = points[index, other]
                variance[index, joints] = 2.0 * variance[index, other]
                states[index, joints] = states[index, other]
                self.counters["repaired"] += 1
            else:
                variance[index, joints] = np.inf
                self.counters["turned"] += 1

    def _believed(
        self, stamp: int, names: list[str], frames: list[_Frame], units: FloatArray, usable: BoolArray
    ) -> FloatArray:
        """(2, 3) the axes of shoulders and hips that are taken for true.

        They are those of the believed sensor; another takes over that sees the body more from the front for a while and
        agrees with it. While the believed one is missing for a moment, its last axes stand.
        """
        angles = np.where(usable[:, 0], [frame.angle for frame in frames], np.inf)
        recent = self._trusted is not None and stamp - self._trusted_ns <= TRUST_AFTER * NANOSECONDS
        if self._trusted in names and usable[names.index(self._trusted)].all():
            trusted = names.index(self._trusted)
        elif recent:
            return self._axes
        else:
            trusted = int(np.argmin(angles))
            self._reversed_since[:] = np.nan
        agreeing = usable[:, 0] & (units[:, 0] @ units[trusted, 0] > np.cos(np.pi / 4))
        better = int(np.argmin(np.where(agreeing, angles, np.inf)))
        if angles[trusted] - angles[better] <= MORE_FRONTAL:
            self._better_since = None
        elif self._better_since is None:
            self._better_since = stamp
        elif stamp - self._better_since > TRUST_AFTER * NANOSECONDS:
            trusted, self._better_since = better, None
        self._axes = self._senses(stamp, units[trusted], recent)[:, None] * units[trusted]
        self._trusted, self._trusted_ns = names[trusted], stamp
        return self._axes

    def _senses(self, stamp: int, axes: FloatArray, recent: bool) -> FloatArray:
        """(2,) of +1, or -1 while the believed sensor has just turned shoulders or hips around between two frames."""
        against = recent & (np.einsum("ai,ai->a", self._axes, axes) < -SAME_SENSE)
        self._reversed_since[~against] = np.nan
        self._reversed_since[against & np.isnan(self._reversed_since)] = stamp
        held = against & (stamp - self._reversed_since <= self.parameters.turned_hold * NANOSECONDS)
        self.counters["reversals_accepted"] += int((against & ~held).sum())
        return np.where(held, -1.0, 1.0)

    def _gated(self, stamp: int, gap: float, names: list[str], points: FloatArray, variance: FloatArray) -> FloatArray:
        """(k, 25) weights: the inverse variances, less for joints away from their prediction, none beyond the gate."""
        finite = np.isfinite(variance) & np.isfinite(points[..., 0])
        weights = np.where(finite, 1.0 / np.where(finite, variance, 1.0), 0.0)
        elapsed = np.where(np.isfinite(self._known_ns), (stamp - self._known_ns) / NANOSECONDS, np.inf)
        predictable = elapsed < self.parameters.reacquire
        if not predictable.any():
            return weights
        step = np.where(predictable, elapsed, 0.0)
        predicted = self._position + step[:, None] * self._velocity
        spread = 0.03**2 + (0.5 * ACCELERATION * step**2 + 0.5 * step) ** 2
        total = np.where(finite, variance, 1.0) + spread
        squared = np.square(points - predicted).sum(axis=2) / total
        far = finite & predictable & (squared > self.parameters.gate**2)
        for index, name in enumerate(names):
            since = self._rejected_since[name]
            since[~far[index]] = np.nan
            since[far[index] & np.isnan(since)] = stamp
            insists = far[index] & (stamp - since > self.parameters.reacquire * NANOSECONDS)
            far[index] &= ~insists
        # Both shoulders and both hips from the same sensors, or the axis between them means nothing; and the believed
        # sensor's at once, when it has turned them as a whole.
        for pair, (least, most) in zip(_PAIRS, _WIDTHS, strict=True):
            far[:, pair] = far[:, pair].any(axis=1, keepdims=True)
            if self._trusted in names:
                believed = names.index(self._trusted)
                if least < np.linalg.norm(points[believed, pair[0]] - points[believed, pair[1]]) < most:
                    far[believed, pair] = False
                    squared[believed, pair] = 0.0
        self.counters["gated_joints"] += int(far.sum())
        soft = np.where(predictable & finite, 1.0 / (1.0 + squared / 4.0), 1.0)
        return np.where(far, 0.0, weights * soft)

    def _combined(
        self, stamp: int, body: int, points: FloatArray, variance: FloatArray, weights: FloatArray, states: np.ndarray
    ) -> Skeleton:
        """The weighted mean (eq. 5.8), with the covariance that the sensors claim, or their disagreement if larger."""
        used = (weights > 0.0) & np.isfinite(points[..., 0])
        weights = np.where(used, weights, 0.0)
        total = weights.sum(axis=0)
        known = total > 0.0
        share = weights / np.where(known, total, 1.0)
        points = np.where(used[..., None], points, 0.0)
        mean = np.einsum("kj,kji->ji", share, points)
        away = np.where(used[..., None], points - mean, 0.0)
        finite = np.where(used & np.isfinite(variance), variance, 0.0)
        claimed = np.einsum("kj,kj->j", share**2, finite)
        covariance = np.einsum("kj,kji,kjl->jil", share, away, away)
        # Only what they disagree beyond their claims: for two sensors the larger of both along their difference.
        spread = np.trace(covariance, axis1=1, axis2=2)
        covariance *= (np.maximum(spread - claimed, 0.0) / np.maximum(spread, 1e-12))[:, None, None]
        covariance[:, [0, 1, 2], [0, 1, 2]] += claimed[:, None]
        return Skeleton(
            stamp,
            self.world,
            np.where(known[:, None], mean, np.nan),
            np.where(used, states, 0).max(axis=0).astype(np.uint8),
            body,
            np.where(known[:, None, None], covariance, np.nan),
        )

    def _follow(self, stamp: int, gap: float, positions: FloatArray) -> None:
        """Keep position and smoothed velocity of the output for the next prediction."""
        known = np.isfinite(positions[:, 0])
        if gap < self.parameters.reacquire:
            elapsed = (stamp - self._known_ns) / NANOSECONDS
            recent = known & (elapsed < self.parameters.reacquire)
            change = (positions - self._position) / np.where(recent, elapsed, 1.0)[:, None]
            smoothing = (1.0 - np.exp(-np.where(recent, elapsed, 0.0) / 0.1))[:, None]
            self._velocity = np.where(recent[:, None], self._velocity + smoothing * (change - self._velocity), 0.0)
        else:
            self._velocity = np.zeros((N_JOINTS, 3))
        self._position = np.where(known[:, None], positions, self._position)
        self._known_ns = np.where(known, stamp, self._known_ns)
