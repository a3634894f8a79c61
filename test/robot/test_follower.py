"""Laws of the safe stop, for any sequence of events."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from dataclasses import fields, replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from small_mappings import content, mapping, seen

from body_tracking.core.skeleton import NANOSECONDS
from body_tracking.robot.calibration import CalibrationQuality
from body_tracking.robot.follower import Command, Follower, FollowerError, State
from draws import draws, some

PERIOD = 0.01
PERIOD_NS = round(PERIOD * NANOSECONDS)
START_NS = 1_000 * NANOSECONDS
EPOCH_NS = 1_750_000_000 * NANOSECONDS
LATENCY_NS = 30_000_000
CONVENTION = "positional"
LEGAL = {
    *((State.STOPPED, State.APPROACHING), (State.APPROACHING, State.FOLLOWING), (State.APPROACHING, State.HOLDING)),
    *((State.FOLLOWING, State.HOLDING), (State.HOLDING, State.APPROACHING), (State.HOLDING, State.STOPPED)),
}
STATE_TOPIC = "/arm/joint_states"


def quality(*missing: str, rotation: float = 0.01, translation: float = 0.01) -> CalibrationQuality:
    return CalibrationQuality(missing, rotation, translation)


class Bench:
    """A follower, its clocks, a person whom a sensor sees 30 times a second, and an obedient robot.

    Args:
        follower: arguments of the follower after the period: clock, delay.
        state_topic: of the robot; empty for none.
        alone: whether the elbow holds its place alone.
        safety: thresholds.

    Attributes:
        order: permutation of the angles in a message.
        frames: frames of the sensors per command.
        stands: position of the robot; None if it is at its command. With ``mute`` it reports none.
    """

    def __init__(self, *follower: Any, state_topic: str = "", alone: bool = False, **safety: Any) -> None:
        made = content(**safety)
        made["output"]["state_topic"] = state_topic
        made["joints"][1]["when_uncertain"] = "hold_joint" if alone else "hold_robot"
        self.follower = Follower(mapping(made), PERIOD, *follower)
        self.follower.enable()
        self.elapsed_ns = self.frame = 0
        self.seen_ns = -NANOSECONDS
        self.every_ns = NANOSECONDS // 30
        self.stands: list[float] | None = None
        self.commands: list[Command] = []
        self.mend()

    def mend(self) -> None:
        """Remove all faults."""
        self.silent = self.mute = False
        self.convention = CONVENTION
        self.stamp_ns: Callable[[], int] = lambda: self.now_ns - LATENCY_NS
        self.pose = [1.0, 0.0, 0.8]
        self.velocity = [0.0, 0.0, 0.0]
        self.stddev = [0.1, 0.1, 0.1]
        self.velocity_stddev = 0.2
        self.order = [0, 1, 2]
        self.frames = 1
        self.quality: CalibrationQuality | None = quality()

    @property
    def steady_ns(self) -> int:
        return START_NS + self.elapsed_ns

    @property
    def now_ns(self) -> int:
        return EPOCH_NS + self.elapsed_ns

    def receive(self, convention: str) -> None:
        angles = seen(self.stamp_ns(), self.pose, self.velocity, self.stddev, self.velocity_stddev)
        arrays = {each.name: getattr(angles, each.name)[self.order] for each in fields(angles)[2:]}
        angles = replace(angles, names=tuple(angles.names[k] for k in self.order), **arrays)
        self.follower.receive_angles(angles, convention, self.now_ns, self.steady_ns)

    def run(self, seconds: float = PERIOD) -> Command:
        """Run for some time; returns the last command."""
        for _ in range(round(seconds / PERIOD)):
            self.elapsed_ns += PERIOD_NS
            self.frame += self.frames
            self.follower.receive_frame("kinect2", EPOCH_NS + self.frame, self.steady_ns)
            if self.quality is not None:
                self.follower.calibration.receive_quality(self.quality, self.steady_ns)
            if not self.mute:
                position = self.commands[-1].position if self.commands else None
                stands = self.stands or ([0.0, 0.1] if position is None else position)
                self.follower.receive_robot_state(
                    ("elbow", "gripper", "shoulder"), np.array([stands[1], 9.0, stands[0]]), self.steady_ns
                )
            if not self.silent and self.elapsed_ns - self.seen_ns >= self.every_ns:
                self.seen_ns = self.elapsed_ns
                self.receive(self.convention)
            self.commands.append(self.follower.step(self.now_ns, self.steady_ns))
        return self.commands[-1]

    def changes(self) -> list[tuple[State, State]]:
        return [(each.before, each.after) for each in self.follower.transitions]


@cache
def _following(**options: Any) -> Bench:
    bench = Bench(**options)
    assert bench.run(3.0).state == State.FOLLOWING
    return bench


def following(**options: Any) -> Bench:
    """A bench of its own, whose robot follows."""
    bench = copy.deepcopy(_following(**options))
    bench.mend()  # its clock is that of the copy
    return bench


def place(command: Command) -> np.ndarray:
    assert command.position is not None
    return command.position


def test_it_begins_stopped_approaches_and_follows() -> None:
    bench = Bench()
    assert bench.run(0.05).position is None
    last = bench.run(4.0)
    np.testing.assert_allclose(place(last), [1.0, 0.8], atol=2e-3)
    assert bench.changes() == [(State.STOPPED, State.APPROACHING), (State.APPROACHING, State.FOLLOWING)]
    assert last.age == pytest.approx(0.03, abs=0.04)
    assert (last.nearest, last.margin) == ("elbow", pytest.approx(0.8, abs=1e-2))


@pytest.mark.parametrize(("age", "moved"), [(0.05, 0.05), (0.1, 0.1), (0.3, 0.1)])
def test_a_moving_angle_is_predicted_to_now_but_not_beyond_the_horizon(age: float, moved: float) -> None:
    bench = Bench(prediction=0.1, max_age=0.5, approach=0.0, recover_after=0.0)
    bench.pose, bench.velocity, bench.every_ns = [0.5, 0.0, 0.5], [1.0, 0.0, -1.0], 0
    bench.stamp_ns = lambda: bench.now_ns - round(age * NANOSECONDS)
    np.testing.assert_allclose(place(bench.run(2.0)), [0.5 + moved, 0.5 - moved], atol=1e-3)


@settings(max_examples=draws(5, 10), suppress_health_check=[HealthCheck.too_slow])
@given(st.floats(0.0, 0.09), st.floats(0.0, 1.0))
def test_it_holds_within_the_silence_of_the_last_angles(phase: float, speed: float) -> None:
    bench = following()
    bench.velocity = [speed, 0.0, 0.0]
    bench.run(0.2 + phase)
    bench.silent = True
    last_ns = START_NS + bench.seen_ns
    while bench.steady_ns < last_ns + 100_000_000 - PERIOD_NS:
        bench.run()
    held = bench.commands[-1]
    assert held.state == State.HOLDING and "no new angles" in held.reason
    # the elbow has no limit of acceleration and stands; the shoulder comes to rest at 20 rad/s^2
    first = place(next(each for each in bench.commands if each.state == State.HOLDING))
    later = place(bench.run(0.5))
    assert later[1] == first[1]
    assert later[0] - first[0] <= 2.0**2 / (2 * 20.0)


def test_it_begins_again_after_good_data_for_the_stated_time_without_a_jump() -> None:
    bench = following()
    bench.silent = True
    held = bench.run(0.5)
    bench.silent, bench.pose = False, [-0.5, 0.0, 1.9]
    assert bench.run(0.48).state == State.HOLDING
    begun = len(bench.commands)
    assert bench.run(0.1).state == State.APPROACHING
    bench.run(0.3)
    positions = np.array([each.position for each in bench.commands[begun - 1 :]])
    np.testing.assert_allclose(positions[0], place(held), atol=1e-9)
    speeds = np.abs(np.diff(positions, axis=0)) / PERIOD
    # a third of a second into the approach of 1.5 s no more than that share of the rate is used
    assert (speeds.max(axis=0) <= np.array([2.0, 3.0]) * 0.4 / 1.5 + 1e-9).all()
    np.testing.assert_allclose(place(bench.run(3.0)), [-0.5, 1.9], atol=2e-3)


NOT_SURE = "standard deviation of shoulder_elevation_left is nan"
TWICE = "angles of positional in another order or twice"
FAULTS: dict[str, tuple[dict[str, Any], str]] = {
    "not finite": ({"pose": [math.nan, 0.0, 0.0]}, "shoulder_elevation_left is not finite"),
    "infinite": ({"pose": [0.0, 0.0, math.inf]}, "elbow_flexion_left is not finite"),
    "velocity unknown": ({"velocity": [math.nan] * 3}, "shoulder_elevation_left is not finite, or its velocity"),
    "not observed": ({"stddev": [0.1, 0.1, math.inf]}, "standard deviation of elbow_flexion_left is inf rad"),
    "uncertain": ({"stddev": [0.5, 0.1, 0.1]}, "standard deviation of shoulder_elevation_left is 0.5"),
    "negative deviation": ({"stddev": [-0.1, 0.1, 0.1]}, NOT_SURE),
    "no deviation": ({"stddev": [0.1, 0.1, math.nan]}, "standard deviation of elbow_flexion_left is nan rad"),
    "a deviation of zero": ({"stddev": [0.0, 0.1, 0.1]}, NOT_SURE),
    "negative deviation of the rate": ({"velocity_stddev": -0.2}, NOT_SURE),
    "a deviation of zero of the rate": ({"velocity_stddev": 0.0}, NOT_SURE),
    "no deviation of the rate": ({"velocity_stddev": math.nan}, NOT_SURE),
    "a rate that no body has": ({"velocity": [0.0, 0.0, -60.0]}, "elbow_flexion_left is 0.8 rad at -60 rad/s"),
    "an angle that no body has": ({"pose": [1e300, 0.0, 0.0]}, "shoulder_elevation_left is 1e+300 rad"),
    "a missing angle": ({"order": [0, 1]}, "not the angles of positional: elbow_flexion_left is missing"),
    "another order": ({"order": [2, 1, 0]}, TWICE),
    "the last angle twice": ({"order": [0, 1, 2, 2]}, TWICE),
    "the first angle twice": ({"order": [0, 0, 1, 2]}, TWICE),
    "another convention": (
        {"convention": "isb", "pose": [-1.0, 0.0, 0.8]},
        "angles are of the convention 'isb', the mapping needs 'positional'",
    ),
    "no convention": ({"convention": ""}, "no convention (an empty frame_id)"),
    "no angles": ({"silent": True}, "no new angles for"),
    "frames that repeat": ({"frames": 0}, "no frame of kinect1, kinect2 for"),
    "a missing sensor": ({"quality": quality("kinect2")}, "calibration is missing: kinect2"),
    "a turned sensor": ({"quality": quality(rotation=0.07)}, "poor: standard deviation 0.07 rad of a sensor's orient"),
    "a misplaced sensor": (
        {"quality": quality(translation=math.nan)},
        "poor: standard deviation nan m of a sensor's p",
    ),
    "silent calibration": ({"quality": None}, "no diagnostics of calibration"),
    "silent robot": ({"mute": True}, "no joint states of the robot"),
}
"""Faults by name, and their reported reasons."""
WITHIN = {
    "no angles": 0.1,
    "frames that repeat": 0.1,
    "silent calibration": 5.1,
    "silent robot": 0.55,
}
"""Seconds within which the robot holds; for all other faults: one frame of a sensor at 30 Hz, and one command."""


@pytest.mark.parametrize("kind", FAULTS)
def test_every_fault_is_held_by_name_then_stopped_and_forgotten_when_it_ends(kind: str) -> None:
    (wrong, reported), within = FAULTS[kind], WITHIN.get(kind, 0.05)
    bench = following(state_topic=STATE_TOPIC, calibration=True, stop_after=1.0)
    bench.follower.watch_sensors(("kinect1", "kinect2"))
    before = bench.commands[-1]
    vars(bench).update(wrong)
    held = bench.run(within)
    assert held.state == State.HOLDING and reported in held.reason
    np.testing.assert_allclose(place(held), place(before), atol=2.0**2 / (2 * 20.0))
    if kind not in some(list(FAULTS), 8):
        return  # what follows is the same for all
    assert bench.run(0.9 - within).state == State.HOLDING
    stopped = bench.run(within + 0.2)
    assert (stopped.state, stopped.position) == (State.STOPPED, None)
    assert "held for 1.0 s: " in str(bench.follower.transitions[-1])
    assert reported in str(bench.follower.transitions[-1])
    bench.mend()
    assert bench.run(2.4).state == State.FOLLOWING


@pytest.mark.parametrize("kind", [kind for kind in FAULTS if kind != "frames that repeat"])
def test_with_a_fault_nothing_begins(kind: str) -> None:
    wrong, reported = FAULTS[kind]
    bench = Bench(state_topic=STATE_TOPIC, calibration=True)
    vars(bench).update(wrong)
    stopped = bench.run(1.0)
    assert {each.state for each in bench.commands} == {State.STOPPED}
    assert reported in stopped.reason or (kind == "no angles" and stopped.reason == "no angles yet")


def test_an_angle_that_jumps_farther_than_a_person_moves_is_not_followed_at_once() -> None:
    bench = following()
    before = place(bench.commands[-1])
    bench.pose = [1.0 - math.pi, 0.0, 0.8]
    held = bench.run(0.1)
    assert held.state == State.HOLDING and "shoulder_elevation_left jumped by 3.14 rad" in held.reason
    assert bench.run(0.35).state == State.HOLDING
    np.testing.assert_allclose(place(bench.commands[-1]), before, atol=1e-9)
    assert bench.run(0.2).state == State.APPROACHING  # the new pose lasts: it may be the right one
    bench.pose = [1.0, 0.0, 0.8]
    bench.run(0.04)
    bench.pose = [1.0 + math.pi, 0.0, 0.8]  # two jumps, and one command after each
    assert bench.run(0.04).state == State.HOLDING


@pytest.mark.parametrize("messages", [1, 2, 3])
def test_a_jump_counts_also_where_further_angles_come_before_the_next_command(messages: int) -> None:
    bench = following()
    for number in range(messages):
        bench.elapsed_ns += PERIOD_NS // 4
        bench.pose = [1.0 - math.pi * (number == 0), 0.0, 0.8]
        bench.receive(CONVENTION)
    bench.silent = True
    assert "jumped by" in bench.run().reason


def test_fast_angles_and_those_of_another_sensor_or_after_a_break_do_not_jump() -> None:
    bench = following()
    bench.pose, bench.velocity = [-0.2, 0.0, 1.9], [-40.0, 0.0, 33.0]  # in a thirtieth of a second
    assert bench.run(0.05).state == State.FOLLOWING
    bench.elapsed_ns += 10_000  # the frame of another sensor, which sees the arm a little elsewhere
    bench.pose = [0.0, 0.0, 1.8]
    bench.receive(CONVENTION)
    assert bench.run().state == State.FOLLOWING
    bench.every_ns = NANOSECONDS // 12
    bench.run(0.2)
    bench.pose, bench.velocity = [2.9, 0.0, 0.0], [0.0, 0.0, 0.0]
    assert bench.run(0.2).state == State.FOLLOWING


def test_unused_angles_may_be_unknown() -> None:
    bench = following()
    bench.pose[1] = math.nan
    bench.stddev[1] = math.inf
    assert bench.run(0.5).state == State.FOLLOWING


def test_a_joint_may_keep_its_place_alone_and_come_back_slowly() -> None:
    bench = Bench(alone=True)
    bench.run(4.0)
    bench.pose, bench.stddev = [0.5, 0.0, 1.9], [0.1, 0.1, math.inf]
    last = bench.run(1.5)
    assert (last.state, last.kept) == (State.FOLLOWING, ("elbow",))
    np.testing.assert_allclose(place(last), [0.5, 0.8], atol=5e-3)
    bench.stddev = [0.1, 0.1, 0.1]
    assert bench.run(0.4).kept == ("elbow",)
    bench.run(0.3)
    speeds = np.diff([place(each)[1] for each in bench.commands[-3:]]) / PERIOD
    assert ((np.abs(speeds) > 0.0) & (np.abs(speeds) < 3.0 * 0.3)).all()
    last = bench.run(2.5)
    assert last.kept == ()
    np.testing.assert_allclose(place(last), [0.5, 1.9], atol=2e-3)


def test_a_calibration_may_get_too_old() -> None:
    bench = Bench(calibration=True, max_calibration_age=20.0)
    assert "age of the calibration is not known" in bench.run(0.1).reason
    bench.follower.calibration.receive_pose("kinect2", EPOCH_NS - 15 * NANOSECONDS)
    assert bench.run(4.0).state == State.FOLLOWING
    assert "calibration is 20 s old, limit 20 s" in bench.run(1.4).reason


# --- clocks


def test_angles_that_came_before_the_clock_do_not_count_for_long() -> None:
    bench = Bench()
    bench.follower.receive_angles(seen(bench.now_ns - LATENCY_NS - 1, bench.pose), CONVENTION, 0, bench.steady_ns)
    assert bench.run(3.0).state == State.FOLLOWING


@pytest.mark.parametrize(("shift", "reported"), [(-0.4, "old, limit 0.3 s"), (0.2, "in the future")])
def test_old_angles_and_angles_of_the_future_are_not_followed(shift: float, reported: str) -> None:
    bench = Bench()
    bench.stamp_ns = lambda: bench.now_ns + round(shift * NANOSECONDS)
    command = bench.run(1.0)
    assert command.state == State.STOPPED
    assert reported in command.reason


@pytest.mark.parametrize(("seconds", "state"), [(0.05, State.FOLLOWING), (1.0, State.HOLDING), (2.1, State.STOPPED)])
def test_a_standstill_of_the_commands_holds_or_stops_at_once_and_is_not_made_up_for(
    seconds: float, state: State
) -> None:
    bench = following(stop_after=60.0)
    bench.pose = [2.4, 0.0, 2.0]
    before = bench.run(0.1)
    bench.elapsed_ns += round(seconds * NANOSECONDS)
    after = bench.run()
    assert after.state == state
    late = f"gap in the commands of {seconds + PERIOD:.2f} s"
    assert (late in after.reason) == (state != State.FOLLOWING)
    if state == State.STOPPED:
        assert after.position is None  # not even the last command is repeated
    else:
        assert (np.abs(place(after) - place(before)) <= np.array([2.0, 3.0]) * 2 * PERIOD + 1e-9).all()


def test_a_backward_jump_of_time_is_reported_and_holds() -> None:
    bench = following()
    now_ns = bench.now_ns - 10 * NANOSECONDS
    for behind_ns, jumps in ((0, True), (NANOSECONDS - 5, False)):
        angles = seen(now_ns - behind_ns, bench.pose)
        assert bench.follower.receive_angles(angles, CONVENTION, now_ns, bench.steady_ns) == jumps
    bench = following()
    bench.follower.time_jumped_back()
    bench.silent = True
    held = bench.run()
    assert (held.state, held.reason) == (State.HOLDING, "time jumped back")


def test_foreign_angles_between_the_right_ones_are_not_overlooked() -> None:
    bench = following()
    for _ in range(100):
        bench.run()
        # the right ones come between this and the next command
        bench.receive("isb")
        bench.receive(CONVENTION)
    assert all(each.state == State.HOLDING for each in bench.commands[-99:])


# --- who else commands, and who may


def test_another_publisher_of_the_commands_stops_at_once() -> None:
    bench = following(state_topic=STATE_TOPIC)
    bench.follower.report_publishers("another publisher of /arm: /other")
    stopped = bench.run()
    assert (stopped.state, stopped.position) == (State.STOPPED, None)
    assert bench.changes()[-2:] == [(State.FOLLOWING, State.HOLDING), (State.HOLDING, State.STOPPED)]
    assert bench.run(1.0).reason == "another publisher of /arm: /other"
    bench.follower.report_publishers("")
    assert bench.run(0.45).state == State.STOPPED
    assert bench.run(0.2).state == State.APPROACHING


def test_a_robot_without_state_topic_waits_for_a_person() -> None:
    bench = Bench()
    bench.follower = Follower(mapping(), PERIOD)
    last = bench.run(3.0)
    assert last.state == State.STOPPED and "waits for a person" in last.reason
    bench.follower.enable()
    assert bench.run(3.0).state == State.FOLLOWING
    with pytest.raises(FollowerError, match="not stopped: following"):
        bench.follower.enable()


def another_publisher(bench: Bench) -> None:
    bench.follower.report_publishers("another publisher of /arm: /other")
    assert bench.run().state == State.STOPPED
    bench.follower.report_publishers("")


def gap(bench: Bench) -> None:
    bench.elapsed_ns += round(2.1 * NANOSECONDS)
    assert bench.run().state == State.STOPPED


@pytest.mark.parametrize("fault", [another_publisher, gap])
@pytest.mark.parametrize("before", [State.FOLLOWING, State.STOPPED])
def test_a_robot_that_may_have_been_moved_waits_for_a_person_and_begins_at_home(
    fault: Callable[[Bench], None], before: State
) -> None:
    bench = following(stop_after=0.5)
    bench.mute = True  # without a state_topic
    if before == State.STOPPED:
        bench.silent = True
        assert bench.run(1.0).state == State.STOPPED
    fault(bench)
    bench.silent = False
    last = bench.run(3.0)
    assert last.state == State.STOPPED and "waits for a person" in last.reason
    bench.follower.enable()
    begun = len(bench.commands)
    assert bench.run(0.6).state == State.APPROACHING
    first = next(each for each in bench.commands[begun:] if each.position is not None)
    np.testing.assert_allclose(place(first), bench.follower.mapping.home, atol=1e-3)


def test_nobody_enables_a_robot_that_another_node_commands() -> None:
    bench = Bench()
    bench.follower = Follower(mapping(), PERIOD)
    bench.follower.report_publishers("another publisher of /arm: /other")
    with pytest.raises(FollowerError, match="another publisher of /arm: /other"):
        bench.follower.enable()


@pytest.mark.parametrize("start_ns", [0, EPOCH_NS - 86_400 * NANOSECONDS, EPOCH_NS + 86_400 * NANOSECONDS])
def test_angles_by_another_clock_are_never_followed(start_ns: int) -> None:
    bench = following(stop_after=0.5)
    moved = len(bench.follower.transitions)
    bench.stamp_ns = lambda: start_ns + bench.elapsed_ns
    for _ in range(2):
        command = bench.run(3.0)
        assert command.state == State.STOPPED
        assert command.reason.startswith("angles are ") and command.reason.endswith(", or not in ROS time")
        bench.follower.enable()  # a person cannot make it so, either
    assert not [each for each in bench.follower.transitions[moved:] if each.after == State.APPROACHING]


# --- the robot's own word


def test_it_begins_where_the_robot_stands() -> None:
    bench = Bench(state_topic=STATE_TOPIC)
    bench.stands = [1.5, 0.3]
    bench.run(0.6)
    first = next(each for each in bench.commands if each.position is not None)
    np.testing.assert_allclose(place(first), [1.5, 0.3], atol=1e-9)


@pytest.mark.parametrize(
    ("joints", "position", "reported"),
    [
        (("shoulder",), [0.0], "elbow is not among them"),
        (("shoulder", "elbow", "elbow"), [0.0, 0.0, 1.0], "elbow is there twice"),
        (("shoulder", "elbow"), [0.0], "1 positions of 2 joints"),
        (("shoulder", "elbow"), [0.0, math.nan], "not finite"),
    ],
)
def test_invalid_joint_states_are_refused_and_not_followed(
    joints: tuple[str, ...], position: list[float], reported: str
) -> None:
    bench = Bench(state_topic=STATE_TOPIC)
    bench.mute = True
    with pytest.raises(FollowerError, match=reported):
        bench.follower.receive_robot_state(joints, np.array(position), bench.steady_ns)
    assert reported in bench.run().reason


def test_while_the_robot_stands_still_its_command_stays_near_by_default() -> None:
    """Held by an emergency stop and moved by hand, whatever the person does; then released."""
    bench = Bench(state_topic=STATE_TOPIC)
    allowed, rate = bench.follower.mapping.safety.max_tracking_error, bench.follower.mapping.rate
    assert allowed < 0.5
    stands = np.array([1.0, 0.8])
    rng = np.random.default_rng(1)
    begun = 0
    aim = np.array(bench.pose)
    for step in range(3600):
        bench.stands = list(stands)
        before = bench.follower.state
        command = bench.run()
        if step % 100 == 0:
            aim = np.array([rng.uniform(-1.0, 2.5), 0.0, rng.uniform(0.0, 2.0)])
        bench.pose = list(bench.pose + np.clip(aim - bench.pose, -0.2, 0.2))  # quickly, but no jump
        if command.position is not None:
            lead = np.abs(command.position - stands)
            assert (lead <= allowed + rate * PERIOD).all()
            if before in (State.STOPPED, State.HOLDING) and command.state == State.APPROACHING:
                begun += 1
                assert (lead <= rate * PERIOD).all()
            if step >= 2400:  # released: a robot that lags by 0.05 s
                stands = stands + (command.position - stands) * PERIOD / 0.05
        if 1200 < step < 1800:
            stands = np.clip(stands + rng.normal(0.0, 0.02, 2), [-1.0, 0.0], [2.5, 2.0])
    assert begun > 5
    assert command.state == State.FOLLOWING
    reported = [str(each) for each in bench.follower.transitions]
    assert any("rad from its command" in each and "-> holding" in each for each in reported)
    assert any("holding -> stopped" in each for each in reported)


def test_where_the_robot_was_moved_while_it_held_it_goes_on_from_there() -> None:
    bench = Bench(state_topic=STATE_TOPIC, stop_after=60.0)
    bench.run(4.0)
    bench.stands = [1.0, 0.8]
    bench.silent = True
    held = bench.run(1.0)
    assert held.state == State.HOLDING
    np.testing.assert_allclose(place(held), [1.0, 0.8], atol=1e-2)
    bench.stands = [1.2, 0.6]  # within the tracking error: nobody notices
    bench.run(1.0)
    bench.silent = False
    while (again := bench.run()).state == State.HOLDING:
        assert len(bench.commands) < 700
    np.testing.assert_allclose(place(again), [1.2, 0.6], atol=1e-3)
    bench.stands = None
    assert bench.run(2.0).state == State.FOLLOWING


def test_no_commands_for_a_robot_beyond_its_limits_until_it_is_back() -> None:
    bench = Bench(state_topic=STATE_TOPIC)
    for elbow, seconds in ((2.2, 1.0), (0.8, 4.0), (2.6, 4.0), (0.8, 4.0)):
        bench.stands = [1.0, elbow]
        begin = len(bench.commands)
        last = bench.run(seconds)
        if elbow > 2.0:
            assert all(each.state == State.STOPPED for each in bench.commands[begin:])
            assert f"the robot's elbow is at {elbow:.3f} rad, beyond its limits" in last.reason
        else:
            assert last.state == State.FOLLOWING


@pytest.mark.parametrize(
    ("period", "reported"),
    [
        (0.1, "silence 0.1 s is no more than the period 0.1 s"),
        (0.05, "time_from_start 0.02 s is less than the period 0.05 s"),
    ],
)
def test_a_period_longer_than_the_limits_is_refused(period: float, reported: str) -> None:
    with pytest.raises(FollowerError, match=reported):
        Follower(mapping(), period)


# --- whatever happens

numbers = st.one_of(st.floats(-7.0, 7.0), st.sampled_from([math.nan, math.inf, -math.inf, 1e300, 0.0]))
deviations = st.one_of(st.floats(0.0, 0.6), st.sampled_from([math.nan, math.inf]))


three = st.lists(st.floats(-3.0, 3.0), min_size=3, max_size=3)
calm = st.tuples(st.just(PERIOD_NS), three, three, st.just([0.1] * 3), st.integers(0, 100_000_000), st.integers(1, 30))
any_three = st.lists(numbers, min_size=3, max_size=3)
wild = st.tuples(
    st.just(PERIOD_NS) | st.integers(0, 400_000_000),
    st.none() | any_three,
    any_three,
    st.lists(deviations, min_size=3, max_size=3),
    st.integers(-15_000_000_000, 15_000_000_000),
    st.integers(1, 10),
)
"""Nanoseconds between two commands; position or None, velocity, deviation and age of angles; how often."""


@settings(max_examples=draws(12, 40), deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.lists(calm | wild, max_size=12), st.booleans())
def test_commands_are_within_limits_for_any_sequence_of_events(events: list[Any], alone: bool) -> None:
    follower = Bench(alone=alone, recover_after=0.05, approach=0.1, stop_after=0.3, max_stddev=1.0).follower
    robot = follower.mapping
    steady_ns, now_ns = START_NS, EPOCH_NS
    last, last_ns, heard_ns, state = robot.home, steady_ns, None, State.STOPPED
    for pause_ns, position, velocity, stddev, age_ns, repeat in events:
        for _ in range(repeat):
            steady_ns += pause_ns
            now_ns += pause_ns
            if position is not None:
                heard_ns = steady_ns
                follower.receive_angles(
                    seen(now_ns - age_ns, position, velocity, stddev), CONVENTION, now_ns, steady_ns
                )
            command = follower.step(now_ns, steady_ns)
            if heard_ns is None or steady_ns - heard_ns >= 90_000_000:
                assert command.state in (State.HOLDING, State.STOPPED)
            assert (command.position is None) == (command.state == State.STOPPED)
            if command.position is not None:
                assert ((command.position >= robot.lower) & (command.position <= robot.upper)).all()
                # also over a pause without commands: it continues where it stopped
                elapsed = (steady_ns - last_ns) / NANOSECONDS
                assert (np.abs(command.position - last) <= robot.rate * elapsed + 1e-9).all()
                if state == command.state == State.HOLDING:
                    assert command.position[1] == last[1]
                last, last_ns = command.position, steady_ns
            assert command.reason
            assert state == command.state or any(each.after == command.state for each in follower.transitions)
            assert all((each.before, each.after) in LEGAL and each.reason for each in follower.transitions)
            follower.transitions.clear()
            state = command.state
