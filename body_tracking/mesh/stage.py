"""Stage of the node ``mesh_tracker``: from the depth images of a camera to the skeleton and mesh of a person."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from body_tracking.core.camera import Camera
from body_tracking.core.parameters import Parameter, Value, fields_of, parameters_from
from body_tracking.core.qos import LATCHED, RELIABLE
from body_tracking.core.repeats import REPEATED, Repeats
from body_tracking.core.sensor_poses import SensorPose
from body_tracking.core.skeleton import NANOSECONDS, FloatArray
from body_tracking.core.sources import check_sensor_name, optical_frame
from body_tracking.fusion.placement import Placement
from body_tracking.fusion.stage import calibration_inputs
from body_tracking.mesh import body_model, storage
from body_tracking.mesh.body_index import IndexArray, IndexPairs
from body_tracking.mesh.body_model import Body
from body_tracking.mesh.codecs import BodyIndex, DepthImage, MeshMarker
from body_tracking.mesh.depth import DepthCamera, DepthError
from body_tracking.mesh.person import COVERED, is_covered
from body_tracking.mesh.personalisation import DistinctPoses, PersonalisationError, personalise
from body_tracking.mesh.sensor_orientations import SensorOrientations
from body_tracking.mesh.topics import (
    IMAGES,
    body_index_topic,
    depth_topic,
    info_topic,
    mesh_sensor,
    mesh_topic,
    personalise_service,
)
from body_tracking.mesh.tracking import MeshTracker, Tracked, TrackerParameters, prepare
from body_tracking.messages.codecs import CameraInfo, Orientation, SensorClock, Skeletons
from body_tracking.pipeline import graph
from body_tracking.pipeline.shared import RELIABLE as TRANSPORT
from body_tracking.pipeline.shared import names_in, skeleton_qos
from body_tracking.pipeline.stage import Now, Output, Port, Stage

CAMERA = Parameter(
    "camera", "kinect1", "name of the depth camera; the node takes /<camera>/depth/image_raw and camera_info"
)
PERSON = Parameter(
    "person",
    "",
    "YAML file with the shape of the person's body; written after a personalisation if it does not exist",
)
_PERSONALISED_FROM = Parameter(
    "personalise_from",
    5,
    "number of images in different poses from which the shape of a person is estimated, unless a file has it; 0 for "
    "never",
    min=0,
    max=12,
)
_MESH_RATE = Parameter(
    "mesh_rate", 5.0, "publish the mesh at most this often, and only while there is a subscriber", "Hz", 0.1, 100.0
)
ORIENTATIONS = Parameter(
    "orientations",
    (),
    "arm segments with inertial sensors, whose orientations come from /imu/<segment>/orientation and are in the fit: "
    "upper_arm, forearm, hand, each _left or _right. Not for segments whose orientations the filter takes, too",
)
_ORIENTATIONS: Final = 32
"""Queue of orientations per segment: half a second."""
_CALIBRATIONS: Final = 1000
"""Queue of poses and clocks, long enough to lose none while an image is fitted."""
_KEPT: Final = 64
"""Queued images with the parameter ``reliable``: two seconds, 60 MB at 512x424."""
_NO_INFO: Final = "images without camera_info"


class MeshStage(Stage):
    """Fits the mesh of a person to each image of a depth camera."""

    NAME = "mesh_tracker"
    PARAMETERS = (
        CAMERA,
        PERSON,
        ORIENTATIONS,
        *parameters_from(TrackerParameters),
        _PERSONALISED_FROM,
        _MESH_RATE,
        TRANSPORT,
    )

    def __init__(self, values: Mapping[str, Value], wanted: Callable[[str], bool] = lambda topic: True) -> None:
        super().__init__(values, wanted)
        camera = check_sensor_name(str(values["camera"]))
        self.sensor = DepthSensor(camera, values, self.events)
        segments = names_in(values["orientations"])
        self._orientations = SensorOrientations(segments)
        self._segments = {graph.orientation_topic(each): each for each in segments}
        prepare()
        reliable = bool(values["reliable"])
        self._info, self._images, self._bodies = info_topic(camera), depth_topic(camera), body_index_topic(camera)
        inputs = [Port(self._info, CameraInfo(), LATCHED, foreign=True)]
        inputs += [
            Port(
                *(topic, codec, IMAGES, _KEPT if reliable else 0),
                droppable=not reliable,
                perishable=not reliable,
                optional=topic == self._bodies,
                foreign=True,
            )
            for topic, codec in ((self._bodies, BodyIndex()), (self._images, DepthImage()))
        ]
        if segments:
            inputs += calibration_inputs(1, _CALIBRATIONS)
            qos = skeleton_qos(values)
            inputs += [Port(topic, Orientation(each), qos, _ORIENTATIONS) for topic, each in self._segments.items()]
        self._skeletons, self._meshes = graph.skeleton_topic(self.sensor.name), mesh_topic(camera)
        self.inputs = tuple(inputs)
        self.outputs = (
            Port(self._skeletons, Skeletons(), skeleton_qos(values), measured=True),
            Port(self._meshes, MeshMarker(), RELIABLE),
        )
        self.services = {personalise_service(camera): self._personalise}

    def take(self, topic: str, payload: Any, now: Now) -> Iterable[Output]:
        if topic in self._segments:
            self._orientations.add(payload)
        elif topic in (graph.CALIBRATION, graph.CALIBRATION_CLOCK):
            self._place(payload)
        elif topic == self._info:
            self.sensor.calibrate(payload)
        else:
            stamp_ns, _, pixels = payload
            if topic == self._bodies:
                self.sensor.pairs.add_index(stamp_ns, pixels)
            else:
                self.sensor.pairs.add_depth(stamp_ns, pixels, now.steady_ns)
            yield from self.poll(now.steady_ns)

    def poll(self, steady_ns: int) -> Iterator[Output]:
        """The outputs of images that need not wait for a body index."""
        while (pair := self.sensor.pairs.next(steady_ns)) is not None:
            tracked = self.sensor.update(pair.stamp_ns, pair.depth, self._orientations, pair.bodies)
            if tracked is not None:
                yield from self._outputs(pair.stamp_ns, tracked)

    @property
    def deadline_ns(self) -> int | None:
        return self.sensor.pairs.deadline_ns

    def _outputs(self, stamp_ns: int, tracked: Tracked) -> Iterator[Output]:
        frame_id = optical_frame(self.sensor.name)
        yield Output(self._skeletons, (tracked.skeleton(frame_id),), stamp_ns)
        if self.wanted(self._meshes) and self.sensor.mesh_is_due(stamp_ns):
            posed = tracked.fit.posed.vertices
            yield Output(self._meshes, (stamp_ns, frame_id, posed[self.sensor.body.model.faces]), stamp_ns)

    def _place(self, payload: SensorPose | SensorClock) -> None:
        """Take a pose or clock of the calibration; ignores those of other sensors."""
        if payload.sensor != self.sensor.name:
            return
        if isinstance(payload, SensorPose):
            self.sensor.placement.set_pose(payload)
        else:
            self.sensor.placement.set_clock(payload.valid_from_ns, payload.clock)

    def _personalise(self) -> str:
        self.sensor.personalise_anew()
        return "move your arms and trunk before the camera: the shape of your body is estimated from different poses"

    def refused(self, topic: str) -> None:
        """Count a message of another encoding, or an unusable calibration."""
        if topic == self._bodies:
            self.sensor.pairs.refuse()
            return
        what = "" if topic in (self._info, self._images) else "inertial "
        self.sensor.counters[f"{what}messages that cannot be used"] += 1

    def reset(self, topic: str) -> None:
        """Forget the person but not the body's shape, or the body-index images, or the orientations of one segment."""
        if topic == self._bodies:
            self.sensor.pairs.forget_indices()
        elif topic in self._segments:
            self._orientations.forget(self._segments[topic])
        elif topic in (self._info, self._images):
            self.sensor.reset()

    def state(self, ros_ns: int) -> tuple[int, str, dict[str, object]]:
        """Warn of a camera without calibration, with images of another size or a covered lens, and of unusable
        body-index images.
        """
        problems = [each for each in (self.sensor.problem, self.sensor.pairs.problem) if each]
        return (1 if problems else 0), "; ".join(problems), self.sensor.state()

    def save(self) -> None:
        """Write the shape of the person's body if it is new."""
        self.sensor.save()

    @property
    def counters(self) -> Mapping[str, int]:
        return self.sensor.counters


class DepthSensor:
    """One depth camera with the tracker of the person in front of it.

    Args:
        camera: its name.
        values: parameters of the stage.
        events: lines for the log.

    Attributes:
        name: of the sensor under which the skeletons are published.
        body: of the person.
        problem: why images are unusable; "" if they are usable, even if nobody is visible.
        placement: pose of the camera in ``world`` and its clock, from the calibration.
        pairs: depth images that wait for their body index.
        poses: images for the next personalisation.

    Raises:
        PersonFileError: the file of the person is invalid.
    """

    def __init__(self, camera: str, values: Mapping[str, Value], events: list[str]) -> None:
        self.name = mesh_sensor(camera)
        self.problem = ""
        self.placement = Placement()
        self._camera, self._events = camera, events
        self._parameters = TrackerParameters(**fields_of(TrackerParameters, values))
        self._needed = int(str(values["personalise_from"]))
        self._mesh_ns = round(NANOSECONDS / float(str(values["mesh_rate"])))
        self._drawn_ns: int | None = None
        self._model = body_model.load()
        self._file = Path(str(values["person"])).expanduser() if values["person"] else None
        self._known = self._file is not None and self._file.exists()
        self._changed = False
        if self._file is not None and self._known:
            self.body, self._covariance = storage.load(self._file, self._model)
        else:
            self.body, self._covariance = self._nobody()
        self.poses = DistinctPoses(self._model, 0 if self._known else self._needed)
        self._tracker: MeshTracker | None = None
        self._counters: Counter[str] = Counter()
        self.pairs = IndexPairs(body_index_topic(camera), self._counters)
        self._repeats = Repeats()

    @property
    def counters(self) -> Counter[str]:
        """Counts of images by outcome."""
        return self._counters

    def _nobody(self) -> tuple[Body, FloatArray]:
        """The mean body with the covariance of the population."""
        return self._model.body(), np.eye(self._model.vertex_shapes.shape[2])

    def calibrate(self, camera: Camera) -> None:
        """Take the intrinsics; if they have changed, start the tracker again."""
        if self._tracker is not None:
            if self._tracker.camera.is_like(camera):
                return
            self._counters["calibrations that differ from the last one"] += 1
        self._tracker = MeshTracker(
            DepthCamera(camera), self.body, self._covariance, self._parameters, counters=self._counters
        )
        self.problem = ""

    def update(
        self, stamp_ns: int, depth: Any, worn: SensorOrientations, index: IndexArray | None = None
    ) -> Tracked | None:
        """Track the person in an image, with the orientations of worn inertial sensors.

        Args:
            stamp_ns: of the image.
            depth: (height, width) metres, 0 where missing.
            worn: the inertial sensors.
            index: (height, width) body-index image of the same time, if there is one.

        Raises:
            DepthError: a size other than the calibrated one.
        """
        if self._tracker is None:
            self._counters[_NO_INFO] += 1
            self.problem = f"no calibration: nothing on {info_topic(self._camera)}"
            return None
        if self._repeats.add(stamp_ns, depth) and not is_covered(depth):
            self._counters[f"repeated images of {self._camera}"] += 1
            self.problem = REPEATED.format("image")
            return None
        gone = self._counters["people lost"]
        names = self._model.joint_names
        orientations = worn.seen_from(self.placement, stamp_ns, names, self._counters)
        try:
            tracked = self._tracker.update(stamp_ns, depth, index, orientations)
        except DepthError as error:
            self._counters["images of another size"] += 1
            self.problem = str(error)
            raise
        self.problem = COVERED if self._tracker.problem == COVERED else ""
        if self._counters["people lost"] > gone and not self._known:
            # the next person may be somebody else
            self.poses = DistinctPoses(self._model, self._needed)
            self._wear(*self._nobody())
        if tracked is not None and not self.poses.complete:
            self._collect(self._tracker, tracked)
        return tracked

    def _collect(self, tracker: MeshTracker, tracked: Tracked) -> None:
        """Keep the image if its pose is new, and estimate the shape once there are enough."""
        assert tracker.observation is not None
        self.poses.offer(tracker.observation, tracked.fit.pose)
        if not self.poses.complete:
            return
        try:
            person = personalise(self._model, self.poses.observations, self.poses.poses)
        except PersonalisationError as error:
            self._events.append(f"{self._camera}: {error}")
            self._counters["failed personalisations"] += 1
            self.poses = DistinctPoses(self._model, self._needed)
            return
        self._wear(person.body, person.covariance)
        self._changed = True
        self._counters["personalisations"] += 1
        stature = float(np.ptp(person.body.vertices[:, 1]))
        self._events.append(f"{self._camera}: body of {stature:.2f} m from {len(self.poses.poses)} images")

    def _wear(self, body: Body, covariance: FloatArray) -> None:
        self.body, self._covariance = body, covariance
        if self._tracker is not None:
            self._tracker.wear(body, covariance)

    def personalise_anew(self) -> None:
        """Estimate the shape anew from the next poses, also if a file gave it."""
        self.poses = DistinctPoses(self._model, self._needed or int(str(_PERSONALISED_FROM.default)))

    def mesh_is_due(self, stamp_ns: int) -> bool:
        """Whether the mesh of an image is due for publishing; if so, it counts as published."""
        if self._drawn_ns is not None and 0 <= stamp_ns - self._drawn_ns < self._mesh_ns:
            return False
        self._drawn_ns = stamp_ns
        return True

    def reset(self) -> None:
        """Forget the person and the background; keep the newest pose and clock of the camera."""
        self.placement.restart()
        self.pairs.forget_depth()
        if self._tracker is not None:
            self._tracker.reset()

    def state(self) -> dict[str, object]:
        """Figures of the last fit."""
        return {} if self._tracker is None else self._tracker.state()

    def save(self) -> None:
        """Write the shape of the body to the file if it is new.

        Raises:
            PersonFileError: the file cannot be written.
        """
        if self._file is not None and self._changed:
            self.save_to(self._file)
        self._changed = False

    def save_to(self, file: Path) -> None:
        """Write the shape of the body; raises the errors of :meth:`save`."""
        storage.save(file, self.body.shape, self._covariance)
