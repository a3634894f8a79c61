"""Skeletons whose axes or units are wrong are reported, and no person who bends or walks."""

from __future__ import annotations

import re
from typing import Final

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from two_kinects import FRAME, POSES

from body_tracking.calibration.stage import CalibrationStage
from body_tracking.core.parameters import check_all
from body_tracking.core.skeleton import NANOSECONDS, FloatArray, Skeleton
from body_tracking.fusion.stage import FusionStage
from body_tracking.pipeline import graph
from body_tracking.pipeline.stage import Now, Stage
from walkers import walk

TIMES: Final = np.arange(0.0, 6.0, FRAME)


def given(stage: Stage, positions: FloatArray) -> tuple[int, str]:
    """Level and text of a stage after one sensor's positions at ``TIMES``, with noise of a millimetre."""
    noise = 0.001 * np.random.default_rng(0).normal(size=positions.shape)
    for time, points in zip(TIMES, positions + noise, strict=True):
        stamp_ns = NANOSECONDS + round(time * NANOSECONDS)
        skeleton = Skeleton(stamp_ns, "kinect1_optical_frame", points, np.full(25, 2, np.uint8))
        list(stage.take(graph.skeleton_topic("kinect1"), (skeleton,), Now(stamp_ns, stamp_ns)))
        list(stage.poll(stamp_ns))
    return stage.state(0)[:2]


def state_after(positions: FloatArray) -> tuple[int, str]:
    """Level and text of the fusion."""
    stage = FusionStage(check_all(FusionStage.PARAMETERS, {"sensors": ("kinect1",)}))
    list(stage.take(graph.CALIBRATION, POSES["kinect1"], Now(0, 0)))
    return given(stage, positions)


@pytest.mark.parametrize("axes", [(1.0, -1.0, 1.0), (-1.0, -1.0, 1.0)])
def test_a_person_upside_down_is_reported(axes: tuple[float, float, float]) -> None:
    level, text = state_after(walk(TIMES) * np.array(axes))
    assert level == 1
    assert text.startswith("the person is upside down in world: are the axes")


def test_a_person_who_walks_or_bends_down_is_not() -> None:
    assert state_after(walk(TIMES)) == (0, "")
    turn = Rotation.from_euler("x", 110.0, degrees=True)  # the head is lower than the hips
    points = walk(TIMES)
    bent = turn.apply((points - points[:, :1]).reshape(-1, 3)).reshape(points.shape) + points[:, :1]
    assert state_after(bent) == (0, "")


@pytest.mark.parametrize(
    ("sensor", "frame", "reported"),
    [
        ("kinect1", "kinect2_optical_frame", True),
        ("kinect1", "kinect1_optical_frame", False),
        ("kinect1", "depth_camera_link", False),
        ("kinect1", "", False),
    ],
)
def test_skeletons_in_the_frame_of_another_sensor_are_reported(sensor: str, frame: str, reported: bool) -> None:
    """As of two drivers that are mixed up; a driver may give its own frame any other name."""
    stage = CalibrationStage(check_all(CalibrationStage.PARAMETERS, {"sensors": ("kinect1", "kinect2")}))
    for own in (frame, f"{sensor}_optical_frame"):
        skeleton = Skeleton(NANOSECONDS, own, walk(TIMES)[0], np.full(25, 2, np.uint8))
        list(stage.take(graph.skeleton_topic(sensor), (skeleton,), Now(NANOSECONDS, NANOSECONDS)))
        level, text = stage.state(0)[:2]
        named = f"{sensor}: its skeletons are in {frame}, of another sensor; "
        assert (level == 1 and text.startswith(named)) == (reported and own == frame)


@pytest.mark.parametrize("unit", [1000.0, 100.0, 0.01])
def test_coordinates_in_another_unit_are_reported(unit: float) -> None:
    stage = CalibrationStage(check_all(CalibrationStage.PARAMETERS, {"sensors": ("kinect1",)}))
    level, text = given(stage, unit * walk(TIMES))
    assert level == 1
    assert re.match(r"kinect1: a trunk of [\d.]+ m, coordinates must be metres; ", text)
    assert given(stage, walk(TIMES + TIMES[-1] + 1.0))[0] == 0
