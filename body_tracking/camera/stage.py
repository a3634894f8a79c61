"""Colour and depth images to skeletons: the stage of the node ``camera_skeleton``."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import fields
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from body_tracking.camera import lifting, registration
from body_tracking.camera.codecs import ColourImage, CompressedColour, CompressedDepth
from body_tracking.camera.lifting import is_flat, lift
from body_tracking.camera.pictures import RATE, Pictures
from body_tracking.camera.pose_model import ImageArray, Landmarks
from body_tracking.camera.registration import Registration, is_registered, moved
from body_tracking.camera.settings import DRIVER, MODEL, PEOPLE, SEARCH, THREADS, WAIT_NS, image_port, trackers_of
from body_tracking.camera.topics import COMPRESSION, DRIVERS, CameraTopics, images_of
from body_tracking.core.camera import Camera, CameraError
from body_tracking.core.parameters import Numbers, Parameter, Value
from body_tracking.core.qos import LATCHED
from body_tracking.core.repeats import REPEATED, Repeats
from body_tracking.core.sensor_poses import SensorPose
from body_tracking.core.skeleton import NANOSECONDS, SingleArray, Skeleton
from body_tracking.core.sources import check_sensor_name, optical_frame
from body_tracking.markers.pairing import FrameSets
from body_tracking.mesh.codecs import DepthImage
from body_tracking.mesh.depth import DepthError, check_size
from body_tracking.mesh.person import COVERED, is_covered
from body_tracking.messages.codecs import CameraInfo, Skeletons
from body_tracking.pipeline import graph
from body_tracking.pipeline.shared import RELIABLE as TRANSPORT
from body_tracking.pipeline.shared import skeleton_qos
from body_tracking.pipeline.stage import Now, Output, Port, Stage

CAMERA = Parameter("camera", "camera1", "name of the camera; the node publishes /<camera>/skeleton")
_TOPICS = tuple(
    Parameter(
        f"{field.name}_topic",
        "",
        f"topic of the {what}, with {{camera}} for the camera's name; empty for that of the driver",
    )
    for field, what in zip(
        fields(CameraTopics),
        ("colour images", "colour images' camera_info", "depth images", "depth images' camera_info"),
        strict=True,
    )
)
_COMPRESSED = Parameter(
    "compressed",
    "none",
    "which images come compressed by image_transport: none, colour (JPEG or PNG), or both (depth in PNG)",
    choices=COMPRESSION,
)
_DEPTH_POSE = Parameter(
    "depth_pose",
    Numbers((0.0,) * 7),
    "pose of the depth camera in the colour camera's optical frame: x, y, z in metres and the quaternion x, y, z, w; "
    "all 0 where the driver registers the depth images to the colour images",
)
_TOLERANCE = Parameter(
    "tolerance", 0.02, "largest difference between the stamps of a colour and a depth image of one time", "s", 0.0, 0.5
)

_COLOUR, _DEPTH = "colour", "depth"
_ROUNDED = 0.02
"""By which the length of a quaternion may differ from 1: its numbers may be written with one digit."""
FLAT: Final = "the person is flat: a picture of one?"


class CameraStage(Stage):
    """Finds people in the colour images of a camera, and the depth of their joints in its depth images."""

    NAME = "camera_skeleton"
    PARAMETERS = (
        CAMERA,
        DRIVER,
        *_TOPICS,
        _COMPRESSED,
        _DEPTH_POSE,
        MODEL,
        PEOPLE,
        SEARCH,
        _TOLERANCE,
        THREADS,
        RATE,
        TRANSPORT,
    )

    def __init__(self, values: Mapping[str, Value], wanted: Callable[[str], bool] = lambda topic: True) -> None:
        super().__init__(values, wanted)
        prepare()
        self._name = check_sensor_name(str(values["camera"]))
        self._pose = _pose(values["depth_pose"])
        self._tracker = trackers_of(values)()
        self._pictures = Pictures(self._name, float(str(values["picture_rate"])), wanted)
        self._topics = topics = topics_of(self._name, values)
        self._counters: Counter[str] = Counter()
        self._people = 0
        self._problem = ""
        self._infos: dict[str, Camera] = {}
        self._registration: Registration | None = None
        tolerance_ns = round(float(str(values["tolerance"])) * NANOSECONDS)
        self._repeats = {_COLOUR: Repeats(), _DEPTH: Repeats()}
        self._sets: FrameSets[Any] = FrameSets((_COLOUR, _DEPTH), tolerance_ns, WAIT_NS)
        compressed = str(values["compressed"])
        colour, depth = images_of(topics, compressed)
        self._kinds = {colour: _COLOUR, depth: _DEPTH, topics.colour_info: _COLOUR, topics.depth_info: _DEPTH}
        self.inputs = (
            image_port(colour, ColourImage() if compressed == "none" else CompressedColour(), values),
            image_port(depth, CompressedDepth() if compressed == "both" else DepthImage(), values),
            *(Port(topic, CameraInfo(), LATCHED, foreign=True) for topic in (topics.colour_info, topics.depth_info)),
        )
        self._skeletons = graph.skeleton_topic(self._name)
        self.outputs = (
            Port(self._skeletons, Skeletons(), skeleton_qos(values), measured=True),
            *self._pictures.ports,
        )

    def take(self, topic: str, payload: Any, now: Now) -> Iterable[Output]:
        kind = self._kinds[topic]
        if isinstance(payload, Camera):
            self._calibrate(kind, payload)
            return ()
        stamp_ns, _, pixels = payload
        return self._outputs(self._sets.push(kind, stamp_ns, (stamp_ns, pixels), now.steady_ns))

    def poll(self, steady_ns: int) -> Iterable[Output]:
        return self._outputs(self._sets.poll(steady_ns))

    @property
    def deadline_ns(self) -> int | None:
        return self._sets.deadline_ns

    def refused(self, topic: str) -> None:
        """Count a message of another encoding, or a calibration that cannot be used."""
        info = " info" * (topic in (self._topics.colour_info, self._topics.depth_info))
        self._counters[f"{self._kinds[topic]}{info} messages that cannot be used"] += 1

    def reset(self, topic: str) -> None:
        """Forget people and images."""
        self._sets.reset()
        self._tracker.reset()
        self._people = 0

    def state(self, ros_ns: int) -> tuple[int, str, dict[str, object]]:
        """Why there is no skeleton: no calibration, images of other sizes or times, or a picture of a person."""
        problem = self._problem or self._sets.problem()
        return (1 if problem else 0), problem, {"people": self._people}

    @property
    def counters(self) -> Mapping[str, int]:
        unpaired = {"images without the other one": self._sets.incomplete, "images that came too late": self._sets.late}
        return {**self._counters, **self._tracker.counters, **unpaired}

    def _calibrate(self, kind: str, camera: Camera) -> None:
        """Take the intrinsics of the colour or the depth images; CameraError for depth that is not registered."""
        known = self._infos.get(kind)
        if known is not None and known.is_like(camera):
            return
        self._infos[kind] = camera
        self._registration = None
        if len(self._infos) < 2:
            return
        colour, depth = self._infos[_COLOUR], self._infos[_DEPTH]
        if self._pose is None and not is_registered(colour, depth):
            self._problem = (
                f"the depth images are not registered to the colour images: {self._topics.depth_info} has other "
                "intrinsics. Let the driver register them, or set depth_pose"
            )
            raise CameraError(self._problem)
        self._problem = ""
        self._registration = Registration(depth, colour, self._pose)

    def _outputs(self, sets: Iterable[Mapping[str, Any]]) -> Iterator[Output]:
        for images in sets:
            (stamp_ns, colour), (_, depth) = images[_COLOUR], images[_DEPTH]
            landmarks: dict[int, Landmarks] = {}
            skeletons = self._people_in(stamp_ns, colour, depth, landmarks)
            if skeletons:
                yield Output(self._skeletons, skeletons, stamp_ns)
            yield from self._pictures.of(stamp_ns, colour, landmarks.values())

    def _people_in(
        self, stamp_ns: int, colour: ImageArray, depth: SingleArray, landmarks: dict[int, Landmarks]
    ) -> tuple[Skeleton, ...]:
        """The people with depth; ``landmarks`` gets those of everybody in the colour image."""
        self._people = 0
        if self._registration is None:
            self._counters["images without camera_info"] += 1
            missing = [
                topic
                for what, topic in ((_COLOUR, self._topics.colour_info), (_DEPTH, self._topics.depth_info))
                if what not in self._infos
            ]
            self._problem = self._problem or f"no calibration: nothing on {', '.join(missing)}"
            return ()
        self._check(colour, depth)
        self._counters["pairs of images"] += 1
        self._problem = COVERED if is_covered(depth) else ""
        images = ((_COLOUR, colour), (_DEPTH, depth))
        repeated = [what for what, image in images if self._repeats[what].add(stamp_ns, image)]
        if repeated and not self._problem:
            self._counters[f"repeated images of {self._name}"] += 1
            self._problem = REPEATED.format(f"{' and '.join(repeated)} image")
            return ()
        seen = self._registration(depth)
        source, camera = self._infos[_COLOUR], self._registration.camera
        found = []
        landmarks |= self._tracker.update(stamp_ns, colour)
        for number, each in landmarks.items():
            there = moved(each, source, camera)
            if is_flat(there, seen, camera):
                self._counters["pictures of people"] += 1
                self._problem = FLAT
                continue
            lifted = lift(there, seen, camera)
            if lifted is None:
                self._counters["people without depth"] += 1
                continue
            found.append(lifted.skeleton(stamp_ns, optical_frame(self._name), number))
        self._people = len(found)
        return tuple(found)

    def _check(self, colour: ImageArray, depth: SingleArray) -> None:
        """Raise DepthError for an image of another size than that of its calibration."""
        images: dict[str, NDArray[Any]] = {_COLOUR: colour[..., 0], _DEPTH: depth}
        for what, image in images.items():
            try:
                check_size(image, self._infos[what], what)
            except DepthError as error:
                self._counters[f"{what} images of another size"] += 1
                self._problem = str(error)
                raise


def prepare() -> None:
    """Compile the loops of a camera's images, or load them, before the first one."""
    registration.prepare()
    lifting.prepare()


def topics_of(camera: str, values: Mapping[str, Value]) -> CameraTopics:
    """The topics of a camera: those of its driver, with those that the parameters name instead."""
    of_driver = DRIVERS[str(values["driver"])]
    given = {
        field.name: str(values[f"{field.name}_topic"]) or getattr(of_driver, field.name)
        for field in fields(CameraTopics)
    }
    return CameraTopics(**given).of(camera)


def _pose(given: Value) -> SensorPose | None:
    """The value of the parameter ``depth_pose``; GraphError for one whose quaternion has another length than 1."""
    assert isinstance(given, Numbers)
    values = np.array(given.values)
    if not values.any():
        return None
    length = float(np.linalg.norm(values[3:]))
    if abs(length - 1.0) > _ROUNDED:
        raise graph.GraphError(f"depth_pose: the quaternion x, y, z, w has the length {length:.3g}, not 1")
    return SensorPose(_DEPTH, values[:3], values[3:])
