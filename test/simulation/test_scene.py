"""Scenes are repeatable, their parts are independent, and without errors the sensors report the truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from body_tracking.core.skeleton import NANOSECONDS, FloatArray, Joint, TrackingState
from body_tracking.inertial.simulated import SimulatedImu, usual_mounting
from body_tracking.inertial.surroundings import Iron, Surroundings
from body_tracking.kinect.simulated import KinectErrors
from body_tracking.simulation.layouts import NUMBERS, around, layout
from body_tracking.simulation.people import MODEL
from body_tracking.simulation.scene import (
    APART,
    RECEIVED_FROM_NS,
    START_NS,
    SceneError,
    Setup,
    SimulatedRecording,
    lanes,
    simulate,
)
from draws import draws

SHORT = 12.0
"""Seconds: enough for a repetition of most motions, with their T-poses."""


def reported(recording: SimulatedRecording, sensor: str) -> FloatArray:
    return np.stack([frame.skeletons[0].positions for frame in recording.frames if frame.sensor == sensor])


def test_the_same_setup_gives_the_same_numbers_and_another_seed_others() -> None:
    setup = Setup("hair_combing", seconds=SHORT)
    one, two, other = simulate(setup), simulate(setup), simulate(replace(setup, seed=1))
    assert [frame.received_ns for frame in one.frames] == [frame.received_ns for frame in two.frames]
    assert_array_equal(reported(one, "kinect1"), reported(two, "kinect1"))
    assert_array_equal(one.truths[0].q, two.truths[0].q)
    assert one.truths[0].person.stature != other.truths[0].person.stature


def test_a_further_sensor_or_person_or_inertial_sensor_changes_nothing_of_the_rest() -> None:
    two = Setup("squat", around(np.radians([30.0, -30.0]).tolist()), seconds=SHORT)
    imu = SimulatedImu("imu", "forearm_left", usual_mounting("forearm_left"))
    more = replace(two, layout=around(np.radians([30.0, -30.0, 150.0]).tolist()), imus=(imu,))
    one, other = simulate(two), simulate(more)
    assert_array_equal(one.truths[0].positions, other.truths[0].positions)
    for sensor in ("kinect1", "kinect2"):
        assert_array_equal(reported(one, sensor), reported(other, sensor))
    crowd = simulate(replace(two, number=2))
    assert_array_equal(crowd.truths[0].positions, one.truths[0].positions)


def test_other_errors_leave_people_clocks_and_captures_as_they_are() -> None:
    setup = Setup("slow_down", seconds=SHORT)
    worse = KinectErrors().scaled(2.0, ("bias", "white", "lost"))
    one, other = simulate(setup), simulate(replace(setup, errors=worse))
    assert_array_equal(one.truths[0].q, other.truths[0].q)
    assert [sensor.clock for sensor in one.sensors] == [sensor.clock for sensor in other.sensors]


@settings(max_examples=draws(2, 8), deadline=None)
@given(seed=st.integers(0, 1000), number=st.sampled_from(NUMBERS))
def test_without_errors_the_sensors_report_the_true_joints(seed: int, number: int) -> None:
    recording = simulate(Setup("two_handed_wave", layout(number), seconds=SHORT, seed=seed, errors=KinectErrors.none()))
    truth = recording.truths[0]
    for sensor in recording.sensors:
        for frame in recording.frames[:200]:
            if frame.sensor != sensor.pose.sensor:
                continue
            (skeleton,) = frame.skeletons
            reference_ns = sensor.clock.to_reference(skeleton.stamp_ns)
            near = np.searchsorted(truth.stamps_ns, reference_ns).clip(1, len(truth.stamps_ns) - 1)
            apart = (reference_ns - truth.stamps_ns[near]) / NANOSECONDS
            expected = truth.positions[near] + apart * truth.velocities[near]
            seen = skeleton.states == TrackingState.TRACKED
            assert seen[Joint.SPINE_MID]
            # to second order of up to a frame's time
            assert_allclose(sensor.pose.apply(skeleton.positions)[seen], expected[seen], atol=0.02)


def test_the_truth_is_one_body_with_its_velocities() -> None:
    truth = simulate(Setup("punching", seconds=SHORT)).truths[0]
    posture = MODEL.forward(truth.q, truth.person.lengths)
    assert_allclose(truth.positions[:, MODEL.joints], posture.positions, atol=1e-12)
    lines = MODEL.linearise(truth.q, truth.person.lengths)
    by_rates = np.einsum("njiv,nv->nji", lines.jacobian, truth.rates)
    assert_allclose(truth.velocities[:, MODEL.joints], by_rates, atol=2e-4)
    assert truth.stamps_ns[0] == pytest.approx(START_NS, abs=NANOSECONDS // 100)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_velocities_are_whole_from_the_first_instant_on(seed: int) -> None:
    """Whether the first capture falls before or after the start."""
    truth = simulate(Setup("random", seconds=SHORT, seed=seed)).truths[0]
    assert_allclose(truth.velocities[0], truth.velocities[1], atol=0.05 + 0.2 * np.abs(truth.velocities[1]).max())
    assert np.abs(truth.rates[0]).max() > 0.5 * np.abs(truth.rates[1]).max()


def test_people_stand_side_by_side_and_are_separated() -> None:
    recording = simulate(Setup("standing_still", layout(1), number=3, seconds=3.0))
    bases = np.stack([truth.positions[0, Joint.SPINE_BASE] for truth in recording.truths])
    across = np.abs(bases[:, 1] - bases[0, 1])
    assert_allclose(across[1:], APART, atol=0.1)
    assert np.sign(bases[1, 1] - bases[0, 1]) == -np.sign(bases[2, 1] - bases[0, 1])
    bodies = {skeleton.body for frame in recording.frames for skeleton in frame.skeletons}
    assert bodies == {0, 1, 2}
    for frame in recording.frames:
        assert len({skeleton.stamp_ns for skeleton in frame.skeletons}) == 1


def test_a_person_behind_another_is_lost_and_found_again_and_the_truth_has_both() -> None:
    setup = Setup("walking_and_turning", around([0.0]), number=2, seconds=8.0, standard=True, places=lanes(2))
    recording = simulate(setup)
    near, far = (truth.positions[:, Joint.SPINE_MID] for truth in recording.truths)
    assert (near[:, 0] < far[:, 0]).all() and len(near) == len(far) > 200
    hidden = 0
    for frame in recording.frames:
        instant = np.abs(recording.truths[0].stamps_ns - frame.skeletons[0].stamp_ns).argmin()
        # by the angle between their lines of sight
        apart = abs(near[instant, 1] / near[instant, 0] - far[instant, 1] / far[instant, 0])
        if len(frame.skeletons) == 1:
            hidden += 1
            (seen,) = frame.skeletons
            assert np.abs(recording.sensors[0].pose.apply(seen.positions[Joint.SPINE_MID]) - near[instant]).max() < 0.3
            assert apart < 0.4
        else:
            assert apart > 0.02 and {skeleton.body for skeleton in frame.skeletons} == {0, 1}
    assert 5 < hidden < 0.5 * len(recording.frames)
    alone = simulate(replace(setup, people=(recording.truths[0].person,), places=lanes(2)[:1]))
    assert_array_equal(alone.truths[0].positions, recording.truths[0].positions)


def test_frames_come_in_the_order_of_receipt_and_after_their_capture() -> None:
    recording = simulate(Setup("move_along", seconds=SHORT, seed=3))
    received = [frame.received_ns for frame in recording.frames]
    assert received == sorted(received)
    clocks = {sensor.pose.sensor: sensor.clock for sensor in recording.sensors}
    for frame in recording.frames:
        captured = clocks[frame.sensor].to_reference(frame.skeletons[0].stamp_ns) - START_NS
        assert frame.received_ns - RECEIVED_FROM_NS > captured


def test_iron_in_the_surroundings_changes_only_the_measured_field() -> None:
    imu = SimulatedImu("imu", "forearm_left", usual_mounting("forearm_left"))
    clean = Setup("standing_still", imus=(imu,), seconds=SHORT)
    magnet = Iron(clean.layout.position + [0.0, 0.5, 0.8], np.array([0.0, 30.0, 0.0]))
    (_, undisturbed), (_, disturbed) = (
        simulate(each).imus[0] for each in (clean, replace(clean, surroundings=Surroundings(iron=(magnet,))))
    )
    assert undisturbed.magnetic_field is not None and disturbed.magnetic_field is not None
    assert np.linalg.norm(disturbed.magnetic_field - undisturbed.magnetic_field, axis=1).min() > 1e-6
    assert_array_equal(disturbed.linear_acceleration, undisturbed.linear_acceleration)


def test_an_inertial_sensor_turns_as_its_segment_does() -> None:
    imu = SimulatedImu("imu", "hand_right", usual_mounting("hand_right"), oriented=True)
    recording = simulate(Setup("forearm_rolling", imus=(imu,), seconds=SHORT))
    ((_, samples),) = recording.imus
    assert len(samples.stamps_ns) > 900
    moving = np.linalg.norm(samples.angular_velocity, axis=1)
    assert np.quantile(moving, 0.9) > 1.0
    assert (samples.received_ns >= RECEIVED_FROM_NS).all()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"number": 0}, "0 people"),
        ({"number": 7}, "7 people"),
        ({"people": ()}, "0 people"),
        ({"seed": -1}, "seed -1"),
        ({"places": lanes(2)}, "2 places for 1 people"),
        ({"seconds": 0.5}, r"0\.5 seconds"),
        ({"seconds": float("nan")}, "nan seconds"),
    ],
)
def test_impossible_setups_are_refused(changes: dict[str, object], message: str) -> None:
    with pytest.raises(SceneError, match=message):
        replace(Setup("squat"), **changes)  # type: ignore[arg-type]
