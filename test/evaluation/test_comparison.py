"""Laws of comparing a recording with the truth, on arrays."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from body_tracking.core.estimate import ModelEstimate
from body_tracking.core.joint_angles import JointAngles
from body_tracking.core.measurement import joint_correlation
from body_tracking.core.skeleton import N_JOINTS, NANOSECONDS, Joint
from body_tracking.evaluation.comparison import (
    ALIGNED,
    AS_IT_IS,
    evaluate,
)
from body_tracking.evaluation.metrics import Curve
from body_tracking.evaluation.reading import (
    AngleSeries,
    EvaluationError,
    Recorded,
    SensorClaims,
    read_truth,
    truth_of_markers,
)
from body_tracking.kinematics.conventions import CONVENTIONS, angles_of, convention
from body_tracking.kinematics.positional import ANGLE_NAMES
from body_tracking.kinematics.upper_body import UpperBody
from draws import some

TWIST = Path(__file__).resolve().parents[2] / "bags" / "tpose_torso_twist"
TURN = Rotation.from_euler("zyx", [2.0, 0.4, -0.3]).as_matrix()
FLEXION = ANGLE_NAMES.index("elbow_flexion_left")


@cache
def truth() -> Recorded:
    """Some seconds of the simulated twist, thinned out where nothing but time would be gained."""
    whole = read_truth(TWIST)
    assert whole.angles is not None
    return replace(whole, stamps_ns=whole.stamps_ns[100:350], positions=whole.positions[100:350])


def estimate(delay: float = 0.0, noise: float = 0.0, **changed: object) -> Recorded:
    """Unbiased estimates between the truth's frames."""
    stamps_ns = truth().stamps_ns[10:-1:2] + 7_000_000
    zero = int(truth().stamps_ns[0])
    positions = Curve(truth().seconds(zero), truth().positions).at((stamps_ns - zero) / NANOSECONDS - delay)
    # errors of the joints of a bone are correlated, as the deviations of angles assume
    alike = np.linalg.cholesky(joint_correlation())
    positions = positions + noise * alike @ np.random.default_rng(4).standard_normal(positions.shape)
    covariances = np.broadcast_to(max(noise, 1e-3) ** 2 * np.eye(3), (*positions.shape, 3))
    made = Recorded(Path("mine"), "/filtered/skeleton", "world", stamps_ns, positions, covariances)
    return replace(made, **changed)  # type: ignore[arg-type]


def test_the_truth_itself_has_no_errors() -> None:
    result = evaluate(estimate(), truth())
    assert [each.name for each in result.comparisons] == [AS_IT_IS, ALIGNED]
    as_it_is, aligned = result.comparisons
    assert result.delay == pytest.approx(0.0, abs=5e-4)
    assert as_it_is.joints.farthest.max() < 1e-6
    assert aligned.joints.farthest.max() < 5e-3  # straight lines between 15 Hz frames
    assert (as_it_is.joints.covered == 1.0).all() and (as_it_is.off_track == 0.0).all()
    assert np.nanmax(as_it_is.positional.errors.largest) < 1e-6
    assert result.jitter.max() < 1e-6
    assert result.notes == ()


def test_delay_and_displacement_count_as_they_are_and_not_when_aligned() -> None:
    moved = estimate(0.08, 0.002)
    moved = replace(moved, positions=moved.positions @ TURN.T + [0.3, 0.0, -0.1])
    result = evaluate(moved, truth())
    as_it_is, aligned = result.comparisons
    assert result.delay == pytest.approx(0.08, abs=2e-3)
    assert aligned.alignment.delay == result.delay
    assert_allclose(aligned.alignment.rotation @ TURN, np.eye(3), atol=2e-3)
    assert as_it_is.joints.rms.min() > 0.2 and aligned.joints.rms.max() < 0.006
    assert as_it_is.off_track.min() > 0.9 and aligned.off_track.max() < 0.1
    # the elbow flexes in any frame; the trunk leans against one vertical only
    trunk = ANGLE_NAMES.index("trunk_flexion")
    assert as_it_is.positional.errors.rmse[trunk] > np.radians(10.0)
    assert aligned.positional.errors.rmse[trunk] < np.radians(2.0)
    assert as_it_is.positional.errors.rmse[FLEXION] < np.radians(4.0)


def test_stated_uncertainty_that_is_right_covers_95_percent_and_half_of_it_does_not() -> None:
    right = estimate(noise=0.02)
    assert right.covariances is not None
    rows = evaluate(right, truth()).comparisons[0]
    assert np.mean(rows.joints.covered) == pytest.approx(0.95, abs=0.02)
    assert 0.9 < rows.positional.errors.covered[FLEXION] <= 1.0
    sure = evaluate(replace(right, covariances=0.25 * right.covariances), truth()).comparisons[0]
    assert np.mean(sure.joints.covered) < 0.5
    silent = evaluate(replace(right, covariances=None), truth()).comparisons[0]
    assert np.isnan(silent.joints.covered).all() and np.isnan(silent.positional.errors.covered).all()


def test_frames_that_are_left_out_are_off_track() -> None:
    whole = estimate(noise=0.001)
    assert whole.covariances is not None
    kept = np.ones(len(whole.stamps_ns), dtype=bool)
    kept[40:80] = False  # 40 of 120 frames, 15 a second
    with_gap = Recorded(
        whole.source, whole.topic, "world", whole.stamps_ns[kept], whole.positions[kept], whole.covariances[kept]
    )
    result = evaluate(with_gap, truth())
    for comparison in result.comparisons:
        assert_allclose(comparison.off_track, 40 / 120, atol=0.02)
        assert comparison.joints.rms.max() < 0.01
    ended = Recorded(whole.source, whole.topic, "world", whole.stamps_ns[:60], whole.positions[:60])
    assert_allclose(evaluate(ended, truth()).comparisons[0].off_track, 0.5, atol=0.05)


def test_gaps_of_the_truth_are_reported_and_not_filled() -> None:
    gappy = truth().positions.copy()
    gappy[100:160, Joint.WRIST_LEFT] = np.nan
    gappy[:, Joint.HEAD] = np.nan
    result = evaluate(estimate(), replace(truth(), positions=gappy))
    frames = result.comparisons[0].joints.frames
    assert frames[Joint.HEAD] == 0 and frames[Joint.WRIST_RIGHT] == 120
    assert frames[Joint.WRIST_LEFT] == pytest.approx(120 - 30, abs=1)
    assert result.comparisons[0].joints.farthest[Joint.WRIST_LEFT] < 1e-3
    said = "\n".join(result.notes)
    assert "not compared, since only the estimate has these joints: Head" in said
    assert "60 of 250 frames" in said


def test_angles_are_matched_by_name_and_passed_over_the_cut() -> None:
    stamps = truth().stamps_ns
    turn = np.linspace(3.0, 3.4, len(stamps))
    right = AngleSeries(stamps, ("other", "turn"), np.stack([0.0 * turn, turn], axis=1), np.zeros((len(stamps), 2)))
    mine = estimate()
    at = np.interp(mine.stamps_ns, stamps, turn)
    said = (at + 0.01 + np.pi) % (2.0 * np.pi) - np.pi
    stddev = np.full((len(at), 2), 0.006)
    stddev[:20] = np.inf
    angles = AngleSeries(mine.stamps_ns, ("turn", "only_mine"), np.stack([said, said], axis=1), stddev)
    named = evaluate(replace(mine, angles=angles), replace(truth(), angles=right)).comparisons[0].named
    assert named is not None and named.names == ("turn",)
    assert named.errors.frames[0] == len(at) - 20
    assert named.errors.offset[0] == pytest.approx(0.01, abs=1e-4) and named.errors.covered[0] == 1.0


@pytest.mark.parametrize("name", some(tuple(CONVENTIONS)))
def test_the_models_true_coordinates_give_the_true_angles_in_the_estimates_convention(name: str) -> None:
    model = UpperBody()
    stamps = truth().stamps_ns
    tangent = np.zeros((len(stamps), model.nv))
    for coordinate, least, most in (("elbow_flexion_left", 0.3, 1.8), ("shoulder_y_right", 0.1, 0.6)):
        tangent[:, model.coordinate_names.index(coordinate)] = np.linspace(least, most, len(stamps))
    zeros = np.zeros_like(tangent)
    right = replace(truth(), coordinates=AngleSeries(stamps, model.coordinate_names, tangent, zeros))
    sure = 1e-10 * np.eye(2 * model.nv)
    lengths = model.default_lengths()
    said: list[JointAngles] = []
    for stamp, each in zip(stamps, tangent, strict=True):
        q = model.integrate(model.neutral(), each)
        posture = ModelEstimate(int(stamp), "world", 0, q, zeros[0], sure, lengths, 0.0 * lengths)
        said.append(angles_of(posture, model, name, said[-1] if said else None))
    position, stddev = (np.stack([getattr(each, part) for each in said]) for part in ("position", "position_stddev"))
    mine = estimate(angles=AngleSeries(stamps, said[0].names, position + 0.02, stddev))
    named = evaluate(mine, right).comparisons[0].named
    assert named is not None and named.names == said[0].names
    compared = named.errors.frames > 0
    assert compared.mean() > 0.7
    assert_allclose(named.errors.offset[compared], 0.02, atol=1e-5)
    assert_allclose(named.errors.fixed_rmse[compared], 0.0, atol=1e-5)


@pytest.mark.parametrize("name", CONVENTIONS)
def test_positional_truth_is_compared_only_with_angles_that_are_the_same(name: str) -> None:
    """Names that two conventions share may stand for different angles: ISB's elevation has the other sign."""
    names = convention(name, UpperBody()).names
    mine = estimate()
    flexed = np.full((len(mine.stamps_ns), len(names)), 0.5)
    angles = AngleSeries(mine.stamps_ns, names, flexed, 0.1 * np.ones_like(flexed))
    right = truth()
    assert right.angles is not None and right.angles.names == ANGLE_NAMES
    named = evaluate(replace(mine, angles=angles), replace(right, coordinates=None)).comparisons[0].named
    assert (named.names if named else ()) == tuple(each for each in names if each.startswith("elbow_flexion"))


def test_a_truth_with_a_clock_and_a_frame_of_its_own_is_found_by_its_movement() -> None:
    """As markers are: at 100 Hz, from some other instant on."""
    times = np.arange(1.0, 7.0, 0.01)
    zero = int(truth().stamps_ns[0])
    positions = Curve(truth().seconds(zero), truth().positions).at(times) @ TURN.T + [5.0, 1.0, 0.0]
    markers = truth_of_markers(Path("trial.c3d"), times - 1.0, positions)
    result = evaluate(estimate(noise=0.005), markers, own_clock=True)
    (aligned,) = result.comparisons
    assert aligned.name == ALIGNED and np.isnan(result.delay)
    assert aligned.joints.rms.max() < 0.02
    assert_allclose(aligned.alignment.rotation, TURN, atol=5e-3)


def test_without_motion_alignment_is_in_space_only_and_needs_a_common_clock() -> None:
    still = np.broadcast_to(truth().positions[0], truth().positions.shape)
    mine = estimate(noise=0.01, positions=np.broadcast_to(still[0], (120, N_JOINTS, 3)))
    result = evaluate(mine, replace(truth(), positions=still))
    assert np.isnan(result.delay) and any("aligned in space only" in note for note in result.notes)
    assert result.comparisons[1].alignment.delay == 0.0
    with pytest.raises(EvaluationError, match="do not show the same movement"):
        evaluate(mine, replace(truth(), positions=still), own_clock=True)


def test_calibration_is_judged_where_the_person_is() -> None:
    def claims(turn: float, stamps: list[int], offsets: list[float]) -> SensorClaims:
        rotation = Rotation.from_euler("z", [[turn]] * len(stamps)).as_matrix()
        stamps_ns = np.array(stamps) * NANOSECONDS + truth().stamps_ns[0]
        return SensorClaims(stamps_ns, rotation, np.zeros((len(stamps), 3)), stamps_ns, np.array(offsets))

    right = {"one": claims(0.0, [0], [0.0]), "two": claims(0.5, [0, 10], [2.0, 2.1])}
    found = {"one": claims(0.0, [0], [0.0]), "two": claims(0.51, [1, 5], [2.01, 2.06])}
    result = evaluate(estimate(sensors=found), replace(truth(), sensors=right))
    (two,) = result.calibration  # the first is world itself
    assert two.sensor == "two"
    assert_allclose(two.poses.rotation, 0.01)
    assert_allclose(two.clock, [0.0, 0.01], atol=1e-9)
    base = truth().positions[:, Joint.SPINE_BASE].mean(axis=0)
    assert_allclose(two.poses.displacement, 0.01 * np.linalg.norm(base[:2]), rtol=1e-3)


def test_errors_of_a_comparison_name_the_data() -> None:
    late = estimate()
    late = replace(late, stamps_ns=late.stamps_ns + 60 * NANOSECONDS)
    with pytest.raises(
        EvaluationError, match=r"do not overlap in time: mine from 17500000\d\d\.\d+ to .* from 17500000\d\d\."
    ):
        evaluate(late, truth())
    arms, legs = np.full((2, 120, N_JOINTS, 3), np.nan)
    arms[:, Joint.WRIST_LEFT] = 1.0
    legs[:, Joint.KNEE_LEFT] = 1.0
    with pytest.raises(EvaluationError, match=r"no joint is known in both: mine knows WristLeft, .* KneeLeft"):
        evaluate(estimate(positions=arms), replace(truth(), stamps_ns=truth().stamps_ns[:120], positions=legs))
    first, second = truth().positions.copy(), truth().positions.copy()
    first[125:], second[:135] = np.nan, np.nan
    mine = replace(truth(), source=Path("mine"), positions=first)
    with pytest.raises(EvaluationError, match=r"do not overlap|no joint is known in both at any time"):
        evaluate(mine, replace(truth(), positions=second))
    apart = replace(truth(), stamps_ns=truth().stamps_ns[0] + np.arange(250) * NANOSECONDS)
    with pytest.raises(EvaluationError, match=r"no joint is known twice within 0.15 s"):
        evaluate(estimate(), apart)
    ends = estimate()
    beyond = np.array([truth().stamps_ns[0] - NANOSECONDS, truth().stamps_ns[-1] + NANOSECONDS])
    with pytest.raises(EvaluationError, match=r"mine has 0 frames from 0.000 to"):
        evaluate(replace(ends, stamps_ns=beyond, positions=ends.positions[:2], covariances=None), truth())
    warned = evaluate(estimate(warnings=("mine: cut off at byte 7",)), truth()).notes
    assert warned == ("mine: cut off at byte 7",)
    frames = evaluate(estimate(frame_id="kinect1_optical_frame"), truth()).notes
    assert any("kinect1_optical_frame" in note for note in frames)
