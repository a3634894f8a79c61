"""Inertial sensors as a source: readings in, orientations of segments and a skeleton in ``world`` out.

Combines the other modules of this package: each sensor's orientation in an earth frame of its own (``worn``), its
alignment and heading by a pose and by a camera's bones (``held_pose``, ``alignment``, ``heading``), its clock
(``timing``, ``clock``), exchanged and slipped sensors (``detection``), and the body that fits all (``body``).

Headings: with a camera, ``world`` is the camera's. Without one, x is where the person faced in the pose; the common
part of all headings drifts, and the covariance grows with it.

Over 500 lines: one state machine over the estimators of the other modules; an alignment, a slip or an exchange of two
sensors changes the headings of all.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from body_tracking.calibration.clock_correlation import Series
from body_tracking.core import so3
from body_tracking.core.clocks import JUMP_BACK_NS, jumped_back
from body_tracking.core.errors import BodyTrackingError, one_of
from body_tracking.core.imu import ImuSample
from body_tracking.core.orientation import SegmentOrientation
from body_tracking.core.skeleton import NANOSECONDS, FloatArray, Skeleton
from body_tracking.inertial.alignment import (
    TISSUE_STDDEV,
    Alignment,
    Stream,
    align_in_pose,
    yaw,
)
from body_tracking.inertial.body import WornBody, joint_variances
from body_tracking.inertial.clock import clock_offset, turning_of_bone, turning_of_sensor
from body_tracking.inertial.detection import SlipDetector, assign, likelihood_by_motion, likelihood_by_pose
from body_tracking.inertial.heading import HEADING_WALK, JOINTS, HeadingTracker, bone_of
from body_tracking.inertial.held_pose import HeldPose, PoseFinder
from body_tracking.inertial.mounting import mountings as intended_mountings
from body_tracking.inertial.parameters import ARMS_DOWN, AUTO, REFERENCE, T_POSE, TrackingParameters
from body_tracking.inertial.timing import SensorClocks
from body_tracking.inertial.worn import UNKNOWN_HEADING, OrientedReading, WornSensor
from body_tracking.kinematics.upper_body import UpperBody

_STEP_NS = NANOSECONDS // 10
"""Period of the slow estimates: bones, poses, elbows, clocks."""
_AHEAD_OF = 0.85
"""Share of the output period after which the next orientation is published. Every third reading of 100 Hz comes after
nine tenths of the period of 30 Hz, and stamps jitter."""
_POSE_S, _POSE_EVERY_S = 1.6, 0.25
"""Seconds of readings in which a pose is searched, and seconds between searches."""
_POSES = {
    AUTO: "a T-pose with palms down, or arms hanging with thumbs forward,",
    T_POSE: "a T-pose with palms down",
    ARMS_DOWN: "arms hanging with thumbs forward",
}
"""What the person holds to align the sensors, by the parameter ``pose``."""
_ASKED_S = 15.0
"""Seconds within which a requested pose must be held."""
_CAMERA_LASTS = 12.0
"""Factor on ``heading.CAMERA_TIME``: a camera's joint offsets persist longer than its other errors."""
_CAMERA_SLIPS = 3.0
"""Such a factor for slips: part of the longer-lasting errors is equal before and after a slip, and cancels."""
_ALONE_S = 5.0
"""Seconds after which the tracker starts without a camera's skeleton."""
_FRESH_NS = NANOSECONDS // 2
_PENDING_NS = NANOSECONDS // 20
"""Time that a skeleton waits for the readings around it."""
_ELBOW_S = 0.5
_DRIFT_S, _LOST = 1.0, 0.05
"""Seconds between updates of the drift, and rad2 at once from which a heading is lost instead of drifting."""
_CLOCK_EVERY_S, _CHECK_EVERY_S, _LOOK_BACK_S = 3.0, 5.0, 30.0
_CLOCK_WINDOW = 0.5
_SLIP_WINDOWS = 6.0, 18.0
"""Seconds of the two detectors: the short one finds large slips soon, the long one those near a camera's errors."""
_NAMED_S = 60.0
"""Seconds for which a slip is reported."""
_POSE_LIMIT = 20.0
"""Upper bound of the log likelihood ratio of a pose for the place of a sensor, which may be moved later."""
_FAR_HEADING = 0.5
"""Radians of a heading's standard deviation from which it counts as unknown."""
_MAGNETIC_WALK = 0.1 * HEADING_WALK
_RATE_STDDEV, _RATE_SHARE = 0.05, 0.1
"""rad/s, and share of the rate: standard deviation of a segment's rate, mostly by soft tissue."""
_EYE3 = np.eye(3)


class InertialTrackingError(BodyTrackingError):
    """Raised when the segments with sensors are unknown, repeated or none."""


@dataclass(frozen=True, slots=True, eq=False)
class TrackerOutput:
    """The output of one reading.

    Attributes:
        orientation: of the sensor's segment; None if it is not due or too uncertain.
        skeleton: the whole body; None if it is not due.
    """

    orientation: SegmentOrientation | None = None
    skeleton: Skeleton | None = None


_NO_OUTPUT: Final = TrackerOutput()


class InertialTracker:
    """Tracks orientations of segments from readings of several sensors and, optionally, a camera's skeletons.

    Args:
        segments: of ``UpperBody.segment_names``, each with a sensor.
        parameters: defaults where None.
        mountings: ``segment:axes`` of sensors that are not worn in the usual way (``mounting``).
        world: name of the output frame.

    Attributes:
        counters: event counts since the construction, for diagnostics.
        aligned: whether a pose has aligned the sensors.

    Raises:
        InertialTrackingError: no segment, one twice or an unknown one.
        MountingError: an invalid mounting.
    """

    def __init__(
        self,
        segments: Sequence[str],
        parameters: TrackingParameters | None = None,
        mountings: Sequence[str] = (),
        world: str = "world",
    ) -> None:
        self.parameters = TrackingParameters() if parameters is None else parameters
        self._model = UpperBody()
        unknown = [name for name in segments if name not in self._model.segment_names]
        if unknown or not segments or len(set(segments)) < len(segments):
            problem = f"unknown: {', '.join(unknown)}" if unknown else "one twice" if segments else "none"
            expected = one_of(", ".join(unknown), self._model.segment_names)
            raise InertialTrackingError(f"segments with inertial sensors: {problem}; {expected}")
        self.segments = tuple(segments)
        self._intended = intended_mountings(self.segments, mountings)
        self._world = world
        self.counters: Counter[str] = Counter()
        self._poses = PoseFinder(self._model)
        self._sensors = {name: WornSensor(name, magnetometer=self.parameters.magnetometer) for name in self.segments}
        self._begin()

    def _begin(self) -> None:
        """Set the initial state of person and time."""
        self._magnetic = np.zeros(len(self.segments), dtype=np.bool_)
        self._tracker = self._new_tracker(self._unaligned(self.segments))
        self._last = 0.0
        self._epoch_ns: int | None = None
        self.aligned = False
        self._asked_until: float | None = None
        self._clocks = SensorClocks(self.parameters.clock, self.segments)
        self._pending: deque[Skeleton] = deque()
        self._seen: deque[Skeleton] = deque()
        self._body = WornBody(self._model, self.parameters.stature, self._world)
        self._first_ns: int | None = None
        self._received_ns: int | None = None
        self._newest_ns: int | None = None
        self._due: dict[str, float] = {}
        self._published_ns: dict[str, int] = {}
        self._skeleton_ns: int | None = None
        self._slips: dict[str, tuple[float, str]] = {}
        self._exchanged: dict[str, str] = {}
        self._by_pose: dict[str, dict[str, float]] = {}
        self._detectors = {name: self._new_detectors() for name in self.segments}
        self._turn = 0

    def _unaligned(self, segments: Sequence[str]) -> Alignment:
        """Intended mountings with unknown headings."""
        prior = np.tile([self.parameters.mounting_stddev**2] * 3 + [UNKNOWN_HEADING], len(segments))
        meant = self._intended[[self.segments.index(name) for name in segments]]
        return Alignment(tuple(segments), meant, np.zeros(len(segments)), np.diag(prior))

    @staticmethod
    def _new_detectors() -> tuple[SlipDetector, ...]:
        return tuple(SlipDetector(window) for window in _SLIP_WINDOWS)

    def reset(self) -> None:
        """Start again, as after a jump of time; the counters stay."""
        for sensor in self._sensors.values():
            sensor.segment = sensor.stated
            sensor.reset()
        self._begin()

    def align(self) -> str:
        """Align again in the next pose that is held; returns the instruction for the caller."""
        self._asked_until = self._last + _ASKED_S
        return f"hold {_POSES[self.parameters.pose]} for four seconds, within the next {_ASKED_S:.0f} s"

    @property
    def alignment(self) -> Alignment:
        """The current alignment of ``segments``."""
        return self._tracker.alignment

    def problems(self, now_ns: int) -> tuple[str, ...]:
        """One line for each current problem.

        Args:
            now_ns: the time in the clock of receipt.
        """
        lines, unaligned = [], []
        for stated, sensor in self._sensors.items():
            if sensor.received_ns is None:
                lines.append(f"{stated}: nothing has come yet")
                continue
            silent = (now_ns - sensor.received_ns) / NANOSECONDS
            if silent > self.parameters.silent_after:
                lines.append(f"{stated}: silent for {silent:.0f} s")
                continue
            lines += [f"{stated}: {problem}" for problem in sensor.problems]
            if sensor.disturbed:
                lines.append(f"{stated}: magnetic field disturbed")
            if stated in self._exchanged:
                lines.append(f"{stated}: its sensor is on {self._exchanged[stated]}")
            if not sensor.problems and self._stddev(sensor) > self.parameters.largest_stddev:
                unaligned.append(stated)
        if unaligned:
            pose = _POSES[self.parameters.pose]
            lines.append(f"{', '.join(unaligned)}: not aligned: the person has to hold {pose} for four seconds")
        lines += [text for stamp, text in self._slips.values() if self._last - stamp < _NAMED_S]
        return tuple(lines)

    def state(self) -> dict[str, float]:
        """Standard deviations of alignments and headings, degrees, and clock offsets by motion, milliseconds."""
        stddev = np.degrees(self.alignment.stddev)
        values = {}
        for number, name in enumerate(self.segments):
            values[f"{name} alignment deg"] = round(float(np.sqrt((stddev[number, :3] ** 2).mean())), 1)
            values[f"{name} heading deg"] = round(float(stddev[number, 3]), 1)
        values |= {f"{name} clock ms": round(1e3 * offset, 1) for name, offset in self._clocks.found.items()}
        return values

    # --- readings

    def add(self, segment: str, sample: ImuSample, received_ns: int, *, skeleton: bool = True) -> TrackerOutput:
        """Take one reading.

        Args:
            segment: stated place of the sensor.
            sample: the reading.
            received_ns: time of receipt, in a clock common to all sensors and to the camera.
            skeleton: fit and return the whole body when it is due.

        Raises:
            InertialTrackingError: no such segment.
            ImuOrientationError: neither orientation nor rate and acceleration.
        """
        if segment not in self._sensors:
            raise InertialTrackingError(f"{segment}: no inertial sensor is expected there")
        self._receive(received_ns)
        sensor = self._sensors[segment]
        reading = sensor.take(sample, received_ns)
        self._clocks.take_reading(sample.stamp_ns, received_ns)
        if sensor.frozen:
            self.counters[f"repeated readings of {segment}"] += 1
        if reading is None or sensor.problems:
            return _NO_OUTPUT
        stamp_ns = reading.stamp_ns + self._offset_ns(sensor)
        if self._waits_for_camera(received_ns):
            return _NO_OUTPUT
        now = self._advance(stamp_ns)
        self._note_heading(sensor, now)
        if now >= self._due.get("step", -np.inf):
            self._due["step"] = now + _STEP_NS / NANOSECONDS
            self._step(now, stamp_ns)
        return TrackerOutput(
            self._orientation(sensor, reading, stamp_ns), self._skeleton(stamp_ns) if skeleton else None
        )

    def take_camera_frame(self, stamp_ns: int, received_ns: int) -> None:
        """Take the time of receipt of a frame of the camera whose clock is that of ``world``.

        Args:
            stamp_ns: of the frame.
            received_ns: as of :meth:`add`.
        """
        if not self.parameters.camera:
            return
        self._receive(received_ns)
        if self._clocks.take_camera_frame(stamp_ns, received_ns):
            self._rebase()

    def take_skeleton(self, skeleton: Skeleton, received_ns: int) -> None:
        """Take a camera's skeleton in ``world``; ignored with the parameter ``camera`` false."""
        if not self.parameters.camera:
            return
        self._receive(received_ns)
        newest, first = self._newest_ns, not self._clocks.camera_known
        back = jumped_back(skeleton.stamp_ns, newest)
        if newest is not None and skeleton.stamp_ns <= newest and not back:
            self.counters["camera's late frames"] += 1
            return
        jumped = self._clocks.take_skeleton(skeleton.stamp_ns, received_ns, back)
        if jumped:
            self.counters["camera's time jumped"] += 1
            self._pending.clear()
            self._seen.clear()
        if jumped or first:
            self._rebase()
        self._newest_ns = skeleton.stamp_ns
        self._pending.append(skeleton)
        self._seen.append(skeleton)
        while skeleton.stamp_ns - self._seen[0].stamp_ns > _LOOK_BACK_S * NANOSECONDS:
            self._seen.popleft()
        self._body.take_skeleton(skeleton)

    def _receive(self, received_ns: int) -> None:
        if jumped_back(received_ns, self._received_ns):
            self.counters["time jumps"] += 1
            self.reset()
        self._received_ns = received_ns
        if self._first_ns is None:
            self._first_ns = received_ns

    def _waits_for_camera(self, received_ns: int) -> bool:
        """Whether to wait for the camera's first skeleton, which defines the reference clock and ``world``."""
        if not self.parameters.camera or self._newest_ns is not None:
            return False
        assert self._first_ns is not None
        return received_ns - self._first_ns < _ALONE_S * NANOSECONDS

    # --- time

    def _offset_ns(self, sensor: WornSensor) -> int:
        """From a sensor's stamps to the output clock."""
        return self._clocks.offset_ns(sensor.stated, sensor.clock)

    def _rebase(self) -> None:
        """Restart all times after a change of the output clock."""
        self._tracker = self._new_tracker(self.alignment)
        self._epoch_ns, self._last = None, 0.0
        self._due.clear()
        self._published_ns.clear()
        self._skeleton_ns = None
        self._slips.clear()
        self._detectors = {name: self._new_detectors() for name in self.segments}
        self._asked_until = None if self._asked_until is None else _ASKED_S

    def _new_tracker(self, alignment: Alignment) -> HeadingTracker:
        return HeadingTracker(alignment, heading_walk=np.where(self._magnetic, _MAGNETIC_WALK, HEADING_WALK))

    def _advance(self, stamp_ns: int) -> float:
        """Seconds since the start, not decreasing."""
        if self._epoch_ns is None:
            self._epoch_ns = stamp_ns
        self._last = max(self._last, (stamp_ns - self._epoch_ns) / NANOSECONDS)
        return self._last

    def _note_heading(self, sensor: WornSensor, now: float) -> None:
        """Pass the loss of a sensor's heading and the presence of a magnetometer to the heading tracker."""
        number = self.segments.index(sensor.segment)
        if sensor.growth > _LOST:
            self._inflate_heading(number, sensor.growth, now)
            sensor.growth = 0.0
        if sensor.has_field != self._magnetic[number]:
            self._magnetic[number] = sensor.has_field
            self._tracker = self._new_tracker(self.alignment)

    def _note_drift(self, now: float) -> None:
        """Add the drift of the last second in excess of the assumed random walk."""
        for sensor in self._sensors.values():
            excess, sensor.growth = sensor.growth - HEADING_WALK**2 * _DRIFT_S, 0.0
            if excess > 0.0:
                self._inflate_heading(self.segments.index(sensor.segment), excess, now)

    def _inflate_heading(self, number: int, variance: float, now: float) -> None:
        """Add rad2 to the variance of a heading, up to that of an unknown one."""
        self._tracker.predict(max(now, self._last))
        a = self.alignment
        covariance = a.covariance.copy()
        place = 4 * number + 3
        covariance[place, place] += min(variance, max(0.0, UNKNOWN_HEADING - covariance[place, place]))
        self._tracker.alignment = Alignment(a.segments, a.rotations, a.headings, covariance)

    def _step(self, now: float, stamp_ns: int) -> None:
        """Run the slow estimates that are due."""
        while self._pending and self._pending[0].stamp_ns < max(stamp_ns, self._newest_ns or 0) - _PENDING_NS:
            self._compare(self._pending.popleft(), now)
        if self._is_due("drift", now, _DRIFT_S):
            self._note_drift(now)
        if self._is_due("pose", now, _POSE_EVERY_S):
            self._look_for_pose(now, stamp_ns)
        if self._is_due("elbow", now, _ELBOW_S):
            self._constrain(now, stamp_ns)
        if self._is_due("clock", now, _CLOCK_EVERY_S):
            self._look_at_clock(now, stamp_ns)
        if self._is_due("exchange", now, _CHECK_EVERY_S):
            self._look_for_exchange(now, stamp_ns)

    def _is_due(self, task: str, now: float, every: float) -> bool:
        if now < self._due.get(task, 0.0):
            return False
        self._due[task] = now + every
        return True

    def _active(self, stamp_ns: int) -> list[tuple[int, WornSensor]]:
        """Sensors with a recent usable reading, and the numbers of their segments."""
        found = []
        for sensor in self._sensors.values():
            latest = sensor.latest
            if latest is None or sensor.problems:
                continue
            if abs(latest.stamp_ns + self._offset_ns(sensor) - stamp_ns) < self.parameters.silent_after * NANOSECONDS:
                found.append((self.segments.index(sensor.segment), sensor))
        return sorted(found, key=lambda each: each[0])

    def _stream(self, sensor: WornSensor, readings: Sequence[OrientedReading]) -> Stream:
        """Readings in the output clock, in seconds since the start."""
        assert self._epoch_ns is not None
        offset = self._offset_ns(sensor) - self._epoch_ns
        return Stream(
            sensor.segment,
            np.array([(each.stamp_ns + offset) / NANOSECONDS for each in readings]),
            np.array([each.rotation for each in readings]).reshape(-1, 3, 3),
            np.array([each.rate for each in readings]).reshape(-1, 3),
        )

    def _recent(self, sensor: WornSensor, stamp_ns: int, seconds: float) -> list[OrientedReading]:
        return sensor.history(stamp_ns - round(seconds * NANOSECONDS) - self._offset_ns(sensor))

    # --- a camera

    def _compare(self, skeleton: Skeleton, now: float) -> None:
        """Update headings, alignments and slip detectors by the bones of a skeleton."""
        if not self._is_due("bones", now, 0.9 * _STEP_NS / NANOSECONDS):
            return
        variance, valid = joint_variances(skeleton), skeleton.valid
        for _, sensor in self._active(skeleton.stamp_ns):
            segment = sensor.segment
            bone, rotation = bone_of(segment), sensor.at(skeleton.stamp_ns - self._offset_ns(sensor))
            if bone is None or rotation is None or not (valid[bone.start] and valid[bone.end]):
                continue
            way = skeleton.positions[bone.end] - skeleton.positions[bone.start]
            length = float(np.linalg.norm(way))
            if length < 0.05:
                continue
            stddev = float(np.sqrt(variance[bone.start] + variance[bone.end])) / length
            innovation = self._tracker.observe_bone(now, segment, rotation, way, stddev * np.sqrt(_CAMERA_LASTS))
            if innovation is None or sensor.disturbed or self._stddev(sensor) > _FAR_HEADING:
                continue
            off = float(np.sqrt(0.5 * innovation.covariance.trace() - (_CAMERA_LASTS - _CAMERA_SLIPS) * stddev**2))
            for detector in self._detectors[segment]:
                turn = detector.update(now, innovation.turn, off)
                if turn is not None:
                    self._slipped(segment, now, float(np.linalg.norm(turn)))
                    break

    def _slipped(self, segment: str, now: float, turn: float) -> None:
        self.counters["slips"] += 1
        self._slips[segment] = now, f"{segment}: its sensor has slipped by {np.degrees(turn):.0f} deg"
        self._tracker.loosen(segment, max(turn, 0.2))
        self._detectors[segment] = self._new_detectors()

    def _bones(self, segments: Sequence[str]) -> list[Series | None]:
        """Turning rates of bones in the camera's recent skeletons."""
        assert self._epoch_ns is not None
        stamps = np.array([(each.stamp_ns - self._epoch_ns) / NANOSECONDS for each in self._seen])
        positions = np.array([np.where(each.valid[:, None], each.positions, np.nan) for each in self._seen])
        found: list[Series | None] = []
        for segment in segments:
            bone = bone_of(segment)
            if bone is None or len(stamps) < 2:
                found.append(None)
            else:
                found.append(turning_of_bone(stamps, positions[:, bone.end] - positions[:, bone.start]))
        return found

    def _turning(self, number: int, sensor: WornSensor, stamp_ns: int) -> Series | None:
        """Turning rate of a bone by its sensor's recent readings."""
        readings = self._recent(sensor, stamp_ns, _LOOK_BACK_S)
        bone = bone_of(sensor.segment)
        if len(readings) < 2 or bone is None:
            return None
        stream = self._stream(sensor, readings)
        return turning_of_sensor(stream.stamps, stream.rates, self.alignment.rotations[number] @ bone.axis)

    def _look_at_clock(self, now: float, stamp_ns: int) -> None:
        """Estimate the offset of one sensor's stamps from the camera's by motion; the sensors take turns."""
        active = self._active(stamp_ns)
        if not self._seen or not active or self.parameters.clock == REFERENCE:
            return
        self._turn += 1
        number, sensor = active[self._turn % len(active)]
        measured, (seen,) = self._turning(number, sensor, stamp_ns), self._bones([sensor.segment])
        if measured is None or seen is None:
            return
        found = clock_offset(seen, measured, window=_CLOCK_WINDOW)
        if found is not None and sensor.segment not in self._exchanged.values():
            self._clocks.correct(sensor.stated, now, found.offset, found.stddev)
            self.counters["clocks by motion"] += 1

    def _look_for_exchange(self, now: float, stamp_ns: int) -> None:
        """Compare the turning rates of all sensors with those of all bones."""
        active = [each for each in self._active(stamp_ns) if bone_of(each[1].segment) is not None]
        if len(self._seen) < 2 or len(active) < 2:
            return
        measured = [self._turning(number, sensor, stamp_ns) for number, sensor in active]
        kept = [number for number, each in enumerate(measured) if each is not None]
        segments = [active[number][1].segment for number in kept]
        table = likelihood_by_motion([each for each in measured if each is not None], self._bones(segments))
        for row, number in enumerate(kept):
            by_pose = self._by_pose.get(active[number][1].stated, {})
            table[row] += [by_pose.get(segment, 0.0) for segment in segments]
        self._exchange([active[number][1] for number in kept], assign(segments, table))

    def _note_pose(self, sensors: Sequence[WornSensor], table: FloatArray) -> None:
        """Keep the log likelihoods of a pose, to add them to those of motion."""
        for sensor, row in zip(sensors, table, strict=True):
            bounded = np.maximum(row - row.max(), -_POSE_LIMIT).tolist()
            self._by_pose[sensor.stated] = dict(zip((each.segment for each in sensors), bounded, strict=True))

    def _exchange(self, sensors: Sequence[WornSensor], segments: Sequence[str]) -> bool:
        """Assign sensors to the segments on which they were found; returns whether any segment changed."""
        pairs = zip(sensors, segments, strict=True)
        moved = [(sensor, segment) for sensor, segment in pairs if sensor.segment != segment]
        if not moved:
            return False
        for sensor, segment in moved:
            stated = sensor.stated
            self._slips.pop(segment, None)  # the exchange looked like a slip
            self.counters["exchanged sensors"] += 1
            if segment == stated:
                self._exchanged.pop(stated, None)
            else:
                self._exchanged[stated] = segment
        for sensor, segment in moved:
            sensor.segment = segment
            self._magnetic[self.segments.index(segment)] = sensor.has_field
            self._detectors[segment] = self._new_detectors()
        self._tracker = self._new_tracker(self.alignment.replaced(self._unaligned([each for _, each in moved])))
        return True

    # --- a pose

    def _look_for_pose(self, now: float, stamp_ns: int) -> None:
        """Align in a pose that is held now, for the first time or when requested."""
        asked = self._asked_until is not None and now <= self._asked_until
        if self._asked_until is not None and not asked:
            self.counters["requested poses not held"] += 1
            self._asked_until = None
        if self.aligned and not asked:
            return
        active = self._active(stamp_ns)
        complete = len(active) == len(self.segments)
        if not active or not (complete or now > _ALONE_S):
            return
        streams = [self._stream(sensor, self._recent(sensor, stamp_ns, _POSE_S)) for _, sensor in active]
        if any(len(stream.stamps) < 2 for stream in streams):
            return
        seen = self._seen[-1] if self._seen and abs(self._seen[-1].stamp_ns - stamp_ns) < _FRESH_NS else None
        if self._seen and seen is None:
            return  # the heading must come from the camera, which has no recent skeleton
        assert self._epoch_ns is not None
        recent = [
            ((each.stamp_ns - self._epoch_ns) / NANOSECONDS, each)
            for each in self._seen
            if stamp_ns - each.stamp_ns < 2.0 * _POSE_S * NANOSECONDS
        ]
        intended = self._intended[[number for number, _ in active]]
        held = self._poses.find(streams, intended, self.parameters.pose, now, recent, asked=asked)
        if held is not None:
            self._align(held, active)
            self._asked_until = None

    def _align(self, held: HeldPose, active: Sequence[tuple[int, WornSensor]]) -> None:
        """Align the active sensors by a pose; the others keep their alignment."""
        numbers = [number for number, _ in active]
        segments = [self.segments[number] for number in numbers]
        measured = np.array([so3.mean_rotation(stream.rotations) for stream in held.streams])
        posed = self._poses.rotations(held.name, segments)
        magnetic = bool(self._magnetic[numbers].all())
        if len(segments) > 1 and (held.facing is None or magnetic):
            table = likelihood_by_pose(segments, measured, posed, self._intended[numbers], common_heading=magnetic)
            self._note_pose([sensor for _, sensor in active], table)
            if self._exchange([sensor for _, sensor in active], assign(segments, table)):
                return  # the next pose aligns them under their new segments
        a = self.alignment
        places = [4 * number + 3 for number in numbers]
        own = a.covariance[np.ix_(places, places)]
        headings: FloatArray | None = None
        if held.facing is not None and float(own.diagonal().max()) < _FAR_HEADING**2:
            headings = a.headings[numbers]
        elif all(sensor.has_field and not sensor.disturbed for _, sensor in active):
            # all headings agree, at an unknown value
            variances = [reading.covariance[2, 2] for _, sensor in active if (reading := sensor.latest) is not None]
            headings, own = np.zeros(len(numbers)), UNKNOWN_HEADING + np.diag(variances)
        part = align_in_pose(
            segments,
            measured,
            posed,
            self._poses.covariance(held, segments, self.parameters.pose_stddev),
            mountings=self._intended[numbers],
            mounting_stddev=self.parameters.mounting_stddev,
            headings=headings,
            heading_covariance=None if headings is None else own,
            facing=0.0 if held.facing is None else held.facing,
        )
        self._tracker = self._new_tracker(a.replaced(part))
        self._detectors = {each: self._new_detectors() for each in self.segments}
        for each in segments:
            self._slips.pop(each, None)
        self.aligned = True
        self.counters["alignments by a pose"] += 1

    # --- joints

    def _constrain(self, now: float, stamp_ns: int) -> None:
        """Update by elbows and ranges of motion (eq. 11 and 12 of ``heading``)."""
        rotations = {
            sensor.segment: rotation
            for _, sensor in self._active(stamp_ns)
            if self._stddev(sensor) < self.parameters.largest_stddev
            and (rotation := sensor.at(stamp_ns - self._offset_ns(sensor))) is not None
        }
        for side in ("left", "right"):
            upper, lower = rotations.get(f"upper_arm_{side}"), rotations.get(f"forearm_{side}")
            if upper is not None and lower is not None:
                self._tracker.observe_elbow(now, side, upper, lower)
        for parent, child in JOINTS:
            if parent in rotations and child in rotations:
                self._tracker.observe_range(now, parent, child, (rotations[parent], rotations[child]))

    # --- output

    def _stddev(self, sensor: WornSensor) -> float:
        """Radians, the largest standard deviation of a sensor's alignment and heading."""
        number = self.segments.index(sensor.segment)
        variances = self.alignment.covariance.diagonal()[4 * number : 4 * number + 4]
        return float(np.sqrt(variances.max()))

    def _placed(self, number: int, reading: OrientedReading, rotation: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(3, 3) orientation of a segment in world, and its (3, 3) covariance about the axes of world."""
        a = self.alignment
        world = a.oriented(number, rotation)
        own = self._tracker.orientation_covariance(self.segments[number], rotation)
        earth = yaw(a.headings[number])
        covariance = world @ (own + TISSUE_STDDEV**2 * _EYE3) @ world.T + earth @ reading.covariance @ earth.T
        return world, 0.5 * (covariance + covariance.T)

    def _orientation(self, sensor: WornSensor, reading: OrientedReading, stamp_ns: int) -> SegmentOrientation | None:
        last = self._published_ns.get(sensor.segment)
        if (
            last is not None
            and -JUMP_BACK_NS < stamp_ns - last < _AHEAD_OF * NANOSECONDS / self.parameters.orientation_rate
        ):
            return None
        number = self.segments.index(sensor.segment)
        world, covariance = self._placed(number, reading, reading.rotation)
        if float(np.sqrt(covariance.diagonal().max())) > self.parameters.largest_stddev:
            return None
        self._published_ns[sensor.segment] = stamp_ns
        rate = self.alignment.rotations[number].T @ reading.rate
        return SegmentOrientation(
            stamp_ns,
            f"imu_{sensor.segment}",
            sensor.segment,
            so3.quat_to_matrix(so3.matrix_to_quat(world)),  # without accumulated rounding errors
            covariance,
            rate if reading.rate_measured else None,
            rate_variance(rate),
            self._world,
        )

    def _skeleton(self, stamp_ns: int) -> Skeleton | None:
        """The body that fits all orientations; None if it is not due."""
        period = NANOSECONDS / self.parameters.rate
        if self._skeleton_ns is not None and stamp_ns - self._skeleton_ns < 0.98 * period:
            return None
        rotations, covariances, segments = [], [], []
        for number, sensor in self._active(stamp_ns):
            rotation = sensor.at(stamp_ns - self._offset_ns(sensor))
            if rotation is None or self._stddev(sensor) > np.sqrt(UNKNOWN_HEADING) - 0.01:
                continue
            assert sensor.latest is not None
            world, covariance = self._placed(number, sensor.latest, rotation)
            rotations.append(world)
            covariances.append(world.T @ covariance @ world)
            segments.append(sensor.segment)
        if not segments:
            return None
        self._skeleton_ns = stamp_ns
        return self._body.skeleton(stamp_ns, segments, np.array(rotations), np.array(covariances))


def rate_variance(rate: FloatArray) -> float:
    """rad2/s2 per axis: variance of a segment's rate (3,) as measured by its sensor."""
    return float((_RATE_STDDEV + _RATE_SHARE * np.linalg.norm(rate)) ** 2)
