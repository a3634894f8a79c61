"""Frames of several cameras come together by their stamps, whatever order they arrive in."""

from __future__ import annotations

from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st

from body_tracking.markers.pairing import FrameSets

MS = 1_000_000
PERIOD_NS = 16 * MS


def sets(cameras: int = 2) -> FrameSets[int]:
    return FrameSets([f"camera{k}" for k in range(cameras)], 2 * MS, 30 * MS)


@given(st.data(), st.integers(2, 4))
def test_every_set_is_complete_and_in_order_where_cameras_send_in_order(data: st.DataObject, cameras: int) -> None:
    count, waiting = 6, sets(cameras)
    left, found = {f"camera{k}": list(range(count)) for k in range(cameras)}, []
    while any(left.values()):
        camera = data.draw(st.sampled_from(sorted(name for name, frames in left.items() if frames)))
        number = left[camera].pop(0)
        jitter = data.draw(st.integers(-MS, MS))
        found += waiting.push(camera, 1000 * PERIOD_NS + number * PERIOD_NS + jitter, number, 0)
    assert [set(frames.values()) for frames in found] == [{number} for number in range(count)]
    assert waiting.incomplete == waiting.late == 0


def test_a_set_with_a_missing_frame_waits_and_is_given_up() -> None:
    waiting = sets(3)
    assert not waiting.push("camera0", 0, 1, 0) and not waiting.push("camera2", 0, 2, 5 * MS)
    assert waiting.deadline_ns == 30 * MS and not waiting.poll(29 * MS)
    assert waiting.poll(30 * MS) == [{"camera0": 1, "camera2": 2}]
    assert waiting.deadline_ns is None and waiting.incomplete == 1
    assert not waiting.push("camera1", 0, 3, 31 * MS) and waiting.late == 1


def test_one_camera_alone_makes_no_set() -> None:
    waiting = sets()
    found = [frames for number in range(300) for frames in waiting.push("camera0", number * PERIOD_NS, number, 0)]
    assert not found and waiting.incomplete > 200


def test_a_camera_that_lags_by_more_than_the_tolerance_makes_no_set() -> None:
    waiting = sets()
    for number in range(20):
        assert not waiting.push("camera0", number * PERIOD_NS, number, 0)
        assert not waiting.push("camera1", number * PERIOD_NS + 3 * MS, number, 0)


def test_a_camera_that_stops_or_loses_images_is_not_said_to_be_out_of_step() -> None:
    waiting = sets()

    def said(first: int, last: int, *, every: int) -> str:
        for number in range(first, last):
            now = number * PERIOD_NS
            waiting.push("camera1", now, number, now)
            if every and number % every == 0:
                waiting.push("camera0", now, number, now)
            waiting.poll(now)
        return waiting.problem()

    assert said(0, 40, every=1) == ""
    assert said(40, 80, every=2) == "camera0 lacks in 15 of 30 sets of images: some of its images do not come"
    assert said(80, 180, every=0) == "camera0 lacks in 30 of 30 sets of images: nothing has come from it for 1.6 s"
    assert said(180, 220, every=1) == ""


def test_sets_are_given_in_order() -> None:
    waiting, given_out = sets(), []
    for camera in ("camera0", "camera1"):
        for number in range(5):
            given_out += waiting.push(camera, number * PERIOD_NS, number, 0)
    assert all(set(frames.values()) == {number} for number, frames in enumerate(given_out))
    assert all(a["camera0"] < b["camera0"] for a, b in pairwise(given_out))
