"""Laws of remote clocks: offsets from round trips and delays, and monotonic stamps."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from body_tracking.core.skeleton import NANOSECONDS
from body_tracking.kinect.remote_clock import CaptureClock, RoundTrips
from draws import draws

MS = 1_000_000
FRAME_NS = NANOSECONDS // 30


def ask(
    trips: RoundTrips, local_ns: int, offset_ns: float, drift: float, there_ns: int, back_ns: int, at_ns: int = 0
) -> bool:
    """A round trip; the remote clock is the local one minus ``offset``, which grows by ``drift``."""

    def remote(local: int) -> int:
        return round(local - offset_ns - drift * (local - at_ns))

    t2 = local_ns + there_ns
    t3 = t2 + 20_000
    return trips.add(local_ns, remote(t2), remote(t3), t3 + back_ns)


def true_offset(local_ns: int, offset_ns: float, drift: float) -> float:
    return offset_ns + drift * local_ns


@settings(max_examples=draws(8, 20), deadline=None)
@given(
    st.integers(-(10**18), 10**18),
    st.floats(-1e-4, 1e-4),
    st.integers(10_000, 20 * MS),
    st.integers(0, 2**32),
)
@example(0, 0.0, 10_000, 2003)  # a first round trip that takes long in one direction only
def test_with_jitter_the_offset_errs_by_less_than_half_the_shortest_round_trip(
    offset: int, drift: float, least_ns: int, seed: int
) -> None:
    numbers = np.random.default_rng(seed)
    trips = RoundTrips()
    for k in range(200):
        there, back = (least_ns + int(x) for x in numbers.exponential(5 * MS, size=2))
        assert ask(trips, k * NANOSECONDS // 4, offset, drift, there, back)
    local = 200 * NANOSECONDS // 4
    remote = round(local - true_offset(local, offset, drift))
    shortest = trips.round_trip_ns
    assert shortest >= 2 * least_ns
    # the fit follows a drift of 100 ppm over 60 s of bounds, except for half a millisecond
    assert abs(trips.offset_ns(remote) - true_offset(local, offset, drift)) < shortest / 2 + MS // 2


def test_with_equal_delays_the_offset_is_exact_and_drift_is_followed() -> None:
    trips = RoundTrips()
    for k in range(400):
        ask(trips, k * NANOSECONDS // 4, 300 * MS, 80e-6, 2 * MS, 2 * MS)
    assert trips.drift == pytest.approx(80e-6, abs=1e-6)
    local = 400 * NANOSECONDS // 4
    # and predicted without round trips: half a minute later
    for later in (0, 30 * NANOSECONDS):
        now = local + later
        error = trips.offset_ns(round(now - true_offset(now, 300 * MS, 80e-6))) - true_offset(now, 300 * MS, 80e-6)
        assert abs(error) < 100_000


def test_five_milliseconds_of_jitter_leave_less_than_one() -> None:
    numbers = np.random.default_rng(3)
    trips, errors = RoundTrips(), []
    for k in range(240):
        local = k * NANOSECONDS // 4
        there, back = (int(x) for x in numbers.uniform(0.2 * MS, 5.2 * MS, size=2))
        ask(trips, local, -300 * MS, 20e-6, there, back)
        true = true_offset(local, -300 * MS, 20e-6)
        errors.append(abs(trips.offset_ns(round(local - true)) - true))
    assert max(errors[40:]) < 1 * MS


def test_a_slow_hour_of_the_network_is_believed_less_than_a_fast_second() -> None:
    trips = RoundTrips()
    for k in range(60):
        ask(trips, k * NANOSECONDS // 4, 0, 0.0, MS, MS)
    for k in range(60, 200):  # the way back is full
        ask(trips, k * NANOSECONDS // 4, 0, 0.0, MS, 80 * MS)
    assert abs(trips.offset_ns(200 * NANOSECONDS // 4)) < 2 * MS


def test_a_clock_that_is_set_is_noticed_and_a_single_wild_answer_is_not_believed() -> None:
    trips = RoundTrips()
    for k in range(100):
        ask(trips, k * NANOSECONDS // 4, 0, 0.0, MS, MS)
    assert not ask(trips, 25 * NANOSECONDS, 900 * MS, 0.0, MS, MS)
    assert abs(trips.offset_ns(25 * NANOSECONDS)) < MS
    for k in range(101, 110):
        ask(trips, k * NANOSECONDS // 4, 2000 * MS, 0.0, MS, MS)
    assert trips.steps == 1
    assert abs(trips.offset_ns(25 * NANOSECONDS) - 2000 * MS) < MS


@given(st.tuples(*[st.integers(-(10**18), 10**18)] * 4))
def test_impossible_round_trips_do_not_count(times: tuple[int, int, int, int]) -> None:
    t1, t2, t3, t4 = times
    possible = t4 >= t1 and t3 >= t2 and t4 - t1 >= t3 - t2
    assert RoundTrips().add(t1, t2, t3, t4) == possible


# --- stamps


def test_stamps_keep_the_sensors_intervals_for_any_delay_of_the_frames() -> None:
    numbers = np.random.default_rng(1)
    clock = CaptureClock()
    stamps, captures = [], []
    for k in range(900):
        captured = k * FRAME_NS
        delay = 20 * MS + int(numbers.exponential(4 * MS))
        stamps.append(clock.stamp(captured - 7 * NANOSECONDS, captured + delay, 300 * MS))
        captures.append(captured + 300 * MS)
    late = np.array(stamps) - np.array(captures)
    # by the shortest delay, which is unobservable; it is reached within seconds
    assert np.abs(late[150:] - 20 * MS).max() < 1 * MS
    assert np.ptp(np.diff(stamps)[150:]) <= 2 * FRAME_NS // 100


def test_after_a_cut_of_half_a_minute_slow_frames_and_answers_do_not_move_the_stamps() -> None:
    trips, clock = RoundTrips(), CaptureClock()
    for k in range(900):
        ask(trips, k * FRAME_NS, 300 * MS, 30e-6, MS, MS)
    for k in [*range(900), *range(1800, 1830)]:
        captured = k * FRAME_NS
        slow = 40 * MS if k >= 1800 else 0
        if slow:
            ask(trips, captured, 300 * MS, 30e-6, MS, 9 * MS)
        sent = captured + 20 * MS + slow  # by the sender's clock
        stamp = clock.stamp(captured, sent, trips.offset_ns(sent))
        true = true_offset(captured + 300 * MS, 300 * MS, 30e-6) + captured
        assert abs(stamp - true - 20 * MS) < MS // 2


@settings(max_examples=draws(12, 50), deadline=None)
@given(st.integers(0, 2**32), st.floats(-3e-4, 3e-4), st.floats(0.0, 0.5))
def test_stamps_never_run_backwards(seed: int, drift: float, chance: float) -> None:
    """Neither as the estimate improves, nor where a frame is held up, nor where the sensor begins to count anew."""
    numbers = np.random.default_rng(seed)
    clock, stamps = CaptureClock(), []
    sensor_zero, offset = 0, 0
    for k in range(300):
        sent = k * FRAME_NS
        if numbers.random() < 0.01:
            sensor_zero = sent
        if numbers.random() < chance:
            offset = int(numbers.uniform(-200 * MS, 200 * MS))
        captured = sent - int(numbers.exponential(10 * MS))
        stamps.append(clock.stamp(round((captured - sensor_zero) * (1.0 + drift)), sent, offset))
    assert (np.diff(stamps) > 0).all()


@pytest.mark.parametrize(
    ("counted_ns", "offset_ns", "expected_ns"),
    [
        (-FRAME_NS, 0, 0),  # a sensor that counts anew goes on where time is
        (100 * FRAME_NS, -3600 * NANOSECONDS, -3600 * NANOSECONDS),  # where this computer's clock is set back
    ],
)
def test_stamps_follow_a_clock_that_is_set(counted_ns: int, offset_ns: int, expected_ns: int) -> None:
    clock = CaptureClock(20 * MS)
    for k in range(100):
        assert clock.stamp(k * FRAME_NS, k * FRAME_NS + 20 * MS, 0) == k * FRAME_NS  # the least delay is taken off
    sent_ns = 100 * FRAME_NS + 20 * MS
    assert clock.stamp(counted_ns, sent_ns, offset_ns) == 100 * FRAME_NS + expected_ns
