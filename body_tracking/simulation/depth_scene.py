"""Depth images of a simulated person in clothes who moves in a room in front of a depth camera, with ground truth."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter

from body_tracking.core.camera import Camera
from body_tracking.core.sensor_poses import SensorPose, level_pose
from body_tracking.core.skeleton import FloatArray, SingleArray
from body_tracking.mesh.depth import DepthCamera
from body_tracking.mesh.person import Floor
from body_tracking.mesh.raster import render
from body_tracking.mesh.simulated import DepthErrors, measured
from body_tracking.simulation.clothed import ClothedPerson
from body_tracking.simulation.makehuman import MakeHuman
from body_tracking.simulation.people import MODEL, Course
from body_tracking.simulation.repertoire import Movement, make_movement

RATE: Final = 30.0
"""Images per second."""
SENSOR: Final = "kinect1"
_HEIGHT, _PITCH, _DISTANCE, _WALL = 1.0, 0.03, 2.2, 3.6
"""Height of the camera above the floor, metres; pitch downwards, radians; distances to person and wall, metres."""
_TABLE: Final = ((-0.75, -0.35), (1.55, 2.0), 0.72)
"""A table before the person: extents across and ahead of the camera, and height, metres."""


def kinect_camera(scale: int = 1) -> Camera:
    """The depth camera of a Kinect v2 with the SDK's focal length, or with 1/scale of the pixels in each direction."""
    width, height, focal = 512 // scale, 424 // scale, 365.5 / scale
    centre = (256.5 / scale - 0.5, 208.0 / scale - 0.5)
    matrix = np.array([[focal, 0.0, centre[0]], [0.0, focal, centre[1]], [0.0, 0.0, 1.0]])
    return Camera(f"{SENSOR}_optical_frame", width, height, matrix, np.array([0.093, -0.27, 0.0, 0.0, 0.09]))


class DepthFrame(NamedTuple):
    """One image with its ground truth.

    Attributes:
        time: seconds.
        image: (height, width) millimetres, 0 where missing.
        true_depth: (height, width) metres, without sensor errors.
        person: (height, width) mask of the person.
        joints: (25, 3) metres in the optical frame.
        segments: (12, 3, 3) rotations of ``UpperBody``'s segments in the optical frame.
        vertices: (N, 3) of the surface, metres in the optical frame.
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
    """A person and a motion in front of a camera.

    Attributes:
        who: the person.
        motion: one of ``repertoire.MOTIONS``.
        seed: of the person's manner and the sensor's errors.
        camera: intrinsics.
        errors: of the depth.
        table: whether a table stands in front of the person's left side.
        speed: factor on the motion's speed.
        still: whether the errors of the room are constant over images, which makes recordings small.
    """

    who: ClothedPerson
    motion: str
    seed: int = 0
    camera: Camera = field(default_factory=kinect_camera)
    errors: DepthErrors = field(default_factory=DepthErrors)
    table: bool = False
    speed: float = 1.0
    still: bool = False

    @property
    def pose(self) -> SensorPose:
        """The camera in ``world``, whose origin is on the floor below the camera."""
        return level_pose(SENSOR, _HEIGHT, _PITCH)

    @property
    def movement(self) -> Movement:
        """The person's performance of the motion."""
        return make_movement(self.motion, self.who.person, np.random.default_rng([self.seed, self._name, 2]))

    @property
    def _name(self) -> int:
        return zlib.crc32(self.motion.encode())

    def course(self, times: FloatArray) -> Course:
        """The body at (n,) seconds in ``world``, facing the camera."""
        movement = self.movement
        inside = np.clip(times * self.speed, 0.0, movement.duration)
        return movement.course(inside).placed(np.array([_DISTANCE, 0.0, 0.0]), np.pi)

    def motion_of(self, segment: str) -> Callable[[FloatArray], tuple[FloatArray, FloatArray]]:
        """Function of (n,) seconds: rotations and origins of a segment in ``world``."""
        place = MODEL.segment_names.index(segment)

        def motion(times: FloatArray) -> tuple[FloatArray, FloatArray]:
            posture = MODEL.forward(self.course(times).q, self.who.person.lengths)
            return posture.rotations[:, place], posture.origins[:, place]

        return motion

    def frames(self, start: float = 0.0, stop: float | None = None, step: int = 1) -> Iterator[DepthFrame]:
        """Every ``step``-th image from ``start`` to ``stop`` seconds; each has its own random generator."""
        count = int(min(self.movement.duration / self.speed, np.inf if stop is None else stop) * RATE)
        numbers = np.arange(round(start * RATE), count, step)
        course = self.course(numbers / RATE)
        floor = Floor(self.pose.rotation.T @ [0.0, 0.0, 1.0], _HEIGHT)
        view, room = DepthCamera(self.camera), render(*self.room(), self.camera).depth
        empty = measured(room, view, self._rng(-1), self.errors, floor=floor)
        rotation, translation = self.pose.rotation, self.pose.translation
        for index, number in enumerate(numbers.tolist()):
            vertices, joints, segments = self.who.posed(course, index)
            seen = (vertices - translation) @ rotation
            own = render(seen, self.who.body.faces, self.camera)
            person = (own.depth > 0.0) & ((room == 0.0) | (own.depth < room))
            depth = np.where(person, own.depth, room)
            corner = self.who.body.faces[np.maximum(own.faces, 0), 0]
            dark = person & self.who.body.dark[corner]
            image = measured(depth, view, self._rng(number), self.errors, dark=dark, floor=floor)
            if self.still:
                image = np.where(maximum_filter(person, 5), image, empty)
            optical = (joints - translation) @ rotation
            yield DepthFrame(number / RATE, image, depth, person, optical, rotation.T @ segments, seen)

    def _rng(self, number: int) -> np.random.Generator:
        return np.random.default_rng([self.seed, self._name, 7, number + 1])

    def room(self) -> tuple[FloatArray, NDArray[np.int32]]:
        """Vertices (n, 3) of floor, wall and table in the optical frame, metres, and faces (m, 3), the floor's first.

        The faces are small, because lens distortion bends their edges.
        """
        quads = [
            quad((0.4, -4.0, 0.0), (_WALL - 0.4, 0.0, 0.0), (0.0, 8.0, 0.0)),
            quad((_WALL, -4.0, 0.0), (0.0, 8.0, 0.0), (0.0, 0.0, 3.5)),
        ]
        if self.table:
            (left, right), (near, far), height = _TABLE
            wide, thick, leg = right - left, 0.08, 0.05
            quads.append(quad((near, left, height), (far - near, 0.0, 0.0), (0.0, wide, 0.0)))
            quads.append(quad((near, left, height - thick), (0.0, wide, 0.0), (0.0, 0.0, thick)))
            quads += [quad((near, y, 0.0), (0.0, leg, 0.0), (0.0, 0.0, height)) for y in (left, right - leg)]
        starts = np.cumsum([0, *(len(points) for points, _ in quads[:-1])])
        faces = [each + start for (_, each), start in zip(quads, starts, strict=True)]
        points = np.concatenate([points for points, _ in quads])
        return (points - self.pose.translation) @ self.pose.rotation, np.concatenate(faces).astype(np.int32)


def quad(
    corner: tuple[float, float, float], one: tuple[float, float, float], other: tuple[float, float, float]
) -> tuple[FloatArray, NDArray[np.int32]]:
    """A parallelogram from a corner and two sides, metres, with faces of a decimetre."""
    a, b = np.array(one), np.array(other)
    rows, columns = (int(np.ceil(np.linalg.norm(side) / 0.1)) + 1 for side in (a, b))
    along, across = np.meshgrid(np.linspace(0.0, 1.0, rows), np.linspace(0.0, 1.0, columns), indexing="ij")
    points = np.array(corner) + along[..., None] * a + across[..., None] * b
    number = np.arange(rows * columns).reshape(rows, columns)
    p, q, r, t = number[:-1, :-1].ravel(), number[:-1, 1:].ravel(), number[1:, :-1].ravel(), number[1:, 1:].ravel()
    faces = np.concatenate([np.column_stack([p, q, r]), np.column_stack([q, t, r])])
    return points.reshape(-1, 3), faces.astype(np.int32)


def held_out(data: MakeHuman, seed: int) -> ClothedPerson:
    """A person for evaluation, determined by the seed."""
    return ClothedPerson.of(data.draw(np.random.default_rng([seed, 20180718])))
