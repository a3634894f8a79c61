"""A simulated marker laboratory: a rig to calibrate, targets to measure, an arm that moves in front of them.

Shared by the benchmarks of accuracy. Balls have the centroid noise of the thesis (0.1 pixels, Gaschler 2011, 6.1) and
corners of boards the residual of its table 4.1 (0.06), without images; all later steps are the package's own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation
from target_points import fit_pose

from body_tracking.core import so3
from body_tracking.core.skeleton import FloatArray
from body_tracking.markers.bundle import Corners
from body_tracking.markers.camera_calibration import calibrate_cameras
from body_tracking.markers.joint_model import SIZE, Joint, JointKind, axis_frame, conventional
from body_tracking.markers.joint_tree import Posture, Tree, tree_of
from body_tracking.markers.observations import ImageBalls, Points, TargetPose
from body_tracking.markers.pose import umeyama
from body_tracking.markers.rig import Rig
from body_tracking.markers.target_calibration import calibrate_target
from body_tracking.markers.targets import Target
from body_tracking.markers.triangulation import triangulate
from body_tracking.simulation.marker_scene import APART, TOED_IN, stereo_rig

BALL_NOISE, CORNER_NOISE = 0.1, 0.06
"""Standard deviations per axis, pixels."""
VIEWS, TARGET_VIEWS = 13, 60
PERIOD_NS = 16_666_667


def before(distance: float) -> FloatArray:
    """(3,) point at this distance from the left camera, in the middle of both views, metres."""
    return np.array([0.5 * (APART - distance * np.tan(TOED_IN)), 0.0, distance])


def corners(truth: Rig, rng: np.random.Generator) -> Corners:
    """Corners of a board of 9 x 6, squares of 40 mm, in 13 poses; both cameras see all of it."""
    board = np.stack([*np.meshgrid(0.04 * np.arange(9), 0.04 * np.arange(6)), np.zeros((6, 9))], axis=-1).reshape(-1, 3)
    seen: list[FloatArray] = []
    while len(seen) < VIEWS:
        turn = so3.quat_to_matrix(so3.exp(rng.uniform(-0.6, 0.6, 3)))
        place = before(rng.uniform(0.9, 1.5)) + rng.uniform([-0.2, -0.15, 0.0], [0.2, 0.15, 0.0])
        pixels = truth.project((board - board.mean(axis=0)) @ turn.T + place)
        if all(camera.contains(each).all() for camera, each in zip(truth.cameras, pixels, strict=True)):
            seen.append(pixels + rng.normal(0.0, CORNER_NOISE, pixels.shape))
    cameras, count = len(truth.cameras), len(board)
    return Corners(
        np.tile(np.repeat(np.arange(cameras), count), VIEWS),
        np.repeat(np.arange(VIEWS), cameras * count),
        np.tile(board, (VIEWS * cameras, 1)),
        np.concatenate([each.reshape(-1, 2) for each in seen]),
    )


def calibrated(truth: Rig, rng: np.random.Generator) -> Rig:
    """The rig as calibrated with 13 boards."""
    sizes = [(camera.width, camera.height) for camera in truth.cameras]
    return calibrate_cameras([camera.frame_id for camera in truth.cameras], sizes, corners(truth, rng)).rig


def see(truth: Rig, balls: FloatArray, rng: np.random.Generator, stamp_ns: int = 0) -> list[ImageBalls]:
    """Noisy centroids of (b, 3) balls in each camera, in their order."""
    pixels = truth.project(balls)
    pixels = pixels + rng.normal(0.0, BALL_NOISE, pixels.shape)
    covariance = np.tile(BALL_NOISE**2 * np.eye(2), (len(balls), 1, 1))
    return [
        ImageBalls(stamp_ns, camera.frame_id, each, np.full(len(balls), 60.0), covariance)
        for camera, each in zip(truth.cameras, pixels, strict=True)
    ]


def points_of(rig: Rig, images: Sequence[ImageBalls]) -> Points:
    """Triangulated points in the order of the balls, without wrong matches where epipolar lines cross several balls."""
    points = triangulate(rig, images)
    right = np.flatnonzero((points.balls == points.balls[:, :1]).all(axis=1))
    right = right[np.argsort(points.balls[right, 0])]
    return replace(
        points,
        positions=points.positions[right],
        covariance=points.covariance[right],
        balls=points.balls[right],
    )


def poses_of(targets: Sequence[Target], points: Points) -> list[TargetPose]:
    """Poses of targets with consecutive balls; balls lost by the gates of matching count as not seen."""
    row = np.full(sum(len(target.points) for target in targets), -1)
    row[points.balls[:, 0]] = np.arange(len(points.balls))
    poses, start = [], 0
    for target in targets:
        end = start + len(target.points)
        poses.append(fit_pose(target, points, row[start:end]))
        start = end
    return poses


def placed(targets: Sequence[Target], rotations: FloatArray, translations: FloatArray) -> FloatArray:
    """(b, 3) all balls of targets at poses (t, 3, 3), (t, 3)."""
    return np.concatenate(
        [each.points @ turn.T + shift for each, turn, shift in zip(targets, rotations, translations, strict=True)]
    )


@dataclass(frozen=True, slots=True, eq=False)
class Lab:
    """A laboratory after its calibration.

    Attributes:
        truth: the true rig.
        rig: as calibrated.
        bodies: the true targets.
        targets: as measured, in their own frames.
        turns: (t, 3, 3) and
        shifts: (t, 3) metres: a point x of a true target is at ``turn @ x + shift`` in the measured one.
    """

    truth: Rig
    rig: Rig
    bodies: tuple[Target, ...]
    targets: tuple[Target, ...]
    turns: FloatArray
    shifts: FloatArray

    @classmethod
    def make(cls, bodies: Sequence[Target], rng: np.random.Generator) -> Lab:
        """Calibrate the rig with boards, and measure each target from 60 views at a metre."""
        truth = stereo_rig()
        rig, targets = calibrated(truth, rng), []
        turns, shifts = np.empty((len(bodies), 3, 3)), np.empty((len(bodies), 3))
        for index, body in enumerate(bodies):
            count = len(body.points)
            views, noise = np.full((TARGET_VIEWS, count, 3), np.nan), np.zeros((TARGET_VIEWS, count, 3, 3))
            for view in range(TARGET_VIEWS):
                turn = Rotation.random(random_state=rng).as_matrix()
                points = points_of(rig, see(truth, body.points @ turn.T + before(1.0), rng))
                views[view, points.balls[:, 0]], noise[view, points.balls[:, 0]] = points.positions, points.covariance
            target = calibrate_target(body.name, views, noise, body.diameter).target
            targets.append(target)
            turn, shift = umeyama(body.points[None], target.points[None], np.ones((1, count)))
            turns[index], shifts[index] = turn[0], shift[0]
        return cls(truth, rig, tuple(bodies), tuple(targets), turns, shifts)

    def measure(
        self, rotations: FloatArray, translations: FloatArray, rng: np.random.Generator
    ) -> list[list[TargetPose]]:
        """Measured poses of all targets, frame by frame; the true poses are (n, t, 3, 3), (n, t, 3)."""
        return [
            poses_of(self.targets, points_of(self.rig, see(self.truth, placed(self.bodies, turn, shift), rng, stamp)))
            for stamp, turn, shift in zip(
                range(0, PERIOD_NS * len(rotations), PERIOD_NS), rotations, translations, strict=True
            )
        ]

    def true_joint(self, joint: Joint) -> Joint:
        """A joint of the true targets in the frames of the measured ones, by the conventions."""
        parent, child = ([each.name for each in self.bodies].index(name) for name in (joint.parent, joint.child))
        centres = [
            self.turns[index] @ centre + self.shifts[index]
            for index, centre in ((parent, joint.parent_centre), (child, joint.child_centre))
        ]
        frames = [np.eye(3), np.eye(3)]
        if joint.kind is not JointKind.BALL:
            axes = self.turns[parent] @ joint.parent_axis, self.turns[child] @ joint.child_axis
            frames = [axis_frame(axis, centre) for axis, centre in zip(axes, centres, strict=True)]
        moved = replace(
            joint,
            parent_centre=centres[0],
            child_centre=centres[1],
            parent_rotation=frames[0],
            child_rotation=frames[1],
        )
        return conventional(moved)[0]


def random_joint(rng: np.random.Generator, kind: JointKind, name: str, parent: str, child: str) -> Joint:
    """A joint about 120 mm from both targets, by the conventions."""

    def centre() -> FloatArray:
        direction = rng.normal(size=3)
        return rng.uniform(0.09, 0.15) * direction / np.linalg.norm(direction)

    ball = kind is JointKind.BALL
    frames = [np.eye(3) if ball else Rotation.random(random_state=rng).as_matrix() for _ in range(2)]
    joint = Joint(name, parent, child, kind, frames[0], centre(), frames[1], centre(), np.zeros((SIZE, SIZE)))
    return conventional(joint)[0]


def arm(rng: np.random.Generator, names: Sequence[str]) -> Tree:
    """A ball joint between the first two targets and a hinge between the last two."""
    kinds = (JointKind.BALL, "shoulder", *names[:2]), (JointKind.HINGE, "elbow", *names[1:])
    return tree_of([random_joint(rng, *each) for each in kinds])


def motion(rng: np.random.Generator, tree: Tree, frames: int, degrees: float) -> Posture:
    """Arm at a metre; joints move within +-``degrees`` about all their axes, the body sways by 30 degrees."""

    def smooth(width: int, size: float) -> FloatArray:
        times = np.linspace(0.0, 1.0, frames)[:, None]
        phases, rates = rng.uniform(0.0, 2.0 * np.pi, (3, 1, width)), rng.uniform(3.0, 20.0, (3, 1, width))
        waves = np.sin(2.0 * np.pi * rates * times + phases) / np.arange(1, 4)[:, None, None]
        return size / 1.5 * waves.sum(axis=0)

    turns = []
    for joint in tree.joints:
        size = np.radians(smooth(3, degrees))
        if joint.kind is JointKind.HINGE:
            size = size[:, :1] * np.array([0.0, 0.0, 1.0])
        turned = Rotation.from_rotvec(size)
        base = Rotation.random(random_state=rng) if joint.kind is JointKind.BALL else Rotation.identity()
        turns.append((turned * base).as_matrix())
    base = Rotation.random(random_state=rng)
    rotation = (Rotation.from_rotvec(np.radians(smooth(3, 30.0))) * base).as_matrix()
    return Posture(rotation, before(1.0) + smooth(3, 0.05), tuple(turns))
