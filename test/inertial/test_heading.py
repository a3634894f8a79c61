"""Headings are found with a camera, held by joints, and have consistent covariances."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from body_tracking.core import so3
from body_tracking.core.skeleton import FloatArray, Joint
from body_tracking.core.so3 import wrapped
from body_tracking.inertial.alignment import Alignment, AlignmentError, elbow_segment_axes, yaw
from body_tracking.inertial.heading import HeadingTracker, bone_of
from draws import draws

ARM = ("upper_arm_left", "forearm_left")
SEEDS = st.integers(0, 2**32 - 1)


def smooth(times: FloatArray, rng: np.random.Generator, size: int) -> FloatArray:
    """(n, size) waves of unit variance, 0.1 to 0.5 Hz."""
    frequencies, phases = rng.uniform(0.1, 0.5, (size, 4)), rng.uniform(0.0, 6.3, (size, 4))
    return np.sin(2.0 * np.pi * times[:, None, None] * frequencies + phases).sum(axis=-1) / np.sqrt(2.0)


def arm(times: FloatArray, rng: np.random.Generator) -> FloatArray:
    """(n, 2, 3, 3) a left upper arm, and a forearm that bends and turns within its ranges."""
    waves = smooth(times, rng, 5)
    upper = so3.quat_to_matrix(so3.exp(0.6 * waves[:, :3] + [0.8, 0.0, 0.0]))
    flexion, pronation = elbow_segment_axes("left")
    bend = np.radians(70.0 + 30.0 * np.tanh(waves[:, 3]))
    joint = so3.quat_multiply(so3.exp(bend[:, None] * flexion), so3.exp(np.tanh(waves[:, 4:]) * pronation))
    return np.stack([upper, upper @ so3.quat_to_matrix(joint)], axis=1)


class Wearer:
    """A left arm with two sensors: the true state, and an initial alignment with errors as stated."""

    def __init__(self, seed: int, seconds: float, heading_stddev: float, walk: float = 0.0) -> None:
        self.rng = rng = np.random.default_rng(seed)
        self.times = np.arange(0.0, seconds, 1.0 / 30.0)
        self.world = arm(self.times, rng)
        self.true = so3.quat_to_matrix(so3.exp(rng.normal(size=(2, 3))))
        steps = walk * np.sqrt(1.0 / 30.0) * rng.normal(size=(len(self.times), 2))
        self.psi = rng.uniform(-np.pi, np.pi, 2) + np.cumsum(steps, axis=0)
        deviations = np.tile([*np.radians([6.0, 6.0, 6.0]), heading_stddev], 2)
        prior = np.diag(deviations**2)
        self.start = Alignment(ARM, self.true, self.psi[0], prior).moved(deviations * rng.normal(size=8), prior)

    def sensors(self, instant: int) -> FloatArray:
        """(2, 3, 3) sensor to earth."""
        return yaw(-self.psi[instant]) @ self.world[instant] @ self.true.swapaxes(-1, -2)

    def error(self, alignment: Alignment, instant: int) -> FloatArray:
        """(8,) errors in the coordinates of the covariance."""
        turned = so3.rotation_vectors(alignment.rotations.swapaxes(-1, -2) @ self.true)
        apart = wrapped(self.psi[instant] - alignment.headings)
        return np.concatenate([turned, apart[:, None]], axis=1).reshape(-1)

    def run(self, tracker: HeadingTracker, look: Callable[[HeadingTracker, int, FloatArray], None], every: int) -> None:
        for instant in range(0, len(self.times), every):
            look(tracker, instant, self.sensors(instant))


def see_bones(
    wearer: Wearer, tracker: HeadingTracker, instant: int, sensors: FloatArray, stddev: float, errors: FloatArray
) -> None:
    """Observe both bones with these errors, (2, 3) in units of their standard deviation."""
    for number, name in enumerate(ARM):
        bone = bone_of(name)
        assert bone is not None
        seen = wearer.world[instant, number] @ bone.axis + stddev * errors[number]
        tracker.observe_bone(float(wearer.times[instant]), name, sensors[number], seen, stddev)


def by_bones(wearer: Wearer, stddev: float) -> Callable[[HeadingTracker, int, FloatArray], None]:
    def look(tracker: HeadingTracker, instant: int, sensors: FloatArray) -> None:
        see_bones(wearer, tracker, instant, sensors, stddev, wearer.rng.normal(size=(2, 3)))

    return look


@pytest.mark.parametrize("seed", range(3))
def test_a_camera_determines_unknown_headings(seed: int) -> None:
    wearer = Wearer(seed, 30.0, np.pi / np.sqrt(3.0))
    tracker = HeadingTracker(wearer.start)
    wearer.run(tracker, by_bones(wearer, 0.05), 6)
    error = wearer.error(tracker.alignment, len(wearer.times) - 1)
    stddev = tracker.alignment.stddev.reshape(-1)
    assert np.abs(np.degrees(error[3::4])).max() < 8.0
    assert (stddev[3::4] < np.radians(6.0)).all()
    assert (np.abs(error) < 3.5 * stddev).all()


def test_covariance_holds_with_lasting_errors_of_the_camera_and_drifting_headings() -> None:
    inside = []
    for seed in range(draws(2, 4)):
        walk = np.radians(0.4)
        wearer = Wearer(seed, 25.0, np.radians(15.0), walk)
        tracker = HeadingTracker(wearer.start, heading_walk=walk)
        fades = np.exp(-(5.0 / 30.0) / 0.7)
        error = wearer.rng.normal(size=(2, 3))
        for instant in range(0, len(wearer.times), 5):
            error = fades * error + np.sqrt(1.0 - fades**2) * wearer.rng.normal(size=(2, 3))
            see_bones(wearer, tracker, instant, wearer.sensors(instant), 0.08, error)
            if instant % 90 == 45:
                off = wearer.error(tracker.alignment, instant)
                inside.append(np.abs(off) < 1.96 * tracker.alignment.stddev.reshape(-1))
    assert np.mean(inside) >= 0.92


@pytest.mark.parametrize("seed", range(3))
def test_an_elbow_bounds_the_difference_of_two_headings_and_their_common_part_drifts(seed: int) -> None:
    wearer = Wearer(seed, 40.0, np.radians(15.0))
    tracker = HeadingTracker(wearer.start)

    def look(tracker: HeadingTracker, instant: int, sensors: FloatArray) -> None:
        tracker.observe_elbow(float(wearer.times[instant]), "left", *sensors)

    wearer.run(tracker, look, 15)
    covariance = tracker.alignment.covariance[np.ix_([3, 7], [3, 7])]
    apart, common = np.array([-1.0, 1.0]), np.array([0.5, 0.5])
    grown = 0.5 * (np.radians(15.0) ** 2 + np.radians(0.4) ** 2 * 40.0)
    np.testing.assert_allclose(common @ covariance @ common, grown, rtol=0.1)
    assert apart @ covariance @ apart < 0.5 * 4.0 * grown
    error = wearer.error(tracker.alignment, len(wearer.times) - 1)[[3, 7]]
    assert abs(apart @ error) < 3.5 * np.sqrt(apart @ covariance @ apart)


@settings(max_examples=draws(8, 15), deadline=None)
@given(SEEDS)
def test_a_limit_pulls_back_only_what_is_beyond_it(seed: int) -> None:
    wearer = Wearer(seed, 0.2, np.radians(15.0))
    tracker = HeadingTracker(Alignment(ARM, wearer.true, wearer.psi[0], wearer.start.covariance))
    sensors = wearer.sensors(0)
    assert tracker.observe_range(0.0, *ARM, (sensors[0], sensors[1])) is None
    flexion, _ = elbow_segment_axes("left")
    # bent backwards by 40 degrees
    beyond = wearer.world[0, 0] @ so3.quat_to_matrix(so3.exp(-np.radians(40.0) * flexion))
    lower = yaw(-wearer.psi[0, 1]) @ beyond @ wearer.true[1].T
    found = tracker.observe_range(0.1, *ARM, (sensors[0], lower))
    assert found is not None
    again = tracker.observe_range(10.0, *ARM, (sensors[0], lower))
    assert again is None or np.abs(again.residual).sum() < np.abs(found.residual).sum()


@pytest.mark.parametrize("child", ["upper_trunk", "head", "clavicle_right"])
def test_the_trunks_joints_have_ranges_too(child: str) -> None:
    parent = "pelvis" if child == "upper_trunk" else "upper_trunk"
    upright = Alignment((parent, child), np.tile(np.eye(3), (2, 1, 1)), np.zeros(2), 0.1 * np.eye(8))
    tracker = HeadingTracker(upright)
    assert tracker.observe_range(0.0, parent, child, (np.eye(3), np.eye(3))) is None
    # turned far against the other: the common heading stays, the difference shrinks
    found = tracker.observe_range(1.0, parent, child, (np.eye(3), yaw(2.5)))
    assert found is not None
    assert abs(tracker.alignment.headings[1] - tracker.alignment.headings[0]) > 0.1
    with pytest.raises(AlignmentError, match="no joint"):
        tracker.observe_range(2.0, child, parent, (np.eye(3), np.eye(3)))


def test_one_outlier_skeleton_hardly_changes_the_estimate() -> None:
    wearer = Wearer(4, 20.0, np.radians(5.0))
    tracker = HeadingTracker(wearer.start)
    wearer.run(tracker, by_bones(wearer, 0.03), 6)
    before = tracker.alignment
    sensors = wearer.sensors(-1)
    found = tracker.observe_bone(21.0, ARM[0], sensors[0], -wearer.world[-1, 0] @ [0.0, 0.3, -1.0], 0.03)
    assert found is not None
    assert found.weight < 0.2
    moved = so3.rotation_vectors(before.rotations[0].T @ tracker.alignment.rotations[0])
    assert np.linalg.norm(moved) < np.radians(4.0)


def test_unseen_bones_are_ignored_and_backward_time_is_refused() -> None:
    wearer = Wearer(0, 1.0, 0.1)
    tracker = HeadingTracker(wearer.start)
    sensors = wearer.sensors(0)
    assert tracker.observe_bone(0.0, ARM[0], sensors[0], np.full(3, np.nan), 0.1) is None
    assert tracker.observe_bone(0.0, ARM[0], sensors[0], np.zeros(3), 0.1) is None
    np.testing.assert_array_equal(tracker.alignment.covariance, wearer.start.covariance)
    tracker.predict(1.0)
    with pytest.raises(AlignmentError, match="comes before"):
        tracker.predict(0.5)
    with pytest.raises(AlignmentError, match="carries no sensor"):
        tracker.loosen("head", 0.1)
    before = tracker.alignment.stddev[0, 0]
    tracker.loosen(ARM[0], 0.3)
    assert tracker.alignment.stddev[0, 0] == pytest.approx(np.hypot(before, 0.3))
    with pytest.raises(AlignmentError, match="no joint"):
        tracker.observe_range(1.0, "forearm_left", "upper_arm_left", (sensors[1], sensors[0]))
    assert bone_of("lower_trunk") is None
    bone = bone_of("forearm_right")
    assert bone is not None
    assert (bone.start, bone.end) == (Joint.ELBOW_RIGHT, Joint.WRIST_RIGHT)
