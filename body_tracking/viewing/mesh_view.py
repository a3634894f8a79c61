"""The mesh system in the viewer: the fitted body as a surface in the scene, and over the depth images."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

import numpy as np

from body_tracking.core.camera import Camera
from body_tracking.core.sensor_poses import SensorPose
from body_tracking.core.skeleton import FloatArray
from body_tracking.core.sources import check_sensor_name
from body_tracking.mesh.codecs import DepthImage, MeshMarker
from body_tracking.mesh.picture import outlined
from body_tracking.mesh.topics import depth_topic, info_topic, mesh_sensor, mesh_topic
from body_tracking.messages.cdr import stamp_of
from body_tracking.messages.codecs import CameraInfo, Codec
from body_tracking.viewing.colours import Colour
from body_tracking.viewing.handles import show
from body_tracking.viewing.snapshot import Decode

_SKIN: Final[Colour] = (214, 180, 150)
_OPACITY: Final = 0.7
"""Opacity of the surface: the joints inside stay visible."""
_WIDTH: Final = 480
"""Width of an image on the page, pixels."""
_PERIOD_S: Final = 0.1
"""Shortest interval between two images, or two meshes, of a camera that are sent to the browsers, seconds."""
_IMAGES, _MESH = "depth_images", "mesh"


class MeshView:
    """Depth cameras on the page.

    Args:
        cameras: their names.
        clock: steady time in seconds, to limit the rate.

    Raises:
        SensorNameError: an invalid name.
    """

    body = ""
    layers: Mapping[str, tuple[str, bool]] = {
        _IMAGES: ("depth images", True),
        _MESH: ("mesh", True),
        "body": ("body", False),  # the page's own, of capsules, would cover the mesh
    }

    def __init__(self, cameras: Sequence[str], clock: Callable[[], float] = time.monotonic) -> None:
        self._cameras = tuple(check_sensor_name(each) for each in cameras)
        self._clock = clock
        self.held = frozenset(map(info_topic, self._cameras))
        self._shown: dict[str, _CameraView] = {}

    def topics(self, visible: Mapping[str, bool]) -> Mapping[str, Codec]:
        """Topics of the visible layers, with the codecs of their messages."""
        found: dict[str, Codec] = {}
        for camera in self._cameras:
            if visible[_IMAGES] or visible[_MESH]:
                found[mesh_topic(camera)] = MeshMarker()
            if visible[_IMAGES]:
                found |= {depth_topic(camera): DepthImage(), info_topic(camera): CameraInfo()}
        return found

    def start(self, server: Any) -> None:
        """Create the widgets."""
        with server.gui.add_folder("Depth cameras", order=0.5):
            self._shown = {camera: _CameraView(server, camera, self._clock) for camera in self._cameras}

    def draw(
        self,
        recent: Mapping[str, Sequence[bytes]],
        decode: Decode,
        visible: Mapping[str, bool],
        poses: Mapping[str, SensorPose],
    ) -> FloatArray | None:
        """Draw the latest mesh of each camera, over the image that it was fitted to."""
        for camera, shown in self._shown.items():
            shown.draw(recent, decode, visible, poses.get(mesh_sensor(camera)))
        return None


class _CameraView:
    """One depth camera on the page."""

    def __init__(self, server: Any, camera: str, clock: Callable[[], float]) -> None:
        self._scene, self._camera, self._clock = server.scene, camera, clock
        self._surface = _Surface(server.scene, f"/mesh/{camera}")
        black = np.zeros((3, 4, 3), np.uint8)
        self.image = server.gui.add_image(black, label=camera, format="jpeg")
        self._drawn: tuple[bytes, bytes] = b"", b""
        self._drawn_s = -np.inf

    def draw(
        self,
        recent: Mapping[str, Sequence[bytes]],
        decode: Decode,
        visible: Mapping[str, bool],
        pose: SensorPose | None,
    ) -> None:
        images = recent.get(depth_topic(self._camera), ()) if visible[_IMAGES] else ()
        meshes = recent.get(mesh_topic(self._camera), ()) if visible[_IMAGES] or visible[_MESH] else ()
        show(self.image, visible[_IMAGES])
        self._surface.place(pose if visible[_MESH] and meshes else None)
        # a mesh is published some images after the image to which it was fitted
        by_stamp = {stamp_of(cdr): cdr for cdr in images}
        paired = [cdr for cdr in meshes if stamp_of(cdr) in by_stamp]
        mesh = (paired or meshes or (b"",))[-1]
        image = by_stamp[stamp_of(mesh)] if paired else images[-1] if images else b""
        now = self._clock()
        if (image, mesh) == self._drawn or now - self._drawn_s < _PERIOD_S:
            return
        self._drawn, self._drawn_s = (image, mesh), now
        found = decode(mesh_topic(self._camera), mesh) if mesh else None
        corners = np.zeros((0, 3, 3)) if found is None else found[2]
        if visible[_MESH] and len(corners):
            self._surface.draw(corners)
        depth = decode(depth_topic(self._camera), image) if image else None
        if depth is not None:
            info = self._info(recent, decode) if paired else None
            self.image.image = outlined(depth[2], corners if paired else corners[:0], info, _WIDTH)

    def _info(self, recent: Mapping[str, Sequence[bytes]], decode: Decode) -> Camera | None:
        infos = recent.get(info_topic(self._camera), ())
        found: Camera | None = decode(info_topic(self._camera), infos[-1]) if infos else None
        return found


class _Surface:
    """A mesh in viser's scene whose vertices are updated in place."""

    def __init__(self, scene: Any, name: str) -> None:
        self._frame = scene.add_frame(name, show_axes=False, visible=False)
        self._scene, self._name = scene, name
        self._first = np.zeros(0, np.intp)
        """First corner of each vertex."""
        self._faces = np.zeros((0, 3), np.intp)
        self._handle: Any = None

    def place(self, pose: SensorPose | None) -> None:
        """Move the mesh to its camera; hide it without a pose."""
        if pose is not None:
            self._frame.position, self._frame.wxyz = pose.translation, np.roll(pose.quat_xyzw, 1)
        show(self._frame, pose is not None)

    def draw(self, corners: FloatArray) -> None:
        """Draw (F, 3, 3) corners of triangles, metres in the camera's optical frame."""
        points = corners.reshape(-1, 3)
        # coinciding corners are one vertex, for smooth shading; the same corners coincide in all poses
        vertices = points[self._first] if self._faces.size == len(points) else points[:0]
        if not len(vertices) or not np.array_equal(vertices[self._faces.ravel()], points):
            vertices, self._first, inverse = np.unique(points, axis=0, return_index=True, return_inverse=True)
            self._faces = inverse.reshape(-1, 3)
            self._handle = self._scene.add_mesh_simple(
                f"{self._name}/surface",
                vertices,
                self._faces,
                color=_SKIN,
                opacity=_OPACITY,
                side="double",
                cast_shadow=False,
                receive_shadow=False,
            )
            return
        self._handle.vertices = vertices.astype(np.float32)
