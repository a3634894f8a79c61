"""Colour images of a simulated person in a room, for networks that detect people in images.

Nothing is learned or measured: skin, hair, eyes, mouth and clothes have one colour each, and a lamp shines from above
the camera. The networks were trained on photographs; their errors on these images are accepted.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from body_tracking.core.camera import Camera
from body_tracking.core.sensor_poses import SensorPose
from body_tracking.core.skeleton import BoolArray, FloatArray, IntArray, SingleArray
from body_tracking.core.sources import optical_frame
from body_tracking.mesh.raster import render
from body_tracking.simulation.depth_scene import DepthFrame, DepthScene
from body_tracking.simulation.makehuman import CLOTH, HAIR, SKIN, Body, normals

_LAMP: Final[FloatArray] = np.array([0.25, -0.65, -0.72])
"""Direction to the lamp in the optical frame."""
_AMBIENT: Final = 0.45
_EYE, _BROW, _MOUTH = 0.013, 0.012, 0.022
"""Radii about the middle of an eye, of an eyebrow above it, and of the mouth, with their colour, metres."""
_ON_FLOOR: Final = 0.01
"""Largest height of a face of the room that counts as floor, metres."""
CAMERA: Final = "camera1"
NOISE: Final = 4.0
"""Standard deviation of a pixel's noise, of 255."""


def colour_camera(width: int = 640) -> Camera:
    """A camera with an aspect ratio of 4:3, 69 degrees wide, without lens distortion."""
    height, focal = width * 3 // 4, 465.0 / 640.0 * width
    matrix = np.array([[focal, 0.0, (width - 1) / 2.0], [0.0, focal, (height - 1) / 2.0], [0.0, 0.0, 1.0]])
    return Camera(optical_frame(CAMERA), width, height, matrix, np.zeros(5))


@dataclass(frozen=True, slots=True, eq=False)
class Painter:
    """Renders the colour images of a scene.

    Attributes:
        scene: of a person in a room.
        camera: intrinsics.
        pose: of the camera in ``world``.
        faces: (F, 3) of the body without the strands of hair, which would hide the person's face.
        colours: (F, 3) red, green, blue of each face.
        background: (height, width, 3) the room.
        distance: (height, width) metres to the room; 0 where there is nothing.
    """

    scene: DepthScene
    camera: Camera
    pose: SensorPose
    faces: IntArray
    colours: FloatArray
    background: FloatArray
    distance: SingleArray

    @classmethod
    def of(cls, scene: DepthScene, camera: Camera | None = None, pose: SensorPose | None = None) -> Painter:
        """With colours drawn by the scene's seed; defaults are the scene's own camera and pose."""
        camera, pose = camera or scene.camera, pose or scene.pose
        vertices, faces = scene.room()
        world = scene.pose.apply(vertices)
        room = render((world - pose.translation) @ pose.rotation, faces, camera)
        wall, floor = np.array([172.0, 178.0, 170.0]), np.array([124.0, 108.0, 92.0])
        rows = np.arange(camera.height)[:, None, None] / camera.height
        background = np.tile(wall * (1.0 - 0.15 * rows), (1, camera.width, 1))
        heights = world[faces, 2].max(axis=1)
        background[(room.faces >= 0) & (heights[room.faces] < _ON_FLOOR)] = floor
        rng = np.random.default_rng([scene.seed, 20250101])
        background += rng.normal(scale=NOISE, size=background.shape)
        body = scene.who.body
        shown = body.materials != HAIR
        return cls(scene, camera, pose, body.faces[shown], _colours(body, rng)[shown], background, room.depth)

    def image(self, frame: DepthFrame) -> NDArray[np.uint8]:
        """(height, width, 3) red, green, blue of a frame of the scene."""
        vertices = (self.scene.pose.apply(frame.vertices) - self.pose.translation) @ self.pose.rotation
        own = render(vertices, self.faces, self.camera)
        seen = (own.depth > 0.0) & ((self.distance == 0.0) | (own.depth < self.distance))
        face = own.faces[seen]
        direction = normals(vertices, self.faces)[self.faces[face]].mean(axis=1)
        rng = np.random.default_rng([self.scene.seed, round(frame.time * 1e3), 11])
        return exposed(self.background, seen, self.colours[face], direction, rng)


def exposed(
    background: FloatArray, seen: BoolArray, colours: FloatArray, direction: FloatArray, rng: np.random.Generator
) -> NDArray[np.uint8]:
    """(height, width, 3) red, green, blue of lit surfaces in front of a background, with noise and blur.

    Args:
        background: (height, width, 3), with noise.
        seen: (height, width) mask of the n pixels of the surfaces.
        colours: (n, 3) of these pixels.
        direction: (n, 3) normals in the optical frame.
        rng: for the surfaces' noise.
    """
    light = _AMBIENT + (1.0 - _AMBIENT) * np.clip(direction @ (_LAMP / np.linalg.norm(_LAMP)), 0.0, 1.0)
    picture = background.copy()
    picture[seen] = colours * light[:, None]
    picture[seen] += rng.normal(scale=NOISE, size=(len(colours), 3))
    return np.clip(np.round(cv2.GaussianBlur(picture, (0, 0), 0.6)), 0.0, 255.0).astype(np.uint8)


def _colours(body: Body, rng: np.random.Generator) -> FloatArray:
    """(F, 3) colours of the faces."""
    skin = np.array([[236.0, 188.0, 160.0], [198.0, 148.0, 112.0], [122.0, 84.0, 60.0]])[rng.integers(3)]
    hair = np.array([[60.0, 42.0, 30.0], [30.0, 26.0, 24.0], [140.0, 104.0, 60.0]])[rng.integers(3)]
    shirt, trousers = rng.uniform(40.0, 220.0, 3), rng.uniform(25.0, 110.0, 3)
    centres = body.vertices[body.faces].mean(axis=1)
    colours = np.tile(skin, (len(body.faces), 1))
    cloth = body.materials == CLOTH
    hips = body.head_of("upperleg01.L")[2] + 0.08
    colours[cloth] = np.where(centres[cloth, 2:] > hips, shirt, trousers)
    face = body.materials == SKIN
    for side in ("L", "R"):
        eye = body.head_of(f"eye.{side}") + [0.01, 0.0, 0.0]
        off = (centres - eye) / [2.0, 1.3, 1.0]
        colours[face & (np.linalg.norm(off, axis=1) < _EYE)] = [28.0, 22.0, 20.0]
        above = (centres - eye - [0.005, 0.0, 0.024]) / [2.0, 1.8, 0.6]
        colours[face & (np.linalg.norm(above, axis=1) < _BROW)] = 0.8 * hair
    lips = body.vertices[body.faces[face].ravel()]
    mouth = np.array([lips[lips[:, 2] > 0.0, 0].max() - 0.03, 0.0, body.head_of("oris06.L")[2] + 0.015])
    off = (centres - mouth) / [2.0, 1.2, 0.35]
    colours[face & (np.linalg.norm(off, axis=1) < _MOUTH)] = [150.0, 62.0, 58.0]
    crown = centres[:, 2] > body.head_of("eye.L")[2] + 0.055
    back = (centres[:, 0] < body.head_of("head")[0] + 0.02) & (centres[:, 2] > body.head_of("head")[2] - 0.02)
    colours[face & (crown | back)] = hair
    return colours
