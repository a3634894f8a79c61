"""The stage of the node ``skeleton_filter``: several people, and the order of frames."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from random_people import START_NS, MeasurementErrors, RandomPerson, capture_times, observe, truth_of

from body_tracking.core.body_model import SEGMENTS
from body_tracking.core.orientation import SegmentOrientation
from body_tracking.core.parameters import check_all
from body_tracking.core.sensor_poses import level_pose
from body_tracking.core.skeleton import NANOSECONDS, Skeleton
from body_tracking.filters.stage import FilterStage
from body_tracking.pipeline import graph
from body_tracking.pipeline.people import ALL
from body_tracking.pipeline.stage import Now, Output
from body_tracking.simulation.people import MODEL
from body_tracking.simulation.random_motion import RandomMotion
from draws import some

SENSORS = ("kinect1", "kinect2")
DELAYS = 0.02, 0.045
"""Seconds from capture to delivery."""
SECONDS = 1.5

Event = tuple[int, str, Skeleton]
Staged = tuple[FilterStage, list[tuple[str, int]], list[Skeleton]]


@pytest.fixture(scope="module")
def events() -> list[Event]:
    """Two sensors at one place see a person, and one of them delivers later than the other: arrivals in their order."""
    rng = np.random.default_rng(3)
    person, motion = RandomPerson.draw(rng), RandomMotion(rng, SECONDS + 1.0)
    found: list[Event] = []
    for number, (sensor, delay) in enumerate(zip(SENSORS, DELAYS, strict=True)):
        truth = truth_of(person, motion, capture_times(SECONDS, rng) + 0.012 * (number + 1))
        pose = level_pose(sensor)
        for seen in observe(truth, MeasurementErrors(0.005), np.random.default_rng(number)).skeletons:
            positions = (seen.positions - pose.translation) @ pose.rotation
            own = Skeleton(seen.stamp_ns, f"{sensor}_optical_frame", positions, seen.states)
            found.append((seen.stamp_ns + round(delay * NANOSECONDS), sensor, own))
    return sorted(found, key=lambda event: event[:2])


def stage_of(name: str, wanted: Callable[[str], bool] | None = None, **values: Any) -> FilterStage:
    """The stage with this filter and two calibrated sensors."""
    given = {"filter": name, "sensors": SENSORS, **values}
    stage = FilterStage(check_all(FilterStage.PARAMETERS, given), wanted or (lambda topic: True))
    for sensor in SENSORS:
        stage.take(graph.CALIBRATION, level_pose(sensor), Now(0, 0))
    return stage


def staged(
    events: list[Event], wanted: Callable[[str], bool] | None = None, busy: float = 0.0, **settings: float
) -> Staged:
    """The stage after all events; topic and stamp of what it published; the skeletons.

    With ``busy``, it takes all frames that have arrived together, once in so many seconds.
    """
    outputs: list[Output] = []
    stage = stage_of("ekf", wanted, **settings)
    looked_ns = events[0][0]
    for now_ns, sensor, skeleton in events:
        topic = graph.skeleton_topic(sensor)
        if busy == 0.0:
            outputs += stage.take(topic, [skeleton], Now(now_ns, now_ns))
            outputs += stage.poll(now_ns)
            continue
        while now_ns > looked_ns:
            outputs += stage.poll(looked_ns)
            looked_ns += round(busy * NANOSECONDS)
        outputs += stage.take(topic, [skeleton], Now(looked_ns, looked_ns))
    while (deadline_ns := stage.deadline_ns) is not None:
        outputs += stage.poll(deadline_ns)
    published = [(each.topic, each.stamp_ns or 0) for each in outputs if each.topic != graph.TRACKED]
    skeletons = [body for each in outputs if each.topic == graph.FILTERED for body in each.payload]
    return stage, published, skeletons


@pytest.fixture(scope="module")
def prompt(events: list[Event]) -> Staged:
    """The output of a stage that takes each frame on arrival."""
    return staged(events)


@pytest.fixture(scope="module")
def never_predicting(events: list[Event]) -> Staged:
    return staged(events, predict_after=1.0)


def test_frames_wait_for_older_ones_and_the_outcome_is_that_of_going_back(events: list[Event], prompt: Staged) -> None:
    waiting, _, ordered = prompt
    hasty, _, early = staged(events, order_wait=0.0)
    assert waiting.counters["late_frames"] <= 2 and hasty.counters["late_frames"] > 20
    assert waiting.counters["frames"] == hasty.counters["frames"] > len(events) - 2 * len(SENSORS) * 4
    stamps = [skeleton.stamp_ns for skeleton in ordered]
    assert stamps == sorted(set(stamps))
    assert_allclose(ordered[-1].positions, early[-1].positions, rtol=0.0, atol=1e-6)
    assert ordered[-1].stamp_ns == early[-1].stamp_ns


@pytest.mark.parametrize("busy", some([0.15, 0.03]))
def test_a_busy_filter_takes_queued_frames_in_the_order_of_their_stamps(
    events: list[Event], never_predicting: Staged, busy: float
) -> None:
    waiting, _, ordered = never_predicting
    lagging, _, together = staged(events, busy=busy, predict_after=1.0)
    assert lagging.counters["late_frames"] <= waiting.counters["late_frames"]
    assert lagging.counters["frames"] == waiting.counters["frames"]
    # each frame has its output still, one after the other
    stamps = [skeleton.stamp_ns for skeleton in together]
    assert stamps == sorted(set(stamps)) and set(stamps) >= {skeleton.stamp_ns for skeleton in ordered}
    assert_allclose(together[-1].positions, ordered[-1].positions, rtol=0.0, atol=1e-6)


@pytest.mark.parametrize("busy", some([0.002, 0.0]))
def test_a_burst_after_a_stall_goes_back_once_and_its_frames_all_count(
    events: list[Event], prompt: Staged, busy: float
) -> None:
    # the second sensor's connection stalls for 0.18 s
    begin_ns = events[len(events) // 2][0]
    end_ns = begin_ns + round(0.18 * NANOSECONDS)
    held = [event[1] == SENSORS[1] and begin_ns <= event[0] < end_ns for event in events]
    first_ns = next(skeleton.stamp_ns for (_, _, skeleton), late in zip(events, held, strict=True) if late)
    newer = [
        skeleton
        for (now_ns, _, skeleton), late in zip(events, held, strict=True)
        if not late and now_ns < end_ns and skeleton.stamp_ns > first_ns
    ]
    stalled = sorted(
        ((end_ns if late else now_ns, sensor, seen) for (now_ns, sensor, seen), late in zip(events, held, strict=True)),
        key=lambda event: event[:2],
    )
    smooth, _, ordered = prompt
    stage, _, late_ones = staged(stalled, busy=busy)
    assert stage.counters["frames"] == smooth.counters["frames"] and stage.counters["too_late"] == 0
    late_frames, taken_again = (stage.counters[name] - smooth.counters[name] for name in ("late_frames", "taken_again"))
    assert late_frames >= 3 and 0 < taken_again <= len(newer)
    assert_allclose(late_ones[-1].positions, ordered[-1].positions, rtol=0.0, atol=1e-6)


@pytest.mark.parametrize("name", ["lkf_constant_velocity", "ekf"])
def test_each_of_several_people_is_filtered_as_if_alone(events: list[Event], name: str) -> None:
    """Two who stand 2 m apart, of whom the second is hidden for a while."""
    ids = graph.bodies(3)
    published: dict[str, list[Output]] = {"together": [], "alone 1": [], "alone 2": []}
    stages = {who: stage_of(name, subject=ALL, people=3) for who in published}
    by_sensor = name == "ekf"
    taken = events[:70]
    for number, (now_ns, sensor, one) in enumerate(taken):
        shift = np.array([2.0, 0.0, 0.0])
        two = replace(one, positions=one.positions + shift, body=1)
        hidden = 30 <= number < 45
        frames = {"together": [one] if hidden else [one, two], "alone 1": [one], "alone 2": [] if hidden else [two]}
        for who, bodies in frames.items():
            if bodies and by_sensor:
                published[who] += stages[who].take(graph.skeleton_topic(sensor), bodies, Now(now_ns, now_ns))
            elif bodies and sensor == SENSORS[0]:  # as the fusion has them
                placed = [_fused(body) for body in bodies]
                published[who] += stages[who].take(graph.FUSED, placed, Now(now_ns, now_ns))
            if by_sensor or not bodies:
                published[who] += stages[who].poll(now_ns)
    filtered: dict[str, list[Skeleton]] = {
        who: [body for each in outputs if each.topic == graph.FILTERED for body in each.payload]
        for who, outputs in published.items()
    }
    assert any(len(each.payload) == 2 for each in published["together"] if each.topic == graph.FILTERED)
    assert [each.payload[2] for each in published["together"] if each.topic == graph.TRACKED][-1] == ids[:2]
    for number in (1, 2):
        mine = [each for each in filtered["together"] if each.body == number]
        # a single person is the first one
        other = filtered[f"alone {number}"]
        assert len(mine) == len(other) > 20
        for one, same in zip(mine, other, strict=True):
            assert one.stamp_ns == same.stamp_ns
            assert_array_equal(one.positions, same.positions)
        if by_sensor:
            state = graph.model_topics(ids[number - 1], several=True).state
            alone = graph.model_topics(ids[0], several=True).state
            states = [each.payload.q.tolist() for each in published["together"] if each.topic == state]
            same_states = [each.payload.q.tolist() for each in published[f"alone {number}"] if each.topic == alone]
            assert states == same_states and len(states) > 20


def _fused(seen: Skeleton) -> Skeleton:
    """As the fusion publishes a person: in world, with a number from 1 on and with covariances."""
    covariances = np.broadcast_to(1e-4 * np.eye(3), (25, 3, 3))
    return replace(seen, positions=level_pose("").apply(seen.positions), body=seen.body + 1, covariances=covariances)


def test_a_skeleton_that_nobody_wants_is_not_made(events: list[Event]) -> None:
    _, published, _ = staged(events[:60], lambda topic: topic == graph.MODEL_STATE)
    assert {topic for topic, _ in published} == {graph.MODEL_STATE, graph.urdf_topic(graph.DEFAULT_BODY)}
    _, everything, _ = staged(events[:60])
    wanted = [stamp_ns for topic, stamp_ns in published if topic == graph.MODEL_STATE]
    assert wanted == [stamp_ns for topic, stamp_ns in everything if topic == graph.FILTERED]


def test_no_prediction_for_a_time_with_waiting_frames(events: list[Event]) -> None:
    rng = np.random.default_rng(1)
    kept = [event for event in events if rng.uniform() > 0.2]
    for settings in some([{"order_wait": 0.3}, {"predict_after": 0.02}, {}], 2):
        _, published, _ = staged(kept, **settings)
        stamps = [stamp_ns for topic, stamp_ns in published if topic == graph.FILTERED]
        # a prediction may overtake a frame, whose estimate is not published then
        assert len(stamps) > 40 and stamps == sorted(stamps)


@pytest.mark.parametrize("lag", [0.0, 0.15])
def test_frames_of_one_instant_give_one_output(events: list[Event], lag: float) -> None:
    """A receiver of transforms ignores a second one of the same time, with a warning."""
    period_ns = NANOSECONDS // 20
    together = []
    for now_ns, sensor, skeleton in events[:160]:
        stamp_ns = skeleton.stamp_ns // period_ns * period_ns
        together.append((now_ns, sensor, replace(skeleton, stamp_ns=stamp_ns)))
    stage, published, _ = staged(together, lag=lag)
    stamps = [stamp_ns for topic, stamp_ns in published if topic == graph.MODEL_STATE]
    assert len(stamps) > 20 and stamps == sorted(set(stamps))
    assert stage.counters["frames"] > 1.5 * len(stamps)


@pytest.mark.parametrize("lag", [0.0, 0.15])
def test_orientations_alone_are_published_at_the_rate_of_predicted_frames(lag: float) -> None:
    rng = np.random.default_rng(4)
    person, motion = RandomPerson.draw(rng), RandomMotion(rng, 3.0)
    times = np.arange(0.0, 3.0, 0.02)
    rotations = MODEL.forward(motion.configuration(times), person.lengths).rotations
    outputs: list[Output] = []
    segments = ("pelvis", "upper_trunk", "forearm_left")
    stage = stage_of("ekf", lag=lag, orientations=segments)
    linear = stage_of("lkf_constant_velocity")
    for time, posture in zip(times, rotations, strict=True):
        stamp_ns = START_NS + round(time * NANOSECONDS)
        for number, name in enumerate(segments):
            rotation, topic = posture[SEGMENTS.index(name)], graph.orientation_topic(name)
            measurement = SegmentOrientation(stamp_ns + number, name, name, rotation, 1e-4 * np.eye(3))
            now_ns = stamp_ns + NANOSECONDS // 100
            outputs += stage.take(topic, measurement, Now(now_ns, now_ns))
            outputs += stage.poll(now_ns)
            linear.take(topic, measurement, Now(now_ns, now_ns))
    stamps = [each.stamp_ns or 0 for each in outputs if each.topic == graph.MODEL_STATE]
    assert len(stamps) > 40 and stamps == sorted(stamps)  # 30 Hz of the 1.9 s after the start
    # of three sensors of 50 Hz every second one, of the two seconds after the start
    assert stage.counters["orientations_used"] >= 3 * 2 * 25 - 3
    assert "orientations_used" not in linear.counters


def test_names_in_not_kinects_that_no_sensor_has_are_reported() -> None:
    values = {"filter": "ekf", "sensors": ("kinect1", "azure1")}
    for names, note in {
        (): "ekf",
        ("azure1",): "ekf",
        ("azure1", "azure2", "azure2"): "ekf (not_kinects: no sensor azure2 here)",
    }.items():
        stage = FilterStage(check_all(FilterStage.PARAMETERS, {**values, "not_kinects": names}))
        assert stage.state(0)[:2] == (int("(" in note), note)
