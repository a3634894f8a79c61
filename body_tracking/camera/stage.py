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
from body_tracking.camera.people import PersonTracker
from body_tracking.camera.pictures import RATE, Pictures
from body_tracking.camera.pose_model import ImageArray, Landmarks
from body_tracking.camera.registration import Registration, is_registered, moved
from body_tracking.camera.settings import DRIVER, MODEL, PEOPLE, SEARCH, THREADS, WAIT_NS, image_port, trackers_of
from body_tracking.camera.topics import COMPRESSION, DRIVERS, CameraTopics, images_of
from body_tracking.core.camera import Camera, CameraError
from body_tracking.core.parameters import Parameter, Value
from body_tracking.core.qos import LATCHED
from body_tracking.core.sensor_poses import SensorPose
from body_tracking.core.skeleton import NANOSECONDS, SingleArray, Skeleton
from body_tracking.core.sources import check_sensor_name, optical_frame
from body_tracking.markers.pairing import FrameSets
from body_tracking.mesh.codecs import DepthImage, DepthInfo
from body_tracking.mesh.depth import DepthError, check_size
from body_tracking.mesh.person import COVERED, is_covered
from body_tracking.messages.codecs import Codec, Skeletons
from body_tracking.pipeline import graph
from body_tracking.pipeline.shared import RELIABLE as TRANSPORT
from body_tracking.pipeline.shared import names_in, skeleton_qos
from body_tracking.pipeline.stage import Now, Output, Port, Stage

CAMERAS = Parameter("cameras", (), "the cameras; the node publishes /<camera>/skeleton of each")
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
    (),
    "pose of the depth camera in the colour camera's optical frame: x, y, z in metres and the quaternion x, y, z, w; "
    "empty where the driver registers the depth images to the colour images",
)
_TOLERANCE = Parameter(
    "tolerance", 0.02, "largest difference between the stamps of a colour and a depth image of one time", "s", 0.0, 0.5
)

_COLOUR, _DEPTH = "colour", "depth"
FLAT: Final = "the person is flat: a picture of one?"


class CameraStage(Stage):
    """Finds people in the colour images of cameras, and the depth of their joints in the depth images."""

    NAME = "camera_skeleton"
    PARAMETERS = (
        CAMERAS,
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
        names = tuple(check_sensor_name(each) for each in names_in(values["cameras"]))
        if not names or len(set(names)) < len(names):
            raise graph.GraphError(f"cameras: {', '.join(names) or 'none'}; expected one or more, each once")
        pose = _pose(names_in(values["depth_pose"]))
        new_tracker = trackers_of(values)
        tolerance_ns = round(float(str(values["tolerance"])) * NANOSECONDS)
        self._cameras = {
            name: ColourAndDepth(
                name,
                topics_of(name, values),
                new_tracker(),
                Pictures(name, float(str(values["picture_rate"])), wanted),
                pose,
                tolerance_ns,
            )
            for name in names
        }
        self._by_topic: dict[str, tuple[ColourAndDepth, str]] = {}
        inputs: list[Port] = []
        for camera in self._cameras.values():
            topics, compressed = camera.topics, str(values["compressed"])
            colour, depth = images_of(topics, compressed)
            colour_codec: Codec = ColourImage() if compressed == "none" else CompressedColour()
            depth_codec: Codec = CompressedDepth() if compressed == "both" else DepthImage()
            for topic, what, codec in ((colour, _COLOUR, colour_codec), (depth, _DEPTH, depth_codec)):
                self._by_topic[topic] = camera, what
                inputs.append(image_port(topic, codec, values))
            for topic, what in ((topics.colour_info, f"{_COLOUR} info"), (topics.depth_info, f"{_DEPTH} info")):
                self._by_topic[topic] = camera, what
                inputs.append(Port(topic, DepthInfo(), LATCHED, foreign=True))
        self.inputs = tuple(inputs)
        self.outputs = tuple(
            Port(graph.skeleton_topic(name), Skeletons(), skeleton_qos(values), measured=True) for name in names
        ) + tuple(port for camera in self._cameras.values() for port in camera.pictures.ports)

    def take(self, topic: str, payload: Any, now: Now) -> Iterable[Output]:
        camera, what = self._by_topic[topic]
        if isinstance(payload, Camera):
            camera.calibrate(what.removesuffix(" info"), payload)
            return ()
        stamp_ns, _, pixels = payload
        return camera.push(what, stamp_ns, pixels, now.steady_ns)

    def poll(self, steady_ns: int) -> Iterable[Output]:
        for camera in self._cameras.values():
            yield from camera.poll(steady_ns)

    @property
    def deadline_ns(self) -> int | None:
        waiting = [camera.deadline_ns for camera in self._cameras.values()]
        return min((each for each in waiting if each is not None), default=None)

    def refused(self, topic: str) -> None:
        """Count a message of another encoding, or a calibration that cannot be used."""
        camera, what = self._by_topic[topic]
        camera.counters[f"{what} messages that cannot be used"] += 1

    def reset(self, topic: str) -> None:
        """Forget the people and the images of one camera."""
        self._by_topic[topic][0].reset()

    def state(self, ros_ns: int) -> tuple[int, str, dict[str, object]]:
        """Names the cameras without calibration, with images of other sizes or times, or with pictures of people."""
        problems = [f"{name}: {camera.problem}" for name, camera in self._cameras.items() if camera.problem]
        values: dict[str, object] = {f"{name} people": camera.people for name, camera in self._cameras.items()}
        return (1 if problems else 0), "; ".join(problems), values

    @property
    def counters(self) -> Mapping[str, int]:
        return {
            f"{name} {key}": count
            for name, camera in self._cameras.items()
            for key, count in {**camera.counters, **camera.tracker.counters, **camera.unpaired}.items()
        }


class ColourAndDepth:
    """One camera with the people before it.

    Args:
        name: of the sensor.
        topics: on which it publishes.
        tracker: of the people in its colour images.
        pictures: of them.
        pose: of the depth camera in the colour camera's frame; None where the depth images are registered.
        tolerance_ns: largest difference between the stamps of images of one time.

    Attributes:
        counters: of images and people, by the result.
        people: number of people in the last image.
    """

    def __init__(
        self,
        name: str,
        topics: CameraTopics,
        tracker: PersonTracker,
        pictures: Pictures,
        pose: SensorPose | None,
        tolerance_ns: int,
    ) -> None:
        self.name, self.topics, self.tracker, self.pictures = name, topics, tracker, pictures
        self.counters: Counter[str] = Counter()
        self.people = 0
        self._pose, self._problem = pose, ""
        self._infos: dict[str, Camera] = {}
        self._registration: Registration | None = None
        self._sets: FrameSets[Any] = FrameSets((_COLOUR, _DEPTH), tolerance_ns, WAIT_NS)

    @property
    def unpaired(self) -> Mapping[str, int]:
        """Numbers of images without another one of their time."""
        return {"images without the other one": self._sets.incomplete, "images that came too late": self._sets.late}

    @property
    def problem(self) -> str:
        """Why there is no skeleton; empty if there is one, or if nobody is seen."""
        return self._problem or self._sets.problem()

    def calibrate(self, what: str, camera: Camera) -> None:
        """Take the intrinsics of the colour or the depth images.

        Raises:
            CameraError: the depth images are not registered to the colour images.
        """
        known = self._infos.get(what)
        if known is not None and known.is_like(camera):
            return
        self._infos[what] = camera
        self._registration = None
        if len(self._infos) < 2:
            return
        colour, depth = self._infos[_COLOUR], self._infos[_DEPTH]
        if self._pose is None and not is_registered(colour, depth):
            self._problem = (
                f"the depth images are not registered to the colour images: {self.topics.depth_info} has other "
                "intrinsics. Let the driver register them, or set depth_pose"
            )
            raise CameraError(self._problem)
        self._problem = ""
        self._registration = Registration(depth, colour, self._pose)

    def push(self, what: str, stamp_ns: int, pixels: Any, now_ns: int) -> Iterator[Output]:
        """Take an image; returns the outputs of each time that has both images now.

        Raises:
            DepthError: an image of another size than that of its calibration.
        """
        return self._outputs(self._sets.push(what, stamp_ns, (stamp_ns, pixels), now_ns))

    def poll(self, now_ns: int) -> Iterator[Output]:
        """Process the images that have waited for long enough; outputs and errors as of :meth:`push`."""
        return self._outputs(self._sets.poll(now_ns))

    @property
    def deadline_ns(self) -> int | None:
        return self._sets.deadline_ns

    def reset(self) -> None:
        """Forget people and images."""
        self._sets.reset()
        self.tracker.reset()
        self.people = 0

    def _outputs(self, sets: Iterable[Mapping[str, Any]]) -> Iterator[Output]:
        for images in sets:
            (stamp_ns, colour), (_, depth) = images[_COLOUR], images[_DEPTH]
            landmarks: dict[int, Landmarks] = {}
            skeletons = self._people_in(stamp_ns, colour, depth, landmarks)
            if skeletons:
                yield Output(graph.skeleton_topic(self.name), skeletons, stamp_ns)
            yield from self.pictures.of(stamp_ns, colour, landmarks.values())

    def _people_in(
        self, stamp_ns: int, colour: ImageArray, depth: SingleArray, landmarks: dict[int, Landmarks]
    ) -> tuple[Skeleton, ...]:
        """The people with depth; ``landmarks`` gets those of everybody in the colour image."""
        self.people = 0
        if self._registration is None:
            self.counters["images without camera_info"] += 1
            missing = [
                topic
                for what, topic in ((_COLOUR, self.topics.colour_info), (_DEPTH, self.topics.depth_info))
                if what not in self._infos
            ]
            self._problem = self._problem or f"no calibration: nothing on {', '.join(missing)}"
            return ()
        self._check(colour, depth)
        self.counters["pairs of images"] += 1
        self._problem = COVERED if is_covered(depth) else ""
        seen = self._registration(depth)
        source, camera = self._infos[_COLOUR], self._registration.camera
        found = []
        landmarks |= self.tracker.update(stamp_ns, colour)
        for number, each in landmarks.items():
            there = moved(each, source, camera)
            if is_flat(there, seen, camera):
                self.counters["pictures of people"] += 1
                self._problem = FLAT
                continue
            lifted = lift(there, seen, camera)
            if lifted is None:
                self.counters["people without depth"] += 1
                continue
            found.append(lifted.skeleton(stamp_ns, optical_frame(self.name), number))
        self.people = len(found)
        return tuple(found)

    def _check(self, colour: ImageArray, depth: SingleArray) -> None:
        """Raise DepthError for an image of another size than that of its calibration."""
        images: dict[str, NDArray[Any]] = {_COLOUR: colour[..., 0], _DEPTH: depth}
        for what, image in images.items():
            try:
                check_size(image, self._infos[what])
            except DepthError as error:
                self.counters[f"{what} images of another size"] += 1
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


def _pose(numbers: tuple[str, ...]) -> SensorPose | None:
    """The value of the parameter ``depth_pose``; GraphError for another one."""
    if not numbers:
        return None
    try:
        values = np.array([float(each) for each in numbers])
    except ValueError as error:
        raise graph.GraphError(f"depth_pose: {error}") from error
    if values.shape != (7,) or not np.isfinite(values).all() or not np.linalg.norm(values[3:]) > 0.5:
        raise graph.GraphError(f"depth_pose: {', '.join(numbers)}; expected x, y, z and a unit quaternion x, y, z, w")
    return SensorPose(_DEPTH, values[:3], values[3:])
