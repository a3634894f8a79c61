"""Stamps of worn sensors come out in one clock."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from body_tracking.core.clocks import ReceiptClock
from body_tracking.core.skeleton import NANOSECONDS
from body_tracking.inertial.parameters import OWN, REFERENCE, SHARED
from body_tracking.inertial.timing import SensorClocks

OFFSETS = st.integers(-(10**12), 10**12)
SENSORS = ("forearm_left", "forearm_right")


def receipts(offset_ns: int, transport_ns: int = 0, seconds: int = 3) -> list[tuple[int, int]]:
    """(stamp, time of receipt) of a clock that is ahead by ``offset_ns``."""
    times = [10**12 + k * NANOSECONDS // 10 for k in range(10 * seconds)]
    return [(now + offset_ns, now + transport_ns + (k % 3) * 10**6) for k, now in enumerate(times)]


@given(OFFSETS, OFFSETS, OFFSETS)
def test_stamps_of_all_clocks_come_out_in_that_of_the_camera(left: int, right: int, camera: int) -> None:
    clocks = SensorClocks(OWN, SENSORS)
    assert not clocks.camera_known
    for stamp, received in receipts(camera):
        clocks.take_camera_frame(stamp, received)
    assert clocks.camera_known
    for name, offset in zip(SENSORS, (left, right), strict=True):
        own = ReceiptClock()
        for stamp, received in receipts(offset):
            own.add(stamp, received)
        assert clocks.offset_ns(name, own) == camera - offset


@given(OFFSETS)
def test_sensors_with_a_shared_clock_have_one_offset(offset: int) -> None:
    clocks = SensorClocks(SHARED, SENSORS)
    for stamp, received in receipts(offset):
        clocks.take_reading(stamp, received)
    nothing = ReceiptClock()
    assert clocks.offset_ns(SENSORS[0], nothing) == clocks.offset_ns(SENSORS[1], nothing) == -offset
    clocks.correct(SENSORS[1], 1.0, 0.02, 0.001)
    assert clocks.offset_ns(SENSORS[0], nothing) == clocks.offset_ns(SENSORS[1], nothing) < -offset


def test_stamps_that_are_of_the_reference_clock_stay() -> None:
    clocks = SensorClocks(REFERENCE, SENSORS)
    assert clocks.offset_ns(SENSORS[0], ReceiptClock()) == 0


def test_offsets_by_motion_are_followed_and_reported() -> None:
    clocks, own = SensorClocks(OWN, SENSORS), ReceiptClock()
    for stamp, received in receipts(0):
        own.add(stamp, received)
    assert clocks.found == {}
    late = 0.02
    for k in range(20):
        left = late - (-clocks.offset_ns(SENSORS[0], own) / NANOSECONDS)
        clocks.correct(SENSORS[0], 3.0 * k, left, 0.005)
    assert clocks.found == {SENSORS[0]: pytest.approx(late, abs=0.002)}
    assert clocks.offset_ns(SENSORS[0], own) == pytest.approx(-late * NANOSECONDS, abs=0.002 * NANOSECONDS)
    assert clocks.offset_ns(SENSORS[1], own) == 0


def test_a_camera_counts_by_its_own_frames_where_they_arrive() -> None:
    clocks, own = SensorClocks(OWN, SENSORS), ReceiptClock()
    for stamp, received in receipts(0):
        own.add(stamp, received)
    for stamp, received in receipts(0, transport_ns=30 * 10**6):  # skeletons come late
        assert not clocks.take_skeleton(stamp, received, jumped=False)
    assert clocks.offset_ns(SENSORS[0], own) == -30 * 10**6
    begun = [clocks.take_camera_frame(stamp, received) for stamp, received in receipts(0)]
    assert begun[0] and not any(begun[1:])
    assert clocks.offset_ns(SENSORS[0], own) == 0
    for stamp, received in receipts(0, transport_ns=30 * 10**6):
        clocks.take_skeleton(stamp, received, jumped=False)
    assert clocks.offset_ns(SENSORS[0], own) == 0


def test_a_camera_whose_clock_is_set_is_noticed() -> None:
    clocks = SensorClocks(OWN, SENSORS)
    (stamp, received), *_ = receipts(0)
    assert not clocks.take_skeleton(stamp, received, jumped=False)
    assert clocks.take_skeleton(stamp + 60 * NANOSECONDS, received + NANOSECONDS, jumped=False)
    assert clocks.take_skeleton(stamp, received + 2 * NANOSECONDS, jumped=True)
    frames = SensorClocks(OWN, SENSORS)
    assert frames.take_camera_frame(stamp, received)
    assert not frames.take_camera_frame(stamp + NANOSECONDS, received + NANOSECONDS)
    assert frames.take_camera_frame(stamp - 60 * NANOSECONDS, received + 2 * NANOSECONDS)
