"""Colour images of calibrated cameras to skeletons, without depth: the stage of the node ``camera_rig``."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

from body_tracking.camera.codecs import ColourImage, CompressedColour
from body_tracking.camera.numbers import PersonNumbers
from body_tracking.camera.pictures import RATE, Pictures
from body_tracking.camera.pose_model import ImageArray, Landmarks
from body_tracking.camera.settings import DRIVER, MODEL, PEOPLE, SEARCH, THREADS, WAIT_NS, image_port, trackers_of
from body_tracking.camera.topics import COMPRESSED, DRIVERS, RIG_SENSOR
from body_tracking.camera.triangulation import SightLines, match, triangulate
from body_tracking.core.parameters import Parameter, Value
from body_tracking.core.skeleton import NANOSECONDS, Skeleton
from body_tracking.core.sources import optical_frame
from body_tracking.markers import setup
from body_tracking.markers.pairing import FrameSets
from body_tracking.markers.rig_storage import load_rig
from body_tracking.mesh.depth import DepthError, check_size
from body_tracking.messages.codecs import Codec, Skeletons
from body_tracking.pipeline import graph
from body_tracking.pipeline.shared import RELIABLE as TRANSPORT
from body_tracking.pipeline.shared import skeleton_qos
from body_tracking.pipeline.stage import Now, Output, Port, Stage

RIG = Parameter("setup", "", "folder with rig.yaml, the cameras' calibration (body_tracking markers calibrate or wand)")
_COLOUR_TOPIC = Parameter(
    "colour_topic", "", "topic of the colour images, with {camera} for the camera's name; empty for that of the driver"
)
_COMPRESSED = Parameter("compressed", False, "take the images that image_transport has compressed (JPEG or PNG)")
_TOLERANCE = Parameter("tolerance", 0.01, "largest difference between the stamps of images of one time", "s", 0.0, 0.5)


class RigStage(Stage):
    """Finds people in the colour images of calibrated cameras, and triangulates their joints."""

    NAME = "camera_rig"
    PARAMETERS = (RIG, DRIVER, _COLOUR_TOPIC, _COMPRESSED, MODEL, PEOPLE, SEARCH, _TOLERANCE, THREADS, RATE, TRANSPORT)

    def __init__(self, values: Mapping[str, Value], wanted: Callable[[str], bool] = lambda topic: True) -> None:
        super().__init__(values, wanted)
        self._rig = load_rig(setup.file_of(values["setup"], setup.RIG, "calibrate"))
        names = [setup.camera_name(camera.frame_id) for camera in self._rig.cameras]
        if len(names) < 2:
            raise graph.GraphError(f"setup: {', '.join(names)} alone; two cameras or more are needed")
        new_tracker = trackers_of(values)
        self._trackers = {name: new_tracker() for name in names}
        self._cameras = dict(zip(names, self._rig.cameras, strict=True))
        self._numbers = PersonNumbers(int(str(values["people"])))
        self._counters: Counter[str] = Counter()
        self._problems: dict[str, str] = {}
        self._lines = SightLines()
        self._people = 0
        tolerance_ns = round(float(str(values["tolerance"])) * NANOSECONDS)
        self._sets: FrameSets[tuple[int, ImageArray]] = FrameSets(names, tolerance_ns, WAIT_NS)
        compressed = bool(values["compressed"])
        pattern = str(values["colour_topic"]) or DRIVERS[str(values["driver"])].colour
        topics = [pattern.replace("{camera}", name) + COMPRESSED * compressed for name in names]
        if len(set(topics)) < len(topics):
            raise graph.GraphError(f"colour_topic: {pattern} is the same of all cameras; {{camera}} is their name")
        self._by_topic = dict(zip(topics, names, strict=True))
        codec: Codec = CompressedColour() if compressed else ColourImage()
        self.inputs = tuple(image_port(topic, codec, values) for topic in topics)
        self._topic = graph.skeleton_topic(RIG_SENSOR)
        self._pictures = {name: Pictures(name, float(str(values["picture_rate"])), wanted) for name in names}
        skeletons = Port(self._topic, Skeletons(), skeleton_qos(values), measured=True)
        self.outputs = (skeletons, *(port for each in self._pictures.values() for port in each.ports))

    def take(self, topic: str, payload: Any, now: Now) -> Iterable[Output]:
        stamp_ns, _, pixels = payload
        name = self._by_topic[topic]
        self._problems.pop(name, None)
        try:
            check_size(pixels[..., 0], self._cameras[name], "colour")
        except DepthError as error:
            self._counters[f"{name} images of another size"] += 1
            self._problems[name] = str(error)
            raise
        return self._outputs(self._sets.push(name, stamp_ns, (stamp_ns, pixels), now.steady_ns))

    def poll(self, steady_ns: int) -> Iterable[Output]:
        return self._outputs(self._sets.poll(steady_ns))

    @property
    def deadline_ns(self) -> int | None:
        return self._sets.deadline_ns

    def _outputs(self, sets: Iterable[Mapping[str, tuple[int, ImageArray]]]) -> Iterator[Output]:
        for images in sets:
            stamp_ns = min(stamp for stamp, _ in images.values())
            found = [
                tracker.update(stamp_ns, images[name][1]) if name in images else {}
                for name, tracker in self._trackers.items()
            ]
            skeletons = self._skeletons(stamp_ns, found)
            if skeletons:
                yield Output(self._topic, skeletons, stamp_ns)
            for name, people in zip(self._trackers, found, strict=True):
                if name in images:
                    yield from self._pictures[name].of(stamp_ns, images[name][1], people.values())

    def _skeletons(self, stamp_ns: int, found: Sequence[Mapping[int, Landmarks]]) -> tuple[Skeleton, ...]:
        self._counters["sets of images"] += 1
        self._lines.add(self._rig, found)
        matched = match(self._rig, found)
        self._counters["people seen by one camera alone"] += sum(map(len, found)) - sum(map(len, matched))
        bodies = [triangulate(self._rig, views) for views in matched]
        numbers = self._numbers.of([body.positions for body in bodies])
        self._people = len(bodies)
        frame = optical_frame(RIG_SENSOR)
        return tuple(
            body.skeleton(stamp_ns, frame, number)
            for body, number in zip(bodies, numbers, strict=True)
            if (body.states > 0).any()
        )

    def refused(self, topic: str) -> None:
        """Count a message of another encoding."""
        self._counters[f"{self._by_topic[topic]} messages that cannot be used"] += 1

    def reset(self, topic: str) -> None:
        """Forget the people and the images."""
        self._sets.reset()
        self._lines = SightLines()
        self._numbers = PersonNumbers(self._numbers.most)
        for tracker in self._trackers.values():
            tracker.reset()

    def state(self, ros_ns: int) -> tuple[int, str, dict[str, object]]:
        """Names the cameras whose images are missing, come at other times or have another size, and a rig in doubt."""
        problems = [f"{name}: {text}" for name, text in self._problems.items()]
        problems += [text for text in (self._sets.problem(), self._lines.problem()) if text]
        return (1 if problems else 0), "; ".join(problems), {"people": self._people}

    @property
    def counters(self) -> Mapping[str, int]:
        of_cameras = {
            f"{name} {key}": count
            for name, tracker in self._trackers.items()
            for key, count in tracker.counters.items()
        }
        own = {"incomplete sets": self._sets.incomplete, "late images": self._sets.late}
        return {**self._counters, **own, **of_cameras}
