"""A robot's joints follow a person's angles, and hold and stop where they should not.

States and what leads from one to the next (times by the mapping's ``SafetyLimits``)::

    stopped ──good for recover_after──> approaching ──after approach──> following
       ^                                  ^    └──────any fault──────┐     │
       │                 good for recover_after                      v     v
       └───────────a fault after stop_after of holding───────────── holding

- *stopped*: no commands. So it begins, too; where the robot does not say how it stands, until a person enables it.
- *approaching*: follows, from where the robot stands; the rates grow from nothing to their limits, so that there is no
  jump to where the person is.
- *following*: each command is where the person is expected to be now, within the limits.
- *holding*: the same command again and again; joints with a limit of acceleration come to rest first. Where the robot
  did not go where it was sent, the command is where the robot stands.

A fault is any of: no new angles for ``silence``, by the wall clock; no frame of any sensor for that long, although
somebody goes on saying what is to be expected; angles older than ``max_age``, or stamped in the future; angles of
another convention than the mapping's, or with other names; angles of two publishers; an angle that is not finite, that
no body has, or that is less certain than allowed; no good calibration; a robot that is silent or not where it was sent;
commands that came to a standstill themselves. Each is reported by name. These stop at once, without holding: another
publisher of the commands, a robot beyond its limits, a standstill of ``STANDSTILL``.

Nothing in here looks at a clock. Two times are given: ``now_ns`` in ROS time, as stamps are (it may stand still or
jump), and ``steady_ns``, which never does. This is no safety-rated function.
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
from body_tracking.robot.calibration import CalibrationWatch
from body_tracking.robot.limiter import Limiter
from body_tracking.robot.mapping import TRAJECTORY, RobotMapping

ROBOT_SILENCE = 0.5
"""Seconds without a word of the robot's own state after which it is taken to be away."""

STANDSTILL = 2.0
"""Seconds after which commands that stood still have ended: they do not go on with the one before."""

_AHEAD = 0.05
"""Seconds by which stamps may be in the future: clocks that are kept together differ by less."""

_OTHER_CLOCK = 10.0
"""Seconds from now beyond which a stamp hardly is ROS time."""

_SETTLING_NS = NANOSECONDS
"""After ROS time jumped back, angles are not used for so long: some are still of the time before."""

_AT_REST = 0.25
"""Share of ``max_tracking_error`` that a robot may be off at rest. The rest of it is lag, which grows with the rate."""

_MAX_ANGLE = 4.0 * math.pi
"""Radians: no joint of a body turns further."""

_MAX_RATE = 50.0
"""rad/s: faster is an error. The elbow of a pitcher reaches 40 (Fleisig et al. 1995)."""


class FollowerError(BodyTrackingError):
    """A follower that cannot do what its mapping says, or a state that is not of its robot."""


class State(StrEnum):
    """What the robot is told to do."""

    STOPPED = "stopped"
    APPROACHING = "approaching"
    FOLLOWING = "following"
    HOLDING = "holding"


@dataclass(frozen=True, slots=True)
class Transition:
    """A change of state.

    Attributes:
        before, after: the states.
        reason: what caused it, by name.
    """

    before: State
    after: State
    reason: str

    def __str__(self) -> str:
        return f"{self.before} -> {self.after}: {self.reason}"


@dataclass(frozen=True, slots=True, eq=False)
class Command:
    """What to tell the robot now.

    Attributes:
        state: of the follower.
        reason: why it is in that state, or what it waits for.
        position: (n,) radians by the mapping's joints; None where nothing is to be published.
        kept: joints that keep their place alone, because their angles are unknown.
        age: seconds from capture to now of the angles that it is made of; NaN where there are none.
        margin: radians from the joint nearest to one of its limits to that limit.
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
class _Expected:
    """What is expected of the person now.

    Attributes:
        age: seconds since capture; NaN without angles.
        angle, stddev: (m,) radians of the person.
        target: (n,) radians of the robot.
        known: (n,) whether all of a joint's angles are known well enough.
    """

    age: float
    angle: FloatArray
    stddev: FloatArray
    target: FloatArray
    known: BoolArray


class Follower:
    """Takes what is heard, and answers with commands.

    Args:
        mapping: of the robot.
        period: seconds between two commands. A fault that would be one by the next command is one now.

    Attributes:
        state: what it does now.
        enabled: whether a person has said that the robot stands where commands begin; true where it says so itself.
        transitions: those that nobody has taken away yet, the oldest first.

    Raises:
        FollowerError: ``silence`` is not longer than the period, or the point of a trajectory nearer than that.
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
        self._heard_ns = 0
        self._wrong = "no angles yet"
        self._refused = ""
        self._places: IntArray = np.array([mapping.names.index(name) for name in mapping.angles], dtype=np.intp)
        self._watched: tuple[str, ...] = ()
        self._sensors: dict[str, tuple[int, int]] = {}
        self._others = ""
        self._robot: FloatArray | None = None
        self._robot_ns = 0
        self._robot_wrong = self._astray = ""
        self._stepped_ns: int | None = None
        self._since_ns = self._approached_ns = 0
        self._good_since_ns: int | None = None
        self._reason = self._wrong
        self._last_fault = self._wrong
        n = len(mapping.joints)
        self._known_since_ns: IntArray = np.full(n, -1, dtype=np.intp)
        self._used = mapping.matrix != 0.0

    # --- what is heard

    def hear_angles(self, angles: JointAngles, convention: str, now_ns: int, steady_ns: int) -> bool:
        """Take note of angles and of the convention that they name; of a message that came late, nothing.

        Returns:
            Whether time jumped back, which forgets what was heard before.
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
            return jumped  # late, or the same again: no news
        self._wrong = ""
        columns = (angles.position, angles.velocity, angles.position_stddev, angles.velocity_stddev)
        self._angles = JointAngles(angles.stamp_ns, self.mapping.angles, *(each[self._places] for each in columns))
        self._heard_ns = steady_ns
        return jumped

    def refuse_angles(self, reason: str) -> None:
        """Angles came that must not be followed: a fault until others come, and for one command at least."""
        self._wrong = self._refused = reason

    def _foreign(self, names: tuple[str, ...], convention: str) -> str:
        """Why these are not the angles that the mapping is about; empty if they are."""
        mapping = self.mapping
        if convention != mapping.convention:
            said = f"the convention {convention!r}" if convention else "no convention (an empty frame_id)"
            return f"angles are of {said}, the mapping is about {mapping.convention!r}"
        if names == mapping.names:
            return ""
        missing = [name for name in mapping.names if name not in names]
        unknown = [name for name in names if name not in mapping.names]
        if not missing and not unknown:
            return f"angles of {mapping.convention} in another order or twice"
        what = f"{missing[0]} is missing" if missing else f"{unknown[0]} is none of them"
        return f"these are not the angles of {mapping.convention}: {what}"

    def hear_sensor(self, sensor: str, stamp_ns: int, steady_ns: int) -> None:
        """Take note of a sensor's frame; a stamp that stands still is none."""
        if sensor not in self._sensors or self._sensors[sensor][0] != stamp_ns:
            self._sensors[sensor] = stamp_ns, steady_ns

    def watch_sensors(self, sensors: tuple[str, ...]) -> None:
        """Hold where none of these is heard of; of none at all, that does not matter."""
        self._watched = sensors

    def hear_publishers(self, problem: str) -> None:
        """Take note of who else publishes commands for this robot, or that this is not known yet; empty for nobody."""
        self._others = problem

    def enable(self) -> None:
        """A person says that the robot may move: it stands at ``home``, or where it was left.

        Raises:
            FollowerError: the robot is not stopped.
        """
        if self.state != State.STOPPED:
            raise FollowerError(f"the robot is not stopped: {self.state}")
        self.enabled = True

    def hear_robot(self, joints: tuple[str, ...], position: FloatArray, steady_ns: int) -> None:
        """Take note of how the robot stands.

        Args:
            joints: names, in any order, others among them.
            position: radians of each.
            steady_ns: now.

        Raises:
            FollowerError: a joint is missing, or stands nowhere.
        """
        self._robot, self._robot_ns, self._robot_wrong = None, steady_ns, ""
        missing = [name for name in self.mapping.joints if name not in joints]
        if missing:
            self._robot_wrong = f"the robot's joint states: {missing[0]} is not among them"
        elif len(position) != len(joints):
            self._robot_wrong = f"the robot's joint states: {len(position)} positions of {len(joints)} joints"
        elif not np.isfinite(found := position[[joints.index(name) for name in self.mapping.joints]]).all():
            self._robot_wrong = "the robot's joint states are not finite"
        else:
            self._robot = found
            return
        raise FollowerError(self._robot_wrong)

    def time_jumped_back(self) -> None:
        """The stamps jumped back: what was heard before is of another time."""
        self._angles, self._wrong = None, "time jumped back"
        self._good_since_ns = None
        self._known_since_ns[:] = -1

    def _ros_time(self, now_ns: int, steady_ns: int) -> bool:
        """Whether ROS time jumped back, as where a recording begins again."""
        jumped = jumped_back(now_ns, self._ros_ns)
        self._ros_ns = now_ns
        if jumped:
            self.time_jumped_back()
            self._settled_ns = steady_ns + _SETTLING_NS
        return jumped

    # --- what follows from it

    def step(self, now_ns: int, steady_ns: int) -> Command:
        """The next command; to be called once per period, late or not."""
        elapsed = self._period if self._stepped_ns is None else (steady_ns - self._stepped_ns) / NANOSECONDS
        # Never more than two periods at once: after a standstill the robot must not make up for it.
        dt = min(max(elapsed, 0.0), 2.0 * self._period)
        self._stepped_ns = steady_ns
        self._ros_time(now_ns, steady_ns)
        expected = self._expected(now_ns)
        known = expected.known
        fault = self._fatal(elapsed, steady_ns)
        fatal = bool(fault)
        fault = fault or self._fault(steady_ns, elapsed, expected)
        self._refused = ""
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
            self._limiter.step(np.where(free, expected.target, self._limiter.position), dt, np.maximum(share, 0.0))
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
            expected.age,
            float(margins[nearest]),
            self.mapping.joints[nearest],
        )

    def _expected(self, now_ns: int) -> _Expected:
        """Where the person's angles put the joints now."""
        angles, mapping, n = self._angles, self.mapping, len(self.mapping.joints)
        if angles is None:
            unknown = np.full(len(mapping.angles), np.inf)
            return _Expected(math.nan, unknown, unknown, self._limiter.position, np.zeros(n, dtype=bool))
        age = (now_ns - angles.stamp_ns) / NANOSECONDS
        wait = max(age, 0.0)
        ahead = min(wait, self._limits.prediction)
        with np.errstate(invalid="ignore"):  # infinite and NaN say that something is not known
            possible = (np.abs(angles.position) <= _MAX_ANGLE) & (np.abs(angles.velocity) <= _MAX_RATE)
            predicted = np.where(possible, angles.position + ahead * angles.velocity, np.nan)
            # How errors of angle and velocity go together is not told; this is the most that any correlation makes of
            # them. Beyond the horizon the velocity itself is the error.
            stddev = angles.position_stddev + wait * angles.velocity_stddev + (wait - ahead) * np.abs(angles.velocity)
            stddev[~((angles.position_stddev >= 0.0) & (angles.velocity_stddev >= 0.0))] = np.nan
            sound = possible & np.isfinite(stddev)
        most = np.where(self._used, mapping.max_stddev[:, None], np.inf)
        known = (~self._used | (sound & (stddev <= most))).all(axis=1)
        turned = np.remainder(np.where(sound, predicted, 0.0) + np.pi, 2.0 * np.pi) - np.pi
        target = mapping.matrix @ turned + mapping.offset
        # Of the values that mean the same, the one nearest to where the joint is.
        turns = np.divide(self._limiter.position - target, mapping.period, out=np.zeros(n), where=mapping.period > 0.0)
        return _Expected(age, predicted, stddev, target + np.round(turns) * mapping.period, known)

    def _fatal(self, elapsed: float, steady_ns: int) -> str:
        """What is so wrong that not even the same command may be repeated; empty for nothing."""
        if self._others:
            return self._others
        if elapsed > STANDSTILL:
            return f"the commands themselves stood still for {elapsed:.2f} s"
        return self._check_tracking(steady_ns)

    def _fault(self, steady_ns: int, elapsed: float, expected: _Expected) -> str:
        """What is wrong now, or would be by the next command; empty for nothing."""
        limits, angles, age = self._limits, self._angles, expected.age
        allowed_ns = round((limits.silence - self._period) * NANOSECONDS)
        if not self.enabled:
            return "waits for a person: call its service enable once the robot stands at home"
        if self._refused or self._wrong or angles is None:
            return self._refused or self._wrong or "no angles yet"
        if steady_ns - self._heard_ns >= allowed_ns:
            return f"no new angles for {(steady_ns - self._heard_ns) / NANOSECONDS:.2f} s"
        if self._watched:
            heard = [self._sensors[sensor][1] for sensor in self._watched if sensor in self._sensors]
            listed = ", ".join(self._watched)
            if not heard:
                return f"no frame of {listed} yet"
            if steady_ns - max(heard) >= allowed_ns:
                return f"no frame of {listed} for {(steady_ns - max(heard)) / NANOSECONDS:.2f} s"
        if elapsed > limits.silence:
            return f"the commands themselves stood still for {elapsed:.2f} s"
        if age > limits.max_age or age < -_AHEAD:
            said = (
                f"{age:.2f} s old, limit {limits.max_age:g} s" if age > 0.0 else f"stamped {-age:.2f} s in the future"
            )
            return f"angles are {said}" + (", or not in ROS time" if abs(age) > _OTHER_CLOCK else "")
        needed = ~expected.known & ~self.mapping.alone
        if needed.any():
            return self._unknown(int(needed.argmax()), angles, expected)
        return self.calibration.fault(limits, angles.stamp_ns, steady_ns) or self._robot_fault(steady_ns)

    def _unknown(self, joint: int, angles: JointAngles, expected: _Expected) -> str:
        """What is wrong with the angles of a joint."""
        for place in np.flatnonzero(self._used[joint]):
            name, most = self.mapping.angles[place], self.mapping.max_stddev[joint]
            angle, rate = angles.position[place], angles.velocity[place]
            if not np.isfinite([angle, rate]).all():
                return f"{name} is not finite, or its velocity is not known"
            if not np.isfinite(expected.angle[place]):
                return f"{name} is {angle:.3g} rad at {rate:.3g} rad/s, which no body does"
            if not expected.stddev[place] <= most:
                return f"standard deviation of {name} is {expected.stddev[place]:.2f} rad, limit {most:g}"
        raise AssertionError(f"nothing is wrong with {self.mapping.joints[joint]}")

    def _robot_fault(self, steady_ns: int) -> str:
        """What is wrong with the robot itself, where it says how it stands."""
        if not self.mapping.output.state_topic:
            return ""
        if self._robot_wrong:
            return self._robot_wrong
        if self._robot_now(steady_ns) is None:
            return "the robot does not say how it stands"
        return self._astray or (self._beyond() if self.state == State.STOPPED else "")

    def _robot_now(self, steady_ns: int) -> FloatArray | None:
        """(n,) how the robot stands; None where it has not said so lately."""
        return self._robot if steady_ns - self._robot_ns <= ROBOT_SILENCE * NANOSECONDS else None

    def _beyond(self) -> str:
        """Which of the robot's joints stands beyond its limits; empty for none."""
        robot, mapping = self._robot, self.mapping
        if robot is None or not (beyond := (robot < mapping.lower) | (robot > mapping.upper)).any():
            return ""
        joint = int(beyond.argmax())
        return f"the robot's {mapping.joints[joint]} is at {robot[joint]:.3f} rad, beyond its limits"

    def _check_tracking(self, steady_ns: int) -> str:
        """Take the command back to where the robot stands, where it did not go where it was sent.

        So it does not jump when what keeps it (an emergency stop, a hand) lets it go.

        Returns:
            Why no command can say so: the robot stands too far beyond its limits. Empty where one can.
        """
        robot = self._robot_now(steady_ns)
        if self.state == State.STOPPED or robot is None:
            return ""
        share = np.ones(len(robot)) if self.state == State.HOLDING else np.abs(self._shares(steady_ns))
        allowed = self._limits.max_tracking_error * (_AT_REST + (1.0 - _AT_REST) * share)
        errors = np.abs(robot - self._limiter.position)
        if (errors <= allowed).all():
            return ""
        worst = int((errors - allowed).argmax())
        self._astray = f"the robot's {self.mapping.joints[worst]} is {errors[worst]:.2f} rad from its command"
        self._limiter.reset(robot)
        return self._beyond() if (np.abs(robot - self._limiter.position) > allowed).any() else ""

    def _next_state(self, fault: str, fatal: bool, steady_ns: int) -> None:
        limits = self._limits
        good = -1.0 if self._good_since_ns is None else (steady_ns - self._good_since_ns) / NANOSECONDS
        if fault and self.state in (State.APPROACHING, State.FOLLOWING):
            self._enter(State.HOLDING, fault, steady_ns)
        since = (steady_ns - self._since_ns) / NANOSECONDS
        if self.state in (State.STOPPED, State.HOLDING):
            if good >= limits.recover_after:
                robot = self._robot_now(steady_ns)
                if robot is not None:
                    self._limiter.reset(robot)
                self._enter(State.APPROACHING, f"everything was good for {good:.2f} s", steady_ns)
            elif fault and self.state == State.HOLDING and (fatal or since >= limits.stop_after):
                self._enter(State.STOPPED, f"held for {since:.1f} s: {fault}", steady_ns)
                self._astray = ""
            else:
                waits = f"good for {good:.2f} of {limits.recover_after:g} s"
                self._reason = fault or (f"{waits} since: {self._last_fault}" if self._last_fault else waits)
        elif self.state == State.APPROACHING and since >= limits.approach:
            self._enter(State.FOLLOWING, "the rates have reached their limits", steady_ns)

    def _enter(self, state: State, reason: str, steady_ns: int) -> None:
        self.transitions.append(Transition(self.state, state, reason))
        if state == State.APPROACHING:
            self._approached_ns = steady_ns
        self.state, self._reason, self._since_ns = state, reason, steady_ns

    def _shares(self, steady_ns: int) -> FloatArray:
        """(n,) of its rate that each joint may use; negative for one that keeps its place."""
        limits = self._limits
        ready_ns = self._known_since_ns + round(limits.recover_after * NANOSECONDS)
        begun_ns = np.maximum(ready_ns, self._approached_ns)
        waiting = self.mapping.alone & ((self._known_since_ns < 0) | (steady_ns < ready_ns))
        grown = (steady_ns - np.where(self.mapping.alone, begun_ns, self._approached_ns)) / NANOSECONDS
        share = np.minimum(grown / limits.approach, 1.0) if limits.approach > 0.0 else np.ones(len(ready_ns))
        return np.where(waiting, -1.0, share)
