"""Filters correct sensors' offsets of the joint centres after a T-pose."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from body_tracking.calibration.joint_centres import LEARNT, posed
from body_tracking.core.measurement import BASE_STDDEV
from body_tracking.core.orientation import SegmentOrientation
from body_tracking.core.parameters import check_all
from body_tracking.core.sensor_poses import SensorPose
from body_tracking.core.skeleton import NANOSECONDS, FloatArray, Joint, Skeleton
from body_tracking.filters import SkeletonFilter, make_filter
from body_tracking.filters.stage import FilterStage
from body_tracking.kinematics import positional
from body_tracking.kinematics.positional import ANGLE_NAMES, angles_over_time
from body_tracking.pipeline import graph
from body_tracking.pipeline.people import HOLD
from body_tracking.pipeline.stage import Now
from draws import draws, some
from walkers import TRACKED, frame, performed

FILTERS = ("lkf_constant_velocity", "ekf")
ELBOWS, ARMS = (
    [ANGLE_NAMES.index(f"{angle}_{side}") for side in ("left", "right")]
    for angle in ("elbow_flexion", "shoulder_elevation")
)
RATE = 30.0
SECONDS = draws(7, 16)
HOLDING, MOVING = range(70, 88), range(150, round(SECONDS * RATE))
"""Frames in which the T-pose is held after it was learnt from, and in which the arms reach in many directions."""
GAP = 1.5
"""Seconds: longer than a linear filter goes on for, shorter than the other one."""


@cache
def reaching() -> FloatArray:
    """A T-pose of three seconds, then arms in many directions."""
    return performed("reaching")[: MOVING.stop]


@cache
def skeletons() -> tuple[Skeleton, ...]:
    """Skeletons of :func:`reaching` by a camera that sees elbows too low and wrists too high."""
    local = np.zeros((len(LEARNT), 3))
    for place, joint in enumerate(LEARNT):
        if joint in (Joint.ELBOW_LEFT, Joint.ELBOW_RIGHT):
            local[place] = [-0.02, 0.0, -0.03]
        elif joint in (Joint.WRIST_LEFT, Joint.WRIST_RIGHT):
            local[place] = [0.02, 0.0, 0.03]
    t_pose = reaching()[20]
    # offsets in the T-pose, converted to the frames of the segments
    axes = posed(t_pose, np.broadcast_to(np.eye(3), (len(LEARNT), 3, 3)).copy())
    local = np.einsum("jab,jb->ja", axes, local)
    rng = np.random.default_rng(0)
    covariances = BASE_STDDEV[:, None, None] ** 2 * np.eye(3)
    result = []
    for number, true in enumerate(reaching()):
        positions = true + rng.normal(scale=0.001, size=true.shape)
        positions[LEARNT] += posed(true, local[:, None])[:, 0]
        each = frame(number / RATE + 1.0, positions)
        result.append(Skeleton(each.stamp_ns, "world", positions, TRACKED, covariances=covariances))
    return tuple(result)


def run(
    tested: SkeletonFilter, frames: range = MOVING, left_out: range = range(0), angles: list[int] = ELBOWS
) -> tuple[FloatArray, FloatArray]:
    """Errors of angles in degrees in some frames, and their stated deviations."""
    found, right = [], []
    for number, (seen, true) in enumerate(zip(skeletons()[: frames.stop], reaching(), strict=False)):
        out = None if number in left_out else tested.update(seen)
        if out is None or number not in frames:
            continue
        found.append(out)
        right.append(true)
    covariances = np.stack([each.covariances for each in found])
    ours, stddev = angles_over_time(np.stack([each.positions for each in found]), covariances)
    errors = ours - angles_over_time(np.stack(right))[0]
    return np.degrees(errors[:, angles]), np.degrees(stddev[:, angles])


@cache
def taught(name: str) -> tuple[SkeletonFilter, FloatArray, FloatArray]:
    """A filter after all frames, the errors of the elbows and their stated deviations, degrees."""
    tested = make_filter(name)
    return tested, *run(tested)


@cache
def untaught(name: str) -> FloatArray:
    """Errors of the elbows without the correction by the T-pose, degrees."""
    tested = make_filter(name, t_pose=False)
    errors, _ = run(tested)
    assert tested.counters["t_poses"] == 0
    return errors


def rms(errors: FloatArray) -> float:
    return float(np.sqrt(np.mean(errors**2)))


@pytest.mark.parametrize("name", FILTERS)
def test_elbows_are_bent_as_they_are_after_a_t_pose(name: str) -> None:
    with_it, errors, stddev = taught(name)
    assert with_it.counters["t_poses"] == 1
    assert rms(untaught(name)) > 12.0
    assert rms(errors) < 0.4 * rms(untaught(name))
    assert (np.abs(errors) < 1.96 * stddev).mean() > 0.95


@pytest.mark.parametrize("name", FILTERS)
def test_they_are_not_too_sure_of_where_arms_point(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A person's own deviation from a T-pose is as large as a camera's errors: linear filters gain no certainty.

    The bend of the spine, of which the pose tells nothing, is left out of the deviations.
    """
    monkeypatch.setattr(positional, "_bend_variance", lambda _positions: 0.0)
    # posture makes the extended filter surer of arms without the pose, too
    alone = {"posture": False} if name == "ekf" else {}
    errors, stddev = run(make_filter(name, **alone), HOLDING, angles=ARMS)
    _, unsure = run(make_filter(name, t_pose=False, **alone), HOLDING, angles=ARMS)
    # the offsets of neighbouring joints are correlated before and after the pose, so that it tells less: 0.86
    assert np.median(stddev) < (0.9 if name == "ekf" else 1.02) * np.median(unsure)
    assert (np.abs(errors) < 1.96 * stddev).all()


@pytest.mark.parametrize("name", some(FILTERS))
def test_who_is_not_seen_for_a_moment_need_not_hold_the_pose_again(name: str) -> None:
    errors, _ = run(make_filter(name), left_out=range(100, 100 + round(GAP * RATE)))
    assert rms(errors) < 0.4 * rms(untaught(name))


INPUTS = [("lkf_constant_velocity", graph.FUSED_INPUT), ("ekf", graph.FUSED_INPUT), ("ekf", graph.SENSORS_INPUT)]


def hosted(name: str, source: str, **values: Any) -> FilterStage:
    given = {"filter": name, "input": source, "sensors": ("kinect1",), "kinect_v2": False, **values}
    stage = FilterStage(check_all(FilterStage.PARAMETERS, given))
    stage.take(graph.CALIBRATION, SensorPose("kinect1", np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0])), Now(0, 0))
    return stage


def fed(stage: FilterStage, frames: Iterable[Skeleton]) -> list[Skeleton]:
    """The filtered skeletons."""
    topic = graph.FUSED if graph.FUSED in {port.topic for port in stage.inputs} else graph.skeleton_topic("kinect1")
    found = []
    for each in frames:
        now = Now(each.stamp_ns, each.stamp_ns)
        outputs = [*stage.take(topic, (each,), now), *stage.poll(now.steady_ns)]
        found += [body for output in outputs if output.topic == graph.FILTERED for body in output.payload]
    return found


def others(away: float) -> list[Skeleton]:
    """Another person, whose joints are seen where they are, this many seconds after the end of the first one's pose."""
    first = skeletons()[MOVING.start].stamp_ns
    later_ns = skeletons()[HOLDING.stop - 1].stamp_ns + round(away * NANOSECONDS) - first
    covariances = BASE_STDDEV[:, None, None] ** 2 * np.eye(3)
    return [
        Skeleton(each.stamp_ns + later_ns, each.frame_id, true, TRACKED, body=2, covariances=covariances)
        for each, true in zip(skeletons()[MOVING.start : MOVING.start + 15], reaching()[MOVING.start :], strict=False)
    ]


@pytest.mark.parametrize(("name", "source"), INPUTS)
def test_another_person_is_filtered_as_if_nobody_had_been_there(name: str, source: str) -> None:
    """But for the lengths, which the extended filter keeps, as mostly the same person comes back."""
    stage, alone = hosted(name, source), hosted(name, source)
    fed(stage, skeletons()[: HOLDING.stop])
    stage.state(0)
    assert stage.counters["t_poses"] == 1 and "T-pose" in stage.events.pop()
    start_ns = others(HOLD + 0.1)[0].stamp_ns  # the frames before are predicted
    found, expected = (
        [seen for seen in fed(each, others(HOLD + 0.1)) if seen.stamp_ns >= start_ns] for each in (stage, alone)
    )
    assert len(found) >= len(expected) > 10
    for one, other in zip(found[len(found) - len(expected) :], expected, strict=True):
        if name == "ekf":
            assert np.nanmax(np.abs(one.positions - other.positions)) < 0.02
        else:
            assert_array_equal(one.positions, other.positions)
            assert_array_equal(one.covariances, other.covariances)
    stage.state(0)
    assert "the T-pose no longer counts" in stage.events.pop()


@pytest.mark.parametrize(("name", "source"), INPUTS)
def test_who_is_away_for_less_keeps_the_pose(name: str, source: str) -> None:
    stage = hosted(name, source)
    fed(stage, skeletons()[: HOLDING.stop])
    fed(stage, others(HOLD - 0.1))
    assert stage.counters["t_poses_forgotten"] == 0


def test_who_wears_a_sensor_is_never_another_person() -> None:
    stage = hosted("ekf", graph.SENSORS_INPUT, orientations=("forearm_left",))
    fed(stage, skeletons()[: HOLDING.stop])
    start_ns = skeletons()[HOLDING.stop - 1].stamp_ns
    for number in range(1, round(HOLD + 1.0) * 10):
        stamp_ns = start_ns + number * NANOSECONDS // 10
        worn = SegmentOrientation(stamp_ns, "left", "forearm_left", np.eye(3), np.eye(3))
        stage.take(graph.orientation_topic("forearm_left"), worn, Now(stamp_ns, stamp_ns))
    fed(stage, others(HOLD + 1.1))
    assert stage.counters["t_poses_forgotten"] == 0


@pytest.mark.parametrize(("name", "source"), INPUTS)
def test_only_a_change_that_concerns_the_estimate_forgets_the_pose(name: str, source: str) -> None:
    stage, same = hosted(name, source), hosted(name, source)
    prefix = "ekf." if name == "ekf" else ""
    foreign = "measurement_noise_scale" if name == "ekf" else "ekf.predict_for"
    for each in (stage, same):
        fed(each, skeletons()[: HOLDING.stop])
        each.state(0)
        each.events.clear()
    stage.change({**stage.values, "predict_after": 0.5, "order_wait": 0.01, foreign: 0.7})
    following = skeletons()[HOLDING.stop : HOLDING.stop + 15]
    for one, other in zip(fed(stage, following), fed(same, following), strict=True):
        assert_array_equal(one.positions, other.positions)
    assert not stage.events
    stage.change({**stage.values, f"{prefix}predict_for": 0.7})
    assert "the T-pose no longer counts" in stage.events.pop()


@pytest.mark.parametrize(("name", "source"), INPUTS)
def test_a_stage_that_restarts_after_errors_knows_nobody(name: str, source: str) -> None:
    stage, fresh = hosted(name, source), hosted(name, source)
    fed(stage, skeletons()[: HOLDING.stop])
    stage.restart()
    assert stage.counters["t_poses_forgotten"] == 1
    following = skeletons()[HOLDING.stop : HOLDING.stop + 15]
    for one, other in zip(fed(stage, following), fed(fresh, following), strict=True):
        assert_array_equal(one.positions, other.positions)


def test_lengths_are_those_between_the_joints_as_they_are_known_then() -> None:
    ekf, _, _ = taught("ekf")
    lengths = ekf.estimate.lengths  # type: ignore[attr-defined]
    true = reaching()[0]
    for name, start, end in (("upper_arm", "SHOULDER", "ELBOW"), ("forearm", "ELBOW", "WRIST")):
        for side in ("left", "right"):
            known = lengths[ekf.model.length_names.index(f"{name}_{side}")]  # type: ignore[attr-defined]
            real = np.linalg.norm(true[Joint[f"{end}_{side.upper()}"]] - true[Joint[f"{start}_{side.upper()}"]])
            assert known == pytest.approx(real, abs=0.015)
