"""A simulated person with targets on shoulder, upper arm and forearm in front of a stereo rig of infrared cameras.

Geometry of Gaschler (2011), chapter 6: focal length 834 pixels, baseline 0.48 m, toed in by 13 degrees, targets of 98
mm. The shoulder is a ball joint between its target, which moves with the clavicle, and the upper arm; the elbow is a
universal joint: flexion, then pronation.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from body_tracking.core import so3
from body_tracking.core.camera import Camera
from body_tracking.core.skeleton import NANOSECONDS, FloatArray
from body_tracking.markers.angles import AngleEstimator
from body_tracking.markers.chain import Chain, JointDescription
from body_tracking.markers.joint_model import SIZE, Joint, JointKind, axis_frame, conventional
from body_tracking.markers.observations import TargetPose
from body_tracking.markers.rig import Rig
from body_tracking.markers.targets import Target
from body_tracking.simulation.people import MODEL, Course, Person
from body_tracking.simulation.repertoire import make_movement

FOCAL, WIDTH, HEIGHT = 834.0, 640, 480
APART, TOED_IN = 0.48, np.radians(13.0)
DIAMETER: Final = 0.014
EXTENT: Final = 0.098
SEGMENTS: Final = {"shoulder": "clavicle_left", "upper_arm": "upper_arm_left", "forearm": "forearm_left"}
"""Segment of each target."""
JOINTS: Final = (
    JointDescription("shoulder", "shoulder", "upper_arm", JointKind.BALL),
    JointDescription("elbow", "upper_arm", "forearm", JointKind.UNIVERSAL),
)
"""Joints between the targets."""
_MOUNTS: Final = {"shoulder": (0.03, 0.10, 0.05), "upper_arm": (0.03, 0.06, -0.14), "forearm": (0.03, 0.05, -0.13)}
"""Position of each target on its segment, metres: x forward, y left, z up for a hanging arm."""
_TRIALS: Final = 2000
_APART: Final = 2.0 * DIAMETER
"""Least distance between the centres of two balls of a target, metres."""
_AWAY: Final = 1.7
"""Distance from the rig to the middle of the arm, metres."""
_FLEXION, _PRONATION = np.array([0.0, -1.0, 0.0]), np.array([0.0, 0.0, -1.0])
"""Axes of the elbow in the upper arm's segment and in the forearm's (:mod:`body_tracking.kinematics.upper_body`)."""
_EXACT: Final = 1e-6
"""Standard deviation of a true pose, metres and radians; a covariance must be positive definite."""


@dataclass(frozen=True, slots=True, eq=False)
class MarkerScene:
    """True motion of targets in front of the rig.

    Attributes:
        rig: of two cameras; its frame is that of the left one.
        targets: with their true geometry.
        times: (n,) seconds.
        rotations: (n, t, 3, 3) and
        translations: (n, t, 3) metres: true poses of the targets in the rig's frame.
        elbow: (n, 2) radians, flexion and pronation.
        chain: the true joints, exactly known.
    """

    rig: Rig
    targets: tuple[Target, ...]
    times: FloatArray
    rotations: FloatArray
    translations: FloatArray
    elbow: FloatArray
    chain: Chain

    def balls(self, index: int) -> FloatArray:
        """(b, 3) all balls at one time in the rig's frame, target by target."""
        return np.concatenate(
            [
                target.points @ rotation.T + translation
                for target, rotation, translation in zip(
                    self.targets, self.rotations[index], self.translations[index], strict=True
                )
            ]
        )

    def poses(self, index: int, stamp_ns: int) -> list[TargetPose]:
        """The true poses of all targets at one time, with the covariance of :data:`_EXACT`."""
        return [
            TargetPose(
                target.name,
                stamp_ns,
                self.rig.cameras[0].frame_id,
                rotation,
                translation,
                _EXACT**2 * np.eye(6),
                np.arange(len(target.points)),
                0.0,
            )
            for target, rotation, translation in zip(
                self.targets, self.rotations[index], self.translations[index], strict=True
            )
        ]

    def angles(self) -> FloatArray:
        """(n, k) true angles of :attr:`chain`, radians, by the conventions of :mod:`body_tracking.markers.angles`."""
        estimator, start = AngleEstimator(self.chain), self.times[0]
        return np.stack(
            [
                estimator.estimate(self.poses(index, round((time - start) * NANOSECONDS))).angles
                for index, time in enumerate(self.times)
            ]
        )


def stereo_rig() -> Rig:
    """The stereo rig."""
    matrix = np.array([[FOCAL, 0.0, WIDTH / 2.0 - 0.5], [0.0, FOCAL, HEIGHT / 2.0 - 0.5], [0.0, 0.0, 1.0]])
    cameras = tuple(
        Camera(f"{name}_optical_frame", WIDTH, HEIGHT, matrix, np.array([-0.1, 0.0, 0.0, 0.0, 0.0]))
        for name in ("left", "right")
    )
    # the right camera is on the left one's +x side, rotated about y towards it
    turn = so3.quat_to_matrix(so3.exp(np.array([0.0, TOED_IN, 0.0])))
    middle = np.array([APART * np.cos(TOED_IN / 2.0), 0.0, -APART * np.sin(TOED_IN / 2.0)])
    rig = Rig(cameras, np.stack([np.eye(3), turn]), np.stack([np.zeros(3), -turn @ middle]), np.zeros((30, 30)))
    return rig


def make_targets() -> tuple[Target, ...]:
    """Distinguishable targets of five balls each: the best of random ones."""
    rng = np.random.default_rng(0)
    found: list[Target] = []
    for name in SEGMENTS:
        drawn = rng.uniform(-0.5, 0.5, (_TRIALS, 5, 3)) * np.array([1.0, 1.0, 0.45])
        drawn *= (EXTENT / _distances(drawn).max(axis=1))[:, None, None]
        own = _distances(drawn)
        others = np.hstack([own, *(np.tile(_distances(each.points), (_TRIALS, 1)) for each in found)])
        # distances within a target must differ most, distances of different targets less
        smallest = (np.diff(np.sort(each, axis=1)).min(axis=1) for each in (own, others))
        worth = np.minimum(next(smallest) / 0.002, next(smallest) / 3e-4)
        best = drawn[np.where(own.min(axis=1) < _APART, 0.0, worth).argmax()]
        found.append(Target(name, best - best.mean(axis=0), np.zeros((15, 15)), DIAMETER))
    return tuple(found)


def _distances(points: FloatArray) -> FloatArray:
    """(..., 10) distances between five points (..., 5, 3), metres."""
    first, second = np.triu_indices(5, 1)
    apart: FloatArray = np.linalg.norm(points[..., first, :] - points[..., second, :], axis=-1)
    return apart


def marker_scene(
    motion: str = "reaching", seed: int = 0, rate: float = 60.0, seconds: float = 20.0, start: float | None = None
) -> MarkerScene:
    """A person, drawn by the seed, who moves in front of the rig.

    Args:
        motion: of the repertoire.
        seed: of the person and their manner.
        rate: images per second.
        seconds: of the motion.
        start: seconds of the motion to skip; None takes its middle.
    """
    rng = np.random.default_rng([seed, 20110215])
    person = Person.draw(rng)
    movement = make_movement(motion, person, rng, None)
    count = round(rate * min(seconds, movement.duration))
    start = max(0.0, 0.5 * (movement.duration - count / rate)) if start is None else start
    return scene_of(person, movement.course(start + np.arange(count) / rate), seed)


def scene_of(person: Person, course: Course, seed: int) -> MarkerScene:
    """A person who moves in front of the rig, with the left arm in the middle of its view.

    Args:
        person: the body.
        course: its motion in the person's own frame, which the rig faces.
        seed: of the targets' orientations on the segments.
    """
    # constant over all motions of a person, so that joints fitted to one motion are valid for others
    worn = so3.quat_to_matrix(so3.exp(np.random.default_rng([seed, 98]).normal(0.0, 0.3, (len(SEGMENTS), 3))))
    posture = MODEL.forward(course.q, person.lengths)
    indices = [MODEL.segment_names.index(segment) for segment in SEGMENTS.values()]
    # x right, y down, z forward in the rig; the person's arm in the middle of its view, facing the rig
    away = posture.origins[:, indices].mean(axis=(0, 1))
    to_rig = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]])
    rig = stereo_rig()
    middle = 0.5 * (APART - _AWAY * np.tan(TOED_IN))  # between the axes of the cameras
    mounts = np.array([_MOUNTS[name] for name in SEGMENTS])
    on_segments = posture.rotations[:, indices]
    origins = posture.origins[:, indices] + np.einsum("ntij,tj->nti", on_segments, mounts)
    translations = (origins - away) @ to_rig.T + np.array([middle, 0.0, _AWAY])
    rotations = to_rig @ on_segments @ worn
    upper, lower = (MODEL.coordinate_names.index(name) for name in ("elbow_flexion_left", "forearm_pronation_left"))
    angles = MODEL.difference(MODEL.neutral(), course.q)[:, [upper, lower]]
    centres = (posture.origins[0, indices] - away) @ to_rig.T + np.array([middle, 0.0, _AWAY])
    chain = _true_chain(rotations[0], translations[0], centres, worn)
    return MarkerScene(rig, make_targets(), course.times, rotations, translations, angles, chain)


def _true_chain(rotations: FloatArray, translations: FloatArray, origins: FloatArray, worn: FloatArray) -> Chain:
    """The joints from the targets' poses (3, ...) and their segments' origins (3, 3), which are the joint centres.

    ``worn``: (3, 3, 3) rotations of the targets in their segments.
    """
    joints: list[Joint] = []
    for child, described in enumerate(JOINTS, 1):
        parent = child - 1
        own, other = (rotations[index].T @ (origins[child] - translations[index]) for index in (parent, child))
        frames = np.eye(3), np.eye(3)
        if described.kind is JointKind.UNIVERSAL:
            frames = axis_frame(worn[parent].T @ _FLEXION, own), axis_frame(worn[child].T @ _PRONATION, other)
        joint = Joint(
            described.name,
            described.parent,
            described.child,
            described.kind,
            frames[0],
            own,
            frames[1],
            other,
            np.zeros((SIZE, SIZE)),
        )
        joints.append(conventional(joint)[0])
    size = SIZE * len(joints)
    return Chain(tuple(joints), np.zeros((size, size)), np.zeros((size, 0)))
