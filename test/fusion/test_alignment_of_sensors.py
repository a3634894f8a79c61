"""Single frames in world: placed and timed by the calibration, with left and right as all sensors see them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation
from two_kinects import FRAME, OFFSET_NS, POSES, truth

from body_tracking.core.clocks import ClockModel
from body_tracking.core.measurement import joint_stddev
from body_tracking.core.sensor_poses import level_pose
from body_tracking.core.skeleton import MIRROR, NANOSECONDS, Joint, Skeleton
from body_tracking.fusion.alignment import SensorAlignment
from body_tracking.fusion.placement import FusionError
from walkers import frame


def alignment(*calibrated: str) -> SensorAlignment:
    made = SensorAlignment(tuple(POSES), "kinect1")
    for sensor in calibrated or tuple(POSES):
        made.set_pose(POSES[sensor])
    made.set_clock("kinect2", 0, ClockModel(OFFSET_NS))
    return made


def seen(sensor: str, time: float, mirrored: bool = False) -> Skeleton:
    """The frame of a sensor at a reference time, in its own frame and clock."""
    pose = POSES[sensor]
    positions = (truth(np.array([time]))[0] - pose.translation) @ pose.rotation
    skeleton = frame(time, positions[MIRROR] if mirrored else positions, sensor)
    shift = OFFSET_NS if sensor == "kinect2" else 0
    return replace(skeleton, stamp_ns=skeleton.stamp_ns + shift)


def pushed(made: SensorAlignment, sensor: str, skeleton: Skeleton) -> Skeleton:
    aligned = made.push(sensor, skeleton)
    assert aligned is not None
    return aligned


def test_a_known_pose_and_clock_give_back_the_truth_at_its_time() -> None:
    """A body that one sensor sees mirrored is repaired."""
    made, mirrored_from = alignment(), 30
    for number in range(60):
        for sensor, time in (("kinect1", number * FRAME), ("kinect2", number * FRAME + 0.011)):
            given = seen(sensor, time, sensor == "kinect2" and number >= mirrored_from)
            aligned = pushed(made, sensor, given)
            assert aligned.stamp_ns == round(time * NANOSECONDS)
            assert aligned.frame_id == "world"
            assert_allclose(aligned.positions, truth(np.array([time]))[0], atol=1e-9)
            if number < mirrored_from:
                stddev = joint_stddev(given.positions, given.states)
                assert_allclose(aligned.covariances, (stddev**2)[:, None, None] * np.eye(3))
    assert made.counters["aligned"] == 120
    assert made.counters["repaired"] == 60 - mirrored_from


def test_a_body_seen_with_its_axis_across_keeps_its_midline_only() -> None:
    made = alignment()
    for number in range(30):
        time = number * FRAME
        pushed(made, "kinect1", seen("kinect1", time))
        pushed(made, "kinect2", seen("kinect2", time + 0.011))
    given = seen("kinect2", 1.011)
    pose = POSES["kinect2"]
    pushed(made, "kinect1", seen("kinect1", 1.0))
    world = truth(np.array([1.011]))[0]
    centre = world[Joint.SPINE_SHOULDER]
    turned = (world - centre) @ Rotation.from_euler("z", 90, degrees=True).as_matrix().T + centre
    aligned = pushed(made, "kinect2", replace(given, positions=(turned - pose.translation) @ pose.rotation))
    lateral = np.arange(25) != MIRROR
    assert np.isnan(aligned.positions[lateral]).all()
    assert (aligned.states[lateral] == 0).all()
    assert aligned.valid[~lateral].all()
    assert made.counters["turned_joints"] == lateral.sum()


def test_a_pose_holds_from_its_time_on_and_not_before() -> None:
    made = alignment("kinect1")
    made.set_pose(replace(POSES["kinect2"], valid_from_ns=NANOSECONDS))
    assert made.push("kinect2", seen("kinect2", 0.9)) is None
    assert made.counters["uncalibrated"] == 1
    assert_allclose(pushed(made, "kinect2", seen("kinect2", 1.1)).positions, truth(np.array([1.1]))[0], atol=1e-9)


def test_a_clock_that_jumps_back_starts_anew_and_poses_hold() -> None:
    made = alignment("kinect1")
    made.set_pose(replace(POSES["kinect2"], valid_from_ns=NANOSECONDS))
    pushed(made, "kinect1", seen("kinect1", 5.0))
    pushed(made, "kinect1", seen("kinect1", 0.5))
    assert made.counters["resets"] == 1
    # The pose that waited for its time is in force, because the recording began again.
    assert_allclose(pushed(made, "kinect2", seen("kinect2", 0.5)).positions, truth(np.array([0.5]))[0], atol=1e-9)


@pytest.mark.parametrize("off", [-5.0, 5.0])
def test_a_sensor_with_a_wrong_clock_is_left_out_until_it_is_calibrated(off: float) -> None:
    made = alignment()
    taken = []
    for number in range(60):
        time = 10.0 + number * FRAME
        pushed(made, "kinect1", seen("kinect1", time))
        other = seen("kinect2", time + 0.011)
        if number == 10:  # a refined clock
            made.set_clock("kinect2", round(time * NANOSECONDS), ClockModel(OFFSET_NS + 1_000_000))
        if number >= 20:
            other = replace(other, stamp_ns=other.stamp_ns + round(off * NANOSECONDS))
        if number == 40:
            made.set_clock("kinect2", round(time * NANOSECONDS), ClockModel(OFFSET_NS + round(off * NANOSECONDS)))
        taken.append(made.push("kinect2", other) is not None)
    # Stamps from the past are detected at once, those from the future at the reference's next frame.
    assert taken == [True] * 20 + [off > 0.0] + [False] * 19 + [True] * 20


def test_late_frames_pass_and_unknown_sensors_are_counted_or_rejected() -> None:
    made = alignment()
    pushed(made, "kinect1", seen("kinect1", 1.0))
    aligned = pushed(made, "kinect1", seen("kinect1", 0.95))
    assert_allclose(aligned.positions, truth(np.array([0.95]))[0], atol=1e-9)
    assert made.counters["late"] == 1
    assert made.push("kinect9", seen("kinect1", 0.0)) is None
    made.set_pose(level_pose("kinect9"))
    made.set_clock("kinect9", 0, ClockModel())
    assert made.counters["unknown_sensor"] == 3
    with pytest.raises(FusionError, match="kinect9"):
        SensorAlignment(tuple(POSES), "kinect9")
