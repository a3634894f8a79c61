"""Depth images of a simulated person in clothes, who moves in a room before a depth camera, with the truth."""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from body_tracking.core.camera import Camera
from body_tracking.core.sensor_poses import SensorPose, level_pose
from body_tracking.core.skeleton import FloatArray, SingleArray
from body_tracking.mesh.depth import DepthCamera
from body_tracking.mesh.person import Floor
from body_tracking.mesh.raster import render
from body_tracking.mesh.simulated import DepthErrors, measured
from body_tracking.simulation.clothed import ClothedPerson
from body_tracking.simulation.makehuman import MakeHuman
from body_tracking.simulation.repertoire import make_movement

RATE: Final = 30.0
"""Images a second."""
SENSOR: Final = "kinect1"
_HEIGHT, _PITCH, _DISTANCE, _WALL = 1.0, 0.03, 2.2, 3.6
"""Of the camera above the floor, metres; its pitch downwards, radians; metres to the person and to the wall behind."""
_TABLE: Final = ((-0.75, -0.35), (1.55, 2.0), 0.72)
"""A table before the person: its sides across and ahead of the camera, and its height, metres."""


def kinect_camera(scale: int = 1) -> Camera:
    """The depth camera of a Kinect v2 with the focal length of the SDK, or one with 1/scale of its pixels."""
    width, height, focal = 512 // scale, 424 // scale, 365.5 / scale
    centre = (256.5 / scale - 0.5, 208.0 / scale - 0.5)
    matrix = np.array([[focal, 0.0, centre[0]], [0.0, focal, centre[1]], [0.0, 0.0, 1.0]])
    return Camera(f"{SENSOR}_optical_frame", width, height, matrix, np.array([0.093, -0.27, 0.0, 0.0, 0.09]))


class DepthFrame(NamedTuple):
    """One image with the truth.

    Attributes:
        time: seconds.
        image: (height, width) millimetres, 0 where missing.
        true_depth: (height, width) metres, without the sensor's errors.
        person: (height, width) pixels of the person.
        joints: (25, 3) metres in the optical frame.
        segments: (12, 3, 3) rotations of ``UpperBody``'s segments in the optical frame.
        vertices: (N, 3) surface, metres in the optical frame.
    """

    time: float
    image: NDArray[np.uint16]
    true_depth: SingleArray
    person: NDArray[np.bool_]
    joints: FloatArray
    segments: FloatArray
    vertices: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class DepthScene:
    """A person and a motion before a camera.

    Attributes:
        who: the person.
        motion: one of ``repertoire.MOTIONS``.
        seed: of the manner and of the sensor's errors.
        camera: intrinsics.
        errors: of the depth.
        seconds: of the motion; its own length where None.
        standard: without an individual manner.
        table: whether a table stands before the person's left side.
        speed: factor of the motion's speed.
    """

    who: ClothedPerson
    motion: str
    seed: int = 0
    camera: Camera = field(default_factory=kinect_camera)
    errors: DepthErrors = field(default_factory=DepthErrors)
    seconds: float | None = None
    standard: bool = False
    table: bool = False
    speed: float = 1.0

    @property
    def pose(self) -> SensorPose:
        """The camera in ``world``: origin on the floor below it."""
        return level_pose(SENSOR, _HEIGHT, _PITCH)

    def frames(self, start: float = 0.0, stop: float | None = None, step: int = 1) -> Iterator[DepthFrame]:
        """The images from ``start`` to ``stop`` seconds, every ``step``-th; each has its own random generator."""
        name = zlib.crc32(self.motion.encode())
        own = None if self.standard else np.random.default_rng([self.seed, name, 2])
        movement = make_movement(self.motion, self.who.person, own, self.seconds)
        count = int(min(movement.duration / self.speed, np.inf if stop is None else stop) * RATE)
        numbers = np.arange(round(start * RATE), count, step)
        times = numbers / RATE
        # the person faces the camera
        course = movement.course(times * self.speed).placed(np.array([_DISTANCE, 0.0, 0.0]), np.pi)
        view, still, floor = DepthCamera(self.camera), self._room(), self._floor()
        room = render(*still, self.camera).depth
        rotation, translation = self.pose.rotation, self.pose.translation
        for index, number in enumerate(numbers.tolist()):
            vertices, joints, segments = self.who.posed(course, index)
            seen = (vertices - translation) @ rotation
            own_depth = render(seen, self.who.body.faces, self.camera)
            person = (own_depth.depth > 0.0) & ((room == 0.0) | (own_depth.depth < room))
            depth = np.where(person, own_depth.depth, room)
            corner = self.who.body.faces[np.maximum(own_depth.faces, 0), 0]
            dark = person & self.who.body.dark[corner]
            image = measured(
                depth, view, np.random.default_rng([self.seed, name, 7, number]), self.errors, dark=dark, floor=floor
            )
            yield DepthFrame(
                float(times[index]),
                image,
                depth,
                person,
                (joints - translation) @ rotation,
                rotation.T @ segments,
                seen,
            )

    def _floor(self) -> Floor:
        return Floor(self.pose.rotation.T @ [0.0, 0.0, 1.0], _HEIGHT)

    def _room(self) -> tuple[FloatArray, NDArray[np.int32]]:
        """Floor, wall and table, in the optical frame."""
        floor = [[0.4, 4.0, 0.0], [0.4, -4.0, 0.0], [_WALL, 4.0, 0.0], [_WALL, -4.0, 0.0]]
        wall = [[_WALL, 4.0, 0.0], [_WALL, -4.0, 0.0], [_WALL, 4.0, 3.5], [_WALL, -4.0, 3.5]]
        quads = [floor, wall]
        if self.table:
            (left, right), (near, far), height = _TABLE
            quads.append([[x, y, height] for x in (near, far) for y in (left, right)])
            quads.append([[near, y, z] for z in (height - 0.08, height) for y in (left, right)])
            quads += [[[near, y + d, z] for z in (0.0, height) for d in (0.0, 0.05)] for y in (left, right - 0.05)]
        corners = np.array(quads, dtype=float)
        faces = np.concatenate([np.array([[0, 1, 2], [1, 3, 2]]) + 4 * k for k in range(len(quads))])
        points = (corners.reshape(-1, 3) - self.pose.translation) @ self.pose.rotation
        return points, faces.astype(np.int32)


def held_out(data: MakeHuman, seed: int) -> ClothedPerson:
    """A person to be judged on; the same seed gives the same one."""
    return ClothedPerson.of(data.draw(np.random.default_rng([seed, 20180718])))
