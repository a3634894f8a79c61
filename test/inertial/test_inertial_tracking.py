"""The inertial tracker has consistent covariances, reports problems, and recovers."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from worn_people import FOREARMS, MODEL, Fed, feed, recorded, sensor

from body_tracking.core import so3
from body_tracking.core.body_model import SEGMENTS
from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.imu import ImuSample
from body_tracking.core.orientation import SegmentOrientation
from body_tracking.core.skeleton import NANOSECONDS, FloatArray, Joint, Skeleton, TrackingState
from body_tracking.inertial.alignment import pose_rotations
from body_tracking.inertial.mounting import mountings
from body_tracking.inertial.parameters import TrackingParameters
from body_tracking.inertial.simulated import Slip
from body_tracking.inertial.stage import ImuStage
from body_tracking.inertial.tracking import InertialTracker, InertialTrackingError, TrackerOutput
from body_tracking.inertial.worn import ReceiptClock, WornSensor
from body_tracking.simulation.scene import START_NS
from draws import draws

SECONDS = 22.0
"""Duration of recordings of people who reach out in all directions: about the shortest that works."""
WORN = ("upper_trunk", "upper_arm_left", "forearm_left", "upper_arm_right", "forearm_right")
STILL = np.zeros(3)


def covered(fed: Fed, segment: str, since: float) -> FloatArray:
    """(n,) whether an orientation is within 10 degrees, or within two of its deviations."""
    error, stddev = fed.errors(segment, since)
    assert len(error) > 50
    return np.asarray(((np.abs(error) < np.radians(10.0)) | (np.abs(error) < 2.0 * stddev)).all(axis=1), float)


def lines(fed: Fed, since: float = 0.0, until: float = np.inf) -> set[str]:
    return {line for now, line in fed.named if since <= now <= until}


@pytest.fixture(scope="module")
def wrists() -> Iterator[Fed]:
    imus = sensor("forearm_left"), sensor("forearm_right")
    yield feed(recorded("forearm_rolling", imus, 13.0, seed=3), TrackingParameters(rate=10.0))


def test_orientations_of_two_forearms_with_a_camera_are_within_their_stated_deviation(wrists: Fed) -> None:
    for segment in FOREARMS:
        assert covered(wrists, segment, 4.0).mean() > 0.95
        error, _ = wrists.errors(segment, 4.0)
        # pronation turns by 150 degrees in this movement; the error is hardly more than the alignment's own
        assert np.degrees(np.sqrt((error**2).mean())) < 12.0
    assert wrists.tracker.counters["alignments by a pose"] == 1
    assert "T-pose" in wrists.tracker.align()
    assert not {line for line in lines(wrists, 6.0) if line}


def test_orientations_have_the_cameras_clock_correct_rates_and_at_most_the_requested_frequency(wrists: Fed) -> None:
    for segment in FOREARMS:
        published = [each for each in wrists.orientations if each.segment == segment]
        steps = np.diff([each.stamp_ns for each in published]) / NANOSECONDS
        # every second one of 50 readings per second is published: at most 30 per second
        assert (steps > 0.8 / TrackingParameters().orientation_rate).all()
        assert np.median(steps) == pytest.approx(2.0 / 50.0, rel=0.1)
        # the rate is that at which the orientation changes
        before, after = published[len(published) // 2 : len(published) // 2 + 2]
        turned = so3.rotation_vectors(before.rotation.T @ after.rotation)
        assert before.angular_velocity is not None
        expected = before.angular_velocity * (after.stamp_ns - before.stamp_ns) / NANOSECONDS
        np.testing.assert_allclose(turned, expected, atol=0.05)
    last = wrists.recording.truths[0].stamps_ns[-1]
    assert abs(wrists.orientations[-1].stamp_ns - last) < 0.2 * NANOSECONDS


def test_the_skeleton_has_its_forearms_and_states_inferred_joints(wrists: Fed) -> None:
    assert len(wrists.skeletons) > 70
    skeleton = wrists.skeletons[-1]
    assert skeleton.frame_id == "world"
    assert skeleton.states[Joint.ELBOW_LEFT] == TrackingState.INFERRED
    assert skeleton.states[Joint.KNEE_LEFT] == TrackingState.NOT_TRACKED
    truth = wrists.recording.truths[0]
    inside = []
    for each in wrists.skeletons[50::3]:
        instant = int(np.argmin(np.abs(truth.stamps_ns - each.stamp_ns)))
        for joint in (Joint.SPINE_SHOULDER, Joint.ELBOW_LEFT, Joint.WRIST_RIGHT):
            assert each.covariances is not None
            off = each.positions[joint] - truth.positions[instant, joint]
            inside.append(np.abs(off) < 2.5 * np.sqrt(each.covariances[joint].diagonal()))
    assert np.mean(inside) > 0.9


def test_a_sensor_that_is_switched_off_is_named_and_comes_back() -> None:
    off = sensor("forearm_right", off=((6.0, 9.0),))
    fed = feed(recorded("forearm_rolling", (sensor("forearm_left"), off), 13.0, seed=4))
    assert any(line.startswith("forearm_right: silent") for line in lines(fed, 6.8, 8.8))
    assert not any("silent" in line for line in lines(fed, 9.8))
    published = [
        (each.stamp_ns - START_NS) / NANOSECONDS for each in fed.orientations if each.segment == "forearm_right"
    ]
    assert not [stamp for stamp in published if 6.2 < stamp < 8.9]
    if [stamp for stamp in published if stamp > 9.5]:
        error, stddev = fed.errors("forearm_right", 9.5)
        assert ((np.abs(error) < np.radians(10.0)) | (np.abs(error) < 2.0 * stddev)).mean() > 0.95
    assert covered(fed, "forearm_left", 4.0).mean() > 0.95


def test_a_driver_that_repeats_one_reading_counts_as_silent() -> None:
    sensor, rng = WornSensor("forearm_left"), np.random.default_rng(0)
    for oriented in (False, True):
        used, values = [], np.zeros(6)
        for k in range(300):
            if not 100 <= k < 200:
                values = rng.normal(scale=0.02, size=6)
            stamp_ns = (10 * oriented + 1) * NANOSECONDS + k * NANOSECONDS // 50
            quaternion = np.array([0.0, 0.0, 0.0, 1.0]) if oriented else None
            sample = ImuSample(stamp_ns, "a", quaternion, None, values[:3], values[3:] + [0.0, 0.0, 9.81])
            used.append(sensor.take(sample, stamp_ns) is not None)
        assert all(used[50:100])
        assert used[100:200] == [True] * 15 + [False] * 85
        assert all(used[250:])


@pytest.mark.parametrize("magnetometer", [True, False])
def test_a_clock_set_back_costs_no_heading_that_refers_to_north(magnetometer: bool) -> None:
    sensor, rng = WornSensor("forearm_left"), np.random.default_rng(0)
    for k in range(200):
        received_ns = (100 * NANOSECONDS) + k * NANOSECONDS // 50
        rate, force = rng.normal(scale=0.02, size=3), np.array([0.0, 0.0, 9.81]) + rng.normal(scale=0.02, size=3)
        field = np.array([2e-5, 0.0, -4e-5]) if magnetometer else None
        stamp_ns = received_ns - (10 * NANOSECONDS if k >= 150 else 0)
        sensor.take(ImuSample(stamp_ns, "a", np.array([0.0, 0.0, 0.0, 1.0]), None, rate, force, field), received_ns)
    assert sensor.counters["clock set back"] == 1
    assert (sensor.growth < 0.01) == magnetometer


def test_a_slip_by_20_degrees_is_named() -> None:
    slipped = sensor("forearm_right", slips=(Slip(10.0, np.radians([0.0, 20.0, 0.0])),))
    fed = feed(
        recorded("reaching", (sensor("forearm_left"), slipped), SECONDS, seed=5), camera_stddev=0.01, seconds=20.0
    )
    named = [line for line in lines(fed) if "slipped" in line]
    assert named
    assert all(line.startswith("forearm_right: its sensor has slipped by") for line in named)
    assert not any("slipped" in line for line in lines(fed, 0.0, 9.9))
    assert covered(fed, "forearm_right", 18.0).mean() > 0.9


def test_two_exchanged_sensors_are_reported_and_reassigned(wrists: Fed) -> None:
    assert wrists.tracker.counters["exchanged sensors"] == 0
    crossed = sensor("forearm_left", "forearm_right"), sensor("forearm_right", "forearm_left")
    fed = feed(recorded("reaching", crossed, SECONDS, seed=4), seconds=20.0)
    assert fed.tracker.counters["exchanged sensors"] == 2
    assert "forearm_left: its sensor is on forearm_right" in lines(fed, 14.0)
    assert "forearm_right: its sensor is on forearm_left" in lines(fed, 14.0)
    for segment in FOREARMS:
        assert covered(fed, segment, 14.0).mean() > 0.9


@pytest.mark.slow
def test_a_pose_alone_names_no_swap_of_wrist_sensors() -> None:
    """A T-pose with swapped sensors equals one turned by half a turn; without north only motion distinguishes them."""
    for seed in range(draws(2, 20)):
        for worn in (FOREARMS, FOREARMS[::-1]):
            imus = tuple(sensor(name, on, magnetometer=True) for name, on in zip(FOREARMS, worn, strict=True))
            said = lines(feed(recorded("arm_raises", imus, seed=seed), seconds=4.0))
            assert not [line for line in said if "its sensor is on" in line], (seed, worn)


@pytest.mark.parametrize("oriented", [False, pytest.param(True, marks=pytest.mark.slow)], ids=["raw", "oriented"])
def test_a_magnetic_disturbance_is_named_and_covered(oriented: bool) -> None:
    imus = (sensor("forearm_left", magnetometer=True, oriented=oriented),)

    def iron(now: float, _tracker: InertialTracker, sample: ImuSample) -> ImuSample:
        assert sample.magnetic_field is not None
        if not 8.0 < now < 16.0:
            return sample
        return replace(sample, magnetic_field=sample.magnetic_field + np.array([3e-5, -2e-5, 2e-5]))

    fed = feed(recorded("reaching", imus, SECONDS, seed=3), meddle=iron, seconds=16.5)
    assert any(line == "forearm_left: magnetic field disturbed" for line in lines(fed, 9.0, 16.0))
    assert not any("disturbed" in line for line in lines(fed, 0.0, 7.9))
    assert covered(fed, "forearm_left", 8.0).mean() > 0.95


def test_without_a_camera_a_pose_aligns_and_the_drift_is_stated() -> None:
    imus = tuple(sensor(segment) for segment in WORN)
    fed = feed(recorded("forearm_rolling", imus, 8.0, seed=5), TrackingParameters(camera=False, rate=2.0), seconds=5.5)
    assert fed.tracker.counters["alignments by a pose"] == 1
    truth = fed.recording.truths[0]
    # world is where the person faced; the receiver's clock is another than the truth's
    assert truth.stamps_ns[0] > 0
    stddev = [float(np.sqrt(each.covariance[2, 2])) for each in fed.orientations if each.segment == "forearm_left"]
    assert stddev[-1] > stddev[10]
    assert fed.skeletons[-1].states[Joint.WRIST_LEFT] == TrackingState.TRACKED
    assert fed.skeletons[-1].states[Joint.HAND_LEFT] == TrackingState.INFERRED


def held(
    tracker: InertialTracker, fused_late_ns: int | None = None, *, camera_frames: bool = False
) -> list[SegmentOrientation]:
    """Orientations from three seconds of T-pose with magnetometers and straps that are turned by 8 degrees."""
    names = tracker.segments
    posed = pose_rotations(MODEL, "t")[[SEGMENTS.index(name) for name in names]]
    off = so3.quat_to_matrix(so3.exp(np.radians(8.0) * np.eye(3)[0]))
    rotations = so3.matrix_to_quat(posed @ mountings(names).swapaxes(-1, -2) @ off)
    rng = np.random.default_rng(0)
    skeleton = Skeleton(0, "world", tposed(), np.full(25, TrackingState.TRACKED, np.uint8))
    published, level, field = [], np.diag([1e-4, 1e-4, 1e-3]), np.array([2e-5, 0.0, -4e-5])
    for k in range(150):
        stamp_ns = (100 * NANOSECONDS) + k * NANOSECONDS // 50
        for number, name in enumerate(names):
            to_sensor = so3.quat_to_matrix(rotations[number]).T
            force = to_sensor @ [0.0, 0.0, 9.81] + 0.02 * rng.normal(size=3)
            rate = 0.005 * rng.normal(size=3)
            sample = ImuSample(stamp_ns, name, rotations[number], level, rate, force, to_sensor @ field)
            orientation = tracker.add(name, sample, stamp_ns + 10_000_000).orientation
            published += [] if orientation is None else [orientation]
        if fused_late_ns is not None:
            received_ns = stamp_ns + 15_000_000
            if camera_frames:
                tracker.take_camera_frame(stamp_ns + 5 * NANOSECONDS, received_ns)
            tracker.take_skeleton(replace(skeleton, stamp_ns=stamp_ns + 5 * NANOSECONDS), received_ns + fused_late_ns)
    return published


def tposed() -> FloatArray:
    """(25, 3) metres, of a person who faces x."""
    positions = np.full((25, 3), np.nan)
    q = MODEL.neutral()
    for side, sign in (("left", 1.0), ("right", -1.0)):
        q[MODEL.quaternion_of(f"upper_arm_{side}")] = so3.exp(np.array([sign * 0.5 * np.pi, 0.0, 0.0]))
    positions[MODEL.joints] = MODEL.forward(q, MODEL.default_lengths()).positions
    return positions


@cache
def _aligned_by_magnetometers() -> InertialTracker:
    tracker = InertialTracker(("upper_trunk", "upper_arm_left", "forearm_left"), TrackingParameters(camera=False))
    assert held(tracker)
    assert tracker.aligned
    return tracker


def aligned_by_magnetometers() -> InertialTracker:
    return copy.deepcopy(_aligned_by_magnetometers())


def output_later(
    tracker: InertialTracker,
    stamp_ns: int,
    rate: FloatArray | None = STILL,
    turned: FloatArray = STILL,
    *,
    skeleton: bool = True,
) -> TrackerOutput:
    """The tracker's output for a reading of the left forearm, at a time after a T-pose."""
    stamp_ns += 110 * NANOSECONDS
    level, up = np.diag([1e-4, 1e-4, 1e-3]), np.array([0.0, 0.0, 9.81 + 1e-12 * (stamp_ns % NANOSECONDS)])  # not frozen
    sample = ImuSample(stamp_ns, "forearm_left", so3.exp(turned), level, rate, None if rate is None else up, None)
    return tracker.add("forearm_left", sample, stamp_ns + 10_000_000, skeleton=skeleton)


def test_magnetometers_share_their_heading_so_that_a_pose_finds_straps_that_are_turned() -> None:
    alignment = aligned_by_magnetometers().alignment
    assert np.abs(alignment.headings - alignment.headings[0]).max() < np.radians(1.5)
    apart = alignment.covariance[3::4, 3::4]
    assert apart[0, 0] + apart[1, 1] - 2.0 * apart[0, 1] < np.radians(10.0) ** 2


@pytest.mark.parametrize("rate", [None, np.array([0.1, 0.0, 0.0])], ids=["none", "some"])
def test_no_rate_is_published_that_the_driver_does_not_report(rate: FloatArray | None) -> None:
    """The difference of two orientations is too noisy to count as a measurement."""
    tracker = aligned_by_magnetometers()
    for k in range(2):
        output = output_later(tracker, k * NANOSECONDS // 20, rate, np.array([0.005 * k, 0.0, 0.0])).orientation
        assert output is not None
        assert (output.angular_velocity is None) is (rate is None)


def test_no_body_is_fitted_without_a_subscriber() -> None:
    tracker = aligned_by_magnetometers()
    for k, wanted in enumerate((True, False, True)):
        output = output_later(tracker, k * NANOSECONDS // 5, skeleton=wanted)
        assert (output.skeleton is not None) is wanted


def test_stamps_that_jitter_cost_no_orientations() -> None:
    """Every third of 100 readings per second gives an orientation, although that is slightly more than 30 Hz."""
    tracker = aligned_by_magnetometers()
    jitter = np.random.default_rng(0).integers(-1_000_000, 1_000_000, 300).tolist()
    stamps = [k * NANOSECONDS // 100 + off for k, off in enumerate(jitter)]
    published = [output_later(tracker, stamp_ns, skeleton=False).orientation for stamp_ns in stamps]
    assert sum(each is not None for each in published) == 100


def test_stamps_are_placed_by_the_cameras_own_frames_however_late_fused_ones_come() -> None:
    parameters = TrackingParameters(clock="own", rate=2.0)
    published = [
        held(InertialTracker(FOREARMS, parameters), late, camera_frames=camera_frames)
        for late, camera_frames in ((0, True), (30_000_000, True), (30_000_000, False))
    ]
    first, late, without_frames = ([(each.stamp_ns, each.segment) for each in one] for one in published)
    assert len(first) > 100
    assert first == late
    # a sensor's reading of the same instant, which came 5 ms sooner
    assert (first[-1][0] - 5 * NANOSECONDS - 100 * NANOSECONDS) % (NANOSECONDS // 50) == 15_000_000
    assert without_frames[-1][0] == first[-1][0] - 30_000_000


def test_a_restart_of_the_stage_begins_anew() -> None:
    stage = ImuStage({each.name: each.default for each in ImuStage.PARAMETERS} | {"segments": ("forearm_left",)})
    stage.tracker.aligned = True
    stage.restart()
    assert not stage.tracker.aligned


def test_time_that_runs_backwards_begins_anew_and_is_counted() -> None:
    tracker = InertialTracker(["forearm_left"], TrackingParameters(camera=False))
    rng = np.random.default_rng(0)

    def still(start_s: float) -> None:
        for k in range(100):
            rate, force = 0.01 * rng.normal(size=3), np.array([0.0, 0.0, 9.81]) + 0.02 * rng.normal(size=3)
            stamp_ns = round((start_s + 0.02 * k) * NANOSECONDS)
            tracker.add("forearm_left", ImuSample(stamp_ns, "a", None, None, rate, force), stamp_ns + 10_000_000)

    still(100.0)
    still(50.0)
    assert tracker.counters["time jumps"] == 1
    assert not any("silent" in line for line in tracker.problems(round(52.0 * NANOSECONDS)))
    assert any("silent" in line for line in tracker.problems(round(60.0 * NANOSECONDS)))


def test_a_sensor_in_other_units_is_named_and_left_out() -> None:
    def in_g(now: float, tracker: InertialTracker, sample: ImuSample) -> ImuSample:
        assert sample.acceleration is not None
        return replace(sample, acceleration=sample.acceleration / 9.81)

    fed = feed(recorded("two_handed_wave", (sensor("forearm_left"),), seed=1), meddle=in_g, seconds=8.0)
    assert any(line.startswith("forearm_left: the acceleration is in units of g") for line in lines(fed, 5.0))
    assert not [each for each in fed.orientations if each.stamp_ns - START_NS > 4 * NANOSECONDS]


def test_a_clock_by_receipt_follows_the_least_delay_and_notices_that_it_was_set() -> None:
    clock = ReceiptClock()
    assert clock.delay_ns is None
    for k in range(1000):
        assert clock.add(k * 10**7, k * 10**7 + 5 * 10**9 + (k % 7) * 10**6)
    assert clock.delay_ns == 5 * 10**9
    assert not clock.add(100 * 10**9, 10 * 10**9)
    assert clock.delay_ns == -90 * 10**9


def test_a_mounting_names_the_directions_of_x_and_z() -> None:
    (other,) = mountings(["head"], ["head:+x+z"])
    np.testing.assert_allclose(other, np.eye(3), atol=1e-12)


@pytest.mark.parametrize(
    "segments, given",
    [([], ()), (["nose"], ()), (["head", "head"], ()), (["head"], ["head:+x+x"]), (["head"], ["x:+x"])],
)
def test_invalid_segments_and_mountings_are_refused(segments: list[str], given: tuple[str, ...]) -> None:
    with pytest.raises(BodyTrackingError):
        InertialTracker(segments, mountings=given)
    with pytest.raises(InertialTrackingError, match="unknown: nose; expected one of pelvis, "):
        InertialTracker(["nose"])
    with pytest.raises(InertialTrackingError, match="no inertial sensor"):
        InertialTracker(["head"]).add("pelvis", ImuSample(0, "a", np.array([0.0, 0.0, 0.0, 1.0])), 0)
