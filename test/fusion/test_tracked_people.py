"""Which of several people are tracked, and under which number."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from body_tracking.core.clocks import ClockModel
from body_tracking.core.parameters import check_all
from body_tracking.core.sensor_poses import SensorPose, level_pose
from body_tracking.core.skeleton import NANOSECONDS, Skeleton
from body_tracking.fusion.fusion import Fusion
from body_tracking.fusion.people import People, Slots
from body_tracking.fusion.stage import FusionStage
from body_tracking.pipeline import graph
from body_tracking.pipeline.people import ALL, FIRST, NEAREST, PeopleParameters
from body_tracking.pipeline.stage import Now
from walkers import ABOUT_FACE, frame, performed

SENSORS = ("kinect1", "kinect2")
FIGURE = performed("standing_still", np.zeros(1))[0] * ABOUT_FACE
OFF = 3.5
"""Seconds by which the second sensor's clock is ahead."""

_ABOUT = Rotation.from_euler("z", 180.0, degrees=True) * Rotation.from_matrix(level_pose("kinect2").rotation)
POSES = {
    "kinect1": level_pose("kinect1"),
    # 4 m ahead and turned round, so that people near the first sensor are far from this one
    "kinect2": SensorPose("kinect2", np.array([4.0, 0.0, 0.0]), _ABOUT.as_quat()),
}


def seen(sensor: str, time: float, places: dict[int, tuple[float, float]]) -> list[Skeleton]:
    """A sensor's skeletons of people who stand at (x, y) in world, by its body numbers, with noise of a micrometre."""
    pose = POSES[sensor]
    noise = 1e-6 * np.random.default_rng(round(1000 * time)).normal(size=FIGURE.shape)
    result = []
    for number, place in sorted(places.items()):
        positions = (FIGURE + noise + [*place, 0.0] - pose.translation) @ pose.rotation
        stamp = time + (OFF if sensor == "kinect2" else 0.0)
        result.append(replace(frame(stamp, positions, sensor), body=number))
    return result


def made(subject: str, count: int = 3, hold: float = 1.0) -> People:
    people = People(SENSORS, PeopleParameters(subject, count, hold))
    for pose in POSES.values():
        people.set_pose(pose)
    people.set_clock("kinect2", 0, ClockModel(round(OFF * NANOSECONDS)))
    return people


@pytest.mark.parametrize("subject", [NEAREST, FIRST])
def test_one_subject_is_the_same_in_all_sensors(subject: str) -> None:
    people = made(subject)
    # the near one of the first sensor is the far one of the second, which calls them otherwise
    for step in range(40):
        ((number, one),) = people.sort("kinect1", seen("kinect1", 40.0 + step / 30, {0: (1.5, 0.3), 1: (2.8, -0.3)}))
        ((_, other),) = people.sort("kinect2", seen("kinect2", 40.01 + step / 30, {0: (2.8, -0.3), 3: (1.5, 0.3)}))
        assert (number, one.body, other.body) == (1, 0, 3)
    assert people.tracked == (1,) and people.counts["people"] == 2


def test_the_subject_is_held_while_hidden_and_then_another_is_chosen() -> None:
    for subject, who in ((NEAREST, 2), (FIRST, 1)):
        people = made(subject, hold=1.0)
        times = [40.0 + step / 30 for step in range(150)]
        picked = []
        for time in times:
            there = {0: (1.5, 0.0), 1: (3.0, 1.0)} if time < 41.0 else {1: (3.0, 1.0), 2: (1.5, -1.5)}
            found = people.sort("kinect1", seen("kinect1", time, there))
            picked.append(found[0][1].body if found else None)
        assert set(picked[:30]) == {0}
        assert picked[35:55] == [None] * 20  # hidden, not exchanged
        assert set(picked[-30:]) == {who}


def test_all_have_numbers_and_a_new_one_gets_the_number_unused_for_longest() -> None:
    gone: list[int] = []
    people = made(ALL, count=3, hold=0.5)
    people.gone = gone.append
    stages = [
        ({0: (1.5, 0.0), 1: (2.5, 1.0)}, {0: 1, 1: 2}),
        ({1: (2.5, 1.0)}, {1: 2}),
        ({1: (2.5, 1.0), 5: (1.5, -1.0)}, {1: 2, 5: 3}),
        ({1: (2.5, 1.0), 5: (1.5, -1.0), 4: (3.2, -0.6)}, {1: 2, 5: 3, 4: 1}),
        ({1: (2.5, 1.0), 5: (1.5, -1.0), 4: (3.2, -0.6), 2: (3.4, 0.6)}, {1: 2, 5: 3, 4: 1}),
    ]
    time = 40.0
    for there, expected in stages:
        for _ in range(45):
            time += 1 / 30
            found = people.sort("kinect1", seen("kinect1", time, there))
        assert {body.body: number for number, body in found} == expected
        assert people.tracked == tuple(sorted(expected.values()))
    assert gone == [1]
    assert people.counts["people without a number"] == 1


def test_slots_are_taken_in_turn() -> None:
    slots = Slots(2)
    assert slots.update([7, 8, 9]) == ([], 1)
    assert slots.of == {7: 1, 8: 2}
    assert slots.update([8, 9]) == ([1], 0)
    assert slots.of == {8: 2, 9: 1}


def test_frames_without_pose_or_clock_are_not_associated() -> None:
    for several in (False, True):
        people = People(SENSORS, PeopleParameters(ALL if several else NEAREST))
        people.set_pose(POSES["kinect1"])
        for step in range(3):
            people.sort("kinect1", seen("kinect1", 40.0 + step, {0: (1.5, 0.0), 1: (3.0, 1.0)}))
            found = people.sort("kinect2", seen("kinect2", 40.0 + step, {0: (1.5, 0.0), 1: (3.0, 1.0)}))
            # the one nearest to itself, for its rhythm
            assert [body.body for _, body in found] == ([] if several else [1])
        people.set_pose(POSES["kinect2"])
        people.set_clock("kinect2", 0, ClockModel(-20 * NANOSECONDS))
        people.sort("kinect2", seen("kinect2", 43.0, {0: (1.5, 0.0)}))
        people.sort("kinect1", seen("kinect1", 43.0, {0: (1.5, 0.0)}))
        people.sort("kinect2", seen("kinect2", 43.1, {0: (1.5, 0.0)}))
        assert people.counts["uncalibrated"] == 3 and people.counters["other_clock"] == 1


def test_a_lone_person_keeps_the_number_when_another_one_comes() -> None:
    people = made(NEAREST)
    for step in range(90):
        x = 1.5 + 0.02 * step
        for sensor in SENSORS:
            body = seen(sensor, 40.0 + step / 30, {3: (x, 0.0)})
            assert people.sort(sensor, body) == [(1, body[0])]
    # two now, and the sensor's number went to the newcomer
    both = seen("kinect1", 43.0, {3: (x - 1.5, 0.0), 4: (x, 0.0)})
    ((_, subject),) = people.sort("kinect1", both)
    assert subject.body == 4


def test_each_person_is_fused_as_if_alone() -> None:
    rng = np.random.default_rng(0)
    several = FusionStage(check_all(FusionStage.PARAMETERS, {"sensors": SENSORS, "subject": ALL}))
    alone = [Fusion(SENSORS) for _ in range(2)]
    clock = "kinect2", 0, ClockModel(round(OFF * NANOSECONDS))
    for pose in POSES.values():
        several.take(graph.CALIBRATION, pose, Now(0, 0))
    several.take(graph.CALIBRATION_CLOCK, clock, Now(0, 0))
    for fusion in alone:
        for pose in POSES.values():
            fusion.set_pose(pose)
        fusion.set_clock(*clock)
    together: list[Skeleton] = []
    apart: list[list[Skeleton]] = [[], []]
    for step in range(60):
        for number, sensor in enumerate(SENSORS):
            time = 40.0 + step / 30 + 0.01 * number
            now_ns = round((time + 0.02) * NANOSECONDS)
            bodies = [
                replace(each, positions=each.positions + 0.01 * rng.normal(size=(25, 3)))
                for each in seen(sensor, time, {0: (1.5, 0.3), 1: (2.8, -0.3)})
            ]
            outputs = several.take(graph.skeleton_topic(sensor), bodies, Now(now_ns, now_ns))
            together += [each for output in outputs for each in output.payload]
            for fusion, found, body in zip(alone, apart, bodies, strict=True):
                found += fusion.push(sensor, body, now_ns)
    for number, found in enumerate(apart, 1):
        mine = [each for each in together if each.body == number]
        assert len(mine) == len(found) > 50
        for one, other in zip(mine, found, strict=True):
            assert one.stamp_ns == other.stamp_ns
            np.testing.assert_array_equal(one.positions, other.positions)
            np.testing.assert_array_equal(one.covariances, other.covariances)
