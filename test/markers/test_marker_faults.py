"""Cameras that were moved, are out of step or send invalid images: the stages name them, count them and go on."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from rigs import images, rig, turned
from test_rig_monitor import Arm, calibrated

from body_tracking.core.message_types import IMAGE, POINT_CLOUD
from body_tracking.core.parameters import check_all
from body_tracking.core.skeleton import NANOSECONDS, FloatArray
from body_tracking.markers import setup
from body_tracking.markers.codecs import Balls, SpacePoints
from body_tracking.markers.observations import ImageBalls, Points
from body_tracking.markers.rig import Rig
from body_tracking.markers.rig_monitor import Fault, Finding
from body_tracking.markers.rig_storage import save_rig
from body_tracking.markers.stages import DetectorStage, TrackerStage, TriangulationStage
from body_tracking.messages.base import to_header
from body_tracking.messages.images import array_to_image
from body_tracking.pipeline.offline import OfflineRunner
from body_tracking.pipeline.stage import Now
from body_tracking.recording.rosbag2 import BAG_MESSAGES, BAG_WIRE
from body_tracking.simulation.marker_scene import stereo_rig
from draws import draws, some

RATE = 60
START_NS, MS = 1_750_000_000 * NANOSECONDS, 1_000_000
CAMERAS = "abc"


@lru_cache
def nominal(seed: int) -> Rig:
    return calibrated(3, seed)


class Watched:
    """The stage of a rig of three cameras, before which three targets move."""

    def __init__(self, folder: Path, seed: int, speed: float) -> None:
        save_rig(nominal(seed), folder / setup.RIG)
        self.stage = TriangulationStage(check_all(TriangulationStage.PARAMETERS, {"setup": str(folder), "tf": False}))
        self.rng = np.random.default_rng(seed)
        self.arm, self.frame = Arm(speed, self.rng), 0

    def run(self, frames: int, truth: Rig, late: tuple[float, ...] = (0.0, 0.0, 0.0)) -> str:
        """Text of the diagnostics after ``frames`` frames of a rig; ``late`` is each camera's delay, seconds."""
        for _ in range(frames):
            stamp_ns = START_NS + round(self.frame / RATE * NANOSECONDS)
            points = [self.arm.at(self.frame / RATE - delay) for delay in late]
            for balls in images(truth, points, self.rng, stamp_ns=stamp_ns)[0]:
                message = Balls().decode(Balls().encode(balls, BAG_WIRE), BAG_WIRE)
                list(self.stage.take(setup.balls_topic(balls.camera), message, Now(stamp_ns, stamp_ns)))
            self.frame += 1
            list(self.stage.poll(stamp_ns))
        return self.stage.state(0)[1]


def test_points_without_a_target_are_named_after_two_seconds() -> None:
    """As where a camera was moved along the epipolar lines, or the file is of other targets."""
    folder = Path(__file__).resolve().parents[2] / "config" / "five_systems"
    stage, rng = TrackerStage(check_all(TrackerStage.PARAMETERS, {"setup": str(folder)})), np.random.default_rng(0)

    def text_after(first: int, last: int, points: int) -> str:
        for frame in range(first, last):
            covariance = np.broadcast_to(1e-8 * np.eye(3), (points, 3, 3))
            seen = Points(
                START_NS + frame * NANOSECONDS // 30,
                "left_optical_frame",
                rng.normal(size=(points, 3)),
                covariance,
                np.empty((points, 0), np.intp),
            )
            list(stage.take(setup.POINTS, seen, Now(seen.stamp_ns, seen.stamp_ns)))
        return stage.state(0)[1]

    assert text_after(0, 30, 0) == ""
    assert text_after(30, 50, 10) == ""
    assert text_after(50, 300, 10).startswith("no target among 9 points: was a camera moved since the calibration")
    stage.reset(setup.POINTS)
    assert text_after(0, 2, 10) == "" and text_after(2, 90, 2) == ""


def turn(rng: np.random.Generator) -> FloatArray:
    """A rotation vector of 0.2 degrees about a random axis."""
    axis = rng.normal(size=3)
    return np.asarray(np.radians(0.2) * axis / np.linalg.norm(axis))


@pytest.mark.parametrize("seed", range(draws(1, 8)))
def test_a_camera_turned_in_mid_run_is_named_within_a_second(tmp_path: Path, seed: int) -> None:
    watched = Watched(tmp_path, seed, 1.0)
    assert watched.run(RATE // 2, rig(3)) == ""
    assert watched.run(RATE, turned(rig(3), 1, turn(watched.rng))).startswith("moved camera: b")
    assert [event.startswith("moved camera: b") for event in watched.stage.events] == [True]
    assert watched.stage.counters["moved camera found"] >= 1
    # a jump of time forgets it, and once put right it is not reported any more
    watched.stage.reset(setup.balls_topic("a"))
    assert watched.run(RATE // 2, rig(3)) == ""


def test_a_finding_names_all_cameras_that_may_have_moved() -> None:
    assert str(Finding(Fault.MOVED_CAMERA, ("a", "b"), 0.0035, 1e-4)) == (
        "moved camera: a or b by 0.20 deg (which of them, the images cannot tell)"
    )
    assert str(Finding(Fault.OUT_OF_STEP, ("b",), 0.0167, 1e-4)) == "cameras out of step: b by 16.7 ms"


@pytest.mark.parametrize("late", some([(0.0, 0.0, 1.0 / RATE), (0.0, 0.0, -1.0 / RATE)]))
def test_a_camera_that_is_a_frame_late_or_early_is_named_as_that(
    tmp_path: Path, late: tuple[float, float, float]
) -> None:
    watched = Watched(tmp_path, 0, 1.0)
    said = watched.run(RATE, rig(3), late)
    assert said.startswith("cameras out of step: c by 1")  # 16.7 ms within some tenths
    assert watched.stage.counters["cameras out of step found"] >= 1


def test_a_fast_arm_is_no_fault(tmp_path: Path) -> None:
    watched = Watched(tmp_path, 0, 4.0)
    assert watched.run(2 * RATE // 3, rig(3)) == "" and not watched.stage.events


def test_stamps_out_of_step_are_named_and_the_right_pairs_still_made(tmp_path: Path) -> None:
    """One camera's stamps are off by 6.7 ms: none of its images has a partner; then they are right again."""
    watched = Watched(tmp_path, 0, 1.0)
    shift, found = round(0.4 / RATE * NANOSECONDS), []
    for number in range(60):
        for balls in images(rig(3), [watched.arm.at(0.0)] * 3, watched.rng)[0]:
            stamp_ns = START_NS + round(number / RATE * NANOSECONDS)
            stamp_ns += shift if balls.camera == "b" and number < 40 else 0
            taken = watched.stage.take(
                setup.balls_topic(balls.camera), replace(balls, stamp_ns=stamp_ns), Now(stamp_ns, stamp_ns)
            )
            found += [output for output in taken if output.topic == setup.POINTS]
        found += watched.stage.poll(START_NS + round(number / RATE * NANOSECONDS))
        if number == 39:
            level, said, _ = watched.stage.state(0)
            assert level == 1 and said.startswith("b lacks in") and "6.7 ms after those of a" in said
    assert watched.stage.state(0)[1] == ""
    # in the first 40 frames the other two cameras alone make points, some of them spurious
    assert min(len(output.payload.positions) for output in found) >= 15 and len(found) >= 58


def test_balls_in_a_drivers_own_frame_are_those_of_the_topics_camera(tmp_path: Path) -> None:
    watched = Watched(tmp_path, 0, 0.0)
    found = []
    for balls in images(rig(3), [watched.arm.at(0.0)] * 3, watched.rng, stamp_ns=START_NS)[0]:
        other = replace(balls, camera="infra1")
        found += list(watched.stage.take(setup.balls_topic(balls.camera), other, Now(START_NS, START_NS)))
    assert len(found) == 1 and len(found[0].payload.positions) == 15
    assert watched.stage.counters["balls in another frame"] == 3


# --- images

SIZE = (480, 640)


def spots(kind: type = np.uint8) -> NDArray[Any]:
    """Three round balls of four pixels' radius, on a dark ground."""
    rows, columns = np.mgrid[: SIZE[0], : SIZE[1]]
    light = np.zeros(SIZE)
    for v, u in ((100, 150), (240, 320), (350, 500)):
        light += np.clip(4.5 - np.hypot(rows - v, columns - u), 0.0, 1.0)
    return np.asarray(200 / 255 * np.iinfo(kind).max * light + 2, dtype=kind)


def message(pixels: NDArray[Any], encoding: str = "") -> Any:
    made = array_to_image(pixels, START_NS, "left_optical_frame", BAG_MESSAGES)
    made.encoding = encoding or made.encoding
    return made


def seen(folder: Path, *messages: Any) -> tuple[list[ImageBalls], DetectorStage, int]:
    """Balls in images of the left camera, the detector's stage, and the number of refused images."""
    save_rig(stereo_rig(), folder / setup.RIG)
    stage = DetectorStage(check_all(DetectorStage.PARAMETERS, {"setup": str(folder)}))
    found: list[ImageBalls] = []
    runner = OfflineRunner([stage], BAG_WIRE, lambda topic, cdr, at: found.append(Balls().decode(cdr, BAG_WIRE)))
    for number, each in enumerate(messages):
        each.header = to_header(START_NS + number * 33 * MS, "left_optical_frame", BAG_MESSAGES)
        runner.push(setup.image_topic("left"), BAG_WIRE.serialize(IMAGE, each), START_NS)
    return found, stage, sum(runner.counters.values())


@pytest.mark.parametrize(
    ("bad", "refused", "counted", "said"),
    [
        (message(np.repeat(spots(), 3, axis=1)[:, :640], "rgb8"), 1, "", ""),
        (message(spots()[:240, :320]), 1, "images of another size", "320 x 240 pixels, calibrated were 640 x 480"),
        (message(np.full(SIZE, 255, np.uint8)), 0, "saturated images", "100 % of the pixels are saturated"),
        (message(np.full(SIZE, 65535, np.uint16)), 0, "saturated images", "100 % of the pixels are saturated"),
        (message(np.zeros(SIZE, np.uint8)), 0, "images without balls", ""),
        (message(np.random.default_rng(0).integers(0, 255, SIZE, np.uint8)), 0, "images without balls", ""),
        (message(np.full((480, 1280), 0x7FC0, np.uint16)[:, :640], "32FC1"), 1, "", ""),
        (message(np.zeros((0, 640), np.uint8)), 1, "", ""),
    ],
    ids=["colour", "size", "saturated", "saturated, 16 bits", "dark", "noise", "NaN", "empty"],
)
def test_unusable_images_are_reported_and_survived(
    tmp_path: Path, bad: Any, refused: int, counted: str, said: str
) -> None:
    found, stage, count = seen(tmp_path, message(spots()), bad)
    assert count == refused and len(found) == 2 - refused
    assert not counted or stage.counters[counted] == 1
    assert said in stage.state(0)[1] and bool(stage.state(0)[0]) == bool(said)
    assert stage.counters["images without balls"] == (counted != "" and not refused)
    # the next image is handled as usual
    again, stage, _ = seen(tmp_path, bad, message(spots(np.uint16)))
    assert len(again[-1].pixels) == 3 and stage.state(0)[0] == 0


def test_balls_that_are_not_finite_are_refused_and_survived(tmp_path: Path) -> None:
    save_rig(stereo_rig(), tmp_path / setup.RIG)
    stage = TriangulationStage(check_all(TriangulationStage.PARAMETERS, {"setup": str(tmp_path), "tf": False}))
    found = []
    runner = OfflineRunner([stage], BAG_WIRE, lambda topic, cdr, at: found.append(SpacePoints().decode(cdr, BAG_WIRE)))
    pixels = stereo_rig().project(np.array([[0.2, 0.0, 1.0]]))
    for number, broken in enumerate((True, False)):
        stamp_ns = START_NS + number * 33 * MS
        for index, camera in enumerate(("left", "right")):
            place = np.full((1, 2), np.nan) if broken and not index else pixels[index]
            balls = ImageBalls(stamp_ns, f"{camera}_optical_frame", place, np.ones(1), 0.01 * np.eye(2)[None])
            runner.push(setup.balls_topic(camera), Balls().encode(balls, BAG_WIRE), stamp_ns)
    runner.finish(stamp_ns)
    assert runner.counters == {"malformed /left/balls": 1} and Balls.type_name == POINT_CLOUD
    assert [len(points.positions) for points in found] == [1] and stage.counters["incomplete sets"] == 1
    np.testing.assert_allclose(found[0].positions, [[0.2, 0.0, 1.0]], atol=1e-4)
