"""Rendered images of a robot arm with red balls, and of a pendulum with a retro-reflective ball.

The scenes of the thesis's baseline tests (Schlagenhauf 2017, sections 4.1.1 and 4.1.2). Depth has the errors of
:mod:`body_tracking.mesh.simulated`. Not simulated: errors of the intrinsics and of depth over whole surfaces, motion
blur, and a Kinect's different capture times of colour and depth.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.ndimage import maximum_filter

from body_tracking.core import so3
from body_tracking.core.camera import Camera
from body_tracking.core.imu import STANDARD_GRAVITY
from body_tracking.core.sensor_poses import SensorPose
from body_tracking.core.skeleton import BoolArray, FloatArray, IntArray, SingleArray
from body_tracking.kinematics.trajectories import minimum_jerk
from body_tracking.markers.rendering import Sensor
from body_tracking.markers.rendering import render as render_balls
from body_tracking.mesh.depth import DepthCamera
from body_tracking.mesh.raster import render
from body_tracking.mesh.simulated import DepthErrors, measured
from body_tracking.simulation.colour_images import NOISE, colour_camera, exposed
from body_tracking.simulation.depth_scene import kinect_camera, quad

RADIUS: Final = 0.03
"""Radius of the red balls, metres."""
_SHOULDER: Final = 0.5
"""Height of the arm's first joint, metres."""
_LINKS: Final = (0.4, 0.32)
_ASIDE: Final = np.array([0.08, 0.0, 0.0])
"""Offset from a joint, or the end effector, to its ball: along the joints' axes, towards the camera, metres."""
_WAYPOINTS: Final = np.array(
    [
        [-0.25, 60.0, -30.0],
        [0.25, 60.0, -30.0],
        [0.25, 45.0, -50.0],
        [-0.25, 45.0, -50.0],
        [-0.25, 75.0, -80.0],
        [0.25, 75.0, -80.0],
    ]
)
"""Metres along the linear stage, and degrees of both links above the horizontal: the strokes of a painting robot."""
_WIDTH: Final = 1024
"""Pixels of a colour image; a depth image has half as many."""
_LINE: Final = 1.8
"""Seconds from one waypoint to the next."""
_REST: Final = 0.5
"""Seconds at rest before and after the motion."""
_PLACE, _AIM = np.array([1.3, -1.7, 0.9]), np.array([0.0, -0.25, 0.6])
"""Position and aim of the camera in the robot's frame, metres: it looks at the arm obliquely, as in figure 4.3."""
_RED, _GREY, _BLUE = (196.0, 30.0, 34.0), (150.0, 152.0, 156.0), (52.0, 70.0, 112.0)

_Mesh = tuple[FloatArray, IntArray]


def sphere(radius: float, rings: int = 24) -> _Mesh:
    """Vertices (n, 3) and faces (m, 3) of a sphere about the origin, metres."""
    polar = np.linspace(0.0, np.pi, rings + 1)
    return _turned(radius * np.sin(polar), radius * np.cos(polar), 2 * rings)


def rod(radius: float, length: float) -> _Mesh:
    """Vertices and faces of a rod from the origin along z, with flat ends, metres."""
    steps = np.linspace(0.0, length, max(2, int(np.ceil(length / 0.05)) + 1))
    profile = np.array([0.0, *(radius,) * len(steps), 0.0])
    return _turned(profile, np.array([steps[0], *steps, steps[-1]]), 24)


def _turned(radii: FloatArray, heights: FloatArray, around: int) -> _Mesh:
    """A surface of revolution about z; its normals point outwards or inwards."""
    angle = 2.0 * np.pi * np.arange(around) / around
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    flat = radii[:, None, None] * ring
    vertices = np.concatenate([flat, np.broadcast_to(heights[:, None, None], (*flat.shape[:2], 1))], axis=-1)
    number = np.arange(vertices.shape[0] * around).reshape(-1, around)
    p, q, r, t = number[:-1], np.roll(number[:-1], -1, axis=1), number[1:], np.roll(number[1:], -1, axis=1)
    faces = np.concatenate([np.stack([p, q, r], axis=-1), np.stack([q, t, r], axis=-1)]).reshape(-1, 3)
    return vertices.reshape(-1, 3), faces.astype(np.int32)


def looking(sensor: str, place: FloatArray, at: FloatArray) -> SensorPose:
    """The pose of an upright camera at ``place`` that looks at ``at``."""
    ahead = (at - place) / np.linalg.norm(at - place)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return SensorPose(sensor, place, so3.matrix_to_quat(np.column_stack([right, np.cross(ahead, right), ahead])))


@dataclass(frozen=True, eq=False)
class ArmScene:
    """An arm of three degrees of freedom on a linear stage, after figures 4.1-4.3 of Schlagenhauf 2017.

    Attributes:
        seed: of the sensor's errors.
        camera: the colour camera's name.
        errors: of the depth.
    """

    seed: int = 0
    camera: str = "camera1"
    errors: DepthErrors = field(default_factory=DepthErrors)

    @property
    def seconds(self) -> float:
        """Duration of the motion, including the rest before and after."""
        return 2.0 * _REST + _LINE * (len(_WAYPOINTS) - 1)

    @cached_property
    def pose(self) -> SensorPose:
        """The camera in the robot's frame."""
        return looking(self.camera, _PLACE, _AIM)

    @cached_property
    def colour(self) -> Camera:
        """Intrinsics of the colour images."""
        return colour_camera(_WIDTH)

    @cached_property
    def depth(self) -> Camera:
        """Intrinsics of the depth images, which are registered to the colour images."""
        return colour_camera(_WIDTH // 2)

    @cached_property
    def _view(self) -> DepthCamera:
        return DepthCamera(self.depth)

    def joints(self, times: FloatArray) -> FloatArray:
        """(n, 3, 3) metres in the robot's frame: shoulder, elbow and end effector at (n,) s."""
        share = (times - _REST) / _LINE
        line = np.clip(share.astype(int), 0, len(_WAYPOINTS) - 2)
        part = minimum_jerk(share - line)[:, None]
        stage, *angles = ((1.0 - part) * _WAYPOINTS[line] + part * _WAYPOINTS[line + 1]).T
        found = np.zeros((len(times), 3, 3))
        found[:, 0] = np.column_stack([stage, np.zeros_like(stage), np.full_like(stage, _SHOULDER)])
        for number, (length, angle) in enumerate(zip(_LINKS, np.radians(angles), strict=True), 1):
            along = np.column_stack([np.zeros_like(angle), -np.cos(angle), np.sin(angle)])
            found[:, number] = found[:, number - 1] + length * along
        return found

    def balls(self, times: FloatArray) -> FloatArray:
        """(n, 3, 3) metres in the robot's frame: the balls of base, elbow and end effector."""
        return np.asarray(self.joints(times) + _ASIDE)

    @cached_property
    def _room(self) -> tuple[FloatArray, SingleArray, NDArray[np.uint16]]:
        """Colours (height, width, 3), distances and the measured depth image of the room without the arm."""
        quads = [
            quad((-2.2, -1.0, 0.0), (4.0, 0.0, 0.0), (0.0, 2.6, 0.0)),
            quad((-2.2, 1.6, 0.0), (4.0, 0.0, 0.0), (0.0, 0.0, 2.5)),
            quad((-2.2, -1.0, 0.0), (0.0, 2.6, 0.0), (0.0, 0.0, 2.5)),
            # a red square on the wall as a distractor
            quad((-0.9, 1.59, 0.9), (0.1, 0.0, 0.0), (0.0, 0.0, 0.1)),
        ]
        starts = np.cumsum([0, *(len(points) for points, _ in quads[:-1])])
        faces = np.concatenate([each + start for (_, each), start in zip(quads, starts, strict=True)])
        shades = np.repeat(
            [[124.0, 108.0, 92.0], [172.0, 178.0, 170.0], [160.0, 166.0, 160.0], _RED],
            [len(each) for _, each in quads],
            axis=0,
        )
        points = self._optical(np.concatenate([points for points, _ in quads]))
        seen = render(points, faces, self.colour)
        picture = np.where((seen.faces >= 0)[..., None], shades[np.maximum(seen.faces, 0)], 90.0)
        rng = np.random.default_rng([self.seed, 41])
        picture += rng.normal(scale=NOISE, size=picture.shape)
        distance = render(points, faces, self.depth).depth
        empty = measured(distance, self._view, np.random.default_rng([self.seed, 42]), self.errors)
        return picture, distance, empty

    def _optical(self, points: FloatArray) -> FloatArray:
        return (points - self.pose.translation) @ self.pose.rotation

    @cached_property
    def _parts(self) -> tuple[list[_Mesh], FloatArray]:
        """Meshes of rail, column, two links and three balls, and the colour of each face."""
        ball = sphere(RADIUS)
        meshes = [rod(0.04, 1.4), rod(0.06, _SHOULDER), *(rod(0.035, length) for length in _LINKS), *(ball,) * 3]
        colours = [_BLUE, _BLUE, _GREY, _GREY, *(_RED,) * 3]
        return meshes, np.repeat(colours, [len(faces) for _, faces in meshes], axis=0)

    def _mesh(self, time: float) -> _Mesh:
        """The arm in the optical frame."""
        (shoulder, elbow, tool), balls = self.joints(np.array([time]))[0], self.balls(np.array([time]))[0]
        foot = np.array([shoulder[0], 0.0, 0.0])
        ends = [([-0.7, 0.0, 0.06], [0.7, 0.0, 0.06]), (foot, shoulder), (shoulder, elbow), (elbow, tool)]
        meshes, _ = self._parts
        points = []
        for (vertices, _), (start, end) in zip(meshes[: len(ends)], ends, strict=True):
            along = np.subtract(end, start) / np.linalg.norm(np.subtract(end, start))
            side = np.cross(along, [0.0, 1.0, 0.0] if abs(along[1]) < 0.9 else [1.0, 0.0, 0.0])
            side /= np.linalg.norm(side)
            points.append(vertices @ np.array([side, np.cross(along, side), along]) + start)
        points += [vertices + place for (vertices, _), place in zip(meshes[len(ends) :], balls, strict=True)]
        starts = np.cumsum([0, *(len(each) for each in points[:-1])])
        faces = np.concatenate([each + start for (_, each), start in zip(meshes, starts, strict=True)])
        return self._optical(np.concatenate(points)), faces.astype(np.int32)

    def images(self, time: float, number: int) -> tuple[NDArray[np.uint8], NDArray[np.uint16]]:
        """Colour (height, width, 3) and depth (millimetres) at a time in s; the image's ``number`` seeds its noise."""
        picture, distance, empty = self._room
        vertices, faces = self._mesh(time)
        colour = render(vertices, faces, self.colour)
        seen = colour.faces >= 0
        face = colour.faces[seen]
        corners = vertices[faces[face]]
        across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12)
        # flip the normals towards the camera
        across *= -np.sign((across * corners[:, 0]).sum(axis=1, keepdims=True))
        rng = np.random.default_rng([self.seed, 43, number])
        shown = exposed(picture, seen, self._parts[1][face], across, rng)
        own = render(vertices, faces, self.depth).depth
        arm = (own > 0.0) & ((distance == 0.0) | (own < distance))
        depth = measured(np.where(arm, own, distance), self._view, rng, self.errors)
        # away from the arm the room's errors stay constant, as in still scenes, which makes recordings small
        return shown, np.where(maximum_filter(arm, 5), depth, empty)


@dataclass(frozen=True, eq=False)
class PendulumScene:
    """A ball on a string that swings perpendicular to the view of an infrared and depth camera (figure 4.9).

    Attributes:
        length: of the string, metres.
        amplitude: radians, at the release.
        damping: decay rate of the amplitude, 1/s.
        distance: metres from the camera.
        diameter: of the ball, metres.
        seed: of the sensor's errors.
        camera: intrinsics.
        bolt: whether a bright bolt, which has depth, is in view.
        depth_at_ball: whether depth is measured at the ball, as if it were not retro-reflective.
    """

    length: float
    amplitude: float = np.radians(12.0)
    damping: float = 0.02
    distance: float = 1.5
    diameter: float = 0.02
    seed: int = 0
    camera: Camera = field(default_factory=kinect_camera)
    bolt: bool = True
    depth_at_ball: bool = False

    def angles(self, times: FloatArray) -> FloatArray:
        """(n,) radians at (n,) s, from the equation of motion theta'' = -g / L sin(theta) - 2 damping theta'."""

        def slope(_: float, state: FloatArray) -> list[float]:
            pull = -STANDARD_GRAVITY / self.length * np.sin(state[0])
            return [state[1], float(pull - 2.0 * self.damping * state[1])]

        end = float(times.max()) + 1e-3
        solved = solve_ivp(slope, (0.0, end), [self.amplitude, 0.0], rtol=1e-9, atol=1e-11, dense_output=True)
        return np.asarray(solved.sol(times)[0])

    def balls(self, times: FloatArray) -> FloatArray:
        """(n, 3) metres in the optical frame; at rest the ball is near the middle of the image."""
        theta = self.angles(times)
        across = self.length * np.stack([np.sin(theta), np.cos(theta) - 1.0, np.zeros_like(theta)], axis=-1)
        return np.asarray(across + np.array([0.0, 0.1, self.distance]))

    @cached_property
    def _wall(self) -> NDArray[np.uint16]:
        """The measured depth image without the pendulum."""
        wall = np.full((self.camera.height, self.camera.width), self.distance + 1.0, np.float32)
        return measured(wall, DepthCamera(self.camera), np.random.default_rng([self.seed, 51]))

    @cached_property
    def _grid(self) -> tuple[IntArray, IntArray]:
        rows, columns = np.indices((self.camera.height, self.camera.width))
        return rows, columns

    def images(self, ball: FloatArray, number: int) -> tuple[NDArray[Any], NDArray[np.uint16]]:
        """Infrared and depth (millimetres) with the ball at a position (3,); ``number`` seeds the noise."""
        places = [ball, *([np.array([0.25, -0.3, self.distance])] if self.bolt else [])]
        sensor = Sensor(brightness=6.0)
        infrared = render_balls(
            *(self.camera, np.eye(3), np.zeros(3), np.array(places), self.diameter, sensor),
            self.seed * 100_003 + number,
        ).image
        depth = self._wall
        if not self.depth_at_ball:
            rows, columns = self._grid
            x, y = self.camera.project(ball)
            reach = 0.5 * self.diameter * float(self.camera.matrix[0, 0]) / self.distance + 1.5
            hole: BoolArray = (columns - x) ** 2 + (rows - y) ** 2 <= reach**2
            depth = np.where(hole, np.uint16(0), depth)
        return infrared, depth
