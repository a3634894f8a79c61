"""One skeleton from several sensors: by stamp, weighted, and robust against one of them."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import cache
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from two_kinects import FRAME, OFFSET, OFFSET_NS, POSES, truth

from body_tracking.calibration.online import OnlineCalibration
from body_tracking.core.clocks import ClockModel
from body_tracking.core.measurement import COMMON_SHARE, left_right_axes
from body_tracking.core.parameters import check_all
from body_tracking.core.skeleton import NANOSECONDS, FloatArray, Joint, Skeleton, TrackingState
from body_tracking.fusion.fusion import Fusion, FusionParameters
from body_tracking.fusion.placement import FusionError
from body_tracking.fusion.sides import HOLD, MIN_HOLD
from body_tracking.fusion.stage import FusionStage
from body_tracking.kinect.csv_recording import CsvRecording
from body_tracking.pipeline import graph
from body_tracking.pipeline.stage import Now
from draws import draws, some
from walkers import TRACKED, about_y, frame

Frame = tuple[str, Skeleton, int]


def fusion(sensors: Iterable[str] = ("kinect1", "kinect2"), **parameters: object) -> Fusion:
    made = Fusion(tuple(sensors), FusionParameters(**({"fade_in": 0.0} | parameters)))
    for sensor in sensors:
        made.set_pose(POSES[sensor])
    if "kinect2" in sensors:
        made.set_clock("kinect2", 0, ClockModel(OFFSET_NS))
    return made


@cache
def frames(seconds: float, noise: float = 0.0, phase: float = 0.013, start: float = 0.0) -> list[Frame]:
    """Both sensors' frames in order of capture; the time of arrival is that of capture."""
    rng = np.random.default_rng(0)
    made = []
    for sensor, lag, clock in (("kinect1", 0.0, 0.0), ("kinect2", phase, OFFSET)):
        times = start + np.arange(0.0, seconds, FRAME) + lag
        pose = POSES[sensor]
        seen = (truth(times) - pose.translation) @ pose.rotation
        seen = seen + rng.normal(scale=noise, size=seen.shape)
        for time, positions in zip(times, seen, strict=True):
            made.append((sensor, frame(time + clock, positions, sensor), round(time * NANOSECONDS)))
    return sorted(made, key=lambda each: each[2])


def of_one(seconds: float, noise: float = 0.0) -> list[Frame]:
    return [each for each in frames(seconds, noise) if each[0] == "kinect1"]


def run(made: Fusion, given_frames: Iterable[Frame]) -> list[Skeleton]:
    fused: list[Skeleton] = []
    last = 0
    for sensor, skeleton, now in given_frames:
        last = now
        fused += made.poll(now)
        fused += made.push(sensor, skeleton, now)
    return fused + made.poll(last + NANOSECONDS)


def errors(fused: list[Skeleton]) -> FloatArray:
    stamps = np.array([skeleton.stamp for skeleton in fused])
    return np.linalg.norm(np.stack([each.positions for each in fused]) - truth(stamps), axis=-1)


def changed(given_frames: list[Frame], sensor: str, change: Callable[[Skeleton], Skeleton | None]) -> list[Frame]:
    """The frames with those of one sensor changed, or left out."""
    out = []
    for name, skeleton, now in given_frames:
        other = change(skeleton) if name == sensor else skeleton
        if other is not None:
            out.append((name, other, now))
    return out


def lowered(by: float) -> Callable[[Skeleton], Skeleton]:
    """Shift all joints down, metres: the optical y axis points down."""
    return lambda seen: replace(seen, positions=seen.positions + [0.0, by, 0.0])


# --- outputs


def test_noiseless_frames_give_the_truth_once_per_reference_frame() -> None:
    fused = run(fusion(), frames(8.0))
    assert len(fused) == 240
    assert np.diff([each.stamp_ns for each in fused]).min() > 0
    assert {each.frame_id for each in fused} == {"world"}
    # The extrapolation error of a waving person's hands over half a frame.
    assert errors(fused)[30:].mean() < 0.002
    assert errors(fused)[30:].max() < 0.03


def test_two_noisy_sensors_have_smaller_error_and_covariance_than_one() -> None:
    alone = run(fusion(["kinect1"]), of_one(8.0, 0.02))
    together = run(fusion(), frames(8.0, 0.02))
    one, both = errors(alone)[30:90], errors(together)[30:90]
    # With 20 mm of noise the axis of the hips jumps in some frames. Alone, a sensor has no legs then; they return soon.
    compared = np.isfinite(one)
    assert np.isfinite(both).all()
    assert compared.mean() > 0.99
    assert both[compared].mean() < 0.8 * one[compared].mean()
    traces = []
    for made in (alone, together):
        covariances = [each.covariances for each in made[30:] if each.covariances is not None]
        assert len(covariances) == len(made) - 30
        traces.append(np.nanmedian(np.trace(covariances, axis1=2, axis2=3)))
    assert all(
        np.linalg.eigvalsh(each.covariances).min() > 0.0 for each in together[30:] if each.covariances is not None
    )
    assert traces[1] < 0.85 * traces[0]


def test_what_sensors_err_by_alike_is_not_averaged_out() -> None:
    """Two sensors that state the same variance: their mean has 3/4 of it, since half of it is common, not 1/2."""
    seen = [replace(skeleton, covariances=np.tile(0.03**2 * np.eye(3), (25, 1, 1))) for _, skeleton, _ in frames(3.0)]
    stated = [(name, given, now) for (name, _, now), given in zip(frames(3.0), seen, strict=True)]
    alone = run(fusion(["kinect1"]), [each for each in stated if each[0] == "kinect1"])
    together = run(fusion(), stated)
    one, both = (
        np.stack([each.covariances for each in made[30:60]])[:, Joint.ELBOW_LEFT] for made in (alone, together)
    )
    ratios = both.trace(axis1=1, axis2=2) / one.trace(axis1=1, axis2=2)
    assert_allclose(ratios, 1.0 - COMMON_SHARE / 2.0, atol=0.1)


def test_disagreement_increases_the_covariance() -> None:
    trunk = [Joint.SPINE_BASE, Joint.SPINE_MID, Joint.SPINE_SHOULDER]
    agreed, apart = (run(fusion(), frames(3.0)), run(fusion(), changed(frames(3.0), "kinect2", lowered(0.16))))
    for near, far in zip(agreed[10:], apart[10:], strict=True):
        assert near.covariances is not None
        assert far.covariances is not None
        # z is up: the shift is downwards in the optical frame.
        assert (far.covariances[trunk, 2, 2] > near.covariances[trunk, 2, 2] + 0.0015).all()


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=draws(2, 15))
def test_output_is_independent_of_small_changes_of_arrival(seed: int) -> None:
    rng = np.random.default_rng(seed)
    orderly = frames(4.0, 0.01, phase=0.004)
    shaken = sorted(
        ((sensor, skeleton, now + int(rng.integers(0, 8_000_000))) for sensor, skeleton, now in orderly),
        key=lambda each: each[2],
    )
    expected, found = run(fusion(), orderly), run(fusion(), shaken)
    assert [each.stamp_ns for each in found] == [each.stamp_ns for each in expected]
    for each, other in zip(found, expected, strict=True):
        assert_allclose(each.positions, other.positions, atol=1e-12)


def test_a_frame_waits_only_for_one_that_is_due() -> None:
    """The other sensor misses one frame: the reference's frame waits for it, and not longer than ``max_wait``."""
    given_frames = frames(3.0, phase=0.016)
    missing = next(index for index, each in enumerate(given_frames) if index > 60 and each[0] == "kinect2")
    made = fusion(max_wait=0.01)
    for sensor, skeleton, now in given_frames[:missing]:
        made.push(sensor, skeleton, now)
    sensor, skeleton, now = given_frames[missing + 1]
    assert sensor == "kinect1"
    assert made.push(sensor, skeleton, now) == []
    assert made.deadline_ns == now + 10_000_000
    assert made.poll(now + 9_999_999) == []
    assert len(made.poll(now + 10_000_000)) == 1


def test_the_order_of_the_sensors_does_not_matter() -> None:
    there = run(fusion(), frames(4.0, 0.01))
    back = Fusion(("kinect2", "kinect1"), FusionParameters(fade_in=0.0), reference="kinect1")
    for pose in POSES.values():
        back.set_pose(pose)
    back.set_clock("kinect2", 0, ClockModel(OFFSET_NS))
    for each, other in zip(there, run(back, frames(4.0, 0.01)), strict=True):
        assert_allclose(each.positions, other.positions, atol=1e-12)


def test_the_thesis_methods_take_its_weights() -> None:
    states = TRACKED.copy()
    states[Joint.WRIST_LEFT] = 1

    def inferred(seen: Skeleton) -> Skeleton:
        positions = seen.positions.copy()
        positions[Joint.WRIST_LEFT] += [0.3, 0.0, 0.0]
        return frame(seen.stamp, positions, "kinect2", states)

    still = [each for each in frames(2.0, phase=0.0) if each[2] < 2 * NANOSECONDS]
    for method, share in (("thesis_text", 0.0), ("thesis_formula", 1 / 3)):
        last = run(fusion(method=method), changed(still, "kinect2", inferred))[-1]
        wrong = np.linalg.norm(last.positions - truth(np.array([last.stamp]))[0], axis=-1)
        assert wrong[Joint.WRIST_LEFT] == pytest.approx(0.3 * share, abs=1e-6)
        assert np.delete(wrong, Joint.WRIST_LEFT).max() < 1e-6


# --- when sensors fail


def test_a_silent_sensor_is_dropped_within_a_tenth_of_a_second_and_faded_in_again() -> None:
    def paused(seen: Skeleton) -> Skeleton | None:
        # Its frames are 10 cm off, which shows when they have weight.
        return None if 2.0 < seen.stamp - OFFSET < 4.0 else lowered(0.1)(seen)

    fused = run(fusion(fade_in=0.5), changed(frames(8.0), "kinect2", paused))
    always = np.median(errors(run(fusion(fade_in=0.5), changed(frames(8.0), "kinect2", lowered(0.1)))), axis=1)
    stamps = np.array([each.stamp for each in fused])
    wrong = np.median(errors(fused), axis=1)
    assert len(fused) == 240
    assert wrong[(stamps > 1.0) & (stamps < 2.0)].min() > 0.03
    assert wrong[(stamps > 2.1) & (stamps < 4.0)].max() < 1e-6
    assert_allclose(wrong[stamps > 5.0], always[stamps > 5.0], atol=0.002)
    # ... gently.
    assert np.abs(np.diff(wrong[(stamps > 4.0) & (stamps < 4.6)])).max() < 0.012


@pytest.mark.parametrize("every", [3, 4, 6])
def test_a_slow_sensor_has_nearly_the_weight_of_a_fast_one_right_after_its_frames(every: int) -> None:
    """At 10, 7.5 and 5 frames a second, longer apart than ``silence``; a little less, as it corrects the output."""
    both = changed(frames(8.0), "kinect2", lowered(0.1))
    number = {at: count for count, at in enumerate(at for name, _, at in both if name == "kinect2")}
    fast = run(fusion(fade_in=0.5), both)
    slow = run(fusion(fade_in=0.5), [each for each in both if each[0] == "kinect1" or number[each[2]] % every == 0])
    due = [at for at, count in number.items() if count % every == 0]
    after = [k for k, each in enumerate(slow) if any(0 <= each.stamp_ns - at < 0.03 * NANOSECONDS for at in due)]
    assert [each.stamp_ns for each in slow] == [each.stamp_ns for each in fast] and len(after) > 30
    trunk = [Joint.SPINE_BASE, Joint.SPINE_MID, Joint.SPINE_SHOULDER]
    shifts = [errors(fused)[after][:, trunk] for fused in (slow, fast)]
    settled = [slow[k].stamp > 2.0 for k in after]
    assert (shifts[0][settled] > 0.7 * shifts[1][settled]).mean() > 0.95


@pytest.mark.parametrize(("late", "lag"), [("kinect1", 0.3), ("kinect2", 0.3), ("kinect1", 0.05)])
def test_a_sensor_whose_frames_arrive_too_late_is_named(late: str, lag: float) -> None:
    stage = FusionStage(check_all(FusionStage.PARAMETERS, {"sensors": ("kinect1", "kinect2")}))
    for pose in POSES.values():
        list(stage.take(graph.CALIBRATION, pose, Now(0, 0)))
    list(stage.take(graph.CALIBRATION_CLOCK, ("kinect2", 0, ClockModel(OFFSET_NS)), Now(0, 0)))
    arriving = [(at + round(lag * NANOSECONDS) * (name == late), name, seen) for name, seen, at in frames(3.0, 0.001)]
    for at, name, seen in sorted(arriving, key=lambda each: each[0])[:150]:  # both still come
        list(stage.take(graph.skeleton_topic(name), (seen,), Now(at, at)))
        list(stage.poll(at))
    level, text, _ = stage.state(0)
    assert level == (lag > 0.1)
    assert text.startswith(f"{late} is not used: its frames arrive 0." if lag > 0.1 else "")
    assert bool(text) == (lag > 0.1)


@pytest.mark.parametrize("frozen", ["kinect1", "kinect2"])
def test_a_sensor_that_repeats_one_frame_is_named_and_left_out(frozen: str) -> None:
    stage = FusionStage(check_all(FusionStage.PARAMETERS, {"sensors": ("kinect1", "kinect2")}))
    for pose in POSES.values():
        list(stage.take(graph.CALIBRATION, pose, Now(0, 0)))
    list(stage.take(graph.CALIBRATION_CLOCK, ("kinect2", 0, ClockModel(OFFSET_NS)), Now(0, 0)))
    first: dict[str, Skeleton] = {}
    fused: list[Skeleton] = []
    for name, seen, at in frames(4.0, 0.001):
        first.setdefault(name, seen)
        if name == frozen and 2 * NANOSECONDS < at < 3 * NANOSECONDS:
            seen = replace(seen, positions=first[name].positions)
        for output in (*stage.take(graph.skeleton_topic(name), (seen,), Now(at, at)), *stage.poll(at)):
            fused += output.payload
        text = f"{frozen}: the same frame again and again is not used: restart the sensor's driver"
        if not (2.0 < at / NANOSECONDS < 2.4 or 2.95 < at / NANOSECONDS < 3.1):  # while it begins and ends
            assert (stage.state(0)[1] == text) == (2 < at / NANOSECONDS < 3)
    assert stage.counters[f"association repeated frames of {frozen}"] in (19, 20, 21)
    stamps = np.array([each.stamp for each in fused])
    assert np.diff(stamps).max() < 0.1
    assert errors(fused)[(stamps > 1.0) & (stamps < 1.95) | (stamps > 2.5)].max() < 0.05


def test_output_continues_while_the_reference_is_silent() -> None:
    def gone(seen: Skeleton) -> Skeleton | None:
        return None if 2.0 < seen.stamp < 4.0 else seen

    fused = run(fusion(), changed(frames(6.0), "kinect1", gone))
    stamps = np.array([each.stamp for each in fused])
    assert np.diff(stamps).max() < 0.1
    assert np.sum((stamps > 2.0) & (stamps < 4.0)) > 55, "at every frame of the other sensor"
    assert errors(fused)[30:].max() < 0.05


def test_a_slow_reference_does_not_halve_the_rate_of_the_output() -> None:
    """A Kinect v2 in the dark gives 15 frames a second."""
    slow, kept = frames(6.0), 0
    given_frames = []
    for name, seen, at in slow:
        kept += name == "kinect1"
        if name == "kinect2" or kept % 2:
            given_frames.append((name, seen, at))
    fused = run(fusion(), given_frames)
    stamps = np.array([each.stamp for each in fused])
    assert np.diff(stamps).min() > 0.0 and len(stamps) > 170
    assert errors(fused)[30:].max() < 0.05


@pytest.mark.parametrize("sensor", ["kinect1", "kinect2"])
@pytest.mark.parametrize("seconds", some([1.2, 0.3, 3.0]))
def test_a_temporary_reversal_in_one_sensor_is_swapped_back(sensor: str, seconds: float) -> None:
    """Whichever is the trusted one: the other sensor sees no reversal."""

    def reverse(skeleton: Skeleton) -> Skeleton:
        stamp = skeleton.stamp - (OFFSET if sensor == "kinect2" else 0.0)
        return skeleton.mirrored() if 4.0 <= stamp < 4.0 + seconds else skeleton

    fused = run(made := fusion(), changed(frames(10.0), sensor, reverse))
    assert made.counters["repaired"] > 0 and not made.counters["reversals_accepted"]
    assert errors(fused)[30:].max() < 0.05


LOWER = [each for each in Joint if each.name.startswith(("HIP", "KNEE", "ANKLE", "FOOT")) or each is Joint.SPINE_BASE]
UPPER = [each for each in Joint if each not in LOWER]


def behind_a_table(seen: Skeleton) -> Skeleton:
    """Nothing below the waist is seen."""
    positions, states = seen.positions.copy(), seen.states.copy()
    positions[LOWER], states[LOWER] = np.nan, TrackingState.NOT_TRACKED
    return replace(seen, positions=positions, states=states)


@pytest.mark.parametrize("sensor", ["kinect1", "kinect2"])
def test_sides_of_a_person_behind_a_table_are_repaired_by_the_shoulders_alone(sensor: str) -> None:
    """Also where the hips come into view later, in a frame that shows them swapped."""

    def change(skeleton: Skeleton, name: str) -> Skeleton:
        stamp = skeleton.stamp - (OFFSET if name == "kinect2" else 0.0)
        turned = skeleton.mirrored() if name == sensor and 4.0 <= stamp < 5.2 else skeleton
        return turned if stamp > 5.0 else behind_a_table(turned)

    given_frames = changed(frames(8.0), "kinect1", lambda seen: change(seen, "kinect1"))
    fused = run(made := fusion(), changed(given_frames, "kinect2", lambda seen: change(seen, "kinect2")))
    assert made.counters["repaired"] > 0 and not made.counters["reversals_accepted"]
    assert errors(fused)[30:, UPPER].max() < 0.05
    assert errors(fused)[180:].max() < 0.05


@pytest.mark.parametrize("sensor", ["kinect1", "kinect2"])
def test_an_impossible_turn_in_one_sensor_is_rejected(sensor: str) -> None:
    """In a side view, swapped sides can turn the body by less than half a turn."""

    def turn(skeleton: Skeleton) -> Skeleton:
        stamp = skeleton.stamp - (OFFSET if sensor == "kinect2" else 0.0)
        if not 4.0 <= stamp < 6.0:
            return skeleton
        centre = skeleton.positions[Joint.SPINE_SHOULDER]
        return frame(skeleton.stamp, (skeleton.positions - centre) @ about_y(115.0).T + centre, sensor)

    fused = run(fusion(), changed(frames(10.0), sensor, turn))
    found = np.stack([left_right_axes(each.positions)[0] for each in fused])
    true = left_right_axes(truth(np.array([each.stamp for each in fused])))[:, 0]
    assert (np.einsum("ni,ni->n", found, true) > 0.0)[30:].all()


def test_a_body_seen_from_the_side_does_not_flatten_the_shoulders() -> None:
    """Of a sensor whose axis is across the accepted one, only the joints of left and right are rejected."""

    def twisted(seen: Skeleton) -> Skeleton:
        centre = seen.positions[Joint.SPINE_SHOULDER]
        turn = about_y(90.0 * min(1.0, max(0.0, seen.stamp - OFFSET - 2.0)))
        return frame(seen.stamp, (seen.positions - centre) @ turn.T + centre, "kinect2")

    fused = run(fusion(), changed(frames(6.0), "kinect2", twisted))
    width = np.linalg.norm([left_right_axes(each.positions)[0] for each in fused], axis=1)
    assert width[60:].min() > 0.75 * np.median(width[:60])


def test_a_common_reversal_is_held_and_then_followed_by_turning() -> None:
    def turned(seen: Skeleton) -> Skeleton:
        return seen.mirrored() if seen.stamp > 3.0 else seen

    made = fusion(["kinect1"])
    fused = run(made, changed(of_one(16.0), "kinect1", turned))
    assert errors(fused)[[each.stamp < 3.0 + HOLD for each in fused]].max() < 0.1
    axes = np.stack([left_right_axes(each.positions)[0] for each in fused])
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    assert np.einsum("ni,ni->n", axes[1:], axes[:-1]).min() > 0.4  # never through a mirror
    assert made.counters["reversals_accepted"] > 0
    # In the end the reversal is accepted.
    assert errors(fused)[-1].max() > 0.2


def test_a_sensor_that_tells_left_from_right_is_followed_soon() -> None:
    """A camera whose person turned round while nobody saw it: seen reversed, and rightly so."""

    def stated(seen: Skeleton) -> Skeleton:
        given = replace(seen, covariances=np.tile(0.04**2 * np.eye(3), (25, 1, 1)))
        return given if seen.stamp > 3.0 else given.mirrored()

    made = fusion(["kinect1"])
    fused = run(made, changed(of_one(8.0), "kinect1", stated))
    assert made.counters["reversals_accepted"] > 0
    assert errors(fused)[[each.stamp > 3.0 + MIN_HOLD + 0.8 for each in fused]].max() < 0.1


def test_outliers_of_a_joint_are_gated_and_a_lasting_change_is_accepted() -> None:
    def wild(seen: Skeleton) -> Skeleton:
        positions = seen.positions.copy()
        clock = seen.stamp
        if 2.0 < clock < 2.1 or clock > 4.0:
            positions[Joint.WRIST_RIGHT] += [0.0, -0.8, 0.0]
        return frame(seen.stamp, positions)

    made = fusion(["kinect1"])
    fused = run(made, changed(of_one(6.0), "kinect1", wild))
    stamps = np.array([each.stamp for each in fused])
    wrist = np.stack([each.positions[Joint.WRIST_RIGHT] for each in fused]) - truth(stamps)[:, Joint.WRIST_RIGHT]
    height = wrist[:, 2]
    assert np.isnan(height[(stamps > 2.0) & (stamps < 2.1)]).all()
    assert np.nanmax(np.abs(height[(stamps > 2.2) & (stamps < 4.0)])) < 0.05
    assert_allclose(height[stamps > 4.5], 0.8, atol=0.05)
    assert made.counters["gated_joints"] > 3


def test_a_wrist_beyond_an_inferred_elbow_counts_as_inferred() -> None:
    def raised(elbow: TrackingState) -> Callable[[Skeleton], Skeleton]:
        def change(seen: Skeleton) -> Skeleton:
            positions, states = seen.positions.copy(), seen.states.copy()
            positions[Joint.WRIST_LEFT] += [0.0, -0.2, 0.0]
            states[Joint.ELBOW_LEFT] = elbow
            return replace(seen, positions=positions, states=states)

        return change

    tracked, inferred = (
        errors(run(fusion(), changed(frames(2.0), "kinect1", raised(state))))[30:, Joint.WRIST_LEFT].mean()
        for state in (TrackingState.TRACKED, TrackingState.INFERRED)
    )
    assert tracked > 0.05
    assert inferred < 0.4 * tracked


def test_late_repeated_and_backward_stamps() -> None:
    made = fusion()
    given_frames = frames(3.0)
    fused = run(made, given_frames)
    assert made.push("kinect1", given_frames[-2][1], 10 * NANOSECONDS) == []  # repeated
    assert made.counters["late"] == 1
    again = run(made, [(sensor, skeleton, now + 20 * NANOSECONDS) for sensor, skeleton, now in frames(3.0)])
    assert made.counters["resets"] >= 1
    assert len(again) == len(fused)
    assert errors(again)[30:].max() < 0.05


@pytest.mark.filterwarnings("error")
def test_joints_that_are_not_valid_are_left_out() -> None:
    def damaged(seen: Skeleton) -> Skeleton:
        positions, states = seen.positions.copy(), seen.states.copy()
        positions[Joint.HAND_LEFT] = np.nan
        positions[Joint.FOOT_LEFT] = np.inf
        positions[Joint.HEAD] = 1e30
        states[Joint.KNEE_RIGHT] = 0
        return frame(seen.stamp, positions, "kinect1", states)

    nowhere = [Joint.HAND_LEFT, Joint.FOOT_LEFT, Joint.HEAD, Joint.KNEE_RIGHT]
    for each in run(fusion(["kinect1"]), changed(of_one(3.0), "kinect1", damaged)):
        assert np.isnan(each.positions[nowhere]).all()
        assert (each.states[nowhere] == 0).all()
        assert np.isfinite(np.delete(each.positions, nowhere, axis=0)).all()
    both = run(fusion(), changed(frames(3.0), "kinect1", damaged))
    assert np.isfinite(both[-1].positions).all()  # the other sensor has them
    nowhere_at_all = [(name, replace(seen, positions=np.full((25, 3), np.nan)), now) for name, seen, now in of_one(3.0)]
    empty = run(fusion(["kinect1"]), nowhere_at_all)
    assert all((each.states == 0).all() for each in empty)


# --- calibration


def test_nothing_comes_from_a_sensor_that_is_not_calibrated() -> None:
    with pytest.raises(FusionError):
        Fusion(())
    made = Fusion(("kinect1", "kinect2"))
    assert run(made, frames(1.0)) == []
    assert made.counters["uncalibrated"] == 60
    made.set_pose(POSES["kinect1"])
    assert len(run(made, [(s, k, now + 5 * NANOSECONDS) for s, k, now in frames(1.0, start=5.0)])) == 30


# --- real sensors


@pytest.mark.parametrize("person", some(["p02", "p07", "p12"]))
def test_the_shoulders_of_real_people_never_reverse(shared_data: Path, person: str) -> None:
    """At 90 degrees one sensor sees the body turned around in up to 22 % of its frames."""
    calibration = OnlineCalibration(("kinect1", "kinect2"))
    made = Fusion(("kinect1", "kinect2"))
    made.set_pose(calibration.current_update().result.poses["kinect1"])
    fused = []
    recording = CsvRecording(shared_data / "kinect_pairs" / f"{person}_90deg.csv.gz")
    for each in islice(recording, draws(900, 0), draws(2300, 10_000)):
        for update in calibration.push(each.sensor, each.skeletons[0], each.received_ns):
            for name, pose in update.result.poses.items():
                made.set_clock(name, update.valid_from_ns, update.result.clocks[name])
                made.set_pose(pose)
        fused += made.push(each.sensor, each.skeletons[0], each.received_ns)
    assert made.counters["repaired"] + made.counters["turned"] > 50
    for half in (0, 1):
        axes = np.stack([left_right_axes(each.positions)[half] for each in fused])
        axes = axes[np.isfinite(axes).all(axis=1)]
        axes /= np.linalg.norm(axes, axis=1, keepdims=True)
        assert np.einsum("ni,ni->n", axes[1:], axes[:-1]).min() > 0.0
