"""A state machine that lets a robot's joints follow a person's angles, and holds or stops them on a fault.

States and transitions (times from the mapping's ``SafetyLimits``)::

    stopped ──good for recover_after──> approaching ──after approach──> following
       ^                                  ^    └──────any fault──────┐     │
       │                 good for recover_after                      v     v
       └───────────a fault after stop_after of holding───────────── holding

- *stopped*: no commands. The initial state; without a ``state_topic`` an operator has to enable the robot, which then
  begins at ``home``.
- *approaching*: follows, starting at the robot's position; the rates grow from 0 to their limits: no jump.
- *following*: each command is the person's posture, predicted to now, within the limits.
- *holding*: repeats the last command, after joints with a limit of acceleration have braked. Where the robot did not
  follow its command, the command is the robot's measured position.

Faults: no new angles for ``silence``, by the wall clock; no frame of any sensor for that long, although angles are
still published (predicted ones); angles older than ``max_age`` or stamped in the future; angles of another convention
or with other names than the mapping's; angles of two publishers; an angle that is not finite, anatomically impossible,
that jumps, or is less certain than allowed; no good calibration; a robot that is silent or off its command; a gap in
the calls of :meth:`Follower.step`. Each is reported by name. Another publisher of the commands, a robot beyond its
limits, and a gap of ``STANDSTILL`` stop at once, without holding. After them nobody knows where a robot without a
``state_topic`` is: an operator has to enable it anew.

The caller passes two times: ``now_ns`` in ROS time, as stamps are (it may stand still or jump), and ``steady_ns``,
which is monotonic. This is not a safety-rated function.

Over 500 lines: one state machine with all its faults, which are checked in their order.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from body_tracking.core.clocks import jumped_back
from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.joint_angles import JointAngles
from body_tracking.core.skeleton import NANOSECONDS, BoolArray, FloatArray, IntArray
from body_tracking.core.so3 import wrapped
from body_tracking.robot.calibration import CalibrationWatch
from body_tracking.robot.limiter import Limiter
from body_tracking.robot.mapping import TRAJECTORY, RobotMapping

ROBOT_SILENCE = 0.5
"""Seconds without joint states of the robot after which it counts as silent."""

STANDSTILL = 2.0
"""Seconds between two steps after which the follower stops instead of continuing from its last command."""

_AHEAD = 0.05
"""Seconds by which stamps may be in the future: synchronised clocks differ by less."""

_OTHER_CLOCK = 10.0
"""Seconds from now beyond which a stamp is hardly ROS time."""

_SETTLING_NS = NANOSECONDS
"""After ROS time jumped back, angles are discarded for this long: some still have the earlier time."""

_AT_REST = 0.25
"""Share of ``max_tracking_error`` allowed at rest. The remainder is for lag, which grows with the rate."""

_MAX_ANGLE = 4.0 * math.pi
"""Radians: no joint of a body turns further."""

_MAX_RATE = 50.0
"""rad/s: faster is an error. The elbow of a pitcher reaches 40 (Fleisig et al. 1995)."""

_FRAME = 1.0 / 30.0
"""Seconds in which a filter may correct an angle by as much as a person could turn it. Messages of two sensors' frames
may be microseconds apart."""


class FollowerError(BodyTrackingError):
    """Raised when the mapping cannot be followed at this period, or the robot's state does not fit the mapping."""


class State(StrEnum):
    """States of the follower."""

    STOPPED = "stopped"
    APPROACHING = "approaching"
    FOLLOWING = "following"
    HOLDING = "holding"


@dataclass(frozen=True, slots=True)
class Transition:
    """A change of state.

    Attributes:
        before, after: the states.
        reason: its cause.
    """

    before: State
    after: State
    reason: str

    def __str__(self) -> str:
        return f"{self.before} -> {self.after}: {self.reason}"


@dataclass(frozen=True, slots=True, eq=False)
class Command:
    """The result of one step.

    Attributes:
        state: of the follower.
        reason: why it is in that state, or what it waits for.
        position: (n,) radians by the mapping's joints; None where nothing is to be published.
        kept: joints that hold alone because their angles are unknown.
        age: seconds since the capture of the angles; NaN without angles.
        margin: radians from a joint to its limit, the least of all joints.
        nearest: the name of that joint.
    """

    state: State
    reason: str
    position: FloatArray | None
    kept: tuple[str, ...]
    age: float
    margin: float
    nearest: str


@dataclass(frozen=True, slots=True, eq=False)
class _Prediction:
    """The angles, predicted to now.

    Attributes:
        age: seconds since capture; NaN without angles.
        angle, stddev: (m,) radians of the person.
        target: (n,) radians of the robot.
        known: (n,) whether all angles of a joint are certain enough.
    """

    age: float
    angle: FloatArray
    stddev: FloatArray
    target: FloatArray
    known: BoolArray


class Follower:
    """Receives angles and states, and computes commands.

    Args:
        mapping: of the robot.
        period: seconds between two commands. A fault that would occur before the next command counts now.

    Attributes:
        state: the present state.
        enabled: whether an operator has confirmed that the robot stood at ``home``, and nothing but this follower can
            have moved it since; always true with a ``state_topic``.
        transitions: since the caller last cleared the list, the oldest first.

    Raises:
        FollowerError: ``silence`` or a trajectory's ``time_from_start`` is shorter than the period.
    """

    def __init__(self, mapping: RobotMapping, period: float) -> None:
        if period >= mapping.safety.silence:
            raise FollowerError(
                f"{mapping.robot}: silence {mapping.safety.silence:g} s is no more than the period {period:g} s"
            )
        if mapping.output.kind == TRAJECTORY and mapping.output.time_from_start < period:
            at = mapping.output.time_from_start
            raise FollowerError(f"{mapping.robot}: time_from_start {at:g} s is less than the period {period:g} s")
        self.mapping = mapping
        self.calibration = CalibrationWatch()
        self.state = State.STOPPED
        self.enabled = bool(mapping.output.state_topic)
        self.transitions: list[Transition] = []
        self._limits = mapping.safety
        self._period = period
        self._limiter = Limiter(mapping.lower, mapping.upper, mapping.rate, mapping.acceleration, mapping.home)
        self._ros_ns = self._settled_ns = 0
        self._angles: JointAngles | None = None
        self._received_ns = 0
        self._angle_fault = "no angles yet"
        self._refusal = ""
        self._jump: FloatArray = np.zeros(len(mapping.angles))
        self._columns: IntArray = np.array([mapping.names.index(name) for name in mapping.angles], dtype=np.intp)
        self._watched: tuple[str, ...] = ()
        self._sensors: dict[str, tuple[int, int]] = {}
        self._other_publishers = ""
        self._robot: FloatArray | None = None
        self._robot_ns = 0
        self._robot_state_fault = self._tracking_fault = ""
        self._stepped_ns: int | None = None
        self._since_ns = self._approached_ns = 0
        self._good_since_ns: int | None = None
        self._reason = self._angle_fault
        self._last_fault = self._angle_fault
        n = len(mapping.joints)
        self._known_since_ns: IntArray = np.full(n, -1, dtype=np.intp)
        self._used = mapping.matrix != 0.0

    # --- inputs

    def receive_angles(self, angles: JointAngles, convention: str, now_ns: int, steady_ns: int) -> bool:
        """Receive angles and their convention; messages out of order are ignored.

        Returns:
            Whether time jumped back, which discards everything received before.
        """
        jumped = self._ros_time(now_ns, steady_ns)
        if steady_ns < self._settled_ns:
            return jumped
        foreign = self._foreign(angles.names, convention)
        if foreign:
            self.refuse_angles(foreign)
            return jumped
        last_ns = self._angles.stamp_ns if self._angles is not None else None
        if jumped_back(angles.stamp_ns, last_ns):
            jumped = True
            self.time_jumped_back()
        elif last_ns is not None and angles.stamp_ns <= last_ns:
            return jumped  # out of order or repeated
        self._angle_fault = ""
        columns = (angles.position, angles.velocity, angles.position_stddev, angles.velocity_stddev)
        used = JointAngles(angles.stamp_ns, self.mapping.angles, *(each[self._columns] for each in columns))
        if self._angles is not None:
            passed = (used.stamp_ns - self._angles.stamp_ns) / NANOSECONDS
            with np.errstate(invalid="ignore"):  # unknown values are infinite or NaN
                moved = np.abs(wrapped(used.position - self._angles.position))
            self._jump = np.where(moved > _MAX_RATE * max(passed, _FRAME), moved, self._jump)
        self._angles, self._received_ns = used, steady_ns
        return jumped

    def refuse_angles(self, reason: str) -> None:
        """Report angles that must not be followed: a fault until valid angles arrive, and for one command at least."""
        self._angle_fault = self._refusal = reason

    def refuse_robot_state(self, reason: str) -> None:
        """Report joint states that may be another robot's: a fault for one command at least."""
        self._refusal = reason

    def _foreign(self, names: tuple[str, ...], convention: str) -> str:
        """Why these angles do not match the mapping; empty if they do."""
        mapping = self.mapping
        if convention != mapping.convention:
            said = f"the convention {convention!r}" if convention else "no convention (an empty frame_id)"
            return f"angles are of {said}, the mapping needs {mapping.convention!r}"
        if names == mapping.names:
            return ""
        missing = [name for name in mapping.names if name not in names]
        unknown = [name for name in names if name not in mapping.names]
        if not missing and not unknown:
            return f"angles of {mapping.convention} in another order or twice"
        what = f"{missing[0]} is missing" if missing else f"{unknown[0]} is none of them"
        return f"these are not the angles of {mapping.convention}: {what}"

    def receive_frame(self, sensor: str, stamp_ns: int, steady_ns: int) -> None:
        """Receive a sensor's frame; a repeated stamp does not count."""
        if sensor not in self._sensors or self._sensors[sensor][0] != stamp_ns:
            self._sensors[sensor] = stamp_ns, steady_ns

    def watch_sensors(self, sensors: tuple[str, ...]) -> None:
        """Hold while none of these sensors sends frames; an empty tuple turns this off."""
        self._watched = sensors

    def report_publishers(self, problem: str) -> None:
        """Report other publishers of this robot's commands, or that they are not known yet; empty for none."""
        self._other_publishers = problem

    def enable(self) -> None:
        """Allow the robot to move: an operator confirms that it stands at ``home``.

        Raises:
            FollowerError: the robot is not stopped, or another node may command it.
        """
        if self.state != State.STOPPED:
            raise FollowerError(f"the robot is not stopped: {self.state}")
        if self._other_publishers:
            raise FollowerError(self._other_publishers)
        self.enabled = True

    def receive_robot_state(self, joints: tuple[str, ...], position: FloatArray, steady_ns: int) -> None:
        """Receive the robot's joint states.

        Args:
            joints: names, in any order; other joints are ignored.
            position: radians of each.
            steady_ns: now.

        Raises:
            FollowerError: a joint is missing or there twice, or its position is not finite.
        """
        self._robot, self._robot_ns, self._robot_state_fault = None, steady_ns, ""
        missing = [name for name in self.mapping.joints if name not in joints]
        twice = [name for name in self.mapping.joints if joints.count(name) > 1]
        if missing:
            self._robot_state_fault = f"the robot's joint states: {missing[0]} is not among them"
        elif twice:
            self._robot_state_fault = f"the robot's joint states: {twice[0]} is there twice"
        elif len(position) != len(joints):
            self._robot_state_fault = f"the robot's joint states: {len(position)} positions of {len(joints)} joints"
        elif not np.isfinite(found := position[[joints.index(name) for name in self.mapping.joints]]).all():
            self._robot_state_fault = "the robot's joint states are not finite"
        else:
            self._robot = found
            return
        raise FollowerError(self._robot_state_fault)

    def time_jumped_back(self) -> None:
        """Discard everything received before the jump."""
        self._angles, self._angle_fault = None, "time jumped back"
        self._good_since_ns = None
        self._known_since_ns[:] = -1

    def _ros_time(self, now_ns: int, steady_ns: int) -> bool:
        """Whether ROS time jumped back, as when a recording restarts."""
        jumped = jumped_back(now_ns, self._ros_ns)
        self._ros_ns = now_ns
        if jumped:
            self.time_jumped_back()
            self._settled_ns = steady_ns + _SETTLING_NS
        return jumped

    # --- commands

    def step(self, now_ns: int, steady_ns: int) -> Command:
        """The next command; to be called once per period, also when late."""
        elapsed = self._period if self._stepped_ns is None else (steady_ns - self._stepped_ns) / NANOSECONDS
        # At most two periods: after a gap the robot must not catch up.
        dt = min(max(elapsed, 0.0), 2.0 * self._period)
        self._stepped_ns = steady_ns
        self._ros_time(now_ns, steady_ns)
        prediction = self._predicted(now_ns)
        known = prediction.known
        fault = self._fatal(elapsed, steady_ns)
        fatal = bool(fault)
        if fatal and not self.mapping.output.state_topic:
            self.enabled = False
            self._limiter.reset(self.mapping.home)
        fault = fault or self._fault(steady_ns, elapsed, prediction)
        self._refusal = ""
        self._jump[:] = 0.0
        if fault:
            self._good_since_ns, self._last_fault = None, fault
        elif self._good_since_ns is None:
            self._good_since_ns = steady_ns
        self._known_since_ns[~known] = -1
        self._known_since_ns[known & (self._known_since_ns < 0)] = steady_ns
        self._next_state(fault, fatal, steady_ns)
        kept: tuple[str, ...] = ()
        if self.state in (State.APPROACHING, State.FOLLOWING):
            share = self._shares(steady_ns)
            free = share >= 0.0
            kept = tuple(name for name, moves in zip(self.mapping.joints, free, strict=True) if not moves)
            self._limiter.step(np.where(free, prediction.target, self._limiter.position), dt, np.maximum(share, 0.0))
        elif self.state == State.HOLDING:
            self._limiter.brake(dt)
        position = self._limiter.position
        margins = np.minimum(position - self.mapping.lower, self.mapping.upper - position)
        nearest = int(margins.argmin())
        return Command(
            self.state,
            self._reason,
            None if self.state == State.STOPPED else position.copy(),
            kept,
            prediction.age,
            float(margins[nearest]),
            self.mapping.joints[nearest],
        )

    def _predicted(self, now_ns: int) -> _Prediction:
        angles, mapping, n = self._angles, self.mapping, len(self.mapping.joints)
        if angles is None:
            unknown = np.full(len(mapping.angles), np.inf)
            return _Prediction(math.nan, unknown, unknown, self._limiter.position, np.zeros(n, dtype=bool))
        age = (now_ns - angles.stamp_ns) / NANOSECONDS
        wait = max(age, 0.0)
        ahead = min(wait, self._limits.prediction)
        with np.errstate(invalid="ignore"):  # unknown values are infinite or NaN
            possible = (np.abs(angles.position) <= _MAX_ANGLE) & (np.abs(angles.velocity) <= _MAX_RATE)
            possible &= self._jump == 0.0
            predicted = np.where(possible, angles.position + ahead * angles.velocity, np.nan)
            # An upper bound over all correlations of angle and velocity, which the message does not carry. Beyond the
            # horizon of the prediction the velocity itself is the error.
            stddev = angles.position_stddev + wait * angles.velocity_stddev + (wait - ahead) * np.abs(angles.velocity)
            # 0 is no standard deviation of an estimate: its publisher does not know it
            stddev[~((angles.position_stddev > 0.0) & (angles.velocity_stddev > 0.0))] = np.nan
            sound = possible & np.isfinite(stddev)
        most = np.where(self._used, mapping.max_stddev[:, None], np.inf)
        known = (~self._used | (sound & (stddev <= most))).all(axis=1)
        turned = wrapped(np.where(sound, predicted, 0.0))
        target = mapping.matrix @ turned + mapping.offset
        # Of the equivalent positions, the one nearest to the joint.
        turns = np.divide(self._limiter.position - target, mapping.period, out=np.zeros(n), where=mapping.period > 0.0)
        return _Prediction(age, predicted, stddev, target + np.round(turns) * mapping.period, known)

    def _fatal(self, elapsed: float, steady_ns: int) -> str:
        """A fault that stops the robot at once, without holding; empty for none."""
        if self._other_publishers:
            return self._other_publishers
        if elapsed > STANDSTILL:
            return f"gap in the commands of {elapsed:.2f} s"
        return self._check_tracking(steady_ns)

    def _fault(self, steady_ns: int, elapsed: float, prediction: _Prediction) -> str:
        """A fault that exists now or would before the next command; empty for none."""
        limits, angles, age = self._limits, self._angles, prediction.age
        allowed_ns = round((limits.silence - self._period) * NANOSECONDS)
        if not self.enabled:
            return "waits for a person: call its service enable once the robot stands at home"
        if self._refusal or self._angle_fault or angles is None:
            return self._refusal or self._angle_fault or "no angles yet"
        if steady_ns - self._received_ns >= allowed_ns:
            return f"no new angles for {(steady_ns - self._received_ns) / NANOSECONDS:.2f} s"
        if self._watched:
            received = [self._sensors[sensor][1] for sensor in self._watched if sensor in self._sensors]
            listed = ", ".join(self._watched)
            if not received:
                return f"no frame of {listed} yet"
            if steady_ns - max(received) >= allowed_ns:
                return f"no frame of {listed} for {(steady_ns - max(received)) / NANOSECONDS:.2f} s"
        if elapsed > limits.silence:
            return f"gap in the commands of {elapsed:.2f} s"
        if age > limits.max_age or age < -_AHEAD:
            said = (
                f"{age:.2f} s old, limit {limits.max_age:g} s" if age > 0.0 else f"stamped {-age:.2f} s in the future"
            )
            return f"angles are {said}" + (", or not in ROS time" if abs(age) > _OTHER_CLOCK else "")
        needed = ~prediction.known & ~self.mapping.alone
        if needed.any():
            return self._unknown(int(needed.argmax()), angles, prediction)
        return self.calibration.fault(limits, angles.stamp_ns, steady_ns) or self._robot_fault(steady_ns)

    def _unknown(self, joint: int, angles: JointAngles, prediction: _Prediction) -> str:
        """Why an angle of this joint cannot be followed."""
        for place in np.flatnonzero(self._used[joint]):
            name, most = self.mapping.angles[place], self.mapping.max_stddev[joint]
            angle, rate = angles.position[place], angles.velocity[place]
            if not np.isfinite([angle, rate]).all():
                return f"{name} is not finite, or its velocity is not known"
            if self._jump[place]:
                return f"{name} jumped by {self._jump[place]:.2f} rad from one message to the next"
            if not np.isfinite(prediction.angle[place]):
                return f"{name} is {angle:.3g} rad at {rate:.3g} rad/s; a person does not move so"
            if not prediction.stddev[place] <= most:
                return f"standard deviation of {name} is {prediction.stddev[place]:.2f} rad, limit {most:g}"
        raise AssertionError(f"nothing is wrong with {self.mapping.joints[joint]}")

    def _robot_fault(self, steady_ns: int) -> str:
        """A fault of the robot itself, where it reports its joint states; empty for none."""
        if not self.mapping.output.state_topic:
            return ""
        if self._robot_state_fault:
            return self._robot_state_fault
        if self._measured(steady_ns) is None:
            return "no joint states of the robot"
        return self._tracking_fault or (self._limit_fault() if self.state == State.STOPPED else "")

    def _measured(self, steady_ns: int) -> FloatArray | None:
        """(n,) the robot's measured position; None if it is older than ``ROBOT_SILENCE``."""
        return self._robot if steady_ns - self._robot_ns <= ROBOT_SILENCE * NANOSECONDS else None

    def _limit_fault(self) -> str:
        """Names the first of the robot's joints beyond its limits; empty for none."""
        robot, mapping = self._robot, self.mapping
        if robot is None or not (beyond := (robot < mapping.lower) | (robot > mapping.upper)).any():
            return ""
        joint = int(beyond.argmax())
        return f"the robot's {mapping.joints[joint]} is at {robot[joint]:.3f} rad, beyond its limits"

    def _check_tracking(self, steady_ns: int) -> str:
        """Reset the command to the measured position where the robot is off its command.

        So the robot does not jump when an emergency stop or an obstacle releases it.

        Returns:
            The fault if the robot stands too far beyond its limits for that; else empty.
        """
        robot = self._measured(steady_ns)
        if self.state == State.STOPPED or robot is None:
            return ""
        share = np.ones(len(robot)) if self.state == State.HOLDING else np.abs(self._shares(steady_ns))
        allowed = self._limits.max_tracking_error * (_AT_REST + (1.0 - _AT_REST) * share)
        errors = np.abs(robot - self._limiter.position)
        if (errors <= allowed).all():
            return ""
        worst = int((errors - allowed).argmax())
        self._tracking_fault = f"the robot's {self.mapping.joints[worst]} is {errors[worst]:.2f} rad from its command"
        self._limiter.reset(robot)
        return self._limit_fault() if (np.abs(robot - self._limiter.position) > allowed).any() else ""

    def _next_state(self, fault: str, fatal: bool, steady_ns: int) -> None:
        limits = self._limits
        good = -1.0 if self._good_since_ns is None else (steady_ns - self._good_since_ns) / NANOSECONDS
        if fault and self.state in (State.APPROACHING, State.FOLLOWING):
            self._enter(State.HOLDING, fault, steady_ns)
        since = (steady_ns - self._since_ns) / NANOSECONDS
        if self.state in (State.STOPPED, State.HOLDING):
            if good >= limits.recover_after:
                robot = self._measured(steady_ns)
                if robot is not None:
                    self._limiter.reset(robot)
                self._enter(State.APPROACHING, f"everything was good for {good:.2f} s", steady_ns)
            elif fault and self.state == State.HOLDING and (fatal or since >= limits.stop_after):
                self._enter(State.STOPPED, f"held for {since:.1f} s: {fault}", steady_ns)
                self._tracking_fault = ""
            else:
                waits = f"{good:.2f} s without a fault, {limits.recover_after:g} needed"
                self._reason = fault or (f"{waits}; the last was: {self._last_fault}" if self._last_fault else waits)
        elif self.state == State.APPROACHING and since >= limits.approach:
            self._enter(State.FOLLOWING, "the rates have reached their limits", steady_ns)

    def _enter(self, state: State, reason: str, steady_ns: int) -> None:
        self.transitions.append(Transition(self.state, state, reason))
        if state == State.APPROACHING:
            self._approached_ns = steady_ns
        self.state, self._reason, self._since_ns = state, reason, steady_ns

    def _shares(self, steady_ns: int) -> FloatArray:
        """(n,) usable part of each joint's rate; negative for a joint that holds."""
        limits = self._limits
        ready_ns = self._known_since_ns + round(limits.recover_after * NANOSECONDS)
        begun_ns = np.maximum(ready_ns, self._approached_ns)
        waiting = self.mapping.alone & ((self._known_since_ns < 0) | (steady_ns < ready_ns))
        grown = (steady_ns - np.where(self.mapping.alone, begun_ns, self._approached_ns)) / NANOSECONDS
        share = np.minimum(grown / limits.approach, 1.0) if limits.approach > 0.0 else np.ones(len(ready_ns))
        return np.where(waiting, -1.0, share)
