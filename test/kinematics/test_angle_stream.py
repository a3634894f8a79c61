"""A model that follows a skeleton: the truth comes back, and unobservable angles have large deviations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from body_tracking.core.estimate import ModelEstimate
from body_tracking.core.joint_angles import JointAngles
from body_tracking.core.skeleton import N_JOINTS, NANOSECONDS, FloatArray, Joint, Skeleton, TrackingState
from body_tracking.kinematics.codecs import segment_poses
from body_tracking.kinematics.conventions import ALL_CONVENTIONS, ConventionError, angles_of
from body_tracking.kinematics.lengths import LengthChanges
from body_tracking.kinematics.positional import positional_angles
from body_tracking.kinematics.skeleton_fit import SkeletonFit
from body_tracking.kinematics.stage import AnglesStage, AngleStream, JumpDoubt
from body_tracking.kinematics.upper_body import UNOBSERVED, UpperBody
from body_tracking.pipeline import graph
from body_tracking.pipeline.stage import Now
from draws import draws

MODEL = UpperBody()
LENGTHS = MODEL.default_lengths(1.82) * (1.0 + 0.05 * np.sin(np.arange(21)))
STDDEV = 0.005
FRAME = 1 / 30


def motion(time: float) -> tuple[FloatArray, FloatArray]:
    """Configuration and tangent velocity of a person who bends, turns and waves, away from singular poses."""
    v = np.zeros(MODEL.nv)
    rate = np.zeros(MODEL.nv)
    amplitudes = {
        "base_x": (2.5, 0.1), "base_z": (1.0, 0.02), "base_rz": (0.4, 0.3), "lumbar_flexion": (0.1, 0.1),
        "thoracic_lateral": (0.0, 0.1), "neck_flexion": (0.1, 0.1), "shoulder_y_left": (-0.6, 0.3),
        "shoulder_y_right": (-0.4, 0.2), "elbow_flexion_left": (1.2, 0.4), "elbow_flexion_right": (0.9, 0.3),
        "forearm_pronation_left": (0.2, 0.3), "clavicle_elevation_right": (0.1, 0.05),
    }  # fmt: skip
    for number, (name, (centre, size)) in enumerate(amplitudes.items()):
        column, frequency = MODEL.coordinate_names.index(name), 2.0 + 0.3 * number
        v[column] = centre + size * np.sin(frequency * time)
        rate[column] = size * frequency * np.cos(frequency * time)
    # each rotation is about one axis: the rates of its vector are its tangent velocity
    return MODEL.integrate(MODEL.neutral(), v), rate


def seen(time: float, noise: np.random.Generator | None = None) -> Skeleton:
    q, rate = motion(time)
    lines = MODEL.linearise(q, LENGTHS)
    positions, velocities = np.full((2, N_JOINTS, 3), np.nan)
    positions[MODEL.joints] = lines.posture.positions
    velocities[MODEL.joints] = lines.jacobian @ rate
    if noise is not None:
        positions += noise.normal(scale=STDDEV, size=positions.shape)
    states = np.zeros(N_JOINTS, np.uint8)
    states[MODEL.joints] = TrackingState.TRACKED
    covariances = np.tile(STDDEV**2 * np.eye(3), (N_JOINTS, 1, 1))
    return Skeleton(round(time * NANOSECONDS), "world", positions, states, 3, covariances, velocities)


def followed(fit: SkeletonFit, times: FloatArray, noise: np.random.Generator | None = None) -> list[ModelEstimate]:
    found = [fit.update(seen(time, noise)) for time in times]
    assert all(estimate is not None for estimate in found)
    return [estimate for estimate in found if estimate is not None]


def test_lengths_pose_and_rates_of_a_person_come_back() -> None:
    times = np.arange(60) * FRAME
    estimates = followed(SkeletonFit(), times)
    for time, estimate in zip(times[5:], estimates[5:], strict=True):
        assert_allclose(estimate.lengths, LENGTHS, atol=1e-6)
        assert (estimate.stamp_ns, estimate.frame_id, estimate.body) == (round(time * NANOSECONDS), "world", 3)
        fitted, true = (MODEL.linearise(q, LENGTHS) for q in (estimate.q, motion(time)[0]))
        # the ranges of motion pull a little against the points
        assert np.abs(fitted.posture.positions - true.posture.positions).max() < 0.002
        moved = fitted.jacobian @ estimate.velocity - true.jacobian @ motion(time)[1]
        assert np.abs(moved).max() < 0.05
        variances = estimate.covariance.diagonal()
        assert (variances > 0.0).all()
        assert np.isfinite(estimate.covariance).all()


def test_errors_by_noise_are_within_the_stated_deviations() -> None:
    rng = np.random.default_rng(4)
    errors = []
    for estimate in followed(SkeletonFit(), np.arange(draws(100, 150)) * FRAME, rng)[40:]:
        stddev = np.sqrt(estimate.covariance.diagonal()[: MODEL.nv])
        errors.append(MODEL.difference(estimate.q, motion(estimate.stamp_ns / NANOSECONDS)[0]) / stddev)
    observed = np.array([name not in UNOBSERVED for name in MODEL.coordinate_names])
    within = (np.abs(np.array(errors)[:, observed]) < 2.0).mean()
    assert 0.85 < within <= 1.0


def test_a_length_that_is_never_seen_is_the_other_sides() -> None:
    fit = SkeletonFit()
    for time in np.arange(20) * FRAME:
        skeleton = seen(time)
        skeleton.states[[Joint.THUMB_LEFT, Joint.HAND_TIP_LEFT]] = TrackingState.NOT_TRACKED
        fit.update(skeleton)
    names = list(MODEL.length_names)
    for name in ("thumb_out", "thumb_along", "hand_tip"):
        left, right = names.index(f"{name}_left"), names.index(f"{name}_right")
        assert fit.lengths.lengths[left] == fit.lengths.lengths[right] == pytest.approx(LENGTHS[right])
        assert np.isinf(fit.lengths.stddev[left])
        assert np.isfinite(fit.lengths.stddev[right])


def test_without_a_trunk_there_is_nothing_and_then_it_goes_on() -> None:
    fit = SkeletonFit()
    followed(fit, np.arange(10) * FRAME)
    hidden = seen(10 * FRAME)
    hidden.states[[Joint.SPINE_BASE, Joint.SPINE_MID]] = TrackingState.NOT_TRACKED
    assert fit.update(hidden) is None
    assert fit.counters["no trunk"] == 1
    (estimate,) = followed(fit, np.array([11 * FRAME]))
    assert (
        np.abs(
            MODEL.forward(estimate.q, LENGTHS).positions - MODEL.forward(motion(11 * FRAME)[0], LENGTHS).positions
        ).max()
        < 0.003
    )
    assert fit.update(replace(seen(12 * FRAME), covariances=None)) is None


def test_without_velocities_the_rates_are_unknown() -> None:
    estimate = SkeletonFit().update(replace(seen(0.0), velocities=None))
    assert estimate is not None
    assert np.isnan(estimate.velocity).all()
    assert np.isinf(estimate.covariance.diagonal()[MODEL.nv :]).all()
    angles = angles_of(estimate, MODEL, "model")
    assert np.isnan(angles.velocity).all()
    assert np.isinf(angles.velocity_stddev).all()


@pytest.mark.parametrize("convention", ALL_CONVENTIONS)
def test_a_stream_has_the_same_names_from_frame_to_frame_and_starts_anew_when_told(convention: str) -> None:
    stream = AngleStream(convention)
    first = [stream.of_skeleton(seen(time)) for time in np.arange(5) * FRAME]
    assert len({each.names for each in first if each is not None}) == 1
    stream.reset()
    for before, time in zip(first, np.arange(5) * FRAME, strict=True):
        again = stream.of_skeleton(seen(time))
        assert before is not None
        assert again is not None
        np.testing.assert_array_equal(again.position, before.position)
    if convention == "positional":
        np.testing.assert_array_equal(first[3].position, positional_angles(seen(3 * FRAME)).position)


def stated(seconds: float, degrees: float, rate: float = 0.0, stddev: float = 5.0) -> JointAngles:
    one = np.radians([1.0])
    return JointAngles(round(seconds * 1e9), ("elbow",), degrees * one, rate * one, stddev * one, 30.0 * one)


def test_a_jump_that_contradicts_the_deviations_is_doubted_for_a_while() -> None:
    doubt = JumpDoubt()
    moving = [doubt(stated(k * FRAME, 600.0 * k * FRAME, 600.0)) for k in range(6)]  # 20 deg a frame, as stated
    still = [doubt(stated(k * FRAME, 100.0 + noise)) for k, noise in zip(range(6, 9), (0.0, 12.0, 0.0), strict=True)]
    for angles in (*moving, *still[1:]):
        assert angles.position_stddev == pytest.approx(np.radians(5.0))
    jumped = doubt(stated(9 * FRAME, 180.0))
    assert abs(np.radians(100.0) - jumped.position[0]) <= 1.96 * jumped.position_stddev[0]
    later = [np.degrees(doubt(stated(k * FRAME, 180.0)).position_stddev[0]) for k in range(10, 40)]
    assert (np.diff(later) < 0.0).all() and later[0] > 30.0 and later[-1] < 5.1
    assert np.degrees(doubt(stated(40 * FRAME, -179.0)).position_stddev[0]) < 5.1  # the same angle, a full turn on


def test_another_convention_is_refused() -> None:
    with pytest.raises(ConventionError, match="'isp'"):
        AngleStream("isp")


def test_segments_stand_where_their_joints_are() -> None:
    (estimate,) = followed(SkeletonFit(), np.array([0.0]))
    origins, quats = segment_poses(estimate, MODEL)
    points = MODEL.forward(estimate.q, estimate.lengths).positions
    forearm = MODEL.segment_names.index("forearm_left")
    assert_allclose(origins[forearm], points[list(MODEL.joints).index(Joint.ELBOW_LEFT)])
    assert_allclose(np.linalg.norm(quats, axis=1), 1.0)


# --- news of lengths


def test_lengths_are_published_first_on_changes_and_once_settled_but_not_too_often() -> None:
    changes = LengthChanges()
    lengths = np.array([0.3, 0.4])
    published = []
    for number in range(300):
        time = number * FRAME
        if 1.0 < time <= 4.0:
            lengths = lengths + np.array([0.0002, 0.0])  # 6 mm/s
        if changes.due(round(time * NANOSECONDS), lengths.copy()):
            published.append((time, float(lengths[0])))
    assert published[0][0] == 0.0
    assert np.diff([time for time, _ in published]).min() >= 1.0 - 1e-6
    assert 3 <= len(published) <= 6
    assert published[-1][1] == lengths[0]  # exactly, once they settle


def test_constant_lengths_are_published_once() -> None:
    changes = LengthChanges()
    assert [changes.due(k * NANOSECONDS, np.array([0.3])) for k in range(5)] == [True, False, False, False, False]
    changes.reset()
    assert changes.due(0, np.array([0.3]))


def test_angles_that_need_a_trunk_say_so_where_none_is_seen() -> None:
    given = {"convention": "isb", "input": graph.SKELETON_INPUT}
    stage = AnglesStage({each.name: each.default for each in AnglesStage.PARAMETERS} | given)
    for number in range(3):
        skeleton = seen(number * FRAME)
        assert [*stage.take(graph.FILTERED, (skeleton,), Now(skeleton.stamp_ns, skeleton.stamp_ns))]
    assert stage.state(0)[0] == 0
    for number in range(3, 8):
        skeleton = seen(number * FRAME)
        skeleton.states[[Joint.SPINE_MID, Joint.SPINE_BASE]] = TrackingState.NOT_TRACKED
        assert not [*stage.take(graph.FILTERED, (skeleton,), Now(skeleton.stamp_ns, skeleton.stamp_ns))]
    level, text, _ = stage.state(0)
    assert level == 1 and "need two joints of the spine" in text
