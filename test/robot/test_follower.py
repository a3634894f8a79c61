"""Laws of the safe stop: whatever is heard, and whenever."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from small_mappings import content, mapping, seen

from body_tracking.robot.calibration import CalibrationQuality
from body_tracking.robot.follower import Command, Follower, FollowerError, State
from body_tracking.skeleton import NANOSECONDS

PERIOD = 0.01
START_NS = 1_000 * NANOSECONDS
EPOCH_NS = 1_750_000_000 * NANOSECONDS
LATENCY_NS = 30_000_000
CONVENTION = "positional"
SOUND = CalibrationQuality((), 0.01, 0.01)
LEGAL = {
    (State.STOPPED, State.APPROACHING),
    (State.APPROACHING, State.FOLLOWING),
    (State.APPROACHING, State.HOLDING),
    (State.FOLLOWING, State.HOLDING),
    (State.HOLDING, State.APPROACHING),
    (State.HOLDING, State.STOPPED),
}


class Bench:
    """A follower, its clocks, and a person who is seen 30 times a second."""

    def __init__(self, follower: Follower | None = None, **safety: Any) -> None:
        self.follower = follower or Follower(mapping(content(**safety)), PERIOD)
        self.follower.enable()
        self.convention = CONVENTION
        self.elapsed_ns = 0
        self.seen_ns = -NANOSECONDS
        self.silent = False
        self.pose = [1.0, 0.0, 0.8]
        self.velocity = [0.0, 0.0, 0.0]
        self.stddev = [0.1, 0.1, 0.1]
        self.velocity_stddev = 0.2
        self.commands: list[Command] = []

    @property
    def steady_ns(self) -> int:
        return START_NS + self.elapsed_ns

    @property
    def now_ns(self) -> int:
        return EPOCH_NS + self.elapsed_ns

    def run(self, seconds: float) -> Command:
        """Go on for some time; the last command."""
        for _ in range(round(seconds / PERIOD)):
            self.elapsed_ns += round(PERIOD * NANOSECONDS)
            if not self.silent and self.elapsed_ns - self.seen_ns >= NANOSECONDS // 30:
                self.seen_ns = self.elapsed_ns
                stamp_ns = self.now_ns - LATENCY_NS
                angles = seen(stamp_ns, self.pose, self.velocity, self.stddev, self.velocity_stddev)
                self.follower.hear_angles(angles, self.convention, self.now_ns, self.steady_ns)
            self.commands.append(self.follower.step(self.now_ns, self.steady_ns))
        return self.commands[-1]


def following(**safety: Any) -> Bench:
    bench = Bench(**safety)
    assert bench.run(3.0).state == State.FOLLOWING
    return bench


def test_it_begins_stopped_approaches_and_follows() -> None:
    bench = Bench()
    assert bench.run(0.05).position is None
    last = bench.run(4.0)
    np.testing.assert_allclose(last.position, [1.0, 0.8], atol=2e-3)
    assert [(each.before, each.after) for each in bench.follower.transitions] == [
        (State.STOPPED, State.APPROACHING),
        (State.APPROACHING, State.FOLLOWING),
    ]
    assert last.age == pytest.approx(0.03, abs=0.04)
    assert (last.nearest, last.margin) == ("elbow", pytest.approx(0.8, abs=1e-2))


def test_a_moving_angle_is_predicted_to_now_but_not_beyond_the_horizon() -> None:
    follower = Follower(mapping(content(prediction=0.1, max_age=0.5, approach=0.0, recover_after=0.0)), PERIOD)
    follower.enable()
    follower.hear_angles(seen(EPOCH_NS, [0.5, 0.0, 0.5], [1.0, 0.0, -1.0]), CONVENTION, EPOCH_NS, START_NS)
    for age, moved in ((0.05, 0.05), (0.1, 0.1), (0.3, 0.1)):
        steady_ns, now_ns = START_NS, EPOCH_NS + round(age * NANOSECONDS)
        for step in range(200):
            # the same angles, new each time, always of the same age: the joints come to where they are expected
            steady_ns += 10_000_000
            follower.hear_angles(
                seen(EPOCH_NS + step + 1, [0.5, 0.0, 0.5], [1.0, 0.0, -1.0]), CONVENTION, now_ns, steady_ns
            )
            command = follower.step(now_ns + step + 1, steady_ns)
        np.testing.assert_allclose(command.position, [0.5 + moved, 0.5 - moved], atol=1e-3)


@settings(max_examples=10, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.floats(0.0, 0.09), st.floats(0.0, 1.0))
def test_it_holds_within_the_silence_of_the_last_angles(phase: float, speed: float) -> None:
    bench = following()
    bench.velocity = [speed, 0.0, 0.0]
    bench.run(0.2 + phase)
    bench.silent = True
    last_ns = START_NS + bench.seen_ns
    while bench.steady_ns < last_ns + 100_000_000 - round(PERIOD * NANOSECONDS):
        bench.run(PERIOD)
    held = bench.commands[-1]
    assert held.state == State.HOLDING
    assert "no new angles" in held.reason
    # the elbow has no limit of acceleration and stands; the shoulder comes to rest at 20 rad/s^2
    first = next(each for each in bench.commands if each.state == State.HOLDING)
    assert first.position is not None
    later = bench.run(0.5)
    assert later.position is not None
    assert later.position[1] == first.position[1]
    assert later.position[0] - first.position[0] <= 2.0**2 / (2 * 20.0)


def test_it_stops_publishing_after_the_stated_time_and_says_why() -> None:
    bench = following(stop_after=1.0)
    bench.silent = True
    assert bench.run(1.0).state == State.HOLDING
    stopped = bench.run(0.15)
    assert stopped.state == State.STOPPED
    assert stopped.position is None
    last = bench.follower.transitions[-1]
    assert "held for 1.0 s: no new angles" in str(last)


def test_it_begins_again_after_good_data_for_the_stated_time_without_a_jump() -> None:
    bench = following()
    bench.silent = True
    held = bench.run(0.5)
    bench.silent, bench.pose = False, [-0.5, 0.0, 1.9]
    waiting = bench.run(0.48)
    assert waiting.state == State.HOLDING
    begun = len(bench.commands)
    assert bench.run(0.1).state == State.APPROACHING
    assert held.position is not None
    positions = np.array([each.position for each in bench.commands[begun - 1 :]])
    np.testing.assert_allclose(positions[0], held.position, atol=1e-9)
    bench.run(0.3)
    positions = np.array([each.position for each in bench.commands[begun - 1 :]])
    speeds = np.abs(np.diff(positions, axis=0)) / PERIOD
    # a third of a second into the approach of 1.5 s no more than that share of the rate is used
    assert (speeds.max(axis=0) <= np.array([2.0, 3.0]) * 0.4 / 1.5 + 1e-9).all()
    np.testing.assert_allclose(bench.run(3.0).position, [-0.5, 1.9], atol=2e-3)


FAULTS = {
    "not finite": ({"pose": [math.nan, 0.0, 0.0]}, "shoulder_elevation_left is not finite"),
    "infinite": ({"pose": [0.0, 0.0, math.inf]}, "elbow_flexion_left is not finite"),
    "velocity unknown": ({"velocity": [math.nan] * 3}, "shoulder_elevation_left is not finite, or its velocity"),
    "not observed": ({"stddev": [0.1, 0.1, math.inf]}, "standard deviation of elbow_flexion_left is inf rad"),
    "uncertain": ({"stddev": [0.5, 0.1, 0.1]}, "standard deviation of shoulder_elevation_left is 0.5"),
    "negative deviation": ({"stddev": [-0.1, 0.1, 0.1]}, "standard deviation of shoulder_elevation_left is nan rad"),
    "no deviation": ({"stddev": [0.1, 0.1, math.nan]}, "standard deviation of elbow_flexion_left is nan rad"),
    "negative deviation of the rate": (
        {"velocity_stddev": -0.2},
        "standard deviation of shoulder_elevation_left is nan",
    ),
    "no deviation of the rate": ({"velocity_stddev": math.nan}, "standard deviation of shoulder_elevation_left is nan"),
    "a rate that no body has": ({"velocity": [0.0, 0.0, -60.0]}, "elbow_flexion_left is 0.8 rad at -60 rad/s"),
    "an angle that no body has": ({"pose": [1e300, 0.0, 0.0]}, "shoulder_elevation_left is 1e+300 rad"),
}


@pytest.mark.parametrize("kind", FAULTS)
def test_bad_angles_are_held_at_once_by_name(kind: str) -> None:
    changes, said = FAULTS[kind]
    bench = following()
    for name, value in changes.items():
        setattr(bench, name, value)
    held = bench.run(0.05)
    assert held.state == State.HOLDING
    assert said in held.reason
    assert held.position is not None
    assert np.isfinite(held.position).all()


def test_what_nobody_asked_for_may_be_unknown() -> None:
    bench = following()
    bench.pose[1] = math.nan
    bench.stddev[1] = math.inf
    assert bench.run(0.5).state == State.FOLLOWING


def test_a_joint_may_keep_its_place_alone_and_come_back_slowly() -> None:
    made = content()
    made["joints"][1]["when_uncertain"] = "hold_joint"
    bench = Bench(Follower(mapping(made), PERIOD))
    bench.run(4.0)
    bench.pose, bench.stddev = [0.5, 0.0, 1.9], [0.1, 0.1, math.inf]
    last = bench.run(1.5)
    assert (last.state, last.kept) == (State.FOLLOWING, ("elbow",))
    np.testing.assert_allclose(last.position, [0.5, 0.8], atol=5e-3)
    bench.stddev = [0.1, 0.1, 0.1]
    assert bench.run(0.4).kept == ("elbow",)
    bench.run(0.3)
    speeds = [np.diff([bench.commands[-k].position, bench.commands[-k - 1].position], axis=0) / PERIOD for k in (1, 2)]
    assert all(0.0 < abs(speed[0, 1]) < 3.0 * 0.3 for speed in speeds)
    last = bench.run(2.5)
    assert last.kept == ()
    np.testing.assert_allclose(last.position, [0.5, 1.9], atol=2e-3)


def test_angles_that_are_only_expected_do_not_hide_that_every_sensor_is_silent() -> None:
    bench = Bench()
    bench.follower.watch_sensors(("kinect1", "kinect2"))
    assert "no frame of kinect1, kinect2 yet" in bench.run(1.0).reason
    for frame in range(400):
        bench.follower.hear_sensor("kinect2", EPOCH_NS + frame, bench.steady_ns)
        bench.run(PERIOD)
    assert bench.commands[-1].state == State.FOLLOWING
    for _ in range(9):
        bench.follower.hear_sensor("kinect2", EPOCH_NS + 399, bench.steady_ns)  # the same frame again is none
        bench.run(PERIOD)
    assert bench.run(PERIOD).state == State.HOLDING
    assert "no frame of kinect1, kinect2 for" in bench.run(0.1).reason


@pytest.mark.parametrize(
    ("quality", "said"),
    [
        (None, "calibration has not been heard of"),
        (CalibrationQuality(("kinect2",), math.nan, math.nan), "calibration is missing: kinect2"),
        (
            CalibrationQuality((), 0.2, 0.01),
            "calibration is poor: standard deviation 0.2 rad of a sensor's orientation",
        ),
        (CalibrationQuality((), 0.01, math.inf), "calibration is poor: standard deviation inf m of a sensor's place"),
    ],
)
def test_without_a_good_calibration_nothing_moves(quality: CalibrationQuality | None, said: str) -> None:
    bench = Bench(calibration=True)
    if quality is not None:
        bench.follower.calibration.heard(quality, bench.steady_ns)
    last = bench.run(2.0)
    assert last.state == State.STOPPED
    assert said in last.reason


def test_a_calibration_must_go_on_being_heard_of_and_may_get_too_old() -> None:
    bench = Bench(calibration=True, max_calibration_age=20.0)
    bench.follower.calibration.heard(SOUND, bench.steady_ns)
    assert "age of the calibration is not known" in bench.run(0.1).reason
    bench.follower.calibration.pose("kinect2", EPOCH_NS - 15 * NANOSECONDS)
    assert bench.run(4.0).state == State.FOLLOWING
    assert "calibration has not been heard of for 5 s" in bench.run(1.2).reason
    bench.follower.calibration.heard(SOUND, bench.steady_ns)
    assert "calibration is 20 s old, limit 20 s" in bench.run(0.2).reason


def test_angles_that_came_before_the_clock_do_not_count_for_long() -> None:
    bench = Bench()
    bench.follower.hear_angles(seen(bench.now_ns - LATENCY_NS - 1, bench.pose), CONVENTION, 0, bench.steady_ns)
    assert bench.run(3.0).state == State.FOLLOWING


def test_old_angles_and_angles_of_the_future_are_not_followed() -> None:
    for shift, said in ((-0.4, "old, limit 0.3 s"), (0.2, "in the future")):
        bench = Bench(Follower(mapping(), PERIOD))
        for _ in range(100):
            bench.elapsed_ns += 10_000_000
            stamp_ns = bench.now_ns + round(shift * NANOSECONDS)
            bench.follower.hear_angles(seen(stamp_ns, bench.pose), CONVENTION, bench.now_ns, bench.steady_ns)
            command = bench.follower.step(bench.now_ns, bench.steady_ns)
        assert command.state == State.STOPPED
        assert said in command.reason


def test_a_standstill_of_the_commands_themselves_holds_and_is_not_made_up_for() -> None:
    bench = following()
    bench.pose = [2.4, 0.0, 2.0]
    before = bench.run(0.1).position
    bench.elapsed_ns += NANOSECONDS
    after = bench.run(PERIOD)
    assert after.state == State.HOLDING
    assert "the commands themselves stood still for 1.01 s" in after.reason
    assert after.position is not None
    assert before is not None
    assert (np.abs(after.position - before) <= np.array([2.0, 3.0]) * 2 * PERIOD).all()


def test_a_backward_jump_of_time_is_told_and_holds() -> None:
    bench = following()
    now_ns = bench.now_ns - 10 * NANOSECONDS
    for behind_ns, jumps in ((0, True), (NANOSECONDS - 5, False)):
        angles = seen(now_ns - behind_ns, bench.pose)
        assert bench.follower.hear_angles(angles, CONVENTION, now_ns, bench.steady_ns) == jumps
    bench = following()
    bench.follower.time_jumped_back()
    bench.silent = True
    held = bench.run(PERIOD)
    assert (held.state, held.reason) == (State.HOLDING, "time jumped back")


def test_a_missing_angle_is_named() -> None:
    bench = following()
    angles = seen(bench.now_ns, bench.pose)
    fewer = type(angles)(angles.stamp_ns, angles.names[:2], *(getattr(angles, name)[:2] for name in (
        "position", "velocity", "position_stddev", "velocity_stddev")))  # fmt: skip
    bench.follower.hear_angles(fewer, CONVENTION, bench.now_ns, bench.steady_ns)
    bench.silent = True
    assert "not the angles of positional: elbow_flexion_left is missing" in bench.run(PERIOD).reason
    bench.silent = False
    assert bench.run(3.0).state == State.FOLLOWING


# --- foreign angles


def test_angles_of_another_convention_hold_at_once_and_stop() -> None:
    bench = following(stop_after=1.0)
    before = bench.commands[-1].position
    bench.convention, bench.pose = "isb", [-1.0, 0.0, 0.8]
    held = bench.run(0.05)
    assert held.state == State.HOLDING
    assert held.reason == "angles are of the convention 'isb', the mapping is about 'positional'"
    assert held.position is not None and before is not None
    np.testing.assert_allclose(held.position, before, atol=2.0**2 / (2 * 20.0))
    assert bench.run(1.2).state == State.STOPPED
    bench.convention = ""
    assert "no convention (an empty frame_id)" in bench.run(0.05).reason
    bench.convention = CONVENTION
    assert bench.run(3.0).state == State.FOLLOWING


def test_foreign_angles_between_the_right_ones_are_not_overlooked() -> None:
    bench = following()
    for _ in range(100):
        bench.run(PERIOD)
        # the right ones come between this and the next command
        angles = seen(bench.now_ns, bench.pose)
        bench.follower.hear_angles(angles, "isb", bench.now_ns, bench.steady_ns)
        bench.follower.hear_angles(angles, CONVENTION, bench.now_ns, bench.steady_ns)
    assert all(each.state == State.HOLDING for each in bench.commands[-99:])


@pytest.mark.parametrize("order", [(2, 1, 0), (0, 1, 2, 2), (0, 0, 1, 2)])
def test_names_in_another_order_or_twice_are_not_those_of_the_convention(order: tuple[int, ...]) -> None:
    bench = following()
    angles = seen(bench.now_ns, bench.pose)
    other = type(angles)(angles.stamp_ns, tuple(angles.names[k] for k in order), *(getattr(angles, name)[list(order)]
        for name in ("position", "velocity", "position_stddev", "velocity_stddev")))  # fmt: skip
    bench.follower.hear_angles(other, CONVENTION, bench.now_ns, bench.steady_ns)
    bench.silent = True
    assert "angles of positional in another order or twice" in bench.run(PERIOD).reason


# --- who else commands, and who may


def test_beside_another_publisher_of_its_commands_it_is_silent_at_once() -> None:
    bench = following()
    bench.follower.hear_publishers("another publisher of /arm: /other")
    stopped = bench.run(PERIOD)
    assert (stopped.state, stopped.position) == (State.STOPPED, None)
    assert [(each.before, each.after) for each in bench.follower.transitions[-2:]] == [
        (State.FOLLOWING, State.HOLDING),
        (State.HOLDING, State.STOPPED),
    ]
    assert bench.run(1.0).reason == "another publisher of /arm: /other"
    bench.follower.hear_publishers("")
    assert bench.run(0.45).state == State.STOPPED
    assert bench.run(0.2).state == State.APPROACHING


def test_after_a_long_standstill_not_even_the_last_command_is_repeated() -> None:
    bench = following(stop_after=60.0)
    bench.elapsed_ns += round(2.1 * NANOSECONDS)
    stopped = bench.run(PERIOD)
    assert (stopped.state, stopped.position) == (State.STOPPED, None)
    assert "the commands themselves stood still for 2.11 s" in stopped.reason


def test_a_robot_that_does_not_say_how_it_stands_waits_for_a_person() -> None:
    bench = Bench()
    bench.follower = Follower(mapping(content()), PERIOD)
    last = bench.run(3.0)
    assert last.state == State.STOPPED and "waits for a person" in last.reason
    bench.follower.enable()
    assert bench.run(3.0).state == State.FOLLOWING
    with pytest.raises(FollowerError, match="not stopped: following"):
        bench.follower.enable()


@pytest.mark.parametrize("start_ns", [0, EPOCH_NS - 86_400 * NANOSECONDS, EPOCH_NS + 86_400 * NANOSECONDS])
def test_angles_by_another_clock_are_never_followed(start_ns: int) -> None:
    bench = following(stop_after=0.5)
    moved = len(bench.follower.transitions)
    for _ in range(2):
        for _ in range(round(3.0 / PERIOD)):
            bench.elapsed_ns += round(PERIOD * NANOSECONDS)
            angles = seen(start_ns + bench.elapsed_ns, bench.pose)
            bench.follower.hear_angles(angles, CONVENTION, bench.now_ns, bench.steady_ns)
            command = bench.follower.step(bench.now_ns, bench.steady_ns)
        assert command.state == State.STOPPED
        assert command.reason.startswith("angles are ") and command.reason.endswith(", or not in ROS time")
        bench.follower.enable()  # a person cannot make it so, either
    assert not [each for each in bench.follower.transitions[moved:] if each.after == State.APPROACHING]


# --- the robot's own word


def with_robot(**safety: Any) -> Bench:
    made = content(**safety)
    made["output"]["state_topic"] = "/arm/joint_states"
    return Bench(Follower(mapping(made), PERIOD))


def test_it_begins_where_the_robot_stands() -> None:
    bench = with_robot()
    assert "does not say how it stands" in bench.run(1.0).reason
    stands = np.array([0.3, 9.0, 1.5])
    for _ in range(60):
        bench.follower.hear_robot(("elbow", "gripper", "shoulder"), stands, bench.steady_ns)
        bench.run(PERIOD)
    first = next(each for each in bench.commands if each.position is not None)
    assert first.position is not None
    np.testing.assert_allclose(first.position, [1.5, 0.3], atol=1e-9)


def test_a_robot_that_stands_beyond_its_limits_or_nowhere_is_not_driven() -> None:
    bench = with_robot()
    for _ in range(100):
        bench.follower.hear_robot(("shoulder", "elbow"), np.array([0.0, 2.2]), bench.steady_ns)
        last = bench.run(PERIOD)
    assert "the robot's elbow is at 2.200 rad, beyond its limits" in last.reason
    for joints, position, said in (
        (("shoulder",), [0.0], "elbow is not among them"),
        (("shoulder", "elbow"), [0.0], "1 positions of 2 joints"),
        (("shoulder", "elbow"), [0.0, math.nan], "not finite"),
    ):
        with pytest.raises(FollowerError, match=said):
            bench.follower.hear_robot(joints, np.array(position), bench.steady_ns)
        assert said in bench.run(PERIOD).reason


def test_a_robot_that_is_not_where_it_was_sent_is_held_and_then_taken_from_where_it_stands() -> None:
    bench = with_robot(max_tracking_error=0.2, stop_after=0.5)
    for _ in range(500):
        bench.follower.hear_robot(("shoulder", "elbow"), np.array([0.0, 0.1]), bench.steady_ns)
        bench.run(PERIOD)
    said = [str(each) for each in bench.follower.transitions]
    assert any("rad from its command" in each and "-> holding" in each for each in said)
    assert any("holding -> stopped" in each for each in said)
    for before, after in zip(bench.commands, bench.commands[1:], strict=False):
        if before.position is None and after.position is not None:
            np.testing.assert_allclose(after.position, [0.0, 0.1], atol=1e-9)


def test_while_the_robot_stands_still_its_command_stays_near_by_default() -> None:
    """Kept by an emergency stop and moved by hand, whatever the person does; and then let go."""
    bench = with_robot()
    allowed = bench.follower.mapping.safety.max_tracking_error
    assert allowed < 0.5
    stands, rate = np.array([1.0, 0.8]), bench.follower.mapping.rate
    rng = np.random.default_rng(1)
    begun = 0
    for step in range(6000):
        bench.follower.hear_robot(("shoulder", "elbow"), stands, bench.steady_ns)
        before = bench.follower.state
        command = bench.run(PERIOD)
        if step % 100 == 0:
            bench.pose = [rng.uniform(-1.0, 2.5), 0.0, rng.uniform(0.0, 2.0)]
        if command.position is not None:
            lead = np.abs(command.position - stands)
            assert (lead <= allowed + rate * PERIOD).all()
            if before in (State.STOPPED, State.HOLDING) and command.state == State.APPROACHING:
                begun += 1
                assert (lead <= rate * PERIOD).all()
            if step >= 4000:  # let go: a robot that is 0.05 s late
                stands = stands + (command.position - stands) * PERIOD / 0.05
        if 2000 < step < 3000:
            stands = np.clip(stands + rng.normal(0.0, 0.02, 2), [-1.0, 0.0], [2.5, 2.0])
    assert begun > 5
    assert command.state == State.FOLLOWING


def test_where_the_robot_was_moved_while_it_held_it_goes_on_from_there() -> None:
    bench = with_robot(stop_after=60.0)
    stands = np.array([1.0, 0.8])
    for step in range(900):
        if step == 400:
            bench.silent = True
        if step == 500:
            stands = np.array([1.2, 0.6])  # within the tracking error: nobody notices
        if step == 600:
            bench.silent = False
        bench.follower.hear_robot(("shoulder", "elbow"), stands, bench.steady_ns)
        command = bench.run(PERIOD)
        if step > 600 and command.state != State.HOLDING and command.position is not None:
            stands = command.position
    places = [each.state for each in bench.commands]
    held = bench.commands[590]
    assert (held.state, places[-1]) == (State.HOLDING, State.FOLLOWING) and held.position is not None
    np.testing.assert_allclose(held.position, [1.0, 0.8], atol=1e-2)
    first = bench.commands[600 + places[600:].index(State.APPROACHING)]
    assert first.position is not None
    np.testing.assert_allclose(first.position, [1.2, 0.6], atol=1e-3)


def test_a_robot_that_was_moved_beyond_its_limits_is_told_nothing() -> None:
    bench = with_robot()
    for step in range(1200):
        stands = np.array([1.0, 0.8 if step < 400 or step > 800 else 2.6])
        bench.follower.hear_robot(("shoulder", "elbow"), stands, bench.steady_ns)
        last = bench.run(PERIOD)
        if 400 <= step <= 800:
            assert last.state == State.STOPPED
            assert "the robot's elbow is at 2.600 rad, beyond its limits" in last.reason
    assert last.state == State.FOLLOWING


def test_a_period_that_cannot_keep_the_promises_is_refused() -> None:
    with pytest.raises(FollowerError, match=r"silence 0.1 s is no more than the period 0.1 s"):
        Follower(mapping(), 0.1)
    with pytest.raises(FollowerError, match=r"time_from_start 0.02 s is less than the period 0.05 s"):
        Follower(mapping(), 0.05)


# --- whatever happens

numbers = st.one_of(st.floats(-7.0, 7.0), st.sampled_from([math.nan, math.inf, -math.inf, 1e300, 0.0]))
deviations = st.one_of(st.floats(0.0, 0.6), st.sampled_from([math.nan, math.inf]))


@dataclass(frozen=True)
class Event:
    """What happens between two commands."""

    pause_ns: int
    position: list[float] | None
    velocity: list[float]
    stddev: list[float]
    age_ns: int
    repeat: int


calm = st.builds(
    Event,
    pause_ns=st.just(10_000_000),
    position=st.lists(st.floats(-3.0, 3.0), min_size=3, max_size=3),
    velocity=st.lists(st.floats(-3.0, 3.0), min_size=3, max_size=3),
    stddev=st.just([0.1, 0.1, 0.1]),
    age_ns=st.integers(0, 100_000_000),
    repeat=st.integers(1, 30),
)
wild = st.builds(
    Event,
    pause_ns=st.one_of(st.just(10_000_000), st.integers(0, 400_000_000)),
    position=st.one_of(st.none(), st.lists(numbers, min_size=3, max_size=3)),
    velocity=st.lists(numbers, min_size=3, max_size=3),
    stddev=st.lists(deviations, min_size=3, max_size=3),
    age_ns=st.integers(-15_000_000_000, 15_000_000_000),
    repeat=st.integers(1, 10),
)


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.lists(st.one_of(calm, wild), max_size=12), st.booleans())
def test_whatever_is_heard_the_robot_is_never_told_what_it_must_not(events: list[Event], alone: bool) -> None:
    made = content(recover_after=0.05, approach=0.1, stop_after=0.3, max_stddev=1.0)
    if alone:
        made["joints"][1]["when_uncertain"] = "hold_joint"
    robot = mapping(made)
    follower = Follower(robot, PERIOD)
    steady_ns, now_ns = START_NS, EPOCH_NS
    last, last_ns, heard_ns, state = robot.home, steady_ns, None, State.STOPPED
    for event in events:
        for _ in range(event.repeat):
            steady_ns += event.pause_ns
            now_ns += event.pause_ns
            if event.position is not None:
                heard_ns = steady_ns
                angles = seen(now_ns - event.age_ns, event.position, event.velocity, event.stddev)
                follower.hear_angles(angles, CONVENTION, now_ns, steady_ns)
            command = follower.step(now_ns, steady_ns)
            silent = heard_ns is None or steady_ns - heard_ns >= 90_000_000
            if silent:
                assert command.state in (State.HOLDING, State.STOPPED)
            assert (command.position is None) == (command.state == State.STOPPED)
            if command.position is not None:
                assert np.isfinite(command.position).all()
                assert (command.position >= robot.lower).all()
                assert (command.position <= robot.upper).all()
                # also over a pause without commands: where it stopped it goes on
                elapsed = (steady_ns - last_ns) / NANOSECONDS
                assert (np.abs(command.position - last) <= robot.rate * elapsed + 1e-9).all()
                if state == command.state == State.HOLDING:
                    assert command.position[1] == last[1]
                last, last_ns = command.position, steady_ns
            assert command.reason
            assert state == command.state or any(each.after == command.state for each in follower.transitions)
            for change in follower.transitions:
                assert (change.before, change.after) in LEGAL
                assert change.reason
            follower.transitions.clear()
            state = command.state
