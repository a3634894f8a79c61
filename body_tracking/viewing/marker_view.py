"""The marker system in the viewer: cameras and their images, points, targets and the chain.

The rig's frame, that of its first camera, is drawn as if this camera looked horizontally along x of the world.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np

from body_tracking.core import so3
from body_tracking.core.sensor_poses import SensorPose
from body_tracking.core.skeleton import NANOSECONDS, FloatArray
from body_tracking.markers import setup
from body_tracking.markers.chain_files import load_chain
from body_tracking.markers.codecs import Balls, CameraImage, PoseOfTarget, SpacePoints
from body_tracking.markers.observations import TargetPose
from body_tracking.markers.overlay import annotate, chain_places, targets_of_balls
from body_tracking.markers.rig import Rig
from body_tracking.markers.rig_storage import load_rig
from body_tracking.markers.targets_file import load_targets
from body_tracking.messages.cdr import stamp_of
from body_tracking.messages.codecs import Codec
from body_tracking.viewing.colours import FILTERED, PALETTE, sensor_colours
from body_tracking.viewing.handles import BALL, Shapes, show
from body_tracking.viewing.snapshot import Decode

_OPTICAL: Final = (0.5, -0.5, 0.5, -0.5)
"""Quaternion w x y z of an optical frame (x right, y down, z forward) that looks along x, with z up."""
_TOLERANCE_NS: Final = NANOSECONDS // 500
"""Largest difference of the stamps of one instant, as in ``marker_triangulation``."""
_WIDTH: Final = 480
"""Largest width of an image on the page, pixels."""
_BALL, _POINT, _JOINT = 0.008, 0.005, 0.015
"""Radii, metres."""
_IMAGES, _CAMERAS, _POINTS, _TARGETS, _CHAIN = (
    "marker_images",
    "marker_cameras",
    "marker_points",
    "marker_targets",
    "marker_chain",
)


class MarkerView:
    """A marker system on the page.

    Args:
        folder: of the setup, which may be incomplete; without rig.yaml no cameras are shown.

    Raises:
        BodyTrackingError: a file cannot be read, or there is none.
    """

    body = setup.BODY
    held: Collection[str] = ()
    layers: Mapping[str, tuple[str, bool]] = {
        _IMAGES: ("images of cameras", True),
        _CAMERAS: ("cameras", True),
        _POINTS: ("points", True),
        _TARGETS: ("targets", True),
        _CHAIN: ("chain", True),
    }

    def __init__(self, folder: str) -> None:
        path = Path(folder).expanduser()
        rig = (path / setup.RIG).exists() or not (path / setup.TARGETS).exists()
        self._rig = load_rig(setup.file_of(folder, setup.RIG, "calibrate")) if rig else None
        found = load_targets(path / setup.TARGETS) if (path / setup.TARGETS).exists() else []
        self._targets = {target.name: target for target in found}
        self._chain = load_chain(path / setup.CHAIN) if (path / setup.CHAIN).exists() else None
        self._colours = sensor_colours(tuple(self._targets))
        cameras = () if self._rig is None else self._rig.cameras
        self._names = [setup.camera_name(camera.frame_id) for camera in cameras]

    def topics(self, visible: Mapping[str, bool]) -> Mapping[str, Codec]:
        """Topics of the visible layers, with the codecs of their messages."""
        found: dict[str, Codec] = {}
        if visible[_IMAGES]:
            found |= {setup.image_topic(name): CameraImage() for name in self._names}
            found |= {setup.balls_topic(name): Balls() for name in self._names}
        if visible[_POINTS]:
            found[setup.POINTS] = SpacePoints()
        return found | {setup.pose_topic(name): PoseOfTarget(name) for name in self._targets}

    def start(self, server: Any) -> None:
        """Create the nodes of the scene and the widgets."""
        scene = server.scene
        scene.add_frame("/markers", show_axes=False, wxyz=_OPTICAL)
        self._cameras = [] if self._rig is None else _frustums(scene, self._names, self._rig)
        self._points = Shapes(scene, "/markers/points", BALL, FILTERED)
        self._poses = {}
        for name, target in self._targets.items():
            path = f"/markers/targets/{name}"
            self._poses[name] = scene.add_frame(path, axes_length=0.06, axes_radius=0.002, visible=False)
            balls = Shapes(scene, f"{path}/balls", BALL, self._colours[name])
            balls.draw(target.points, None, np.full((len(target.points), 3), _BALL))
            scene.add_label(f"{path}/name", name, position=(0.0, 0.0, 0.0), anchor="bottom-left")
        self._joints = Shapes(scene, "/markers/chain/joints", BALL, FILTERED)
        self._lines = None
        if self._chain is not None:
            room = np.zeros((2 * len(self._chain.joints), 2, 3))
            self._lines = scene.add_line_segments("/markers/chain/lines", room, FILTERED, thickness=0.008)
        self._images = []
        if self._names:
            black = np.zeros((3, 4, 3), np.uint8)
            with server.gui.add_folder("Cameras", order=0.5):
                self._images = [server.gui.add_image(black, label=name, format="jpeg") for name in self._names]

    def draw(
        self,
        recent: Mapping[str, Sequence[bytes]],
        decode: Decode,
        visible: Mapping[str, bool],
        poses: Mapping[str, SensorPose],
    ) -> FloatArray | None:
        """Draw messages of one instant; returns the (3,) mean position of the targets in world, or None."""
        at = {topic: {stamp_of(cdr): (topic, cdr) for cdr in each} for topic, each in recent.items() if each}
        posed, stamp_ns = self._one_time(at, decode)
        for camera in self._cameras:
            show(camera, visible[_CAMERAS])
        self._draw_images(at, stamp_ns, posed, decode, visible[_IMAGES])
        points = _latest(at.get(setup.POINTS, {}), stamp_ns, decode) if visible[_POINTS] else None
        positions = np.empty((0, 3)) if points is None else points.positions
        self._points.draw(positions, None, np.full((len(positions), 3), _POINT))
        seen = {pose.name: pose for pose in posed}
        for name, frame in self._poses.items():
            show(frame, visible[_TARGETS] and name in seen)
            if name in seen:
                frame.wxyz, frame.position = _wxyz(seen[name].rotation), seen[name].translation
        self._draw_chain(posed if visible[_CHAIN] else [])
        if not posed:
            return None
        middle = np.mean([pose.translation for pose in posed], axis=0)
        return np.array([middle[2], -middle[0], -middle[1]])

    def _one_time(
        self, at: Mapping[str, Mapping[int, tuple[str, bytes]]], decode: Decode
    ) -> tuple[list[TargetPose], int | None]:
        """The poses at the latest time that also has images and balls, if any were received; and that time, ns."""
        posed = [at.get(setup.pose_topic(name), {}) for name in self._targets]
        stamps = sorted({stamp_ns for each in posed for stamp_ns in each}, reverse=True)
        topics = [topic(name) for topic in (setup.image_topic, setup.balls_topic) for name in self._names]
        others = [at[topic] for topic in topics if topic in at]
        chosen = (stamp for stamp in stamps if all(_nearest(each, stamp) is not None for each in others))
        stamp_ns = next(chosen, stamps[0] if stamps else None)
        found = [decode(*each[stamp_ns]) for each in posed if stamp_ns in each] if stamp_ns is not None else []
        return [pose for pose in found if pose is not None], stamp_ns

    def _draw_images(
        self,
        at: Mapping[str, Mapping[int, tuple[str, bytes]]],
        stamp_ns: int | None,
        poses: Sequence[TargetPose],
        decode: Decode,
        visible: bool,
    ) -> None:
        for index, (name, handle) in enumerate(zip(self._names, self._images, strict=True)):
            show(handle, visible)
            image = _latest(at.get(setup.image_topic(name), {}), stamp_ns, decode) if visible else None
            if image is None:
                continue
            taken_ns, _, pixels = image
            # balls and poses of another time would not match the image
            balls = _of_time(at.get(setup.balls_topic(name), {}), taken_ns, decode)
            posed = poses if stamp_ns is not None and abs(taken_ns - stamp_ns) <= _TOLERANCE_NS else ()
            assert self._rig is not None
            found = np.empty((0, 2)) if balls is None else balls.pixels
            owners = targets_of_balls(self._rig, index, found, self._targets, posed)
            names = [pose.name for pose in posed]
            drawn = annotate(pixels, balls, owners, names, [self._colours[name] for name in names])
            height, width = drawn.shape[:2]
            if width > _WIDTH:
                size = _WIDTH, _WIDTH * height // width
                drawn = np.asarray(cv2.resize(drawn, size, interpolation=cv2.INTER_AREA), np.uint8)
            handle.image = drawn

    def _draw_chain(self, poses: Sequence[TargetPose]) -> None:
        if self._chain is None or self._lines is None:
            return
        centres, lines = chain_places(self._chain, poses)
        self._joints.draw(centres, None, np.full((len(centres), 3), _JOINT))
        if len(lines):
            # unused lines have length 0
            points = np.tile(lines[0, 0], (2 * len(self._chain.joints), 2, 1))
            points[: len(lines)] = lines
            self._lines.points = points.astype(np.float32)
        show(self._lines, bool(len(lines)))


def _frustums(scene: Any, names: Sequence[str], rig: Rig) -> list[Any]:
    """Frustums of the cameras, with their names."""
    frustums = []
    for name, camera, rotation, translation in zip(names, rig.cameras, rig.rotations, rig.translations, strict=True):
        path = f"/markers/cameras/{name}"
        frustum = scene.add_camera_frustum(
            path,
            fov=2.0 * float(np.arctan(0.5 * camera.height / camera.matrix[1, 1])),
            aspect=camera.width / camera.height * float(camera.matrix[1, 1] / camera.matrix[0, 0]),
            scale=0.12,
            thickness=0.004,
            color=PALETTE[0],
            wxyz=_wxyz(rotation.T),
            position=-rotation.T @ translation,
            cast_shadow=False,
        )
        scene.add_label(f"{path}/name", name, position=(0.0, -0.06, 0.0), anchor="bottom-center")
        frustums.append(frustum)
    return frustums


def _wxyz(rotation: FloatArray) -> FloatArray:
    return np.roll(so3.matrix_to_quat(rotation), 1)


def _nearest(messages: Mapping[int, tuple[str, bytes]], stamp_ns: int | None) -> int | None:
    """The stamp nearest to a time, within the tolerance; None without one."""
    if stamp_ns is None or not messages:
        return None
    nearest = min(messages, key=lambda each: abs(each - stamp_ns))
    return nearest if abs(nearest - stamp_ns) <= _TOLERANCE_NS else None


def _of_time(messages: Mapping[int, tuple[str, bytes]], stamp_ns: int | None, decode: Decode) -> Any:
    """The payload of the message nearest to a time, within the tolerance; None without one."""
    at_ns = _nearest(messages, stamp_ns)
    return None if at_ns is None else decode(*messages[at_ns])


def _latest(messages: Mapping[int, tuple[str, bytes]], stamp_ns: int | None, decode: Decode) -> Any:
    """The payload of the message nearest to a time, else of the latest one; None without messages."""
    return _of_time(messages, stamp_ns, decode) or (decode(*messages[max(messages)]) if messages else None)
