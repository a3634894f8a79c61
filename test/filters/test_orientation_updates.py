"""Orientations of segments in the extended filter: their information, the errors of their sources, and covariances."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest
from estimates import assert_same, known
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from random_people import START_NS, Dropout, MeasurementErrors, RandomPerson, Truth, capture_times, observe, truth_of
from scipy.linalg import expm
from scipy.signal import lfilter
from scipy.stats import binom, norm

from body_tracking.core import so3
from body_tracking.core.body_model import SEGMENTS
from body_tracking.core.compiled import LOOPS
from body_tracking.core.measurement import BASE_STDDEV, joint_correlation
from body_tracking.core.orientation import SEGMENT_NUMBER, SegmentOrientation
from body_tracking.core.skeleton import N_JOINTS, NANOSECONDS, FloatArray, Joint, Skeleton, TrackingState
from body_tracking.filters.ekf import orientations
from body_tracking.filters.ekf import sources as orientation
from body_tracking.filters.ekf.filter import ExtendedKalmanFilter, prepare
from body_tracking.filters.ekf.parameters import EkfParameters
from body_tracking.filters.ekf.sources import PER_SOURCE, Sources
from body_tracking.kinematics.posture import STDDEV, PosturePrior
from body_tracking.kinematics.ranges import Ranges
from body_tracking.kinematics.upper_body import UNOBSERVED
from body_tracking.simulation.people import MODEL
from body_tracking.simulation.random_motion import RandomMotion
from draws import draws, some

NAMES = MODEL.coordinate_names
PRONATION = [NAMES.index(f"forearm_pronation_{side}") for side in ("left", "right")]
FOREARMS = ("forearm_left", "forearm_right")
HANDS = tuple(Joint[f"{part}_{side}"] for part in ("HAND", "HAND_TIP", "THUMB") for side in ("LEFT", "RIGHT"))
BODY = 85
"""Size of the state without sources."""
PERFECT = EkfParameters(
    misalignment_stddev=1e-3,
    heading_stddev=1e-3,
    tissue_stddev=0.0,
)
"""Parameters for sources without errors."""


@dataclass(frozen=True)
class Person:
    """A moving person, and a camera's skeletons."""

    body: RandomPerson
    motion: RandomMotion
    truth: Truth
    skeletons: tuple[Skeleton, ...]

    def at(self, stamp_ns: int) -> FloatArray:
        """(35,) the configuration."""
        result: FloatArray = self.motion.configuration(np.array([(stamp_ns - START_NS) / NANOSECONDS]))[0]
        return result


def worn_person(
    seed: int, seconds: float, noise: float = 0.015, without: Sequence[Joint] = (), tempo: float = 1.0
) -> Person:
    rng = np.random.default_rng([seed, 5])
    body = RandomPerson.draw(rng)
    motion = RandomMotion(rng, seconds, tempo)
    truth = truth_of(body, motion, capture_times(seconds, rng))
    dropouts = (Dropout(-1.0, seconds, tuple(without)),) if without else ()
    return Person(body, motion, truth, observe(truth, MeasurementErrors(noise, dropouts=dropouts), rng).skeletons)


@dataclass(frozen=True)
class Source:
    """Errors of a sensor: misalignment, heading, deviation and time of persistent errors; a slip at some time.

    With ``spin``, it reports angular velocities with errors of so many rad/s, about its misaligned axes.
    """

    segment: str
    misalignment: tuple[float, float, float] = (0.0, 0.0, 0.0)
    heading: float = 0.0
    slow: float = 0.0
    slow_time: float = 2.0
    slip: tuple[float, tuple[float, float, float]] | None = None
    stated: float = 0.01
    rate: float = 50.0
    spin: float | None = None

    def measure(self, person: Person, seed: int = 0) -> list[SegmentOrientation]:
        """Its orientations, by equation (1)."""
        rng = np.random.default_rng([seed, SEGMENT_NUMBER[self.segment]])
        seconds = float(person.truth.times[-1])
        times = np.arange(0.0011 + 0.0007 * SEGMENT_NUMBER[self.segment], seconds, 1.0 / self.rate)
        rotations = MODEL.forward(person.motion.configuration(times), person.body.lengths).rotations
        keep = np.exp(-1.0 / (self.rate * self.slow_time))
        drive = rng.normal(size=(len(times), 3))
        drive[1:] *= np.sqrt(1.0 - keep**2)
        slow = lfilter([1.0], [1.0, -keep], drive, axis=0)
        mounting = np.tile(so3.quat_to_matrix(so3.exp(np.array(self.misalignment))), (len(times), 1, 1))
        if self.slip is not None:
            late = times > self.slip[0]
            mounting[late] = so3.quat_to_matrix(so3.exp(np.array(self.slip[1]))) @ mounting[late]
        turned = so3.quat_to_matrix(so3.exp(np.array([0.0, 0.0, self.heading])))
        measured = turned @ so3.quat_to_matrix(so3.exp(self.slow * slow))
        measured = measured @ rotations[:, SEGMENT_NUMBER[self.segment]] @ mounting
        stamps = START_NS + np.round(times * NANOSECONDS).astype(np.int64)
        drawn = [
            SegmentOrientation(int(stamp), f"imu_{self.segment}", self.segment, each, self.stated**2 * np.eye(3))
            for stamp, each in zip(stamps, measured, strict=True)
        ]
        if self.spin is None:
            return drawn
        step = 1e-4
        after = MODEL.forward(person.motion.configuration(times + step), person.body.lengths).rotations
        turned = rotations[:, SEGMENT_NUMBER[self.segment]].swapaxes(-1, -2) @ after[:, SEGMENT_NUMBER[self.segment]]
        rates = so3.rotation_vectors(mounting.swapaxes(-1, -2) @ turned @ mounting) / step
        rates += self.spin * rng.normal(size=rates.shape)
        return [
            replace(each, angular_velocity=rate, angular_velocity_variance=self.spin**2)
            for each, rate in zip(drawn, rates, strict=True)
        ]


def in_order(*parts: Iterable[Skeleton | SegmentOrientation]) -> list[Skeleton | SegmentOrientation]:
    return sorted((each for part in parts for each in part), key=lambda each: each.stamp_ns)


def feed(estimator: ExtendedKalmanFilter, events: Iterable[Skeleton | SegmentOrientation]) -> None:
    for each in events:
        give(estimator, each)


def give(estimator: ExtendedKalmanFilter, event: Skeleton | SegmentOrientation) -> bool:
    if isinstance(event, SegmentOrientation):
        return estimator.take_orientation(event)
    return estimator.take(event)


def followed(
    estimator: ExtendedKalmanFilter,
    events: Iterable[Skeleton | SegmentOrientation],
    person: Person,
    after: float = 2.0,
) -> tuple[FloatArray, FloatArray]:
    """Errors (n, 32) and covariances (n, 32, 32) at the frames after so many seconds."""
    errors, covariances = [], []
    for each in events:
        taken = give(estimator, each)
        if taken and isinstance(each, Skeleton) and each.stamp_ns > START_NS + after * NANOSECONDS:
            estimate = known(estimator)
            errors.append(MODEL.difference(estimate.q, person.at(estimate.stamp_ns)))
            covariances.append(estimate.covariance[: MODEL.nv, : MODEL.nv])
    return np.array(errors), np.array(covariances)


def rms(errors: FloatArray) -> float:
    return float(np.degrees(np.sqrt((errors**2).mean())))


def learnt(estimator: ExtendedKalmanFilter, source: Source) -> tuple[FloatArray, FloatArray]:
    """(4,) errors of the estimated misalignment and heading, radians, and (4, 4) their covariance."""
    state = estimator._state
    assert state is not None
    number = state.sources.find(f"imu_{source.segment}")
    assert number is not None
    right = so3.quat_to_matrix(so3.exp(np.array(source.misalignment)))
    off = so3.rotation_vectors(right @ state.sources.misalignment[number].T)
    begin = BODY + PER_SOURCE * number
    covariance = state.covariance[begin : begin + 4, begin : begin + 4]
    return np.append(off, source.heading - state.sources.heading[number]), covariance


# --- compilation


def test_no_frame_or_orientation_waits_for_the_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(orientations, "_FORGET_AFTER_NS", NANOSECONDS // 2)
    prepare()
    before = sum(len(loop.signatures) for loop in LOOPS)
    person = worn_person(1, 4.0)
    hidden = [
        replace(each, states=np.where(np.arange(N_JOINTS) < 8, 0, each.states).astype(np.uint8))
        for each in person.skeletons[50:55]
    ]
    estimator = ExtendedKalmanFilter()
    sources = [Source(segment).measure(person) for segment in ("forearm_left", "hand_right", "upper_arm_left")]
    sources[1] = sources[1][:40]  # it is forgotten
    feed(estimator, in_order(person.skeletons[:50], hidden, person.skeletons[55:], *sources))
    estimator.predict(known(estimator).stamp_ns + NANOSECONDS // 10)
    estimator.results_of(estimator.last_frame())
    assert before and sum(len(loop.signatures) for loop in LOOPS) == before


# --- equations


def known_sources(rng: np.random.Generator) -> Sources:
    sources = Sources.none()
    for segment in rng.choice(SEGMENTS, 3, replace=False):
        measurement = SegmentOrientation(0, f"imu_{segment}", str(segment), np.eye(3), 0.01 * np.eye(3))
        sources, covariance = sources.with_new(measurement, EkfParameters())
        assert np.linalg.eigvalsh(covariance)[0] > 0.0
    return sources.moved(0.5 * rng.normal(size=PER_SOURCE * 3))


def random_pose(rng: np.random.Generator) -> FloatArray:
    return MODEL.integrate(MODEL.neutral(), 0.7 * rng.normal(size=MODEL.nv))


@settings(max_examples=draws(8, 25))
@given(st.integers(0, 10**6), st.booleans())
def test_derivatives_of_an_orientation_against_differences(seed: int, corrected: bool) -> None:
    rng = np.random.default_rng(seed)
    q, sources, number = random_pose(rng), known_sources(rng), int(rng.integers(3))
    measured = so3.quat_to_matrix(so3.exp(1.5 * rng.uniform(-1.0, 1.0, 3)))
    about = 0.4 * rng.normal(size=PER_SOURCE)
    step = 1e-6

    def innovation(by_tangent: FloatArray, by_source: FloatArray) -> FloatArray:
        moved = MODEL.integrate(q, by_tangent)
        return orientation.expect(MODEL, moved, sources, number, measured, about * corrected + by_source).innovation

    lines = orientation.expect(MODEL, q, sources, number, measured, about if corrected else None)
    if np.linalg.norm(lines.innovation) > 2.8:
        return  # at half a turn the shortest way jumps
    for analytic, part in ((lines.by_tangent, 0), (lines.by_source, 1)):
        for column in range(analytic.shape[1]):
            change = [np.zeros(MODEL.nv), np.zeros(PER_SOURCE)]
            change[part][column] = step
            difference = (innovation(*change) - innovation(*(-each for each in change))) / (2.0 * step)
            assert_allclose(-analytic[:, column], difference, rtol=0.0, atol=1e-6)


def test_the_innovation_follows_the_equation() -> None:
    rng = np.random.default_rng(1)
    q, sources = random_pose(rng), known_sources(rng)
    rotation = MODEL.forward(q, MODEL.default_lengths()).rotations[sources.segments[1]]
    cross = so3.skew(np.stack([np.array([0.0, 0.0, sources.heading[1]]), sources.slow[1]]))
    measured = expm(cross[0]) @ expm(cross[1]) @ rotation @ sources.misalignment[1]
    assert_allclose(orientation.expect(MODEL, q, sources, 1, measured).innovation, 0.0, atol=1e-12)
    noise = np.array([0.1, -0.2, 0.3])
    found = orientation.expect(MODEL, q, sources, 1, expm(so3.skew(noise)) @ measured).innovation
    assert_allclose(found, noise, rtol=0.0, atol=1e-12)


def test_time_passes_over_the_covariance_of_sources_as_by_its_equation() -> None:
    rng = np.random.default_rng(2)
    sources, dt, size = known_sources(rng), 0.3, 5 + 3 * PER_SOURCE
    root = rng.normal(size=(size, size))
    before = root @ root.T
    transition, noise = np.eye(size), np.zeros((size, size))
    for number in range(3):
        begin = 5 + PER_SOURCE * number
        slow = slice(begin + 4, begin + 7)
        transition[slow, slow] *= np.exp(-dt / orientation.TISSUE_TIME)
        noise[slow, slow] = (1.0 - np.exp(-2.0 * dt / orientation.TISSUE_TIME)) * sources.slow_variance[number]
        walks = [*[orientation.MISALIGNMENT_DENSITY] * 3, orientation.HEADING_DENSITY]
        noise[range(begin, begin + 4), range(begin, begin + 4)] = dt * np.array(walks)
    after = before.copy()
    share = orientation.advance(after, 5, sources, dt)
    assert share == pytest.approx(np.exp(-dt / orientation.TISSUE_TIME))
    assert_allclose(after, transition @ before @ transition.T + noise, rtol=1e-12, atol=1e-12)


def test_a_sources_variances_follow_its_stated_covariance() -> None:
    first = SegmentOrientation(0, "a", "head", np.eye(3), np.diag([1e-3, 3e-3, 0.03]))
    p = EkfParameters()
    sources, covariance = Sources.none().with_new(first, p)
    aligned = p.misalignment_stddev**2 + 2e-3
    assert_allclose(covariance.diagonal()[:4], [aligned, aligned, aligned, 0.03])
    # only a few degrees of the error vary
    assert (np.diag(sources.slow_variance[0]) <= 2.0 * p.tissue_stddev**2 + 1e-12).all()
    assert sources.restated(0, replace(first, stamp_ns=1), p) is None
    # the stated variance of the heading grows: drift
    drifted = sources.restated(0, replace(first, covariance=np.diag([1e-3, 3e-3, 0.1])), p)
    assert drifted is not None
    known, left, new = drifted
    assert_allclose(left, 1.0)
    assert_allclose(new, [0.0, 0.0, 0.0, 0.07])
    assert known.restated(0, replace(first, covariance=np.diag([1e-3, 3e-3, 0.1])), p) is None
    # it shrinks: the source has corrected its heading; without other information the variance is the stated one
    known = known.moved(np.array([0.0, 0.0, 0.0, 0.2, 0.0, 0.0, 0.0]))
    corrected = known.restated(0, replace(first, covariance=np.diag([1e-3, 3e-3, 0.02])), p)
    assert corrected is not None
    known, left, new = corrected
    assert_allclose(left[3] ** 2 * 0.1 + new[3], 0.02)
    assert known.heading[0] == pytest.approx(0.2 * 0.02 / 0.1)


# --- in the filter


def test_the_forearms_rotation_is_found_where_points_cannot_tell() -> None:
    person = worn_person(1, 2.5, 0.001, HANDS)
    sources = [Source(segment, stated=1e-3) for segment in FOREARMS]
    blind, seeing = ExtendedKalmanFilter(PERFECT), ExtendedKalmanFilter(PERFECT)
    by_points, _ = followed(blind, person.skeletons, person, 1.5)
    with_orientations, _ = followed(
        seeing, in_order(person.skeletons, *(source.measure(person) for source in sources)), person, 1.5
    )
    assert rms(by_points[:, PRONATION]) > 15.0
    assert rms(with_orientations[:, PRONATION]) < 1.0


def test_a_misalignment_is_found_over_movement_and_its_covariance_covers_it() -> None:
    person = worn_person(2, 9.0, 0.01)
    source = Source("upper_arm_left", (0.15, -0.15, 0.15), 0.1)  # 15 degrees
    p = EkfParameters(misalignment_stddev=0.14, heading_stddev=0.17)
    estimator = ExtendedKalmanFilter(p)
    feed(estimator, in_order(person.skeletons, source.measure(person)))
    error, covariance = learnt(estimator, source)
    first = np.array([*[p.misalignment_stddev] * 3, p.heading_stddev])
    assert np.linalg.norm(error[:3]) < np.radians(5.0) and abs(error[3]) < np.radians(5.0)
    assert (np.sqrt(covariance.diagonal()) < 0.6 * first).all()
    assert error @ np.linalg.solve(covariance, error) < 18.5  # chi-square with 4 degrees of freedom, 0.999


def test_an_unobserved_misalignment_keeps_its_deviation() -> None:
    """Without hands, a forearm's misalignment about its own axis cannot be distinguished from its rotation."""
    person = worn_person(3, 4.5, 0.01, HANDS)
    source = Source("forearm_left", (0.1, 0.05, 0.2))
    p = EkfParameters(misalignment_stddev=0.14)
    estimator = ExtendedKalmanFilter(p)
    feed(estimator, in_order(person.skeletons, source.measure(person)))
    _, covariance = learnt(estimator, source)
    stddev = np.sqrt(covariance.diagonal()[:3])
    assert (stddev[:2] < 0.5 * p.misalignment_stddev).all()
    assert stddev[2] > 0.7 * p.misalignment_stddev


ALL_BUT_HANDS = ("pelvis", "upper_trunk", "head", "upper_arm_left", "forearm_left", "upper_arm_right", "forearm_right")


def still(posture: dict[str, float], seconds: float, until: dict[str, float] | None = None) -> list[SegmentOrientation]:
    """Seven exact sources, which state 0.2 rad, on a person who does not move; ``until`` ends some of them, seconds."""
    step = np.zeros(MODEL.nv)
    step[[NAMES.index(name) for name in posture]] = np.radians(list(posture.values()))
    rotations = MODEL.forward(MODEL.integrate(MODEL.neutral(), step), MODEL.default_lengths()).rotations
    return [
        SegmentOrientation(
            START_NS + round((time + 0.003 * number) * NANOSECONDS),
            f"imu_{segment}",
            segment,
            rotations[SEGMENT_NUMBER[segment]],
            0.2**2 * np.eye(3),
        )
        for time in np.arange(0.0, seconds, 0.1)
        for number, segment in enumerate(ALL_BUT_HANDS)
        if time < (until or {}).get(segment, np.inf)
    ]


def test_posture_causes_no_error_of_the_sources() -> None:
    """A prior has the same error each time, and must not turn segments that are measured (before: 13 degrees)."""
    posture = {"lumbar_flexion": 30.0, "thoracic_flexion": 15.0, "lumbar_axial": 12.0, "clavicle_elevation_left": 20.0}
    estimator = ExtendedKalmanFilter()
    events = still(posture, 12.0)
    feed(estimator, events)
    estimate = known(estimator)
    found = MODEL.forward(estimate.q, MODEL.default_lengths()).rotations
    said = {each.segment: each.rotation for each in events}
    for segment, rotation in said.items():
        off = so3.rotation_vectors(rotation.T @ found[SEGMENT_NUMBER[segment]])
        assert np.linalg.norm(off) < np.radians(6.0), segment


def test_posture_shares_a_bend_between_measured_segments_and_does_not_turn_these() -> None:
    """Pelvis and chest are measured: the prior shares the rotation between them among lumbar and thoracic joints."""
    events = [
        each
        for each in still({"lumbar_flexion": 30.0, "thoracic_flexion": 0.0}, 4.0)
        if each.segment in ("pelvis", "upper_trunk")
    ]
    estimator = ExtendedKalmanFilter()
    feed(estimator, events)
    q = known(estimator).q
    found = MODEL.forward(q, MODEL.default_lengths()).rotations
    for each in events[-2:]:
        off = so3.rotation_vectors(each.rotation.T @ found[SEGMENT_NUMBER[each.segment]])
        assert np.linalg.norm(off) < np.radians(2.0), each.segment
    flexion = {name: q[MODEL.scalar_q[MODEL.scalar_v == NAMES.index(name)][0]] for name in NAMES if "flexion" in name}
    lumbar, thoracic = (STDDEV[f"{part}_flexion"] ** 2 for part in ("lumbar", "thoracic"))
    share = flexion["lumbar_flexion"] / (flexion["lumbar_flexion"] + flexion["thoracic_flexion"])
    assert abs(share - lumbar / (lumbar + thoracic)) < 0.1


def test_ranges_bound_the_deviation_after_a_source_falls_silent() -> None:
    estimator = ExtendedKalmanFilter()
    feed(estimator, still({"elbow_flexion_right": 60.0}, 9.0, {"forearm_right": 4.0}))
    estimate = known(estimator)
    elbow = NAMES.index("elbow_flexion_right")
    deviation = np.sqrt(estimate.covariance[elbow, elbow])
    assert np.radians(20.0) < deviation < 1.5 * PosturePrior(MODEL, Ranges(MODEL)).stddev[elbow - 6]


@pytest.mark.parametrize("turn", some([(0.0, 0.0, 0.35), (0.35, 0.0, 0.0)]))
def test_a_sensor_that_slips_leaves_the_angles_sound(turn: tuple[float, float, float]) -> None:
    person = worn_person(4, 7.0, 0.01)
    source = Source("upper_arm_right", slip=(3.5, turn))
    estimator = ExtendedKalmanFilter()
    errors, covariances = followed(estimator, in_order(person.skeletons, source.measure(person)), person, 3.5)
    arm = [k for k, name in enumerate(NAMES) if name.endswith("_right") and name.startswith(("shoulder", "elbow"))]
    size = np.abs(errors[:, arm])
    stddev = np.sqrt(covariances[:, arm, arm])
    sound = (size < np.radians(10.0)) | (size < 2.0 * stddev)
    assert sound.mean() > 0.97


def test_a_camera_corrects_a_sources_direction_but_not_its_axial_rotation() -> None:
    q = MODEL.neutral()
    q[MODEL.scalar_q[[NAMES[v].startswith("elbow") for v in MODEL.scalar_v]]] = np.radians(16.0)
    posture = MODEL.forward(q, MODEL.default_lengths())
    positions = np.full((25, 3), np.nan)
    positions[MODEL.joints] = posture.positions
    forearm = posture.rotations[SEGMENT_NUMBER["forearm_right"]]
    estimator, tracked = ExtendedKalmanFilter(), np.full(25, 2, np.uint8)

    def said() -> FloatArray:
        sources = estimator._state.sources  # type: ignore[union-attr]
        turn = so3.quat_to_matrix(so3.exp(np.array([[0.0, 0.0, sources.heading[0]], sources.slow[0]])))
        return np.asarray(turn[0] @ turn[1] @ forearm @ sources.misalignment[0])

    taught = np.zeros(3)
    for k in range(30):
        stamp_ns = START_NS + k * NANOSECONDS // 30
        if k == 20:  # a Kinect v2 displaces the elbow of a hanging arm
            positions[Joint.ELBOW_RIGHT] += [0.05, -0.03, 0.0]
        before = said() if k >= 20 else None
        estimator.take(Skeleton(stamp_ns, "world", positions, tracked))
        if before is not None:
            taught += np.abs(so3.rotation_vectors(before.T @ said()))
        estimator.take_orientation(
            SegmentOrientation(stamp_ns + 5_000_000, "imu", "forearm_right", forearm, 0.03**2 * np.eye(3))
        )
    assert taught[2] < 0.2 * np.hypot(*taught[:2])


def turned_away(person: Person, begin: float, end: float) -> list[Skeleton]:
    """Frames that have left and right swapped for some time, as of a person who turned the back to a camera."""
    return [
        each.mirrored() if begin < (each.stamp_ns - START_NS) / NANOSECONDS < end else each for each in person.skeletons
    ]


def test_inertial_sensors_keep_the_heading_of_a_body_that_a_camera_reverses() -> None:
    person = worn_person(3, 2.7)
    worn = Source("forearm_left", (0.05, 0.0, 0.1), 0.1, 0.05)
    estimator = ExtendedKalmanFilter()
    errors, covariances = followed(
        estimator, in_order(turned_away(person, 1.5, 2.5), worn.measure(person)), person, 1.5
    )
    assert estimator.counters["sides_swapped"] > 24
    assert np.degrees(np.abs(errors[:, 5]).max()) < 15.0
    unturned, _ = followed(ExtendedKalmanFilter(), in_order(person.skeletons, worn.measure(person)), person, 1.5)
    assert rms(errors[:, 3:6]) < 1.5 * rms(unturned[:, 3:6])
    assert np.linalg.eigvalsh(covariances[-1])[0] > 0.0

    # with the camera alone the swap is not detected
    alone = ExtendedKalmanFilter()
    errors, _ = followed(alone, turned_away(person, 1.5, 2.5), person, 1.5)
    assert alone.counters["sides_swapped"] == 0
    assert np.degrees(np.abs(errors[:, 5]).max()) > 90.0


TURNED_ROUND = 0.035
"""Share of people who are still tracked turned round 8 s after their first second was seen with left and right swapped:
7 of 200 seeds. A defect of the filter: it should be none."""


@pytest.mark.slow
def test_filter_that_began_turned_round_recovers_in_most_cases() -> None:
    """The share that stays turned round is no larger than the known one; two people are too few to show that."""
    count = draws(20, 200)
    turned = 0
    for seed in range(count):
        person = worn_person(seed, 8.0)
        worn = [Source(f"forearm_{side}", (0.02, 0.0, 0.02)) for side in ("left", "right")]
        events = in_order(turned_away(person, -1.0, 1.0), *(each.measure(person) for each in worn))
        errors, _ = followed(ExtendedKalmanFilter(), events, person, 7.9)
        turned += bool(np.degrees(np.abs(errors[-1, 5])) > 90.0)
    assert turned <= binom.ppf(0.999, count, TURNED_ROUND), turned


def test_a_doubt_about_the_sides_fades_with_time_and_not_with_frames() -> None:
    """Otherwise it would fade faster with more cameras."""
    estimator, person = ExtendedKalmanFilter(), worn_person(3, 1.0)
    followed(estimator, person.skeletons, person)
    state = estimator._state
    assert state is not None
    doubted, after_ns = state.but(doubt=5.0), state.stamp_ns + NANOSECONDS // 4
    stepped = doubted
    for stamp_ns in np.linspace(state.stamp_ns, after_ns, 9, dtype=np.int64)[1:]:
        stepped = estimator._motion.predicted(stepped, int(stamp_ns))
    assert 1.0 < stepped.doubt < 4.0
    assert stepped.doubt == pytest.approx(estimator._motion.predicted(doubted, after_ns).doubt)


def arm_bent_to_the_wrong_side(seconds: float) -> list[Skeleton]:
    """A camera's skeletons of a straight right arm, held out to the side, with the elbow bent to the wrong side."""
    seen = out_to_the_side(elbow=25.0, twist=125.0)
    positions = np.full((25, 3), np.nan)
    positions[MODEL.joints] = MODEL.forward(seen, MODEL.default_lengths()).positions
    rng, tracked = np.random.default_rng(14), np.full(25, 2, np.uint8)
    covariances = np.tile(0.04**2 * np.eye(3), (25, 1, 1))  # as by a sensor that states its errors
    return [
        Skeleton(
            START_NS + k * NANOSECONDS // 30,
            "world",
            positions + 0.003 * rng.normal(size=(25, 3)),
            tracked,
            0,
            covariances,
        )
        for k in range(round(30 * seconds))
    ]


def out_to_the_side(elbow: float, twist: float) -> FloatArray:
    """(35,) a right arm that is straight but for so many degrees, and turned about itself by so many."""
    q = MODEL.neutral()
    turns = so3.exp(np.radians([[-85.0, 0.0, 0.0], [0.0, 0.0, twist]]))
    q[MODEL.quaternion_of("upper_arm_right")] = so3.quat_multiply(turns[0], turns[1])
    q[MODEL.scalar_q[[NAMES[v] == "elbow_flexion_right" for v in MODEL.scalar_v]]] = np.radians(elbow)
    return q


@pytest.mark.parametrize(
    "after",
    [
        pytest.param(0.1, id="from the start"),
        pytest.param(3.0, id="after seconds of the camera alone", marks=pytest.mark.slow),
    ],
)
def test_an_inertial_sensor_decides_the_axial_rotation_of_an_upper_arm(after: float) -> None:
    truth = out_to_the_side(elbow=5.0, twist=0.0)
    rotation = MODEL.forward(truth, MODEL.default_lengths()).rotations[SEGMENT_NUMBER["upper_arm_right"]]
    frames = arm_bent_to_the_wrong_side(after + 3.0)
    begin = START_NS + round(after * NANOSECONDS)
    said = [
        SegmentOrientation(stamp, "imu", "upper_arm_right", rotation, np.radians(8.0) ** 2 * np.eye(3))
        for stamp in range(begin, frames[-1].stamp_ns, NANOSECONDS // 50)
    ]
    estimator = ExtendedKalmanFilter()
    feed(estimator, in_order(frames, said))
    assert estimator.counters["slips"] == 0
    estimate = known(estimator)
    found = MODEL.forward(estimate.q, estimate.lengths).rotations[SEGMENT_NUMBER["upper_arm_right"]]
    off = so3.rotation_vectors(rotation.T @ found)
    stddev = np.sqrt(estimate.covariance[MODEL.ball_v[-1, 2], MODEL.ball_v[-1, 2]])
    assert abs(off[2]) < max(np.radians(15.0), 2.0 * stddev)


def test_first_rejections_of_a_new_source_are_no_slip() -> None:
    person = worn_person(15, 1.0, 0.01)
    far = Source("forearm_left", misalignment=(1.2, 0.0, 0.0)).measure(person)
    estimator = ExtendedKalmanFilter(EkfParameters(orientation_rate=50.0))
    soon = START_NS + round(0.8 * orientations._SLIP_AFTER * NANOSECONDS)
    events = in_order(person.skeletons, far)
    feed(estimator, [each for each in events if each.stamp_ns < soon])
    assert estimator.counters["orientations_rejected"] > 5
    assert estimator.counters["slips"] == 0
    feed(estimator, [each for each in events if each.stamp_ns >= soon])
    assert estimator.counters["slips"] == 1


@pytest.mark.parametrize("spin", some([0.05, None]), ids=str)
def test_covariance_holds_under_correlated_errors(spin: float | None) -> None:
    observed = np.array([k for k, name in enumerate(NAMES) if name not in UNOBSERVED and k >= 6])
    p, normalised = EkfParameters(), []
    for seed in range(draws(1, 3)):
        rng = np.random.default_rng([seed, 8])
        person = worn_person(30 + seed, 4.0)
        sources = [
            Source(
                segment,
                tuple(p.misalignment_stddev * rng.normal(size=3)),
                p.heading_stddev * rng.normal(),
                float(np.hypot(p.tissue_stddev, 0.01)),
                orientation.TISSUE_TIME,
                spin=spin,
            )
            for segment in (*FOREARMS, "upper_trunk")
        ]
        events = in_order(person.skeletons, *(source.measure(person, seed) for source in sources))
        errors, covariances = followed(ExtendedKalmanFilter(), events, person, 1.0)
        for error, covariance in zip(errors[:, observed], covariances[:, observed][:, :, observed], strict=True):
            normalised.append(error @ np.linalg.solve(covariance, error))
    assert 0.5 < np.mean(normalised) / len(observed) < 1.6, np.mean(normalised) / len(observed)


def displaced(seed: int, segments: Sequence[str]) -> tuple[ExtendedKalmanFilter, FloatArray]:
    """The filter of a person whose joint centres are off as the camera states, and the true (35,) configuration.

    The sensors on the segments have the errors that they state.
    """
    rng = np.random.default_rng([seed, 9])
    person = worn_person(300 + seed, 2.0, 0.004)
    offsets = BASE_STDDEV[:, None] * (np.linalg.cholesky(joint_correlation()) @ rng.normal(size=(N_JOINTS, 3)))
    stated = np.broadcast_to(np.diag([0.03**2] * 3), (N_JOINTS, 3, 3))
    frames = [replace(each, positions=each.positions + offsets, covariances=stated) for each in person.skeletons]
    p = EkfParameters(posture=False)
    sources = [
        Source(
            segment,
            tuple(p.misalignment_stddev * rng.normal(size=3)),
            p.heading_stddev * rng.normal(),
            p.tissue_stddev,
        )
        for segment in segments
    ]
    estimator = ExtendedKalmanFilter(p)
    feed(estimator, in_order(frames, *(source.measure(person, seed) for source in sources)))
    return estimator, person.at(known(estimator).stamp_ns)


def test_offsets_of_joint_centres_turn_a_measured_segment_less() -> None:
    arm = [
        NAMES.index(name) for name in ("shoulder_x_left", "shoulder_y_left", "shoulder_z_left", "elbow_flexion_left")
    ]
    inside = []
    people = draws(3, 30)
    for seed in range(people):
        estimator, true = displaced(seed, ("upper_arm_left", "forearm_left"))
        estimate, state = known(estimator), estimator._state
        error = MODEL.difference(estimate.q, true)
        inside.append(np.abs(error) < norm.ppf(0.975) * np.sqrt(estimate.covariance.diagonal()[: MODEL.nv]))
        assert state is not None
        silent = state.sources._but(stamps=state.sources.stamps - NANOSECONDS)
        by_points, by_both = (estimator._displacement.displaced(each)[0] for each in (state.but(sources=silent), state))
        turning = estimator._space.model.linearised(state.q, state.lengths).rotation_jacobian[state.sources.segments]
        for rows in turning:
            left, whole = (rows @ each[: MODEL.nv, : MODEL.nv] @ rows.T for each in (by_both, by_points))
            assert 0.0 < np.trace(left) < 0.8 * np.trace(whole), np.trace(left) / np.trace(whole)
    # the coordinates of a person are not independent: at least as many cover as of `people` that are
    assert np.mean(inside, axis=0)[arm].mean() >= binom.ppf(0.001, people, 0.95) / people


def test_a_bent_trunk_stays_as_measured_after_the_camera_has_stopped() -> None:
    """The prior that draws a spine upright would turn it, and the sensors' misalignments would follow."""
    bend = np.zeros(MODEL.nv)
    bend[[NAMES.index("lumbar_flexion"), NAMES.index("thoracic_flexion")]] = np.radians([40.0, 20.0])
    stated = np.broadcast_to(np.diag([0.03**2] * 3), (N_JOINTS, 3, 3))
    rng = np.random.default_rng(0)
    states = np.zeros(N_JOINTS, dtype=np.uint8)
    states[MODEL.joints] = TrackingState.TRACKED
    estimator = ExtendedKalmanFilter()
    trunk = [SEGMENT_NUMBER[segment] for segment in ("pelvis", "upper_trunk")]
    for time in np.arange(0.0, 7.0, 1.0 / 30.0):
        pose = MODEL.forward(
            MODEL.integrate(MODEL.neutral(), np.clip(time - 1.0, 0.0, 1.0) * bend), MODEL.default_lengths()
        )
        stamp_ns = START_NS + round(time * NANOSECONDS)
        if time < 3.0:
            positions = np.full((N_JOINTS, 3), np.nan)
            positions[MODEL.joints] = pose.positions + 0.004 * rng.normal(size=pose.positions.shape)
            estimator.take(Skeleton(stamp_ns, "world", positions, states, 0, stated))
        for number in trunk:
            segment = SEGMENTS[number]
            estimator.take_orientation(
                SegmentOrientation(stamp_ns, f"imu_{segment}", segment, pose.rotations[number], 0.05**2 * np.eye(3))
            )
    found = MODEL.forward(known(estimator).q, MODEL.default_lengths()).rotations[trunk]
    off = so3.rotation_vectors(pose.rotations[trunk].swapaxes(-1, -2) @ found)
    assert (np.linalg.norm(off, axis=1) < np.radians(5.0)).all(), np.degrees(off)


# --- angular velocities


def test_angular_velocities_correct_velocities_and_nothing_else() -> None:
    person = worn_person(15, 2.0)
    measured = Source("forearm_left", (0.05, 0.0, 0.1), spin=0.05).measure(person)
    estimator = ExtendedKalmanFilter()
    feed(estimator, in_order(person.skeletons, [replace(each, angular_velocity=None) for each in measured]))
    without = estimator._state
    assert without is not None
    own = slice(BODY, BODY + PER_SOURCE)
    quicker = replace(measured[-1], angular_velocity=measured[-1].angular_velocity + 0.1)
    with_rates = ExtendedKalmanFilter()
    found = with_rates._orientations._spun_by(without, quicker, 0, own)
    assert_allclose(found.q, without.q, rtol=0.0, atol=0.0)
    assert_allclose(found.sources.misalignment, without.sources.misalignment, rtol=0.0, atol=0.0)
    assert np.abs(found.velocity - without.velocity).max() > 0.01
    before, after = (np.sqrt(state.covariance.diagonal()) for state in (without, found))
    velocities = with_rates._space.velocities
    moved = [NAMES.index(name) for name in ("elbow_flexion_left", "forearm_pronation_left")]
    assert (after[velocities][moved] < 0.9 * before[velocities][moved]).all()
    rest = np.ones(len(before), dtype=np.bool_)
    rest[velocities] = False
    assert_allclose(after[rest], before[rest], rtol=1e-9)
    assert np.linalg.eigvalsh(found.covariance).min() > -1e-12


def test_how_quickly_joints_turn_is_known_better_by_rates() -> None:
    observed = [NAMES.index(name) for name in ("elbow_flexion_left", "forearm_pronation_left")]
    errors = np.empty((draws(1, 6), 2))
    for number in range(len(errors)):
        person = worn_person(16 + number, 2.5, tempo=3.0)
        for place, spin in enumerate((None, 0.05)):
            sources = [Source(segment, spin=spin, rate=30.0) for segment in ("forearm_left", "upper_arm_left")]
            estimator, off = ExtendedKalmanFilter(), []
            for each in in_order(person.skeletons, *(source.measure(person) for source in sources)):
                if give(estimator, each) and isinstance(each, Skeleton):
                    estimate = known(estimator)
                    step = NANOSECONDS // 1000
                    true = 1e3 * MODEL.difference(person.at(estimate.stamp_ns), person.at(estimate.stamp_ns + step))
                    off.append((estimate.velocity - true)[observed])
            errors[number, place] = rms(np.array(off[30:]))
    without, by_rates = errors.mean(axis=0)
    assert by_rates < 0.9 * without, errors


def test_a_rate_that_cannot_be_is_left_out_and_counted() -> None:
    person = worn_person(17, 2.0)
    orientations = Source("forearm_left", spin=0.05).measure(person)
    wild = [
        replace(each, angular_velocity=np.array([50.0, -40.0, 30.0])) if k % 7 == 5 else each
        for k, each in enumerate(orientations)
    ]
    estimates = []
    for fed in (orientations, wild):
        estimator = ExtendedKalmanFilter()
        errors, _ = followed(estimator, in_order(person.skeletons, fed), person, 1.0)
        estimates.append(rms(errors))
    assert estimator.counters["rates_rejected"] > 5
    assert estimates[1] < 1.1 * estimates[0]


# --- time


def two_sources() -> list[Skeleton | SegmentOrientation]:
    person = worn_person(5, 1.3)
    sources = [Source(segment, (0.05, 0.0, 0.1), 0.1, 0.05) for segment in ("forearm_left", "head")]
    return in_order(person.skeletons, *(source.measure(person) for source in sources))


def test_the_order_of_arrival_does_not_matter() -> None:
    events = two_sources()
    rng = np.random.default_rng(6)
    late = rng.uniform(0.0, 0.15, len(events)) * (rng.random(len(events)) < 0.4)
    late[:40] = 0.0
    arrival = [each.stamp_ns + delay * NANOSECONDS for each, delay in zip(events, late, strict=True)]
    one, other = ExtendedKalmanFilter(), ExtendedKalmanFilter()
    feed(one, events)
    feed(other, [events[k] for k in np.argsort(arrival, kind="stable")])
    assert (
        other.counters["orientations_late"] > 20
        and other.counters["late_frames"] > 0
        and other.counters["too_late"] == 0
    )
    assert_same(known(one), known(other), 1e-9)


def test_orientations_that_are_taken_before_a_frame_needs_them_make_no_difference() -> None:
    events = two_sources()
    # orientations come some milliseconds after frames of the same time
    arrival = [each.stamp_ns + (0 if isinstance(each, Skeleton) else 6_000_000) for each in events]
    events = [events[k] for k in np.argsort(arrival, kind="stable")]
    one, other = ExtendedKalmanFilter(), ExtendedKalmanFilter()
    waited = {one: 0, other: 0}
    for estimator in waited:
        frame_ns = 0
        for each in events:
            if isinstance(each, Skeleton) and estimator._last is not None:
                frame_ns = each.stamp_ns
                waited[estimator] += sum(isinstance(late, SegmentOrientation) for late in estimator._late)
            give(estimator, each)
            if estimator is other:
                estimator.settle(frame_ns + 31_000_000)
    assert 0 < waited[other] < 0.5 * waited[one]
    # not more than once for each frame
    assert other.counters["taken_again"] < 1.5 * one.counters["taken_again"]
    assert_same(known(one), known(other), 1e-9)


def test_orientations_of_one_stamp_count_alike_in_any_order() -> None:
    person = worn_person(6, 1.5)
    results = []
    for order in (1, -1):
        estimator = ExtendedKalmanFilter()
        for skeleton in person.skeletons:
            at = skeleton.stamp_ns
            rotations = MODEL.forward(person.at(at), person.body.lengths).rotations
            measured = [
                SegmentOrientation(at, name, name, rotations[SEGMENT_NUMBER[name]], 1e-4 * np.eye(3))
                for name in ("pelvis", "forearm_left", "hand_right")
            ]
            if estimator.estimate is None:
                estimator.take(skeleton)
            else:
                feed(estimator, [skeleton, *measured][::order])
        assert estimator.counters["orientations_used"] > 90
        results.append(known(estimator))
    assert_allclose(results[0].q, results[1].q, rtol=0.0, atol=1e-9)
    assert_allclose(results[0].covariance, results[1].covariance, rtol=0.0, atol=1e-9)


def test_ignored_orientations_are_counted() -> None:
    person = worn_person(7, 2.5)
    events = in_order(person.skeletons, Source("forearm_left").measure(person))
    estimator = ExtendedKalmanFilter()
    feed(estimator, events)
    last = next(each for each in reversed(events) if isinstance(each, SegmentOrientation))
    before = known(estimator)
    used = estimator.counters["orientations_used"]
    assert not estimator.take_orientation(last)
    assert estimator.counters["repeated_stamps"] == 1
    assert not estimator.take_orientation(replace(last, stamp_ns=last.stamp_ns - NANOSECONDS, source="other"))
    assert estimator.counters["too_late"] == 1
    assert not estimator.take_orientation(replace(last, stamp_ns=last.stamp_ns + 1, frame_id="elsewhere"))
    assert not estimator.take_orientation(replace(last, stamp_ns=last.stamp_ns + 100 * NANOSECONDS))
    assert estimator.counters["orientations_refused"] == 2
    assert_same(known(estimator), before, 0.0)
    assert estimator.counters["orientations_used"] == used


def test_a_fast_source_counts_no_more_often_than_it_may() -> None:
    person = worn_person(8, 1.6)
    estimator = ExtendedKalmanFilter(EkfParameters(orientation_rate=20.0))
    feed(estimator, in_order(person.skeletons, Source("head", rate=400.0).measure(person)))
    assert estimator.counters["orientations"] > 550
    assert 20 < estimator.counters["orientations_used"] < 40


@pytest.mark.parametrize(("name", "silent"), [("imu_forearm_left", 1.0), ("imu_head", 0.0)], ids=["another", "moved"])
def test_a_source_that_is_silent_for_long_or_moves_to_another_segment_is_forgotten(
    name: str, silent: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(orientations, "_FORGET_AFTER_NS", (1 if silent else 100) * NANOSECONDS)
    person = worn_person(9, 3.4)
    turn = START_NS + NANOSECONDS
    early = [each for each in Source("head").measure(person) if each.stamp_ns < turn]
    late = [
        replace(each, source=name)
        for each in Source("forearm_left").measure(person)
        if each.stamp_ns > turn + round(silent * NANOSECONDS)
    ]
    estimator = ExtendedKalmanFilter()
    feed(estimator, in_order(person.skeletons, early, late))
    state = estimator._state
    assert state is not None and state.sources.names == (name,)
    assert state.sources.segments.tolist() == [SEGMENT_NUMBER["forearm_left"]]
    assert state.covariance.shape == (BODY + PER_SOURCE, BODY + PER_SOURCE)
    assert state.crosses.shape[0] == BODY + PER_SOURCE


# --- without a camera


def test_a_pose_is_found_from_orientations() -> None:
    """Except for the pull of the ranges' centres and of the upright posture."""
    person = worn_person(10, 1.0)
    posture = MODEL.forward(person.truth.q[0], person.body.lengths)
    measured = [
        SegmentOrientation(0, name, name, rotation, 1e-4 * np.eye(3))
        for name, rotation in zip(SEGMENTS, posture.rotations, strict=True)
    ]
    q = orientation.pose_of(MODEL, Ranges(MODEL), measured)
    found = MODEL.forward(q, person.body.lengths).rotations
    off = so3.rotation_vectors(found @ posture.rotations.swapaxes(-1, -2))
    assert np.degrees(np.linalg.norm(off, axis=-1)).max() < 10.0
    assert_allclose(q[:3], 0.0, atol=1e-9)


def test_orientations_alone_give_the_angles_and_an_unknown_place() -> None:
    person = worn_person(11, 3.0)
    segments = ("pelvis", "upper_trunk", "head", *FOREARMS, "upper_arm_left", "upper_arm_right")
    estimator = ExtendedKalmanFilter(PERFECT)
    events = in_order(*(Source(segment, stated=1e-3).measure(person) for segment in segments))
    errors = []
    for each in events:
        assert isinstance(each, SegmentOrientation)
        if estimator.take_orientation(each) and each.stamp_ns > START_NS + 2 * NANOSECONDS:
            estimate = known(estimator)
            errors.append(MODEL.difference(estimate.q, person.at(estimate.stamp_ns)))
    arms = [k for k, name in enumerate(NAMES) if name.startswith(("elbow", "forearm"))]
    assert len(errors) > 150
    assert rms(np.array(errors)[:, arms]) < 3.0
    estimate = known(estimator)
    assert (np.sqrt(estimate.covariance.diagonal()[:3]) > 50.0).all()
    assert_allclose(estimate.q[:3], 0.0, atol=1e-3)
    output = estimator.filtered
    assert output is not None and output.covariances is not None
    assert (np.linalg.eigvalsh(output.covariances[MODEL.joints])[:, -1] > 50.0**2).all()
    assert estimator.predict(estimate.stamp_ns + NANOSECONDS) is not None


def test_a_camera_that_comes_later_places_the_body() -> None:
    person = worn_person(12, 3.0)
    frames = [each for each in person.skeletons if each.stamp_ns > START_NS + 1.5 * NANOSECONDS]
    sources = [Source(segment, stated=0.01) for segment in ("pelvis", *FOREARMS)]
    estimator = ExtendedKalmanFilter()
    events = in_order(frames, *(source.measure(person) for source in sources))
    errors, covariances = followed(estimator, events, person, 2.0)
    assert len(errors) > 25
    assert np.abs(errors[:, :3]).max() < 0.1
    assert np.sqrt(covariances[:, :3, :3].diagonal(axis1=1, axis2=2)).max() < 0.1
    assert estimator._state is not None and len(estimator._state.sources) == 3
