"""Reads recordings of the baseline tests: trials of a robot arm, and pendulums."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from body_tracking.camera.codecs import ColourImage, CompressedColour, CompressedDepth
from body_tracking.camera.registration import is_registered
from body_tracking.camera.topics import COMPRESSED, COMPRESSED_DEPTH, CameraTopics, info_beside
from body_tracking.core.camera import Camera
from body_tracking.core.message_types import POSE_ARRAY
from body_tracking.core.skeleton import NANOSECONDS, FloatArray, SingleArray
from body_tracking.evaluation.balls import bright_balls, red_balls
from body_tracking.evaluation.reading import EvaluationError
from body_tracking.evaluation.robot_arm import BALLS, Trial
from body_tracking.markers.camera_images import DriverCodec, DriverImage
from body_tracking.mesh.codecs import DepthImage
from body_tracking.messages.base import MessageError
from body_tracking.messages.codecs import CameraInfo, Codec
from body_tracking.messages.points import pose_array_to_points
from body_tracking.recording.progress import Progress
from body_tracking.recording.rig import RigReader
from body_tracking.recording.rosbag2 import BAG_WIRE, deserialize

_TOLERANCE_NS: Final = NANOSECONDS // 50
"""Largest difference between the stamps of two simultaneous images."""
_KEPT: Final = 30
"""Largest number of images kept for their counterparts."""
_MOST: Final = 0.5
"""Least share of usable images for a test."""

_Image = tuple[int, NDArray[Any]]
"""Stamp in nanoseconds, pixels."""


@dataclass(frozen=True, slots=True, eq=False)
class PendulumTrack:
    """A pendulum's ball in the images of a camera.

    Attributes:
        times: (n,) s after the first image, by the stamps.
        points: (n, 2) undistorted image coordinates x/z and y/z; NaN unless exactly one ball is detected.
    """

    times: FloatArray
    points: FloatArray


def _source(bag: RigReader, path: Path, choices: Mapping[str, Codec]) -> tuple[str, Codec]:
    """The first of some topics that exists in a bag."""
    for topic, codec in choices.items():
        if topic in bag.topics:
            if bag.topics[topic].type_name != codec.type_name:
                raise EvaluationError(
                    f"{path}: {topic} is of type {bag.topics[topic].type_name}, expected {codec.type_name}"
                )
            return topic, codec
    raise EvaluationError(f"{path}: nothing on {' or '.join(choices)}")


def _decoded(path: Path, topic: str, codec: Codec, cdr: bytes) -> Any:
    """The payload of a message; raises EvaluationError with path and topic for an unusable one."""
    try:
        return codec.decode(cdr, BAG_WIRE)
    except MessageError as error:
        raise EvaluationError(f"{path}: {topic}: {error}") from error


def _camera(bag: RigReader, path: Path, topic: str) -> Camera:
    """The first calibration on a topic."""
    codec = CameraInfo()
    _source(bag, path, {topic: codec})
    for raw in bag.messages([topic]):
        camera: Camera = _decoded(path, topic, codec, raw.cdr)
        return camera
    raise EvaluationError(f"{path}: nothing on {topic}")


def _pairs(
    bag: RigReader, path: Path, image: tuple[str, Codec], depth: tuple[str, Codec]
) -> Iterator[tuple[int, NDArray[Any], SingleArray]]:
    """Stamps in nanoseconds and simultaneous images, with progress on stderr."""
    waiting: tuple[deque[_Image], deque[_Image]] = deque(), deque()
    sides = {image[0]: (waiting[0], image[1]), depth[0]: (waiting[1], depth[1])}
    progress = Progress(0, sum(bag.topics[topic].count for topic in sides))
    for number, raw in enumerate(bag.messages(sides)):
        side, codec = sides[raw.topic]
        payload = _decoded(path, raw.topic, codec, raw.cdr)
        driver = isinstance(payload, DriverImage)
        side.append((payload.stamp_ns, payload.pixels) if driver else (payload[0], payload[2]))
        yield from _matched(*waiting)
        progress.at(number)
    progress.end()


def _matched(images: deque[_Image], depths: deque[_Image]) -> Iterator[tuple[int, NDArray[Any], SingleArray]]:
    """Remove and yield image pairs whose depth image is certain; both queues are in order of stamps.

    The tolerance may exceed the frame interval, so that the nearest images must be matched.
    """
    while images and depths and depths[-1][0] >= images[0][0]:
        stamp_ns, pixels = images.popleft()
        nearest = min(depths, key=lambda each: abs(each[0] - stamp_ns))
        apart = abs(nearest[0] - stamp_ns)
        if apart <= _TOLERANCE_NS and not (images and abs(images[0][0] - nearest[0]) < apart):
            yield stamp_ns, pixels, nearest[1]
            while depths and depths[0][0] <= nearest[0]:
                depths.popleft()
    while len(depths) > _KEPT:
        depths.popleft()
    while len(images) > _KEPT:
        images.popleft()


def _check_size(path: Path, topic: str, image: NDArray[Any], camera: Camera) -> None:
    """Raise EvaluationError for an image whose size differs from its camera's calibration."""
    height, width = image.shape[:2]
    if (width, height) != (camera.width, camera.height):
        raise EvaluationError(
            f"{path}: {topic}: an image of {width} x {height} pixels, but the camera_info says {camera.width} x "
            f"{camera.height}"
        )


def read_arm(path: Path, topics: CameraTopics, balls_topic: str, diameter: float) -> Trial:
    """One trial of a robot arm from a bag.

    Args:
        path: of the bag.
        topics: of the camera; images may be compressed by image_transport.
        balls_topic: of the balls' positions stated by the robot.
        diameter: of the balls, metres.

    Raises:
        BagError: the bag is unreadable.
        EvaluationError: a topic is missing, or most images do not show three red balls with depth.
    """
    with RigReader(path) as bag:
        image = _source(bag, path, {topics.colour: ColourImage(), topics.colour + COMPRESSED: CompressedColour()})
        depth = _source(bag, path, {topics.depth: DepthImage(), topics.depth + COMPRESSED_DEPTH: CompressedDepth()})
        colour, view = _camera(bag, path, topics.colour_info), _camera(bag, path, topics.depth_info)
        if not is_registered(colour, view):
            raise EvaluationError(
                f"{path}: the depth images are not registered to the colour images: {topics.depth_info} has other "
                "intrinsics. Let the driver register them"
            )
        true_times, true = _robot(bag, path, balls_topic)
        times: list[float] = []
        found: list[FloatArray] = []
        numbers, without = Counter[int](), 0
        for stamp_ns, pixels, distances in _pairs(bag, path, image, depth):
            _check_size(path, image[0], pixels, colour)
            _check_size(path, depth[0], distances, view)
            balls = red_balls(pixels, distances, colour, view, 0.5 * diameter)
            times.append(stamp_ns / NANOSECONDS)
            found.append(balls.centres)
            numbers[len(balls.centres)] += 1
            without += len(balls.centres) + balls.without_depth >= len(BALLS) > len(balls.centres)
    _check_numbers(path, numbers, without)
    whole = [index for index in np.argsort(times, kind="stable") if len(found[index]) == len(BALLS)]
    placed = np.array([found[index] for index in whole])
    return Trial(path.name, np.array(times)[whole], placed, len(times), true_times, true)


def _check_numbers(path: Path, numbers: Counter[int], without: int) -> None:
    """Raise EvaluationError unless most images show three red balls."""
    images = numbers.total()
    if not images:
        raise EvaluationError(f"{path}: no colour and depth images of one time")
    if numbers[len(BALLS)] >= _MOST * images:
        return
    if without > _MOST * images:
        raise EvaluationError(f"{path}: no depth at the red balls in {without} of {images} images")
    (usual, count), *_ = numbers.most_common()
    raise EvaluationError(f"{path}: {usual} red balls in {count} of {images} images, {len(BALLS)} are needed")


def _robot(bag: RigReader, path: Path, topic: str) -> tuple[FloatArray, FloatArray]:
    """Times (m,) s and the robot's balls (m, 3, 3), metres."""
    if topic not in bag.topics:
        raise EvaluationError(f"{path}: nothing on {topic}, on which the robot states where its balls are")
    if bag.topics[topic].type_name != POSE_ARRAY:
        raise EvaluationError(f"{path}: {topic} is of type {bag.topics[topic].type_name}, expected {POSE_ARRAY}")
    times: list[float] = []
    places: list[FloatArray] = []
    for raw in bag.messages([topic]):
        try:
            stamp_ns, points = pose_array_to_points(deserialize(POSE_ARRAY, raw.cdr))
        except MessageError as error:
            raise EvaluationError(f"{path}: {topic}: {error}") from error
        if len(points) != len(BALLS):
            raise EvaluationError(f"{path}: {topic}: {len(points)} poses, expected {', '.join(BALLS)}")
        if not times or stamp_ns / NANOSECONDS > times[-1]:
            times.append(stamp_ns / NANOSECONDS)
            places.append(points)
    if len(times) < 2:
        raise EvaluationError(f"{path}: {len(times)} messages on {topic}, at least 2 are needed")
    return np.array(times), np.array(places)


def read_pendulum(path: Path, infrared: str, depth: str) -> PendulumTrack:
    """The ball of a pendulum in a bag of infrared and depth images from one camera.

    Raises:
        BagError: the bag is unreadable.
        EvaluationError: a topic is missing, or most images do not show one retro-reflective ball.
    """
    numbers, bright = Counter[int](), 0
    stamps, pixels = [], []
    with RigReader(path) as bag:
        image = _source(bag, path, {infrared: DriverCodec()})
        distances = _source(bag, path, {depth: DepthImage(), depth + COMPRESSED_DEPTH: CompressedDepth()})
        camera = _camera(bag, path, info_beside(infrared))
        for stamp_ns, light, far in _pairs(bag, path, image, distances):
            _check_size(path, image[0], light, camera)
            _check_size(path, distances[0], far, camera)
            found = bright_balls(light, far)
            numbers[len(found.pixels)] += 1
            bright += not len(found.pixels) and found.with_depth > 0
            stamps.append(stamp_ns)
            pixels.append(found.pixels[0] if len(found.pixels) == 1 else (np.nan, np.nan))
    images = numbers.total()
    if not images:
        raise EvaluationError(f"{path}: no infrared and depth images of one time")
    if numbers[1] < _MOST * images:
        if bright > _MOST * images:
            raise EvaluationError(
                f"{path}: what is bright has depth in {bright} of {images} images, so that it is no retro-reflective "
                "ball"
            )
        (usual, count), *_ = numbers.most_common()
        raise EvaluationError(f"{path}: {usual} retro-reflective balls in {count} of {images} images, 1 is needed")
    order = np.argsort(stamps, kind="stable")
    times = (np.array(stamps, dtype=np.int64)[order] - min(stamps)) / NANOSECONDS
    return PendulumTrack(times, camera.undistort(np.array(pixels, dtype=np.float64)[order]))
