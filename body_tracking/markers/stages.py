"""Stages of the marker nodes, from images to joint angles (Gaschler 2011, figure 2.1)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from body_tracking.core.joint_angles import JointAngles
from body_tracking.core.parameters import Parameter, Value, fields_of, parameters_from
from body_tracking.core.qos import LATCHED, RELIABLE, Qos
from body_tracking.core.skeleton import NANOSECONDS
from body_tracking.markers import angles, corrections, detection, setup, tracking, triangulation
from body_tracking.markers.angles import AngleEstimator, ChainAngles
from body_tracking.markers.chain_files import load_chain
from body_tracking.markers.codecs import Balls, CameraImage, Frames, PoseOfTarget, SpacePoints
from body_tracking.markers.corrections import calibration_effects, centred
from body_tracking.markers.detection import DetectionSettings, ImageError, detect
from body_tracking.markers.observations import ImageBalls, Points, TargetPose
from body_tracking.markers.pairing import FrameSets
from body_tracking.markers.rig_monitor import Finding, RigMonitor
from body_tracking.markers.rig_storage import load_rig, rig_in
from body_tracking.markers.targets_file import load_targets
from body_tracking.markers.tracking import TargetTracker
from body_tracking.markers.triangulation import TriangulationSettings, triangulate
from body_tracking.messages.codecs import Angles
from body_tracking.pipeline import graph
from body_tracking.pipeline.shared import RELIABLE as TRANSPORT
from body_tracking.pipeline.shared import names_in
from body_tracking.pipeline.stage import Now, Output, Port, Stage

_SATURATED: Final = 0.05
"""Share of saturated pixels above which the image is reported: 15 balls at 1 m fill less than 1 % of 640x480."""
_ROWS: Final = 4
"""The check uses every fourth row."""
_WATCH_NS: Final = NANOSECONDS // 4
"""Nanoseconds between two searches for a moved camera; a search takes some frames, and a fault must be named within a
second."""
_SEARCH_NS: Final = NANOSECONDS // 10
"""Nanoseconds after which a search is finished with the next images, at low frame rates."""
_MIN_POINTS: Final = 3.0
"""Least mean number of points in that time: those of one target."""
_UNRECOGNISED_NS: Final = 2 * NANOSECONDS
"""Nanoseconds of points without a target after which that is reported."""
_LONGEST_NS: Final = NANOSECONDS // 5
"""Longest time between two frames for a rate by their difference, nanoseconds."""
CONVENTION: Final = "markers"
"""frame_id of the angles' headers."""
SETUP = Parameter("setup", "", "folder with rig.yaml, targets.yaml and chain.yaml (body_tracking markers)")
CAMERAS = Parameter(
    "cameras", (), "names of the cameras, whose /<camera>/image_raw the node takes; empty for those of the setup's rig"
)
_IMAGES: Final = Qos(reliability="reliable", depth=10)
_KEPT: Final = 64
"""Queued images per camera with the parameter ``reliable``: two seconds, 20 MB at 640x480."""
_DETECTION: Final = ("lower", "noise", "least_area", "most_area", "most_balls")
_TRIANGULATION: Final = ("gate", "nearest", "farthest")


def with_rates(found: ChainAngles, last: JointAngles | None) -> JointAngles:
    """Add rates from the difference to the last angles, with deviations by the noise of both; unknown at the start."""
    rates, deviations = np.full_like(found.angles, np.nan), np.full_like(found.angles, np.inf)
    if last is not None and 0 < found.stamp_ns - last.stamp_ns < _LONGEST_NS:
        elapsed = (found.stamp_ns - last.stamp_ns) / NANOSECONDS
        rates = (found.angles - last.position) / elapsed
        deviations = np.where(np.isfinite(rates), np.sqrt(2.0) * found.noise / elapsed, np.inf)
    return JointAngles(found.stamp_ns, found.names, found.angles, rates, found.stddev, deviations)


class DetectorStage(Stage):
    """Detects balls in the images of cameras, the first stage of figure 2.1 of Gaschler (2011)."""

    NAME = "marker_detector"
    PARAMETERS = (SETUP, CAMERAS, *parameters_from(DetectionSettings, only=_DETECTION, live=True), TRANSPORT)

    def __init__(self, values: Mapping[str, Value], wanted: Callable[[str], bool] = lambda topic: True) -> None:
        super().__init__(values, wanted)
        self._settings = DetectionSettings(**fields_of(DetectionSettings, values))
        cameras = names_in(values["cameras"]) or setup.camera_names(Path(str(values["setup"])))
        self._topics = {setup.image_topic(camera): setup.balls_topic(camera) for camera in cameras}
        rig = rig_in(values["setup"])
        self._sizes = {} if rig is None else {setup.image_topic(each.frame_id): each for each in rig.cameras}
        self._counters: Counter[str] = Counter()
        self._problems: dict[str, str] = {}
        detection.prepare()
        waiting = _KEPT if values["reliable"] else 0
        self.inputs = tuple(
            Port(topic, CameraImage(), _IMAGES, waiting, perishable=not waiting, foreign=True) for topic in self._topics
        )
        self.outputs = tuple(Port(topic, Balls(), RELIABLE, measured=True) for topic in self._topics.values())

    def change(self, values: Mapping[str, Value]) -> None:
        """Takes effect with the next image."""
        self._settings = DetectionSettings(**fields_of(DetectionSettings, values))
        self.values = values

    def take(self, topic: str, payload: Any, now: Now) -> Iterable[Output]:
        stamp_ns, frame_id, pixels = payload
        self._counters["images"] += 1
        self._check(topic, pixels)
        balls = detect(pixels, stamp_ns=stamp_ns, camera=frame_id, settings=self._settings)
        self._counters["images without balls"] += not len(balls.pixels)
        yield Output(self._topics[topic], balls, stamp_ns)

    def _check(self, topic: str, pixels: NDArray[Any]) -> None:
        """Note a saturated image; raise ImageError for an image whose size differs from the calibrated one."""
        self._problems.pop(topic, None)
        camera = self._sizes.get(topic)
        if camera is not None and pixels.shape != (camera.height, camera.width):
            height, width = pixels.shape
            text = f"{topic}: {width} x {height} pixels, calibrated were {camera.width} x {camera.height}"
            self._problems[topic] = text
            self._counters["images of another size"] += 1
            raise ImageError(text)
        some = pixels[::_ROWS]
        share = np.count_nonzero(some == np.iinfo(pixels.dtype).max) / max(some.size, 1)
        if share > _SATURATED:
            self._problems[topic] = f"{topic}: {100 * share:.0f} % of the pixels are saturated"
            self._counters["saturated images"] += 1

    def state(self, ros_ns: int) -> tuple[int, str, dict[str, object]]:
        """Warn of cameras whose last image had another size or was saturated."""
        return (1, "; ".join(self._problems.values()), {}) if self._problems else (0, "", {})

    @property
    def counters(self) -> Mapping[str, int]:
        return self._counters


class TriangulationStage(Stage):
    """Triangulates points in space from the balls in the images of a rig."""

    NAME = "marker_triangulation"
    PARAMETERS = (
        SETUP,
        Parameter(
            "diameter",
            0.0,
            "diameter of the balls; 0: the centroid of a ball's image counts as its centre",
            "m",
            0.0,
            0.2,
        ),
        Parameter("tolerance", 0.002, "largest difference between the stamps of one set of images", "s", 0.0, 0.1),
        Parameter(
            "max_wait",
            0.25,
            "longest wait of a set of images for a missing one, unless a later set is complete before",
            "s",
            0.0,
            1.0,
        ),
        Parameter(
            "tf",
            True,
            "publish the frames of the cameras, in that of the first one, on /tf_static; false where their driver does",
        ),
        *parameters_from(TriangulationSettings, only=_TRIANGULATION, live=True),
        TRANSPORT,
    )

    def __init__(self, values: Mapping[str, Value], wanted: Callable[[str], bool] = lambda topic: True) -> None:
        super().__init__(values, wanted)
        self.rig = load_rig(setup.file_of(values["setup"], setup.RIG, "calibrate"))
        self._settings = TriangulationSettings(**fields_of(TriangulationSettings, values))
        self._monitor = RigMonitor(self.rig)
        self._watched_ns: int | None = None
        self._finding: Finding | None = None
        self._search: Generator[None, None, Finding | None] | None = None
        self._counters: Counter[str] = Counter()
        self._diameter = float(str(values["diameter"]))
        frames = [camera.frame_id for camera in self.rig.cameras]
        tolerance, wait = float(str(values["tolerance"])), float(str(values["max_wait"]))
        triangulation.prepare()
        self._sets: FrameSets[ImageBalls] = FrameSets(frames, round(tolerance * NANOSECONDS), round(wait * NANOSECONDS))
        self._frames = {setup.balls_topic(frame): frame for frame in frames}
        self.inputs = tuple(Port(topic, Balls(), RELIABLE, perishable=True, foreign=True) for topic in self._frames)
        self.outputs = (Port(setup.POINTS, SpacePoints(), RELIABLE, measured=True),)
        if values["tf"]:
            self.outputs += (Port(graph.TF_STATIC, Frames(), LATCHED, optional=True),)

    def start(self, now: Now) -> Iterable[Output]:
        if self.values["tf"]:
            first, *others = (camera.frame_id for camera in self.rig.cameras)
            into, shifts = self.rig.rotations.swapaxes(1, 2), self.rig.translations
            frames = [
                (frame, turn, -turn @ shift) for frame, turn, shift in zip(others, into[1:], shifts[1:], strict=True)
            ]
            yield Output(graph.TF_STATIC, (now.ros_ns, first, frames))

    def change(self, values: Mapping[str, Value]) -> None:
        """Takes effect with the next images."""
        self._settings = TriangulationSettings(**fields_of(TriangulationSettings, values))
        self.values = values

    def take(self, topic: str, payload: ImageBalls, now: Now) -> Iterable[Output]:
        frame = self._frames[topic]
        if payload.camera != frame:  # the topic determines the camera
            self._counters["balls in another frame"] += 1
            payload = replace(payload, camera=frame)
        return self._points(self._sets.push(frame, payload.stamp_ns, payload, now.steady_ns))

    def poll(self, steady_ns: int) -> Iterable[Output]:
        return self._points(self._sets.poll(steady_ns))

    @property
    def deadline_ns(self) -> int | None:
        return self._sets.deadline_ns

    def reset(self, topic: str) -> None:
        self._sets.reset()
        self._monitor.reset()
        self._watched_ns = self._finding = self._search = None

    def state(self, ros_ns: int) -> tuple[int, str, dict[str, object]]:
        """Warn of a moved camera, or of one that is unsynchronised by its images or by its stamps."""
        problems = [text for text in (self._sets.problem(), str(self._finding or "")) if text]
        return (1, "; ".join(problems), {}) if problems else (0, "", {})

    def _points(self, sets: Iterable[Mapping[str, ImageBalls]]) -> Iterator[Output]:
        for frames in sets:
            balls = tuple(frames.values())
            points = triangulate(self.rig, balls, self._settings)
            if self._diameter and len(points.positions):
                points = triangulate(self.rig, centred(self.rig, balls, points, self._diameter), self._settings)
            yield Output(setup.POINTS, points, points.stamp_ns)
            # after publishing, because the check may take time
            self._watch(balls)

    def _watch(self, balls: tuple[ImageBalls, ...]) -> None:
        """Search for a moved camera and for unsynchronised cameras; log a new fault at once."""
        self._monitor.take(balls)
        stamp_ns = balls[0].stamp_ns
        if self._watched_ns is None or stamp_ns < self._watched_ns:
            self._watched_ns = stamp_ns
        if self._search is None:
            if stamp_ns - self._watched_ns < _WATCH_NS:
                return
            self._watched_ns, self._search = stamp_ns, self._monitor.search()
        try:
            next(self._search)
            while stamp_ns - self._watched_ns > _SEARCH_NS:
                next(self._search)
        except StopIteration as end:
            self._search, before, self._finding = None, self._finding, end.value
            if self._finding is not None:
                self._counters[f"{self._finding.fault.value} found"] += 1
                if before is None or before.fault is not self._finding.fault:
                    self.events.append(str(self._finding))

    @property
    def counters(self) -> Mapping[str, int]:
        return {**self._counters, "incomplete sets": self._sets.incomplete, "late images": self._sets.late}


class TrackerStage(Stage):
    """Recognises and tracks targets among points."""

    NAME = "rigid_body_tracker"
    PARAMETERS = (
        SETUP,
        Parameter("deadline", 0.02, "longest time for one frame; then the search for targets ends", "s", 0.001, 10.0),
        Parameter(
            "tf",
            "targets",
            "targets that become frames on /tf: all; only the root of the chain, for robot_state_publisher with "
            "chain.urdf; none",
            choices=("targets", "root", "none"),
        ),
        TRANSPORT,
    )

    def __init__(self, values: Mapping[str, Value], wanted: Callable[[str], bool] = lambda topic: True) -> None:
        super().__init__(values, wanted)
        self.targets = load_targets(setup.file_of(values["setup"], setup.TARGETS, "target"))
        self.tracker = TargetTracker(self.targets, deadline=float(str(values["deadline"])))
        tracking.prepare()
        self.inputs = (Port(setup.POINTS, SpacePoints(), RELIABLE, perishable=True),)
        self.outputs = tuple(
            Port(setup.pose_topic(target.name), PoseOfTarget(target.name), RELIABLE, measured=True)
            for target in self.targets
        )
        self._framed = {target.name for target in self.targets} if values["tf"] == "targets" else set()
        if values["tf"] == "root":
            self._framed = {load_chain(setup.file_of(values["setup"], setup.CHAIN, "fit")).targets[0]}
        if self._framed:
            self.outputs += (Port(graph.TF, Frames(), RELIABLE, optional=True),)
        self._points = 0.0
        self._from_ns = self._to_ns = 0

    def take(self, topic: str, payload: Points, now: Now) -> Iterable[Output]:
        poses = self.tracker.update(payload)
        self._watch(payload, found=bool(poses))
        for pose in poses:
            yield Output(setup.pose_topic(pose.name), pose, pose.stamp_ns)
        frames = [(pose.name, pose.rotation, pose.translation) for pose in poses if pose.name in self._framed]
        if frames:
            yield Output(graph.TF, (payload.stamp_ns, payload.frame_id, frames), payload.stamp_ns)

    def _watch(self, payload: Points, *, found: bool) -> None:
        """Average the number of points since the last target was found."""
        if found or not 0 < self._from_ns < payload.stamp_ns:
            self._from_ns, self._points = payload.stamp_ns, 0.0
        else:
            share = (payload.stamp_ns - self._to_ns) / (payload.stamp_ns - self._from_ns)
            self._points += share * (len(payload.positions) - self._points)
        self._to_ns = payload.stamp_ns

    def reset(self, topic: str) -> None:
        self.tracker.reset()
        self._from_ns = self._to_ns = 0

    def state(self, ros_ns: int) -> tuple[int, str, dict[str, object]]:
        """Warn of points among which there is no target."""
        if self._to_ns - self._from_ns < _UNRECOGNISED_NS or self._points < _MIN_POINTS:
            return 0, "", {}
        text = (
            f"no target among {self._points:.0f} points: was a camera moved since the calibration, or is "
            f"{setup.TARGETS} of other targets?"
        )
        return 1, text, {}

    @property
    def counters(self) -> Mapping[str, int]:
        return asdict(self.tracker.counters)


class AnglesOfTargetsStage(Stage):
    """Computes the joint angles of a chain of targets."""

    NAME = "marker_joint_angles"
    PARAMETERS = (
        SETUP,
        Parameter("max_wait", 0.02, "longest wait of the poses of one time for another target's", "s", 0.0, 1.0),
        TRANSPORT,
    )

    def __init__(self, values: Mapping[str, Value], wanted: Callable[[str], bool] = lambda topic: True) -> None:
        super().__init__(values, wanted)
        chain = load_chain(setup.file_of(values["setup"], setup.CHAIN, "fit"))
        self._rig = rig_in(values["setup"])
        targets = load_targets(setup.file_of(values["setup"], setup.TARGETS, "target"))
        self._shapes = {target.name: target for target in targets}
        self._angles = AngleEstimator(chain)
        corrections.prepare()
        angles.prepare()
        self._sets: FrameSets[TargetPose] = FrameSets(
            chain.targets, 0, round(float(str(values["max_wait"])) * NANOSECONDS)
        )
        self._targets = {setup.pose_topic(target): target for target in chain.targets}
        self._last: JointAngles | None = None
        self.inputs = tuple(
            Port(topic, PoseOfTarget(target), RELIABLE, perishable=True) for topic, target in self._targets.items()
        )
        topic = graph.joint_states_topic(setup.BODY)
        self.outputs = tuple(
            Port(f"{topic}{suffix}", Angles(setup.BODY, part, lambda: CONVENTION), RELIABLE, measured=not part)
            for part, suffix in enumerate(("", "_stddev"))
        )

    def take(self, topic: str, payload: TargetPose, now: Now) -> Iterable[Output]:
        return self._found(self._sets.push(self._targets[topic], payload.stamp_ns, payload, now.steady_ns))

    def poll(self, steady_ns: int) -> Iterable[Output]:
        return self._found(self._sets.poll(steady_ns))

    @property
    def deadline_ns(self) -> int | None:
        return self._sets.deadline_ns

    def reset(self, topic: str) -> None:
        self._sets.reset()
        self._angles.reset()
        self._last = None

    def _found(self, sets: Iterable[Mapping[str, TargetPose]]) -> Iterator[Output]:
        for poses in sets:
            sensitivities = calibration_effects(self._rig, self._shapes, list(poses.values()))
            calibration = None if self._rig is None else self._rig.covariance
            found = self._angles.estimate(tuple(poses.values()), sensitivities, calibration)
            self._last = with_rates(found, self._last)
            for port in self.outputs:
                yield Output(port.topic, self._last, self._last.stamp_ns)

    @property
    def counters(self) -> Mapping[str, int]:
        return {"poses without a partner": self._sets.incomplete}


def prepare() -> None:
    """Compile the loops of all stages, or load them."""
    for each in (detection, triangulation, tracking, corrections, angles):
        each.prepare()
